"""Experts, worlds and trackers that fail at a known stage: what the rules of `failure_rules` are held against.

A saboteur changes one thing that an expert believes, does or is executed by, and nothing of how episodes are judged.
What differs between two of its episodes is drawn from the episode seed.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from arena_newton import tasks
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.certification.stand_ins.bodies import Body, WithOtherLegs
from arena_newton.eval.certification.stand_ins.handling import HANDLING
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.interaction_view import InteractionView
from arena_newton.interfaces import Chunk, Observation, World
from arena_newton.physics.mujoco_engine import MujocoPhysics
from arena_newton.policies.base import Mask
from arena_newton.policies.experts import ExpertPolicy, Sight
from arena_newton.policies.experts.base import Expert
from arena_newton.policies.experts.style import Style
from arena_newton.robot.canonical import ACTION
from arena_newton.robot.g1 import CANONICAL_JOINTS, PALMS
from arena_newton.robot.rotations import atan2, matrix_from_quat, quat_from_euler, quat_from_rot6d
from arena_newton.tasks.football import GOAL
from arena_newton.trackers.base import Tracker
from arena_newton.trackers.motions.commands import MotionCommand

__all__ = ["HALTS", "PERCHED", "SABOTAGES", "MisledExpert", "MisledSight", "RelocatingEnv", "Sabotage", "WeakTracker"]

UNSEEN = (0.0, 0.0, 30.0)
"""Displacement of an object that nobody can see: in the sky, where no camera looks [m]."""
ELSEWHERE = (2.4, 3.2)
"""Distance of the place where a blind robot believes the object, drawn between these [m]; a seat farther off, for its
robots stand 0.9 m nearer to it than to the place, and who stops within two metres of the seat has come for it ..."""
FARTHER = (3.0, 3.4)
TOWARDS: Mapping[str, tuple[float, float]] = {"": (150, 190), "football": (-20, 20), "sit_sofa": (90, 150)}
"""... and its direction from the object, drawn between these [degrees from the x-axis]: where there is free floor."""
SHORT = (0.55, 0.80)
"""Distance that a robot that aims badly stops short of where it wants to stop, drawn between these [m] ..."""
ASIDE = math.radians(35)
"""... and how far to either side of the straight way that is at most [rad]."""
CLOSE = 1.6
"""Distance to the object at which what goes wrong on the approach begins [m]."""
KNEES = tuple(ACTION["joint_pos"].start + CANONICAL_JOINTS.index(f"{side}_knee_joint") for side in ("left", "right"))
"""Columns of the action that bend the knees, left and right."""
LEAN = math.radians(80)
"""Lean of the reference of a robot that loses its balance [rad]; trackers stay on their feet up to about 60 degrees."""
BENT = 2.2
"""Knee of the leg that it takes off the floor for that where hands are needed [rad]; its foot goes up behind it."""
GROWS = 40
"""Ticks in which what goes wrong on the approach grows to its size."""
OFF_CENTRE = (0.18, 0.22)
"""Height by which a fist misses its target, drawn between these [m]: it is still on the bag."""
AWAY = 1.5
"""Distance that an object is moved by when it is touched first [m]."""
BEFORE_BALL = (1.05, 1.30)
"""Distances before the ball at which a robot that aims badly kicks the air, one drawn per episode [m]: it comes to a
stand up to 0.6 m past the position where it believes the ball."""
BESIDE_GOAL = (4.5, 5.5)
"""Distances to a side of the goal's middle at which a robot that kicks badly believes it, one drawn per episode [m]:
the posts are at 2.5 m, and it aims up to 0.8 m inwards."""
BESIDE_SEAT = (0.90, 1.20)
"""Distances beyond its position on the sofa at which a robot that aims badly turns its back, one drawn per episode [m]:
next to the armrest, which begins 0.5 m beyond that position."""
HALTS = (0.36, 0.30)
"""Distance to a ball at which a robot that does not kick halts, and over how many before that it slows down [m]."""
SLOWEST = 0.25
"""Fraction of its speed that is left when it halts."""
PERCHED = (0.63, 0.66)
"""Height at which a pelvis stays that comes down on the seat without weight, drawn between these [m] ..."""
PERCHED_BACK = 0.18
"""... and how far it goes back for that at most [m]."""
PERCHES = 60
"""Ticks after the first touch at which a robot that sat down badly falls over."""


class MisledSight(Sight):
    """A view of the world in which robot, hands or object are not where they are."""

    def __init__(self, env: World):
        """Nothing is displaced yet."""
        super().__init__(env)
        self.view = InteractionView(env)
        worlds = env.worlds
        self.robot_off, self.hands_off, self.object_off, self.goal_off = (
            torch.zeros(worlds, 3, device=self.device) for _ in range(4)
        )
        """Errors of the believed positions of robot, hands, object and goal [m], shape [worlds, 3]."""
        self._robot = frozenset(int(body) for body in env.scene.robot.bodies)
        self._object = _bodies_of(env, self.view.box.body_id)

    @property
    def pose(self) -> Tensor:
        """See `Sight.pose`."""
        return super().pose + torch.nn.functional.pad(self.robot_off[:, :2], (0, 1))

    @property
    def root_position(self) -> Tensor:
        """See `Sight.root_position`."""
        return super().root_position + self.robot_off

    def body(self, body: int) -> tuple[Tensor, Tensor]:
        """See `Sight.body`."""
        position, quat = super().body(body)
        if body in self._robot:
            position = position + self.robot_off
        return position + self.object_off if body in self._object else position, quat

    def frame(self, name: str) -> Callable[[], Tensor]:
        """See `Sight.frame`."""
        read = super().frame(name)
        if name == GOAL:
            return lambda: read() + self.goal_off
        return (lambda: read() + self.hands_off) if name in PALMS else read

    def com(self, prim: str) -> Callable[[], Tensor]:
        """See `Sight.com`."""
        read = super().com(prim)
        return (lambda: read() + self.object_off) if self.scene.body_id(prim) in self._object else read


def _bodies_of(env: World, body: int) -> frozenset[int]:
    """The bodies that are where an object is: those of the whole tree that hangs on the object's root."""
    roots = env.scene.mj_model.body_rootid
    return frozenset(int(number) for number in np.flatnonzero(roots == roots[body])) if body else frozenset({0})


