"""Rows of datasets that a training reads besides pictures: states, actions of one protocol, tasks, statistics."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from arena_newton.data.datasets.row_statistics import aggregated, row_statistics
from arena_newton.data.readers.dataset_files import DatasetFiles, read_json
from arena_newton.data.readers.label_decoder import decode_v4
from arena_newton.data.readers.label_protocols import LABELS, action_names, encode_v4
from arena_newton.data.readers.lerobot_reader import DatasetActions
from arena_newton.data.readers.looks import LOOKS_FOLDER
from arena_newton.errors import InputError
from arena_newton.pictures.settings import CAMERAS, FRONT
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

__all__ = [
    "ACTION_KEY",
    "CAMERA_KEY",
    "PICTURES",
    "STATE_KEY",
    "VECTOR_KEY",
    "DatasetRows",
    "EpisodeRows",
    "read_rows",
    "statistics",
]

STATE_KEY, ACTION_KEY = "observation.state", "action"
"""LeRobot's names of state and action."""
PICTURES = "observation.images."
"""Beginning of the names of pictures, before that of the camera."""
CAMERA_KEY = f"{PICTURES}{FRONT}"
"""Name of the head camera's pictures."""
VECTOR_KEY = "observation.environment_state"
"""Name of the one-hot vector of task and tracker: LeRobot's networks take it as a token of its own."""
STATISTICS = ("min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99")
"""Those of a feature that normalization may use."""


@dataclass(frozen=True)
class EpisodeRows:
    """One demonstration without its pictures."""

    states: np.ndarray
    """float32, shape [T, 64]."""
    actions: np.ndarray
    """Actions in the label protocol of the training, float32, shape [T, 40]."""
    instruction: str
    task: str
    """Name of our task; empty where the dataset does not tell."""
    tracker: str = ""
    """Name of the tracker through which it was recorded; empty where the dataset does not tell."""

    @property
    def length(self) -> int:
        """Number of rows."""
        return len(self.states)


@dataclass(frozen=True)
class DatasetRows:
    """A dataset without its pictures."""

    root: Path
    episodes: tuple[EpisodeRows, ...]
    trackers: tuple[str, ...]
    cameras: Mapping[str, str]
    """Camera → its feature, of those that are trained on."""
    height: int
    """Height of a picture [px]."""
    width: int
    """Width of a picture [px]."""
    picture_statistics: Mapping[str, Mapping[str, np.ndarray]]
    """Statistics of each camera per channel on the scale 0 to 1, shape [3, 1, 1], and `count`."""
    hash: str
    """`content_hash`."""

    @property
    def frames(self) -> int:
        """Rows of all episodes."""
        return sum(episode.length for episode in self.episodes)

    def first(self, episodes: int) -> DatasetRows:
        """The dataset's first episodes.

        Raises:
            InputError: It has fewer.
        """
        if episodes > len(self.episodes):
            raise InputError(f"--episodes {episodes}: {self.root} has {len(self.episodes)}")
        return dataclasses.replace(self, episodes=self.episodes[:episodes])

    @property
    def described(self) -> dict[str, object]:
        """Description of it in a checkpoint."""
        return {
            "name": self.root.resolve().name,
            "hash": self.hash,
            "episodes": len(self.episodes),
            "frames": self.frames,
        }


def read_rows(root: Path, labels: str, cameras: Sequence[str] = (FRONT,)) -> DatasetRows:
    """Read the rows of a dataset.

    Args:
        labels: Protocol in which the actions are wanted, `v3.1` or `v4`.
        cameras: Cameras whose pictures are wanted, by their names in recordings.

    Raises:
        InputError: It is no dataset of canonical states and actions with those pictures, in one size, or is damaged.
    """
    if not (root / "meta" / "info.json").is_file():
        raise InputError(
            f"--dataset {root}: no LeRobot dataset, meta/info.json is missing; `python -m arena_newton.data build` "
            "makes one of recordings"
        )
    about = DatasetActions(root)
    files = about.files
    where = files.root / "meta" / "info.json"
    if shape_of(files, STATE_KEY) != [STATE_WIDTH]:
        raise InputError(f"{where}: features: {STATE_KEY} has shape {shape_of(files, STATE_KEY)}, expected [64]")
    keys = files.video_keys
    if not keys:
        raise InputError(f"{where}: features: has no pictures, which a policy is to see")
    features = {name: PICTURES + name for name in cameras}
    if FRONT in features and CAMERA_KEY not in keys:
        foreign = (key for key in keys if key.removeprefix(PICTURES) not in CAMERAS)
        features[FRONT] = next(foreign, CAMERA_KEY)
    shape: list[int] = []
    for name, key in features.items():
        if key not in keys:
            raise InputError(f"--cameras {name}: {where} has no {key}, but {', '.join(keys)}")
        shape, before = shape_of(files, key), shape
        if len(shape) != 3 or shape[2] != 3 or not all(16 <= n <= 4096 for n in shape[:2]):
            raise InputError(f"{where}: features: {key} has shape {shape}, expected [height, width, 3]")
        if before and shape != before:
            raise InputError(f"{where}: features: {key} has shape {shape}, other cameras {before}, expected one size")
    seeds = about.seeds()
    states, actions = episode_arrays(files, about.labels)
    episodes = []
    for row in files.episode_rows:
        task = seeds[row.index].task if seeds else about.task(row.index) or ""
        wanted = converted(actions[row.index], about.labels, labels)
        instruction = row.tasks[0] if row.tasks else ""
        tracker = seeds[row.index].tracker if seeds else ""
        episodes.append(EpisodeRows(states[row.index], wanted, instruction, task, tracker))
    return DatasetRows(
        root=files.root,
        episodes=tuple(episodes),
        trackers=tuple(sorted({seed.tracker for seed in seeds})),
        cameras=features,
        height=shape[0],
        width=shape[1],
        picture_statistics={name: picture_statistics(files, key) for name, key in features.items()},
        hash=content_hash(files, states, actions),
    )


