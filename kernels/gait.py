"""The reference generator's tick around the solver of the joints: commands to goals, solution to frame and action.

`launch_plan` limits the channels of a command, moves body and feet and writes the goals of `ik`; `launch_present` takes
its solution over. Both and `launch_realign` are one launch for any number of worlds, and no world's numbers depend on
another world.
"""

from dataclasses import dataclass

import warp as wp

from arena_newton.kernels import ik
from arena_newton.kernels.footwork import (
    BEHIND_PER_STEP,
    LEFT,
    LEFT_KICK,
    RIGHT,
    STRIDE,
    GaitModel,
    GaitState,
    advance_kick,
    approach,
    rotate_xy,
    smooth,
    sway,
    velocity_of,
    walk,
)
from arena_newton.kernels.launching import launch
from arena_newton.kernels.rotations import wrap_angle

__all__ = ["FRAME", "FRAME_WIDTH", "Presented", "launch_plan", "launch_present", "launch_realign"]

# Unrolled, loops over columns and feet take the compiler longer, for no faster a kernel.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

WALK_HEIGHT = wp.constant(0.75)
"""Highest pelvis of a walk [m]: higher, the legs do not reach their footsteps."""
LONGEST_BEHIND, LOWERING = wp.constant(0.22), wp.constant(0.8)
"""A foot farther behind the pelvis than this at the end of its stance [m] lowers the walk by this much per metre."""
LIFT_SPEED, LIFT_ACCELERATION = wp.constant(0.35), wp.constant(2.0)
"""The pelvis follows the ground under the feet with this speed [m/s] and acceleration [m/s²]."""
DEEP, DEEP_LEAN = wp.constant(0.55), wp.constant(2.6)
"""Below this pelvis height [m] the pelvis leans so much per metre [rad/m]: upright, ankles would not bend enough."""
WALK_PITCH = wp.constant(0.05)
"""Forward lean of the pelvis in a walk [rad]."""
STILL = wp.constant(0.02)
"""Commanded speeds below this are standing [m/s, rad/s]."""
SEATED = wp.constant(0.01)
"""A pelvis farther behind its position above the feet than this sits [m]."""
SEAT_BLEND = wp.constant(0.05)
"""The seat's bound on the pelvis is complete at this `pelvis_back` [m]."""
COM_AHEAD = wp.constant(0.0214)
"""Centre of mass ahead of the ankles in a relaxed stand [m]: where the default pose has it."""
CAREFUL_DEPTH = wp.constant(0.2)
"""Depth of a squat from which on the centre of mass is above the middle of the soles [m]."""
KICK_COM_AHEAD = wp.constant(0.055)
"""Centre of mass ahead of the ankle of the standing foot in a kick [m]."""
KICK_HEIGHT = wp.constant(0.75)
"""Highest pelvis of a kick [m]."""

FRAME: dict[str, slice] = {
    "root_pos": slice(0, 3),
    "root_quat": slice(3, 7),
    "joint_pos": slice(7, 36),
    "hands": slice(36, 38),
}
"""One row of frames: position of the pelvis [m], its orientation, wxyz, joints [rad], MuJoCo order, and hands."""
FRAME_WIDTH = 38

_COM = wp.constant(ik.GOAL["com"].start)
_PELVIS = wp.constant(ik.GOAL["pelvis"].start)
_PELVIS_WEIGHT = wp.constant(ik.GOAL["pelvis_weight"].start)
_HEIGHT = wp.constant(ik.GOAL["height"].start)
_SEAT = wp.constant(ik.GOAL["seat"].start)
_ANCHOR = wp.constant(ik.GOAL["anchor"].start)
_YAW = wp.constant(ik.GOAL["yaw"].start)
_PITCH = wp.constant(ik.GOAL["pitch"].start)
_ROLL = wp.constant(ik.GOAL["roll"].start)
_FEET = wp.constant(ik.GOAL["feet"].start)
_UPPER = wp.constant(ik.GOAL["upper"].start)
_HAND_POINT = wp.constant(ik.GOAL["hand_point"].start)
_REACH = wp.constant(ik.GOAL["reach"].start)
_SEAT_WEIGHT = wp.constant(ik.GOAL["seat_weight"].start)
_ROOT_QUAT = wp.constant(FRAME["root_quat"].start)
_JOINT_POS = wp.constant(FRAME["joint_pos"].start)
_HANDS = wp.constant(FRAME["hands"].start)


