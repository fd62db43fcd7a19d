"""bench --peers: ratios are medians of rounds, what was not measured says so, history names device and versions."""

import json

import pytest
import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench import bench, bench_peers, peer_lerobot_eval, peer_tracker_training
from arena_newton.eval.bench.bench_options import BenchOptions
from arena_newton.eval.bench.bench_tick import network_seconds
from arena_newton.policies.lerobot.resnet_weights import find_resnet


def figures_of(options):
    """All figures of the pairs that are named."""
    return [figure for _, found in bench_peers.peer_items(options) for figure in found]


def test_tick_is_the_median_of_the_rounds_ratios(tmp_path, monkeypatch):
    """The ratio is formed within each round; every measured pair leaves one line with what it was measured on."""
    rounds = [(0.003, 0.002), (0.008, 0.004), (0.009, 0.003)]
    monkeypatch.setattr(bench_peers, "tick_times", lambda *given: rounds)
    monkeypatch.setattr(bench_peers, "network_seconds", lambda *given: 0.0006)
    history = tmp_path / "history.jsonl"
    figures = figures_of(BenchOptions(peers=("tick",), peers_history=str(history)))
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
    assert 1e-6 < network_seconds(rounds=3, count=5) < 0.02


def test_on_the_cpu_world_ticks_are_information(monkeypatch):
    """Without CUDA no bar is judged, whatever the ratio is."""
    monkeypatch.setattr(bench_peers.wp, "is_cuda_available", lambda: False)
    monkeypatch.setattr(bench_peers, "tick_times", lambda *given: [(0.5, 0.4)])
    (figure,) = figures_of(BenchOptions(peers=("world_ticks",)))
    assert figure.value is None and figure.verdict == "-" and "0.80 x" in figure.note


@pytest.mark.parametrize("pair", ["tracker_training", "act_training"])
def test_what_is_not_measured_is_not_reached(pair):
    """A pair without its dataset or its peer's interpreter says so and has no value."""
    (figure,) = figures_of(BenchOptions(peers=(pair,), peers_worlds=(4,)))
    assert figure.value is None and figure.note.startswith("not measured:")


@pytest.mark.parametrize("module", [peer_tracker_training, peer_lerobot_eval])
def test_a_missing_extra_is_one_line(module, monkeypatch):
    """A pair whose libraries are not installed says so and has no value: it is not reached."""

    def missing(extra, what):
        raise InputError(f"{what} needs the extra {extra}")

    monkeypatch.setattr(module, "require", missing)
    pair = module.__name__.rsplit(".peer_")[-1]
    (figure,) = figures_of(BenchOptions(peers=(pair,), mjlab_python="python", peers_worlds=(4,)))
    assert figure.value is None and figure.verdict == "-"
    assert figure.note.startswith(f"not measured: eval bench --peers {pair} needs the extra")


def test_a_pair_that_breaks_does_not_stop_the_others(monkeypatch, capsys):
    """It is a miss with its reason; the pairs after it are measured, and the exit code is 1."""

    def broken(options):
        raise ArenaError("mjlab ended with code 1: out of memory")
        yield

    monkeypatch.setattr(bench_peers, "tracker_training_figures", broken)
    assert bench.run(BenchOptions(peers=("tracker_training", "act_training"))) == 1
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("MISS") and "tracker_training" in first and "out of memory" in first
    assert "ACT training" in second


def test_unknown_pair():
    """An unknown pair is an error that names the flag."""
    with pytest.raises(InputError, match="--peers nonsense"):
        bench.run(BenchOptions(peers=("nonsense",)))


def test_training_speeds_are_read():
    """Both speeds of the training's bench are found; where one is missing that is an error."""
    text = "act/paper\nalone: 71.5 steps/s (one graph a step)\nLeRobot's loop, 4 workers: 31.0 steps/s; ours\n"
    assert bench_peers.training_speeds(text) == (71.5, 31.0)
    with pytest.raises(ArenaError, match="no two speeds"):
        bench_peers.training_speeds("alone: 71.5 steps/s\n")


def test_training_needs_no_download(tmp_path):
    """The paper's recipe takes vision weights that are made on the spot."""
    path = bench_peers.new_vision_weights(tmp_path)
    assert find_resnet("resnet18", path) == path
    assert torch.load(path, weights_only=True)["conv1.weight"].shape == (64, 3, 7, 7)


def test_vision_weights_that_cannot_be_made(tmp_path):
    """A folder that is not there is one error."""
    with pytest.raises(ArenaError, match="vision encoder's weights"):
        bench_peers.new_vision_weights(tmp_path / "missing")
