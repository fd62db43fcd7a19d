"""The original benchmark's Redis interface: names of its keys, and what is in them.

Names and meanings are those of the original's `reset_control.py` and of its teleoperation server; values are JSON text.
Keys that begin with `arena_` are our own.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from arena_newton.errors import InputError
from arena_newton.robot.g1 import HAND_CLOSE_LEFT, HAND_CLOSE_RIGHT, MUJOCO_JOINTS

__all__ = [
    "ACTION_BODY",
    "ACTION_HANDS",
    "BACKENDS",
    "CAMERA",
    "CONTROLLERS",
    "GMR_BODY_POS",
    "GMR_BODY_QUAT",
    "GMR_FRAME_INDEX",
    "GMR_JOINT_POS",
    "LARGEST",
    "RECORDING_CONTROL",
    "RESET_COMPLETE",
    "RESET_TRIGGER",
    "RESET_TTL",
    "STATE_BODY",
    "STATE_HANDS",
    "STATE_NECK",
    "STATUS",
    "T_ACTION",
    "T_STATE",
    "Backend",
    "RecordingCommand",
    "closed_hands",
    "input_ready",
    "numbers",
    "parse",
    "recording_command",
    "stamp",
]

SUFFIX = "_unitree_g1_with_hands"
"""Robot in the names of most keys."""
LARGEST = 65_536
"""A value with more bytes is refused; the longest of the original's, the human skeleton, has 5 kB."""
JOINTS = len(MUJOCO_JOINTS)

ACTION_BODY = f"action_body{SUFFIX}"
"""35 numbers: the mimic command, joints in MuJoCo (TWIST2) order."""
ACTION_HANDS = (f"action_hand_left{SUFFIX}", f"action_hand_right{SUFFIX}")
"""7 numbers each: joint targets of a hand [rad]."""
ACTION_NECK = f"action_neck{SUFFIX}"
CONTROLLERS = "controller_data"
"""`LeftController` and `RightController` with, among others, `grip_binary`: the hand is to close; `index_trig` and
`grip`, 0 to 1, are its trigger and grip."""
SIDES = ("Left", "Right")
"""Hands in the order of our actions, as the controllers are named."""
PRESSED = 0.5
"""A trigger or grip beyond this is pressed (the original's sender)."""
RECORDING_CONTROL = f"recording_control{SUFFIX}"
"""`active`, `command`, `sequence`, `timestamp_ms`, `source`; a command counts when its sequence changes."""
T_ACTION = "t_action"
"""Time at which the sender wrote, on its clock [ms]."""
GMR_JOINT_POS = f"gmr_joint_pos{SUFFIX}"
"""29 numbers: reference joint positions [rad], canonical order."""
GMR_BODY_POS = f"gmr_body_pos{SUFFIX}"
"""3 numbers: reference root position [m]."""
GMR_BODY_QUAT = f"gmr_body_quat_w{SUFFIX}"
"""4 numbers: reference root orientation wxyz."""
GMR_FRAME_INDEX = f"gmr_frame_index{SUFFIX}"
"""Number of the reference's frame."""
RESET_TRIGGER = "isaac_reset_trigger"
"""Asks for a reset: `reset_category` and `timestamp` [ms]."""
RESET_COMPLETE = f"isaac_reset_complete{SUFFIX}"
"""Says that one is done: `status` and `timestamp` [ms]."""
RESET_TTL = 5
"""Life of those two [s]."""
STATE_BODY = f"state_body{SUFFIX}"
"""34 numbers: angular velocity in the body frame [rad/s], roll, pitch, 29 joint positions [rad], MuJoCo order."""
STATE_HANDS = (f"state_hand_left{SUFFIX}", f"state_hand_right{SUFFIX}")
"""7 numbers each."""
STATE_NECK = f"state_neck{SUFFIX}"
"""2 numbers."""
T_STATE = "t_state"
"""Time at which the state was written, on our clock [ms]."""
CAMERA = f"arena_camera_front{SUFFIX}"
"""The head camera's newest picture, JPEG bytes."""
STATUS = f"arena_status{SUFFIX}"
"""`tick`, `recording`, `outcome`, `note` and `factor` of the session, for the person's display."""

_COMMON: tuple[str, ...] = (ACTION_BODY, *ACTION_HANDS, ACTION_NECK, f"human_smplx_data{SUFFIX}", f"human_info{SUFFIX}")
_COMMON += (CONTROLLERS, RECORDING_CONTROL, T_ACTION)
_GMR = (GMR_JOINT_POS, f"gmr_joint_vel{SUFFIX}", GMR_BODY_POS, GMR_BODY_QUAT, f"gmr_full_qpos{SUFFIX}", GMR_FRAME_INDEX)


@dataclass(frozen=True)
class Backend:
    """Messages that a sender sends for one kind of tracker."""

    name: str
    stream: tuple[str, ...]
    """Keys that are deleted before an episode, so that nothing old is taken for new."""

    @property
    def ready(self) -> str:
        """Key by which the simulator says that it takes input."""
        return f"isaac_input_ready_{self.name}{SUFFIX}"


