"""Picture preparation of the original's policy server: resized and padded as the checkpoint's training did it.

The original trains on 640x480 pictures and lists what happens to them as image transforms of LeRobot's training
configuration, `train_config.json`. Its server applies those that are deterministic, `Resize` and `Pad`, in their order,
and no other (`lerobot/scripts/serve_lerobot_vla_http.py` of github.com/Allenhetl/HumanoidArena at 822e4e9).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from arena_newton.errors import InputError
from arena_newton.files.stored_json import read_object

__all__ = ["MOST_JSON", "TRAIN_CONFIG", "PicturePreparation"]

TRAIN_CONFIG = "train_config.json"
"""LeRobot's file of a training's options, next to the weights."""
MOST_JSON = 8 * 2**20
"""Largest JSON file of a checkpoint that is read [bytes]; the tokens of a prompt are in files of their own."""
MODES = ("bilinear", "nearest", "bicubic", "area")
"""Kinds of interpolation that need no more than the picture."""
SMOOTH = ("bilinear", "bicubic")
"""Those of them that are filtered when they shrink a picture."""
LARGEST = 4096
"""Largest width and height of a prepared picture [px]."""


@dataclass(frozen=True)
class PictureStep:
    """One `Resize` or `Pad`."""

    size: tuple[int, int] | None = None
    """Height and width after a `Resize` [px]; None: this is a `Pad`."""
    mode: str = "bilinear"
    """Interpolation of a `Resize`."""
    padding: tuple[int, int, int, int] = (0, 0, 0, 0)
    """Pixels that a `Pad` adds on the left, on top, on the right and below."""
    fill: float = 0.0
    """Value of those pixels, 0 to 1."""


@dataclass(frozen=True)
class PicturePreparation:
    """Steps that a picture goes through before LeRobot's own processors see it."""

    steps: tuple[PictureStep, ...]

    def __call__(self, pictures: torch.Tensor) -> torch.Tensor:
        """Prepared pictures.

        Args:
            pictures: uint8, shape [B, H, W, 3].

        Returns:
            uint8, shape [B, height, width, 3]: rounded, as the original's server hands them on.
        """
        values = pictures.permute(0, 3, 1, 2).to(torch.float32) / 255.0
        for step in self.steps:
            if step.size is None:
                left, top, right, bottom = step.padding
                values = torch.nn.functional.pad(values, (left, right, top, bottom), value=step.fill)
            elif step.mode in SMOOTH:
                values = torch.nn.functional.interpolate(
                    values, size=step.size, mode=step.mode, align_corners=False, antialias=True
                )
            else:
                values = torch.nn.functional.interpolate(values, size=step.size, mode=step.mode)
        return values.clamp(0.0, 1.0).mul(255.0).round().to(torch.uint8).permute(0, 2, 3, 1)

    @classmethod
    def read(cls, folder: Path) -> PicturePreparation | None:
        """Read a checkpoint's `train_config.json`; None where it has no such file, or names no such step.

        Raises:
            InputError: The file is damaged, or names steps that the original's server refuses too.
        """
        path = folder / TRAIN_CONFIG
        if not path.is_file():
            return None
        transforms = _table(read_object(path, MOST_JSON).get("dataset") or {}, path, "dataset")
        chosen = _table(transforms.get("image_transforms") or {}, path, "dataset.image_transforms")
        listed = _table(chosen.get("tfs") or {}, path, "dataset.image_transforms.tfs")
        if not chosen.get("enable"):
            return None
        steps = []
        for name, entry in listed.items():
            where = f"dataset.image_transforms.tfs.{name}"
            spec = _table(entry, path, where)
            weight = spec.get("weight", 1.0)
            if not isinstance(weight, int | float):
                raise InputError(f"{path}: {where}.weight is {weight!r:.40}, expected a number")
            if weight > 0.0 and spec.get("type") in ("Resize", "Pad"):
                options = _table(spec.get("kwargs") or {}, path, f"{where}.kwargs")
                steps.append(_step(str(spec["type"]), options, path, f"{where}.kwargs"))
        if not steps:
            return None
        most = chosen.get("max_num_transforms", len(listed))
        if chosen.get("random_order") or not isinstance(most, int) or most < len(steps):
            raise InputError(
                f"{path}: dataset.image_transforms applies its {len(steps)} Resize and Pad steps at random, expected "
                "random_order false and max_num_transforms of at least as many"
            )
        return cls(tuple(steps))


def _table(value: object, path: Path, where: str) -> Mapping[str, object]:
    if not isinstance(value, dict):
        raise InputError(f"{path}: {where} is {type(value).__name__}, expected an object")
    return value


def _step(kind: str, options: Mapping[str, object], path: Path, where: str) -> PictureStep:
    if kind == "Resize":
        size = _integers(options.get("size"), 1, LARGEST)
        mode = options.get("interpolation", "bilinear")
        if size is None or len(size) != 2:
            raise InputError(f"{path}: {where}.size is {options.get('size')!r:.60}, expected height and width [px]")
        if mode not in MODES:
            raise InputError(f"{path}: {where}.interpolation is {mode!r:.40}, expected one of {', '.join(MODES)}")
        return PictureStep(size=(size[0], size[1]), mode=str(mode))
    given = options.get("padding")
    border = _integers([given] if isinstance(given, int) else given, 0, LARGEST)
    fill = options.get("fill", 0)
    if border is None or len(border) not in (1, 2, 4):
        expected = "a number, [x, y] or [left, top, right, bottom]"
        raise InputError(f"{path}: {where}.padding is {given!r:.60}, expected {expected} [px]")
    if isinstance(fill, bool) or not isinstance(fill, int | float) or not 0.0 <= fill <= 1.0:
        raise InputError(f"{path}: {where}.fill is {fill!r:.40}, expected 0 to 1")
    left, top, right, bottom = (border * 4)[:4] if len(border) < 4 else border
    return PictureStep(padding=(left, top, right, bottom), fill=float(fill))


def _integers(value: object, low: int, high: int) -> list[int] | None:
    """Whole numbers of a list within limits; None where it is something else."""
    if not isinstance(value, Sequence) or isinstance(value, str):
        return None
    found = [n for n in value if isinstance(n, int) and not isinstance(n, bool) and low <= n <= high]
    return found if len(found) == len(value) else None
