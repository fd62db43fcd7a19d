"""Boxing: hit the green target on one of two bags."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from arena_newton import seeding
from arena_newton.rules import ByRules, CylinderRange, RuleSet, SuccessRule, TaskRules, num
from arena_newton.tasks.base import FACE_MINUS_Y, Judge, ObjectSpec, Sample, TaskSpec, draw_uniform, object_range

if TYPE_CHECKING:
    from arena_newton.physics import Physics
    from arena_newton.scene import Scene

__all__ = ["TASK", "BoxingJudge", "BoxingRule"]

TARGET = "/World/Target"
PALMS = ("left_hand_palm_link", "right_hand_palm_link")


@dataclass(frozen=True)
class BoxingRule(SuccessRule):
    """Numbers of the predicate; the target's bounding radius comes from the marker `Target/Frame/Bounds`."""

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
        import warp as wp

        from arena_newton.kernels.success import Boxes

        super().__init__(scene)
        self.rule: BoxingRule = rules.task("boxing").success
        palms = [scene.frame(name) for name in PALMS]
        self.palm_body: Any = wp.array([p.body_id for p in palms], dtype=wp.int32, device=self.device)
        self.palm_offset: Any = wp.array([wp.vec3(*p.pos) for p in palms], dtype=wp.vec3, device=self.device)
        self.target = Boxes.upload([scene.marker(f"{TARGET}/Frame/Bounds")], self.device)

    def evaluate(self, physics: Physics) -> None:
        """See `Judge.evaluate`."""
        from arena_newton.kernels import success

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
    ranges: CylinderRange = object_range(rule, mode)
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
    make_judge=BoxingJudge,
    sample=sample_target,
)
