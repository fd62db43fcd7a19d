"""Engine `mujoco`: native MuJoCo on the CPU, one `MjData` per world, several threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import mujoco
import numpy as np
import warp as wp

from arena_newton.physics.batch import Physics
from arena_newton.physics.scene import Scene
from arena_newton.robot.g1 import PhysicsRate

__all__ = ["MujocoPhysics", "MujocoSnapshot", "lone_joints"]

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_BUFFERS_FULL = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)


def lone_joints(model: mujoco.MjModel) -> np.ndarray:
    """Free joints of bodies that move by themselves: those that have no other joint in their tree."""
    joints = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    found: np.ndarray = joints[model.tree_dofnum[model.body_treeid[model.jnt_bodyid[joints]]] == 6]
    return found


@dataclass(frozen=True)
class MujocoSnapshot:
    """State of all worlds; see `MujocoPhysics.snapshot`."""

    state: np.ndarray
    """MuJoCo's `mjSTATE_INTEGRATION`, float64, shape [worlds, size]."""
    overflows: np.ndarray
    """Warnings of full buffers since the reset, int, shape [worlds, 2]."""
    views: dict[str, np.ndarray]
    """Published arrays, rows are worlds."""


class MujocoPhysics(Physics):
    """Native MuJoCo: one `MjData` per world, several threads, bit-identical for any number of worlds."""

    engine = "mujoco"

    def __init__(
        self,
        scene: Scene,
        rate: PhysicsRate,
        threads: int | None = None,
        *,
        models: Sequence[mujoco.MjModel] | None = None,
    ):
        """Allocate one `MjData` per world; see `physics.make_physics`."""
        super().__init__(scene, rate, models)
        mujoco.set_mju_user_warning(_ignore_warning)
        for model in self._models:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._data = [mujoco.MjData(model) for model in self._model_of]
        m = scene.mj_model
        self._host: dict[str, np.ndarray] = {
            "contact_force": self.contact_force.numpy(),
            "pair_force": self.pair_force.numpy(),
            "latch": self.latch_locked.numpy(),
        }
        self.qpos = self._shared("qpos", m.nq)
        self.qvel = self._shared("qvel", m.nv)
        self.ctrl = self._shared("ctrl", m.nu)
        self.xpos = self._shared("xpos", m.nbody, 3)
        self.xquat = self._shared("xquat", m.nbody, 4)
        self.xipos = self._shared("xipos", m.nbody, 3)
        quat = scene.robot.root_qpos + 3
        self._root_xy = self._host["qpos"][:, quat + 1], self._host["qpos"][:, quat + 2]
        self._force: wp.array | None = None
        # Views made once: a property of MjData costs about as much as the copy behind it.
        names = ("qpos", "qvel", "xpos", "xquat", "xipos")
        self._copies = [[(self._host[n][w], getattr(d, n)) for n in names] for w, d in enumerate(self._data)]
        self._targets = [(d.ctrl, self._host["ctrl"][w]) for w, d in enumerate(self._data)]
        self._pair: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self.threads = max(1, min(threads or len(os.sched_getaffinity(0)), self.worlds))
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self._active = np.ones(self.worlds, dtype=bool)
        self._reset_all()

    def _shared(self, name: str, *shape: int) -> wp.array:
        """A Warp array [worlds, *shape] over the memory of a NumPy array in `_host`."""
        buffer = self._host[name] = np.zeros((self.worlds, *shape), dtype=np.float32)
        return wp.array(buffer, dtype=wp.float32, device="cpu", copy=False)

    @property
    def data(self) -> Sequence[mujoco.MjData]:
        """MuJoCo's own state of each world; the Warp views follow it at the next step."""
        return tuple(self._data)

    @property
    def external_force(self) -> wp.array:
        """See `Physics.external_force`."""
        if self._force is None:
            self._force = self._shared("external_force", self.nbody, 6)
        return self._force

    def watch_pair(self, geoms_a: Sequence[int], geoms_b: Sequence[int], worlds: np.ndarray | None = None) -> None:
        """See `Physics.watch_pair`."""
        a, b = np.zeros((2, self.scene.mj_model.ngeom), dtype=bool)
        a[geoms_a], b[geoms_b] = True, True
        self._pair = (a, b, np.ones(self.worlds, dtype=bool) if worlds is None else worlds)

    def set_active(self, mask: np.ndarray) -> None:
        """See `Physics.set_active`."""
        self._active[:] = mask

    def _each(self, work: Callable[[Iterator[int]], None], worlds: np.ndarray) -> None:
        # One iterator for all threads: each takes the next world when it is free, so that a slow core delays nobody.
        queue = iter(worlds.tolist())
        others = [self._pool.submit(work, queue) for _ in range(self.threads - 1)] if self._pool else []
        work(queue)
        for other in others:
            other.result()

    def step(self) -> None:
        """See `Physics.step`."""
        self._each(self._step_worlds, np.flatnonzero(self._active))
        self._read_contacts()

    def _step_worlds(self, queue: Iterator[int]) -> None:
        n, step = self.rate.substeps, mujoco.mj_step
        latch, locked, qpos = self.scene.latch, self._host["latch"], self._host["qpos"]
        force = self._host.get("external_force")
        for w in queue:
            d = self._data[w]
            target, source = self._targets[w]
            target[:] = source
            if force is not None:
                d.xfrc_applied[:] = force[w]
            if latch is not None:
                d.eq_active[latch.equality] = locked[w]
            step(self._model_of[w], d, n)
            self._publish(w, d)
            if latch is not None and qpos[w, latch.handle_qpos] <= latch.release_angle:
                locked[w] = 0

    def _publish(self, w: int, d: mujoco.MjData) -> None:
        mujoco.mj_kinematics(self._model_of[w], d)
        for target, source in self._copies[w]:
            target[:] = source

    def put(self, world: int, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put a world into a state; what its solver starts from stays.

        Args:
            qpos: Positions, shape [nq].
            qvel: Velocities, shape [nv].
        """
        d = self._data[world]
        d.qpos[:], d.qvel[:] = qpos, qvel
        self._publish(world, d)

    def follow(self, data: Sequence[mujoco.MjData]) -> None:
        """Take over what a tick has left of other copies of the worlds, one `MjData` each: state, contacts, latch."""
        for w, given in enumerate(data):
            mujoco.mj_copyData(self._data[w], self._model_of[w], given)
            self._publish(w, self._data[w])
            if self.scene.latch is not None:
                self._host["latch"][w] = given.eq_active[self.scene.latch.equality]
        self._read_contacts()

    def mj_step_only(self) -> None:
        """See `Physics.mj_step_only`."""
        self._each(self._solve_worlds, np.arange(self.worlds))

    def _solve_worlds(self, queue: Iterator[int]) -> None:
        n, step = self.rate.substeps, mujoco.mj_step
        for w in queue:
            step(self._model_of[w], self._data[w], n)

    def _read_contacts(self) -> None:
        """Contact forces of the last physics step."""
        asked = self._active
        if not self.want_forces:
            x, y = self._root_xy
            asked = asked & (1.0 - 2.0 * (x**2 + y**2) < 0.5)
        if asked.any():
            for w in np.flatnonzero(asked):
                self._host["contact_force"][w] = self._body_forces(self._data[w])
        if self._pair is not None:
            for w in np.flatnonzero(self._active & self._pair[2]):
                self._host["pair_force"][w] = self._pair_normal(self._data[w], *self._pair[:2])

    def overflowed(self, world: int) -> bool:
        """See `Physics.overflowed`."""
        warning = self._data[world].warning
        return any(warning[kind].number for kind in _BUFFERS_FULL)

    def _body_forces(self, d: mujoco.MjData) -> np.ndarray:
        """Norm of the net contact force on each body [N], shape [nbody]."""
        total = np.zeros((self.nbody, 3))
        normal, tangent, frame, bodies = self._contact_forces(d, slice(None))
        if len(normal):
            force = np.einsum("ck,ckj->cj", np.column_stack([normal, tangent]), frame)
            np.add.at(total, bodies[:, 1], force)
            np.subtract.at(total, bodies[:, 0], force)
        norm: np.ndarray = np.linalg.norm(total, axis=1)
        return norm

    def _contact_forces(
        self, d: mujoco.MjData, pick: slice | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Normal [c], tangential [c, 2], frame [c, 3, 3] and bodies [c, 2] of contacts, pyramidal cone.

        A contact without friction (condim 1) has one row, its normal force. Others have two edges per direction: the
        normal force is the sum of all, a tangent's is μ times the difference of its two (MuJoCo's
        `mju_decodePyramid`); torsion and rolling add to the normal force and have no tangential one.
        """
        contact = d.contact
        rows = np.asarray(contact.efc_address)[pick]
        live = rows >= 0
        rows = rows[live]
        dim = np.asarray(contact.dim)[pick][live]
        edges = np.where(dim == 1, 1, 2 * (dim - 1))
        mu = np.asarray(contact.friction)[pick][live]
        normal, tangent = np.zeros(len(rows)), np.zeros((len(rows), 2))
        for k in range(int(edges.max(initial=0))):
            has = np.flatnonzero(edges > k)
            force = d.efc_force[rows[has] + k]
            normal[has] += force
            if k < 4:
                has_tangent = dim[has] > 1
                sign = 1.0 if k % 2 == 0 else -1.0
                tangent[has[has_tangent], k // 2] += sign * force[has_tangent]
        tangent *= mu[:, :2]
        frame = np.asarray(contact.frame)[pick][live].reshape(-1, 3, 3)
        bodies = self.scene.mj_model.geom_bodyid[np.asarray(contact.geom)[pick][live]]
        return normal, tangent, frame, bodies

    def _pair_normal(self, d: mujoco.MjData, a: np.ndarray, b: np.ndarray) -> float:
        if not d.ncon:
            return 0.0
        geom = d.contact.geom
        hit = np.flatnonzero((a[geom[:, 0]] & b[geom[:, 1]]) | (b[geom[:, 0]] & a[geom[:, 1]]))
        return float(self._contact_forces(d, hit)[0].sum()) if len(hit) else 0.0

    def add_velocity(self, change: np.ndarray, mask: np.ndarray | None = None) -> None:
        """See `Physics.add_velocity`."""
        super().add_velocity(change, mask)
        root, change = self.scene.robot.root_qvel, np.asarray(change, dtype=np.float32)
        for w in range(self.worlds) if mask is None else np.flatnonzero(mask):
            self._data[w].qvel[root : root + 6] += change[w]

    def snapshot(self) -> MujocoSnapshot:
        """See `Physics.snapshot`."""
        state = np.empty((self.worlds, mujoco.mj_stateSize(self.scene.mj_model, _STATE)))
        force = self._host.get("external_force")
        for w, (model, d) in enumerate(zip(self._model_of, self._data, strict=True)):
            if force is not None:
                d.xfrc_applied[:] = force[w]
            mujoco.mj_getState(model, d, state[w], _STATE)
        overflows = np.array([[d.warning[kind].number for kind in _BUFFERS_FULL] for d in self._data])
        return MujocoSnapshot(state, overflows, {name: array.copy() for name, array in self._host.items()})

    def restore(self, snapshot: MujocoSnapshot, mask: np.ndarray | None = None) -> None:
        """See `Physics.restore`."""
        for w in range(self.worlds) if mask is None else np.flatnonzero(mask):
            d = self._data[w]
            mujoco.mj_setState(self._model_of[w], d, snapshot.state[w], _STATE)
            for kind, number in zip(_BUFFERS_FULL, snapshot.overflows[w], strict=True):
                d.warning[kind].number = number
            for name, array in self._host.items():
                array[w] = snapshot.views[name][w] if name in snapshot.views else d.xfrc_applied

    def reset_worlds(self, worlds: np.ndarray, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray) -> None:
        """See `Physics.reset_worlds`."""
        for k, w in enumerate(worlds):
            d = self._data[w]
            mujoco.mj_resetData(self._model_of[w], d)
            d.qpos[:] = qpos[k]
            d.mocap_pos[:] = mocap_pos[k]
            d.mocap_quat[:] = mocap_quat[k]
            if self.scene.latch is not None:
                d.eq_active[self.scene.latch.equality] = 1
            for array in self._host.values():
                array[w] = 0
            self._host["latch"][w] = 1
            self._publish(w, d)

    def close(self) -> None:
        """See `Physics.close`."""
        if self._pool is not None:
            self._pool.shutdown(wait=False)


def _ignore_warning(message: str) -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT into the working folder; what it warns of is read from each `MjData`."""
