"""Boxing: hit the green target on one of two bags."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import PALMS
from arena_newton.rules import seeding
from arena_newton.rules.rule_types import ByRules, CylinderRange, RuleSet, SuccessRule, TaskRules, num
from arena_newton.tasks.base import (
    FACE_MINUS_Y,
    REACH,
    ObjectSpec,
    Required,
    Sample,
    TaskSpec,
    draw_uniform,
    object_range,
)
from arena_newton.tasks.interaction import Interaction
from arena_newton.tasks.judge import Judge, links, near, palms

if TYPE_CHECKING:
    from arena_newton.physics.engines import Physics
    from arena_newton.physics.scene import Scene

__all__ = ["TASK", "BoxingJudge", "BoxingRule"]

TARGET = "/World/Target"
BOUNDS = f"{TARGET}/Frame/Bounds"

PREDICATES = (
    Predicate("approach", f"root within {num(REACH)} m of the target, seen from above"),
    Predicate("contact", "a palm is at the target, as the rule set says"),
)


@dataclass(frozen=True)
class BoxingRule(SuccessRule):
    """Numbers of the success condition; the target's bounding radius comes from the marker `Target/Frame/Bounds`."""

    min_radius: float
    """A target with a smaller bounding radius counts as this large [m]."""
    hand_radius: float = 0.08
    """[m]."""

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        known = "target's bounding radius"
        radius = f"max(bounding radius, {num(self.min_radius)} m)" if self.min_radius > 0.0 else known
        return f"a palm within ({radius} + {num(self.hand_radius)} m) of the target's centre"


class BoxingJudge(Judge):
    """A palm at the target."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind target and palms."""
        target, hands = scene.marker(BOUNDS), palms(scene)
        super().__init__(
            scene, PREDICATES, {"approach": [near(links(scene, "pelvis"), target, REACH, horizontal=True)]}
        )
        self.rule: BoxingRule = rules.task("boxing").success
        self.palm_body, self.palm_offset = self.points(*hands)
        self.target = self.boxes(target)

    def decide(self, physics: Physics) -> None:
        """See `Judge.decide`."""
        from arena_newton.kernels.rules import success

        success.launch_boxing(
            physics.xpos,
            physics.xquat,
            palm_body=self.palm_body,
            palm_offset=self.palm_offset,
            target=self.target,
            min_radius=self.rule.min_radius,
            pad=self.rule.hand_radius,
            **self.outputs(),
        )


def sample_target(episode_seed: int, mode: str, rules: TaskRules) -> dict[str, Sample]:
    """One generator draws bag, azimuth and height, in this order."""
    (rule,) = rules.objects
    ranges = object_range(rule, mode)
    assert isinstance(ranges, CylinderRange)
    rng = seeding.object_rng(seeding.object_seed(episode_seed), rule.record)
    bag = int(rng.integers(len(ranges.centers)))
    azimuth = draw_uniform(rng, ranges.azimuth)
    z = draw_uniform(rng, ranges.z)
    x = ranges.centers[bag][0] + ranges.radius * math.cos(azimuth)
    y = ranges.centers[bag][1] + ranges.radius * math.sin(azimuth)
    return {rule.record: {"bag": bag + 1, "azimuth": azimuth, "x": x, "y": y, "z": z, "yaw": 0.0}}


_BAGS = ((-0.97, -3.7), (-3.0, -3.7))

TASK = TaskSpec(
    name="boxing",
    gym_id="Isaac-Move-Boxing-Bag-G129-Dex3-Wholebody",
    instruction="Strike the green markers on the punching bag.",
    suite="HSI",
    spawn_position=(-1.6, -2.0, 0.8),
    spawn_quat=FACE_MINUS_Y,
    requires=(
        Required("/World/Bag_1", "collider"),
        Required("/World/Bag_2", "collider"),
        Required(TARGET, "target"),
        Required(BOUNDS, "marker"),
    ),
    objects=(
        ObjectSpec(
            record="boxing_target",
            prim=TARGET,
            base=CylinderRange(_BAGS, radius=0.15, azimuth=(-math.pi, math.pi), z=(0.75, 0.85)),
            execution=CylinderRange(_BAGS, radius=0.15, azimuth=(-math.pi, math.pi), z=(0.65, 0.95)),
        ),
    ),
    steps=ByRules(paper=1500, released=900),
    success=ByRules(paper=BoxingRule(min_radius=0.0), released=BoxingRule(min_radius=0.10)),
    judge=BoxingJudge,
    predicates=PREDICATES,
    target=TARGET,
    # A fist that lands beside the target is still on the bag, whose radius is 0.15 m. The expert strikes from 0.45 m
    # off the bag's axis with the target 0.1 to 0.3 rad to its side; a hand reaches 45 degrees aside without a step.
    interaction=Interaction(BOUNDS, PALMS, touch=0.20, stance=0.60, bearing=0.8),
    without_legs=(
        "the target's centre is 0.75 to 0.85 m high and counts from 0.13 m away, and a pelvis that glides at 0.8 m has "
        "its shoulders 0.3 m above that: the arms alone reach down to it, from wherever the base rolls"
    ),
    semantic_change="shape",
    recolour={TARGET: 0.0},
    expert="arena_newton.policies.experts.boxing:BoxingExpert",
    disturbance=2.0,
    sample=sample_target,
)
