"""Rule sets: what counts as success and as a fall, how long an episode lasts, where objects are put.

`paper` is what the benchmark's paper says, made precise where it is silent; `released` is what its released code does.
A rule set is frozen, printable and hashed; its hash is stored with every result. The numbers that belong to one task stand
in that task's file, the common ones here.
"""

import dataclasses
import functools
import hashlib
import json
from dataclasses import dataclass
from typing import Any

from arena_newton.errors import InputError
from arena_newton.robot import PhysicsRate

__all__ = [
    "CylinderRange",
    "FallRule",
    "FixedLight",
    "LightRange",
    "ObjectRule",
    "PoseRange",
    "RuleSet",
    "StandingRule",
    "TaskRules",
    "get",
    "names",
]

Range = tuple[float, float]

MODES = ("base", "execution", "semantic", "visual")
"""Test modes of the benchmark."""


@dataclass(frozen=True)
class PoseRange:
    """Ranges of an object's sampled pose; equal bounds mean a constant that consumes no draw."""

    x: Range
    """[m]."""
    y: Range
    """[m]."""
    z: Range
    """[m]."""
    yaw: Range | None = None
    """[rad]; None: the object keeps its initial orientation."""


@dataclass(frozen=True)
class CylinderRange:
    """A point on the surface of one of several upright cylinders."""

    centers: tuple[tuple[float, float], ...]
    """Axes [m], world x and y."""
    radius: float
    """[m]."""
    azimuth: Range
    """[rad]."""
    z: Range
    """[m]."""


@dataclass(frozen=True)
class ObjectRule:
    """Where one randomised object may stand and how its sample becomes a world pose."""

    record: str
    """Name in the original's records, which seeds the object's generator."""
    placement: str
    """`absolute`: the sample is the world pose. `offset`: initial position + sample. `scaled`: initial position +
    spawn scale × sample."""
    base: PoseRange | CylinderRange
    execution: PoseRange | CylinderRange


@dataclass(frozen=True)
class FixedLight:
    """A distant light that shines straight down, the same in every episode."""

    intensity: float = 5000.0
    color: tuple[float, float, float] = (0.75, 0.75, 0.75)


@dataclass(frozen=True)
class LightRange:
    """Visual mode's distant light. Drawn in the order yaw, pitch, roll, intensity, r, g, b."""

    yaw_deg: Range = (0.0, 0.0)
    pitch_deg: Range = (-20.0, 20.0)
    roll_deg: Range = (-20.0, 20.0)
    intensity: Range = (3000.0, 7000.0)
    color: tuple[Range, Range, Range] = ((0.65, 0.85), (0.65, 0.85), (0.65, 0.85))


@dataclass(frozen=True)
class TaskRules:
    """Everything that one rule set says about one task."""

    task: str
    max_steps: int
    """Step budget [50 Hz ticks]."""
    success: Any
    """The task's own frozen dataclass with the numbers of its predicate."""
    objects: tuple[ObjectRule, ...]
    semantic_variant: str = "semantic"
    """USD variant of semantic mode."""
    light: FixedLight | None = None
    """Light of base, execution and semantic mode; None: the scene's dome."""

    def object(self, record: str) -> ObjectRule:
        """Rule of one object by its record name."""
        return next(o for o in self.objects if o.record == record)


@dataclass(frozen=True)
class FallRule:
    """A *severe* tick: tilt above the hard angle, or above the soft one with a pressed critical body."""

    at_once: bool
    """True: a severe tick is a fall at once, soft tilt alone after `confirm_ticks` in a row.
    False: `confirm_ticks` severe ticks in a row are a fall, soft tilt alone never counts."""
    soft_tilt_deg: float = 60.0
    hard_tilt_deg: float = 75.0
    force_threshold: float = 50.0
    """Net contact force on a critical body that counts [N]."""
    confirm_ticks: int = 5


@dataclass(frozen=True)
class StandingRule:
    """What the predicates of OpenDoor and VisNavi call standing."""

    min_root_z: float = 0.45
    """[m]."""
    min_up: float = 0.60
    """Cosine of the tilt."""


@dataclass(frozen=True)
class RuleSet:
    """One frozen set of rules for all tasks."""

    name: str
    fall: FallRule
    tasks: tuple[TaskRules, ...]
    navi_visual_room_swap: bool
    """The original's released VisNavi visual configuration also exchanges the room's asset. No room of ours stands in for
    that asset, so this records the difference and changes nothing in the scene."""
    standing: StandingRule = StandingRule()
    visual_light: LightRange = LightRange()
    twist2_rate: PhysicsRate = PhysicsRate(dt=0.001, substeps=20)
    """Physics rate under the TWIST2 tracker."""
    success_judged: str = "once a tick, the first tick that satisfies it ends the episode"

    def task(self, name: str) -> TaskRules:
        """Rules of one task.

        Raises:
            InputError: Unknown task.
        """
        for entry in self.tasks:
            if entry.task == name:
                return entry
        raise InputError(f"task {name}: unknown, choose from {', '.join(t.task for t in self.tasks)}")

    @property
    def ball_restitution(self) -> float:
        """Coefficient of restitution of Football's ball."""
        return self.task("football").success.ball_restitution

    def to_dict(self) -> dict[str, Any]:
        """Plain data, ready for JSON."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @functools.cached_property
    def hash(self) -> str:
        """First 12 hex digits of the sha256 of the canonical JSON."""
        text = json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def table(self) -> list[tuple[str, str]]:
        """Rows (item, what this set says) in the order of the documentation."""
        from arena_newton import rules_table

        return rules_table.rows(self)

    def __str__(self) -> str:
        """One line a row."""
        return "\n".join([f"rules {self.name} ({self.hash})", *(f"  {item}: {text}" for item, text in self.table())])


def names() -> tuple[str, ...]:
    """Names of the rule sets, the default first."""
    return ("paper", "released")


@functools.cache
def get(name: str) -> RuleSet:
    """A rule set by name.

    Raises:
        InputError: Unknown name.
    """
    if name not in names():
        raise InputError(f"--rules {name}: unknown, choose {' or '.join(names())}")
    from arena_newton import tasks

    paper = name == "paper"
    return RuleSet(
        name=name,
        fall=FallRule(at_once=paper),
        tasks=tuple(tasks.get(task).rules.of(name) for task in tasks.names()),
        navi_visual_room_swap=not paper,
    )
