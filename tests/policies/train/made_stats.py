"""Statistics and batches of made data, for tests of the families; what all of them are held to."""

from collections.abc import Callable

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


def observed(batch: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A batch with LeRobot's axis of observed ticks."""
    names = ("observation.state", "observation.images.front")
    return {**batch, **{name: batch[name].unsqueeze(1) for name in names}}


def trained(model: TrainableModel, optimizer: type[torch.optim.Optimizer], *noise: dict[str, torch.Tensor]) -> None:
    """Two steps of a training."""
    steps = optimizer(model.groups(), lr=1e-3)
    for _ in range(2):
        steps.zero_grad()
        model.loss(made_batch(model), *noise).backward()
        steps.step()


def hold_loss(
    model: TrainableModel, ours: Callable[[], torch.Tensor], theirs: Callable[[], torch.Tensor], **slack: float
) -> None:
    """Two ways to one loss agree to 1e-6, and so do the gradients of all parameters, to `slack`."""
    found = []
    for loss_of in (ours, theirs):
        torch.manual_seed(7)
        model.policy.zero_grad()
        loss = loss_of()
        loss.backward()
        found.append((loss.detach(), [p.grad.clone() for p in model.policy.parameters() if p.grad is not None]))
    assert torch.allclose(found[0][0], found[1][0], rtol=1e-6)
    assert all(torch.allclose(a, b, **slack) for a, b in zip(found[0][1], found[1][1], strict=True))
