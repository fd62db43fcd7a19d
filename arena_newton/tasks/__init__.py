"""The tasks: the paper's seven, one file each, and those of other packages: entry points, and what is registered."""

from arena_newton.cli.registry import Registry
from arena_newton.errors import InputError
from arena_newton.tasks.base import Draws, LightDraw, ObjectSpec, Pose, Required, TaskSpec
from arena_newton.tasks.interaction import Interaction

__all__ = [
    "OWN",
    "PAPER",
    "Draws",
    "Interaction",
    "LightDraw",
    "ObjectSpec",
    "Pose",
    "Required",
    "TaskSpec",
    "get",
    "names",
    "register",
    "specs",
    "unregister",
]

PAPER = ("football", "double_desk", "pp_box", "open_door", "sit_sofa", "boxing", "vis_navi")
"""The paper's tasks in its order: three object tasks, four scene tasks. `--task all` and the default run are these."""
OWN = PAPER
"""All tasks of this package; one that is not the paper's follows here."""
_TASKS: Registry[TaskSpec] = Registry(
    "task",
    "arena_newton.tasks",
    lambda: TaskSpec,
    {name: f"arena_newton.tasks.{name}:TASK" for name in OWN},
    named=True,
)


def names() -> tuple[str, ...]:
    """Task names: the package's own, then those of others."""
    return (*OWN, *(name for name in _TASKS.names() if name not in OWN))


def get(name: str) -> TaskSpec:
    """A task by name.

    Raises:
        InputError: Unknown task, or one whose package does not load or offers something else.
    """
    spec = _TASKS.make(name)
    return spec if name in OWN else _whole(spec)


def specs() -> tuple[TaskSpec, ...]:
    """All tasks in the order of `names`, without those of other packages that `get` refuses."""
    found = []
    for name in names():
        try:
            found.append(get(name))
        except InputError:
            if name in OWN:
                raise
    return tuple(found)


def register(spec: TaskSpec) -> None:
    """Add a task in this process.

    Raises:
        InputError: The name is taken, or the task names no scene.
    """
    if spec.name in names() or spec.name == "all":
        raise InputError(f"task {spec.name!r}: the name is taken; register yours under another name")
    _TASKS.register(_whole(spec).name, spec)


def unregister(name: str) -> None:
    """Remove a registered task; those of packages stay."""
    _TASKS.unregister(name)


def _whole(spec: TaskSpec) -> TaskSpec:
    """A task of another package, which must bring what this package has for its own."""
    if spec.scene is None:
        raise InputError(f"task {spec.name!r}: `scene` must name the layer of its scene")
    if spec.interaction is not None and not (spec.target or spec.interaction.sight):
        raise InputError(f"task {spec.name!r}: `target` must name the prim to find, as it has an `interaction`")
    return spec
