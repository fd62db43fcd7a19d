"""Cost of a gradient through a tick of engine `mujoco`, in bare ticks of it: processor time and memory."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial

import torch

from arena_newton import trackers
from arena_newton.differentiable import EngineState, EngineStep, closed_loop
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.bench_tick import as_before
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.files.text import counted
from arena_newton.robot.canonical import STAND_ACTION

__all__ = ["gradient_figures", "standing_step"]

TASKS = ("football", "vis_navi")
"""Scenes with two and with seven bodies that move freely, the robot included."""
WORLDS = (1, 16)
BARE = 25
"""Bare ticks of a round: one is too short for the clock."""
LOOP = 50
"""Ticks of a closed loop whose memory is measured, in one part or in two."""


def gradient_figures(rounds: int) -> Iterator[BenchFigure]:
    """Processor time of a tick backward as a multiple of a bare tick's, and memory that a tick forward keeps."""
    for task in TASKS:
        for worlds in WORLDS:
            yield from _figures(task, worlds, rounds)
    env = ArenaEnv("football", tracker=trackers.get("twist2"), worlds=1, rules="released", engine="mujoco")
    plan = torch.tensor(STAND_ACTION).double().repeat(1, LOOP, 1).requires_grad_()
    for checkpoint, which, bar in ((None, "", 100.0), (LOOP // 2, f", checkpoints of {LOOP // 2} ticks", 10.0)):
        kept = closed_loop(env, plan, [0], LOOP, checkpoint=checkpoint).memory / 1e3
        yield BenchFigure(f"memory of a closed loop per tick, twist2, 1 world{which}", bar, "kB", True, kept)
    env.close()


def standing_step(task: str, worlds: int) -> tuple[ArenaEnv, EngineStep, EngineState, torch.Tensor]:
    """Worlds whose robots stand after the start-up, their step, its state, and targets that take a gradient."""
    env = ArenaEnv(task, tracker=trackers.get("twist2"), worlds=worlds, engine="mujoco", fast_physics=True)
    env.reset(list(range(worlds)))
    for _ in range(env.startup_ticks):
        env.step(torch.tensor(STAND_ACTION).repeat(worlds, 1))
    step = EngineStep(env.physics)
    state, targets = step.state(), torch.from_numpy(env.physics.ctrl.numpy().copy()).double().requires_grad_()
    return env, step, state, targets


def _figures(task: str, worlds: int, rounds: int) -> Iterator[BenchFigure]:
    env, step, state, targets = standing_step(task, worlds)
    spent: dict[str, list[float]] = {"bare": [], "forward": [], "backward": []}
    for _ in range(rounds + 1):  # the first one warms up
        with as_before(env.physics):
            spent["bare"].append(_used(lambda: [env.physics.mj_step_only() for _ in range(BARE)])[0] / BARE)
        seconds, after = _used(partial(step, state, targets))
        spent["forward"].append(seconds)
        spent["backward"].append(_used(partial(torch.autograd.grad, after.qpos.sum() + after.qvel.sum(), targets))[0])
    env.close()
    bare, forward, backward = (statistics.median(times[1:]) / worlds for times in spent.values())
    name = f"a tick backward / bare tick, {task}, {counted(worlds, 'world')}, CPU"
    note = f"{1e3 * backward:.2f} ms / {1e3 * bare:.3f} ms of processor time per world; forward {forward / bare:.1f} x"
    yield BenchFigure(name, 50.0, "x", True, backward / bare, note)
    if worlds == 1:
        kept = sum(part.nbytes for part in (*state, targets)) / 1e3
        yield BenchFigure(f"memory of a tick for its gradient, {task}, 1 world", 10.0, "kB", True, kept)


def _used[Found](work: Callable[[], Found]) -> tuple[float, Found]:
    """Processor time of this process, all threads [s], and the result."""
    began = time.process_time()
    found = work()
    return time.process_time() - began, found
