"""One training of a policy, from datasets to a checkpoint: `train`."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from tqdm import tqdm

from arena_newton.errors import ArenaError, InputError
from arena_newton.files.text import counted
from arena_newton.physics.devices import torch_device, torch_threads
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts, vector_of
from arena_newton.policies.recipes.training_recipe import REALIGN, TrainingRecipe, recipe, with_pretrained
from arena_newton.policies.train.families import families
from arena_newton.policies.train.families.policy_model import TrainableModel
from arena_newton.policies.train.frames.batching import BatchMaker
from arena_newton.policies.train.frames.demonstration_rows import VECTOR_KEY, DatasetRows, read_rows, statistics
from arena_newton.policies.train.frames.frame_store import FrameStore, is_pad, load_frames
from arena_newton.policies.train.frames.look_store import load_looks
from arena_newton.policies.train.network_compiler import check_compiler
from arena_newton.policies.train.network_memory import network_bytes
from arena_newton.policies.train.policy_options import (
    PolicyTrainOptions,
    check_numbers,
    look_changes,
    look_fractions,
    recipe_values,
    task_weights,
)
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from arena_newton.policies.train.stored_flags import plain, plain_options, resumed, stored_recipe
from arena_newton.policies.train.trained_start import TrainedStart, of_training, read_start
from arena_newton.policies.train.training_loop import Processes, TrainingLoop
from arena_newton.policies.train.training_state import TrainingProgress, check_new, last_checkpoint, restore

__all__ = ["chosen_recipe", "fast_kernels", "make_batches", "train"]

TOKEN_ROWS = 4096
"""Rows whose prompts are made at once."""


def train(options: PolicyTrainOptions, named: Collection[str] = ()) -> Path:
    """Train to the end of the steps or of the time.

    Args:
        options: Flags. With `resume` those of the interrupted training hold; of those that may differ, what is not
            at its default is taken.
        named: With `resume`, fields that count though they are at their default.

    Returns:
        Folder of the last checkpoint, which `--policy lerobot:` and LeRobot load.

    Raises:
        InputError: A flag or a dataset is unfit.
        ArenaError: The training failed: a loss that is not finite, a full disk.
        KeyboardInterrupt: Ctrl-C or SIGTERM; the state was saved.
    """
    check_numbers(options)
    progress: TrainingProgress | None = None
    checkpoint: Path | None = None
    if options.resume is not None:
        checkpoint = last_checkpoint(options.resume)
        progress = TrainingProgress.read(checkpoint)
        quiet, before = options.quiet, progress.options.get("minutes")
        options = resumed(options, progress.options, checkpoint, named)
        check_numbers(options)
        if options.minutes and options.minutes != before:  # another time: the number of steps is fixed again
            progress = dataclasses.replace(progress, steps=0)
        if 0 < (options.steps or progress.steps) <= progress.step:  # it came to its end
            if not quiet:
                print(f"finished already, after {counted(progress.step, 'step')}: {checkpoint / PRETRAINED_MODEL_DIR}")
            return checkpoint / PRETRAINED_MODEL_DIR
    start: TrainedStart | None = None
    settings = chosen_recipe(options) if checkpoint is None else stored_recipe(checkpoint)
    if options.start_from and checkpoint is not None:
        start = of_training(checkpoint)
    elif options.start_from:
        start = read_start(options.start_from)
        settings = start.recipe(settings)
        if start.facts.tracker_vector and not options.tracker_vector:
            raise InputError(
                f"--no-tracker-vector: {start.checkpoint.folder}, which it begins with, is given its tracker"
            )
    out = options.out or default_folder(options)
    if options.resume is None:
        check_new(out)
    device = torch_device(options.device)
    processes = Processes(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
    most = torch.get_num_threads()
    threads = min(options.jobs or most, most)  # those of trainings that share a machine would wait for each other
    try:
        with _group(device, processes), fast_kernels(device), torch_threads(threads):
            return _train(options, settings, out, device, processes, progress, checkpoint, start)
    except torch.OutOfMemoryError as error:
        text = " ".join(str(error).split())[:160]
        raise ArenaError(
            f"{device}: its memory is full ({text}); try a smaller --batch-size, or fewer datasets"
        ) from None


def _train(
    options: PolicyTrainOptions,
    settings: TrainingRecipe,
    out: Path,
    device: torch.device,
    processes: Processes,
    progress: TrainingProgress | None,
    checkpoint: Path | None,
    start: TrainedStart | None,
) -> Path:
    speaks = processes.first and not options.quiet
    if options.compile:
        check_compiler(device)
    families.check_weights(settings, options.weights or None)
    datasets = [read_rows(root, settings.labels, options.cameras) for root in options.dataset]
    if options.episodes:
        datasets = [dataset.first(options.episodes) for dataset in datasets]
    if progress is not None:
        _check_same_data(datasets, progress)
    check_pictures(datasets, settings)
    began = time.monotonic()
    every = options.picture_every
    cameras = len(options.cameras)
    total = cameras * sum(-(-episode.length // every) for dataset in datasets for episode in dataset.episodes)
    with tqdm(total=total, unit="picture", desc="decoding", disable=None if speaks else True, leave=False) as bar:
        jobs = options.jobs or max(1, len(os.sched_getaffinity(0)) // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
        network = network_bytes(settings, device, cameras)
        store = load_frames(
            datasets,
            device,
            hold_out=options.hold_out,
            every=every,
            middle=settings.height if settings.cut_pad else 0,
            jobs=jobs,
            network=network,
            on_frames=bar.update,
        )
    if options.looks:
        changes = look_changes(options.look_changes)
        looks = load_looks(datasets, store, *look_fractions(options.looks), changes, jobs=jobs, network=network)
        store = dataclasses.replace(store, looks=looks)
    if processes.first:
        size = store.pictures.numel() / 1e9
        print(
            f"{counted(len(store.lengths), 'episode')} ({sum(store.held)} held out), {len(store.pictures)} pictures, "
            f"{size:.2f} GB on {device} in {time.monotonic() - began:.1f} s",
            flush=True,
        )
    trained = [e for d in datasets for e in d.episodes[: len(d.episodes) - options.hold_out]]
    stats = {
        key: {name: torch.from_numpy(np.array(value)) for name, value in of.items()}
        for key, of in statistics(datasets, trained, settings.labels).items()
    }
    if start is not None:
        stats |= start.stats
    if settings.cut_pad and camera_fit(store) != "pad":
        settings = dataclasses.replace(settings, cut_pad=False)
    vector = task_vector(store, settings)
    trackers = tracker_vector(store) if vector and options.tracker_vector else ()
    if start is not None:
        vector, trackers = start.vector(vector, trackers, {tracker for _, tracker in store.pairs if tracker})
    if vector:
        ones = torch.ones(len(vector_of(vector, trackers, "", "")))
        zeros = torch.zeros_like(ones)
        stats[VECTOR_KEY] = {"mean": zeros, "std": ones, "min": zeros, "max": ones, "q01": zeros, "q99": ones}
    torch.manual_seed(settings.seed)
    model = families.build(settings, stats, device, options.weights or None)
    if start is not None and checkpoint is None:
        start.check(model, camera_fit(store))
        start.put_into(model, vector, trackers)
        if speaks:
            print(f"begins with the weights of {start.checkpoint.folder} ({start.digest})", flush=True)
    batches = make_batches(model, store, vector, trackers)
    trainer = PolicyTrainer(
        model,
        batches,
        settings,
        weights=pair_weights(store, options),
        graph=options.graph,
        compiled=options.compile,
        rank=processes.rank,
        ranks=processes.count,
    )
    if options.steps:
        trainer.fix_steps(options.steps)
    elif progress is not None and progress.steps:
        trainer.fix_steps(progress.steps)
    if progress is not None and checkpoint is not None:
        restore(trainer, checkpoint)
    facts = CheckpointFacts(
        labels=settings.labels,
        realign=settings.realign,
        fit=camera_fit(store),
        task_vector=vector,
        tracker_vector=trackers,
        family=settings.family,
        recipe=settings.name,
        tasks=tuple(task for task in store.tasks if task),
        trackers=tuple(sorted({tracker for dataset in datasets for tracker in dataset.trackers})),
        seed=settings.seed,
        started_from="" if start is None else start.digest,
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        processes=processes.count,
        datasets=tuple(dataset.described for dataset in datasets),
        options={"flags": plain_options(options), "recipe": plain(dataclasses.asdict(settings))},
    )
    run = TrainingLoop(options, out, trainer, facts, processes, progress)
    return run.work() / PRETRAINED_MODEL_DIR


def chosen_recipe(options: PolicyTrainOptions) -> TrainingRecipe:
    """The recipe with what the flags change.

    Raises:
        InputError: The family has no such recipe.
    """
    named = recipe(options.policy, options.recipe)
    if options.weights:
        named = with_pretrained(named)
    changes: dict[str, object] = {"lr_backbone": named.lr_backbone}
    changes |= recipe_values(options.recipe_values)
    if options.labels:
        changes["labels"] = options.labels
        # Integrated yaw rates drift; a recipe of v3.1 says nothing of it.
        changes["realign"] = (named.realign or REALIGN) if options.labels == "v4" else 0.0
    if options.task_vector:
        changes["use_task_vector"] = True
    if options.batch_size:
        changes["batch_size"] = options.batch_size
    if options.lr:
        changes |= {"lr": options.lr, "lr_backbone": options.lr * named.lr_backbone / named.lr}
    if options.seed is not None:
        changes["seed"] = options.seed
    return recipe(options.policy, options.recipe, **changes)


def make_batches(
    model: TrainableModel, store: FrameStore, vector: tuple[str, ...] = (), trackers: tuple[str, ...] = ()
) -> BatchMaker:
    """Batches of a store as a model takes them, with a vector of tasks and trackers; prompts become tokens once."""
    tokens: dict[str, torch.Tensor] = {}
    per_row = model.reads_task and model.recipe.family == "pi05"  # its prompt holds the state
    if per_row:
        parts = []
        for start in range(0, store.rows, TOKEN_ROWS):
            rows = slice(start, start + TOKEN_ROWS)
            words = [store.instructions[number] for number in store.instruction[rows].tolist()]
            parts.append(model.tokens(words, model.normalise("observation.state", store.states[rows])))
        tokens = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
    elif model.reads_task:
        tokens = model.tokens(store.instructions)
    placed = {key: value.to(store.device) for key, value in tokens.items()}
    tall = model.recipe.height
    return BatchMaker(store, model.normalise, model.samples, vector, trackers, tall, placed, per_row)


def task_vector(store: FrameStore, settings: TrainingRecipe) -> tuple[str, ...]:
    """Tasks of the one-hot vector; none where the recipe has none.

    Raises:
        InputError: The datasets do not say what an episode's task is.
    """
    if not settings.use_task_vector:
        return ()
    if "" in store.tasks:
        raise InputError("--task-vector: an episode's dataset does not say which task it is of")
    return store.tasks


def tracker_vector(store: FrameStore) -> tuple[str, ...]:
    """Trackers that the vector names; none where all episodes have the same."""
    trackers = sorted({tracker for _, tracker in store.pairs})
    return tuple(filter(None, trackers)) if len(trackers) > 1 else ()


def pair_weights(store: FrameStore, options: PolicyTrainOptions) -> list[float] | None:
    """Weight of each pair of task and tracker in the draw of the samples; None where every picture counts alike.

    Raises:
        InputError: A task that is weighed is none of the datasets', or these do not say what an episode's task is.
    """
    if options.balance != "task":
        return None
    if "" in store.tasks:
        raise InputError("--balance task: an episode's dataset does not say which task it is of")
    weights = task_weights(options.task_weights)
    for task in weights:
        if task not in store.tasks:
            raise InputError(f"--task-weights {task}: the datasets have {', '.join(store.tasks)}")
    return [weights.get(task, 1.0) for task, _ in store.pairs]


def camera_fit(store: FrameStore) -> Literal["pad", "native"]:
    """`pad` where the black rows are those around a 4:3 picture, else `native` (`CameraConfig.fit`)."""
    return "pad" if is_pad(store.height, store.width * 3 // 4, store.top, store.bottom) else "native"


def check_pictures(datasets: list[DatasetRows], settings: TrainingRecipe) -> None:
    """Refuse pictures of another size than the recipe's network sees.

    Raises:
        InputError: They have another size.
    """
    for dataset in datasets:
        if (dataset.width, dataset.height) != (settings.picture, settings.picture):
            raise InputError(
                f"--dataset {dataset.root}: pictures of {dataset.width}x{dataset.height} pixels, recipe "
                f"{settings.family}/{settings.name} takes {settings.picture}x{settings.picture}: record with "
                f"--size {settings.picture}x{settings.picture}"
            )


def default_folder(options: PolicyTrainOptions) -> Path:
    """Folder of a training that names none."""
    names = options.dataset[0].resolve().name if len(options.dataset) == 1 else f"{len(options.dataset)}_datasets"
    return Path("runs") / f"{options.policy}_{options.recipe}_{names}"


def _check_same_data(datasets: list[DatasetRows], progress: TrainingProgress) -> None:
    now = [dataset.hash for dataset in datasets]
    before = [one.get("hash") for one in progress.datasets]
    if now != before:
        names = ", ".join(str(one.get("name")) for one in progress.datasets)
        raise InputError(f"--dataset: the content is not that of the datasets which the training began with ({names})")


@contextlib.contextmanager
def fast_kernels(device: torch.device) -> Iterator[None]:
    """Settings of LeRobot's trainer: TF32, and convolutions that are chosen by trying; what was set before returns."""
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    before = matmul.allow_tf32, cudnn.allow_tf32, cudnn.benchmark
    matmul.allow_tf32 = cudnn.allow_tf32 = cudnn.benchmark = True
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            yield
    finally:
        matmul.allow_tf32, cudnn.allow_tf32, cudnn.benchmark = before
        if device.type == "cuda":
            torch.cuda.empty_cache()


@contextlib.contextmanager
def _group(device: torch.device, processes: Processes) -> Iterator[None]:
    """The processes of `torchrun`, connected."""
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if processes.count == 1:
        yield
        return
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield
    finally:
        torch.distributed.destroy_process_group()
