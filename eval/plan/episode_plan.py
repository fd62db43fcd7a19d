"""The plan of an evaluation: which episodes, in which order, with which draws. Pure: nothing is built, nothing runs."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError, check_once
from arena_newton.eval.records.schema import MAX_COUNT, MAX_EPISODES, MAX_SEED
from arena_newton.files.own_files import file_label
from arena_newton.files.stored_json import JsonObject
from arena_newton.rules import modes as all_modes
from arena_newton.rules import seeding

__all__ = ["MAX_EPISODES", "PROTOCOL_REPEATS", "PROTOCOL_SEEDS", "Episode", "expand", "listed"]

PROTOCOL_SEEDS = (0, 1, 2)
"""Group seeds of the benchmark's protocol (original benchmark: 3 seeds)."""
PROTOCOL_REPEATS = 20
"""Repeats per group seed of the benchmark's protocol."""


@dataclass(frozen=True)
class Episode:
    """One planned episode."""

    index: int
    """Position in the plan, from 0."""
    task: str
    mode: str
    rules: str
    tracker: str
    policy: str
    engine: str
    group_seed: int
    repeat: int
    episode_seed: int
    """Seed of everything random in the episode; the same for every mode, tracker, policy and rule set."""
    object_seed: int
    max_steps: int
    """Step budget [50 Hz ticks]."""
    rank: int = 0
    """Position among the episodes of its task, tracker and mode, from 0."""

    @property
    def key(self) -> str:
        """Name that is unique in a plan of one tracker, e.g. `football/base/s0/r3`."""
        return f"{self.task}/{self.mode}/s{self.group_seed}/r{self.repeat}"


def expand(
    task_names: Sequence[str],
    *,
    trackers: Sequence[str],
    policy: str,
    modes: Sequence[str] = ("base",),
    rules: str = "paper",
    engine: str = "mujoco",
    seeds: Sequence[int] = PROTOCOL_SEEDS,
    repeats: int = PROTOCOL_REPEATS,
    max_steps: int | None = None,
    seed_range: str = seeding.EVALUATION,
    most: int | None = None,
) -> list[Episode]:
    """Episodes of a run: tasks × trackers × modes × group seeds × repeats, in this order.

    `task_names` may be `all` alone; `repeats` are the episodes per group seed; `max_steps` caps the rule set's step
    budgets; trackers, policy, rules and engine are the names that results carry. Of another `seed_range` than the
    evaluation's, `seeds` are numbers of series. `most` is the `--max` from which repeats were made, if one was.

    Raises:
        InputError: Unknown task, mode or rule set, something named twice, or nothing to run.
    """
    rule_set = rule_sets.get(rules)
    names = tasks.PAPER if list(task_names) == ["all"] else tuple(task_names)
    recorded = seed_range == seeding.DEMONSTRATION
    seeds_flag = "--seed-series" if recorded else "--seeds"
    for flag, values in (("--task", names), ("--tracker", trackers), ("--mode", modes), (seeds_flag, seeds)):
        if not values:
            raise InputError(f"{flag}: nothing given, at least one value is needed")
        check_once(flag, values)
    if len({file_label(name) for name in trackers}) < len(trackers):
        raise InputError(
            f"--tracker {' '.join(trackers)}: two have one name as a folder of actions; play each by itself"
        )
    high = max(seeds)
    if high > MAX_SEED:
        raise InputError(f"{seeds_flag} {_cut(high)}: expected at most {MAX_SEED}")
    for mode in modes:
        all_modes.get(mode)
    if repeats < 1:
        raise InputError(f"--repeats {repeats}: expected at least 1")
    if max_steps is not None and max_steps < 1:
        raise InputError(f"--max-steps {max_steps}: expected at least 1")
    if max_steps is not None and max_steps > MAX_COUNT:
        raise InputError(f"--max-steps {_cut(max_steps)}: expected at most {MAX_COUNT:,}")
    total = len(names) * len(trackers) * len(modes) * len(seeds) * repeats
    if total > MAX_EPISODES:
        made = f"{total:,} episodes" if total < 10**12 else "too many episodes"
        counted = f"--repeats {_cut(repeats)}" if most is None else f"--max {_cut(most)}"
        given = "--episodes" if recorded else counted
        raise InputError(f"{given}: makes {made}, at most {MAX_EPISODES:,} are planned at once")
    episodes: list[Episode] = []
    for name in names:
        spec = tasks.get(name)
        budget = spec.max_steps(rule_set)
        for tracker, mode in itertools.product(trackers, modes):
            for position, group_seed in enumerate(seeds):
                for repeat in range(repeats):
                    seed = seeding.planned_seed(spec.gym_id, seed_range, group_seed, repeat)
                    episodes.append(
                        Episode(
                            index=len(episodes),
                            task=name,
                            mode=mode,
                            rules=rules,
                            tracker=tracker,
                            policy=policy,
                            engine=engine,
                            group_seed=group_seed,
                            repeat=repeat,
                            episode_seed=seed,
                            object_seed=seeding.object_seed(seed),
                            max_steps=budget if max_steps is None else min(budget, max_steps),
                            rank=position * repeats + repeat,
                        )
                    )
    return episodes


def _cut(number: int) -> str:
    """A number for a message, shortened where it has more digits than a line."""
    return str(number) if number < 10**40 else f"{str(number)[:40]}..."


def listed(episode: Episode) -> JsonObject:
    """Entry of an episode in `list --json`.

    `sampled` and `placed` are keyed by the object's name in the original's records. A placed object names its prim, its
    `position` [m] and its `orientation` (wxyz). `light` is the episode's distant light, or null under the scene's dome.
    """
    spec = tasks.get(episode.task)
    draws = spec.draw(episode.episode_seed, episode.mode, rule_sets.get(episode.rules))
    placed = {}
    for o in spec.objects:
        pose = draws.placed[o.prim]
        placed[o.record] = {"prim": o.prim, "position": list(pose.pos), "orientation": list(pose.quat)}
    light = None
    if draws.light is not None:
        light = dataclasses.asdict(draws.light)
        light |= {"direction": list(draws.light.direction), "color": list(draws.light.color)}
    keys = ("task", "mode", "rules", "group_seed", "repeat", "episode_seed", "object_seed")
    facts = {key: getattr(episode, key) for key in keys}
    return facts | {"sampled": draws.sampled, "placed": placed, "light": light, "max_steps": episode.max_steps}
