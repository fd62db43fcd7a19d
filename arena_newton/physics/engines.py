"""The physics of a batch of worlds: native MuJoCo on the CPU, or mujoco_warp on CUDA and the Warp CPU backend.

Both engines step the model that Newton compiled from the USD stage; `physics_batch.Physics` is their interface.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from arena_newton.physics.batch import Physics
from arena_newton.physics.devices import resolve_engine
from arena_newton.physics.mujoco_engine import MujocoPhysics
from arena_newton.physics.scene import Scene
from arena_newton.physics.warp_engine import WarpPhysics
from arena_newton.robot.g1 import PhysicsRate

__all__ = ["MujocoPhysics", "Physics", "WarpPhysics", "make_physics", "resolve_engine"]


def make_physics(
    scene: Scene,
    rate: PhysicsRate,
    engine: str,
    threads: int | None = None,
    *,
    models: Sequence[mujoco.MjModel] | None = None,
) -> MujocoPhysics | WarpPhysics:
    """Engine `mujoco` or `warp` over a scene.

    Args:
        rate: The tracker's physics rate.
        engine: `mujoco` or `warp`.
        threads: CPU threads of engine `mujoco`; all by default.
        models: Variants of `scene.mj_model`, one per world (worlds may share one), that differ in the fields
            `physics_warp.PER_WORLD_FIELDS`; by default every world steps the scene's model.
    """
    if engine == "mujoco":
        return MujocoPhysics(scene, rate, threads, models=models)
    return WarpPhysics(scene, rate, models=models)
