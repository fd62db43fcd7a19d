"""Running worlds in Newton's viewers, and recordings of failed episodes to walk around in.

One code path for both engines: the physics writes its bodies' poses into a Newton state, and a viewer draws that state.
Nothing here changes an episode: a viewer looks on, forces from the page are not applied.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import newton
import newton.viewer
import numpy as np
import torch
import warp as wp
from pxr import Sdf, UsdGeom, UsdUtils

from arena_newton.cli.extras import require
from arena_newton.errors import InputError
from arena_newton.files.own_files import PARTIAL
from arena_newton.interfaces import Recorder
from arena_newton.pictures.camera import CAMERA_PRIMS
from arena_newton.pictures.follow import follow_pose, room_walls
from arena_newton.pictures.settings import MOST_VIEWED, VIEWERS
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import heading_np, matrix_from_quat_np

if TYPE_CHECKING:
    from arena_newton.interfaces import EpisodeResult, World
    from arena_newton.pictures.recorder import EpisodeKey

__all__ = ["FailureRecorder", "WorldViewer"]

LOCAL = "127.0.0.1"
"""Address that only this machine reaches."""
EVERY = 2
"""Ticks between frames: 25 frames/s."""
CHEST = 0.3
"""Height of the point that a following camera looks at, above the pelvis [m]."""
NEAREST = 1.0
"""Least distance of the point that a page's camera turns about [m]."""
UP = np.array([0.0, 0.0, 1.0])
IDLE = 0.02
"""Pause between two looks at the page while it holds the run [s]."""
SCENE = "scene.usdc"
"""File of a recorded USD scene, in a folder of its own with its textures."""


class WorldViewer(Recorder):
    """Shows the first worlds of an `ArenaEnv` while they run; close it after use."""

    def __init__(
        self,
        kind: str,
        *,
        worlds: int = MOST_VIEWED,
        port: int = 8080,
        host: str = LOCAL,
        out: Path | None = None,
        follow: bool = False,
        real_time: bool = False,
    ):
        """Start the viewer.

        Args:
            kind: `viser` (a page), `rerun` (a page of rerun's), `usd` (a file with one time sample per frame).
            worlds: Worlds shown, the first of the batch; at most `MOST_VIEWED`.
            port: TCP port of the page; rerun takes the next one too.
            host: Address that the page is served at.
            out: For `usd`: folder in which each batch of worlds has a folder of its own.
            follow: viser: the camera goes with the first world's robot; otherwise it starts at the scene's own.
            real_time: Hold the run back to real time.

        Raises:
            InputError: Unknown kind, a library is missing, a port is taken, or `usd` without a folder.
        """
        if kind not in VIEWERS:
            raise InputError(f"--viewer {kind}: unknown, choose from {', '.join(VIEWERS)}")
        if not 1 <= worlds <= MOST_VIEWED:
            raise InputError(f"--viewer: {worlds} worlds, expected 1 to {MOST_VIEWED}")
        if kind == "usd" and out is None:
            raise InputError("--viewer usd: needs a folder to write to")
        self.kind, self.most, self.out, self.follow, self.real_time = kind, worlds, out, follow, real_time
        self._address = f"http://{host}:{port}"
        self._viewer: newton.viewer.ViewerBase | None = None
        self._env: World | None = None
        self._ticks = 0
        self._due = 0.0
        self._partial: Path | None = None
        if kind == "viser":
            self._viewer = _viser(host, port)
        elif kind == "rerun":
            self._viewer = _rerun(host, port)

    @property
    def url(self) -> str | None:
        """Address of the page; None for a file."""
        return None if self.kind == "usd" else self._address

    def open(self, env: World, name: str) -> None:
        """Show the worlds of another environment from now on.

        Args:
            name: What they are called; `usd` writes into a folder of that name, a numbered one where it exists.
        """
        self._finish_file()
        if self.kind == "usd":
            folder = _unused(Path(self.out or "."), name)
            self._partial = folder / f"{SCENE.removesuffix('.usdc')}{PARTIAL}.usdc"
            self._viewer = newton.viewer.ViewerUSD(str(self._partial), fps=round(1 / (EVERY * TICK)), num_frames=None)
            self._ticks = 0
        viewer = self._viewer
        if viewer is None:
            raise InputError("viewer: is closed")
        self._env, self._state = env, env.scene.model.state()
        viewer.world_offsets = None
        viewer.set_model(env.scene.model)
        if env.worlds > self.most:
            viewer.set_visible_worlds(range(self.most))
        if isinstance(viewer, newton.viewer.ViewerViser):
            _look(viewer, env, self.follow)

    def show(self, env: World) -> None:
        """Draw the worlds as they are now; does not wait."""
        if self._env is not env:
            self.open(env, env.spec.name)
        viewer = self._viewer
        assert viewer is not None
        env.physics.write_newton_state(self._state)
        viewer.begin_frame(self._ticks * TICK)
        viewer.log_state(self._state)
        viewer.end_frame()
        if self.follow and isinstance(viewer, newton.viewer.ViewerViser):
            self._go_along(viewer, env)

    def _go_along(self, viewer: newton.viewer.ViewerViser, env: World) -> None:
        """Move the pages' cameras with the robot, each as its person has turned it."""
        target = _chest(env) + _offset(viewer)
        for client in viewer.server.get_clients().values():
            with client.atomic():
                client.camera.position = target + client.camera.position - client.camera.look_at

    def start(self, env: World, world: int, episode: object) -> None:
        """Draw the first state of a batch."""
        if self._env is not env:
            self.show(env)

    def tick(self, env: World) -> None:
        """Draw every second tick; wait where real time or a press of Pause on the page says so."""
        self._ticks += 1
        if self._ticks % EVERY:
            return
        self.show(env)
        assert self._viewer is not None
        while not self._viewer.should_step():
            time.sleep(IDLE)
        if self.real_time:
            now = time.monotonic()
            self._due = max(self._due + EVERY * TICK, now - EVERY * TICK)
            time.sleep(max(0.0, self._due - now))

    def close(self) -> None:
        """End the page, or write the file."""
        self._finish_file()
        viewer, self._viewer, self._env = self._viewer, None, None
        if viewer is not None:
            _quietly(viewer.close)

    def _finish_file(self) -> None:
        """Give a complete USD file its name, and its textures relative paths."""
        if self._partial is None or not isinstance(self._viewer, newton.viewer.ViewerUSD):
            return
        partial, self._partial = self._partial, None
        _gather(self._viewer.stage.GetRootLayer(), partial.parent)
        _quietly(self._viewer.close)
        self._viewer = None
        os.replace(partial, partial.with_name(SCENE))


