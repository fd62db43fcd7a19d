"""A LeRobot v3.0 dataset made of episodes of others: tables are renumbered, pictures copied packet by packet.

Nothing is decoded or encoded, and LeRobot itself is not needed. Equal sources give equal bytes.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np
import pyarrow
import pyarrow.compute
import pyarrow.parquet
from tqdm import tqdm

from arena_newton.data.datasets.look_films import write_looks
from arena_newton.data.datasets.row_statistics import HAND_NAME, aggregated, row_statistics
from arena_newton.data.readers.dataset_files import (
    DATA_PATH,
    VIDEO_PATH,
    DatasetFiles,
    EpisodeRow,
    VideoPart,
    read_json,
)
from arena_newton.data.readers.looks import Looks, dataset_looks
from arena_newton.data.recording.layouts import REFERENCE_SOURCES
from arena_newton.errors import InputError
from arena_newton.files.limits import MIB
from arena_newton.files.own_files import replace_atomically, write_json

__all__ = ["Selection", "check_alike", "content", "described", "write_selection"]

MODALITY = Path("meta") / "modality.json"
NUMBERED = ("episode_index", "index", "task_index")
"""Columns that are counted again."""
OWN_FILE = {"meta/episodes/chunk_index", "meta/episodes/file_index"}
"""Columns that say where the table of episodes itself is; not every dataset has them."""
DATA_MB, VIDEO_MB = 100, 200
"""Sizes of files where `info.json` names none: LeRobot's own."""


@dataclass(frozen=True)
class Selection:
    """Episodes of a dataset, in their order."""

    files: DatasetFiles
    episodes: Sequence[int]


def described(files: DatasetFiles) -> list[dict[str, object]] | None:
    """Entry of each episode in the block `arena`; None in a dataset of others.

    Raises:
        InputError: It has another number of episodes, or one is no object.
    """
    block = files.info.get("arena")
    if block is None:
        return None
    episodes = block.get("episodes") if isinstance(block, dict) else None
    fits = isinstance(episodes, list) and len(episodes) == files.episodes
    if not fits or not all(isinstance(episode, dict) for episode in episodes or ()):
        raise InputError(f"{_info(files)}: arena: episodes are no list of {files.episodes} objects")
    return episodes


def check_alike(sources: Sequence[DatasetFiles]) -> None:
    """Refuse datasets that are not of one kind.

    Raises:
        InputError: Rate, robot type, label protocol, layout or features differ, or an episode is in two of them.
    """
    first = sources[0]
    for other in sources[1:]:
        for name in ("fps", "robot_type", "codebase_version"):
            _same(first, other, name, first.info.get(name), other.info.get(name))
        for name in ("labels", "layout", "schema"):
            blocks = first.info.get("arena"), other.info.get("arena")
            if isinstance(blocks[0], dict) and isinstance(blocks[1], dict):
                _same(first, other, f"arena: {name}", blocks[0].get(name), blocks[1].get(name))
        _same(first, other, "features", sorted(first.features), sorted(other.features))
        for key, feature in first.features.items():
            for name in ("dtype", "shape", "names"):
                _same(first, other, f"features: {key}: {name}", feature.get(name), other.features[key].get(name))
    seen: dict[tuple[str, ...], Path] = {}
    for files in sources:
        for number, episode in enumerate(described(files) or ()):
            own = tuple(str(episode.get(name)) for name in ("task", "tracker", "mode", "episode_seed"))
            if own in seen:
                raise InputError(f"{files.root}: episode {number} ({' '.join(own)}) is in {seen[own]} too")
            seen[own] = files.root


def _same(first: DatasetFiles, other: DatasetFiles, name: str, was: object, now: object) -> None:
    if was != now:
        values = f"{str(now)[:120]}, {first.root} has {str(was)[:120]}"
        raise InputError(f"{_info(other)}: {name} is {values}; datasets of two kinds cannot be one")


def _info(files: DatasetFiles) -> Path:
    return files.root / "meta" / "info.json"