class _Overruled(Expert):
    """An expert whose commands are changed."""

    def __init__(self, inner: Expert, change: Callable[[MotionCommand], MotionCommand]):
        super().__init__(inner.sight)
        self._inner, self._change = inner, change

    def begin(self, mask: Tensor, style: Style) -> None:
        self._inner.begin(mask, style)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        return self._change(self._inner.command(mask, dt))

    def phases(self) -> list[str] | None:
        return self._inner.phases()


class MisledExpert(ExpertPolicy):
    """The expert under a `MisledSight`; a subclass says what it is misled about."""

    sight: MisledSight

    def __init__(self) -> None:
        """Know no environment yet."""
        super().__init__(MisledSight)
        self.name = "expert"

    def attach(self, env: World) -> None:
        """See `Policy.attach`."""
        super().attach(env)
        self.env, self.handling = env, HANDLING.get(env.spec.name)
        assert self.expert is not None
        self.expert = _Overruled(self.expert, self.overrule)
        self.since = torch.full((env.worlds,), -1.0, device=env.torch_device)
        """Ticks since the robot came close to the object, shape [worlds]; -1 before."""
        self.touched = torch.zeros(env.worlds, dtype=torch.bool, device=env.torch_device)
        """The object was touched in this episode, shape [worlds]."""
        self.after = torch.zeros(env.worlds, device=env.torch_device)
        """Ticks since then, shape [worlds]; 0 before."""

    @torch.inference_mode()  # a world's next episode clears what `act` made
    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """See `Policy.reset`."""
        super().reset(seeds, tasks, mask)
        begins = self._begins_now(mask, len(seeds))
        for off in (self.sight.robot_off, self.sight.hands_off, self.sight.object_off, self.sight.goal_off):
            off[begins] = 0.0
        self.since[begins], self.touched[begins], self.after[begins] = -1.0, False, 0.0

    def _begins_now(self, mask: Mask, worlds: int) -> Tensor:
        every = np.ones(worlds, dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
        return torch.from_numpy(every).to(self.sight.device)

    @torch.inference_mode()
    def act(self, observation: Observation) -> Chunk:
        """See `Policy.act`."""
        view = self.sight.view
        asking = torch.from_numpy(np.asarray(observation.mask)).to(self.sight.device)
        counts = asking & ((view.distance < CLOSE) | (self.since >= 0))
        self.since = torch.where(counts, self.since + 1.0, self.since)
        self.touched |= asking & (view.reach <= view.spec.touch)
        self.after = self.after + (asking & self.touched)
        self.mislead()
        chunk = super().act(observation)
        return Chunk(self.spoil(chunk.actions), chunk.errors, chunk.phases)

    def mislead(self) -> None:
        """Displace what is believed, from the truth of this tick."""

    def overrule(self, command: MotionCommand) -> MotionCommand:
        """Command in place of the expert's command."""
        return command

    def spoil(self, actions: Tensor | np.ndarray) -> Tensor | np.ndarray:
        """Actions in place of the expert's actions, shape [worlds, n, 40]."""
        return actions


def _level(length: Tensor, turn: Tensor) -> Tensor:
    """Displacements of some lengths [m] in some directions [rad], both [worlds], over the floor; [worlds, 3]."""
    return torch.stack([length * torch.cos(turn), length * torch.sin(turn), torch.zeros_like(length)], dim=1)


def _upright(command: MotionCommand) -> MotionCommand:
    """The same without sitting down: where there is no seat, a robot that sits down falls."""
    neutral = MotionCommand.neutral(len(command.height), command.height.device)
    return dataclasses.replace(
        command, height=neutral.height, pelvis_back=neutral.pelvis_back, pitch=neutral.pitch, waist=neutral.waist
    )


def _leaning(actions: Tensor | np.ndarray, lean: Tensor, side: Tensor) -> Tensor:
    """Actions whose root leans over by an angle, forward and to a side [rad], both shape [worlds]."""
    spoilt = torch.as_tensor(actions).clone()
    turn = torch.stack([lean * torch.sin(side), lean * torch.cos(side), torch.zeros_like(lean)], dim=1)
    own = matrix_from_quat(quat_from_rot6d(spoilt[:, 0, ACTION["root_rot6d"]]))
    leaning = own @ matrix_from_quat(quat_from_euler(turn))
    spoilt[:, :, ACTION["root_rot6d"]] = leaning[:, :, :2].reshape(-1, 1, 6)
    return spoilt


class BlindExpert(MisledExpert):
    """Knows nothing of the object: in every other episode it believes it elsewhere, in the others nowhere."""

    def mislead(self) -> None:
        """See `MisledExpert.mislead`."""
        if self.handling:
            self.sight.object_off = self.handling.elsewhere(self.style, ELSEWHERE)
            return
        least, most = TOWARDS.get(self.env.spec.name, TOWARDS[""])
        turn = self.style.uniform("to", math.radians(least), math.radians(most))
        if self.env.spec.name == "football":  # on the other half of the pitch
            turn = torch.where(self.sight.view.centre[:, 0] > 0.0, math.pi - turn, turn)
        far = FARTHER if self.sight.view.spec.behind else ELSEWHERE
        self.sight.object_off = self._elsewhere(_level(self.style.uniform("far", *far), turn))

    def overrule(self, command: MotionCommand) -> MotionCommand:
        """See `MisledExpert.overrule`."""
        return _upright(command) if self.sight.view.spec.behind else command

    def _elsewhere(self, aside: Tensor) -> Tensor:
        if self.env.spec.name != "boxing":
            return aside
        # The other bag, or none.
        bags = [self.env.scene.frame(f"/World/Bag_{number}").pos for number in (1, 2)]
        mine = (self.sight.view.centre[:, 0] > 0.5 * (bags[0][0] + bags[1][0])) == (bags[0][0] > bags[1][0])
        way = torch.tensor(bags[1], device=self.sight.device) - torch.tensor(bags[0], device=self.sight.device)
        other = torch.where(mine[:, None], way, -way).float()
        nowhere = torch.tensor(UNSEEN, device=self.sight.device).expand_as(other)
        return torch.where(self.style.coin("nowhere")[:, None], nowhere, other)


class MisaimedExpert(MisledExpert):
    """Stops short of where the object can be touched: it believes itself nearer to it, or a place nearer to itself."""

    def mislead(self) -> None:
        """See `MisledExpert.mislead`."""
        view, short = self.sight.view, self.handling.short if self.handling else SHORT
        far, aside = self.style.uniform("short", *short), self.style.uniform("to", -ASIDE, ASIDE)
        if self.env.spec.name == "football":
            self.sight.object_off = _level(self.style.uniform("short", *BEFORE_BALL), aside - 0.5 * math.pi)
            return
        if self.sight.view.spec.behind:
            self.sight.object_off = _level(self.style.uniform("short", *BESIDE_SEAT), torch.zeros_like(far))
            return
        if view.spec.level:  # a place is missed as a whole, on the side from which the robot comes
            self.sight.object_off = _level(far + 1.6 * view.box.half[0], aside - 0.5 * math.pi)
            return
        way = view.centre - view.root[:, :3]
        grown = (self.since / GROWS).clamp(0.0, 1.0)
        self.sight.robot_off = _level(grown * far, atan2(way[:, 1], way[:, 0]) + aside)

    def overrule(self, command: MotionCommand) -> MotionCommand:
        """See `MisledExpert.overrule`."""
        return _upright(command) if self.sight.view.spec.behind else command


class UnbalancedExpert(MisledExpert):
    """Leans over more and more once it is close, until it falls.

    Before door, table and desk it leans backwards, for these would hold it, and takes one foot off the floor: SONIC
    stays up on two, whichever way its reference leans.
    """

    def spoil(self, actions: Tensor | np.ndarray) -> Tensor | np.ndarray:
        """See `MisledExpert.spoil`."""
        grown = (self.since / GROWS).clamp(0.0, 1.0) * ~self.touched
        side = self.style.uniform("side", -1.0, 1.0)
        if not self.handling:
            return _leaning(actions, LEAN * grown, side)
        spoilt = _leaning(actions, LEAN * grown, side + math.pi)
        lifted = torch.stack([side > 0.0, side <= 0.0], dim=1) * grown[:, None]
        for column, part in zip(KNEES, lifted.unbind(dim=1), strict=True):
            knee = spoilt[:, :, column]
            spoilt[:, :, column] = knee + part[:, None] * (BENT - knee)
        return spoilt


class ReluctantExpert(MisledExpert):
    """Stands where it could touch the object, and does not: before a seat upright, behind a ball still."""

    def attach(self, env: World) -> None:
        """See `Policy.attach`."""
        super().attach(env)
        self.halted = torch.zeros(env.worlds, dtype=torch.bool, device=env.torch_device)
        """It stopped behind the ball, shape [worlds]."""

    @torch.inference_mode()
    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """See `Policy.reset`."""
        super().reset(seeds, tasks, mask)
        self.halted[self._begins_now(mask, len(seeds))] = False

    def overrule(self, command: MotionCommand) -> MotionCommand:
        """See `MisledExpert.overrule`."""
        if self.sight.view.spec.behind:
            return _upright(command)
        view, (halt, course) = self.sight.view, (self.handling.halts, HALTS[1]) if self.handling else HALTS
        before = view.bearing <= view.spec.bearing
        self.halted |= (view.distance < halt) & before
        slower = torch.where(before, ((view.distance - halt) / course).clamp(SLOWEST, 1.0), 1.0)
        still = MotionCommand.neutral(len(self.halted), self.halted.device)
        command = dataclasses.replace(command, velocity=command.velocity * slower[:, None])
        if self.handling:  # hands that are raised already would touch it on their way down
            command = dataclasses.replace(command, reach=still.reach, arms=still.arms, hand_point=still.hand_point)
        return MotionCommand.unpack(torch.where(self.halted[:, None], still.pack(), command.pack()))


class ClumsyExpert(MisledExpert):
    """Touches without effect.

    Its fist lands above or below the target, its kick sends the ball beside the goal, and it comes down on a seat
    without weight.
    """

    def mislead(self) -> None:
        """See `MisledExpert.mislead`."""
        if self.env.spec.name == "football":
            far = self.style.uniform("beside", *BESIDE_GOAL)
            side = torch.where(self.style.coin("left"), math.pi, 0.0)
            self.sight.goal_off = _level(far, side.expand_as(far))
        if self.env.spec.name != "boxing":
            return
        size = self.style.uniform("off", *OFF_CENTRE)
        side = torch.where(self.style.coin("above"), 1.0, -1.0)
        zero = torch.zeros_like(size)
        self.sight.object_off = torch.stack([zero, zero, side * size], dim=1)

    def overrule(self, command: MotionCommand) -> MotionCommand:
        """See `MisledExpert.overrule`."""
        if self.handling:
            return self.handling.let_go(command, self.style, self.after)
        return self._perched(command) if self.sight.view.spec.behind else command

    def _perched(self, command: MotionCommand) -> MotionCommand:
        height = torch.maximum(command.height, self.style.uniform("perched", *PERCHED))
        return dataclasses.replace(command, height=height, pelvis_back=command.pelvis_back.clamp_max(PERCHED_BACK))


class StubbornExpert(ClumsyExpert):
    """Believes the object where it was when the episode began, in a world that moves it when it is touched.

    A seat cannot be moved: from that it falls after it came down on it without weight.
    """

    env: RelocatingEnv
    left_at: Tensor | None = None
    """Positions of a free object when it was moved [m], shape [worlds, 3]."""

    def mislead(self) -> None:
        """See `MisledExpert.mislead`."""
        if self.handling and self.env.free:  # it falls where it was put
            kept, there = self.env.relocated.any(dim=1)[:, None], self.sight.view.centre
            self.left_at = there.clone() if self.left_at is None else torch.where(kept, self.left_at, there)
            self.sight.object_off = self.left_at - there
            return
        self.sight.object_off = -self.env.relocated

    def overrule(self, command: MotionCommand) -> MotionCommand:
        """See `MisledExpert.overrule`."""
        return command if self.handling else super().overrule(command)

    def spoil(self, actions: Tensor | np.ndarray) -> Tensor | np.ndarray:
        """See `MisledExpert.spoil`."""
        if self.env.movable:
            return actions
        lean = LEAN * ((self.after - PERCHES) / GROWS).clamp(0.0, 1.0)
        return _leaning(actions, lean, self.style.uniform("side", -1.0, 1.0))


class RelocatingEnv(ArenaEnv):
    """Moves the object away at its first touch; engine `mujoco` alone."""

    shown = ("relocated", "movable", "free")

    @functools.cached_property
    def view(self) -> InteractionView:
        """View that measures the robot's position."""
        return InteractionView(self)

    @functools.cached_property
    def relocated(self) -> Tensor:
        """Displacement of the object [m], shape [worlds, 3]."""
        if not isinstance(self.physics, MujocoPhysics):
            raise InputError("--checks failures: an object is moved on engine mujoco alone; choose --engine mujoco")
        return torch.zeros(self.worlds, 3, device=self.torch_device)

    @property
    def movable(self) -> bool:
        """True if the object can be moved: a part of the room cannot."""
        return self.view.box.body_id != 0

    @functools.cached_property
    def root(self) -> int:
        """The body that carries the object with all that hangs on it."""
        return int(self.scene.mj_model.body_rootid[self.view.box.body_id])

    @functools.cached_property
    def free(self) -> bool:
        """True if the object is a free body."""
        return int(self.scene.mj_model.body_mocapid[self.root]) < 0

    def reset(self, seeds: Sequence[int], worlds: Sequence[int] | np.ndarray | None = None, **more: object) -> None:
        """See `ArenaEnv.reset`."""
        super().reset(seeds, worlds, **cast("dict[str, Any]", more))
        self.relocated[slice(None) if worlds is None else list(worlds)] = 0.0

    def step(self, action: torch.Tensor | np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """See `ArenaEnv.step`."""
        status = super().step(action, worlds)
        if not self.movable:
            return status
        moved = self.relocated.abs().sum(dim=1) > 0
        touched = (self.view.reach <= self.view.spec.touch) & ~moved
        for world in np.flatnonzero(touched.cpu().numpy() & self.active & (self.tick > 0)).tolist():
            self._relocate(world)
        return status

    def _relocate(self, world: int) -> None:
        way = np.array([-AWAY, 0.0, 0.0])
        assert isinstance(self.physics, MujocoPhysics)
        model, data = self.scene.mj_model, self.physics.data[world]
        if self.free:  # it lies still where it is put
            joint = int(model.body_jntadr[self.root])
            place, speed = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            data.qpos[place : place + 3] += way
            data.qvel[speed : speed + 6] = 0.0
        else:
            data.mocap_pos[int(model.body_mocapid[self.root])] += way
        self.relocated[world] = torch.from_numpy(way).float()


class WeakTracker(WithOtherLegs):
    """A tracker whose legs do only a part of what its network says."""

    def __init__(self, inner: Tracker, part: float):
        """Take a tracker that is bound to no worlds yet, and the part of each leg's excursion that is executed."""
        super().__init__(inner)
        self.part = part

    def legs(self, asked: torch.Tensor) -> torch.Tensor:
        """See `WithOtherLegs.legs`."""
        return self.standing + self.part * (asked - self.standing)

    def describe(self) -> dict[str, object]:
        """See `Tracker.describe`."""
        return self.inner.describe() | {"legs": f"{self.part:g} of the network's excursions"}


PART = 0.5
"""Part of the legs' excursions that a weakened tracker executes."""


@dataclasses.dataclass(frozen=True)
class Sabotage:
    """A scripted failure."""

    stage: FailureStage
    """The stage at which it fails."""
    body: Body
    """Body that plays the tasks."""
    without: tuple[str, ...] = ()
    """Tasks in which there is no such failure."""

    def fits(self, task: str) -> bool:
        """True if there is such a failure in a task: a touch that is all that is wanted has no effect to miss."""
        touch = tasks.get(task).interaction
        reached = touch is not None and touch.reached_only and self.stage is FailureStage.CONTACT
        return task not in self.without and not reached


def _expert(expert: type[MisledExpert], env: type[ArenaEnv] | None = None) -> Callable[[Factories], Factories]:
    def equip(factories: Factories) -> Factories:
        return dataclasses.replace(factories, env=env or factories.env, policy=lambda spec, **options: expert())

    return equip


def _weak(factories: Factories) -> Factories:
    def tracker(spec: str, checkpoint: Path | None) -> Tracker:
        return WeakTracker(factories.tracker(spec, checkpoint), PART)

    def env(task: str, *, tracker: Tracker, **options: object) -> World:
        if task in HANDLING and isinstance(tracker, WeakTracker):
            tracker.part = HANDLING[task].weak
        return factories.env(task, tracker=tracker, **options)

    return dataclasses.replace(factories, tracker=tracker, env=env)


_MADE = (
    (FailureStage.PERCEPTION, "blinded", "expert that does not see the object", _expert(BlindExpert)),
    (FailureStage.APPROACH, "misaimed", "expert that stops beside its place", _expert(MisaimedExpert)),
    (FailureStage.POSTURE, "unbalanced", "expert that leans until it falls", _expert(UnbalancedExpert)),
    (FailureStage.CONTACT, "clumsy", "expert that touches without effect", _expert(ClumsyExpert)),
    (FailureStage.RECOVERY, "stubborn", "object that moves away unnoticed", _expert(StubbornExpert, RelocatingEnv)),
    (FailureStage.TRACKING, "weakened", "tracker with weak legs", _weak),
)
SABOTAGES: dict[str, Sabotage] = {
    name: Sabotage(stage, Body(name, title, equip)) for stage, name, title, equip in _MADE
}
SABOTAGES |= {
    "reluctant": Sabotage(
        FailureStage.POSTURE,
        Body("reluctant", "expert that stands before the object", _expert(ReluctantExpert)),
        ("boxing", "vis_navi", "double_desk"),
    )
}
"""Scripted failures by name."""
