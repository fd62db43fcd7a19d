"""Adjoint of a tick of native MuJoCo in one world, by the implicit function theorem where its solver stopped.

The solver leaves an acceleration a at which inverse dynamics F(q, v, a), explicit in its arguments, equals the drives'
torque. That equation is differentiated instead of the solver's iterations: forward is `mj_step` itself, backward solves
once with dF/da, the Hessian of the solver's cost. The integrator adds (M - h D)(v' - v) = h M a and q' = q + h v', on
the manifold; D is constant, but has -dC/dv too for a body that moves freely by itself. Gradients of positions are
tangent, of length nv, where a name does not say qpos.

dF/da = M + J' R J and dF/dv = dC/dv + J' R b J are closed: J the constraints' Jacobian, R their stiffness where they
act and 0 elsewhere, b their damping (`efc_J`, `efc_D`, `efc_KBIP` of MuJoCo), C Coriolis and passive forces. Only dF/dq
is differenced: trees that no constraint connects move at once, and joints that move no constraint without constraints.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from arena_newton.errors import InputError
from arena_newton.physics.mujoco_engine import lone_joints
from arena_newton.physics.scene import Scene

__all__ = ["ImplicitWorld", "Inputs", "check", "scaled"]

_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_QUADRATIC = int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC)
"""State of a constraint that acts."""
_STEP = 3e-9
"""Step of the differences of inverse dynamics in positions [m, rad]. They are one-sided and a contact stiffens within
1 mm, so that their error is in proportion: 1e-4 of a slope at 1e-7; that of rounding is below 1e-6 here."""
_FACTOR_STEP = 1e-6
"""Step of the differences of inverse dynamics in a factor of the model."""
_AXES = np.array([[[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
                  [[0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]],
                  [[0, 0, 0, -1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]]], dtype=np.float64)  # fmt: skip
"""`_AXES[i] @ quat` is quat times the i-th imaginary unit, twice its change per angle about body axis i."""

_WORLD_AXES = np.array([[[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]],
                        [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
                        [[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]]], dtype=np.float64)  # fmt: skip
"""The same with the unit to the left, about axis i of the world."""

_CROSS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0],
                   [0, 0, 1, 0, 0, 0, -1, 0, 0],
                   [0, -1, 0, 1, 0, 0, 0, 0, 0]], dtype=np.float64)  # fmt: skip
"""Map from a vector to the nine numbers of the matrix of its cross product."""

Scaled = list[tuple[str, list[int] | tuple[list[int], int]]]
"""Fields of a MuJoCo model, and the index of the numbers in each, that one parameter scales."""


def check(m: mujoco.MjModel) -> None:
    """Refuse a model of which a part has no gradient here.

    Raises:
        InputError: It names the first such part.
    """
    drives = [
        m.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT,
        m.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED,
        m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE,
        np.isclose(m.actuator_biasprm[:, 1], -m.actuator_gainprm[:, 0]),  # a velocity drive has gain kd, and no kp
        m.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE,
        m.actuator_gear[:, 0] == 1.0,
        ~(m.actuator_forcelimited | m.actuator_ctrllimited).astype(bool),
        np.isin(m.jnt_type[m.actuator_trnid[:, 0]], (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)),
    ]
    foreign = ~np.logical_and.reduce(drives)
    parts = {
        "an integrator other than implicitfast": m.opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
        "a tendon": m.ntendon > 0,
        "an activation state": m.na > 0,
        f"actuator {[*foreign, True].index(True)}, not a joint's position drive": foreign.any(),
        "a delayed actuator": m.nhistory > 0,
        "a deformable body": m.nflex > 0,
        "a plugin": m.nplugin > 0,
        "a fluid": m.opt.density > 0.0 or m.opt.viscosity > 0.0,
        "nonlinear damping": m.dof_dampingpoly.any() or m.actuator_damping.any(),
        "gravity compensation by a drive": m.jnt_actgravcomp.any(),
        "a solver without slip": m.opt.noslip_iterations > 0,
        "elliptic friction cones": m.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL,
    }
    for part, there in parts.items():
        if there:
            raise InputError(f"engine mujoco has no gradient here: its model has {part}")


def scaled(name: str, scene: Scene) -> Scaled:
    """Numbers of the scene's model that a parameter scales: `mass`, `friction`, `kp`, `kd`, `mass:PRIM,PRIM` and so on.

    Raises:
        InputError: Another name, or a prim without bodies, geoms or driven joints.
    """
    kind, _, prim = name.partition(":")
    m, prims = scene.mj_model, prim.split(",")

    def under(paths: dict[str, int]) -> list[int]:
        found = [index for path, index in paths.items() for one in prims if path == one or path.startswith(f"{one}/")]
        return found if prim else list(paths.values())

    if kind == "mass":
        rows = under(scene.body_ids)
        found: Scaled = [("body_mass", rows), ("body_inertia", rows)]
    elif kind == "friction":
        rows = [geom for one in prims for geom in scene.geom_ids(one)] if prim else list(range(m.ngeom))
        found = [("geom_friction", (rows, 0))]
    elif kind in ("kp", "kd"):
        rows = np.flatnonzero(np.isin(m.actuator_trnid[:, 0], under(scene.joint_ids))).tolist()
        found = [("actuator_biasprm", (rows, 1 if kind == "kp" else 2))]
        found += [("actuator_gainprm", (rows, 0))] if kind == "kp" else []
    else:
        raise InputError(f"parameter {name}: must begin with mass, friction, kp or kd")
    if not rows:
        raise InputError(f"parameter {name}: {scene.path} has nothing of the kind at or under the prim")
    return found


class Inputs(NamedTuple):
    """Arguments of a tick of one world, or a number's gradient to them."""

    qpos: np.ndarray
    qvel: np.ndarray
    carried: np.ndarray
    """All else of the state (`mjSTATE_INTEGRATION`); it has no gradient."""
    targets: np.ndarray
    """Targets of the drives [rad]."""
    factors: np.ndarray
    """Factors of the model, one per parameter."""


