"""``policies train bench``: steps/s of a training alone, of several at once on one device, of LeRobot's loop."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from arena_newton.errors import ArenaError, InputError
from arena_newton.files.own_processes import environment
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames.demonstration_rows import CAMERA_KEY, read_rows, statistics
from arena_newton.policies.train.measured_training import READY, WARM_STEPS, SpeedFigure, bench_recipe
from arena_newton.policies.train.training import chosen_device, fast_kernels

if TYPE_CHECKING:
    from arena_newton.policies.train.policy_options import TrainingBenchOptions

__all__ = ["bench"]

PROGRAM = "arena_newton.policies.train.measured_training"
"""Module that a measured training runs."""
BAR = 70.0
"""Steps/s of one ACT training of batch 64 on one H200 that the product must reach."""
LOOP_BAR = 31.0
"""Speed of LeRobot's own loop there, for comparison."""
START_LIMIT = 900.0
"""Longest time that the processes may take to begin [s]."""


def bench(options: TrainingBenchOptions) -> list[tuple[int, list[SpeedFigure]]]:
    """Measure and print.

    Args:
        options: Flags.

    Returns:
        Number of trainings at once, and a figure of each.

    Raises:
        InputError: A flag is unfit, or the trainings do not fit into the device's memory.
        ArenaError: A training failed.
    """
    device, _ = chosen_device(options.device)
    settings = bench_recipe(options)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    source = ", ".join(str(one) for one in options.dataset) or f"{options.frames} made-up pictures"
    print(
        f"{settings.family}/{settings.name}, batch {settings.batch_size}, {settings.precision}, "
        f"{settings.picture}x{settings.picture} pixels, {source}, on {name}",
        flush=True,
    )
    found = []
    for count in options.trainings:
        figures = _at_once(options, count)
        found.append((count, figures))
        each = " + ".join(f"{one.steps_per_s:.1f}" for one in figures)
        total = sum(one.steps_per_s for one in figures)
        kind = "one graph a step" if figures[0].graphed else "no graph"
        kind += ", compiled" if options.compile else ""
        line = f"{count} at once: {each} = {total:.1f} steps/s" if count > 1 else f"alone: {total:.1f} steps/s"
        memory = f", {max(one.memory for one in figures):.1f} GB each" if device.type == "cuda" else ""
        print(f"{line} ({kind}{memory}){_verdict(name, settings, total) if count == 1 else ''}", flush=True)
    if options.against_lerobot:
        own = next((figures[0].steps_per_s for count, figures in found if count == 1), None)
        loop = _lerobot_loop(options, settings, device)
        ratio = f"; ours alone is {own / loop:.1f} times as fast" if own is not None else ""
        print(f"LeRobot's loop, {options.workers} workers: {loop:.1f} steps/s{ratio}", flush=True)
    return found


def _verdict(device: str, settings: TrainingRecipe, speed: float) -> str:
    """Sentence on whether the bar is reached, where it is about this measurement."""
    if "H200" not in device or settings.family != "act" or settings.batch_size != 64 or settings.name == "small":
        return ""
    return f"  >= {BAR:.0f} {'pass' if speed >= BAR else 'MISS'} (LeRobot's loop: {LOOP_BAR:.0f})"


def _at_once(options: TrainingBenchOptions, count: int) -> list[SpeedFigure]:
    """Figures of so many trainings, each in a process of its own, that begin together."""
    flags = dataclasses.asdict(options) | {"dataset": [str(one.resolve()) for one in options.dataset]}
    variables = environment()
    command = _command(json.dumps(flags))
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
        return [_figure(_answer(process, count)) for process in processes]
    finally:
        for process in processes:
            if process.poll() is None:
                process.terminate()
            process.communicate()


def _command(flags: str) -> list[str]:
    """Command of a measured training."""
    return [sys.executable, "-P", "-m", PROGRAM, flags]


def _figure(answer: Mapping[str, float]) -> SpeedFigure:
    return SpeedFigure(answer["steps_per_s"], answer["memory"], bool(answer["graphed"]))


def _answer(process: subprocess.Popen[str], count: int) -> dict[str, float]:
    """The next answer of a measured training; empty where it says that it is ready.

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


def _lerobot_loop(options: TrainingBenchOptions, settings: TrainingRecipe, device: torch.device) -> float:
    """Steps/s of what LeRobot's trainer does: its data loader, its processors, `policy.forward`, its way to step."""
    datasets = [read_rows(root, settings.labels) for root in options.dataset]
    arrays = statistics(datasets, [e for d in datasets for e in d.episodes], settings.labels)
    stats = {key: {name: torch.from_numpy(values) for name, values in of.items()} for key, of in arrays.items()}
    if settings.use_task_vector:
        raise InputError("--against-lerobot: LeRobot's loader gives no task vector; choose a recipe without one")
    model = families.build(settings, stats, device, options.weights or None)
    root, fps = datasets[0].root, 50
    config = model.policy.config
    deltas = {"action": [tick / fps for tick in config.action_delta_indices]}
    for key in (datasets[0].camera, "observation.state"):
        if config.observation_delta_indices is not None:
            deltas[key] = [tick / fps for tick in config.observation_delta_indices]
    dataset = LeRobotDataset(f"local/{Path(root).name}", root=root, delta_timestamps=deltas)
    loader = torch.utils.data.DataLoader(
        dataset,
        batch_size=settings.batch_size,
        shuffle=True,
        num_workers=options.workers,
        pin_memory=device.type == "cuda",
        drop_last=len(dataset) >= settings.batch_size,
    )
    optimizer = torch.optim.AdamW(model.groups(), lr=settings.lr, weight_decay=settings.weight_decay)
    model.policy.train()

    def batches() -> Generator[dict[str, object]]:
        while True:
            yield from loader

    began, steps = 0.0, 0
    with fast_kernels(device), contextlib.closing(batches()) as source:
        for number, batch in enumerate(source):
            if number == WARM_STEPS if device.type == "cuda" else number == 1:
                began, steps = time.perf_counter(), 0
            if datasets[0].camera != CAMERA_KEY:
                batch[CAMERA_KEY] = batch.pop(datasets[0].camera)
            loss, _ = model.policy.forward(model.preprocess(batch))
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.policy.parameters(), settings.grad_clip)
            optimizer.step()
            optimizer.zero_grad()
            loss.item()  # as LeRobot's own log of each step
            steps += 1
            if began and time.perf_counter() - began > options.seconds:
                break
    return steps / (time.perf_counter() - began)
