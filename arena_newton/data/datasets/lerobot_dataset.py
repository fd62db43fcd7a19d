"""``data build``: recorded episodes become a LeRobot v3.0 dataset; pictures are handed over as they were encoded.

LeRobot's own writer makes the files. Three of its names, none of them promised, are used so that videos are not encoded
a second time and statistics are exact: the writer's attribute `_streaming_encoder`, and the functions `embed_images`
and `compute_episode_stats` of its module. Another version than `LEROBOT` is refused.

Equal recordings give equal bytes with equal versions of the libraries (`info.json` names them), whatever the order of
the folders, the number of worlds that recorded or the hash seed of the process.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import av
import numpy as np
from lerobot.configs import RGBEncoderConfig
from lerobot.datasets import dataset_writer
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

from arena_newton import __version__
from arena_newton.data.datasets.look_films import write_looks
from arena_newton.data.datasets.row_statistics import row_statistics
from arena_newton.data.readers.dataset_files import read_json
from arena_newton.data.recording.episode import EpisodeFile, episode_files, opened
from arena_newton.data.recording.image_statistics import statistics
from arena_newton.data.recording.layouts import Layout, described_protocol, described_slots, layout, modality
from arena_newton.data.recording.source_videos import SourceVideo, source_looks, source_video
from arena_newton.errors import InputError
from arena_newton.files.new_folder import new_folder
from arena_newton.files.own_files import write_json
from arena_newton.files.text import counted
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.data.datasets.data_options import BuildOptions
    from arena_newton.data.readers.looks import Looks

__all__ = ["LEROBOT", "SCHEMA", "Chosen", "FinishedVideos", "build", "choose", "write_dataset"]

LEROBOT = "0.6.1"
"""Version of LeRobot whose writer this knows."""
SCHEMA = "arena_dataset_v1"
"""Version of the block `arena` of `info.json`."""
LIBRARIES = ("lerobot", "av", "datasets", "numpy", "pandas", "pyarrow")
"""Those that make the bytes of a dataset, besides this package."""
SMALL_HEIGHT = 256
"""Pictures up to this height [px] go into video files of `SMALL_MB`, larger ones into files of `LARGE_MB`."""
SMALL_MB, LARGE_MB = 5, 25
"""Size of a video file [MB]: a reader that opens the file for every picture reads four times as fast from 5 MB as from
80, and LeRobot copies the whole file to append an episode."""
FACTS = tuple(
    f"arena_{word}"
    for word in (
        *("task", "instruction", "tracker", "policy", "mode", "rules", "seed_range", "group_seed", "repeat"),
        *("episode_seed", "outcome", "configuration"),
    )
)
"""Fields of an episode that a dataset names; they are read at once."""


@dataclass(frozen=True)
class Chosen:
    """Episodes of a dataset, in its order, and what they have in common."""

    episodes: tuple[EpisodeFile, ...]
    videos: tuple[Mapping[str, SourceVideo], ...]
    """Videos of each episode by camera, the cameras in the dataset's order."""
    fps: int
    left_out: int
    """Episodes that did not succeed."""
    looks: tuple[tuple[Looks, Path] | None, ...] = ()
    """Looks of each episode's head camera and their film."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras as episodes name them."""
        return tuple(self.videos[0])

    @property
    def rows(self) -> int:
        """Rows of all episodes."""
        return sum(episode.rows for episode in self.episodes)


class FinishedVideos:
    """Stands where LeRobot's encoder of streamed pictures would, and hands over MP4s that are finished."""

    def __init__(self, folder: Path):
        """Copies are made in `folder`: LeRobot moves a video and deletes the folder that it was in."""
        self._folder = folder
        self._videos: dict[str, tuple[Path, dict[str, np.ndarray]]] = {}

    def hand_over(self, videos: Mapping[str, tuple[Path, dict[str, np.ndarray]]]) -> None:
        """Videos of the next episode: feature → MP4 and statistics of its pictures, per channel on 0 to 255."""
        self._videos = dict(videos)

    def finish_episode(self) -> dict[str, tuple[Path, dict[str, np.ndarray]]]:
        """A copy of each video, and its statistics."""
        found = {}
        for key, (path, about) in self._videos.items():
            own = Path(tempfile.mkdtemp(dir=self._folder))
            found[key] = Path(shutil.copyfile(path, own / path.name)), about
        self._videos = {}
        return found

    def cancel_episode(self) -> None:
        """Nothing is running."""

    def close(self) -> None:
        """Nothing is open."""


