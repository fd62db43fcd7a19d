"""Two seconds of standing, turning and walking in the lab, which show whether a tracker holds the robot.

Shapes and masks say nothing of signs, frames, order and scale. A wrong default pose, action scale or gain shows in
height and joints; the wrong sign or frame of a turn in a robot that turns away from its reference; the wrong sign of a
commanded velocity, and joints in another order or scale, in one that does not walk with it.
"""

from __future__ import annotations

import numpy as np
import torch

from arena_newton.interfaces import Tracker
from arena_newton.robot.g1 import MUJOCO_JOINTS
from arena_newton.testing.findings import CheckResult
from arena_newton.trackers.evaluation.suite import Cell
from arena_newton.trackers.evaluation.suite_rollout import SuiteRollout, make_plan
from arena_newton.trackers.motions import primitives

__all__ = ["stand"]

SECONDS = 2.0
"""Standing, turning or walking after the start-up [s]."""
TURN = 0.5
"""Rate of the turns to the left and to the right [rad/s]."""
WALK = 0.3
"""Speed of the walks forward and backward [m/s]."""
ROLLOUTS = 4
"""Rollouts of each of the five; their starts differ by the suite's noise."""
HEIGHT = 0.6
"""Least height of the pelvis [m]."""
JOINT_ERROR = 0.15
"""Largest mean error of the joints [rad] (the bar of HumanoidArena's body qualification)."""
WORST = 0.4
"""Largest mean error of one joint [rad]: no tracker of this package has half of it but at a wrist (measured)."""
FOLLOWED = {"turn": 0.5, "walk": 0.75}
"""Least part of a motion that is followed, the way it is commanded. `twist2`, `sonic` and official TWIST2 20k and 25k
walk 0.84 to 0.94; with a halved command, half the action scale or swapped legs at most 0.74 (measured)."""
LEGLESS = 0.45
"""The same of a walk for a tracker that declares that it ignores the leg joints: FALCON walks 0.60 (measured)."""


@torch.inference_mode()
def stand(tracker: Tracker, *, engine: str = "auto", device: str | None = None) -> list[CheckResult]:
    """Findings of a tracker that is not bound yet: `pelvis` and `joints` of standing, `turn` and `walk`.

    Raises:
        InputError: Engine or device is not available, or targets of another kind than the interface says.
    """
    speeds = {"stand": (0.0, 0.0), "turn left": (0.0, TURN), "turn right": (0.0, -TURN)}
    speeds |= {"walk forward": (WALK, 0.0), "walk backward": (-WALK, 0.0)}
    scripts = {n: primitives.walk(ahead, turn=rate, seconds=SECONDS, pause=0.0) for n, (ahead, rate) in speeds.items()}
    cells = [Cell(name, "stand", SECONDS, script, window=0.0) for name, script in scripts.items()]
    rollout = SuiteRollout(tracker, make_plan(cells, ROLLOUTS, 0), engine=engine, device=device)
    lab, cell = rollout.lab, rollout.plan.cell
    still = torch.as_tensor(np.flatnonzero(cell == 0), device=lab.device)
    error, lowest = torch.zeros(len(MUJOCO_JOINTS), device=lab.device), lab.qpos.new_full((), torch.inf)
    rollout.prepare()
    for tick in range(-rollout.startup_ticks, rollout.ticks):
        rollout.tick(tick)
        if tick >= 0:
            standing = lab.qpos[still]
            lowest = torch.minimum(lowest, standing[:, lab.root_q + 2].min())
            error += (standing[:, lab.joint_q] - rollout.loop.command.joints[still]).abs().mean(0) / rollout.ticks
    measures = rollout.outcome().measures
    height, mean, worst = float(lowest), float(error.mean()), float(error.max())
    joint = MUJOCO_JOINTS[int(error.argmax())]
    turn = _followed("turn", measures, cell, 1, "yaw", "orientation, angular velocity or anchor", FOLLOWED["turn"])
    ignored = getattr(tracker, "ignores", ())
    least = LEGLESS if "leg joints" in ignored else FOLLOWED["walk"]
    if "root orientation" in ignored:
        turn = CheckResult("turn", True, "the tracker declares that it follows no orientation of the root")
    fault = "" if height >= HEIGHT else ": gains, action scale, joint order, or sign of a measurement?"
    near = (
        f"{mean:.3f} rad from the reference on average, expected {JOINT_ERROR:g} or less; most {joint}, {worst:.2f} rad"
    )
    return [
        CheckResult("pelvis", height >= HEIGHT, f"{height:.2f} m at its lowest, expected {HEIGHT:g} m or more{fault}"),
        CheckResult("joints", mean <= JOINT_ERROR and worst <= WORST, f"{near}, expected {WORST:g} or less"),
        turn,
        _followed("walk", measures, cell, 3, "x", "velocity, or order or scale of joints or actions", least),
    ]


def _followed(
    name: str, measures: dict[str, np.ndarray], cell: np.ndarray, first: int, axis: str, suspects: str, least: float
) -> CheckResult:
    """Part of a motion one way and the other, in two cells, that is followed."""
    sides = [cell == first, cell == first + 1]
    fell = bool(measures["fell"][sides[0] | sides[1]].any())
    done, asked = (np.subtract(*(measures[f"{of}_{axis}"][side].mean() for side in sides)) for of in ("speed", "ref"))
    followed = 0.0 if fell else float(done / asked)
    said = "the robot falls" if fell else f"{100 * followed:.0f} % of a {name} is followed"
    fault = "" if followed >= least else f": sign or frame of {suspects}?"
    return CheckResult(name, not fault, f"{said}, expected {100 * least:.0f} % or more{fault}")
