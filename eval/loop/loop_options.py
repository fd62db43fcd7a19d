"""Flags of `eval loop`."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Device, Engine, Several

__all__ = ["LoopOptions"]


@dataclass(frozen=True)
class LoopOptions:
    """Record demonstrations, build a dataset, train a policy, evaluate it, and report: the whole loop in one command.

    Each stage resumes: after an interruption the same command continues, and what is finished is not repeated.
    """

    task: Several[str] = ("vis_navi",)
    """Tasks, which one policy learns together."""
    tracker: str = "twist2"
    """Tracker that records and executes."""
    policy: str = "act"
    """Family: act, diffusion, flow or pi05."""
    recipe: str | None = None
    """Settings of the training: fast (when none is named), paper, released, compact."""
    minutes: float | None = None
    """Time of the training [min]; the schedule is fitted to it. The recipe's number of steps when none is given. With
    --plan that of all stages: trainings have what recording and the plan's reserve leave."""
    steps: int | None = None
    """Optimizer steps instead of the recipe's."""
    episodes: int | None = None
    """Successes to record of each task: 100, or 3 episodes under --small."""
    repeats: int | None = None
    """Episodes of the evaluation for each of the group seeds 0 1 2: 20, or 1 under --small."""
    seed: int = 0
    """Seed of the training, and series of the recorded seeds."""
    worlds: int | None = None
    """Episodes simulated at once: 100 on CUDA and 20 on the CPU when none is given."""
    engine: Engine = "auto"
    device: Device[str | None] = None
    size: str | None = None
    """Size of the recorded pictures, which is what the policy sees: 224x224, or 64x64 under --small [px]."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""
    weights: str | None = None
    """Pretrained weights for the training: a name on the hub or a local folder."""
    plan: str | None = None
    """Play a plan instead: a TOML file of sets, rows of trainings, seeds and suites, or the name of one that comes with
    the package: ablation generalist singles tiny wrists (docs/howto/train/loop.md)."""
    rows: Several[str] = ()
    """With --plan: rows that are trained and played; the first one when none is named."""
    seeds: Several[int] = ()
    """With --plan: seeds of the trainings of each row instead of the plan's."""
    only: Several[str] = ()
    """With --plan: stages that are played: record build train evaluate tables card."""
    small: bool = False
    """A loop for tests of the machinery: few episodes, small pictures, the recipe `small`; it learns nothing."""
    out: str | None = None
    """Folder; results/loop_<tasks>_<tracker>_<policy>_<recipe> when none is named."""
