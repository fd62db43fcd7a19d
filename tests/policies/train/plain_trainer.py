"""Trainer of a narrow ACT whose steps draw nothing."""

import dataclasses

import torch

from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames.batching import BatchMaker
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from benchmarks.made_frames import made_frames


def plain_trainer(batch, rank=0, ranks=1, store=None, **more):
    """A trainer whose loss is a mean over the batch and draws nothing: no dropout, latent, augmentation or padding."""
    network = {"dropout": 0.0, "use_vae": False, "chunk_size": 1, "n_action_steps": 1}
    settings = recipe("act", "small", network=network, chunk=1, horizon=1, batch_norm=False)
    settings = dataclasses.replace(settings, batch_size=batch, shift_px=0, colour=0.0, steps=6, warmup_steps=0, **more)
    torch.manual_seed(0)
    zeros, ones = torch.zeros(64), torch.ones(64)
    stats = {"observation.state": {"mean": zeros, "std": ones}, "action": {"mean": zeros[:40], "std": ones[:40]}}
    model = families.build(settings, stats, "cpu")
    store = made_frames(40, 64, torch.device("cpu")) if store is None else store
    batches = BatchMaker(store, model.normalise, model.samples)
    return PolicyTrainer(model, batches, settings, rank=rank, ranks=ranks)
