"""One interface, two engines: native MuJoCo on the CPU and mujoco_warp on CUDA or the Warp CPU backend.

Both step the model that Newton compiled from the USD stage. State arrays are Warp arrays, float32, MuJoCo layout,
shape [worlds, n]; the free joint's quaternion is wxyz, its angular velocity is in the body frame.
"""

from __future__ import annotations

import copy
import dataclasses
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton.ball import set_restitution
from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.robot import PhysicsRate
    from arena_newton.scene import Scene

__all__ = ["MujocoPhysics", "Physics", "WarpPhysics", "make_physics", "resolve_engine"]


def resolve_engine(engine: str, device: str | None) -> tuple[str, str]:
    """Engine and device for `auto`, checked against what this machine has.

    Raises:
        InputError: Unknown engine, or a device that is not here.
    """
    import warp as wp

    cuda = wp.is_cuda_available()
    if engine not in {"auto", "mujoco", "warp"}:
        raise InputError(f"--engine {engine}: unknown, choose auto, mujoco or warp")
    if device is not None and device != "cpu":
        if not device.startswith("cuda"):
            raise InputError(f"--device {device}: unknown, choose cpu, cuda or cuda:N")
        if not cuda:
            raise InputError(f"--device {device}: no CUDA device on this machine, use --device cpu")
        if device != "cuda" and device not in {d.alias for d in wp.get_cuda_devices()}:
            raise InputError(f"--device {device}: no such device, this machine has {wp.get_cuda_device_count()}")
    if engine == "auto":
        engine = "warp" if cuda and device != "cpu" else "mujoco"
    if engine == "mujoco":
        if device not in (None, "cpu"):
            raise InputError(f"--device {device}: engine mujoco runs on the CPU, use --engine warp for CUDA")
        return "mujoco", "cpu"
    return "warp", device or ("cuda:0" if cuda else "cpu")


class Physics:
    """State views, reset and one 50 Hz tick; see the engines below."""

    engine: str
    qpos: Any
    """Positions, shape [worlds, nq]."""
    qvel: Any
    """Velocities, shape [worlds, nv]."""
    ctrl: Any
    """Actuator targets, shape [worlds, nu]."""
    xpos: Any
    """Body positions [m], shape [worlds, nbody, 3]."""
    xquat: Any
    """Body orientations wxyz, shape [worlds, nbody, 4]."""
    xipos: Any
    """Body centres of mass [m], shape [worlds, nbody, 3]."""

    def __init__(self, scene: Scene, rate: PhysicsRate):
        """Bind a scene; `rate` is the tracker's physics rate."""
        import warp as wp

        self.scene = scene
        self.rate = rate
        self.mj_model = self._own_model(scene, rate)
        """The MuJoCo model at this physics' rate; the scene's own stays as it was built."""
        self.worlds = scene.worlds
        self.device = wp.get_device(scene.device)
        self.want_forces = False
        """Fill `contact_force` every tick (otherwise only for worlds tilted beyond 60°, engine `mujoco`)."""
        m = scene.mj_model
        self.nq, self.nv, self.nu, self.nbody, self.nmocap = m.nq, m.nv, m.nu, m.nbody, m.nmocap
        self.qpos0 = np.tile(m.qpos0.astype(np.float32), (self.worlds, 1))
        fixtures = [b for b in range(m.nbody) if m.body_mocapid[b] >= 0]
        self.mocap_pos0 = m.body_pos[fixtures].astype(np.float32)
        self.mocap_quat0 = m.body_quat[fixtures].astype(np.float32)
        with wp.ScopedDevice(self.device):
            self.contact_force = wp.zeros((self.worlds, m.nbody), dtype=wp.float32)
            self.pair_force = wp.zeros(self.worlds, dtype=wp.float32)
            self.latch_locked = wp.full(self.worlds, 1, dtype=wp.int32)
            """1 = the door's latch holds the leaf, shape [worlds]."""
        self._pair: tuple[np.ndarray, np.ndarray] | None = None

    @staticmethod
    def _own_model(scene: Scene, rate: PhysicsRate) -> Any:
        """A copy of the scene's MuJoCo model for this time step, on which a ball's bounce depends too."""
        model = copy.copy(scene.mj_model)
        model.opt.timestep = rate.dt
        if scene.ball_restitution is not None:
            set_restitution(scene, scene.ball_restitution, rate.dt, model)
        return model

    def watch_pair(self, geoms_a: list[int], geoms_b: list[int]) -> None:
        """Report the normal force between two groups of geoms in `pair_force` [N], shape [worlds]."""
        a, b = np.zeros(self.scene.mj_model.ngeom, np.int32), np.zeros(self.scene.mj_model.ngeom, np.int32)
        a[geoms_a], b[geoms_b] = 1, 1
        self._pair = (a, b)

    def lock_latch(self, mask: Any) -> None:
        """Lock the door's latch again in the worlds of a mask; int32 Warp array [worlds], 1 = lock."""
        from arena_newton.kernels import latch

        latch.launch_lock(mask, self.latch_locked)

    def step(self) -> None:
        """Advance one 50 Hz tick under the current `ctrl`."""
        self.bare_step()
        self.read_contacts()

    def bare_step(self) -> None:
        """Only the physics of one tick."""
        raise TypeError("use make_physics() for an engine")

    def read_contacts(self) -> None:
        """Contact forces of the last physics step."""

    def overflowed(self, world: int) -> bool:
        """Whether a contact or constraint buffer overflowed in this world since its reset."""
        raise TypeError("use make_physics() for an engine")

    def set_active(self, mask: np.ndarray) -> None:
        """Say which worlds run an episode, bool [worlds]."""

    def close(self) -> None:
        """Let go of threads; the physics steps no more."""

    def mj_step_only(self) -> None:
        """Nothing but the solver: what `bench` divides by."""
        raise TypeError("use make_physics() for an engine")

    def reset_worlds(self, worlds: np.ndarray, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray) -> None:
        """Put worlds at rest in a state, clearing every trace of their past.

        Args:
            worlds: World indices [k].
            qpos: Positions [k, nq].
            mocap_pos: Fixture positions [m], shape [k, nmocap, 3].
            mocap_quat: Fixture orientations wxyz, shape [k, nmocap, 4].
        """
        raise TypeError("use make_physics() for an engine")

    def write_newton_state(self, state: Any) -> None:
        """Write body poses into a Newton state (for rendering)."""
        import warp as wp

        from arena_newton.kernels import newton_state

        if not hasattr(self, "_newton_map"):
            self._newton_map = wp.array(self.scene.body_to_newton, dtype=wp.int32, device=self.device)
        newton_state.launch_body_q(self.xpos, self.xquat, self._newton_map, state.body_q)


