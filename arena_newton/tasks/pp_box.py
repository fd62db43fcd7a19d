"""P&PBox: move the box from the table onto the shelf."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from arena_newton.errors import InputError
from arena_newton.robot import TICK
from arena_newton.rules import ByRules, PoseRange, RuleSet, SuccessRule, num
from arena_newton.tasks.base import DISTANT_LIGHT, IDENTITY, Judge, ObjectSpec, TaskSpec

if TYPE_CHECKING:
    from arena_newton.physics import Physics
    from arena_newton.scene import Marker, Scene

__all__ = ["TASK", "PPBoxAnyDeckRule", "PPBoxJudge", "PPBoxOneDeckRule"]

BOX = "/World/Box"
SHELF = "/World/Shelf"
DECKS = tuple(f"{SHELF}/Frame/{name}" for name in ("Deck_0", "Deck_1", "Deck_2", "Deck_3", "Top"))


@dataclass(frozen=True)
class PPBoxAnyDeckRule(SuccessRule):
    """The box rests on any deck."""

    height_tolerance: float = 0.06
    """Largest distance of the box's bottom to the deck [m]."""
    max_speed: float = 0.05
    """[m/s]."""
    confirm_ticks: int = 10

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        return (
            f"box centre above any shelf deck within its span, bottom within {num(self.height_tolerance)} m of the "
            f"deck, slower than {num(self.max_speed)} m/s for {self.confirm_ticks} ticks"
        )


@dataclass(frozen=True)
class PPBoxOneDeckRule(SuccessRule):
    """The box is near the one layer that the original's code accepts, at any speed."""

    plane_below: float = 0.0223
    """How far the accepted plane lies below the deck's surface [m]: the original's is 0.6477 m, its deck at 0.67 m."""
    height_tolerance: float = 0.06
    """[m]."""
    deck: int = 1
    """Index of that layer in `DECKS`."""

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        return (
            f"box centre over deck {self.deck} of the stage within its span less half the box, bottom within "
            f"{num(self.height_tolerance)} m of the plane {num(self.plane_below)} m below its surface, no speed test"
        )


def collider(scene: Scene, prim: str) -> Marker:
    """The box around all collision geometry of a rigid prim, along the axes of its body.

    Raises:
        InputError: The prim is no rigid body or holds no collision geometry.
    """
    import mujoco

    from arena_newton.scene import Marker

    m, body = scene.mj_model, scene.body_id(prim)
    corners = []
    for geom in scene.geom_ids(prim):
        if m.geom_bodyid[geom] != body or not (m.geom_contype[geom] or m.geom_conaffinity[geom]):
            continue
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, m.geom_quat[geom])
        centre, half = m.geom_aabb[geom, :3], m.geom_aabb[geom, 3:]
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        corners.append(m.geom_pos[geom] + (centre + signs * half) @ turn.reshape(3, 3).T)
    if not corners:
        raise InputError(f"{scene.path}: prim {prim} holds no collision geometry")
    points = np.concatenate(corners)
    low, high = points.min(axis=0), points.max(axis=0)
    return Marker(body, tuple(0.5 * (low + high)), (1.0, 0.0, 0.0, 0.0), tuple(0.5 * (high - low)))


class PPBoxJudge(Judge):
    """The box on the shelf."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind box and decks."""
        from arena_newton.kernels.success import Boxes

        super().__init__(scene)
        self.rule: PPBoxAnyDeckRule | PPBoxOneDeckRule = rules.task("pp_box").success
        self.box = Boxes.upload([collider(scene, BOX)], self.device)
        self.box_qvel = scene.joint_qvel(BOX)
        self.decks = Boxes.upload([scene.marker(path) for path in DECKS], self.device)
        self.slow = self.counter()

    def evaluate(self, physics: Physics) -> None:
        """See `Judge.evaluate`."""
        from arena_newton.kernels import success

        common = {"box": self.box, "decks": self.decks, **self.outputs()}
        if isinstance(self.rule, PPBoxAnyDeckRule):
            success.launch_pp_box_paper(
                physics.xpos,
                physics.xquat,
                physics.qvel,
                box_qvel_adr=self.box_qvel,
                height_tolerance=self.rule.height_tolerance,
                max_speed=self.rule.max_speed,
                confirm_ticks=self.rule.confirm_ticks,
                tick=TICK,
                counter=self.slow,
                **common,
            )
        else:
            success.launch_pp_box_released(
                physics.xpos,
                physics.xquat,
                deck=self.rule.deck,
                plane_below=self.rule.plane_below,
                height_tolerance=self.rule.height_tolerance,
                **common,
            )


TASK = TaskSpec(
    name="pp_box",
    gym_id="Isaac-Move-PickPlace-Box-G129-Dex3-Wholedoby",
    instruction="Move the box from the table onto the shelf.",
    suite="HOI",
    spawn_position=(-1.6, -5.0, 0.8),
    spawn_quat=IDENTITY,
    objects=(
        ObjectSpec(
            record="box",
            prim=BOX,
            base=PoseRange(x=(-0.58, -0.40), y=(-5.63, -3.92), z=(0.75, 0.75), yaw=(-0.785398, 0.785398)),
            execution=PoseRange(x=(-0.58, -0.40), y=(-5.97, -3.92), z=(0.75, 0.75), yaw=(-0.785398, 0.785398)),
        ),
        ObjectSpec(
            record="shelf",
            prim=SHELF,
            base=PoseRange(x=(-0.2, 1.2), y=(-3.3, -2.2), z=(0.0, 0.0), yaw=(-0.261799, 0.261799)),
            execution=PoseRange(x=(-0.48, 1.2), y=(-3.3, -2.0), z=(0.0, 0.0), yaw=(-0.261799, 0.261799)),
            init=(-2.7, -0.15, 0.0),
            placement=ByRules.same("offset"),
        ),
    ),
    steps=ByRules(paper=2000, released=1450),
    success=ByRules(paper=PPBoxAnyDeckRule(), released=PPBoxOneDeckRule()),
    make_judge=PPBoxJudge,
    light=ByRules(paper=None, released=DISTANT_LIGHT),
)
