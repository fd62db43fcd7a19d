"""Cost of a gradient by Newton's `SolverFeatherstone`, contacts as springs and a tape, next to the implicit tick.

Its slopes in contact are wrong in Newton 1.8 (`docs/howto/program/gradients.md`); what it would cost is a matter of its
own, above all on CUDA, where its worlds are one launch and the implicit tick stays on the CPU. Nearly all of a first
run is compilation, so that the robot is alone: the corners of its soles touch a floor that is no shape, no collision is
looked for, and of three modules of kernels two have adjoints.
"""

from __future__ import annotations

import importlib
import itertools
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import newton
import newton.solvers
import numpy as np
import torch
import warp as wp

from arena_newton.eval.bench.bench_gradients import standing_step
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.robot import g1
from arena_newton.tasks.base import SCENES
from arena_newton.tasks.handles import ROBOT
from arena_newton.usd_scenes.shapes import open_stage

__all__ = ["featherstone_figures"]

TASK = "football"
"""Scene of the implicit tick."""
STEP = 0.0005
"""Physics step [s]: with this one and these contacts a robot walks as in the engine for some seconds."""
SPRING = {"ke": 1e4, "kd": 100.0, "kf": 300.0}
"""Stiffness [N/m], damping [N s/m] and friction [N s/m] of every contact."""
CORNERS = tuple(itertools.product((-0.05, 0.12), (-0.03, 0.03), (-0.035,)))
"""Corners of a sole in the foot's link [m]."""
DEPTH = 0.004
"""Depth of the corners in the floor at first [m], at which the springs carry the robot."""
WORLDS = {"cpu": 4, "cuda": 1024}
ROUNDS = 3
ADJOINT_MODULES = ("newton._src.solvers.featherstone.kernels", "newton._src.solvers.semi_implicit.kernels_contact")
"""Modules of the kernels on the tape."""
FORWARD_MODULES = ("newton._src.sim.articulation", "newton._src.geometry.inertia")
"""Modules of kernels that run before it."""


def featherstone_figures(limit: float) -> Iterator[BenchFigure]:
    """Duration of each stage, and wall time of a tick forward and backward per world beside that of `EngineStep`.

    Each stage is told as it begins; one that has not ended after `limit` seconds of all is named, and left to itself.
    """
    found, began = queue.Queue[BenchFigure | Exception | None](), time.monotonic()
    threading.Thread(target=_measured, args=(found,), daemon=True).start()
    last = "the start"
    while True:
        try:
            figure = found.get(timeout=max(0.0, limit - (time.monotonic() - began)))
        except queue.Empty:
            yield BenchFigure("SolverFeatherstone's gradient", limit, "s", True, np.inf, f"not ended, after {last}")
            return
        if figure is None:
            return
        if isinstance(figure, Exception):
            raise figure
        last = figure.name
        yield figure


def _measured(found: queue.Queue[BenchFigure | Exception | None]) -> None:
    try:
        for figure in _figures():
            found.put(figure)
        found.put(None)
    except Exception as error:
        found.put(error)


def _figures() -> Iterator[BenchFigure]:
    device = "cuda" if wp.is_cuda_available() else "cpu"
    worlds, where = WORLDS[device], "cuda:0" if device == "cuda" else "cpu"
    _adjoints(FORWARD_MODULES, False)
    _adjoints(ADJOINT_MODULES, False)
    seconds, tick = _stage(f"{worlds} robots, {device.upper()}", where, lambda: _Tick(worlds, where))
    yield _duration("robots built", seconds)
    seconds, _ = _stage("kernels forward, and a tick", where, tick.forward)
    yield _duration("kernels forward, and a tick", seconds)
    _adjoints(ADJOINT_MODULES, True)
    seconds, _ = _stage("kernels with their adjoints, and a tick", where, tick.forward)
    yield _duration("kernels with their adjoints, and a tick", seconds)
    _, exact = _stage("implicit tick", "cpu", lambda: _implicit(min(worlds, 16)))
    for part, work, beside in zip(("forward", "backward"), (tick.forward, tick.backward), exact, strict=True):
        taken, _ = _stage(f"a tick {part}", where, work)
        name = f"SolverFeatherstone's tick {part} / implicit tick {part}, {worlds} worlds, {device.upper()}"
        note = f"{1e3 * taken / worlds:.2f} ms / {1e3 * beside:.2f} ms of wall time per world"
        yield BenchFigure(name, None, "x", True, taken / worlds / beside, note)
    yield BenchFigure("SolverFeatherstone's slopes that are finite", 1.0, "", False, tick.finite)


def _duration(name: str, seconds: float) -> BenchFigure:
    return BenchFigure(f"SolverFeatherstone: {name}", None, "s", True, seconds)


def _stage[Found](name: str, device: str, work: Callable[[], Found]) -> tuple[float, Found]:
    """Wall time of a stage [s] and its result; its name is printed as it begins."""
    print(f"featherstone: {name} ...", file=sys.stderr, flush=True)
    return _took(work, device)