@dataclass
class _Growing:
    """Tables of the dataset so far, and where the next file goes."""

    root: Path
    megabytes: int
    chunk_files: int
    rows: int = 0
    number: int = 0
    waiting: list[pyarrow.Table] = field(default_factory=list)
    """Tables that are not in a file yet."""

    @property
    def position(self) -> tuple[int, int]:
        """Chunk and file of the next table."""
        return divmod(self.number, self.chunk_files)

    def add(self, table: pyarrow.Table) -> tuple[int, int]:
        """Take a table; returns chunk and file that it will be in."""
        if self.waiting and sum(one.nbytes for one in self.waiting) + table.nbytes > self.megabytes * MIB:
            self.flush()
        self.waiting.append(table)
        self.rows += table.num_rows
        return self.position

    def flush(self) -> None:
        if self.waiting:
            chunk, number = self.position
            _write_table(self.root / DATA_PATH.format(chunk_index=chunk, file_index=number), *self.waiting)
            self.waiting, self.number = [], self.number + 1


class _Pictures:
    """The videos of one feature: packets of episodes, one after the other, in files of some size."""

    def __init__(self, root: Path, key: str, fps: int, megabytes: int, chunk_files: int):
        self.root, self.key, self.fps, self.bytes = root, key, fps, megabytes * MIB
        self.chunk_files, self.number = chunk_files, -1
        self.frames = self.size = 0
        self._out: av.container.OutputContainer | None = None
        self._stream: av.VideoStream | None = None
        self._kind: tuple[object, ...] = ()

    def add(self, part: VideoPart) -> dict[str, object]:
        """Append the frames of an episode; returns what its row says of them.

        Raises:
            InputError: They are not there, or cannot be taken out without a second encoding.
        """
        where = f"{part.path}: frames {part.first} to {part.first + part.frames - 1}"
        try:
            with av.open(str(part.path)) as source:
                stream = source.streams.video[0]
                context = stream.codec_context
                if context is None:
                    raise InputError(f"{where}: its codec is unknown")
                packets = self._packets(source, stream, part, where)
                own = _parameter_sets(packets, context.extradata or b"") if context.name == "h264" else None
                kind = (context.name, context.width, context.height, context.extradata, stream.time_base, own)
                size = sum(packet.size for packet in packets)
                if self._out is None or kind != self._kind or self.size + size > self.bytes:
                    self._begin(stream, kind)
                shift = round((self.frames - part.first) / self.fps / (stream.time_base or 1))
                for packet in packets:
                    packet.pts = (packet.pts or 0) + shift
                    packet.dts = None if packet.dts is None else packet.dts + shift
                    packet.stream = self._stream  # type: ignore[assignment]  # was opened
                    self._out.mux(packet)  # type: ignore[union-attr]
        except (av.error.FFmpegError, IndexError, ValueError, TypeError) as error:
            raise InputError(f"{where}: cannot be copied ({type(error).__name__}: {error})") from error
        chunk, number = divmod(self.number, self.chunk_files)
        first, self.frames, self.size = self.frames, self.frames + part.frames, self.size + size
        facts: dict[str, object] = {"chunk_index": chunk, "file_index": number}
        facts |= {"from_timestamp": first / self.fps, "to_timestamp": self.frames / self.fps}
        return {f"videos/{self.key}/{name}": value for name, value in facts.items()}

    def _packets(
        self, source: av.container.InputContainer, stream: av.VideoStream, part: VideoPart, where: str
    ) -> list[av.Packet]:
        """Packets of some frames, in the order of the file."""
        base = stream.time_base
        if base is None:
            raise InputError(f"{where}: the video has no clock")
        source.seek(max(0, round((part.first + 0.5) / self.fps / base)), stream=stream, backward=True)
        found: dict[int, av.Packet] = {}
        end = part.first + part.frames
        for packet in source.demux(stream):
            if packet.pts is None or not packet.size:
                continue
            frame = round(packet.pts * base * self.fps)
            if part.first <= frame < end:
                found[frame] = packet
            elif packet.dts is not None and packet.dts * base * self.fps >= end + self.fps:
                break
        if len(found) != part.frames:
            raise InputError(f"{where}: only {len(found)} of them are there")
        packets = list(found.values())
        if not packets[0].is_keyframe or packets[0] is not found[part.first]:
            raise InputError(f"{where}: do not begin with a key frame, so they cannot be taken out as they are")
        return packets

    def _begin(self, template: av.VideoStream, kind: tuple[object, ...]) -> None:
        """Open the next file."""
        self.close()
        self.number += 1
        self.frames = self.size = 0
        chunk, number = divmod(self.number, self.chunk_files)
        path = self.root / VIDEO_PATH.format(video_key=self.key, chunk_index=chunk, file_index=number)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._out = av.open(str(path), mode="w", format="mp4", options={"movflags": "+faststart"})
        self._stream = self._out.add_stream_from_template(template, opaque=True)
        self._stream.time_base = template.time_base
        self._kind = kind

    def close(self) -> None:
        if self._out is not None:
            self._out.close()
        self._out = None


