"""The first call of a differentiable function in a process, gradients and all."""

import torch

from arena_newton import differentiable
from arena_newton.kernels.rules import success


def main(arguments):
    """Call the function of this name, in a process that has called nothing yet."""
    if arguments == ["reference_step"]:
        state = differentiable.ReferenceState(
            torch.zeros(2, 3),
            torch.tensor([[1.0, 0, 0, 0]] * 2),
            torch.zeros(2, 29),
            *torch.zeros(3, 2),
            torch.zeros(2, dtype=torch.int32),
            torch.zeros(2, 29),
        )
        x = torch.zeros(2, 40)
        x[:, 3] = x[:, 6] = 1.0
        differentiable.reference_step(x.requires_grad_(), state)[0].sum().backward()
    else:
        x = torch.zeros(2, 9)
        x[:, 2], x[:, 3] = 0.8, 1.0
        margin = differentiable.success_margin(
            success.launch_open_door_released,
            qpos=x.requires_grad_(),
            root_qpos_adr=0,
            leaf_qpos_adr=7,
            latched=torch.zeros(2, dtype=torch.int32),
            min_angle=1.0,
            stand_height=0.45,
            stand_up=0.6,
        )
        margin.sum().backward()
    return int(not x.grad.isfinite().all())
