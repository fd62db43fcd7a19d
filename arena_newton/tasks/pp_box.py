"""P&PBox: move the box from the table onto the shelf."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from arena_newton.robot import TICK
from arena_newton.rules import ByRules, PoseRange, RuleSet
from arena_newton.tasks.base import DISTANT_LIGHT, IDENTITY, Judge, ObjectSpec, TaskSpec

if TYPE_CHECKING:
    from arena_newton.physics import Physics
    from arena_newton.scene import Scene

__all__ = ["TASK", "PPBoxAnyDeckRule", "PPBoxJudge", "PPBoxOneDeckRule"]

BOX = "/World/Box"
SHELF = "/World/Shelf"
DECKS = tuple(f"{SHELF}/Frame/{name}" for name in ("Deck_0", "Deck_1", "Deck_2", "Deck_3", "Top"))


@dataclass(frozen=True)
class PPBoxAnyDeckRule:
    """The box rests on any deck."""

    height_tolerance: float = 0.06
    """Largest distance of the box's bottom to the deck [m]."""
    max_speed: float = 0.05
    """[m/s]."""
    confirm_ticks: int = 10


@dataclass(frozen=True)
class PPBoxOneDeckRule:
    """The box is near the one layer that the original's code accepts, at any speed."""

    plane_z: float = 0.6477
    """[m]."""
    height_tolerance: float = 0.06
    """[m]."""
    deck: int = 1
    """Index of that layer in `DECKS`."""


class PPBoxJudge(Judge):
    """The box on the shelf."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind box and decks."""
        import warp as wp

        from arena_newton.kernels.success import Boxes

        super().__init__(scene)
        self.rule: PPBoxAnyDeckRule | PPBoxOneDeckRule = rules.task("pp_box").success
        self.box = scene.body_id(BOX)
        self.box_qvel = scene.joint_qvel(BOX)
        self.box_half = wp.vec3(*(float(v) for v in scene.mj_model.geom_aabb[scene.geom_ids(BOX)[0], 3:]))
        self.decks = Boxes.upload([scene.marker(path) for path in DECKS], self.device)
        self.slow = self.counter()
        centred = float(abs(scene.mj_model.body_ipos[self.box]).max()) < 1e-6
        self._centres = (
            None if centred else wp.zeros((self.worlds, scene.mj_model.nbody, 3), dtype=wp.float32, device=self.device)
        )
        """Body positions with the box's centre of mass in place of its origin, which lies at its base."""

    def positions(self, physics: Physics) -> Any:
        """Body positions in which the box stands for its centre, shape [worlds, nbody, 3]."""
        import warp as wp

        if self._centres is None:
            return physics.xpos
        wp.copy(self._centres, physics.xpos)
        row = slice(self.box, self.box + 1)
        wp.copy(self._centres[:, row], physics.xipos[:, row])
        return self._centres

    def evaluate(self, physics: Physics) -> None:
        """See `Judge.evaluate`."""
        from arena_newton.kernels import success

        positions = self.positions(physics)
        common = {"box_body": self.box, "box_half": self.box_half, "decks": self.decks, **self.outputs()}
        if isinstance(self.rule, PPBoxAnyDeckRule):
            success.launch_pp_box_paper(
                positions,
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
                positions,
                physics.xquat,
                deck=self.rule.deck,
                plane_z=self.rule.plane_z,
                height_tolerance=self.rule.height_tolerance,
                **common,
            )


TASK = TaskSpec(
    name="pp_box",
    gym_id="Isaac-Move-PickPlace-Box-G129-Dex3-Wholedoby",
    instruction="Move the box from the table onto the shelf.",
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
