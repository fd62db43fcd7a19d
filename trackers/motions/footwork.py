"""What the feet do: footsteps planned ahead of the body, the sway that goes with them, and kicks.

State is a table of tensors, rows = worlds, that each function advances by one tick.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from arena_newton.robot import TICK
from arena_newton.trackers.motions.commands import CHANNELS
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT

if TYPE_CHECKING:
    import torch

__all__ = ["State", "approach", "kick", "kick_seconds", "nominal_feet", "rotate", "smooth", "sway", "walk", "wrap"]

State = dict[str, "torch.Tensor"]
"""Tensors by name, rows = worlds."""

DOUBLE_SUPPORT = 0.2
"""Share of a step with both feet on the ground."""
SWAY = 0.05
"""Sway of the pelvis towards the stance foot [m] at a stance width of 0.22 m."""
LEAD_IN = 0.4
"""Weight shift before the first lift and after the last touchdown, in steps."""
STRIDE = 0.28
"""Longest step [m]: faster walks take shorter time."""
SIDE_STRIDE = 0.11
"""Longest step sideways [m]: the feet keep off each other."""
SHORTEST_STEP = 0.32
"""Shortest time of a step [s]."""
EDGE = 0.2
"""A foot steps onto other ground when it lands so far before the other one [m]: a sole and room for the edge."""
LEAST_CLEARANCE = 0.05
"""Least height of a step down above the ground it leaves [m]."""
MISPLACED = (0.02, 0.07)
"""A standing robot steps when a foot is so far from its place [m, rad]."""
PLACED = (0.004, 0.02)
"""A walk ends when both feet are so near to their places [m, rad]."""
KICK_SHIFT, KICK_WIND, KICK_RETURN, KICK_SETTLE = 1.2, 0.4, 0.6, 1.2
"""Times of a kick's phases around the swing [s]; a faster shift would need a support beside the standing foot."""
KICK_BACK, KICK_FRONT = 0.20, 0.24
"""Ends of the swing behind and before the stance [m]."""
KICK_TOE = (0.45, -0.25)
"""Pitch of the foot there [rad], toes down positive: within the ankle's range."""
KICK_LIFT, KICK_LOW = 0.10, 0.09
"""Height of the foot at the end of the wind-up and of the swing [m]: it meets a ball at its middle. 5 cm lower it
scoops the ball up, and a third of the speed goes there."""


def smooth(share: torch.Tensor) -> torch.Tensor:
    """Minimum-jerk course from 0 to 1."""
    t = share.clamp(0.0, 1.0)
    return t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)


