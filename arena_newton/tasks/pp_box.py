"""P&PBox: move the box from the table onto the shelf."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import PALMS, TICK
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
from arena_newton.tasks.handles import ROBOT, BodyFrame, Marker
from arena_newton.tasks.interaction import Interaction
from arena_newton.tasks.judge import Condition, Judge, above, bounding_box, links, near, palms, top

if TYPE_CHECKING:
    from arena_newton.physics.engines import Physics
    from arena_newton.physics.scene import Scene

__all__ = ["TASK", "PPBoxAnyDeckRule", "PPBoxJudge", "PPBoxOneDeckRule"]

BOX = "/World/Box"
TABLE = "/World/Table"
SHELF = "/World/Shelf"
DECKS = tuple(f"{SHELF}/Frame/{name}" for name in ("Deck_0", "Deck_1", "Deck_2", "Deck_3", "Top"))


OVER_SHELF = 0.05
"""Distance of a lifted box's centre to a deck, seen from above [m], from which it is carried over: its edge, 0.105 m
ahead, is then over the deck. On the table it starts 0.17 m away at the least."""
ON_DECK = 0.06
"""Largest distance of the box's bottom to a deck [m]: the tolerance of both rule sets."""

PREDICATES = (
    Predicate("approach", f"root within {num(REACH)} m of the box, seen from above"),
    Predicate("contact", f"a palm within {num(TOUCH)} m of the box"),
    Predicate("lift", f"the box's centre {num(LIFT)} m above where it is when the box rests on the table"),
    Predicate("transport", f"the box's centre within {num(OVER_SHELF)} m of the shelf's decks, seen from above"),
    Predicate("place", f"the box's centre over a deck, its bottom within {num(ON_DECK)} m of it"),
    Predicate("release", f"the same, and no palm within {num(TOUCH)} m of the box"),
    Predicate("hold", "the box stays on the shelf, as the rule set says"),
)


@dataclass(frozen=True)
class PPBoxAnyDeckRule(SuccessRule):
    """The box rests on any deck, and the robot has let go of it.

    The paper's box "rests on the shelf support surface". One that is still squeezed between the hands, held in a few
    centimetres' distance of a deck, does not.
    """

    height_tolerance: float = 0.06
    """Largest distance of the box's bottom to the deck [m]."""
    max_speed: float = 0.05
    """[m/s]."""
    confirm_ticks: int = 10

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        return (
            f"box centre above any shelf deck within its span, bottom within {num(self.height_tolerance)} m of the "
            f"deck, slower than {num(self.max_speed)} m/s and touched by no robot link at the end of "
            f"{self.confirm_ticks} consecutive ticks"
        )


@dataclass(frozen=True)
class PPBoxOneDeckRule(SuccessRule):
    """The box is near the one layer that the original's code accepts, at any speed."""

    plane_below: float = 0.0223
    """Depth of the accepted plane below the deck's surface [m]: the original's is 0.6477 m, its deck at 0.67 m."""
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


def on_deck(deck: Marker, half: float) -> Marker:
    """Centre of a box of half height `half` [m] that rests on a deck."""
    x, y, z = deck.pos
    height = z + deck.half[2] + half
    return dataclasses.replace(deck, pos=(x, y, height), half=(deck.half[0], deck.half[1], ON_DECK))


class PPBoxJudge(Judge):
    """The box on the shelf."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind box, decks and robot."""
        self.rule: PPBoxAnyDeckRule | PPBoxOneDeckRule = rules.task("pp_box").success
        box, decks = bounding_box(scene, BOX), tuple(scene.marker(path) for path in DECKS)
        centre, half = BodyFrame(box.body_id, box.pos, IDENTITY), box.half[2]
        placed = Condition("near", 0.0, (centre,), tuple(on_deck(deck, half) for deck in decks))
        super().__init__(
            scene,
            PREDICATES,
            {
                "approach": [near(links(scene, "pelvis"), box, REACH, horizontal=True)],
                "contact": [near(palms(scene), box, TOUCH)],
                "lift": [above(centre, top(scene, TABLE) + half + LIFT)],
                "transport": [near([centre], decks[0], OVER_SHELF, horizontal=True)],
                "place": [placed],
                "release": [placed, Condition("clear", TOUCH, palms(scene), (box,))],
            },
        )
        self.box = self.boxes(box)
        self.box_qvel = scene.joint_qvel(BOX)
        self.decks = self.boxes(*decks)
        self.box_geoms, self.robot_geoms = scene.geom_ids(BOX), scene.geom_ids(ROBOT)
        self.slow = self.counter()
        self._bound: Physics | None = None

    def bind(self, physics: Physics) -> None:
        """See `Judge.bind`."""
        if self._bound is not physics and isinstance(self.rule, PPBoxAnyDeckRule):
            physics.watch_pair(self.robot_geoms, self.box_geoms)
        self._bound = physics

    def decide(self, physics: Physics) -> None:
        """See `Judge.decide`."""
        from arena_newton.kernels.rules import success

        self.bind(physics)
        common = {"box": self.box, "decks": self.decks, **self.outputs()}
        if isinstance(self.rule, PPBoxAnyDeckRule):
            success.launch_pp_box_paper(
                physics.xpos,
                physics.xquat,
                physics.qvel,
                physics.pair_force,
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
    requires=(
        Required(BOX, "body"),
        Required(TABLE, "collider"),
        Required(SHELF, "fixture"),
        *(Required(deck, "marker") for deck in DECKS),
    ),
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
    judge=PPBoxJudge,
    predicates=PREDICATES,
    target=BOX,
    # A palm is 6 cm from the box when its fist squeezes it, and 0.16 m when it begins to close. The expert stands 0.22
    # to 0.30 m before the box. Episodes begin 0.9 m and more before it, which is not near yet.
    interaction=Interaction(
        BOX, PALMS, touch=TOUCH, stance=0.45, predicate="contact", bearing=0.8, near=0.85, carried=True, loose=True
    ),
    without_legs=(
        "the box is on a table and the only empty deck is 0.67 m high, at hip height: arms alone lift the box, hold it "
        "and set it down, and a base that rolls carries it there. Only a lower deck would ask for a crouch"
    ),
    light=ByRules(paper=None, released=DISTANT_LIGHT),
    semantic_change="clutter",
    recolour={BOX: KEY_OBJECT},
    expert="arena_newton.policies.experts.pp_box:PPBoxExpert",
    disturbance=0.5,
)
