"""``python -m arena_newton.eval engines``: do the two physics engines give the same rates?

A replayed walk from one spawn pose is a single trajectory, and contacts make it chaotic: the least difference of two
engines decides whether it stumbles. Rates are therefore compared over rollouts whose spawn positions differ by far less
than any rule can see.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from tqdm import tqdm

from arena_newton import policies, trackers
from arena_newton.cli.intervals import wilson
from arena_newton.cli.quiet import quiet_warp
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.plan.options import EngineOptions
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES, check_types, parse, read_regular
from arena_newton.files.text import plain_text
from arena_newton.interfaces import Spawn
from arena_newton.physics.devices import resolve_engine
from arena_newton.policies.base import Policy
from arena_newton.rollout import Rollout
from arena_newton.tasks.base import TaskSpec

__all__ = ["Rates", "fisher", "measure", "run"]


@dataclass(frozen=True)
class Rates:
    """What one engine gave."""

    engine: str
    device: str
    rollouts: int
    falls: int
    successes: int
    errors: int
    overflows: int
    """Rollouts in which a contact or constraint buffer overflowed."""
    wall_s: float
    """Wall-clock time without building and compiling [s]."""


def fisher(a: int, n: int, b: int, m: int) -> float:
    """Two-sided p-value of `a` of `n` against `b` of `m` under one common rate.

    Fisher's exact test: the sum over all tables with the same margins that are no likelier than the observed one.
    """

    def weight(x: int) -> int:
        return math.comb(n, x) * math.comb(m, a + b - x)

    seen = weight(a)
    possible = range(max(0, a + b - m), min(n, a + b) + 1)
    return sum(weight(x) for x in possible if weight(x) <= seen) / math.comb(n + m, a + b)


def measure(options: EngineOptions, engine: str, policy: Policy) -> Rates:
    """Run the rollouts on one engine."""
    env = ArenaEnv(
        options.task,
        worlds=min(options.worlds, options.rollouts),
        tracker=trackers.get(options.tracker, options.checkpoint),
        engine=engine,
        fast_physics=options.fast_physics,
    )
    rollouts = [SimpleNamespace(episode_seed=options.seed * 1_000_003 + i) for i in range(options.rollouts)]
    began = time.perf_counter()
    with tqdm(total=len(rollouts), desc=engine, unit="rollout", disable=None) as bar:  # none in a log file
        results = Rollout(
            env,
            policy,
            rollouts,
            max_steps=options.max_steps,
            spawn=moved_spawn(env.spec, options.noise),
            on_finish=lambda _: bar.update(),
        ).run()
    outcomes = [result.outcome for result in results]
    return Rates(
        engine=engine,
        device=str(env.device),
        rollouts=len(results),
        falls=outcomes.count("fall"),
        successes=outcomes.count("success"),
        errors=outcomes.count("error"),
        overflows=sum(result.overflow for result in results),
        wall_s=time.perf_counter() - began,
    )


def moved_spawn(spec: TaskSpec, noise: float) -> Spawn:
    """The task's spawn pose, moved by noise [m] that the episode seed alone decides."""

    def spawn(seed: int) -> tuple[Sequence[float], Sequence[float]]:
        position = np.array(spec.spawn_position, dtype=np.float32)
        position[:2] += noise * np.random.default_rng(seed).standard_normal(2)
        return position.tolist(), spec.spawn_quat

    return spawn


def _line(rates: Rates) -> str:
    def rate(count: int) -> str:
        low, high = wilson(count, rates.rollouts)
        return f"{count}/{rates.rollouts} ({count / rates.rollouts:.1%}, 95 % {low:.1%} to {high:.1%})"

    return (
        f"{rates.engine:<7} {rates.device:<7} falls {rate(rates.falls)}  successes {rate(rates.successes)}  "
        f"errors {rates.errors}  overflows {rates.overflows}  {rates.wall_s:.0f} s"
    )


def run(options: EngineOptions) -> int:
    """Measure each engine, print rates and p-values.

    Returns:
        Exit code 0.

    Raises:
        InputError: Unfit numbers or names, or a file to compare with that cannot be read.
        StorageError: The rates cannot be written; they were printed.
    """
    bounds = [("--rollouts", options.rollouts, 1), ("--worlds", options.worlds, 1), ("--seed", options.seed, 0)]
    bounds += [("--max-steps", options.max_steps, 1)] if options.max_steps is not None else []
    for flag, value, least in bounds:
        if value < least:
            raise InputError(f"{flag} {value}: must be at least {least}")
    if not (math.isfinite(options.noise) and options.noise >= 0.0):
        raise InputError(f"--noise {options.noise}: must be a distance of 0 or more [m]")
    policy = policies.get(options.policy)
    policy.check()
    policy.check_task(options.task)
    earlier = _earlier(options.against)
    quiet_warp()
    for engine in options.engines:  # an unknown one is refused before the first rollout
        resolve_engine(engine, None)
    rates = [*earlier, *(measure(options, engine, policy) for engine in options.engines)]
    for one in rates:
        print(_line(one), flush=True)
    for i, one in enumerate(rates):
        for other in rates[:i]:
            p = fisher(one.falls, one.rollouts, other.falls, other.rollouts)
            q = fisher(one.successes, one.rollouts, other.successes, other.rollouts)
            names = f"{other.engine} ({other.device}) against {one.engine} ({one.device})"
            print(f"{names}: p = {p:.3f} falls, {q:.3f} successes")
    if options.out is not None:
        write_atomic(Path(options.out).expanduser(), json.dumps([asdict(one) for one in rates], indent=2) + "\n")
    return 0


def _earlier(path: str | None) -> list[Rates]:
    if path is None:
        return []
    try:
        rows = parse(read_regular(Path(path), MAX_CONFIG_BYTES))
        rates = [Rates(**check_types(path, row, Rates)) for row in rows]
        if any(min(one.falls, one.successes) < 0 or max(one.falls, one.successes) > one.rollouts for one in rates):
            raise ValueError("counts beyond the number of rollouts")
    except (OSError, ValueError, TypeError, AttributeError, InputError) as error:
        reason = plain_text(error, 200)
        raise InputError(f"--against {path}: not a file that --out of this command wrote ({reason})") from error
    return rates
