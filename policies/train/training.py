"""One training of a policy, from datasets to a checkpoint: `train`."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from tqdm import tqdm

from arena_newton.errors import ArenaError, InputError
from arena_newton.files import replace_atomically
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import TrainingRecipe, recipe
from arena_newton.policies.train import families
from arena_newton.policies.train.batching import BatchMaker
from arena_newton.policies.train.demonstration_rows import VECTOR_KEY, DatasetRows, read_rows, statistics
from arena_newton.policies.train.frame_store import FrameStore, load_frames
from arena_newton.policies.train.model import Model
from arena_newton.policies.train.policy_options import PolicyTrainOptions, check_numbers
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from arena_newton.policies.train.training_log import TrainingLog
from arena_newton.policies.train.training_state import (
    TrainingProgress,
    last_checkpoint,
    remove_older,
    restore,
    write_checkpoint,
)
from arena_newton.text import counted

__all__ = ["chosen_device", "chosen_recipe", "fast_kernels", "make_batches", "train"]

MEASURED_STEPS = 100
"""Steps whose time decides how many fit into --minutes."""
SKIPPED_STEPS = 10
"""First steps, which are not measured: a graph is captured, memory is taken."""
MEASURED_FRACTION = 0.1
"""Most of --minutes that the measurement takes, where steps are slow."""
TIME_KEPT = 0.98
"""Of the time that is left, what steps are planned for; the rest is for checkpoints and held-out losses."""
STOP_STEPS = 20
"""With several processes: steps between exchanges of whether one was asked to stop."""
TOKEN_ROWS = 4096
"""Rows whose prompts are made at once."""
FREE_ON_RESUME = frozenset(
    ("resume", "out", "dataset", "steps", "minutes", "device", "save_every", "keep", "hold_out_every", "log_every")
    + ("graph", "jobs", "quiet")
)
"""Flags that may differ when a training goes on; datasets must have the content that they had."""


@dataclass(frozen=True)
class Processes:
    """This process among those of `torchrun`."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether it writes files and speaks."""
        return self.rank == 0


