"""Reads a LeRobot v3.0 dataset from its files, without LeRobot: JSON, parquet, and where each episode's frames are."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.stored_json import read_object
from arena_newton.files.untrusted_files import check_size

__all__ = ["CODEBASE_VERSION", "DatasetFiles", "EpisodeRow", "VideoPart", "read_json"]

CODEBASE_VERSION = "v3.0"
"""LeRobot's format."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
"""LeRobot's names of files; a dataset with others is refused."""
PARQUET_BYTES = 1024 * limits.MIB
"""Size of a parquet file; LeRobot begins another at 100 MB."""
JSON_BYTES = 64 * limits.MIB
"""Size of a JSON file of a dataset: 100,000 episodes."""
TEXT_ROWS = 256
"""Rows of a table with text that are read at once."""
_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8}
"""Parquet's types of numbers → bytes of one in memory."""
_KEY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,200}")


def read_json(path: Path) -> dict[str, object]:
    """A JSON object.

    Raises:
        InputError: The file is absent, too large or no JSON object.
    """
    return read_object(path, JSON_BYTES)


@dataclass(frozen=True)
class VideoPart:
    """Video file and time range with the frames of an episode."""

    path: Path
    first: int
    """Number of its first frame in the file."""
    frames: int


@dataclass(frozen=True)
class EpisodeRow:
    """One row of `meta/episodes`."""

    index: int
    length: int
    tasks: tuple[str, ...]
    first: int
    """Number of its first row in the dataset."""
    data: Path
    """File of its rows."""
    values: Mapping[str, object]
    """All columns, statistics included."""


def _integer(value: object, where: str, least: int = 0) -> int:
    if not isinstance(value, int | float) or isinstance(value, bool) or value != value or int(value) != value:
        raise InputError(f"{where} is {str(value)[:60]!r}, expected an integer")
    if not least <= value < 2**40:
        raise InputError(f"{where} is {value}, expected at least {least}")
    return int(value)


def _check_memory(path: Path, size: int) -> None:
    if size > limits.ROWS_MEMORY:
        raise InputError(f"{path}: its rows take more than {limits.ROWS_MEMORY // limits.MIB} MiB of memory")


def _text_table(path: Path, file: pyarrow.parquet.ParquetFile, columns: list[str] | None) -> pyarrow.Table:
    """A table with text, a few rows at a time: no header says how long a text is that many rows repeat."""
    parts, size = [], 0
    for part in file.iter_batches(TEXT_ROWS, columns=columns):
        size += part.nbytes
        _check_memory(path, size)
        parts.append(part)
    return pyarrow.Table.from_batches(parts) if parts else file.read(columns)


