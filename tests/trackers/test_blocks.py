"""Inference in blocks gives each row bits that do not depend on the other rows."""

import pytest
import torch

from arena_newton.trackers.inference import blocks
from arena_newton.trackers.inference.blocks import BlockRunner


def outputs(network, rows: torch.Tensor) -> torch.Tensor:
    runner = BlockRunner(network, rows.shape[1], len(rows))
    runner.input.copy_(rows)
    return runner.run()


def mlp(width: int, hidden: int, out: int) -> torch.nn.Module:
    torch.manual_seed(0)
    layers = [torch.nn.Linear(width, hidden), torch.nn.SiLU(), torch.nn.Linear(hidden, hidden), torch.nn.ELU()]
    return torch.nn.Sequential(*layers, torch.nn.Linear(hidden, out)).eval()


@pytest.mark.parametrize("shape", [(1432, 512, 29), (451, 37, 29), (64, 300, 40)])
def test_bit_identity(shape):
    """Batches of 1, 3 and 20 rows in any order give the same bits, with one thread and with two."""
    network = mlp(*shape)
    rows = torch.randn(20, shape[0], generator=torch.Generator().manual_seed(1))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = outputs(network, rows)
        torch.testing.assert_close(whole, network(rows), atol=1e-5, rtol=1e-4)
        for threads in (1, 2):
            torch.set_num_threads(threads)
            for seed in range(3):
                order = torch.randperm(20, generator=torch.Generator().manual_seed(seed))
                assert torch.equal(outputs(network, rows[order]), whole[order])
                assert torch.equal(outputs(network, rows[order[:3]]), whole[order[:3]])
            for row in range(20):
                assert torch.equal(outputs(network, rows[row : row + 1]), whole[row : row + 1])
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_modules_run_compiled_and_in_one_product():
    """Networks of modules need no blocks: every row has its bits in any product."""
    runner = BlockRunner(mlp(451, 64, 29), 451, 20)
    assert runner.plan() == (1, True)
    rows = torch.randn(20, 451)
    runner.input.copy_(rows)
    assert runner.run().shape == (20, 29)


@pytest.mark.parametrize("worlds", [41, 64])
def test_many_rows_are_shared_among_threads(monkeypatch, worlds):
    """Threads with a product each give the bits of one product."""
    network, rows = mlp(451, 64, 29), torch.randn(worlds, 451)
    whole = outputs(network, rows)
    monkeypatch.setattr(blocks, "_SHARE", 8)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    runner = BlockRunner(network, 451, worlds)
    used = set()
    runner.input.copy_(rows)
    runner.plan()
    product = runner._product
    runner._product = lambda part: used.add(len(part)) or product(part)
    assert torch.equal(runner.run(), whole)
    assert max(used) <= -(-worlds // 3) + 1


def test_a_module_that_cannot_be_compiled_runs_all_the_same(monkeypatch):
    """Where the exporter fails, blocks of a traced network give the same promise."""
    monkeypatch.setattr(torch.onnx, "export", lambda *a, **k: 1 / 0)
    network, rows = mlp(451, 64, 29), torch.randn(20, 451)
    whole = outputs(network, rows)
    torch.testing.assert_close(whole, network(rows), atol=1e-5, rtol=1e-4)
    for row in range(20):
        assert torch.equal(outputs(network, rows[row : row + 1]), whole[row : row + 1])


def test_blocks_of_a_traced_network_stay_on_one_thread(monkeypatch):
    """Only of a compiled network is it known that a row has its bits in any product."""
    monkeypatch.setattr(torch.onnx, "export", lambda *a, **k: 1 / 0)
    monkeypatch.setattr(blocks, "_SHARE", 8)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    network, rows = mlp(451, 64, 29), torch.randn(40, 451)
    runner = BlockRunner(network, 451, 40)
    runner.input.copy_(rows)
    whole = runner.run()
    assert runner._pool is None
    for row in range(0, 40, 7):
        assert torch.equal(outputs(network, rows[row : row + 1]), whole[row : row + 1])


def test_network_that_mixes_positions():
    """Where no block size keeps a row's bits, rows run one at a time and still do not depend on each other."""

    def network(x):
        return x + 1e-3 * torch.arange(len(x))[:, None]

    rows = torch.randn(20, 8)
    runner = BlockRunner(network, 8, 20)
    assert runner.plan() == (1, False)
    assert torch.equal(outputs(network, rows), rows)


def test_separate_blocks_where_merging_changes_bits():
    """Blocks run separately where one larger product would give other bits."""

    def network(x):
        return x + (1e-3 if len(x) > 4 else 0.0)

    runner = BlockRunner(network, 4, 20)
    assert runner.plan() == (4, False)
    rows = torch.randn(20, 4)
    assert torch.equal(outputs(network, rows), rows)
