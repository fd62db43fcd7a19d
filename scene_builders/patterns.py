"""Textures of the held-out looks: patterns of several hues, each used by one mode alone.

As in `textures` every pattern is a deterministic uint8 image [height, width, 3] that tiles without a seam.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from scene_builders.textures import SIDE, Color, blend, boards, football, generator, noise, write

__all__ = ["PATTERNS", "build"]


def _grain(colors: Sequence[Color], *octaves: tuple[float, int, int]) -> np.ndarray:
    """Smooth noise through `colors`; an octave is its weight and its cells along height and width."""
    rng = generator(f"grain {colors[0]}")
    height = np.sum([weight * noise(rng, rows, columns) for weight, rows, columns in octaves], axis=0)
    amount = np.round((height - height.min()) / np.ptp(height) * 15) / 15
    stops = np.linspace(0, 1, len(colors))
    return np.stack([np.interp(amount, stops, channel) for channel in zip(*colors, strict=True)], -1).astype(np.uint8)


def _bond(
    rows: int, columns: int, colors: Sequence[Color], joint: Color, stagger: float = 0.5, width: int = 2
) -> np.ndarray:
    """Rectangles in drawn colours with joints of `width` [px], every second row shifted by `stagger` of one."""
    rng = generator(f"bond {rows} {columns} {colors[0]}")
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    row = y * rows // SIDE
    x = (x + row % 2 * round(stagger * SIDE / columns)) % SIDE
    order = rng.permutation(rows * columns).reshape(rows, columns) % len(colors)
    image = np.array(colors, dtype=np.uint8)[order[row, x * columns // SIDE]]
    image[(y % (SIDE // rows) < width) | (x % (SIDE // columns) < width)] = joint
    return image


def _motifs(
    ground: Color, rings: Sequence[tuple[float, Color]], cells: int, norm: float = 2, lobes: int = 0, both: bool = True
) -> np.ndarray:
    """Nested shapes in the middle of `cells` squares a side and, with `both`, on their corners.

    `rings` are radii and colours, the widest first; shapes of radius 1 touch along a row. Discs have `norm` 2, diamonds
    1, squares a high one; `lobes` makes a star of so many points.
    """
    y, x = (np.mgrid[0:SIDE, 0:SIDE] + 0.5) * cells / SIDE
    image = np.full((SIDE, SIDE, 3), ground, dtype=np.uint8)
    for shift in (0.0, 0.5) if both else (0.0,):
        u, v = (x + shift) % 1 - 0.5, (y + shift) % 1 - 0.5
        radius = 2 * (np.abs(u) ** norm + np.abs(v) ** norm) ** (1 / norm)
        radius = radius * (1 + (0.24 * np.sin(lobes * np.arctan2(v, u)) if lobes else 0.0))
        for reach, color in rings:
            image[radius < reach] = color
    return image


def _ridges(low: Color, high: Color, count: int) -> np.ndarray:
    """Upright ribs, such as corrugated sheet metal."""
    across = np.broadcast_to(np.arange(SIDE) * count / SIDE, (SIDE, SIDE))
    return blend(low, high, 0.5 + 0.5 * np.cos(2 * np.pi * across), levels=8)


def _bands(*bands: tuple[int, Color]) -> np.ndarray:
    """Level bands from above, each its height [px] and colour."""
    rows = np.repeat(np.array([color for _, color in bands], dtype=np.uint8), [height for height, _ in bands], axis=0)
    return np.repeat(rows[:, None], SIDE, axis=1)


def _stripes(*stripes: tuple[int, Color]) -> np.ndarray:
    """Upright stripes from the left, each its width [px] and colour."""
    return _bands(*stripes).transpose(1, 0, 2)


def _forest(sky: Color, trees: Sequence[Color], snow: Color) -> np.ndarray:
    """Rows of pointed trees, the farthest first, between sky and snow."""
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    image = _bands((104, sky), (24, snow))
    for row, color in enumerate(trees):
        tip = np.abs((x + 11 * row) % 32 - 16) * 2.5 + 14 + 22 * row
        image[(y > tip) & (y < 106 + 4 * row)] = color
    return image


def _tartan(ground: Color, wide: Color, thin: Color) -> np.ndarray:
    """Crossing stripes, mixed where they cross, two setts a side."""
    thread = np.array((ground, wide, ground, thin), dtype=float)[np.repeat([0, 1, 0, 3, 0], (14, 22, 14, 4, 10))]
    thread = np.concatenate([thread, thread])
    return ((thread[:, None] + thread[None]) / 2).astype(np.uint8)


def _cross(ground: Color, cross: Color) -> np.ndarray:
    """A cross of equal arms in the middle."""
    image = _bands((SIDE, ground))
    image[28:100, 50:78] = image[50:78, 28:100] = cross
    return image


def _label(board: Color, foot: Color, label: Color, ink: Color) -> np.ndarray:
    """A box's face: board, a foot in another colour, and in the middle a label with a frame and two lines."""
    image = _bands((98, board), (30, foot))
    image[26:82, 26:102] = ink
    image[30:78, 30:98] = label
    image[42:48, 38:90] = image[58:64, 38:76] = ink
    return image


