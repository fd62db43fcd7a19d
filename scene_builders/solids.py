"""Many simple solids in one textured mesh: rich scenes with few shapes to trace."""

from collections.abc import Sequence

import numpy as np
from pxr import Usd

from scene_builders import author
from scene_builders.author import Vec

__all__ = ["Solids"]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


class Solids:
    """Collects boxes, tubes, cords and rings and writes them as one triangle mesh with texture coordinates.

    Every face has its own vertices, so edges stay sharp; triangles wind counter-clockwise seen from outside.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._points: list[np.ndarray] = []
        self._uv: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        self._count = 0

    def _add(self, points: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> None:
        self._points.append(points)
        self._uv.append(uv)
        self._faces.append(faces + self._count)
        self._count += len(points)

    def quad(self, corners: Sequence[Vec], *, tile: float | None = None, two_sided: bool = False) -> "Solids":
        """A flat quadrilateral, counter-clockwise corners [m]; the texture repeats every `tile` m, or fills it once."""
        p = np.asarray(corners, dtype=float)
        width, height = np.linalg.norm(p[1] - p[0]), np.linalg.norm(p[3] - p[0])
        repeat = (1.0, 1.0) if tile is None else (width / tile, height / tile)
        uv = np.array([(0, 0), (repeat[0], 0), repeat, (0, repeat[1])], dtype=float)
        faces = np.array([(0, 1, 2), (0, 2, 3)])
        if two_sided:
            self._add(np.concatenate([p, p]), np.concatenate([uv, uv]), np.concatenate([faces, faces[:, ::-1] + 4]))
        else:
            self._add(p, uv, faces)
        return self

    def box(self, half: Vec, centre: Vec = (0, 0, 0), *, yaw: float = 0.0, tile: float | None = None) -> "Solids":
        """A box with half sizes `half` [m] around `centre`, turned by `yaw` [rad] about z."""
        h, turn = (
            np.asarray(half, dtype=float),
            np.array([(np.cos(yaw), -np.sin(yaw), 0), (np.sin(yaw), np.cos(yaw), 0), (0, 0, 1)]),
        )
        # Normal, then the direction of u; v follows. Side faces keep v upright.
        for normal, along in (
            ((1, 0, 0), (0, 1, 0)),
            ((-1, 0, 0), (0, -1, 0)),
            ((0, 1, 0), (-1, 0, 0)),
            ((0, -1, 0), (1, 0, 0)),
            ((0, 0, 1), (1, 0, 0)),
            ((0, 0, -1), (-1, 0, 0)),
        ):
            n, u, v = np.array(normal), np.array(along), np.cross(normal, along)
            corners = [(n + a * u + b * v) * h @ turn.T + centre for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            self.quad(corners, tile=tile)
        return self

    def tube(
        self,
        start: Vec,
        end: Vec,
        radius: float,
        *,
        taper: float = 1.0,
        sides: int = 10,
        tile: float | None = None,
    ) -> "Solids":
        """A round bar of `radius` [m], at its end `taper` times as thick, from `start` to `end`, open at its ends."""
        a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
        axis = _unit(b - a)
        across = _unit(np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0)))
        other = np.cross(axis, across)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        rim = radius * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * other)
        length = 1.0 if tile is None else np.linalg.norm(b - a) / tile
        around = angle / (2 * np.pi) * (1.0 if tile is None else max(1, round(2 * np.pi * radius / tile)))
        uv = np.concatenate([np.stack([around, np.zeros_like(angle)], 1), np.stack([around, angle * 0 + length], 1)])
        k, n = np.arange(sides), sides + 1
        faces = np.concatenate([np.stack([k, k + 1, k + n + 1], 1), np.stack([k, k + n + 1, k + n], 1)])
        self._add(np.concatenate([a + rim, b + taper * rim]), uv, faces)
        return self

    def cord(self, start: Vec, end: Vec, width: float, normal: Vec) -> "Solids":
        """A flat two-sided strip of `width` [m] from `start` to `end` in the plane with `normal`."""
        a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
        side = _unit(np.cross(normal, b - a)) * width / 2
        return self.quad([a - side, b - side, b + side, a + side], two_sided=True)

    def net(self, corners: Sequence[Vec], *, spacing: float, width: float) -> "Solids":
        """A net over a quadrilateral: cords of `width` [m] about every `spacing` [m] in both directions."""
        p = np.asarray(corners, dtype=float)
        normal = np.cross(p[1] - p[0], p[3] - p[0])
        across = max(np.linalg.norm(p[1] - p[0]), np.linalg.norm(p[2] - p[3]))
        along = max(np.linalg.norm(p[3] - p[0]), np.linalg.norm(p[2] - p[1]))
        for t in np.linspace(0, 1, round(across / spacing) + 1):
            self.cord(p[0] + t * (p[1] - p[0]), p[3] + t * (p[2] - p[3]), width, normal)
        for t in np.linspace(0, 1, round(along / spacing) + 1):
            self.cord(p[0] + t * (p[3] - p[0]), p[1] + t * (p[2] - p[1]), width, normal)
        return self

    def ring(self, inner: float, outer: float, centre: Vec) -> "Solids":
        """A flat ring in the xy plane facing +z, radii [m]."""
        sides = 64
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        rim = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        points = np.concatenate([inner * rim, outer * rim]) + np.asarray(centre, dtype=float)
        k, n = np.arange(sides), sides + 1
        faces = np.concatenate([np.stack([k, k + n, k + n + 1], 1), np.stack([k, k + n + 1, k + 1], 1)])
        self._add(points, points[:, :2], faces)
        return self

    def ball(self, radius: float) -> "Solids":
        """A sphere of `radius` [m] whose texture is an equirectangular map with its north pole in the first row."""
        rings = 20
        polar = np.linspace(0, np.pi, rings + 1)
        around = np.linspace(0, 2 * np.pi, 2 * rings + 1)
        theta, phi = (g.reshape(-1) for g in np.meshgrid(polar, around, indexing="ij"))
        unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
        uv = np.stack([phi / (2 * np.pi), 1 - theta / np.pi], axis=1)
        row = 2 * rings + 1
        i, j = (g.reshape(-1) for g in np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij"))
        a, b = i * row + j, (i + 1) * row + j
        lower = np.stack([a, b, b + 1], 1)[i < rings - 1]
        upper = np.stack([a, b + 1, a + 1], 1)[i > 0]
        self._add(radius * unit + 0.0, uv, np.concatenate([lower, upper]))
        return self

    def write(self, stage: Usd.Stage, path: str, *, look: Usd.Prim | None = None) -> Usd.Prim:
        """Write everything collected as one visual mesh at `path`."""
        return author.mesh(
            stage,
            path,
            np.concatenate(self._points).round(6),
            np.concatenate(self._faces),
            uv=np.concatenate(self._uv).round(6),
            look=look,
        )
