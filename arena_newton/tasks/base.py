"""Tasks: one record holds everything that the project knows about a task.

Drawing is pure: an episode's draws depend on its seed, its mode and the rule set only.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from arena_newton.errors import InputError
from arena_newton.interfaces import Predicate
from arena_newton.rules import modes, seeding
from arena_newton.rules.rule_types import (
    ByRules,
    CylinderRange,
    FixedLight,
    LightRange,
    ObjectRule,
    PoseRange,
    Range,
    RuleSet,
    SuccessRule,
    TaskRules,
)

if TYPE_CHECKING:
    from arena_newton.physics.scene import Scene
    from arena_newton.tasks.interaction import Interaction
    from arena_newton.tasks.judge import Judge

__all__ = [
    "DISTANT_LIGHT",
    "GOAL_OBJECT",
    "KEY_OBJECT",
    "LIFT",
    "REACH",
    "ROOM",
    "SCENES",
    "SUCCESS",
    "TOUCH",
    "Draws",
    "Kind",
    "LightDraw",
    "ObjectSpec",
    "Overlap",
    "Pose",
    "Required",
    "TaskSpec",
    "widened",
]

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Sample = dict[str, float]
Kind = Literal[
    "body", "fixture", "target", "hinge", "latch", "marker", "collider", "camera", "light", "physics", "robot"
]
"""Kinds of prim that a scene may have to have; `usd_scenes.validate` tests them."""

IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)
FACE_PLUS_Y: Quat = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
FACE_MINUS_Y: Quat = (math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5))

EXECUTION_WIDENING = 1.45 / 1.2
"""Football's execution range over its base range (±1.45 m over ±1.2 m): a range grows by 21 %."""

DISTANT_LIGHT = FixedLight()
"""The distant light that two of the original's scenes carry in every mode."""

SAME_HEIGHT = 1e-5
"""Difference of heights [m] that single precision makes."""

SCENES = Path(__file__).resolve().parents[1] / "usd_scenes"
"""Folder of the project's own scenes."""

ROOM = ((-7.2, -6.5), (0.6, 5.2))
"""Lower and upper corner (x, y) [m] of the warehouse room, in which OpenDoor, SitSofa, Boxing and VisNavi happen."""

SUCCESS = Predicate("success", "the task's success condition holds")
"""Last predicate of a task that names no other."""

REACH = 0.8
"""Distance of the root [m] from which a thing can be touched without a step: 0.6 m of arm, and a lean or a bend."""
TOUCH = 0.08
"""Distance of a palm's frame [m] to a thing that it holds or presses: the hand radius of Boxing's rule."""
GOAL_OBJECT, KEY_OBJECT = 0.05, 0.15
"""Kinds of prims in `TaskSpec.recolour`, as films of looks name them (`pictures.changed_looks.Changes`)."""
LIFT = 0.10
"""Height [m] above its support from which a thing counts as lifted: more than tilting it on an edge gives."""


@dataclass(frozen=True)
class Pose:
    """A world pose."""

    pos: Vec3
    """[m]."""
    quat: Quat
    """wxyz."""


@dataclass(frozen=True)
class LightDraw:
    """One distant light."""

    direction: Vec3
    """Unit vector from the light to the scene."""
    intensity: float
    color: Vec3
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    angle_deg: float = 15.0
    """Angular size [deg]: how soft shadows are (original benchmark)."""


@dataclass(frozen=True)
class Draws:
    """Everything random about one episode."""

    sampled: dict[str, Sample]
    """Record name → the sample as configured: x, y, z [m], yaw [rad] (and what else the task draws)."""
    placed: dict[str, Pose]
    """Prim path → world pose of the prim's origin."""
    light: LightDraw | None
    """Distant light of the episode; None: the scene's dome."""

    @property
    def dynamics(self) -> Sample:
        """Values of `modes.QUANTITIES` that differ from the usual; empty in a mode that draws none."""
        return self.sampled.get(modes.DYNAMICS, {})


