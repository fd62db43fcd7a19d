"""A training whose speed is measured, in a process of its own: it says when it is ready, and begins when it is told.

Run by `training_bench` as `python -m arena_newton.policies.train.measured_training OPTIONS`, the flags as JSON. Its
output is a line `ready`, then a JSON object with the figure or an error.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from arena_newton.errors import ArenaError
from arena_newton.policies.recipes.training_recipe import TrainingRecipe, recipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames.demonstration_rows import VECTOR_KEY, read_rows, statistics
from arena_newton.policies.train.frames.feature_scaling import Stats
from arena_newton.policies.train.frames.frame_store import FrameStore, load_frames, made_frames, made_statistics
from arena_newton.policies.train.network_compiler import check_compiler
from arena_newton.policies.train.network_memory import network_bytes
from arena_newton.policies.train.policy_options import TrainingBenchOptions
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from arena_newton.policies.train.training import chosen_device, fast_kernels, make_batches

__all__ = ["READY", "WARM_STEPS", "SpeedFigure", "bench_recipe", "main"]

READY = "ready"
"""Line that says that the clock may start."""
WARM_STEPS = 15
"""Steps before the clock starts: a graph is captured, convolutions are chosen."""
SYNCHRONISED = 10
"""Steps on CUDA between looks at the clock, each of which waits for the device."""


@dataclass(frozen=True)
class SpeedFigure:
    """Figures of one training of a measurement."""

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


def _data(options: TrainingBenchOptions, settings: TrainingRecipe, device: torch.device) -> tuple[FrameStore, Stats]:
    """Rows on the device and their statistics."""
    network = network_bytes(settings, device)
    if not options.dataset:
        return made_frames(options.frames, settings.picture, device, network=network), made_statistics()
    datasets = [read_rows(root, settings.labels) for root in options.dataset]
    episodes = [episode for dataset in datasets for episode in dataset.episodes]
    arrays = statistics(datasets, episodes, settings.labels)
    stats = {key: {name: torch.from_numpy(values) for name, values in of.items()} for key, of in arrays.items()}
    ones = torch.ones(len({episode.task for episode in episodes}))
    stats[VECTOR_KEY] = {"mean": 0 * ones, "std": ones}
    return load_frames(datasets, device, network=network), stats


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


def measured(options: TrainingBenchOptions) -> SpeedFigure:
    """Warm up, wait for a line on the input, and take steps for the time that is asked for.

    Raises:
        ArenaError: The training cannot be made, or its loss is not finite.
    """
    device, _ = chosen_device(options.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    with fast_kernels(device):
        trainer = _trainer(options, bench_recipe(options), device)
        for _ in range(WARM_STEPS if device.type == "cuda" else 1):
            trainer.advance()
        float(trainer.loss)  # waits for the device
        print(READY, flush=True)
        if not sys.stdin.readline():
            raise ArenaError("the bench that measures has ended")
        began, steps, loss = time.perf_counter(), 0, 0.0
        while not steps or time.perf_counter() - began < options.seconds:
            for _ in range(SYNCHRONISED if device.type == "cuda" else 1):
                trainer.advance()
                steps += 1
            loss = float(trainer.loss)
        spent = time.perf_counter() - began
        if not math.isfinite(loss):
            raise ArenaError(f"the loss is {loss}")
        memory = torch.cuda.max_memory_reserved(device) / 1e9 if device.type == "cuda" else 0.0
    return SpeedFigure(steps / spent, memory, trainer.graphed)


def main(argument: str) -> int:
    """Measure one training.

    Args:
        argument: Flags of the bench as JSON.

    Returns:
        Exit code 0; an error is in the output.
    """
    content = json.loads(argument)
    content["dataset"] = tuple(Path(one) for one in content["dataset"])
    try:
        answer = dataclasses.asdict(measured(TrainingBenchOptions(**content)))
    except (ArenaError, torch.OutOfMemoryError) as error:
        answer = {"error": " ".join(str(error).split())[:400]}
    print(json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
