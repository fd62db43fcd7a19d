"""The suite: every primitive at three settings, conditions that make them hard, goals in closed loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from arena_newton.trackers.evaluation import push_suite
from arena_newton.trackers.evaluation.suite import Ball, Cell, Navigation, Placed, Push
from arena_newton.trackers.motions import primitives as p
from arena_newton.trackers.motions.primitives import Script

__all__ = ["GOALS", "QUICK", "goals", "suite"]

GOALS = 20
"""Goals of a suite."""
GOAL_SECONDS = 26.0
"""Time for a goal, the return from an overshoot included [s]."""
GOAL_RANGE = 3.0
"""Goals are within this on either axis [m]."""
RIGHT_FOOT = -0.11
"""Offset to the left of the robot's middle [m]: in front of the right foot."""
SEAT_DEPTH, SEAT_GAP = 0.5, 0.05
"""Depth of the seat, and its front edge behind the standing pelvis [m] (measured: at 18 cm the robot misses it)."""
QUICK = ("stand", "walk 0.3", "walk 0.6", "turn 0.5", "squat 0.45", "kick 2.5", "sit 0.42", "push 40 N·s, walk 0.3")
"""Cells of the quick suite, besides a few goals."""
CARRY_WALK = 1.5
"""Time at which a carrying robot starts to walk [s]."""
LEFT_HIGH, FRONT, LOW = (0.35, 0.20, 0.45), (0.42, 0.12, 0.20), (0.38, 0.15, -0.05)
"""Points for the left hand [m], pelvis' heading frame."""


def _right(point: tuple[float, float, float]) -> tuple[float, float, float]:
    return point[0], -point[1], point[2]


def _go(seconds: float, forward: float, left: float = 0.0, turn: float = 0.0) -> Script:
    return p.walk(forward, left, turn, seconds, pause=0.0)


def _cell(name: str, group: str, script: Script, **more: Any) -> Cell:
    """A cell as long as its script."""
    return Cell(name, group, script.seconds, script, **more)


def _standing() -> list[Cell]:
    raised = p.mirrored_arms((-1.6, 0.4, 0.0, 0.6, 0.0, 0.0, 0.0))
    aside = p.mirrored_arms((0.0, 1.4, 0.0, 1.2, 0.0, 0.0, 0.0))
    cells = [
        _cell("stand", "stand", p.stand(10.0)),
        _cell("stand, arms raised", "stand", p.stand(0.5) + p.stand(9.5, arms=raised)),
        _cell("stand, arms aside", "stand", p.stand(0.5) + p.stand(9.5, arms=aside)),
    ]
    for name, shift in (("left", (0.0, 0.05)), ("right", (0.0, -0.05)), ("forward", (0.04, 0.0))):
        cells.append(_cell(f"shift {name}", "shift", p.stand(0.5) + p.shift(*shift, hold=2.0) + p.stand(1.0)))
    for pace in (0.36, 0.45, 0.55):
        cells.append(_cell(f"step in place {pace:g} s", "step", p.step(8.0, pause=0.0).over(step_time=pace)))
    return cells


def _walking() -> list[Cell]:
    velocities = {
        "walk 0.3": (0.3, 0.0, 0.0),
        "walk 0.6": (0.6, 0.0, 0.0),
        "walk 0.8": (0.8, 0.0, 0.0),
        "walk -0.3": (-0.3, 0.0, 0.0),
        "side 0.2": (0.0, 0.2, 0.0),
        "side -0.2": (0.0, -0.2, 0.0),
        "turn 0.5": (0.0, 0.0, 0.5),
        "turn -0.8": (0.0, 0.0, -0.8),
        "arc 0.4, 0.4": (0.4, 0.0, 0.4),
    }
    cells = [_cell(name, name.split()[0], _go(10.0, *velocity)) for name, velocity in velocities.items()]
    stops = p.walk(0.5, seconds=2.5, pause=2.5) + p.walk(0.5, seconds=2.5, pause=2.5)
    return [*cells, _cell("walk 0.5, stop and go", "walk", stops, window=0.0)]


