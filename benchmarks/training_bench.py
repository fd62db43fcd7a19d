"""``python -m benchmarks training``: steps/s of one training, of several at once on one device, of LeRobot's loop."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Iterator

import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.files.own_processes import environment
from arena_newton.physics.devices import torch_device
from arena_newton.policies.train.policy_options import check_choices
from benchmarks.bench_options import TrainingBenchOptions
from benchmarks.measured_training import READY, SpeedFigure, bench_recipe

__all__ = ["measure", "training_figures"]

PROGRAM = "benchmarks.measured_training"
"""Module that a measured training runs."""
BAR = 70.0
"""Steps/s of one ACT training of batch 64 on one H200 that the product must reach; LeRobot's own loop reached 31."""
MOST_TRAININGS = 16
"""Most trainings that are measured side by side."""


def check(options: TrainingBenchOptions) -> None:
    """Refuse flags before anything is measured.

    Raises:
        InputError: A flag's value is unfit.
    """
    check_choices(options.policy, options.recipe, options.dataset, compiled=options.compile)
    if not options.trainings or not all(1 <= n <= MOST_TRAININGS for n in options.trainings):
        raise InputError(f"--trainings: expected numbers from 1 to {MOST_TRAININGS}")
    if options.against_lerobot and not options.dataset:
        raise InputError("--against-lerobot: LeRobot's loop reads a dataset; name one with --dataset")
    if options.against_lerobot and bench_recipe(options).use_task_vector:
        raise InputError("--against-lerobot: LeRobot's loader gives no task vector; choose a recipe without one")


def training_figures(options: TrainingBenchOptions) -> Iterator[BenchFigure]:
    """Steps per second of each number of trainings at once, all together.

    Raises:
        InputError: A flag is unfit.
        ArenaError: A training failed, or the trainings do not fit into the device's memory.
    """
    check(options)
    device = torch_device(options.device)
    settings = bench_recipe(options)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    judged = "H200" in name and settings.family == "act" and settings.batch_size == 64 and settings.name != "small"
    source = ", ".join(str(one) for one in options.dataset) or f"{options.frames} made-up pictures"
    about = f"{settings.family}/{settings.name}, batch {settings.batch_size}"
    facts = f"{settings.precision}, {settings.picture}x{settings.height} pixels, {source}, on {name}"
    alone = None
    for count in options.trainings:
        found = measure(options, count)
        total = sum(one.steps_per_s for one in found)
        notes = [" + ".join(f"{one.steps_per_s:.1f}" for one in found)] if count > 1 else []
        notes += ["one graph a step" if found[0].graphed else "no graph", *(["compiled"] if options.compile else [])]
        notes += [f"{max(one.memory for one in found):.1f} GB each"] if device.type == "cuda" else []
        bar = BAR if judged and count == 1 else None
        alone = total if count == 1 else alone
        label = f"training, {about}, {f'{count} at once' if count > 1 else 'alone'}"
        yield BenchFigure(label, bar, "steps/s", False, total, "; ".join([*notes, facts]))
    if options.against_lerobot:
        (loop,) = measure(options, 1, lerobot=True)
        note = "" if alone is None else f"ours alone is {alone / loop.steps_per_s:.1f} times as fast"
        label = f"LeRobot's loop, {about}, {options.workers} workers"
        yield BenchFigure(label, None, "steps/s", False, loop.steps_per_s, note)


def measure(options: TrainingBenchOptions, count: int, *, lerobot: bool = False) -> list[SpeedFigure]:
    """Figures of so many trainings, each in a process of its own, that begin together.

    Args:
        lerobot: LeRobot's own loop instead of ours.

    Raises:
        ArenaError: A training failed.
    """
    flags = dataclasses.asdict(options) | {"dataset": [str(one.resolve()) for one in options.dataset]}
    variables = environment()
    command = _command(json.dumps(flags), lerobot)
    processes: list[subprocess.Popen[str]] = []
    try:
        for _ in range(count):
            processes.append(
                subprocess.Popen(
                    command, env=variables, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
                )
            )
        for process in processes:
            _answer(process, count)
        for process in processes:
            assert process.stdin is not None
            process.stdin.write("go\n")
            process.stdin.flush()
        answers = [_answer(process, count) for process in processes]
    finally:
        for process in processes:
            if process.poll() is None:
                process.terminate()
            process.communicate()
    return [SpeedFigure(one["steps_per_s"], one["memory"], bool(one["graphed"])) for one in answers]


def _command(flags: str, lerobot: bool) -> list[str]:
    """Command of a measured training."""
    return [sys.executable, "-P", "-m", PROGRAM, flags, *(["lerobot"] if lerobot else [])]


def _answer(process: subprocess.Popen[str], count: int) -> dict[str, float]:
    """The next answer of a measured training; empty where it is ready.

    Raises:
        ArenaError: It failed.
    """
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == READY:
            return {}
        if line.startswith("{"):
            answer = json.loads(line)
            if "error" in answer:
                raise ArenaError(f"bench, {count} at once: {answer['error']}")
            return dict(answer)
    raise ArenaError(f"bench, {count} at once: a training ended with code {process.wait()}")
