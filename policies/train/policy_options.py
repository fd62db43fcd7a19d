"""Flags of the training of policies, and the bounds of their numbers; nothing heavy is loaded here."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from arena_newton.cli.flags import Device, Engine, Several, bounds, check_bounds
from arena_newton.errors import InputError, check_once
from arena_newton.files.stored_json import check_types
from arena_newton.pictures.settings import CAMERAS, FRONT
from arena_newton.policies.chunk_flags import LABELS
from arena_newton.policies.recipes.training_recipe import FAMILIES, RECIPES, TrainingRecipe

__all__ = [
    "LEARNED",
    "PolicyTrainOptions",
    "TeachableOptions",
    "check_choices",
    "check_numbers",
    "check_teachable",
    "look_changes",
    "look_fractions",
    "recipe_values",
    "task_weights",
]

UNCOMPILED = ("pi05",)
"""Families that --compile refuses."""
ROBOT_CAMERAS = tuple(name for name in CAMERAS if name != "world")
"""Cameras that policies are trained on: those that the robot carries."""
BALANCES = ("picture", "task")
"""Draws of the samples."""
FLAGGED = {
    **{name: f"--{name.replace('_', '-')}" for name in ("steps", "batch_size", "lr", "seed", "labels")},
    **{"family": "--policy", "name": "--recipe", "use_task_vector": "--task-vector", "lr_backbone": "--lr"},
    "network": "network.<field>=",
}
"""Fields of a recipe that a flag of their own says, and that flag."""

LEARNED = "learned"
"""Name of the policy that ships, of `--start-from`."""


@dataclass(frozen=True)
class PolicyTrainOptions:
    """Train a policy on datasets of demonstrations; with torchrun each process takes a GPU of its own."""

    policy: str = "act"
    """Family: act, diffusion, flow or pi05."""
    dataset: Several[Path] = ()
    """Folders of LeRobot v3.0 datasets; several are trained on together."""
    recipe: str = "fast"
    """Settings: paper (the paper's table), released (the original's own files), fast (better per GPU minute), compact
    (ACT in 32 MB), small (for tests, with pictures of `eval record --size 64x64`)."""
    out: Path | None = None
    """Folder of the training; runs/<policy>_<recipe>_<dataset> by default."""
    steps: int = field(default=0, metadata=bounds(0, 10_000_000))
    """Optimizer steps; 0: the recipe's, or what --minutes gives. Not together with --minutes."""
    minutes: float = field(default=0.0, metadata=bounds(0.0, 100_000.0))
    """Time of the optimization [min], from its first step: the speed is measured, then the number of steps is fixed so
    that the schedule ends when the time is up; 0: no limit."""
    resume: Path | None = None
    """Folder of a training to go on with, with its own options; only --device, --steps, --minutes (in all),
    --save-every and the like may differ."""
    cameras: Several[str] = (FRONT,)
    """Cameras that the policy looks through: front left_wrist right_wrist, of those that the datasets have."""
    labels: str = ""
    """Protocol of the network's actions, v3.1 or v4; the recipe's by default. A dataset of the other one is converted
    in memory."""
    balance: str = "picture"
    """Draw of the samples: picture (every picture equally often), task (first a task and tracker, then a picture)."""
    task_weights: Several[str] = ()
    """Weights of tasks in the draw of --balance task, as boxing=1.5 double_desk=2; 1 of those that are not named."""
    picture_every: int = field(default=1, metadata=bounds(1, 1000))
    """Ticks from one picture of an episode that is loaded, and that a sample begins at, to the next."""
    looks: Several[str] = ()
    """Fraction of the samples whose looks are changed, and that of single tasks, as 0.6 double_desk=0.3; of datasets
    that were recorded with `eval record --looks`."""
    look_changes: Several[str] = ()
    """Probabilities of the kinds of change in such a sample, as light=0 things=0; the usual ones of those that are not
    named: colours patterns light things rectangles exposure key_objects goals flat figures tones."""
    recipe_values: Several[str] = ()
    """Values of the recipe that no other flag has, as frozen_norms=0.3 shift_px=0 network.dim_model=384."""
    task_vector: bool = False
    """Give the policy a one-hot vector of its tasks; recipes that need one have it without this flag."""
    tracker_vector: bool = True
    """Name in that vector the tracker too, where the datasets were recorded through several."""
    batch_size: int = field(default=0, metadata=bounds(0, 65536))
    """Samples of a step, of each process; 0: the recipe's."""
    lr: float = field(default=0.0, metadata=bounds(0.0, 1.0))
    """Learning rate after the warm-up; 0: the recipe's."""
    seed: int | None = field(default=None, metadata=bounds(0, 2**31))
    """Seed of weights, order, augmentation and noise; the recipe's by default."""
    device: Device[str] = "auto"
    weights: str = ""
    """Pretrained weights by their name on the hub or a local folder, where the family takes some."""
    start_from: str = ""
    """Begin with the weights of a trained policy of the same network: folder of a training, checkpoint or packed
    policy, or `learned`, the one that ships (--recipe compact)."""
    save_every: int = field(default=5000, metadata=bounds(0))
    """Steps between checkpoints; 0: only the last one."""
    keep: int = field(default=2, metadata=bounds(0))
    """Number of latest checkpoints that are kept; 0: all."""
    episodes: int = field(default=0, metadata=bounds(0, 100_000_000))
    """Episodes of each dataset that are used, its first ones; 0: all."""
    hold_out: int = field(default=0, metadata=bounds(0, 100_000))
    """Episodes of each dataset, its last ones, that are not trained on; their loss is measured at intervals."""
    hold_out_every: int = field(default=1000, metadata=bounds(1))
    """Steps between measurements of the held-out loss."""
    log_every: int = field(default=50, metadata=bounds(1))
    """Steps between rows of the log."""
    graph: bool = True
    """Capture batch and step in one CUDA graph, on CUDA."""
    compile: bool = False
    """Compile the network with torch.compile, which takes a minute or so at the first step; not for pi05."""
    jobs: int = field(default=0, metadata=bounds(0, 1024))
    """Cores that it takes: they decode pictures, four or more by a process each, fewer by threads, and torch has no
    more threads; 0: all that may be used."""
    quiet: bool = False
    """Show no progress bar."""


