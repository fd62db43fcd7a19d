"""Football's expert: walk onto the line behind the ball, then through the ball towards the goal.

No kick motion: a foot of a robot that walks at 0.6 m/s sends the ball off at 0.8 to 2.3 m/s, and it rolls on without
loss. What decides is that the robot is on its line at the touch: 13 cm beside it, the ball leaves 24° off. So it walks
slower the farther it is from the line, and tries again after a weak kick or a miss. The foot that kicks is the one on
the ball's side of the picture.

Read from the head camera's picture (105° wide, from 3° below the horizon down): the ball, which is in view at the spawn
pose wherever it is drawn; whether it moves, and where to; the goal, whose mouth is ahead and does not move; the other
ball of the released rule set's semantic scene, which lies on the way. The true positions are a stand-in for these.
"""

from __future__ import annotations

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.phases import Phases, select
from arena_newton.policies.experts.planning import Floor
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import Walk, along
from arena_newton.robot.rotations import atan2, rotate_xy
from arena_newton.tasks.football import BALL, GOAL
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.navigate import NavigationLimits

__all__ = ["FootballExpert"]

DISTRACTOR = "/World/Distractor"
"""The second ball; only in the semantic scene of the rule set `released`."""
PHASES = {"approach": 12.0, "kick": 5.0, "follow": 2.0, "watch": 8.0}
"""Longest times [s]: the farthest ball is 4 m away; the line is 0.9 m long; four steps for a weak touch; 4 m at
0.5 m/s."""
STEP = 0.4
"""Time that the robot walks on after a touch [s]: the step that it is in."""
WEAK = 0.5
"""A ball slower than this [m/s] is touched again: the robot that walks on overtakes it."""
LANE = 0.115
"""The foot that kicks is this far beside the pelvis [m]: half of a walking stance."""
AIM_BEHIND = 0.37
"""The ball is aimed at a point this far behind the goal line [m]."""
AIM_SHARE = 0.5
"""Fraction of the ball's sideways distance from the goal's middle that the aim keeps: the line is then nearer to
straight ahead, and the ball still crosses the goal line far from the posts."""
AIM_WITHIN = 0.8
"""Largest distance of the aim from the goal's middle [m]; the posts are at 2.5 m."""
CLEAR = 0.36
"""Distance that the ball's path should keep from the other ball [m]: two radii and an error of 5° over 1.5 m."""
FROM_POST = 0.5
"""Distance from a post that an aim past the other ball keeps [m]."""
AIMS = 25
"""Number of aims that are compared."""
COLLISION = 30.0
"""Cost of a lack of that distance against a shift of the aim [m per m]."""
ON_LINE = (0.09, 0.12)
"""Errors behind the ball with which the kick begins [m, rad]; the walk along the line takes what is left."""
SLOW_DOWN = (6.0, 0.15)
"""Speed lost for a distance from the line [1/m], and the least fraction of it."""
TOUCHED = 0.15
"""Change of the ball's velocity during a kick that tells a touch [m/s]."""
PASSED = 0.20
"""A pelvis this far past the ball has missed it [m]."""
ROLLED = 0.03
"""A ball that rolled this far since the path was planned requires a new one [m]."""
CAUGHT = 0.6
"""A slower ball is walked after: its velocity is added to the robot's [m/s]."""
SLOW = 0.08
"""A ball slower than this counts as at rest [m/s]."""
LONGEST_ROLL = 8.0
"""A ball that needs longer than this to the goal line is kicked again [s]."""


