"""The record of PushBin: push a tall bin onto the yellow mark and let it come to rest there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import PALMS
from arena_newton.rules.rule_types import ByRules, PoseRange, RuleSet, SuccessRule
from arena_newton.tasks import Interaction, ObjectSpec, Required, TaskSpec
from arena_newton.tasks.base import FACE_PLUS_Y, REACH, TOUCH
from arena_newton.tasks.judge import (
    Condition,
    ConditionsJudge,
    bounding_box,
    links,
    near,
    origin,
    palms,
    slow,
    standing,
)

if TYPE_CHECKING:
    from arena_newton.physics.scene import Scene

BIN = "/World/Bin"
MARK = "/World/Mark"
ZONE = f"{MARK}/Frame/Zone"

ROLLING = 0.1
"""Speed toward the mark from which the bin counts as pushed [m/s]."""

PREDICATES = (
    Predicate("approach", f"root within {REACH:g} m of the bin, seen from above"),
    Predicate("contact", f"a palm within {TOUCH:g} m of the bin"),
    Predicate("transport", f"the bin moves toward the mark with at least {ROLLING:g} m/s"),
    Predicate("rest", "the bin is at rest over the mark, and the robot stands, as the rule says"),
)


@dataclass(frozen=True)
class PushBinRule(SuccessRule):
    """Numbers of the success condition; the mark itself is the marker `Mark/Frame/Zone` of the scene."""

    max_speed: float = 0.05
    """Of the bin [m/s]."""
    confirm_ticks: int = 25
    """Ticks in a row."""

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        ticks = f"{self.confirm_ticks} consecutive ticks"
        return f"bin's middle over the mark, slower than {self.max_speed:g} m/s, robot standing, for {ticks}"


def judge(scene: Scene, rules: RuleSet) -> ConditionsJudge:
    """Binds the conditions to a built scene."""
    rule: PushBinRule = rules.task("push_bin").success
    middle, zone, surface = origin(scene, BIN), scene.marker(ZONE), bounding_box(scene, BIN)
    moving = Condition("toward", ROLLING, (middle,), (zone,), horizontal=True, address=scene.joint_qvel(BIN))
    steps = {
        "approach": [near(links(scene, "pelvis"), surface, REACH, horizontal=True)],
        "contact": [near(palms(scene), surface, TOUCH)],
        "transport": [moving],
    }
    rest = [near([middle], zone, 0.0, horizontal=True), slow(scene, BIN, rule.max_speed), *standing(scene, rules)]
    return ConditionsJudge(scene, PREDICATES, steps, rest, rule.confirm_ticks)


TASK = TaskSpec(
    name="push_bin",
    gym_id="Push-Bin-G129-Dex3-Wholebody",
    instruction="Push the bin onto the yellow mark.",
    spawn_position=(-3.0, -4.4, 0.8),
    spawn_quat=FACE_PLUS_Y,
    scene=Path(__file__).parent / "scene.usda",
    requires=(Required(BIN, "body"), Required(MARK, "target"), Required(ZONE, "marker")),
    objects=(
        ObjectSpec(
            record="bin",
            prim=BIN,
            base=PoseRange(x=(-3.4, -2.6), y=(-3.1, -2.7), z=(0.0, 0.0)),
            execution=PoseRange(x=(-3.6, -2.4), y=(-3.2, -2.6), z=(0.0, 0.0)),
            rest_height=0.0,
        ),
        ObjectSpec(
            record="mark",
            prim=MARK,
            base=PoseRange(x=(-3.6, -2.4), y=(-0.8, 0.2), z=(0.0, 0.0)),
            execution=PoseRange(x=(-3.8, -2.2), y=(-0.9, 0.4), z=(0.0, 0.0)),
        ),
    ),
    steps=ByRules.same(1500),
    success=ByRules.same(PushBinRule()),
    judge=judge,
    predicates=PREDICATES,
    target=BIN,
    interaction=Interaction(BIN, PALMS, touch=TOUCH, stance=0.5, predicate="contact", bearing=0.8, loose=True),
    without_legs="the bin is pushed at chest height: a base that rolls pushes it as well as legs do",
    semantic_change="texture",
    recolour={MARK: 0.0},
    expert="push_bin.expert:PushBinExpert",
)
