"""The two protocols of action labels, 40 slots each: v3.1, what is executed, and v4, a command of root velocities.

A v3.1 action names the reference's orientation relative to the episode's heading, and its displacement of a tick. A v4
action names velocities and leaves the heading to whoever executes it: it is integrated from the yaw rate, beginning at
the episode's heading. The original's authors drafted v4 because the orientation labels of two trackers differ more than
their motions (`isaaclab_twist2_g1/docs/UNITREE_G1_GMT_CMD_V4_DATA_PROTOCOL.md` of github.com/Allenhetl/HumanoidArena at
70f0148); no data of it were published. Names, units and the first row are the draft's. Two things differ, so that
an episode's actions come back: velocities are in the frame of the reference root, the draft's in that of the measured
base, and the yaw rate is the difference of the reference's yaws (ZYX), the draft's the z component of its angular
velocity in the measured base.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.files.untrusted_files import numbers
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH, validate_action
from arena_newton.robot.rotations import matrix_from_quat, quat_from_euler

__all__ = ["LABELS", "V4", "LabelProtocol", "V4Decoder", "action_names", "decode_v4", "encode_v4", "protocol"]

V4: dict[str, slice] = {
    "velocity_xy": slice(0, 2),
    "root_z": slice(2, 3),
    "roll_pitch": slice(3, 5),
    "yaw_rate": slice(5, 6),
    "reserved": slice(6, 9),
    "joint_pos": slice(9, 38),
    "hands": slice(38, 40),
}
"""Slots of v4: velocity of the reference root [m/s, its own frame], its height [m, world], roll and pitch (ZYX) [rad],
yaw rate [rad/s], three zeros, reference joint positions [rad], hands. Roll and pitch are those of v3.1's orientation,
and the yaw rate is the change of its yaw."""
RATE_STEP = 2.0**-20
"""Unit of yaw rates [rad/s]. Whole multiples add up exactly, in any order, so that the yaw of an episode does not drift
and does not depend on chunks and worlds; float32 holds those below 16 rad/s exactly."""
MAX_RATE = 1e6
"""Yaw rates are limited to this [rad/s], far beyond any motion, so that their sum stays in 64 bits."""


@dataclass(frozen=True)
class LabelProtocol:
    """Meaning of an action's 40 numbers."""

    name: str
    robot_type: str
    """Name in LeRobot's `info.json`; policy servers check that of v3.1."""
    schema: str
    """Name in the block `vla_protocol` of `info.json`."""
    slots: Mapping[str, slice]
    sentence: str

    def validate(self, actions: object, where: str) -> np.ndarray:
        """Check actions of this protocol and return them as float32.

        Args:
            actions: Array-like, shape [..., 40].
            where: What the message names as the origin.

        Returns:
            float32, shape [..., 40].

        Raises:
            InputError: Wrong width, no numbers, NaN or infinity, or of v3.1 an orientation that names no rotation.
        """
        if self.slots is ACTION:
            return validate_action(actions, where)
        array = numbers(np.asarray(actions), f"{where}: action", np.float32)
        if array.ndim == 0 or array.shape[-1] != ACTION_WIDTH:
            raise InputError(f"{where}: action has shape {list(array.shape)}, expected [..., {ACTION_WIDTH}]")
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            *row, column = bad[0].tolist()
            at = f", row {'/'.join(map(str, row))}" if row else ""
            name = action_names(self.name)[column]
            raise InputError(
                f"{where}{at}: {name} (index {column}) is {array[tuple(bad[0])]}, expected a finite number"
            )
        return array


LABELS: dict[str, LabelProtocol] = {
    "v3.1": LabelProtocol(
        "v3.1",
        "unitree_g1_refpose_v3_1",
        "unitree_g1_gmt_refpose_v3_1",
        ACTION,
        "root displacement of a tick and orientation, as they are executed",
    ),
    "v4": LabelProtocol(
        "v4", "unitree_g1_gmt_cmd_v4", "unitree_g1_gmt_cmd_v4", V4, "root velocity, roll, pitch and yaw rate"
    ),
}
"""Protocols by the name that `--labels` takes."""
_NAMES = {
    "v3.1": (
        *("action.root_ref_base_local_xy_delta.x", "action.root_ref_base_local_xy_delta.y", "action.root_z"),
        *(f"action.root_ref_rot6d.{i}" for i in range(6)),
    ),
    "v4": (
        *("action.root_base_local_vx", "action.root_base_local_vy", "action.root_z", "action.root_roll"),
        *("action.root_pitch", "action.root_yaw_rate", *(f"action.reserved_{i}" for i in range(3))),
    ),
}
"""Names of the first nine slots in LeRobot's datasets; those of v3.1 are the original's, of v4 the draft's (§5.2)."""


