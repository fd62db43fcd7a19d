"""LeRobot's default image transforms, for a batch on the device: each sample has its own, three of six.

The paper enables them for pi0.5. LeRobot applies torchvision's to one picture at a time on the host; here parameters
are drawn for all samples from the device's default generator, as everything random in a step is, and nothing waits for
the device. At given parameters each transform is torchvision's (`torchvision.transforms.v2.functional`) of float
pictures; LeRobot's trainer transforms uint8, so that each rounds to whole grey levels.

Source: `ImageTransformsConfig` of LeRobot 0.6.1, which applies a random subset in the order below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from arena_newton.pictures.changed_looks import hue_lacks

__all__ = ["CHOSEN", "RANGES", "TRANSLATION", "TransformDraw", "drawn_transforms", "transformed"]

CHOSEN = 3
"""Transforms of a picture (`max_num_transforms`), all of equal weight."""
RANGES = {
    "brightness": (0.8, 1.2),
    "contrast": (0.8, 1.2),
    "saturation": (0.5, 1.5),
    "hue": (-0.05, 0.05),
    "sharpness": (0.5, 1.5),
    "affine": (-5.0, 5.0),
}
"""Transform → bounds of its factor, of the hue's turn [turns], of the rotation [degrees]; in their order."""
TRANSLATION = (0.05, 0.05)
"""Most shift of the affine transform, as a fraction of width and height."""
_GREY = (0.2989, 0.587, 0.114)
"""Weights of red, green and blue in torchvision's grey."""


@dataclass(frozen=True)
class TransformDraw:
    """Transforms drawn for each sample of a batch."""

    chosen: torch.Tensor
    """Chosen transforms, bool, shape [B, 6], in the order of `RANGES`."""
    values: torch.Tensor
    """Their parameters, float32, shape [B, 6]."""
    moved: torch.Tensor
    """Shift of the affine transform to the right and down [px], whole numbers as float32, shape [B, 2]."""


def drawn_transforms(batch: int, height: int, width: int, device: torch.device) -> TransformDraw:
    """Transforms of a batch, from the device's default generator."""
    chosen = torch.rand((batch, len(RANGES)), device=device).argsort(dim=1).argsort(dim=1) < CHOSEN
    uniform = torch.rand((batch, len(RANGES) + 2), device=device)
    parts = [low + (high - low) * uniform[:, i] for i, (low, high) in enumerate(RANGES.values())]
    most = (TRANSLATION[0] * width, TRANSLATION[1] * height)
    moved = [((2.0 * uniform[:, len(RANGES) + i] - 1.0) * most[i]).round() for i in range(2)]
    return TransformDraw(chosen, torch.stack(parts, dim=1), torch.stack(moved, dim=1))


def transformed(pictures: torch.Tensor, draw: TransformDraw) -> torch.Tensor:
    """Pictures after their transforms.

    Args:
        pictures: 0 to 1, float32, shape [B, 3, height, width].
        draw: What is done to each.
    """
    works = (_brightness, _contrast, _saturation, _hue, _sharpness)
    for number, work in enumerate(works):
        done = work(pictures, draw.values[:, number].view(-1, 1, 1, 1))
        pictures = torch.where(draw.chosen[:, number].view(-1, 1, 1, 1), done, pictures)
    turned = _affine(pictures, draw.values[:, len(works)], draw.moved)
    return torch.where(draw.chosen[:, len(works)].view(-1, 1, 1, 1), turned, pictures)


def _blend(one: torch.Tensor, other: torch.Tensor, ratio: torch.Tensor) -> torch.Tensor:
    return (one * ratio + other * (1.0 - ratio)).clamp_(0.0, 1.0)


def _grey(pictures: torch.Tensor) -> torch.Tensor:
    red, green, blue = pictures.unbind(dim=1)
    return (_GREY[0] * red + _GREY[1] * green + _GREY[2] * blue).unsqueeze(1)


def _brightness(pictures: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    return (pictures * factor).clamp_(0.0, 1.0)


def _contrast(pictures: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    """Nearer to the mean grey, or further away."""
    return _blend(pictures, _grey(pictures).mean(dim=(1, 2, 3), keepdim=True), factor)


def _saturation(pictures: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    return _blend(pictures, _grey(pictures), factor)


def _hue(pictures: torch.Tensor, turns: torch.Tensor) -> torch.Tensor:
    """Convert to hue, saturation and value, and back with another hue."""
    low, high = pictures.aminmax(dim=1, keepdim=True)
    span = torch.where(high == low, 1.0, high - low)
    to_red, to_green, to_blue = ((high - pictures) / span).split(1, dim=1)
    red, green, _ = pictures.split(1, dim=1)
    sixths = torch.where(
        high == red, to_blue - to_green, torch.where(high == green, 2.0 + to_red - to_blue, 4.0 + to_green - to_red)
    )
    sixths = 6.0 * torch.remainder(torch.remainder(sixths / 6.0, 1.0) + turns, 1.0)
    return high - (high - low) * hue_lacks(sixths.squeeze(1), 1)


def _sharpness(pictures: torch.Tensor, factor: torch.Tensor) -> torch.Tensor:
    """Nearer to a blurred picture, or further away; the border stays."""
    inner = pictures[:, :, 1:-1, 1:-1]
    blurred = (9.0 * torch.nn.functional.avg_pool2d(pictures, 3, stride=1) + 4.0 * inner) / 13.0
    done = pictures.clone()
    done[:, :, 1:-1, 1:-1] = inner + (blurred - inner) * (1.0 - factor)
    return done.clamp_(0.0, 1.0)


def _affine(pictures: torch.Tensor, degrees: torch.Tensor, moved: torch.Tensor) -> torch.Tensor:
    """Turned about the centre and shifted, the nearest pixel, black where nothing was seen."""
    height, width = pictures.shape[-2:]
    device = pictures.device
    across = torch.linspace((1.0 - width) * 0.5, (width - 1.0) * 0.5, width, device=device)
    down = torch.linspace((1.0 - height) * 0.5, (height - 1.0) * 0.5, height, device=device)
    angle = (degrees * (math.pi / 180.0)).view(-1, 1, 1)
    x = across.view(1, 1, -1) - moved[:, 0].view(-1, 1, 1)
    y = down.view(1, -1, 1) - moved[:, 1].view(-1, 1, 1)
    grid = torch.stack(
        [
            (torch.cos(angle) * x + torch.sin(angle) * y) / (0.5 * width),
            (torch.cos(angle) * y - torch.sin(angle) * x) / (0.5 * height),
        ],
        dim=-1,
    )
    return torch.nn.functional.grid_sample(pictures, grid, mode="nearest", padding_mode="zeros", align_corners=False)
