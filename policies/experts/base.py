"""Base of the scripted experts: a privileged view of the world, and the generator that makes their actions.

An expert decides commands for the reference generator (velocity, height, hand points) from the true state of the world;
the generator turns them into canonical actions. The expert does not know which tracker executes those.
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp
from torch import Tensor

from arena_newton import tasks as task_registry
from arena_newton.errors import InputError
from arena_newton.interfaces import Chunk, Observation
from arena_newton.policies.base import Json, Mask, Policy, world_mask
from arena_newton.policies.experts.style import Style
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import heading
from arena_newton.trackers.motions.commands import COLUMNS, MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator

if TYPE_CHECKING:
    from arena_newton.interfaces import World

__all__ = ["Expert", "ExpertPolicy", "Sight"]

DECISION = 5
"""Ticks between two decisions of an expert, counted from the start of a world's episode."""
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
        self._qpos, self._qvel = qpos, wp.to_torch(env.physics.qvel)
        self._root = qpos[:, root : root + 7]
        self._xpos, self._xquat = wp.to_torch(env.physics.xpos), wp.to_torch(env.physics.xquat)
        self._xipos = wp.to_torch(env.physics.xipos)
        self._joint_qpos = torch.from_numpy(env.scene.robot.joint_qpos).long().to(self.device)
        self._measured: dict[Hashable, Tensor] | None = None

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Measures everything once only: no world moves while the experts decide."""
        self._measured = {}
        try:
            yield
        finally:
            self._measured = None

    def once(self, key: Hashable, measure: Callable[[], Tensor]) -> Tensor:
        """A measurement that is made once while the worlds are `still`, and otherwise at every call."""
        if self._measured is None:
            return measure()
        if key not in self._measured:
            self._measured[key] = measure()
        return self._measured[key]

    @property
    def pose(self) -> Tensor:
        """Root x, y [m] and yaw [rad], shape [worlds, 3]."""
        return self.once("pose", lambda: torch.cat([self._root[:, :2], heading(self.root_quat)[:, None]], dim=1))

    @property
    def height(self) -> Tensor:
        """Root height [m], shape [worlds]."""
        return self._root[:, 2]

    @property
    def root_position(self) -> Tensor:
        """Pelvis x, y, z [m], shape [worlds, 3]."""
        return self._root[:, :3]

    @property
    def root_quat(self) -> Tensor:
        """Orientation of the pelvis, wxyz, shape [worlds, 4]."""
        return self._root[:, 3:7]

    @property
    def joints(self) -> Tensor:
        """Angles of the 29 body joints [rad], MuJoCo order, shape [worlds, 29]."""
        return self._qpos[:, self._joint_qpos]

    def joint(self, prim: str) -> Callable[[], Tensor]:
        """Reader of the position [rad or m] of a joint prim of the scene, shape [worlds]."""
        address = self.scene.joint_qpos(prim)
        return lambda: self._qpos[:, address]

    def velocity(self, prim: str) -> Callable[[], Tensor]:
        """Reader of the linear velocity [m/s] of a free body's origin, world, shape [worlds, 3]."""
        address = self.scene.joint_qvel(prim)
        return lambda: self._qvel[:, address : address + 3]

    def com(self, prim: str) -> Callable[[], Tensor]:
        """Reader of the centre of mass [m] of a rigid prim, shape [worlds, 3]."""
        body = self.scene.body_id(prim)
        return lambda: self._xipos[:, body]

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
        return lambda: self.once(("frame", name), lambda: self.point(frame.body_id, offset))

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
    """Scripted solution of one task; a subclass writes `begin` and `command`."""

    task: str = ""
    """Name of the task that it solves."""
    reference: ReferenceGenerator
    """The generator that makes its actions, known from `attach` on: an expert that must place its feet reads the
    phase of the gait there."""

    def __init__(self, sight: Sight):
        """Look up what the task needs in the scene.

        Raises:
            InputError: A prim is missing in the scene; the message names it.
        """
        self.sight = sight

    def begin(self, mask: Tensor, style: Style) -> None:
        """Episodes begin in the worlds of `mask`: the robot stands; dropped objects may still roll.

        Args:
            mask: Worlds, bool, shape [worlds].
            style: Seeded numbers of every world's episode, which make two demonstrations differ.
        """

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """The command of the next `dt` [s] for the worlds that decide now: `mask`, bool, shape [worlds]."""
        raise TypeError(f"expert of {self.task!r} defines no command()")

    def phases(self) -> list[str] | None:
        """Phase that each world is in under the last command; None: the expert knows no phases."""
        return None


