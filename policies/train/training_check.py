"""Requirements of a training besides its data, checked before anything that takes time: `check_training`."""

from __future__ import annotations

import math

import torch

from arena_newton import tasks
from arena_newton.physics.devices import torch_device
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames.frame_store import made_statistics
from arena_newton.policies.train.network_compiler import check_compiler
from arena_newton.policies.train.network_memory import checkpoint_bytes
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from arena_newton.policies.train.training import chosen_recipe

__all__ = ["check_training"]

UNBUILT = ("pi05",)
"""Families whose network takes minutes and tens of gigabytes to build: their weights are only looked for."""


def check_training(options: PolicyTrainOptions) -> int:
    """Refuse a training that cannot begin, whatever its data; its datasets need not be there yet.

    Pretrained weights are looked for, downloaded where they are on the hub, and put into the network, which reads the
    instructions of all tasks: weights of another network and a tokenizer that is missing are found here, too.

    Returns:
        What its checkpoints take on the disk at the least [bytes].

    Raises:
        InputError: A flag is unfit, or something is missing.
    """
    settings, device = chosen_recipe(options), torch_device(options.device)
    if options.compile:
        check_compiler(device)
    weights = options.weights or None
    families.check_weights(settings, weights)
    if weights is not None and settings.family not in UNBUILT:
        with torch.random.fork_rng([]):
            model = families.build(settings, made_statistics(), "cpu", weights)
        if model.reads_task:
            model.tokens([tasks.get(name).instruction for name in tasks.PAPER])
    return _written(options, settings)


def _written(options: PolicyTrainOptions, settings: TrainingRecipe) -> int:
    """Bytes of the checkpoints that are there together: while one is written, those that are kept are there, too."""
    count = 1  # how many steps a time gives shows later
    if not options.minutes:
        count = math.ceil((options.steps or settings.steps) / options.save_every) if options.save_every else 1
        count = min(count, options.keep + 1) if options.keep else count
    return count * checkpoint_bytes(settings, pretrained=bool(options.weights))
