"""Motions in words: sentences such as `walk to 1.2 -0.4` steer the reference generator of one robot.

Whoever decides by sentences, a language model or a script, needs no command of numbers: metres and degrees are those of
the frame in which the robot began, ahead, left and up; those of a hand are of the pelvis.
"""

from __future__ import annotations

import math

import torch

from arena_newton.errors import InputError
from arena_newton.files.text import plain_text
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import heading
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator
from arena_newton.trackers.motions.navigate import Navigator

__all__ = ["VOCABULARY", "WordedMotion"]

VOCABULARY = {
    "walk to <ahead> <left>": "to a point of the start's frame [m], facing where it goes",
    "walk to <ahead> <left> facing <degrees>": "the same with a heading at the end, positive to the left",
    "turn to <degrees>": "a heading on the spot",
    "reach <left|right> <ahead> <left> <up>": "a palm to a point before the pelvis [m]",
    "<close|open> <left|right>": "a hand",
    "crouch <height>": "the pelvis to a height [m], 0.38 to 0.785",
    "sit": "down and back, onto a seat behind the robot",
    "stand": "upright where it is, arms down, hands as they are",
}
"""Sentence → its meaning. Walking, arms, hands and height go on side by side until another sentence changes them."""
SEAT = (0.46, 0.25)
"""Height of the sitting pelvis, and its distance behind where it balances [m]."""
SIDES = {"left": 0, "right": 1}


class WordedMotion:
    """The generator of one robot, which does what the last sentences say."""

    def __init__(self) -> None:
        """Stand at the origin."""
        self.generator, self._navigator = ReferenceGenerator(1), Navigator(1)
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.generator.reset()
        self._navigator.reset()
        self._command = MotionCommand.neutral(1)
        self._goal: torch.Tensor | None = None
        self.arrived = True
        """True once the last walk or turn is over."""

    @property
    def pose(self) -> tuple[float, float, float]:
        """Position ahead and to the left of the start [m], and heading [rad], of the reference: nothing measures it."""
        frames = self.generator.frames
        x, y = frames.root_pos[0, :2].tolist()
        return x, y, float(heading(frames.root_quat)[0])

    def say(self, sentence: str) -> None:
        """Take a sentence.

        Raises:
            InputError: It is none of `VOCABULARY`; the message lists them.
        """
        neutral = MotionCommand.neutral(1)
        try:
            match sentence.lower().split():
                case ["walk", "to", x, y, *facing] if not facing or (facing[0] == "facing" and len(facing) == 2):
                    here, point = self.pose, (_number(x), _number(y))
                    yaw = math.atan2(point[1] - here[1], point[0] - here[0])
                    self._to(*point, math.radians(_number(facing[1])) if facing else yaw)
                case ["turn", "to", degrees]:
                    self._to(*self.pose[:2], math.radians(_number(degrees)))
                case ["reach", ("left" | "right") as side, *point] if len(point) == 3:
                    self._command.hand_point[0, SIDES[side]] = torch.tensor([_number(one) for one in point])
                    self._command.reach[0, SIDES[side]] = 1.0
                case [("close" | "open") as what, ("left" | "right") as side]:
                    self._command.hands[0, SIDES[side]] = float(what == "close")
                case ["crouch", height]:
                    self._command.height[0], self._command.pelvis_back[0] = _number(height), 0.0
                case ["sit"]:
                    self._to(*self.pose)
                    self._command.height[0], self._command.pelvis_back[0] = SEAT
                case ["stand"]:
                    self._to(*self.pose)
                    neutral.hands = self._command.hands
                    self._command = neutral
                case _:
                    raise ValueError
        except ValueError:
            raise InputError(f"{plain_text(sentence, 80)}: expected one of {'; '.join(VOCABULARY)}") from None

    def _to(self, x: float, y: float, yaw: float) -> None:
        """Walk to a pose."""
        self._goal, self.arrived = torch.tensor([[x, y, yaw]]), False
        self._navigator.retarget(torch.ones(1, dtype=torch.bool))

    def actions(self, ticks: int, measured: float | None = None) -> list[list[float]]:
        """Canonical actions of the next ticks, each of 40 numbers.

        Args:
            ticks: Number of them, of 0.02 s.
            measured: The robot's heading [rad], to which the reference turns; without it the reference goes on.
        """
        if measured is not None:
            self.generator.realign(torch.tensor([measured]))
        rows = []
        for _ in range(ticks):
            if self._goal is not None:
                answer = self._navigator.command(torch.tensor([self.pose]), self._goal, TICK)
                self._command.velocity, self.arrived = answer.velocity, bool(answer.arrived[0])
            self.generator.step(self._command)
            rows.append(self.generator.action()[0].tolist())
        return rows


def _number(text: str) -> float:
    """A number of a sentence.

    Raises:
        ValueError: It is none, or not finite.
    """
    number = float(text)
    if not math.isfinite(number):
        raise ValueError
    return number
