"""The door's latch: a pressed handle releases it for the rest of the episode."""

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["launch_lock", "launch_release"]

wp.set_module_options({"enable_backward": False})


@wp.kernel
def release_kernel(qpos: wp.array2d[float], handle_qpos_adr: int, release_angle: float, locked: wp.array[int]):
    """One thread per world."""
    w = wp.tid()
    if qpos[w, handle_qpos_adr] <= release_angle:
        locked[w] = 0


def launch_release(qpos: wp.array, handle_qpos_adr: int, release_angle: float, locked: wp.array) -> None:
    """Releases the latch of every world whose handle is at or below an angle; a released latch stays released.

    Args:
        qpos: Positions, MuJoCo layout, shape [worlds, nq].
        handle_qpos_adr: Address of the handle's hinge in `qpos`; pressing the lever turns it negative.
        release_angle: Angle of release [rad], negative.
        locked: 1 = locked, updated, int32, shape [worlds].
    """
    launch(release_kernel, locked.shape[0], [qpos, handle_qpos_adr, release_angle], [locked])


@wp.kernel
def lock_kernel(mask: wp.array[int], locked: wp.array[int]):
    """One thread per world."""
    w = wp.tid()
    if mask[w] != 0:
        locked[w] = 1


def launch_lock(mask: wp.array, locked: wp.array) -> None:
    """Locks the latch of the masked worlds.

    Args:
        mask: 1 = lock, int32, shape [worlds].
        locked: 1 = locked, updated, int32, shape [worlds].
    """
    launch(lock_kernel, mask.shape[0], [mask], [locked])
