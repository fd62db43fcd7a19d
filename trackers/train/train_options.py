"""Options of the command line, the bounds of their numbers, and rsl_rl's configuration made of them.

This module loads nothing heavy: `--help` answers at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from arena_newton.cli.flags import Device, Several, bounds, check_bounds, check_number
from arena_newton.errors import InputError
from arena_newton.trackers.interface import names

__all__ = [
    "CPU_WORLDS",
    "FAMILY_WEIGHTS",
    "GPU_WORLDS",
    "CurveOptions",
    "ExportOptions",
    "TrainOptions",
    "check",
    "runner_config",
]

if TYPE_CHECKING:
    TrackerName = str
else:
    TrackerName = Literal[names()]

FAMILY_WEIGHTS: dict[str, float] = {"clips": 40.0}
"""Sampling weights of families per second of motion: there are minutes of captured motion, hours of generated one."""


GPU_WORLDS, CPU_WORLDS = 8192, 16
"""Worlds where none are named: what fills a GPU, and what a CPU trains an iteration of in seconds."""


@dataclass(frozen=True)
class TrainOptions:
    """Train a tracker with PPO in the lab world; with torchrun each process takes a GPU of its own."""

    tracker: TrackerName = "twist2"
    """Interface to train."""
    worlds: int = field(default=0, metadata=bounds(0))
    """Parallel worlds of each process, 0 = 8192 on a GPU, 16 on a CPU."""
    device: Device[str] = "auto"
    minutes: float = field(default=0.0, metadata=bounds(0))
    """Time limit [min], 0 = none."""
    iterations: int = field(default=100000, metadata=bounds(1))
    """Largest number of iterations of this call."""
    seed: int = field(default=0, metadata=bounds(0, 2**31))
    """Seed; each process of torchrun adds its rank."""
    resume: Path | None = None
    """Checkpoint of a training to continue."""
    start_from: Path | None = None
    """Weights file (.safetensors) with the initial network of a new training."""
    library: Path | None = None
    """Motion library (NPZ); without it, references are generated."""
    families: dict[str, int] = field(default_factory=dict, metadata=bounds(1))
    """Number of generated clips per family, e.g. `--families walk 900 squat 200`; the generator's mix by default."""
    clips: Several[Path] = ()
    """Further motion files of any format that `motions convert` reads."""
    clips_licence: str = "unknown"
    """Licence of those files, for the card."""
    clips_source: str = "unknown"
    """Origin of those files, for the card."""
    mirror: bool = True
    """Add the mirror image of every clip."""
    family_weights: dict[str, float] = field(default_factory=dict, metadata=bounds(0))
    """Sampling weights of families per second of motion; by default 40 for `clips`, 1 for the others."""
    log_dir: Path = Path("runs/tracker")
    """Folder for checkpoints, progress.jsonl and TensorBoard."""
    logger: Literal["tensorboard", "wandb"] = "tensorboard"
    """Service that shows the curves."""
    action_form: Literal["auto", "residual", "default"] = "auto"
    """Raw actions are offsets from the reference (residual, auto) or from a default pose."""
    rewards: dict[str, float] = field(default_factory=dict, metadata=bounds(-1e6, 1e6))
    """Weights of reward terms by name, where not those of the table, e.g. `--rewards heading 1.0`."""
    reward_scales: dict[str, float] = field(default_factory=dict, metadata=bounds(1e-6, 1e6))
    """Scales of tracking rewards exp(-error² / scale²) by name, e.g. `--reward-scales legs 0.1`."""
    randomise: bool = True
    """Domain randomisation, observation noise and pushes."""
    events: Several[tuple[str, str, float]] = ()
    """Settings of events of the randomisation, where not those of the table, e.g. `--events push planar 1.6`."""
    adaptive: float = field(default=0.25, metadata=bounds(0, 1))
    """Fraction of the episodes that start where the tracker fails."""
    episode_s: float = field(default=10.0, metadata=bounds(0.1, 3600))
    """Maximum length of an episode [s]."""
    steps: int = field(default=16, metadata=bounds(2))
    """Ticks per iteration."""
    epochs: int = field(default=5, metadata=bounds(1))
    """Passes over the samples of an iteration."""
    minibatches: int = 4
    """Minibatches per pass."""
    learning_rate: float = field(default=3e-4, metadata=bounds(1e-8, 1))
    """Initial learning rate."""
    desired_kl: float = field(default=0.02, metadata=bounds(1e-6, 10))
    """Target KL divergence per iteration (adaptive learning rate)."""
    entropy: float = field(default=0.0015, metadata=bounds(0))
    """Entropy coefficient."""
    # `--settle` in the commands of earlier cards.
    anneal: Annotated[float, tyro.conf.arg(aliases=("--settle",))] = field(default=0.0, metadata=bounds(0, 1))
    """Final fraction of `--minutes` over which target KL and entropy coefficient are annealed to 10 %."""
    init_std: float = field(default=0.5, metadata=bounds(1e-3, 10))
    """Initial standard deviation of the action noise."""
    mirror_loss: float = field(default=0.0, metadata=bounds(0))
    """Weight of the squared difference between the action of a mirrored observation and the mirrored action."""
    save_interval: int = field(default=200, metadata=bounds(1))
    """Iterations between checkpoints."""
    keep_last: int = field(default=3, metadata=bounds(0))
    """Number of latest checkpoints that are kept, 0 = all."""
    keep_every: int = field(default=10, metadata=bounds(0))
    """Interval of the older ones that are kept: every n-th, 0 = none."""
    print_interval: int = field(default=20, metadata=bounds(1))
    """Iterations between printed lines."""
    log_interval: int = field(default=5, metadata=bounds(1))
    """Iterations between points of the curves."""
    contacts_per_world: int = field(default=48, metadata=bounds(1))
    """Size of the contact buffer."""
    constraints_per_world: int = field(default=160, metadata=bounds(1))
    """Size of the constraint buffer."""
    graph: bool = True
    """Capture the physics of a tick in a graph, on the CPU too."""
    tick_graph: bool = True
    """Capture the rest of a tick in CUDA graphs."""
    update_graph: bool = True
    """Capture PPO's work on a minibatch in CUDA graphs."""
    bench: bool = False
    """Measure only: train for `--minutes` (one by default), write nothing, print samples/s."""
    verbose: bool = False
    """Print the tables of reward terms, of events and of the critic's observation first."""
    commit: str = ""
    """Commit for the card where git is not available."""


