"""Parts of the product that need libraries which a bare evaluation does not: extras of the package."""

from __future__ import annotations

import importlib.util
import logging

from arena_newton.errors import InputError

__all__ = ["EXTRAS", "require"]

EXTRAS: dict[str, tuple[str, ...]] = {
    "data": ("pyarrow", "datasets", "pandas"),
    "docs": ("sphinx", "myst_parser", "pydata_sphinx_theme"),
    "gr00t": ("zmq", "msgpack"),
    "plots": ("matplotlib", "sklearn"),
    "policies": ("diffusers", "transformers", "scipy"),
    "ray": ("ray",),
    "rerun": ("rerun",),
    "serve": ("websockets", "msgpack"),
    "teleop": ("viser", "websockets", "redis"),
    "train": ("accelerate", "wandb"),
}
"""Extra → modules by which it is known to be installed."""


_LEROBOT = frozenset({"data", "policies", "train"})
"""Extras that LeRobot belongs to."""


def _no_torchcodec(record: logging.LogRecord) -> bool:
    """True for warnings of LeRobot's imports that are kept: all but pages of tracebacks on a machine without FFmpeg.

    Videos are read and written by PyAV here, which brings its own.
    """
    return not record.getMessage().startswith("Could not load libtorchcodec")


def require(extra: str, purpose: str, modules: tuple[str, ...] = ()) -> None:
    """Check that an extra is installed; nothing is imported. LeRobot's complaint of a missing torchcodec is silenced.

    Args:
        extra: Its name, a key of `EXTRAS`.
        purpose: What needs it, as the message begins: `data build`, `--viewer viser`.
        modules: Those of its modules that are needed; all by default.

    Raises:
        InputError: One is missing; the message names the extra and the command that installs it.
    """
    for module in modules or EXTRAS[extra]:
        if importlib.util.find_spec(module) is None:
            raise InputError(
                f"{purpose}: needs the extra [{extra}] ({module} is not installed): "
                f"uv sync --extra {extra}, or pip install 'arena-newton[{extra}]'"
            )
    if extra in _LEROBOT:
        logging.getLogger("lerobot.utils.import_utils").addFilter(_no_torchcodec)
