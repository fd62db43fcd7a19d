"""Options of a training and rsl-rl's configuration made of them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

__all__ = ["FAMILY_WEIGHTS", "TrainOptions", "runner_config"]

FAMILY_WEIGHTS: dict[str, float] = {"clips": 40.0}
"""Weights of families in the sampling, per second of motion: a few minutes of captured motion stand beside hours that
were generated."""


@dataclass(frozen=True)
class TrainOptions:
    """Train a tracker with PPO in the lab world."""

    tracker: Literal["twist2", "sonic"] = "twist2"
    """Interface to train."""
    worlds: int = 8192
    """Parallel worlds of each process."""
    device: str = "auto"
    """cpu, cuda or cuda:N; with torchrun each process takes its own GPU."""
    minutes: float = 0.0
    """Most minutes to train, 0 = no limit."""
    iterations: int = 100000
    """Most iterations of this call."""
    seed: int = 0
    """Seed; every process of torchrun adds its rank."""
    resume: Path | None = None
    """Checkpoint of a training to go on with."""
    start_from: Path | None = None
    """Weights file (.safetensors) whose network a new training begins with."""
    library: Path | None = None
    """Motion library (NPZ); without it, references are generated."""
    families: dict[str, int] = field(default_factory=dict)
    """Generated clips of each family, e.g. `--families walk 900 squat 200`; the generator's mix by default."""
    clips: tuple[Path, ...] = ()
    """More motion files of any format that `motions convert` reads."""
    clips_licence: str = "unknown"
    """Licence of those files, for the card."""
    clips_source: str = "unknown"
    """Origin of those files, for the card."""
    mirror: bool = True
    """Add the mirror image of every clip."""
    family_weights: dict[str, float] = field(default_factory=dict)
    """Weights of families in the sampling, per second of motion; 40 for clips and 1 for the others where not named."""
    log_dir: Path = Path("runs/tracker")
    """Folder for checkpoints, progress.jsonl and TensorBoard."""
    logger: Literal["tensorboard", "wandb"] = "tensorboard"
    """Where curves go."""
    action_form: Literal["auto", "residual", "default"] = "auto"
    """Raw actions correct the reference (residual, auto) or a default pose."""
    rewards: dict[str, float] = field(default_factory=dict)
    """Other weights for reward terms, by name."""
    randomise: bool = True
    """Randomisation, noise and pushes."""
    adaptive: float = 0.25
    """Share of the episodes that start where the tracker fails."""
    episode_s: float = 10.0
    """Longest episode [s]."""
    steps: int = 16
    """Ticks of an iteration."""
    epochs: int = 5
    """Passes over an iteration's samples."""
    minibatches: int = 4
    """Minibatches of a pass."""
    learning_rate: float = 3e-4
    """Learning rate at the start."""
    desired_kl: float = 0.02
    """Divergence of an iteration that the learning rate aims at."""
    entropy: float = 0.0015
    """Weight of the entropy."""
    settle: float = 0.0
    """Share of `--minutes` at whose end the aimed divergence and the entropy's weight fall to a tenth."""
    init_std: float = 0.5
    """Standard deviation of the action noise at the start."""
    mirror_loss: float = 0.0
    """Weight of the difference between the action of a mirrored observation and the mirrored action."""
    save_interval: int = 200
    """Iterations between checkpoints."""
    keep_last: int = 3
    """Latest checkpoints that stay, 0 = all."""
    keep_every: int = 10
    """Of the older ones, every so many-th stays, 0 = none."""
    print_interval: int = 20
    """Iterations between lines on the screen."""
    log_interval: int = 5
    """Iterations between points of the curves."""
    contacts_per_world: int = 48
    """Contact buffer."""
    constraints_per_world: int = 160
    """Constraint buffer."""
    graph: bool = True
    """Capture the physics of a tick on CUDA."""
    tick_graph: bool = True
    """Capture what a tick does around the physics on CUDA."""
    update_graph: bool = True
    """Capture PPO's work on a minibatch on CUDA."""
    bench: bool = False
    """Only measure: train for `--minutes` (one by default), write nothing, print samples/s."""
    commit: str = ""
    """Commit for the card, where git is not at hand."""


def runner_config(options: TrainOptions, network: dict[str, Any], card: dict[str, Any]) -> dict[str, Any]:
    """rsl-rl's configuration.

    Args:
        options: The user's options.
        network: Widths of the tracker's network.
        card: What the weights' card will say about this training.
    """
    hidden = [512, 512, 256]
    logger: Any = options.logger
    if options.logger == "wandb":
        logger = {"class_name": "WandbLogWriter", "project_name": "arena-newton-trackers"}
    return {
        "seed": options.seed,
        "num_steps_per_env": options.steps,
        "save_interval": options.save_interval,
        "keep_last": options.keep_last,
        "keep_every": options.keep_every,
        "print_interval": options.print_interval,
        "log_interval": options.log_interval,
        "logger": logger,
        "card": card,
        "options": {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(options).items()},
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": {
            "class_name": "arena_newton.trackers.train.model:TrackerActor",
            "interface": options.tracker,
            "network": network,
            "init_std": options.init_std,
        },
        "settle": options.settle,
        "fit_steps": 300,
        "critic_iterations": 20,
        "critic": {
            "class_name": "arena_newton.trackers.train.model:TrackerCritic",
            "hidden_dims": hidden,
            "activation": "elu",
            "obs_normalization": True,
        },
        "algorithm": {
            "class_name": "arena_newton.trackers.train.ppo:IterationPPO",
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
            # Returns are about 16; clipping value steps to 0.2 would slow the critic down by that much.
            "use_clipped_value_loss": False,
        },
    }
