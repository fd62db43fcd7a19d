"""Decodes every frame of a dataset's videos and holds them against the tables and the recorded MP4s.

Files are decoded by threads: FFmpeg works without Python's lock. Which mismatch is reported does not depend on their
number: it is the first one of the first file that has one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from arena_newton.data.readers.dataset_files import DatasetFiles, EpisodeRow, VideoPart
from arena_newton.data.readers.frame_reader import OpenVideo
from arena_newton.errors import ArenaError, InputError

__all__ = ["CameraVideos", "DatasetMismatch", "check_videos"]

MEAN_TOLERANCE = 3.0
"""Largest difference [grey levels] between the mean of decoded frames and that of the statistics, which were taken
before encoding: x264 changes it by less than 1."""
RED_GREEN_BLUE = np.array([[1.164, 0.0, 1.596], [1.164, -0.392, -0.813], [1.164, 2.017, 0.0]])
"""Colour of luma and chroma less `BLACK` (ITU-R BT.601, limited range). Means can be converted, as it is linear."""
BLACK = np.array([16.0, 128.0, 128.0])
TIME_TOLERANCE = 1e-3
"""Largest difference of a frame's time from its number, in frames."""
COMPARED = 12
"""Frames of an episode that are compared with the recorded MP4's, bit for bit: its first, its last, some between."""
REPORT_SECONDS = 0.2
"""Time [s] between two reports of how far the threads are."""


class DatasetMismatch(ArenaError):
    """The first thing in a dataset that is not as it should be."""

    def __init__(self, file: Path | str, message: str, *, episode: int | None = None, row: int | None = None):
        """Name it.

        Args:
            file: File of the dataset.
            message: What is wrong, the column included.
            episode: Number of the episode.
            row: Its row or frame.
        """
        parts = [str(file)]
        parts += [f"episode {episode}"] if episode is not None else []
        parts += [f"row {row}"] if row is not None else []
        super().__init__(f"{', '.join(parts)}: {message}")


@dataclass(frozen=True)
class CameraVideos:
    """Expected properties of a camera's videos."""

    key: str
    """Feature of the camera."""
    means: Sequence[np.ndarray]
    """Mean of each episode's pictures by its statistics, 0 to 1, shape [3]."""
    sources: Mapping[int, Path]
    """Recorded MP4 of each episode, where there is one."""


@dataclass(frozen=True)
class _Source:
    """Frames of a recorded MP4 that are compared."""

    path: Path
    frames: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class _Video:
    """One file and the episodes in it, in the order of their frames."""

    camera: CameraVideos
    path: Path
    parts: Sequence[tuple[EpisodeRow, VideoPart]]


class _NotWanted(Exception):
    """An earlier file has a mismatch, or the check was interrupted."""