def solved_tasks() -> list[str]:
    """Tasks that name an expert, sorted."""
    return sorted(spec.name for spec in task_registry.specs() if spec.expert)


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
    """`--policy expert`: the expert of the task that the environment runs.

    It gives one action at a time, so that all worlds share one step of the generator whenever their episodes began; the
    expert itself decides every `DECISION` ticks of a world's own episode.
    """

    name = "expert"
    labels = "v3.1"
    chunk_size = 1

    def __init__(self, sight: Callable[[World], Sight] | None = None) -> None:
        """Know no environment yet; `sight` is what the expert sees worlds with, `Sight` when None."""
        self._sight_of = sight or Sight
        self.expert: Expert | None = None
        """The expert of the environment's task; None before `attach`."""

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """See `Policy.check_task`."""
        expert_class(task)

    def attach(self, env: World) -> None:
        """Take the privileged view of an environment and pick the expert of its task."""
        expert = expert_class(env.spec.name)
        self.sight = self._sight_of(env)
        self.expert = expert(self.sight)
        self.generator = self.expert.reference = ReferenceGenerator(env.worlds, env.torch_device)
        self.style = Style(env.worlds, env.torch_device)
        self._begins = np.ones(env.worlds, dtype=bool)
        self._asked = np.zeros(env.worlds, dtype=np.int64)
        self._commands = MotionCommand.neutral(env.worlds, env.torch_device).pack()
        self._walking = torch.zeros(env.worlds, dtype=torch.bool, device=env.torch_device)
        self._phases: list[str] | None = None

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """New episodes in the worlds of `mask`; the expert reads their state when they ask first."""
        if self.expert is not None:
            begins = world_mask(mask, len(seeds))
            self._begins |= begins
            self.style.begin(begins, seeds)

    @torch.inference_mode()
    def act(self, observation: Observation) -> Chunk:
        """See `Policy.act`."""
        if self.expert is None:
            raise InputError("--policy expert: sees the world itself; run it in this process, with attach(env)")
        worlds, device = len(observation.state), self.sight.device
        asking = world_mask(observation.mask, worlds)
        mask = torch.from_numpy(asking).to(device)
        with self.sight.still():
            self._begin(asking & self._begins)
            self._decide(asking & (self._asked % DECISION == 0))
            self.generator.realign(self.sight.pose[:, 2], REALIGN * (mask & self._walking))
        self._asked[asking] += 1
        self.generator.step(self._commands, mask)
        return Chunk(self.generator.action()[:, None], phases=self._phases)

    def _begin(self, beginning: np.ndarray) -> None:
        """Start the episodes of the worlds that ask first."""
        if self.expert is None or not beginning.any():
            return
        begins, pose = torch.from_numpy(beginning).to(self.sight.device), self.sight.pose
        self.generator.reset(begins, root_xy=pose[:, :2], yaw=pose[:, 2])
        self.expert.begin(begins, self.style)
        self._begins &= ~beginning
        self._asked[beginning] = 0

    def _decide(self, deciding: np.ndarray) -> None:
        """Let the expert renew the commands of some worlds."""
        if self.expert is None or not deciding.any():
            return
        mask = torch.from_numpy(deciding).to(self.sight.device)
        command = self.expert.command(mask, DECISION * TICK)
        self._commands = torch.where(mask[:, None], command.pack(), self._commands)
        self._walking = (self._commands[:, COLUMNS["velocity"]] != 0).any(dim=1)
        phases = self.expert.phases()
        if phases is not None and self._phases is not None:
            # Of a world that does not decide now the expert may name the phase that its next decision begins.
            phases = [new if now else old for now, new, old in zip(deciding, phases, self._phases, strict=True)]
        self._phases = phases

    def describe(self) -> Json:
        """Name, the tasks that have an expert and the ticks between two decisions."""
        return {"name": self.name, "tasks": solved_tasks(), "decision_ticks": DECISION}