class _Substep(NamedTuple):
    """A step of the engine: position and velocity before it, acceleration, and the change of velocity."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    change: np.ndarray


class ImplicitWorld:
    """One world: its ticks as the engine makes them, and their adjoint."""

    def __init__(self, model: mujoco.MjModel, scene: Scene, substeps: int, parameters: Sequence[Scaled]):
        """Copy a model, which `check` admits; `parameters` are the factors that every tick takes."""
        self._origin, self._latch, self._substeps, self._parameters = model, scene.latch, substeps, parameters
        self._fields = {field for parameter in parameters for field, _ in parameter}
        self._model, self._inverse = copy.copy(model), copy.copy(model)
        self._inverse.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICIT)  # for dC/dv
        self._inverse.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        self._flags = self._inverse.opt.disableflags
        self._data = self.data = mujoco.MjData(model)
        self._scaled: dict[int, bytes] = {}
        """Factors that each of the two models has now."""
        self._spare = mujoco.MjData(model)
        joints = model.actuator_trnid[:, 0]
        self._dof, self._qadr = model.jnt_dofadr[joints], model.jnt_qposadr[joints]
        bound = np.tile((-np.inf, np.inf), (model.nv, 1))
        limited = np.flatnonzero(model.jnt_actfrclimited)
        bound[model.jnt_dofadr[limited]] = model.jnt_actfrcrange[limited]
        self._low, self._high = bound.T
        turning = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}
        self._quats = [
            (int(model.jnt_qposadr[j]) + turning[kind], int(model.jnt_dofadr[j]) + turning[kind])
            for j, kind in enumerate(model.jnt_type.tolist())
            if kind in turning
        ]
        self._alone = [
            (int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]), np.flatnonzero(model.body_treeid == tree).tolist())
            for j in lone_joints(model)
            for tree in [model.body_treeid[model.jnt_bodyid[j]]]
        ]
        """Address of position, of velocity, and rigid bodies of each of `lone_joints`."""
        self._turns = np.array([[dof + 3, dof + 4, dof + 5] for _, dof, _ in self._alone], int).reshape(-1, 3)
        self._own = np.array([range(dof, dof + 6) for _, dof, _ in self._alone], int).reshape(-1, 6)
        self._lumped: tuple[bytes, np.ndarray, np.ndarray, np.ndarray] | None = None
        self._line_q = np.setdiff1d(np.arange(model.nq), [q + i for q, _ in self._quats for i in range(4)])
        self._line_v = np.setdiff1d(np.arange(model.nv), [v + i for _, v in self._quats for i in range(3)])
        self._mass_at = np.repeat(np.arange(model.nv), model.M_rownnz), model.M_colind
        self._rate_at = np.repeat(np.arange(model.nv), model.D_rownnz), model.D_colind
        self._sparse = mujoco.mj_isSparse(model)

    def read(self, state: np.ndarray, locked: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The state of a running physics as a tick takes it: qpos, qvel and all else.

        Raises:
            InputError: A force acts from outside, whose arm has no gradient here.
        """
        d = self._data
        mujoco.mj_setState(self._origin, d, state, _STATE)
        if d.xfrc_applied.any():
            raise InputError("engine mujoco has no gradient here: an external force acts on a body")
        if self._latch is not None:
            d.eq_active[self._latch.equality] = locked
        return self._read()

    def tick(self, given: Inputs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The engine's tick: qpos, qvel and all else after it."""
        d, latch = self._data, self._latch
        self._begin(given)
        mujoco.mj_step(self._model, d, self._substeps)
        if latch is not None and np.float32(d.qpos[latch.handle_qpos]) <= latch.release_angle:
            d.eq_active[latch.equality] = 0
        return self._read()

    def adjoint(self, given: Inputs, qpos: np.ndarray, qvel: np.ndarray) -> Inputs:
        """Gradient of a number to what a tick took, from its gradients to qpos and qvel after the tick."""
        self._begin(given)
        steps = self._steps()
        at_q, at_v, at_targets, at_factors = self._pulled(
            given, steps, self._tangent(self._data.qpos, qpos)[None], qvel[None]
        )
        return Inputs(
            self._ambient(given.qpos, at_q[0]), at_v[0], np.zeros_like(given.carried), at_targets[0], at_factors[0]
        )

    def jacobian(self, given: Inputs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Slopes of tangent position and velocity after a tick to those before it, to targets and to factors.

        Shapes [2 nv, 2 nv], [2 nv, nu] and [2 nv, factors].
        """
        self._begin(given)
        rows = np.eye(2 * self._model.nv)
        at_q, at_v, *rest = self._pulled(given, self._steps(), *np.hsplit(rows, 2))
        return np.hstack([at_q, at_v]), rest[0], rest[1]

    def _steps(self) -> list[_Substep]:
        """The steps of a tick that has begun."""
        d, steps = self._data, list[_Substep]()
        for _ in range(self._substeps):
            q, v = d.qpos.copy(), d.qvel.copy()
            mujoco.mj_step(self._model, d)
            steps.append(_Substep(q, v, d.qacc.copy(), d.qvel - v))
        return steps

    def _pulled(self, given: Inputs, steps: list[_Substep], at_q: np.ndarray, at_v: np.ndarray) -> list[np.ndarray]:
        """Tangent gradients of some numbers to what a tick took, from those to its end, one row per number."""
        self._scale(self._inverse, given.factors)
        at_targets = np.zeros((len(at_q), len(given.targets)))
        at_gains = np.zeros((2, *at_targets.shape))
        weighed: list[tuple[_Substep, np.ndarray, np.ndarray]] = []
        for step in reversed(steps):
            at_q, at_v, at_drives, by_gains, *weights = self._step_adjoint(step, given.targets, at_q, at_v)
            at_targets += at_drives
            at_gains += by_gains
            weighed.append((step, weights[0], weights[1]))
        at_factors = np.empty((len(at_q), len(given.factors)))
        base = self._inertial(weighed, given.factors) if self._parameters else 0.0
        for k, ((field, index), *_) in enumerate(self._parameters):
            if field == "actuator_biasprm":
                at_factors[:, k] = at_gains[index[1] - 1][:, index[0]].sum(axis=1) / given.factors[k]
                continue
            moved = given.factors.copy()
            moved[k] += _FACTOR_STEP
            at_factors[:, k] = (self._inertial(weighed, moved) - base) / _FACTOR_STEP
        return [at_q, at_v, at_targets, at_factors]

    def poses(self, qpos: np.ndarray, carried: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and orientations wxyz of the bodies, shapes [nbody, 3] and [nbody, 4]."""
        mujoco.mj_setState(self._model, self._data, carried, _STATE)
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.xpos.copy(), self._data.xquat.copy()

    def poses_adjoint(
        self, qpos: np.ndarray, carried: np.ndarray, at_xpos: np.ndarray, at_xquat: np.ndarray
    ) -> tuple[np.ndarray]:
        """Gradient to qpos from gradients to the bodies' poses."""
        m, d = self._model, self._data
        self.poses(qpos, carried)
        mujoco.mj_comPos(m, d)
        found, by_pos, by_turn = np.zeros(m.nv), np.empty((3, m.nv)), np.empty((3, m.nv))
        for body in np.flatnonzero(at_xpos.any(axis=1) | at_xquat.any(axis=1)).tolist():
            mujoco.mj_jacBody(m, d, by_pos, by_turn, body)
            found += at_xpos[body] @ by_pos + 0.5 * (_WORLD_AXES @ d.xquat[body]) @ at_xquat[body] @ by_turn
        return (self._ambient(qpos, found),)

    def _begin(self, given: Inputs) -> None:
        d = self._data
        self._scale(self._model, given.factors)
        mujoco.mj_setState(self._model, d, given.carried, _STATE)
        d.qpos[:], d.qvel[:], d.ctrl[:] = given.qpos, given.qvel, given.targets

    def _read(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        carried = np.empty(mujoco.mj_stateSize(self._origin, _STATE))
        mujoco.mj_getState(self._origin, self._data, carried, _STATE)
        return self._data.qpos.copy(), self._data.qvel.copy(), carried

    def _scale(self, model: mujoco.MjModel, factors: np.ndarray) -> None:
        if self._scaled.get(id(model)) == (now := factors.tobytes()):
            return
        self._scaled[id(model)] = now
        for field in self._fields:
            getattr(model, field)[:] = getattr(self._origin, field)
        for parameter, factor in zip(self._parameters, factors, strict=True):
            for field, index in parameter:
                getattr(model, field)[index] *= factor
        if "body_mass" in self._fields:
            mujoco.mj_setConst(model, self._spare)

    def _damping(self, model: mujoco.MjModel) -> np.ndarray:
        """Diagonal of the integrator's D; the engine keeps a drive's part where its torque is at the limit."""
        found: np.ndarray = np.bincount(self._dof, model.actuator_biasprm[:, 2], model.nv) - model.dof_damping
        return found

    def _torque(self, model: mujoco.MjModel, step: _Substep, targets: np.ndarray) -> np.ndarray:
        """Torque of the drives before their limits, shape [nv]."""
        bias = model.actuator_biasprm
        force = model.actuator_gainprm[:, 0] * targets + bias[:, 0]
        force = force + bias[:, 1] * step.q[self._qadr] + bias[:, 2] * step.v[self._dof]
        torque: np.ndarray = np.bincount(self._dof, force, model.nv)
        return torque

    def _mass_matrix(self) -> np.ndarray:
        rows, columns = self._mass_at
        full = np.zeros((self._model.nv, self._model.nv))
        full[rows, columns] = full[columns, rows] = self._data.M
        return full

    def _step_adjoint(
        self, step: _Substep, targets: np.ndarray, at_q: np.ndarray, at_v: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Gradients to position, velocity, targets and gains at a step, and the weights of its two equations, in rows.

        Those to gains are times the gains: of stiffness and of damping, shape [2, rows, nu].
        """
        m, d = self._inverse, self._data
        h = m.opt.timestep
        at_v, at_q = at_v + h * at_q, at_q.copy()
        for _, dof in self._quats:
            part = slice(dof, dof + 3)
            by_quat, by_vel = np.empty(9), np.empty(9)
            mujoco.mjd_quatIntegrate(step.v[part] + step.change[part], h, by_quat, by_vel, np.empty(3))
            at_v[:, part] += h * (at_q[:, part] @ by_vel.reshape(3, 3) - at_q[:, part])
            at_q[:, part] = at_q[:, part] @ by_quat.reshape(3, 3)
        m.opt.disableflags = self._flags
        d.qpos[:], d.qvel[:], d.qacc[:] = step.q, step.v, step.a
        mujoco.mj_inverse(m, d)
        mass, jacobian, (rows, columns) = self._mass_matrix(), self._jacobian(), self._rate_at
        stiffness, constrained = np.where(d.efc_state == _QUADRATIC, d.efc_D, 0.0), np.zeros_like(mass)
        mujoco.mju_sqrMatTD(constrained, jacobian, stiffness)
        stiffened = stiffness * d.efc_KBIP[:, 1]
        mujoco.mj_implicit(m, d)  # leaves qDeriv, and takes a step that nobody needs
        rates = np.zeros_like(mass)
        rates[rows, columns] = d.qDeriv
        y = h * _solved(mass - h * np.diag(self._damping(m)), at_v)
        if self._alone:
            own = self._own
            blocks = (mass - h * rates)[own[:, None], own[:, :, None]]
            y.T[own] = h * np.linalg.solve(blocks, at_v.T[own])
        w = _solved(mass + constrained, y @ mass)
        at_v = at_v - (stiffened * (w @ jacobian.T)) @ jacobian + w @ rates
        turned, spun = self._spinning(step, y)
        at_q, at_v = at_q + turned + self._by_position(step, y, w, jacobian != 0.0), at_v + spun
        torque = self._torque(m, step, targets)
        driven = np.where((torque > self._low) & (torque < self._high), w, 0.0)
        gain, bias, drive = m.actuator_gainprm[:, 0], m.actuator_biasprm, driven[:, self._dof]
        np.add.at(at_q.T, self._dof, (bias[:, 1] * drive).T)
        np.add.at(at_v.T, self._dof, (bias[:, 2] * drive).T)
        stiff = drive * (gain * targets + bias[:, 1] * step.q[self._qadr])
        damped = bias[:, 2] * (drive * step.v[self._dof] + (y * step.change)[:, self._dof])
        return at_q, at_v, gain * drive, np.stack([stiff, damped]), y, w

    def _spinning(self, step: _Substep, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients to position and velocity of y · D (v' - v) of the bodies that move freely by themselves.

        Of such a body's centre at r, mass m and inertia I in its frame Q, C is m ω × (ω × r) as a force, in Q, and
        ω × I ω as a torque about the centre. The sum itself is its gradient to v, times v.
        """
        at_q, at_v = np.zeros_like(y), np.zeros_like(y)
        if not self._alone:
            return at_q, at_v
        mass, lever, inertia = self._lumps()
        frames = np.empty((len(self._alone), 9))
        for frame, (qpos, *_) in zip(frames, self._alone, strict=True):
            mujoco.mju_quat2Mat(frame, step.q[qpos + 3 : qpos + 7])
        turns = self._turns
        spin, change, z = step.v[turns][:, None], step.change[turns][:, None], y.T[turns].transpose(0, 2, 1)
        pull = y.T[turns - 3].transpose(0, 2, 1) @ frames.reshape(-1, 3, 3)
        across, turned = _crossed(change), _crossed(change @ lever)
        force = mass * (change @ _crossed(spin @ lever) + spin @ turned)
        by_spin = (pull + z @ lever) @ (-mass * (across @ lever + turned))
        by_spin += z @ (across @ inertia - _crossed(change @ inertia))
        at_v[:, turns] = -by_spin.transpose(1, 0, 2)
        at_q[:, turns] = (pull @ _crossed(force)).transpose(1, 0, 2)
        return at_q, at_v

    def _lumps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mass, `_crossed` centre and inertia of bodies that move freely, shapes [n, 1, 1], [n, 3, 3], [n, 3, 3]."""
        m = self._inverse
        key = m.body_mass.tobytes() + m.body_inertia.tobytes()
        if self._lumped is None or self._lumped[0] != key:
            found = zip(*(_lump(m, bodies) for *_, bodies in self._alone), strict=True)
            mass, centre, inertia = map(np.array, found)
            self._lumped = key, mass[:, None, None], _crossed(centre[:, None]), inertia
        return self._lumped[1:]

    def _jacobian(self) -> np.ndarray:
        """Jacobian of the constraints, shape [constraints, nv]."""
        d = self._data
        full = np.zeros((d.nefc, self._model.nv))
        if self._sparse:
            full[np.repeat(np.arange(d.nefc), d.efc_J_rownnz), d.efc_J_colind] = d.efc_J
        else:
            full[:] = d.efc_J.reshape(full.shape)
        return full

    def _by_position(self, step: _Substep, y: np.ndarray, w: np.ndarray, moves: np.ndarray) -> np.ndarray:
        """Gradient of y · M(q) (a - (v' - v) / h) - w · F(q, v, a) to q.

        Args:
            step: It gives q, v, a and v' - v.
            y: Weights of what the integrator equates to 0, in rows.
            w: Weights of what the solver equates to 0.
            moves: Which degree of freedom moves which constraint, shape [constraints, nv].
        """
        m, d, found = self._inverse, self._data, np.empty_like(w)
        trees = np.eye(m.ntree)[m.dof_treeid]
        touched = moves @ trees
        joined = np.eye(m.ntree) + touched.T @ touched > 0.0
        for _ in range(m.ntree.bit_length()):
            joined = joined @ joined
        moved, islands = moves.any(axis=0), np.eye(m.ntree)[joined.argmax(axis=1)[m.dof_treeid]]
        rest, island = step.a - step.change / m.opt.timestep, int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        qpos, force = d.qpos, d.qfrc_inverse  # views: a property of MjData costs as much as the copy behind it
        d.qvel[:] = step.v
        for dofs, groups, flags in ((moved, islands, 0), (~moved, trees, int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT))):
            m.opt.disableflags = self._flags | island | flags
            at = np.flatnonzero(dofs)
            row = (groups[at].cumsum(axis=0) * groups[at]).sum(axis=1).astype(int)  # from 1 on in each group
            directions = np.zeros((row.max(initial=0) + 1, m.nv))
            directions[row, at] = _STEP
            forces, inertial = np.empty_like(directions), np.empty_like(directions)
            for k, point in enumerate(step.q + self._ambient(step.q, directions, 0.5)):
                qpos[:] = point
                mujoco.mj_inverse(m, d)
                mujoco.mj_mulM(m, d, inertial[k], rest)
                forces[k] = force
            for group in groups.T[groups[at].any(axis=0)].astype(bool):
                there = group[at]
                sums = y[:, group] @ inertial[:, group].T - w[:, group] @ forces[:, group].T
                found[:, at[there]] = (sums[:, row[there]] - sums[:, :1]) / _STEP
        return found

    def _inertial(self, weighed: Sequence[tuple[_Substep, np.ndarray, np.ndarray]], factors: np.ndarray) -> np.ndarray:
        """Weighted sums of what integrator and solver equate to 0, drives aside; gradients are slopes in a factor."""
        m, d, product = self._inverse, self._data, np.empty(self._model.nv)
        m.opt.disableflags = self._flags
        self._scale(m, factors)
        total = np.zeros(len(weighed[0][1]))
        for step, y, w in weighed:
            d.qpos[:], d.qvel[:], d.qacc[:] = step.q, step.v, step.a
            mujoco.mj_inverse(m, d)
            mujoco.mj_mulM(m, d, product, step.a - step.change / m.opt.timestep)
            total += y @ product - w @ d.qfrc_inverse + self._spinning(step, y)[1] @ step.v
        return total

    def _tangent(self, qpos: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Tangent gradient from one in the coordinates of qpos."""
        found = np.empty(self._model.nv)
        found[self._line_v] = gradient[self._line_q]
        for q, v in self._quats:
            found[v : v + 3] = 0.5 * (_AXES @ qpos[q : q + 4]) @ gradient[q : q + 4]
        return found

    def _ambient(self, qpos: np.ndarray, tangent: np.ndarray, turn: float = 2.0) -> np.ndarray:
        """Moves or gradients in the coordinates of qpos, shape [..., nq], from tangent ones, shape [..., nv].

        Args:
            qpos: Where.
            tangent: Moves or gradients per degree of freedom.
            turn: Length in a quaternion's coordinates of a unit of angle: 1/2 for moves, 2 for gradients.
        """
        found = np.empty((*tangent.shape[:-1], self._model.nq))
        found[..., self._line_q] = tangent[..., self._line_v]
        for q, v in self._quats:
            quat = qpos[q : q + 4]
            found[..., q : q + 4] = turn * tangent[..., v : v + 3] @ (_AXES @ quat) / (quat @ quat)
        return found


def _solved(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Solutions of a positive definite system, in one thread: LAPACK's wait for each other; overwrites matrix."""
    found = np.empty_like(rows)
    mujoco.mju_cholFactor(matrix, 0.0)
    for solution, row in zip(found, rows, strict=True):
        mujoco.mju_cholSolve(solution, matrix, row)
    return found


def _lump(m: mujoco.MjModel, bodies: Sequence[int]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre and inertia about it of rigidly joined bodies, parents first, in the frame of the first one."""
    poses, parts, turn, axes = {bodies[0]: (np.zeros(3), np.eye(3))}, [], np.empty(9), np.empty(9)
    for body in bodies:
        if body != bodies[0]:
            mujoco.mju_quat2Mat(turn, m.body_quat[body])
            at, frame = poses[int(m.body_parentid[body])]
            poses[body] = at + frame @ m.body_pos[body], frame @ turn.reshape(3, 3)
        at, frame = poses[body]
        mujoco.mju_quat2Mat(axes, m.body_iquat[body])
        main = frame @ axes.reshape(3, 3)
        parts.append((m.body_mass[body], at + frame @ m.body_ipos[body], main @ np.diag(m.body_inertia[body]) @ main.T))
    mass = sum(part for part, *_ in parts)
    centre = sum(part * at for part, at, _ in parts) / mass
    arms = [(part, at - centre, own) for part, at, own in parts]
    return mass, centre, sum(own + part * (s @ s * np.eye(3) - np.outer(s, s)) for part, s, own in arms)


def _crossed(b: np.ndarray) -> np.ndarray:
    """Matrices with which rows a give a × b, shape [n, 3, 3], of vectors b, shape [n, 1, 3]."""
    found: np.ndarray = (b @ _CROSS).reshape(-1, 3, 3)
    return found