def check_videos(
    files: DatasetFiles,
    cameras: Sequence[CameraVideos],
    *,
    jobs: int = 1,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Decode all frames of some cameras.

    Args:
        cameras: Its cameras, in the order in which mismatches are reported.
        jobs: Threads; each decodes one file at a time.
        progress: Is given the number of frames decoded so far, now and then.

    Returns:
        Number of frames.

    Raises:
        DatasetMismatch: A video is not what the tables say.
        InputError: A recorded MP4 cannot be read.
    """
    videos = [video for camera in cameras for video in _videos(files, camera)]
    decoded = [0] * len(videos)
    lock, failed = threading.Lock(), len(videos)

    def check(number: int) -> None:
        nonlocal failed

        def advance() -> None:
            decoded[number] += 1
            if number > failed:
                raise _NotWanted

        try:
            if number <= failed:
                _check_file(files, videos[number], advance)
        except _NotWanted:
            pass
        except BaseException:
            with lock:
                failed = min(failed, number)
            raise

    with ThreadPoolExecutor(jobs, thread_name_prefix="decoder") as pool:
        try:
            for future in [pool.submit(check, number) for number in range(len(videos))]:
                while wait([future], timeout=REPORT_SECONDS).not_done:
                    if progress is not None:
                        progress(sum(decoded))
                future.result()
        finally:
            failed = -1  # a file that is still decoded ends at its next frame
            pool.shutdown(cancel_futures=True)
    if progress is not None:
        progress(sum(decoded))
    return sum(decoded)


def _videos(files: DatasetFiles, camera: CameraVideos) -> list[_Video]:
    """The files of a camera, after what the tables say of them was checked.

    Raises:
        DatasetMismatch: Episodes overlap or leave gaps, a number of frames is wrong, or a file is nobody's.
    """
    by_file: dict[Path, list[tuple[EpisodeRow, VideoPart]]] = {}
    for row in files.episode_rows:
        part = files.video(row, camera.key)
        if part.frames != row.length:
            raise DatasetMismatch(part.path, f"{part.frames} frames for {row.length} rows", episode=row.index)
        parts = by_file.setdefault(part.path, [])
        expected = parts[-1][1].first + parts[-1][1].frames if parts else 0
        if part.first != expected:
            raise DatasetMismatch(part.path, f"begins at frame {part.first}, expected {expected}", episode=row.index)
        parts.append((row, part))
    stray = sorted(set((files.root / "videos" / camera.key).rglob("*.mp4")) - set(by_file))
    if stray:
        raise DatasetMismatch(stray[0], "no episode has frames in it")
    return [_Video(camera, path, parts) for path, parts in by_file.items()]


def _check_file(files: DatasetFiles, video: _Video, advance: Callable[[], None]) -> None:
    """Decode one file; `advance` is called after each frame.

    Raises:
        DatasetMismatch: It is not what the tables say.
        InputError: A recorded MP4 cannot be read.
    """
    try:
        _check_frames(files, video, advance)
    except (av.error.FFmpegError, OSError, IndexError, ValueError) as error:
        raise DatasetMismatch(video.path, f"cannot be decoded ({type(error).__name__})") from error


def _check_frames(files: DatasetFiles, video: _Video, advance: Callable[[], None]) -> None:
    key, path = video.camera.key, video.path
    info = files.features[key].get("info")
    about = info if isinstance(info, dict) else {}
    shape = files.features[key].get("shape")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        codec = stream.codec_context
        if codec is None:
            raise DatasetMismatch(path, "holds no video that can be decoded")
        _check_stream(path, codec, stream, about, shape, files.fps)
        codec.thread_count = 1
        frames = _decoded(container, stream, path, files.fps, about)
        for row, part in video.parts:
            source = _source(video.camera.sources.get(row.index), part, row)
            sums = np.zeros(3)
            for number in range(part.frames):
                frame = next(frames, None)
                if frame is None:
                    raise DatasetMismatch(path, "the video has no frame for it", episode=row.index, row=number)
                sums += _mean(frame)
                if source is not None and number in source.frames:
                    picture = frame.to_ndarray(format="rgb24")
                    if not np.array_equal(picture, source.frames[number]):
                        message = f"{key} differs from frame {number} of {source.path}"
                        raise DatasetMismatch(path, message, episode=row.index, row=number)
                advance()
            apart = np.abs(sums / part.frames - 255.0 * np.asarray(video.camera.means[row.index]).reshape(3)).max()
            if not apart <= MEAN_TOLERANCE:
                message = f"{key}: mean of the pictures is {apart:.1f} grey levels from that of the statistics"
                raise DatasetMismatch(path, message, episode=row.index)
        if next(frames, None) is not None:
            message = f"{key}: the video goes on after the last episode's last frame"
            raise DatasetMismatch(path, message, episode=video.parts[-1][0].index)


def _mean(frame: av.VideoFrame) -> np.ndarray:
    """Mean colour of a frame, 0 to 255, shape [3]."""
    if frame.format.name != "yuv420p":
        picture: np.ndarray = frame.to_ndarray(format="rgb24").reshape(-1, 3).mean(axis=0)
        return picture
    means = []
    for plane in frame.planes:
        lines = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
        means.append(lines[:, : plane.width].mean())
    colour: np.ndarray = RED_GREEN_BLUE @ (np.array(means) - BLACK)
    return colour


def _check_stream(
    path: Path,
    codec: av.VideoCodecContext,
    stream: av.VideoStream,
    about: Mapping[str, object],
    shape: object,
    fps: int,
) -> None:
    """Size, codec and rate, which `info.json` names."""
    size = [codec.height, codec.width, 3]
    even = [n + n % 2 for n in shape[:2]] if isinstance(shape, list | tuple) and len(shape) == 3 else None
    if even != size[:2]:
        raise DatasetMismatch(path, f"pictures are {size[1]}x{size[0]}, info.json says shape {shape}")
    named = about.get("video.codec")
    if named is not None and named != codec.codec.canonical_name:
        raise DatasetMismatch(path, f"codec is {codec.codec.canonical_name}, info.json says {named}")
    rate = float(stream.average_rate or 0)
    if abs(rate - fps) > 1e-3:
        raise DatasetMismatch(path, f"{rate:g} frames per second, info.json says {fps}")


def _decoded(
    container: av.container.InputContainer, stream: av.VideoStream, path: Path, fps: int, about: Mapping[str, object]
) -> Iterator[av.VideoFrame]:
    """Frames in order; each must be at its time, and key frames as often as `info.json` says."""
    group, since = about.get("video.g"), 0
    for number, frame in enumerate(container.decode(stream)):
        if frame.time is None or abs(frame.time * fps - number) > TIME_TOLERANCE:
            raise DatasetMismatch(path, f"frame {number} is at another time than {number / fps:g} s")
        since = 0 if frame.key_frame else since + 1
        if isinstance(group, int) and since >= group:
            raise DatasetMismatch(path, f"no key frame in {since + 1} frames, info.json says one in {group}")
        yield frame


def _source(path: Path | None, part: VideoPart, row: EpisodeRow) -> _Source | None:
    """Some frames of the recorded MP4.

    Raises:
        InputError: It cannot be read.
        DatasetMismatch: It has another number of frames.
    """
    if path is None:
        return None
    try:
        video = OpenVideo(path)
    except (av.error.FFmpegError, OSError, IndexError) as error:
        raise InputError(f"{path}: not a readable video ({type(error).__name__})") from error
    try:
        if len(video.times) != part.frames:
            raise DatasetMismatch(part.path, f"{part.frames} frames, {path} has {len(video.times)}", episode=row.index)
        chosen = sorted({int(n) for n in np.linspace(0, part.frames - 1, min(COMPARED, part.frames)).round()})
        return _Source(path, {number: video.read(number) for number in chosen})
    finally:
        video.close()
