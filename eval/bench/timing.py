"""Parts of every measurement of speed: figures with bars, the clock, episodes that are played again and again."""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass

import warp as wp

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.plan import episode_plan
from arena_newton.interfaces import Disturbance, EpisodeResult, Recorder
from arena_newton.physics.devices import torch_threads
from arena_newton.pictures.settings import policy_cameras
from arena_newton.policies.base import Policy
from arena_newton.policies.label_reader import read_by
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding

__all__ = ["NEEDS_CUDA", "BenchFigure", "RepeatedEpisodes", "chosen", "cores", "print_figures", "seconds_of"]

NEEDS_CUDA = "not measured here (needs CUDA)"
WARM_UP = 45
"""Ticks that are played first: kernels and networks are loaded, graphs captured, two chunks decided."""


@dataclass(frozen=True)
class BenchFigure:
    """One line of the bench."""

    name: str
    bar: float | None
    """None where nothing is required of it."""
    unit: str
    at_most: bool
    """True when smaller is better."""
    value: float | None = None
    """None when it was not measured, or is not judged here."""
    note: str = ""

    @property
    def verdict(self) -> str:
        """``pass``, ``MISS`` or ``-``."""
        if self.value is None or self.bar is None:
            return "-"
        return "pass" if (self.value <= self.bar if self.at_most else self.value >= self.bar) else "MISS"

    @property
    def line(self) -> str:
        """The figure as it is printed."""
        value = "" if self.value is None else f"{self.value:,.3g}" if self.value < 1000 else f"{self.value:,.0f}"
        bar = "" if self.bar is None else f"({'<=' if self.at_most else '>='} {self.bar:,g})"
        return f"{self.verdict:<5} {self.name:<62} {value:>9} {self.unit:<14} {bar}  {self.note}".rstrip()


type Figures = Callable[[], Iterator[BenchFigure]]
"""Measures one item."""


def chosen(names: Sequence[str], items: Mapping[str, Figures]) -> dict[str, Figures]:
    """Items that ``--what`` names; all of them for `all`.

    Raises:
        InputError: An unknown item.
    """
    for name in names:
        if name not in (*items, "all"):
            raise InputError(f"--what {name}: known are {' '.join(items)} all")
    return {name: items[name] for name in (items if "all" in names else names)}


def print_figures(items: Mapping[str, Figures], *, as_json: bool = False) -> int:
    """Measure items and print their figures; one that breaks is a miss with its reason and does not stop the others.

    Returns:
        Exit code: 0 when no measured figure misses its bar, 1 otherwise.

    Raises:
        InputError: A flag is wrong, or a file cannot be read.
    """
    found: list[BenchFigure] = []
    for name, figures in items.items():
        for figure in _guarded(name, figures):
            found.append(figure)
            if not as_json:
                print(figure.line, flush=True)
    if as_json:
        print(json.dumps([asdict(figure) | {"verdict": figure.verdict} for figure in found], indent=2))
    return 1 if any(figure.verdict == "MISS" for figure in found) else 0


def _guarded(name: str, figures: Figures) -> Iterator[BenchFigure]:
    try:
        yield from figures()
    except InputError:
        raise
    except Exception as error:
        reason = f"failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        yield BenchFigure(name, 0.0, "", True, math.inf, reason)


def seconds_of(work: Callable[[], object]) -> float:
    """Time of a piece of work by the clock; devices are waited for before and after it [s]."""
    wp.synchronize()
    began = time.perf_counter()
    work()
    wp.synchronize()
    return time.perf_counter() - began


@contextlib.contextmanager
def cores(count: int) -> Iterator[int]:
    """Restrict this process to ``count`` cores; yields how many there are."""
    before = os.sched_getaffinity(0)
    kept = set(sorted(before)[:count])
    os.sched_setaffinity(0, kept)
    try:
        with torch_threads(len(kept)):
            yield len(kept)
    finally:
        os.sched_setaffinity(0, before)


class RepeatedEpisodes:
    """Episodes of a task through TWIST2 that are played again and again in one environment."""

    def __init__(
        self,
        task: str,
        policy: Policy,
        repeats: int,
        *,
        seeds: Sequence[int] = (0,),
        worlds: int | None = None,
        cuda: bool = False,
        checkpoint: str | None = None,
        seed_range: str = seeding.EVALUATION,
    ):
        """Plan the episodes and build the environment.

        Args:
            policy: Policy, read by the protocol that it answers; the pictures that it needs are rendered.
            worlds: Episodes at once; all when None.
            cuda: Engine warp on CUDA, instead of mujoco on the CPU.
            checkpoint: Weights of TWIST2; those of the package when None.
        """
        self.policy = read_by(policy, policy.labels or "v3.1")
        self.episodes = episode_plan.expand(
            [task], trackers=["twist2"], policy="bench", seeds=seeds, repeats=repeats, seed_range=seed_range
        )
        self.env = ArenaEnv(
            task,
            tracker=trackers.get("twist2", checkpoint),
            worlds=worlds or len(self.episodes),
            engine="warp" if cuda else "mujoco",
            device="cuda:0" if cuda else "cpu",
            cameras=policy_cameras(self.policy),
        )

    def play(
        self,
        ticks: int | None = None,
        *,
        recorder: Recorder | Sequence[Recorder] = (),
        disturbance: Disturbance | None = None,
        on_tick: Callable[[int], None] | None = None,
    ) -> tuple[float, list[EpisodeResult]]:
        """Seconds of all episodes, of at most so many ticks each, and their results."""
        began = time.perf_counter()
        results = Rollout(
            self.env,
            self.policy,
            self.episodes,
            recorder=recorder,
            disturbance=disturbance,
            max_steps=ticks,
            on_tick=on_tick,
        ).run()
        return time.perf_counter() - began, results

    def parts(self, ticks: int | None) -> tuple[dict[str, float], float]:
        """Seconds of each part of a tick and of the whole, in a play in which each part waits for the device."""
        spent: dict[str, float] = {}

        def timed(name: str, work: Callable[..., object]) -> Callable[..., object]:
            def call(*args: object, **kwargs: object) -> object:
                answers: list[object] = []
                spent[name] = spent.get(name, 0.0) + seconds_of(lambda: answers.append(work(*args, **kwargs)))
                return answers[0]

            return call

        where = {
            "physics": (self.env.physics, "step"),
            "pictures": (self.env, "render"),
            "tracker": (self.env.loop, "tick"),
            "policy": (self.policy, "act"),
        }
        with contextlib.ExitStack() as stack:
            for name, (owner, method) in where.items():
                setattr(owner, method, timed(name, getattr(owner, method)))
                stack.callback(delattr, owner, method)
            whole = seconds_of(lambda: self.play(ticks))
        return spent, whole

    def fractions(self, ticks: int) -> str:
        """Percentages of a tick that its parts take."""
        parts, whole = self.parts(ticks)
        parts["rest"] = whole - sum(parts.values())
        return ", ".join(f"{name} {100 * seconds / whole:.0f} %" for name, seconds in parts.items())

    def close(self) -> None:
        """Release policy and environment."""
        self.policy.close()
        self.env.close()
