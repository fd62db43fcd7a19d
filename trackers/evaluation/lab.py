"""The lab as a batch of worlds that differ: friction, payload, forces on the chest, and what stands on the floor.

One interface over both engines; state and controls are torch views of the engine's own buffers, and on CUDA nothing
here waits for the device after the start.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton.physics import MujocoPhysics, WarpPhysics, resolve_engine
from arena_newton.trackers.motions.library import FIXTURES

if TYPE_CHECKING:
    import torch

    from arena_newton.robot import DriveGains, PhysicsRate

__all__ = ["Lab", "Start", "WorldKind", "variant"]

CHEST = "torso_link"
"""Link that forces act on, at its centre of mass."""
HANDS = ("left_wrist_yaw_link", "right_wrist_yaw_link")
GRIP = (0.10, 0.0, 0.0)
"""Where a payload sits in the frame of a wrist [m]: in the palm."""
BALL = "/World/Ball"
CONTACTS, CONSTRAINTS = 64, 224
"""Buffers a world of engine `warp`: feet, seat and ball at once, with room for a fall."""
_FIELDS = ("body_mass", "body_ipos", "body_inertia", "body_iquat", "body_subtreemass", "body_invweight0")
"""What a payload changes in a MuJoCo model, and `geom_friction` and `dof_invweight0`."""


@dataclass(frozen=True)
class WorldKind:
    """What makes a world's model different from the scene's."""

    friction: float = 1.0
    """Sliding friction of everything but the ball."""
    payload: float = 0.0
    """Point mass in each hand [kg]."""


@dataclass
class Start:
    """Initial states, rows are worlds."""

    root: np.ndarray
    """Position [m] and orientation wxyz, [worlds, 7]."""
    joints: np.ndarray
    """[rad], MuJoCo order, [worlds, 29]."""
    supports: dict[str, np.ndarray]
    """Support to poses (x, y, z of the top face, yaw), [worlds, 4]; NaN leaves it parked."""
    ball: np.ndarray
    """Centre of the ball [m], [worlds, 3]; NaN leaves it parked."""


class _LabMujoco(MujocoPhysics):
    """Native MuJoCo with a model a kind of world, forces on the chest, and pair forces of chosen worlds only."""

    def prepare(self, kinds: list[WorldKind], watched: np.ndarray) -> None:
        models = {kind: variant(self.scene, kind, self.mj_model) for kind in set(kinds)}
        self._models = [models[kind] for kind in kinds]
        self._watched = watched
        self._chest = self.scene.link(CHEST)
        self.force = np.zeros((self.worlds, 3), dtype=np.float32)

    def _step_share(self, share: Iterator[int]) -> None:
        n, step, ctrl = self.rate.substeps, self._mj.mj_step, self._np["ctrl"]
        for w in share:
            d = self._data[w]
            d.ctrl[:] = ctrl[w]
            d.xfrc_applied[self._chest, :3] = self.force[w]
            step(self._models[w], d, n)
            self._publish(w, d)

    def read_contacts(self) -> None:
        """Forces between the watched groups, in the worlds that ask for them."""
        for w in np.flatnonzero(self._active & self._watched):
            self._np["pair_force"][w] = self._pair_normal(self._data[w])

    def add_velocity(self, change: np.ndarray) -> None:
        """Change the root's velocity: linear in the world, angular in the body frame, [worlds, 6]."""
        at = self.scene.robot.root_qvel
        for d, row in zip(self._data, change, strict=True):
            d.qvel[at : at + 6] += row
        self._np["qvel"][:, at : at + 6] += change


class _LabWarp(WarpPhysics):
    """mujoco_warp with per-world rows of the model's fields."""

    def prepare(self, kinds: list[WorldKind], watched: np.ndarray) -> None:
        import warp as wp

        models = {kind: variant(self.scene, kind, self.mj_model) for kind in set(kinds)}
        for name in (*_FIELDS, "geom_friction", "dof_invweight0"):
            array = getattr(self._m, name)
            rows = np.stack([getattr(models[kind], name) for kind in kinds]).astype(np.float32)
            array.assign(rows.reshape(array.numpy().shape))
        self.force = wp.to_torch(self._d.xfrc_applied)[:, self.scene.link(CHEST), :3]

    def add_velocity(self, change: np.ndarray) -> None:
        """Change the root's velocity: linear in the world, angular in the body frame, [worlds, 6]."""
        at = self.scene.robot.root_qvel
        qvel = self._d.qvel.numpy()
        qvel[:, at : at + 6] += change
        self._d.qvel.assign(qvel)


def variant(scene: Any, kind: WorldKind, model: Any = None) -> Any:
    """A model of the scene (its own by default) with another friction and a payload in each hand."""
    import mujoco

    m = copy.deepcopy(scene.mj_model if model is None else model)
    ball = scene.geom_ids(BALL) if scene.has_body(BALL) else []
    others = np.setdiff1d(np.arange(m.ngeom), ball)
    m.geom_friction[others, 0] = kind.friction
    if kind.payload > 0.0:
        for name in HANDS:
            _add_point_mass(m, scene.link(name), kind.payload, np.array(GRIP))
        mujoco.mj_setConst(m, mujoco.MjData(m))
    return m


