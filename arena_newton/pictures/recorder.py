"""Pictures of episodes: ego and world videos, and the paper's film strip of ten frames.

A strip draws no more than its ten frames: while an episode runs, only poses are kept (a few kB per frame), and the
frames are drawn when it ends. A video draws each of its frames. Pictures depend on the episode alone, not on the number
of worlds, and strips not on whether there are videos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import newton
import numpy as np
import torch
import warp as wp

from arena_newton.errors import InputError
from arena_newton.interfaces import Recorder
from arena_newton.pictures import follow as following
from arena_newton.pictures.camera import Camera, WorldLights
from arena_newton.pictures.settings import STRIP_SIZES, video_sizes
from arena_newton.pictures.video import VideoWriter, caption, evenly, film_strip
from arena_newton.robot.g1 import TICK

if TYPE_CHECKING:
    from arena_newton.interfaces import EpisodeResult, World

__all__ = ["EpisodeRecorder", "video_sizes"]

STRIP_FRAMES = 10
"""Frames of a film strip, as in the paper's rollout figures."""
STRIP_POSES = 4 * STRIP_FRAMES
"""Most poses kept of an episode; beyond them every other one is dropped. Frames are then evenly spaced to 1 in 40."""
VIEWS = 32
"""Worlds that are drawn at once: bounds the memory of the pictures."""
HOLD_FRAMES = 25
"""Frames for which a video's last picture is held, with the outcome on it."""

COLOURS = {"success": (36, 128, 84), "fall": (192, 64, 40), "timeout": (150, 104, 0), "error": (122, 70, 168)}
"""Outcome → RGB of its name on strips."""
BRIGHT = {"success": (120, 240, 170), "fall": (255, 130, 100), "timeout": (255, 205, 90), "error": (215, 165, 255)}
"""Outcome → RGB of its name on videos."""


class EpisodeKey(Protocol):
    """Attributes that a plan's episode needs so that its pictures find a name."""

    task: str
    mode: str
    group_seed: int
    repeat: int
    rank: int
    """Number within task, tracker and mode, in the order of the plan."""


@dataclass
class _Stream:
    """Recorded poses of one world's episode."""

    label: str
    rows: torch.Tensor
    """Bodies of the world in the model, shape [n]."""
    writers: dict[str, VideoWriter]
    stride: int
    """Frames from one kept pose to the next."""
    ticks: list[int] = field(default_factory=list)
    """Ticks of the kept poses."""
    poses: list[torch.Tensor] = field(default_factory=list)
    """Kept poses of the world's bodies, each of shape [n, 7]."""
    last: int = -1
    """Tick of the last frame."""
    last_frame: dict[str, np.ndarray] = field(default_factory=dict)

    def keep(self, tick: int, poses: torch.Tensor) -> None:
        self.ticks.append(tick)
        self.poses.append(poses)
        if len(self.poses) > STRIP_POSES:
            self.ticks, self.poses, self.stride = self.ticks[::2], self.poses[::2], 2 * self.stride


