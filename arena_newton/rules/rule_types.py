"""Parts of a rule set: what counts as success and as a fall, how long an episode lasts, where objects are put.

A rule set is frozen and hashed; its hash is stored with every result. No task is known here: the numbers that belong to
one task are in that task's file, `arena_newton.rule_sets` assembles them.
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from arena_newton.errors import InputError

__all__ = [
    "ByRules",
    "CylinderRange",
    "FallRule",
    "FixedLight",
    "LightRange",
    "ObjectRule",
    "PoseRange",
    "RuleSet",
    "StandingRule",
    "StartupRule",
    "SuccessRule",
    "TaskRules",
    "check_name",
    "num",
]

Range = tuple[float, float]


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
    """Range of one randomised object's position, and the conversion of its sample to a world pose."""

    record: str
    """Name in the original's records, which seeds the object's generator."""
    placement: str
    """`absolute`: the sample is the world pose. `offset`: initial position + sample. `scaled`: initial position +
    spawn scale × sample."""
    base: PoseRange | CylinderRange
    execution: PoseRange | CylinderRange


@dataclass(frozen=True)
class ByRules[T]:
    """One value for each rule set."""

    paper: T
    released: T

    @classmethod
    def same(cls, value: T) -> "ByRules[T]":
        """The same value in both."""
        return cls(value, value)

    def of(self, rules_name: str) -> T:
        """The value of one rule set.

        Raises:
            InputError: Unknown rule set.
        """
        check_name(rules_name)
        value: T = getattr(self, rules_name)
        return value


def check_name(rules_name: str) -> None:
    """Refuse what is not the name of a rule set.

    Raises:
        InputError: Unknown name.
    """
    known = [field.name for field in dataclasses.fields(ByRules)]
    if rules_name not in known:
        raise InputError(f"--rules {rules_name}: unknown, choose {' or '.join(known)}")


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
class SuccessRule:
    """Numbers of one task's success condition; each task derives its own and says them in words."""

    def sentence(self) -> str:
        """Condition of success, with every number of this rule that the judge reads."""
        raise NotImplementedError

    def notes(self) -> tuple[tuple[str, str], ...]:
        """Further rows (item, what this rule says) after the success condition."""
        return ()

    def bounce(self) -> float | None:
        """Coefficient of restitution of the scene's ball; None: the task has no ball."""
        return None


@dataclass(frozen=True)
class TaskRules:
    """Everything that one rule set says about one task."""

    task: str
    max_steps: int
    """Step budget [50 Hz ticks]."""
    success: Any
    """The task's own `SuccessRule`."""
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
class StartupRule:
    """Phases between a reset and the policy's first action."""

    ticks: int
    """Length [50 Hz ticks] under a standing command; 0: the policy is asked at the spawn pose."""
    prefill: bool
    """True: the tracker's history holds the first frame, as if the robot had been standing there. False: it starts as
    the original resets it (TWIST2: zeros; SONIC: the first joints, zeros otherwise)."""

    @property
    def history(self) -> str:
        """Content of the tracker's history at the reset, in one phrase."""
        return "first frame" if self.prefill else "as the original"


@dataclass(frozen=True)
class StandingRule:
    """Standing, as the predicates of OpenDoor and VisNavi define it."""

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
    """The original's released visual mode also exchanges the room of one task. No room of ours replaces that asset, so
    this records the difference, as part of the hash, and changes nothing in the scene."""
    startup: StartupRule
    original_drive: bool
    """Official TWIST2 checkpoints are driven by the gains of the original's robot asset instead of TWIST2's own."""
    standing: StandingRule = StandingRule()
    visual_light: LightRange = LightRange()
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
        """Coefficient of restitution of a ball in a scene of no task (the lab): that of the first task with a ball."""
        found: float = next(value for task in self.tasks if (value := task.success.bounce()) is not None)
        return found

    def bounce(self, task: str) -> float:
        """Coefficient of restitution of the ball in a task's scene, or in a scene of no task."""
        own = next((entry.success.bounce() for entry in self.tasks if entry.task == task), None)
        return self.ball_restitution if own is None else own

    def to_dict(self) -> dict[str, object]:
        """Plain data, ready for JSON."""
        plain: dict[str, object] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain

    @functools.cached_property
    def hash(self) -> str:
        """First 12 hex digits of the sha256 of the canonical JSON, all tasks."""
        return self.hash_for(t.task for t in self.tasks)

    def hash_for(self, tasks: Iterable[str]) -> str:
        """Hash of what the set says about some tasks; it does not change when another task is registered.

        Args:
            tasks: Task names, in any order.

        Raises:
            InputError: Unknown task.
        """
        used = {self.task(name).task for name in tasks}
        content = dataclasses.replace(self, tasks=tuple(sorted((self.task(n) for n in used), key=lambda t: t.task)))
        text = json.dumps(content.to_dict(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]


def num(value: float) -> str:
    """A number as the tables print it: at most four decimals, a true minus sign."""
    return f"{round(value, 4):g}".replace("-", "−")