def train(options: PolicyTrainOptions) -> Path:
    """Train to the end of the steps or of the time.

    Args:
        options: Flags. With `resume` those of the interrupted training hold; of the flags that may differ, those that are
            not at their default are taken.

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
        options = resumed(options, progress, checkpoint)
        check_numbers(options)
    settings = chosen_recipe(options)
    out = options.out or default_folder(options)
    if options.resume is None and any(one.name.isdigit() for one in out.glob("checkpoints/*")):
        raise InputError(f"--out {out}: holds a training already; --resume {out} goes on with it")
    device, processes = chosen_device(options.device)
    with _group(device, processes), fast_kernels(device):
        return _train(options, settings, out, device, processes, progress, checkpoint)


def _train(
    options: PolicyTrainOptions,
    settings: TrainingRecipe,
    out: Path,
    device: torch.device,
    processes: Processes,
    progress: TrainingProgress | None,
    checkpoint: Path | None,
) -> Path:
    speaks = processes.first and not options.quiet
    datasets = [read_rows(root, settings.labels) for root in options.dataset]
    if progress is not None:
        _check_same_data(datasets, progress)
    check_pictures(datasets, settings)
    began = time.monotonic()
    total = sum(dataset.frames for dataset in datasets)
    with tqdm(total=total, unit="picture", desc="decoding", disable=None if speaks else True, leave=False) as bar:
        jobs = options.jobs or max(1, len(os.sched_getaffinity(0)) // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))
        store = load_frames(datasets, device, hold_out=options.hold_out, jobs=jobs, on_frames=bar.update)
    if speaks:
        size = store.pictures.numel() / 1e9
        print(
            f"{counted(len(store.lengths), 'episode')} ({sum(store.held)} held out), {store.rows} pictures, {size:.2f} GB "
            f"on {device} in {time.monotonic() - began:.1f} s",
            flush=True,
        )
    trained = [e for d in datasets for e in d.episodes[: len(d.episodes) - options.hold_out]]
    stats = {
        key: {name: torch.from_numpy(np.array(value)) for name, value in of.items()}
        for key, of in statistics(datasets, trained, settings.labels).items()
    }
    vector = task_vector(store, settings)
    if vector:
        ones, zeros = torch.ones(len(vector)), torch.zeros(len(vector))
        stats[VECTOR_KEY] = {"mean": zeros, "std": ones, "min": zeros, "max": ones, "q01": zeros, "q99": ones}
    torch.manual_seed(settings.seed)
    model = families.build(settings, stats, device, options.weights or None)
    batches = make_batches(model, store, vector)
    trainer = PolicyTrainer(
        model, batches, settings, graph=options.graph, rank=processes.rank, ranks=processes.count
    )
    if options.steps:
        trainer.fix_steps(options.steps)
    elif progress is not None and progress.steps:
        trainer.fix_steps(progress.steps)
    if progress is not None and checkpoint is not None:
        restore(trainer, checkpoint)
    fit = "pad" if store.top or store.bottom else "native"
    facts = CheckpointFacts(
        labels=settings.labels,
        realign=settings.realign,
        width=store.width,
        height=store.height,
        fit=fit,
        task_vector=vector,
        family=settings.family,
        recipe=settings.name,
        tasks=tuple(task for task in store.tasks if task),
        trackers=tuple(sorted({tracker for dataset in datasets for tracker in dataset.trackers})),
        seed=settings.seed,
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        datasets=tuple(dataset.described for dataset in datasets),
        options={"flags": plain_options(options), "recipe": _plain(dataclasses.asdict(settings))},
    )
    run = _Run(options, out, trainer, facts, processes, progress)
    return run.work() / PRETRAINED_MODEL_DIR


class _Run:
    """The loop of a training: steps, log, checkpoints, the end of the time."""

    def __init__(
        self,
        options: PolicyTrainOptions,
        out: Path,
        trainer: PolicyTrainer,
        facts: CheckpointFacts,
        processes: Processes,
        progress: TrainingProgress | None,
    ):
        self._options, self._out, self._trainer = options, out, trainer
        self._facts, self._processes = facts, processes
        self._before = progress.minutes if progress is not None else 0.0
        self._total = trainer.recipe.steps
        if options.minutes and not options.steps and not (progress is not None and progress.steps):
            self._total = 0  # until the speed is measured
        self._started = 0.0
        self._stopped = False
        self._measured_from: tuple[int, float] | None = None
        self._last: Path | None = None

    @property
    def minutes(self) -> float:
        """Time of the optimization so far [min]."""
        return self._before + (time.monotonic() - self._started) / 60.0

    def work(self) -> Path:
        """Take all steps; returns the folder of the last checkpoint."""
        options, trainer, first = self._options, self._trainer, self._processes.first
        if first:
            try:
                self._out.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"--out {self._out}: cannot be made ({error.strerror})") from None
            remove_older(self._out, 0)
        log = TrainingLog(self._out, step=trainer.step, quiet=options.quiet) if first else None
        begin = trainer.step
        self._started = time.monotonic()
        try:
            with _stopping(self._stop):
                row_at = (trainer.step, self._started)
                while not self._total or trainer.step < self._total:
                    trainer.advance()
                    self._fit_to_time(begin)
                    done = bool(self._total) and trainer.step >= self._total
                    if log is not None:
                        log.advance(trainer.step, self._total)
                    held = trainer.step % options.hold_out_every == 0 or done
                    if trainer.step % options.log_every == 0 or done or (held and len(trainer.held)):
                        row_at = self._log(log, row_at, held)
                    if self._asked_to_stop():
                        break
                    if not done and options.save_every and trainer.step % options.save_every == 0:
                        self._save()
                last = self._save()
        finally:
            if log is not None:
                log.close()
        if self._stopped:
            if first:
                print(
                    f"stopped after {counted(trainer.step, 'step')}; go on with: python -m arena_newton.policies.train "
                    f"--resume {self._out}",
                    flush=True,
                )
            raise KeyboardInterrupt
        if first and not options.quiet:
            print(f"{counted(trainer.step, 'step')} in {self.minutes:.1f} min; wrote {last / PRETRAINED_MODEL_DIR}")
        return last

    def _stop(self) -> None:
        self._stopped = True

    def _asked_to_stop(self) -> bool:
        """Whether a signal came, to any of the processes."""
        if self._processes.count == 1:
            return self._stopped
        if self._trainer.step % STOP_STEPS:
            return False
        flag = torch.tensor(float(self._stopped), device=self._trainer.device)
        torch.distributed.all_reduce(flag)
        self._stopped = bool(flag)
        return self._stopped

    def _fit_to_time(self, begin: int) -> None:
        """Fix the number of steps once their speed is known."""
        if self._total:
            return
        trainer, budget = self._trainer, self._options.minutes
        taken = trainer.step - begin
        if self._measured_from is None:
            if taken >= SKIPPED_STEPS or self.minutes - self._before > MEASURED_FRACTION / 2 * budget:
                _wait(trainer.device)
                self._measured_from = trainer.step, time.monotonic()
            return
        since, at = self._measured_from
        count = trainer.step - since
        if count < MEASURED_STEPS and self.minutes - self._before < MEASURED_FRACTION * budget:
            return
        _wait(trainer.device)
        per_step = (time.monotonic() - at) / count
        left = max(0.0, budget - self.minutes) * 60.0 * TIME_KEPT
        steps = trainer.step + int(left / max(per_step, 1e-9))
        if self._processes.count > 1:
            agreed = torch.tensor(float(steps), dtype=torch.float64, device=trainer.device)
            torch.distributed.broadcast(agreed, 0)
            steps = int(agreed)
        self._total = max(steps, trainer.step)
        trainer.fix_steps(self._total)

    def _log(self, log: TrainingLog | None, row_at: tuple[int, float], held: bool) -> tuple[int, float]:
        """Write a row; returns step and time from which the next one's speed counts."""
        trainer = self._trainer
        loss = float(trainer.loss)  # waits for the device
        now = time.monotonic()
        if not math.isfinite(loss):
            raise ArenaError(
                f"the loss is {loss} at step {trainer.step}; the last checkpoint is {self._last or 'none'}: a smaller --lr, "
                "or another --recipe"
            )
        if log is None:
            return trainer.step, now
        row = {
            "step": float(trainer.step),
            "minutes": self.minutes,
            "loss": loss,
            "learning_rate": trainer.recipe.lr * trainer.recipe.lr_factor(max(0, trainer.step - 1)),
            "gradient_norm": float(trainer.gradient_norm),
            "steps_per_s": (trainer.step - row_at[0]) / max(now - row_at[1], 1e-9),
        }
        if held and len(trainer.held):
            row["held_out_loss"] = trainer.held_out_loss()
        log.record(row)
        return trainer.step, time.monotonic()

    def _save(self) -> Path:
        """Write a checkpoint of this step; only the first process does."""
        trainer, options = self._trainer, self._options
        progress = TrainingProgress(
            step=trainer.step,
            steps=self._total,
            minutes=self.minutes,
            processes=self._processes.count,
            batch_size=trainer.recipe.batch_size,
            options=plain_options(options),
            datasets=self._facts.datasets,
        )
        facts = dataclasses.replace(self._facts, steps=trainer.step, minutes=round(self.minutes, 3))
        if self._processes.first:
            self._last = write_checkpoint(self._out, trainer, facts, progress)
            remove_older(self._out, options.keep)
        return self._last or self._out / "checkpoints" / f"{trainer.step:06d}"


