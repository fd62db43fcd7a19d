"""Randomisation: one function per event, all listed with their settings in `EVENTS`.

`start` events draw properties that a world keeps for the whole training, `reset` events draw at the start of an
episode, `interval` events happen at random ticks. All of them work on every world at once and write only the rows of a
mask, so that nothing waits for the device.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch

from arena_newton.cli.flags import check_number
from arena_newton.errors import InputError, check_once
from arena_newton.robot.g1 import TICK
from arena_newton.rules.modes import MOST_LATENCY

if TYPE_CHECKING:
    from arena_newton.physics.dynamics import Delay
    from arena_newton.trackers.train.tracker_env import TrackerEnv

__all__ = ["EVENTS", "OBSERVATION_NOISE", "START_NOISE", "Event", "apply", "configured", "uniform"]

OBSERVATION_NOISE: dict[str, float] = {"ang_vel": 0.15, "tilt": 0.03, "joint_pos": 0.01, "joint_vel": 0.4}
"""Half width of the uniform noise on what the tracker measures [rad/s, rad, rad, rad/s]."""
START_NOISE: dict[str, float] = {
    "xy": 0.03,
    "z": 0.01,
    "tilt": 0.05,
    "heading": 0.1,
    "lin_vel": 0.15,
    "ang_vel": 0.3,
    "joint_pos": 0.05,
    "joint_vel": 0.3,
}
"""Half width of the uniform noise on the state in which an episode starts [m, m, rad, rad, m/s, rad/s, rad, rad/s];
height is only ever added, so that no foot starts in the ground."""
HANDS = ("left_wrist_yaw_link", "right_wrist_yaw_link")
_PALM = 0.1
"""Distance of a payload in front of the wrist yaw frame [m]."""
_PAYLOAD_RADIUS = 0.05
"""Radius of gyration of a payload [m]."""


@dataclass(frozen=True)
class Event:
    """One event and its settings."""

    when: str
    """`start`, `reset` or `interval`."""
    run: Callable[..., None]
    """Takes the environment, a mask of worlds [worlds] and the settings."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """Keyword arguments of `run`."""


def uniform(like: torch.Tensor, low: float, high: float, *shape: int) -> torch.Tensor:
    """Uniform numbers on the device of `like`."""
    return torch.rand(shape, device=like.device) * (high - low) + low


def _chance(like: torch.Tensor, probability: float, worlds: int) -> torch.Tensor:
    return torch.rand(worlds, device=like.device) < probability


def friction(env: TrackerEnv, mask: torch.Tensor, low: float, high: float) -> None:
    """Sliding friction of every geom of a world: MuJoCo takes the larger of two geoms."""
    value = uniform(env.sim.qpos, low, high, env.sim.worlds)
    env.sim.geom_friction[:, :, 0] = value[:, None]
    env.privileged["friction"] = value[:, None] - 0.8


def link_mass(env: TrackerEnv, mask: torch.Tensor, low: float, high: float) -> None:
    """Mass and inertia of every link of the robot, by one factor per link."""
    sim = env.sim
    links = list(sim.bodies.values())
    factor = torch.ones_like(sim.body_mass)
    factor[:, links] = uniform(sim.qpos, low, high, sim.worlds, len(links))
    sim.body_mass.mul_(factor)
    sim.body_inertia.mul_(factor[..., None])
    env.privileged["trunk_mass"] = 10.0 * (factor[:, [sim.bodies["pelvis"], sim.bodies["torso_link"]]] - 1.0)


def centre_of_mass(env: TrackerEnv, mask: torch.Tensor, reach: float) -> None:
    """Centres of mass of pelvis and torso [m]."""
    sim = env.sim
    moved = []
    for name in ("pelvis", "torso_link"):
        shift = uniform(sim.qpos, -reach, reach, sim.worlds, 3)
        sim.body_com[:, sim.bodies[name]] += shift
        moved.append(shift)
    env.privileged["centre_of_mass"] = 50.0 * torch.cat(moved, 1)


def payload(env: TrackerEnv, mask: torch.Tensor, fraction: float, mass: float) -> None:
    """Up to `mass` [kg] in either hand in a fraction of the worlds, each hand loaded with probability 2/3."""
    sim = env.sim
    loaded = _chance(sim.qpos, fraction, sim.worlds)
    carried = []
    for name in HANDS:
        body = sim.bodies[name]
        extra = uniform(sim.qpos, 0.0, mass, sim.worlds) * (loaded & _chance(sim.qpos, 2.0 / 3.0, sim.worlds))
        before = sim.body_mass[:, body].clone()
        palm = sim.body_com.new_tensor((_PALM, 0.0, 0.0))
        apart = palm - sim.body_com[:, body]
        reduced = before * extra / (before + extra)
        sim.body_com[:, body] += apart * (extra / (before + extra))[:, None]
        sim.body_inertia[:, body] += (extra * _PAYLOAD_RADIUS**2 + reduced * apart.square().sum(1))[:, None]
        sim.body_mass[:, body] += extra
        carried.append(extra)
    env.privileged["payload"] = torch.stack(carried, 1)


def motor_strength(env: TrackerEnv, mask: torch.Tensor, low: float, high: float) -> None:
    """Stiffness, damping and torque limit of every joint, by one factor per joint."""
    sim = env.sim
    factor = uniform(sim.qpos, low, high, sim.worlds, 29)
    sim.gain[:, :29, 0] *= factor
    sim.bias[:, :29, 1:3] *= factor[..., None]
    sim.effort_range.mul_(factor[..., None])
    env.privileged["motor_strength"] = 10.0 * (factor - 1.0)


def action_delay(env: TrackerEnv, mask: torch.Tensor, fraction: float, ticks: float) -> None:
    """Targets arrive up to `ticks` late, at least one, in a fraction of the episodes."""
    _draw_delay(env.late_targets, env, mask, fraction, ticks)


def state_delay(env: TrackerEnv, mask: torch.Tensor, fraction: float, ticks: float) -> None:
    """The tracker gets the state as it was up to `ticks` ago, at least one, in a fraction of the episodes."""
    if fraction > 0.0:
        _draw_delay(env.late_state, env, mask, fraction, ticks)


def _draw_delay(late: Delay, env: TrackerEnv, mask: torch.Tensor, fraction: float, ticks: float) -> None:
    drawn = _chance(env.sim.qpos, fraction, env.sim.worlds).long()
    if ticks > 1.0:
        drawn = drawn * torch.randint(1, int(ticks) + 1, drawn.shape, device=drawn.device)
    late.ticks.copy_(torch.where(mask, drawn, late.ticks))


def hand_force(env: TrackerEnv, mask: torch.Tensor, fraction: float, force: float) -> None:
    """A constant force of up to `force` [N] in a random direction on each hand, in a fraction of the episodes."""
    for name in HANDS:
        direction = torch.nn.functional.normalize(torch.randn(env.sim.worlds, 3, device=mask.device), dim=1)
        _write_force(env, mask, name, direction, fraction, force)


def trunk_force(env: TrackerEnv, mask: torch.Tensor, fraction: float, force: float, resistance: float) -> None:
    """A constant horizontal force of up to `force` [N] on the torso, in a fraction of the episodes.

    References of the family `push` lean into something: nothing but a force against their heading makes them feasible,
    so their torso always meets one of up to `resistance` [N].
    """
    flat = torch.nn.functional.normalize(torch.randn(env.sim.worlds, 2, device=mask.device), dim=1)
    _write_force(env, mask, "torso_link", torch.nn.functional.pad(flat, (0, 1)), fraction, force)
    bank = env.bank
    if "push" not in bank.family_names:
        return
    family = bank.family.index_select(0, bank.clip_of.index_select(0, env.frame))
    pushing = mask & (family == bank.family_names.index("push"))
    w, z = env.sim.root_quat[:, 0], env.sim.root_quat[:, 3]
    against = -torch.stack((w * w - z * z, 2.0 * w * z, torch.zeros_like(w)), 1)
    _write_force(env, pushing, "torso_link", torch.nn.functional.normalize(against, dim=1), 1.0, resistance)


def _write_force(
    env: TrackerEnv, mask: torch.Tensor, link: str, direction: torch.Tensor, fraction: float, force: float
) -> None:
    worlds = env.sim.worlds
    size = uniform(env.sim.qpos, 0.0, force, worlds) * _chance(mask, fraction, worlds)
    applied = env.sim.body_force[:, env.sim.bodies[link], :3]
    applied.copy_(torch.where(mask[:, None], direction * size[:, None], applied))


def push(env: TrackerEnv, mask: torch.Tensor, every: float, planar: float, vertical: float, turn: float) -> None:
    """A kick of the base, every `every` seconds on average: its velocity jumps.

    Args:
        mask: Worlds that may be pushed.
        every: Mean time between two pushes of the same world [s].
        planar: Largest jump over the ground, in any direction [m/s].
        vertical: Largest jump up or down [m/s].
        turn: Largest jump of each component of the angular velocity [rad/s].
    """
    worlds = env.sim.worlds
    pushed = _chance(env.sim.qpos, TICK / every, worlds) & mask
    hit = pushed.float()[:, None]
    flat = torch.nn.functional.normalize(torch.randn(worlds, 2, device=mask.device), dim=1)
    env.sim.root_vel[:, :2].add_(flat * uniform(env.sim.qpos, 0.0, planar, worlds, 1) * hit)
    jump = uniform(env.sim.qpos, -1.0, 1.0, worlds, 4) * hit
    env.sim.root_vel[:, 2:].add_(jump[:, :1], alpha=vertical)
    env.sim.root_ang_vel.add_(jump[:, 1:], alpha=turn)
    env.since_push.masked_fill_(pushed, 0.0)


EVENTS: dict[str, Event] = {
    "friction": Event("start", friction, {"low": 0.4, "high": 1.2}),
    "link_mass": Event("start", link_mass, {"low": 0.95, "high": 1.05}),
    "centre_of_mass": Event("start", centre_of_mass, {"reach": 0.01}),
    "payload": Event("start", payload, {"fraction": 0.25, "mass": 2.0}),
    "motor_strength": Event("start", motor_strength, {"low": 0.95, "high": 1.05}),
    "action_delay": Event("reset", action_delay, {"fraction": 0.2, "ticks": 1.0}),
    "state_delay": Event("reset", state_delay, {"fraction": 0.0, "ticks": 1.0}),
    "hand_force": Event("reset", hand_force, {"fraction": 0.1, "force": 5.0}),
    "trunk_force": Event("reset", trunk_force, {"fraction": 0.1, "force": 10.0, "resistance": 12.0}),
    "push": Event("interval", push, {"every": 5.0, "planar": 1.2, "vertical": 0.05, "turn": 0.5}),
}


BOUNDS: dict[str, tuple[float, float]] = {
    "fraction": (0.0, 1.0),
    "ticks": (1.0, float(MOST_LATENCY)),
    "every": (TICK, 1e6),
    "low": (0.01, 100.0),
    "high": (0.01, 100.0),
    "reach": (0.0, 0.2),
}
"""Least and largest value of settings by name; the others are from 0 to 1000."""


def configured(changes: Sequence[tuple[str, str, float]]) -> dict[str, Event]:
    """`EVENTS` with other settings, given as event, setting and value.

    Raises:
        InputError: An event or a setting is unknown, a setting is given twice, or a value is unfit for it.
    """
    check_once("--events", (f"{name} {key}" for name, key, _ in changes))
    events = dict(EVENTS)
    for name, key, value in changes:
        if name not in events:
            raise InputError(f"--events {name}: no such event; known are {', '.join(events)}")
        settings = dict(events[name].settings)
        if key not in settings:
            raise InputError(f"--events {name} {key}: no such setting; {name} has {', '.join(settings)}")
        flag = f"--events {name} {key}"
        check_number(flag, value, *BOUNDS.get(key, (0.0, 1e3)))
        if key == "ticks" and not float(value).is_integer():
            raise InputError(f"{flag} {value}: expected a whole number")
        events[name] = dataclasses.replace(events[name], settings=settings | {key: float(value)})
    for name, event in events.items():
        if event.settings.get("low", 0.0) > event.settings.get("high", 1e3):
            raise InputError(f"--events {name}: low {event.settings['low']:g} is above high {event.settings['high']:g}")
    return events


def apply(env: TrackerEnv, when: str, mask: torch.Tensor, events: Mapping[str, Event]) -> None:
    """Run the events of one kind on the worlds of a mask, in the table's order."""
    for event in events.values():
        if event.when == when:
            event.run(env, mask, **event.settings)
