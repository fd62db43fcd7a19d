"""Flags that say by whom and how many episodes are played: refused where they cannot be, before anything is started."""

from __future__ import annotations

import math
import re

from arena_newton.cli.extras import require
from arena_newton.errors import InputError
from arena_newton.eval.plan.options import RunOptions

__all__ = ["RAY_FLAGS", "check_ray", "check_width"]

RAY_FLAGS = ("ray_actors", "ray_cpus", "ray_gpus", "ray_minutes", "ray_attempts")
"""Flags that belong to --ray."""


def check_width(options: RunOptions) -> None:
    """Refuse a rule for the number of episodes that cannot be one.

    Raises:
        InputError: A number is out of range, or a flag does not go with it.
    """
    width, most = options.until_width, options.max
    if width is None:
        if most is not None:
            raise InputError("--max: belongs to --until-width, which is not given")
        return
    if not 0 < width < 1:
        raise InputError(f"--until-width {width:g}: expected more than 0 and less than 1, such as 0.14")
    if most is not None and most < 1:
        raise InputError(f"--max {most}: expected at least 1")
    if options.shard is not None:
        raise InputError("--shard: does not go with --until-width, whose episodes follow from the earlier ones")


def check_ray(options: RunOptions) -> None:
    """Refuse a cluster that cannot be asked for, before one is looked for.

    Raises:
        InputError: A number is out of range, a flag does not go with it, or the extra is missing.
    """
    if options.ray is None:
        for name in RAY_FLAGS:
            if getattr(options, name) != getattr(RunOptions, name):
                raise InputError(f"{_flag(name)}: belongs to --ray, which is not given")
        return
    addresses = [text for text in options.ray if text == "auto" or re.fullmatch(r"[^/\s]+:[0-9]{1,5}", text)]
    if len(options.ray) > 1 or len(addresses) < len(options.ray):
        raise InputError(f"--ray {' '.join(options.ray)}: expected one address, such as 10.0.0.1:6379, auto, or none")
    for name in ("ray_actors", "ray_cpus", "ray_attempts"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise InputError(f"{_flag(name)} {value}: expected at least 1")
    gpus, minutes = options.ray_gpus, options.ray_minutes
    if gpus is not None and not 0 < gpus <= 1:
        raise InputError(f"--ray-gpus {gpus:g}: expected more than 0 and at most 1; an environment is on one GPU")
    if not 0 < minutes < math.inf:
        raise InputError(f"--ray-minutes {minutes:g}: expected more than 0, and finite")
    if options.viewer is not None:
        raise InputError("--viewer: shows worlds of this process, and with --ray none are; drop one of both")
    require("ray", "--ray")


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
