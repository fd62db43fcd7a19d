"""Per-tick bookkeeping: joint targets into actuators, one status code per world."""

import warp as wp

from arena_newton.kernels.launching import launch_again

__all__ = [
    "ERROR_ACTION",
    "ERROR_STATE",
    "ERROR_TARGETS",
    "FALL",
    "RUNNING",
    "SUCCESS",
    "launch_check_targets",
    "launch_sanitize",
    "launch_status",
    "launch_write_ctrl",
]

RUNNING = wp.constant(0)
SUCCESS = wp.constant(1)
FALL = wp.constant(2)
ERROR_STATE = wp.constant(3)
ERROR_ACTION = wp.constant(4)
ERROR_TARGETS = wp.constant(5)
EVENT = wp.constant(8)
"""Codes above EVENT carry a judge's event number."""


@wp.kernel
def _write_ctrl(
    targets: wp.array2d[wp.float32],
    joint_ctrl: wp.array[wp.int32],
    hands: wp.array2d[wp.float32],
    hand_ctrl: wp.array[wp.int32],
    hand_open: wp.array[wp.float32],
    hand_close: wp.array[wp.float32],
    mask: wp.array[wp.int32],
    ctrl: wp.array2d[wp.float32],
):
    world, i = wp.tid()
    if mask[world] == 0:
        return
    joints = joint_ctrl.shape[0]
    if i < joints:
        ctrl[world, joint_ctrl[i]] = targets[world, i]
    else:
        finger = i - joints
        side = (2 * finger) // hand_ctrl.shape[0]
        if hands[world, side] >= 0.5:
            ctrl[world, hand_ctrl[finger]] = hand_close[finger]
        else:
            ctrl[world, hand_ctrl[finger]] = hand_open[finger]


def launch_write_ctrl(
    targets: wp.array,
    joint_ctrl: wp.array,
    hands: wp.array,
    hand_ctrl: wp.array,
    hand_open: wp.array,
    hand_close: wp.array,
    mask: wp.array,
    ctrl: wp.array,
) -> None:
    """Write joint targets and binary hands of the masked worlds into the actuator targets.

    Args:
        targets: Joint targets [rad], shape [worlds, 29].
        joint_ctrl: Actuator of each joint, int32, shape [29].
        hands: Left and right hand, from 0.5 on closed, shape [worlds, 2].
        hand_ctrl: Actuator of each finger joint, left hand first, int32, shape [14], or [0] with fixed hands.
        hand_open: Finger targets of open hands [rad], shape as `hand_ctrl`.
        hand_close: Finger targets of closed hands [rad], shape as `hand_ctrl`.
        mask: 1 = write this world, int32, shape [worlds].
        ctrl: Actuator targets [rad], written, shape [worlds, nu].
    """
    dim = (ctrl.shape[0], joint_ctrl.shape[0] + hand_ctrl.shape[0])
    inputs = [targets, joint_ctrl, hands, hand_ctrl, hand_open, hand_close, mask]
    launch_again(_write_ctrl, dim=dim, inputs=inputs, outputs=[ctrl], device=ctrl.device)


@wp.kernel
def _check_targets(
    targets: wp.array2d[wp.float32],
    joint_ctrl: wp.array[wp.int32],
    ctrl: wp.array2d[wp.float32],
    bad: wp.array[wp.int32],
):
    world = wp.tid()
    broken = wp.int32(0)
    for i in range(joint_ctrl.shape[0]):
        if not wp.isfinite(targets[world, i]):
            targets[world, i] = ctrl[world, joint_ctrl[i]]
            broken = wp.int32(1)
    bad[world] = broken


def launch_check_targets(targets: wp.array, joint_ctrl: wp.array, ctrl: wp.array, bad: wp.array) -> None:
    """Flag worlds in `bad` [worlds] whose joint targets [worlds, 29] are not all finite, and hold those joints.

    Args:
        targets: Joint targets [rad], updated: a non-finite one becomes the actuator's present target.
        joint_ctrl: Actuator of each joint, int32, shape [29].
        ctrl: Actuator targets [rad], shape [worlds, nu].
        bad: Output, 1 = a target was not finite, int32, shape [worlds].
    """
    launch_again(_check_targets, dim=bad.shape[0], inputs=[targets, joint_ctrl, ctrl], outputs=[bad], device=bad.device)


@wp.kernel
def _sanitize(bad: wp.array[wp.int32], neutral: wp.array[wp.float32], action: wp.array2d[wp.float32]):
    world, i = wp.tid()
    if bad[world] != 0:
        action[world, i] = neutral[i]


def launch_sanitize(bad: wp.array, neutral: wp.array, action: wp.array) -> None:
    """Replace the actions of worlds flagged `bad` [worlds] by `neutral` [40]."""
    launch_again(_sanitize, dim=action.shape, inputs=[bad, neutral], outputs=[action], device=action.device)


@wp.kernel
def _status(
    success: wp.array[wp.int32],
    fallen: wp.array[wp.int32],
    event: wp.array[wp.int32],
    bad_state: wp.array[wp.int32],
    bad_action: wp.array[wp.int32],
    bad_targets: wp.array[wp.int32],
    status: wp.array[wp.int32],
):
    world = wp.tid()
    code = wp.int32(RUNNING)
    if event[world] != 0:
        code = EVENT + event[world]
    if fallen[world] != 0:
        code = FALL
    if success[world] != 0:
        code = SUCCESS
    if bad_state[world] != 0:
        code = ERROR_STATE
    if bad_targets[world] != 0:
        code = ERROR_TARGETS
    if bad_action[world] != 0:
        code = ERROR_ACTION
    status[world] = code


def launch_status(success, fallen, event, bad_state, bad_action, bad_targets, status) -> None:
    """One code per world, int32 [worlds], in the original's order: error, then success, then fall, then task events."""
    inputs = [success, fallen, event, bad_state, bad_action, bad_targets]
    launch_again(_status, dim=status.shape[0], inputs=inputs, outputs=[status], device=status.device)
