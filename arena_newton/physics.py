"""The physics of a batch of worlds: native MuJoCo on the CPU, or mujoco_warp on CUDA and the Warp CPU backend.

Both engines step the model that Newton compiled from the USD stage; `physics_batch.Physics` is their interface.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import warp as wp

from arena_newton.errors import InputError
from arena_newton.physics_batch import Physics
from arena_newton.physics_mujoco import MujocoPhysics
from arena_newton.physics_warp import WarpPhysics
from arena_newton.robot import PhysicsRate
from arena_newton.scene import Scene

__all__ = ["MujocoPhysics", "Physics", "WarpPhysics", "make_physics", "resolve_engine"]


def resolve_engine(engine: str, device: str | None) -> tuple[str, str]:
    """Engine and device for `auto`, checked against what this machine has.

    Raises:
        InputError: Unknown engine, or a device that this machine does not have.
    """
    cuda = wp.is_cuda_available()
    if engine not in {"auto", "mujoco", "warp"}:
        raise InputError(f"--engine {engine}: unknown, choose auto, mujoco or warp")
    if device is not None and device != "cpu":
        if not device.startswith("cuda"):
            raise InputError(f"--device {device}: unknown, choose cpu, cuda or cuda:N")
        if not cuda:
            raise InputError(f"--device {device}: no CUDA device on this machine, use --device cpu")
        if device != "cuda" and device not in {d.alias for d in wp.get_cuda_devices()}:
            raise InputError(f"--device {device}: no such device, this machine has {wp.get_cuda_device_count()}")
    if engine == "auto":
        engine = "warp" if cuda and device != "cpu" else "mujoco"
    if engine == "mujoco":
        if device not in (None, "cpu"):
            raise InputError(f"--device {device}: engine mujoco runs on the CPU, use --engine warp for CUDA")
        return "mujoco", "cpu"
    return "warp", device or ("cuda:0" if cuda else "cpu")


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
        scene: The scene.
        rate: The tracker's physics rate.
        engine: `mujoco` or `warp`.
        threads: CPU threads of engine `mujoco`; all by default.
        models: Variants of `scene.mj_model`, one per world (worlds may share one), that differ in the fields
            `physics_warp.PER_WORLD_FIELDS`; by default every world steps the scene's model.
    """
    if engine == "mujoco":
        return MujocoPhysics(scene, rate, threads, models=models)
    return WarpPhysics(scene, rate, models=models)
