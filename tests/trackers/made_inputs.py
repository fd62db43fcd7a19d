"""Random commands and states of robots, and some rows of them."""

import torch

from arena_newton.trackers import RobotState, TrackerCommand


def inputs(seed: int, worlds: int, device: str = "cpu") -> tuple[TrackerCommand, RobotState]:
    """A command and a measured state of each world."""
    rng = torch.Generator().manual_seed(seed)

    def draw(width):
        return torch.randn(worlds, width, generator=rng).to(device)

    quat, target = (torch.nn.functional.normalize(draw(4)) for _ in range(2))
    command = TrackerCommand(draw(35), draw(29), 5.0 * draw(29), target)
    return command, RobotState(quat, draw(3), draw(29), 10.0 * draw(29))


def rows(value, index):
    """The same of some worlds."""
    return value.mapped(lambda tensor: tensor[index])