@dataclass
class Presented:
    """Outputs of a tick; rows are worlds."""

    frame: wp.array
    """Rows laid out as `FRAME`, shape [worlds, `FRAME_WIDTH`]."""
    action: wp.array
    """Canonical actions, orientation relative to the yaw at the reset, shape [worlds, 40]."""
    to_mujoco: wp.array
    """MuJoCo index of each canonical joint, int32, shape [29]."""


@wp.func
def in_range(m: GaitModel, command: wp.array2d[float], w: int, column: int) -> float:
    """A number of a packed command within its range; one that is not a number stays what it is."""
    value = command[w, column]
    if value < m.low[column]:
        value = m.low[column]
    if value > m.high[column]:
        value = m.high[column]
    return value


@wp.func
def limit_channels(
    m: GaitModel,
    s: GaitState,
    w: int,
    command: wp.array2d[float],
    palms: wp.array2d[float],
    velocity: wp.vec3,
    walking: bool,
    busy: bool,
):
    """Moves every rate-limited channel towards its command.

    Args:
        m: What all ticks have in common.
        s: State.
        w: World.
        command: Packed commands.
        palms: Hand points of the last tick [m], pelvis' heading frame, shape [worlds, 6].
        velocity: Velocity to aim for, where the robot may walk.
        walking: Whether it walks or must.
        busy: Whether it kicks or waits for it.
    """
    for i in range(m.limited.shape[0]):
        s.targets[w, i] = in_range(m, command, w, m.limited[i])
    for k in range(3):
        s.targets[w, m.at.velocity + k] = velocity[k]
    now = velocity_of(m, s, w)
    speed = wp.max(
        wp.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1]), wp.sqrt(now[0] * now[0] + now[1] * now[1])
    )
    stride = wp.min(speed * s.channels[w, m.at.step_time], STRIDE)
    behind = BEHIND_PER_STEP * stride + s.channels[w, m.at.foot_offset]
    top = WALK_HEIGHT - LOWERING * wp.max(behind - LONGEST_BEHIND, 0.0)
    if walking:
        s.targets[w, m.at.height] = wp.min(s.targets[w, m.at.height], top)
    else:
        # Feet stay where they are until there is a reason to step: their offset waits for it.
        s.targets[w, m.at.foot_offset] = s.channels[w, m.at.foot_offset]
    if busy:
        s.targets[w, m.at.height] = wp.min(s.targets[w, m.at.height], KICK_HEIGHT)
    if velocity[0] == 0.0 and velocity[1] == 0.0 and velocity[2] == 0.0:
        s.targets[w, m.at.stagger] = 0.0
    for side in range(2):
        resting = s.channels[w, m.at.reach + side] <= 0.0
        reaching = s.targets[w, m.at.reach + side] > 0.0
        for k in range(3):
            i = m.at.hand_point + 3 * side + k
            # A hand that does not reach carries its point along, so that a reach starts where the hand is.
            if resting:
                s.channels[w, i] = palms[w, 3 * side + k]
            if not reaching:
                s.targets[w, i] = s.channels[w, i]
    arm_speed = in_range(m, command, w, m.command.arm_speed)
    for i in range(m.limited.shape[0]):
        scale = wp.where(m.per_arm_speed[i], arm_speed, 1.0)
        moved = approach(
            s.channels[w, i],
            s.rates[w, i],
            s.targets[w, i],
            m.rate[i] * scale,
            m.acceleration[i] * scale,
            m.tick,
        )
        s.channels[w, i] = moved[0]
        s.rates[w, i] = moved[1]


@wp.func
def advance_body(m: GaitModel, s: GaitState, w: int):
    """Moves the body by its velocity."""
    v = velocity_of(m, s, w)
    body = s.body[w]
    moved = rotate_xy(body[2] + 0.5 * m.tick * v[2], v[0], v[1])
    s.body[w] = wp.vec3(body[0] + m.tick * moved[0], body[1] + m.tick * moved[1], body[2] + m.tick * v[2])


