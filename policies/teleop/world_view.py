"""The world as the page shows it: Newton's viewer on viser, with a camera that follows the robot.

viser serves whoever asks; here its socket needs the page's token and viser's own `Origin`, as the page's does.
"""

from __future__ import annotations

import contextlib
import http
import io
import math
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import newton.viewer
import numpy as np
import websockets.asyncio.server
from pxr import UsdGeom
from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.typing import Origin

from arena_newton.errors import InputError
from arena_newton.pictures.camera import CAMERA_PRIMS
from arena_newton.pictures.follow import WALL_GAP, room_walls
from arena_newton.policies.protocols.ports import LOCAL, bind, names_this_machine
from arena_newton.policies.serve.connection_guard import same_token
from arena_newton.policies.teleop.driving import CAMERAS
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import heading_np

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv

__all__ = ["PERIOD", "WorldView"]

PERIOD = 0.04
"""Time between two pictures of the world [s]."""
EYE = (-2.1, 0.55, 0.95)
"""The following camera: ahead of, left of and above the pelvis [m]."""
AIM = (0.9, 0.0, -0.05)
"""The point that it looks at, likewise [m]."""
SWING = 0.8
"""Time in which the camera takes up a turn of the robot [s]."""
AHEAD = 0.8
"""Least time between two states of the world, in frames of the page."""
PANEL = 300
"""Width of viser's own panel, which the page hides [px]; its style sheet names it too."""
FOV = 0.95
"""Height of the following camera's view [rad]."""


class WorldView:
    """Shows the one world of an environment at an address of its own."""

    def __init__(self, env: ArenaEnv, port: int, token: str):
        """Begin to serve.

        Args:
            port: TCP port of viser; 0 takes a free one.
            token: What the socket's address must name.

        Raises:
            InputError: The port is taken.
        """
        with bind(port, "--view-port") as probe:  # viser itself takes the next port where this one is taken
            port = int(probe.getsockname()[1])
        with contextlib.redirect_stdout(io.StringIO()), _guarded(port, token):
            self._viewer = newton.viewer.ViewerViser(host=LOCAL, port=port, label="arena_newton", verbose=False)
        server = self._viewer.server
        if server.get_port() != port:
            self.close()
            raise InputError(f"--view-port {port}: cannot be served at {LOCAL} (taken); name another port")
        self.url = f"http://{LOCAL}:{port}/?websocket=ws://{LOCAL}:{port}/{token}"
        """Address of viser's page, with the token of its socket."""
        self.camera = CAMERAS[0]
        """One of `driving.CAMERAS`."""
        self.frames = 30.0
        """Frames per second that the page draws."""
        self._drawn = 0.0
        self._env = env
        self._state = env.scene.model.state()
        self._ticks = 0
        self._walls = room_walls(env.scene.mj_model)
        self._yaw: float | None = None
        self._seen: set[tuple[int, str]] = set()
        """Pages that have the camera that they keep."""
        self._room = _room_camera(env)
        self._viewer.set_model(env.scene.model)
        server.gui.reset()  # Newton's panel: nothing of it is a person's who drives
        server.gui.main_panel.dock_right()  # the page shows what is left of it
        server.gui.main_panel.set_width(PANEL)
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)

    def draw(self) -> None:
        """Show the world as it is now, unless the page has not drawn the last one yet.

        A browser without a graphics card draws a few frames a second; what is sent beyond them it draws seconds later.
        """
        now = time.monotonic()
        if now - self._drawn < AHEAD / self.frames:
            return
        self._drawn = now
        self._env.physics.write_newton_state(self._state)
        self._ticks += 1
        self._viewer.begin_frame(self._ticks * TICK)
        self._viewer.log_state(self._state)
        self._viewer.end_frame()
        self._aim()

    def _aim(self) -> None:
        """Let the cameras of all pages go with the robot; the others are set once."""
        robot = self._env.scene.robot.root_qpos
        root = self._env.physics.qpos.numpy()[0, robot : robot + 7].astype(np.float64)
        yaw = heading_np(root[3:])
        before = yaw if self._yaw is None else self._yaw
        turn = math.remainder(yaw - before, 2.0 * math.pi)
        self._yaw = before + turn * (1.0 - math.exp(-PERIOD / SWING))
        follows = self.camera == "follow"
        for number, client in self._viewer.server.get_clients().items():
            if not follows and (number, self.camera) in self._seen:
                continue
            first = (number, self.camera) not in self._seen
            self._seen = {seen for seen in self._seen if seen[0] != number} | {(number, self.camera)}
            if self.camera == "room":
                eye, aim, fov = self._room
            elif follows:
                eye, aim, fov = self._behind(root[:3], self._yaw)
            else:
                continue
            with client.atomic():
                if first:
                    client.camera.fov = fov
                    client.camera.up_direction = np.array([0.0, 0.0, 1.0])
                client.camera.position = eye
                client.camera.look_at = aim

    def _behind(self, pelvis: np.ndarray, yaw: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Position and aim of the following camera [m], and the height of its view [rad]."""
        cos, sin = math.cos(yaw), math.sin(yaw)

        def at(ahead: float, left: float, up: float) -> np.ndarray:
            point: np.ndarray = pelvis + (cos * ahead - sin * left, sin * ahead + cos * left, up)
            return point

        eye = at(*EYE)
        for normal, distance in self._walls:
            eye = eye + normal * max(0.0, distance + WALL_GAP - float(normal @ eye))
        return eye, at(*AIM), FOV

    def close(self) -> None:
        """End viser."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._viewer.close()


def _room_camera(env: ArenaEnv) -> tuple[np.ndarray, np.ndarray, float]:
    """Position and aim of the scene's own camera [m], and the height of its view [rad]."""
    path = CAMERA_PRIMS["world"]
    frame = env.scene.frame(path)
    eye = np.asarray(frame.pos, dtype=np.float64)
    w, x, y, z = (float(v) for v in frame.quat)
    # A camera looks along its −z: the third column of its rotation, negated.
    ahead = -np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    lens = UsdGeom.Camera(env.scene.stage.GetPrimAtPath(path))
    half = 0.5 * float(lens.GetVerticalApertureAttr().Get()) / float(lens.GetFocalLengthAttr().Get())
    return eye, eye + 3.0 * ahead, 2.0 * math.atan(half)


@contextlib.contextmanager
def _guarded(port: int, token: str) -> Iterator[None]:
    """While viser starts, its server is made to check token, `Host` and `Origin`: it has no option for that."""
    serve: Callable[..., object] = websockets.asyncio.server.serve
    hosts = [f"{name}:{port}" for name in (LOCAL, "localhost")]

    def guarded(*args: object, process_request: Callable[..., Response | None], **options: object) -> object:
        def answer(connection: object, request: Request) -> Response | None:
            named = same_token(request.path.strip("/"), token)
            wants_socket = bool(request.headers.get_all("Upgrade"))
            if not names_this_machine(request.headers.get_all("Host")) or (wants_socket and not named):
                return Response(http.HTTPStatus.NOT_FOUND.value, "Not Found", Headers({"Content-Length": "0"}), b"")
            return process_request(connection, request)

        origins = [Origin(f"http://{host}") for host in hosts]
        return serve(*args, process_request=answer, origins=origins, **options)

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
