"""The canonical 64D state, the integration of 40D actions into a reference pose, and the 35D mimic command.

Schema v3.1 of the original benchmark: xy displacement per control step in the reference's own full frame, absolute
root height, orientation as rot6d with the initial heading removed, 29 absolute joint positions in canonical order, two
hands.
"""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import math
from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from arena_newton.kernels.launching import launch
from arena_newton.kernels.rotations import (
    heading_quat,
    heading_yaw,
    limit_rotation,
    load_quat2,
    pitch_of,
    quat_from_rot6d,
    roll_of,
    rot6d_from_quat,
    rot6d_is_degenerate,
    vec6,
    wrap_angle,
)

__all__ = [
    "ACTION_BAD_ROT6D",
    "ACTION_NONFINITE",
    "ReferencePose",
    "launch_integrate",
    "launch_reset_reference",
    "launch_state64",
    "launch_validate_action",
]

JOINTS = wp.constant(29)
"""Joints of the body, `g1.MUJOCO_JOINTS`, from which the widths follow."""
STATE_VEL = wp.constant(6 + JOINTS)
"""First joint velocity of state 64."""
ACTION_JOINTS = wp.constant(9)
"""First joint of action 40."""
ACTION_HANDS = wp.constant(ACTION_JOINTS + JOINTS)
"""First hand of action 40."""
ACTION_SIZE = wp.constant(ACTION_HANDS + 2)
MIMIC_JOINTS = wp.constant(6)
"""First joint of mimic 35."""
HAND_CLOSED_FROM = wp.constant(0.5)
"""A hand command from here on closes the hand."""
LEVEL_FLOOR = wp.constant(1.0e-6)
"""Below this |R22| the reference frame is on its edge and height no longer gives local z: its part is dropped."""

ACTION_NONFINITE = 1
"""Flag of `launch_validate_action`: a number of the action is NaN or infinite."""
ACTION_BAD_ROT6D = 2
"""Flag of `launch_validate_action`: the two columns of the rot6d span no plane."""
_NONFINITE = wp.constant(ACTION_NONFINITE)
_BAD_ROT6D = wp.constant(ACTION_BAD_ROT6D)


@dataclass
class ReferencePose:
    """The reference that actions integrate to, per world, and what the next step needs of the last."""

    position: wp.array
    """World position [m], shape [worlds, 3]; xy is integrated open loop, z is the action's."""
    quat: wp.array
    """World orientation of the target, wxyz, shape [worlds, 4]; the robot's own right after a reset."""
    joints: wp.array
    """Joint targets [rad], canonical order, shape [worlds, 29]."""
    joint_vel: wp.array
    """Backward difference of the joint targets [rad/s], canonical order, zero on the first step, shape [worlds, 29]."""
    heading: wp.array
    """Heading of the robot at reset [rad], shape [worlds]."""
    prev_yaw: wp.array
    """Yaw of the last target [rad], shape [worlds]."""
    prev_z: wp.array
    """Height of the last action [m], shape [worlds]."""
    hands: wp.array
    """Left and right hand, 1 closed, 0 open, shape [worlds, 2]."""
    mimic: wp.array
    """[vx, vy, z, roll, pitch, yaw_rate, 29 joints in MuJoCo order], shape [worlds, 35]."""
    steps: wp.array
    """Steps since the reset, int32, shape [worlds]."""
    canonical_to_mujoco: wp.array
    """MuJoCo index of each canonical joint, int32, shape [29]."""
    tick: float
    """Control period [s]."""

    @classmethod
    def allocate(
        cls,
        worlds: int,
        device: wp.DeviceLike = None,
        *,
        canonical_to_mujoco: Sequence[int],
        tick: float,
        requires_grad: bool = False,
    ) -> "ReferencePose":
        """Allocates zeros for `worlds` worlds; reset it before the first step.

        Args:
            canonical_to_mujoco: MuJoCo index of each of the 29 canonical joints (`g1.CANONICAL_TO_MUJOCO`).
            tick: Control period [s] (`g1.TICK`).
            requires_grad: whether a `wp.Tape` differentiates through the arrays.
        """

        def zeros(*shape: int) -> wp.array:
            return wp.zeros(shape, dtype=wp.float32, device=device, requires_grad=requires_grad)

        return cls(
            position=zeros(worlds, 3),
            quat=zeros(worlds, 4),
            joints=zeros(worlds, JOINTS),
            joint_vel=zeros(worlds, JOINTS),
            heading=zeros(worlds),
            prev_yaw=zeros(worlds),
            prev_z=zeros(worlds),
            hands=zeros(worlds, 2),
            mimic=zeros(worlds, MIMIC_JOINTS + JOINTS),
            steps=wp.zeros(worlds, dtype=wp.int32, device=device),
            canonical_to_mujoco=wp.array(list(canonical_to_mujoco), dtype=wp.int32, device=device),
            tick=float(tick),
        )


