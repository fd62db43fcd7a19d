"""Modes of an episode: what each changes about base mode, and from which ranges; also those of other packages."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from arena_newton.cli.registry import Registry
from arena_newton.errors import InputError, UnknownName, check_once
from arena_newton.rules import seeding
from arena_newton.rules.rule_types import CylinderRange, LightRange, ObjectRule, PoseRange, Range, RuleSet

__all__ = ["BUILT_IN", "DYNAMICS", "HELD_OUT", "QUANTITIES", "Mode", "Quantity"]
__all__ += ["get", "is_composed", "names", "register", "unregister"]

DYNAMICS = "dynamics"
"""Record name of what a mode draws about an episode's dynamics, next to the names of the objects."""
MOST_LATENCY = 10
"""Longest latency [ticks]."""
MOST_LETTERS = 100
"""Longest name of a mode with quantities added to it, which names files too."""
PLUS, TO = "+", ".."
"""Signs before a quantity that a mode's name adds, and between the ends of its range."""
_NUMBER = r"(-?[0-9]{1,9}(?:\.[0-9]{1,9})?)"
_ADDED = re.compile(rf"([a-z_]+)={_NUMBER}(?:{re.escape(TO)}{_NUMBER})?")


@dataclass(frozen=True)
class Quantity:
    """A number about the dynamics of an episode."""

    usual: float
    """Value that changes nothing."""
    unit: str
    sentence: str
    whole: bool = False
    """True if it is drawn among whole numbers, both bounds included."""


