"""The flight of balls on level ground by Newton's differentiable solver, as a torch function of how they start.

The engines that play episodes have no adjoints, so `newton.solvers.SolverSemiImplicit` moves the ball alone again: it
falls, bounces, slides and rolls as the scene's ball does, on contacts of springs and dampers instead of constraints.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import newton
import numpy as np
import torch
import warp as wp

from arena_newton.differentiable.kernel_gradients import recorded
from arena_newton.errors import InputError
from arena_newton.kernels.flight import launch_place_bodies, launch_trace_bodies
from arena_newton.physics.ball import BALL
from arena_newton.robot.g1 import TICK

if TYPE_CHECKING:
    from arena_newton.physics.scene import Scene

__all__ = ["RollingBall", "ball_flight", "damping_ratio"]

STEP = 0.001
"""Physics step of the flight [s]."""
SPRING = 0.1
"""Frequency of the contact's spring times the step: 100 rad/s, on which a ball at rest sinks 1 mm. A stiffer one needs
a shorter step, because the integration is explicit."""
MOST_DAMPING = 0.75 / SPRING
"""Largest damping ratio at which the explicit step does not overshoot: twice ratio times `SPRING` is 1.5 of 2. It gives
a restitution of 0.065."""
SLIP_DECAY = 7.4
"""Rate at which friction takes the slip of a ball below the Coulomb limit [1/s]: what the engines' regularised friction
does to a ball that starts at 2 to 6 m/s (`docs/howto/program/gradients.md`). A stiff friction would roll the ball 8 cm
shorter."""
SLIP_MASS = 2.0 / 7.0
"""Part of a solid ball's mass that a force at its rim moves: 1 / (1 + m·r²/I) with I = 2/5·m·r²."""


@dataclass(frozen=True)
class RollingBall:
    """A solid ball and the ground under it."""

    radius: float
    """[m]."""
    mass: float
    """[kg]."""
    friction: float
    """Coefficient of friction between ball and ground."""
    restitution: float
    """Speed of parting over speed of approach, 0 to 1."""

    @classmethod
    def of(cls, scene: Scene) -> RollingBall:
        """The ball of a scene, with the bounce that its rule set gives it.

        Raises:
            InputError: The scene has no ball.
        """
        restitution = scene.ball_restitution
        if restitution is None:
            raise InputError(f"{scene.path}: has no ball")
        model, geom = scene.mj_model, scene.geom_ids(BALL)[0]
        return cls(
            radius=float(model.geom_size[geom, 0]),
            mass=float(model.body_mass[scene.body_id(BALL)]),
            friction=float(model.geom_friction[geom, 0]),
            restitution=restitution,
        )


def damping_ratio(restitution: float) -> float:
    """Damping ratio ζ of a contact whose damper works on the approach alone, as Newton's does, for a restitution.

    The approach from speed u compresses the spring by x = u/ω·exp(−ζ·arccos(ζ)/√(1−ζ²)), with arcosh and √(ζ²−1) for
    ζ > 1; the spring then gives back ω·x. Restitution falls with ζ, so that bisection finds it.

    Args:
        restitution: Speed of parting over speed of approach, 0 to 1.
    """

    def parting(ratio: float) -> float:
        if ratio < 1.0:
            return math.exp(-ratio * math.acos(ratio) / math.sqrt(1.0 - ratio**2))
        return math.exp(-ratio * math.acosh(ratio) / math.sqrt(ratio**2 - 1.0)) if ratio > 1.0 else math.exp(-1.0)

    low, high = 0.0, 1.0
    while parting(high) > restitution and high < MOST_DAMPING:
        low, high = high, 2.0 * high
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if parting(middle) > restitution else (low, middle)
    return min(high, MOST_DAMPING)


