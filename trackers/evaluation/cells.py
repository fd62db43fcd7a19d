"""The suite: every primitive at three settings, conditions that make them hard, goals in closed loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton.trackers.evaluation.suite import Ball, Cell, Navigation, Placed, Push

if TYPE_CHECKING:
    import torch

    from arena_newton.trackers.motions.commands import MotionCommand

__all__ = ["GOALS", "QUICK", "Timeline", "at", "goals", "suite"]

GOALS = 20
"""Goals of a suite."""
GOAL_SECONDS = 30.0
"""Time for a goal, the way back from an overshoot included [s]."""
GOAL_RANGE = 3.0
"""Goals lie within this on either axis [m]."""
RIGHT_FOOT = -0.11
"""To the left of the robot's middle [m]: what lies before the right foot."""
SEAT_DEPTH, SEAT_GAP = 0.5, 0.05
"""Depth of the seat, and its front edge behind the standing pelvis [m] (measured: 5 cm is sat on, 18 cm is missed)."""
QUICK = (
    "stand",
    "walk 0.3",
    "walk 0.6",
    "turn 0.5",
    "squat 0.45",
    "kick 2.5",
    "sit 0.42",
    "push 40 N·s, walk 0.3",
)
"""Cells of the quick suite, beside a few goals."""


@dataclass(frozen=True)
class Timeline:
    """Commands as steps in time: the generator smooths them."""

    events: tuple[tuple[float, tuple[tuple[str, Any], ...]], ...]
    """Time [s] and the channels that change then."""

    def __call__(self, times: torch.Tensor) -> MotionCommand:
        """Commands at times [s], shape [ticks]."""
        import torch

        from arena_newton.trackers.motions.commands import CHANNELS, MotionCommand

        table = MotionCommand.neutral(len(times), times.device).pack()
        for time, changes in self.events:
            late = times >= time - 1e-6
            for channel, value in changes:
                row = torch.as_tensor(value, dtype=table.dtype, device=table.device).reshape(-1)
                table[late, CHANNELS[channel]] = row
        return MotionCommand.unpack(table)


def at(*events: tuple[float, dict[str, Any]]) -> Timeline:
    """A timeline of (time [s], channels that change then)."""
    return Timeline(tuple((time, tuple(changes.items())) for time, changes in events))


def _walk(x: float, y: float = 0.0, turn: float = 0.0, **other: Any) -> Timeline:
    return at((0.0, {"velocity": (x, y, turn), **other}))


def _hands(left: tuple[float, float, float], right: tuple[float, float, float], weight: tuple[float, float]) -> dict:
    return {"hand_point": (*left, *right), "reach": weight}


_REST = ((0.2, 0.15, 0.1), (0.2, -0.15, 0.1))
CARRY = _hands((0.30, 0.14, 0.12), (0.30, -0.14, 0.12), (1.0, 1.0))
"""Both palms before the belly."""


def _standing() -> list[Cell]:
    raised = (-1.6, 0.4, 0.0, 0.6, 0.0, 0.0, 0.0, -1.6, -0.4, 0.0, 0.6, 0.0, 0.0, 0.0)
    aside = (0.0, 1.4, 0.0, 1.2, 0.0, 0.0, 0.0, 0.0, -1.4, 0.0, 1.2, 0.0, 0.0, 0.0)
    cells = [
        Cell("stand", "stand", 10.0, at()),
        Cell("stand, arms raised", "stand", 10.0, at((0.5, {"arms": raised}))),
        Cell("stand, arms aside", "stand", 10.0, at((0.5, {"arms": aside}))),
    ]
    for name, shift in (("left", (0.0, 0.05)), ("right", (0.0, -0.05)), ("forward", (0.04, 0.0))):
        events = ((0.5, {"shift": shift}), (3.5, {"shift": (0.0, 0.0)}))
        cells.append(Cell(f"shift {name}", "shift", 6.0, at(*events)))
    for pace in (0.36, 0.45, 0.55):
        cells.append(Cell(f"step in place {pace:g} s", "step", 8.0, at((0.0, {"step_in_place": 1, "step_time": pace}))))
    return cells


