"""Textures of the held-out looks: patterns of several hues, each used by one mode alone.

As in `textures` every pattern is a deterministic uint8 image [height, width, 3] that tiles without a seam.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from scene_builders.textures import SIDE, Color, blend, football, generator, noise, write

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
    """Upright ribs, such as corduroy and the shell of a suitcase."""
    across = np.broadcast_to(np.arange(SIDE) * count / SIDE, (SIDE, SIDE))
    return blend(low, high, 0.5 + 0.5 * np.cos(2 * np.pi * across), levels=8)


def _bands(*bands: tuple[int, Color]) -> np.ndarray:
    """Level bands from above, each its height [px] and colour."""
    rows = np.repeat(np.array([color for _, color in bands], dtype=np.uint8), [height for height, _ in bands], axis=0)
    return np.repeat(rows[:, None], SIDE, axis=1)


def _facade(plaster: Color, frame: Color, pane: Color, plinth: Color) -> np.ndarray:
    """A house front: plinth, plaster and one window with a cross bar."""
    image = _bands((96, plaster), (32, plinth))
    image[20:76, 30:98] = frame
    image[24:46, 34:62] = image[24:46, 66:94] = image[50:72, 34:62] = image[50:72, 66:94] = pane
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
        "sand": partial(_grain, ((172, 136, 90), (212, 180, 128), (234, 212, 168)), (1, 12, 5), (0.5, 40, 32)),
        "sea": partial(_bands, (40, (150, 200, 236)), (12, (226, 236, 240)), (40, (20, 84, 150)), (36, (36, 150, 168))),
        "ball": partial(football, (16, 104, 110), ((250, 246, 236), (236, 120, 30)), (60, 70, 74)),
        "linoleum": partial(_grain, ((184, 116, 52), (206, 146, 76), (220, 170, 104)), (1, 3, 7), (0.9, 20, 28)),
        "mat": partial(_bond, 8, 8, ((18, 92, 74), (22, 100, 80)), (150, 206, 170), 0.0, 1),
        "books": partial(_bond, 4, 16, ((120, 34, 30), (36, 62, 96), (196, 166, 112), (60, 88, 60)), (34, 22, 16)),
        "felt": partial(_grain, ((14, 54, 38), (26, 84, 56), (44, 104, 68)), (1, 4, 4), (0.8, 48, 48)),
        "mahogany": partial(_grain, ((62, 18, 12), (122, 42, 24), (156, 72, 40)), (1, 2, 20), (0.5, 4, 64)),
        "archive": partial(_label, (120, 140, 160), (84, 104, 126), (238, 232, 214), (40, 44, 60)),
        "folio": partial(_label, (140, 24, 40), (70, 12, 24), (244, 226, 170), (50, 16, 20)),
        "damask": partial(_motifs, (104, 24, 44), ((0.8, (176, 126, 62)), (0.5, (120, 34, 52))), 4, lobes=4),
        "diamonds": partial(_motifs, (24, 40, 92), ((0.5, (202, 164, 76)), (0.34, (150, 40, 50))), 4, norm=1.0),
        "circles": partial(_motifs, (240, 224, 190), ((0.96, (224, 110, 30)), (0.6, (104, 54, 26))), 4, both=False),
        "pile": partial(_grain, ((66, 30, 16), (112, 58, 28), (146, 82, 42)), (0.6, 6, 6), (1, 40, 40)),
        "rug": partial(_motifs, (236, 222, 190), ((0.88, (214, 100, 30)), (0.7, (128, 70, 36))), 1, 6.0, both=False),
        "corduroy": partial(_ridges, (150, 100, 16), (226, 170, 44), 12),
        "mover": partial(_label, (244, 240, 226), (190, 50, 40), (110, 118, 50), (244, 240, 226)),
        "tatami": partial(_bond, 2, 1, ((190, 180, 116), (206, 192, 132)), (30, 44, 70), width=5),
        "shoji": partial(_bond, 4, 4, ((238, 232, 216), (230, 220, 200)), (74, 44, 26), 0.0, 4),
        "lounge": partial(_bond, 4, 4, ((66, 50, 118), (84, 62, 140), (52, 64, 130), (98, 70, 148)), (0, 0, 0), 0.0, 0),
        "glazing": partial(_bond, 1, 2, ((150, 196, 230), (176, 212, 238)), (50, 56, 66), 0.0, 6),
        "shell": partial(_ridges, (6, 84, 86), (40, 158, 150), 8),
    },
    "semantic-3": {
        "asphalt": partial(_grain, ((48, 50, 58), (66, 68, 76), (92, 92, 98)), (0.6, 4, 4), (1, 56, 56)),
        "school": partial(_facade, (236, 216, 160), (250, 250, 246), (70, 104, 140), (150, 70, 56)),
        "ball": partial(football, (30, 34, 84), ((246, 136, 26),), (250, 240, 220)),
        "metro": partial(_bond, 8, 4, ((168, 196, 142), (182, 206, 154), (152, 184, 130)), (236, 236, 224)),
        "quarry": partial(_bond, 8, 8, ((116, 38, 30), (134, 50, 38), (98, 32, 30)), (196, 176, 156), 0.0),
        "butcher": partial(_bond, 8, 2, ((214, 166, 104), (196, 142, 80), (226, 184, 126)), (130, 84, 44), width=1),
        "clouds": partial(_grain, ((84, 158, 222), (110, 180, 234), (250, 250, 250)), (1, 3, 4), (0.4, 10, 12)),
        "puzzle": partial(_bond, 4, 4, ((246, 190, 200), (250, 226, 140), (170, 224, 206)), (250, 250, 250), 0.0),
        "dots": partial(_motifs, (110, 50, 140), ((0.46, (246, 240, 250)),), 4),
        "star": partial(_motifs, (8, 150, 160), ((0.8, (252, 224, 80)), (0.36, (226, 60, 80))), 1, 2, 5, False),
        "vinyl": partial(_grain, ((66, 146, 132), (94, 174, 156), (140, 204, 184)), (0.5, 5, 5), (1, 44, 44)),
        "zellige": partial(_motifs, (240, 230, 206), ((0.96, (176, 78, 44)), (0.6, (240, 230, 206))), 4, lobes=8),
        "kilim": partial(_motifs, (186, 58, 44), ((0.74, (240, 214, 160)), (0.5, (40, 90, 84))), 2, norm=1.0),
        "pouf": partial(_motifs, (236, 226, 208), ((0.78, (30, 60, 140)), (0.44, (236, 226, 208))), 1, 2, 6, False),
        "track": partial(_grain, ((128, 44, 32), (156, 60, 42), (176, 82, 60)), (0.5, 5, 5), (1, 52, 52)),
        "blocks": partial(_bond, 8, 4, ((232, 206, 132), (224, 194, 116), (240, 216, 148)), (186, 160, 104)),
        "gravel": partial(_grain, ((136, 88, 66), (170, 118, 92), (204, 158, 130)), (0.4, 4, 4), (1, 60, 60)),
        "limestone": partial(_bond, 4, 2, ((214, 196, 150), (198, 178, 132), (226, 210, 170)), (150, 132, 100)),
        "boxwood": partial(_grain, ((10, 46, 20), (34, 96, 36), (112, 160, 60)), (0.7, 16, 16), (1, 36, 36)),
    },
}
"""Mode → name → pattern; the file is `patterns/<mode>/<name>.png`."""


def build(folder: Path) -> list[Path]:
    """Write every pattern as `<folder>/<mode>/<name>.png`; the bytes are the same on every run."""
    return [path for mode, patterns in PATTERNS.items() for path in write(folder / mode, patterns)]
