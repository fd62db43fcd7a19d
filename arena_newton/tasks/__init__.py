"""The tasks: the paper's seven, one file each, and those that other packages register."""

import importlib

from arena_newton.errors import InputError
from arena_newton.tasks.base import Draws, LightDraw, ObjectSpec, Pose, Required, TaskSpec

__all__ = [
    "PAPER",
    "Draws",
    "LightDraw",
    "ObjectSpec",
    "Pose",
    "Required",
    "TaskSpec",
    "get",
    "names",
    "register",
    "unregister",
]

PAPER = ("football", "double_desk", "pp_box", "open_door", "sit_sofa", "boxing", "vis_navi")
"""The paper's tasks in its order: three object tasks, four scene tasks."""
_NAMES = PAPER
"""All tasks of this package; one that is not the paper's follows here."""
_registered: dict[str, TaskSpec] = {}


def names() -> tuple[str, ...]:
    """Task names: the paper's, then those registered."""
    return (*_NAMES, *_registered)


def get(name: str) -> TaskSpec:
    """A task by name.

    Raises:
        InputError: Unknown task.
    """
    if name in _registered:
        return _registered[name]
    if name not in _NAMES:
        raise InputError(f"--task {name}: unknown, choose from {', '.join(names())} or all")
    spec: TaskSpec = importlib.import_module(f"arena_newton.tasks.{name}").TASK
    return spec


def register(spec: TaskSpec) -> None:
    """Add a task in this process.

    Raises:
        InputError: The name is taken, or the task names no scene.
    """
    if spec.name in names() or spec.name == "all":
        raise InputError(f"task {spec.name!r}: the name is taken; register yours under another name")
    if spec.scene is None:
        raise InputError(f"task {spec.name!r}: `scene` must name the layer of its scene")
    _registered[spec.name] = spec


def unregister(name: str) -> None:
    """Remove a registered task; the paper's seven stay."""
    _registered.pop(name, None)