def build(folders: Sequence[Path], options: BuildOptions) -> int:
    """Build the dataset of a command line and say what it holds.

    Returns:
        Exit code 0.

    Raises:
        InputError: A folder, an episode or a flag is unfit; the message names it.
        ArenaError: The dataset cannot be written.
    """
    kind = layout(options.layout, options.labels)
    if options.file_mb < 0:
        raise InputError(f"--file-mb {options.file_mb}: expected a size in MB, or 0")
    chosen = choose(
        episode_files(folders),
        cameras=options.cameras,
        only_success=options.only_success,
        allow_evaluation_seeds=options.allow_evaluation_seeds,
    )
    out = options.out.expanduser()
    repo_id = options.repo_id or f"local/{out.resolve().name}"
    write_dataset(chosen, out, kind=kind, labels=options.labels, repo_id=repo_id, file_mb=options.file_mb)
    left = f", {chosen.left_out} without success left out" if chosen.left_out else ""
    cameras = ", ".join(kind.image_key(camera) for camera in chosen.cameras) or "no pictures"
    print(f"{out}: {counted(len(chosen.episodes), 'episode')}, {chosen.rows} rows{left}; {cameras}")
    given = " ".join(map(str, folders))
    print(f"check it: python -m arena_newton.data verify {out} --recordings {given}")
    return 0


def choose(
    files: Sequence[Path],
    *,
    cameras: Sequence[str] = (),
    only_success: bool = False,
    allow_evaluation_seeds: bool = False,
) -> Chosen:
    """Open recorded episodes and check that they fit one dataset.

    Args:
        files: NPZ files in any order.
        cameras: Cameras to take; those that all have by default.
        only_success: Leave out what did not succeed.
        allow_evaluation_seeds: Take seeds on which policies are judged.

    Raises:
        InputError: They do not fit; the message names the episode.
    """
    every = list(opened(files))
    for episode in every:
        episode.load(FACTS)
    episodes = [episode for episode in every if not only_success or episode.text("arena_outcome") == "success"]
    if not episodes:
        raise InputError(f"none of {counted(len(every), 'episode')} succeeded; there is nothing to build")
    first = episodes[0]
    wanted = tuple(dict.fromkeys(cameras)) or first.cameras
    rate = _rate(first)
    videos: list[dict[str, SourceVideo]] = []
    seen: dict[tuple[object, ...], EpisodeFile] = {}
    for episode in episodes:
        if _rate(episode) != rate:
            raise InputError(f"{episode.path}: {_rate(episode)} rows per second, {first.path.name} has {rate}")
        if not cameras and episode.cameras != wanted:
            listed = [" ".join(one) or "none" for one in (episode.cameras, wanted)]
            raise InputError(
                f"{episode.path}: cameras {listed[0]}, {first.path.name} has {listed[1]}; choose with --cameras"
            )
        videos.append({})
        for camera in wanted:
            if camera not in episode.cameras:
                raise InputError(f"--cameras {camera}: {episode.path} has {' '.join(episode.cameras) or 'none'}")
            video = source_video(episode, camera)
            videos[-1][camera] = video
            other = videos[0][camera]
            if video.kind != other.kind:
                raise InputError(f"{video.path}: is {video.kind}, {other.path.name} is {other.kind}")
            if round(video.fps) != rate:
                raise InputError(f"{video.path}: {video.fps:g} frames per second, the rows have {rate}")
        seed = episode.integer("arena_episode_seed")
        evaluated = seeding.EVALUATION in (episode.text("arena_seed_range"), seeding.seed_range(seed))
        if evaluated and not allow_evaluation_seeds:
            raise InputError(
                f"{episode.path}: seed {seed} is one of those that judge policies; what is trained on it proves "
                "nothing (--allow-evaluation-seeds takes it anyway)"
            )
        name = (*(episode.text(f"arena_{word}") for word in ("task", "tracker", "mode")), seed)
        if name in seen:
            raise InputError(f"{episode.path}: is the same episode as {seen[name].path} ({' '.join(map(str, name))})")
        seen[name] = episode
    looks = tuple(map(source_looks, episodes)) if "front" in wanted else ()
    return Chosen(tuple(episodes), tuple(videos), rate, len(every) - len(episodes), looks)


def _rate(episode: EpisodeFile) -> int:
    """Rows per second: the median, as the original's converter takes it."""
    rate = float(np.median(episode.array("system_control_frequency", episode.rows)))
    if not 1.0 <= rate <= 1000.0:
        raise InputError(f"{episode.path}: system_control_frequency is {rate}, expected 1 to 1000")
    return round(rate)


