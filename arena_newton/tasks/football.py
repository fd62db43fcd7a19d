"""Football: kick the ball into the goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from arena_newton.interfaces import Predicate
from arena_newton.robot.g1 import FEET, TOE
from arena_newton.rules.rule_types import ByRules, PoseRange, RuleSet, SuccessRule, num
from arena_newton.tasks.base import FACE_PLUS_Y, GOAL_OBJECT, IDENTITY, REACH, ObjectSpec, Required, TaskSpec
from arena_newton.tasks.handles import BodyFrame
from arena_newton.tasks.interaction import Interaction
from arena_newton.tasks.judge import Condition, Judge, bounding_box, links, near, origin

if TYPE_CHECKING:
    from arena_newton.physics.engines import Physics
    from arena_newton.physics.scene import Scene

__all__ = ["TASK", "FootballJudge", "FootballRule"]

BALL = "/World/Ball"
GOAL = "/World/Goal/Volume"
PITCH = "/World/Pitch"
KICK = 0.06
"""Distance of a toe to the ball's bounding box [m] that counts as contact: half a foot's width, and some motion."""
ROLLING = 0.5
"""Speed toward the goal [m/s] that distinguishes a kicked ball from one that a passing foot brushed."""

PREDICATES = (
    Predicate("approach", f"root within {num(REACH)} m of the ball, seen from above"),
    Predicate("contact", f"a toe within {num(KICK)} m of the ball's bounding box"),
    Predicate("transport", f"the ball moves toward the goal's centre with at least {num(ROLLING)} m/s"),
    Predicate("goal", "the ball is in the goal, as the rule set says"),
)


@dataclass(frozen=True)
class FootballRule(SuccessRule):
    """Numbers of the success condition; the goal's box itself is the marker `Goal/Volume` of the stage."""

    rear_bound: bool
    """True if a ball behind the net no longer counts."""
    ball_out: bool
    """True if leaving the field ends the episode."""
    ball_restitution: float
    """Speed of parting over speed of approach, which the scene's ball takes at every physics rate."""
    out_z: float = -0.5
    """A ball below this height has left the field [m]."""

    def sentence(self) -> str:
        """See `SuccessRule.sentence`."""
        rear = "and before its rear face" if self.rear_bound else "no rear bound"
        return f"ball centre past the goal's plane within the goal's volume (the stage's `Goal/Volume`), {rear}"

    def notes(self) -> tuple[tuple[str, str], ...]:
        """See `SuccessRule.notes`."""
        out = (
            "beyond the backdrop walls (the stage's `Pitch`) or "
            f"z < {num(self.out_z)} m: ends, outcome `timeout` with reason `ball_out`"
        )
        return (
            ("football, ball leaves the field", out if self.ball_out else "never ends"),
            ("ball restitution", num(self.ball_restitution)),
        )

    def bounce(self) -> float:
        """See `SuccessRule.bounce`."""
        return self.ball_restitution


class FootballJudge(Judge):
    """The ball's centre in the goal's box."""

    def __init__(self, scene: Scene, rules: RuleSet):
        """Bind ball, goal and pitch."""
        self.rule: FootballRule = rules.task("football").success
        self.ball = scene.body_id(BALL)
        ball, goal = origin(scene, BALL), scene.marker(GOAL)
        surface, speed = bounding_box(scene, BALL), scene.joint_qvel(BALL)
        toes = [BodyFrame(foot.body_id, TOE, IDENTITY) for foot in links(scene, *FEET)]
        super().__init__(
            scene,
            PREDICATES,
            {
                "approach": [near(links(scene, "pelvis"), surface, REACH, horizontal=True)],
                "contact": [near(toes, surface, KICK)],
                "transport": [Condition("toward", ROLLING, (ball,), (goal,), horizontal=True, address=speed)],
            },
        )
        self.goal = self.boxes(goal)
        self.pitch = self.boxes(scene.marker(PITCH))

    def decide(self, physics: Physics) -> None:
        """See `Judge.decide`."""
        from arena_newton.kernels.rules import success

        success.launch_football(
            physics.xpos,
            physics.xquat,
            ball_body=self.ball,
            goal=self.goal,
            pitch=self.pitch,
            rear_bound=self.rule.rear_bound,
            judge_out=self.rule.ball_out,
            min_z=self.rule.out_z,
            event=self.event,
            **self.outputs(),
        )


TASK = TaskSpec(
    name="football",
    gym_id="Isaac-Move-Football-Single-G129-Dex3-Wholebody",
    instruction="Kick the soccer ball into the goal.",
    suite="HOI",
    spawn_position=(0.0, -2.0, 0.8),
    spawn_quat=FACE_PLUS_Y,
    requires=(
        Required(BALL, "body"),
        Required("/World/Goal", "collider"),
        Required(GOAL, "marker"),
        Required(PITCH, "marker"),
        Required("/World/Distractor", "body", ("semantic_released",)),
    ),
    objects=(
        ObjectSpec(
            record="football",
            prim=BALL,
            base=PoseRange(x=(-1.2, 1.2), y=(-1.2, 1.2), z=(0.11, 0.11)),
            execution=PoseRange(x=(-1.45, 1.45), y=(-1.45, 1.45), z=(0.11, 0.11)),
            rest_height=0.11,
        ),
    ),
    steps=ByRules(paper=1300, released=2000),
    success=ByRules(
        paper=FootballRule(rear_bound=True, ball_out=True, ball_restitution=0.1),
        released=FootballRule(rear_bound=False, ball_out=False, ball_restitution=0.75),
    ),
    judge=FootballJudge,
    predicates=PREDICATES,
    target=BALL,
    # The toe's distance is the one of the task's own `contact`. It is 0.12 m before the ankle and swings another 0.3 m
    # ahead while the other foot stands. The expert walks through the ball, and turns and steps back below 0.35 m/s.
    interaction=Interaction(
        BALL, FEET, touch=KICK, stance=0.40, predicate="contact", bearing=0.8, loose=True, slow=0.35, tip=TOE
    ),
    without_legs=(
        "the rule asks where the ball goes, not how: the feet that hang from the gliding base meet it as a bumper "
        "would, and push it into the goal at the speed of the base. Only a kick is a matter of legs"
    ),
    semantic_change="texture",
    recolour={BALL: GOAL_OBJECT},
    expert="arena_newton.policies.experts.football:FootballExpert",
    events={1: "ball_out"},
    semantic_variant=ByRules(paper="semantic", released="semantic_released"),
    mode_notes={
        "semantic": ByRules(
            paper="texture-modified goal",
            released="texture-modified goal and a dynamic ball dropped beside the way (scene variant "
            "`semantic_released`)",
        )
    },
)