def _add_point_mass(m: Any, body: int, mass: float, point: np.ndarray) -> None:
    """Fuse a point mass into a body: mass, centre, and principal moments by the parallel-axis theorem."""
    import mujoco

    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, m.body_iquat[body])
    turn: Any = flat.reshape(3, 3)
    old, centre = float(m.body_mass[body]), m.body_ipos[body].copy()
    total = old + mass
    joint = (old * centre + mass * point) / total
    inertia = turn @ np.diag(m.body_inertia[body]) @ turn.T
    for part, at in ((old, centre), (mass, point)):
        r = at - joint
        inertia = inertia + part * (r @ r * np.eye(3) - np.outer(r, r))
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1.0
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    m.body_mass[body], m.body_ipos[body] = total, joint
    m.body_inertia[body], m.body_iquat[body] = moments, quat


class Lab:
    """Worlds of the lab with a robot each; see `start` and `step`."""

    def __init__(
        self,
        kinds: list[WorldKind],
        watched: np.ndarray,
        *,
        drive: DriveGains,
        rate: PhysicsRate,
        engine: str = "auto",
        device: str | None = None,
        threads: int | None = None,
    ):
        """Build the scene for as many worlds as there are kinds.

        Args:
            kinds: What each world is like.
            watched: Worlds whose force between supports and robot is reported, bool, shape [worlds].
            drive: Gains of the robot's drives.
            rate: Physics step and substeps a tick.
            engine: `auto`, `mujoco` or `warp`.
            device: Warp device.
            threads: CPU threads of engine `mujoco`; all by default.

        Raises:
            InputError: Engine or device is not here.
        """
        import torch
        import warp as wp

        from arena_newton import rule_sets
        from arena_newton.scene import load_scene

        self.engine, device = resolve_engine(engine, device)
        self.worlds = len(kinds)
        self.scene = load_scene(
            "lab",
            worlds=self.worlds,
            device=device,
            hands="fixed",
            variant="ball",
            rules=rule_sets.get("paper"),
            drive=drive,
            native=self.engine == "mujoco",
            contacts_per_world=CONTACTS,
            constraints_per_world=CONSTRAINTS,
        )
        native = self.engine == "mujoco"
        self.physics: Any = _LabMujoco(self.scene, rate, threads) if native else _LabWarp(self.scene, rate)
        supports = [g for name in FIXTURES for g in self.scene.geom_ids(f"/World/{name}")]
        robot = [g for g, label in enumerate(self.scene.geom_labels) if label.startswith("/World/Robot/")]
        self.physics.watch_pair(supports, robot)
        self.physics.prepare(kinds, watched)
        self.device = wp.device_to_torch(self.physics.device)
        p, h = self.physics, self.scene.robot
        self.qpos, self.qvel = wp.to_torch(p.qpos), wp.to_torch(p.qvel)
        self.xpos, self.xquat = wp.to_torch(p.xpos), wp.to_torch(p.xquat)
        self.ctrl, self.pair_force = wp.to_torch(p.ctrl), wp.to_torch(p.pair_force)
        force: Any = p.force
        self.force: torch.Tensor = torch.from_numpy(force) if native else force
        """Force on the chest [N], world frame, [worlds, 3]; stays until changed."""

        def indices(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.long, device=self.device)

        self.joint_q, self.joint_v = indices(h.joint_qpos), indices(h.joint_qvel)
        self.joint_ctrl = indices(h.joint_ctrl)
        self.root_q, self.root_v = h.root_qpos, h.root_qvel
        self.ball_q = self.scene.joint_qpos(BALL)
        self.ball_v = self.scene.joint_qvel(BALL)

    def start(self, start: Start) -> None:
        """Put every world at rest in its initial state."""
        p = self.physics
        qpos = p.qpos0.copy()
        qpos[:, self.root_q : self.root_q + 7] = start.root
        qpos[:, self.scene.robot.joint_qpos] = start.joints
        placed = np.isfinite(start.ball).all(axis=1)
        qpos[placed, self.ball_q : self.ball_q + 3] = start.ball[placed]
        position = np.tile(p.mocap_pos0, (self.worlds, 1, 1))
        quat = np.tile(p.mocap_quat0, (self.worlds, 1, 1))
        for name, pose in start.supports.items():
            rows = np.isfinite(pose).all(axis=1)
            mocap = self.scene.mocap_id(f"/World/{name}")
            position[rows, mocap] = pose[rows, :3]
            half = 0.5 * pose[rows, 3]
            quat[rows, mocap] = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
        p.reset_worlds(np.arange(self.worlds), qpos, position, quat)
        self.force.zero_()

    def add_velocity(self, change: np.ndarray) -> None:
        """Change the root's velocity: linear [m/s] in the world, angular [rad/s] in the body frame, [worlds, 6]."""
        self.physics.add_velocity(change.astype(np.float32))

    def set_active(self, mask: torch.Tensor) -> None:
        """Spare engine `mujoco` the worlds that have ended; a batch on the GPU steps as one and does not ask."""
        if self.engine == "mujoco":
            self.physics.set_active(mask.numpy())

    def step(self, targets: torch.Tensor) -> None:
        """Drive the joints to `targets` [rad], MuJoCo order, [worlds, 29], for one tick."""
        self.ctrl.index_copy_(1, self.joint_ctrl, targets)
        self.physics.step()

    def overflows(self) -> int:
        """Worlds whose contact or constraint buffers overflowed."""
        if self.engine == "warp":
            return int(self.physics.overflow.numpy().sum())
        return sum(self.physics.overflowed(w) for w in range(self.worlds))
