"""Build every layer of the project: textures, robot, one scene per task, and the lab."""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.usd_scenes.patterns import PATTERNS
from arena_newton.usd_scenes.textures import write_all

__all__ = ["FOLDER", "build_all", "parts"]

FOLDER = Path(__file__).resolve().parent
"""Folder of the layers in the project."""


def parts() -> tuple[str, ...]:
    """Parts that can be built, in order; without tasks that bring their own layer."""
    return ("textures", "g1", *(name for name in tasks.names() if tasks.get(name).scene is None), "lab")


def build_all(folder: Path = FOLDER, names: Sequence[str] = ()) -> list[Path]:
    """Write the named parts (all by default) under `folder` and return what was written.

    Layers refer to each other by relative paths, so a build elsewhere must hold the robot and the textures too.

    Raises:
        InputError: A name is not a part.
    """
    for name in names:
        if name not in parts():
            raise InputError(f"unknown part {name!r}; parts are {', '.join(parts())}")
    written = []
    for name in names or parts():
        target = folder / name
        target.mkdir(parents=True, exist_ok=True)
        if name == "textures":
            write_all(target)
            for mode, patterns in PATTERNS.items():
                write_all(target / mode, patterns)
            written.append(target)
        elif name == "g1":
            path = target / "g1.usda"
            import_module("arena_newton.usd_scenes.g1.build").build(path)
            written.append(path)
        else:
            import_module(f"arena_newton.usd_scenes.{name}.build").build(target)
            written.append(target / "scene.usda")
    return written
