"""Figures with a bar: what a tracker has to reach, each one row with its verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from arena_newton.cli.intervals import wilson
from arena_newton.trackers import interface
from arena_newton.trackers.evaluation import push_suite
from arena_newton.trackers.evaluation.cells import suite
from arena_newton.trackers.evaluation.suite_rollout import Outcome, Plan

__all__ = ["BARS", "FigureBar", "Figure", "Result", "figures"]

BASELINE = "twist2"
"""Interface whose official checkpoints set the bar of the fall rate for everyone."""
GOAL_DISTANCE, GOAL_TURN = 0.08, 5.0
"""A goal counts as reached within this [m], [deg]."""
BALL_SPEED = 1.5
"""A ball counts as hit from this speed on [m/s]."""
TOUCH = 5.0
"""Force above which a sill counts as touched [N]."""
SEAT_TIME = 2.0
"""Time at 100 N and more that counts as sitting [s]."""
BEHIND = 0.2
"""A pelvis this far past the middle of a sill is over it [m]."""
RISEN = 0.65
"""A pelvis above this stands again [m]."""


@dataclass
class Result:
    """One tracker on one plan."""

    label: str
    """Name in tables."""
    interface: str
    """Name of the tracker's class: which bars apply follows from it."""
    official: bool
    """Weights of others, to compare with."""
    tracker: dict[str, Any]
    """`Tracker.describe`."""
    plan: Plan
    outcome: Outcome
    inference: dict[str, float] = field(default_factory=dict)
    """`cpu` of one world and, where there is a GPU, `cuda` of 4096 [ms]."""

    def rows(self, *names: str) -> np.ndarray:
        """Worlds of the cells or groups with these names, bool [worlds]; all without a name."""
        wanted = [i for i, cell in enumerate(self.plan.cells) if not names or {cell.name, cell.group} & set(names)]
        return np.isin(self.plan.cell, wanted)

    @property
    def whole(self) -> bool:
        """True if the plan holds every cell of the full suite: the bar of the fall rate is one for all of it."""
        return {cell.name for cell in suite("full")} <= {cell.name for cell in self.plan.cells}

    @property
    def fall_rate(self) -> float:
        """Fraction of all rollouts that fell."""
        return float(self.outcome.measures["fell"].mean())


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
    """True if `number` must reach `limit`; otherwise it must not pass it."""

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


class Sample:
    """The rollouts of a figure's cells."""

    def __init__(self, result: Result, rows: np.ndarray):
        """Take some worlds of a result, bool [worlds]."""
        self.measures = {name: values[rows] for name, values in result.outcome.measures.items()}
        self.fell: np.ndarray = self.measures["fell"].astype(bool)

    def mean(self, measure: str) -> float:
        """Mean over the rollouts."""
        return float(self.measures[measure].mean())

    def common(self) -> dict[str, Any]:
        """Values that every text may use: falls, rollouts, and the fall rate with its 95 % interval [%]."""
        fell, count = int(self.fell.sum()), len(self.fell)
        low, high = wilson(fell, count)
        rate = f"{fell}/{count} = {100 * fell / max(count, 1):.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
        return {"fell": fell, "count": count, "falls": rate}


Numbers = dict[str, Any]


@dataclass(frozen=True)
class FigureBar:
    """Figure of the suite, and its bar."""

    name: str
    """The figure's row."""
    cells: tuple[str, ...]
    """Cells or groups whose rollouts count; all without one."""
    reduce: Callable[[Sample], Numbers]
    """Numbers for the text; the first one is judged."""
    value: str
    """Text of the value, made of these numbers and of `Sample.common`."""
    bar: str
    """Text of the bar, made of `limit`, or of `percent`, a hundred times that."""
    limit: float | None = None
    """Bar of the judged number."""
    at_least: bool = False
    """True if the number must reach the limit; otherwise it must not pass it."""
    no_fall: bool = False
    """True if no fall is allowed in addition."""
    key: str = ""
    """Key of `Interface.bars` where each interface has a limit of its own, or none."""
    whole: bool | None = None
    """Shown only if every cell of the full suite was played (True), or only if not (False)."""

    def figure(self, result: Result) -> Figure | None:
        """The row of a tracker; None where its cells were not played."""
        rows = result.rows(*self.cells)
        if not rows.any() or (self.whole is not None and self.whole != result.whole):
            return None
        sample = Sample(result, rows)
        numbers = self.reduce(sample)
        number, limit = next(iter(numbers.values())), self.limit
        if self.key:
            known = result.interface in interface.names()
            limit = interface.get(result.interface).bars.get(self.key) if known else None
        met, bar = None, ""
        if limit is not None:
            met = (number >= limit if self.at_least else number <= limit) and not (self.no_fall and sample.fell.any())
            bar = self.bar.format(limit=limit, percent=100 * limit)
        value = self.value.format(**sample.common(), **numbers)
        return Figure(self.name, value, bar, met, number, limit, self.at_least)


