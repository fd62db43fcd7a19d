"""Measures of a rollout, accumulated on the device: nothing leaves it before the last tick.

Names are those of the motion tracking literature; every value is one number per rollout, taken until its end or fall.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from arena_newton.robot import g1
from arena_newton.robot.g1 import FEET
from arena_newton.robot.rotations import heading, rotate_xy, wrap_angle
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT

if TYPE_CHECKING:
    from arena_newton.trackers.evaluation.lab import Lab

__all__ = ["FALL_HEIGHT", "FALL_TILT_DEG", "LINKS", "Meter", "TickReference"]

FALL_TILT_DEG = 60.0
"""A pelvis tilted beyond this has fallen [deg]."""
FALL_HEIGHT = (0.2, 0.4)
"""A pelvis 0.2 m below its reference has fallen, but never above 0.4 m and always below 0.2 m [m]."""
FALL_DROP = 0.2
LINKS: tuple[str, ...] = tuple(
    f"{side}_{part}_link"
    for side in ("left", "right")
    for part in ("hip_roll", "knee", "ankle_roll", "shoulder_roll", "elbow", "wrist_yaw")
) + ("torso_link",)
"""Links whose position counts in the link error."""
CONTACT_HEIGHT = SOLE_HEIGHT + 0.01
"""An ankle frame below this counts as a foot on the floor [m]."""
SEAT_LOAD = 100.0
"""Force that counts as sitting [N]."""
SEAT_SMOOTHING = 0.1
"""Time constant of the seat's force [s]: the solver's force of one step jitters."""
LEGS, ARMS = (slice(block[0], block[-1] + 1) for block in (g1.LEGS, g1.ARMS))

_POSTURE = ("joint", "legs", "arms", "link", "velocity", "height", "tilt", "slip", "contact", "rate", "torque", "limit")
_WINDOW = ("speed_x", "speed_y", "speed_yaw", "ref_x", "ref_y", "ref_yaw")


@dataclass
class TickReference:
    """The reference of one tick, rows are worlds."""

    position: torch.Tensor
    """Root in the world [m], [worlds, 3]."""
    quat: torch.Tensor
    """Root orientation wxyz, [worlds, 4]."""
    joints: torch.Tensor
    """[rad], MuJoCo order, [worlds, 29]."""
    links: torch.Tensor
    """`LINKS` relative to the root in its heading frame [m], [worlds, links, 3]."""


class Meter:
    """Accumulators of a batch of rollouts; `update` after every tick, `results` once at the end."""

    def __init__(self, lab: Lab, end: np.ndarray, window: np.ndarray, *, traced: int = 0):
        """Allocate.

        Args:
            end: Length of each rollout [ticks], shape [worlds].
            window: First tick that counts for mean speeds, shape [worlds].
            traced: Number of ticks whose errors are kept.
        """
        self.lab = lab
        w, device = lab.worlds, lab.device

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(w, *shape, device=device)

        def indices(names: tuple[str, ...]) -> torch.Tensor:
            return torch.tensor([lab.scene.link(n) for n in names], dtype=torch.long, device=device)

        self.end = torch.as_tensor(end, device=device)
        self.window = torch.as_tensor(window, device=device)
        self.fallen = torch.zeros(w, dtype=torch.bool, device=device)
        """Worlds that have fallen, [worlds]."""
        self.fall_tick = torch.full((w,), -1, dtype=torch.long, device=device)
        self.errors: torch.Tensor = torch.full((traced, w, 2), torch.nan, device=device)
        """Link error [m] and planar velocity error [m/s] of each tick that is kept, NaN after a fall or the end, shape
        [ticks, worlds, 2]."""
        self._links, self._feet = indices(LINKS), indices(FEET)
        drive = lab.scene.drive
        self._kp, self._kd, self._effort = (torch.tensor(v, device=device) for v in (drive.kp, drive.kd, drive.effort))
        self._sum, self._count = zeros(len(_POSTURE)), zeros()
        self._window_sum, self._window_count = zeros(len(_WINDOW)), zeros()
        self._last: dict[str, torch.Tensor] = {}
        self._end_offset, self._end_turn = zeros(2), zeros()
        self._end_root = zeros(4)
        self._lowest, self._lowest_ref = zeros() + 10.0, zeros() + 10.0
        self._ball_peak, self._ball_end = zeros(), zeros()
        self._force, self._streak, self._loaded, self._touch = zeros(), zeros(), zeros(), zeros()

    def _root(self) -> tuple[torch.Tensor, torch.Tensor]:
        q, at = self.lab.qpos, self.lab.root_q
        return q[:, at : at + 3], q[:, at + 3 : at + 7]

    def anchor(self, targets: torch.Tensor, reference: torch.Tensor) -> None:
        """Store the state before the first tick: root, feet, targets and the reference's root [worlds, 3]."""
        position, quat = self._root()
        yaw, feet = heading(quat), self.lab.xpos[:, self._feet]
        self._remember(position=position, yaw=yaw, ref_position=reference, ref_yaw=yaw, feet=feet, targets=targets)

    def _remember(self, **state: torch.Tensor) -> None:
        """Keep the state of this tick for the differences of the next."""
        self._last = {name: value.clone() for name, value in state.items()}

    def update(self, tick: int, reference: TickReference, targets: torch.Tensor) -> torch.Tensor:
        """Take one tick into account; returns the worlds that still run, bool [worlds].

        Args:
            tick: Ticks since the anchor, negative in the start-up, where only falls are detected.
            reference: Reference of this tick.
            targets: Joint targets of this tick [rad], [worlds, 29].
        """
        position, quat = self._root()
        up = 1.0 - 2.0 * (quat[:, 1].square() + quat[:, 2].square())
        z = position[:, 2]
        floor = (reference.position[:, 2] - FALL_DROP).clamp(*FALL_HEIGHT)
        standing = (up > float(np.cos(np.radians(FALL_TILT_DEG)))) & (z > floor)  # false for NaN
        running = ~self.fallen & (self.end > tick)
        falls = running & ~standing
        self.fallen |= falls
        self.fall_tick = torch.where(falls, tick, self.fall_tick)
        live = running & standing
        if tick >= 0:
            self._posture(live, tick, reference, targets, position, quat, up)
            self._events(live)
        return live

    def _posture(
        self,
        live: torch.Tensor,
        tick: int,
        reference: TickReference,
        targets: torch.Tensor,
        position: torch.Tensor,
        quat: torch.Tensor,
        up: torch.Tensor,
    ) -> None:
        lab, last = self.lab, self._last
        joints, speed = lab.qpos.index_select(1, lab.joint_q), lab.qvel.index_select(1, lab.joint_v)
        error = (joints - reference.joints).square()
        yaw, ref_yaw = heading(quat), heading(reference.quat)

        offset = lab.xpos[:, self._links] - position[:, None]
        level = torch.cat([rotate_xy(-yaw[:, None], offset[..., :2]), offset[..., 2:]], dim=-1)
        link = torch.linalg.vector_norm(level - reference.links, dim=-1).mean(1)

        moved = rotate_xy(-yaw, (position - last["position"])[:, :2]) / g1.TICK
        ref_moved = rotate_xy(-ref_yaw, (reference.position - last["ref_position"])[:, :2]) / g1.TICK
        turned, ref_turned = wrap_angle(yaw - last["yaw"]) / g1.TICK, wrap_angle(ref_yaw - last["ref_yaw"]) / g1.TICK

        feet = lab.xpos[:, self._feet]
        down = (torch.maximum(feet[..., 2], last["feet"][..., 2]) < CONTACT_HEIGHT).float()
        slip = torch.linalg.vector_norm((feet - last["feet"])[..., :2], dim=-1) / g1.TICK
        torque = (self._kp * (targets - joints) - self._kd * speed) / self._effort
        ref_up = 1.0 - 2.0 * (reference.quat[:, 1].square() + reference.quat[:, 2].square())

        velocity = (moved - ref_moved).square().sum(1)
        if tick < len(self.errors):
            self.errors[tick] = torch.where(live[:, None], torch.stack([link, velocity.sqrt()], dim=1), torch.nan)
        values = torch.stack(
            [
                error.mean(1),
                error[:, LEGS].mean(1),
                error[:, ARMS].mean(1),
                link,
                velocity,
                (position[:, 2] - reference.position[:, 2]).abs(),
                (torch.acos(up.clamp(-1, 1)) - torch.acos(ref_up.clamp(-1, 1))).abs(),
                (slip * down).sum(1),
                down.sum(1),
                ((targets - last["targets"]) / g1.TICK).square().mean(1),
                torque.abs().clamp_max(1.0).mean(1),
                (torque.abs() > 0.95).float().mean(1),
            ],
            dim=1,
        )
        self._sum += torch.where(live[:, None], values, 0.0)
        self._count += live
        counted = live & (self.window <= tick)
        speeds = torch.stack([*moved.unbind(1), turned, *ref_moved.unbind(1), ref_turned], dim=1)
        self._window_sum += torch.where(counted[:, None], speeds, 0.0)
        self._window_count += counted

        self._end_offset = torch.where(live[:, None], (position - reference.position)[:, :2], self._end_offset)
        self._end_turn = torch.where(live, wrap_angle(yaw - ref_yaw), self._end_turn)
        self._end_root = torch.where(live[:, None], torch.cat([position, yaw[:, None]], 1), self._end_root)
        self._lowest = torch.where(live, torch.minimum(self._lowest, position[:, 2]), self._lowest)
        self._lowest_ref = torch.where(
            live, torch.minimum(self._lowest_ref, reference.position[:, 2]), self._lowest_ref
        )
        self._remember(
            position=position, yaw=yaw, ref_position=reference.position, ref_yaw=ref_yaw, feet=feet, targets=targets
        )

    def _events(self, live: torch.Tensor) -> None:
        lab = self.lab
        ball = torch.linalg.vector_norm(lab.qvel[:, lab.ball_v : lab.ball_v + 2], dim=1)
        self._ball_peak = torch.where(live, torch.maximum(self._ball_peak, ball), self._ball_peak)
        self._ball_end = torch.where(live, ball, self._ball_end)
        gain = g1.TICK / (SEAT_SMOOTHING + g1.TICK)
        self._force = self._force + gain * (lab.pair_force - self._force)
        self._touch = torch.where(live, torch.maximum(self._touch, lab.pair_force), self._touch)
        # A leaky count: every tick below the load takes one back.
        step = torch.where(self._force >= SEAT_LOAD, g1.TICK, -g1.TICK)
        self._streak = torch.where(live, (self._streak + step).clamp_min(0.0), self._streak)
        self._loaded = torch.maximum(self._loaded, self._streak)

    def results(self) -> dict[str, np.ndarray]:
        """Every measure as an array [worlds]; the one transfer from the device.

        `joint_rmse`, `leg_rmse`, `arm_rmse` [rad]; `mpjpe`: mean link error relative to the root in the heading frame
        [m]; `velocity_error`: RMS of the root's planar velocity error [m/s]; `height_error` [m]; `tilt_error` [rad];
        `drift`: planar distance from the reference at the end [m]; `drift_10s`: the same scaled to 10 s [m];
        `heading_error` at the end [deg]; `foot_slip`: mean planar speed of a foot on the floor [m/s]; `action_rate`:
        RMS of the targets' rate [rad/s]; `torque`: mean fraction of the torque limit; `saturation`: fraction of joint
        ticks above 95 % of it; `speed_*`, `ref_*`: mean speeds in the heading frame [m/s], [rad/s]; `ball_peak`,
        `ball_end` [m/s]; `seat_time`: time at 100 N and more, minus the gaps [s]; `touch`: largest force on a support
        [N]; `lowest`, `lowest_ref`: lowest pelvis [m]; `end_x`, `end_y`, `end_z` [m], `end_yaw` [rad]: root at the end.
        """
        host: Callable[[torch.Tensor], np.ndarray] = lambda t: t.double().cpu().numpy()  # noqa: E731
        count = np.maximum(host(self._count), 1.0)
        mean = {name: column / count for name, column in zip(_POSTURE, host(self._sum).T, strict=True)}
        windowed = host(self._window_sum) / np.maximum(host(self._window_count), 1.0)[:, None]
        seconds = count * g1.TICK
        offset = np.linalg.norm(host(self._end_offset), axis=1)
        out = {
            "fell": host(self.fallen) > 0.5,
            "fall_time": np.where(host(self.fall_tick) != -1, host(self.fall_tick) * g1.TICK, np.nan),
            "seconds": seconds,
            "joint_rmse": np.sqrt(mean["joint"]),
            "leg_rmse": np.sqrt(mean["legs"]),
            "arm_rmse": np.sqrt(mean["arms"]),
            "mpjpe": mean["link"],
            "velocity_error": np.sqrt(mean["velocity"]),
            "height_error": mean["height"],
            "tilt_error": mean["tilt"],
            "drift": offset,
            "drift_10s": offset * 10.0 / seconds,
            "heading_error": np.degrees(np.abs(host(self._end_turn))),
            "foot_slip": host(self._sum)[:, _POSTURE.index("slip")]
            / np.maximum(host(self._sum)[:, _POSTURE.index("contact")], 1.0),
            "action_rate": np.sqrt(mean["rate"]),
            "torque": mean["torque"],
            "saturation": mean["limit"],
            "ball_peak": host(self._ball_peak),
            "ball_end": host(self._ball_end),
            "seat_time": host(self._loaded),
            "touch": host(self._touch),
            "lowest": host(self._lowest),
            "lowest_ref": host(self._lowest_ref),
        }
        out |= dict(zip(("end_x", "end_y", "end_z", "end_yaw"), host(self._end_root).T, strict=True))
        return out | dict(zip(_WINDOW, windowed.T, strict=True))
