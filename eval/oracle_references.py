"""References for the comparison with plain MuJoCo: standing, a squat, a walk from a footstep plan, motion clips.

Each is one stream of canonical actions at 50 Hz, built once and given to both sides. The legs of the squat and of the
walk come from inverse kinematics on the official MJCF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from arena_newton.canonical import ACTION, ACTION_WIDTH
from arena_newton.errors import InputError
from arena_newton.robot import CANONICAL_TO_MUJOCO, DEFAULT_POSE, MUJOCO_JOINTS, TICK
from arena_newton.trackers.motions.kinematics import SOLE_CENTRE, SOLE_HEIGHT

__all__ = ["FEET", "Gait", "LegSolver", "Reference", "clip", "squat", "stand", "walk"]

FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
BLEND = 1.0
"""Time from standing to a reference's first pose [s], without displacement."""


@dataclass(frozen=True)
class Reference:
    """A named stream of canonical actions."""

    name: str
    """What tables call it."""
    actions: np.ndarray
    """float32, shape [ticks, 40], one action each 0.02 s."""


@dataclass(frozen=True)
class Gait:
    """The footstep gait that TWIST2 follows best (measured: 0.13 m drift in 8 s at 0.3 m/s)."""

    step: float = 0.45
    """Time of one step [s]."""
    double_support: float = 0.2
    """Share of a step with both feet on the ground."""
    swing: float = 0.08
    """Height of the swing foot [m]."""
    width: float = 0.22
    """Distance between the feet [m]."""
    height: float = 0.75
    """Pelvis height [m]; free of the swing foot: a bob makes TWIST2 fall."""
    sway: float = 0.05
    """Pelvis sway towards the stance foot [m]."""
    pitch: float = 0.05
    """Forward lean of the pelvis [rad]."""
    reach: float = 1.5
    """A swing ends at the nominal foot pose this many steps after its start: half a stance ahead of the body."""
    ramp: float = 1.0
    """Time from stepping in place to full speed [s]."""


class LegSolver:
    """Both legs by damped Gauss-Newton on a MuJoCo model's kinematics."""

    DAMPING = 1e-3

    def __init__(self, model: Any):
        """Start at the default pose."""
        import mujoco

        self._mj, self.model, self.data = mujoco, model, mujoco.MjData(model)
        joints = [model.joint(n) for n in MUJOCO_JOINTS]
        self.qpos = np.array([int(j.qposadr[0]) for j in joints])
        self._dof = np.array([int(j.dofadr[0]) for j in joints])[:12]
        self._low, self._high = np.array([j.range for j in joints])[:12].T
        self._feet = [int(model.body(n).id) for n in FEET]
        self._pelvis = int(model.body("pelvis").id)
        self._jac = np.zeros((12, model.nv))
        self.joints = np.array(DEFAULT_POSE)
        """Present solution [rad], MuJoCo order."""

    def forward(self, position: np.ndarray, rotation: np.ndarray) -> None:
        """Kinematics at a root pose with the present joints."""
        self.data.qpos[:3] = position
        self._mj.mju_mat2Quat(self.data.qpos[3:7], rotation.ravel())
        self.data.qpos[self.qpos] = self.joints
        self._mj.mj_kinematics(self.model, self.data)
        self._mj.mj_comPos(self.model, self.data)

    @property
    def feet(self) -> np.ndarray:
        """Ankle roll frames [m], shape [2, 3]."""
        return self.data.xpos[self._feet].copy()

    @property
    def centre_of_mass(self) -> np.ndarray:
        """Of the whole robot [m], shape [3]."""
        return self.data.subtree_com[self._pelvis].copy()

    def error(self, feet: np.ndarray) -> np.ndarray:
        """Distance to flat feet at the given places: per foot 3 [m] and 3 [rad], shape [12]."""
        out = np.zeros((2, 6))
        for side, body in enumerate(self._feet):
            out[side, :3] = feet[side] - self.data.xpos[body]
            # The rotation that levels the foot and turns it to +x, as a rotation vector in the world.
            self._mj.mju_quat2Vel(out[side, 3:], self.data.xquat[body] * [1.0, -1.0, -1.0, -1.0], 1.0)
        return out.ravel()

    def solve(self, position: np.ndarray, rotation: np.ndarray, feet: np.ndarray, iterations: int = 8) -> float:
        """Move the legs so that flat feet stand at `feet` [2, 3]; returns the largest error left [m or rad]."""
        for _ in range(iterations):
            self.forward(position, rotation)
            for side, body in enumerate(self._feet):
                rows = self._jac[6 * side : 6 * side + 6]
                self._mj.mj_jacBody(self.model, self.data, rows[:3], rows[3:], body)
            jac = self._jac[:, self._dof]
            step = np.linalg.solve(jac.T @ jac + self.DAMPING**2 * np.eye(12), jac.T @ self.error(feet))
            self.joints[:12] = np.clip(self.joints[:12] + step, self._low, self._high)
        self.forward(position, rotation)
        return float(np.abs(self.error(feet)).max())


def _lean(pitch: float) -> np.ndarray:
    c, s = np.cos(pitch), np.sin(pitch)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _smooth(share: float) -> float:
    """Minimum-jerk course from 0 to 1."""
    t = min(max(share, 0.0), 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t * t)


