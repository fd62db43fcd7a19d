"""Pictures of episodes: ego and world videos, and the paper's film strip of ten frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

__all__ = ["EpisodeRecorder"]

STRIP_FRAMES = 10
"""Frames of a film strip, as in the paper's rollout figures."""


class _Frames:
    """At most 2·n evenly spaced frames of a stream of unknown length."""

    def __init__(self, n: int):
        self.limit, self.stride, self.count = 2 * n, 1, 0
        self.kept: list[Any] = []

    def add(self, frame: Any) -> None:
        if self.count % self.stride == 0:
            self.kept.append(frame.copy())
            if len(self.kept) > self.limit:
                self.kept = self.kept[::2]
                self.stride *= 2
        self.count += 1


class EpisodeRecorder:
    """Records the worlds of an `ArenaEnv`; give it to `ArenaEnv.run_episodes`."""

    def __init__(
        self,
        folder: str | Path,
        *,
        video: bool = True,
        strip: bool = True,
        every: int = 2,
        ego: tuple[int, int] = (320, 240),
        world: tuple[int, int] = (480, 270),
    ):
        """Set up the recorder.

        Args:
            folder: Where `videos/` and `strips/` are written.
            video: Write H.264 MP4s.
            strip: Write film strips.
            every: Ticks between frames (2 is 25 frames/s).
            ego: Head camera size (width, height) [px].
            world: World camera size (width, height) [px].
        """
        self.folder = Path(folder)
        self.video, self.strip, self.every = video, strip, every
        self.sizes = {"ego": ego, "world": world}
        self._cameras: dict[str, Any] = {}
        self._env: Any = None
        self._streams: dict[int, dict[str, Any]] = {}
        self._ticks = 0

    @staticmethod
    def label(episode: Any) -> str:
        """File stem of an episode."""
        parts = [episode.task, episode.mode, f"seed{episode.group_seed}", f"repeat{episode.repeat}"]
        return "__".join(str(p) for p in parts)

    def _bind(self, env: Any) -> None:
        from arena_newton.camera import Camera

        if self._env is env:
            return
        self._env = env
        self._cameras = {
            name: Camera.from_scene(env.scene, env.physics, prim=name, width=w, height=h, lights=env._lights())
            for name, (w, h) in self.sizes.items()
        }

    def start(self, env: Any, world: int, episode: Any) -> None:
        """Open the streams of a world's new episode."""
        from arena_newton.video import VideoWriter

        self._bind(env)
        streams: dict[str, Any] = {"label": self.label(episode)}
        for name, (w, h) in self.sizes.items():
            frames = _Frames(STRIP_FRAMES) if self.strip else None
            writer = None
            if self.video:
                path = self.folder / "videos" / f"{streams['label']}__{name}.mp4"
                path.parent.mkdir(parents=True, exist_ok=True)
                writer = VideoWriter(path, w, h, fps=50 / self.every)
            streams[name] = (writer, frames)
        self._streams[world] = streams

    def tick(self, env: Any) -> None:
        """Take a frame of every recorded world that is past its start-up."""
        self._ticks += 1
        if self._ticks % self.every:
            return
        mask = env.active & (env.tick >= 0)
        if not mask.any():
            return
        for name, camera in self._cameras.items():
            images = env.render(camera, mask).cpu().numpy()
            for world, streams in self._streams.items():
                if not mask[world]:
                    continue
                writer, frames = streams[name]
                if writer is not None:
                    writer.write(images[world])
                if frames is not None:
                    frames.add(images[world])

    def finish(self, env: Any, world: int, result: Any) -> None:
        """Close the streams of a world's episode; the outcome goes into the strip's label."""
        from arena_newton.video import film_strip

        streams = self._streams.pop(world, None)
        if streams is None:
            return
        for name in self.sizes:
            writer, frames = streams[name]
            if writer is not None:
                writer.close()
            if frames is not None and frames.kept:
                path = self.folder / "strips" / f"{streams['label']}__{name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                film_strip(frames.kept, path, n=STRIP_FRAMES, label=f"{streams['label']} {result.outcome}")