@dataclass
class _Poses:
    """An episode so far."""

    label: str
    ticks: list[int] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    """Poses of the world's bodies, float32, each of shape [n, 7]."""


class FailureRecorder(Recorder):
    """Writes one `.viser` recording per failed episode: the scene in motion, to walk around in.

    While an episode runs only its poses are kept, 28 bytes per body and frame; one that succeeds is dropped.
    """

    def __init__(self, folder: Path, prefix: str = ""):
        """Write into a folder: `<task>__<mode>__seed<group seed>__repeat<repeat>.viser`.

        Args:
            folder: The folder, made with the first recording.
            prefix: First part of every file's name, such as the tracker's; none by default.

        Raises:
            InputError: viser is not installed.
        """
        require("teleop", "--viewer-failures", ("viser",))
        self.folder, self.prefix = folder, prefix
        self._env: World | None = None
        self._running: dict[int, _Poses] = {}

    def start(self, env: World, world: int, episode: EpisodeKey) -> None:
        """An episode without poses yet."""
        if self._env is not env:
            self._env, self._state, self._running = env, env.scene.model.state(), {}
            self._bodies = wp.to_torch(self._state.body_q)
            carried = [np.unique(row[row >= 0]) for row in np.asarray(env.scene.body_to_newton)]
            self._rows = [torch.as_tensor(rows, device=self._bodies.device) for rows in carried]
        parts = [self.prefix] if self.prefix else []
        parts += [episode.task, episode.mode, f"seed{episode.group_seed}", f"repeat{episode.repeat}"]
        self._running[world] = _Poses("__".join(parts))
        self._keep(env, [world])

    def tick(self, env: World) -> None:
        """Keep the poses of every second tick."""
        due = [world for world in self._running if env.active[world] and env.tick[world] % EVERY == 0]
        if due:
            self._keep(env, due)

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Write the recording of an episode that did not succeed.

        Raises:
            OSError: The file cannot be written.
        """
        poses = self._running.pop(world)
        if result.outcome == "success":
            return
        if poses.ticks[-1] != env.tick[world]:
            self._running[world] = poses
            self._keep(env, [world])
            del self._running[world]
        self._write(env, world, poses)

    def _keep(self, env: World, worlds: Sequence[int]) -> None:
        env.physics.write_newton_state(self._state)
        for world in worlds:
            poses = self._running[world]
            poses.ticks.append(int(env.tick[world]))
            poses.frames.append(self._bodies[self._rows[world]].cpu().numpy())

    def _write(self, env: World, world: int, poses: _Poses) -> None:
        """Play the poses once more through a viewer that records, under a temporary name."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{poses.label}.viser"
        partial = path.with_name(path.name + PARTIAL)
        state = env.scene.model.state()
        bodies = wp.to_torch(state.body_q)
        rows = self._rows[world]
        viewer = _quiet_viser(LOCAL, _free_port(), partial)
        try:
            viewer.set_model(env.scene.model)
            if env.worlds > 1:
                viewer.set_visible_worlds([world])
            viewer.set_world_offsets((0.0, 0.0, 0.0))
            bodies[rows] = torch.as_tensor(poses.frames[0], device=bodies.device)
            _look(viewer, env, True, world)
            for tick, frame in zip(poses.ticks, poses.frames, strict=True):
                bodies[rows] = torch.as_tensor(frame, device=bodies.device)
                viewer.begin_frame((tick - poses.ticks[0]) * TICK)
                viewer.log_state(state)
                viewer.end_frame()
            viewer.save_recording()
            os.replace(partial, path)
        finally:
            _quietly(viewer.close)
            partial.unlink(missing_ok=True)


