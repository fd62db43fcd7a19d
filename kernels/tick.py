"""Per-tick bookkeeping: joint targets into actuators, one status code per world, and what happened first when."""

from dataclasses import dataclass

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = [
    "ERROR_ACTION",
    "ERROR_STATE",
    "ERROR_TARGETS",
    "EVENT",
    "FALL",
    "NEVER",
    "RUNNING",
    "SUCCESS",
    "EpisodeLog",
    "launch_check_targets",
    "launch_clear_log",
    "launch_log",
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
NEVER = wp.constant(-1)
"""Tick of something that has not happened since step 0."""


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
    launch(_write_ctrl, dim, inputs, [ctrl])


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
    launch(_check_targets, bad.shape[0], [targets, joint_ctrl, ctrl], [bad])


@wp.kernel
def _sanitize(bad: wp.array[wp.int32], neutral: wp.array[wp.float32], action: wp.array2d[wp.float32]):
    world, i = wp.tid()
    if bad[world] != 0:
        action[world, i] = neutral[i]


def launch_sanitize(bad: wp.array, neutral: wp.array, action: wp.array) -> None:
    """Replace the actions of worlds flagged `bad` [worlds] by `neutral` [40]."""
    launch(_sanitize, action.shape, [bad, neutral], [action])


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
    launch(_status, status.shape[0], inputs, [status])


@dataclass
class EpisodeLog:
    """First tick of each event in each world's episode; int32, stored on the device."""

    tick: wp.array
    """Ticks since step 0, negative in the start-up, shape [worlds]."""
    fall_trigger: wp.array
    """Trigger of the first fall (`kernels.rules.fall`), 0 before one, shape [worlds]."""
    fall_tick: wp.array
    """Its tick, shape [worlds]."""
    event: wp.array
    """The judge's first event, 0 before one, shape [worlds]."""
    event_tick: wp.array
    """Its tick, shape [worlds]."""
    contact_tick: wp.array
    """First tick at which a critical body was pressed, or `NEVER`, shape [worlds]."""
    predicate_ticks: wp.array
    """First tick at which each predicate held, or `NEVER`, shape [worlds, n]."""

    @classmethod
    def allocate(cls, worlds: int, predicates: int, device: wp.DeviceLike) -> "EpisodeLog":
        """Allocate for a number of predicates; clear it before the first tick."""
        one = [wp.zeros(worlds, dtype=wp.int32, device=device) for _ in range(6)]
        return cls(*one, wp.zeros((worlds, predicates), dtype=wp.int32, device=device))


@wp.kernel
def _clear_log(
    mask: wp.array[wp.int32],
    first: wp.int32,
    tick: wp.array[wp.int32],
    fall_trigger: wp.array[wp.int32],
    event: wp.array[wp.int32],
    contact_tick: wp.array[wp.int32],
    predicate_ticks: wp.array2d[wp.int32],
):
    world = wp.tid()
    if mask[world] == 0:
        return
    tick[world] = first
    fall_trigger[world] = 0
    event[world] = 0
    contact_tick[world] = NEVER
    for i in range(predicate_ticks.shape[1]):
        predicate_ticks[world, i] = NEVER


def launch_clear_log(log: EpisodeLog, mask: wp.array, first: int) -> None:
    """Begin the log of the masked worlds.

    Args:
        log: Cleared.
        mask: 1 = clear, int32, shape [worlds].
        first: Tick that they are at: 0, or minus the length of the start-up.
    """
    cleared = [log.tick, log.fall_trigger, log.event, log.contact_tick, log.predicate_ticks]
    launch(_clear_log, mask.shape[0], [mask, first], cleared)


@wp.kernel
def _log(
    mask: wp.array[wp.int32],
    fall_now: wp.array[wp.int32],
    event_now: wp.array[wp.int32],
    pressed: wp.array[wp.int32],
    predicates: wp.array2d[wp.int32],
    tick: wp.array[wp.int32],
    fall_trigger: wp.array[wp.int32],
    fall_tick: wp.array[wp.int32],
    event: wp.array[wp.int32],
    event_tick: wp.array[wp.int32],
    contact_tick: wp.array[wp.int32],
    predicate_ticks: wp.array2d[wp.int32],
):
    world = wp.tid()
    if mask[world] == 0:
        return
    now = tick[world] + 1
    tick[world] = now
    if fall_trigger[world] == 0 and fall_now[world] != 0:
        fall_trigger[world] = fall_now[world]
        fall_tick[world] = now
    if now <= 0:
        return
    if event[world] == 0 and event_now[world] != 0:
        event[world] = event_now[world]
        event_tick[world] = now
    if contact_tick[world] == NEVER and pressed[world] != 0:
        contact_tick[world] = now
    for i in range(predicate_ticks.shape[1]):
        if predicate_ticks[world, i] == NEVER and predicates[world, i] != 0:
            predicate_ticks[world, i] = now


def launch_log(
    log: EpisodeLog, mask: wp.array, fall_now: wp.array, event_now: wp.array, pressed: wp.array, predicates: wp.array
) -> None:
    """Count a tick of the masked worlds and keep what happens at it for the first time.

    In the start-up only falls are kept.

    Args:
        log: Continued.
        mask: 1 = this world has moved by one tick, int32, shape [worlds].
        fall_now: Trigger of the fall rule at this tick, int32, shape [worlds].
        event_now: The judge's event at this tick, int32, shape [worlds].
        pressed: 1 = a critical body is pressed, int32, shape [worlds].
        predicates: 1 where a predicate holds at this tick, int32, shape [worlds, n].
    """
    kept = [log.tick, log.fall_trigger, log.fall_tick, log.event, log.event_tick, log.contact_tick, log.predicate_ticks]
    launch(_log, mask.shape[0], [mask, fall_now, event_now, pressed, predicates], kept)
