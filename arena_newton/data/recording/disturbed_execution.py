"""Disturbed execution: demonstrations that hold recoveries while their labels stay what the policy decided.

What is executed is the policy's action and Ornstein-Uhlenbeck noise on the reference's joints, its velocity and its
heading; a recorder stores the action without the noise. So the states are those that a learner will get into, and the
labels lead back from them.

An episode's noise follows from its seed alone: it is drawn as a whole on the host when the episode begins.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from arena_newton.data.recording.noise_levels import NoiseLevels
from arena_newton.interfaces import Recorder
from arena_newton.robot.canonical import ACTION
from arena_newton.robot.g1 import CANONICAL_JOINTS, TICK

if TYPE_CHECKING:
    from arena_newton.interfaces import Planned, World

__all__ = ["ActionNoise", "noise_series"]

STREAM = 0x4F55_4E4F
"""Second half of the generator's key: separates the noise from whatever else an episode's seed draws."""
JOINTS = len(CANONICAL_JOINTS)
WIDTH = JOINTS + 4
"""Numbers of a tick: joints [rad], displacement x and y [m], cosine and sine of the turn."""


def noise_series(episode_seed: int, ticks: int, levels: NoiseLevels) -> np.ndarray:
    """Noise of an episode from its step 0 on; it begins with none, so that the first action is no jump.

    Args:
        levels: How strong and how slow it is.

    Returns:
        float32, shape [ticks, 33]: joints [rad], displacement in the reference root's frame [m], cosine and sine of
        the turn about the vertical.
    """
    draw = np.random.Generator(np.random.Philox(key=[int(episode_seed), STREAM]))
    normal = draw.standard_normal((ticks, JOINTS + 3))
    deviation = np.repeat([levels.joints, levels.velocity, levels.yaw_rate], [JOINTS, 2, 1])
    time = np.repeat([levels.joints_time, levels.velocity_time, levels.yaw_rate_time], [JOINTS, 2, 1])
    stays = np.array([math.exp(-TICK / t) for t in time])  # np.exp may differ from one processor to another
    drives = deviation * np.sqrt(1.0 - stays * stays)
    series, now = np.zeros_like(normal), np.zeros(normal.shape[1])
    turns, turn, keeps = [], 0.0, math.exp(-TICK / levels.yaw_leak)
    for tick in range(ticks):
        series[tick] = now
        turns.append((math.cos(turn), math.sin(turn)))
        turn = keeps * turn + float(now[-1]) * TICK
        now = stays * now + drives * normal[tick]
    series[:, JOINTS : JOINTS + 2] *= TICK
    whole: np.ndarray = np.concatenate([series[:, :-1], np.array(turns).reshape(ticks, 2)], axis=1)
    return whole.astype(np.float32)


class ActionNoise(Recorder):
    """A `Disturbance` for `rollout.Rollout`; as one of its recorders it receives the beginnings of episodes."""

    def __init__(self, ticks: int, levels: NoiseLevels | None = None):
        """Set up the noise.

        Args:
            ticks: Longest episode [ticks]; later ones get the last tick's noise.
            levels: How strong and how slow it is.
        """
        self.levels = levels or NoiseLevels()
        self.ticks = ticks
        self._env: World | None = None
        self._series: torch.Tensor | None = None
        """Noise of each world's episode, shape [worlds, ticks, 33]."""

    def describe(self) -> dict[str, object]:
        """Levels to record with every result so that this disturbance is named exactly, as JSON."""
        return self.levels.describe()

    def start(self, env: World, world: int, episode: Planned) -> None:
        """Draw the noise of an episode."""
        if self._series is None or self._env is not env:
            self._env = env
            self._series = torch.zeros((env.worlds, self.ticks, WIDTH), device=env.torch_device)
            self._series[..., -2] = 1.0
        drawn = noise_series(episode.episode_seed, self.ticks, self.levels)
        self._series[world] = torch.from_numpy(drawn).to(env.torch_device)

    def __call__(self, env: World, action: torch.Tensor) -> torch.Tensor:
        """Actions as they are executed, shape [worlds, 40]: noise of each world's tick is added.

        Joints and displacement are sums; the orientation is turned about the vertical of the episode's frame. Height
        and hands stay.
        """
        executed = action.clone()
        if self._series is None:
            return executed
        tick = torch.from_numpy(np.clip(env.tick, 0, self.ticks - 1)).to(env.torch_device)
        noise = self._series[torch.arange(env.worlds, device=env.torch_device), tick]
        executed[:, ACTION["joint_pos"]] += noise[:, :JOINTS]
        executed[:, ACTION["root_xy_delta"]] += noise[:, JOINTS : JOINTS + 2]
        cosine, sine = noise[:, -2:-1], noise[:, -1:]
        first = ACTION["root_rot6d"].start
        x, y = action[:, first : first + 2], action[:, first + 2 : first + 4]
        executed[:, first : first + 2] = cosine * x - sine * y
        executed[:, first + 2 : first + 4] = sine * x + cosine * y
        return executed
