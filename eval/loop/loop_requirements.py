"""Requirements of a loop's stages besides each other, checked before the first one."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path

from arena_newton.cli.extras import require
from arena_newton.errors import InputError
from arena_newton.policies.recipes.training_recipe import FAMILIES

__all__ = ["SHIPPED", "check_disk", "check_folder", "check_libraries", "plan_path", "recorded_bytes"]

SHIPPED = Path(__file__).resolve().parent
"""Folder of the plans that come with the package."""

TICK_BYTES = 2_500
"""A recorded tick with its picture of 224x224, and the same in the dataset [bytes]; 1,800 and 700 were measured."""
TICK_PIXELS = 224 * 224
"""Pixels of that picture."""
SUCCESS_FRACTION = 0.3
"""Fraction of the step budget that a demonstration lasts: between a quarter (Boxing) and two thirds (VisNavi)."""
MARGIN_BYTES = 50_000_000
"""Journals, reports, and strips of the evaluation [bytes]."""


def check_libraries(family: str) -> None:
    """Refuse a loop for which an extra is missing.

    Raises:
        InputError: It is not installed; the message names it.
    """
    require("data", "eval loop")
    if family in FAMILIES and family != "act":
        require("policies", f"eval loop --policy {family}")


def plan_path(given: str) -> Path:
    """File of a plan: that file, or the one of a plan that comes with the package.

    Raises:
        InputError: There is none.
    """
    path = Path(given).expanduser()
    if not path.is_file() and re.fullmatch(r"[a-z0-9_]+", given):
        path = SHIPPED / f"{given}.toml"
    if not path.is_file():
        known = " ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        found = "is a folder, expected a file" if path.is_dir() else "no such file"
        raise InputError(f"--plan {given}: {found}; the package brings the plans {known}")
    return path


def check_folder(out: Path) -> None:
    """Refuse a folder that cannot be written; nothing is made.

    Raises:
        InputError: It is a file or in one, or may not be written.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out}: is a file")
    above = existing(out)
    if not above.is_dir():
        raise InputError(f"--out {out}: {above} is a file")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"--out {out}: cannot be written (no permission for {above})")


def existing(path: Path) -> Path:
    """The path itself, or the nearest one above it that is there."""
    absolute = path.absolute()
    return next(one for one in (absolute, *absolute.parents) if one.exists())


def recorded_bytes(budgets: Mapping[str, int], episodes: int, size: str) -> int:
    """Disk that recordings and their dataset take [bytes], estimated.

    Args:
        budgets: Task → most ticks of an episode.
        size: Of the pictures, such as `224x224`.
    """
    width, height = map(int, size.split("x"))
    ticks = episodes * SUCCESS_FRACTION * sum(budgets.values())
    return round(ticks * TICK_BYTES * min(1.0, width * height / TICK_PIXELS))


def check_disk(out: Path, needed: int) -> None:
    """Refuse a loop that cannot fit on the disk.

    Args:
        out: Folder of the loop, which need not be there; what is in it already counts as free.
        needed: What recordings, dataset and checkpoints take at the least [bytes].

    Raises:
        InputError: Less is free.
    """
    there = sum(file.lstat().st_size for file in out.rglob("*") if file.is_file()) if out.is_dir() else 0
    free = shutil.disk_usage(existing(out)).free + there
    if free < needed + MARGIN_BYTES:
        raise InputError(
            f"--out {out}: recordings, dataset and checkpoints take about {(needed + MARGIN_BYTES) / 1e9:.1f} GB, "
            f"{free / 1e9:.1f} GB are free there; choose a folder on another disk"
        )