@dataclass(frozen=True)
class ObjectSpec:
    """One randomised object."""

    record: str
    """Name in the original's records."""
    prim: str
    """Prim path in the scene."""
    base: PoseRange | CylinderRange
    execution: PoseRange | CylinderRange
    """Execution range as the original configures it."""
    init: Vec3 = (0.0, 0.0, 0.0)
    """Initial position [m], to which `offset` and `scaled` placement add."""
    init_quat: Quat = IDENTITY
    spawn_scale: float = 1.0
    """Scale at which the original spawns the asset, which its `scaled` placement applies to the sample."""
    placement: ByRules[str] = field(default_factory=lambda: ByRules.same("absolute"))
    execution_void: bool = False
    """The original's execution range has no effect there (its placement scales it away)."""
    paper_execution: PoseRange | None = None
    """Execution range of `paper` where the common rule for widening does not work; None: the common rule."""
    lift: float = 0.0
    """Height of our prim's origin above the original's [m]."""
    rest_height: float | None = None
    """Height [m] of the origin above the lowest point of the object's geoms in our own scene; where a variant's geoms
    reach lower, the object starts that much higher. None: the height is the sample's alone."""

    surface: tuple[Callable[[Scene], float], float] | None = None
    """Height of the surface below it in a built scene, and in our own [m]: where a variant's surface is higher or
    lower, the object starts that much higher or lower. None: it stays at the sample's height."""

    def raised(self, scene: Scene) -> float:
        """Height that a scene's own geoms add to a sample [m]; 0 in our own scene."""
        added = 0.0
        if self.rest_height is not None:
            added += -scene.lowest(self.prim) - self.rest_height
        if self.surface is not None:
            height, own = self.surface
            added += height(scene) - own
        return added if abs(added) > SAME_HEIGHT else 0.0

    def rule(self, rules_name: str) -> ObjectRule:
        """Rule of this object in a rule set."""
        execution = self.execution
        if rules_name == "paper" and self.paper_execution is not None:
            execution = self.paper_execution
        elif rules_name == "paper" and isinstance(self.base, PoseRange) and isinstance(self.execution, PoseRange):
            execution = paper_execution(self.base, self.execution, self.execution_void)
        return ObjectRule(self.record, self.placement.of(rules_name), self.base, execution)


def widened(bounds: tuple[float, float]) -> tuple[float, float]:
    """A range about the same centre, wider by `EXECUTION_WIDENING`."""
    centre, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
    return centre - half * EXECUTION_WIDENING, centre + half * EXECUTION_WIDENING


def paper_execution(base: PoseRange, original: PoseRange, void: bool) -> PoseRange:
    """Execution range under `paper`: the original's where that widens the base range, else the base range widened.

    An axis that the original leaves alone stays as it is. One that it shifts, or changes without effect, grows about
    the base range by Football's factor.
    """

    def axis(wanted: Range | None, given: Range | None) -> Range | None:
        if given == wanted or given is None or wanted is None:
            return wanted
        contains = given[0] <= wanted[0] and given[1] >= wanted[1]
        return given if contains and not void else widened(wanted)

    return PoseRange(*(axis(getattr(base, k), getattr(original, k)) for k in ("x", "y", "z", "yaw")))  # type: ignore[arg-type]


def draw_uniform(rng: np.random.Generator | random.Random, bounds: tuple[float, float]) -> float:
    """One number; reversed bounds are harmless, equal bounds consume nothing."""
    low, high = min(bounds), max(bounds)
    return float(rng.uniform(low, high)) if high > low else low


def sample_pose(rng: np.random.Generator, ranges: PoseRange, order: tuple[str, ...]) -> Sample:
    """One sample; axes are drawn in the given order."""
    return {k: draw_uniform(rng, getattr(ranges, k)) for k in order if getattr(ranges, k) is not None}


def object_range(rule: ObjectRule, mode: str) -> PoseRange | CylinderRange:
    """The range that applies in a mode."""
    return modes.get(mode).range_of(rule)


def sample_objects(episode_seed: int, mode: str, rules: TaskRules) -> dict[str, Sample]:
    """Samples of every object, each from its own generator in the order yaw, x, y, z (original benchmark)."""
    master = seeding.object_seed(episode_seed)
    sampled = {}
    for rule in rules.objects:
        ranges = object_range(rule, mode)
        assert isinstance(ranges, PoseRange)
        sampled[rule.record] = sample_pose(seeding.object_rng(master, rule.record), ranges, ("yaw", "x", "y", "z"))
    return sampled


def yaw_quat(yaw: float) -> Quat:
    """Rotation about z."""
    return math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)


def multiply(a: Quat, b: Quat) -> Quat:
    """Quaternion product, wxyz."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def world_pose(spec: ObjectSpec, rule: ObjectRule, sample: Sample) -> Pose:
    """World pose of an object's prim for a sample."""
    p = [sample["x"], sample["y"], sample["z"]]
    if rule.placement != "absolute":
        scale = spec.spawn_scale if rule.placement == "scaled" else 1.0
        p = [o + scale * v for o, v in zip(spec.init, p, strict=True)]
    norm = math.sqrt(sum(v * v for v in spec.init_quat))
    init = tuple(v / norm for v in spec.init_quat)
    return Pose((p[0], p[1], p[2] + spec.lift), multiply(yaw_quat(sample.get("yaw", 0.0)), init))  # type: ignore[arg-type]