PATTERNS: dict[str, dict[str, Callable[[], np.ndarray]]] = {
    "semantic-2": {
        "parquet": partial(_bond, 8, 4, ((206, 152, 94), (190, 132, 76), (216, 168, 112)), (140, 92, 52), width=1),
        "bars": partial(_bands, (56, (150, 186, 214)), *[(5, (196, 140, 80)), (4, (72, 52, 40))] * 8),
        "goal": partial(_bands, (64, (206, 30, 40)), (64, (246, 244, 240))),
        "ball": partial(football, (24, 64, 160), ((252, 214, 60), (250, 250, 246)), (90, 90, 100)),
        "checks": partial(_motifs, (226, 222, 212), ((0.5, (44, 48, 58)),), 4, norm=64),
        "sheet": partial(_ridges, (186, 172, 132), (236, 226, 192), 8),
        "chipboard": partial(_grain, ((160, 112, 58), (206, 164, 100), (236, 206, 150)), (0.6, 40, 12), (0.6, 14, 44)),
        "terrazzo": partial(_grain, ((140, 104, 116), (232, 214, 206), (242, 226, 220), (150, 176, 168)), (1, 44, 44)),
        "drawers": partial(_motifs, (168, 190, 180), ((0.92, (238, 242, 236)), (0.16, (40, 120, 90))), 4, 16, 0, False),
        "medicine": partial(_label, (240, 240, 244), (110, 84, 170), (222, 214, 240), (110, 84, 170)),
        "aid": partial(_cross, (20, 130, 76), (250, 250, 250)),
        "straw": partial(_grain, ((150, 116, 58), (204, 172, 104), (232, 212, 156)), (1, 12, 44), (1, 44, 12)),
        "barn": partial(_stripes, *[(30, (146, 40, 30)), (2, (66, 18, 9)), (30, (160, 50, 36)), (2, (66, 18, 9))] * 2),
        "flags": partial(_bond, 4, 4, ((96, 90, 100), (112, 104, 112), (82, 78, 90)), (52, 50, 54)),
        "logs": partial(_bands, *[(3, (74, 40, 18)), (8, (150, 92, 44)), (14, (186, 122, 66)), (7, (128, 76, 36))] * 4),
        "tartan": partial(_tartan, (24, 84, 52), (150, 26, 34), (240, 200, 70)),
        "fleece": partial(_grain, ((206, 192, 164), (236, 226, 204), (250, 246, 236)), (0.6, 8, 8), (1, 40, 40)),
        "wrapping": partial(_motifs, (30, 70, 140), ((0.5, (240, 244, 250)),), 3, 2, 6),
        "rubber": partial(
            _grain, ((30, 32, 42), (40, 42, 54), (48, 50, 62), (44, 46, 58), (90, 150, 210)), (1, 60, 60)
        ),
        "studio": partial(_bands, (78, (244, 190, 166)), (8, (250, 246, 240)), (42, (112, 52, 104))),
        "marble": partial(_motifs, (208, 200, 194), ((1.0, (64, 104, 90)),), 2, 1.0, 0, False),
        "veined": partial(_grain, ((30, 28, 34), (44, 42, 50), (60, 56, 64), (216, 206, 196)), (1, 5, 9), (1, 14, 20)),
    },
    "semantic-3": {
        "snow": partial(_grain, ((206, 220, 238), (234, 240, 248), (252, 253, 255)), (1, 5, 5), (0.5, 40, 40)),
        "forest": partial(_forest, (168, 196, 222), ((96, 130, 130), (50, 92, 76), (24, 60, 46)), (236, 242, 250)),
        "ball": partial(football, (30, 26, 60), ((252, 64, 140),), (250, 230, 240)),
        "slabs": partial(_bond, 2, 2, ((128, 142, 112), (144, 156, 126), (112, 128, 100)), (62, 84, 44), width=3),
        "panes": partial(_bond, 2, 2, ((172, 214, 190), (188, 226, 204), (156, 204, 178)), (246, 250, 246), 0.0, 4),
        "slats": partial(boards, "slats", (116, 108, 98), (180, 172, 154), (48, 44, 40)),
        "tomato": partial(_grain, ((16, 54, 18), (52, 112, 38), (110, 166, 66), (214, 44, 26)), (1, 14, 14)),
        "slate": partial(_bond, 4, 2, ((54, 62, 76), (68, 76, 90), (44, 52, 64)), (120, 126, 130)),
        "amber": partial(_bond, 8, 8, ((198, 122, 42), (212, 140, 58), (182, 106, 32)), (240, 220, 176)),
        "bottles": partial(_label, (44, 88, 178), (30, 62, 136), (18, 28, 58), (226, 226, 220)),
        "chest": partial(_motifs, (92, 98, 106), ((0.84, (214, 174, 118)), (0.36, (176, 54, 40))), 1, 16, 0, False),
        "sandy": partial(_bond, 16, 16, ((228, 196, 168), (214, 176, 148), (238, 212, 188)), (250, 244, 236), 0.0, 1),
        "pool": partial(_bond, 16, 16, ((20, 140, 172), (44, 172, 194), (96, 204, 212)), (220, 238, 238), 0.0, 1),
        "deck": partial(boards, "deck", (70, 132, 168), (136, 190, 210), (40, 88, 120)),
        "awning": partial(_stripes, (64, (252, 246, 228)), (64, (240, 208, 128))),
        "sailor": partial(_bands, *[(16, (28, 44, 96)), (16, (244, 242, 234))] * 4),
        "hatbox": partial(_stripes, *[(16, (60, 176, 160)), (16, (248, 244, 234))] * 4),
        "sawdust": partial(_grain, ((186, 138, 78), (222, 180, 116), (242, 212, 162)), (0.5, 6, 6), (1, 30, 30)),
        "tent": partial(_stripes, *[(32, (176, 36, 40)), (32, (246, 232, 200))] * 2),
        "podium": partial(_motifs, (40, 60, 150), ((0.7, (250, 214, 80)),), 4, 2, 5),
        "teak": partial(boards, "teak", (132, 92, 56), (182, 136, 90), (44, 34, 28)),
        "portholes": partial(_motifs, (226, 232, 238), ((0.5, (170, 130, 60)), (0.4, (34, 64, 100))), 2, 2, 0, False),
        "container": partial(_ridges, (176, 64, 20), (234, 112, 44), 10),
    },
}
"""Mode → name → pattern; the file is `patterns/<mode>/<name>.png`."""


def build(folder: Path) -> list[Path]:
    """Write every pattern as `<folder>/<mode>/<name>.png`; the bytes are the same on every run."""
    return [path for mode, patterns in PATTERNS.items() for path in write(folder / mode, patterns)]
