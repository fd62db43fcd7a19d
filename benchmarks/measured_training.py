"""A training whose speed is measured, ours or LeRobot's, in a process of its own.

Run by `training_bench` as `python -m benchmarks.measured_training OPTIONS [lerobot]`, the flags as JSON. Its output is
a line `ready`, after which it waits for a line, then a JSON object with the figure or an error.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
import time
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from arena_newton.errors import ArenaError
from arena_newton.physics.devices import torch_device
from arena_newton.pictures.settings import FRONT
from arena_newton.policies.recipes.training_recipe import TrainingRecipe, recipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames.demonstration_rows import (
    CAMERA_KEY,
    VECTOR_KEY,
    DatasetRows,
    read_rows,
    statistics,
)
from arena_newton.policies.train.frames.feature_scaling import Stats
from arena_newton.policies.train.frames.frame_store import FrameStore, load_frames, made_statistics
from arena_newton.policies.train.frames.look_store import load_looks
from arena_newton.policies.train.network_compiler import check_compiler
from arena_newton.policies.train.network_memory import network_bytes
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from arena_newton.policies.train.training import fast_kernels, make_batches
from benchmarks.bench_options import TrainingBenchOptions
from benchmarks.made_frames import made_frames, made_looks

__all__ = ["READY", "WARM_STEPS", "SpeedFigure", "bench_recipe", "main"]

READY = "ready"
"""Line that says that the clock may start."""
WARM_STEPS = 15
"""Steps before the clock starts: a graph is captured, convolutions are chosen."""
SYNCHRONISED = 10
"""Steps on CUDA between readings of the clock, each of which waits for the device."""


@dataclass(frozen=True)
class SpeedFigure:
    """Speed of one training of a measurement."""

    steps_per_s: float
    memory: float
    """Most memory of the device that torch held [GB]; 0 on the CPU."""
    graphed: bool
    """True if a step was a CUDA graph."""


def bench_recipe(options: TrainingBenchOptions) -> TrainingRecipe:
    """The recipe that is measured.

    Raises:
        InputError: The family has no such recipe.
    """
    changes = {"batch_size": options.batch_size} if options.batch_size else {}
    return recipe(options.policy, options.recipe, **changes)


def _read(options: TrainingBenchOptions, settings: TrainingRecipe) -> tuple[list[DatasetRows], Stats]:
    """Rows of the datasets, and their statistics."""
    datasets = [read_rows(root, settings.labels) for root in options.dataset]
    arrays = statistics(datasets, [e for dataset in datasets for e in dataset.episodes], settings.labels)
    return datasets, {
        key: {name: torch.from_numpy(values) for name, values in of.items()} for key, of in arrays.items()
    }


def _data(options: TrainingBenchOptions, settings: TrainingRecipe, device: torch.device) -> tuple[FrameStore, Stats]:
    """Rows on the device and their statistics."""
    network = network_bytes(settings, device)
    if not options.dataset:
        store = made_frames(options.frames, settings.picture, device, network=network)
        looks = made_looks(store, options.looks) if options.looks else None
        return dataclasses.replace(store, looks=looks), made_statistics()
    datasets, stats = _read(options, settings)
    ones = torch.ones(len({episode.task for dataset in datasets for episode in dataset.episodes}))
    stats = {**stats, VECTOR_KEY: {"mean": 0 * ones, "std": ones}}
    store = load_frames(datasets, device, network=network)
    looks = load_looks(datasets, store, options.looks, {}, network=network) if options.looks else None
    return dataclasses.replace(store, looks=looks), stats


def _trainer(options: TrainingBenchOptions, settings: TrainingRecipe, device: torch.device) -> PolicyTrainer:
    if options.compile:
        check_compiler(device)
    families.check_weights(settings, options.weights or None)
    store, stats = _data(options, settings, device)
    torch.manual_seed(settings.seed)
    model = families.build(settings, stats, device, options.weights or None)
    vector = store.tasks if settings.use_task_vector else ()
    return PolicyTrainer(
        model, make_batches(model, store, vector), settings, graph=options.graph, compiled=options.compile
    )


def _own_steps(trainer: PolicyTrainer, many: int) -> Generator[float]:
    """Our training, so many steps at a time; yields the loss."""
    while True:
        for _ in range(many):
            trainer.advance()
        yield float(trainer.loss)  # waits for the device


def _lerobot_steps(options: TrainingBenchOptions, settings: TrainingRecipe, device: torch.device) -> Generator[float]:
    """LeRobot's loop: its data loader, its processors, `policy.forward`, its optimizer; yields the loss."""
    datasets, stats = _read(options, settings)
    model = families.build(settings, stats, device, options.weights or None)
    root, camera, fps = datasets[0].root, datasets[0].cameras[FRONT], 50
    cut = (settings.picture - settings.height) // 2
    config = model.policy.config
    deltas = {"action": [tick / fps for tick in config.action_delta_indices]}
    for key in (camera, "observation.state"):
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
    while True:
        for batch in loader:
            if camera != CAMERA_KEY:
                batch[CAMERA_KEY] = batch.pop(camera)
            batch[CAMERA_KEY] = batch[CAMERA_KEY][..., cut : cut + settings.height, :]
            loss, _ = model.policy.forward(model.preprocess(batch))
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.policy.parameters(), settings.grad_clip)
            optimizer.step()
            optimizer.zero_grad()
            yield float(loss.item())  # as LeRobot's own log of each step


def measured(options: TrainingBenchOptions, *, lerobot: bool = False) -> SpeedFigure:
    """Warm up, wait for a line on the input, and take steps for the time that is asked for.

    Raises:
        ArenaError: The training cannot be made, or its loss is not finite.
    """
    device = torch_device(options.device)
    cuda = device.type == "cuda"
    if cuda:
        torch.cuda.set_device(device)
    settings, many = bench_recipe(options), SYNCHRONISED if cuda and not lerobot else 1
    with fast_kernels(device), contextlib.ExitStack() as ended:
        trainer = None if lerobot else _trainer(options, settings, device)
        steps = _lerobot_steps(options, settings, device) if trainer is None else _own_steps(trainer, many)
        ended.callback(steps.close)
        for _ in range(math.ceil(WARM_STEPS / many) if cuda else 1):
            next(steps)
        print(READY, flush=True)
        if not sys.stdin.readline():
            raise ArenaError("the bench that measures has ended")
        began, taken, loss = time.perf_counter(), 0, 0.0
        while not taken or time.perf_counter() - began < options.seconds:
            loss = next(steps)
            taken += many
        spent = time.perf_counter() - began
        if not math.isfinite(loss):
            raise ArenaError(f"the loss is {loss}")
        memory = torch.cuda.max_memory_reserved(device) / 1e9 if cuda else 0.0
    return SpeedFigure(taken / spent, memory, trainer is not None and trainer.graphed)


def main(argument: str, *more: str) -> int:
    """Measure one training.

    Args:
        argument: Flags of the bench as JSON.
        more: `lerobot` for LeRobot's loop.

    Returns:
        Exit code 0; an error is in the output.
    """
    content = json.loads(argument)
    content["dataset"] = tuple(Path(one) for one in content["dataset"])
    try:
        answer = dataclasses.asdict(measured(TrainingBenchOptions(**content), lerobot="lerobot" in more))
    except (ArenaError, torch.OutOfMemoryError) as error:
        answer = {"error": " ".join(str(error).split())[:400]}
    print(json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