def chosen_recipe(options: PolicyTrainOptions) -> TrainingRecipe:
    """The recipe with what the flags change.

    Raises:
        InputError: The family has no such recipe.
    """
    changes: dict[str, object] = {}
    if options.labels:
        changes["labels"] = options.labels
        if options.labels != "v4":
            changes["realign"] = 0.0
    if options.task_vector:
        changes["use_task_vector"] = True
    if options.batch_size:
        changes["batch_size"] = options.batch_size
    if options.lr:
        changes |= {"lr": options.lr, "lr_backbone": options.lr}
    if options.seed is not None:
        changes["seed"] = options.seed
    return recipe(options.policy, options.recipe, **changes)


def make_batches(model: Model, store: FrameStore, vector: tuple[str, ...] = ()) -> BatchMaker:
    """Batches of a store as a model takes them; prompts are turned into tokens once."""
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
    return BatchMaker(store, model.normalise, model.samples, vector, placed, per_row)


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


def check_pictures(datasets: list[DatasetRows], settings: TrainingRecipe) -> None:
    """Refuse pictures of another size than the recipe's network sees.

    Raises:
        InputError: They have another size.
    """
    for dataset in datasets:
        if (dataset.width, dataset.height) != (settings.picture, settings.picture):
            raise InputError(
                f"--dataset {dataset.root}: pictures of {dataset.width}x{dataset.height} pixels, recipe "
                f"{settings.family}/{settings.name} takes {settings.picture}x{settings.picture}"
            )