def _viser(host: str, port: int) -> newton.viewer.ViewerViser:
    """A page on this port and no other: viser itself takes the next free one where it is taken."""
    require("teleop", "--viewer viser", ("viser",))
    _check_port(host, port)
    viewer = _quiet_viser(host, port)
    if viewer.server.get_port() != port:
        viewer.close()
        raise InputError(f"--viewer-port {port}: is taken at {host}; name another")
    return viewer


def _quiet_viser(host: str, port: int, record: Path | None = None) -> newton.viewer.ViewerViser:
    path = None if record is None else str(record)
    viewer: newton.viewer.ViewerViser = _quietly(
        lambda: newton.viewer.ViewerViser(
            host=host, port=port, label="arena_newton", verbose=False, record_to_viser=path
        )
    )
    return viewer


def _quietly[T](call: Callable[[], T]) -> T:
    """Call, and drop what viewers print whatever their settings."""
    with contextlib.redirect_stdout(io.StringIO()):
        return call()


def _rerun(host: str, port: int) -> newton.viewer.ViewerRerun:
    require("rerun", "--viewer rerun")
    for number in (port, port + 1):
        _check_port(host, number)
    return newton.viewer.ViewerRerun(app_id="arena_newton", web_port=port, grpc_port=port + 1)


def _check_port(host: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) else "no such port"
            raise InputError(f"--viewer-port {port}: cannot be served at {host} ({reason}); name another") from None


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


def _look(viewer: newton.viewer.ViewerViser, env: World, follow: bool, world: int = 0) -> None:
    """Start the camera of a page at the scene's own one, with its lens, or behind the robot of a world."""
    path = CAMERA_PRIMS["world"]
    lens = UsdGeom.Camera(env.scene.stage.GetPrimAtPath(path))
    robot = _chest(env, world)
    target, fov = robot, None
    if follow or not lens:
        root = env.scene.robot.root_qpos
        heading = heading_np(env.physics.qpos.numpy()[world, root + 3 : root + 7])
        eye = follow_pose(robot[:2], heading, walls=room_walls(env.scene.mj_model))[:3].astype(np.float64)
    else:
        frame = env.scene.frame(path)
        eye = np.asarray(frame.pos, dtype=np.float64)
        # A camera looks along its −z, the third column of its rotation negated; the page turns about the point where
        # the robot is nearest to that line.
        ahead = -matrix_from_quat_np(np.asarray(frame.quat))[:, 2]
        target = eye + ahead * max(NEAREST, float(ahead @ (robot - eye)))
        fov = 2.0 * np.degrees(np.arctan(0.5 * lens.GetVerticalApertureAttr().Get() / lens.GetFocalLengthAttr().Get()))
    offset = _offset(viewer)
    # Newton's own `set_camera` keeps the lens and the distance of the point that the page turns about.
    newton.viewer.ViewerViser._set_camera_request(viewer, eye + offset, target + offset, UP, fov=fov)


def _offset(viewer: newton.viewer.ViewerViser) -> np.ndarray:
    """Position at which the viewer puts the first world [m]."""
    if viewer.world_offsets is None:
        return np.zeros(3)
    first: np.ndarray = viewer.world_offsets.numpy()[0].astype(np.float64)
    return first


def _chest(env: World, world: int = 0) -> np.ndarray:
    """A point above the pelvis of a world's robot [m]."""
    root = env.scene.robot.root_qpos
    position: np.ndarray = env.physics.qpos.numpy()[world, root : root + 3].astype(np.float64)
    return position + (0.0, 0.0, CHEST)


def _gather(layer: Sdf.Layer, folder: Path) -> None:
    """Put copies of the textures that a layer names next to it, so that the folder is complete."""
    names: dict[str, str] = {}

    def beside(path: str) -> str:
        source = Path(path)
        if not source.is_absolute() or not source.is_file():
            return path
        if path not in names:
            taken = set(names.values())
            name = next(n for n in (source.name, *(f"{i}_{source.name}" for i in range(2, 999))) if n not in taken)
            if source.parent != folder.resolve():
                shutil.copyfile(source, folder / name)
            names[path] = name
        return f"./{names[path]}"

    UsdUtils.ModifyAssetPaths(layer, beside)


def _unused(folder: Path, name: str) -> Path:
    """A new folder of that name, numbered from the second on."""
    label = re.sub(r"[^A-Za-z0-9._-]+", "_", name)
    for number in range(1, 10_000):
        path = folder / (label if number == 1 else f"{label}-{number}")
        with contextlib.suppress(FileExistsError):
            path.mkdir(parents=True)
            return path
    raise InputError(f"--viewer usd: {folder / label}: too many recordings of that name")
