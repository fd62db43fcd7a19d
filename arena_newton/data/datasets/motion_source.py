"""Episodes as motions, whether they are recordings or a LeRobot dataset: what is looked at before training."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from arena_newton.cli.extras import require
from arena_newton.data.readers.looks import Looks, dataset_looks
from arena_newton.data.recording.episode import EpisodeFile, episode_files, opened
from arena_newton.errors import InputError
from arena_newton.robot.canonical import STATE_WIDTH

if TYPE_CHECKING:
    from arena_newton.data.readers.dataset_files import DatasetFiles, EpisodeRow

__all__ = ["DATASET_FILE", "Motion", "motions"]

DATASET_FILE = Path("meta") / "info.json"
"""File that makes a folder a dataset; other folders are of recordings."""


@dataclass(frozen=True)
class Motion:
    """One episode."""

    name: str
    task: str
    tracker: str
    outcome: str
    seed: int | None
    state: np.ndarray
    """Canonical state, shape [T, 64]."""
    action: np.ndarray
    """Canonical action v3.1, shape [T, 40]."""
    phases: tuple[str, ...] = ()
    """Name of the policy's phase of each row; empty where none is recorded."""
    video: Path | None = None
    first: int = 0
    """Number of its first frame in the video."""
    looks: tuple[Looks, Path] | None = None
    """Looks of its pictures, and their film."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.action)


def motions(folders: Sequence[Path]) -> Iterator[Motion]:
    """Episodes of folders, each a dataset or of recordings.

    Raises:
        InputError: A folder holds neither, or an episode is damaged.
    """
    for folder in folders:
        if (folder / DATASET_FILE).is_file():
            require("data", f"{folder}", ("pyarrow",))
            yield from _of_dataset(folder)
        else:
            for episode in opened(episode_files([folder])):
                yield _of_file(episode)


def _of_file(episode: EpisodeFile) -> Motion:
    camera = next(iter(episode.cameras), None)
    return Motion(
        name=episode.stem,
        task=episode.text("arena_task"),
        tracker=episode.text("arena_tracker"),
        outcome=episode.text("arena_outcome"),
        seed=episode.integer("arena_episode_seed"),
        state=episode.state,
        action=episode.action,
        phases=tuple(episode.phases),
        video=None if camera is None else episode.video(camera),
        looks=None if camera is None else episode.looks(camera),
    )


def _of_dataset(folder: Path) -> Iterator[Motion]:
    from arena_newton.data.datasets.assembly import described
    from arena_newton.data.readers.lerobot_reader import DatasetActions

    actions = DatasetActions(folder)
    files = actions.files
    listed, looks = described(files), dataset_looks(folder, files.episodes)
    for row in files.episode_rows:
        about = {} if listed is None else listed[row.index]
        seed = about.get("episode_seed")
        keys = files.video_keys
        part = files.video(row, keys[0]) if keys else None
        action = actions.actions(row.index)
        yield Motion(
            name=f"{folder.name} {row.index}",
            task=str(about.get("task") or actions.task(row.index) or " ".join(row.tasks)),
            tracker=str(about.get("tracker", "")),
            outcome=str(about.get("outcome", "")),
            seed=seed if isinstance(seed, int) else None,
            state=_state(files, row, len(action)),
            action=action,
            video=None if part is None else part.path,
            first=0 if part is None else part.first,
            looks=None if (film := looks[row.index]) is None else (film.looks, film.path),
        )


def _state(files: DatasetFiles, row: EpisodeRow, rows: int) -> np.ndarray:
    columns = files.columns(row.data, ("episode_index", "observation.state"))
    found: np.ndarray = columns["observation.state"][columns["episode_index"] == row.index]
    if found.shape != (rows, STATE_WIDTH) or not np.isfinite(found).all():
        where = f"{row.data}: episode {row.index}: observation.state"
        raise InputError(f"{where} has shape {list(found.shape)} or is not finite, expected [{rows}, {STATE_WIDTH}]")
    return np.asarray(found, dtype=np.float32)
