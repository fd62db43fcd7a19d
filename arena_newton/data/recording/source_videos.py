"""The MP4 of an episode's camera: what its fields say about it, checked against the file without decoding it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from arena_newton.data.readers.looks import Looks
from arena_newton.data.recording.episode import EpisodeFile, vision
from arena_newton.data.recording.image_statistics import VALUES
from arena_newton.errors import InputError

__all__ = ["SourceVideo", "check_film", "source_looks", "source_video"]


@dataclass(frozen=True)
class SourceVideo:
    """A finished video of a camera."""

    path: Path
    width: int
    height: int
    fps: float
    codec: Mapping[str, object]
    """Codec and its options, as used."""
    histogram: np.ndarray
    """Pixels of all frames by channel and value, before they were encoded, int64, shape [3, 256]."""

    @property
    def kind(self) -> str:
        """Properties that all videos of a camera share."""
        options = " ".join(f"{name} {value}" for name, value in self.codec.items())
        return f"{self.width}x{self.height} {options}"


def source_video(episode: EpisodeFile, camera: str) -> SourceVideo:
    """The video of a camera.

    Raises:
        InputError: It is missing, is not what the fields say, or has another number of frames than there are rows.
    """
    path = episode.video(camera)
    size = episode.array(f"arena_{vision(camera, 'size')}", 2)
    histogram = episode.array(f"arena_{vision(camera, 'histogram')}", 3, VALUES)
    fps = float(episode.array(vision(camera, "rgb_video_fps")))
    found = SourceVideo(
        path, int(size[0]), int(size[1]), fps, episode.json(f"arena_{vision(camera, 'codec')}"), histogram
    )
    indices = episode.array(vision(camera, "frame_indices"), episode.rows)
    if not np.array_equal(indices, np.arange(episode.rows)):
        raise InputError(f"{episode.path}: {vision(camera, 'frame_indices')} is not 0 to {episode.rows - 1}")
    if (np.asarray(histogram) < 0).any() or set(histogram.sum(axis=1)) != {episode.rows * found.width * found.height}:
        raise InputError(f"{episode.path}: arena_{vision(camera, 'histogram')} does not count {episode.rows} pictures")
    check_film(found, episode.rows, f"the episode has {episode.rows} rows")
    return found


def source_looks(episode: EpisodeFile) -> tuple[Looks, Path] | None:
    """Looks of the head camera's pictures and their film; None where none were recorded.

    Raises:
        InputError: The film is missing, or is not what the fields say.
    """
    found = episode.looks("front") if "front" in episode.cameras else None
    if found is not None:
        looks, path = found
        width, height = episode.array(f"arena_{vision('front', 'size')}", 2).tolist()
        fps = float(episode.array(vision("front", "rgb_video_fps"))) / looks.stride
        film = SourceVideo(path, width, height, fps, {"vcodec": "h264"}, np.zeros(0, np.int64))
        check_film(film, looks.frames(episode.rows), f"its episode's looks are {looks.frames(episode.rows)}")
    return found


def check_film(video: SourceVideo, frames_wanted: int, why: str) -> None:
    """Count the frames of a film, which are packets of the file, and compare size, rate and codec.

    Raises:
        InputError: It is not a readable video, or another one.
    """
    try:
        with av.open(str(video.path)) as container:
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise ValueError("no decoder")
            about = stream.codec_context.width, stream.codec_context.height, stream.codec_context.codec.canonical_name
            rate = float(stream.average_rate or 0)
            frames = sum(packet.size > 0 for packet in container.demux(stream))
    except (av.error.FFmpegError, OSError, IndexError, ValueError) as error:
        raise InputError(f"{video.path}: not a readable video ({type(error).__name__})") from error
    if frames != frames_wanted:
        raise InputError(f"{video.path}: has {frames} frames, {why}")
    even = video.width + video.width % 2, video.height + video.height % 2
    if about[:2] != even or about[2] != video.codec.get("vcodec"):
        raise InputError(
            f"{video.path}: is {about[0]}x{about[1]} {about[2]}, its episode says {video.width}x{video.height} "
            f"{video.codec.get('vcodec')}"
        )
    if abs(rate - video.fps) > 1e-3:
        raise InputError(f"{video.path}: has {rate:g} frames per second, its episode says {video.fps:g}")