@wp.func
def aim(m: GaitModel, s: GaitState, w: int, goal: wp.array2d[float]):
    """Writes the goals of the solver."""
    body = s.body[w]
    yaw = body[2]
    gait = wp.clamp(s.gait[w][0], 0.0, 1.0)
    height = s.channels[w, m.at.height]
    offset = s.channels[w, m.at.foot_offset]
    back = s.channels[w, m.at.pelvis_back]
    careful = wp.clamp((m.stand_height - height) / CAREFUL_DEPTH, 0.0, 1.0)
    ahead = COM_AHEAD + (m.sole_centre - COM_AHEAD) * careful - offset * (1.0 - gait)
    aside = sway(m, s, w)
    shift = rotate_xy(
        yaw,
        ahead + s.channels[w, m.at.shift] * (1.0 - gait),
        aside + s.channels[w, m.at.shift + 1] * (1.0 - gait),
    )
    com = wp.vec2(body[0] + shift[0], body[1] + shift[1])
    standing = s.feet[w, wp.where(s.kick_side[w] == LEFT_KICK, RIGHT, LEFT)]
    sole = rotate_xy(standing[3], KICK_COM_AHEAD, 0.0)
    com = com + s.kick_weight[w] * (wp.vec2(standing[0] + sole[0], standing[1] + sole[1]) - com)
    # Deep, the pelvis leans as far as the ankles need.
    pitch = s.channels[w, m.at.pitch] + WALK_PITCH * gait
    pitch = wp.max(pitch, wp.max(DEEP_LEAN * (DEEP - height), 0.0))
    roll = s.channels[w, m.at.roll]
    s.euler[w] = wp.vec3(yaw, pitch, roll)
    pelvis = rotate_xy(yaw, 0.0, aside)

    goal[w, _PELVIS_WEIGHT] = gait
    goal[w, _HEIGHT] = height + s.base[w][0]
    goal[w, _SEAT] = -back - offset
    goal[w, _YAW] = yaw
    goal[w, _PITCH] = pitch
    goal[w, _ROLL] = roll
    goal[w, _SEAT_WEIGHT] = smooth(back / SEAT_BLEND)
    for k in range(2):
        goal[w, _COM + k] = com[k]
        goal[w, _PELVIS + k] = body[k] + pelvis[k]
        goal[w, _ANCHOR + k] = body[k]
        goal[w, _REACH + k] = smooth(s.channels[w, m.at.reach + k])
        foot = s.feet[w, k]
        for i in range(5):
            goal[w, _FEET + 5 * k + i] = foot[i]
    for i in range(3):
        goal[w, _UPPER + i] = s.channels[w, m.at.waist + i]
    for i in range(14):
        goal[w, _UPPER + 3 + i] = s.channels[w, m.at.arms + i]
    for i in range(6):
        goal[w, _HAND_POINT + i] = s.channels[w, m.at.hand_point + i]


