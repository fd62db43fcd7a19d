"""DoubleDesk: carry the hammer from the right desk into the crate on the left desk."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import PALMS
from arena_newton.rules.rule_types import ByRules, PoseRange, RuleSet, SuccessRule, num
from arena_newton.tasks.base import (
    DISTANT_LIGHT,
    IDENTITY,
    KEY_OBJECT,
    LIFT,
    REACH,
    TOUCH,
    ObjectSpec,
    Required,
    TaskSpec,
)
from arena_newton.tasks.handles import BodyFrame
from arena_newton.tasks.interaction import Interaction
from arena_newton.tasks.judge import Judge, above, bounding_box, links, near, palms, top

if TYPE_CHECKING:
    from arena_newton.physics.engines import Physics
    from arena_newton.physics.scene import Scene

__all__ = ["TASK", "DoubleDeskJudge", "DoubleDeskRule"]

HAMMER = "/World/Hammer"
BASKET = "/World/Basket"
INSIDE = f"{BASKET}/Frame/Inside"
RIGHT_DESK, LEFT_DESK = "/World/RightDesk", "/World/LeftDesk"
SILL = "/World/Sill"
DESK_TOP = 0.745
"""Height of both desks in our own scene [m]."""

OVER_CRATE = 0.3
"""Distance to the crate, seen from above [m], from which a lifted hammer counts as carried over: the desks are 2.5 m
apart, so that the robot stands at the left one."""

PREDICATES = (
    Predicate("approach", f"root within {num(REACH)} m of the hammer, seen from above"),
    Predicate("contact", f"a palm within {num(TOUCH)} m of the hammer's bounding box"),
    Predicate("lift", f"the hammer's centre of mass {num(LIFT)} m above the right desk"),
    Predicate("transport", f"at that height, and within {num(OVER_CRATE)} m of the crate, seen from above"),
    Predicate("place", "the hammer is in the crate, as the rule set says"),
)


@dataclass(frozen=True)
class DoubleDeskRule(SuccessRule):
    """Numbers of the success condition; the crate's box is the marker `Basket/Frame/Inside` of the stage."""

    crate_frame: bool
    """True: the box turns with the crate. False: the world-axis box around the turned crate."""
    min_z: float | None
    """Lowest height of the hammer's centre of mass that still counts [m]; None, with `crate_frame`: no such test."""

    def __post_init__(self) -> None:
        """Refuse numbers that no predicate reads.

        Raises:
            InputError: A height together with the crate's frame, or neither.
        """
        if self.crate_frame == (self.min_z is not None):
            raise InputError(
                f"double_desk: crate_frame {self.crate_frame} with min_z {self.min_z}; the box in the crate's frame "
                "has no lowest height, the world-axis box needs one"
            )

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        if self.min_z is None:
            return "hammer's centre of mass inside the crate's box in the crate's own frame"
        return f"hammer's centre of mass inside the crate's world-axis box, and z ≥ {num(self.min_z)} m"


class DoubleDeskJudge(Judge):
    """The hammer's centre of mass in the crate."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind hammer and crate."""
        self.rule: DoubleDeskRule = rules.task("double_desk").success
        self.hammer = scene.body_id(HAMMER)
        inside, hammer = scene.marker(INSIDE), bounding_box(scene, HAMMER)
        mass = BodyFrame(self.hammer, tuple(scene.mj_model.body_ipos[self.hammer]), IDENTITY)
        lifted = above(mass, top(scene, RIGHT_DESK) + LIFT)
        super().__init__(
            scene,
            PREDICATES,
            {
                "approach": [near(links(scene, "pelvis"), hammer, REACH, horizontal=True)],
                "contact": [near(palms(scene), hammer, TOUCH)],
                "lift": [lifted],
                "transport": [lifted, near([mass], inside, OVER_CRATE, horizontal=True)],
            },
        )
        self.inside = self.boxes(inside)

    def decide(self, physics: Physics) -> None:
        """See `Judge.decide`."""
        from arena_newton.kernels.rules import success

        success.launch_double_desk(
            physics.xpos,
            physics.xquat,
            physics.xipos,
            hammer_body=self.hammer,
            inside=self.inside,
            min_z=self.rule.min_z,
            **self.outputs(),
        )


TASK = TaskSpec(
    name="double_desk",
    gym_id="Isaac-Move-PickPlace-DoubleDesk-G129-Dex3-Wholebody",
    instruction="Put the hammer from the right table into the basket on the left table.",
    suite="HOI",
    spawn_position=(-3.7, -2.2, 0.8),
    spawn_quat=IDENTITY,
    requires=(
        Required(HAMMER, "body"),
        Required(BASKET, "fixture"),
        Required(INSIDE, "marker"),
        Required(RIGHT_DESK, "collider"),
        Required(LEFT_DESK, "collider"),
        Required(SILL, "collider"),
    ),
    objects=(
        ObjectSpec(
            record="hammer",
            prim=HAMMER,
            base=PoseRange(x=(-3.2, -2.4), y=(-3.15, -3.0), z=(0.8, 0.8), yaw=(-0.35, 0.35)),
            execution=PoseRange(x=(-3.36, -2.52), y=(-3.15, -3.0), z=(0.8, 0.8), yaw=(-0.35, 0.35)),
            init_quat=(0.7139051, 0.0, 0.0, -0.7002425),
            surface=(functools.partial(top, prim=RIGHT_DESK), DESK_TOP),
        ),
        ObjectSpec(
            record="basket",
            prim=BASKET,
            base=PoseRange(x=(-3.6, -2.0), y=(-0.3, -0.005), z=(0.745, 0.745), yaw=(-0.785398, 0.785398)),
            execution=PoseRange(x=(-5.0, -2.0), y=(-0.3, -0.005), z=(0.745, 0.745), yaw=(-0.785398, 0.785398)),
            init=(-2.8, -0.1, 0.745),
            spawn_scale=0.01,
            placement=ByRules(paper="absolute", released="scaled"),
            execution_void=True,
            surface=(functools.partial(top, prim=LEFT_DESK), DESK_TOP),
        ),
    ),
    steps=ByRules.same(2000),
    success=ByRules(
        paper=DoubleDeskRule(crate_frame=True, min_z=None),
        released=DoubleDeskRule(crate_frame=False, min_z=0.445),
    ),
    judge=DoubleDeskJudge,
    predicates=PREDICATES,
    target=HAMMER,
    # The palm is 5 cm from the handle that it grasps and hovers 0.17 m above it. The expert stands 0.23 to 0.40 m from
    # the hammer. Episodes begin 0.82 m and more from it, which is not near yet.
    interaction=Interaction(
        HAMMER, PALMS, touch=TOUCH, stance=0.40, predicate="contact", bearing=1.0, near=0.80, carried=True, loose=True
    ),
    semantic_change="texture",
    recolour={HAMMER: KEY_OBJECT, BASKET: KEY_OBJECT},
    expert="arena_newton.policies.experts.double_desk:DoubleDeskExpert",
    disturbance=0.5,
    light=ByRules(paper=None, released=DISTANT_LIGHT),
)
