"""What the scripted experts share: a privileged view of the world, and the generator that makes their actions.

An expert decides commands for the reference generator (velocity, height, hand points) from the true state of the world;
the generator turns them into canonical actions. The expert does not know which tracker executes those.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp
from torch import Tensor

from arena_newton import tasks as task_registry
from arena_newton.canonical import ACTION_WIDTH
from arena_newton.errors import InputError
from arena_newton.interfaces import Chunk, Observation
from arena_newton.policies.base import Json, Mask, Policy, world_mask
from arena_newton.robot import TICK
from arena_newton.rotations import heading
from arena_newton.trackers.motions.generator import ReferenceGenerator

if TYPE_CHECKING:
    from arena_newton.interfaces import World
    from arena_newton.trackers.motions.commands import MotionCommand

__all__ = ["Expert", "ExpertPolicy", "Sight"]

REALIGN = TICK / 10.0
"""Fraction of the heading error between reference and robot that is corrected in the reference per tick of a walk.
Slow, because a tracker that does not observe its heading interprets the correction as a yaw rate; not slower, because
one that observes it must not be left far behind."""


class Sight:
    """Privileged view of an environment: true poses as torch tensors on its device, rows are worlds."""

    def __init__(self, env: World):
        """Bind an environment."""
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
        """Reader of the current position [m] of a frame prim of the robot or scene, shape [worlds, 3]."""
        frame = self.scene.frame(name)
        offset = torch.tensor(frame.pos, dtype=torch.float32, device=self.device)
        return lambda: self.point(frame.body_id, offset)

    def box(self, prim: str) -> tuple[int, Tensor, Tensor]:
        """Body of a prim's first box collider, the collider's position in its frame [m] and its half sizes [m]."""
        model = self.scene.mj_model
        geom = self.scene.geom_ids(prim)[0]
        return (
            int(model.geom_bodyid[geom]),
            torch.tensor(model.geom_pos[geom], dtype=torch.float32, device=self.device),
            torch.tensor(model.geom_size[geom], dtype=torch.float32, device=self.device),
        )


class Expert:
    """How one task is solved; a subclass writes `begin` and `command`."""

    task: str = ""
    """Name of the task that it solves."""

    def __init__(self, sight: Sight):
        """Look up what the task needs in the scene.

        Raises:
            InputError: A prim is missing in the scene; the message names it.
        """
        self.sight = sight

    def begin(self, mask: Tensor) -> None:
        """Episodes begin in the worlds of `mask`: the robot stands; dropped objects may still roll."""

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """The command of the next chunk, `dt` [s] long, for the worlds that ask: `mask`, bool, shape [worlds]."""
        raise TypeError(f"expert of {self.task!r} defines no command()")

    def phases(self) -> list[str] | None:
        """Phase that each world is in under the last command; None: the expert knows no phases."""
        return None


def solved_tasks() -> list[str]:
    """Tasks that name an expert, sorted."""
    return sorted(name for name in task_registry.names() if task_registry.get(name).expert)


def expert_class(task: str) -> type[Expert]:
    """The expert that a task names.

    Raises:
        InputError: It names none.
    """
    path = task_registry.get(task).expert
    if path is None:
        raise InputError(f"--policy expert: no expert for task {task}; there are {', '.join(solved_tasks())}")
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


class ExpertPolicy(Policy):
    """`--policy expert`: the expert of the task that the environment runs."""

    name = "expert"

    def __init__(self, chunk_size: int = 5):
        """Set the length of a chunk: the ticks between two readings of the world's state."""
        self.chunk_size = chunk_size
        self.expert: Expert | None = None
        """The expert of the environment's task; None before `attach`."""

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """See `Policy.check_task`."""
        expert_class(task)

    def attach(self, env: World) -> None:
        """Take the privileged view of an environment and pick the expert of its task."""
        expert = expert_class(env.spec.name)
        self.sight = Sight(env)
        self.expert = expert(self.sight)
        self.generator = ReferenceGenerator(env.worlds, env.torch_device)
        self._begins = np.ones(env.worlds, dtype=bool)

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """New episodes in the worlds of `mask`; the expert reads their state when they ask first."""
        if self.expert is not None:
            self._begins |= world_mask(mask, len(seeds))

    @torch.inference_mode()
    def act(self, observation: Observation) -> Chunk:
        """See `Policy.act`."""
        if self.expert is None:
            raise InputError("--policy expert: sees the world itself; run it in this process, with attach(env)")
        worlds, device = len(observation.state), self.sight.device
        asking = world_mask(observation.mask, worlds)
        mask = torch.from_numpy(asking).to(device)
        beginning = asking & self._begins
        if beginning.any():
            begins, pose = torch.from_numpy(beginning).to(device), self.sight.pose
            self.generator.reset(begins, root_xy=pose[:, :2], yaw=pose[:, 2])
            self.expert.begin(begins)
            self._begins &= ~beginning
        command = self.expert.command(mask, self.chunk_size * TICK)
        actions = torch.empty(worlds, self.chunk_size, ACTION_WIDTH, device=device)
        yaw, fraction = self.sight.pose[:, 2], REALIGN * (mask & (command.velocity != 0).any(dim=1))
        for tick in range(self.chunk_size):
            self.generator.realign(yaw, fraction)
            self.generator.step(command, mask)
            actions[:, tick] = self.generator.action()
        return Chunk(actions, phases=self.expert.phases())

    def describe(self) -> Json:
        """Name, the tasks that have an expert and the length of the chunks."""
        return {"name": self.name, "tasks": solved_tasks(), "chunk_size": self.chunk_size}