BACKENDS: Mapping[str, Backend] = {
    "twist2": Backend("twist2", _COMMON),
    "sonic_joint29": Backend("sonic_joint29", _COMMON + _GMR),
}
"""Formats by name: `twist2` sends the mimic command, `sonic_joint29` root pose and joints of the retargeted person."""


def parse(key: str, raw: bytes) -> object:
    """JSON of a value.

    Args:
        key: Its name, for the message.
        raw: The value.

    Raises:
        InputError: Too long, or not JSON.
    """
    if len(raw) > LARGEST:
        raise InputError(f"{key}: more than {LARGEST} bytes")
    try:
        return json.loads(raw)
    except (ValueError, RecursionError):
        raise InputError(f"{key}: is not JSON") from None


def numbers(key: str, raw: bytes, count: int) -> np.ndarray:
    """A list of finite numbers, float64, shape [count].

    Raises:
        InputError: It is something else.
    """
    found = parse(key, raw)
    if not isinstance(found, list) or not all(type(n) in (int, float) for n in found):
        raise InputError(f"{key}: is not a list of numbers")
    if len(found) != count:
        raise InputError(f"{key}: {len(found)} numbers, expected {count}")
    try:
        values = np.array(found, dtype=np.float64)
    except OverflowError:
        raise InputError(f"{key}: a number is out of range") from None
    if not np.isfinite(values).all():
        raise InputError(f"{key}: a number is not finite")
    return values


def stamp(key: str, raw: bytes) -> float | None:
    """A time or a frame's number; None where the key is absent.

    Raises:
        InputError: It is something else.
    """
    if not raw:
        return None
    found = parse(key, raw)
    if not isinstance(found, int | float) or isinstance(found, bool) or not abs(found) < 2**63:
        raise InputError(f"{key}: is not a number")
    return float(found)


def closed_hands(controllers: bytes, hands: tuple[bytes, bytes]) -> np.ndarray | None:
    """Hands to close, left and right: 0 or 1, float32, shape [2].

    Args:
        controllers: Value of `CONTROLLERS`. Of each hand its `grip_binary` decides, as in the original's labels;
            without one `index_trig` above `PRESSED` closes, else `grip` above it opens, as in the original's sender.
        hands: Values of `ACTION_HANDS`; each decides where its controller says nothing: nearer to closed than to open.

    Returns:
        None where neither hand is mentioned; a hand that alone is not mentioned is open.

    Raises:
        InputError: A value is something else than it must be.
    """
    found = parse(CONTROLLERS, controllers) if controllers else None
    closed: list[bool | None] = []
    for side, key, raw, close in zip(SIDES, ACTION_HANDS, hands, (HAND_CLOSE_LEFT, HAND_CLOSE_RIGHT), strict=True):
        pressed = _controlled(found.get(f"{side}Controller")) if isinstance(found, dict) else None
        if pressed is None and raw:
            target = np.asarray(close)
            pressed = bool(numbers(key, raw, len(close)) @ target > 0.5 * target @ target)
        closed.append(pressed)
    if closed == [None, None]:
        return None
    return np.array([bool(pressed) for pressed in closed], dtype=np.float32)


def _controlled(controller: object) -> bool | None:
    """True if a controller closes its hand; None where it has no value for it."""
    if not isinstance(controller, dict):
        return None
    binary = controller.get("grip_binary")
    if isinstance(binary, bool):
        return binary
    for button, closes in (("index_trig", True), ("grip", False)):
        pressed = controller.get(button)
        if isinstance(pressed, int | float) and not isinstance(pressed, bool) and pressed > PRESSED:
            return closes
    return None


@dataclass(frozen=True)
class RecordingCommand:
    """A command of the person about the recording."""

    command: str
    sequence: int


def recording_command(raw: bytes) -> RecordingCommand | None:
    """Command in `RECORDING_CONTROL`; None where it is absent.

    Raises:
        InputError: It is something else.
    """
    if not raw:
        return None
    found = parse(RECORDING_CONTROL, raw)
    command, sequence = (found.get("command"), found.get("sequence")) if isinstance(found, dict) else (None, None)
    if not isinstance(command, str) or type(sequence) is not int:
        raise InputError(f"{RECORDING_CONTROL}: needs a text `command` and a whole number `sequence`")
    return RecordingCommand(command, sequence)


def input_ready(backend: Backend) -> str:
    """Value of `Backend.ready`: a new epoch, from which on input counts."""
    now = time.time()
    return json.dumps(
        {
            "backend": backend.name,
            "source": "arena_newton",
            "epoch_id": int(now * 1e6),
            "ready_timestamp_ms": int(now * 1e3),
            "ready_timestamp_realtime": now,
            "ready_timestamp_monotonic": time.monotonic(),
        }
    )
