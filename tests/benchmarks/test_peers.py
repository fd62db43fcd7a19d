"""Pairs with other programs: ratios are medians of rounds, what was not measured says so, history names versions."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.policies.train.families.resnet_weights import find_resnet
from benchmarks import __main__ as benches
from benchmarks import peers
from benchmarks.__main__ import BENCHES, main
from benchmarks.bench_options import PeerOptions

ROOT = Path(__file__).resolve().parents[2]


def figures_of(options):
    """All figures of the pairs that are named."""
    return [figure for measure in peers.pairs(options).values() for figure in measure()]


def test_tick_is_the_median_of_the_rounds_ratios(tmp_path, monkeypatch):
    """The ratio is formed within each round; every measured pair leaves one line with what it was measured on."""
    rounds = [(0.003, 0.002), (0.008, 0.004), (0.009, 0.003)]
    monkeypatch.setattr(peers, "tick_times", lambda *given: rounds)
    monkeypatch.setattr(peers, "network_seconds", lambda *given: 0.0006)
    history = tmp_path / "history.jsonl"
    figures = figures_of(PeerOptions(what=("tick",), history=str(history)))
    assert [figure.value for figure in figures] == [2.0, 2.0]
    assert [figure.verdict for figure in figures] == ["MISS", "MISS"]
    assert all("0.600 ms, so no tick can have less than 1.20 x" in figure.note for figure in figures)
    lines = [json.loads(line) for line in history.read_text().splitlines()]
    assert len(lines) == 2
    assert lines[0]["ours"] == pytest.approx(8.0) and lines[0]["peer"] == pytest.approx(3.0)
    assert lines[0]["ratio"] == 2.0  # not 8 / 3, the ratio of the medians
    assert lines[0]["bar"] == 1.5 and lines[0]["device"] and lines[0]["versions"]["mujoco"]


def test_the_network_alone_is_timed():
    """One row of TWIST2's network takes more than a microsecond and less than a whole tick of 20 ms."""
    assert 1e-6 < peers.network_seconds(rounds=3, count=5) < 0.02


def test_on_the_cpu_world_ticks_are_information(monkeypatch):
    """Without CUDA no bar is judged, whatever the ratio is."""
    monkeypatch.setattr(peers.wp, "is_cuda_available", lambda: False)
    monkeypatch.setattr(peers, "tick_times", lambda *given: [(0.5, 0.4)])
    (figure,) = figures_of(PeerOptions(what=("world_ticks",)))
    assert figure.value is None and figure.verdict == "-" and "0.80 x" in figure.note


@pytest.mark.parametrize("pair", ["tracker_training", "act_training"])
def test_what_is_not_measured_is_not_reached(pair):
    """A pair without its dataset or its peer's interpreter says so and has no value."""
    (figure,) = figures_of(PeerOptions(what=(pair,), training_worlds=(4,)))
    assert figure.value is None and figure.note.startswith("not measured:")


def test_a_missing_extra_is_one_line(monkeypatch, capsys):
    """A bench whose libraries are not installed is refused in one line."""

    def missing(extra, what):
        raise InputError(f"{what} needs the extra {extra}")

    monkeypatch.setattr(benches, "require", missing)
    for name, bench in BENCHES.items():
        if bench.extras:
            assert main([name]) == 2
            assert capsys.readouterr().err == f"error: benchmarks {name} needs the extra {bench.extras[0]}\n"


def test_a_pair_that_breaks_does_not_stop_the_others(monkeypatch, capsys):
    """It is a miss with its reason; the pairs after it are measured, and the exit code is 1."""

    def broken(options):
        raise ArenaError("mjlab ended with code 1: out of memory")
        yield

    monkeypatch.setattr(peers, "tracker_training_figures", broken)
    assert main(["peers", "--what", "tracker_training", "act_training"]) == 1
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("MISS") and "tracker_training" in first and "out of memory" in first
    assert "ACT training" in second


def test_unknown_pair():
    """An unknown pair is an error that names the flag."""
    with pytest.raises(InputError, match="--what nonsense: known are tick"):
        peers.pairs(PeerOptions(what=("nonsense",)))


def test_training_needs_no_download(tmp_path):
    """The paper's recipe takes vision weights that are made on the spot."""
    path = peers.new_vision_weights(tmp_path)
    assert find_resnet("resnet18", path) == path
    assert torch.load(path, weights_only=True)["conv1.weight"].shape == (64, 3, 7, 7)


def test_the_overview_lists_every_bench():
    """`--help` names every bench with one line and loads nothing heavy, as the flags of each do."""
    code = (
        "import sys; from benchmarks.__main__ import BENCHES, main\n"
        "assert main(['--help']) == 0\n"
        "for name in BENCHES:\n"
        "    try: main([name, '--help'])\n"
        "    except SystemExit as stop: assert not stop.code\n"
        "heavy = {'warp', 'torch', 'mujoco', 'newton', 'lerobot', 'numpy'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert all(f"python -m benchmarks {name} " in done.stdout for name in BENCHES)
    assert main(["nothing"]) == 2 and main([]) == 2
