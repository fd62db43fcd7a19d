"""The judge of a task: binds prims of a built scene to a success kernel and to conditions of predicates.

A plan reads the task files too, and loads neither Warp nor MuJoCo: those are imported where a judge is built.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from arena_newton.errors import InputError
from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import PALMS
from arena_newton.tasks.base import IDENTITY, SUCCESS
from arena_newton.tasks.handles import BodyFrame, Marker

if TYPE_CHECKING:
    import warp as wp

    from arena_newton.kernels.boxes import Boxes
    from arena_newton.kernels.launching import Recorded
    from arena_newton.physics.engines import Physics
    from arena_newton.physics.scene import Scene
    from arena_newton.rules.rule_types import RuleSet

__all__ = ["Condition", "ConditionsJudge", "Judge", "above", "below", "bounding_box", "links", "near"]
__all__ += ["origin", "palms", "slow", "standing", "top"]

_ABOVE = 50.0
"""Half extent of the box that represents everything above or below a height [m]: larger than any scene."""


@dataclass(frozen=True)
class Condition:
    """One measured quantity against a limit; a predicate holds where all of its conditions do."""

    kind: Literal["near", "clear", "angle", "toward", "away", "unlatched", "margin", "slow", "upright"]
    """Measured quantity, described in `kernels.rules.predicates`."""
    limit: float = 0.0
    """Limit in the unit of the kind."""
    points: Sequence[BodyFrame] = ()
    boxes: Sequence[Marker] = ()
    horizontal: bool = False
    """Seen from above: heights do not count."""
    address: int = 0
    """Address in qpos or qvel, for kinds that read it."""


def near(points: Iterable[BodyFrame], box: Marker, limit: float, *, horizontal: bool = False) -> Condition:
    """One of some points is within `limit` [m] of a box."""
    return Condition("near", limit, tuple(points), (box,), horizontal)


def above(point: BodyFrame, height: float) -> Condition:
    """A point is higher than `height` [m]."""
    half = (_ABOVE, _ABOVE, _ABOVE)
    return Condition("near", 0.0, (point,), (Marker(0, (0.0, 0.0, height + _ABOVE), IDENTITY, half),))


def below(point: BodyFrame, height: float) -> Condition:
    """A point is lower than `height` [m], such as the top of a thing that was knocked over."""
    return near([point], Marker(0, (0.0, 0.0, height - _ABOVE), IDENTITY, (_ABOVE, _ABOVE, _ABOVE)), 0.0)


def slow(scene: Scene, prim: str, limit: float) -> Condition:
    """A free body's origin moves with at most `limit` [m/s]."""
    return Condition("slow", limit, address=scene.joint_qvel(prim))


def standing(scene: Scene, rules: RuleSet) -> tuple[Condition, ...]:
    """The robot stands, as a rule set says."""
    (pelvis,) = links(scene, "pelvis")
    return above(pelvis, rules.standing.min_root_z), Condition("upright", rules.standing.min_up, (pelvis,))


def origin(scene: Scene, prim: str) -> BodyFrame:
    """Origin of a rigid prim."""
    return BodyFrame(scene.body_id(prim), (0.0, 0.0, 0.0), IDENTITY)


def links(scene: Scene, *names: str) -> tuple[BodyFrame, ...]:
    """Origins of some robot links."""
    return tuple(BodyFrame(scene.link(name), (0.0, 0.0, 0.0), IDENTITY) for name in names)


def palms(scene: Scene) -> tuple[BodyFrame, ...]:
    """Both palms."""
    return tuple(scene.frame(name) for name in PALMS)