def _walking() -> list[Cell]:
    go = [
        ("walk 0.3", _walk(0.3)),
        ("walk 0.6", _walk(0.6)),
        ("walk 0.8", _walk(0.8)),
        ("walk -0.3", _walk(-0.3)),
        ("side 0.2", _walk(0.0, 0.2)),
        ("side -0.2", _walk(0.0, -0.2)),
        ("turn 0.5", _walk(0.0, 0.0, 0.5)),
        ("turn -0.8", _walk(0.0, 0.0, -0.8)),
        ("arc 0.4, 0.4", _walk(0.4, 0.0, 0.4)),
    ]
    cells = [Cell(name, name.split()[0], 10.0, program) for name, program in go]
    stops = at(*((2.5 * k, {"velocity": (0.5 * (k % 2 == 0), 0.0, 0.0)}) for k in range(4)))
    return [*cells, Cell("walk 0.5, stop and go", "walk", 10.0, stops, window=0.0)]


def _squat(bottom: float) -> Timeline:
    pitch = 1.2 * (0.785 - bottom)
    return at((0.5, {"height": bottom, "pitch": pitch}), (4.0, {"height": 0.785, "pitch": 0.0}))


def _posture() -> list[Cell]:
    cells = [Cell(f"squat {z:.2f}", "squat", 7.0, _squat(z)) for z in (0.60, 0.45, 0.40)]
    low, front, high = (0.38, 0.15, -0.05), (0.42, 0.12, 0.2), (0.35, 0.2, 0.45)

    def right(point: tuple[float, float, float]) -> tuple[float, float, float]:
        return point[0], -point[1], point[2]

    home = {"reach": (0.0, 0.0)}
    for name, changes in (
        ("left, high", _hands(high, _REST[1], (1.0, 0.0))),
        ("right, front", _hands(_REST[0], right(front), (0.0, 1.0))),
        ("both, low", _hands(low, right(low), (1.0, 1.0))),
    ):
        cells.append(Cell(f"reach {name}", "reach", 6.0, at((0.5, changes), (3.5, home))))
    for z, side in ((0.65, "right"), (0.55, "left"), (0.45, "right")):
        weight = (0.0, 1.0) if side == "right" else (1.0, 0.0)
        changes = {"height": z, "pitch": 1.2 * (0.785 - z), **_hands(front, right(front), weight)}
        back = {"height": 0.785, "pitch": 0.0, **home}
        cells.append(Cell(f"crouch {z:.2f} and reach {side}", "crouch_reach", 7.5, at((0.5, changes), (4.5, back))))
    for name, z, weight in (("left", 0.785, (1.0, 0.0)), ("right", 0.785, (0.0, 1.0)), ("crouched", 0.62, (0.0, 1.0))):
        blow = {"arm_speed": 10.0, **_hands((0.45, 0.08, 0.28), (0.45, -0.08, 0.28), weight)}
        lower = {"height": z, "pitch": 1.2 * (0.785 - z)}
        events = [(0.2, lower)] + [(t, blow if k % 2 == 0 else home) for k, t in enumerate((2.0, 2.5, 3.5, 4.0))]
        cells.append(Cell(f"punch {name}", "punch", 6.0, at(*events)))
    return cells


def _seated() -> list[Cell]:
    cells = []
    for z in (0.38, 0.42, 0.45):
        # The measured way down: bend and go back above the seat, then sink into it; the same way up.
        events = (
            (0.5, {"height": z + 0.14, "pitch": 0.35, "pelvis_back": 0.24}),
            (3.2, {"height": z + 0.09, "pitch": 0.20, "pelvis_back": 0.36}),
            (7.5, {"height": z + 0.14, "pitch": 0.45, "pelvis_back": 0.20}),
            (8.7, {"height": 0.60, "pitch": 0.35, "pelvis_back": 0.0}),
            (9.7, {"height": 0.785, "pitch": 0.0}),
        )
        place = Placed("Seat", z, -SEAT_GAP - SEAT_DEPTH / 2)
        cells.append(Cell(f"sit {z:.2f}", "sit", 12.5, at(*events), support=place))
    return cells


