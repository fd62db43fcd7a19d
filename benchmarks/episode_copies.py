"""Copies of recorded episodes under seeds of their own, so that sets of any size can be measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from arena_newton.data.recording.episode import VIDEO_FOLDER, EpisodeFile, vision, write_episode
from arena_newton.files.new_folder import link
from arena_newton.rules import seeding

__all__ = ["copy_episodes"]


def copy_episodes(episodes: Sequence[EpisodeFile], folder: Path, count: int) -> list[Path]:
    """Write so many recordings: the episodes in turn, each with its numbers, its arrays and pictures as they are.

    They are for measurements alone: nothing was played with the seeds that they name. All copies of an episode name one
    MP4.

    Args:
        episodes: Recordings, at least one.
        folder: Empty folder.

    Returns:
        NPZ files.

    Raises:
        InputError: An episode is damaged, or lacks a video.
        OSError: A copy cannot be written.
    """
    videos = folder / VIDEO_FOLDER
    for number, episode in enumerate(episodes):
        for camera in episode.cameras:
            link(episode.video(camera), videos / f"{number}_{camera}.mp4")
    written = []
    for repeat in range(count):
        number = repeat % len(episodes)
        episode = EpisodeFile(episodes[number].path)  # whose arrays are not kept
        seed = seeding.recording_seed(episode.text("task"), seeding.DEMONSTRATION, 0, repeat)
        changes = {
            "arena_seed_range": np.str_(seeding.DEMONSTRATION),
            "arena_group_seed": np.int64(0),
            "arena_repeat": np.int64(repeat),
            "arena_episode_seed": np.uint64(seed),
            "episode_object_seed": np.uint64(seeding.object_seed(seed)),
        }
        for camera in episode.cameras:
            changes[vision(camera, "rgb_video_path")] = np.str_(f"{VIDEO_FOLDER}/{number}_{camera}.mp4")
        path = folder / f"copy{repeat:05d}.npz"
        write_episode(path, episode.copy_of({name: np.asarray(value) for name, value in changes.items()}), sync=False)
        written.append(path)
    return written
