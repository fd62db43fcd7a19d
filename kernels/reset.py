"""Counters cleared, and detection of worlds whose numbers broke."""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["launch_clear", "launch_nonfinite"]

wp.set_module_options({"enable_backward": False})

MAX_VALUE = wp.constant(1.0e10)
"""MuJoCo's `mjMAXVAL`: a coordinate beyond it counts as broken."""


@wp.kernel
def clear_kernel(mask: wp.array[int], counter: wp.array[int]):
    """One thread per world."""
    w = wp.tid()
    if mask[w] != 0:
        counter[w] = 0


def launch_clear(mask: wp.array, counter: wp.array) -> None:
    """Sets the counters of the masked worlds to zero.

    Args:
        mask: 1 = clear, int32, shape [worlds].
        counter: Streak or counter, int32, shape [worlds].
    """
    launch(clear_kernel, mask.shape[0], [mask], [counter])


@wp.kernel
def nonfinite_kernel(qpos: wp.array2d[float], qvel: wp.array2d[float], bad: wp.array[int]):
    """One thread per world."""
    w = wp.tid()
    flag = int(0)
    for i in range(qpos.shape[1]):
        if not (wp.abs(qpos[w, i]) <= MAX_VALUE):
            flag = 1
    for i in range(qvel.shape[1]):
        if not (wp.abs(qvel[w, i]) <= MAX_VALUE):
            flag = 1
    bad[w] = flag


def launch_nonfinite(qpos: wp.array, qvel: wp.array, bad: wp.array) -> None:
    """Flags worlds with a NaN, an infinity, or a number beyond MuJoCo's bound 1e10.

    Args:
        qpos: Positions, shape [worlds, nq].
        qvel: Velocities, shape [worlds, nv].
        bad: Output, 1 = broken, int32, shape [worlds].
    """
    launch(nonfinite_kernel, bad.shape[0], [qpos, qvel], [bad])
