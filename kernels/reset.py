"""Masked writes of initial states, counters cleared, and detection of worlds whose numbers broke."""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["launch_clear", "launch_nonfinite", "launch_reset"]

wp.set_module_options({"enable_backward": False})

MAX_VALUE = wp.constant(1.0e10)
"""MuJoCo's `mjMAXVAL`: a coordinate beyond it counts as broken."""


@wp.kernel
def reset_state_kernel(
    mask: wp.array[int],
    qpos0: wp.array2d[float],
    qvel0: wp.array2d[float],
    ctrl0: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
):
    """One thread per world and column."""
    w, i = wp.tid()
    if mask[w] == 0:
        return
    if i < qpos.shape[1]:
        qpos[w, i] = qpos0[w, i]
    if i < qvel.shape[1]:
        qvel[w, i] = qvel0[w, i]
    if i < ctrl.shape[1]:
        ctrl[w, i] = ctrl0[w, i]


@wp.kernel
def reset_mocap_kernel(
    mask: wp.array[int],
    mocap_pos0: wp.array3d[float],
    mocap_quat0: wp.array3d[float],
    mocap_pos: wp.array3d[float],
    mocap_quat: wp.array3d[float],
):
    """One thread per world and mocap body."""
    w, i = wp.tid()
    if mask[w] == 0:
        return
    for k in range(3):
        mocap_pos[w, i, k] = mocap_pos0[w, i, k]
    for k in range(4):
        mocap_quat[w, i, k] = mocap_quat0[w, i, k]


def launch_reset(
    mask: wp.array,
    qpos0: wp.array,
    qvel0: wp.array,
    ctrl0: wp.array,
    mocap_pos0: wp.array | None,
    mocap_quat0: wp.array | None,
    qpos: wp.array,
    qvel: wp.array,
    ctrl: wp.array,
    mocap_pos: wp.array | None,
    mocap_quat: wp.array | None,
) -> None:
    """Writes the initial state of the masked worlds and leaves the others untouched, bit for bit.

    Args:
        mask: 1 = reset this world, int32, shape [worlds].
        qpos0: Initial positions, shape [worlds, nq].
        qvel0: Initial velocities, shape [worlds, nv].
        ctrl0: Initial controls, shape [worlds, nu].
        mocap_pos0: Fixture positions [m], shape [worlds, nmocap, 3], or None without fixtures.
        mocap_quat0: Fixture orientations, wxyz, shape [worlds, nmocap, 4], or None.
        qpos: Written, shape [worlds, nq].
        qvel: Written, shape [worlds, nv].
        ctrl: Written, shape [worlds, nu].
        mocap_pos: Written, shape [worlds, nmocap, 3], or None.
        mocap_quat: Written, shape [worlds, nmocap, 4], or None.
    """
    worlds = mask.shape[0]
    columns = max(qpos.shape[1], qvel.shape[1], ctrl.shape[1])
    launch(reset_state_kernel, (worlds, columns), [mask, qpos0, qvel0, ctrl0], [qpos, qvel, ctrl])
    if mocap_pos is not None and mocap_pos.shape[1] > 0:
        launch(
            reset_mocap_kernel, (worlds, mocap_pos.shape[1]), [mask, mocap_pos0, mocap_quat0], [mocap_pos, mocap_quat]
        )


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
