"""Base of both physics engines: state views, reset, forces, snapshots and one 50 Hz tick.

State arrays are Warp arrays, float32, MuJoCo layout, shape [worlds, n]; the free joint's quaternion is wxyz, its
angular velocity is in the body frame.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from arena_newton import interfaces
from arena_newton.kernels import newton_state
from arena_newton.kernels.rules import latch
from arena_newton.physics.ball import set_restitution
from arena_newton.physics.dynamics import varied
from arena_newton.physics.scene import Scene

if TYPE_CHECKING:
    import newton

    from arena_newton.robot.g1 import PhysicsRate

__all__ = ["Physics"]


class Physics(interfaces.Physics, ABC):
    """A batch of worlds; what `interfaces.Physics` promises is not described again."""

    def __init__(self, scene: Scene, rate: PhysicsRate, models: Sequence[mujoco.MjModel] | None):
        """Bind a scene; `models` are variants of its model, one per world."""
        if models is not None and len(models) != scene.worlds:
            raise ValueError(f"{len(models)} models for {scene.worlds} worlds")
        self.scene = scene
        self.rate = rate
        given = [scene.mj_model] if models is None else models
        own = {id(model): _at_rate(model, scene, rate) for model in given}
        self._models = [own[id(model)] for model in given]
        self.worlds = scene.worlds
        self._built = self._models * self.worlds if models is None else self._models
        self._model_of = list(self._built)
        """Model that each world steps: the one that it was built with, or one of other dynamics."""
        self.device: wp.Device = wp.get_device(scene.device)
        self.want_forces = False
        """Fill `contact_force` every tick (otherwise only in worlds tilted beyond 60°, engine `mujoco`)."""
        m = scene.mj_model
        self.nq, self.nv, self.nu, self.nbody, self.nmocap = m.nq, m.nv, m.nu, m.nbody, m.nmocap
        self.qpos0 = np.tile(m.qpos0.astype(np.float32), (self.worlds, 1))
        fixtures = [b for b in range(m.nbody) if m.body_mocapid[b] >= 0]
        self.mocap_pos0 = m.body_pos[fixtures].astype(np.float32)
        self.mocap_quat0 = m.body_quat[fixtures].astype(np.float32)
        with wp.ScopedDevice(self.device):
            self.contact_force = wp.zeros((self.worlds, m.nbody), dtype=wp.float32)
            """Norm of the net contact force on each body [N], shape [worlds, nbody]."""
            self.pair_force = wp.zeros(self.worlds, dtype=wp.float32)
            """Normal force between the two groups of `watch_pair` [N], shape [worlds]."""
            self.latch_locked = wp.full(self.worlds, 1, dtype=wp.int32)
            """1 = the door's latch holds the leaf, shape [worlds]."""
            self._newton_bodies = wp.array(scene.body_to_newton, dtype=wp.int32)

    @property
    def models(self) -> Sequence[mujoco.MjModel]:
        """One MuJoCo model for all worlds, or one per world, at this physics' rate; the scene's own stays as built."""
        return tuple(self._models if self._model_of == self._built else self._model_of)

    @property
    def own_models(self) -> Sequence[mujoco.MjModel]:
        """Models from which those of the episodes are made, each once."""
        return tuple({id(model): model for model in self._built}.values())

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The MuJoCo model of the first world."""
        return self._model_of[0]

    @abstractmethod
    def watch_pair(self, geoms_a: Sequence[int], geoms_b: Sequence[int], worlds: np.ndarray | None = None) -> None:
        """Report the normal force between two groups of geoms in `pair_force` [N], shape [worlds].

        Args:
            geoms_a: Geoms of the first group.
            geoms_b: Geoms of the second group.
            worlds: Worlds that need it, bool, shape [worlds]; all by default. The others may stay at 0.
        """

    @abstractmethod
    def mj_step_only(self) -> None:
        """Nothing but the solver's steps of one tick: what `bench` divides by."""

    @abstractmethod
    def reset_worlds(self, worlds: np.ndarray, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray) -> None:
        """Put worlds at rest in a state, clearing every trace of their past.

        Args:
            worlds: World indices [k].
            qpos: Positions [k, nq].
            mocap_pos: Fixture positions [m], shape [k, nmocap, 3].
            mocap_quat: Fixture orientations wxyz, shape [k, nmocap, 4].
        """

    def set_dynamics(self, worlds: np.ndarray, samples: Sequence[Mapping[str, float]]) -> None:
        """See `interfaces.Physics.set_dynamics`."""
        changed = []
        for world, sample in zip(worlds.tolist(), samples, strict=True):
            if sample or self._model_of[world] is not self._built[world]:
                model = self._built[world]
                self._model_of[world] = varied(model, self.scene.robot, sample) if sample else model
                changed.append(world)
        if changed:
            self._use_models(changed)

    def _use_models(self, worlds: Sequence[int]) -> None:  # noqa: B027 - an engine may read the models at each step
        """Step these worlds by their models from now on."""

    def close(self) -> None:  # noqa: B027 - an engine without threads has nothing to release
        """See `interfaces.Physics.close`."""

    def add_velocity(self, change: np.ndarray, mask: np.ndarray | None = None) -> None:
        """See `interfaces.Physics.add_velocity`."""
        rows = np.arange(self.worlds) if mask is None else np.flatnonzero(mask)
        root = self.scene.robot.root_qvel
        qvel = self.qvel.numpy()
        qvel[rows, root : root + 6] += np.asarray(change, dtype=np.float32)[rows]
        self.qvel.assign(qvel)

    def lock_latch(self, mask: wp.array) -> None:
        """Lock the door's latch again in the worlds of a mask; int32 Warp array [worlds], 1 = lock."""
        latch.launch_lock(mask, self.latch_locked)

    def write_newton_state(self, state: newton.State) -> None:
        """See `interfaces.Physics.write_newton_state`."""
        newton_state.launch_body_q(self.xpos, self.xquat, self._newton_bodies, state.body_q)

    def _reset_all(self) -> None:
        fixtures = (np.tile(self.mocap_pos0, (self.worlds, 1, 1)), np.tile(self.mocap_quat0, (self.worlds, 1, 1)))
        self.reset_worlds(np.arange(self.worlds), self.qpos0, *fixtures)


def _at_rate(model: mujoco.MjModel, scene: Scene, rate: PhysicsRate) -> mujoco.MjModel:
    """A copy of a MuJoCo model for this time step, on which a ball's bounce depends too."""
    own = copy.copy(model)
    own.opt.timestep = rate.dt
    if scene.ball_restitution is not None:
        set_restitution(scene, scene.ball_restitution, rate.dt, own)
    return own