@wp.kernel
def plan_kernel(
    m: GaitModel,
    command: wp.array2d[float],
    mask: wp.array[int],
    palms: wp.array2d[float],
    s: GaitState,
    goal: wp.array2d[float],
):
    """One thread per world."""
    w = wp.tid()
    if mask[w] == 0:
        return
    kick = int(wp.rint(in_range(m, command, w, m.command.kick)))
    if kick > 0 and s.kick_command[w] == 0:
        s.kick_pending[w] = kick
    s.kick_command[w] = kick
    busy = s.kick_pending[w] > 0 or s.kick_side[w] > 0
    at = m.at.pelvis_back
    seated = s.channels[w, at] > SEATED or in_range(m, command, w, m.limited[at]) > SEATED
    free = not (busy or seated)

    at = m.limited[m.at.velocity]
    velocity = wp.vec3(in_range(m, command, w, at), in_range(m, command, w, at + 1), in_range(m, command, w, at + 2))
    if not free or (wp.abs(velocity[0]) <= STILL and wp.abs(velocity[1]) <= STILL and wp.abs(velocity[2]) <= STILL):
        velocity = wp.vec3(0.0, 0.0, 0.0)
    in_place = free and in_range(m, command, w, m.command.step_in_place) >= 0.5
    moving = in_place or velocity[0] != 0.0 or velocity[1] != 0.0 or velocity[2] != 0.0

    s.ground[w] = in_range(m, command, w, m.command.ground)
    limit_channels(m, s, w, command, palms, velocity, moving or s.stepping[w], busy)
    advance_body(m, s, w)
    walk(m, s, w, moving, free)
    advance_kick(m, s, w, in_range(m, command, w, m.command.kick_speed))
    # A foot counts where it will land: the body rises when the second foot leaves the floor, sinks with the first.
    base = s.base[w]
    floor = wp.min(s.floor[w][LEFT], s.floor[w][RIGHT])
    s.base[w] = approach(base[0], base[1], floor, LIFT_SPEED, LIFT_ACCELERATION, m.tick)
    aim(m, s, w, goal)
    hands = m.command.hands
    left = wp.where(in_range(m, command, w, hands) >= 0.5, 1.0, 0.0)
    s.hands[w] = wp.vec2(left, wp.where(in_range(m, command, w, hands + 1) >= 0.5, 1.0, 0.0))


def launch_plan(
    model: GaitModel, command: wp.array, mask: wp.array, palms: wp.array, state: GaitState, goal: wp.array
) -> None:
    """Advances the plan by one tick.

    Args:
        model: What all ticks have in common.
        command: Packed commands, shape [worlds, columns].
        mask: 1 = plan this world, int32, shape [worlds]; the others keep state and goals.
        palms: Hand points of the last tick [m], pelvis' heading frame, shape [worlds, 6].
        state: What the generator remembers, updated.
        goal: Rows laid out as `ik.GOAL`, shape [worlds, `ik.GOAL_WIDTH`], updated.
    """
    launch(plan_kernel, mask.shape[0], [model, command, mask, palms], [state, goal], goal.device)


@wp.func
def write_row(
    s: GaitState,
    w: int,
    joints: wp.array2d[float],
    to_mujoco: wp.array[int],
    frame: wp.array2d[float],
    action: wp.array2d[float],
):
    """Writes frame and action of the present state."""
    euler = s.euler[w]
    yaw = euler[0]
    root = s.root[w]
    hands = s.hands[w]
    cz = wp.cos(0.5 * yaw)
    sz = wp.sin(0.5 * yaw)
    cy = wp.cos(0.5 * euler[1])
    sy = wp.sin(0.5 * euler[1])
    cx = wp.cos(0.5 * euler[2])
    sx = wp.sin(0.5 * euler[2])
    frame[w, _ROOT_QUAT] = cz * cy * cx + sz * sy * sx
    frame[w, _ROOT_QUAT + 1] = cz * cy * sx - sz * sy * cx
    frame[w, _ROOT_QUAT + 2] = cz * sy * cx + sz * cy * sx
    frame[w, _ROOT_QUAT + 3] = sz * cy * cx - cz * sy * sx
    for i in range(3):
        frame[w, i] = root[i]
    for i in range(to_mujoco.shape[0]):
        frame[w, _JOINT_POS + i] = joints[w, i]
        action[w, 9 + i] = joints[w, to_mujoco[i]]
    for i in range(2):
        frame[w, _HANDS + i] = hands[i]
        action[w, 38 + i] = hands[i]

    cp = wp.cos(euler[1])
    sp = wp.sin(euler[1])
    cr = wp.cos(euler[2])
    sr = wp.sin(euler[2])
    moved = root - s.previous_root[w]
    flat = rotate_xy(-yaw, moved[0], moved[1])
    action[w, 0] = cp * flat[0] - sp * moved[2]
    action[w, 1] = sp * sr * flat[0] + cr * flat[1] + cp * sr * moved[2]
    action[w, 2] = root[2]
    ct = wp.cos(yaw - s.start_yaw[w])
    st = wp.sin(yaw - s.start_yaw[w])
    action[w, 3] = ct * cp
    action[w, 4] = ct * sp * sr - st * cr
    action[w, 5] = st * cp
    action[w, 6] = st * sp * sr + ct * cr
    action[w, 7] = -sp
    action[w, 8] = cp * sr


