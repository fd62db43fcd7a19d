"""Does an episode succeed at the tick at which its rule holds? The paper's rules again, from the state of every tick.

Sentences of `docs/reference/rules.md` as NumPy, with their numbers written out: nothing of the judge's kernels is used,
and a rule that confirms a tick early or late ends another tick.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import mujoco
import numpy as np

from arena_newton import policies
from arena_newton.eval.certification.checks.traces import world_of
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding, skipped
from arena_newton.interfaces import EpisodeResult, Recorder, World
from arena_newton.pages.tables import Table
from arena_newton.robot.g1 import FEET, PALMS
from arena_newton.rollout import Rollout
from arena_newton.tasks import boxing, double_desk, football, open_door, pp_box, vis_navi

if TYPE_CHECKING:
    from arena_newton.files.stored_json import JsonObject
    from arena_newton.physics.batch import Physics
    from arena_newton.tasks.handles import BodyFrame, Marker

__all__ = ["CHECKS", "RULES", "FirstTicks"]

EPISODES = (1, 4)
"""Episodes of each task under --quick and otherwise."""


class _State:
    """State of one world as a rule reads it."""

    def __init__(self, env: World, world: int):
        self.scene, self.physics, self.world = env.scene, cast("Physics", env.physics), world

    def row(self, name: str) -> np.ndarray:
        """A row of an array of the physics."""
        return np.asarray(getattr(self.physics, name).numpy()[self.world], dtype=float)

    def placed(self, frame: BodyFrame | Marker) -> tuple[np.ndarray, np.ndarray]:
        """World position [m] and rotation of a frame on a body, 0 = the world."""
        turn, centre = np.eye(3), np.zeros(3)
        if frame.body_id:
            turn, centre = _matrix(self.row("xquat")[frame.body_id]), self.row("xpos")[frame.body_id]
        return centre + turn @ np.array(frame.pos), turn @ _matrix(np.array(frame.quat, dtype=float))

    def seen_from(self, marker: Marker, point: np.ndarray) -> np.ndarray:
        """A point in a marker's frame [m]."""
        centre, turn = self.placed(marker)
        seen: np.ndarray = turn.T @ (point - centre)
        return seen

    @property
    def root(self) -> np.ndarray:
        """Position and quaternion of the robot's root."""
        first = self.scene.robot.root_qpos
        return self.row("qpos")[first : first + 7]

    @property
    def stands(self) -> bool:
        """The root is at 0.45 m or higher and the up-axis at 0.6 or more."""
        return bool(self.root[2] >= 0.45 and _matrix(self.root[3:])[2, 2] >= 0.6)


def _matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    turn: np.ndarray = matrix.reshape(3, 3)
    return turn


def _inside(point: np.ndarray, marker: Marker, axes: tuple[int, ...] = (0, 1, 2)) -> bool:
    return all(abs(point[axis]) <= marker.half[axis] for axis in axes)


def _football(s: _State) -> bool:
    goal = s.scene.marker(football.GOAL)
    return _inside(s.seen_from(goal, s.row("xpos")[s.scene.body_id(football.BALL)]), goal)


def _double_desk(s: _State) -> bool:
    crate = s.scene.marker(double_desk.INSIDE)
    return _inside(s.seen_from(crate, s.row("xipos")[s.scene.body_id(double_desk.HAMMER)]), crate)


def _pp_box(s: _State) -> bool:
    body, speed = s.scene.body_id(pp_box.BOX), s.scene.joint_qvel(pp_box.BOX)
    half = 0.105
    turn = _matrix(s.row("xquat")[body])
    centre = s.row("xpos")[body] + turn @ np.array([0.0, 0.0, half])
    bottom = centre[2] - half * np.abs(turn[2]).sum()
    decks = [s.scene.marker(path) for path in pp_box.DECKS]
    over = any(
        _inside(s.seen_from(deck, centre), deck, (0, 1)) and abs(bottom - s.placed(deck)[0][2] - deck.half[2]) <= 0.06
        for deck in decks
    )
    slow = np.linalg.norm(s.row("qvel")[speed : speed + 3]) <= 0.05
    return bool(over and slow and s.row("pair_force") == 0.0)


def _open_door(s: _State) -> bool:
    x, y, _ = s.seen_from(s.scene.marker(open_door.DOORWAY), s.root[:3])
    return bool(abs(x) <= 0.55 and y >= 0.02 and s.stands)