def light_direction(yaw_deg: float, pitch_deg: float, roll_deg: float) -> Vec3:
    """Direction of a light that shines along −z after rotateXYZ = (roll, pitch, yaw): first about x, then y, then z."""
    roll, pitch, yaw = (math.radians(v) for v in (roll_deg, pitch_deg, yaw_deg))
    x, y, z = -math.sin(pitch) * math.cos(roll), math.sin(roll), -math.cos(pitch) * math.cos(roll)
    return math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y, z


def draw_light(episode_seed: int, ranges: LightRange) -> LightDraw:
    """Visual mode's light; equal bounds consume no draw."""
    rng = seeding.light_rng(episode_seed)
    yaw, pitch, roll = (draw_uniform(rng, bounds) for bounds in (ranges.yaw_deg, ranges.pitch_deg, ranges.roll_deg))
    intensity = draw_uniform(rng, ranges.intensity)
    red, green, blue = (draw_uniform(rng, bounds) for bounds in ranges.color)
    return LightDraw(light_direction(yaw, pitch, roll), intensity, (red, green, blue), pitch, roll, yaw)


@dataclass(frozen=True)
class Overlap:
    """Two things that some episodes start more than 1 cm inside each other, as the original's ranges do.

    Nothing reads these but the documentation, and a test that measures them again.
    """

    first: str
    """Prim path."""
    second: str
    """Prim path."""
    rules: tuple[str, ...]
    """Names of the rule sets."""
    modes: tuple[str, ...]
    episodes: int
    """Number among the 60 episodes of each of these modes."""
    depth: float
    """The deepest of them [m]: the shortest shift that separates the two."""
    why: str
    """The original's ranges that meet here."""


