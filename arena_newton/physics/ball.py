"""The ball's contacts: one sphere bounces with a given restitution, a slightly larger one rests and rolls."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import newton
import numpy as np

if TYPE_CHECKING:
    from arena_newton.physics.scene import Scene

__all__ = ["BALL", "BALL_SKIN", "SKIN_HEIGHT", "add_skin", "ball_solref", "set_restitution"]

BALL = "/World/Ball"
BALL_SPRING = 0.025
"""Part of a ball's penetration that the spring of its contact undoes in one physics step: the bounce grows by up to as
much with the depth at which a step finds the ball, and a sunk ball at rest rises within some 1/BALL_SPRING steps."""
BALL_SOLIMP = (0.999, 0.999, 0.001, 0.5, 2.0)
"""Constraint impedance of the ball: constant and near 1, so that the contact does what its solref says."""
BALL_SKIN = f"{BALL}/Skin"
"""Label of the sphere around a ball on which it rests and rolls, see `add_skin`."""
SKIN_HEIGHT = 0.001
"""Extra radius of that sphere [m]: its contact carries a ball at rest before the inner one is touched."""
SKIN_SOLREF = (-0.01, -0.01)
SKIN_SOLIMP = (0.9, 0.001, 0.002, 0.5, 2.0)
"""Stiffness 10,000/s² and damping 10/s, times the last impedance by which MuJoCo divides them; the impedance fades from
0.9 at the surface to nothing 2 mm deep, so that an impact, which is deeper, feels the inner contact alone."""
SKIN_SOLIMP_WARP = (*SKIN_SOLIMP[:4], 1.0)
"""The same on engine `warp`, but fading along a line: mujoco_warp 3.17 clamps every other curve that falls with depth
to its last impedance, and the ball then slides as on ice. Both curves are 0.45 at the depth of 1 mm."""


def ball_solref(restitution: float, dt: float) -> tuple[float, float]:
    """MuJoCo direct-form solref (−stiffness, −damping) of a contact with the given coefficient of restitution.

    The contact reverses the velocity within the physics step that finds it, as the original's engine does: a damper
    of (1 + e)/dt takes the approach u away and adds e·u. It then does not pull the ball back, since a contact only
    pushes; the closed form of a spring with damping, which pulls too, bounces 0.25 where 0.1 is asked. The weak spring
    lifts the ball out; it adds at most BALL_SPRING·u. MuJoCo divides the stiffness by the impedance's square and the
    damping by the impedance, and multiplies the stiffness by it. Such a damper is for contacts without friction alone:
    in the pyramidal cone it also acts on half of the speed of sliding and throws a sliding ball up (`add_skin`).

    Args:
        restitution: Speed of parting over speed of approach, 0 to 1.
        dt: Physics step [s].
    """
    impedance = BALL_SOLIMP[1]
    return -BALL_SPRING / dt**2 * impedance, -(1.0 + float(restitution)) / dt * impedance


def add_skin(builder: newton.ModelBuilder) -> None:
    """Give a round ball two contacts: its own, now without friction, bounces; a sphere 1 mm larger rests and rolls.

    One contact cannot do both. MuJoCo's pyramidal cone couples the damping that a bounce needs to the speed of sliding:
    a ball kicked to 6 m/s along the grass would hop 15 cm, and a glancing bounce would be several times as high as it
    should be. A ball of another shape keeps its one contact.
    """
    if BALL not in builder.body_label:
        return
    body = builder.body_label.index(BALL)
    shapes = [s for s, b in enumerate(builder.shape_body) if b == body]
    solid = [s for s in shapes if builder.shape_flags[s] & newton.ShapeFlags.COLLIDE_SHAPES]
    if len(solid) != 1 or builder.shape_type[solid[0]] != newton.GeoType.SPHERE:
        return
    (shape,) = solid
    attributes = {name: builder.custom_attributes[f"mujoco:{name}"].values for name in ("condim", "geom_priority")}
    condim = int(attributes["condim"].get(shape) or 3)
    if condim == 1:
        return
    builder.add_shape_sphere(
        body,
        xform=builder.shape_transform[shape],
        radius=float(builder.shape_scale[shape][0]) + SKIN_HEIGHT,
        cfg=newton.ModelBuilder.ShapeConfig(
            density=0.0,
            mu=builder.shape_material_mu[shape],
            mu_torsional=builder.shape_material_mu_torsional[shape],
            mu_rolling=builder.shape_material_mu_rolling[shape],
            collision_group=builder.shape_collision_group[shape],
            gap=0.0,
            is_visible=False,
        ),
        label=BALL_SKIN,
        custom_attributes={
            "mujoco:condim": condim,
            "mujoco:geom_priority": int(attributes["geom_priority"].get(shape) or 0),
        },
    )
    attributes["condim"][shape] = 1


def set_restitution(scene: Scene, restitution: float, dt: float, *models: mujoco.MjModel) -> None:
    """Give the ball's contacts a coefficient of restitution at a physics step.

    Args:
        scene: Scene with a `/World/Ball`.
        restitution: Speed of parting over speed of approach, 0 to 1.
        dt: Physics step of the engine that will step the models [s].
        models: MuJoCo or mujoco_warp models of this scene to change; the scene's own when none is named.

    Raises:
        InputError: The ball has no collision geometry.
    """
    contacts = {g: (ball_solref(restitution, dt), BALL_SOLIMP) for g in scene.geom_ids(BALL)}
    skins = [geom for geom, label in enumerate(scene.geom_labels) if label == BALL_SKIN]
    for model in models or (scene.mj_model, getattr(scene.solver, "mjw_model", None)):
        solimp = SKIN_SOLIMP if isinstance(model, mujoco.MjModel) else SKIN_SOLIMP_WARP
        contacts |= dict.fromkeys(skins, (SKIN_SOLREF, solimp))
        for k, name in enumerate(("geom_solref", "geom_solimp")):
            array = getattr(model, name, None)
            if array is None:
                continue
            values = array if isinstance(array, np.ndarray) else array.numpy()
            for geom, contact in contacts.items():
                values[..., geom, :] = contact[k]
            if values is not array:
                array.assign(values)