def _adjoints(modules: Sequence[str], there: bool) -> None:
    """Compile modules with or without their adjoints when one of their kernels is launched next."""
    for name in modules:
        wp.set_module_options({"enable_backward": there}, module=importlib.import_module(name))


class _Tick:
    """A tick of robots that stand on eight corners each, on a tape."""

    def __init__(self, worlds: int, device: str):
        """Build the robots in their default pose."""
        stage = open_stage(SCENES / "lab" / "scene.usda", checked=False)
        stage.GetPrimAtPath(ROBOT).GetVariantSet("hands").SetVariantSelection("fixed")
        robot, builder = newton.ModelBuilder(), newton.ModelBuilder()
        robot.add_usd(stage, root_path=ROBOT, enable_self_collisions=False, load_visual_shapes=False)
        drive, angles = g1.TWIST2_DRIVE, dict(zip(g1.MUJOCO_JOINTS, g1.DEFAULT_POSE, strict=True))
        for joint, label in enumerate(robot.joint_label):
            if (name := label.rsplit("/", 1)[-1]) in angles:
                at, dof = robot.joint_q_start[joint], robot.joint_qd_start[joint]
                robot.joint_q[at] = robot.joint_target_q[at] = angles[name]
                number = g1.MUJOCO_JOINTS.index(name)
                robot.joint_target_ke[dof], robot.joint_target_kd[dof] = drive.kp[number], drive.kd[number]
        builder.replicate(robot, worlds)
        model = self._model = builder.finalize(device=device, requires_grad=True)
        for name, value in SPRING.items():
            getattr(model, f"shape_material_{name}").fill_(value)
        self._solver, self._control = newton.solvers.SolverFeatherstone(model), model.control()
        self._states = [model.state(requires_grad=True) for _ in range(round(g1.TICK / STEP) + 1)]
        newton.eval_fk(model, model.joint_q, model.joint_qd, self._states[0])
        self._contacts, self._tape = self._corners(), wp.Tape()

    def _corners(self) -> newton.Contacts:
        """Corners of the soles in a floor that is no shape."""
        model, where = self._model, self._states[0].body_q.numpy()
        feet = [body for body, label in enumerate(model.body_label) if label.rsplit("/", 1)[-1] in g1.FEET]
        shapes = [model.body_shapes[body][0] for body in feet]
        contacts = newton.Contacts(len(feet) * len(CORNERS), 0, requires_grad=True, device=model.device)
        points = np.tile(CORNERS, (len(feet), 1)).astype(np.float32)
        floor = np.repeat(where[feet, :3], len(CORNERS), axis=0) + points * (0.0, 0.0, 1.0) + (0.0, 0.0, DEPTH)
        contacts.rigid_contact_count.fill_(len(points))
        contacts.rigid_contact_shape0.assign(np.repeat(shapes, len(CORNERS)).astype(np.int32))
        contacts.rigid_contact_shape1.fill_(-1)
        contacts.rigid_contact_point0.assign(points)
        contacts.rigid_contact_point1.assign(floor.astype(np.float32))
        contacts.rigid_contact_normal.assign(np.tile((0.0, 0.0, -1.0), (len(points), 1)).astype(np.float32))
        return contacts

    def forward(self) -> None:
        """Play the tick."""
        self._tape = wp.Tape()
        with self._tape:
            for before, after in itertools.pairwise(self._states):
                self._solver.step(before, after, self._control, self._contacts, STEP)

    def backward(self) -> None:
        """Compute the gradient of the last positions' sum."""
        last = self._states[-1].joint_q
        self._tape.backward(grads={last: wp.ones_like(last, requires_grad=False)})

    @property
    def finite(self) -> float:
        """Fraction of the slopes to the first positions that are finite and not all 0."""
        slopes = self._states[0].joint_q.grad.numpy()
        return float(np.isfinite(slopes).mean()) if slopes.any() else 0.0


def _implicit(worlds: int) -> tuple[float, float]:
    """Wall time of a tick of `EngineStep` per world, forward and backward [s]."""
    env, step, state, targets = standing_step(TASK, worlds)
    times = []
    for _ in range(ROUNDS + 1):
        forward, after = _took(lambda: step(state, targets), "cpu")
        backward, _ = _took(partial(torch.autograd.grad, after.qpos.sum(), targets), "cpu")
        times.append((forward / worlds, backward / worlds))
    env.close()
    forward, backward = np.median(times[1:], axis=0)
    return float(forward), float(backward)


def _took[Found](work: Callable[[], Found], device: str) -> tuple[float, Found]:
    """Wall time [s], and the result."""
    wp.synchronize_device(device)
    began = time.perf_counter()
    found = work()
    wp.synchronize_device(device)
    return time.perf_counter() - began, found
