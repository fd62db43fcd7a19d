"""The lab as a batch of worlds that differ: friction, payload, forces on the chest, supports and a ball.

The state is given as torch views of the engine's own buffers, and on CUDA nothing here waits for the device after the
start.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
import warp as wp

from arena_newton import rule_sets
from arena_newton.physics.engines import make_physics, resolve_engine
from arena_newton.physics.scene import Scene, load_scene
from arena_newton.robot.g1 import DriveGains, PhysicsRate
from arena_newton.trackers.motions.library import FIXTURES

__all__ = ["Lab", "Start", "WorldKind", "variant"]

CHEST = "torso_link"
"""Link that forces act on, at its centre of mass."""
HANDS = ("left_wrist_yaw_link", "right_wrist_yaw_link")
GRIP = (0.10, 0.0, 0.0)
"""Position of a payload in the frame of a wrist [m]: in the palm."""
BALL = "/World/Ball"
CONTACTS, CONSTRAINTS = 64, 224
"""Buffers per world of engine `warp`: feet, seat and ball at once, with room for a fall."""


@dataclass(frozen=True)
class WorldKind:
    """Differences of a world's model from the scene's."""

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


def variant(scene: Scene, kind: WorldKind) -> mujoco.MjModel:
    """The scene's model with another friction and a payload in each hand; other fields are those of the scene."""
    m = copy.deepcopy(scene.mj_model)
    ball = scene.geom_ids(BALL) if scene.has_body(BALL) else []
    others = np.setdiff1d(np.arange(m.ngeom), ball)
    m.geom_friction[others, 0] = kind.friction
    if kind.payload > 0.0:
        for name in HANDS:
            _add_point_mass(m, scene.link(name), kind.payload, np.array(GRIP))
        mujoco.mj_setConst(m, mujoco.MjData(m))
    return m


def _add_point_mass(m: mujoco.MjModel, body: int, mass: float, point: np.ndarray) -> None:
    """Fuse a point mass into a body: mass, centre, and principal moments by the parallel-axis theorem.

    Training's payloads (`train.events.payload`) add a sphere's moment to all three axes instead: they are drawn for
    every world on the device, where principal axes cannot turn.
    """
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, m.body_iquat[body])
    axes: np.ndarray = flat.reshape(3, 3)
    old, centre = float(m.body_mass[body]), m.body_ipos[body].copy()
    total = old + mass
    joint = (old * centre + mass * point) / total
    inertia = axes @ np.diag(m.body_inertia[body]) @ axes.T
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
    """Worlds of the lab with a robot each; `physics` steps them."""

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
            kinds: Properties of each world.
            watched: Worlds whose force between supports and robot is reported, bool, shape [worlds].
            engine: `auto`, `mujoco` or `warp`.
            threads: CPU threads of engine `mujoco`; all by default.

        Raises:
            InputError: Engine or device is not available.
        """
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
        models = {kind: variant(self.scene, kind) for kind in set(kinds)}
        p = make_physics(self.scene, rate, self.engine, threads, models=[models[kind] for kind in kinds])
        self.physics, h = p, self.scene.robot
        supports = [g for name in FIXTURES for g in self.scene.geom_ids(f"/World/{name}")]
        robot = [g for g, label in enumerate(self.scene.geom_labels) if label.startswith("/World/Robot/")]
        p.watch_pair(supports, robot, watched)
        self.device = wp.device_to_torch(p.device)
        self.qpos, self.qvel, self.xpos = wp.to_torch(p.qpos), wp.to_torch(p.qvel), wp.to_torch(p.xpos)
        self.pair_force = wp.to_torch(p.pair_force)
        self.forces: torch.Tensor = wp.to_torch(p.external_force)[:, :, :3]
        """Force on each body at its centre of mass [N], world frame, shape [worlds, bodies, 3]; stays until changed."""
        self.force: torch.Tensor = self.forces[:, self.scene.link(CHEST)]
        """Force on the chest, shape [worlds, 3]; a view."""
        self.joint_q, self.joint_v = (
            torch.as_tensor(addresses, dtype=torch.long, device=self.device)
            for addresses in (h.joint_qpos, h.joint_qvel)
        )
        self.root_q, self.root_v = h.root_qpos, h.root_qvel
        self.ball_q, self.ball_v = self.scene.joint_qpos(BALL), self.scene.joint_qvel(BALL)

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

    def overflows(self) -> int:
        """Worlds whose contact or constraint buffers overflowed."""
        return sum(self.physics.overflowed(w) for w in range(self.worlds))
