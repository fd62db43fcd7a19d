"""Robots that lack their legs: what the tasks are played with to show that legs are needed.

A body changes the robot and nothing else: scene, judge, rules, draws and the policy with its upper-body commands stay.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
import warp as wp

from arena_newton.env import ArenaEnv
from arena_newton.eval.play.factories import Factories
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, DEFAULT_POSE, LEGS, SPAWN_HEIGHT, TICK, DriveGains
from arena_newton.robot.rotations import (
    atan2,
    heading,
    quat_conjugate,
    quat_from_yaw,
    quat_multiply,
    rotate_xy,
    rotation_vector,
    wrap_angle,
)
from arena_newton.trackers.base import Tracker

if TYPE_CHECKING:
    from arena_newton.interfaces import World

__all__ = ["BODIES", "Body", "FrozenLegsEnv", "GlidingBase", "GlidingEnv", "HeldLegs", "WithOtherLegs", "freeze_legs"]

LEG_COLUMNS = tuple(
    ACTION["joint_pos"].start + column for column, joint in enumerate(CANONICAL_TO_MUJOCO) if joint in LEGS
)
"""Columns of the legs' joints in a canonical action."""
GLIDE_HEIGHT = SPAWN_HEIGHT
"""Height at which the gliding base holds the pelvis [m]: the spawn height. A robot that stands has its pelvis 2 cm
lower, so straight down from it the soles hang 2 cm clear of the floor."""
GLIDE_RATE = 10.0
"""Speed at which the gliding base closes a gap to its target: velocity [m/s, rad/s] per gap [m, rad]."""
GLIDE_ACCELERATION = 10.0
"""Largest acceleration of the base [m/s²]: 340 N on the whole robot, as much as its own weight. So hard does it push
against what blocks it."""
TURN_ACCELERATION = 60.0
"""Largest angular acceleration of the base about the vertical [rad/s²]: 46 N·m."""
TIP_ACCELERATION = 300.0
"""The same against tipping [rad/s²]: 1200 N·m, five times what its push on a foot gives. Blocked by a sill it stops,
and does not tip over it."""
LEASH = 0.10
"""The base's target runs ahead of it by so much at most [m], so that it does not wind up where it is blocked."""
TURN_LEASH = 0.3
"""The same for its yaw [rad]."""
STIFF_LEG = (2000.0, 2000.0, 2000.0, 2000.0, 600.0, 600.0)
"""Stiffness of the joints of a held leg, hip to ankle [N·m/rad]: what blocks the base bends the leg by centimetres, so
that a foot does not slip over a sill. Softer at the ankle, whose inertia is small for a step of 5 ms."""
STIFF_DAMPING = 0.05
"""Their damping, as a fraction of the stiffness [s]."""
STIFF_EFFORT = 2000.0
"""Their torque limit [N·m]."""
GRAVITY = 9.81
"""[m/s²]."""


def freeze_legs(env: World, action: torch.Tensor) -> torch.Tensor:
    """A `Disturbance`: the standing legs, and no command that only legs could follow.

    Leg joints, root height and root orientation are those of the standing action, the root's displacement is zero; the
    tracker still balances. Waist, arms and hands are the policy's.

    Args:
        action: The policy's actions, shape [worlds, 40].
    """
    stand = torch.as_tensor(STAND_ACTION, dtype=action.dtype, device=action.device)
    frozen = action.clone()
    for name in ("root_xy_delta", "root_z", "root_rot6d"):
        frozen[:, ACTION[name]] = stand[ACTION[name]]
    return _standing_legs(frozen)


def _standing_legs(action: torch.Tensor) -> torch.Tensor:
    """The action with the legs' joints as they stand, in place."""
    columns = torch.tensor(LEG_COLUMNS, device=action.device)
    action[:, columns] = torch.as_tensor(STAND_ACTION, dtype=action.dtype, device=action.device)[columns]
    return action


