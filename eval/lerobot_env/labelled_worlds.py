"""A batch of worlds that takes actions of label protocol v4 and decodes them as our runner does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
import torch

from arena_newton.data.label_protocols import V4Decoder
from arena_newton.errors import InputError
from arena_newton.eval.gym import ArenaVectorEnv
from arena_newton.policies.label_reader import measured_yaw

if TYPE_CHECKING:
    from typing import Any

__all__ = ["V4VectorEnv", "make_worlds"]


class V4VectorEnv(ArenaVectorEnv):
    """Worlds of one task whose actions are of v4; an episode's heading is that of its own start."""

    def __init__(self, task: str, num_envs: int = 1, *, realign: float = 0.0, look_ticks: int = 1, **options: object):
        """Build the worlds.

        Args:
            task: Task name.
            num_envs: Worlds in the batch.
            realign: Fraction of the gap between commanded and measured heading that is closed each tick.
            look_ticks: Ticks between two looks of the policy, at which the heading is measured: its chunk.
            options: Those of `ArenaVectorEnv`.

        Raises:
            InputError: A number is out of range, or as of `ArenaVectorEnv`.
        """
        if not 0.0 <= realign <= 1.0:
            raise InputError(f"realign {realign}: expected 0 to 1")
        if look_ticks < 1:
            raise InputError(f"look_ticks {look_ticks}: expected at least 1")
        super().__init__(task, num_envs, **cast("dict[str, Any]", options))
        self._look_ticks = look_ticks
        self._decoder = V4Decoder(num_envs, realign=realign)

    def step(
        self, actions: np.ndarray | torch.Tensor
    ) -> tuple[dict[str, object], np.ndarray, np.ndarray, np.ndarray, dict[str, object]]:
        """Decode a tick's actions and advance; see `ArenaVectorEnv.step`."""
        acting = ~self._over & (self.env.tick >= 0)
        self._decoder.measure(
            measured_yaw(torch.from_numpy(self._state)), acting & (self.env.tick % self._look_ticks == 0)
        )
        decoded = self._decoder.decode(self._checked(actions).cpu()[:, None], acting)[:, 0]
        return super().step(decoded)

    def _begin(self, mask: np.ndarray, numbers: Sequence[int | None]) -> None:
        """Begin episodes at their own heading."""
        self._decoder.reset(mask)
        super()._begin(mask, numbers)


def make_worlds(
    task: str, num_envs: int, labels: str, realign: float, look_ticks: int, options: Mapping[str, object]
) -> ArenaVectorEnv:
    """A batch of worlds whose actions are of a label protocol, v3.1 or v4; the others as of `V4VectorEnv`."""
    if labels == "v4":
        return V4VectorEnv(task, num_envs, realign=realign, look_ticks=look_ticks, **options)
    return ArenaVectorEnv(task, num_envs, **cast("dict[str, Any]", options))