def protocol(name: str) -> LabelProtocol:
    """The protocol of a name.

    Raises:
        InputError: There is none.
    """
    if name not in LABELS:
        raise InputError(f"--labels {name}: unknown, choose from {', '.join(LABELS)}")
    return LABELS[name]


def action_names(name: str) -> list[str]:
    """Names of the 40 numbers in LeRobot's datasets."""
    joints = [f"action.joint_pos.{joint}" for joint in g1.CANONICAL_JOINTS]
    return [*_NAMES[protocol(name).name], *joints, "action.hand_binary.left", "action.hand_binary.right"]


def encode_v4(actions: np.ndarray, yaw0: float | None = None) -> np.ndarray:
    """Labels of v4 of an episode.

    The first row of an episode has no velocity and no yaw rate (§6.3 of the draft); the second one's rate takes the
    heading from where the episode begins, so that only the first row's displacement and heading do not come back.

    Args:
        actions: Actions of v3.1, tick by tick, shape [T, 40].
        yaw0: Yaw of the reference before the first of these ticks, in the episode's frame [rad], of rows that continue
            an episode; none where the episode begins with them, at yaw 0.

    Returns:
        float32, shape [T, 40]; `decode_v4` gives all actions but the first back, with an orthonormal orientation.

    Raises:
        InputError: The actions are unfit.
    """
    given = validate_action(actions, "actions")
    if given.ndim != 2:
        raise InputError(f"actions have shape {list(given.shape)}, expected [T, {ACTION_WIDTH}]")
    labels = given.copy()
    columns = given[:, ACTION["root_rot6d"]].astype(np.float64).reshape(-1, 3, 2)
    x = columns[..., 0] / np.linalg.norm(columns[..., 0], axis=1, keepdims=True)
    y = columns[..., 1] - x * (x * columns[..., 1]).sum(axis=1, keepdims=True)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    z = np.cross(x, y)
    begins, before = yaw0 is None, yaw0 or 0.0
    yaw = np.unwrap(np.concatenate([[before], np.arctan2(x[:, 1], x[:, 0])]))
    if begins:
        yaw[1:2] = before
    labels[:, V4["velocity_xy"]] = given[:, ACTION["root_xy_delta"]].astype(np.float64) / g1.TICK
    labels[:, V4["roll_pitch"]] = np.stack(
        [np.arctan2(y[:, 2], z[:, 2]), np.arctan2(-x[:, 2], np.hypot(x[:, 0], x[:, 1]))], axis=1
    )
    # Differences of rounded yaws, not rounded differences: errors do not add up.
    steps = np.diff(np.rint((yaw - before) / (g1.TICK * RATE_STEP)))
    labels[:, V4["yaw_rate"]] = steps[:, None] * RATE_STEP
    if begins:
        labels[:1, V4["velocity_xy"]] = 0.0
    labels[:, V4["reserved"]] = 0.0
    labels[:, V4["roll_pitch"]] += 0.0  # no minus zero
    return labels


def decode_v4(labels: np.ndarray, yaw0: float = 0.0) -> np.ndarray:
    """Actions of v3.1 of an episode's labels of v4.

    Args:
        labels: shape [T, 40].
        yaw0: Yaw before the first of these ticks [rad].

    Returns:
        float32, shape [T, 40]; a row with a number that is not finite has no finite orientation.

    Raises:
        InputError: The labels have another shape.
    """
    if labels.ndim != 2 or labels.shape[1] != ACTION_WIDTH:
        raise InputError(f"labels have shape {list(labels.shape)}, expected [T, {ACTION_WIDTH}]")
    decoder = V4Decoder(1, yaw0=yaw0)
    return decoder.decode(torch.from_numpy(np.ascontiguousarray(labels, np.float32))[None])[0].numpy()


