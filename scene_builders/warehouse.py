"""The grey warehouse room of several scenes, and the mesh shapes its furniture is made of.

Lengths [m]. Room size: walls of the original near x = +0.55 and y = −6.5 (measured on its clips), the far walls
near x = −7.2 and behind the camera.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdPhysics

from arena_newton.tasks.base import ROOM
from scene_builders import author
from scene_builders.author import Vec
from scene_builders.solids import Solids

__all__ = ["FLOOR_X", "FLOOR_Y", "boxes", "room", "room_looks", "rounded_box"]

FLOOR_X, FLOOR_Y = zip(*ROOM, strict=True)
"""Extent of the room along x and y [m]."""
_HEIGHT = 3.3
_SKIRTING = 0.09

_FACES = [(axis, sign, u, v) for axis, u, v in ((0, 1, 2), (1, 0, 2), (2, 0, 1)) for sign in (1, -1)]
"""Faces of a box: axis and sign of the normal, axes of the texture."""


def boxes(
    stage: Usd.Stage, path: str, parts: Iterable[tuple[Vec, Vec]], *, look: Usd.Prim | None = None, tile: float = 1.0
) -> Usd.Prim:
    """One visual mesh made of several axis-aligned boxes `(half sizes, centre)`; its texture repeats every `tile` m."""
    shell = Solids()
    for half, centre in parts:
        shell.box(half, centre, tile=tile)
    return shell.write(stage, path, look=look)


def rounded_box(
    stage: Usd.Stage,
    path: str,
    half: Vec,
    position: Vec = (0, 0, 0),
    *,
    radius: float = 0.05,
    look: Usd.Prim | None = None,
) -> Usd.Prim:
    """A visual box with rounded edges, for cushions; `half` sizes include the rounding."""
    extent = np.asarray(half, dtype=float)
    radius = min(radius, *extent)
    inner = extent - radius
    points, faces, uv = [], [], []
    # Each face: corner fan, flat middle, corner fan.
    angles = np.linspace(0.0, np.pi / 4, 3)
    ramp = np.concatenate([-np.tan(angles[::-1]), np.tan(angles)])
    side, n = np.repeat([-1.0, 1.0], 3), 6
    for axis, sign, u, v in _FACES:
        first = len(points)
        for j in range(n):
            for i in range(n):
                direction = np.zeros(3)
                direction[axis], direction[u], direction[v] = sign, ramp[i], ramp[j]
                corner = np.zeros(3)
                corner[axis], corner[u], corner[v] = sign * inner[axis], side[i] * inner[u], side[j] * inner[v]
                p = corner + radius * direction / np.linalg.norm(direction)
                points.append(p)
                uv.append((p[u] + extent[u], p[v] + extent[v]))
        outward = sign > 0 if axis != 1 else sign < 0
        for j in range(n - 1):
            for i in range(n - 1):
                a = first + j * n + i
                b, c, d = a + 1, a + n + 1, a + n
                faces.extend([[a, b, c], [a, c, d]] if outward else [[a, c, b], [a, d, c]])
    return author.mesh(stage, path, np.round(points, 5), faces, position, uv=np.round(uv, 4), look=look)


def _plane(stage: Usd.Stage, path: str, position: Vec, quat: Vec, surface: Usd.Prim) -> Usd.Prim:
    """An invisible collision plane whose normal is local +z."""
    plane = UsdGeom.Plane.Define(stage, path)
    plane.AddTranslateOp().Set(Gf.Vec3d(*map(float, position)))
    plane.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(*map(float, quat)))
    plane.CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
    return author.bind_physics(plane.GetPrim(), surface)


def room_looks(
    stage: Usd.Stage, *, floor: str = "concrete", wall: str | None = None, skirting: Sequence[float] = (0.9, 0.9, 0.88)
) -> None:
    """The looks that `room` binds: floor and wall textures by name (no wall texture: the original's grey), skirting."""
    wall_texture = None if wall is None else f"../textures/{wall}.png"
    author.material(stage, "/World/Looks/Floor", (0.5, 0.5, 0.49), roughness=0.5, texture=f"../textures/{floor}.png")
    author.material(stage, "/World/Looks/Wall", (0.235, 0.245, 0.24), texture=wall_texture)
    author.material(stage, "/World/Looks/Skirting", skirting)


def room(stage: Usd.Stage, rough: Usd.Prim) -> None:
    """Floor, walls, skirting line and wall sockets; floor and walls also stop bodies (planes)."""
    tile = 2.0
    looks = {n: stage.GetPrimAtPath(f"/World/Looks/{n}") for n in ("Floor", "Wall", "Skirting")}
    (x0, x1), (y0, y1), h = FLOOR_X, FLOOR_Y, _HEIGHT
    cx, cy, lx, ly = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
    author.xform(stage, "/World/Room")
    author.quad(
        stage, "/World/Room/Floor", lx / 2, ly / 2, (cx, cy, 0), repeat=(lx / tile, ly / tile), look=looks["Floor"]
    )
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    points, faces, uv = [], [], []
    for i, start in enumerate(corners):
        end = corners[(i + 1) % 4]
        length, first = float(np.hypot(end[0] - start[0], end[1] - start[1])), len(points)
        points += [(*start, 0), (*end, 0), (*end, h), (*start, h)]
        uv += [(0, 0), (length / tile, 0), (length / tile, h / tile), (0, h / tile)]
        faces += [(first, first + 2, first + 1), (first, first + 3, first + 2)]  # wound to face inwards
    author.mesh(stage, "/World/Room/Walls", points, faces, uv=uv, look=looks["Wall"])
    s, t = _SKIRTING / 2, 0.01
    sockets = [((t, 0.04, 0.06), (x0 + t, y, 0.45)) for y in (-4.5, -2.0, 0.5, 3.0)]
    sockets += [((0.04, t, 0.06), (x, y, 0.45)) for x in (-5.5, -3.2, -1.0) for y in (y0 + t, y1 - t)]
    line = [((lx / 2, t, s), (cx, y, s)) for y in (y0 + t, y1 - t)]
    line += [((t, ly / 2, s), (x, cy, s)) for x in (x0 + t, x1 - t)]
    boxes(stage, "/World/Room/Skirting", [*line, *sockets], look=looks["Skirting"])
    r = float(np.sqrt(0.5))
    for name, position, quat in (
        ("Ground", (cx, cy, 0), (1, 0, 0, 0)),
        ("StopWest", (x0, cy, 0), (r, 0, r, 0)),
        ("StopEast", (x1, cy, 0), (r, 0, -r, 0)),
        ("StopSouth", (cx, y0, 0), (r, -r, 0, 0)),
        ("StopNorth", (cx, y1, 0), (r, r, 0, 0)),
    ):
        _plane(stage, f"/World/Room/{name}", position, quat, rough)
