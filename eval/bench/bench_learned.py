"""What a policy that sees costs beside the expert on the CPU: ticks of both in turn, and where its time goes."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from arena_newton import policies, trackers
from arena_newton.cli.extras import require
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.bench.bench_figure import BenchFigure
from arena_newton.eval.bench.bench_options import BenchOptions
from arena_newton.eval.bench.bench_policy import PARTS, random_checkpoint, timed_parts
from arena_newton.eval.plan import episode_plan
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.learned.learned_card import PolicyCard, shipped_card
from arena_newton.policies.train.checkpoint_packing import pack
from arena_newton.rollout import Rollout

__all__ = ["learned_figures"]

BAR = 2.0
"""Most times the expert's time, on two CPU cores."""
WORLDS = (1, 3)
"""Episodes at once: one, and those of the default run."""
WARM_UP = 45
"""Ticks that are played first: kernels and networks are loaded, two looks taken."""
ROUNDS = 3
"""Times that both are measured in turn; the medians of their seconds per tick are compared."""


def learned_figures(options: BenchOptions) -> Iterator[BenchFigure]:
    """Time of a tick of `--policy learned` as a multiple of the expert's, same task, tracker, worlds and number."""
    card = shipped_card()
    if card is None:
        try:
            require("policies", "learned")
        except InputError as error:  # the other figures of `all` need no such library
            yield BenchFigure("learned / expert, CPU", BAR, "x", True, None, str(error))
            return
    with tempfile.TemporaryDirectory() as folder:
        spec, task, words = "learned", card.tasks[0] if card is not None else "vis_navi", "the policy of the package"
        if card is None:
            packed, words = Path(folder) / "packed", "random weights of the recipe compact"
            pack(random_checkpoint(Path(folder) / "made", "compact", (task,)), packed, PolicyCard(tasks=(task,)))
            spec = f"learned:{packed}"
        for worlds in WORLDS:
            yield _figure(options, task, spec, worlds, words)


def _figure(options: BenchOptions, task: str, spec: str, worlds: int, words: str) -> BenchFigure:
    seen = policies.get(spec)
    seen.check()
    players = {"expert": policies.get("expert"), "learned": read_by(seen, seen.labels or "v3.1")}
    episodes = episode_plan.expand([task], trackers=["twist2"], policy=spec, seeds=[0], repeats=worlds)
    envs = {
        name: ArenaEnv(
            task,
            tracker=trackers.get("twist2", options.checkpoint),
            worlds=worlds,
            engine="mujoco",
            device="cpu",
            camera=seen.camera if name == "learned" else None,
        )
        for name in players
    }
    spent: dict[str, list[float]] = {name: [] for name in players}

    def play(name: str, ticks: int) -> int:
        return sum(result.steps for result in Rollout(envs[name], players[name], episodes, max_steps=ticks).run())

    try:
        for name in players:
            play(name, WARM_UP)
        for _ in range(ROUNDS):
            for name in players:
                began = time.perf_counter()
                played = play(name, options.learned_ticks)
                spent[name].append((time.perf_counter() - began) / played)
        parts, whole = timed_parts(envs["learned"], players["learned"], lambda: play("learned", options.learned_ticks))
    finally:
        for name, player in players.items():
            player.close()
            envs[name].close()
    learned, expert = statistics.median(spent["learned"]), statistics.median(spent["expert"])
    shown = ", ".join(f"{name} {100 * parts[name] / whole:.0f} %" for name in PARTS)
    note = f"{1e3 * learned:.2f} ms / {1e3 * expert:.2f} ms per world and tick; {shown}; {words}"
    name = f"learned / expert, {task}, {worlds} {'worlds' if worlds > 1 else 'world'}, CPU"
    return BenchFigure(name, BAR, "x", True, learned / expert, note)