@dataclass(frozen=True)
class ExportOptions:
    """Write a tracker's weights file and its card."""

    out: Path = Path("tracker.safetensors")
    """The file; the card is written next to it as .json and .md."""
    metrics: Path | None = None
    """JSON file of an evaluation, for the card."""
    note: str = ""
    """A sentence for the card."""
    hardware: str = ""
    """Hardware of the training, for the card."""
    symmetric: bool = True
    """Average the action and the mirrored action of the mirrored observation (left-right symmetric policy): training
    leaves a preferred side, and a walk whose command has no heading turns that way."""


@dataclass(frozen=True)
class CurveOptions:
    """Draw the curves of trainings, their --log-dir or progress.jsonl, over each other."""

    out: Path = Path("curves.png")
    """Picture: .png, .svg or .pdf."""


def check(options: TrainOptions) -> None:
    """Refuse numbers that no training can use, before anything is made.

    Raises:
        InputError: A flag's number is out of range.
    """
    check_bounds(options)
    check_number("--minibatches", options.minibatches, 1, (options.worlds or CPU_WORLDS) * options.steps)
    if options.anneal > 0.0 and options.minutes <= 0.0:
        raise InputError(f"--anneal {options.anneal}: a fraction of --minutes, which is not given")
    if options.events and not options.randomise:
        raise InputError("--events: sets the randomisation that --no-randomise leaves out")
    if options.resume is not None and options.start_from is not None:
        raise InputError("--resume continues a training, --start-from begins one: pass one of the two")
    if options.library is not None and options.families:
        raise InputError("--families generates references, --library reads them: pass one of the two")
    for flag, file in (("--resume", options.resume), ("--start-from", options.start_from)):
        if file is not None and not file.is_file():
            raise InputError(f"{flag} {file}: {'is a folder, expected a file' if file.is_dir() else 'no such file'}")


def runner_config(options: TrainOptions, network: dict[str, Any]) -> dict[str, Any]:
    """rsl_rl's configuration, for a tracker's network of these widths."""
    wandb = {"class_name": "WandbLogWriter", "project_name": "arena-newton-trackers"}
    return {
        "logger": wandb if options.logger == "wandb" else options.logger,
        "num_steps_per_env": options.steps,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": {
            "class_name": "arena_newton.trackers.train.model:TrackerActor",
            "interface": options.tracker,
            "network": network,
            "init_std": options.init_std,
        },
        "critic": {
            "class_name": "arena_newton.trackers.train.model:TrackerCritic",
            "hidden_dims": [512, 512, 256],
            "activation": "elu",
            "obs_normalization": True,
        },
        "algorithm": {
            "class_name": "arena_newton.trackers.train.ppo:TrackerPPO",
            "num_learning_epochs": options.epochs,
            "num_mini_batches": options.minibatches,
            "learning_rate": options.learning_rate,
            "schedule": "adaptive",
            "desired_kl": options.desired_kl,
            "gamma": 0.99,
            "lam": 0.95,
            "clip_param": 0.2,
            "value_loss_coef": 1.0,
            "entropy_coef": options.entropy,
            "max_grad_norm": 1.0,
            "mirror_loss": options.mirror_loss,
            "graph": options.update_graph,
            # Returns are about 16: clipping value steps to 0.2 would make the critic slower by that factor.
            "use_clipped_value_loss": False,
        },
    }
