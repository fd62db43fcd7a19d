"""Standing: a robot comes to a stand when the source of its actions has nothing of now, and takes up actions again."""

from __future__ import annotations

import numpy as np
import torch

from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import heading, matrix_from_quat, quat_from_rot6d, quat_from_yaw

__all__ = ["SECONDS", "Stander", "between"]

SECONDS = 1.0
"""Time from an action to the stand, and from the stand to a source's actions [s]: the length of two steps."""
_XY, _ROT6D = ACTION["root_xy_delta"], ACTION["root_rot6d"]


def _quat(action: np.ndarray) -> torch.Tensor:
    return quat_from_rot6d(torch.from_numpy(action[_ROT6D]))


def _rot6d(quat: torch.Tensor) -> np.ndarray:
    rot6d: np.ndarray = matrix_from_quat(quat)[:, :2].reshape(6).numpy()
    return rot6d


def between(first: np.ndarray, second: np.ndarray, weight: float) -> np.ndarray:
    """An action between two; the orientation turns along the shorter arc.

    Args:
        first: Canonical action, float32, shape [40].
        second: The same.
        weight: 0 gives the first, 1 the second.

    Returns:
        float32, shape [40].
    """
    mixed: np.ndarray = (first + weight * (second - first)).astype(np.float32)
    a, b = _quat(first), _quat(second)
    b = torch.where((a * b).sum() < 0.0, -b, b)
    mixed[_ROT6D] = _rot6d(torch.nn.functional.normalize(a + weight * (b - a), dim=-1))
    return mixed


class Stander:
    """Puts a source's actions through, and fills its silences with a robot that comes to a stand."""

    def __init__(self) -> None:
        """Stand."""
        self.begin()

    def begin(self) -> None:
        """An episode begins: the robot stands."""
        self._last = STAND_ACTION.copy()
        self._from = STAND_ACTION.copy()
        self._weight = 1.0
        """Fraction of the way from `_from`."""
        self._silent = False
        self.standing = False
        """True if the last action was one of standing still."""

    def action(self, given: np.ndarray | None) -> np.ndarray:
        """The action of this tick.

        Args:
            given: The source's action, float32, shape [40]; None: it has none.

        Returns:
            What to execute, float32, shape [40]; the source's own, bit for bit, as soon as nothing is left to fade.
        """
        if (given is None) != self._silent:
            self._silent, self._from, self._weight = given is None, self._last, 0.0
        self._weight = min(1.0, self._weight + TICK / SECONDS)
        goal = self._stand() if given is None else given
        w = self._weight
        out = goal.copy() if w >= 1.0 else between(self._from, goal, w * w * (3.0 - 2.0 * w))
        self._last, self.standing = out, given is None and w >= 1.0
        return out

    def _stand(self) -> np.ndarray:
        """The standing pose with the heading and the hands of the action at which the source fell silent."""
        stand = STAND_ACTION.copy()
        stand[_ROT6D] = _rot6d(quat_from_yaw(heading(_quat(self._from))))
        stand[ACTION["hands"]] = self._from[ACTION["hands"]]
        return stand
