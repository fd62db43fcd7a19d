"""Labels of v4 decoded to actions of v3.1, tick by tick and world by world."""

from __future__ import annotations

import numpy as np
import torch

from arena_newton.data.readers.label_protocols import RATE_STEP, V4
from arena_newton.errors import InputError
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH
from arena_newton.robot.rotations import matrix_from_quat, quat_from_euler

__all__ = ["V4Decoder", "decode_v4"]

MAX_RATE = 1e6
"""Yaw rates are limited to this [rad/s], far beyond any motion, so that their sum stays in 64 bits."""


def decode_v4(labels: np.ndarray, yaw0: float = 0.0) -> np.ndarray:
    """Actions of v3.1 of an episode's labels of v4.

    Args:
        labels: shape [T, 40].
        yaw0: Yaw before the first of these ticks [rad].

    Returns:
        float32, shape [T, 40]; a row with a number that is not finite has no finite orientation.

    Raises:
        InputError: The labels have another shape.
    """
    if labels.ndim != 2 or labels.shape[1] != ACTION_WIDTH:
        raise InputError(f"labels have shape {list(labels.shape)}, expected [T, {ACTION_WIDTH}]")
    decoder = V4Decoder(1, yaw0=yaw0)
    return decoder.decode(torch.from_numpy(np.ascontiguousarray(labels, np.float32))[None])[0].numpy()


class V4Decoder:
    """Turns chunks of v4 into v3.1 for a batch of worlds; it remembers each world's yaw.

    With `realign` the commanded yaw follows the measured one: of the gap between them at the last measurement a
    fraction is closed each tick, so that after k ticks (1 - realign)^k of it is left. It is rounded as rates are.
    """

    def __init__(
        self,
        worlds: int,
        device: str | torch.device = "cpu",
        *,
        yaw0: float = 0.0,
        realign: float = 0.0,
        late: int = 0,
    ):
        """All worlds at the beginning of an episode.

        Args:
            yaw0: Yaw at the beginning of an episode, in its own frame [rad].
            realign: Fraction of the gap to the measured yaw that is closed each tick; 0: none, and yaws are exact.
            late: Ticks between a measurement and the first action of the chunk that is decoded next: actions of the
                chunk before it that are still to be executed.
        """
        self._start, self._realign = yaw0, realign
        self._turned = torch.zeros((worlds, late + 1), dtype=torch.int64, device=device)
        """Yaw since the beginning after each of the last ticks that were decoded [RATE_STEP ticks], the latest last."""
        self._gap = torch.zeros(worlds, dtype=torch.float64, device=device)
        """Measured minus commanded yaw at the last measurement [rad]."""
        self._age = torch.zeros(worlds, dtype=torch.int64, device=device)
        """Ticks since then."""

    def reset(self, mask: np.ndarray | torch.Tensor | None = None) -> None:
        """Begin new episodes in the worlds of `mask`, bool, shape [worlds]; in all without one."""
        chosen = self._mask(mask)
        self._turned[chosen] = 0
        self._gap[chosen], self._age[chosen] = 0.0, 0

    def measure(self, yaw: torch.Tensor, mask: np.ndarray | torch.Tensor | None = None) -> None:
        """Take the measured heading, `late` ticks before the next chunk begins.

        Args:
            yaw: Of the robot in the episode's frame [rad], shape [worlds]; one that is not finite measures no gap.
            mask: Worlds that are measured, bool, shape [worlds]; all without one.
        """
        if not self._realign:
            return
        chosen = self._mask(mask)
        gap = yaw.double() - (self._start + self._turned[:, 0].double() * (RATE_STEP * g1.TICK))
        gap = torch.nan_to_num(gap, nan=0.0, posinf=0.0, neginf=0.0)
        gap = torch.remainder(gap + np.pi, 2.0 * np.pi) - np.pi
        self._gap = torch.where(chosen, gap, self._gap)
        self._age = torch.where(chosen, 0, self._age)

    def decode(self, chunk: torch.Tensor, mask: np.ndarray | torch.Tensor | None = None) -> torch.Tensor:
        """Actions of v3.1 of a chunk that will be executed to its end.

        Args:
            chunk: Actions of v4, shape [worlds, n, 40].
            mask: Worlds whose yaw goes on, bool, shape [worlds]; all without one. Rows of the others mean nothing.

        Returns:
            float32, shape [worlds, n, 40]; where a root number is not finite, neither is the orientation.
        """
        exact = chunk.double()
        rate = exact[..., V4["yaw_rate"].start]
        steps = torch.nan_to_num(rate, nan=0.0).clamp(-MAX_RATE, MAX_RATE).div(RATE_STEP).round().to(torch.int64)
        turned = self._turned[:, -1:] + steps.cumsum(dim=1)
        chosen = self._mask(mask)
        if self._realign:
            ages = self._age[:, None] + torch.arange(chunk.shape[1] + 1, device=chunk.device)
            closed = self._gap[:, None] * (1.0 - torch.pow(1.0 - self._realign, ages.double()))
            closed = closed.div(RATE_STEP * g1.TICK).round().to(torch.int64)
            turned = turned + closed[:, 1:] - closed[:, :1]
            self._age = torch.where(chosen, ages[:, -1], self._age)
        last = torch.cat([self._turned, turned], dim=1)[:, -self._turned.shape[1] :]
        self._turned = torch.where(chosen[:, None], last, self._turned)
        yaw = self._start + turned.double() * (RATE_STEP * g1.TICK) + 0.0 * rate  # keeps NaN and infinity
        roll, pitch = exact[..., V4["roll_pitch"]].unbind(-1)
        matrix = matrix_from_quat(quat_from_euler(torch.stack([yaw, pitch, roll], dim=-1)))
        actions = chunk.float().clone()
        actions[..., ACTION["root_xy_delta"]] = (exact[..., V4["velocity_xy"]] * g1.TICK).float()
        actions[..., ACTION["root_rot6d"]] = matrix[..., :2].flatten(-2).float()
        return actions

    def _mask(self, mask: np.ndarray | torch.Tensor | None) -> torch.Tensor:
        if mask is None:
            return torch.ones_like(self._age, dtype=torch.bool)
        return torch.as_tensor(mask, dtype=torch.bool, device=self._age.device)