def _actions(
    positions: Sequence[np.ndarray], rotations: Sequence[np.ndarray], joints: Sequence[np.ndarray]
) -> np.ndarray:
    """Canonical actions of a root path and joints: displacement in the root frame of the tick, then the rest."""
    path, turn = np.asarray(positions), np.asarray(rotations)
    actions = np.zeros((len(path), ACTION_WIDTH))
    moved = np.diff(path, axis=0, prepend=path[:1])
    actions[:, ACTION["root_xy_delta"]] = np.einsum("tji,tj->ti", turn, moved)[:, :2]
    actions[:, ACTION["root_z"]] = path[:, 2:]
    actions[:, ACTION["root_rot6d"]] = turn[:, :, :2].reshape(len(path), 6)
    actions[:, ACTION["joint_pos"]] = np.asarray(joints)[:, list(CANONICAL_TO_MUJOCO)]
    return actions.astype(np.float32)


def _with_start(name: str, actions: np.ndarray) -> Reference:
    from arena_newton.trackers.motions.playback import startup_actions

    return Reference(name, np.concatenate([startup_actions(actions[0], stand=0.0, blend=BLEND), actions]))


def stand(seconds: float = 10.0) -> Reference:
    """Stand still."""
    from arena_newton.env import STAND_ACTION

    return Reference(f"stand {seconds:g} s", np.repeat(STAND_ACTION[None], round(seconds / TICK), axis=0))


def squat(
    model: Any, *, top: float = 0.79, bottom: float = 0.45, move: float = 2.0, hold: float = 1.0, lean: float = 0.4
) -> Reference:
    """Lower the pelvis over fixed feet with the centre of mass above their middle, hold, and rise.

    Args:
        model: The official MJCF, compiled.
        top: Pelvis height at start and end [m].
        bottom: Pelvis height of the squat [m].
        move: Time of going down, and of going up [s].
        hold: Time at the bottom [s].
        lean: Forward lean of the pelvis at the bottom [rad].

    Raises:
        InputError: The legs do not reach.
    """
    solver = LegSolver(model)
    solver.forward(np.array([0.0, 0.0, top]), np.eye(3))
    feet = solver.feet
    feet[:, 2] = SOLE_HEIGHT
    target = feet[:, 0].mean() + SOLE_CENTRE
    x = 0.0
    times = np.arange(round((2 * move + hold) / TICK) + 1) * TICK
    positions, rotations, joints = [], [], []
    for t in times:
        depth = _smooth(t / move) if t < move + hold else 1.0 - _smooth((t - move - hold) / move)
        rotation = _lean(lean * depth)
        for _ in range(4):
            position = np.array([x, 0.0, top + (bottom - top) * depth])
            left = solver.solve(position, rotation, feet, iterations=3)
            x += target - solver.centre_of_mass[0]
        if left > 0.02:
            raise InputError(f"squat: the legs do not reach at {t:.2f} s, {left:.3f} m or rad are left")
        positions.append(position)
        rotations.append(rotation)
        joints.append(solver.joints.copy())
    return _with_start(f"squat to {bottom:g} m", _actions(positions, rotations, joints))


def walk(model: Any, speed: float = 0.3, seconds: float = 8.0, gait: Gait | None = None) -> Reference:
    """Walk straight on: footsteps planned ahead of the body, legs by inverse kinematics.

    The nominal place of an ankle is beside the pelvis, neither ahead nor behind: a walk with the middle of the soles
    there instead runs 0.4 m ahead of its reference in 8 s.

    Args:
        model: The official MJCF, compiled.
        speed: Speed after the ramp [m/s].
        seconds: Length without the start [s].
        gait: Shape of the steps.

    Raises:
        InputError: The legs do not reach.
    """
    g = gait or Gait()
    solver = LegSolver(model)
    rotation = _lean(g.pitch)

    def travelled(t: float) -> float:
        return speed * (t - g.ramp / 2) if t > g.ramp else speed * t * t / (2 * g.ramp)

    def nominal(side: int, t: float) -> np.ndarray:
        return np.array([travelled(t), (0.5 - side) * g.width, SOLE_HEIGHT])

    feet = np.array([nominal(0, 0.0), nominal(1, 0.0)])
    solver.solve(np.array([0.0, 0.0, g.height]), rotation, feet, iterations=50)
    positions, rotations, joints = [], [], []
    lifted, current = feet.copy(), 0
    for t in np.arange(round(seconds / TICK)) * TICK:
        count = int(t / g.step + 1e-9)
        if count != current:
            feet[current % 2] = nominal(current % 2, (current + g.reach) * g.step)
            lifted, current = feet.copy(), count
        side, share = count % 2, t / g.step - count
        swing = min(max((share - g.double_support / 2) / (1.0 - g.double_support), 0.0), 1.0)
        landing = nominal(side, (count + g.reach) * g.step)
        feet[side] = lifted[side] + _smooth(swing) * (landing - lifted[side])
        feet[side, 2] = SOLE_HEIGHT + g.swing * np.sin(np.pi * swing) ** 2
        sway = -g.sway * np.sin(np.pi * t / g.step) * min(t / g.step, 1.0)
        position = np.array([travelled(t), sway, g.height])
        left = solver.solve(position, rotation, feet)
        if left > 0.02:
            raise InputError(f"walk: the legs do not reach at {t:.2f} s, {left:.3f} m or rad are left")
        positions.append(position)
        rotations.append(rotation)
        joints.append(solver.joints.copy())
    return _with_start(f"walk {speed:g} m/s", _actions(positions, rotations, joints))


def clip(path: str | Path, seconds: float | None = None) -> Reference:
    """A motion clip as the replay policy plays it, jumps at its start cut off; `seconds` keeps the first ones only.

    Two of them lead from standing to the clip's first pose.
    """
    from arena_newton.policies.replay import ReplayPolicy

    actions = ReplayPolicy(path).actions
    return Reference(Path(path).stem, actions if seconds is None else actions[: round(seconds / TICK)])
