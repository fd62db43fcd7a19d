"""``data stats``: five numbers of each episode, and the episodes that are unlike the others of their task.

They are what users of LeRobot's visualizer look for by eye: length, jerk, stillness, final pose, and how far the robot
was from its commands.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from arena_newton.data.datasets.motion_source import Motion, motions
from arena_newton.files.text import counted
from arena_newton.pages.tables import Table
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, STATE

if TYPE_CHECKING:
    from arena_newton.data.datasets.data_options import StatsOptions

__all__ = ["FIGURES", "EpisodeFigures", "figures", "ranked", "stats"]

FIGURES: Mapping[str, str] = {
    "seconds": "length [s]",
    "jerk": "root mean square of the third derivative of the reference joints [rad/s³]",
    "still": "fraction of rows in which no reference joint moves by 0.002 rad",
    "final_pose": "distance of the last joint positions from the median of its kind [rad, root mean square]",
    "error": "distance of measured from reference joints [rad, root mean square]",
}
"""Figures of an episode, in the order of the table."""
STILL = 0.002
"""A joint that moves by less than this in a tick stands still [rad]: 0.1 rad/s."""
OUTLIER = 3.5
"""Robust z-score from which an episode is an outlier (Iglewicz and Hoaglin, 1993)."""
MAD_SCALE = 1.4826
"""Median absolute deviation to standard deviation of a normal distribution."""
LEAST_SPREAD = 0.02
"""Least spread that a score is measured in, as a fraction of the median: equal episodes have no outliers."""
LEAST_GROUP = 5
"""Least number of episodes of a task and tracker among which one can be unlike the others."""
MOST_LINES = 40
"""Episodes in the table that is printed."""


@dataclass(frozen=True)
class EpisodeFigures:
    """Figures of an episode."""

    name: str
    task: str
    tracker: str
    outcome: str
    seed: int | None
    rows: int
    seconds: float
    jerk: float
    still: float
    final_pose: float
    error: float
    score: float
    """Largest robust z-score of its figures within its task and tracker."""
    reason: str
    """Figure of that score."""

    @property
    def is_outlier(self) -> bool:
        """True if it is unlike the others of its task and tracker."""
        return self.score >= OUTLIER


def figures(episodes: Iterable[Motion]) -> list[EpisodeFigures]:
    """Figures of episodes, in their order; each is compared with the others of its task and tracker."""
    names, values, poses = [], [], []
    for motion in episodes:
        # Arrays are not kept: a set of a thousand episodes has half a gigabyte of them.
        names.append((motion.name, motion.task, motion.tracker, motion.outcome, motion.seed, motion.rows))
        values.append(_alone(motion))
        poses.append(motion.state[-1, STATE["joint_pos"]].astype(np.float64))
    groups: dict[tuple[str, str], list[int]] = {}
    for number, (_, task, tracker, *_) in enumerate(names):
        groups.setdefault((task, tracker), []).append(number)
    found: dict[int, EpisodeFigures] = {}
    for members in groups.values():
        pose = np.median([poses[number] for number in members], axis=0)
        for number in members:
            values[number]["final_pose"] = float(np.sqrt(np.mean((poses[number] - pose) ** 2)))
        scores = {name: _scores(np.array([values[number][name] for number in members])) for name in FIGURES}
        for at, number in enumerate(members):
            reason = max(FIGURES, key=lambda name: scores[name][at])
            score = float(scores[reason][at])
            reason = reason if score else ""
            found[number] = EpisodeFigures(*names[number], **values[number], score=score, reason=reason)  # type: ignore[arg-type]
    return [found[number] for number in range(len(names))]


def _alone(motion: Motion) -> dict[str, float]:
    """Figures that need no other episode."""
    joints = motion.action[:, ACTION["joint_pos"]].astype(np.float64)
    jerk = np.diff(joints, n=3, axis=0) / g1.TICK**3
    moved = np.abs(np.diff(joints, axis=0)).max(axis=1)
    error = joints - motion.state[:, STATE["joint_pos"]]
    return {
        "seconds": motion.rows * g1.TICK,
        "jerk": float(np.sqrt(np.mean(jerk**2))) if len(jerk) else 0.0,
        "still": float(np.mean(moved < STILL)) if len(moved) else 1.0,
        "final_pose": 0.0,
        "error": float(np.sqrt(np.mean(error**2))),
    }


def _scores(values: np.ndarray) -> np.ndarray:
    """Robust z-scores, shape [n]; of fewer than `LEAST_GROUP` values zeros."""
    if len(values) < LEAST_GROUP:
        return np.zeros(len(values))
    middle = np.median(values)
    spread = MAD_SCALE * np.median(np.abs(values - middle))
    distance: np.ndarray = np.abs(values - middle) / max(spread, LEAST_SPREAD * abs(middle), 1e-9)
    return distance


def ranked(found: Sequence[EpisodeFigures]) -> list[EpisodeFigures]:
    """Episodes by their scores, the most unusual first."""
    return sorted(found, key=lambda one: -one.score)


def stats(folders: Sequence[Path], options: StatsOptions) -> int:
    """Print the figures of recordings or datasets.

    Returns:
        Exit code 0.

    Raises:
        InputError: A folder holds no episodes, or one is damaged.
    """
    found = figures(motions(folders))
    if options.json:
        print(json.dumps([asdict(one) | {"outlier": one.is_outlier} for one in ranked(found)], indent=1))
        return 0
    print(table(found))
    return 0


def table(found: Sequence[EpisodeFigures]) -> str:
    """Medians per task and tracker, then the most unusual episodes, as Markdown."""
    head = [name.replace("_", " ") for name in FIGURES]
    rows: list[list[object]] = []
    groups: dict[tuple[str, str], list[EpisodeFigures]] = {}
    for one in found:
        groups.setdefault((one.task, one.tracker), []).append(one)
    for (task, tracker), members in groups.items():
        middles = [float(np.median([getattr(one, name) for one in members])) for name in FIGURES]
        wins = sum(one.outcome == "success" for one in members)
        outliers = sum(one.is_outlier for one in members)
        rows.append([task, tracker or "-", len(members), wins, *(f"{value:.3g}" for value in middles), outliers])
    lines = Table(("task", "tracker", "episodes", "successes", *head, "outliers"), rows, "llr").compact()
    shown = ranked(found)[:MOST_LINES]
    rows = [
        [one.name, one.rows, *(f"{getattr(one, name):.3g}" for name in FIGURES), f"{one.score:.1f}"]
        + [f"{one.reason} (outlier)" if one.is_outlier else one.reason]
        for one in shown
    ]
    align = "l" + "r" * (len(FIGURES) + 2) + "l"
    lines += ["", *Table(("episode", "rows", *head, "score", "of"), rows, align).compact()]
    if len(found) > len(shown):
        lines.append(f"\n{counted(len(found) - len(shown), 'episode')} more; --json prints all")
    return "\n".join(lines)
