"""Mistakes planted between a tracker and the world, one at a time: does `doctor --stand` find each?"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.canonical import MIMIC
from arena_newton.robot.g1 import MUJOCO_TO_CANONICAL
from arena_newton.robot.rotations import quat_conjugate
from arena_newton.trackers.evaluation.stand_check import stand

if TYPE_CHECKING:
    from benchmarks.bench_options import MistakesOptions

__all__ = ["mistake_figures"]

CANONICAL = list(MUJOCO_TO_CANONICAL)
LEGS = [*range(6, 12), *range(6), *range(12, 29)]
"""Joints with left and right leg swapped."""
ARMS = [*range(15), *range(22, 29), *range(15, 22)]
"""Joints with left and right arm swapped."""
Seen = tuple[TrackerCommand, RobotState]


def _mimic(command: TrackerCommand, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> TrackerCommand:
    mimic = command.mimic.clone()
    mimic[:, MIMIC[name]] = change(mimic[:, MIMIC[name]])
    return replace(command, mimic=mimic)


def _joints(command: TrackerCommand, change: Callable[[torch.Tensor], torch.Tensor]) -> TrackerCommand:
    changed = replace(command, joints=change(command.joints), joint_vel=change(command.joint_vel))
    return _mimic(changed, "joint_pos", change)


SHOWN: dict[str, Callable[[TrackerCommand, RobotState], Seen]] = {
    "orientation conjugated": lambda c, s: (c, replace(s, quat=quat_conjugate(s.quat))),
    "orientation as xyzw": lambda c, s: (c, replace(s, quat=s.quat[:, [1, 2, 3, 0]])),
    "angular velocity of the other sign": lambda c, s: (c, replace(s, ang_vel_body=-s.ang_vel_body)),
    "angular velocity: x, y of the other sign": lambda c, s: (
        c,
        replace(s, ang_vel_body=s.ang_vel_body * torch.tensor([-1.0, -1.0, 1.0])),
    ),
    "joints in canonical order": lambda c, s: (c, replace(s, joint_pos=s.joint_pos[:, CANONICAL])),
    "joints with legs swapped": lambda c, s: (c, replace(s, joint_pos=s.joint_pos[:, LEGS])),
    "joints with arms swapped": lambda c, s: (c, replace(s, joint_pos=s.joint_pos[:, ARMS])),
    "joint velocities of the other sign": lambda c, s: (c, replace(s, joint_vel=-s.joint_vel)),
    "joint velocities in canonical order": lambda c, s: (c, replace(s, joint_vel=s.joint_vel[:, CANONICAL])),
    "command: orientation conjugated": lambda c, s: (replace(c, quat=quat_conjugate(c.quat)), s),
    "command: joints in canonical order": lambda c, s: (_joints(c, lambda v: v[:, CANONICAL]), s),
    "command: legs swapped": lambda c, s: (_joints(c, lambda v: v[:, LEGS]), s),
    "command: arms swapped": lambda c, s: (_joints(c, lambda v: v[:, ARMS]), s),
    "command: joints halved": lambda c, s: (_joints(c, lambda v: 0.5 * v), s),
    "command: 0.1 m lower": lambda c, s: (_mimic(c, "root_z", lambda v: v - 0.1), s),
    "command: velocity of the other sign": lambda c, s: (_mimic(c, "velocity_xy", torch.neg), s),
    "command: x and y of the velocity swapped": lambda c, s: (_mimic(c, "velocity_xy", lambda v: v.flip(1)), s),
    "command: yaw rate of the other sign": lambda c, s: (_mimic(c, "yaw_rate", torch.neg), s),
    "command: roll and pitch of the other sign": lambda c, s: (_mimic(c, "roll_pitch", torch.neg), s),
}
"""Mistake → command and state that the front end is shown instead."""
SCALES = {"action scale × 0.5": 0.5, "action scale × 2": 2.0, "action scale × -1": -1.0}
POSE = "default pose of the other sign"


def mistake_figures(options: MistakesOptions) -> Iterator[BenchFigure]:
    """Measures of the tracker as it is, then with each mistake; a mistake that changes none is not read by it."""
    right, usual = _measured(options, None)
    yield BenchFigure("no mistake, accused", 0.0, "", True, float(not right), usual)
    read, found = 0, 0
    for name in (*SHOWN, *SCALES, POSE):
        ok, said = _measured(options, name)
        yield BenchFigure(name, None, "found", False, float(not ok), "not read" if said == usual else said)
        read, found = read + (said != usual), found + (said != usual and not ok)
    yield BenchFigure("mistakes found", None, f"of {read} read", False, float(found))


def _measured(options: MistakesOptions, mistake: str | None) -> tuple[bool, str]:
    """True if all measures hold, and the measures."""
    tracker: Any = trackers.get(options.tracker, Path(options.checkpoint) if options.checkpoint else None)
    front = getattr(tracker, "front_end", None)
    if front is None:
        raise InputError(f"--tracker {options.tracker}: has no front end in which mistakes could be planted")
    if mistake in SHOWN:
        write, change = front.write, SHOWN[mistake]
        front.write = lambda command, state: write(*change(command, state))
    elif mistake in SCALES:
        form = front.action_form
        front.action_form = replace(form, scale=tuple(SCALES[mistake] * one for one in form.scale))
    elif mistake == POSE:
        front.default_pose = tuple(-angle for angle in front.default_pose)
    results = stand(tracker, engine="mujoco", device="cpu")
    said = "; ".join(f"{one.name} {one.message.partition(', expected')[0]}" for one in results)
    return all(one.ok for one in results), said
