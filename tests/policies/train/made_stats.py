"""Statistics and batches of made data, for tests of the families."""

import torch

from arena_newton.policies.train.families.policy_model import TrainableModel

STATE, ACTION = 64, 40


def made_stats(tasks: int = 0) -> dict[str, dict[str, torch.Tensor]]:
    """Statistics of data with constant hands and reserved slots, as v4 has."""
    generator = torch.Generator().manual_seed(0)
    found = {}
    for name, width in {"observation.state": STATE, "action": ACTION}.items():
        rows = torch.randn(500, width, generator=generator) * 0.3 + 0.1
        rows[:, -2:] = 0.0
        rows[:, 6:9] = 0.0
        q01, q99 = torch.quantile(rows, torch.tensor([0.01, 0.99]), dim=0)
        low, high = rows.amin(0), rows.amax(0)
        found[name] = dict(mean=rows.mean(0), std=rows.std(0), min=low, max=high, q01=q01, q99=q99)
    if tasks:
        zeros, ones = torch.zeros(tasks), torch.ones(tasks)
        found["observation.environment_state"] = dict(mean=zeros, std=ones, min=zeros, max=ones, q01=zeros, q99=ones)
    return found


def made_batch(model: TrainableModel, rows: int = 2, tasks: int = 0, seed: int = 1) -> dict[str, object]:
    """A normalised batch whose last sample ends in padding."""
    generator = torch.Generator().manual_seed(seed)
    size, count = model.recipe.picture, len(model.samples)
    pictures = torch.randint(0, 256, (rows, 3, size, size), generator=generator, dtype=torch.uint8)
    batch: dict[str, object] = {
        "observation.images.front": model.normalise("observation.images.front", pictures.to(model.device)),
        "observation.state": torch.randn(rows, STATE, generator=generator).clamp(-1, 1),
        "action": torch.randn(rows, count, ACTION, generator=generator).clamp(-1, 1),
        "action_is_pad": torch.zeros(rows, count, dtype=torch.bool),
    }
    batch["action_is_pad"][-1, -3:] = True
    if tasks:
        batch["observation.environment_state"] = torch.eye(tasks)[torch.arange(rows) % tasks]
    batch = {name: value.to(model.device) for name, value in batch.items()}
    if model.reads_task:
        words = ["Open the door.", "Sit on the sofa."]
        batch |= model.tokens([words[i % 2] for i in range(rows)], batch["observation.state"])
    return batch
