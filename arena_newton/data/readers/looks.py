"""Looks of recorded pictures: a film without loss that says what each pixel shows and what a second light makes of it.

Each frame has three bytes per pixel, and the size of the camera's pictures:

| channel | byte |
|---|---|
| red | 0 nothing (background, black bars), 1 the robot, from 2 on the shapes in the order of `Looks.shapes` |
| green, blue | luminance under a second light over that under the episode's: 128 + 32 log2(ratio); equal with one |

A dataset has the films in `looks/`, one per episode, and `looks/looks.json`; LeRobot knows of neither.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from arena_newton.errors import InputError
from arena_newton.files.stored_json import Fit, Json, loaded, read_object, shown
from arena_newton.pictures.settings import FIGURES, FIRST_SHAPE

__all__ = ["FIRST_SHAPE", "LOOKS_FOLDER", "MOST_LIGHTS", "MOST_SHAPES", "SCHEMA", "DatasetLooks", "Looks"]
__all__ += ["dataset_looks", "described_looks", "film_path"]

SCHEMA = "arena_looks_v1"
"""Version of films and their description."""
LOOKS_FOLDER = "looks"
"""Folder of a dataset's films and of their list."""
MOST_SHAPES = 256 - FIGURES - FIRST_SHAPE
"""Shapes that bytes can name; the last bytes are of figures that a training draws."""
MOST_LIGHTS = 2
"""Second lights of an episode: a picture has three channels."""


def _are_lights(value: Json) -> bool:
    return 1 <= len(value) <= MOST_LIGHTS and all(len(light) in (1, 4) for light in value)


def _are_shapes(value: Json) -> bool:
    return len(value) <= MOST_SHAPES and all(0.0 <= chance <= 1.0 for _, chance in value)


@dataclass(frozen=True)
class Looks:
    """Meaning of the bytes of a film."""

    stride: Annotated[int, Fit("1 to 1000", lambda value: 1 <= value <= 1000)]
    """Rows from one frame to the next; the first one is that of row 0."""
    lights: Annotated[tuple[tuple[float, ...], ...], Fit("one or two lists, [intensity, direction]", _are_lights)]
    """Second lights: intensity, and of a distant light its direction (unit vector from the light to the scene)."""
    shapes: Annotated[tuple[tuple[str, float], ...], Fit(f"at most {MOST_SHAPES} prims and probabilities", _are_shapes)]
    """Prim of each shape, and the probability with which it may get another colour."""

    def frames(self, rows: int) -> int:
        """Frames of an episode of so many rows."""
        return -(-rows // self.stride)

    def chances(self) -> np.ndarray:
        """Probability with which the shape of each byte may get another colour, float32, shape [256]."""
        found = np.zeros(256, np.float32)
        found[FIRST_SHAPE : FIRST_SHAPE + len(self.shapes)] = [chance for _, chance in self.shapes]
        return found

    def objects(self) -> np.ndarray:
        """First byte of the object that the shape of each byte is part of, int64, shape [256].

        An object is what is directly under `/World`; walls and floor of a room are each its own. So is a part of
        another kind: a lever that got the colour of its door could not be found.
        """
        found, known = np.arange(256), dict[tuple[str, float], int]()
        for byte, (prim, kind) in enumerate(self.shapes, FIRST_SHAPE):
            name = prim if prim.startswith("/World/Room/") else "/".join(prim.split("/")[:3])
            found[byte] = known.setdefault((name, kind), byte)
        return found

    def plain(self) -> dict[str, object]:
        """Description as JSON."""
        lights, shapes = [list(light) for light in self.lights], [list(shape) for shape in self.shapes]
        return {"schema": SCHEMA, "stride": self.stride, "lights": lights, "shapes": shapes}

    @classmethod
    def read(cls, value: object, where: str) -> Looks:
        """Description that a file holds.

        Raises:
            InputError: It is of another version, or damaged; `where` names it.
        """
        stored = value if isinstance(value, dict) else {}
        if (schema := stored.get("schema")) != SCHEMA:
            raise InputError(f"{where}: schema is {shown(schema)}, expected {SCHEMA}")
        return loaded(where, stored, cls)


@dataclass(frozen=True)
class DatasetLooks:
    """Film of one episode of a dataset."""

    episode: int
    path: Path
    looks: Looks
    sha256: str
    """SHA-256 of the file, in hexadecimal digits."""


def described_looks(films: Sequence[tuple[Looks, str] | None]) -> bytes:
    """Content of `looks/looks.json`: description and SHA-256 of each episode's film; None for one without."""
    listed = [None if film is None else film[0].plain() | {"sha256": film[1]} for film in films]
    return json.dumps({"schema": SCHEMA, "episodes": listed}, indent=1).encode()


def film_path(root: Path, episode: int) -> Path:
    """Film of a dataset's episode."""
    return root / LOOKS_FOLDER / f"episode_{episode:06d}.mp4"


def dataset_looks(root: Path, episodes: int) -> list[DatasetLooks | None]:
    """Films of a dataset's episodes; None for an episode without one.

    Raises:
        InputError: The list is damaged, of another version or of other episodes, or a film is missing.
    """
    path = root / LOOKS_FOLDER / "looks.json"
    if not path.parent.is_dir():
        return [None] * episodes
    content = read_object(path, 64 << 20)
    listed = content.get("episodes")
    if content.get("schema") != SCHEMA:
        raise InputError(f"{path}: schema is {shown(content.get('schema'))}, expected {SCHEMA}")
    if not isinstance(listed, list) or len(listed) != episodes:
        raise InputError(f"{path}: episodes is no list of {episodes}, as many as the dataset has")
    found: list[DatasetLooks | None] = []
    for number, entry in enumerate(listed):
        if entry is None:
            found.append(None)
            continue
        where = f"{path}: episode {number}"
        looks = Looks.read(entry, where)
        digest = entry.get("sha256")
        if not isinstance(digest, str):
            raise InputError(f"{where}: sha256 is missing")
        film = film_path(root, number)
        if not film.is_file() or film.is_symlink():
            raise InputError(f"{film}: is missing")
        found.append(DatasetLooks(number, film, looks, digest))
    return found