def content_hash(files: DatasetFiles, states: Sequence[np.ndarray], actions: Sequence[np.ndarray]) -> str:
    """SHA-256 over `meta/info.json`, `meta/stats.json` (of pictures too), the list of looks, states and actions.

    `info.json` of the original's datasets says no more than how many episodes and rows there are.
    """
    digest = hashlib.sha256((files.root / "meta" / "info.json").read_bytes())
    statistics_file = files.root / "meta" / "stats.json"
    if statistics_file.is_file():
        digest.update(statistics_file.read_bytes())
    looks = files.root / LOOKS_FOLDER / "looks.json"
    if looks.is_file():
        digest.update(looks.read_bytes())
    for numbers in (*states, *actions):
        digest.update(np.ascontiguousarray(numbers).tobytes())
    return digest.hexdigest()


def shape_of(files: DatasetFiles, key: str) -> list[int]:
    """Shape of a feature; empty where there is none."""
    shape = files.features.get(key, {}).get("shape")
    return list(shape) if isinstance(shape, list | tuple) and all(isinstance(n, int) for n in shape) else []


def episode_arrays(files: DatasetFiles, labels: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """States and actions of every episode as the dataset has them; each file is read once."""
    states: list[np.ndarray] = []
    actions: list[np.ndarray] = []
    path, columns = Path(), dict[str, np.ndarray]()
    for row in files.episode_rows:
        if row.data != path:
            path, columns = row.data, files.columns(row.data, ("episode_index", "frame_index", STATE_KEY, ACTION_KEY))
        where = f"{path}: episode {row.index}"
        mine = columns["episode_index"] == row.index
        if not np.array_equal(columns["frame_index"][mine], np.arange(row.length)):
            raise InputError(f"{where}: frame_index is not 0 to {row.length - 1} in {int(mine.sum())} rows")
        state = columns[STATE_KEY][mine].astype(np.float32)
        if state.shape != (row.length, STATE_WIDTH) or not np.isfinite(state).all():
            raise InputError(f"{where}: {STATE_KEY} is not {row.length} rows of {STATE_WIDTH} finite numbers")
        states.append(state)
        actions.append(LABELS[labels].validate(columns[ACTION_KEY][mine], where))
        if actions[-1].shape != (row.length, ACTION_WIDTH):
            raise InputError(f"{where}: {ACTION_KEY} is no vector of {ACTION_WIDTH} numbers")
    return states, actions


def converted(actions: np.ndarray, given: str, wanted: str) -> np.ndarray:
    """Actions of an episode in another protocol."""
    if given == wanted:
        return actions
    return encode_v4(actions) if wanted == "v4" else decode_v4(actions)


def picture_statistics(files: DatasetFiles, camera: str) -> dict[str, np.ndarray]:
    """Picture statistics in `meta/stats.json`, and the number of pictures.

    Raises:
        InputError: It says nothing usable.
    """
    path = files.root / "meta" / "stats.json"
    entry = read_json(path).get(camera)
    if not isinstance(entry, dict):
        raise InputError(f"{path}: says nothing of {camera}")
    found: dict[str, np.ndarray] = {"count": np.array([files.frames])}
    for name in STATISTICS:
        if name in entry:
            try:
                values = np.asarray(entry[name], np.float64).reshape(3, 1, 1)
            except (TypeError, ValueError, OverflowError):
                raise InputError(f"{path}: {camera}: {name} is not a number per channel") from None
            if not np.isfinite(values).all():
                raise InputError(f"{path}: {camera}: {name} is not finite")
            found[name] = values
    if missing := {"mean", "std", "min", "max"} - set(found):
        raise InputError(f"{path}: {camera}: lacks {', '.join(sorted(missing))}")
    return found


def statistics(
    datasets: Sequence[DatasetRows],
    episodes: Sequence[EpisodeRows],
    labels: str,
    *,
    state_floor: float = 0.0,
    action_floor: float = 0.0,
) -> dict[str, dict[str, np.ndarray]]:
    """Statistics by which a policy normalizes, as LeRobot joins those of episodes.

    Args:
        datasets: Their pictures.
        episodes: Those that are trained on.
        labels: Protocol of their actions.
        state_floor: Least deviation of a state: one that never changes must not be divided by zero.
        action_floor: Least deviation of an action.

    Returns:
        Feature → statistic → values, float32: shape [3, 1, 1], [64] or [40].
    """
    names = action_names(labels)
    states = aggregated([row_statistics(episode.states) for episode in episodes])
    actions = aggregated([row_statistics(episode.actions, names) for episode in episodes])
    found = {}
    for camera in datasets[0].cameras:
        shown = [dict(dataset.picture_statistics[camera]) for dataset in datasets]
        common = set.intersection(*(set(one) for one in shown))
        found[PICTURES + camera] = aggregated([{name: one[name] for name in common} for one in shown])
    states["std"] = np.maximum(states["std"], state_floor)
    actions["std"] = np.maximum(actions["std"], action_floor)
    found |= {STATE_KEY: states, ACTION_KEY: actions}
    return {
        key: {name: values.astype(np.float32) for name, values in of.items() if name in STATISTICS}
        for key, of in found.items()
    }