def bounding_box(scene: Scene, prim: str) -> Marker:
    """The box around all collision geometry of a rigid or static prim, along the axes of its body.

    Raises:
        InputError: The prim holds no collision geometry.
    """
    import mujoco

    model, body = scene.mj_model, scene.body_ids.get(prim, 0)
    corners = []
    for geom in scene.geom_ids(prim):
        if model.geom_bodyid[geom] != body or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        corners.append(model.geom_pos[geom] + (centre + signs * half) @ turn.reshape(3, 3).T)
    if not corners:
        raise InputError(f"{scene.path}: prim {prim} holds no collision geometry")
    points = np.concatenate(corners)
    low, high = points.min(axis=0), points.max(axis=0)
    return Marker(body, tuple(0.5 * (low + high)), IDENTITY, tuple(0.5 * (high - low)))


def top(scene: Scene, prim: str) -> float:
    """Height of the highest point of a static prim's collision geometry [m]."""
    box = bounding_box(scene, prim)
    return box.pos[2] + box.half[2]


class Judge:
    """Success of every world, judged on the device once per tick.

    A subclass binds prims of a built scene to a kernel of `kernels.rules.success` in `decide`.
    """

    def __init__(
        self,
        scene: Scene,
        predicates: Sequence[Predicate] = (SUCCESS,),
        conditions: Mapping[str, Sequence[Condition]] | None = None,
    ):
        """Allocate the outputs.

        Args:
            predicates: Those of the task; the last one is success.
            conditions: Conditions of every predicate but the last, by its name.

        Raises:
            InputError: Conditions and predicates do not match.
        """
        import warp as wp

        conditions = conditions or {}
        names = [predicate.name for predicate in predicates]
        if names[:-1] != list(conditions):
            raise InputError(f"predicates {', '.join(names)}: conditions are given for {', '.join(conditions)}")
        self.worlds = scene.worlds
        self.device = wp.get_device(scene.device)
        with wp.ScopedDevice(self.device):
            self.success = wp.zeros(self.worlds, dtype=wp.int32)
            """1 = success, shape [worlds]."""
            self.margin = wp.zeros(self.worlds, dtype=wp.float32)
            """Signed distance to success [m], at least 0 where the predicate holds at this instant, shape [worlds]."""
            self.event = wp.zeros(self.worlds, dtype=wp.int32)
            """0 nothing, otherwise one of `TaskSpec.events`, shape [worlds]."""
            self.predicates = wp.zeros((self.worlds, len(names)), dtype=wp.int32)
            """1 where a predicate of the task holds at this tick, shape [worlds, n]."""
        self.counters: list[wp.array] = [self.predicates[:, k] for k in range(len(names))]
        """int32 arrays [worlds] that a reset clears."""
        self._conditions = self.table(*conditions.values())
        self._recorded: Recorded | None = None
        self._physics: Physics | None = None

    def table(self, *predicates: Sequence[Condition]) -> dict[str, wp.array]:
        """Conditions of some predicates on the device, as arguments of `kernels.rules.predicates`."""
        import warp as wp

        from arena_newton.kernels.rules.predicates import KINDS, TERM

        points: list[BodyFrame] = []
        boxes: list[Marker] = []
        rows = []
        for condition in itertools.chain.from_iterable(predicates):
            ranges = (len(points), len(points) + len(condition.points), len(boxes), len(boxes) + len(condition.boxes))
            rows.append((KINDS[condition.kind], int(condition.horizontal), condition.address, *ranges))
            points += condition.points
            boxes += condition.boxes
        limits = [condition.limit for condition in itertools.chain.from_iterable(predicates)]
        first = np.cumsum([0, *(len(conditions) for conditions in predicates)])

        def up(values: object, dtype: type) -> wp.array:
            return wp.array(values, dtype=dtype, device=self.device)

        bodies, positions = self.points(*points)
        return {
            "first": up(first, wp.int32),
            "terms": up(np.array(rows, dtype=np.int32).reshape(-1, len(TERM)), wp.int32),
            "limits": up(limits, wp.float32),
            "point_body": bodies,
            "point_pos": positions,
            "boxes": self.boxes(*boxes),
        }

    def boxes(self, *markers: Marker) -> Boxes:
        """Boxes on the device, for kernels."""
        from arena_newton.kernels.boxes import upload_boxes

        return upload_boxes(markers, self.device)

    def points(self, *points: BodyFrame) -> tuple[wp.array, wp.array]:
        """Bodies that carry some points, int32, and the points in their frames [m], vec3; both of shape [points]."""
        import warp as wp

        bodies = wp.array([point.body_id for point in points], dtype=wp.int32, device=self.device)
        return bodies, wp.array([wp.vec3(*point.pos) for point in points], dtype=wp.vec3, device=self.device)

    def counter(self) -> wp.array:
        """A new counter of ticks, cleared at reset, int32, shape [worlds]."""
        import warp as wp

        self.counters.append(wp.zeros(self.worlds, dtype=wp.int32, device=self.device))
        return self.counters[-1]

    def outputs(self) -> dict[str, wp.array]:
        """Keyword arguments that every kernel of `kernels.rules.success` takes."""
        return {"success": self.success, "margin": self.margin}

    def bind(self, physics: Physics) -> None:
        """Tell the physics what it must measure; called once before the first tick."""

    def decide(self, physics: Physics) -> None:
        """Launch what fills `success`, `margin` and `event` for the state after this tick.

        A subclass says how. It is called once per physics, recorded and repeated every tick: the same kernels with the
        same arrays and numbers.
        """
        raise NotImplementedError

    def evaluate(self, physics: Physics) -> None:
        """Fill `success`, `margin`, `event` and `predicates` for the state after this tick."""
        if self._recorded is None or self._physics is not physics:
            from arena_newton.kernels.launching import record

            self._recorded, self._physics = record(self._launch, physics), physics
        self._recorded()

    def _launch(self, physics: Physics) -> None:
        from arena_newton.kernels.rules.predicates import launch_predicates

        self.decide(physics)
        launch_predicates(
            physics.xpos,
            physics.xquat,
            physics.qpos,
            physics.qvel,
            physics.latch_locked,
            self.success,
            self.margin,
            **self._conditions,
            predicates=self.predicates,
        )

    def reset(self, mask: wp.array) -> None:
        """Forget the past of some worlds.

        Args:
            mask: 1 = reset, int32, shape [worlds].
        """
        from arena_newton.kernels.reset import launch_clear

        for array in (*self.counters, self.success, self.event):
            launch_clear(mask, array)


