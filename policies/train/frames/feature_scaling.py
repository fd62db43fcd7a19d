"""Scaling of the data's numbers for a network: a factor and an offset each, the same as LeRobot's processors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from arena_newton.errors import InputError
from arena_newton.policies.recipes.training_recipe import TrainingRecipe

__all__ = ["EPS", "IMAGENET_MEAN", "IMAGENET_STD", "Scaling", "Stats", "scalings", "usable_stats"]

Stats = Mapping[str, Mapping[str, torch.Tensor]]
"""Feature → `mean`, `std`, `min`, `max`, `q01`, `q99`."""
IMAGENET_MEAN = (0.485, 0.456, 0.406)
"""Mean of each colour of ImageNet's pictures, 0 to 1 (LeRobot's `IMAGENET_STATS`)."""
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Standard deviation of each."""
EPS = 1e-8
"""Addend of LeRobot to a standard deviation (`NormalizerProcessorStep.eps`)."""
_RANGES = (("min", "max"), ("q01", "q99"), ("q10", "q90"))
_PICTURES = "observation.images."


@dataclass(frozen=True)
class Scaling:
    """`value * factor + offset` is what the network receives."""

    factor: torch.Tensor
    offset: torch.Tensor

    def normalise(self, value: torch.Tensor) -> torch.Tensor:
        """Inputs of the network, float32; safe in a CUDA graph."""
        return value.float() * self.factor + self.offset

    def restore(self, value: torch.Tensor) -> torch.Tensor:
        """The reverse of `normalise`."""
        return (value - self.offset) / self.factor


def usable_stats(recipe: TrainingRecipe, stats: Stats) -> dict[str, dict[str, torch.Tensor]]:
    """Statistics by which can be divided, float32 on the CPU.

    Numbers that hardly change (hands, the reserved slots of v4) get the recipe's floor as standard deviation and twice
    the floor as range, around the middle of theirs. Pictures get ImageNet's, as LeRobot's trainer gives them.

    Raises:
        InputError: A feature's statistics are missing or not finite.
    """
    floors = {"action": recipe.action_std_floor, "observation.state": recipe.state_std_floor}
    found: dict[str, dict[str, torch.Tensor]] = {}
    for feature in ("observation.state", "action"):
        if "mean" not in stats.get(feature, {}):
            raise InputError(f"statistics of {feature}: missing, expected mean, std, min, max, q01 and q99")
    for feature, given in stats.items():
        if feature.startswith(_PICTURES):
            continue
        values = {
            name: torch.as_tensor(value).detach().float().cpu().clone()
            for name, value in given.items()
            if name in ("mean", "std", *sum(_RANGES, ()))
        }
        for name, value in values.items():
            if not bool(torch.isfinite(value).all()):
                raise InputError(f"statistics of {feature}: {name} is not finite")
        floor = floors.get(feature, 0.0)
        if floor and "std" in values:
            values["std"] = values["std"].clamp_min(floor)
        for low, high in _RANGES:
            if floor and low in values and high in values:
                middle, narrow = (values[low] + values[high]) / 2, values[high] - values[low] < 2 * floor
                values[low] = torch.where(narrow, middle - floor, values[low])
                values[high] = torch.where(narrow, middle + floor, values[high])
        found[feature] = values
    colours = {"mean": torch.tensor(IMAGENET_MEAN), "std": torch.tensor(IMAGENET_STD)}
    colours |= {"min": torch.zeros(3), "max": torch.ones(3)}
    for camera in [one for one in stats if one.startswith(_PICTURES)] or [f"{_PICTURES}front"]:
        found[camera] = {name: value.reshape(3, 1, 1) for name, value in colours.items()}
    return found


def scalings(modes: Mapping[str, str], stats: Stats, device: torch.device) -> dict[str, Scaling]:
    """Factor and offset of each feature.

    Args:
        modes: Feature → name of LeRobot's `NormalizationMode`.
        stats: As `usable_stats` returns them.

    Raises:
        InputError: A mode is not known, or its statistics are missing.
    """
    found: dict[str, Scaling] = {}
    for feature, mode in modes.items():
        given = stats.get(feature, {})
        match mode:
            case "IDENTITY":
                factor, offset = torch.ones(()), torch.zeros(())
            case "MEAN_STD" if {"mean", "std"} <= set(given):
                factor = 1.0 / (given["std"] + EPS)
                offset = -given["mean"] * factor
            case "MIN_MAX" | "QUANTILES" | "QUANTILE10":
                low, high = dict(zip(("MIN_MAX", "QUANTILES", "QUANTILE10"), _RANGES, strict=True))[mode]
                if not {low, high} <= set(given):
                    raise InputError(f"statistics of {feature}: {low} and {high} are missing, which {mode} needs")
                width = given[high] - given[low]
                factor = 2.0 / torch.where(width == 0, torch.full_like(width, EPS), width)
                offset = -1.0 - given[low] * factor
            case _:
                raise InputError(f"statistics of {feature}: {mode} needs mean and std, or is not known")
        found[feature] = Scaling(factor.to(device), offset.to(device))
    return found
