"""Inference in blocks gives each row bits that do not depend on the other rows."""

import pytest
import torch
import warp as wp

from arena_newton.errors import InputError
from arena_newton.trackers.inference import blocks, stored_graphs
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
            for seed in range(2):
                order = torch.randperm(20, generator=torch.Generator().manual_seed(seed))
                assert torch.equal(outputs(network, rows[order]), whole[order])
                assert torch.equal(outputs(network, rows[order[:3]]), whole[order[:3]])
            for row in (0, 7, 19):
                assert torch.equal(outputs(network, rows[row : row + 1]), whole[row : row + 1])
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_a_run_reads_the_rows_as_they_are():
    """Every run reads what the input holds then, and gives the bits of a run that was never made before."""
    network, rows = mlp(451, 64, 29), torch.randn(3, 451, generator=torch.Generator().manual_seed(2))
    runner = BlockRunner(network, 451, 3)
    for step in range(3):
        runner.input.copy_(rows + step)
        assert torch.equal(runner.run(), outputs(network, rows + step))


def test_modules_run_in_onnx_runtime():
    """A network of modules is compiled, and its plan is a block size that was tried."""
    runner = BlockRunner(mlp(451, 64, 29), 451, 20)
    assert runner.path == "onnxruntime" and runner.plan()[0] in (1, 2, 4)
    runner.input.copy_(torch.randn(20, 451))
    assert runner.run().shape == (20, 29)


@pytest.mark.parametrize("worlds", [41, 64])
def test_many_rows_are_divided_among_threads(monkeypatch, worlds):
    """Threads with a product each give the bits of one product."""
    network, rows = mlp(451, 64, 29), torch.randn(worlds, 451)
    whole = outputs(network, rows)
    monkeypatch.setattr(blocks, "_ROWS_PER_THREAD", 8)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    runner = BlockRunner(network, 451, worlds)
    used = set()
    runner.input.copy_(rows)
    runner.plan()
    product = runner._exported.product
    runner._exported.product = lambda part: used.add(len(part)) or product(part)
    assert torch.equal(runner.run(), whole)
    assert max(used) <= -(-worlds // 3) + 1


def test_a_module_that_cannot_be_compiled_is_refused(monkeypatch):
    """A failing exporter or runtime ends the first tick in one line."""
    monkeypatch.setattr(blocks, "graph_file", lambda network, shape: None)
    monkeypatch.setattr(torch.onnx, "export", lambda *a, **k: 1 / 0)
    with pytest.raises(InputError, match=r"cannot run in ONNX Runtime \(ZeroDivisionError: division by zero\)"):
        outputs(mlp(451, 64, 29), torch.randn(20, 451))


class OnHost(torch.nn.Module):
    """Stands for a session, which is not compiled."""

    on_host = True

    def __init__(self, change):
        super().__init__()
        self.change = change

    def forward(self, x):
        return x + self.change(x)


def test_network_that_mixes_positions():
    """Rows of a network for which no block size keeps their bits run one at a time and do not depend on each other."""
    network = OnHost(lambda x: 1e-3 * torch.arange(len(x))[:, None])
    rows = torch.randn(20, 8)
    assert BlockRunner(network, 8, 20).plan() == (1, False)
    assert torch.equal(outputs(network, rows), rows)


def test_blocks_where_single_rows_have_other_bits():
    """Rows are padded to the smallest block whose bits do not depend on the other blocks."""
    network = OnHost(lambda x: 0.0 if len(x) % 2 == 0 else 1e-3)
    assert BlockRunner(network, 4, 7).plan() == (2, True)
    rows = torch.randn(7, 4)
    assert torch.equal(outputs(network, rows), rows)


def test_an_exported_graph_is_stored(tmp_path, monkeypatch):
    """A network is exported once, again if its stored graph is damaged or foreign, always if none can be stored."""
    exports, export = [], torch.onnx.export
    monkeypatch.setattr(torch.onnx, "export", lambda *given, **named: (exports.append(0), export(*given, **named)))
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    rows = torch.randn(8, 64, generator=torch.Generator().manual_seed(5))

    def exported(network=None) -> int:
        before = len(exports)
        answer = blocks.compiled(network or mlp(64, 32, 8), (8, 64))(rows)
        assert network is not None or torch.equal(answer, first)
        return len(exports) - before

    first = blocks.compiled(mlp(64, 32, 8), (8, 64))(rows)
    known = mlp(64, 32, 8)
    known.register_forward_pre_hook(lambda *_: 1 / 0)
    assert exported() == 0 and torch.equal(blocks.compiled(known, (8, 64))(rows), first)
    (file,) = (tmp_path / "onnx").iterdir()
    graph = file.read_bytes()
    other = mlp(64, 32, 8)
    with torch.no_grad():
        other[0].weight[0, 0] += 1e-6
    assert exported(other) == 1
    (foreign,) = set((tmp_path / "onnx").iterdir()) - {file}
    for damage in (graph[:-1], graph[:200] + b"?" + graph[201:], b"", foreign.read_bytes()):
        file.write_bytes(damage)
        assert exported() == 1 and file.read_bytes() == graph and exported() == 0
    for seed in range(stored_graphs.MOST):
        torch.manual_seed(seed)
        exported(torch.nn.Linear(64, 8))
    assert len(list((tmp_path / "onnx").iterdir())) == stored_graphs.MOST and not file.exists()
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "file"))
    assert exported() == 1
