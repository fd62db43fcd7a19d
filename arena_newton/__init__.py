"""HumanoidArena on Newton/Warp.

A policy decides a 40D whole-body action, a tracker executes it, the simulator steps, a success rule scores. The names
of `__all__` are imported when they are first used, so that `import arena_newton` itself loads no library.
"""

import importlib
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from arena_newton import differentiable, policies, rule_sets, rules, tasks, trackers
    from arena_newton.env import ArenaEnv
    from arena_newton.pictures.camera import Camera
    from arena_newton.pictures.recorder import EpisodeRecorder
    from arena_newton.pictures.settings import CameraConfig
    from arena_newton.robot import canonical
    from arena_newton.rollout import Rollout

__all__ = [
    "ArenaEnv",
    "Camera",
    "CameraConfig",
    "EpisodeRecorder",
    "Rollout",
    "__version__",
    "canonical",
    "differentiable",
    "policies",
    "rule_sets",
    "rules",
    "tasks",
    "trackers",
]

__version__ = "0.1.0"

_HOMES = {
    "ArenaEnv": "arena_newton.env",
    "Camera": "arena_newton.pictures.camera",
    "CameraConfig": "arena_newton.pictures.settings",
    "EpisodeRecorder": "arena_newton.pictures.recorder",
    "Rollout": "arena_newton.rollout",
}
"""Public class → its module; the other public names are modules of this package."""
_ROOMS = {"canonical": "robot."}
"""Public module → its room, where it has one."""

_CHECKOUT = Path(__file__).resolve().parent.parent
# The checkout root holds a folder `kernels/`, which would shadow the package of that name that transformers imports.
if (_CHECKOUT / "pyproject.toml").is_file() and (_CHECKOUT / "kernels").is_dir():
    sys.path[:] = [p for p in sys.path if Path(p or ".").resolve() != _CHECKOUT]

_RUNS_MODULE = sys.argv[:1] == ["-m"] and "-m" in sys.orig_argv[:-1]
_IMPORTED = sys.orig_argv[sys.orig_argv.index("-m") + 1] if _RUNS_MODULE else ""
"""Module that `python -m` is about to run."""


def leave(number: int, frame: object) -> None:
    """Ctrl-C while a command's modules are imported, before `cli.command_line` can say so in its way."""
    os.write(2, b"\ninterrupted\n")
    os._exit(128 + number)


if signal.getsignal(signal.SIGINT) is signal.default_int_handler and (
    Path("".join(sys.argv[:1])).name == "arena-newton"
    or (_CHECKOUT.joinpath(*_IMPORTED.split("."), "__main__.py").is_file() and _IMPORTED.startswith("arena_newton"))
):
    signal.signal(signal.SIGINT, leave)


def __getattr__(name: str) -> object:
    """Import a public name at its first use."""
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    if name in __all__:
        return importlib.import_module(f"{__name__}.{_ROOMS.get(name, '')}{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
