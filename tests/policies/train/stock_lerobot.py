"""Checkpoints as a stock LeRobot opens them, and observations for its processors."""

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors


def opened(folder):
    """Policy and processors of a folder, loaded strictly."""
    config = PreTrainedConfig.from_pretrained(folder)
    policy = get_policy_class(config.type).from_pretrained(folder, config=config, strict=True)
    return policy, *make_pre_post_processors(config, pretrained_path=str(folder))


def raw_observation(size=64, rows=2):
    """An observation before any normalisation."""
    generator = torch.Generator().manual_seed(3)
    return {
        "observation.images.front": torch.rand(rows, 3, size, size, generator=generator),
        "observation.state": torch.randn(rows, 64, generator=generator) * 0.3,
        "task": ["Open the door.", "Sit on the sofa."][:rows],
    }
