"""Cost of a gradient by Newton's `SolverFeatherstone`, contacts as springs and a tape, next to the implicit tick.

Its slopes in contact are wrong in Newton 1.8 (`docs/howto/program/gradients.md`); what it would cost is a matter of its
own, above all on CUDA, where its worlds are one launch and the implicit tick stays on the CPU.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from functools import partial

import newton
import numpy as np
import torch
import warp as wp

from arena_newton.eval.bench.bench_gradients import standing_step
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.physics.scene import load_scene
from arena_newton.robot.g1 import DEFAULT_POSE, MUJOCO_JOINTS, TICK

__all__ = ["featherstone_figures"]

TASK = "football"
STEP = 0.0005
"""Physics step [s]: with this one and these contacts a robot walks as in the engine for some seconds."""
SPRING = {"ke": 1e4, "kd": 100.0, "kf": 300.0}
"""Stiffness [N/m], damping [N s/m] and friction [N s/m] of every contact."""
WORLDS = {"cpu": 4, "cuda": 1024}
ROUNDS = 3


def featherstone_figures() -> Iterator[BenchFigure]:
    """Wall time of a tick forward and backward per world, by the solver on the best device and by `EngineStep`."""
    device = "cuda" if wp.is_cuda_available() else "cpu"
    worlds = WORLDS[device]
    forward, backward, finite = _taped(worlds, "cuda:0" if device == "cuda" else "cpu")
    exact = _implicit(min(worlds, 16))
    where = f"{worlds} worlds, {device.upper()}"
    for part, times, beside in (("forward", forward, exact[0]), ("backward", backward, exact[1])):
        name = f"SolverFeatherstone's tick {part} / implicit tick {part}, {where}"
        note = f"{1e3 * times / worlds:.2f} ms / {1e3 * beside:.2f} ms of wall time per world"
        yield BenchFigure(name, None, "x", True, times / worlds / beside, note)
    yield BenchFigure(f"SolverFeatherstone's slopes that are finite, {where}", 1.0, "", False, finite)


def _taped(worlds: int, device: str) -> tuple[float, float, float]:
    """Wall time of a tick of all worlds forward and backward [s], and the fraction of finite slopes."""
    scene = load_scene(TASK, worlds=worlds, device=device, hands="fixed", native=True)
    model = scene.model
    model.requires_grad = True
    for name, value in SPRING.items():
        getattr(model, f"shape_material_{name}").fill_(value)
    solver, pipeline = newton.solvers.SolverFeatherstone(model), newton.CollisionPipeline(model)
    contacts, control = pipeline.contacts(), model.control()
    _stand(model, control)
    count = round(TICK / STEP)
    forward, backward, finite = [], [], 0.0
    for _ in range(ROUNDS + 1):  # the first one compiles
        states = [model.state(requires_grad=True) for _ in range(count + 1)]
        newton.eval_fk(model, model.joint_q, model.joint_qd, states[0])
        pipeline.collide(states[0], contacts)

        tape = wp.Tape()

        def play(states: list[newton.State] = states, tape: wp.Tape = tape) -> None:
            with tape:
                for before, after in itertools.pairwise(states):
                    solver.step(before, after, control, contacts, STEP)

        seconds, _ = _took(play, device)
        forward.append(seconds)
        ones = wp.ones_like(states[-1].joint_q, requires_grad=False)
        backward.append(_took(partial(tape.backward, grads={states[-1].joint_q: ones}), device)[0])
        finite = float(np.isfinite(states[0].joint_q.grad.numpy()).mean())
    return float(np.median(forward[1:])), float(np.median(backward[1:])), finite


def _stand(model: newton.Model, control: newton.Control) -> None:
    """Put the robots in their default pose, with drives that hold it; they are at the spawn pose as built."""
    angles = dict(zip(MUJOCO_JOINTS, DEFAULT_POSE, strict=True))
    where, drive, firsts = model.joint_q.numpy(), control.joint_target_q.numpy(), model.joint_q_start.numpy()
    for joint, label in enumerate(model.joint_label):
        angle = angles.get(label.rsplit("/", 1)[-1])
        if angle is not None:
            where[firsts[joint]] = drive[firsts[joint]] = angle
    model.joint_q.assign(where)
    control.joint_target_q.assign(drive)


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