class DatasetFiles:
    """A LeRobot v3.0 dataset on disk; tables are read when they are asked for."""

    def __init__(self, root: str | Path):
        """Read `meta/info.json`.

        Raises:
            InputError: It is absent, damaged, or of another version of the format.
        """
        self.root = Path(root)
        self._info = self.root / "meta" / "info.json"
        if not self.root.is_dir():
            raise InputError(f"{self.root}: no such folder")
        self.info = read_json(self._info)
        version = self.info.get("codebase_version")
        if version != CODEBASE_VERSION:
            raise InputError(f"{self._info}: codebase_version is {str(version)[:40]!r}, expected {CODEBASE_VERSION}")
        self.fps = _integer(self.info.get("fps"), f"{self._info}: fps", 1)
        self.episodes = _integer(self.info.get("total_episodes"), f"{self._info}: total_episodes", 1)
        self.frames = _integer(self.info.get("total_frames"), f"{self._info}: total_frames", 1)
        for name, expected in (("data_path", DATA_PATH), ("video_path", VIDEO_PATH)):
            given = self.info.get(name)
            if given != expected and not (name == "video_path" and given is None):
                raise InputError(f"{self._info}: {name} is {str(given)[:80]!r}, expected {expected}")

    @cached_property
    def features(self) -> dict[str, dict[str, object]]:
        """Features by name.

        Raises:
            InputError: They are missing, or one has a name that is none.
        """
        found = self.info.get("features")
        if not isinstance(found, dict) or not all(isinstance(value, dict) for value in found.values()):
            raise InputError(f"{self._info}: features is no table of features")
        for key in found:
            if not _KEY.fullmatch(key):
                raise InputError(f"{self._info}: features: {key[:80]!r} is no name of a feature")
        return found

    @property
    def video_keys(self) -> list[str]:
        """Features that are videos."""
        return [key for key, feature in self.features.items() if feature.get("dtype") == "video"]

    @cached_property
    def tasks(self) -> list[str]:
        """Instructions by their number.

        Raises:
            InputError: `meta/tasks.parquet` is absent or damaged.
        """
        path = self.root / "meta" / "tasks.parquet"
        table = self.table(path)
        names = [name for name in table.column_names if name != "task_index"]
        words = table.column(names[0]).to_pylist() if len(names) == 1 else None
        index = table.column("task_index").to_pylist() if "task_index" in table.column_names else None
        if words is None or index is None or sorted(map(str, index)) != sorted(map(str, range(len(words)))):
            raise InputError(f"{path}: is no table of task_index 0, 1, ... and instructions")
        return [str(word) for _, word in sorted(zip(index, words, strict=True))]

    @cached_property
    def episode_rows(self) -> list[EpisodeRow]:
        """All episodes.

        Raises:
            InputError: `meta/episodes` is absent, damaged or has other numbers than 0, 1, ...
        """
        folder = self.root / "meta" / "episodes"
        files = sorted(folder.glob("chunk-*/file-*.parquet"))
        if not files:
            raise InputError(f"{folder}: holds no table of episodes")
        found: list[EpisodeRow] = []
        for file in files:
            for values in self.table(file).to_pylist():
                where = f"{file}: episode {len(found)}"
                if _integer(values.get("episode_index"), f"{where}: episode_index") != len(found):
                    raise InputError(f"{where}: episode_index is {values['episode_index']}")
                chunk, number = (
                    _integer(values.get(f"data/{n}_index"), f"{where}: data/{n}") for n in ("chunk", "file")
                )
                tasks = values.get("tasks")
                found.append(
                    EpisodeRow(
                        index=len(found),
                        length=_integer(values.get("length"), f"{where}: length", 1),
                        tasks=tuple(map(str, tasks)) if isinstance(tasks, list) else (),
                        first=_integer(values.get("dataset_from_index"), f"{where}: dataset_from_index"),
                        data=self.root / DATA_PATH.format(chunk_index=chunk, file_index=number),
                        values=values,
                    )
                )
        if len(found) != self.episodes:
            raise InputError(f"{folder}: holds {len(found)} episodes, {self._info.name} says {self.episodes}")
        return found

    def video(self, row: EpisodeRow, key: str) -> VideoPart:
        """Video file and time range with the frames of an episode.

        Raises:
            InputError: The table does not say, or the file is absent.
        """
        where = f"{self.root / 'meta' / 'episodes'}: episode {row.index}: videos/{key}"
        chunk, number = (
            _integer(row.values.get(f"videos/{key}/{n}_index"), f"{where}/{n}_index") for n in ("chunk", "file")
        )
        times = [row.values.get(f"videos/{key}/{n}_timestamp") for n in ("from", "to")]
        if not all(isinstance(t, int | float) and 0 <= t < 1e7 for t in times):
            raise InputError(f"{where}: timestamps are {times}")
        path = self.root / VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=number)
        if not path.is_file():
            raise InputError(f"{path}: is missing")
        first, end = (round(float(t) * self.fps) for t in times)  # type: ignore[arg-type]
        return VideoPart(path, first, end - first)

    def table(self, path: Path, columns: Sequence[str] | None = None) -> pyarrow.Table:
        """A parquet file, or some of its columns.

        Raises:
            InputError: It is absent, too large, damaged, or lacks a column.
        """
        check_size(path, PARQUET_BYTES)
        chosen = None if columns is None else list(columns)
        try:
            with pyarrow.parquet.ParquetFile(path, memory_map=False) as file:
                plain = self._check_rows(path, file.metadata, chosen)
                table = file.read(chosen) if plain else _text_table(path, file, chosen)
            table.validate(full=True)  # text of a damaged file may be none
            return table
        except (pyarrow.ArrowException, OSError, KeyError, ValueError) as error:
            raise InputError(f"{path}: not a readable parquet file ({type(error).__name__})") from error

    def _check_rows(self, path: Path, about: pyarrow.parquet.FileMetaData, columns: list[str] | None) -> bool:
        """Refuse a table whose rows would take too much memory, by its header; False where it has text.

        Raises:
            InputError: It has more rows than the dataset has frames, or too many numbers.
        """
        if about.num_rows > self.frames:
            raise InputError(
                f"{path}: has {about.num_rows:,} rows, {self._info.name} says {self.frames:,} total_frames"
            )
        size, plain = 0, True
        for group in map(about.row_group, range(about.num_row_groups)):
            for part in map(group.column, range(group.num_columns)):
                if columns is None or part.path_in_schema.partition(".")[0] in columns:
                    plain &= part.physical_type in _WIDTHS
                    size += part.num_values * _WIDTHS.get(part.physical_type, 1)
            _check_memory(path, size)
        return plain

    def columns(self, path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Columns of a file as arrays of shape [rows] or [rows, width].

        Raises:
            InputError: One is missing, ragged or no numbers.
        """
        check_size(path, PARQUET_BYTES)
        try:
            known = pyarrow.parquet.read_schema(path).names
        except (pyarrow.ArrowException, OSError, ValueError) as error:
            raise InputError(f"{path}: not a readable parquet file ({type(error).__name__})") from error
        for name in names:
            if name not in known:
                raise InputError(f"{path}: has no column {name}")
        table = self.table(path, names)
        found = {}
        for name in names:
            column = table.column(name).combine_chunks()
            kind = column.type
            try:
                width = None
                if pyarrow.types.is_fixed_size_list(kind):
                    width = kind.list_size
                elif pyarrow.types.is_list(kind) or pyarrow.types.is_large_list(kind):
                    lengths = set(column.value_lengths().to_pylist())
                    if len(lengths) != 1:
                        raise InputError(f"{path}: column {name} is ragged")
                    width = lengths.pop()
                flat = column.flatten() if width is not None else column
                values = flat.to_numpy(zero_copy_only=False)
                if values.dtype.kind not in "fiub" or flat.null_count:
                    raise InputError(f"{path}: column {name} holds {flat.type}, expected numbers")
                found[name] = values if width is None else values.reshape(table.num_rows, width)
            except (pyarrow.ArrowException, ValueError, TypeError) as error:
                raise InputError(f"{path}: column {name} cannot be read ({type(error).__name__})") from error
        return found
