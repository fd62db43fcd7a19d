"""Reads a policy's actions by the label protocol that it was trained on, so that the world is given v3.1 always."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from arena_newton.data.readers.label_decoder import V4Decoder
from arena_newton.data.readers.label_protocols import LABELS, protocol
from arena_newton.errors import InputError
from arena_newton.policies.base import Chunk, Json, Mask, Observation, Policy, world_mask
from arena_newton.robot.canonical import ACTION_WIDTH, STATE
from arena_newton.robot.rotations import atan2

if TYPE_CHECKING:
    from arena_newton.interfaces import World

__all__ = ["V4Policy", "measured_yaw", "read_by"]


def read_by(policy: Policy, labels: str, late: int = 0) -> Policy:
    """The policy as the world understands it.

    Args:
        policy: Whose actions are of `labels`.
        late: Ticks from a query to the first action of its chunk, as `rollout.Rollout` delays them.

    Returns:
        The policy itself where it answers v3.1, else one that decodes its chunks.

    Raises:
        InputError: The protocol is unknown, or the policy is always of another one.
    """
    wanted = protocol(labels)
    own = getattr(policy, "labels", None)  # a plug-in need not know of protocols
    if own is not None and own != wanted.name:
        raise InputError(f"--labels {labels}: policy {policy.name} gives actions of {own}; leave the flag out")
    return policy if wanted is LABELS["v3.1"] else V4Policy(policy, late)


def measured_yaw(state: torch.Tensor) -> torch.Tensor:
    """Heading of the robot in its episode's frame (yaw, ZYX) [rad], shape [worlds], of states [worlds, 64]."""
    rot6d = state[:, STATE["root_rot6d"]].double()
    return atan2(rot6d[:, 2], rot6d[:, 0])  # R10 and R00: rows of the first two columns


class V4Policy(Policy):
    """Decodes the v4 actions of another policy per world; an episode's heading is that of its own start.

    A chunk must be executed to its end before the next one is asked for, as `rollout.Rollout` does. Where the policy
    has a `realign`, the heading is measured at each query.
    """

    labels = "v3.1"

    def __init__(self, policy: Policy, late: int = 0):
        """Take the policy whose actions are of v4.

        Args:
            late: Ticks from a query to the first action of its chunk.
        """
        self.policy, self._late = policy, late
        self.name = policy.name
        self.needs_image, self.camera = policy.needs_image, policy.camera
        self.cameras = getattr(policy, "cameras", None)
        self.chunk_size = policy.chunk_size
        self.in_pieces = bool(getattr(policy, "in_pieces", False))
        self._realign = float(getattr(policy, "realign", 0.0))
        self._decoder: V4Decoder | None = None

    @property
    def depends_on_worlds(self) -> bool:  # type: ignore[override]
        """See `Policy.depends_on_worlds`; known when the policy was checked."""
        return self.policy.depends_on_worlds

    def check(self) -> None:
        """See `Policy.check`."""
        self.policy.check()

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """See `Policy.check_task`."""
        self.policy.check_task(task, mode, seeds)

    def attach(self, env: World) -> None:
        """Take the worlds whose headings are integrated."""
        self.policy.attach(env)
        self._decoder = V4Decoder(env.worlds, env.torch_device, realign=self._realign, late=self._late)

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Begin new episodes at their heading."""
        if self._decoder is not None:
            self._decoder.reset(world_mask(mask, len(seeds)))
        self.policy.reset(seeds, tasks, mask)

    def act(self, observation: Observation) -> Chunk:
        """The policy's chunk as v3.1.

        Raises:
            InputError: It has another shape than a chunk.
        """
        answer = self.policy.act(observation)
        actions = torch.as_tensor(answer.actions, dtype=torch.float32, device=observation.state.device)
        worlds = len(observation.state)
        if actions.ndim != 3 or actions.shape[::2] != (worlds, ACTION_WIDTH) or not actions.shape[1]:
            shape = f"a chunk of shape {list(actions.shape)}, expected [{worlds}, n, {ACTION_WIDTH}]"
            raise InputError(f"policy {self.name}: {shape} with n of at least 1")
        if self._decoder is None:  # used without an environment, as a policy server does
            self._decoder = V4Decoder(worlds, actions.device, realign=self._realign, late=self._late)
        if self._realign:
            # Chunks in pieces are queried for the first piece only, and when that is depends on other worlds.
            queried = getattr(self.policy, "queried", None)
            measured = observation.mask if queried is None else observation.mask & queried
            self._decoder.measure(measured_yaw(observation.state), measured)
        return Chunk(self._decoder.decode(actions, observation.mask), answer.errors, answer.phases)

    def describe(self) -> Json:
        """Policy's own description, and the labels by which it is read."""
        return self.policy.describe() | {"labels": "v4"}

    def close(self) -> None:
        """See `Policy.close`."""
        self.policy.close()