def write_dataset(
    chosen: Chosen, out: Path, *, kind: Layout, labels: str = "v3.1", repo_id: str = "local/dataset", file_mb: int = 0
) -> None:
    """Write the dataset: whole, or not at all.

    It grows in `<out>.part` and is renamed at its end; what a killed build left there is removed by the next.

    Args:
        chosen: Its episodes.
        out: Folder that does not exist yet.
        kind: Names of its features.
        labels: What its actions mean.
        repo_id: LeRobot's name for it while it is written.
        file_mb: Size of a video file [MB]; 0: by the size of the pictures.

    Raises:
        InputError: The folder exists, another build writes it, or LeRobot is of another version.
        ArenaError: It cannot be written.
    """
    check_version()
    with new_folder(out) as folder:
        temporary, growing = folder / "temporary", folder / "growing"
        temporary.mkdir()
        with _in_folder(temporary), _own_functions(kind, labels), _quiet_video():
            _write(chosen, growing, temporary, kind=kind, labels=labels, repo_id=repo_id, file_mb=file_mb)
        _finish(chosen, growing, kind=kind, labels=labels)
        shutil.rmtree(temporary)
        for entry in growing.iterdir():
            entry.rename(folder / entry.name)
        growing.rmdir()


def check_version() -> None:
    """Refuse another LeRobot.

    Raises:
        InputError: Its version is another one.
    """
    version = _installed("lerobot")
    if version != LEROBOT:
        given = version or "one without a version"
        raise InputError(f"data build: knows the writer of lerobot {LEROBOT}, {given} is installed")


def _installed(name: str) -> str | None:
    """Version of a distribution; None where it can be imported but was not installed, as from PYTHONPATH."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


@contextlib.contextmanager
def _in_folder(folder: Path) -> Iterator[None]:
    """Temporary files go into a folder: LeRobot joins videos in the system's, where a killed build would leave them."""
    before, tempfile.tempdir = tempfile.tempdir, str(folder)
    try:
        yield
    finally:
        tempfile.tempdir = before


@contextlib.contextmanager
def _own_functions(kind: Layout, labels: str) -> Iterator[None]:
    """Put our statistics where LeRobot's are, and nothing where it looks for pictures in a table that has none."""
    names = {column.key: column.names for column in kind.columns(labels)}

    def exact(rows: Mapping[str, np.ndarray], _: object, quantile_list: object = None) -> dict[str, object]:
        return {key: row_statistics(column, names.get(key, ())) for key, column in rows.items()}

    before = dataset_writer.embed_images, dataset_writer.compute_episode_stats
    dataset_writer.embed_images, dataset_writer.compute_episode_stats = (lambda table: table), exact
    try:
        yield
    finally:
        dataset_writer.embed_images, dataset_writer.compute_episode_stats = before


@contextlib.contextmanager
def _quiet_video() -> Iterator[None]:
    """Let FFmpeg speak of errors only: LeRobot lets it print, and it tells every file that is joined."""
    before = av.logging.get_level()
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        yield
    finally:
        av.logging.set_libav_level(av.logging.INFO)
        av.logging.set_level(before)


def _features(chosen: Chosen, kind: Layout, labels: str) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    for camera, video in chosen.videos[0].items():
        shape, names = (video.height, video.width, 3), ["height", "width", "channels"]
        found[kind.image_key(camera)] = {"dtype": "video", "shape": shape, "names": names}
    for column in kind.columns(labels):
        found[column.key] = {"dtype": column.dtype, "shape": (len(column.names),), "names": list(column.names)}
    return found


def _write(
    chosen: Chosen, root: Path, temporary: Path, *, kind: Layout, labels: str, repo_id: str, file_mb: int
) -> None:
    """Give every episode to LeRobot's writer."""
    videos = list(chosen.videos[0].values())
    tallest = max((video.height for video in videos), default=0)
    dataset = LeRobotDataset.create(
        repo_id,
        chosen.fps,
        _features(chosen, kind, labels),
        root=root,
        robot_type=kind.robot_type(labels),
        use_videos=bool(videos),
        rgb_encoder=_encoder(videos[0]) if videos else None,
        video_files_size_in_mb=file_mb or (SMALL_MB if tallest <= SMALL_HEIGHT else LARGE_MB),
    )
    finished = FinishedVideos(temporary)
    dataset.writer._streaming_encoder = finished if videos else None
    # It asks for every row, and pandas takes 0.1 ms each time.
    numbers: dict[str, int] = {}
    for episode in chosen.episodes:
        numbers.setdefault(episode.text("arena_instruction"), len(numbers))
    dataset.meta.get_task_index = numbers.__getitem__
    bar = tqdm(total=chosen.rows, unit="row", desc="build", disable=None, dynamic_ncols=True)
    with bar, contextlib.closing(_Closing(dataset)):
        for index, (episode, videos_of_it) in enumerate(zip(chosen.episodes, chosen.videos, strict=True)):
            rows = episode.rows
            given: dict[str, object] = {"size": rows, "task": [episode.text("arena_instruction")] * rows}
            given |= {"frame_index": np.arange(rows), "timestamp": (np.arange(rows) / chosen.fps).astype(np.float32)}
            # LeRobot fills in the last three; it wants their names.
            given |= {"episode_index": index, "index": [], "task_index": []}
            given |= kind.rows(EpisodeFile(episode.path), labels)  # whose arrays are not kept
            pictures = {}
            for camera, video in videos_of_it.items():
                key = kind.image_key(camera)
                pictures[key] = video.path, statistics(video.histogram, rows)
                given[key] = [None] * rows
            finished.hand_over(pictures)
            dataset.save_episode(given)
            bar.update(rows)