class MujocoPhysics(Physics):
    """Native MuJoCo: one MjData a world, several threads, bit-identical for any number of worlds."""

    engine = "mujoco"

    def __init__(self, scene: Scene, rate: PhysicsRate, threads: int | None = None):
        """Allocate one MjData a world."""
        import mujoco
        import warp as wp

        super().__init__(scene, rate)
        self._mj = mujoco
        mujoco.set_mju_user_warning(_warn_nobody)
        m = self._m = self.mj_model
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._data = [mujoco.MjData(m) for _ in range(self.worlds)]
        self._np: dict[str, np.ndarray] = {}

        def shared(name: str, *shape: int) -> None:
            buffer = np.zeros((self.worlds, *shape), dtype=np.float32)
            self._np[name] = buffer
            setattr(self, name, wp.array(buffer, dtype=wp.float32, device="cpu", copy=False))

        shared("qpos", m.nq)
        shared("qvel", m.nv)
        shared("ctrl", m.nu)
        shared("xpos", m.nbody, 3)
        shared("xquat", m.nbody, 4)
        shared("xipos", m.nbody, 3)
        # Views made once: a property of MjData costs about as much as the copy behind it.
        names = ("qpos", "qvel", "xpos", "xquat", "xipos")
        self._copies = [[(self._np[n][w], getattr(d, n)) for n in names] for w, d in enumerate(self._data)]
        self._targets = [(d.ctrl, self._np["ctrl"][w]) for w, d in enumerate(self._data)]
        self._np["contact_force"] = self.contact_force.numpy()
        self._np["pair_force"] = self.pair_force.numpy()
        self._np["latch"] = self.latch_locked.numpy()
        self.threads = max(1, min(threads or len(os.sched_getaffinity(0)), self.worlds))
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None
        self._every = np.arange(self.worlds)
        self._active = np.ones(self.worlds, dtype=bool)
        mocap = (np.tile(self.mocap_pos0, (self.worlds, 1, 1)), np.tile(self.mocap_quat0, (self.worlds, 1, 1)))
        self.reset_worlds(self._every, self.qpos0, *mocap)

    def _each(self, work: Any, worlds: np.ndarray) -> None:
        # One iterator for all threads: each takes the next world when it is free, so that a slow core delays nobody.
        shared = iter(worlds.tolist())
        others = [self._pool.submit(work, shared) for _ in range(self.threads - 1)] if self._pool else []
        work(shared)
        for other in others:
            other.result()

    def close(self) -> None:
        """See `Physics.close`."""
        if self._pool is not None:
            self._pool.shutdown(wait=False)

    def set_active(self, mask: np.ndarray) -> None:
        """Step only the worlds of a bool mask [worlds]; the others keep their state."""
        self._active[:] = mask

    def _step_share(self, share: Iterator[int]) -> None:
        m, n, step = self._m, self.rate.substeps, self._mj.mj_step
        latch, locked, qpos = self.scene.latch, self._np["latch"], self._np["qpos"]
        for w in share:
            d = self._data[w]
            target, source = self._targets[w]
            target[:] = source
            if latch is not None:
                d.eq_active[latch.equality] = locked[w]
            step(m, d, n)
            self._publish(w, d)
            if latch is not None and qpos[w, latch.handle_qpos] <= latch.release_angle:
                locked[w] = 0

    def _publish(self, w: int, d: Any) -> None:
        self._mj.mj_kinematics(self._m, d)
        for target, source in self._copies[w]:
            target[:] = source

    def _bare_share(self, share: Iterator[int]) -> None:
        m, n, step, data = self._m, self.rate.substeps, self._mj.mj_step, self._data
        for w in share:
            step(m, data[w], n)

    def mj_step_only(self) -> None:
        """Nothing but `mj_step` on the same threads: what `bench` divides by."""
        self._each(self._bare_share, self._every)

    def bare_step(self) -> None:
        """Only the physics of one tick."""
        self._each(self._step_share, np.flatnonzero(self._active))

    def read_contacts(self) -> None:
        """Contact forces of the last physics step."""
        root = self.scene.robot.root_qpos
        q = self._np["qpos"][:, root + 3 : root + 7]
        tilted = 1.0 - 2.0 * (q[:, 1] ** 2 + q[:, 2] ** 2) < 0.5
        self._np["pair_force"][:] = 0.0
        for w in np.flatnonzero(self._active if self.want_forces else self._active & tilted):
            self._np["contact_force"][w] = self._body_forces(self._data[w])
        if self._pair is not None:
            for w in np.flatnonzero(self._active):
                self._np["pair_force"][w] = self._pair_normal(self._data[w])

    def overflowed(self, world: int) -> bool:
        """Whether a contact or constraint buffer overflowed in this world since its reset."""
        warning = self._data[world].warning
        full = (self._mj.mjtWarning.mjWARN_CONTACTFULL, self._mj.mjtWarning.mjWARN_CNSTRFULL)
        return any(warning[kind].number for kind in full)

    def _body_forces(self, d: Any) -> np.ndarray:
        """Norm of the net contact force on each body [N], shape [nbody]."""
        total = np.zeros((self.nbody, 3))
        normal, tangent, frame, bodies = self._contact_forces(d, slice(None))
        if len(normal):
            force = np.einsum("ck,ckj->cj", np.column_stack([normal, tangent]), frame)
            np.add.at(total, bodies[:, 1], force)
            np.subtract.at(total, bodies[:, 0], force)
        return np.linalg.norm(total, axis=1)

    def _contact_forces(self, d: Any, pick: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Normal [c], tangential [c, 2], frame [c, 3, 3] and bodies [c, 2] of contacts, pyramidal cone.

        A contact without friction (condim 1) has one row, its normal force. Others have two edges a direction: the
        normal force is the sum of all, a tangent's is μ times the difference of its two (MuJoCo's
        `mju_decodePyramid`); torsion and rolling press too but push nowhere.
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
        bodies = self._m.geom_bodyid[np.asarray(contact.geom)[pick][live]]
        return normal, tangent, frame, bodies

    def _pair_normal(self, d: Any) -> float:
        if not d.ncon or self._pair is None:
            return 0.0
        a, b = self._pair
        geom = d.contact.geom
        hit = np.flatnonzero((a[geom[:, 0]] & b[geom[:, 1]]) | (b[geom[:, 0]] & a[geom[:, 1]]))
        return float(self._contact_forces(d, hit)[0].sum()) if len(hit) else 0.0

    def reset_worlds(self, worlds, qpos, mocap_pos, mocap_quat) -> None:
        """See `Physics.reset_worlds`."""
        for k, w in enumerate(worlds):
            d = self._data[w]
            self._mj.mj_resetData(self._m, d)
            d.qpos[:] = qpos[k]
            d.mocap_pos[:] = mocap_pos[k]
            d.mocap_quat[:] = mocap_quat[k]
            self._np["latch"][w] = 1
            if self.scene.latch is not None:
                d.eq_active[self.scene.latch.equality] = 1
            d.ctrl[:] = 0
            self._np["ctrl"][w] = 0
            self._np["contact_force"][w] = 0
            self._np["pair_force"][w] = 0
            self._publish(w, d)