class V4Decoder:
    """Turns chunks of v4 into v3.1 for a batch of worlds; it remembers each world's yaw.

    With `realign` the commanded yaw follows the measured one: of the gap between them at the last measurement a
    fraction is closed each tick, so that after k ticks (1 - realign)^k of it is left. It is rounded as rates are.
    """

    def __init__(
        self,
        worlds: int,
        device: str | torch.device = "cpu",
        *,
        yaw0: float = 0.0,
        realign: float = 0.0,
        late: int = 0,
    ):
        """All worlds at the beginning of an episode.

        Args:
            worlds: Number of worlds.
            device: Torch device of the chunks.
            yaw0: Yaw at the beginning of an episode, in its own frame [rad].
            realign: Fraction of the gap to the measured yaw that is closed each tick; 0: none, and yaws are exact.
            late: Ticks between a measurement and the first action of the chunk that is decoded next: actions of the
                chunk before it that are still to be executed.
        """
        self._start, self._realign = yaw0, realign
        self._turned = torch.zeros((worlds, late + 1), dtype=torch.int64, device=device)
        """Yaw since the beginning after each of the last ticks that were decoded [RATE_STEP ticks], the latest last."""
        self._gap = torch.zeros(worlds, dtype=torch.float64, device=device)
        """Measured minus commanded yaw at the last measurement [rad]."""
        self._age = torch.zeros(worlds, dtype=torch.int64, device=device)
        """Ticks since then."""

    def reset(self, mask: np.ndarray | torch.Tensor | None = None) -> None:
        """Begin new episodes in the worlds of `mask`, bool, shape [worlds]; in all without one."""
        chosen = self._mask(mask)
        self._turned[chosen] = 0
        self._gap[chosen], self._age[chosen] = 0.0, 0

    def measure(self, yaw: torch.Tensor, mask: np.ndarray | torch.Tensor | None = None) -> None:
        """Take the measured heading, `late` ticks before the next chunk begins.

        Args:
            yaw: Of the robot in the episode's frame [rad], shape [worlds]; one that is not finite measures no gap.
            mask: Worlds that are measured, bool, shape [worlds]; all without one.
        """
        if not self._realign:
            return
        chosen = self._mask(mask)
        gap = yaw.double() - (self._start + self._turned[:, 0].double() * (RATE_STEP * g1.TICK))
        gap = torch.nan_to_num(gap, nan=0.0, posinf=0.0, neginf=0.0)
        gap = torch.remainder(gap + np.pi, 2.0 * np.pi) - np.pi
        self._gap = torch.where(chosen, gap, self._gap)
        self._age = torch.where(chosen, 0, self._age)

    def decode(self, chunk: torch.Tensor, mask: np.ndarray | torch.Tensor | None = None) -> torch.Tensor:
        """Actions of v3.1 of a chunk that will be executed to its end.

        Args:
            chunk: Actions of v4, shape [worlds, n, 40].
            mask: Worlds whose yaw goes on, bool, shape [worlds]; all without one. Rows of the others mean nothing.

        Returns:
            float32, shape [worlds, n, 40]; where a root number is not finite, neither is the orientation.
        """
        exact = chunk.double()
        rate = exact[..., V4["yaw_rate"].start]
        steps = torch.nan_to_num(rate, nan=0.0).clamp(-MAX_RATE, MAX_RATE).div(RATE_STEP).round().to(torch.int64)
        turned = self._turned[:, -1:] + steps.cumsum(dim=1)
        chosen = self._mask(mask)
        if self._realign:
            ages = self._age[:, None] + torch.arange(chunk.shape[1] + 1, device=chunk.device)
            closed = self._gap[:, None] * (1.0 - torch.pow(1.0 - self._realign, ages.double()))
            closed = closed.div(RATE_STEP * g1.TICK).round().to(torch.int64)
            turned = turned + closed[:, 1:] - closed[:, :1]
            self._age = torch.where(chosen, ages[:, -1], self._age)
        last = torch.cat([self._turned, turned], dim=1)[:, -self._turned.shape[1] :]
        self._turned = torch.where(chosen[:, None], last, self._turned)
        yaw = self._start + turned.double() * (RATE_STEP * g1.TICK) + 0.0 * rate  # keeps NaN and infinity
        roll, pitch = exact[..., V4["roll_pitch"]].unbind(-1)
        matrix = matrix_from_quat(quat_from_euler(torch.stack([yaw, pitch, roll], dim=-1)))
        actions = chunk.float().clone()
        actions[..., ACTION["root_xy_delta"]] = (exact[..., V4["velocity_xy"]] * g1.TICK).float()
        actions[..., ACTION["root_rot6d"]] = matrix[..., :2].flatten(-2).float()
        return actions

    def _mask(self, mask: np.ndarray | torch.Tensor | None) -> torch.Tensor:
        if mask is None:
            return torch.ones_like(self._age, dtype=torch.bool)
        return torch.as_tensor(mask, dtype=torch.bool, device=self._age.device)
