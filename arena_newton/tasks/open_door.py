"""OpenDoor: press the handle, push the door open and walk through."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import PALMS
from arena_newton.rules.rule_types import ByRules, PoseRange, RuleSet, SuccessRule, num
from arena_newton.tasks.base import FACE_PLUS_Y, KEY_OBJECT, REACH, TOUCH, ObjectSpec, Required, TaskSpec
from arena_newton.tasks.interaction import Interaction
from arena_newton.tasks.judge import Condition, Judge, bounding_box, links, near, palms

if TYPE_CHECKING:
    from arena_newton.physics.engines import Physics
    from arena_newton.physics.scene import Scene

__all__ = ["TASK", "DoorOpenRule", "DoorPassedRule", "OpenDoorJudge"]

DOOR = "/World/Door"
DOORWAY, LEAF, HANDLE = f"{DOOR}/Frame/Doorway", f"{DOOR}/LeafHinge", f"{DOOR}/Handle"
LEAF_BODY = f"{DOOR}/Leaf"

OPEN_DEG = 60.0
"""Angle of an open leaf [deg]: what the original's code asks for."""

PREDICATES = (
    Predicate("approach", f"root within {num(REACH)} m of the doorway, seen from above"),
    Predicate("contact", f"a palm within {num(TOUCH)} m of the handle's bounding box"),
    Predicate("unlatch", "the pressed handle has released the latch"),
    Predicate("open", f"the leaf is open by at least {num(OPEN_DEG)}°"),
    Predicate("pass", "the rule set's condition: `paper` through the frame's plane, `released` leaf open; standing"),
)


@dataclass(frozen=True)
class DoorPassedRule(SuccessRule):
    """The root is through the frame's plane and the robot stands."""

    half_width: float = 0.55
    """Largest |x| of the root in the door's frame [m]."""
    min_y: float = 0.02
    """Smallest y of the root in the door's frame [m]."""

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        return (
            f"root through the frame plane: |x_local| ≤ {num(self.half_width)} m, y_local > {num(self.min_y)} m in the "
            "door's frame, standing"
        )


@dataclass(frozen=True)
class DoorOpenRule(SuccessRule):
    """The latch is released, the leaf is open and the robot stands."""

    min_leaf_deg: float = OPEN_DEG
    """[deg]."""

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        return f"latch released, leaf ≥ {num(self.min_leaf_deg)}°, standing"


class OpenDoorJudge(Judge):
    """The robot behind the open door, or the leaf open; the latch itself belongs to the physics."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind doorway, leaf, handle and root."""
        doorway, self.leaf = scene.marker(DOORWAY), scene.joint_qpos(LEAF)
        super().__init__(
            scene,
            PREDICATES,
            {
                "approach": [near(links(scene, "pelvis"), doorway, REACH, horizontal=True)],
                "contact": [near(palms(scene), bounding_box(scene, HANDLE), TOUCH)],
                "unlatch": [Condition("unlatched")],
                "open": [Condition("angle", math.radians(OPEN_DEG), address=self.leaf)],
            },
        )
        self.rule: DoorPassedRule | DoorOpenRule = rules.task("open_door").success
        self.standing = rules.standing
        self.root = scene.robot.root_qpos
        self.doorway = self.boxes(doorway)

    def decide(self, physics: Physics) -> None:
        """See `Judge.decide`."""
        from arena_newton.kernels.rules import success

        common = {
            "root_qpos_adr": self.root,
            "stand_height": self.standing.min_root_z,
            "stand_up": self.standing.min_up,
            **self.outputs(),
        }
        if isinstance(self.rule, DoorPassedRule):
            success.launch_open_door_paper(
                physics.xpos,
                physics.xquat,
                physics.qpos,
                doorway=self.doorway,
                half_width=self.rule.half_width,
                min_y=self.rule.min_y,
                **common,
            )
        else:
            success.launch_open_door_released(
                physics.qpos,
                leaf_qpos_adr=self.leaf,
                latched=physics.latch_locked,
                min_angle=math.radians(self.rule.min_leaf_deg),
                **common,
            )


TASK = TaskSpec(
    name="open_door",
    gym_id="Isaac-Move-Open-Door-G129-Dex3-Wholebody",
    instruction="Open the door.",
    suite="HSI",
    spawn_position=(-1.6, 0.2, 0.8),
    spawn_quat=FACE_PLUS_Y,
    requires=(
        Required(DOOR, "fixture"),
        Required(DOORWAY, "marker"),
        Required(LEAF_BODY, "body"),
        Required(HANDLE, "body"),
        Required(LEAF, "latch"),
        Required(f"{DOOR}/HandleHinge", "hinge"),
    ),
    objects=(
        ObjectSpec(
            record="door",
            prim=DOOR,
            base=PoseRange(x=(-0.754, 0.55), y=(-0.8, 0.1), z=(0.0, 0.0)),
            execution=PoseRange(x=(-0.9, 0.66), y=(-0.96, 0.12), z=(0.0, 0.0)),
            init=(-1.614, 2.314, 0.002),
            placement=ByRules.same("offset"),
        ),
    ),
    steps=ByRules.same(1800),
    success=ByRules(paper=DoorPassedRule(), released=DoorOpenRule()),
    judge=OpenDoorJudge,
    predicates=PREDICATES,
    target=HANDLE,
    # The leaf is what a robot can find, the lever what it must touch: 6 cm off the leaf. The expert presses it from
    # 0.38 m with the lever 0.4 rad to its right, and a fist of 5 cm meets the leaf around it within 0.15 m.
    interaction=Interaction(HANDLE, PALMS, touch=TOUCH, stance=0.60, sight=LEAF_BODY, predicate="contact", bearing=0.8),
    without_legs=(
        "lever, leaf and doorway are met by hands and body: a base that rolls presses, leans and drives through, and "
        "the doorway has no sill"
    ),
    semantic_change="texture",
    recolour={HANDLE: KEY_OBJECT},
    expert="arena_newton.policies.experts.open_door:OpenDoorExpert",
)
