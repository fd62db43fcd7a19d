"""Figures with a bar: what a tracker has to reach, each one row with its verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from arena_newton.intervals import wilson
from arena_newton.trackers.evaluation.cells import suite
from arena_newton.trackers.evaluation.rollout import Outcome, Plan

__all__ = ["Figure", "Result", "figures"]

GOAL_PLACE, GOAL_TURN = 0.08, 5.0
"""A goal counts as reached within this [m], [deg]."""
SEAT_TIME = 2.0
"""Time at 100 N and more that counts as sitting [s]."""
BEHIND = 0.2
"""A pelvis this far behind the middle of a sill is over it [m]."""
RISEN = 0.65
"""A pelvis above this stands again [m]."""


@dataclass
class Result:
    """One tracker on one plan."""

    label: str
    """What tables call it."""
    interface: str
    """Name of the tracker's class: decides which bars hold."""
    official: bool
    """Weights of others, to compare with."""
    tracker: dict[str, Any]
    """`Tracker.describe`."""
    plan: Plan
    outcome: Outcome
    inference: dict[str, float] = field(default_factory=dict)
    """`cpu` of one world and, where there is a GPU, `cuda` of 4096 [ms]."""

    def rows(self, *names: str) -> np.ndarray:
        """Worlds of the cells with these names, bool [worlds]."""
        wanted = [i for i, cell in enumerate(self.plan.cells) if cell.name in names]
        return np.isin(self.plan.cell, wanted)

    def group(self, name: str) -> np.ndarray:
        """Worlds of a group's cells, bool [worlds]."""
        wanted = [i for i, cell in enumerate(self.plan.cells) if cell.group == name]
        return np.isin(self.plan.cell, wanted)

    @property
    def whole(self) -> bool:
        """Whether the plan holds every cell of the full suite: the bar of the fall rate is one for all of it."""
        return {cell.name for cell in suite("full")} <= {cell.name for cell in self.plan.cells}

    def of(self, measure: str, rows: np.ndarray) -> np.ndarray:
        """Values of a measure in some worlds."""
        return self.outcome.measures[measure][rows]


@dataclass(frozen=True)
class Figure:
    """One row: a value, the bar, and whether it is met."""

    name: str
    value: str
    bar: str
    """Empty without one."""
    met: bool | None
    """None where there is nothing to judge."""
    number: float | None = None
    """The value that `limit` is about; the verdict may ask for more, such as no fall."""
    limit: float | None = None
    """The bar as a number, in the unit of `number`; None without one."""
    at_least: bool = False
    """Whether `number` must reach `limit`; otherwise it must not pass it."""

    @property
    def ratio(self) -> float | None:
        """Number over limit, or limit over number where more is better: up to 1 the bar is met. None without both."""
        if self.number is None or self.limit is None:
            return None
        above, below = (self.limit, self.number) if self.at_least else (self.number, self.limit)
        return above / below if below else float("inf") if above else 0.0

    @property
    def verdict(self) -> str:
        """`pass`, `MISS` or nothing."""
        return "" if self.met is None else "pass" if self.met else "MISS"


def _falls(result: Result, rows: np.ndarray) -> tuple[int, int, str]:
    fell, count = int(result.of("fell", rows).sum()), int(rows.sum())
    low, high = wilson(fell, count)
    return fell, count, f"{fell}/{count} = {100 * fell / max(count, 1):.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def figures(result: Result, others: Sequence[Result] = ()) -> list[Figure]:
    """Every figure that the suite's cells allow.

    Args:
        result: The tracker to judge.
        others: All results of the same plan, for comparisons.
    """
    rows = [
        _fall_rate(result),
        _against_official(result, others),
        *_walks(result),
        _goals(result),
        _squat(result),
        _sit(result),
        _sill(result),
        _ball(result, "ball, walk through 0.6", share=None),
        _ball(result, "ball, standing kick", share=0.8),
        _chest(result),
        _push(result),
        *_inference(result),
    ]
    return [row for row in rows if row is not None]


def _fall_rate(result: Result) -> Figure:
    fell, count, text = _falls(result, np.ones(len(result.plan.cell), dtype=bool))
    if not result.whole:
        return Figure("fall rate, these cells only", text, "", None, fell / max(count, 1))
    limit = {"twist2": 0.01, "sonic": 0.03}.get(result.interface)
    bar = "" if limit is None else f"≤ {100 * limit:g} %"
    met = None if limit is None else fell <= limit * count
    return Figure("fall rate, whole suite", text, bar, met, fell / max(count, 1), limit)


def _against_official(result: Result, others: Sequence[Result]) -> Figure | None:
    rates = {
        o.label: float(o.outcome.measures["fell"].mean()) for o in others if o.official and o.interface == "twist2"
    }
    if result.official or not rates or not result.whole:
        return None
    own, (name, best) = float(result.outcome.measures["fell"].mean()), min(rates.items(), key=lambda item: item[1])
    bar = f"≤ {100 * best:.1f} % ({name})"
    return Figure("fall rate, against official TWIST2", f"{100 * own:.1f} %", bar, own <= best, own, best)


