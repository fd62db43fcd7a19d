"""A plan played cell by cell, each kept in the results' folder as it ends: what is played again is read from there."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from arena_newton import __version__
from arena_newton.errors import InputError
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.untrusted_files import array_digest, read_arrays
from arena_newton.interfaces import Tracker
from arena_newton.physics.engines import resolve_engine
from arena_newton.robot.g1 import TICK, PhysicsRate
from arena_newton.trackers.evaluation.lab import Lab
from arena_newton.trackers.evaluation.suite_rollout import Outcome, Plan, Settings, play

__all__ = ["FOLDER", "play_parts"]

FOLDER = "parts"
"""Folder of the finished cells within the results' folder."""
PAUSE = 5.0
"""Least time between two lines about the same cell [s]."""
NUMBERS = ("overflows", "ticks", "setup_s", "rollout_s")


def play_parts(
    make: Callable[[], Tracker],
    label: str,
    plan: Plan,
    out: Path | None,
    *,
    fast_physics: bool = False,
    **settings: Unpack[Settings],
) -> Outcome:
    """Play each cell of a plan in a batch of its own, or read it where `out` has it from before, and join them.

    Args:
        make: Makes the tracker again for every cell.
        label: What lines on the error stream call it.
        plan: The cells and their draws.
        out: Folder of the results; None keeps nothing.
        fast_physics: The tracker's fast physics rate.
        settings: As of `suite_rollout.play`.

    Raises:
        InputError: A kept cell cannot be read, or as `suite_rollout.play` does.
    """
    engine, device = resolve_engine(settings.get("engine", "auto"), settings.get("device"))
    parts = []
    for i, cell in enumerate(plan.cells):
        alone, tracker = plan.only(i), make()
        facts = {"tracker": tracker.describe(), "drive": tracker.drive.as_json(), "engine": engine}
        facts["version"] = __version__
        rate, where = tracker.rate(fast=fast_physics), "cuda" if device.startswith("cuda") else "cpu"
        facts |= {
            "device": where,
            "rate": dataclasses.asdict(rate),
            "cell": repr(cell),
            "noise": array_digest(alone.noise),
        }
        facts["actions"] = "" if cell.actions is None else array_digest({"actions": cell.actions})
        digest = hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()[:24]
        path = None if out is None else out / FOLDER / f"{digest}.npz"
        name = f"{label}, {cell.name}"
        if path is not None and path.is_file():
            print(f"{name}: kept from before", file=sys.stderr, flush=True)
            parts.append(_read(path, engine, device, rate))
            continue
        print(f"{name}: {len(alone.cell)} rollouts of {cell.seconds:g} s ...", file=sys.stderr, flush=True)
        said = _Said(name, cell.seconds)
        parts.append(play(tracker, alone, fast_physics=fast_physics, observer=said, **settings))
        if path is not None:
            _write(path, parts[-1])
    return _joined(parts)


class _Said:
    """Prints now and then how far the rollouts of a cell are."""

    def __init__(self, name: str, seconds: float):
        self._name, self._seconds, self._last = name, seconds, time.monotonic()

    def __call__(self, lab: Lab, tick: int) -> None:
        if (now := time.monotonic()) - self._last >= PAUSE:
            self._last = now
            print(f"{self._name}: {max(tick, 0) * TICK:.0f} of {self._seconds:g} s", file=sys.stderr, flush=True)


def _write(path: Path, part: Outcome) -> None:
    arrays: dict[str, Any] = {f"measure {name}": values for name, values in part.measures.items()}
    arrays |= {name: np.array(getattr(part, name)) for name in NUMBERS}
    if part.errors is not None:
        arrays["errors"] = part.errors
    with replace_atomically(path) as file:
        np.savez_compressed(file, **arrays)


def _read(path: Path, engine: str, device: str, rate: PhysicsRate) -> Outcome:
    arrays = read_arrays(path)
    measures = {name.removeprefix("measure "): a for name, a in arrays.items() if name.startswith("measure ")}
    if missing := [name for name in (*NUMBERS, "measure fell") if name not in arrays]:
        raise InputError(f"{path}: a kept cell without {missing[0]!r}; delete the file to play the cell again")
    numbers = {name: arrays[name].item() for name in NUMBERS}
    return Outcome(measures, engine=engine, device=device, rate=rate, errors=arrays.get("errors"), **numbers)


def _joined(parts: list[Outcome]) -> Outcome:
    """One outcome of all cells, in their order; measures that a cell lacks are NaN there."""
    sizes = [len(part.measures["fell"]) for part in parts]
    names = dict.fromkeys(name for part in parts for name in part.measures)
    measures = {
        name: np.concatenate(
            [part.measures.get(name, np.full(size, np.nan)) for part, size in zip(parts, sizes, strict=True)]
        )
        for name in names
    }
    longest = max(0 if part.errors is None else len(part.errors) for part in parts)
    errors = np.full((longest, sum(sizes), 2), np.nan)
    for part, first, size in zip(parts, np.cumsum([0, *sizes]), sizes, strict=False):
        if part.errors is not None:
            errors[: len(part.errors), first : first + size] = part.errors
    totals = {name: sum(getattr(part, name) for part in parts) for name in NUMBERS}
    return dataclasses.replace(parts[0], measures=measures, errors=errors, **totals)
