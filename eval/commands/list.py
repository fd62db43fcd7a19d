"""`python -m arena_newton.eval list`: the plan of a run."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass

from arena_newton.cli.flags import shared
from arena_newton.eval.plan.options import RunOptions

__all__ = ["ListOptions", "run"]


@dataclass(frozen=True)
class ListOptions(RunOptions):
    """Show the episodes that a run of the same flags plays, and run nothing."""

    json: bool = False
    """Print an array with one object per episode."""


def run(options: ListOptions) -> int:
    """Print the plan."""
    from arena_newton.eval.plan import episode_plan
    from arena_newton.eval.plan.config import resolve
    from arena_newton.eval.reports.progress import simulated
    from arena_newton.eval.statistics.detectable import detectable_text
    from arena_newton.files.text import counted

    episodes = resolve(shared(options, RunOptions)).episodes
    if options.json:
        rows = [json.dumps(episode_plan.listed(episode), allow_nan=False) for episode in episodes]
        print("[\n" + ",\n".join(rows) + "\n]")
        return 0
    print(f"{counted(len(episodes), 'episode')}, {simulated(sum(episode.max_steps for episode in episodes))}")
    cells = Counter((episode.task, episode.tracker, episode.mode) for episode in episodes)
    if text := detectable_text(list(cells.values())):
        print(text)
    for episode in episodes:
        print(
            f"{episode.index:>5} {episode.task:<12} {episode.tracker:<8} {episode.mode:<10} seed {episode.group_seed} "
            f"repeat {episode.repeat:>2} episode_seed {episode.episode_seed:>10} max_steps {episode.max_steps}"
        )
    return 0