def _posture() -> list[Cell]:
    still = p.stand(0.5)
    cells = [_cell(f"squat {z:.2f}", "squat", still + p.squat(z) + still) for z in (0.60, 0.45, 0.40)]
    cells += [
        _cell("reach left, high", "reach", still + p.reach("left", LEFT_HIGH) + still),
        _cell("reach right, front", "reach", still + p.reach("right", _right(FRONT)) + still),
        _cell("reach left, low", "reach", still + p.reach("left", LOW) + still),
    ]
    for z, side in ((0.65, "right"), (0.55, "left"), (0.45, "right")):
        point = FRONT if side == "left" else _right(FRONT)
        script = still + p.crouch_reach(side, point, z) + still
        cells.append(_cell(f"crouch {z:.2f} and reach {side}", "crouch_reach", script))
    for name, side, height in (("left", "left", None), ("right", "right", None), ("crouched", "right", 0.62)):
        cells.append(_cell(f"punch {name}", "punch", p.punch(side, height=height, times=3) + still))
    return cells


def _seated() -> list[Cell]:
    scripts = {z: p.stand(0.5) + p.sit(z, hold=3.5) + p.rise(z) + p.stand(1.0) for z in (0.38, 0.42, 0.45)}
    x = -SEAT_GAP - SEAT_DEPTH / 2
    return [_cell(f"sit {z:.2f}", "sit", script, support=Placed("Seat", z, x)) for z, script in scripts.items()]


def _contact() -> list[Cell]:
    kicks = {speed: p.stand(0.5) + p.kick("right", speed, pause=1.0) for speed in (1.5, 2.5, 3.5)}
    cells = [_cell(f"kick {speed:g}", "kick", script) for speed, script in kicks.items()]
    cells.append(_cell("ball, standing kick", "ball", kicks[3.5], ball=Ball((0.26, 0.30), RIGHT_FOOT)))
    through = p.walk(0.6, seconds=4.5, pause=2.5)
    cells.append(_cell("ball, walk through 0.6", "ball", through, ball=Ball((1.0, 1.6), RIGHT_FOOT)))
    over = p.stand(0.3) + p.step_over(seconds=5.0)
    cells += [_cell(f"sill {z:.2f}", "sill", over, support=Placed("Sill", z)) for z in (0.05, 0.07, 0.09)]
    up = {z: p.step_up(z) for z in (0.06, 0.10)}
    cells += [_cell(f"platform {z:.2f}", "platform", up[z], support=Placed("Platform", z)) for z in up]
    down = p.step_up(0.10, pairs=3, down=True)
    cells.append(_cell("platform 0.10, up and down", "platform", down, support=Placed("Platform", 0.10)))
    for payload in (0.0, 1.0, 2.0):
        walk, start = p.carry(0.3, seconds=7.0), CARRY_WALK + 1.0
        name = f"carry {payload:g} kg a hand, walk 0.3"
        cells.append(Cell(name, "carry", 8.5, walk, payload=payload, window=start))
    for payload in (1.0, 2.0):
        squat = p.squat(0.6).over(arms=p.CARRY_ARMS) + p.stand(0.5)
        cells.append(_cell(f"carry {payload:g} kg a hand, squat 0.60", "carry", squat, payload=payload))
    for newtons in (0.0, 5.0, 10.0):
        steady = Push(newtons, (2.5, 2.5), 30.0, backward=True)
        lean = p.push(0.35, 9.0, foot_offset=0.08)
        # Measured after the force has acted for two seconds, and before the walk ends.
        cells.append(Cell(f"chest {newtons:g} N, walk 0.35", "chest", 10.2, lean, push=steady, window=4.5))
    for impulse, speed in ((20, 0.3), (20, 0.6), (40, 0.0), (40, 0.3), (40, 0.6)):
        blow = Push(impulse / 0.1, (3.0, 4.0), 0.1)
        name = f"push {impulse} N·s, " + (f"walk {speed:g}" if speed else "stand")
        cells.append(_cell(name, "push", _go(8.0, speed), push=blow))
    cells += [_cell(f"friction {mu:g}, walk 0.6", "friction", _go(8.0, 0.6), friction=mu) for mu in (0.4, 0.7, 1.2)]
    cells.append(_cell("friction 0.4, turn 0.8", "friction", _go(8.0, 0.0, 0.0, 0.8), friction=0.4))
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
    """`full`, `quick` or `push`."""
    if name == "push":
        return push_suite.cells()
    cells = [*_standing(), *_walking(), *_posture(), *_seated(), *_contact()]
    if name == "quick":
        return [cell for cell in cells if cell.name in QUICK] + goals(4)
    return cells + goals()
