"""Procedural textures for the scenes: small, tileable, deterministic PNG files.

Every texture is a function that returns an RGB image as a uint8 array [height, width, 3]. Surfaces (all but the two
balls) tile without a seam; the balls are equirectangular maps, longitude along the width, north pole in the first row.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

__all__ = ["SIDE", "TEXTURES", "Color", "blend", "boards", "build", "football", "generator", "noise", "write"]

SIDE = 128
Color = tuple[int, int, int]
"""sRGB, 0 to 255."""


def generator(name: str) -> np.random.Generator:
    """A generator that depends on the texture's name only."""
    return np.random.default_rng(list(name.encode()))


def noise(rng: np.random.Generator, cells_y: int, cells_x: int) -> np.ndarray:
    """Smooth periodic value noise in [0, 1], shape [SIDE, SIDE]."""
    lattice = rng.random((cells_y, cells_x))

    def axis(cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at = np.arange(SIDE) * cells / SIDE
        low = at.astype(int)
        t = at - low
        return low % cells, (low + 1) % cells, t * t * (3 - 2 * t)

    y0, y1, ty = axis(cells_y)
    x0, x1, tx = axis(cells_x)
    top = lattice[y0][:, x0] * (1 - tx) + lattice[y0][:, x1] * tx
    bottom = lattice[y1][:, x0] * (1 - tx) + lattice[y1][:, x1] * tx
    return top * (1 - ty[:, None]) + bottom * ty[:, None]


def blend(low: Color, high: Color, amount: np.ndarray, levels: int = 16) -> np.ndarray:
    """Mix two colours by `amount` in [0, 1]; few levels keep the files small."""
    amount = np.round(np.clip(amount, 0, 1) * (levels - 1))[..., None] / (levels - 1)
    return np.round(np.asarray(low) * (1 - amount) + np.asarray(high) * amount).astype(np.uint8)


def grass() -> np.ndarray:
    """Bright artificial turf with short blades in two directions."""
    rng = generator("grass")
    blades = 0.45 * noise(rng, 64, 32) + 0.35 * noise(rng, 32, 64) + 0.2 * noise(rng, 6, 6)
    return blend((88, 158, 8), (172, 222, 44), (blades - 0.2) * 1.6)


def carpet() -> np.ndarray:
    """Looped wool, warm grey-red."""
    rng = generator("carpet")
    return blend((112, 62, 58), (158, 98, 88), 0.7 * noise(rng, 64, 64) + 0.3 * noise(rng, 5, 5))


def boards(name: str, low: Color, high: Color, joint: Color) -> np.ndarray:
    """Four planks with grain along the width, between two colours, and joints."""
    rng = generator(name)
    grain = 0.55 * noise(rng, 48, 3) + 0.3 * noise(rng, 24, 2) + 0.15 * noise(rng, 64, 16)
    planks = np.repeat(rng.random(4) * 0.35, SIDE // 4)[:, None]
    image = blend(low, high, 0.75 * grain + planks)
    image[:: SIDE // 4] = joint
    for plank in range(4):
        column = int(rng.integers(0, SIDE))
        image[plank * SIDE // 4 : (plank + 1) * SIDE // 4, column] = joint
    return image


def wood() -> np.ndarray:
    """Brown planks with dark joints."""
    return boards("wood", (126, 82, 46), (196, 146, 96), (84, 54, 32))


def tiles() -> np.ndarray:
    """Two by two pale tiles with grey grout."""
    rng = generator("tiles")
    shade = 0.6 * noise(rng, 8, 8) + 0.4 * np.kron(rng.random((2, 2)), np.ones((SIDE // 2, SIDE // 2)))
    image = blend((196, 192, 184), (224, 222, 216), shade)
    for start in (0, SIDE // 2):
        image[start : start + 3] = (136, 134, 130)
        image[:, start : start + 3] = (136, 134, 130)
    return image


def concrete() -> np.ndarray:
    """Polished grey floor with soft clouds and a little grit."""
    rng = generator("concrete")
    clouds = 0.5 * noise(rng, 3, 3) + 0.3 * noise(rng, 8, 8) + 0.2 * noise(rng, 48, 48)
    return blend((150, 149, 145), (184, 183, 179), clouds, levels=12)


def hazard() -> np.ndarray:
    """Yellow and black diagonal stripes."""
    y, x = np.mgrid[0:64, 0:64]
    return np.where((((x + y) // 32) % 2 == 0)[..., None], (236, 190, 20), (26, 26, 26)).astype(np.uint8)


def cardboard() -> np.ndarray:
    """Brown board with a paler strip of tape across the middle."""
    rng = generator("cardboard")
    fibres = 0.6 * noise(rng, 4, 64) + 0.4 * noise(rng, 12, 12)
    image = blend((164, 118, 70), (192, 146, 96), fibres, levels=12)
    image[56:72] = blend((198, 166, 122), (206, 176, 132), fibres[56:72], levels=4)
    image[:2] = image[-2:] = (132, 92, 54)
    image[:, :2] = image[:, -2:] = (132, 92, 54)
    return image


def directions(height: int, width: int) -> np.ndarray:
    """Unit vectors of an equirectangular map's texel centres, shape [height, width, 3]."""
    polar = (np.arange(height) + 0.5) / height * np.pi
    around = (np.arange(width) + 0.5) / width * 2 * np.pi
    sine, height_of = np.sin(polar)[:, None], np.repeat(np.cos(polar)[:, None], width, axis=1)
    return np.stack([sine * np.cos(around), sine * np.sin(around), height_of], axis=-1)


def football(
    pentagon: Color = (22, 22, 24), hexagons: Sequence[Color] = ((240, 240, 238),), seam: Color = (110, 110, 110)
) -> np.ndarray:
    """The classic ball: a truncated icosahedron, its 12 pentagons black, 20 hexagons white, grey seams.

    Several colours of hexagons follow each other.
    """
    golden = (1 + 5**0.5) / 2
    signs = [(0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    corners = np.array([np.roll(c, k) for k in range(3) for c in signs])
    corners /= np.linalg.norm(corners[0])
    sums = []
    for i in range(12):
        for j in range(i):
            for k in range(j):
                trio = corners[[i, j, k]]
                if np.min([trio[0] @ trio[1], trio[1] @ trio[2], trio[0] @ trio[2]]) > 0.4:
                    sums.append(trio.sum(axis=0))
    faces = np.array(sums) / np.linalg.norm(sums[0])
    # Distances of pentagons and hexagons from the centre, edge length 1: 2.32744 and 2.26728.
    planes = np.concatenate([corners / 2.32744, faces / 2.26728])
    reach = np.sort(directions(SIDE, 2 * SIDE) @ planes.T, axis=-1)
    face = np.argmax(directions(SIDE, 2 * SIDE) @ planes.T, axis=-1)
    colors = [pentagon] * 12 + [hexagons[k % len(hexagons)] for k in range(20)]
    image = np.array(colors, dtype=np.uint8)[face]
    image[reach[..., -1] - reach[..., -2] < 0.006] = seam
    return image


def basketball() -> np.ndarray:
    """Orange rubber with black seams: two great circles and two small circles."""
    rng = generator("basketball")
    direction = directions(SIDE // 2, SIDE)
    grain = rng.random(direction.shape[:2])
    image = blend((186, 84, 24), (212, 104, 36), grain, levels=4)
    x, y, z = np.moveaxis(direction, -1, 0)
    seam = (np.abs(x) < 0.035) | (np.abs(z) < 0.035) | (np.abs(np.abs(y) - 0.62) < 0.03)
    image[seam] = (28, 22, 20)
    return image


def net() -> np.ndarray:
    """White cords on grey, one mesh of the net per tile quarter."""
    image = np.full((64, 64, 3), (150, 152, 152), dtype=np.uint8)
    for start in range(0, 64, 16):
        image[start : start + 2] = (244, 244, 244)
        image[:, start : start + 2] = (244, 244, 244)
    return image


def steel() -> np.ndarray:
    """Brushed metal, grain along the width."""
    rng = generator("steel")
    return blend((150, 154, 158), (196, 200, 204), 0.7 * noise(rng, 128, 4) + 0.3 * noise(rng, 64, 8), levels=12)


def fabric() -> np.ndarray:
    """Off-white upholstery, a plain weave."""
    rng = generator("fabric")
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    weave = 0.5 + 0.25 * np.where((x // 2 + y // 2) % 2 == 0, 1.0, -1.0)
    return blend((206, 204, 200), (236, 235, 232), 0.6 * weave + 0.4 * noise(rng, 16, 16), levels=8)


def wall() -> np.ndarray:
    """Light grey plaster."""
    rng = generator("wall")
    return blend((172, 172, 170), (188, 188, 186), 0.6 * noise(rng, 4, 4) + 0.4 * noise(rng, 40, 40), levels=8)


def brick() -> np.ndarray:
    """Red brickwork in running bond, for changed rooms."""
    rng = generator("brick")
    shade = 0.5 * noise(rng, 32, 32) + 0.5 * np.kron(rng.random((8, 4)), np.ones((SIDE // 8, SIDE // 4)))
    image = blend((138, 62, 48), (182, 96, 74), shade, levels=12)
    for row in range(8):
        image[row * 16 : row * 16 + 2] = (188, 182, 172)
        for column in range(row % 2 * 16, SIDE, 32):
            image[row * 16 : row * 16 + 16, column : column + 2] = (188, 182, 172)
    return image


_ALL = (grass, carpet, wood, tiles, concrete, hazard, cardboard, football, basketball, net, steel, fabric, wall, brick)
TEXTURES: dict[str, Callable[[], np.ndarray]] = {draw.__name__: draw for draw in _ALL}
"""Every texture by name; the file is `textures/<name>.png`."""


def build(folder: Path) -> list[Path]:
    """Write every texture; see `write`."""
    return write(folder, TEXTURES)


def write(folder: Path, textures: Mapping[str, Callable[[], np.ndarray]]) -> list[Path]:
    """Write textures as `<folder>/<name>.png` and return their paths; the bytes are the same on every run."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, draw in textures.items():
        path = folder / f"{name}.png"
        Image.fromarray(draw()).save(path, optimize=True)
        paths.append(path)
    return paths