def _parameter_sets(packets: Sequence[av.Packet], extradata: bytes) -> frozenset[bytes]:
    """H.264 parameter sets among the pictures that the file's head lacks: what follows them is decoded by them."""
    found = set()
    for packet in packets:
        data, at = bytes(packet) if packet.is_keyframe else b"", 0
        while at + 5 <= len(data):
            end = at + 4 + int.from_bytes(data[at : at + 4], "big")
            if data[at + 4] & 31 in (7, 8) and data[at + 4 : end] not in extradata:
                found.add(data[at + 4 : end])
            at = end
    return frozenset(found)


def write_selection(selections: Sequence[Selection], root: Path) -> None:
    """Write a dataset of some episodes, in the order given.

    Args:
        selections: Which ones; of datasets that `check_alike` accepts.
        root: Empty folder.

    Raises:
        InputError: A source is damaged; the message names file and episode.
        OSError: The dataset cannot be written.
    """
    first = selections[0].files
    info = dict(first.info)
    chunk = _size(info, "chunks_size", 1000)
    data = _Growing(root, _size(info, "data_files_size_in_mb", DATA_MB), chunk)
    keys, video_mb = first.video_keys, _size(info, "video_files_size_in_mb", VIDEO_MB)
    videos = {key: _Pictures(root, key, first.fps, video_mb, chunk) for key in keys}
    tasks: dict[str, int] = {}
    rows: list[dict[str, object]] = []
    av.logging.set_libav_level(av.logging.FATAL)  # what fails is raised, and named
    bar = tqdm(total=sum(len(s.episodes) for s in selections), unit="episode", disable=None, dynamic_ncols=True)
    try:
        with bar:
            for selection in selections:
                tables: dict[Path, pyarrow.Table] = {}
                for episode in selection.episodes:
                    row = selection.files.episode_rows[episode]
                    if row.data not in tables:
                        tables = {row.data: selection.files.table(row.data)}  # one at a time in memory
                    table = _episode_table(selection.files, row, tables[row.data])
                    table, values = _numbered(selection.files, row, table, len(rows), data.rows, tasks)
                    values["dataset_from_index"], values["dataset_to_index"] = data.rows, data.rows + table.num_rows
                    values["data/chunk_index"], values["data/file_index"] = data.add(table)
                    values |= dict.fromkeys(values.keys() & OWN_FILE, 0)
                    for key, pictures in videos.items():
                        values |= pictures.add(selection.files.video(row, key))
                    rows.append(values)
                    bar.update()
        data.flush()
    finally:
        for pictures in videos.values():
            pictures.close()
        av.logging.set_libav_level(av.logging.INFO)
    _write_meta(selections, root, info, rows, list(tasks), data.rows)
    films: list[tuple[Looks, Path] | None] = []
    for selection in selections:
        known = dataset_looks(selection.files.root, selection.files.episodes)
        chosen = (known[number] for number in selection.episodes)
        films += [None if film is None else (film.looks, film.path) for film in chosen]
    write_looks(root, films)


def _size(info: Mapping[str, object], name: str, default: int) -> int:
    value = info.get(name, default)
    return value if isinstance(value, int) and 1 <= value < 2**20 else default


def _episode_table(files: DatasetFiles, row: EpisodeRow, table: pyarrow.Table) -> pyarrow.Table:
    """The rows of an episode."""
    where = f"{row.data}: episode {row.index}"
    for name in (*NUMBERED, "frame_index"):
        if name not in table.column_names:
            raise InputError(f"{row.data}: has no column {name}")
    try:
        mine = table.filter(pyarrow.compute.equal(table["episode_index"], row.index))
        frames = mine["frame_index"].to_numpy()
    except pyarrow.ArrowException as error:
        raise InputError(f"{where}: cannot be read ({type(error).__name__})") from error
    if not np.array_equal(frames, np.arange(row.length)):
        raise InputError(f"{where}: frame_index is not 0 to {row.length - 1} in {len(frames)} rows")
    return mine


