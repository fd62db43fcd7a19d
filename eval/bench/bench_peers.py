"""``bench --peers``: this product beside other programs, each pair in one run on one machine."""

from __future__ import annotations

import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import warp as wp

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench.bench_figure import BenchFigure
from arena_newton.eval.bench.bench_options import BenchOptions
from arena_newton.eval.bench.bench_tick import RATES, network_seconds, tick_times
from arena_newton.eval.bench.peer_camera import camera_figures
from arena_newton.eval.bench.peer_lerobot_eval import lerobot_eval_figures
from arena_newton.eval.bench.peer_pairs import add_to_history, device_name, processor_name, versions
from arena_newton.eval.bench.peer_tracker_training import tracker_training_figures
from arena_newton.files.own_processes import environment

__all__ = ["new_vision_weights", "peer_items", "training_speeds"]

TICK_BAR, WORLD_TICKS_BAR, TRAINING_BAR = 1.5, 0.7, 2.0
"""Bars of the ratios."""
CPU_WORLDS = 2
"""Worlds of `world_ticks` where there is no CUDA: for information, no bar is judged there."""


def peer_items(options: BenchOptions) -> list[tuple[str, Iterator[BenchFigure]]]:
    """Name and figures of each pair that ``--peers`` names; a pair is measured when its figures are asked for.

    Raises:
        InputError: An unknown pair.
    """
    known: dict[str, Callable[[BenchOptions], Iterator[BenchFigure]]] = {
        "tick": _tick,
        "world_ticks": _world_ticks,
        "act_training": _act_training,
        "tracker_training": tracker_training_figures,
        "lerobot_eval": lerobot_eval_figures,
        "camera": camera_figures,
    }
    for name in options.peers:
        if name not in (*known, "all"):
            raise InputError(f"--peers {name}: known are {' '.join(known)} all")
    wanted = tuple(known) if "all" in options.peers else options.peers
    return [(name, known[name](options)) for name in dict.fromkeys(wanted)]


def _tick(options: BenchOptions) -> Iterator[BenchFigure]:
    network = 1e3 * network_seconds(options.checkpoint, options.rounds)
    for rate in RATES:
        pairs = tick_times(1, "mujoco", RATES[rate], options.rounds, options.checkpoint)
        ratio = statistics.median(full / alone for full, alone in pairs)
        ours, peer = (1e3 * statistics.median(column) for column in zip(*pairs, strict=True))
        least = 1 + network / peer
        floor = f"the tracker's network alone {network:.3f} ms, so no tick can have less than {least:.2f} x"
        note = f"{ours:.3f} ms / {peer:.3f} ms, median of {len(pairs)} ratios; {floor}; {versions('tick')}"
        name = f"tick with tracker / bare mj_step, one world, CPU, {rate}"
        figure = BenchFigure(name, TICK_BAR, "x", True, ratio, note)
        yield add_to_history(options, "tick", figure, (ours, peer, ratio), "ms", processor_name())


def _world_ticks(options: BenchOptions) -> Iterator[BenchFigure]:
    cuda = wp.is_cuda_available()
    worlds = options.cuda_worlds if cuda else CPU_WORLDS
    pairs = tick_times(worlds, "warp", RATES["5 ms x 4"], options.rounds, options.checkpoint, 25 if cuda else 2)
    ours, peer = (worlds / statistics.median(column) for column in zip(*pairs, strict=True))
    ratio = statistics.median(alone / full for full, alone in pairs)
    note = f"{ours:,.0f} / {peer:,.0f} world-ticks/s; {versions('world_ticks')}"
    name = f"world-ticks/s with tracker / mujoco_warp's bare step, {worlds} worlds, 5 ms x 4"
    if not cuda:
        note = f"not measured here (needs CUDA); for information, on the CPU: {ratio:.2f} x, {note}"
    figure = BenchFigure(name, WORLD_TICKS_BAR, "x", False, ratio if cuda else None, note)
    yield add_to_history(options, "world_ticks", figure, (ours, peer, ratio), "world-ticks/s", device_name())


def training_speeds(text: str) -> tuple[float, float]:
    """Steps/s of our training and of LeRobot's loop in what ``policies.train bench --against-lerobot`` printed.

    Raises:
        ArenaError: One of the two is not there.
    """
    ours = re.search(r"^alone: ([\d.]+) steps/s", text, re.M)
    peer = re.search(r"^LeRobot's loop, \d+ workers: ([\d.]+) steps/s", text, re.M)
    if ours is None or peer is None or float(peer[1]) == 0.0:
        raise ArenaError(f"policies.train bench: no two speeds in what it printed: {text[-200:]!r}")
    return float(ours[1]), float(peer[1])


def new_vision_weights(folder: Path) -> Path:
    """A file of weights that nobody trained, for the paper's vision encoder, so that its speed needs no download.

    Raises:
        ArenaError: They could not be made.
    """
    path = folder / "resnet18.pth"
    program = (
        "import sys, torch, torchvision; m = torchvision.models.resnet18(); torch.save(m.state_dict(), sys.argv[1])"
    )
    command = [sys.executable, "-P", "-c", program, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
    if done.returncode or not path.is_file():
        raise ArenaError(f"the vision encoder's weights could not be made: {done.stderr[-200:]}")
    return path


def _act_training(options: BenchOptions) -> Iterator[BenchFigure]:
    name, bar = "ACT training, 224x224, batch 64 / LeRobot's own loop, same dataset", TRAINING_BAR
    reason = ""
    if not options.peers_dataset:
        reason = "not measured: name a dataset by --peers-dataset"
    elif not wp.is_cuda_available():
        reason = "not measured here (needs CUDA)"
    if reason or options.peers_dataset is None:
        yield BenchFigure(name, bar, "x", False, None, reason)
        return
    # The paper's recipe: both sides compute in float32, and LeRobot's loader can feed it (no task vector).
    flags = ["--policy", "act", "--recipe", "paper", "--batch-size", "64", "--trainings", "1", "--against-lerobot"]
    command = [sys.executable, "-P", "-m", "arena_newton.policies.train", "bench", *flags]
    with tempfile.TemporaryDirectory() as folder:
        command += ["--dataset", options.peers_dataset, "--weights", str(new_vision_weights(Path(folder)))]
        done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
    if done.returncode:
        raise ArenaError(f"policies.train bench ended with code {done.returncode}: {done.stderr[-200:]}")
    ours, peer = training_speeds(done.stdout)
    note = f"{ours:.1f} / {peer:.1f} steps/s, paper's recipe, new vision weights; {versions('act_training')}"
    figure = BenchFigure(name, bar, "x", False, ours / peer, note)
    yield add_to_history(options, "act_training", figure, (ours, peer, ours / peer), "steps/s", device_name())