def _fall_rate(sample: Sample) -> Numbers:
    return {"fall_rate": int(sample.fell.sum()) / max(len(sample.fell), 1)}


def _speed(sample: Sample) -> Numbers:
    asked = sample.mean("ref_x")
    # Where nobody was still up when the mean speed began to count, nothing was reached.
    fraction = sample.mean("speed_x") / asked if asked else 0.0
    return {"fraction": fraction, "percent": 100 * fraction}


def _goals(sample: Sample) -> Numbers:
    distance, turn = sample.measures["goal_distance"], sample.measures["goal_turn"]
    reached = (distance <= GOAL_DISTANCE) & (turn <= GOAL_TURN) & ~sample.fell
    return {
        "fraction": float(reached.mean()),
        "reached": int(reached.sum()),
        "distance": distance.max(),
        "turn": turn.max(),
    }


def _sit(sample: Sample) -> Numbers:
    loaded = sample.measures["seat_time"] >= SEAT_TIME
    risen = ~sample.fell & (sample.measures["end_z"] >= RISEN)
    return {"fraction": float((loaded & risen).mean()), "seated": int(loaded.sum()), "risen": int(risen.sum())}


def _sill(sample: Sample) -> Numbers:
    over = (sample.measures["end_x"] > sample.measures["support_x"] + BEHIND) & ~sample.fell
    touched = int((sample.measures["touch"] > TOUCH).sum())
    return {"fraction": float(over.mean()), "over": int(over.sum()), "touched": touched}


def _ball(sample: Sample) -> Numbers:
    peak, roll = sample.measures["ball_peak"], sample.measures["ball_end"]
    hit = float((peak >= BALL_SPEED).mean())
    return {"median": float(np.median(peak)), "rolls": float(np.median(roll)), "hit": hit, "percent": 100 * hit}


def _standing_ball(sample: Sample) -> Numbers:
    return {"hit": 0.0} | _ball(sample)  # the hits are judged: they come first


def _blows(sample: Sample) -> Numbers:
    up, blows, survived = (
        int((~sample.fell).sum()),
        sample.measures["blows"].sum(),
        sample.measures["blows_survived"].sum(),
    )
    recovery = sample.measures["recovery"][np.isfinite(sample.measures["recovery"])]
    low, high = wilson(up, len(sample.fell))
    return {
        "fraction": up / len(sample.fell),
        "up": up,
        "percent": 100 * up / len(sample.fell),
        "low": 100 * low,
        "high": 100 * high,
        "seconds": sample.mean("survival"),
        "blows": 100 * survived / max(blows, 1.0),
        "recovery": f"{recovery.mean():.2f} s" if len(recovery) else "–",
    }


_TOUR = "{up}/{count} = {percent:.0f} % [{low:.0f}, {high:.0f}], {seconds:.1f} s; blows {blows:.1f} %, {recovery}"
_BALL = "median {median:.1f} m/s (rolls {rolls:.1f}), {percent:.0f} % ≥ 1.5 m/s, falls {fell}/{count}"


def _mean(measure: str) -> Callable[[Sample], Numbers]:
    return lambda sample: {"mean": sample.mean(measure)}