def approach(
    x: torch.Tensor, rate: torch.Tensor, target: torch.Tensor, top: torch.Tensor, slope: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """One tick towards `target` with bounded rate and acceleration; returns value and rate."""
    import torch

    away = target - x
    size = away.abs()
    brake = 0.5 * TICK * slope
    speed = torch.minimum(torch.sqrt(1.8 * slope * size + brake * brake) - brake, size / TICK)
    wanted = torch.sign(away) * torch.minimum(speed, top)
    change = slope * TICK
    rate = rate + torch.maximum(torch.minimum(wanted - rate, change), -change)
    return x + rate * TICK, rate


def rotate(yaw: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
    """Vectors of a heading frame in the world; yaw, shape [...], xy, shape [..., 2]."""
    import torch

    c, s = torch.cos(yaw), torch.sin(yaw)
    return torch.stack([c * xy[..., 0] - s * xy[..., 1], s * xy[..., 0] + c * xy[..., 1]], dim=-1)


def wrap(angle: torch.Tensor) -> torch.Tensor:
    """The same angle [rad] in [-pi, pi)."""
    import torch

    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


def kick_seconds(speed: Any) -> Any:
    """Length of a kick [s] at a foot speed [m/s]."""
    return KICK_SHIFT + KICK_WIND + 1.875 * (KICK_BACK + KICK_FRONT) / speed + KICK_RETURN + KICK_SETTLE


def nominal_feet(s: State, ahead: torch.Tensor) -> torch.Tensor:
    """Places of both feet when the body has gone on for `ahead` seconds: x, y [m], yaw [rad], [worlds, 2, 3]."""
    import torch

    at, body = CHANNELS, s["body"]
    v = s["channels"][:, at["velocity"]]
    yaw = body[:, 2] + v[:, 2] * ahead
    xy = body[:, :2] + rotate(body[:, 2] + 0.5 * v[:, 2] * ahead, v[:, :2] * ahead[:, None])
    width, offset = s["channels"][:, at["stance_width"]], s["channels"][:, at["foot_offset"]]
    stagger = s["channels"][:, at["stagger"]]
    ahead_of_body = torch.cat([0.5 * stagger - offset, -0.5 * stagger - offset], dim=1)
    place = torch.stack([ahead_of_body, torch.cat([0.5 * width, -0.5 * width], dim=1)], dim=-1)
    feet = xy[:, None] + rotate(yaw[:, None], place)
    return torch.cat([feet, yaw[:, None, None].expand(-1, 2, 1)], dim=2)


def walk(s: State, moving: torch.Tensor, free: torch.Tensor) -> None:
    """Starts, advances and ends steps; moves the swing foot."""
    import torch

    at, feet = CHANNELS, s["feet"]
    v = s["channels"][:, at["velocity"]]
    still = ~moving & (v.abs() < 1e-3).all(1)
    pace = s["channels"][:, at["step_time"]].squeeze(1)
    speed = v[:, :2].square().sum(1).sqrt().clamp(min=0.05)
    pace = torch.minimum(pace, torch.minimum(STRIDE / speed, SIDE_STRIDE / v[:, 1].abs().clamp(min=0.05)))
    pace = pace.clamp(min=SHORTEST_STEP)

    nominal = nominal_feet(s, torch.zeros_like(pace))
    away = (feet[:, :, :2] - nominal[:, :, :2]).square().sum(2).sqrt()
    twist = wrap(feet[:, :, 3] - nominal[:, :, 2]).abs()
    misplaced = (away > MISPLACED[0]) | (twist > MISPLACED[1])
    unplaced = (away > PLACED[0]) | (twist > PLACED[1])

    stepping, side = s["stepping"], s["side"]
    share = s["share"] + torch.where(stepping, TICK / pace, 0.0)
    over = stepping & (share >= 1.0 + LEAD_IN * s["final"])
    other = 1 - side
    rows = torch.arange(len(s["body"]), device=s["body"].device)
    go_on = over & (~still | unplaced.any(1))
    next_side = torch.where(still & ~unplaced[rows, other], side, other)
    start = ~stepping & free & (moving | misplaced.any(1))
    turn = v[:, 1] + 0.3 * v[:, 2]
    first_side = torch.where(turn > 0.01, 0, torch.where(turn < -0.01, 1, other))
    first_side = torch.where(still & ~misplaced[rows, first_side], 1 - first_side, first_side)
    begin = go_on | start
    side = torch.where(start, first_side, torch.where(go_on, next_side, side))
    stance = 1 - side
    final_now = still & ~unplaced[rows, stance]
    s["stepping"] = (stepping & ~over) | begin
    s["side"] = side
    s["first"] = torch.where(begin, start, s["first"])
    s["final"] = torch.where(begin, final_now, s["final"])
    share = torch.where(start, -LEAD_IN, torch.where(go_on, share - 1.0 - LEAD_IN * (share > 1.0 + LEAD_IN), share))
    s["share"] = torch.where(s["stepping"], share, 0.0)

    own = feet[rows, side][:, [0, 1, 3]]
    s["lifted"] = torch.where(begin[:, None], own, s["lifted"])
    swing = ((s["share"] - 0.5 * DOUBLE_SUPPORT) / (1.0 - DOUBLE_SUPPORT)).clamp(0.0, 1.0)
    left = (1.0 - s["share"]).clamp(min=0.0) * pace + 0.5 * pace
    planned = nominal_feet(s, left)[rows, side]
    # Onto other ground goes the foot that leads by enough for the edge between them, and then the other one.
    yaw = s["body"][:, 2]
    lead = rotate(-yaw, planned[:, :2] - feet[rows, 1 - side, :2])[:, 0]
    beside = s["floor"][rows, 1 - side]
    land = torch.where((lead > EDGE) | (beside == s["ground"]), s["ground"], beside)
    s["left_floor"] = torch.where(begin, s["floor"][rows, side], s["left_floor"])
    chosen = torch.stack([side == 0, side == 1], dim=1) & begin[:, None]
    s["floor"] = torch.where(chosen, land[:, None], s["floor"])
    # The end of a swing no longer follows the plan, so that a foot comes down without sliding.
    gain = ((0.9 - swing) / 0.4).clamp(0.0, 1.0)
    gain = torch.where(begin, 1.0, gain)[:, None]
    s["landing"] = s["landing"] + gain * (planned - s["landing"])
    # A high step rises before it goes on, so that the foot clears what lies before it.
    early = ((s["channels"][:, at["swing_height"]].squeeze(1) - 0.08) * 1.6).clamp(0.0, 0.16)
    course = smooth((swing - early) / (1.0 - 2.0 * early))[:, None]
    flat = s["lifted"] + course * (s["landing"] - s["lifted"])
    climb = s["floor"][rows, side] - s["left_floor"]
    # Down from higher ground the way over its edge is short, and the bent knee has no more to give.
    clearance = s["channels"][:, at["swing_height"]].squeeze(1)
    clearance = torch.where(climb < 0.0, (clearance + climb).clamp(min=LEAST_CLEARANCE), clearance)
    rise = clearance * torch.sin(math.pi * swing).square()
    # Up first and then ahead, ahead first and then down.
    level = s["left_floor"] + climb * torch.where(climb > 0.0, smooth(swing / 0.5), smooth((swing - 0.5) / 0.5))
    z = SOLE_HEIGHT + level + rise
    moved = torch.stack([flat[:, 0], flat[:, 1], z, flat[:, 2], torch.zeros_like(rise)], dim=1)
    swings = torch.stack([side == 0, side == 1], dim=1) & s["stepping"][:, None]
    s["feet"] = torch.where(swings[:, :, None], moved[:, None], feet)
    s["support"] = ~(swings & ((swing > 0.0) & (swing < 1.0))[:, None])
    gait, rate = s["gait"].unbind(1)
    on = s["stepping"].float()
    top, slope = torch.full_like(gait, 3.0), torch.full_like(gait, 15.0)
    s["gait"] = torch.stack(approach(gait, rate, on, top, slope), dim=1)


def sway(s: State) -> torch.Tensor:
    """Sideways place of the pelvis [m], left positive."""
    import torch

    share = s["share"]
    shape = torch.sin(math.pi * share.clamp(0.0, 1.0))
    lead = smooth((share + LEAD_IN) / (0.5 + LEAD_IN))
    tail = smooth((1.0 + LEAD_IN - share) / (0.5 + LEAD_IN))
    shape = torch.where(s["first"] & (share < 0.5), lead, shape)
    shape = torch.where(s["final"] & (share >= 0.5), tail, shape)
    size = SWAY * s["channels"][:, CHANNELS["stance_width"]].squeeze(1) / 0.22
    return torch.where(s["stepping"], (2.0 * s["side"] - 1.0) * size * shape, 0.0)


def kick(s: State, row: torch.Tensor) -> None:
    """Starts, advances and ends kicks; moves the kicking foot."""
    import torch

    at = CHANNELS
    still = ~s["stepping"] & (s["channels"][:, at["velocity"]].abs() < 1e-3).all(1) & (s["gait"][:, 0] < 0.02)
    start = (s["kick_asked"] > 0) & (s["kick_side"] == 0) & still
    swing = 1.875 * (KICK_BACK + KICK_FRONT) / row[:, at["kick_speed"]].squeeze(1)
    s["kick_swing"] = torch.where(start, swing, s["kick_swing"])
    s["kick_length"] = torch.where(start, kick_seconds(row[:, at["kick_speed"]].squeeze(1)), s["kick_length"])
    s["kick_side"] = torch.where(start, s["kick_asked"], s["kick_side"])
    s["kick_asked"] = torch.where(start, 0, s["kick_asked"])
    active = s["kick_side"] > 0
    time = torch.where(active, s["kick_time"] + TICK, 0.0)
    over = time >= s["kick_length"]
    s["kick_side"] = torch.where(over, 0, s["kick_side"])
    active = active & ~over
    s["kick_time"] = time = torch.where(over, 0.0, time)
    foot = (s["kick_side"] - 1).clamp(min=0)
    rows = torch.arange(len(s["body"]), device=s["body"].device)
    own = s["feet"][rows, foot]
    s["lifted"] = torch.where(start[:, None], own[:, [0, 1, 3]], s["lifted"])

    t1 = KICK_SHIFT + KICK_WIND
    t2 = t1 + s["kick_swing"]
    wind = smooth((time - KICK_SHIFT) / KICK_WIND)
    swing = smooth((time - t1) / s["kick_swing"])
    home = smooth((time - t2) / (0.75 * KICK_RETURN))
    down = smooth((time - t2 - 0.25 * KICK_RETURN) / (0.75 * KICK_RETURN))
    x = -KICK_BACK * wind + (KICK_BACK + KICK_FRONT) * swing - KICK_FRONT * home
    z = KICK_LIFT * wind - (KICK_LIFT - KICK_LOW) * swing - KICK_LOW * down
    base = s["lifted"]
    xy = base[:, :2] + rotate(base[:, 2], torch.stack([x, torch.zeros_like(x)], dim=1))
    toe = KICK_TOE[0] * wind + (KICK_TOE[1] - KICK_TOE[0]) * swing - KICK_TOE[1] * home
    pose = torch.cat([xy, (SOLE_HEIGHT + s["floor"][rows, foot] + z)[:, None], base[:, 2:], toe[:, None]], dim=1)
    kicks = torch.stack([s["kick_side"] == 1, s["kick_side"] == 2], dim=1)
    s["feet"] = torch.where(kicks[:, :, None], pose[:, None], s["feet"])
    s["support"] = s["support"] & ~(kicks & (z > 1e-6)[:, None])
    s["kick_share"] = active * (smooth(time / KICK_SHIFT) - smooth((time - t2 - KICK_RETURN) / KICK_SETTLE))
