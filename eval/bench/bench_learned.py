"""Cost of a policy that sees next to the expert on the CPU: ticks of both in turn, and where its time goes."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterator

from arena_newton import policies
from arena_newton.eval.bench.timing import WARM_UP, BenchFigure, RepeatedEpisodes, cores
from arena_newton.files.text import counted
from arena_newton.policies.learned.learned_card import shipped_card

__all__ = ["learned_figures"]

BAR = 2.0
"""Most times the expert's time, on two CPU cores."""
WORLDS = (1, 3)
"""Episodes at once: one, and those of the default run."""
ROUNDS = 3
"""Times that both are measured in turn: the median of their ratios counts, in which a busy machine slows both."""


def learned_figures(ticks: int, checkpoint: str | None = None) -> Iterator[BenchFigure]:
    """Time of a tick of `--policy learned` as a multiple of the expert's, for each task of its card."""
    card = shipped_card()
    if card is None:
        reason = "not measured: no policy comes with this package"
        yield BenchFigure("learned / expert, CPU", BAR, "x", True, None, reason)
        return
    for task, worlds in itertools.product(card.tasks, WORLDS):
        with cores(2):
            yield _figure(task, worlds, ticks, checkpoint)


def _figure(task: str, worlds: int, ticks: int, checkpoint: str | None) -> BenchFigure:
    seen = policies.get("learned")
    seen.check()
    players = {"expert": policies.get("expert"), "learned": seen}
    sides = {name: RepeatedEpisodes(task, one, worlds, checkpoint=checkpoint) for name, one in players.items()}
    spent: dict[str, list[float]] = {name: [] for name in sides}
    try:
        for side in sides.values():
            side.play(WARM_UP)
        for _ in range(ROUNDS):
            for name, side in sides.items():
                seconds, results = side.play(ticks)
                spent[name].append(seconds / sum(result.steps for result in results))
        parts = sides["learned"].fractions(ticks)
    finally:
        for side in sides.values():
            side.close()
    learned, expert = statistics.median(spent["learned"]), statistics.median(spent["expert"])
    ratio = statistics.median(one / other for one, other in zip(spent["learned"], spent["expert"], strict=True))
    note = f"{1e3 * learned:.2f} ms / {1e3 * expert:.2f} ms per world and tick; {parts}; the policy of the package"
    name = f"learned / expert, {task}, {counted(worlds, 'world')}, CPU"
    return BenchFigure(name, BAR, "x", True, ratio, note)