@wp.kernel
def state64_kernel(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    root_qpos_adr: int,
    joint_qpos: wp.array[int],
    joint_qvel: wp.array[int],
    heading0: wp.array[float],
    state: wp.array2d[float],
):
    """One thread per world."""
    w = wp.tid()
    q = wp.quat_inverse(heading_quat(heading0[w])) * load_quat2(qpos, w, root_qpos_adr + 3)
    r = rot6d_from_quat(q)
    for i in range(6):
        state[w, i] = r[i]
    for i in range(JOINTS):
        state[w, 6 + i] = qpos[w, joint_qpos[i]]
        state[w, STATE_VEL + i] = qvel[w, joint_qvel[i]]


def launch_state64(
    qpos: wp.array,
    qvel: wp.array,
    root_qpos_adr: int,
    joint_qpos: wp.array,
    joint_qvel: wp.array,
    heading0: wp.array,
    state: wp.array,
) -> None:
    """Writes the canonical state: rot6d without the initial heading, joint positions [rad], joint velocities [rad/s].

    Args:
        qpos: Positions, MuJoCo layout, shape [worlds, nq].
        qvel: Velocities, MuJoCo layout, shape [worlds, nv].
        root_qpos_adr: Address of the robot's free joint in `qpos`.
        joint_qpos: Addresses in `qpos`, canonical order, int32, shape [29].
        joint_qvel: Addresses in `qvel`, canonical order, int32, shape [29].
        heading0: Heading of the robot at reset [rad], shape [worlds].
        state: Output, shape [worlds, 64].
    """
    launch(state64_kernel, state.shape[0], [qpos, qvel, root_qpos_adr, joint_qpos, joint_qvel, heading0], [state])


@wp.kernel
def reset_reference_kernel(
    qpos: wp.array2d[float],
    root_qpos_adr: int,
    mask: wp.array[int],
    canonical_to_mujoco: wp.array[int],
    position: wp.array2d[float],
    quat: wp.array2d[float],
    joints: wp.array2d[float],
    joint_vel: wp.array2d[float],
    heading: wp.array[float],
    prev_yaw: wp.array[float],
    prev_z: wp.array[float],
    hands: wp.array2d[float],
    mimic: wp.array2d[float],
    steps: wp.array[int],
):
    """One thread per world."""
    w = wp.tid()
    if mask[w] == 0:
        return
    q = load_quat2(qpos, w, root_qpos_adr + 3)
    yaw = heading_yaw(q)
    heading[w] = yaw
    prev_yaw[w] = yaw
    prev_z[w] = qpos[w, root_qpos_adr + 2]
    steps[w] = 0
    for i in range(3):
        position[w, i] = qpos[w, root_qpos_adr + i]
    quat[w, 0] = q[3]
    quat[w, 1] = q[0]
    quat[w, 2] = q[1]
    quat[w, 3] = q[2]
    hands[w, 0] = 0.0
    hands[w, 1] = 0.0
    for i in range(JOINTS):
        joints[w, i] = 0.0
        joint_vel[w, i] = 0.0
    for i in range(JOINTS + MIMIC_JOINTS):
        mimic[w, i] = 0.0


def launch_reset_reference(ref: ReferencePose, qpos: wp.array, root_qpos_adr: int, mask: wp.array) -> None:
    """Anchors the reference of the masked worlds at the robot: its xy, its orientation as the last target, its heading.

    Args:
        ref: The reference; joints, velocities, hands and mimic become zero until the first step.
        qpos: Positions, MuJoCo layout, shape [worlds, nq].
        root_qpos_adr: Address of the robot's free joint in `qpos`.
        mask: 1 = reset this world, int32, shape [worlds].
    """
    inputs = [qpos, root_qpos_adr, mask, ref.canonical_to_mujoco]
    outputs = [ref.position, ref.quat, ref.joints, ref.joint_vel, ref.heading, ref.prev_yaw, ref.prev_z]
    launch(reset_reference_kernel, mask.shape[0], inputs, [*outputs, ref.hands, ref.mimic, ref.steps])


