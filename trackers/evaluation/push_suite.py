"""The push suite: one tour of a minute with a blow every five seconds, and what a tracker makes of each blow.

Blows are those of a public benchmark of walking policies (rhoyn/teleop-walking-benchmark as of 60 s and 600 N): one in
each of twelve segments, 0.08 s long, on the link of any of the 29 joints in any direction; its forces climb as in the
cell `tour, ramp to 600 N`. Cells of one force, and blows at drawn times within their segments, are ours.
"""

from __future__ import annotations

import numpy as np

from arena_newton.robot.g1 import TICK
from arena_newton.trackers.evaluation.suite import Blows, Cell
from arena_newton.trackers.evaluation.suite_rollout import Outcome, Plan, begins
from arena_newton.trackers.motions import primitives as p
from arena_newton.trackers.motions.primitives import Script

__all__ = ["CALM", "FORCES", "RAMP", "add_blow_measures", "cells", "tour"]

FORCES = (50.0, 150.0, 300.0, 450.0, 600.0)
"""Sizes of the blows of one cell each [N]."""
CALM, RAMP = "tour, no blow", "tour, ramp to 600 N"
SEGMENT = 5.0
"""Length of a segment [s]."""
MARGINS = (0.03, 0.15)
"""A robot has recovered when link error [m] and planar velocity error [m/s] are at most so much above the mean that the
tracker has at the same tick without blows ..."""
STEADY = 0.5
"""... for so long [s]."""


def tour() -> Script:
    """Twelve segments of 5 s: standing, walking in all directions, turning, squatting, reaching."""

    def go(forward: float, left: float = 0.0, turn: float = 0.0) -> Script:
        return p.walk(forward, left, turn, seconds=4.0, pause=1.0)

    raised = p.mirrored_arms((-1.6, 0.4, 0.0, 0.6, 0.0, 0.0, 0.0))
    parts = (
        p.stand(SEGMENT),
        go(0.5),
        go(0.0, turn=0.6),
        go(0.0, left=0.2),
        p.squat(0.55),
        go(0.4, turn=0.4),
        p.stand(4.0, arms=raised),
        go(-0.3),
        p.reach("left", (0.35, 0.20, 0.45)),
        go(0.0, turn=-0.8),
        p.step(4.0),
        go(0.6),
    )
    whole = Script(())
    for part in parts:
        rest = SEGMENT - part.seconds
        whole += part + p.stand(rest) if rest > 0.0 else part
    return whole


def cells() -> list[Cell]:
    """The tour without blows, with blows of one force each, with the ramp of forces, and with late signals."""
    script, segments = tour(), round(60.0 / SEGMENT)

    def cell(name: str, newtons: float, *, latency: int = 0, ramp: bool = False) -> Cell:
        blows = Blows(newtons, segments, SEGMENT, ramp=ramp)
        return Cell(name, "tour", 60.0, script, blows=blows, latency=latency, window=0.0)

    return [
        cell(CALM, 0.0),
        *(cell(f"tour, {force:g} N", force) for force in FORCES),
        cell(RAMP, FORCES[-1], ramp=True),
        cell("tour, no blow, 1 tick late", 0.0, latency=1),
    ]


def add_blow_measures(outcome: Outcome, plan: Plan) -> None:
    """Add what the blows did to a rollout's measures; `outcome` has errors by tick.

    `survival`: time until the fall or the end [s]; `blows`: number of blows that began; `blows_survived`: those whose
    segment ended on both feet; `recovery`: mean time from the end of a blow until the robot has recovered [s], of the
    blows from which it did before the next one; `recovered`: their fraction. The last two are NaN where the plan has no
    cell `CALM` or the rollout no blow.
    """
    measures, errors = outcome.measures, outcome.errors
    assert errors is not None
    begin, cells_of = begins(plan), [plan.cells[i] for i in plan.cell]
    end = np.where(measures["fell"], measures["fall_time"], [c.seconds for c in cells_of]) / TICK
    started = begin < end[:, None]
    fatal = measures["fell"] & started.any(axis=1)
    measures["survival"] = end * TICK
    measures["blows"] = started.sum(axis=1).astype(float)
    measures["blows_survived"] = measures["blows"] - fatal
    calm = plan.cell == next((i for i, c in enumerate(plan.cells) if c.name == CALM), -1)
    up = np.isfinite(errors[:, calm]).sum(axis=1)
    mean = np.nansum(errors[:, calm], axis=1) / np.where(up, up, np.nan)
    within = np.all(errors - mean[:, None] <= MARGINS, axis=2)  # false for NaN
    steady = round(STEADY / TICK)
    settled = np.all(np.lib.stride_tricks.sliding_window_view(within, steady, axis=0), axis=2)
    recovery, recovered = np.full(len(end), np.nan), np.full(len(end), np.nan)
    for w in np.flatnonzero(started.any(axis=1) & calm.any()):
        blows = cells_of[w].blows
        assert blows is not None
        times = []
        for k in np.flatnonzero(started[w]):
            first = int(begin[w, k]) + round(blows.seconds / TICK)
            last = int(begin[w, k + 1]) if k + 1 < blows.segments else len(settled)
            found = np.flatnonzero(settled[first:last, w])
            times.append(found[0] * TICK if len(found) else np.nan)
        recovered[w] = np.isfinite(times).mean()
        recovery[w] = np.nanmean(times) if recovered[w] else np.nan
    measures["recovery"], measures["recovered"] = recovery, recovered