class WarpPhysics(Physics):
    """mujoco_warp: all worlds in one launch; on CUDA the substeps of a tick are one captured graph."""

    engine = "warp"

    def __init__(self, scene: Scene, rate: PhysicsRate):
        """Bind the solver's batch and, on CUDA, capture the tick."""
        import mujoco_warp
        import warp as wp

        super().__init__(scene, rate)
        self._mjw = mujoco_warp
        self._m, self._d = self._own_batch(scene, rate)
        d = self._d

        def view(array: Any, *shape: int) -> Any:
            return wp.array(
                ptr=array.ptr, dtype=wp.float32, shape=(self.worlds, *shape), device=self.device, copy=False
            )

        self.qpos, self.qvel, self.ctrl = d.qpos, d.qvel, d.ctrl
        self.xpos = view(d.xpos, self.nbody, 3)
        self.xquat = view(d.xquat, self.nbody, 4)
        self.xipos = view(d.xipos, self.nbody, 3)
        m = scene.mj_model
        with wp.ScopedDevice(self.device):
            self._geom_body = wp.array(m.geom_bodyid, dtype=wp.int32)
            self._geom_group = wp.zeros(m.ngeom, dtype=wp.int32)
            self.overflow = wp.zeros(self.worlds, dtype=wp.int32)
            """1 where a buffer overflowed since the reset, shape [worlds]."""
            self._force_vector = wp.zeros((self.worlds, m.nbody), dtype=wp.vec3)
        self._graph: Any = None
        self._full_graph: Any = None
        every = np.arange(self.worlds)
        mocap = (np.tile(self.mocap_pos0, (self.worlds, 1, 1)), np.tile(self.mocap_quat0, (self.worlds, 1, 1)))
        self.reset_worlds(every, self.qpos0, *mocap)

    @staticmethod
    def _own_batch(scene: Scene, rate: PhysicsRate) -> tuple[Any, Any]:
        """The solver's model at this rate and its data; the data are copied for a second physics over the scene."""
        model, data = scene.solver.mjw_model, scene.solver.mjw_data
        timestep = _cloned(model.opt.timestep)
        timestep.fill_(rate.dt)
        model = dataclasses.replace(
            model,
            opt=dataclasses.replace(model.opt, timestep=timestep, warn_overflow=0),
            geom_solref=_cloned(model.geom_solref),
            geom_solimp=_cloned(model.geom_solimp),
        )
        if scene.ball_restitution is not None:
            set_restitution(scene, scene.ball_restitution, rate.dt, model)
        if scene.batch_taken:
            data = _cloned(data)
        scene.batch_taken = True
        return model, data

    def _launch_tick(self) -> None:
        from arena_newton.kernels import latch as latches
        from arena_newton.kernels import newton_state

        latch = self.scene.latch
        if latch is not None:
            newton_state.launch_latch(self.latch_locked, latch.equality, self._d.eq_active)
        for _ in range(self.rate.substeps):
            self._mjw.step(self._m, self._d)
        newton_state.launch_overflow(self._d.overflow, self.overflow)
        self._mjw.kinematics(self._m, self._d)
        self._mjw.com_pos(self._m, self._d)
        if latch is not None:
            latches.launch_release(self.qpos, latch.handle_qpos, latch.release_angle, self.latch_locked)
        if self.device.is_cuda:
            self._launch_contacts()

    def _solver_tick(self) -> None:
        for _ in range(self.rate.substeps):
            self._mjw.step(self._m, self._d)

    def _capture(self, work: Any) -> Any:
        import warp as wp

        work()
        with wp.ScopedCapture(self.device) as capture:
            work()
        return capture.graph

    def bare_step(self) -> None:
        """Only the physics of one tick."""
        import warp as wp

        with wp.ScopedDevice(self.device):
            if not self.device.is_cuda:
                self._launch_tick()
                return
            if self._full_graph is None:
                saved = [wp.clone(a) for a in (self._d.qpos, self._d.qvel, self._d.qacc_warmstart, self._d.time)]
                self._full_graph = self._capture(self._launch_tick)
                for array, copy in zip(
                    (self._d.qpos, self._d.qvel, self._d.qacc_warmstart, self._d.time), saved, strict=True
                ):
                    wp.copy(array, copy)
            wp.capture_launch(self._full_graph)

    def mj_step_only(self) -> None:
        """Nothing but the solver's captured graph: what `bench` divides by."""
        import warp as wp

        with wp.ScopedDevice(self.device):
            if not self.device.is_cuda:
                self._solver_tick()
                return
            if self._graph is None:
                self._graph = self._capture(self._solver_tick)
            wp.capture_launch(self._graph)

    def overflowed(self, world: int) -> bool:
        """See `Physics.overflowed`."""
        return bool(self.overflow.numpy()[world])

    def set_active(self, mask: np.ndarray) -> None:
        """All worlds of a batch step together; idle ones are stepped and ignored."""

    def watch_pair(self, geoms_a: list[int], geoms_b: list[int]) -> None:
        """See `Physics.watch_pair`."""
        from arena_newton.kernels import contact

        super().watch_pair(geoms_a, geoms_b)
        a, b = self._pair  # type: ignore[misc]  # the line above has set it
        self._geom_group.assign(a * contact.GROUP_A + b * contact.GROUP_B)

    def _launch_contacts(self) -> None:
        from arena_newton.kernels import contact

        c = self._d.contact
        contact.launch_contact_force(
            self._d.nacon,
            c.geom,
            c.worldid,
            c.frame,
            c.friction,
            c.dim,
            c.efc_address,
            self._d.efc.force,
            pyramidal=True,
            geom_body=self._geom_body,
            geom_group=self._geom_group,
            net_force=self._force_vector,
            force_norm=self.contact_force,
            pair_force=self.pair_force,
        )

    def read_contacts(self) -> None:
        """Contact forces of the last physics step (float atomics: not bit-deterministic on CUDA)."""
        if not self.device.is_cuda:  # on CUDA they are part of the tick's graph
            self._launch_contacts()

    def reset_worlds(self, worlds, qpos, mocap_pos, mocap_quat) -> None:
        """See `Physics.reset_worlds`."""
        import warp as wp

        mask = np.zeros(self.worlds, dtype=bool)
        mask[worlds] = True
        with wp.ScopedDevice(self.device):
            self._mjw.reset_data(self._m, self._d, wp.array(mask, dtype=wp.bool))
            for array, rows in ((self._d.qpos, qpos), (self._d.mocap_pos, mocap_pos), (self._d.mocap_quat, mocap_quat)):
                if array.size == 0:
                    continue
                host = array.numpy()
                host[worlds] = np.asarray(rows, dtype=np.float32).reshape(host[worlds].shape)
                array.assign(host)
            for array in (self.contact_force, self.pair_force, self.overflow, self._d.overflow):
                host = array.numpy()
                host[worlds] = 0
                array.assign(host)
            latch = self.latch_locked.numpy()
            latch[worlds] = 1
            self.latch_locked.assign(latch)
            self._mjw.kinematics(self._m, self._d)
            self._mjw.com_pos(self._m, self._d)


def _warn_nobody(message: str) -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT into the working folder; what it warns of is read from each `MjData`."""


def _cloned(value: Any) -> Any:
    """A deep copy of a struct of Warp arrays; everything else in it is shared."""
    import warp as wp

    if isinstance(value, wp.array):
        return wp.clone(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _cloned(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
        return dataclasses.replace(value, **fields)
    return value


def make_physics(scene: Scene, rate: PhysicsRate, engine: str, threads: int | None = None) -> Physics:
    """Engine `mujoco` or `warp` over a scene."""
    return MujocoPhysics(scene, rate, threads) if engine == "mujoco" else WarpPhysics(scene, rate)
