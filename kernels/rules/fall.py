"""Fall rules of both rule sets, judged once per control tick."""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import math

import warp as wp

from arena_newton.kernels.launching import launch
from arena_newton.kernels.rotations import load_quat2, up_of

__all__ = ["CONTACT", "NO_FALL", "TILT", "TILT_HELD", "launch_fall"]

wp.set_module_options({"enable_backward": False})

NO_FALL = wp.constant(0)
TILT = wp.constant(1)
"""Trigger of a fall: tilt beyond the hard angle."""
TILT_HELD = wp.constant(2)
"""Trigger of a fall: tilt beyond the soft angle for as many ticks as confirm."""
CONTACT = wp.constant(3)
"""Trigger of a fall: a critical body pressed at a tilt between the soft and the hard angle."""


@wp.kernel
def fall_kernel(
    qpos: wp.array2d[float],
    root_qpos_adr: int,
    contact_force: wp.array2d[float],
    critical_body_ids: wp.array[int],
    soft_up: float,
    hard_up: float,
    force_threshold: float,
    confirm_ticks: int,
    at_once: int,
    streak: wp.array[int],
    fallen: wp.array[int],
    trigger: wp.array[int],
    pressed: wp.array[int],
):
    """One thread per world."""
    w = wp.tid()
    up = up_of(load_quat2(qpos, w, root_qpos_adr + 3))
    touch = int(0)
    for k in range(critical_body_ids.shape[0]):
        if contact_force[w, critical_body_ids[k]] >= force_threshold:
            touch = 1
    soft = up < soft_up
    if not soft:
        touch = 0
    severe = up < hard_up or touch == 1
    candidate = severe
    if at_once != 0:
        candidate = soft
    count = int(0)
    if candidate:
        count = streak[w] + 1
    streak[w] = count
    result = int(0)
    if count >= confirm_ticks or (at_once != 0 and severe):
        result = 1
    fallen[w] = result
    pressed[w] = touch
    cause = int(NO_FALL)
    if result == 1:
        cause = TILT_HELD
        if up < hard_up:
            cause = TILT
        elif touch == 1:
            cause = CONTACT
    trigger[w] = cause


def launch_fall(
    qpos: wp.array,
    root_qpos_adr: int,
    contact_force: wp.array,
    critical_body_ids: wp.array,
    streak: wp.array,
    fallen: wp.array,
    trigger: wp.array,
    pressed: wp.array,
    *,
    soft_tilt_deg: float,
    hard_tilt_deg: float,
    force_threshold: float,
    confirm_ticks: int,
    at_once: bool,
) -> None:
    """Judges falls. A *severe* state is: tilt above the hard angle, or above the soft one with a pressed critical body.

    `paper` (`at_once=True`): a severe state is a fall at once, the soft tilt after `confirm_ticks` ticks in a row.
    `released` (`at_once=False`): `confirm_ticks` severe ticks in a row; the soft tilt alone never counts.

    Args:
        qpos: Positions, MuJoCo layout, shape [worlds, nq].
        root_qpos_adr: Address of the robot's free joint in `qpos`.
        contact_force: Norm of the net contact force on each body [N], shape [worlds, nbody].
        critical_body_ids: Bodies that must not be pressed, int32, shape [k].
        streak: Ticks in a row so far, updated, int32, shape [worlds]; zero it at reset.
        fallen: Output, 1 = fallen, int32, shape [worlds].
        trigger: Output, which condition made it a fall at this tick: `NO_FALL`, `TILT`, `TILT_HELD` or `CONTACT`,
            int32, shape [worlds]. Where several do, the hard tilt is named first, then the contact.
        pressed: Output, 1 = a critical body is pressed while the tilt is beyond the soft angle, int32, shape [worlds].
            Upright worlds give 0: engine `mujoco` measures contact forces of tilted worlds alone.
        soft_tilt_deg: Soft tilt [deg], 60 in both rule sets.
        hard_tilt_deg: Hard tilt [deg], 75 in both rule sets.
        force_threshold: Contact force that counts [N], 50 in both rule sets.
        confirm_ticks: Ticks in a row that confirm, 5 in both rule sets.
        at_once: Which rule: True `paper`, False `released`.
    """
    soft_up, hard_up = math.cos(math.radians(soft_tilt_deg)), math.cos(math.radians(hard_tilt_deg))
    inputs = [qpos, root_qpos_adr, contact_force, critical_body_ids, soft_up, hard_up, force_threshold]
    launch(fall_kernel, fallen.shape[0], [*inputs, confirm_ticks, int(at_once)], [streak, fallen, trigger, pressed])