def _sit_sofa(s: _State) -> bool:
    return bool(s.root[2] <= 0.62 and s.row("pair_force") >= 50.0)


def _boxing(s: _State) -> bool:
    target = s.scene.marker(boxing.BOUNDS)
    reach = max(target.half) + 0.08
    palms = [s.placed(s.scene.frame(name))[0] for name in PALMS]
    return bool(min(np.linalg.norm(palm - s.placed(target)[0]) for palm in palms) <= reach)


def _vis_navi(s: _State) -> bool:
    zone = s.scene.marker(vis_navi.ZONE)
    feet = [s.row("xpos")[s.scene.link(name)] for name in FEET]
    return s.stands and all(_inside(s.seen_from(zone, foot), zone, (0, 1)) for foot in feet)


RULES: Mapping[str, tuple[Callable[[_State], bool], int]] = {
    "football": (_football, 1),
    "double_desk": (_double_desk, 1),
    "pp_box": (_pp_box, 10),
    "open_door": (_open_door, 1),
    "sit_sofa": (_sit_sofa, 25),
    "boxing": (_boxing, 1),
    "vis_navi": (_vis_navi, 1),
}
"""Task → whether the paper's condition holds at a tick, and for how many ticks in a row it must."""


class FirstTicks(Recorder):
    """Finds the tick at which each episode is to succeed, and keeps the one at which it did."""

    def __init__(self) -> None:
        """Know no episode yet."""
        self.found: list[tuple[int | None, int | None]] = []
        """Ticks of each episode that ended: by its states and by its verdict; None: no success."""
        self._count: dict[int, int] = {}
        self._first: dict[int, int | None] = {}

    def start(self, env: World, world: int, episode: SimpleNamespace) -> None:
        """See `Recorder.start`."""
        self._count[world], self._first[world] = 0, None

    def tick(self, env: World) -> None:
        """See `Recorder.tick`."""
        holds, confirm = RULES[env.spec.name]
        for world in np.flatnonzero(env.active & (env.tick > 0)).tolist():
            self._count[world] = self._count[world] + 1 if holds(_State(env, world)) else 0
            if self._count[world] >= confirm and self._first[world] is None:
                self._first[world] = int(env.tick[world])

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """See `Recorder.finish`."""
        judged = result.steps if result.outcome == "success" else None
        self.found.append((self._first[world], judged))


def rules(context: Context) -> CheckFinding:
    """Let the experts succeed and compare the tick of the verdict with the tick at which the rule holds."""
    names = [task for task in context.tasks if task in RULES]
    if not names:
        return skipped(f"no rule is written out for {' '.join(context.tasks)}")
    rows, wrong, compared = [], [], 0
    tracker = context.trackers[0]
    for task in names:
        seeds = context.seeds(task, EPISODES[not context.options.quick])

        def measure(task: str = task, seeds: list[int] = seeds) -> JsonObject:
            env, ticks = world_of(context, task, tracker, worlds=len(seeds)), FirstTicks()
            episodes = [SimpleNamespace(episode_seed=seed) for seed in seeds]
            Rollout(env, policies.get("expert"), episodes, recorder=ticks).run()
            env.close()
            return {"found": [list(pair) for pair in ticks.found]}

        found = context.measured("rules", task, tracker, {"seeds": list(seeds)}, measure)["found"]
        for held, judged in found:
            shown = [("none" if tick is None else str(tick)) for tick in (held, judged)]
            rows.append((task, str(RULES[task][1]), *shown))
            compared += held is not None
            if held != judged:
                wrong.append(f"{task}: succeeds at tick {shown[1]}, its rule holds from tick {shown[0]} on")
    if not compared:
        wrong.append("no episode succeeded")
    head = ("task", "ticks in a row", "the rule holds at tick", "the episode succeeds at tick")
    summary = f"{len(rows) - len(wrong)} of {len(rows)} episodes succeed at the tick at which the paper's rule holds"
    sheet = Table(head, rows, title=f"The expert's episodes through {tracker}, judged again from their states")
    return CheckFinding("fail" if wrong else "pass", summary, (sheet,), tuple(wrong))


CHECKS = (Check("rules", "Does an episode succeed at the very tick at which its rule holds?", rules),)
"""This module's checks."""