class FrozenLegsEnv(ArenaEnv):
    """The task with a robot that stands where it is: see `freeze_legs`."""

    def step(self, action: torch.Tensor | np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """See `ArenaEnv.step`."""
        return super().step(freeze_legs(self, torch.as_tensor(action)), worlds)

    def describe(self) -> dict[str, object]:
        """See `ArenaEnv.describe`."""
        return super().describe() | {"body": "legs frozen in the standing posture"}


def stiffened(drive: DriveGains) -> DriveGains:
    """A drive whose legs are as stiff as a column; waist, arms and fingers keep their gains."""
    legs = STIFF_LEG * 2
    damping = tuple(STIFF_DAMPING * stiffness for stiffness in legs)
    return dataclasses.replace(
        drive,
        name=f"{drive.name}, stiff legs",
        kp=(*legs, *drive.kp[len(LEGS) :]),
        kd=(*damping, *drive.kd[len(LEGS) :]),
        effort=(*(STIFF_EFFORT,) * len(LEGS), *drive.effort[len(LEGS) :]),
    )


class WithOtherLegs(Tracker):
    """A tracker whose legs do something else than its network says; waist and arms are its own."""

    def __init__(self, inner: Tracker):
        """Take a tracker that is bound to no worlds yet."""
        self.inner = inner
        self.name, self.joints = inner.name, inner.joints
        self.checkpoint, self.checkpoint_hash = inner.checkpoint, inner.checkpoint_hash
        self.drive, self.original_drive = inner.drive, inner.original_drive
        self.physics_rate, self.fast_physics_rate = inner.physics_rate, inner.fast_physics_rate
        self.ignores, self.max_root_delta_deg = inner.ignores, inner.max_root_delta_deg
        self.needs, self.lookahead = inner.needs, inner.lookahead
        self._takes_mask = "mask" in inspect.signature(inner.step).parameters

    def legs(self, asked: torch.Tensor) -> torch.Tensor:
        """Targets of the legs' joints [rad] in place of those of the network, shape [worlds, 12] or one row for all."""
        raise NotImplementedError

    def bind(self, worlds: int, device: torch.device | str = "cpu") -> None:
        """See `Tracker.bind`."""
        super().bind(worlds, device)
        self.inner.bind(worlds, device)
        self.standing = torch.tensor([DEFAULT_POSE[joint] for joint in LEGS], device=device)

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """See `Tracker.reset`."""
        self.inner.reset(mask)

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """See `Tracker.prefill`."""
        self.inner.prefill(command, state, mask)

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """See `Tracker.step`."""
        masked = self._takes_mask and mask is not None
        targets = (self.inner.step(command, state, mask) if masked else self.inner.step(command, state)).clone()
        legs = list(LEGS)
        targets[:, legs] = self.legs(targets[:, legs])
        return targets


class HeldLegs(WithOtherLegs):
    """A tracker whose legs hold the standing posture stiffly, whatever its network says."""

    def __init__(self, inner: Tracker):
        """Take a tracker that is bound to no worlds yet."""
        super().__init__(inner)
        self.drive = stiffened(inner.drive)
        self.original_drive = None if inner.original_drive is None else stiffened(inner.original_drive)

    def legs(self, asked: torch.Tensor) -> torch.Tensor:
        """See `WithOtherLegs.legs`."""
        return self.standing

    def describe(self) -> dict[str, object]:
        """See `Tracker.describe`."""
        return self.inner.describe() | {"legs": "held in the standing posture"}


class GlidingBase:
    """Holds the pelvis upright at `GLIDE_HEIGHT` and moves it over the floor as the actions command.

    Once a tick the velocity of the root, and with it that of the whole robot, is led toward the commanded one and
    toward a target that the action's displacement and heading move; a steady lift at the pelvis carries the weight. A
    servo on the root rather than a spring at the pelvis: at 50 Hz a spring that is stiff for the robot is unstable for
    the pelvis alone. The robot stays a body: it collides, and what it meets pushes back. Nothing of it can step,
    crouch, rise, kick or sit.
    """

    def __init__(self, env: ArenaEnv):
        """Find the root in the physics."""
        robot = env.scene.robot
        self._physics = env.physics
        qpos, qvel = wp.to_torch(env.physics.qpos), wp.to_torch(env.physics.qvel)
        self._pose = qpos[:, robot.root_qpos : robot.root_qpos + 7]
        self._velocity = qvel[:, robot.root_qvel : robot.root_qvel + 6]
        self._force = wp.to_torch(env.physics.external_force)[:, robot.root_body]
        self._weight = float(env.scene.mj_model.body_subtreemass[robot.root_body]) * GRAVITY
        self._anchor = wp.to_torch(env.loop.reference.heading)
        most = [GLIDE_ACCELERATION] * 3 + [TIP_ACCELERATION] * 2 + [TURN_ACCELERATION]
        self._most = TICK * torch.tensor(most, device=env.torch_device)
        self.target = torch.zeros(env.worlds, 3, device=env.torch_device)
        """Target of the base: x, y [m] and yaw [rad], shape [worlds, 3]."""

    def begin(self, mask: torch.Tensor) -> None:
        """The base of the worlds in `mask` (bool, shape [worlds]) is to stay where the robot is now."""
        now = torch.cat([self._pose[:, :2], heading(self._pose[:, 3:])[:, None]], dim=1)
        self.target = torch.where(mask[:, None], now, self.target)

    def drive(self, action: torch.Tensor, stepping: np.ndarray, acting: np.ndarray) -> None:
        """Lead the base for the coming tick.

        Args:
            action: Canonical actions, shape [worlds, 40].
            stepping: Worlds that advance, bool, shape [worlds]; the others keep every bit.
            acting: Worlds of these whose action counts, bool, shape [worlds]; the base of the others holds still.
        """
        position, quat = self._pose[:, :3], self._pose[:, 3:]
        yaw, counts = heading(quat), torch.from_numpy(acting).to(action.device)
        moves = action[:, ACTION["root_xy_delta"]].nan_to_num(0.0, 0.0, 0.0) * counts[:, None]
        turned = action[:, ACTION["root_rot6d"]].nan_to_num(0.0, 0.0, 0.0)
        wanted = torch.where(counts, self._anchor + atan2(turned[:, 2], turned[:, 0]), self.target[:, 2])
        step = rotate_xy(wanted, moves)
        ahead = self.target[:, :2] + step - position[:, :2]
        length = torch.linalg.vector_norm(ahead, dim=1, keepdim=True).clamp_min(1e-9)
        ahead = ahead * (LEASH / length).clamp_max(1.0)
        turn = wrap_angle(wanted - yaw).clamp(-TURN_LEASH, TURN_LEASH)
        moved = torch.from_numpy(stepping).to(action.device)[:, None]
        target = torch.cat([position[:, :2] + ahead, (yaw + turn)[:, None]], dim=1)
        self.target = torch.where(moved, target, self.target)

        gap = torch.cat([ahead, GLIDE_HEIGHT - position[:, 2:]], dim=1)
        # In the pelvis' frame, in which its angular velocity is given.
        tilt = rotation_vector(quat_multiply(quat_conjugate(quat), quat_from_yaw(self.target[:, 2])))
        speed = torch.nn.functional.pad(step / TICK, (0, 4))
        change = speed + GLIDE_RATE * torch.cat([gap, tilt], dim=1) - self._velocity
        change = torch.minimum(torch.maximum(change, -self._most), self._most)
        self._force[:, 2] = torch.where(moved[:, 0], self._weight, self._force[:, 2])
        self._physics.add_velocity(change.cpu().numpy(), stepping)


class GlidingEnv(ArenaEnv):
    """The task with a robot whose base floats instead of standing on its legs: see `GlidingBase`."""

    @functools.cached_property
    def base(self) -> GlidingBase:
        """Base that carries the robot."""
        return GlidingBase(self)

    def reset(self, seeds: Sequence[int], worlds: Sequence[int] | np.ndarray | None = None, **more: object) -> None:
        """See `ArenaEnv.reset`."""
        super().reset(seeds, worlds, **cast("dict[str, Any]", more))
        mask = np.zeros(self.worlds, dtype=bool)
        mask[slice(None) if worlds is None else worlds] = True
        self.base.begin(torch.from_numpy(mask).to(self.torch_device))

    def step(self, action: torch.Tensor | np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """See `ArenaEnv.step`."""
        standing = _standing_legs(torch.as_tensor(action).to(self.torch_device).clone())
        stepping = self.active.copy() if worlds is None else self.active & worlds
        self.base.drive(standing, stepping, stepping & (self.tick >= 0))
        return super().step(standing, worlds)

    def describe(self) -> dict[str, object]:
        """See `ArenaEnv.describe`."""
        return super().describe() | {"body": f"base gliding at {GLIDE_HEIGHT:g} m, legs held in the standing posture"}


@dataclasses.dataclass(frozen=True)
class Body:
    """A robot that a task can be played with."""

    name: str
    title: str
    """Title in words."""
    equip: Callable[[Factories], Factories]
    """Makes what a run is built with from what it is built with for the whole robot."""


def _frozen(factories: Factories) -> Factories:
    return dataclasses.replace(factories, env=FrozenLegsEnv)


def _gliding(factories: Factories) -> Factories:
    def tracker(spec: str, checkpoint: Path | None) -> Tracker:
        return HeldLegs(factories.tracker(spec, checkpoint))

    return dataclasses.replace(factories, env=GlidingEnv, tracker=tracker)


BODIES: dict[str, Body] = {
    body.name: body
    for body in (
        Body("robot", "the whole robot", lambda factories: factories),
        Body("frozen", "legs frozen in the standing posture", _frozen),
        Body("gliding", "a base that glides in place of legs", _gliding),
    )
}
"""Bodies by name."""