def chosen_device(name: str) -> tuple[torch.device, Processes]:
    """Device of this process, and its number among those of `torchrun`.

    Raises:
        InputError: There is no such device.
    """
    processes = Processes(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))
    cuda = torch.cuda.is_available()
    wanted = ("cuda" if cuda else "cpu") if name == "auto" else name
    if wanted == "cpu":
        return torch.device("cpu"), processes
    number = wanted.removeprefix("cuda").removeprefix(":")
    if not wanted.startswith("cuda") or (number and not number.isdigit()):
        raise InputError(f"--device {name}: unknown, choose cpu, cuda, cuda:N or auto")
    index = int(os.environ.get("LOCAL_RANK", "0")) if processes.count > 1 else int(number or 0)
    if not cuda or index >= torch.cuda.device_count():
        raise InputError(f"--device {name}: no such device, this machine has {torch.cuda.device_count()} for CUDA")
    return torch.device("cuda", index), processes


def default_folder(options: PolicyTrainOptions) -> Path:
    """Folder of a training that names none."""
    names = options.dataset[0].resolve().name if len(options.dataset) == 1 else f"{len(options.dataset)}_datasets"
    return Path("runs") / f"{options.policy}_{options.recipe}_{names}"


def resumed(options: PolicyTrainOptions, progress: TrainingProgress, checkpoint: Path) -> PolicyTrainOptions:
    """Flags of a training that goes on.

    Raises:
        InputError: A flag contradicts the training, or its stored flags are damaged.
    """
    stored = read_options(progress.options, checkpoint)
    empty = PolicyTrainOptions()
    changes: dict[str, object] = {"resume": options.resume, "out": options.resume}
    for one in dataclasses.fields(PolicyTrainOptions):
        given = getattr(options, one.name)
        if one.name in changes or given == getattr(empty, one.name):
            continue
        if one.name not in FREE_ON_RESUME and given != getattr(stored, one.name):
            flag = "--" + one.name.replace("_", "-")
            raise InputError(f"{flag} {given}: the training in {options.resume} has {getattr(stored, one.name)}")
        changes[one.name] = given
    return dataclasses.replace(stored, **changes)  # type: ignore[arg-type]  # fields of the class


def plain_options(options: PolicyTrainOptions) -> dict[str, object]:
    """Flags as JSON; datasets by their whole path."""
    found = _plain(dataclasses.asdict(options))
    assert isinstance(found, dict)
    return found | {"dataset": [str(folder.resolve()) for folder in options.dataset]}


def read_options(content: Mapping[str, object], checkpoint: Path) -> PolicyTrainOptions:
    """Flags that a checkpoint stores.

    Raises:
        InputError: They are damaged.
    """
    values: dict[str, object] = {}
    for one in dataclasses.fields(PolicyTrainOptions):
        if one.name not in content:
            continue
        value, default = content[one.name], one.default
        if one.name == "dataset" and isinstance(value, list) and all(isinstance(name, str) for name in value):
            values[one.name] = tuple(Path(name) for name in value)
        elif one.name in ("out", "resume"):
            continue
        elif type(value) is type(default) or (isinstance(default, float) and type(value) is int):
            values[one.name] = value
        elif one.name == "seed" and (value is None or type(value) is int):
            values[one.name] = value
        else:
            raise InputError(f"{checkpoint}: options: {one.name} is {str(value)[:60]!r}, which it cannot be")
    return PolicyTrainOptions(**values)  # type: ignore[arg-type]  # each is of its default's kind


def _plain(value: object) -> object:
    """A value as JSON."""
    if isinstance(value, Mapping):
        return {str(name): _plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def _check_same_data(datasets: list[DatasetRows], progress: TrainingProgress) -> None:
    now = [dataset.hash for dataset in datasets]
    before = [one.get("hash") for one in progress.datasets]
    if now != before:
        names = ", ".join(str(one.get("name")) for one in progress.datasets)
        raise InputError(f"--dataset: the content is not that of the datasets which the training began with ({names})")


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextlib.contextmanager
def fast_kernels(device: torch.device) -> Iterator[None]:
    """Settings of LeRobot's trainer: TF32, and convolutions that are chosen by trying; what was set before comes back."""
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


@contextlib.contextmanager
def _stopping(stop: object) -> Iterator[None]:
    """Ctrl-C and SIGTERM ask for the end after the current step; a second one comes through at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    assert callable(stop)
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def asked(number: int, frame: object) -> None:
        stop()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    for number in before:
        signal.signal(number, asked)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