def _numbered(
    files: DatasetFiles, row: EpisodeRow, table: pyarrow.Table, number: int, first: int, tasks: dict[str, int]
) -> tuple[pyarrow.Table, dict[str, object]]:
    """An episode's table and row under their new numbers."""
    old = table["task_index"].to_numpy()
    if not (len(old) and 0 <= old.min() and old.max() < len(files.tasks)):
        raise InputError(f"{row.data}: episode {row.index}: task_index is not in {files.root / 'meta/tasks.parquet'}")
    known = {int(one): tasks.setdefault(files.tasks[one], len(tasks)) for one in dict.fromkeys(old.tolist())}
    count = table.num_rows
    columns = {
        "episode_index": np.full(count, number),
        "index": np.arange(first, first + count),
        "task_index": np.array([known[int(one)] for one in old]),
    }
    values = dict(row.values) | {"episode_index": number}
    for name, column in columns.items():
        at = table.column_names.index(name)
        table = table.set_column(at, table.schema.field(at), pyarrow.array(column, table.schema.field(at).type))
        for statistic, value in row_statistics(column).items():
            if f"stats/{name}/{statistic}" in values:
                values[f"stats/{name}/{statistic}"] = value.tolist()
    return table, values


def _write_meta(
    selections: Sequence[Selection],
    root: Path,
    info: dict[str, object],
    rows: Sequence[dict[str, object]],
    tasks: Sequence[str],
    count: int,
) -> None:
    """Everything below `meta`."""
    first, meta = selections[0].files, root / "meta"
    (meta / "episodes" / "chunk-000").mkdir(parents=True)
    folder = first.root / "meta" / "episodes"
    schema = pyarrow.parquet.read_schema(sorted(folder.glob("chunk-*/file-*.parquet"))[0])
    for row in rows:
        if set(row) != set(schema.names):
            odd = sorted(set(row) ^ set(schema.names))[0]
            raise InputError(f"{folder}: column {odd} is not in every dataset's table of episodes")
    try:
        table = pyarrow.Table.from_pylist(list(rows), schema=schema)
    except (pyarrow.ArrowException, ValueError, TypeError) as error:
        raise InputError(f"{folder}: tables of two kinds ({error})") from error
    _write_table(meta / "episodes" / "chunk-000" / "file-000.parquet", table)
    source = pyarrow.parquet.read_table(first.root / "meta" / "tasks.parquet")
    named = {"task_index": pyarrow.array(range(len(tasks)), pyarrow.int64())}
    words = {name: named.get(name, pyarrow.array(tasks, pyarrow.string())) for name in source.column_names}
    written = pyarrow.table(words)
    if source.schema.metadata and len(source) == len(tasks):
        written = written.replace_schema_metadata(source.schema.metadata)
    elif source.schema.metadata:
        written = written.replace_schema_metadata(_pandas(source.schema.metadata, len(tasks)))
    _write_table(meta / "tasks.parquet", written)
    write_json(meta / "stats.json", _statistics(first, rows), sort=True)
    features = {key: dict(feature) for key, feature in first.features.items()}
    for key, feature in features.items():
        known = [s.files.features[key].get("info") for s in selections]
        if isinstance(known[0], dict):
            same = {n: v for n, v in known[0].items() if all(isinstance(k, dict) and k.get(n) == v for k in known)}
            feature["info"] = same
    info |= {"total_episodes": len(rows), "total_frames": count, "total_tasks": len(tasks), "features": features}
    info["splits"] = {"train": f"0:{len(rows)}"}
    for name, block in (("vla_protocol", _protocol(selections)), ("arena", _arena(selections))):
        info.pop(name, None)
        if block is not None:
            info[name] = block
    write_json(meta / "info.json", info)
    modalities = [s.files.root / MODALITY for s in selections]
    if all(path.is_file() for path in modalities) and len({json.dumps(read_json(path)) for path in modalities}) == 1:
        shutil.copyfile(modalities[0], root / MODALITY)


