"""Textures of the held-out looks: patterns of several hues, each used by one mode alone.

As in `textures` every pattern is a deterministic uint8 image [height, width, 3] that tiles without a seam.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from scene_builders.textures import SIDE, Color, blend, boards, football, generator, noise, write

__all__ = ["PATTERNS", "build"]


def _weave(low: Color, high: Color, cells: int, grain: tuple[int, int]) -> np.ndarray:
    """A chequer of `cells` a side whose grain runs along and across in turn, such as parquet and wicker."""
    rng = generator(f"weave {low} {high}")
    y, x = np.mgrid[0:SIDE, 0:SIDE] * cells // SIDE
    along, across = noise(rng, *grain), noise(rng, *grain[::-1])
    edge = np.mgrid[0:SIDE, 0:SIDE] % (SIDE // cells) < 1
    return blend(low, high, np.where((x + y) % 2, along, across) * np.where(edge.any(axis=0), 0.3, 1.0))


def _bands(colors: Sequence[Color], *, slope: int = 0, across: Sequence[Color] = ()) -> np.ndarray:
    """Stripes of one width each along the height, leaning by whole turns `slope`; `across` mixes in as a plaid."""
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    image = np.array(colors)[(x + slope * y) * len(colors) // SIDE % len(colors)]
    if across:
        image = (image + np.array(across)[y * len(across) // SIDE]) // 2
    return image.astype(np.uint8)


def _chequer(colors: Sequence[Color], cells: int) -> np.ndarray:
    """Squares whose colours follow each other along and across."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] * cells // SIDE
    return np.array(colors, dtype=np.uint8)[(x + y) % len(colors)]


