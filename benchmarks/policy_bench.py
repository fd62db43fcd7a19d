"""Cost of a policy that sees: seconds for many episodes, and what part of them each step of a tick takes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch
import warp as wp

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.bench.timing import WARM_UP, BenchFigure, RepeatedEpisodes
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import FAMILIES, recipe
from arena_newton.policies.train.families import families
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION, STATE_WIDTH
from benchmarks.bench_options import PolicyBenchOptions

__all__ = ["policy_figures", "random_checkpoint"]

BARS = {"vis_navi": 30.0, "boxing": 15.0}
"""Seconds for 60 episodes with ACT on one H200, kernels cached."""
EPISODES = 60
"""Episodes to which the bars belong."""
TICKS = {"vis_navi": 950, "boxing": 370}
"""Length of an episode of the policy with random weights, which only stands: about the mean of a trained ACT's
successes, 941 and 363 ticks (measured, 60 episodes each). A checkpoint's episodes end by themselves."""
SMALL = (2, 40)
"""Episodes and ticks without CUDA, where only the fractions say something."""
TIMED = 200
"""Ticks of the play whose parts are timed; each part then waits for the device, so that its time is its own."""


def random_checkpoint(folder: Path, name: str = "fast", tasks: tuple[str, ...] = (), family: str = "act") -> Path:
    """A checkpoint of a recipe with random weights, whose actions stay near standing.

    Args:
        folder: To write.
        name: Of the recipe.
        tasks: Of its task vector, where the recipe has one.
        family: Of the recipe.
    """
    # The fast recipe of pi0.5 begins with weights of a hub: without their name, with new ones of the same size.
    network = {"pretrained_path": ""} if family == "pi05" and name == "fast" else {}
    settings = recipe(family, name, labels="v3.1", realign=0.0, network=network)

    def around(mean: torch.Tensor, deviation: float) -> dict[str, torch.Tensor]:
        spread = torch.full_like(mean, deviation)
        low, high = mean - 3 * spread, mean + 3 * spread
        return {"mean": mean, "std": spread, "min": low, "max": high, "q01": low, "q99": high}

    stats = {
        "observation.state": around(torch.zeros(STATE_WIDTH), 1.0),
        "action": around(torch.from_numpy(STAND_ACTION).clone(), 1e-4),
    }
    if settings.use_task_vector:
        stats["observation.environment_state"] = around(torch.zeros(len(tasks)), 1.0)
    assert stats["action"]["mean"].shape == (ACTION_WIDTH,)
    facts = CheckpointFacts(task_vector=tasks if settings.use_task_vector else ())
    with torch.random.fork_rng(devices=[]):  # made on the CPU; with several GPUs torch would warn and start them all
        torch.manual_seed(0)
        families.build(settings, stats, "cpu").save(folder, facts)
    return folder


def policy_figures(options: PolicyBenchOptions) -> Iterator[BenchFigure]:
    """Seconds for the episodes of each task, and in the note the fractions of a tick."""
    if options.family not in FAMILIES:
        raise InputError(f"--family {options.family}: unknown, choose from {', '.join(FAMILIES)}")
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = options.checkpoint or random_checkpoint(Path(folder), family=options.family)
        for task in options.tasks:
            yield _figure(options, task, f"lerobot:{checkpoint}")


def _figure(options: PolicyBenchOptions, task: str, spec: str) -> BenchFigure:
    cuda, random = bool(wp.is_cuda_available()), options.checkpoint is None
    count = options.episodes or (EPISODES if cuda else SMALL[0])
    policy = policies.get(spec)
    policy.check()
    policy.check_task(task)
    bench = RepeatedEpisodes(task, policy, count, cuda=cuda, checkpoint=options.twist2)
    budget = bench.env.budget
    steps = min(budget, TICKS.get(task, budget)) if random else budget
    steps = options.steps or (steps if cuda else SMALL[1])
    try:
        bench.play(WARM_UP)
        seconds, results = bench.play(steps)
        parts = bench.fractions(min(steps, TIMED))
    finally:
        bench.close()
    ticks, won = [result.steps for result in results], sum(result.outcome == "success" for result in results)
    note = f"{max(ticks) / seconds:.1f} ticks/s of the batch, {parts}; {sum(ticks):,} ticks, {won} successes, "
    note += "random weights" if random else spec
    act = options.family == "act" or not random
    judged = cuda and count == EPISODES and task in BARS and not options.steps and act
    if not judged:
        note = f"{seconds:.1f} s, judged for {EPISODES} episodes on CUDA only: {note}"
    name = f"{count} {task} episodes, policy that sees, {'CUDA' if cuda else 'CPU'}"
    return BenchFigure(name, BARS.get(task, BARS["vis_navi"]), "s", True, seconds if judged else None, note)
