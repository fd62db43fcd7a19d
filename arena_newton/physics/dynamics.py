"""Dynamics of an episode that differ from the scene's: its model, late copies of what is measured and driven."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

from arena_newton.interfaces import RobotState
from arena_newton.robot.canonical import STATE
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, MUJOCO_JOINTS
from arena_newton.robot.rotations import matrix_from_quat, quat_multiply
from arena_newton.rules import seeding
from arena_newton.rules.modes import MOST_LATENCY, QUANTITIES

if TYPE_CHECKING:
    from arena_newton.tasks.handles import RobotHandles

__all__ = ["NOISES", "Delay", "SensorNoise", "value_of", "varied"]

_JOINTS = len(MUJOCO_JOINTS)
_MEASURED = {"joint_pos_noise": _JOINTS, "joint_vel_noise": _JOINTS, "gyro_noise": 3, "orientation_noise": 3}
"""Noise on the robot's state, and how many numbers it changes."""
NOISES = (*_MEASURED, "picture_noise")
"""Quantities that are noise of the sensors."""


def value_of(sample: Mapping[str, float], name: str) -> float:
    """One of `modes.QUANTITIES` in a sample of the dynamics; what it lacks is as usual."""
    return sample.get(name, QUANTITIES[name].usual)


def varied(model: mujoco.MjModel, robot: RobotHandles, sample: Mapping[str, float]) -> mujoco.MjModel:
    """A copy of a model with the friction, masses and gains of a sample; a factor of 1 leaves every bit."""
    own = copy.copy(model)
    own.geom_friction[:, 0] *= value_of(sample, "friction")
    links = np.isin(np.arange(own.nbody), np.asarray(robot.bodies))
    factor = np.where(links, value_of(sample, "robot_mass"), value_of(sample, "object_mass"))
    if (factor != 1.0).any():
        own.body_mass *= factor
        own.body_inertia *= factor[:, None]
        mujoco.mj_setConst(own, mujoco.MjData(own))
    gains = value_of(sample, "gains")
    own.actuator_gainprm[robot.joint_ctrl, 0] *= gains
    own.actuator_biasprm[robot.joint_ctrl, 1:3] *= gains
    return own


class Delay:
    """Rows of a tensor as they were some ticks ago, each world's by a number of its own."""

    def __init__(self, worlds: int, width: int, device: torch.device):
        """Delay no row, float32, shape [worlds, width]."""
        self.ticks = torch.zeros(worlds, dtype=torch.long, device=device)
        """Latency of each world [ticks], shape [worlds]."""
        self._past = torch.zeros(MOST_LATENCY, worlds, width, device=device)
        self._empty = torch.ones(worlds, dtype=torch.bool, device=device)
        self._rows = torch.arange(worlds, device=device)

    def forget(self, mask: torch.Tensor) -> None:
        """Begin with the next rows of the masked worlds, as if they had always been so."""
        self._empty |= mask

    def _since(self, now: torch.Tensor) -> torch.Tensor:
        """Rows now and in the ticks before, shape [1 + MOST_LATENCY, worlds, width]."""
        return torch.cat((now[None], torch.where(self._empty[:, None], now, self._past)))

    def late(self, now: torch.Tensor) -> torch.Tensor:
        """The delayed rows, of which `now` are the newest."""
        return self._since(now)[self.ticks, self._rows]

    def keep(self, now: torch.Tensor, mask: torch.Tensor) -> None:
        """Remember the rows of a tick of the masked worlds; every buffer keeps its address."""
        self._past.copy_(torch.where(mask[:, None], self._since(now)[:-1], self._past))
        self._empty &= ~mask

    def late_parts(self, parts: Mapping[str, torch.Tensor], mask: torch.Tensor) -> dict[str, torch.Tensor]:
        """The delayed rows of tensors side by side, by name, of which these are the newest; `keep` of some worlds."""
        now = torch.cat([*parts.values()], 1)
        late = self.late(now).split([part.shape[1] for part in parts.values()], 1)
        self.keep(now, mask)
        return dict(zip(parts, late, strict=True))


