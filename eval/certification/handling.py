"""How the saboteurs of `sabotage` fail in tasks that are done with the hands: a door, a box, a hammer.

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
    clumsy: tuple[float, float, float]
    """Unit vector from the object to where a clumsy hand believes it, in the world."""
    off: tuple[float, float]
    """How far that is, drawn between these [m]."""
    weak: float
    """Part of the legs' excursions that a weakened tracker executes."""
    short: tuple[float, float]
    """Distance that a robot that aims badly stops short of where it wants to stop, drawn between these [m]."""
    opens: tuple[float, float] | None = None
    """Ticks after the first touch at which clumsy hands let go in every other episode, drawn between these; they reach
    for the object where it is then. None: they never do."""
    apart: float = 0.0
    """How far each hand goes outwards for that [m]; fingers open in any case."""
    halts: float = 0.0
    """Distance at which a robot that does not reach for the object halts before it, its arms hanging [m]; 0 where no
    such robot is played."""

    def believed(self, style: Style) -> Tensor:
        """Where clumsy hands believe the object minus where it is [m], shape [worlds, 3]."""
        size = style.uniform("off", *self.off)
        if self.opens:
            size = size * ~style.coin("opens")
        return size[:, None] * torch.tensor(self.clumsy, dtype=size.dtype, device=size.device)

    def elsewhere(self, style: Style, distance: tuple[float, float]) -> Tensor:
        """Where blind robots believe it minus where it is, so far away [m], shape [worlds, 3]."""
        far, turn = style.uniform("far", *distance), style.uniform("to", *map(math.radians, self.blind))
        return torch.stack([far * torch.cos(turn), far * torch.sin(turn), torch.zeros_like(far)], dim=1)

    def let_go(self, command: MotionCommand, style: Style, after: Tensor) -> MotionCommand:
        """The command of hands that open too early; `after`: ticks since the first touch, shape [worlds]."""
        if self.opens is None:
            return command
        opened = style.coin("opens") & (after > style.uniform("opens at", *self.opens))
        outwards = torch.tensor([self.apart, -self.apart], device=after.device) * opened[:, None]
        points, hands = command.hand_point.clone(), command.hands * ~opened[:, None]
        points[:, :, 1] += outwards
        return replace(command, hand_point=points, hands=hands)


HANDLING: Mapping[str, Handling] = {
    # Along the partition, for behind it there is no floor. A fist that comes down beyond the lever's free end, which is
    # 3 cm beyond the pressed point, misses it by 4 cm and more. With half of the legs' excursions nine of ten episodes
    # succeed: the walk is short, and whoever walks badly pushes no worse.
    "open_door": Handling(
        blind=(180, 180), clumsy=(-1.0, 0.0, 0.0), off=(0.12, 0.16), weak=0.45, short=(0.55, 0.80), halts=0.50
    ),
    # Behind the robot is free floor. Fists 0.18 m above the box's middle close over it; others squeeze and lift it, and
    # open on the way to the shelf. With half of the legs' excursions SONIC walks so well that five of eight robots come
    # to the box and fail with their hands.
    "pp_box": Handling(
        blind=(150, 190),
        clumsy=(0.0, 0.0, 1.0),
        off=(0.18, 0.20),
        weak=0.4,
        short=(0.50, 0.62),
        halts=0.38,
        opens=(300, 450),
        apart=0.30,
    ),
    # To the robot's right the floor is free beside the desk. A hand 11 cm above the handle closes over it; others grasp
    # the hammer and open on the way to the crate.
    "double_desk": Handling(
        blind=(180, 180),
        clumsy=(0.0, 0.0, 1.0),
        off=(0.11, 0.13),
        weak=0.5,
        short=(0.42, 0.55),
        opens=(400, 600),
    ),
}
"""Task name → what its saboteurs do."""
