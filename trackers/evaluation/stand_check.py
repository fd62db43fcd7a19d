"""Two seconds of standing and of turning in the lab, which show whether a tracker holds the robot.

Shapes and masks say nothing of signs, frames, order and scale. A wrong default pose, action scale or gain shows in
height and joints; the wrong sign or frame of a turn in a robot that turns away from its reference.
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
"""Standing or turning after the start-up [s]."""
TURN = 0.5
"""Rate of the turns to the left and to the right [rad/s]."""
ROLLOUTS = 4
"""Rollouts of each of the three; their starts differ by the suite's noise."""
HEIGHT = 0.6
"""Least height of the pelvis [m]."""
JOINT_ERROR = 0.15
"""Largest mean error of the joints [rad] (the bar of HumanoidArena's body qualification)."""
WORST = 0.4
"""Largest mean error of one joint [rad]: no tracker of this package has half of it but at a wrist (measured)."""
FOLLOWED = 0.25
"""Least part of a turn that is followed, the way it is commanded."""


@torch.inference_mode()
def stand(tracker: Tracker, *, engine: str = "auto", device: str | None = None) -> list[CheckResult]:
    """Findings of a tracker that is not bound yet: `pelvis` and `joints` while it stands, `turn` while it turns.

    Raises:
        InputError: Engine or device is not available, or targets of another kind than the interface says.
    """
    rates = {"stand": 0.0, "turn left": TURN, "turn right": -TURN}
    scripts = {name: primitives.walk(0.0, turn=rate, seconds=SECONDS, pause=0.0) for name, rate in rates.items()}
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
    turned, commanded = (measures[name] for name in ("speed_yaw", "ref_yaw"))
    fell, declared = bool(measures["fell"][cell > 0].any()), "root orientation" in getattr(tracker, "ignores", ())
    followed = 0.0 if fell else np.subtract(*_sides(turned, cell)) / np.subtract(*_sides(commanded, cell))
    turn = "the robot falls" if fell else f"{100 * followed:.0f} % of a turn is followed"
    turn += f", expected {100 * FOLLOWED:.0f} % or more"
    if declared:
        turn = "the tracker declares that it follows no orientation of the root"
    elif followed < FOLLOWED:
        turn += ": sign or frame of orientation, angular velocity or anchor?"
    fault = "" if height >= HEIGHT else ": gains, action scale, joint order, or sign of a measurement?"
    near = (
        f"{mean:.3f} rad from the reference on average, expected {JOINT_ERROR:g} or less; most {joint}, {worst:.2f} rad"
    )
    return [
        CheckResult("pelvis", height >= HEIGHT, f"{height:.2f} m at its lowest, expected {HEIGHT:g} m or more{fault}"),
        CheckResult("joints", mean <= JOINT_ERROR and worst <= WORST, f"{near}, expected {WORST:g} or less"),
        CheckResult("turn", declared or followed >= FOLLOWED, turn),
    ]


def _sides(speed: np.ndarray, cell: np.ndarray) -> tuple[float, float]:
    """Mean speed of the turns to the left and to the right."""
    return float(speed[cell == 1].mean()), float(speed[cell == 2].mean())
