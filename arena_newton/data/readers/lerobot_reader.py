"""Actions of a LeRobot dataset as the world executes them: its robot type and protocol decide how they are read.

LeRobot itself is not needed. Besides our own datasets these are the original's released ones, whose folders are named
`<task>/<sonic|twist2>_refpose_v3_1`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arena_newton import tasks
from arena_newton.data.readers.dataset_files import DatasetFiles
from arena_newton.data.readers.label_decoder import decode_v4
from arena_newton.data.readers.label_protocols import LABELS
from arena_newton.errors import InputError
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH

__all__ = ["DatasetActions", "RecordedSeed"]

LEGACY: Mapping[str, str] = {
    "unitree_g1_smpl_pose6d_vla": "the legacy protocol v1, whose displacements and orientations are the world's",
    "unitree_g1_rotlocal_v3": "protocol v3, whose orientations are relative to the robot",
}
"""Robot types of earlier protocols of the original (none of its released data have them), and what they mean."""
MAX_EPISODES = 100_000
"""Episodes of a dataset that are read."""


@dataclass(frozen=True)
class RecordedSeed:
    """Our episode that a dataset's episode was made from, if the dataset names it (block `arena` of `info.json`)."""

    task: str
    mode: str
    tracker: str
    episode_seed: int


class DatasetActions:
    """Episodes of a dataset as actions of v3.1."""

    def __init__(self, root: str | Path):
        """Read what the dataset says of its actions; rows are read when they are asked for.

        Raises:
            InputError: It is no LeRobot v3.0 dataset of canonical actions at 50 Hz, or contradicts itself.
        """
        self.files = DatasetFiles(root)
        self.where = self.files.root / "meta" / "info.json"
        info = self.files.info
        self.labels = self._labels(info)
        """Name of the dataset's label protocol."""
        if self.files.fps != round(1 / g1.TICK):
            wanted = f"an action is a tick of {g1.TICK} s: expected {round(1 / g1.TICK)}"
            raise InputError(f"{self.where}: fps is {self.files.fps}; {wanted}")
        feature = self.files.features.get("action")
        if feature is None:
            raise InputError(f"{self.where}: features has no action")
        if list(_list(feature.get("shape"))) != [ACTION_WIDTH]:
            shape = str(feature.get("shape"))[:60]
            raise InputError(f"{self.where}: features: action has shape {shape}, expected [{ACTION_WIDTH}]")
        self._check_joints(feature.get("names"))
        if self.files.episodes > MAX_EPISODES:
            raise InputError(f"{self.where}: {self.files.episodes} episodes, expected at most {MAX_EPISODES}")

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return self.files.episodes

    def actions(self, episode: int) -> np.ndarray:
        """Actions of an episode, v3.1, float32, shape [T, 40].

        Raises:
            InputError: There is no such episode, or its rows are missing, repeated or unfit.
        """
        if not 0 <= episode < self.episodes:
            last = self.episodes - 1
            raise InputError(f"{self.files.root}: has no episode {episode}, its episodes are 0 to {last}")
        row = self.files.episode_rows[episode]
        columns = self.files.columns(row.data, ("episode_index", "frame_index", "action"))
        where = f"{row.data}: episode {episode}"
        mine = columns["episode_index"] == episode
        frames = columns["frame_index"][mine]
        if not np.array_equal(frames, np.arange(row.length)):
            raise InputError(f"{where}: frame_index is not 0 to {row.length - 1} in {len(frames)} rows")
        if columns["action"].ndim != 2:
            raise InputError(f"{where}: action is no vector")
        found = LABELS[self.labels].validate(columns["action"][mine], where)
        return decode_v4(found) if self.labels == "v4" else found

    def task(self, episode: int) -> str | None:
        """Our task that an episode is of, by its instruction or the block `arena`; None where neither tells."""
        seeds = self.seeds()
        if seeds:
            return seeds[episode].task
        known = {_words(spec.instruction): spec.name for spec in tasks.specs()}
        named = {known.get(_words(text)) for text in self.files.episode_rows[episode].tasks}
        return named.pop() if len(named) == 1 else None

    def seeds(self) -> list[RecordedSeed]:
        """Seeds of the episodes, where they are ours; empty where the dataset does not name them.

        Raises:
            InputError: The block is damaged, or has another number of episodes.
        """
        block = self.files.info.get("arena")
        if block is None:
            return []
        listed = block.get("episodes") if isinstance(block, dict) else None
        if not isinstance(listed, list) or len(listed) != self.episodes:
            raise InputError(f"{self.where}: arena: episodes are no list of {self.episodes}")
        found = []
        for number, entry in enumerate(listed):
            where = f"{self.where}: arena: episode {number}"
            if not isinstance(entry, dict):
                raise InputError(f"{where}: is no object")
            words = [entry.get(name) for name in ("task", "mode", "tracker")]
            seed = entry.get("episode_seed")
            if not all(isinstance(word, str) for word in words) or not isinstance(seed, int):
                raise InputError(f"{where}: task, mode, tracker or episode_seed is missing or unfit")
            task, mode, tracker = map(str, words)
            found.append(RecordedSeed(task, mode, tracker, seed))
        return found

    def _labels(self, info: Mapping[str, object]) -> str:
        """Name of the protocol that robot type and `vla_protocol` agree on."""
        kind = info.get("robot_type")
        block = info.get("vla_protocol")
        if isinstance(kind, str) and kind in LEGACY:
            raise InputError(f"{self.where}: robot_type {kind} is {LEGACY[kind]}; {_supported()}")
        by_robot = {protocol.robot_type: name for name, protocol in LABELS.items()}
        found = by_robot.get(kind) if isinstance(kind, str) else None
        if found is None:
            raise InputError(f"{self.where}: robot_type is {str(kind)[:80]!r}; {_supported()}")
        if block is None:
            return found
        version = block.get("version") if isinstance(block, dict) else None
        declared = {"3.1": "v3.1", "v3.1": "v3.1", "4": "v4", "4.0": "v4", "v4": "v4"}.get(str(version))
        if declared != found:
            raise InputError(
                f"{self.where}: vla_protocol has version {str(version)[:40]!r}, robot_type {kind} is of {found}"
            )
        return found

    def _check_joints(self, names: object) -> None:
        """Refuse joints in another order, where the dataset names them."""
        if isinstance(names, dict):  # LeRobot's other form: {"axes": [...]}
            names = next(iter(names.values()), None)
        if not isinstance(names, list) or len(names) != ACTION_WIDTH:
            return
        first = ACTION["joint_pos"].start
        for number, joint in enumerate(g1.CANONICAL_JOINTS):
            given = str(names[first + number]).rpartition(".")[2]
            if given in g1.CANONICAL_JOINTS and given != joint:
                where = f"{self.where}: features: action: slot {first + number}"
                raise InputError(f"{where} is joint {given}, expected {joint} (canonical order)")


def _list(value: object) -> list[object]:
    return list(value) if isinstance(value, list | tuple) else []


def _words(text: str) -> str:
    """An instruction without case and its last full stop."""
    return text.strip().rstrip(".").lower()


def _supported() -> str:
    types = " and ".join(f"{protocol.robot_type} ({name})" for name, protocol in LABELS.items())
    return f"supported are {types}"