@dataclass(frozen=True)
class TeachableOptions:
    """Say in minutes, without pictures and without a GPU, whether a policy without memory can learn demonstrations.

    A small network that is given the true poses is trained on them and plays. What it cannot do no policy of these
    families will; what it can is still to be seen in pictures.
    """

    recording: Path = Path()
    """Folder of `eval record`."""
    task: str = ""
    """Task of the demonstrations and of the episodes."""
    tracker: str = "twist2"
    """Tracker through which they were recorded, and which executes what the network decides."""
    steps: int = field(default=3000, metadata=bounds(1, 10_000_000))
    """Optimizer steps."""
    batch_size: int = field(default=256, metadata=bounds(1, 65536))
    """Ticks of a step."""
    chunk: int = field(default=20, metadata=bounds(1, 1000))
    """Actions of an answer, which are executed whole."""
    seed: int = field(default=0, metadata=bounds(0, 2**31))
    """Seed of weights, order and noise."""
    episodes: int = field(default=30, metadata=bounds(1, 1000))
    """Episodes that are played, spread over the protocol's group seeds 0 1 2."""
    worlds: int = field(default=30, metadata=bounds(1, 4096))
    """Episodes that are simulated at once."""
    max_steps: int | None = field(default=None, metadata=bounds(1, 10_000_000))
    """Cap on the step budget of the task [ticks of 0.02 s]."""
    engine: Engine = "mujoco"
    device: Device[str] = "cpu"
    out: Path | None = None
    """Write the result to this JSON file."""


def check_teachable(options: TeachableOptions) -> None:
    """Refuse flags before anything is loaded.

    Raises:
        InputError: A flag's value is unfit.
    """
    check_bounds(options)
    if options.recording == Path() or not options.recording.is_dir():
        raise InputError(f"--recording {options.recording}: name a folder that eval record wrote")
    if not options.task:
        raise InputError("--task: name the task of the demonstrations")


def task_weights(given: Sequence[str]) -> dict[str, float]:
    """Weights of tasks as they are typed.

    Raises:
        InputError: One is no name and positive number.
    """
    expected = "a task and a positive number, as boxing=1.5"
    return _task_numbers("--task-weights", given, expected, lambda task, number: bool(task) and 0.0 < number < math.inf)


def look_fractions(given: Sequence[str]) -> tuple[float, dict[str, float]]:
    """Fraction of the samples whose looks are changed, and that of single tasks, as they are typed.

    Raises:
        InputError: One is no fraction.
    """
    expected = "a fraction from 0 to 1, of one task as double_desk=0.3"
    found = _task_numbers("--looks", given, expected, lambda _, number: 0.0 <= number <= 1.0)
    return found.pop("", 0.0), found


def look_changes(given: Sequence[str]) -> dict[str, float]:
    """Probabilities of kinds of change as they are typed; their names are checked where looks are made.

    Raises:
        InputError: One is no name and probability.
    """
    expected = "a kind of change and a probability from 0 to 1, as light=0"
    return _task_numbers("--look-changes", given, expected, lambda kind, number: bool(kind) and 0.0 <= number <= 1.0)


