"""Messages between a robot and a policy server, whatever the bytes are: the codecs translate these records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from arena_newton.pictures.settings import FRONT
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

if TYPE_CHECKING:
    from arena_newton.policies.protocols.packed_picture import PackedPicture

__all__ = [
    "LONGEST_CHUNK",
    "MAX_SEED",
    "MAX_STEP",
    "PICTURE_SIDES",
    "Begin",
    "End",
    "Query",
    "Request",
    "check_picture_size",
    "read_actions",
    "read_count",
    "read_picture",
    "read_state",
    "read_text",
]

LONGEST_CHUNK = 4096
"""Most actions of a chunk."""
PICTURE_SIDES = (16, 2048)
"""Smallest and largest width and height of a picture [px]."""
MOST_PIXELS = 1920 * 1200
"""Most pixels of a picture."""
MAX_SEED = 2**63 - 1
"""Largest seed of an episode."""
MAX_STEP = 10**9
"""Largest number of executed actions."""
LONGEST_TEXT = 4096
"""Most characters of a task's name, an instruction or the name of a session."""


@dataclass(frozen=True)
class Begin:
    """An episode begins in a session."""

    session: str = ""
    """Name of the robot within its connection."""
    seed: int | None = None
    """Episode seed; None: the server chooses."""
    task: str = ""
    """Gym id or name of the task; empty: not given."""
    instruction: str = ""


@dataclass(frozen=True)
class Query:
    """A robot shows what it sees and asks for a chunk."""

    state: np.ndarray
    """Canonical state, float32, shape [64]."""
    images: Mapping[str, np.ndarray | PackedPicture] = field(default_factory=dict)
    """Picture of each camera by its name (`pictures.settings.CAMERAS`), uint8, shape [H, W, 3], red first; or as its
    sender packed it."""
    task: str = ""
    """Task as in `Begin`."""
    instruction: str = ""
    session: str = ""
    """Session as in `Begin`."""
    seed: int | None = None
    """Seed as in `Begin`; with `step` 0 it begins an episode that no `Begin` has announced."""
    step: int | None = None
    """Actions that the episode has executed so far; None: not given."""
    robot_type: str = ""
    """The label protocol's `robot_type` that the robot executes; empty: not given."""

    @property
    def image(self) -> np.ndarray | PackedPicture | None:
        """The head camera's picture."""
        return self.images.get(FRONT)


@dataclass(frozen=True)
class End:
    """An episode is over."""

    session: str = ""
    """Session as in `Begin`."""
    result: Mapping[str, object] = field(default_factory=dict)
    """The robot's report of it."""


type Request = Begin | Query | End
"""Message of a robot."""


def read_state(value: object, where: str) -> np.ndarray:
    """The 64 numbers of a state as float32.

    Raises:
        WireError: Other numbers, or other than finite ones.
    """
    array = _numbers(value, f"{where}: state")
    if array.shape != (STATE_WIDTH,):
        raise WireError(f"{where}: state has shape {list(array.shape)}, expected [{STATE_WIDTH}]")
    if not np.isfinite(array).all():
        index = int(np.flatnonzero(~np.isfinite(array))[0])
        raise WireError(f"{where}: state[{index}] is {array[index]}, expected a finite number")
    return array


def read_actions(value: object, where: str) -> np.ndarray:
    """A chunk as float32, shape [n, 40]; one action of 40 numbers is a chunk of one.

    Raises:
        WireError: Another shape, or no numbers. Whether they are finite is the label protocol's to check.
    """
    array = _numbers(value, f"{where}: actions")
    if array.ndim == 1:
        array = array[None]
    if array.ndim != 2 or array.shape[1] != ACTION_WIDTH or not 1 <= len(array) <= LONGEST_CHUNK:
        expected = f"expected [n, {ACTION_WIDTH}] with n of 1 to {LONGEST_CHUNK}"
        raise WireError(f"{where}: actions have shape {list(array.shape)}, {expected}")
    return array


def read_picture(value: object, where: str) -> np.ndarray:
    """A picture, uint8, shape [H, W, 3].

    Raises:
        WireError: It is none.
    """
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8:
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise WireError(f"{where}: the picture is {kind}, expected uint8")
    if value.ndim != 3 or value.shape[2] != 3:
        raise WireError(f"{where}: the picture has shape {list(value.shape)}, expected [H, W, 3]")
    check_picture_size(value.shape[1], value.shape[0], where)
    return value


def check_picture_size(width: int, height: int, where: str) -> None:
    """Check width and height of a picture [px].

    Raises:
        WireError: It is too small or too large.
    """
    low, high = PICTURE_SIDES
    if not (low <= width <= high and low <= height <= high and width * height <= MOST_PIXELS):
        expected = f"{low} to {high} pixels a side and at most {MOST_PIXELS}"
        raise WireError(f"{where}: a picture of {width}x{height}, expected {expected}")


def read_text(value: object, where: str, name: str) -> str:
    """A text of a message; an absent one is empty.

    Raises:
        WireError: It is no text, or too long.
    """
    if value is None:
        return ""
    if not isinstance(value, str) or len(value) > LONGEST_TEXT:
        raise WireError(f"{where}: {name} is not a text of at most {LONGEST_TEXT} characters")
    return value


def read_count(value: object, where: str, name: str, most: int) -> int | None:
    """A whole number from 0 to `most`; an absent one is None.

    Raises:
        WireError: It is another.
    """
    if value is None:
        return None
    if isinstance(value, np.ndarray) and value.shape in ((), (1,)) and value.dtype.kind in "iu":
        value = value.item()
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
        raise WireError(f"{where}: {name} is {str(value)[:40]!r}, expected a whole number from 0 to {most}")
    return value


def _numbers(value: object, where: str) -> np.ndarray:
    """Real numbers as float32; lists of lists of numbers count."""
    if isinstance(value, list):
        if not all(_plain(item) for item in value):
            raise WireError(f"{where}: holds something that is not a number")
        try:
            value = np.array(value, dtype=np.float64)
        except (ValueError, OverflowError):
            raise WireError(f"{where}: rows of different length, or a number that is too large") from None
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise WireError(f"{where}: {kind}, expected numbers")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(value, dtype=np.float32)


def _plain(item: object) -> bool:
    if isinstance(item, list):
        return all(isinstance(one, int | float) and not isinstance(one, bool) for one in item)
    return isinstance(item, int | float) and not isinstance(item, bool)
