"""A planning model: worlds in which the contact of one prim begins smoothly, so that slopes through it hold farther."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.physics.ball import BALL, BALL_SKIN
from arena_newton.physics.mujoco_engine import MujocoPhysics

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv

__all__ = ["soft_onset"]

ONSET = 1e-4
"""Impedance of a contact at its first touch; the engine's force there jumps to that of a damper (0.9 by default)."""

TOUCH = 0.06
"""Time that a ball and what it bounces off touch [s], three ticks; in the engine it is one physics step, whose damper
turns the velocity around: its sawtooth is steeper than that of an onset, and no onset smooths it."""


def soft_onset(env: ArenaEnv, prim: str, width: float = 0.01) -> None:
    """Let the contacts of a prim begin smoothly, from now on and in all worlds of an environment.

    It then is a planning model, another world than the one that judges: `describe` names it, and `Rollout` plays no
    episode in it. Build a second environment to see what a plan does in the engine.

    Args:
        env: Worlds of engine `mujoco`.
        prim: Prim path; its geoms and those under it are changed (`solimp`, `priority`). The ball's bounce becomes that
            of a spring (`solref`) with the same restitution, on which it sinks some millimetres.
        width: Depth at which a contact has its full impedance [m].

    Raises:
        InputError: Another engine, a width that is not positive, or a prim without collision geometry.
    """
    geoms = env.scene.geom_ids(prim)
    if not isinstance(env.physics, MujocoPhysics):
        raise InputError(f"soft_onset: engine {env.engine} has no planning model: use engine mujoco")
    if not width > 0.0:
        raise InputError(f"soft_onset: width {width:g} m, expected more than 0")
    scene = env.scene
    ball = scene.geom_ids(BALL) if scene.ball_restitution is not None else ()
    bouncing = [geom for geom in geoms if geom in ball and scene.geom_labels[geom] != BALL_SKIN]
    for model in env.physics.own_models:
        full = model.geom_solimp[geoms, :2].max(axis=1)
        for geom, most in zip(geoms, full, strict=True):
            model.geom_solimp[geom] = (ONSET, most, width, 0.5, 2.0)
        model.geom_priority[geoms] = model.geom_priority.max() + 1
        if bouncing and scene.ball_restitution is not None:
            damping = -2.0 * math.log(max(scene.ball_restitution, 0.05)) / TOUCH
            model.geom_solref[bouncing] = (-((math.pi / TOUCH) ** 2) - (damping / 2.0) ** 2, -damping)
    env.planning = f"{prim} touches over {width:g} m"
