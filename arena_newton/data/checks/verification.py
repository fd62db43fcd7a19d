"""``data verify``: checks a LeRobot v3.0 dataset number by number and frame by frame, and names the first mismatch.

States and actions are rebuilt from the raw fields of the recordings (measured joints, root orientation, heading, the
action that was decided), not copied from those that `build` used.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from arena_newton import tasks
from arena_newton.data.checks.video_checks import CameraVideos, DatasetMismatch, check_videos
from arena_newton.data.datasets.look_films import file_hash
from arena_newton.data.datasets.row_statistics import aggregated, quantile_name, row_statistics
from arena_newton.data.readers.dataset_files import DatasetFiles, EpisodeRow, read_json
from arena_newton.data.readers.label_protocols import encode_v4
from arena_newton.data.readers.looks import LOOKS_FOLDER, dataset_looks
from arena_newton.data.recording.episode import EpisodeFile, episode_files, opened, vision
from arena_newton.data.recording.image_statistics import QUANTILES, VALUES, statistics
from arena_newton.data.recording.layouts import (
    FPS,
    LAYOUTS,
    Column,
    Layout,
    described_protocol,
    described_slots,
    modality,
)
from arena_newton.data.recording.source_videos import SourceVideo, check_film, source_looks
from arena_newton.errors import InputError
from arena_newton.files.text import counted
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, STATE, STATE_WIDTH

if TYPE_CHECKING:
    from arena_newton.data.datasets.data_options import VerifyOptions

__all__ = ["TOLERANCE", "rebuilt_state", "verify"]

TOLERANCE = 1e-5
"""Largest difference of a state or an action from what the recording gives (the original's verifier)."""
STATISTICS_TOLERANCE = 1e-6
"""Largest difference of a statistic, relative to 1 and to its size."""
FOREIGN_TOLERANCE = 0.02
"""The same for datasets that LeRobot itself or another tool wrote, relative to the range of the numbers: LeRobot's
statistics are made in single precision."""
MOST_JOBS = 256
"""Most threads: each keeps a decoder and up to 12 compared pictures in memory."""
COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Columns that LeRobot adds."""
MOMENTS = ("min", "max", "mean", "std", "count")


@dataclass(frozen=True)
class _Subject:
    """A dataset and what it claims to be."""

    files: DatasetFiles
    kind: Layout
    labels: str
    arena: Mapping[str, object] | None
    """Block `arena` of `info.json`; other tools write none."""

    @property
    def info(self) -> Path:
        return self.files.root / "meta" / "info.json"

    @property
    def columns(self) -> tuple[Column, ...]:
        return self.kind.columns(self.labels)

    def origin(self, index: int) -> Mapping[str, object]:
        """Entry of an episode in the block `arena`."""
        episodes = self.arena.get("episodes") if self.arena else None
        found = episodes[index] if isinstance(episodes, list) and index < len(episodes) else {}
        return found if isinstance(found, dict) else {}


def verify(folders: Sequence[Path], options: VerifyOptions) -> int:
    """Check a dataset and say what was checked.

    Returns:
        Exit code 0.

    Raises:
        InputError: The folder is no dataset, or its recordings cannot be read.
        DatasetMismatch: The first mismatch.
    """
    if len(folders) != 1:
        raise InputError(f"verify: name one dataset, not {len(folders)}")
    if not 0 <= options.jobs <= MOST_JOBS:
        raise InputError(f"--jobs {options.jobs}: expected 0 to {MOST_JOBS}")
    files = DatasetFiles(folders[0])
    recorded = list(opened(episode_files(options.recordings))) if options.recordings else []
    jobs = options.jobs or len(os.sched_getaffinity(0))
    try:
        lines = _verified(files, recorded, jobs)
    except InputError as error:
        if any(str(error).startswith(str(folder)) for folder in options.recordings):
            raise
        raise DatasetMismatch(files.root, str(error)) from error
    print("\n".join(lines))
    return 0


def _verified(files: DatasetFiles, recorded: Sequence[EpisodeFile], jobs: int) -> list[str]:
    """Check all of it.

    Returns:
        Lines for whoever asked.
    """
    subject = _subject(files)
    _check_features(subject)
    _check_tasks(subject)
    sources = _sources(subject, recorded)
    stats, means, warnings = _check_rows(subject, sources)
    _check_aggregate(subject, stats)
    cameras = []
    for key in files.video_keys:
        camera = _camera(subject, key)
        videos = {index: episode.video(camera) for index, episode in sources.items() if camera in episode.cameras}
        cameras.append(CameraVideos(key, means[key], videos))
    with tqdm(total=files.frames * len(cameras), unit="frame", desc="verify", disable=None) as bar:

        def progress(decoded: int) -> None:
            bar.update(decoded - bar.n)

        total = check_videos(files, cameras, jobs=jobs, progress=progress)
    _check_looks(subject, sources)
    against = f"equal to {counted(len(sources), 'recorded episode')}" if sources else (
        "not compared with recordings (--recordings names them)"
    )  # fmt: skip
    what = f"{counted(files.episodes, 'episode')}, {files.frames} rows, {counted(total, 'decoded frame')}"
    return [*warnings, f"{files.root}: {what}: sound, {against}"]


def _check_looks(subject: _Subject, sources: Mapping[int, EpisodeFile]) -> None:
    """Films of looks: their content by hash, size and number of frames, and against the recording's."""
    files = subject.files
    shape = files.features.get(subject.kind.image_key("front"), {}).get("shape")
    if not isinstance(shape, list):
        return
    for row, film in zip(files.episode_rows, dataset_looks(files.root, files.episodes), strict=True):
        recorded = source_looks(sources[row.index]) if row.index in sources else None
        own = None if film is None else (film.looks, film.sha256)
        if row.index in sources and own != (None if recorded is None else (recorded[0], file_hash(recorded[1]))):
            path = sources[row.index].path
            raise DatasetMismatch(files.root / LOOKS_FOLDER, f"are not the looks of {path}", episode=row.index)
        if film is None:
            continue
        if film.sha256 != file_hash(film.path):
            raise DatasetMismatch(film.path, "is not the film of looks.json (another sha256)", episode=row.index)
        frames, fps = film.looks.frames(row.length), files.fps / film.looks.stride
        video = SourceVideo(film.path, shape[1], shape[0], fps, {"vcodec": "h264"}, np.zeros(0, np.int64))
        check_film(video, frames, f"{row.length} rows have {frames}")


def _subject(files: DatasetFiles) -> _Subject:
    """Layout and labels of a dataset."""
    info = files.root / "meta" / "info.json"
    given, arena = files.info.get("robot_type"), files.info.get("arena")
    if arena is not None and not isinstance(arena, dict):
        raise DatasetMismatch(info, "arena is no table")
    every = [(kind, labels) for kind in LAYOUTS.values() for labels in kind.labels]
    fitting = [(kind, labels) for kind, labels in every if kind.robot_type(labels) == given]
    if not fitting:
        known = ", ".join(kind.robot_type(labels) for kind, labels in every)
        raise DatasetMismatch(info, f"robot_type is {str(given)[:80]!r}, known are {known}")
    kind, labels = fitting[0]
    if arena is not None and (arena.get("layout"), arena.get("labels")) != (kind.name, labels):
        named = f"{arena.get('layout')} {arena.get('labels')}"
        raise DatasetMismatch(info, f"robot_type {given} is layout {kind.name} {labels}, arena says {named[:80]}")
    return _Subject(files, kind, labels, arena)


def _camera(subject: _Subject, key: str) -> str:
    """Camera of a feature, as episodes name it."""
    return next(camera for camera in subject.kind.cameras if subject.kind.image_key(camera) == key)


def _check_features(subject: _Subject) -> None:
    """Names, types, widths; the blocks that say what they mean."""
    files = subject.files
    columns = {column.key: column for column in subject.columns}
    cameras = [camera for camera in subject.kind.cameras if subject.kind.image_key(camera) in files.features]
    expected = {*columns, *COUNTERS, *(subject.kind.image_key(camera) for camera in cameras)}
    for key in sorted(set(files.features) ^ expected):
        verb = "is unknown to this layout" if key in files.features else "is missing"
        raise DatasetMismatch(subject.info, f"feature {key} {verb}")
    for key, column in columns.items():
        feature = files.features[key]
        if (feature.get("dtype"), feature.get("shape")) != (column.dtype, [len(column.names)]):
            about = f"{feature.get('dtype')} {feature.get('shape')}"
            raise DatasetMismatch(
                subject.info, f"feature {key} is {about[:80]}, expected {column.dtype} [{len(column.names)}]"
            )
        names = feature.get("names")
        if names != list(column.names):
            given = names if isinstance(names, list) else []
            at = next((n for n, name in enumerate(column.names) if n >= len(given) or given[n] != name), len(given) - 1)
            shown = given[at] if at < len(given) else None
            wanted = column.names[at] if at < len(column.names) else "no more"
            raise DatasetMismatch(subject.info, f"feature {key}: name {at} is {str(shown)[:80]!r}, expected {wanted}")
    if files.fps != FPS:
        raise DatasetMismatch(subject.info, f"fps is {files.fps}, expected {FPS}")
    chunk = files.info.get("chunks_size")
    if not isinstance(chunk, int) or isinstance(chunk, bool) or chunk < 1:
        raise DatasetMismatch(subject.info, f"chunks_size is {chunk!r:.40}, expected a number of at least 1")
    splits = files.info.get("splits")
    if not isinstance(splits, dict):
        raise DatasetMismatch(subject.info, f"splits is {splits!r:.80}, expected a table")
    for name, part in splits.items():
        ends = re.fullmatch(r"([0-9]{1,12}):([0-9]{1,12})", str(part))
        if ends is None or not int(ends[1]) <= int(ends[2]) <= files.episodes:
            raise DatasetMismatch(
                subject.info, f"splits: {name[:40]} is {part!r:.60}, expected a range of its {files.episodes} episodes"
            )
    protocol = files.info.get("vla_protocol")
    if subject.kind.name == "arena" and (subject.arena is not None or protocol is not None):
        declared = protocol if isinstance(protocol, dict) else {}
        wanted_protocol = described_protocol(subject.labels, str(declared.get("backend_source", "")).split("+"))
        keys = list(wanted_protocol) if subject.arena is not None else ["version"]
        for name in keys:
            if declared.get(name) != wanted_protocol[name]:
                shown = f"is {str(declared.get(name))[:80]!r}, expected {wanted_protocol[name]!r}"
                raise DatasetMismatch(subject.info, f"vla_protocol: {name} {shown}")
    if subject.arena is not None:
        if subject.kind.name == "arena" and subject.arena.get("slots") != described_slots(subject.labels):
            raise DatasetMismatch(subject.info, "arena: slots are not those of state and action")
        path = files.root / "meta" / "modality.json"
        if read_json(path) != modality(subject.kind, subject.labels, tuple(cameras)):
            raise DatasetMismatch(path, "does not name the features' slices")
        _check_origin(subject)


def _check_origin(subject: _Subject) -> None:
    """Check the list of episodes in block `arena`, and its lists of what they have in common."""
    assert subject.arena is not None
    episodes = subject.arena.get("episodes")
    number = len(episodes) if isinstance(episodes, list) else 0
    if number != subject.files.episodes:
        raise DatasetMismatch(subject.info, f"arena: names {number} episodes of {subject.files.episodes}")
    for plural, name in (("seed_ranges", "seed_range"), ("trackers", "tracker"), ("policies", "policy")):
        found = sorted({str(subject.origin(index).get(name)) for index in range(number)})
        if subject.arena.get(plural) != found:
            raise DatasetMismatch(
                subject.info, f"arena: {plural} is {subject.arena.get(plural)}, episodes have {found}"
            )


def _check_tasks(subject: _Subject) -> None:
    """Every episode has one instruction: that of its task."""
    files = subject.files
    known = {spec.instruction: spec.name for spec in tasks.specs()}
    for row in files.episode_rows:
        if len(row.tasks) != 1:
            raise DatasetMismatch(_meta(files), f"has {len(row.tasks)} instructions, expected 1", episode=row.index)
        words = row.tasks[0]
        task = subject.origin(row.index).get("task")
        expected = tasks.get(str(task)).instruction if task in tasks.names() else None
        if expected is not None and words != expected:
            message = f"instruction is {words[:120]!r}, that of {task} is {expected!r}"
            raise DatasetMismatch(_meta(files), message, episode=row.index)
        if task is None and words not in known:
            raise DatasetMismatch(_meta(files), f"no task has the instruction {words[:120]!r}", episode=row.index)


def _meta(files: DatasetFiles) -> Path:
    return files.root / "meta" / "episodes"


def _sources(subject: _Subject, recorded: Sequence[EpisodeFile]) -> dict[int, EpisodeFile]:
    """Recorded episode of each episode of the dataset.

    Raises:
        DatasetMismatch: One is not among the recordings, or is another file now.
    """
    if not recorded:
        return {}
    files = subject.files
    if subject.arena is None:
        if len(recorded) != files.episodes:
            message = f"{files.episodes} episodes, the recordings are {len(recorded)}, and nothing says which is which"
            raise DatasetMismatch(files.root, message)
        return dict(enumerate(recorded))
    by_name: dict[str, list[EpisodeFile]] = {}
    for episode in recorded:
        by_name.setdefault(episode.stem, []).append(episode)
    found = {}
    for index in range(files.episodes):
        origin = subject.origin(index)
        candidates = by_name.get(str(origin.get("source")), [])
        if not candidates:
            message = f"arena: its recording {str(origin.get('source'))[:200]} is not among --recordings"
            raise DatasetMismatch(subject.info, message, episode=index)
        codes = [hashlib.sha256(candidate.path.read_bytes()).hexdigest() for candidate in candidates]
        if origin.get("sha256") not in codes:
            message = f"arena: {candidates[0].path} is not the file that it was built from (another sha256)"
            raise DatasetMismatch(subject.info, message, episode=index)
        episode = found[index] = candidates[codes.index(str(origin["sha256"]))]
        for name, value in origin.items():
            if f"arena_{name}" in episode and name != "configuration":
                stored = episode.array(f"arena_{name}").item()
                if stored != value:
                    raise DatasetMismatch(subject.info, f"arena: {name} is {value}, recorded {stored}", episode=index)
    return found


def _check_rows(
    subject: _Subject, sources: Mapping[int, EpisodeFile]
) -> tuple[dict[str, list[dict[str, np.ndarray]]], dict[str, list[np.ndarray]], list[str]]:
    """Every row of every table.

    Returns:
        Statistics of each feature by episode, means of each camera's pictures by episode, warnings.
    """
    files = subject.files
    names = [*(column.key for column in subject.columns), *COUNTERS]
    stats: dict[str, list[dict[str, np.ndarray]]] = {key: [] for key in (*names, *files.video_keys)}
    still = {"left": True, "right": True}
    first, path, table, begin = 0, None, {}, 0
    for row in tqdm(files.episode_rows, unit="episode", desc="verify rows", disable=None):
        if row.first != first:
            raise DatasetMismatch(_meta(files), f"begins at row {row.first}, expected {first}", episode=row.index)
        if row.data != path:
            _check_end(path, table, begin, row.index)
            path, begin = row.data, 0
            table = files.columns(row.data, names)
        rows = {name: column[begin : begin + row.length] for name, column in table.items()}
        if len(rows["index"]) != row.length:
            message = f"has {len(rows['index'])} rows of it, expected {row.length}"
            raise DatasetMismatch(row.data, message, episode=row.index)
        _check_counters(files, row, rows)
        _check_columns(subject, row, rows)
        if row.index in sources:
            _check_against(subject, row, rows, sources[row.index])
        for key in names:
            stats[key].append(_check_statistics(subject, row, key, rows[key]))
        for key in files.video_keys:
            stats[key].append(_check_pictures(subject, row, key, sources.get(row.index)))
        if subject.kind.name == "arena":
            hands = rows["action"][:, ACTION["hands"]]
            for number, side in enumerate(still):
                still[side] &= bool((hands[:, number] == hands[0, number]).all())
        first, begin = first + row.length, begin + row.length
    _check_end(path, table, begin, files.episodes)
    if first != files.frames:
        raise DatasetMismatch(subject.info, f"total_frames is {files.frames}, the episodes have {first} rows")
    warnings = [
        f"warning: the {side} hand never moves within an episode; its action carries no information"
        for side, constant in still.items()
        if constant and subject.kind.name == "arena"
    ]
    means = {key: [about["mean"] for about in stats[key]] for key in files.video_keys}
    return stats, means, warnings


def _check_end(path: Path | None, table: Mapping[str, np.ndarray], rows: int, episode: int) -> None:
    """A file holds the rows of its episodes and no others."""
    if path is not None and len(table["index"]) != rows:
        message = f"has {len(table['index'])} rows, its episodes have {rows}"
        raise DatasetMismatch(path, message, episode=episode - 1)


def _check_counters(files: DatasetFiles, row: EpisodeRow, rows: Mapping[str, np.ndarray]) -> None:
    """Numbers of row, episode and task, and the time."""
    number = np.arange(row.length)
    if row.tasks[0] not in files.tasks:
        raise DatasetMismatch(files.root / "meta" / "tasks.parquet", f"lacks {row.tasks[0]!r}", episode=row.index)
    expected = {
        "frame_index": number,
        "episode_index": np.full(row.length, row.index),
        "index": row.first + number,
        "task_index": np.full(row.length, files.tasks.index(row.tasks[0])),
        "timestamp": (number / files.fps).astype(np.float32),
    }
    for name, values in expected.items():
        wrong = np.flatnonzero(rows[name].reshape(-1) != values)
        if len(wrong):
            at = int(wrong[0])
            message = f"{name} is {rows[name].reshape(-1)[at]}, expected {values[at]}"
            raise DatasetMismatch(row.data, message, episode=row.index, row=at)


def _check_columns(subject: _Subject, row: EpisodeRow, rows: Mapping[str, np.ndarray]) -> None:
    """Widths, and numbers that are numbers."""
    for column in subject.columns:
        values = rows[column.key]
        if values.shape[1:] != (len(column.names),):
            message = f"{column.key} has shape {list(values.shape)}, expected width {len(column.names)}"
            raise DatasetMismatch(row.data, message, episode=row.index)
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            at, number = (int(n) for n in bad[0])
            message = f"{column.names[number]} is {values[at, number]}"
            raise DatasetMismatch(row.data, message, episode=row.index, row=at)


def rebuilt_state(episode: EpisodeFile) -> np.ndarray:
    """Canonical state from measured joints, root orientation and initial heading, float64, shape [T, 64]."""
    order = list(g1.CANONICAL_TO_MUJOCO)
    quat = episode.array("robot_root_orientation", episode.rows, 4).astype(np.float64)
    w, x, y, z = (quat / np.linalg.norm(quat, axis=1, keepdims=True)).T
    columns = np.empty((episode.rows, 3, 2))
    columns[:, :, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    columns[:, :, 1] = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    heading = float(episode.array("arena_initial_heading"))
    cosine, sine = np.cos(heading), np.sin(heading)
    back = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    state = np.empty((episode.rows, STATE_WIDTH))
    state[:, STATE["root_rot6d"]] = (back @ columns).reshape(-1, 6)
    for part, name in (("joint_pos", "robot_qpos_before_decimation"), ("joint_vel", "robot_qvel_before_decimation")):
        state[:, STATE[part]] = episode.array(name, episode.rows, len(order))[:, order]
    return state


def _check_against(subject: _Subject, row: EpisodeRow, rows: Mapping[str, np.ndarray], recorded: EpisodeFile) -> None:
    """States and actions against the recording."""
    episode = EpisodeFile(recorded.path)  # whose arrays are not kept
    if episode.rows != row.length:
        message = f"{row.length} rows, {episode.path} has {episode.rows}"
        raise DatasetMismatch(row.data, message, episode=row.index)
    if episode.text("arena_instruction") != row.tasks[0]:
        raise DatasetMismatch(_meta(subject.files), f"instruction is {row.tasks[0][:120]!r}", episode=row.index)
    if subject.kind.name == "arena":
        action = episode.action
        wanted = {
            "observation.state": rebuilt_state(episode),
            "action": encode_v4(action) if subject.labels == "v4" else action,
        }
    else:
        wanted = subject.kind.rows(episode, subject.labels)
    for column in subject.columns:
        given = rows[column.key].astype(np.float64)
        wrong = np.argwhere(np.abs(given - wanted[column.key]) > TOLERANCE)
        if len(wrong):
            at, number = (int(n) for n in wrong[0])
            message = (
                f"{column.names[number]} is {given[at, number]:.7g}, {episode.path.name} gives "
                f"{wanted[column.key][at, number]:.7g}"
            )
            raise DatasetMismatch(row.data, message, episode=row.index, row=at)


def _stored(row: EpisodeRow, key: str, name: str, files: DatasetFiles) -> np.ndarray:
    value = row.values.get(f"stats/{key}/{name}")
    try:
        return np.asarray(value, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise DatasetMismatch(_meta(files), f"stats/{key}/{name} are no numbers", episode=row.index) from None


def _check_statistics(subject: _Subject, row: EpisodeRow, key: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics of an episode's column.

    Returns:
        Those that are stored.
    """
    names = next((column.names for column in subject.columns if column.key == key), (key,))
    expected = row_statistics(values, names)
    stored = {name: _stored(row, key, name, subject.files) for name in expected}
    _compare(subject, _meta(subject.files), f"stats/{key}", expected, stored, names, episode=row.index)
    return stored


def _check_pictures(subject: _Subject, row: EpisodeRow, key: str, episode: EpisodeFile | None) -> dict[str, np.ndarray]:
    """Statistics of an episode's pictures, from the recorded histogram where there is one.

    Returns:
        Those that are stored.
    """
    stored = {name: _stored(row, key, name, subject.files) for name in (*MOMENTS, *map(quantile_name, QUANTILES))}
    channels = [f"{key} channel {number}" for number in range(3)]
    camera = _camera(subject, key)
    for name, values in stored.items():
        if len(values) != (1 if name == "count" else 3) or not np.isfinite(values).all():
            raise DatasetMismatch(_meta(subject.files), f"stats/{key}/{name} is {values}", episode=row.index)
    field = f"arena_{vision(camera, 'histogram')}"
    if episode is not None and field in episode:
        histogram = episode.array(field, 3, VALUES)
        expected = {
            name: value if name == "count" else value / 255.0
            for name, value in statistics(histogram, row.length).items()
        }
        _compare(subject, _meta(subject.files), f"stats/{key}", expected, stored, channels, episode=row.index)
    return stored


def _compare(
    subject: _Subject,
    file: Path,
    where: str,
    expected: Mapping[str, np.ndarray],
    stored: Mapping[str, np.ndarray],
    names: Sequence[str],
    *,
    episode: int | None = None,
) -> None:
    """Statistics against those of the numbers."""
    own = subject.arena is not None
    span = np.maximum(1.0, np.abs(expected["max"] - expected["min"]))
    for name, values in expected.items():
        if not own and name not in MOMENTS:
            continue  # other tools read quantiles from bins
        given, wanted = stored[name].reshape(-1), np.asarray(values, np.float64).reshape(-1)
        if given.shape != wanted.shape:
            raise DatasetMismatch(file, f"{where}/{name} has {len(given)} numbers, not {len(wanted)}", episode=episode)
        allowed = FOREIGN_TOLERANCE * span if not own else STATISTICS_TOLERANCE * np.maximum(1.0, np.abs(wanted))
        wrong = np.flatnonzero(~(np.abs(given - wanted) <= (0.0 if name == "count" else allowed)))
        if len(wrong):
            at = int(wrong[0])
            column = names[at] if at < len(names) else str(at)
            message = f"{where}/{name}: {column} is {given[at]:.9g}, the numbers give {wanted[at]:.9g}"
            raise DatasetMismatch(file, message, episode=episode)


def _check_aggregate(subject: _Subject, stats: Mapping[str, Sequence[Mapping[str, np.ndarray]]]) -> None:
    """`meta/stats.json` against the episodes' statistics."""
    path = subject.files.root / "meta" / "stats.json"
    content = read_json(path)
    if set(content) != set(stats):
        key = sorted(set(content) ^ set(stats))[0]
        raise DatasetMismatch(path, f"{key[:80]} is {'missing' if key in stats else 'no feature'}")
    for key, parts in stats.items():
        about = content[key]
        expected = aggregated(parts)
        stored = {}
        for name in expected:
            value = about.get(name) if isinstance(about, dict) else None
            try:
                stored[name] = np.asarray(value, dtype=np.float64).reshape(-1)
            except (TypeError, ValueError):
                raise DatasetMismatch(path, f"{key}/{name} are no numbers") from None
        names = next((column.names for column in subject.columns if column.key == key), (key,) * 3)
        _compare(subject, path, key, expected, stored, names)
