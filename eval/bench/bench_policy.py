"""What a policy that sees costs: seconds for many episodes, and what part of them each step of a tick takes."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
import warp as wp

from arena_newton import policies, trackers
from arena_newton.cli.extras import require
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.bench.bench_figure import BenchFigure
from arena_newton.eval.bench.bench_options import BenchOptions
from arena_newton.eval.plan import episode_plan
from arena_newton.interfaces import Policy
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.recipes.training_recipe import FAMILIES
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION, STATE_WIDTH
from arena_newton.rollout import Rollout

__all__ = ["PARTS", "policy_figures", "random_checkpoint", "timed_parts"]

BARS = {"vis_navi": 30.0, "boxing": 15.0}
"""Seconds for 60 episodes with ACT on one H200, kernels cached."""
EPISODES = 60
"""Episodes to which the bars belong."""
TICKS = {"vis_navi": 950, "boxing": 370}
"""Length of an episode of the policy with random weights, which only stands: about the mean of a trained ACT's
successes, 941 and 363 ticks (measured, 60 episodes each). A checkpoint's episodes end by themselves."""
SMALL = (2, 40)
"""Episodes and ticks without CUDA, where only the fractions say something."""
WARM_UP = 45
"""Ticks that are played first: kernels and networks are loaded, graphs captured, two looks taken."""
TIMED = 200
"""Ticks of the run whose parts are timed; each part then waits for the device, so that its time is its own."""
PARTS = ("physics", "pictures", "tracker", "policy")
"""Parts of a tick whose times are told apart."""


def random_checkpoint(folder: Path, name: str = "fast", tasks: tuple[str, ...] = (), family: str = "act") -> Path:
    """A checkpoint of a recipe with random weights, whose actions stay near standing.

    Args:
        folder: To write.
        name: Of the recipe.
        tasks: Of its task vector, where the recipe has one.
        family: Of the recipe.
    """
    from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
    from arena_newton.policies.recipes.training_recipe import recipe
    from arena_newton.policies.train.families import families

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


def policy_figures(options: BenchOptions) -> Iterator[BenchFigure]:
    """Seconds for the episodes of each task, and in the note the fractions of a tick."""
    cuda = bool(wp.is_cuda_available())
    if options.policy_family not in FAMILIES:
        raise InputError(f"--policy-family {options.policy_family}: unknown, choose from {', '.join(FAMILIES)}")
    if options.policy_checkpoint is None:
        try:
            require("policies", "policy")
        except InputError as error:  # the other figures of `all` need no such library
            yield BenchFigure("episodes, policy that sees", BARS["vis_navi"], "s", True, None, str(error))
            return
    with tempfile.TemporaryDirectory() as folder:
        given = options.policy_checkpoint
        spec = f"lerobot:{given or random_checkpoint(Path(folder), family=options.policy_family)}"
        for task in options.policy_tasks:
            yield _figure(options, task, spec, cuda, given is None)


def _figure(options: BenchOptions, task: str, spec: str, cuda: bool, random: bool) -> BenchFigure:
    count = options.policy_episodes or (EPISODES if cuda else SMALL[0])
    policy = policies.get(spec)
    policy.check()
    policy.check_task(task)
    policy = read_by(policy, policy.labels or "v3.1")
    env = ArenaEnv(
        task,
        tracker=trackers.get("twist2", options.checkpoint),
        worlds=count,
        engine="warp" if cuda else "mujoco",
        device="cuda:0" if cuda else "cpu",
        camera=policy.camera,
    )
    steps = env.budget if not random else min(env.budget, TICKS.get(task, env.budget))
    steps = options.policy_steps or (steps if cuda else SMALL[1])
    episodes = episode_plan.expand([task], trackers=["twist2"], policy=spec, seeds=[0], repeats=count)
    try:
        Rollout(env, policy, episodes, max_steps=WARM_UP).run()
        began = time.perf_counter()
        results = Rollout(env, policy, episodes, max_steps=steps).run()
        seconds = time.perf_counter() - began
        parts, timed = timed_parts(
            env, policy, lambda: Rollout(env, policy, episodes, max_steps=min(steps, TIMED)).run()
        )
    finally:
        policy.close()
        env.close()
    ticks, won = sum(result.steps for result in results), sum(result.outcome == "success" for result in results)
    ticks_s = max(result.steps for result in results) / seconds
    shown = f"{ticks_s:.1f} ticks/s of the batch, "
    shown += ", ".join(f"{name} {100 * parts[name] / timed:.0f} %" for name in PARTS)
    rest = 100 * (1 - sum(parts.values()) / timed)
    note = f"{shown}, rest {rest:.0f} %; {ticks:,} ticks, {won} successes, {'random weights' if random else spec}"
    act = options.policy_family == "act" or options.policy_checkpoint is not None
    whole = cuda and count == EPISODES and task in BARS and not options.policy_steps and act
    where = "CUDA" if cuda else "CPU"
    name = f"{count} {task} episodes, policy that sees, {where}"
    if whole:
        return BenchFigure(name, BARS[task], "s", True, seconds, note)
    reason = "judged for 60 episodes on CUDA only"
    return BenchFigure(name, BARS.get(task, BARS["vis_navi"]), "s", True, None, f"{seconds:.1f} s, {reason}: {note}")


def timed_parts(env: ArenaEnv, policy: Policy, play: Callable[[], object]) -> tuple[dict[str, float], float]:
    """Seconds of each part of a tick and of the whole; the device is waited for before and after each."""
    spent = dict.fromkeys(PARTS, 0.0)

    def wait() -> None:
        if env.device.is_cuda:
            wp.synchronize_device(env.device)

    def timed(name: str, work: Callable[..., object]) -> Callable[..., object]:
        def call(*args: object, **kwargs: object) -> object:
            wait()
            began = time.perf_counter()
            try:
                return work(*args, **kwargs)
            finally:
                wait()
                spent[name] += time.perf_counter() - began

        return call

    where = {
        "physics": (env.physics, "step"),
        "pictures": (env, "render"),
        "tracker": (env.loop, "tick"),
        "policy": (policy, "act"),
    }
    with contextlib.ExitStack() as stack:
        for name, (owner, method) in where.items():
            setattr(owner, method, timed(name, getattr(owner, method)))
            stack.callback(delattr, owner, method)
        wait()
        began = time.perf_counter()
        play()
        wait()
        return spent, time.perf_counter() - began
