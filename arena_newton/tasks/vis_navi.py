"""VisNavi: walk around dropped obstacles into the yellow area at the wet-floor sign."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import ANKLES
from arena_newton.rules import seeding
from arena_newton.rules.rule_types import ByRules, PoseRange, RuleSet, SuccessRule, TaskRules, num
from arena_newton.tasks.base import (
    FACE_PLUS_Y,
    GOAL_OBJECT,
    REACH,
    ObjectSpec,
    Overlap,
    Required,
    Sample,
    TaskSpec,
    object_range,
    sample_pose,
)
from arena_newton.tasks.interaction import Interaction
from arena_newton.tasks.judge import Judge, links, near

if TYPE_CHECKING:
    from arena_newton.physics.engines import Physics
    from arena_newton.physics.scene import Scene

__all__ = ["TASK", "VisNaviJudge", "VisNaviRule"]

SIGN = "/World/TargetSign"
ZONE = f"{SIGN}/Frame/Zone"

PREDICATES = (
    Predicate("approach", f"root within {num(REACH)} m of the marked area, seen from above"),
    Predicate("enter", "an ankle link over the marked area's box"),
    Predicate("stand", "both feet in the marked area, standing, as the rule set says"),
)


@dataclass(frozen=True)
class VisNaviRule(SuccessRule):
    """The area is the marker `TargetSign/Frame/Zone` of the stage."""

    round_signs: bool
    """True if a zone that the stage marks as round (semantic mode's ring) is the disc in its box instead of the box."""
    feet: tuple[str, ...] = ANKLES
    """Links whose origins must be inside."""

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        text = "both feet (ankle links) inside the target box, standing"
        return f"{text}; in semantic mode inside the target ring" if self.round_signs else text


class VisNaviJudge(Judge):
    """Both feet in the marked area."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind area, feet and root."""
        rule: VisNaviRule = rules.task("vis_navi").success
        zone, feet = scene.marker(ZONE), links(scene, *rule.feet)
        super().__init__(
            scene,
            PREDICATES,
            {
                "approach": [near(links(scene, "pelvis"), zone, REACH, horizontal=True)],
                "enter": [near(feet, zone, 0.0, horizontal=True)],
            },
        )
        self.standing = rules.standing
        self.root = scene.robot.root_qpos
        self.feet, _ = self.points(*feet)
        self.zone = self.boxes(zone)
        self.round = zone.round and rule.round_signs

    def decide(self, physics: Physics) -> None:
        """See `Judge.decide`."""
        from arena_newton.kernels.rules import success

        success.launch_vis_navi(
            physics.xpos,
            physics.xquat,
            physics.qpos,
            root_qpos_adr=self.root,
            feet=self.feet,
            zone=self.zone,
            round_zone=self.round,
            stand_height=self.standing.min_root_z,
            stand_up=self.standing.min_up,
            **self.outputs(),
        )


def sample_layout(episode_seed: int, mode: str, rules: TaskRules) -> dict[str, Sample]:
    """One generator draws all obstacles, each x, y, z, yaw; the sign has its own and draws yaw first."""
    master = seeding.object_seed(episode_seed)
    layout = np.random.default_rng(master)
    sampled = {}
    for rule in rules.objects:
        ranges = object_range(rule, mode)
        assert isinstance(ranges, PoseRange)
        if rule.record.startswith("obstacle_"):
            sampled[rule.record] = sample_pose(layout, ranges, ("x", "y", "z", "yaw"))
        else:
            rng = seeding.object_rng(master, rule.record)
            sampled[rule.record] = sample_pose(rng, ranges, ("yaw", "x", "y", "z"))
    return sampled


def _obstacle(record: str, prim: str, x: tuple[float, float], z: float) -> ObjectSpec:
    """An obstacle dropped from height z [m] (of a beam's centre, of a block's underside); it may land on another.

    Beams come to rest at once. Blocks roll on and off them: in 56 of 60 layouts something still moves (0.02 m/s,
    0.05 rad/s) one second after the drop, in half of them for 1.7 s, in one of ten for 6 s and more.
    """
    yaw = (-0.785398, 0.785398)
    return ObjectSpec(
        record=record,
        prim=prim,
        base=PoseRange(x=x, y=(-2.5, -1.2), z=(z, z), yaw=yaw),
        execution=PoseRange(x=x, y=(-2.76, -1.2), z=(z, z), yaw=yaw),
    )


_HIGH_BLOCKS = ("/World/Block_a", "/World/Block_c")
_SIDE_BY_SIDE = (
    "obstacle_02_a begins at x −1.8 m, obstacle_02_c ends at x −2 m, both are 0.5 m wide and turned, "
    "and their heights 1.56 … 2.36 m and 1.8 … 2.6 m meet"
)

TASK = TaskSpec(
    name="vis_navi",
    gym_id="Isaac-Move-SmallWarehouse-VisionNavigation-G129-Dex3-Wholebody",
    instruction="Avoid obstacles and move to the yellow marked area.",
    suite="HSI",
    spawn_position=(-1.90, -5.20, 0.80),
    spawn_quat=FACE_PLUS_Y,
    requires=(
        *(Required(f"/World/{name}_{letter}", "body") for name in ("Beam", "Block") for letter in "abc"),
        Required(SIGN, "fixture"),
        Required(ZONE, "marker"),
    ),
    objects=(
        _obstacle("obstacle_01_a", "/World/Beam_a", (-0.5, -0.4), 0.16),
        _obstacle("obstacle_01_b", "/World/Beam_b", (-2.2, -1.7), 0.56),
        _obstacle("obstacle_01_c", "/World/Beam_c", (-4.6, -4.5), 1.06),
        _obstacle("obstacle_02_a", "/World/Block_a", (-1.8, -0.7), 1.56),
        _obstacle("obstacle_02_b", "/World/Block_b", (-5.2, -4.0), 1.3),
        _obstacle("obstacle_02_c", "/World/Block_c", (-3.1, -2.0), 1.8),
        ObjectSpec(
            record="target_sign",
            prim=SIGN,
            base=PoseRange(x=(-3.0, -1.5), y=(-0.12, 0.8), z=(0.0, 0.0), yaw=(-0.3, 0.3)),
            execution=PoseRange(x=(-5.0, 0.0), y=(-0.12, 5.0), z=(0.0, 0.0), yaw=(-0.3, 0.3)),
            init=(-2.0, -0.25, 0.0),
            spawn_scale=0.01,
            placement=ByRules(paper="absolute", released="scaled"),
            execution_void=True,
        ),
    ),
    steps=ByRules.same(1800),
    success=ByRules(paper=VisNaviRule(round_signs=False), released=VisNaviRule(round_signs=True)),
    judge=VisNaviJudge,
    predicates=PREDICATES,
    target=SIGN,
    # The area is entered by walking on: half a step (0.3 m) before its border the next one leads into it.
    interaction=Interaction(ZONE, ANKLES, touch=0.0, stance=0.30, predicate="enter", level=True, reached_only=True),
    without_legs=(
        "the rule asks for both ankle links inside the area's box and an upright robot; legs that hang still from a "
        "gliding base are carried over the floor into it. It tests navigation; feet only by what they bump into"
    ),
    semantic_change="shape",
    recolour={f"{SIGN}/Frame/Outline": 0.0, SIGN: GOAL_OBJECT},
    expert="arena_newton.policies.experts.vis_navi:VisNaviExpert",
    mode_notes={
        "visual": ByRules(
            paper="light only",
            released="the original also swaps the room's asset; recorded here, the scene stays",
        )
    },
    overlaps=(
        Overlap(*_HIGH_BLOCKS, ("paper", "released"), ("base", "semantic", "visual"), 2, 0.21, _SIDE_BY_SIDE),
        Overlap(*_HIGH_BLOCKS, ("paper", "released"), ("execution",), 2, 0.182, _SIDE_BY_SIDE),
    ),
    sample=sample_layout,
)