def _pandas(metadata: Mapping[bytes, bytes], count: int) -> dict[bytes, bytes]:
    """Notes of pandas in a table of tasks, for another number of rows."""
    notes = dict(metadata)
    try:
        about = json.loads(notes[b"pandas"])
        for index in about["index_columns"]:
            if isinstance(index, dict) and index.get("kind") == "range":
                index["stop"] = count
        notes[b"pandas"] = json.dumps(about).encode()
    except (KeyError, ValueError, TypeError):
        notes.pop(b"pandas", None)
    return notes


def _statistics(first: DatasetFiles, rows: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """`stats.json` from the episodes' statistics."""
    found: dict[str, object] = {}
    for key, feature in first.features.items():
        prefix = f"stats/{key}/"
        names = [name.removeprefix(prefix) for name in rows[0] if name.startswith(prefix)]
        if not names:
            continue
        try:
            parts = [{name: np.asarray(row[prefix + name], np.float64) for name in names} for row in rows]
            joined = aggregated(parts)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{first.root}: statistics of {key} are unfit ({type(error).__name__})") from error
        columns = feature.get("names")
        for number, column in enumerate(columns if isinstance(columns, list) else ()):
            if str(column).startswith(HAND_NAME):
                for name in set(joined) & {"q01", "q10", "q90", "q99"}:
                    joined[name][number] = round(joined[name][number])  # averages of zeros and ones
        found[key] = {name: value.tolist() for name, value in joined.items()}
    return found


def _protocol(selections: Sequence[Selection]) -> dict[str, object] | None:
    """`vla_protocol` as far as all agree; sources of the actions are listed."""
    blocks = [s.files.info.get("vla_protocol") for s in selections]
    if not all(isinstance(block, dict) for block in blocks):
        return None
    known = [block for block in blocks if isinstance(block, dict)]
    same: dict[str, object] = {
        name: value for name, value in known[0].items() if all(block.get(name) == value for block in known)
    }
    backends = [part for block in known for part in str(block.get("backend_source", "")).split("+") if part]
    if backends:
        same["backend_source"] = "+".join(dict.fromkeys(backends))
    for key in (f"{name}_reference_source" for name in REFERENCE_SOURCES):
        if any(key in block for block in known):  # a set of another tracker names none
            sources = [part for block in known for part in str(block.get(key) or "").split("+") if part]
            same[key] = "+".join(dict.fromkeys(sources)) or None
    return same


def _arena(selections: Sequence[Selection]) -> dict[str, object] | None:
    """Block `arena` of the chosen episodes; None where one dataset has none."""
    episodes: list[dict[str, object]] = []
    configurations: dict[str, object] = {}
    versions: dict[str, set[str]] = {}
    for selection in selections:
        listed, block = described(selection.files), selection.files.info.get("arena")
        if listed is None or not isinstance(block, dict):
            return None
        chosen = [listed[number] for number in selection.episodes]
        known = block.get("configurations")
        for episode in chosen:
            code = episode.get("configuration")
            if isinstance(known, dict) and code in known:
                configurations[str(code)] = known[code]
        for name, version in block["versions"].items() if isinstance(block.get("versions"), dict) else ():
            versions.setdefault(name, set()).update([] if version is None else [str(version)])
        episodes += chosen
    block = selections[0].files.info["arena"]
    assert isinstance(block, dict)
    lists = {"seed_ranges": "seed_range", "trackers": "tracker", "policies": "policy"}
    changed = {many: sorted({str(episode.get(one)) for episode in episodes}) for many, one in lists.items()}
    return {
        **block,
        **changed,
        "versions": {name: ", ".join(sorted(found)) or None for name, found in versions.items()},
        "configurations": dict(sorted(configurations.items())),
        "episodes": episodes,
    }


def _write_table(path: Path, *tables: pyarrow.Table) -> None:
    """Write tables of one schema as a file, each as a group of its own, as LeRobot does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        replace_atomically(path) as file,
        pyarrow.parquet.ParquetWriter(file, tables[0].schema, compression="snappy", use_dictionary=True) as writer,
    ):
        for table in tables:
            writer.write_table(table.cast(tables[0].schema))


def content(files: DatasetFiles, row: EpisodeRow) -> bytes:
    """The actions of an episode as bytes, by which one without a seed is known."""
    columns = files.columns(row.data, ("episode_index", "action"))
    return np.ascontiguousarray(columns["action"][columns["episode_index"] == row.index]).tobytes()
