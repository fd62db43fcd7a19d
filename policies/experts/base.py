"""What the scripted experts share: a privileged view of the world, and the reference generator that speaks for them.

An expert decides commands for the generator (velocity, height, hand points) from the true state of the world, and hands
over the canonical actions that the generator makes of them. It never learns which tracker executes those.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from arena_newton.canonical import ACTION_WIDTH
from arena_newton.errors import InputError
from arena_newton.interfaces import Chunk, Observation
from arena_newton.policies.base import Policy, world_mask
from arena_newton.robot import TICK
from arena_newton.rotations import heading

if TYPE_CHECKING:
    from arena_newton.trackers.motions.commands import MotionCommand

__all__ = ["Expert", "ExpertPolicy", "Sight"]

REALIGN = TICK / 10.0
"""Share of the heading error between reference and robot that a tick of a walk takes out of the reference. Slow: a
tracker that does not see its heading takes the correction for a yaw rate; one that sees it must not be left far behind.
"""


class Sight:
    """Privileged view of an environment: true poses as torch tensors on its device, rows are worlds."""

    def __init__(self, env: Any):
        """Bind an `ArenaEnv`."""
        import warp as wp

        self.scene = env.scene
        self.worlds: int = env.worlds
        self.device = env.torch_device
        self.task: str = env.spec.name
        root = env.scene.robot.root_qpos
        qpos = wp.to_torch(env.physics.qpos)
        self._root = qpos[:, root : root + 7]
        self._xpos, self._xquat = wp.to_torch(env.physics.xpos), wp.to_torch(env.physics.xquat)

    @property
    def pose(self) -> Tensor:
        """Root x, y [m] and yaw [rad], shape [worlds, 3]."""
        return torch.cat([self._root[:, :2], heading(self._root[:, 3:7])[:, None]], dim=1)

    @property
    def height(self) -> Tensor:
        """Root height [m], shape [worlds]."""
        return self._root[:, 2]

    def body(self, body: int) -> tuple[Tensor, Tensor]:
        """Position [m] and orientation wxyz of a body, shapes [worlds, 3] and [worlds, 4]."""
        return self._xpos[:, body], self._xquat[:, body]

    def point(self, body: int, offset: Tensor) -> Tensor:
        """A point fixed to a body, given in its frame [m], shape [3]; shape [worlds, 3]."""
        pos, quat = self.body(body)
        v, axis = offset.expand_as(pos), quat[:, 1:]
        twice = 2.0 * torch.linalg.cross(axis, v)
        return pos + v + quat[:, :1] * twice + torch.linalg.cross(axis, twice)

    def frame(self, name: str) -> Callable[[], Tensor]:
        """Position [m] of a frame prim of the robot or scene, to be read again each time; shape [worlds, 3]."""
        frame = self.scene.frame(name)
        offset = torch.tensor(frame.pos, dtype=torch.float32, device=self.device)
        return lambda: self.point(frame.body_id, offset)

    def box(self, prim: str) -> tuple[int, Tensor, Tensor]:
        """Body of a prim's first box collider, the collider's place in it [m] and its half sizes [m]."""
        model = self.scene.mj_model
        geom = self.scene.geom_ids(prim)[0]
        return (
            int(model.geom_bodyid[geom]),
            torch.tensor(model.geom_pos[geom], dtype=torch.float32, device=self.device),
            torch.tensor(model.geom_size[geom], dtype=torch.float32, device=self.device),
        )


class Expert:
    """One task's way of deciding; a subclass writes `begin` and `command`."""

    task: str = ""
    """Name of the task that it solves."""

    def __init__(self, sight: Sight):
        """Look up what the task needs in the scene.

        Raises:
            InputError: The scene misses a prim; the message names it.
        """
        self.sight = sight

    def begin(self, mask: Tensor) -> None:
        """Episodes begin in the worlds of `mask`: the robot stands; dropped objects may still roll."""

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """The command of the next chunk.

        Args:
            mask: Worlds that ask, bool, shape [worlds].
            dt: Length of the chunk [s].
        """
        raise TypeError(f"expert of {self.task!r} defines no command()")


class ExpertPolicy(Policy):
    """`--policy expert`: the expert of the task that the environment runs."""

    name = "expert"

    def __init__(self, experts: Mapping[str, Callable[[Sight], Expert]], chunk_size: int = 5):
        """Take the table of experts.

        Args:
            experts: Task name to maker of its expert.
            chunk_size: Ticks between two looks at the world.
        """
        self.experts = experts
        self.chunk_size = chunk_size
        self.expert: Expert | None = None
        """The expert at work; None before `attach`."""

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """Refuse a task without an expert.

        Raises:
            InputError: There is no expert for the task.
        """
        if task not in self.experts:
            raise InputError(f"--policy expert: no expert for task {task}; there are {', '.join(sorted(self.experts))}")

    def attach(self, env: Any) -> None:
        """Get the privileged view of an environment and pick the expert of its task.

        Raises:
            InputError: There is no expert for the task.
        """
        task = env.spec.name
        self.check_task(task)
        from arena_newton.trackers.motions.generator import ReferenceGenerator

        self.sight = Sight(env)
        self.expert = self.experts[task](self.sight)
        self.generator = ReferenceGenerator(env.worlds, env.torch_device)
        self._fresh = np.ones(env.worlds, dtype=bool)

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Any = None) -> None:
        """New episodes in the worlds of `mask`; the expert looks at them when they ask first."""
        if self.expert is not None:
            self._fresh |= world_mask(mask, len(seeds))

    @torch.inference_mode()
    def act(self, observation: Observation) -> Chunk:
        """The next actions of the worlds that ask.

        Raises:
            InputError: No environment was attached.
        """
        if self.expert is None:
            raise InputError("--policy expert: sees the world itself; run it in this process, with attach(env)")
        worlds, device = len(observation.state), self.sight.device
        asking = world_mask(observation.mask, worlds)
        mask = torch.from_numpy(asking).to(device)
        fresh = asking & self._fresh
        if fresh.any():
            begins, pose = torch.from_numpy(fresh).to(device), self.sight.pose
            self.generator.reset(begins, root_xy=pose[:, :2], yaw=pose[:, 2])
            self.expert.begin(begins)
            self._fresh &= ~fresh
        command = self.expert.command(mask, self.chunk_size * TICK)
        actions = torch.empty(worlds, self.chunk_size, ACTION_WIDTH, device=device)
        yaw, share = self.sight.pose[:, 2], REALIGN * (mask & (command.velocity != 0).any(dim=1))
        for tick in range(self.chunk_size):
            self.generator.realign(yaw, share)
            self.generator.step(command, mask)
            actions[:, tick] = self.generator.action()
        return Chunk(actions)

    def describe(self) -> dict[str, Any]:
        """Name, the tasks it knows and the length of its chunks."""
        return {"name": self.name, "tasks": sorted(self.experts), "chunk_size": self.chunk_size}