@functools.lru_cache(maxsize=8)
def _model(ball: RollingBall, balls: int, device: str) -> tuple[newton.Model, newton.Contacts]:
    """Balls that do not meet, on one ground, and the contact that each of them has with it, wherever it is.

    A contact of a sphere is its centre and its radius along the normal, a plane's one point of it: neither depends on
    the pose, so that the contacts are found once.
    """
    rate = SPRING / STEP
    material = newton.ModelBuilder.ShapeConfig(
        density=0.0,
        ke=ball.mass * rate**2,
        kd=2.0 * damping_ratio(ball.restitution) * ball.mass * rate,
        kf=SLIP_DECAY * SLIP_MASS * ball.mass,
        mu=ball.friction,
        restitution=0.0,
    )
    inertia = wp.mat33(np.eye(3, dtype=np.float32) * 0.4 * ball.mass * ball.radius**2)
    builder = newton.ModelBuilder()
    for _ in range(balls):
        builder.begin_world()
        start = wp.transform(wp.vec3(0.0, 0.0, ball.radius), wp.quat_identity())
        body = builder.add_link(xform=start, mass=ball.mass, inertia=inertia)
        builder.add_shape_sphere(body, radius=ball.radius, cfg=material)
        builder.end_world()
    builder.add_ground_plane(cfg=material)
    model = builder.finalize(device=device, requires_grad=True, skip_validation_joints=True)
    pipeline = newton.CollisionPipeline(model, broad_phase="explicit")
    contacts = pipeline.contacts()
    pipeline.collide(model.state(), contacts)
    return model, contacts


def ball_flight(
    position: torch.Tensor,
    velocity: torch.Tensor,
    ball: RollingBall,
    *,
    ticks: int,
    spin: torch.Tensor | None = None,
) -> torch.Tensor:
    """Positions of balls, tick by tick, differentiable in their initial positions and velocities.

    They know gravity and the ground z = 0, nothing else. Gradients are exact in the air, in sliding and in rolling.
    Behind a bounce, those to what decides when it lands (height and vertical speed) are wrong: the steps are
    differentiated as they were taken, and the step of the landing does not move.

    Args:
        position: Centres at the start [m], float32, shape [balls, 3].
        velocity: Velocities at the start [m/s], shape [balls, 3].
        ball: What they are.
        ticks: How long, in ticks of 0.02 s.
        spin: Angular velocities at the start [rad/s], shape [balls, 3]; none by default.

    Returns:
        Centres [m], shape [ticks + 1, balls, 3]; the first row is the start.

    Raises:
        InputError: Shapes that do not fit each other.
    """
    spin = torch.zeros_like(velocity) if spin is None else spin
    count = len(position)
    if not count or any(t.shape != (count, 3) for t in (position, velocity, spin)) or ticks < 0:
        shapes = ", ".join(str(list(t.shape)) for t in (position, velocity, spin))
        raise InputError(f"ball_flight: position, velocity, spin of shape {shapes} for {ticks} ticks: expected [n, 3]")
    model, contacts = _model(ball, count, str(wp.device_from_torch(position.device)))
    solver = newton.solvers.SolverSemiImplicit(model, angular_damping=0.0)
    substeps = round(TICK / STEP)

    def record(place: wp.array, speed: wp.array, turn: wp.array) -> tuple[wp.Tape, list[wp.array]]:
        path = wp.zeros((ticks + 1, count, 3), dtype=wp.float32, device=model.device, requires_grad=True)
        states = [model.state(requires_grad=True) for _ in range(ticks * substeps + 1)]
        tape = wp.Tape()
        with tape:
            launch_place_bodies(place, speed, turn, states[0].body_q, states[0].body_qd)
            launch_trace_bodies(states[0].body_q, 0, path)
            for k, (before, after) in enumerate(zip(states, states[1:], strict=False), start=1):
                solver.step(before, after, None, contacts, STEP)
                if k % substeps == 0:
                    launch_trace_bodies(after.body_q, k // substeps, path)
        return tape, [path]

    return recorded(record, position.float(), velocity.float(), spin.float())[0]