def recipe_values(given: Sequence[str]) -> dict[str, object]:
    """Fields of a recipe as they are typed: JSON, or text; those of the network under `network`.

    Raises:
        InputError: One is no field of a recipe and value of its type, is given twice, or has a flag of its own.
    """
    found: dict[str, object] = {}
    network: dict[str, object] = {}
    for text in given:
        name, equals, typed = text.partition("=")
        try:
            value = json.loads(typed)
        except ValueError:
            value = typed
        fields = network if name.startswith("network.") else found
        key = name.removeprefix("network.")
        if not (equals and key) or key in fields or value in ("", None):
            raise InputError(f"--recipe-values {text}: expected a field once and its value, as frozen_norms=0.3")
        if fields is found and key in FLAGGED:
            raise InputError(f"--recipe-values {text}: {FLAGGED[key]} says it")
        fields[key] = value
    typed_fields = found | ({"network": network} if network else {})
    return check_types("--recipe-values", typed_fields, TrainingRecipe)


def _task_numbers(
    flag: str, given: Sequence[str], expected: str, fits: Callable[[str, float], bool]
) -> dict[str, float]:
    """Numbers of tasks, typed as task=number; one without a task has none."""
    found: dict[str, float] = {}
    check_once(f"{flag} for", (text.rpartition("=")[0] or "all" for text in given))
    for text in given:
        task, _, number = text.rpartition("=")
        try:
            found[task] = float(number)
        except ValueError:
            found[task] = math.nan
        if not fits(task, found[task]):
            raise InputError(f"{flag} {text}: expected {expected}")
    return found


def check_choices(policy: str, recipe: str, datasets: Sequence[Path], *, compiled: bool) -> None:
    """Refuse a family, recipe or datasets that no training can use, before anything is loaded.

    Raises:
        InputError: One is unfit.
    """
    for flag, value, known in (("--policy", policy, FAMILIES), ("--recipe", recipe, RECIPES)):
        if value not in known:
            raise InputError(f"{flag} {value}: unknown, choose from {', '.join(known)}")
    if compiled and policy in UNCOMPILED:
        raise InputError(
            f"--compile: {policy} cannot be compiled: LeRobot makes its masks on the host in every forward pass"
        )
    for folder in datasets:
        if not folder.is_dir():
            raise InputError(f"--dataset {folder}: no such folder")
    resolved = [folder.resolve() for folder in datasets]
    for number, folder in enumerate(resolved):
        if folder in resolved[:number]:
            raise InputError(f"--dataset {datasets[number]}: is named twice")


def check_numbers(options: PolicyTrainOptions) -> None:
    """Refuse flags that no training can use, before anything is loaded.

    Raises:
        InputError: A flag's value is unfit.
    """
    check_bounds(options)
    check_choices(options.policy, options.recipe, options.dataset, compiled=options.compile)
    if options.steps and options.minutes:
        raise InputError("--steps: is given by --minutes too; drop one of them")
    if options.start_from and options.weights:
        raise InputError("--weights: are those of --start-from; drop one of them")
    start = options.start_from if options.resume is None else ""
    if start not in ("", LEARNED) and not Path(start).expanduser().is_dir():
        raise InputError(f"--start-from {start}: no such folder, and not {LEARNED}")
    if options.labels not in ("", *LABELS):
        raise InputError(f"--labels {options.labels}: unknown, choose from {', '.join(LABELS)}")
    look_fractions(options.looks)
    if look_changes(options.look_changes) and not options.looks:
        raise InputError("--look-changes: belongs to --looks, which is not given")
    recipe_values(options.recipe_values)
    named = {*options.cameras}
    if not named or len(named) < len(options.cameras) or named - {*ROBOT_CAMERAS}:
        expected = f"expected different ones of {' '.join(ROBOT_CAMERAS)}"
        raise InputError(f"--cameras {' '.join(options.cameras)}: {expected}")
    if options.looks and named != {FRONT}:
        raise InputError("--looks: changes the pictures of camera front alone, but --cameras names others")
    if options.balance not in BALANCES:
        raise InputError(f"--balance {options.balance}: unknown, choose from {', '.join(BALANCES)}")
    if task_weights(options.task_weights) and options.balance != "task":
        raise InputError("--task-weights: weigh the draw of --balance task, which is not given")
    if options.resume is None and not options.dataset:
        raise InputError("--dataset: name at least one folder of a dataset")
    if options.resume is not None and not options.resume.is_dir():
        raise InputError(f"--resume {options.resume}: no such folder")
