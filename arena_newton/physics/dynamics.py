"""Dynamics of an episode that differ from the scene's: its model, late copies of what is measured and driven."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch

from arena_newton.rules.modes import MOST_LATENCY, QUANTITIES

if TYPE_CHECKING:
    from arena_newton.tasks.handles import RobotHandles

__all__ = ["Delay", "value_of", "varied"]


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