@wp.kernel
def present_kernel(
    m: GaitModel,
    mask: wp.array[int],
    pelvis: wp.array2d[float],
    joints: wp.array2d[float],
    to_mujoco: wp.array[int],
    s: GaitState,
    frame: wp.array2d[float],
    action: wp.array2d[float],
):
    """One thread per world."""
    w = wp.tid()
    if mask[w] == 0:
        return
    s.previous_root[w] = s.root[w]
    s.root[w] = wp.vec3(pelvis[w, 0], pelvis[w, 1], s.channels[w, m.at.height] + s.base[w][0])
    write_row(s, w, joints, to_mujoco, frame, action)


def launch_present(
    model: GaitModel, mask: wp.array, solved: ik.IkState, state: GaitState, presented: Presented
) -> None:
    """Takes the solver's pelvis and joints over as the tick's frame and action.

    Args:
        model: What all ticks have in common.
        mask: 1 = this world was solved, int32, shape [worlds]; the others keep root, frame and action.
        solved: Pelvis and joints.
        state: Its root moves on.
        presented: Frame and action.
    """
    launch(
        present_kernel,
        mask.shape[0],
        [model, mask, solved.pelvis, solved.joints, presented.to_mujoco],
        [state, presented.frame, presented.action],
        mask.device,
    )


@wp.func
def about(centre: wp.vec3, turn: float, x: float, y: float) -> wp.vec2:
    """A point turned about another one in the plane [m]."""
    moved = rotate_xy(turn, x - centre[0], y - centre[1])
    return wp.vec2(centre[0] + moved[0], centre[1] + moved[1])


@wp.func
def course_about(centre: wp.vec3, turn: float, course: wp.vec3) -> wp.vec3:
    """Position and heading, x, y [m], yaw [rad], turned about a point."""
    xy = about(centre, turn, course[0], course[1])
    return wp.vec3(xy[0], xy[1], course[2] + turn)


@wp.kernel
def realign_kernel(
    yaw: wp.array[float],
    weight: wp.array[float],
    joints: wp.array2d[float],
    to_mujoco: wp.array[int],
    s: GaitState,
    com: wp.array2d[float],
    frame: wp.array2d[float],
    action: wp.array2d[float],
):
    """One thread per world."""
    w = wp.tid()
    turn = weight[w] * wrap_angle(yaw[w] - s.body[w][2])
    if turn == 0.0:
        return
    centre = s.root[w]
    s.body[w] = course_about(centre, turn, s.body[w])
    s.lift_off[w] = course_about(centre, turn, s.lift_off[w])
    s.landing[w] = course_about(centre, turn, s.landing[w])
    for side in range(2):
        foot = s.feet[w, side]
        moved = course_about(centre, turn, wp.vec3(foot[0], foot[1], foot[3]))
        foot[0] = moved[0]
        foot[1] = moved[1]
        foot[3] = moved[2]
        s.feet[w, side] = foot
    before = s.previous_root[w]
    xy = about(centre, turn, before[0], before[1])
    s.previous_root[w] = wp.vec3(xy[0], xy[1], before[2])
    s.euler[w] = s.euler[w] + wp.vec3(turn, 0.0, 0.0)
    xy = about(centre, turn, com[w, 0], com[w, 1])
    com[w, 0] = xy[0]
    com[w, 1] = xy[1]
    write_row(s, w, joints, to_mujoco, frame, action)


def launch_realign(yaw: wp.array, weight: wp.array, solved: ik.IkState, state: GaitState, presented: Presented) -> None:
    """Turns the odometry about the pelvis towards a heading; a world that need not turn keeps every bit.

    Args:
        yaw: Heading [rad], shape [worlds].
        weight: Fraction of the difference to take up, shape [worlds].
        solved: Joints; its centre of mass turns too.
        state: Turned.
        presented: Frame and action, those of the turned state.
    """
    launch(
        realign_kernel,
        yaw.shape[0],
        [yaw, weight, solved.joints, presented.to_mujoco],
        [state, solved.com, presented.frame, presented.action],
        yaw.device,
    )
