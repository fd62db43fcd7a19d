"""The first lines of a variant: a layer over a task's scene that may be stored anywhere."""

import os
from pathlib import Path

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.usd_scenes.dependencies import PACKAGE
from arena_newton.usd_scenes.shapes import open_stage

__all__ = ["write"]

_TEXT = """#usda 1.0
(
    "A variant of the task {task}: says only what is different from its scene."
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    # Found in the installed package, so this file may be stored anywhere.
    subLayers = [@{scene}@]
)

over "World"
{{
    # Write every attribute on a line of its own. What the task needs, and what rules read:
{prims}
    over "Light"
    {{
        color3f inputs:color = {color}
    }}
}}
"""


def write(task: str, path: str | Path) -> Path:
    """Write a variant that validates, runs and changes nothing.

    Args:
        path: The `.usda` file; one that exists stays as it is.

    Returns:
        The path.

    Raises:
        InputError: Unknown task, another kind of file, or the file exists or cannot be written.
    """
    path = Path(path)
    if task not in tasks.names():
        raise InputError(f"unknown task {task!r}; tasks are {', '.join(tasks.names())}")
    if path.suffix != ".usda":
        raise InputError(f"{path}: expected a name that ends in .usda")
    spec = tasks.get(task)
    prims = "".join(f"    #   {item.path} ({item.kind})\n" for item in spec.requires if not item.variants)
    scene = os.path.relpath(spec.scene, path.parent) if spec.scene else f"{PACKAGE}{task}/scene.usda"
    text = _TEXT.format(task=task, scene=scene, prims=prims, color=_light(spec.layer))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"{path}: exists already, choose another name") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def _light(scene: Path) -> str:
    """Colour of the scene's light, as USD writes it."""
    stage = open_stage(scene, checked=False)
    color = stage.GetPrimAtPath("/World/Light").GetAttribute("inputs:color").Get()
    return f"({', '.join(f'{value:g}' for value in color)})"
