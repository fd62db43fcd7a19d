"""PushBin's expert: walk behind the bin on its line to the mark, push with both palms, stop when it is there."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from arena_newton.policies.experts.base import Expert, Sight
from arena_newton.policies.experts.phases import Phases, select
from arena_newton.policies.experts.planning import Floor
from arena_newton.policies.experts.style import Style
from arena_newton.policies.experts.walking import Walk, along, passing
from arena_newton.robot.rotations import atan2, rotate_xy
from arena_newton.trackers.motions.commands import MotionCommand

from .task import BIN, ZONE

PHASES = {"approach": 20.0, "push": 15.0, "leave": 1.5, "stand": math.inf}
"""Longest times [s]."""
BEHIND = 0.75
"""Distance from the bin's middle at which the push begins [m]."""
PALMS = ((0.36, 0.13, 0.18), (0.36, -0.13, 0.18))
"""Left and right palm that push, pelvis' heading frame [m]."""
EARLY = 0.07
"""The bin slides on so far when the robot stops [m]."""
BESIDE = 0.25
"""A robot this far beside its line has lost the bin [m]."""


class PushBinExpert(Expert):
    """Walks behind the bin, pushes it along its line to the mark, and steps back; starts over when it lost it."""

    task = "push_bin"

    def __init__(self, sight: Sight):
        """Find bin and mark."""
        super().__init__(sight)
        self._bin, self._mark = sight.scene.body_id(BIN), sight.frame(ZONE)
        self.walk = Walk(sight)
        self.states = Phases(PHASES, sight.worlds, sight.device)
        self._pace = torch.zeros(sight.worlds, device=sight.device)
        self._palms = torch.tensor(PALMS, device=sight.device).expand(sight.worlds, 2, 3)

    def begin(self, mask: Tensor, style: Style) -> None:
        """Go behind the bin."""
        self._pace = torch.where(mask, style.uniform("pace", 0.34, 0.40), self._pace)
        self.walk.begin(mask)
        self.states.begin(mask)
        self._approach(mask)

    def command(self, mask: Tensor, dt: float) -> MotionCommand:
        """Walk, push, step back, stand."""
        states, pose = self.states, self.sight.pose
        states.advance(mask, dt)
        middle, left, yaw = self._line()
        behind = rotate_xy(-yaw, pose[:, :2] - middle)
        states.enter("stand", states.over("leave", mask, lambda: torch.zeros_like(mask)))
        states.enter("leave", mask & states.at("push") & (left < EARLY))
        lost = mask & states.at("push") & (states.late | (behind[:, 1].abs() > BESIDE))
        short = mask & states.at("stand") & (left > 2 * EARLY)
        states.enter("approach", lost | short)
        self._approach(lost | short)
        answer = self.walk.command(mask & states.at("approach"), dt)
        states.enter("push", mask & states.at("approach") & (passing(answer, (0.06, 0.08)) | states.late))

        command = MotionCommand.neutral(self.sight.worlds, self.sight.device)
        forward = self._pace * ((left + 0.1) / 0.4).clamp(0.4, 1.0)
        back = torch.tensor([-0.2, 0.0, 0.0], device=pose.device).expand_as(pose)
        velocity = select(states.at("push"), along(pose, middle, yaw, forward), answer.velocity)
        velocity = select(states.at("leave"), back, velocity)
        command.velocity = select(states.at("stand"), command.velocity, velocity)
        pushing = states.at("push") | states.at("approach") & (answer.distance < 0.3)
        command.hand_point = select(pushing, self._palms, command.hand_point)
        command.reach = pushing[:, None].expand(-1, 2).to(command.reach.dtype)
        return command

    def phases(self) -> list[str]:
        """Names of `PHASES`."""
        return self.states.names()

    def _line(self) -> tuple[Tensor, Tensor, Tensor]:
        """Middle of the bin x, y [m], the way left to the mark [m] and its direction [rad]."""
        middle = self.sight.body(self._bin)[0][:, :2]
        way = self._mark()[:, :2] - middle
        return middle, torch.linalg.vector_norm(way, dim=1), atan2(way[:, 1], way[:, 0])

    def _approach(self, mask: Tensor) -> None:
        """Plan the way behind the bin, around it."""
        middle, _, yaw = self._line()
        start = middle - BEHIND * torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1)
        square = torch.full_like(middle, 0.2)
        floor = Floor(torch.cat([middle, yaw[:, None], square], dim=1)[:, None])
        self.walk.to(mask, torch.cat([start, yaw[:, None]], dim=1), floor)
