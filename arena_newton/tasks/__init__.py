"""The seven tasks: one file each."""

import functools
import importlib

from arena_newton.errors import InputError
from arena_newton.tasks.base import Draws, Judge, LightDraw, ObjectSpec, Pose, TaskSpec

__all__ = ["Draws", "Judge", "LightDraw", "ObjectSpec", "Pose", "TaskSpec", "get", "names"]

_NAMES = ("football", "double_desk", "pp_box", "open_door", "sit_sofa", "boxing", "vis_navi")


def names() -> tuple[str, ...]:
    """Task names in the paper's order: three object tasks (HOI), four scene tasks (HSI)."""
    return _NAMES


@functools.cache
def get(name: str) -> TaskSpec:
    """A task by name.

    Raises:
        InputError: Unknown task.
    """
    if name not in _NAMES:
        raise InputError(f"--task {name}: unknown, choose from {', '.join(_NAMES)} or all")
    return importlib.import_module(f"arena_newton.tasks.{name}").TASK