# fmt: off
def _walk(speed: str, leg_rmse: float) -> tuple[FigureBar, ...]:
    cells, name = (f"walk {speed}",), f"walk {speed} m/s"
    return (
        FigureBar(f"speed reached, {name}", cells, _speed, "{percent:.0f} %", "≥ {percent:.0f} %", 0.9, at_least=True),
        FigureBar(f"leg joint RMSE, {name}", cells, _mean("leg_rmse"), "{mean:.3f} rad", "≤ {limit:g} rad", leg_rmse),
        FigureBar(f"drift per 10 s, {name}, open loop", cells, _mean("drift_10s"), "{mean:.2f} m", "≤ {limit:.2f} m",
            key=f"drift, walk {speed}"),
    )


BARS: tuple[FigureBar, ...] = (
    FigureBar("fall rate, whole suite", (), _fall_rate, "{falls}", "≤ {percent:g} %", key="fall_rate", whole=True),
    FigureBar("fall rate, these cells only", (), _fall_rate, "{falls}", "", whole=False),
    *_walk("0.3", 0.045),
    *_walk("0.6", 0.06),
    FigureBar("goals reached in closed loop", ("goal",), _goals,
        "{reached}/{count} (worst {distance:.3f} m, {turn:.1f}°, falls {fell})",
        "all within 0.08 m and 5°, no fall", 1.0, at_least=True, no_fall=True),
    FigureBar("squat to 0.45 m and back", ("squat 0.45",), _mean("lowest"),
        "falls {fell}/{count}, lowest {mean:.2f} m", "no fall, ≤ {limit:.2f} m", 0.50, no_fall=True),
    FigureBar("sit on 0.42 m (100 N for 2 s) and rise", ("sit 0.42",), _sit,
        "falls {fell}/{count}, seated {seated}, risen {risen}",
        "no fall, all seated and risen", 1.0, at_least=True, no_fall=True),
    FigureBar("step over a 9 cm sill", ("sill 0.09",), _sill, "falls {fell}/{count}, over {over}, touched {touched}",
        "no fall, all over", 1.0, at_least=True, no_fall=True),
    FigureBar("ball speed: walk through 0.6", ("ball, walk through 0.6",), _ball, _BALL,
        "median ≥ {limit:g} m/s, no fall", BALL_SPEED, at_least=True, no_fall=True),
    FigureBar("ball speed: standing kick", ("ball, standing kick",), _standing_ball, _BALL,
        "≥ 1.5 m/s in {percent:g} %, no fall", 0.8, at_least=True, no_fall=True),
    FigureBar("10 N against the chest, walk 0.35 m/s", ("chest 10 N, walk 0.35",), _mean("speed_x"),
        "{mean:.2f} m/s, falls {fell}/{count}", "≥ {limit:g} m/s, no fall", 0.2, at_least=True, no_fall=True),
    FigureBar("push of 40 N·s in 0.1 s while walking, falls", ("push 40 N·s, walk 0.3", "push 40 N·s, walk 0.6"),
        _fall_rate, "{falls}", "≤ {percent:g} %", 0.15),
    *(FigureBar(f"60 s on both feet: {cell.name}", (cell.name,), _blows, _TOUR, "") for cell in push_suite.cells()),
)
# fmt: on
"""Figures in the order of the table."""


def figures(result: Result, others: Sequence[Result] = ()) -> list[Figure]:
    """Every figure that the suite's cells allow; `others` are all results of the plan, for comparisons."""
    rows = [bar.figure(result) for bar in BARS]
    rows.insert(1, _against_official(result, others))
    return [row for row in rows if row is not None] + _inference(result)


def _against_official(result: Result, others: Sequence[Result]) -> Figure | None:
    rates = {other.label: other.fall_rate for other in others if other.official and other.interface == BASELINE}
    if result.official or not rates or not result.whole:
        return None
    own, (name, best) = result.fall_rate, min(rates.items(), key=lambda item: item[1])
    bar = f"≤ {100 * best:.1f} % ({name})"
    return Figure("fall rate, against official TWIST2", f"{100 * own:.1f} %", bar, own <= best, own, best)


def _inference(result: Result) -> list[Figure]:
    bars = (("cpu", "inference, 1 world on the CPU", 0.3), ("cuda", "inference, 4096 worlds on the GPU", 1.0))
    return [
        Figure(name, f"{time:.3f} ms", f"≤ {limit:g} ms", time <= limit, time, limit)
        for key, name, limit in bars
        if (time := result.inference.get(key)) is not None
    ]
