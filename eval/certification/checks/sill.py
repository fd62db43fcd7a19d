"""DoubleDesk's sill: how often the expert's robot treads on what it should step over. No rule counts it."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import numpy as np

from arena_newton import policies
from arena_newton.eval.certification.checks.traces import world_of
from arena_newton.eval.certification.finding import Check, CheckFinding, skipped
from arena_newton.interfaces import Recorder, World
from arena_newton.pages.tables import Table, percent
from arena_newton.rollout import Rollout
from arena_newton.tasks.double_desk import SILL

if TYPE_CHECKING:
    from arena_newton.eval.certification.context import Context
    from arena_newton.files.stored_json import JsonObject
    from arena_newton.physics.batch import Physics

__all__ = ["CHECKS", "Treads"]

TASK = "double_desk"
TREAD = 10
"""A touch of more ticks than this is a tread: the foot stood on the sill; shorter ones are a toe that brushes it."""


class Treads(Recorder):
    """Counts in each episode the ticks with a force between robot and sill."""

    def __init__(self) -> None:
        """Know no episode yet."""
        self.ticks: dict[int, int] = {}
        """Episode seed → ticks in which the robot touched the sill."""
        self.highest: dict[int, float] = {}
        """Episode seed → largest normal force between them [N]."""
        self._running: dict[int, int] = {}

    def start(self, env: World, world: int, episode: SimpleNamespace) -> None:
        """See `Recorder.start`."""
        model, robot = env.scene.mj_model, list(env.scene.robot.bodies)
        links = np.flatnonzero(np.isin(model.geom_bodyid, robot)).tolist()
        cast("Physics", env.physics).watch_pair(links, env.scene.geom_ids(SILL))
        seed = self._running[world] = int(episode.episode_seed)
        self.ticks[seed], self.highest[seed] = 0, 0.0

    def tick(self, env: World) -> None:
        """See `Recorder.tick`."""
        force = cast("Physics", env.physics).pair_force.numpy()
        for world in np.flatnonzero(env.active & (force > 0.0)).tolist():
            seed = self._running[world]
            self.ticks[seed] += 1
            self.highest[seed] = max(self.highest[seed], float(force[world]))


def sill(context: Context) -> CheckFinding:
    """Count the touches of the expert's episodes through each tracker."""
    if TASK not in context.tasks:
        return skipped(f"needs --task {TASK}")
    rows, parts = [], []
    for tracker in context.trackers:
        measure = functools.partial(_count, context, tracker)
        found = context.measured("sill", TASK, tracker, {"episodes": context.episodes}, measure)
        ticks, force = np.array(found["ticks"]), np.array(found["force"])
        free, trod = int((ticks == 0).sum()), int((ticks > TREAD).sum())
        touched = ticks[ticks > 0]
        middle = f"{np.median(touched):g}, {touched.max()}" if len(touched) else "-"
        rows.append((tracker, f"{free}/{len(ticks)}", f"{trod}/{len(ticks)}", middle, f"{force.max():.0f}"))
        parts.append(f"{tracker} crosses without a touch in {percent(free / len(ticks), 0)} %")
    head = (
        "tracker",
        "without a touch",
        f"more than {TREAD} ticks",
        "ticks of the others: median, most",
        "most force [N]",
    )
    sheet = Table(head, rows, title="Touches of the sill in an episode")
    return CheckFinding("note", "; ".join(parts), (sheet,), ("An episode that touches the sill counts as it ends.",))


def _count(context: Context, tracker: str) -> JsonObject:
    """Ticks and forces of a tracker's episodes, in the order of the protocol."""
    seeds, treads = context.seeds(TASK, context.episodes), Treads()
    env = world_of(context, TASK, tracker, worlds=min(len(seeds), context.options.worlds))
    Rollout(env, policies.get("expert"), [SimpleNamespace(episode_seed=s) for s in seeds], recorder=treads).run()
    env.close()
    return {"ticks": [treads.ticks[s] for s in seeds], "force": [treads.highest[s] for s in seeds]}


CHECKS = (Check("sill", "How often do the feet tread on DoubleDesk's sill?", sill),)
"""This module's checks."""