def _contact() -> list[Cell]:
    cells = []
    for speed in (1.5, 2.5, 3.5):
        events = ((0.5, {"kick": 2, "kick_speed": speed}), (1.5, {"kick": 0, "kick_speed": speed}))
        cells.append(Cell(f"kick {speed:g}", "kick", 6.0, at(*events)))
    events = ((0.5, {"kick": 2, "kick_speed": 3.5}), (1.5, {"kick": 0, "kick_speed": 3.5}))
    lies = Ball((0.30, 0.34), RIGHT_FOOT)
    cells.append(Cell("ball, standing kick", "ball", 6.0, at(*events), ball=lies))
    way = Ball((1.0, 1.6), RIGHT_FOOT)
    stops = at((0.0, {"velocity": (0.6, 0.0, 0.0)}), (4.5, {"velocity": (0.0, 0.0, 0.0)}))
    cells.append(Cell("ball, walk through 0.6", "ball", 7.0, stops, ball=way))
    for z in (0.05, 0.07, 0.09):
        step = _walk(0.53, swing_height=0.22, step_time=0.56)
        cells.append(Cell(f"sill {z:.2f}", "sill", 8.0, step, support=Placed("Sill", z)))
    for payload in (0.0, 1.0, 2.0):
        walk = at((0.0, CARRY), (1.0, {"velocity": (0.3, 0.0, 0.0)}))
        cells.append(Cell(f"carry {payload:g} kg a hand, walk 0.3", "carry", 8.0, walk, payload=payload, window=3.0))
    for payload in (1.0, 2.0):
        squat = at((0.0, CARRY), (1.0, {"height": 0.6, "pitch": 0.2}), (4.5, {"height": 0.785, "pitch": 0.0}))
        cells.append(Cell(f"carry {payload:g} kg a hand, squat 0.60", "carry", 7.5, squat, payload=payload))
    for newtons in (0.0, 5.0, 10.0):
        steady = Push(newtons, (2.0, 2.0), 20.0, backward=True)
        lean = _walk(0.35, foot_offset=0.08)
        cells.append(Cell(f"chest {newtons:g} N, walk 0.35", "chest", 10.0, lean, push=steady, window=4.0))
    for impulse, speed in ((20, 0.3), (20, 0.6), (40, 0.0), (40, 0.3), (40, 0.6)):
        blow = Push(impulse / 0.1, (3.0, 4.0), 0.1)
        name = f"push {impulse} N·s, " + (f"walk {speed:g}" if speed else "stand")
        cells.append(Cell(name, "push", 8.0, _walk(speed), push=blow))
    for mu in (0.4, 0.7, 1.2):
        cells.append(Cell(f"friction {mu:g}, walk 0.6", "friction", 8.0, _walk(0.6), friction=mu))
    cells.append(Cell("friction 0.4, turn 0.8", "friction", 8.0, _walk(0.0, 0.0, 0.8), friction=0.4))
    return cells


def goals(count: int = GOALS, seed: int = 0) -> list[Cell]:
    """Goals within ±3 m with any heading, drawn from the seed; one rollout each."""
    rng = np.random.default_rng(seed)
    drawn = [(*rng.uniform(-GOAL_RANGE, GOAL_RANGE, 2), rng.uniform(-np.pi, np.pi)) for _ in range(count)]
    return [
        Cell(f"goal {k + 1}", "goal", GOAL_SECONDS, goal=Navigation(*map(float, pose)), window=0.0, rollouts=1)
        for k, pose in enumerate(drawn)
    ]


def suite(name: str) -> list[Cell]:
    """`full` or `quick`."""
    cells = [*_standing(), *_walking(), *_posture(), *_seated(), *_contact()]
    if name == "quick":
        return [cell for cell in cells if cell.name in QUICK] + goals(4)
    return cells + goals()