@dataclass(frozen=True)
class Required:
    """A prim that a task's scene must have."""

    path: str
    kind: Kind
    """Required kind of prim, as docs/howto/bring/authoring.md describes them."""
    variants: tuple[str, ...] = ()
    """Variants of `semantics` that need it; empty: all of them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TaskSpec:
    """One task; everything that lists tasks or their parts reads it from here."""

    name: str
    gym_id: str
    """The original's id; it seeds episodes and is sent to remote policies, so its spelling matters."""
    instruction: str
    suite: str | None = None
    """Group of the paper's tables that averages it, `HOI` (human-object) or `HSI` (human-scene interaction); None: no
    group, as of every task that is not the paper's."""
    spawn_position: Vec3
    """Robot root at spawn [m]."""
    spawn_quat: Quat
    """Robot root at spawn, wxyz."""
    requires: tuple[Required, ...]
    """Prims that its scene must have, besides robot, camera, light and physics scene."""
    scene: Path | None = None
    """Layer of its scene; None: `usd_scenes/<name>/scene.usda` of the project."""
    objects: tuple[ObjectSpec, ...]
    steps: ByRules[int]
    """Step budget [50 Hz ticks]."""
    success: ByRules[SuccessRule]
    """The success condition's numbers and its sentence, one per rule set."""
    judge: Callable[[Scene, RuleSet], Judge]
    """Binds the success condition to a built scene; raises `InputError` where a prim or marker is missing."""
    predicates: tuple[Predicate, ...] = (SUCCESS,)
    """Steps on the way to success, in order; the last one is the success condition itself."""
    target: str = ""
    """Prim of what its instruction names and the robot must find; empty: not given, and visibility is not certified."""
    interaction: Interaction | None = None
    """Its first contact; None: it has no failure signals."""
    without_legs: str = ""
    """Reason for which a base that glides in place of legs may solve it; empty: legs are needed."""
    events: Mapping[int, str] = field(default_factory=dict)
    """The judge's event number → reason of the timeout that it causes."""
    expert: str | None = None
    """Class of its scripted expert as `module:attribute`; None: it has none."""
    disturbance: float = 1.0
    """Factor of `noise_levels.NoiseLevels` when its demonstrations are recorded.

    Measured, engine mujoco, tracker sonic, successes at 0, 0.35, 0.5 and 1: P&PBox 7/8, 6/8, 8/12, 2/12; DoubleDesk
    8/8, 8/8, 11/12, 6/12 (docs/howto/train/recording.md). Tasks that grasp take 0.5; Boxing takes 2, by
    which learners gained; the others bear it whole."""
    sample: Callable[[int, str, TaskRules], dict[str, Sample]] = sample_objects
    """Draws the samples: (episode seed, mode, rules) → record name → sample."""
    overlaps: tuple[Overlap, ...] = ()
    """Episodes that start with things inside each other."""
    semantic_variant: ByRules[str] = field(default_factory=lambda: ByRules.same("semantic"))
    semantic_change: Literal["texture", "shape", "clutter"] | None = None
    """Change that semantic mode of rule set `paper` makes: in textures and colours; in shapes that are drawn
    without a collider; or by things that are added. The compiled model is else that of base mode. None: not given."""
    light: ByRules[FixedLight | None] = field(default_factory=lambda: ByRules.same(None))
    """Distant light of the modes other than visual; None: the scene's dome."""
    recolour: Mapping[str, float] = field(default_factory=dict)
    """Prim → its kind in changed looks (docs/howto/train/recording.md): 0 where the instruction names its colour, which
    it keeps; `GOAL_OBJECT` where its form tells it apart; `KEY_OBJECT` where a hand must find it; else 1, as walls."""
    mode_notes: Mapping[str, ByRules[str]] = field(default_factory=dict)
    """Mode → what it changes in this task in particular, in words, where the rule sets differ."""

    def __post_init__(self) -> None:
        """Check the names of the objects.

        Raises:
            InputError: One has the name under which an episode's dynamics are recorded.
        """
        if any(one.record == modes.DYNAMICS for one in self.objects):
            raise InputError(f"task {self.name!r}: object {modes.DYNAMICS!r}: the name is taken, records need another")

    @property
    def layer(self) -> Path:
        """The layer of its scene, which may not be built yet."""
        return self.scene or SCENES / self.name / "scene.usda"

    @property
    def rules(self) -> ByRules[TaskRules]:
        """Rules of this task in each rule set."""
        return ByRules(*(self._rules(name) for name in ("paper", "released")))

    def _rules(self, rules_name: str) -> TaskRules:
        return TaskRules(
            task=self.name,
            max_steps=self.steps.of(rules_name),
            success=self.success.of(rules_name),
            objects=tuple(o.rule(rules_name) for o in self.objects),
            semantic_variant=self.semantic_variant.of(rules_name),
            light=self.light.of(rules_name),
        )

    def max_steps(self, rules: RuleSet) -> int:
        """Step budget [50 Hz ticks]."""
        return rules.task(self.name).max_steps

    def variant(self, mode: str, rules: RuleSet) -> str:
        """Variant of the scene's set `semantics`."""
        return rules.task(self.name).semantic_variant if modes.get(mode).scene == "semantic" else "base"

    def scene_name(self, mode: str, rules: RuleSet) -> str:
        """Name of the scene of a mode: modes of one name share it, and differ in placements and lights alone."""
        return mode if modes.get(mode).scene == "layer" else self.variant(mode, rules)

    def own_layer(self, mode: str) -> Path | None:
        """The layer that replaces the scene in this mode; None: the mode selects a `variant` of the scene.

        Raises:
            InputError: The task has no such layer.
        """
        if (own := modes.get(mode)).scene != "layer":
            return None
        path = own.layers / f"{self.name}.usda" if own.layers else self.layer.parent / "variants" / f"{mode}.usda"
        if not path.is_file():
            raise InputError(f"--mode {mode}: task {self.name} has no {path}")
        return path

    def drawn(self, seed: int, mode: str, rules: TaskRules) -> dict[str, Sample]:
        """Samples of the objects and, where the mode draws some, of the dynamics of the episode with this seed."""
        dynamics = modes.get(mode).draw(seed)
        return self.sample(seed, mode, rules) | ({modes.DYNAMICS: dynamics} if dynamics else {})

    def draw(self, seed: int, mode: str, rules: RuleSet, samples: Mapping[str, Sample] | None = None) -> Draws:
        """Everything random about the episode with this seed.

        Args:
            mode: One of `modes.names()`.
            rules: Rule set; it decides where a sample is put.
            samples: Record name → sample, instead of those that the seed draws.

        Raises:
            InputError: Unknown mode.
        """
        own, ranges = rules.task(self.name), modes.get(mode)
        sampled = self.drawn(seed, mode, own) if samples is None else dict(samples)
        placed = {o.prim: world_pose(o, own.object(o.record), sampled[o.record]) for o in self.objects}
        light = None
        if ranges.light is not None:
            light = draw_light(seed, ranges.light(rules))
        elif own.light is not None:
            light = LightDraw(light_direction(0.0, 0.0, 0.0), own.light.intensity, own.light.color)
        return Draws(sampled, placed, light)