class EpisodeRecorder(Recorder):
    """Records the worlds of an `ArenaEnv` while a `rollout.Rollout` plays; close it after use."""

    def __init__(
        self,
        folder: str | Path,
        *,
        video: bool = True,
        strip: bool = True,
        episodes: int | None = None,
        size: tuple[int, int] | None = None,
        follow: bool = False,
        every: int = 2,
        prefix: str = "",
    ):
        """Set up the recorder.

        Args:
            folder: Folder in which `videos/` and `strips/` are written.
            video: Write H.264 MP4s.
            episodes: Number of episodes with videos, the first of each task, tracker and mode in the order of the plan;
                all by default.
            size: Width and height of world videos [px]; head camera videos are as high, 4:3. 480×270 (and 320×240) by
                default. Strips keep their size.
            follow: The world camera keeps the robot in the picture, from behind and the left; by default it is the
                scene's own.
            every: Ticks between frames (2 is 25 frames/s).
            prefix: First part of every file's name, such as the tracker's; none by default.

        Raises:
            InputError: A number out of range.
        """
        self.video_sizes = video_sizes(size)
        if episodes is not None and episodes < 1:
            raise InputError(f"--video-episodes {episodes}: expected at least 1")
        if every < 1:
            raise InputError(f"recorder: a frame every {every} ticks, expected at least 1")
        self.folder, self.prefix = Path(folder), prefix
        self.video, self.strip, self.episodes, self.follow, self.every = video, strip, episodes, follow, every
        self._env: World | None = None
        self._cameras: dict[str, Camera] = {}
        self._strip_cameras: dict[str, Camera] = {}
        self._streams: dict[int, _Stream] = {}

    def label(self, episode: EpisodeKey) -> str:
        """File stem of an episode."""
        parts = [self.prefix] if self.prefix else []
        parts += [episode.task, episode.mode, f"seed{episode.group_seed}", f"repeat{episode.repeat}"]
        return "__".join(parts)

    def media(self, episode: EpisodeKey) -> dict[str, str]:
        """Files of a finished episode, relative to the folder: `ego`, `world`, `ego strip`, `world strip`."""
        label = self.label(episode)
        found = {}
        if self._filmed(episode):
            found |= {name: f"videos/{label}__{name}.mp4" for name in self.video_sizes}
        if self.strip:
            found |= {f"{name} strip": f"strips/{label}__{name}.jpg" for name in STRIP_SIZES}
        return {name: path for name, path in found.items() if (self.folder / path).is_file()}

    def _filmed(self, episode: EpisodeKey) -> bool:
        return self.video and (self.episodes is None or episode.rank < self.episodes)

    def _bind(self, env: World) -> None:
        """Cameras and work space of an environment."""
        if self._env is env:
            return
        self._discard()
        self._env = env
        # Poses as they are now, and those of another time: the second is drawn when a strip is made.
        self._now, self._then = env.scene.model.state(), env.scene.model.state()
        self._now_poses, self._then_poses = wp.to_torch(self._now.body_q), wp.to_torch(self._then.body_q)
        self._walls = following.room_walls(env.scene.mj_model) if self.follow else ()
        self._pelvis = env.scene.body_to_newton[:, env.scene.robot.root_body]
        self._headings: dict[int, float] = {}
        self._follower = following.Follower(self._headings, self._walls)
        lights = env.lights
        views = min(env.worlds, VIEWS)
        if self.video:
            self._cameras = {n: self._camera(env, n, size, lights, views) for n, size in self.video_sizes.items()}
        if self.strip:
            self._strip_cameras = {n: self._camera(env, n, size, lights, 1) for n, size in STRIP_SIZES.items()}

    def _camera(self, env: World, name: str, size: tuple[int, int], lights: WorldLights, views: int) -> Camera:
        width, height = size
        if name == "world" and self.follow:
            return Camera(
                env.scene.model,
                np.full(env.worlds, -1),
                (0.0, 0.0, 0.0),
                (1.0, 0.0, 0.0, 0.0),
                width=width,
                height=height,
                focal_length=following.FOCAL,
                horizontal_aperture=following.APERTURE,
                lights=lights,
                views=views,
            )
        return Camera.from_scene(env.scene, prim=name, width=width, height=height, lights=lights, views=views)

    def start(self, env: World, world: int, episode: EpisodeKey) -> None:
        """Open the streams of a world's new episode.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        self._bind(env)
        label = self.label(episode)
        bodies = np.asarray(env.scene.body_to_newton[world])
        rows = torch.as_tensor(np.unique(bodies[bodies >= 0]), device=self._now_poses.device)
        stream = self._streams[world] = _Stream(label, rows, {}, stride=1)
        if self._filmed(episode):
            for name, (width, height) in self.video_sizes.items():
                path = self.folder / "videos" / f"{label}__{name}.mp4"
                stream.writers[name] = VideoWriter(path, width, height, fps=50 / self.every)
        if self.follow or env.tick[world] >= 0:
            env.physics.write_newton_state(self._now)
        if self.follow:
            x, y, z, w = self._now_poses[self._pelvis[world], 3:].tolist()
            self._headings[world] = float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
            self._follower.forget(world)
        if env.tick[world] >= 0:  # without a start-up the first frame is the spawn's
            self._take(env, [world])

    def tick(self, env: World) -> None:
        """Take a frame of every recorded world that is past its start-up and whose frame is due.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        due = [w for w in self._streams if env.active[w] and env.tick[w] >= 0 and env.tick[w] % self.every == 0]
        wanted = [w for w in due if self._streams[w].writers or self._due(w, int(env.tick[w]))]
        if wanted:
            env.physics.write_newton_state(self._now)
            self._take(env, wanted)

    def _due(self, world: int, tick: int) -> bool:
        """True if a strip keeps the poses of this tick."""
        return self.strip and tick % (self.every * self._streams[world].stride) == 0

    def _take(self, env: World, worlds: Sequence[int], *, final: bool = False) -> None:
        """A frame of some worlds, whose poses are in `_now`; poses that are not finite cannot be drawn."""
        finite = [w for w in worlds if self._now_poses[self._streams[w].rows].isfinite().all()]
        for world in finite:
            stream, tick = self._streams[world], int(env.tick[world])
            stream.last = tick
            if self._due(world, tick) or (self.strip and final):
                stream.keep(tick, self._now_poses[stream.rows].clone())
        filmed = [w for w in finite if self._streams[w].writers]
        for name, camera in self._cameras.items():
            for first in range(0, len(filmed), camera.views):
                part = filmed[first : first + camera.views]
                ticks = [int(env.tick[w]) for w in part]
                images = self._draw(name, camera, self._now, self._now_poses, part, ticks, self._follower)
                for image, world in zip(images, part, strict=True):
                    stream = self._streams[world]
                    stream.last_frame[name] = image
                    stream.writers[name].write(caption(image, _time(int(env.tick[world]))))

    def _draw(
        self,
        name: str,
        camera: Camera,
        state: newton.State,
        poses: torch.Tensor,
        worlds: Sequence[int],
        ticks: Sequence[int],
        follower: following.Follower,
    ) -> np.ndarray:
        """Pictures of some worlds from one camera, uint8 [len(worlds), H, W, 3]."""
        if name == "world" and self.follow:
            pelvises = poses[self._pelvis[list(worlds)], :2].cpu().numpy()
            return follower.draw(camera, state, worlds, pelvises, ticks)
        return camera.render_worlds(state, worlds).cpu().numpy().copy()

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Close the streams of a world's episode; the outcome goes onto its pictures.

        Raises:
            OSError: A file cannot be written; the error carries its name.
        """
        stream = self._streams.get(world)
        if stream is None:
            return
        if env.tick[world] >= 0 and stream.last != env.tick[world]:
            env.physics.write_newton_state(self._now)
            self._take(env, [world], final=True)
        elif self.strip and stream.last >= 0 and stream.ticks[-1] != stream.last:
            stream.keep(stream.last, self._now_poses[stream.rows].clone())
        text = result.outcome if result.reason in (result.outcome, "", None) else f"{result.outcome} ({result.reason})"
        for name, writer in stream.writers.items():
            if name in stream.last_frame:
                held = caption(
                    stream.last_frame[name],
                    f"{_time(stream.last)}  {text}",
                    BRIGHT.get(result.outcome, (255, 255, 255)),
                )
                for _ in range(HOLD_FRAMES):
                    writer.write(held)
            writer.close()
        if self.strip and stream.poses:
            self._write_strips(stream, world, result, text)
        del self._streams[world]

    def _write_strips(self, stream: _Stream, world: int, result: EpisodeResult, text: str) -> None:
        """Draw the frames of a strip, and nothing else, from the poses that were kept."""
        # Nearest to even spacing in time, first and last included.
        wanted = np.linspace(stream.ticks[0], stream.ticks[-1], STRIP_FRAMES)
        nearest = [int(np.abs(np.asarray(stream.ticks) - tick).argmin()) for tick in wanted]
        picks = sorted(set(nearest)) if len(stream.ticks) > STRIP_FRAMES else evenly(len(stream.ticks), STRIP_FRAMES)
        for name, camera in self._strip_cameras.items():
            # Not the videos' follower: a strip is the same with and without videos.
            follower = following.Follower(self._headings, self._walls)
            frames = []
            for i in picks:
                self._then_poses[stream.rows] = stream.poses[i]
                tick = stream.ticks[i]
                frames.append(self._draw(name, camera, self._then, self._then_poses, [world], [tick], follower)[0])
            film_strip(
                frames,
                self.folder / "strips" / f"{stream.label}__{name}.jpg",
                n=STRIP_FRAMES,
                label=f"{stream.label.replace('__', ' ')}: {text}",
                colour=COLOURS.get(result.outcome, (0, 0, 0)),
                captions=[_time(stream.ticks[i]) for i in picks],
            )

    def close(self) -> None:
        """Drop what is unfinished; no partial file stays."""
        self._discard()
        self._env = None
        self._cameras, self._strip_cameras = {}, {}

    def _discard(self) -> None:
        for stream in self._streams.values():
            for writer in stream.writers.values():
                writer.discard()
        self._streams = {}

    def __enter__(self) -> EpisodeRecorder:
        """The recorder itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Drop what is unfinished."""
        self.close()


def _time(tick: int) -> str:
    return f"step {tick}  {tick * TICK:.2f} s"