QUANTITIES: Mapping[str, Quantity] = {
    "friction": Quantity(1.0, "", "factor of the sliding friction of every surface"),
    "robot_mass": Quantity(1.0, "", "factor of mass and inertia of every link of the robot"),
    "object_mass": Quantity(1.0, "", "factor of mass and inertia of every other body"),
    "gains": Quantity(1.0, "", "factor of stiffness and damping of the drives of the 29 joints"),
    "state_latency": Quantity(0.0, "ticks", "age of the robot's state that policy and tracker get", whole=True),
    "action_latency": Quantity(0.0, "ticks", "ticks by which joint targets reach the drives late", whole=True),
    "push": Quantity(0.0, "m/s", "sudden change of the base's horizontal velocity"),
    "push_heading": Quantity(0.0, "rad", "direction of that push in the world, from x"),
    "push_time": Quantity(0.0, "", "its time after step 0, as a fraction of the rule set's step budget"),
    "joint_pos_noise": Quantity(0.0, "rad", "deviation of each measured joint position that policy and tracker get"),
    "joint_vel_noise": Quantity(0.0, "rad/s", "deviation of each measured joint velocity that they get"),
    "orientation_noise": Quantity(0.0, "rad", "deviation of the measured root orientation, about each of its axes"),
    "gyro_noise": Quantity(0.0, "rad/s", "deviation of the root's measured angular velocity, which trackers get"),
    "picture_noise": Quantity(0.0, "of 255", "deviation of each colour of the pictures that policies get"),
}
"""Everything that a mode may draw about an episode's dynamics."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mode:
    """One mode; everything that lists modes or asks what one changes reads it from here."""

    name: str
    sentence: str
    """Change against base mode, in a sentence without a full stop."""
    placements: Callable[[ObjectRule], PoseRange | CylinderRange] = lambda rule: rule.base
    """Range from which an object's placement is drawn, of those that the rule set has or another one."""
    scene: Literal["base", "semantic", "layer"] = "base"
    """The scene itself, its semantic variant, or a layer of its own, `variants/<mode>.usda` next to the scene."""
    layers: Path | None = None
    """Folder with a layer `<task>.usda` of each task, instead of those next to the scenes."""
    light: Callable[[RuleSet], LightRange] | None = None
    """Range from which a distant light is drawn; None: the light of the scene."""
    dynamics: Mapping[str, Range] = field(default_factory=dict)
    """Name of one of `QUANTITIES` → the range from which an episode's value is drawn, under both rule sets."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InputError: A field of another kind, an unknown quantity, a range that is none, or layers of a mode that
                takes none.
        """
        kinds = {
            "placements": (callable(self.placements), "a function of an object's rule"),
            "scene": (self.scene in ("base", "semantic", "layer"), "base, semantic or layer"),
            "layers": (self.layers is None or isinstance(self.layers, Path), "a Path or None"),
            "light": (self.light is None or callable(self.light), "a function of a rule set or None"),
            "dynamics": (isinstance(self.dynamics, Mapping), "ranges by name"),
        }
        for name, (fit, expected) in kinds.items():
            if not fit:
                raise InputError(f"mode {self.name}: {name} is {getattr(self, name)!r}, expected {expected}")
        if self.layers is not None and self.scene != "layer":
            raise InputError(f"mode {self.name}: has layers, but its scene is {self.scene!r}, expected 'layer'")
        for name, (low, high) in self.dynamics.items():
            if name not in QUANTITIES:
                raise InputError(f"mode {self.name}: {name} is none of {', '.join(QUANTITIES)}")
            whole, signed, bounds = QUANTITIES[name].whole, name == "push_heading", (float(low), float(high))
            if (
                not (low <= high and all(map(math.isfinite, bounds)))
                or (low < 0.0 and not signed)
                or (low == 0.0 and name in ("friction", "robot_mass", "object_mass"))
                or (high > 1.0 and name == "push_time")
                or (whole and not all(bound.is_integer() for bound in bounds))
            ):
                raise InputError(f"mode {self.name}: {name}: {low:g} to {high:g} is not a range of it")
            if whole and high > MOST_LATENCY:
                raise InputError(f"mode {self.name}: {name}: {high:g}, expected at most {MOST_LATENCY} ticks")

    @property
    def ruled(self) -> bool:
        """True if the hash of a rule set holds all its ranges."""
        return self.name in BUILT_IN and not self.dynamics

    @property
    def looks(self) -> bool:
        """True if its pictures differ from those of base mode."""
        return self.scene != "base" or self.light is not None

    def range_of(self, rule: ObjectRule) -> PoseRange | CylinderRange:
        """Range from which an object's placement is drawn.

        Raises:
            InputError: It is of another kind than the object's base range.
        """
        found = self.placements(rule)
        if type(found) is not type(rule.base):
            kinds = f"{type(found).__name__}, expected a {type(rule.base).__name__}"
            raise InputError(f"mode {self.name}: placements of {rule.record}: {kinds} as its base range is")
        return found

    def draw(self, episode_seed: int) -> dict[str, float]:
        """Dynamics of an episode: one value per range, each by a generator of its own."""
        found = {}
        for name, (low, high) in self.dynamics.items():
            rng = seeding.dynamics_rng(episode_seed, name)
            found[name] = float(rng.randint(int(low), int(high))) if QUANTITIES[name].whole else rng.uniform(low, high)
        return found

    def hash_for(self, rules: RuleSet, tasks: Iterable[str]) -> str:
        """Hash of its ranges and of its scene's name, for some tasks under a rule set: 12 hex digits."""
        objects = [one for task in sorted(tasks) for one in rules.task(task).objects]
        ranges = [[one.record, dataclasses.asdict(self.range_of(one))] for one in objects]
        light = None if self.light is None else dataclasses.asdict(self.light(rules))
        text = json.dumps([self.scene, ranges, light, sorted(self.dynamics.items())], separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]


