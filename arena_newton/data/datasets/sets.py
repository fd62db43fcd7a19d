"""``data merge`` and ``data split``: several datasets as one, and one as two, to train on and to hold out."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.extras import require
from arena_newton.data.recording.episode import VIDEO_FOLDER, EpisodeFile, episode_files
from arena_newton.errors import InputError
from arena_newton.files.new_folder import link, new_folder
from arena_newton.files.text import counted
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.data.datasets.data_options import MergeOptions, SplitOptions
    from arena_newton.data.readers.dataset_files import DatasetFiles

__all__ = ["held_out", "merge", "split"]

DATASET_FILE = Path("meta") / "info.json"
"""File that makes a folder a dataset; other folders are of recordings."""


def held_out(seed: int | str, fraction: float, salt: int = 0) -> bool:
    """True if an episode is held out: of its seed alone, so that it is held out of every set that it is part of.

    Args:
        seed: The episode's seed; of an episode without one, its content.
        fraction: Probability, in [0, 1].
        salt: Another number draws another side.
    """
    digest = hashlib.sha256(f"{salt}|{seed}".encode()).digest()
    return int.from_bytes(digest[:8], "big") < fraction * 2.0**64


def merge(folders: Sequence[Path], options: MergeOptions) -> int:
    """Write one dataset of several, in the order given.

    Returns:
        Exit code 0.

    Raises:
        InputError: They are of different kinds, share an episode, or one is damaged.
        ArenaError: The dataset cannot be written.
    """
    from arena_newton.data.datasets import assembly
    from arena_newton.data.readers.dataset_files import DatasetFiles

    if len(folders) < 2:
        raise InputError("merge: name at least two datasets")
    sources = [DatasetFiles(folder) for folder in folders]
    assembly.check_alike(sources)
    with new_folder(options.out.expanduser()) as folder:
        assembly.write_selection([assembly.Selection(files, range(files.episodes)) for files in sources], folder)
    episodes, rows = sum(files.episodes for files in sources), sum(files.frames for files in sources)
    print(f"{options.out}: {counted(episodes, 'episode')}, {rows} rows of {len(sources)} datasets")
    judged = _mixed(sources)
    if judged:
        print(
            f"note: {judged} of them are on seeds of evaluations, the others are not; what is trained on this set must "
            "not be judged on those seeds"
        )
    return 0


def _mixed(sources: Sequence[DatasetFiles]) -> int:
    """Number of episodes on seeds of evaluations, where others are not; 0 where they are alike or not known."""
    from arena_newton.data.datasets import assembly

    listed = [assembly.described(files) for files in sources]
    ranges = [str(episode.get("seed_range")) for episodes in listed for episode in episodes or ()]
    judged = ranges.count(seeding.EVALUATION)
    return judged if judged < len(ranges) else 0


def split(folders: Sequence[Path], options: SplitOptions) -> int:
    """Write the episodes to train on and those to hold out, of datasets or of recordings.

    Returns:
        Exit code 0.

    Raises:
        InputError: A flag or a folder is unfit, or one side would be empty.
        ArenaError: A folder cannot be written.
    """
    if not 0.0 < options.fraction < 1.0:
        raise InputError(f"--fraction {options.fraction}: expected a number between 0 and 1")
    train, held = options.out_train.expanduser(), options.out_held_out.expanduser()
    if train.resolve() == held.resolve():
        raise InputError(f"--out-held-out {held}: is the folder of --out-train")
    kinds = {(folder / DATASET_FILE).is_file() for folder in folders}
    if len(kinds) > 1:
        raise InputError("split: some folders are datasets and some recordings; split them one by one")
    counts = (_split_datasets if kinds.pop() else _split_recordings)(folders, options, train, held)
    print(f"{train}: {counted(counts[0], 'episode')} to train on\n{held}: {counted(counts[1], 'episode')} held out")
    return 0


def _sides[T](items: Sequence[tuple[int | str, T]], options: SplitOptions) -> tuple[list[T], list[T]]:
    """Items by side; their first parts are seeds."""
    sides: tuple[list[T], list[T]] = [], []
    for seed, item in items:
        sides[held_out(seed, options.fraction, options.seed)].append(item)
    for side, name in zip(sides, ("to train on", "held out"), strict=True):
        if not side:
            of = counted(len(items), "episode")
            raise InputError(f"--fraction {options.fraction}: of {of} none is {name}; another --seed draws again")
    return sides


def _split_datasets(folders: Sequence[Path], options: SplitOptions, train: Path, held: Path) -> tuple[int, int]:
    """Split datasets; several are merged on each side."""
    require("data", "data split", ("pyarrow",))
    from arena_newton.data.datasets import assembly
    from arena_newton.data.readers.dataset_files import DatasetFiles

    sources = [DatasetFiles(folder) for folder in folders]
    assembly.check_alike(sources)
    items: list[tuple[int | str, tuple[DatasetFiles, int]]] = []
    for files in sources:
        listed = assembly.described(files)
        for row in files.episode_rows:
            seed: object = listed[row.index].get("episode_seed") if listed is not None else None
            if not isinstance(seed, int):  # a dataset of others says no seeds
                seed = hashlib.sha256(assembly.content(files, row)).hexdigest()
            items.append((seed, (files, row.index)))
    sides = _sides(items, options)
    with new_folder(train, "--out-train") as one, new_folder(held, "--out-held-out") as other:
        for side, folder in zip(sides, (one, other), strict=True):
            chosen = [assembly.Selection(files, [number for of, number in side if of is files]) for files in sources]
            assembly.write_selection([selection for selection in chosen if selection.episodes], folder)
    return len(sides[0]), len(sides[1])


def _split_recordings(folders: Sequence[Path], options: SplitOptions, train: Path, held: Path) -> tuple[int, int]:
    """Split recordings: files are linked where the disk allows it, else copied."""
    episodes = [EpisodeFile(file) for file in episode_files(folders)]
    names = [episode.path.name for episode in episodes]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise InputError(f"split: {doubled[0]} is in two folders; split them one by one")
    sides = _sides([(episode.integer("arena_episode_seed"), episode) for episode in episodes], options)
    with new_folder(train, "--out-train") as one, new_folder(held, "--out-held-out") as other:
        for side, folder in zip(sides, (one, other), strict=True):
            for episode in side:
                link(episode.path, folder / episode.path.name)
                for camera in episode.cameras:
                    looks = episode.looks(camera)
                    for film in (episode.video(camera), *([looks[1]] if looks else [])):
                        link(film, folder / VIDEO_FOLDER / film.name)
    return len(sides[0]), len(sides[1])
