"""``bench --peers``: this product beside other programs, each pair in one run on one machine."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import platform
import re
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import warp as wp

import arena_newton
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench_figure import BenchFigure
from arena_newton.eval.bench_tick import RATES, tick_times
from arena_newton.eval.options import BenchOptions
from arena_newton.own_processes import environment

__all__ = ["peer_figures", "training_speeds"]

PEERS = {
    "tick": ("mujoco", "newton", "warp-lang"),
    "world_ticks": ("mujoco-warp", "newton", "warp-lang"),
    "act_training": ("lerobot", "torch"),
}
"""Pairs, and the packages whose versions are named beside their figures."""
UNWRITTEN = {
    "tracker_training": ("tracker training, samples/s / mjlab's G1 tracking task, 4096 and 8192 worlds", 1.2),
    "lerobot_eval": ("60 VisNavi episodes, learned policy / lerobot-eval, speed", 5.0),
    "pictures": ("head-camera pictures/s / Newton's camera sensor, 1024 worlds", 1.0),
}
"""Pairs that the product must be measured in and for which there is no measurement yet, with their bars."""
TICK_BAR, WORLD_TICKS_BAR, TRAINING_BAR = 1.5, 0.7, 2.0
"""Bars of the ratios."""
CPU_WORLDS = 2
"""Worlds of `world_ticks` where there is no CUDA: for information, no bar is judged there."""


def peer_figures(options: BenchOptions) -> Iterator[BenchFigure]:
    """Measure the pairs that ``--peers`` names.

    Raises:
        InputError: An unknown pair.
    """
    known: dict[str, Callable[[BenchOptions], Iterator[BenchFigure]]] = {
        "tick": _tick,
        "world_ticks": _world_ticks,
        "act_training": _act_training,
    }
    for name in options.peers:
        if name not in (*known, *UNWRITTEN, "all"):
            raise InputError(f"--peers {name}: known are {' '.join((*known, *UNWRITTEN))} all")
    wanted = (*known, *UNWRITTEN) if "all" in options.peers else options.peers
    for name in dict.fromkeys(wanted):
        if name in UNWRITTEN:
            title, bar = UNWRITTEN[name]
            yield BenchFigure(title, bar, "x", False, None, "not measured: there is no measurement of this pair yet")
        else:
            yield from known[name](options)


def _pair(
    options: BenchOptions,
    pair: str,
    figure: BenchFigure,
    speeds: tuple[float, float, float],
    unit: str,
    device: str,
) -> BenchFigure:
    """The figure, after its line was added to the history.

    Args:
        options: Flags.
        pair: Name of the pair.
        figure: Its figure.
        speeds: Ours, the peer's, and the ratio that is judged: the median of the rounds' ratios, which is not the
            ratio of the two medians.
        unit: Unit of the two.
        device: What it was measured on.
    """
    ours, peer, ratio = speeds
    if options.peers_history:
        line = {
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "pair": pair,
            "name": figure.name,
            "device": device,
            "commit": _commit(),
            "versions": {one: importlib.metadata.version(one) for one in PEERS[pair]},
            "ours": ours,
            "peer": peer,
            "unit": unit,
            "ratio": ratio,
            "bar": figure.bar,
            "verdict": figure.verdict if figure.value is not None else "information",
        }
        with Path(options.peers_history).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
    return figure


def _commit() -> str:
    """Commit of the checkout, with ``+`` where files differ from it; empty outside a checkout."""
    root = Path(arena_newton.__file__).resolve().parent.parent
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip()


def _device() -> str:
    return str(wp.get_device("cuda:0").name) if wp.is_cuda_available() else _processor()


def _processor() -> str:
    """Name of the processor."""
    facts = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", facts.read_text()) if facts.is_file() else None
    return found[1] if found else platform.machine()


def _versions(pair: str) -> str:
    return ", ".join(f"{one} {importlib.metadata.version(one)}" for one in PEERS[pair])


def _tick(options: BenchOptions) -> Iterator[BenchFigure]:
    for rate in RATES:
        pairs = tick_times(1, "mujoco", RATES[rate], options.rounds, options.checkpoint)
        ratio = statistics.median(full / alone for full, alone in pairs)
        ours, peer = (1e3 * statistics.median(column) for column in zip(*pairs, strict=True))
        note = f"{ours:.3f} ms / {peer:.3f} ms, median of {len(pairs)} ratios; {_versions('tick')}"
        name = f"tick with tracker / bare mj_step, one world, CPU, {rate}"
        figure = BenchFigure(name, TICK_BAR, "x", True, ratio, note)
        yield _pair(options, "tick", figure, (ours, peer, ratio), "ms", _processor())


def _world_ticks(options: BenchOptions) -> Iterator[BenchFigure]:
    cuda = wp.is_cuda_available()
    worlds = options.cuda_worlds if cuda else CPU_WORLDS
    pairs = tick_times(worlds, "warp", RATES["5 ms x 4"], options.rounds, options.checkpoint, 25 if cuda else 2)
    ours, peer = (worlds / statistics.median(column) for column in zip(*pairs, strict=True))
    ratio = statistics.median(alone / full for full, alone in pairs)
    note = f"{ours:,.0f} / {peer:,.0f} world-ticks/s; {_versions('world_ticks')}"
    name = f"world-ticks/s with tracker / mujoco_warp's bare step, {worlds} worlds, 5 ms x 4"
    if not cuda:
        note = f"not measured here (needs CUDA); for information, on the CPU: {ratio:.2f} x, {note}"
    figure = BenchFigure(name, WORLD_TICKS_BAR, "x", False, ratio if cuda else None, note)
    yield _pair(options, "world_ticks", figure, (ours, peer, ratio), "world-ticks/s", _device())


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
    command += ["--dataset", options.peers_dataset]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
    if done.returncode:
        raise ArenaError(f"policies.train bench ended with code {done.returncode}: {done.stderr[-200:]}")
    ours, peer = training_speeds(done.stdout)
    note = f"{ours:.1f} / {peer:.1f} steps/s, paper's recipe; {_versions('act_training')}"
    figure = BenchFigure(name, bar, "x", False, ours / peer, note)
    yield _pair(options, "act_training", figure, (ours, peer, ours / peer), "steps/s", _device())