BUILT_IN = {
    "base": Mode(name="base", sentence="changes nothing"),
    "execution": Mode(
        name="execution", sentence="objects start in wider ranges", placements=lambda rule: rule.execution
    ),
    "semantic": Mode(name="semantic", sentence="textures, drawn shapes or decor differ", scene="semantic"),
    "semantic-2": Mode(
        name="semantic-2", sentence="a held-out look: others than those of semantic mode", scene="layer"
    ),
    "semantic-3": Mode(name="semantic-3", sentence="another held-out look", scene="layer"),
    "visual": Mode(
        name="visual",
        sentence="a distant light of drawn direction, intensity and colour",
        light=lambda rules: rules.visual_light,
    ),
    DYNAMICS: Mode(
        name=DYNAMICS,
        sentence="friction, masses, gains and latencies differ, and the robot is pushed once",
        dynamics={
            "friction": (0.3, 1.2),
            "robot_mass": (0.8, 1.2),
            "object_mass": (0.5, 1.5),
            "gains": (0.8, 1.2),
            "state_latency": (0, 1),
            "action_latency": (0, 1),
            "push": (0.0, 1.0),
            "push_heading": (-math.pi, math.pi),
            "push_time": (0.02, 0.25),
        },
    ),
}
"""The paper's four test modes, base, execution, semantic and visual; the held-out looks; and dynamics."""
HELD_OUT = tuple(mode.name for mode in BUILT_IN.values() if mode.scene == "layer")
"""Modes whose looks are a layer of their own."""
_MODES = Registry[Mode]("mode", "arena_newton.modes", lambda: Mode, dict.fromkeys(BUILT_IN, ""), named=True)


def names() -> tuple[str, ...]:
    """Names of all modes: the built-in ones, then those of other packages."""
    return (*BUILT_IN, *(name for name in _MODES.names() if name not in BUILT_IN))


def get(name: str) -> Mode:
    """A mode by name; `execution+push=0.5+gyro_noise=0.1..0.3` draws these too, instead of what the mode says of them.

    A push that is named without its time or heading gets those of `dynamics`, where the mode has none.

    Raises:
        InputError: Unknown name, a package that offers something else, or a quantity that is none.
    """
    known, plus, added = name.partition(PLUS)
    if plus:
        return _with(get(known), name, added.split(PLUS))
    if name in BUILT_IN:
        return BUILT_IN[name]
    if name not in names():
        raise UnknownName(f"--mode {name}: unknown, choose from {', '.join(names())}")
    return _MODES.make(name)


def is_composed(name: object) -> bool:
    """True for the name of a mode with quantities added to it, as `get` takes it."""
    try:
        return isinstance(name, str) and PLUS in name and bool(get(name))
    except InputError:
        return False


def _with(mode: Mode, name: str, added: list[str]) -> Mode:
    """A mode that also draws the quantities of texts such as `push=0.5..1`."""
    if len(name) > MOST_LETTERS:
        raise InputError(f"--mode {name[:MOST_LETTERS]}…: longer than {MOST_LETTERS} letters")
    if mode.scene == "layer":
        raise InputError(f"--mode {name}: {mode.name} has a layer of its own, to which no quantity can be added")
    check_once(f"--mode {name}:", (text.partition("=")[0] for text in added))
    given: dict[str, Range] = {}
    for text in added:
        found = _ADDED.fullmatch(text)
        if not found:
            wanted = f"expected a quantity and its value or range, as push=0.5{TO}1, without an exponent"
            raise InputError(f"--mode {name}: {text!r}: {wanted}")
        quantity, low, high = found.groups()
        given[quantity] = float(low), float(low if high is None else high)
    if "push" in given:
        drawn = BUILT_IN[DYNAMICS].dynamics
        given = {key: drawn[key] for key in ("push_heading", "push_time")} | dict(mode.dynamics) | given
    return dataclasses.replace(mode, name=name, dynamics={**mode.dynamics, **given})


def register(mode: Mode) -> None:
    """Offer a mode in this process; packages offer theirs as entry points of the group `arena_newton.modes`.

    Raises:
        InputError: A built-in one has that name.
    """
    _MODES.register(mode.name, mode)


def unregister(name: str) -> None:
    """Take back a mode that was offered in this process, if there is one."""
    _MODES.unregister(name)
