"""What the pairs of ``bench --peers`` have in common: versions, names of devices, the history."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import platform
import re
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

import warp as wp

import arena_newton
from arena_newton.eval.bench.bench_figure import BenchFigure
from arena_newton.eval.bench.bench_options import BenchOptions

__all__ = ["NEEDS_CUDA", "PEERS", "add_to_history", "device_name", "median_speeds", "processor_name", "versions"]

PEERS = {
    "tick": ("mujoco", "newton", "warp-lang"),
    "world_ticks": ("mujoco-warp", "newton", "warp-lang"),
    "act_training": ("lerobot", "torch"),
    "tracker_training": ("mujoco-warp", "newton", "rsl-rl-lib", "torch", "warp-lang"),
    "lerobot_eval": ("lerobot", "newton", "torch", "warp-lang"),
    "camera": ("newton", "warp-lang"),
}
"""Pairs, and the packages whose versions are named beside their figures."""
NEEDS_CUDA = "not measured here (needs CUDA); for information, on the CPU: "
"""Begins the note of a pair that was run without CUDA: its bar is not judged there."""


def add_to_history(
    options: BenchOptions,
    pair: str,
    figure: BenchFigure,
    speeds: tuple[float, float, float],
    unit: str,
    device: str,
    peer_versions: Mapping[str, str] | None = None,
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
        peer_versions: Versions of a peer that has an interpreter of its own.
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
        if peer_versions is not None:
            line["peer_versions"] = dict(peer_versions)
        with Path(options.peers_history).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
    return figure


def median_speeds(rounds: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Median speed of ours and of the peer over the rounds, and the median of the rounds' ratios."""
    ours, peer = (statistics.median(column) for column in zip(*rounds, strict=True))
    return ours, peer, statistics.median(one / other for one, other in rounds)


def _commit() -> str:
    """Commit of the checkout, with ``+`` where files differ from it; empty outside a checkout."""
    root = Path(arena_newton.__file__).resolve().parent.parent
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip()


def device_name() -> str:
    """Name of the GPU, or of the processor where there is none."""
    return str(wp.get_device("cuda:0").name) if wp.is_cuda_available() else processor_name()


def processor_name() -> str:
    """Name of the processor."""
    facts = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", facts.read_text()) if facts.is_file() else None
    return found[1] if found else platform.machine()


def versions(pair: str) -> str:
    """Names and versions of a pair's packages."""
    return ", ".join(f"{one} {importlib.metadata.version(one)}" for one in PEERS[pair])
