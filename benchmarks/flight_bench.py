"""Flights of a kicked ball by `ball_flight`, next to those of engine `mujoco`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import torch

from arena_newton import trackers
from arena_newton.differentiable import RollingBall, ball_flight
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.physics.mujoco_engine import MujocoPhysics
from arena_newton.tasks.football import BALL

__all__ = ["flight_figures"]

KICKS = ((2.0, 0.0, 0.0), (4.0, 0.0, 0.0), (6.0, 0.0, 0.0), (3.0, 3.0, 0.0), (4.0, 0.0, 2.0))
"""Velocities of the kicks: ahead, to the left, up [m/s]."""
TICKS = 75


def flight_figures() -> Iterator[BenchFigure]:
    """Largest distance of the two paths within 1.5 s, for each kick."""
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco", fast_physics=True)
    ball, address, speed = RollingBall.of(env.scene), env.scene.joint_qpos(BALL), env.scene.joint_qvel(BALL)
    physics = cast("MujocoPhysics", env.physics)
    for kick in KICKS:
        env.reset([7], spawn=lambda seed: ((0.0, -5.0, 0.8), (1.0, 0.0, 0.0, 0.0)))  # the robot looks on from behind
        data = physics.data[0]
        data.qvel[speed : speed + 3] = kick
        path = [torch.tensor(data.qpos[address : address + 3]).float()]
        for _ in range(TICKS):
            physics.step()
            path.append(torch.tensor(data.qpos[address : address + 3]).float())
        flown = ball_flight(path[0][None], torch.tensor([kick]), ball, ticks=TICKS)[:, 0]
        apart = 100.0 * (flown - torch.stack(path)).norm(dim=1)
        landed = next((n for n in range(1, TICKS + 1) if flown[n, 2] <= ball.radius), TICKS)
        note = f"until it lands {float(apart[:landed].max()):.1f}" if kick[2] else ""
        name = f"flights apart after a kick of {' '.join(f'{part:g}' for part in kick)} m/s, at most"
        yield BenchFigure(name, None, "cm", True, float(apart.max()), note)
    env.close()