@wp.kernel
def integrate_kernel(
    action: wp.array2d[float],
    mask: wp.array[int],
    max_root_delta: float,
    tick: float,
    canonical_to_mujoco: wp.array[int],
    heading: wp.array[float],
    position: wp.array2d[float],
    quat: wp.array2d[float],
    joints: wp.array2d[float],
    prev_yaw: wp.array[float],
    prev_z: wp.array[float],
    steps: wp.array[int],
    out_position: wp.array2d[float],
    out_quat: wp.array2d[float],
    out_joints: wp.array2d[float],
    out_joint_vel: wp.array2d[float],
    out_prev_yaw: wp.array[float],
    out_prev_z: wp.array[float],
    out_hands: wp.array2d[float],
    out_mimic: wp.array2d[float],
    out_steps: wp.array[int],
):
    """One thread per world. Outputs may be the inputs' own arrays; a tape needs separate arrays."""
    w = wp.tid()
    if mask[w] == 0:
        return
    first = steps[w] == 0
    dx = action[w, 0]
    dy = action[w, 1]
    z = action[w, 2]
    rot = vec6(action[w, 3], action[w, 4], action[w, 5], action[w, 6], action[w, 7], action[w, 8])
    target = wp.normalize(heading_quat(heading[w]) * quat_from_rot6d(rot))
    if max_root_delta > 0.0:
        target = limit_rotation(load_quat2(quat, w, 0), target, max_root_delta)
    r = wp.quat_to_matrix(target)
    dz = wp.where(first, 0.0, z - prev_z[w])
    dz_local = float(0.0)
    if wp.abs(r[2, 2]) > LEVEL_FLOOR:
        dz_local = (dz - r[2, 0] * dx - r[2, 1] * dy) / r[2, 2]
    x_new = position[w, 0] + (r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz_local)
    y_new = position[w, 1] + (r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz_local)
    yaw = heading_yaw(target)
    yaw_rate = wrap_angle(yaw - prev_yaw[w]) / tick

    out_mimic[w, 0] = dx / tick
    out_mimic[w, 1] = dy / tick
    out_mimic[w, 2] = z
    out_mimic[w, 3] = roll_of(target)
    out_mimic[w, 4] = pitch_of(target)
    out_mimic[w, 5] = yaw_rate
    for i in range(JOINTS):
        joint = action[w, ACTION_JOINTS + i]
        out_joint_vel[w, i] = wp.where(first, 0.0, (joint - joints[w, i]) / tick)
        out_joints[w, i] = joint
        out_mimic[w, MIMIC_JOINTS + canonical_to_mujoco[i]] = joint
    for i in range(2):
        out_hands[w, i] = wp.where(action[w, ACTION_HANDS + i] >= HAND_CLOSED_FROM, 1.0, 0.0)
    out_position[w, 0] = x_new
    out_position[w, 1] = y_new
    out_position[w, 2] = z
    out_quat[w, 0] = target[3]
    out_quat[w, 1] = target[0]
    out_quat[w, 2] = target[1]
    out_quat[w, 3] = target[2]
    out_prev_yaw[w] = yaw
    out_prev_z[w] = z
    out_steps[w] = steps[w] + 1


def launch_integrate(
    ref: ReferencePose,
    action: wp.array,
    mask: wp.array,
    max_root_delta_deg: float = 0.0,
    *,
    out: ReferencePose | None = None,
) -> None:
    """Executes one action per world: advances the reference pose and writes the mimic command.

    Height enters as the difference between consecutive actions (none on the first step), which fixes the local z
    displacement and with it the world xy displacement. Velocities in `mimic` are the action's displacements divided by
    the tick; the yaw rate is the wrapped difference to the last target's yaw, on the first step to the robot's.

    Args:
        ref: The reference, advanced in place unless `out` is given.
        action: Canonical actions, shape [worlds, 40].
        mask: 1 = advance this world, int32, shape [worlds].
        max_root_delta_deg: Largest rotation [deg] between consecutive targets; 0 = no limit (SONIC scripts: 26).
        out: Where to write instead, for differentiation.
    """
    to = ref if out is None else out
    inputs = [action, mask, math.radians(max_root_delta_deg), ref.tick, ref.canonical_to_mujoco, ref.heading]
    inputs += [ref.position, ref.quat, ref.joints, ref.prev_yaw, ref.prev_z, ref.steps]
    outputs = [to.position, to.quat, to.joints, to.joint_vel, to.prev_yaw, to.prev_z, to.hands, to.mimic, to.steps]
    launch(integrate_kernel, action.shape[0], inputs, outputs)


@wp.kernel
def validate_action_kernel(action: wp.array2d[float], bad: wp.array[int]):
    """One thread per world."""
    w = wp.tid()
    flag = int(0)
    for i in range(ACTION_SIZE):
        if not wp.isfinite(action[w, i]):
            flag = _NONFINITE
    if flag == 0:
        rot = vec6(action[w, 3], action[w, 4], action[w, 5], action[w, 6], action[w, 7], action[w, 8])
        if rot6d_is_degenerate(rot):
            flag = _BAD_ROT6D
    bad[w] = flag


def launch_validate_action(action: wp.array, bad: wp.array) -> None:
    """Flags actions that cannot be executed.

    Args:
        action: Canonical actions, shape [worlds, 40].
        bad: Output: 0 good, `ACTION_NONFINITE`, or `ACTION_BAD_ROT6D` (|c0 x c1| < 1e-6), int32, shape [worlds].
    """
    launch(validate_action_kernel, action.shape[0], [action], [bad])