class _Closing:
    """Ends LeRobot's writer, whose files are complete only then."""

    def __init__(self, dataset: LeRobotDataset):
        self._dataset = dataset

    def close(self) -> None:
        try:
            self._dataset.finalize()
        finally:
            # Where it fails LeRobot tries once more when it is collected, and would make the removed folder again.
            self._dataset.meta._finalized = self._dataset.writer._finalized = True


def _encoder(video: SourceVideo) -> RGBEncoderConfig:
    """Encoder settings that LeRobot writes into `info.json`; nothing is encoded."""
    codec = dict(video.codec)
    known = {name: codec.pop(name) for name in ("vcodec", "g", "crf", "preset") if name in codec}
    return RGBEncoderConfig(**known, extra_options=codec)


def _finish(chosen: Chosen, root: Path, *, kind: Layout, labels: str) -> None:
    """Statistics with sorted names, our own blocks of `info.json`, `modality.json`, and equal rights for all files."""
    meta = root / "meta"
    stats = read_json(meta / "stats.json")
    names = {column.key: column.names for column in kind.columns(labels)}
    # Averages of zeros and ones are again zeros and ones up to rounding, which is not wanted here.
    for key, columns in names.items():
        stats[key] = _clean_hands(stats[key], columns)
    write_json(meta / "stats.json", stats, sort=True)
    info = read_json(meta / "info.json")
    features = info["features"]
    assert isinstance(features, dict)
    for camera, video in chosen.videos[0].items():
        about = {name: value for name, value in video.codec.items() if name in ("g", "crf", "preset")}
        features[kind.image_key(camera)]["info"] |= {f"video.{name}": value for name, value in about.items()}
    if kind.name == "arena":
        trackers = list(dict.fromkeys(episode.text("arena_tracker") for episode in chosen.episodes))
        info["vla_protocol"] = described_protocol(labels, trackers)
    info["arena"] = _origin(chosen, kind, labels)
    write_json(meta / "info.json", info)
    write_json(meta / "modality.json", modality(kind, labels, chosen.cameras))
    write_looks(root, chosen.looks)
    rights = (meta / "info.json").stat().st_mode & 0o777
    for file in root.rglob("*"):
        if file.is_file():
            file.chmod(rights)


def _clean_hands(stats: object, columns: Sequence[str]) -> object:
    """Quantiles of the hands, without the rounding of averages."""
    assert isinstance(stats, dict)
    for number, name in enumerate(columns):
        if name.startswith("action.hand_binary."):
            for quantile in ("q01", "q10", "q90", "q99"):
                stats[quantile][number] = float(round(stats[quantile][number]))
    return stats


def _origin(chosen: Chosen, kind: Layout, labels: str) -> dict[str, object]:
    """Block `arena` of `info.json`: what every episode is, and what made the bytes."""
    configurations: dict[str, object] = {}
    episodes = []
    for episode in chosen.episodes:
        about = episode.json("arena_configuration")
        code = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
        configurations[code] = about
        words = ("task", "tracker", "policy", "mode", "rules", "seed_range", "outcome")
        numbers = ("group_seed", "repeat", "episode_seed")
        episodes.append(
            {
                "source": episode.stem,
                "sha256": hashlib.sha256(episode.path.read_bytes()).hexdigest(),
                **{word: episode.text(f"arena_{word}") for word in words},
                **{word: episode.integer(f"arena_{word}") for word in numbers},
                "configuration": code,
            }
        )
    return {
        "schema": SCHEMA,
        "layout": kind.name,
        "labels": labels,
        **({"slots": described_slots(labels)} if kind.name == "arena" else {}),
        "cameras": {kind.image_key(camera): camera for camera in chosen.cameras},
        "seed_ranges": sorted({str(episode["seed_range"]) for episode in episodes}),
        "trackers": sorted({str(episode["tracker"]) for episode in episodes}),
        "policies": sorted({str(episode["policy"]) for episode in episodes}),
        "versions": {"arena-newton": __version__, **{name: _installed(name) for name in LIBRARIES}},
        "configurations": dict(sorted(configurations.items())),
        "episodes": episodes,
    }
