"""``python -m benchmarks peers``: this product next to other programs, each pair in one run on one machine."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
import warp as wp
from torchvision.models import resnet18

from arena_newton import trackers
from arena_newton.eval.bench.bench_tick import RATES, tick_times
from arena_newton.eval.bench.timing import NEEDS_CUDA, BenchFigure, Figures, chosen
from arena_newton.trackers.front_end import NetworkTracker
from arena_newton.trackers.inference.blocks import BlockRunner
from benchmarks.bench_options import PeerOptions, TrainingBenchOptions
from benchmarks.peer_camera import camera_figures
from benchmarks.peer_lerobot_eval import lerobot_eval_figures
from benchmarks.peer_pairs import Pair, on_cpu, processor_name
from benchmarks.peer_tracker_training import tracker_training_figures
from benchmarks.training_bench import measure

__all__ = ["network_seconds", "new_vision_weights", "pairs"]

TICK = Pair("tick", 1.5, "ms", ("mujoco", "newton", "warp-lang"), digits=3, at_most=True)
WORLD_TICKS = Pair("world_ticks", 0.7, "world-ticks/s", ("mujoco-warp", "newton", "warp-lang"))
ACT_TRAINING = Pair("act_training", 2.0, "steps/s", ("lerobot", "torch"), digits=1)
CPU_WORLDS = 2
"""Worlds of `world_ticks` where there is no CUDA: for information, no bar is judged there."""


def pairs(options: PeerOptions) -> dict[str, Figures]:
    """Pairs that ``--what`` names; one is measured when its figures are asked for.

    Raises:
        InputError: An unknown pair.
    """
    known = {
        "tick": _tick,
        "world_ticks": _world_ticks,
        "act_training": _act_training,
        "tracker_training": tracker_training_figures,
        "lerobot_eval": lerobot_eval_figures,
        "camera": camera_figures,
    }
    return chosen(options.what, {name: partial(work, options) for name, work in known.items()})


def _tick(options: PeerOptions) -> Iterator[BenchFigure]:
    network = 1e3 * network_seconds(options.twist2, options.rounds)
    for rate in RATES:
        times = tick_times(1, "mujoco", RATES[rate], options.rounds, options.twist2)
        rounds = [(1e3 * full, 1e3 * alone) for full, alone in times]
        least = 1 + network / statistics.median(alone for _, alone in rounds)
        floor = f"the tracker's network alone {network:.3f} ms, so no tick can have less than {least:.2f} x"
        label = f"tick with tracker / bare mj_step, one world, CPU, {rate}"
        yield TICK.judge(options, label, rounds, notes=[floor], device=processor_name())


def network_seconds(checkpoint: str | None = None, rounds: int = 20, count: int = 100) -> float:
    """Median time of TWIST2's network for one world on the CPU, as it runs in a tick, without its observation [s].

    No tick takes less than this and its physics.

    Args:
        checkpoint: Weights of TWIST2; those of the package when None.
        rounds: Rounds, of which the median is taken.
        count: Runs of a round.
    """
    tracker = trackers.get("twist2", checkpoint)
    assert isinstance(tracker, NetworkTracker)
    runner = BlockRunner(tracker.network, tracker.front_end.obs_width, 1)
    runner.input.normal_(generator=torch.Generator().manual_seed(0))
    for _ in range(count):  # the first run compiles
        runner.run()
    measured = []
    for _ in range(rounds):
        began = time.perf_counter()
        for _ in range(count):
            runner.run()
        measured.append((time.perf_counter() - began) / count)
    return statistics.median(measured)


def _world_ticks(options: PeerOptions) -> Iterator[BenchFigure]:
    cuda = wp.is_cuda_available()
    worlds = options.worlds if cuda else CPU_WORLDS
    times = tick_times(worlds, "warp", RATES["5 ms x 4"], options.rounds, options.twist2, 25 if cuda else 2)
    label = f"world-ticks/s with tracker / mujoco_warp's bare step, {worlds} worlds, 5 ms x 4"
    rounds = [(worlds / full, worlds / alone) for full, alone in times]
    yield WORLD_TICKS.judge(options, label, rounds, unjudged=on_cpu(cuda))


def new_vision_weights(folder: Path) -> Path:
    """A file of weights that nobody trained, for the paper's vision encoder, so that its speed needs no download."""
    path = folder / "resnet18.pth"
    torch.save(resnet18().state_dict(), path)
    return path


def _act_training(options: PeerOptions) -> Iterator[BenchFigure]:
    label = "ACT training, 224x224, batch 64 / LeRobot's own loop, same dataset"
    if not options.dataset:
        yield ACT_TRAINING.missing(label, "not measured: name a dataset by --dataset")
        return
    if not wp.is_cuda_available():
        yield ACT_TRAINING.missing(label, NEEDS_CUDA)
        return
    with tempfile.TemporaryDirectory() as folder:
        # The paper's recipe: both sides compute in float32, and LeRobot's loader can feed it (no task vector).
        flags = TrainingBenchOptions(
            recipe="paper",
            batch_size=64,
            dataset=(Path(options.dataset),),
            weights=str(new_vision_weights(Path(folder))),
            against_lerobot=True,
        )
        speeds = [(measure(flags, 1)[0].steps_per_s, measure(flags, 1, lerobot=True)[0].steps_per_s)]
    notes = ["paper's recipe, new vision weights"]
    yield ACT_TRAINING.judge(options, label, speeds, notes=notes)
