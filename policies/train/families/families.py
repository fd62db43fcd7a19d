"""Policies of LeRobot as a trainer needs them: from a recipe, with a loss for CUDA graphs, saved for a stock LeRobot.

A batch is a dict of normalised tensors on the device: `observation.images.front` [B, 3, H, W] and so on of each camera
that the statistics name, `observation.state` [B, 64], for recipes with a task vector `observation.environment_state`
[B, tasks], `action` [B, n, 40] at the offsets `samples` of the model from the observation's tick, `action_is_pad` bool
[B, n]; for families that read the instruction either `task`, a list of strings, or its tokens (`tokens` of the model).
"""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import torch

from arena_newton.errors import InputError
from arena_newton.policies.recipes.training_recipe import FAMILIES, TrainingRecipe
from arena_newton.policies.train.families.policy_model import TrainableModel
from arena_newton.policies.train.frames.feature_scaling import Stats

__all__ = ["Model", "build", "check_weights"]

Model = TrainableModel
"""Model that `build` returns."""

_MODULES = {family: f"arena_newton.policies.train.families.{family}_family" for family in FAMILIES}


def build(
    recipe: TrainingRecipe, stats: Stats, device: str | torch.device, weights: str | Path | None = None
) -> TrainableModel:
    """A policy with new or pretrained weights, in training mode, and its processors.

    Args:
        stats: Statistics of the training's data, of its features before normalisation. Those of
            `observation.environment_state` say the width of the task vector.
        weights: Name on the Hugging Face hub or a local folder (of ResNet also the file) with pretrained weights: of
            the vision encoder, of pi0.5 the whole network. None: as the recipe says.

    Raises:
        InputError: Weights are not there or do not fit, or statistics are missing.
    """
    found = _module(recipe).build(recipe, stats, torch.device(device), weights)
    assert isinstance(found, TrainableModel)
    return found


def check_weights(recipe: TrainingRecipe, weights: str | Path | None = None) -> None:
    """Make sure that pretrained weights are there, before anything that takes time; they are not loaded.

    Args:
        weights: As of `build`. What is on the hub and not in its cache is downloaded.

    Raises:
        InputError: They are not there, or obviously those of something else.
    """
    _module(recipe).check_weights(recipe, weights)


def _module(recipe: TrainingRecipe) -> ModuleType:
    if recipe.family not in FAMILIES:
        raise InputError(f"--policy {recipe.family}: unknown, choose from {', '.join(FAMILIES)}")
    return importlib.import_module(_MODULES[recipe.family])
