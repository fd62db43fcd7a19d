"""Failures of the saboteurs of `sabotage` in tasks that are done with the hands: a door, a box, a hammer.

One entry per task: where a blind robot believes the object, how a clumsy one touches it without effect, how weak legs
must be. Nothing that is not in an entry differs from the other tasks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from arena_newton.policies.experts.style import Style
from arena_newton.trackers.motions.commands import MotionCommand

__all__ = ["HANDLING", "Handling"]


@dataclass(frozen=True)
class Handling:
    """Numbers of one task's saboteurs."""

    blind: tuple[float, float]
    """Direction from the object to where a blind robot believes it, drawn between these [degrees from the x-axis]."""
    weak: float
    """Part of the legs' excursions that a weakened tracker executes."""
    short: tuple[float, float]
    """Distance that a robot that aims badly stops short of where it wants to stop, drawn between these [m]."""
    opens: tuple[float, float] | None = None
    """Ticks after the first touch at which clumsy hands let go, drawn between these. None: they never do."""
    apart: float = 0.0
    """Distance that each hand goes outwards for that [m]; fingers open in any case."""
    halts: float = 0.0
    """Distance at which a robot that does not reach for the object halts before it, its arms hanging [m]; 0 where no
    such robot is played."""

    def elsewhere(self, style: Style, distance: tuple[float, float]) -> Tensor:
        """Error of blind robots about its position, of this length [m], shape [worlds, 3]."""
        far, turn = style.uniform("far", *distance), style.uniform("to", *map(math.radians, self.blind))
        return torch.stack([far * torch.cos(turn), far * torch.sin(turn), torch.zeros_like(far)], dim=1)

    def let_go(self, command: MotionCommand, style: Style, after: Tensor) -> MotionCommand:
        """The command of hands that open too early; `after`: ticks since the first touch, shape [worlds]."""
        if self.opens is None:
            return command
        opened = after > style.uniform("opens at", *self.opens)
        outwards = torch.tensor([self.apart, -self.apart], device=after.device) * opened[:, None]
        points, hands = command.hand_point.clone(), command.hands * ~opened[:, None]
        points[:, :, 1] += outwards
        return replace(command, hand_point=points, hands=hands)


HANDLING: Mapping[str, Handling] = {
    # Along the partition, for behind it there is no floor. The fist touches the lever and goes aside before it is
    # pressed: half of the robots come back and go through all the same. With half of the legs' excursions nine of ten
    # episodes succeed: the walk is short, and whoever walks badly pushes no worse.
    "open_door": Handling(blind=(180, 180), weak=0.45, short=(0.55, 0.80), halts=0.50, opens=(0, 1), apart=0.30),
    # Behind the robot is free floor. Fists squeeze and lift the box, and open on the way to the shelf. With half of the
    # legs' excursions SONIC walks so well that five of eight robots come to the box and fail with their hands.
    "pp_box": Handling(blind=(150, 190), weak=0.4, short=(0.50, 0.62), halts=0.38, opens=(300, 450), apart=0.30),
    # To the robot's right the floor is free beside the desk. The hand grasps the hammer, and opens on the way to the
    # crate.
    "double_desk": Handling(blind=(180, 180), weak=0.5, short=(0.36, 0.46), opens=(400, 600)),
}
"""Task name → what its saboteurs do."""