class SensorNoise:
    """White noise on what policy and tracker are shown, by an episode's seed and its tick alone.

    At one tick both see the same; latency is before it. Worlds without noise keep every bit.
    """

    def __init__(self, worlds: int, device: torch.device):
        """Disturb no world."""
        self._deviations = np.zeros((worlds, sum(_MEASURED.values())))
        self._pictures = np.zeros(worlds)
        self._seeds: list[int] = [0] * worlds
        self._drawn_at = np.full(worlds, np.iinfo(np.int64).min)
        self._drawn = np.zeros(self._deviations.shape, np.float32)
        self._shown: tuple[torch.Tensor, ...] = ()
        self._device = device
        self._order = torch.tensor(CANONICAL_TO_MUJOCO, device=device)

    def set(self, world: int, seed: int, sample: Mapping[str, float]) -> None:
        """Give a world the noise of its episode."""
        parts = [np.full(width, value_of(sample, name)) for name, width in _MEASURED.items()]
        self._deviations[world] = np.concatenate(parts)
        self._pictures[world] = value_of(sample, "picture_noise")
        self._seeds[world], self._drawn_at[world] = seed, np.iinfo(np.int64).min

    def _draws(self, ticks: np.ndarray) -> tuple[torch.Tensor, ...]:
        """Worlds with noise, shape [worlds, 1], and that of their tick: positions, velocities, gyro, a quaternion."""
        fresh = self._drawn_at != ticks
        if not fresh.any():  # the policy and the tracker see the same
            return self._shown
        noisy = self._deviations.any(axis=1)
        for world in np.flatnonzero(noisy & fresh).tolist():
            rng = seeding.sensor_rng(self._seeds[world], int(ticks[world]))
            self._drawn[world] = rng.standard_normal(self._drawn.shape[1]) * self._deviations[world]
        self._drawn_at[:] = ticks
        drawn = torch.from_numpy(self._drawn.copy()).to(self._device)
        position, velocity, gyro, turn = drawn.split([*_MEASURED.values()], 1)
        half = 0.5 * turn
        angle = half.norm(dim=1, keepdim=True)
        quat = torch.cat((torch.cos(angle), half * torch.sinc(angle / np.pi)), 1)
        self._shown = torch.from_numpy(noisy)[:, None].to(self._device), position, velocity, gyro, quat
        return self._shown

    def on_robot(self, state: RobotState, ticks: np.ndarray) -> RobotState:
        """The state that a tracker gets at these ticks of the worlds; position and base velocity stay exact."""
        noisy, position, velocity, gyro, turn = self._draws(ticks)
        return dataclasses.replace(
            state,
            quat=torch.where(noisy, quat_multiply(state.quat, turn), state.quat),
            ang_vel_body=torch.where(noisy, state.ang_vel_body + gyro, state.ang_vel_body),
            joint_pos=torch.where(noisy, state.joint_pos + position, state.joint_pos),
            joint_vel=torch.where(noisy, state.joint_vel + velocity, state.joint_vel),
        )

    def on_state(self, state: torch.Tensor, ticks: np.ndarray) -> torch.Tensor:
        """The state 64 that a policy gets at these ticks of the worlds."""
        noisy, position, velocity, _, turn = self._draws(ticks)
        x, y = state[:, STATE["root_rot6d"]].reshape(-1, 3, 2).unbind(2)
        matrix = torch.stack((x, y, torch.cross(x, y, dim=1)), 2) @ matrix_from_quat(turn)
        changed = state.clone()
        changed[:, STATE["root_rot6d"]] = matrix[:, :, :2].reshape(-1, 6)
        changed[:, STATE["joint_pos"]] += position[:, self._order]
        changed[:, STATE["joint_vel"]] += velocity[:, self._order]
        return torch.where(noisy, changed, state)

    def on_picture(self, name: str, picture: torch.Tensor, mask: np.ndarray, ticks: np.ndarray) -> torch.Tensor:
        """The picture of one camera, uint8, shape [worlds, H, W, 3], that a policy gets of the masked worlds."""
        worlds = np.flatnonzero(mask & (self._pictures > 0.0)).tolist()
        picture = picture.clone() if worlds else picture
        for world in worlds:
            rng = seeding.sensor_rng(self._seeds[world], int(ticks[world]), name)
            noise = rng.standard_normal(picture.shape[1:], np.float32) * np.float32(self._pictures[world])
            seen = picture[world].float() + torch.from_numpy(noise).to(picture.device)
            picture[world] = seen.round().clamp(0.0, 255.0).to(torch.uint8)
        return picture
