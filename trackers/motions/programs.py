"""Random motion programs: clips for training that cover primitives, their parameters and the transitions between."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import atan2, heading, rotate_xy
from arena_newton.trackers.motions import primitives as p
from arena_newton.trackers.motions.generator import ReferenceGenerator
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT
from arena_newton.trackers.motions.library import SUPPORTS
from arena_newton.trackers.motions.primitives import Program, Script

__all__ = ["FAMILIES", "place_platform", "random_clips"]

SEAT_SIZE = (0.5, 0.6)
"""Length and width of a seat [m]."""
SILL_SIZE = (0.10, 1.4)
"""Thickness and width of a sill [m]."""
SILL_CLEARANCE = 0.05
"""Least height of a sole above a sill [m]."""
SILL_HEIGHTS = (0.05, 0.10)
"""Lowest and highest sill [m]."""
PLATFORM_SIZE = (1.0, 1.4)
"""Length and width of a platform [m]."""
PLATFORM_HEIGHTS = (0.05, 0.12)
"""Lowest and highest platform [m]."""
SOLE_BACK, SOLE_FRONT = 0.06, 0.14
"""Ends of the foot behind and ahead of the ankle [m], with a centimetre of margin."""
ARM_RANGES = ((-1.9, 0.6), (0.05, 0.9), (-0.7, 0.7), (-0.7, 1.5), (-0.6, 0.6), (-0.5, 0.5), (-0.5, 0.5))
"""Random posture of a left arm [rad]."""
LARGEST_ERROR = 0.02
"""A clip with more IK error anywhere is replaced [m]."""
FASTEST_JOINT = 25.0
"""A clip with a faster joint anywhere is replaced [rad/s]."""
SIT_SECONDS, RISE_SECONDS = 3.2, 5.0
"""Time of sitting down, and for standing up and a second after it [s]."""
ROUNDS = 6
"""Attempts at a clip before the library is refused."""


@dataclass
class _Plan:
    """One clip, drawn and not yet played."""

    script: Script
    support: str = "none"
    start: float = 0.0
    """Time at which the robot begins to sit down [s]."""
    height: float = 0.0
    """Height of the seat or the platform, wanted height of the sill [m]."""
    edge: float = 0.0
    """Front edge of the seat behind the standing pelvis [m]."""


class _Draw:
    """Random parameters of one clip."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng

    def __call__(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def side(self) -> str:
        return "left" if self.chance(0.5) else "right"

    def arms(self) -> tuple[float, ...]:
        """A random posture of both arms [rad]."""
        limbs = [tuple(self(low, high) for low, high in ARM_RANGES) for _ in range(2)]
        return (*limbs[0], *p.mirrored_arms(limbs[1])[7:])

    def hand(self) -> tuple[str, tuple[float, float, float]]:
        """A random side and a point for its hand [m]."""
        side, y = self.side(), self(-0.08, 0.45)
        return side, (self(0.12, 0.5), y if side == "left" else -y, self(-0.25, 0.6))

    def gait(self) -> dict[str, float]:
        """Random shape of steps."""
        return {
            "step_time": self(0.38, 0.52),
            "stance_width": self(0.19, 0.27),
            "swing_height": self(0.06, 0.10),
            "height": self(0.70, 0.779),
        }

    def velocity(self) -> tuple[float, float, float]:
        """A random walk [m/s, m/s, rad/s]: mostly forward, often curved."""
        kind = self.rng.random()
        if kind < 0.45:
            return self(0.1, 0.8), 0.0, self(-0.5, 0.5) * self.chance(0.5)
        if kind < 0.6:
            return self(-0.4, -0.1), 0.0, self(-0.3, 0.3) * self.chance(0.3)
        if kind < 0.75:
            return 0.0, self(-0.3, 0.3), 0.0
        return self(-0.3, 0.6), self(-0.25, 0.25), self(-0.8, 0.8)

    def upper(self, script: Script, probability: float = 0.5) -> Script:
        """Random arms, waist and tilt on some scripts, another posture for every segment."""
        if not self.chance(probability):
            return script
        out = []
        for s in script.segments:
            more: dict[str, Any] = {"arms": self.arms(), "arm_speed": self(0.8, 4.0)}
            if self.chance(0.4):
                more["waist"] = (self(-0.6, 0.6), self(-0.15, 0.15), self(-0.15, 0.3))
            if self.chance(0.2):
                more["hands"] = (float(self.chance(0.5)), float(self.chance(0.5)))
            out.append(p.Segment(s.seconds, {**more, **s.channels}, s.ramp))
        return Script(tuple(out))


@dataclass(frozen=True)
class _Family:
    """A kind of motion."""

    clips: int
    """Clips in the default library."""
    make: Callable[[_Draw, float], _Plan]
    """Draws a clip of a length [s]."""


_FAMILIES: dict[str, _Family] = {}


def _family(clips: int) -> Callable[[Callable[[_Draw, float], _Plan]], Callable[[_Draw, float], _Plan]]:
    """Adds a function `_name` as the family `name`; its docstring says what is drawn."""

    def add(make: Callable[[_Draw, float], _Plan]) -> Callable[[_Draw, float], _Plan]:
        _FAMILIES[make.__name__.removeprefix("_")] = _Family(clips, make)
        return make

    return add


@_family(128)
def _stand(d: _Draw, seconds: float) -> _Plan:
    """Heights, tilts, arms."""
    parts = p.stand(d(0.5, 1.5))
    while parts.seconds < seconds:
        channels: dict[str, Any] = {}
        if d.chance(0.5):
            channels["height"] = d(0.68, 0.785)
        if d.chance(0.3):
            channels["pitch"], channels["roll"] = d(-0.1, 0.3), d(-0.08, 0.08)
        parts = parts + p.stand(d(0.8, 2.5), **channels)
    return _Plan(d.upper(parts, 0.75))


@_family(224)
def _squat(d: _Draw, seconds: float) -> _Plan:
    """Down to 0.42-0.72 m, repeated."""
    parts = p.stand(d(0.3, 1.0))
    while parts.seconds < seconds:
        parts = parts + p.squat(d(0.42, 0.72), pitch=d(0.0, 0.5), down=d(0.9, 2.2), hold=d(0.2, 2.0))
    return _Plan(d.upper(parts))


@_family(128)
def _shift(d: _Draw, seconds: float) -> _Plan:
    """Weight shifts."""
    parts = p.stand(d(0.3, 1.0))
    while parts.seconds < seconds:
        parts = parts + p.shift(d(-0.04, 0.05), d(-0.09, 0.09), d(0.5, 2.0))
    return _Plan(d.upper(parts.over(height=d(0.66, 0.779), stance_width=d(0.19, 0.28))))


@_family(96)
def _step(d: _Draw, seconds: float) -> _Plan:
    """Steps in place."""
    parts = p.stand(d(0.2, 0.8))
    while parts.seconds < seconds:
        parts = parts + p.step(d(1.5, 4.0), pause=d(0.5, 1.5)).over(**d.gait())
    return _Plan(d.upper(parts))


@_family(832)
def _walk(d: _Draw, seconds: float) -> _Plan:
    """Pieces of 2-4.5 s: forward 0.1-0.8, back to -0.4, sideways 0.3 m/s, arcs to 0.8 rad/s, stops between a third.

    A tenth walks crouched at 0.60-0.70 m.
    """
    gait, parts = d.gait(), p.stand(d(0.1, 0.6))
    if d.chance(0.1):
        gait["height"], gait["pitch"] = d(0.60, 0.70), d(0.0, 0.15)
    while parts.seconds < seconds:
        forward, left, turn = d.velocity()
        pause = d(0.8, 2.0) if d.chance(0.35) else 0.0
        parts = parts + p.walk(forward, left, turn, d(2.0, 4.5), pause=pause)
    return _Plan(d.upper(parts.over(**gait)))


@_family(192)
def _turn(d: _Draw, seconds: float) -> _Plan:
    """Turns on the spot."""
    gait, parts = d.gait(), p.stand(d(0.1, 0.6))
    while parts.seconds < seconds:
        parts = parts + p.walk(0.0, 0.0, d(0.2, 1.0) * d.rng.choice([-1, 1]), d(1.5, 4.0), pause=d(0.3, 1.5))
    return _Plan(d.upper(parts.over(**gait)))


@_family(160)
def _reach(d: _Draw, seconds: float) -> _Plan:
    """Either palm to random points."""
    parts = p.stand(d(0.2, 0.8))
    while parts.seconds < seconds:
        one = p.reach(*d.hand(), hold=d(0.3, 1.5)).over(
            height=d(0.68, 0.779), pitch=d(-0.05, 0.3), arm_speed=d(1.0, 4.0), shift=(d(-0.01, 0.03), d(-0.03, 0.03))
        )
        if d.chance(0.3):
            one = one.over(waist=(d(-0.6, 0.6), 0.0, d(0.0, 0.2)))
        parts = parts + one
    return _Plan(parts)


@_family(96)
def _crouch_reach(d: _Draw, seconds: float) -> _Plan:
    """The same in a squat."""
    parts = p.stand(d(0.2, 0.8))
    while parts.seconds < seconds:
        parts = parts + p.crouch_reach(*d.hand(), d(0.42, 0.68), pitch=d(0.1, 0.55), down=d(1.0, 2.0), hold=d(0.3, 1.5))
    return _Plan(parts)


@_family(224)
def _kick(d: _Draw, seconds: float) -> _Plan:
    """Either foot at 1.5-3.5 m/s."""
    parts = p.stand(d(0.3, 1.0))
    while parts.seconds < seconds:
        parts = parts + p.kick(d.side(), d(1.5, 3.5), pause=d(0.2, 1.2))
    return _Plan(d.upper(parts, 0.3))


@_family(96)
def _walk_kick(d: _Draw, seconds: float) -> _Plan:
    """A kick out of a walk."""
    gait, parts = d.gait(), p.stand(d(0.1, 0.5))
    while parts.seconds < seconds:
        parts = parts + p.walk(d(0.15, 0.6), 0.0, d(-0.3, 0.3), d(1.2, 3.0), pause=0.0)
        parts = parts + p.kick(d.side(), d(1.5, 3.5), pause=d(0.8, 1.5))
    return _Plan(d.upper(parts.over(**gait), 0.3))


@_family(64)
def _punch(d: _Draw, seconds: float) -> _Plan:
    """Some crouched, some after steps."""
    parts = p.stand(d(0.2, 0.8))
    while parts.seconds < seconds:
        height = d(0.55, 0.77) if d.chance(0.5) else None
        parts = parts + p.punch(d.side(), height=height, speed=d(5.0, 11.0), times=int(d.rng.integers(1, 4)))
        if d.chance(0.3):
            parts = parts + p.walk(*d.velocity(), d(1.0, 2.0), pause=1.0).over(arms=p.GUARD_ARMS)
    return _Plan(parts)


@_family(96)
def _carry(d: _Draw, seconds: float) -> _Plan:
    """A walk with palms at a box of 16-40 cm."""
    parts = p.stand(d(0.2, 0.6))
    while parts.seconds < seconds:
        forward, left, turn = d.velocity()
        parts = parts + p.carry(0.6 * forward, 0.6 * left, 0.6 * turn, d(2.0, 5.0), width=d(0.16, 0.4))
    return _Plan(parts)


@_family(96)
def _push(d: _Draw, seconds: float) -> _Plan:
    """A walk with the feet 3-10 cm behind the pelvis."""
    parts = p.stand(d(0.2, 0.6))
    while parts.seconds < seconds:
        hands = [(d(0.25, 0.42), s * d(0.05, 0.25), d(0.0, 0.35)) for s in (1, -1)]
        parts = parts + p.push(d(0.15, 0.5), d(3.0, 6.0), foot_offset=d(0.03, 0.10), hands=hands)
    return _Plan(parts)


@_family(64)
def _sit_air(d: _Draw, seconds: float) -> _Plan:
    """Down to 0.5-0.6 m and up without a seat: the weight stays over the feet."""
    parts = p.stand(d(0.2, 0.8))
    while parts.seconds < seconds:
        low = {"height": d(0.5, 0.6), "pitch": d(0.2, 0.45), "arms": p.FORWARD_ARMS}
        parts = parts + p.script(
            p.Segment(d(1.5, 2.5), low, ramp=True), (d(0.5, 1.5), low), p.Segment(d(1.5, 2.5), {}, ramp=True), (0.6, {})
        )
    return _Plan(parts)


def _seated(d: _Draw, lead: Script, seconds: float) -> _Plan:
    """Down to a seat of 0.36-0.48 m with the front edge 3-8 cm behind the standing pelvis, and up again.

    The seat is loaded: the pelvis ends 24-36 cm back and 9-14 cm above it.
    """
    seat, edge = d(0.36, 0.48), d(0.03, 0.08)
    depth, press = d(0.24, 0.36), d(0.09, 0.14)
    hold = seconds - lead.seconds - SIT_SECONDS - RISE_SECONDS
    script = lead + p.sit(seat, hold=max(hold, 1.0), depth=depth, press=press)
    script = script + p.rise(seat, depth=depth, press=press) + p.stand(1.0)
    return _Plan(script, "seat", lead.seconds, seat, edge)


@_family(224)
def _sit(d: _Draw, seconds: float) -> _Plan:
    """Plan from standing onto a seat; see `_seated`."""
    return _seated(d, p.stand(d(0.3, 1.5)), seconds)


@_family(96)
def _walk_sit(d: _Draw, seconds: float) -> _Plan:
    """The same after turning and walking backwards to the seat."""
    back = p.walk(-d(0.15, 0.3), 0.0, 0.0, d(1.0, 1.8), pause=1.2)
    if d.chance(0.5):
        back = p.walk(0.0, 0.0, d(0.5, 0.9) * d.rng.choice([-1, 1]), d(0.8, 1.6), pause=0.6) + back
    return _seated(d, p.stand(0.2) + back, seconds)


@_family(128)
def _sill(d: _Draw, seconds: float) -> _Plan:
    """A walk with steps of 15-20 cm, the feet next to each other; `_place_sill` finds where a sill fits under it."""
    lead = p.stand(d(0.1, 0.5)) + p.walk(d(0.2, 0.5), 0.0, 0.0, d(0.5, 1.5), pause=0.0)
    over = p.step_over(d(0.37, 0.44), d(4.0, 6.0), swing_height=d(0.15, 0.20), step_time=d(0.48, 0.6))
    return _Plan(d.upper(lead + over + p.stand(1.0), 0.3), "sill", height=d(*SILL_HEIGHTS))


@_family(160)
def _mixed(d: _Draw, seconds: float) -> _Plan:
    """Walk, reach, crouch, kick, punch, squat in any order."""
    pieces = (
        lambda: p.walk(*d.velocity(), d(1.5, 3.0), pause=d(0.0, 1.0)).over(**d.gait()),
        lambda: p.crouch_reach(*d.hand(), d(0.45, 0.7), down=1.2, hold=d(0.3, 1.0)),
        lambda: p.reach(*d.hand(), hold=d(0.3, 1.0)),
        lambda: p.kick(d.side(), d(1.5, 3.2), pause=0.3),
        lambda: p.punch(d.side(), height=d(0.6, 0.77)),
        lambda: p.squat(d(0.45, 0.7), down=d(1.0, 1.6), hold=d(0.2, 1.0)),
    )
    parts = p.stand(d(0.1, 0.6))
    while parts.seconds < seconds:
        parts = parts + pieces[d.rng.integers(6)]()
    return _Plan(parts)


@_family(96)
def _platform(d: _Draw, seconds: float) -> _Plan:
    """A walk onto a platform, half of them over it and down again; `place_platform` finds where it fits."""
    height, down = d(*PLATFORM_HEIGHTS), d.chance(0.5)
    stride, ahead, swing_height, step_time = d(0.38, 0.42), d(1.0, 2.0), d(0.14, 0.18), d(0.5, 0.6)
    high = {"swing_height": swing_height, "step_time": step_time}
    over = p.step_up(height, stride, 3 if down else 2, ahead=ahead, down=down, **high)
    return _Plan(d.upper(p.stand(d(0.1, 0.5)) + over, 0.3), "platform", height=height)


FAMILIES: dict[str, int] = {name: family.clips for name, family in _FAMILIES.items()}
"""Clips of each family in the default library."""


def _play(plans: list[_Plan], ticks: int, device: torch.device | str) -> dict[str, torch.Tensor]:
    """Frames of all plans, and which of them are sound."""
    program = Program([plan.script for plan in plans], device)
    generator = ReferenceGenerator(len(plans), device)
    names = ("root_pos", "root_quat", "joint_pos", "hands")
    frames: dict[str, list[torch.Tensor]] = {name: [] for name in (*names, "feet")}
    worst = torch.zeros(len(plans), device=generator.device)
    for tick in range(ticks):
        one = generator.step(program(tick * TICK))
        for name in names:
            frames[name].append(getattr(one, name))
        frames["feet"].append(torch.cat([generator.feet_pos, generator.feet_yaw[:, :, None]], dim=2))
        worst = torch.maximum(worst, generator.ik_error)
    out = {name: torch.stack(values, dim=1) for name, values in frames.items()}
    speed = (out["joint_pos"][:, 1:] - out["joint_pos"][:, :-1]).abs().amax((1, 2)) / TICK
    finite = torch.stack([v.flatten(1).isfinite().all(1) for v in out.values()]).all(0)
    out["sound"] = finite & (worst <= LARGEST_ERROR) & (speed <= FASTEST_JOINT)
    return out


def _box(centre: torch.Tensor, top: torch.Tensor, yaw: torch.Tensor, size: tuple[float, float]) -> torch.Tensor:
    """Rows of `MotionLibrary.support_box` of boxes of one length and width, shape [clips, 7]."""
    sizes = torch.tensor(size, device=top.device).expand(len(top), 2)
    return torch.cat([centre, top[:, None], yaw[:, None], sizes, top[:, None]], dim=1)


def _place_seat(plans: list[_Plan], out: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Boxes behind the standing pelvis, and which stay clear of the feet and of the walk to them."""
    root = out["root_pos"]
    at = torch.tensor([min(round(plan.start / TICK), root.shape[1] - 1) for plan in plans], device=root.device)
    rows = torch.arange(len(plans), device=root.device)
    position, yaw = root[rows, at], heading(out["root_quat"][rows, at])
    edge = torch.tensor([plan.edge for plan in plans], device=root.device)
    height = torch.tensor([plan.height for plan in plans], device=root.device)
    ahead = torch.stack([torch.cos(yaw), torch.sin(yaw)], dim=1)
    centre = position[:, :2] - ahead * (edge + 0.5 * SEAT_SIZE[0])[:, None]
    box = _box(centre, height, yaw, SEAT_SIZE)

    def local(xy: torch.Tensor) -> torch.Tensor:
        return rotate_xy(-yaw[:, None], xy - centre[:, None]).abs()

    half = 0.5 * torch.tensor(SEAT_SIZE, device=root.device)
    feet = local(out["feet"][..., :2].flatten(1, 2))
    stepped = (feet < half).all(-1).any(1)
    early = torch.arange(root.shape[1], device=root.device)[None] < at[:, None]
    crossed = ((local(root[..., :2]) < half).all(-1) & early).any(1)
    return box, ~(stepped | crossed)


def _along(root_xy: torch.Tensor, feet: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """The line of a walk from its start to its end, and where the feet are on it.

    Pelvis [m], shape [clips, ticks, 2], and ankles [m], shape [clips, ticks, 2, 2 or more], give the start [m] and the
    direction, shape [clips, 2], the length [m], shape [clips], and each foot's position along it [m], shape [clips,
    ticks, 2].
    """
    start, path = root_xy[:, 0], root_xy[:, -1] - root_xy[:, 0]
    length = path.square().sum(1).sqrt().clamp(min=1e-3)
    ahead = path / length[:, None]
    return start, ahead, length, ((feet[..., :2] - start[:, None, None]) * ahead[:, None, None]).sum(-1)


def _place_sill(plans: list[_Plan], out: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Position along the walk at which a sill is cleared best, and whether by enough; one too high is lowered.

    Positions along the line from start to end are tried; feet and their soles cross the sill in the air.
    """
    root, feet = out["root_pos"], out["feet"]
    start, ahead, length, along = _along(root[..., :2], feet)
    along = along.flatten(1)
    height = (feet[..., 2] - SOLE_HEIGHT).flatten(1)
    best = torch.full_like(length, -1.0)
    where = torch.zeros_like(length)
    half = 0.5 * SILL_SIZE[0]
    for fraction in np.linspace(0.25, 0.85, 49):
        spot = length * float(fraction)
        over = (along - SOLE_BACK < (spot + half)[:, None]) & (along + SOLE_FRONT > (spot - half)[:, None])
        clear = torch.where(over, height, 1.0).amin(1)
        where = torch.where(clear > best, spot, where)
        best = torch.maximum(best, clear)
    wanted = torch.tensor([plan.height for plan in plans], device=root.device)
    top = torch.minimum(best - SILL_CLEARANCE, wanted)
    yaw = atan2(ahead[:, 1], ahead[:, 0])
    centre = start + ahead * where[:, None]
    return _box(centre, top, yaw, SILL_SIZE), top >= SILL_HEIGHTS[0]


def place_platform(
    root_xy: torch.Tensor, feet: torch.Tensor, height: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Position along a straight walk at which a platform fits under the feet that tread at its height.

    Args:
        root_xy: Pelvis [m], shape [clips, ticks, 2].
        feet: Ankles [m], shape [clips, ticks, 2, 3 or more].
        height: Height of the platform [m], shape [clips].

    Returns:
        Centre x, y and yaw [m, rad], shape [clips, 3], and the least distance of a foot's tread from an end of the
        platform [m], shape [clips]: below 0 where none fits.
    """
    start, ahead, length, along = _along(root_xy, feet)
    above = feet[..., 2] - SOLE_HEIGHT - height[:, None, None]
    still = torch.zeros_like(above, dtype=torch.bool)
    still[:, 1:] = (feet[:, 1:, :, :3] - feet[:, :-1, :, :3]).abs().amax(-1) < 1e-4
    treads = (still & (above.abs() < 1e-3)).flatten(1)
    along, above = along.flatten(1), above.flatten(1)
    best, where = torch.full_like(length, -1.0), torch.zeros_like(length)
    for edge in torch.linspace(0.2, 4.0, 191, device=feet.device).tolist():
        far = edge + PLATFORM_SIZE[0]
        within = (along + SOLE_FRONT > edge) & (along - SOLE_BACK < far)
        clear = torch.where(within, above, 1.0).amin(1) > -1e-3
        room = torch.minimum(along - SOLE_BACK - edge, far - along)
        room = torch.where(treads, room, 1.0).amin(1)
        room = torch.where(clear & treads.any(1), room, -1.0)
        where = torch.where(room > best, edge, where)
        best = torch.maximum(best, room)
    centre = start + ahead * (where + 0.5 * PLATFORM_SIZE[0])[:, None]
    return torch.cat([centre, atan2(ahead[:, 1], ahead[:, 0])[:, None]], dim=1), best


def _place_platform_box(plans: list[_Plan], out: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Platforms under the feet, and on which of them no foot treads on an edge."""
    root = out["root_pos"]
    height = torch.tensor([plan.height for plan in plans], device=root.device)
    pose, room = place_platform(root[..., :2], out["feet"], height)
    return _box(pose[:, :2], height, pose[:, 2], PLATFORM_SIZE), room >= 0.0


_PLACE = {"seat": _place_seat, "sill": _place_sill, "platform": _place_platform_box}
"""Support → its box for each clip, and whether it fits."""


def _drawn(family: str, number: int, seconds: float, seed: int, attempt: int) -> _Plan:
    """A clip's plan from a generator of its own, so that it depends on no other clip and no other family."""
    rng = np.random.default_rng([seed, zlib.crc32(family.encode()), number, attempt])
    return _FAMILIES[family].make(_Draw(rng), seconds)


def random_clips(
    families: Mapping[str, int] | None = None, seconds: float = 12.0, seed: int = 0, device: torch.device | str = "cpu"
) -> dict[str, Any]:
    """Random clips of the named families, all of the same length.

    A family draws scripts of primitives, joined until the clip is full, as the docstring of its maker (`_stand` to
    `_platform`) says; on about half the clips every segment has random arms, waist and hands.

    A clip with more than 2 cm of IK error, a joint faster than 25 rad/s, or a support in the path of a foot is drawn
    again.

    Args:
        families: Clips of each family; `FAMILIES` without it.
        seconds: Length of every clip [s].
        seed: The same seed gives the same clips of a family, whatever other families and however many clips are
            made; at least 0.
        device: Torch device; a GPU makes 2400 clips in seconds.

    Returns:
        Torch tensors on `device`: root_pos [m], shape [clips, ticks, 3]; root_quat, wxyz, [clips, ticks, 4]; joint_pos
        [rad], MuJoCo order, [clips, ticks, 29]; hands [clips, ticks, 2]; family, int64 [clips], into family_names;
        support_kind, int64 [clips], into `SUPPORTS`; support_box [clips, 7]: centre of the top face x, y, z [m], yaw
        [rad], length along the heading, width, height of the top [m] (zeros without one).

    Raises:
        InputError: An unknown family, or one whose clips are refused `ROUNDS` times.
    """
    counts = dict(FAMILIES if families is None else families)
    for name in counts:
        if name not in FAMILIES:
            raise InputError(f"random clips: no family {name!r}, expected one of {', '.join(FAMILIES)}")
    names = list(counts)
    family = np.repeat(np.arange(len(names)), [counts[n] for n in names])
    ticks = round(seconds / TICK)
    number = [k for n in names for k in range(counts[n])]
    result: dict[str, torch.Tensor] = {}
    missing = np.arange(len(family))
    for attempt in range(ROUNDS):
        if not len(missing):
            break
        plans = [_drawn(names[family[i]], number[i], seconds, seed, attempt) for i in missing]
        out = _play(plans, ticks, device)
        sound = out.pop("sound")
        kind = torch.tensor([SUPPORTS.index(plan.support) for plan in plans], device=sound.device)
        box = torch.zeros(len(plans), 7, device=sound.device)
        for support, place in _PLACE.items():
            found, fits = place(plans, out)
            chosen = kind == SUPPORTS.index(support)
            sound &= torch.where(chosen, fits, True)
            box = torch.where(chosen[:, None], found, box)
        out = {**out, "support_kind": kind, "support_box": box}
        good = sound.cpu().numpy()
        to = torch.tensor(missing[good], device=sound.device)
        for name, values in out.items():
            if name not in result:
                result[name] = torch.zeros(len(family), *values.shape[1:], dtype=values.dtype, device=values.device)
            result[name][to] = values[sound]
        missing = missing[~good]
    if len(missing):
        bad = ", ".join(sorted({names[family[i]] for i in missing}))
        why = f"{ROUNDS} attempts failed (IK error, joint speed or support)"
        raise InputError(f"could not generate {len(missing)} clips of {bad}: {why}")
    del result["feet"]
    return {**result, "family": torch.tensor(family, device=device), "family_names": names}