def _cells(rows: int, columns: int, colors: Sequence[Color], *, joint: Color | None = None) -> np.ndarray:
    """Rectangles in drawn colours, each colour equally often but for the rest, with joints of two pixels."""
    rng = generator(f"cells {rows} {columns} {colors[0]}")
    order = rng.permutation(rows * columns).reshape(rows, columns) % len(colors)
    image = np.kron(np.array(colors, dtype=np.uint8)[order], np.ones((SIDE // rows, SIDE // columns, 1), np.uint8))
    if joint is not None:
        for start in range(2):
            image[start :: SIDE // rows] = joint
            image[:, start :: SIDE // columns] = joint
    return image


def _stones(count: int, colors: Sequence[Color], joint: Color, width: float) -> np.ndarray:
    """Irregular pieces around drawn points in joints of `width` [px]: stained glass, paving, terrazzo."""
    rng = generator(f"stones {count} {colors[0]}")
    points = rng.random((count, 2)) * SIDE
    away = np.abs(np.indices((SIDE, SIDE)).transpose(1, 2, 0)[:, :, None] - points)
    distance = np.linalg.norm(np.minimum(away, SIDE - away), axis=-1)
    first, second = np.sort(distance, axis=-1)[..., :2].transpose(2, 0, 1)
    image = np.array(colors, dtype=np.uint8)[np.argmin(distance, axis=-1) % len(colors)]
    image[second - first < width] = joint
    return image


def _flecks(ground: Color, colors: Sequence[Color], fraction: float) -> np.ndarray:
    """Granulate: grains of two pixels on a ground, a fraction of them coloured."""
    rng = generator(f"flecks {ground}")
    grains = rng.random((SIDE // 2, SIDE // 2))
    shade = blend(ground, tuple(min(255, c + 18) for c in ground), grains, levels=3)  # type: ignore[arg-type]
    drawn = np.array(colors, dtype=np.uint8)[rng.integers(0, len(colors), grains.shape)]
    image = np.where((rng.random(grains.shape) < fraction)[..., None], drawn, shade)
    return image.repeat(2, axis=0).repeat(2, axis=1)


def _clouds(colors: Sequence[Color], cells: int) -> np.ndarray:
    """Large soft shapes, one colour each, like a painted wall."""
    rng = generator(f"clouds {colors[0]}")
    height = noise(rng, cells, cells)
    rank = np.argsort(np.argsort(height, axis=None)).reshape(height.shape)
    return np.array(colors, dtype=np.uint8)[rank * len(colors) // rank.size]


def _turf() -> np.ndarray:
    """Mown grass: a pale and a dark band, with blades."""
    rng = generator("turf")
    blades = 0.5 * noise(rng, 64, 32) + 0.5 * noise(rng, 32, 64)
    light = np.where(np.arange(SIDE) < SIDE // 2, 0.55, 0.0)
    return blend((22, 84, 40), (98, 168, 88), 0.45 * blades + light)


def _parcel(board: Color, tape: Color, label: Color, ink: Color) -> np.ndarray:
    """A box's face: board with tape along and across, and a label with lines of print."""
    image = np.full((SIDE, SIDE, 3), board, dtype=np.uint8)
    image[54:74] = image[:, 54:74] = tape
    image[12:46, 80:120] = label
    image[18:40:6, 84:116] = ink
    return image


PATTERNS: dict[str, dict[str, Callable[[], np.ndarray]]] = {
    "semantic-2": {
        "turf": _turf,
        "ball": partial(football, (28, 62, 170), ((244, 244, 240), (244, 244, 240), (214, 44, 40)), (90, 90, 96)),
        "hoarding": partial(
            _cells, 2, 4, ((196, 40, 52), (28, 74, 150), (240, 240, 236), (24, 120, 110), (232, 146, 40))
        ),
        "lino": partial(_chequer, ((52, 104, 84), (226, 218, 192)), 4),
        "wallpaper": partial(
            _bands, ((214, 200, 170), (214, 200, 170), (120, 150, 160), (214, 200, 170), (168, 74, 70), (120, 150, 160))
        ),
        "wicker": partial(_weave, (118, 76, 34), (222, 176, 104), 8, (32, 8)),
        "parcel": partial(_parcel, (54, 96, 168), (226, 226, 222), (240, 214, 150), (60, 40, 40)),
        "parquet": partial(_weave, (66, 36, 22), (146, 92, 58), 4, (32, 3)),
        "tartan": partial(
            _bands,
            ((150, 30, 40), (150, 30, 40), (24, 60, 70), (150, 30, 40), (232, 206, 150), (24, 60, 70)),
            across=((150, 30, 40), (24, 60, 70), (150, 30, 40), (150, 30, 40), (232, 206, 150), (24, 60, 70)),
        ),
        "runner": partial(
            _bands, ((236, 222, 190), (40, 110, 120), (236, 222, 190), (208, 96, 50), (60, 50, 80), (208, 96, 50))
        ),
        "rubber": partial(_flecks, (40, 40, 44), ((70, 120, 190), (190, 80, 60), (200, 200, 200)), 0.16),
        "crate": partial(boards, "crate", (150, 104, 60), (214, 168, 110), (70, 44, 24)),
        "door": partial(boards, "door", (30, 84, 62), (72, 140, 104), (14, 40, 30)),
    },
    "semantic-3": {
        "court": partial(_cells, 4, 4, ((44, 88, 150), (52, 98, 162), (38, 80, 140)), joint=(60, 104, 166)),
        "ball": partial(football, (110, 30, 130), ((246, 204, 40), (250, 246, 236)), (40, 30, 50)),
        "bars": partial(boards, "bars", (196, 138, 78), (232, 186, 124), (120, 74, 40)),
        "terrazzo": partial(
            _stones, 420, ((232, 226, 214),) * 5 + ((206, 120, 104), (70, 128, 130), (60, 60, 66)), (222, 214, 200), 2.2
        ),
        "mural": partial(_clouds, ((232, 188, 160), (206, 110, 92), (70, 106, 120), (238, 214, 150), (64, 70, 96)), 4),
        "pavers": partial(
            _stones, 26, ((150, 112, 104), (122, 100, 112), (172, 142, 122), (98, 98, 112)), (66, 62, 64), 2.0
        ),
        "glass": partial(
            _stones,
            22,
            ((196, 40, 50), (40, 90, 180), (240, 190, 60), (60, 150, 90), (226, 226, 236)),
            (24, 22, 24),
            2.5,
        ),
        "mosaic": partial(
            _cells, 16, 16, ((30, 110, 130), (80, 170, 180), (214, 230, 226), (24, 70, 110)), joint=(196, 196, 188)
        ),
        "mats": partial(
            _cells, 2, 2, ((178, 64, 58), (60, 96, 160), (214, 206, 190), (70, 70, 82)), joint=(40, 40, 44)
        ),
        "barrier": partial(_bands, ((36, 70, 150), (236, 236, 232), (36, 70, 150), (196, 60, 120)), slope=1),
        "gift": partial(_parcel, (150, 32, 84), (236, 190, 60), (150, 32, 84), (244, 226, 232)),
        "quilt": partial(
            _cells, 4, 4, ((52, 110, 92), (226, 190, 120), (170, 70, 60), (60, 76, 110)), joint=(236, 228, 212)
        ),
    },
}
"""Mode → name → pattern; the file is `patterns/<mode>/<name>.png`."""


def build(folder: Path) -> list[Path]:
    """Write every pattern as `<folder>/<mode>/<name>.png`; the bytes are the same on every run."""
    return [path for mode, patterns in PATTERNS.items() for path in write(folder / mode, patterns)]