class ConditionsJudge(Judge):
    """Success where all of some conditions hold, for some ticks in a row: a task that needs no kernel of its own.

    The margin is the smallest slack of the conditions, in metres, metres per second and cosines alike: at least 0 where
    all hold at this instant.
    """

    def __init__(
        self,
        scene: Scene,
        predicates: Sequence[Predicate],
        conditions: Mapping[str, Sequence[Condition]],
        success: Sequence[Condition],
        ticks: int = 1,
    ):
        """Bind conditions to the scene.

        Args:
            predicates: As of `Judge`.
            conditions: As of `Judge`.
            success: Conditions of success.
            ticks: Ticks in a row for which all of them must hold.

        Raises:
            InputError: No condition of success, one that is itself made of success, or no tick.
        """
        if not success or any(condition.kind == "margin" for condition in success):
            raise InputError(f"{scene.path}: success needs conditions, and none of the kind margin, which it gives")
        if ticks < 1:
            raise InputError(f"{scene.path}: success for {ticks} ticks, expected at least 1")
        super().__init__(scene, predicates, conditions)
        self._success, self._ticks, self._held = self.table(success), ticks, self.counter()
        del self._success["first"]  # one conjunction

    def decide(self, physics: Physics) -> None:
        """See `Judge.decide`."""
        from arena_newton.kernels.rules.success_conditions import launch_conditions

        launch_conditions(
            physics.xpos,
            physics.xquat,
            physics.qpos,
            physics.qvel,
            physics.latch_locked,
            **self._success,
            ticks=self._ticks,
            counter=self._held,
            **self.outputs(),
        )