def _walks(result: Result) -> list[Figure]:
    out = []
    for speed, error, drift in ((0.3, 0.045, 0.20), (0.6, 0.06, 0.30)):
        rows = result.rows(f"walk {speed:g}")
        if not rows.any():
            continue
        asked = float(np.mean(result.of("ref_x", rows)))
        # Nobody was still up when the mean speed began to count: nothing was reached.
        share = float(np.mean(result.of("speed_x", rows))) / asked if asked else 0.0
        name = f"speed reached, walk {speed:g} m/s"
        out.append(Figure(name, f"{100 * share:.0f} %", "≥ 90 %", share >= 0.9, share, 0.9, at_least=True))
        rmse = float(result.of("leg_rmse", rows).mean())
        name = f"leg joint RMSE, walk {speed:g} m/s"
        out.append(Figure(name, f"{rmse:.3f} rad", f"≤ {error:g} rad", rmse <= error, rmse, error))
        mean = float(result.of("drift_10s", rows).mean())
        judged = result.interface == "twist2"
        bar = f"≤ {drift:.2f} m" if judged else ""
        name = f"drift per 10 s, walk {speed:g} m/s, open loop"
        met, limit = (mean <= drift, drift) if judged else (None, None)
        out.append(Figure(name, f"{mean:.2f} m", bar, met, mean, limit))
    return out


def _goals(result: Result) -> Figure | None:
    rows = result.group("goal")
    if not rows.any():
        return None
    place, turn = result.of("goal_distance", rows), result.of("goal_turn", rows)
    fell = result.of("fell", rows)
    reached = (place <= GOAL_PLACE) & (turn <= GOAL_TURN) & ~fell
    text = (
        f"{int(reached.sum())}/{len(reached)} (worst {place.max():.3f} m, {turn.max():.1f}°, falls {int(fell.sum())})"
    )
    bar = "all within 0.08 m and 5°, no fall"
    share = float(reached.mean())
    return Figure("goals reached in closed loop", text, bar, bool(reached.all()), share, 1.0, at_least=True)


def _squat(result: Result) -> Figure | None:
    rows = result.rows("squat 0.45")
    if not rows.any():
        return None
    fell, count, _ = _falls(result, rows)
    lowest = float(result.of("lowest", rows).mean())
    done = bool(fell == 0 and lowest <= 0.50)
    text = f"falls {fell}/{count}, lowest {lowest:.2f} m"
    return Figure("squat to 0.45 m and back", text, "no fall, ≤ 0.50 m", done, lowest, 0.50)


def _sit(result: Result) -> Figure | None:
    rows = result.rows("sit 0.42")
    if not rows.any():
        return None
    fell, count, _ = _falls(result, rows)
    loaded = result.of("seat_time", rows) >= SEAT_TIME
    risen = ~result.of("fell", rows) & (result.of("end_z", rows) >= RISEN)
    text = f"falls {fell}/{count}, seated {int(loaded.sum())}, risen {int(risen.sum())}"
    met = bool(fell == 0 and loaded.all() and risen.all())
    share = float((loaded & risen).mean())
    bar = "no fall, all seated and risen"
    return Figure("sit on 0.42 m (100 N for 2 s) and rise", text, bar, met, share, 1.0, at_least=True)


def _sill(result: Result) -> Figure | None:
    rows = result.rows("sill 0.09")
    if not rows.any():
        return None
    fell, count, _ = _falls(result, rows)
    over = (result.of("end_x", rows) > result.of("support_x", rows) + BEHIND) & ~result.of("fell", rows)
    text = f"falls {fell}/{count}, over {int(over.sum())}, touched {int((result.of('touch', rows) > 5).sum())}"
    met, share = bool(fell == 0 and over.all()), float(over.mean())
    return Figure("step over a 9 cm sill", text, "no fall, all over", met, share, 1.0, at_least=True)


def _ball(result: Result, cell: str, share: float | None) -> Figure | None:
    rows = result.rows(cell)
    if not rows.any():
        return None
    fell, count, _ = _falls(result, rows)
    peak, roll = result.of("ball_peak", rows), result.of("ball_end", rows)
    hit = float((peak >= 1.5).mean())
    text = (
        f"median {np.median(peak):.1f} m/s (rolls {np.median(roll):.1f}), "
        f"{100 * hit:.0f} % ≥ 1.5 m/s, falls {fell}/{count}"
    )
    bar = "median ≥ 1.5 m/s, no fall" if share is None else f"≥ 1.5 m/s in {100 * share:g} %, no fall"
    enough = bool(np.median(peak) >= 1.5) if share is None else hit >= share
    number, limit = (float(np.median(peak)), 1.5) if share is None else (hit, share)
    name = f"ball speed: {cell.removeprefix('ball, ')}"
    return Figure(name, text, bar, enough and fell == 0, number, limit, at_least=True)


def _chest(result: Result) -> Figure | None:
    rows = result.rows("chest 10 N, walk 0.35")
    if not rows.any():
        return None
    fell, count, _ = _falls(result, rows)
    speed = float(result.of("speed_x", rows).mean())
    text = f"{speed:.2f} m/s, falls {fell}/{count}"
    met = speed >= 0.2 and fell == 0
    return Figure("10 N against the chest, walk 0.35 m/s", text, "≥ 0.2 m/s, no fall", met, speed, 0.2, at_least=True)


def _push(result: Result) -> Figure | None:
    rows = result.rows("push 40 N·s, walk 0.3", "push 40 N·s, walk 0.6")
    if not rows.any():
        return None
    fell, count, text = _falls(result, rows)
    met = fell <= 0.15 * count
    return Figure("push of 40 N·s in 0.1 s while walking, falls", text, "≤ 15 %", met, fell / max(count, 1), 0.15)


def _inference(result: Result) -> list[Figure]:
    bars: list[tuple[str, str, float]] = [
        ("cpu", "inference, 1 world on the CPU", 0.3),
        ("cuda", "inference, 4096 worlds on the GPU", 1.0),
    ]
    times: Callable[[str], float | None] = result.inference.get
    out = []
    for key, name, limit in bars:
        value = times(key)
        if value is not None:
            out.append(Figure(name, f"{value:.3f} ms", f"≤ {limit:g} ms", value <= limit, value, limit))
    return out
