"""Engine `warp`: mujoco_warp, all worlds in one launch, on CUDA or the Warp CPU backend."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import mujoco
import mujoco_warp
import numpy as np
import warp as wp

from arena_newton.kernels import contact, newton_state
from arena_newton.kernels.rules import latch
from arena_newton.physics.ball import set_restitution
from arena_newton.physics.batch import Physics
from arena_newton.physics.scene import Scene
from arena_newton.robot.g1 import PhysicsRate

__all__ = ["PER_WORLD_FIELDS", "WarpPhysics"]

PER_WORLD_FIELDS = (
    "body_mass",
    "body_ipos",
    "body_inertia",
    "body_iquat",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "geom_friction",
    "actuator_gainprm",
    "actuator_biasprm",
)
"""Fields of a MuJoCo model that may differ between worlds."""

_STATE = (
    "time qpos qvel act history qacc_warmstart ctrl qfrc_applied xfrc_applied eq_active mocap_pos mocap_quat overflow"
).split()
"""Arrays of mujoco_warp's `Data` that the next step depends on, and its buffers' overflow flags."""


class WarpPhysics(Physics):
    """mujoco_warp: all worlds in one launch; the substeps of a tick are one captured graph."""

    engine = "warp"

    def __init__(self, scene: Scene, rate: PhysicsRate, *, models: Sequence[mujoco.MjModel] | None = None):
        """Bind the solver's batch; see `physics.make_physics`."""
        super().__init__(scene, rate, models)
        self._m, self._d = _own_batch(scene, rate)
        self._solver_graph: wp.Graph | None = None
        self._tick_graph: wp.Graph | None = None
        d, m = self._d, scene.mj_model
        self._fields: dict[str, np.ndarray] = {}
        """`PER_WORLD_FIELDS` as they were built; empty until a world has dynamics of its own."""
        if models is not None:
            fields = {name: self._rows_of_models(name) for name in PER_WORLD_FIELDS}
            self._m = dataclasses.replace(self._m, **fields)
        self.qpos, self.qvel, self.ctrl = d.qpos, d.qvel, d.ctrl
        self.xpos = self._floats(d.xpos, self.nbody, 3)
        self.xquat = self._floats(d.xquat, self.nbody, 4)
        self.xipos = self._floats(d.xipos, self.nbody, 3)
        self._force = self._floats(d.xfrc_applied, self.nbody, 6)
        with wp.ScopedDevice(self.device):
            self._geom_body = wp.array(m.geom_bodyid, dtype=wp.int32)
            self._geom_group = wp.zeros(m.ngeom, dtype=wp.int32)
            self.overflow = wp.zeros(self.worlds, dtype=wp.int32)
            """1 where a buffer overflowed since the reset, shape [worlds]."""
            self._force_vector = wp.zeros((self.worlds, m.nbody), dtype=wp.vec3)
            self._idle = wp.zeros(self.worlds, dtype=wp.int32)
        self._idle_host: np.ndarray = np.zeros(self.worlds, dtype=np.int32)
        published = (self.xpos, self.xquat, self.xipos, self.contact_force, self.pair_force)
        arrays = [getattr(d, name) for name in _STATE] + [*published, self.latch_locked, self.overflow]
        self._state = [self._words(array) for array in arrays if array.size]
        self._hold: tuple[list[wp.array], wp.Graph, wp.Graph] | None = None
        """The state before a tick, the graph that keeps it, and the one that puts idle worlds back after the tick."""
        self._reset_all()

    def _floats(self, array: wp.array, *shape: int) -> wp.array:
        """A float32 view [worlds, *shape] of an array of vectors."""
        return wp.array(ptr=array.ptr, dtype=wp.float32, shape=(self.worlds, *shape), device=self.device, copy=False)

    def _words(self, array: wp.array) -> wp.array:
        """A view [worlds, n] of an array's bits: 32-bit words, or bytes of booleans."""
        size = array.size * wp.types.type_size_in_bytes(array.dtype)
        dtype, width = (wp.uint8, 1) if array.dtype == wp.bool else (wp.int32, 4)
        shape = (self.worlds, size // width // self.worlds)
        return wp.array(ptr=array.ptr, dtype=dtype, shape=shape, device=self.device, copy=False)

    def _rows_of_models(self, name: str) -> wp.array:
        """A field of the models, one row per world, in the form of mujoco_warp's model."""
        array = getattr(self._m, name)
        rows = np.stack([getattr(model, name) for model in self._models]).astype(np.float32)
        return wp.array(rows.reshape(array.numpy().shape), dtype=array.dtype, device=self.device)

    def _use_models(self, worlds: Sequence[int]) -> None:
        """Scale mujoco_warp's fields as the models were scaled; principal axes are not the same in both."""
        if not self._fields:
            own = {name: wp.clone(getattr(self._m, name)) for name in PER_WORLD_FIELDS}
            self._m = dataclasses.replace(self._m, **own)
            self._fields = {name: array.numpy().copy() for name, array in own.items()}
            self._tick_graph = self._solver_graph = None
        for name, built in self._fields.items():
            rows = getattr(self._m, name).numpy()
            for world in worlds:
                now, was = (
                    np.reshape(getattr(of[world], name), rows[world].shape) for of in (self._model_of, self._built)
                )
                rows[world] = built[world] * np.divide(now, was, out=np.ones_like(now), where=was != 0.0)
            getattr(self._m, name).assign(rows)

    @property
    def external_force(self) -> wp.array:
        """See `Physics.external_force`."""
        return self._force

    def watch_pair(self, geoms_a: Sequence[int], geoms_b: Sequence[int], worlds: np.ndarray | None = None) -> None:
        """See `Physics.watch_pair`; reports every world."""
        group = np.zeros(self.scene.mj_model.ngeom, np.int32)
        group[geoms_a] |= contact.GROUP_A
        group[geoms_b] |= contact.GROUP_B
        self._geom_group.assign(group)

    def set_active(self, mask: np.ndarray) -> None:
        """See `Physics.set_active`; idle worlds are stepped with the others and put back."""
        idle = (~np.asarray(mask, dtype=bool)).astype(np.int32)
        if not np.array_equal(idle, self._idle_host):
            self._idle_host = idle
            self._idle.assign(idle)

    def step(self) -> None:
        """See `Physics.step`; sums of contact forces (float atomics) are not bit-deterministic on CUDA."""
        with wp.ScopedDevice(self.device):
            if self._tick_graph is None:
                self._tick_graph = self._capture(self._launch_tick)
            graphs = [self._tick_graph]
            if self._idle_host.any():
                self._hold = self._hold or self._captured_hold()
                _, keep, put_back = self._hold
                graphs = [keep, self._tick_graph, put_back]
            for graph in graphs:
                wp.capture_launch(graph)

    def _captured_hold(self) -> tuple[list[wp.array], wp.Graph, wp.Graph]:
        before = self.snapshot()

        def keep() -> None:
            for saved, words in zip(before, self._state, strict=True):
                wp.copy(saved, words)

        return before, self._capture(keep), self._capture(lambda: self._put_back(before, self._idle))

    def _launch_tick(self) -> None:
        door = self.scene.latch
        if door is not None:
            newton_state.launch_latch(self.latch_locked, door.equality, self._d.eq_active)
        self._launch_solver()
        newton_state.launch_overflow(self._d.overflow, self.overflow)
        mujoco_warp.kinematics(self._m, self._d)
        mujoco_warp.com_pos(self._m, self._d)
        if door is not None:
            latch.launch_release(self.qpos, door.handle_qpos, door.release_angle, self.latch_locked)
        self._launch_contacts()

    def _launch_solver(self) -> None:
        for _ in range(self.rate.substeps):
            mujoco_warp.step(self._m, self._d)

    def _capture(self, work: Callable[[], None]) -> wp.Graph:
        """Launches as a graph; the worlds stay where they are."""
        began = self.snapshot()
        work()  # loads what is launched
        with wp.ScopedCapture(self.device) as capture:
            work()
        self.restore(began)
        return capture.graph

    def mj_step_only(self) -> None:
        """See `Physics.mj_step_only`."""
        with wp.ScopedDevice(self.device):
            if self._solver_graph is None:
                self._solver_graph = self._capture(self._launch_solver)
            wp.capture_launch(self._solver_graph)

    def _launch_contacts(self) -> None:
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

    def overflowed(self, world: int) -> bool:
        """See `Physics.overflowed`."""
        return bool(self.overflow.numpy()[world])

    def snapshot(self) -> list[wp.array]:
        """See `Physics.snapshot`."""
        return [wp.clone(words) for words in self._state]

    def restore(self, snapshot: list[wp.array], mask: np.ndarray | None = None) -> None:
        """See `Physics.restore`."""
        rows = np.ones(self.worlds, np.int32) if mask is None else np.asarray(mask, dtype=np.int32)
        self._put_back(snapshot, wp.array(rows, dtype=wp.int32, device=self.device))

    def _put_back(self, saved: list[wp.array], mask: wp.array) -> None:
        for before, words in zip(saved, self._state, strict=True):
            newton_state.launch_put_back(mask, before, words)

    def reset_worlds(self, worlds: np.ndarray, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray) -> None:
        """See `Physics.reset_worlds`."""
        mask = np.zeros(self.worlds, dtype=bool)
        mask[worlds] = True
        d = self._d
        with wp.ScopedDevice(self.device):
            mujoco_warp.reset_data(self._m, d, wp.array(mask, dtype=wp.bool))
            values = [(d.qpos, qpos), (d.mocap_pos, mocap_pos), (d.mocap_quat, mocap_quat), (self.latch_locked, 1)]
            values += [(array, 0) for array in (self.contact_force, self.pair_force, self.overflow, d.overflow)]
            for array, rows in values:
                if array.size:
                    host = array.numpy()
                    shape = (len(worlds), *host.shape[1:])
                    host[worlds] = rows if np.isscalar(rows) else np.asarray(rows, np.float32).reshape(shape)
                    array.assign(host)
            mujoco_warp.kinematics(self._m, d)
            mujoco_warp.com_pos(self._m, d)


def _own_batch(scene: Scene, rate: PhysicsRate) -> tuple[mujoco_warp.Model, mujoco_warp.Data]:
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


def _cloned[T](value: T) -> T:
    """A deep copy of a struct of Warp arrays; everything else in it is shared."""
    if isinstance(value, wp.array):
        copy: T = wp.clone(value)
        return copy
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _cloned(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
        return dataclasses.replace(value, **fields)
    return value