class FootballExpert(Expert):
    """`approach` a pose behind the ball, `kick` by walking through, `follow` until it rolls well, `watch` it roll."""

    task = "football"

    def __init__(self, sight: Sight):
        """Find ball and goal."""
        super().__init__(sight)
        worlds, device = sight.worlds, sight.device
        self._ball = sight.scene.body_id(BALL)
        self._velocity = sight.velocity(BALL)
        self._others = [sight.scene.body_id(DISTRACTOR)] if sight.scene.has_body(DISTRACTOR) else []
        self._goal, self._goal_half = sight.frame(GOAL), sight.scene.marker(GOAL).half
        self._radius = float(sight.scene.mj_model.geom_size[sight.scene.geom_ids(BALL)[0], 0])
        self.walk = Walk(sight, NavigationLimits(forward=0.55, turn=0.9))
        self.states = Phases(PHASES, worlds, device)
        self.lane = torch.zeros(worlds, 3, device=device)
        """The line to walk: the point next to the ball x, y [m], and its direction [rad], shape [worlds, 3]."""
        self._aimed = torch.zeros(worlds, 2, device=device)
        self._before = torch.zeros(worlds, 2, device=device)
        self._side = torch.zeros(worlds, device=device)
        self._speed, self._back, self._step_time = (torch.zeros(worlds, device=device) for _ in range(3))
        self._arms = MotionCommand.neutral(worlds, device).arms

    def begin(self, mask: Tensor, style: Style) -> None:
        """Look where the ball is."""
        self._speed = torch.where(mask, style.uniform("speed", 0.54, 0.63), self._speed)
        self._back = torch.where(mask, style.uniform("back", 0.68, 0.82), self._back)
        self._step_time = torch.where(mask, style.uniform("step", 0.44, 0.47), self._step_time)
        arms = MotionCommand.neutral(self.sight.worlds, self.sight.device).arms
        for column, name in ((0, "shoulder"), (3, "elbow")):  # the same in both arms
            arms[:, [column, column + 7]] += style.uniform(name, -0.15, 0.15)[:, None]
        self._arms = select(mask, arms, self._arms)
        self.walk.begin(mask)
        self.states.begin(mask)
        self._choose_foot(mask)
        self._approach(mask)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Walk behind the ball, through it, or stand and watch."""
        states, pose = self.states, self.sight.pose
        states.advance(mask, dt)
        ball, velocity = self.sight.body(self._ball)[0][:, :2], self._velocity()[:, :2]
        speed = torch.linalg.vector_norm(velocity, dim=1)

        kicking = mask & states.at("kick")
        touched = kicking & (torch.linalg.vector_norm(velocity - self._before, dim=1) > TOUCHED)
        states.enter("follow", touched)
        following = mask & states.at("follow")
        kicked = following & (states.clock >= STEP) & (speed > WEAK)
        states.enter("watch", kicked | following & states.late)
        kicking = mask & states.at("kick", "follow")
        # A ball that rolls takes its line with it; once kicked well, the step is ended on the old one.
        if kicking.any():
            self.lane = select(kicking & (speed < WEAK), self._line(ball), self.lane)
        missed = kicking & (speed < WEAK) & (self._ahead(pose)[:, 0] > PASSED)
        missed = missed | mask & states.at("kick") & states.late
        over = states.over("watch", mask, lambda: (speed < SLOW) | self._hopeless(ball, velocity))
        states.enter("approach", missed | over)
        self._choose_foot(missed | over)
        away = torch.linalg.vector_norm(ball - self._aimed, dim=1) > ROLLED
        again = missed | over | mask & states.at("approach") & (away | states.late)
        if again.any():
            self._approach(again)

        answer = self.walk.command(mask & states.at("approach"), dt)
        near = (answer.distance < ON_LINE[0]) & (answer.heading_error.abs() < ON_LINE[1])
        begins = mask & states.at("approach") & (near | answer.arrived)
        self._before = select(begins, velocity, self._before)
        states.enter("kick", begins)

        drift = rotate_xy(-pose[:, 2], velocity) * ((speed > SLOW) & (speed < CAUGHT))[:, None]
        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        command.velocity = select(states.at("approach"), answer.velocity, command.velocity)
        if states.present("kick", "follow"):
            off, (steep, least) = self._ahead(pose)[:, 1].abs(), SLOW_DOWN
            forward = self._speed * (1.0 - steep * off).clamp_min(least)
            through = along(pose, self.lane[:, :2], self.lane[:, 2], forward)
            command.velocity = select(states.at("kick", "follow"), through, command.velocity)
        command.velocity[:, :2] += drift * states.at("approach", "kick")[:, None]
        command.step_time = self._step_time
        command.arms = self._arms
        return command

    def phases(self) -> list[str]:
        """`approach`, `kick`, `follow` or `watch`."""
        return self.states.names()

    def _ahead(self, pose: Tensor) -> Tensor:
        """The robot on its line: past the ball, and to the left [m], shape [worlds, 2]."""
        return rotate_xy(-self.lane[:, 2], pose[:, :2] - self.lane[:, :2])

    def _hopeless(self, ball: Tensor, velocity: Tensor) -> Tensor:
        """Worlds whose ball, as it rolls now, reaches the goal line too late, never, or past a post, shape [worlds]."""
        goal, (wide, deep, _) = self._goal(), self._goal_half
        left = goal[:, 1] - deep - ball[:, 1]
        time = left / velocity[:, 1].clamp_min(1e-3)
        return (time > LONGEST_ROLL) | ((ball[:, 0] + time * velocity[:, 0] - goal[:, 0]).abs() > wide)

    def _line(self, ball: Tensor) -> Tensor:
        """The line on which the kicking foot meets the ball, as `lane`, shape [worlds, 3]."""
        offset = self._aim(ball) - ball
        yaw = atan2(offset[:, 1], offset[:, 0])
        beside = torch.stack([torch.zeros_like(self._side), self._side], dim=1)
        return torch.cat([ball + rotate_xy(yaw, beside), yaw[:, None]], dim=1)

    def _choose_foot(self, mask: Tensor) -> None:
        """The foot on the ball's side of the picture, so that who sees the picture knows the line."""
        if not mask.any():
            return
        pose, ball = self.sight.pose, self.sight.body(self._ball)[0][:, :2]
        left = rotate_xy(-pose[:, 2], ball - pose[:, :2])[:, 1] > 0.0
        self._side = torch.where(mask, torch.where(left, -LANE, LANE), self._side)

    def _approach(self, mask: Tensor) -> None:
        """Draw the line through the ball, and plan the path to its beginning."""
        ball = self.sight.body(self._ball)[0][:, :2]
        self._aimed = select(mask, ball, self._aimed)
        self.lane = select(mask, self._line(ball), self.lane)
        back = torch.stack([-self._back, torch.zeros_like(self._back)], dim=1)
        start = self.lane[:, :2] + rotate_xy(self.lane[:, 2], back)
        self.walk.to(mask, torch.cat([start, self.lane[:, 2:]], dim=1), Floor(self._boxes()))
        self.states.enter("approach", mask & self.states.late)

    def _boxes(self) -> Tensor:
        """The balls on the floor as squares, shape [worlds, balls, 5]."""
        balls = torch.stack([self.sight.body(body)[0][:, :2] for body in (self._ball, *self._others)], dim=1)
        return torch.cat([balls, torch.zeros_like(balls[..., :1]), torch.full_like(balls, self._radius)], dim=2)

    def _aim(self, ball: Tensor) -> Tensor:
        """Point in the goal to which the ball must roll [m], shape [worlds, 2]."""
        goal = self._goal()[:, :2]
        line = goal[:, 1] - self._goal_half[1] + AIM_BEHIND
        middle = goal[:, 0]
        x = middle + (AIM_SHARE * (ball[:, 0] - middle)).clamp(-AIM_WITHIN, AIM_WITHIN)
        for body in self._others:
            other = self.sight.body(body)[0][:, :2]
            x = self._past(other, ball, x, line, middle)
        return torch.stack([x, line], dim=1)

    def _past(self, other: Tensor, ball: Tensor, x: Tensor, line: Tensor, middle: Tensor) -> Tensor:
        """The x of the aim nearest to a wanted one with which the ball's path clears another ball [m]."""
        wide = self._goal_half[0] - FROM_POST
        aims = middle[:, None] + torch.linspace(-wide, wide, AIMS, device=x.device)
        path = torch.stack([aims, line[:, None].expand_as(aims)], dim=2) - ball[:, None]
        offset = (other - ball)[:, None]
        fraction = ((offset * path).sum(2) / path.square().sum(2)).clamp(0.0, 1.0)
        gap = torch.linalg.vector_norm(offset - fraction[..., None] * path, dim=2)
        price = (aims - x[:, None]).abs() + COLLISION * (CLEAR - gap).clamp_min(0.0)
        nearest = torch.gather(aims, 1, price.argmin(dim=1, keepdim=True))[:, 0]
        blocked = ((aims - x[:, None]).abs() < wide / AIMS) & (gap < CLEAR)
        return torch.where(blocked.any(dim=1), nearest, x)
