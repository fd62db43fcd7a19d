"""Privileged terms of the critic: one function per term, all listed in `CRITIC`, whose order is the observation's.

A term sees the environment and the exact state against the reference frame of the state; vectors are in the measured
heading frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from arena_newton.trackers.train.terms.measurement import TickMeasurement, TrainingError

if TYPE_CHECKING:
    from arena_newton.trackers.train.tracker_env import TrackerEnv

__all__ = ["CRITIC", "CriticTerm", "observe"]

CriticTerm = Callable[["TrackerEnv", TickMeasurement], torch.Tensor]
"""Maps the environment and the state to numbers of order 1, shape [worlds, n]."""
_VALUE_CLIP = 50.0
"""Largest magnitude of a critic observation."""


def command_ahead(env: TrackerEnv, frames: int) -> torch.Tensor:
    """The mimic command so many frames after the state's, at most the clip's last, shape [worlds, 35]."""
    last = env.bank.last.index_select(0, env.frame)
    return env.bank.mimic.index_select(0, torch.minimum(env.frame + frames, last))


def heading_error(env: TrackerEnv, m: TickMeasurement) -> torch.Tensor:
    """Sine and cosine."""
    return torch.stack((torch.sin(m.heading_error), torch.cos(m.heading_error)), 1)


def family(env: TrackerEnv, m: TickMeasurement) -> torch.Tensor:
    """One-hot family of the clip."""
    return env.families.index_select(0, env.bank.family.index_select(0, env.clip()))


def support(env: TrackerEnv, m: TickMeasurement) -> torch.Tensor:
    """Centre of the support's top face relative to the pelvis [m], zero without a support."""
    clip = env.clip()
    offset = m.in_heading_frame(env.bank.support_pos.index_select(0, clip) - env.sim.root_pos)
    return torch.where((env.bank.support_kind.index_select(0, clip) > 0)[:, None], offset, 0.0)


def support_kind(env: TrackerEnv, m: TickMeasurement) -> torch.Tensor:
    """One-hot kind of the support, zero without one."""
    return (env.bank.support_kind.index_select(0, env.clip())[:, None] == env.support_kinds).float()


def forces(env: TrackerEnv, m: TickMeasurement) -> torch.Tensor:
    """Forces of the randomisation on hands and torso [10 N]."""
    force = torch.cat([env.sim.body_force[:, link, :3] for link in env.pushed_links], 1)
    return m.in_heading_frame(force.unflatten(1, (-1, 3))).flatten(1) * 0.1


CRITIC: dict[str, CriticTerm] = {
    "angular_velocity": lambda env, m: 0.25 * m.state.root_ang_vel,
    "gravity": lambda env, m: m.gravity,
    "joint_position": lambda env, m: m.state.joint_pos - env.default_pose,
    "joint_error": lambda env, m: m.state.joint_pos - m.reference.joint_pos,
    "joint_velocity": lambda env, m: 0.05 * m.state.joint_vel,
    "last_action": lambda env, m: env.front_end.last_action,
    "command": lambda env, m: env.ahead.mimic,
    "velocity": lambda env, m: m.velocity,
    "velocity_error": lambda env, m: m.velocity_error,
    "height": lambda env, m: m.state.root_pos[:, 2:],
    "position_error": lambda env, m: m.position_error,
    "heading_error": heading_error,
    "key_links": lambda env, m: m.keys.flatten(1),
    "key_link_errors": lambda env, m: (m.reference.keys - m.keys).flatten(1),
    "foot_velocity": lambda env, m: m.in_heading_frame(m.foot_vel).flatten(1),
    "command_in_4": lambda env, m: command_ahead(env, 4),
    "command_in_10": lambda env, m: command_ahead(env, 10),
    "root_command_in_25": lambda env, m: command_ahead(env, 25)[:, :6],
    "family": family,
    "support": support,
    "support_kind": support_kind,
    "forces": forces,
    "action_delay": lambda env, m: env.late_targets.ticks[:, None].float(),
    "state_delay": lambda env, m: env.late_state.ticks[:, None].float(),
    "randomised": lambda env, m: env.randomised,
}


def observe(env: TrackerEnv, m: TickMeasurement) -> torch.Tensor:
    """The critic's observation, shape [worlds, n]; fills and checks `env.critic_widths`.

    Raises:
        TrainingError: A term's shape is not [worlds, n], or its width changed.
    """
    values = {name: term(env, m) for name, term in env.critic.items()}
    for name, value in values.items():
        width = env.critic_widths.get(name, "n")
        if value.dim() != 2 or len(value) != env.num_envs or width not in ("n", value.shape[1]):
            expected = f"[{env.num_envs}, {width}]"
            raise TrainingError(f"critic term {name}: shape {list(value.shape)}, expected {expected}")
        env.critic_widths[name] = value.shape[1]
    return torch.cat(list(values.values()), 1).clamp(-_VALUE_CLIP, _VALUE_CLIP)
