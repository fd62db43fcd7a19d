"""Motion of the feet: footsteps planned ahead of the body, the sway that goes with them, and kicks.

`GaitState` is what one tick hands to the next; each function here advances one world's part of it by one tick.
"""

from collections.abc import Mapping, Sequence

import warp as wp

from arena_newton.kernels.rotations import wrap_angle

__all__ = [
    "BEHIND_PER_STEP",
    "LEFT",
    "LEFT_KICK",
    "RIGHT",
    "STRIDE",
    "ChannelColumns",
    "CommandColumns",
    "GaitModel",
    "GaitState",
    "advance_kick",
    "allocate_gait",
    "approach",
    "kick_seconds",
    "rotate_xy",
    "smooth",
    "sway",
    "upload_gait_model",
    "velocity_of",
    "walk",
]

PI = wp.constant(3.14159265358979)
LEFT, RIGHT = wp.constant(0), wp.constant(1)
"""Rows of the feet."""
LEFT_KICK, RIGHT_KICK = wp.constant(1), wp.constant(2)
"""Values of the channel `kick`; 0 is none."""

vec5f = wp.types.vector(length=5, dtype=wp.float32)
"""Pose of an ankle: x, y, z [m], yaw, pitch [rad]."""

PEAK_OF_SMOOTH = wp.constant(1.875)
"""Peak speed of a minimum-jerk course (`smooth`) over its mean: 15/8."""
BRAKING = wp.constant(1.8)
"""A value slows down as v² = `BRAKING` · acceleration · distance: 2 in continuous time. With ticks, 2 overshoots a
target 1.5 m away by up to 5 mm, 1.9 by 1 mm, 1.8 not at all."""
DOUBLE_SUPPORT = wp.constant(0.2)
"""Fraction of a step with both feet on the ground."""
SWAY, SWAY_WIDTH = wp.constant(0.05), wp.constant(0.22)
"""Sway of the pelvis towards the stance foot [m] at this stance width [m]; proportional to the width."""
LEAD_IN = wp.constant(0.4)
"""Weight shift before the first lift and after the last touchdown, in steps."""
FOOT_LEAD = wp.constant(0.5)
"""A foot lands where the body needs it this many steps after the landing: in the middle of its stance."""
BEHIND_PER_STEP = wp.constant(0.75)
"""Distance of the stance foot behind the pelvis when it lifts, in steps: half a step, and what the lift takes."""
STRIDE = wp.constant(0.28)
"""Longest step [m]: faster walks take shorter time."""
SIDE_STRIDE = wp.constant(0.11)
"""Longest step sideways [m]: keeps the feet apart."""
SLOWEST = wp.constant(0.05)
"""Speeds below this count as this for the time of a step [m/s]."""
STANDSTILL = wp.constant(1e-3)
"""A body slower than this no longer moves [m/s, rad/s]."""
TURN_SIDE = wp.constant(0.3)
"""Weight of the yaw rate against the sideways speed in the choice of the first foot [m]."""
EDGE = wp.constant(0.2)
"""A foot steps onto other ground when it lands this far ahead of the other one [m]: a sole and room for the edge."""
LEAST_CLEARANCE = wp.constant(0.05)
"""Least height of a step down above the ground that it leaves [m]."""
HIGH_STEP, RISE_PER_HEIGHT, MOST_RISE = wp.constant(0.08), wp.constant(1.6), wp.constant(0.16)
"""A step higher than this [m] rises before it goes on: by this fraction of the swing per metre, up to a limit."""
LANDING_FIXED, LANDING_BLEND = wp.constant(0.9), wp.constant(0.4)
"""Fraction of a swing from which on the landing is fixed, and that before it in which it follows the plan ever less."""
GAIT_RATE, GAIT_ACCELERATION = wp.constant(3.0), wp.constant(15.0)
"""Limits of the change between standing and walking [1/s, 1/s²]."""
MISPLACED = wp.constant(wp.vec2(0.02, 0.07))
"""A standing robot steps when a foot is this far from its position [m, rad]."""
PLACED = wp.constant(wp.vec2(0.004, 0.02))
"""A walk ends when both feet are this near to their positions [m, rad]."""
KICK_SHIFT, KICK_WIND, KICK_RETURN, KICK_SETTLE = wp.constant(1.2), wp.constant(0.4), wp.constant(0.6), wp.constant(1.2)
"""Times of a kick's phases around the swing [s]; a faster shift would need a support next to the standing foot."""
KICK_BACK, KICK_FRONT = wp.constant(0.20), wp.constant(0.24)
"""Ends of the swing behind and ahead of the stance [m]."""
KICK_TOE = wp.constant(wp.vec2(0.45, -0.25))
"""Pitch of the foot there [rad], toes down positive: within the ankle's range."""
KICK_LIFT, KICK_LOW = wp.constant(0.10), wp.constant(0.09)
"""Height of the foot at the end of the wind-up and of the swing [m]: it meets a ball at its middle. 5 cm lower it
scoops the ball up, and a third of the speed is lost."""
KICK_OVERLAP = wp.constant(0.75)
"""Fraction of the return in which the foot goes back, and, ending with it, in which it goes down."""
KICK_GAIT = wp.constant(0.02)
"""A kick starts when the gait has faded to this."""


@wp.struct
class ChannelColumns:
    """First column of each rate-limited channel in `GaitState.channels`, by the channel's name."""

    velocity: int
    height: int
    pitch: int
    roll: int
    waist: int
    shift: int
    foot_offset: int
    stance_width: int
    stagger: int
    swing_height: int
    step_time: int
    pelvis_back: int
    arms: int
    hand_point: int
    reach: int


@wp.struct
class CommandColumns:
    """First column of each channel that takes effect at once in a packed command, by the channel's name."""

    arm_speed: int
    kick_speed: int
    ground: int
    step_in_place: int
    kick: int
    hands: int


@wp.struct
class GaitModel:
    """Constants that all ticks of a generator share."""

    tick: float
    """Time of a tick [s]."""
    sole_height: float
    """Height of a standing ankle above the ground [m]."""
    sole_centre: float
    """Middle of the sole ahead of the ankle [m]."""
    shortest_step: float
    """Shortest time of a step [s]."""
    stand_height: float
    """Height of the pelvis in the default pose [m]."""
    at: ChannelColumns
    command: CommandColumns
    low: wp.array[float]
    """Least value of each column of a packed command that takes effect, shape [columns of a command]."""
    high: wp.array[float]
    """Largest value, same shape."""
    limited: wp.array[int]
    """Column of a packed command of each rate-limited column, shape [rate-limited columns]."""
    rate: wp.array[float]
    """Largest rate of each rate-limited column [unit/s], same shape."""
    acceleration: wp.array[float]
    """Largest acceleration [unit/s²], same shape."""
    per_arm_speed: wp.array[wp.bool]
    """True where rate and acceleration are multiplied by the channel `arm_speed`, same shape."""


@wp.struct
class GaitState:
    """State of the generator between ticks; rows are worlds. Ground and world are those of the odometry."""

    body: wp.array[wp.vec3]
    """Course of the body: x, y [m], yaw [rad]."""
    channels: wp.array2d[float]
    """Rate-limited channels, shape [worlds, rate-limited columns]."""
    rates: wp.array2d[float]
    """Their rates [unit/s], same shape."""
    targets: wp.array2d[float]
    """Joint targets of the present tick, same shape."""
    feet: wp.array2d[vec5f]
    """Left and right ankle: x, y, z [m], yaw, pitch [rad], shape [worlds, 2]."""
    lift_off: wp.array[wp.vec3]
    """Pose from which the moving foot left the ground: x, y [m], yaw [rad]."""
    landing: wp.array[wp.vec3]
    """Pose at which it will land, likewise."""
    stepping: wp.array[wp.bool]
    """True while a step is under way."""
    side: wp.array[int]
    """Foot of the present or last step, `LEFT` or `RIGHT`."""
    phase: wp.array[float]
    """Phase of the step, 0 to 1; below 0 leads into the first, above 1 out of the last one."""
    first: wp.array[wp.bool]
    """True if the step is the first of a walk."""
    final: wp.array[wp.bool]
    """True if it is the last of a walk."""
    gait: wp.array[wp.vec2]
    """Gait from 0 standing to 1 walking, and its rate [1/s]."""
    ground: wp.array[float]
    """Commanded height of the ground ahead [m]."""
    floor: wp.array[wp.vec2]
    """Height of the ground under each foot, of a moving one where it will land [m]."""
    lift_off_floor: wp.array[float]
    """Height of the ground that the moving foot left [m]."""
    base: wp.array[wp.vec2]
    """Height of the ground that carries the pelvis [m], and its rate [m/s]."""
    kick_side: wp.array[int]
    """Present kick: 0 none, `LEFT_KICK` or `RIGHT_KICK`."""
    kick_pending: wp.array[int]
    """Kick that waits for the end of a walk, same values."""
    kick_command: wp.array[int]
    """Kick of the last command, same values: a change from 0 starts a kick."""
    kick_time: wp.array[float]
    """Time since the start of the kick [s]."""
    kick_weight: wp.array[float]
    """Weight of the standing foot of a kick in where the centre of mass must be, 0 to 1."""
    kick_length: wp.array[float]
    """Length of the present or last kick [s]."""
    kick_swing: wp.array[float]
    """Time of its swing [s]."""
    support: wp.array2d[wp.bool]
    """Feet on the ground, shape [worlds, 2]."""
    euler: wp.array[wp.vec3]
    """Yaw, pitch, roll of the pelvis [rad]."""
    root: wp.array[wp.vec3]
    """Pelvis [m]."""
    previous_root: wp.array[wp.vec3]
    """Pelvis one tick earlier [m]."""
    start_yaw: wp.array[float]
    """Heading at the reset [rad]."""
    hands: wp.array[wp.vec2]
    """Left and right hand, 1 closed, 0 open."""


def upload_gait_model(
    numbers: Mapping[str, float],
    limits: Mapping[str, Sequence[float]],
    channels: Mapping[str, slice],
    command: Mapping[str, slice],
    device: wp.DeviceLike = None,
) -> GaitModel:
    """The model on a device.

    Args:
        numbers: The single numbers of `GaitModel` by name.
        limits: `low`, `high` of every column of a packed command; `rate`, `acceleration`, `per_arm_speed` of every
            rate-limited column.
        channels: Columns of each rate-limited channel among all rate-limited ones, in their order.
        command: Columns of each channel in a packed command.
        device: Where to.

    Raises:
        KeyError: A channel that the kernels read is missing.
    """
    model = GaitModel()
    for name, number in numbers.items():
        setattr(model, name, number)
    for name in ChannelColumns.vars:
        setattr(model.at, name, channels[name].start)
    for name in CommandColumns.vars:
        setattr(model.command, name, command[name].start)
    for name, values in limits.items():
        setattr(model, name, wp.array(values, dtype=GaitModel.vars[name].type.dtype, device=device))
    limited = [column for name in channels for column in range(command[name].start, command[name].stop)]
    model.limited = wp.array(limited, dtype=wp.int32, device=device)
    return model


def allocate_gait(worlds: int, limited: int, device: wp.DeviceLike = None) -> tuple[GaitState, dict[str, wp.array]]:
    """A state of zeros for so many rate-limited columns, and its arrays by name."""
    columns = {"channels": limited, "rates": limited, "targets": limited, "feet": 2, "support": 2}
    state, arrays = GaitState(), {}
    for name, member in GaitState.vars.items():
        shape = (worlds, columns[name]) if name in columns else (worlds,)
        arrays[name] = wp.zeros(shape, dtype=member.type.dtype, device=device)
        setattr(state, name, arrays[name])
    return state, arrays


@wp.func
def smooth(fraction: float) -> float:
    """Minimum-jerk course from 0 to 1."""
    t = wp.clamp(fraction, 0.0, 1.0)
    return t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)


@wp.func
def approach(x: float, rate: float, target: float, top: float, acceleration: float, tick: float) -> wp.vec2:
    """One tick [s] towards `target` with bounded rate and acceleration; value and rate.

    A target that is not a number is the value at once: what comes of it is seen, where a limit would hide it.
    """
    if wp.isnan(target):
        return wp.vec2(target, target)
    away = target - x
    size = wp.abs(away)
    brake = 0.5 * tick * acceleration
    speed = wp.min(wp.sqrt(BRAKING * acceleration * size + brake * brake) - brake, top)
    arrives = size / tick <= speed
    wanted = wp.where(arrives, size / tick, speed)
    if away < 0.0:
        wanted = -wanted
    change = acceleration * tick
    if wp.abs(wanted - rate) > change:
        rate = rate + wp.where(wanted > rate, change, -change)
    elif arrives:
        # Exactly: a reach that ends at 1e-12 instead of 0 would keep its hand from resting.
        return wp.vec2(target, wanted)
    else:
        rate = wanted
    return wp.vec2(x + rate * tick, rate)


@wp.func
def rotate_xy(yaw: float, x: float, y: float) -> wp.vec2:
    """A planar vector of a heading frame [rad] in the world, for `-yaw` the inverse."""
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    return wp.vec2(c * x - s * y, s * x + c * y)


@wp.func
def swing_seconds(speed: float) -> float:
    """Time of a kick's swing [s] at a foot speed [m/s]."""
    return PEAK_OF_SMOOTH * (KICK_BACK + KICK_FRONT) / speed


@wp.func
def kick_seconds(speed: float) -> float:
    """Length of a kick [s] at a foot speed [m/s]; also callable from Python."""
    return KICK_SHIFT + KICK_WIND + swing_seconds(speed) + KICK_RETURN + KICK_SETTLE


@wp.func
def velocity_of(m: GaitModel, s: GaitState, w: int) -> wp.vec3:
    """Velocity of the body in its heading frame: forward, left [m/s], yaw rate [rad/s]."""
    at = m.at.velocity
    return wp.vec3(s.channels[w, at], s.channels[w, at + 1], s.channels[w, at + 2])


@wp.func
def at_rest(v: wp.vec3) -> bool:
    """True if a body of this velocity no longer moves."""
    return wp.abs(v[0]) < STANDSTILL and wp.abs(v[1]) < STANDSTILL and wp.abs(v[2]) < STANDSTILL


@wp.func
def step_seconds(m: GaitModel, s: GaitState, w: int) -> float:
    """Time of a step [s]: shorter in a fast walk, whose steps would be too long."""
    v = velocity_of(m, s, w)
    speed = wp.max(wp.sqrt(v[0] * v[0] + v[1] * v[1]), SLOWEST)
    longest = wp.min(STRIDE * (1.0 / speed), SIDE_STRIDE * (1.0 / wp.max(wp.abs(v[1]), SLOWEST)))
    return wp.max(wp.min(s.channels[w, m.at.step_time], longest), m.shortest_step)


@wp.func
def nominal_foot(m: GaitModel, s: GaitState, w: int, side: int, ahead: float) -> wp.vec3:
    """Position of a foot after the body has gone on for `ahead` [s]: x, y [m], yaw [rad]."""
    v = velocity_of(m, s, w)
    body = s.body[w]
    yaw = body[2] + v[2] * ahead
    gone = rotate_xy(body[2] + 0.5 * v[2] * ahead, v[0] * ahead, v[1] * ahead)
    sign = wp.where(side == LEFT, 1.0, -1.0)
    forward = sign * 0.5 * s.channels[w, m.at.stagger] - s.channels[w, m.at.foot_offset]
    left = sign * 0.5 * s.channels[w, m.at.stance_width]
    foot = rotate_xy(yaw, forward, left)
    return wp.vec3(body[0] + gone[0] + foot[0], body[1] + gone[1] + foot[1], yaw)


@wp.func
def stance_error(m: GaitModel, s: GaitState, w: int, side: int) -> wp.vec2:
    """Distance and turn of a foot from its position under the body [m, rad]."""
    nominal = nominal_foot(m, s, w, side, 0.0)
    foot = s.feet[w, side]
    dx = foot[0] - nominal[0]
    dy = foot[1] - nominal[1]
    return wp.vec2(wp.sqrt(dx * dx + dy * dy), wp.abs(wrap_angle(foot[3] - nominal[2])))


@wp.func
def beyond(error: wp.vec2, limit: wp.vec2) -> bool:
    """True if one of two errors is larger than its limit."""
    return error[0] > limit[0] or error[1] > limit[1]


@wp.func
def advance_phase(m: GaitModel, s: GaitState, w: int, moving: bool, free: bool, step_time: float) -> bool:
    """Advances the phase, decides which step comes next; whether one begins."""
    v = velocity_of(m, s, w)
    still = not moving and at_rest(v)
    errors = wp.matrix_from_rows(stance_error(m, s, w, LEFT), stance_error(m, s, w, RIGHT))
    stepping = s.stepping[w]
    side = s.side[w]
    other = 1 - side
    phase = s.phase[w]
    if stepping:
        phase = phase + m.tick * (1.0 / step_time)
    over = stepping and phase >= 1.0 + wp.where(s.final[w], LEAD_IN, 0.0)
    go_on = over and (not still or beyond(errors[LEFT], PLACED) or beyond(errors[RIGHT], PLACED))
    start = not stepping and free and (moving or beyond(errors[LEFT], MISPLACED) or beyond(errors[RIGHT], MISPLACED))
    if start:
        turn = v[1] + TURN_SIDE * v[2]
        side = other
        if turn > 0.01:
            side = LEFT
        elif turn < -0.01:
            side = RIGHT
        if still and not beyond(errors[side], MISPLACED):
            side = 1 - side
        phase = -LEAD_IN
    elif go_on:
        if not still or beyond(errors[other], PLACED):
            side = other
        phase = phase - 1.0 - wp.where(phase > 1.0 + LEAD_IN, LEAD_IN, 0.0)
    begin = go_on or start
    stepping = (stepping and not over) or begin
    s.side[w] = side
    s.stepping[w] = stepping
    s.phase[w] = wp.where(stepping, phase, 0.0)
    if begin:
        s.first[w] = start
        s.final[w] = still and not beyond(errors[1 - side], PLACED)
        foot = s.feet[w, side]
        s.lift_off[w] = wp.vec3(foot[0], foot[1], foot[3])
    return begin


@wp.func
def plan_landing(m: GaitModel, s: GaitState, w: int, begin: bool, swing: float, step_time: float):
    """Landing pose of the swing foot, and the ground it lands on."""
    side = s.side[w]
    remaining = wp.max(1.0 - s.phase[w], 0.0) * step_time
    planned = nominal_foot(m, s, w, side, remaining + FOOT_LEAD * step_time)
    if begin:
        # Onto other ground goes the foot that leads by enough for the edge between them, and then the other one.
        standing = s.feet[w, 1 - side]
        lead = rotate_xy(-s.body[w][2], planned[0] - standing[0], planned[1] - standing[1])
        floor = s.floor[w]
        s.lift_off_floor[w] = floor[side]
        ground = s.ground[w]
        next_to = floor[1 - side]
        floor[side] = wp.where(lead[0] > EDGE or next_to == ground, ground, next_to)
        s.floor[w] = floor
    # The end of a swing no longer follows the plan, so that a foot comes down without sliding.
    gain = wp.clamp((LANDING_FIXED - swing) / LANDING_BLEND, 0.0, 1.0)
    if begin:
        gain = 1.0
    s.landing[w] = s.landing[w] + gain * (planned - s.landing[w])


@wp.func
def swing_pose(m: GaitModel, s: GaitState, w: int, swing: float) -> vec5f:
    """Pose of the swing foot at a fraction of its swing: x, y, z [m], yaw, pitch [rad]."""
    height = s.channels[w, m.at.swing_height]
    # A high step rises before it goes on, so that the foot clears what is in front of it.
    early = wp.clamp((height - HIGH_STEP) * RISE_PER_HEIGHT, 0.0, MOST_RISE)
    course = smooth((swing - early) / (1.0 - 2.0 * early))
    flat = s.lift_off[w] + course * (s.landing[w] - s.lift_off[w])
    left_floor = s.lift_off_floor[w]
    climb = s.floor[w][s.side[w]] - left_floor
    if climb < 0.0:
        # Down from higher ground the path over its edge is short, and the bent knee has no more to give.
        height = wp.max(height + climb, LEAST_CLEARANCE)
    wave = wp.sin(PI * swing)
    # Up first and then ahead, ahead first and then down.
    level = left_floor + climb * wp.where(climb > 0.0, smooth(swing / 0.5), smooth((swing - 0.5) / 0.5))
    return vec5f(flat[0], flat[1], m.sole_height + level + height * (wave * wave), flat[2], 0.0)


@wp.func
def walk(m: GaitModel, s: GaitState, w: int, moving: bool, free: bool):
    """Starts, advances and ends steps; moves the swing foot. Body and channels must be those of this tick.

    Args:
        m: What all ticks have in common.
        s: State.
        w: World.
        moving: Whether the command is to walk or to step.
        free: Whether the robot neither kicks nor sits.
    """
    step_time = step_seconds(m, s, w)
    begin = advance_phase(m, s, w, moving, free, step_time)
    swing = wp.clamp((s.phase[w] - 0.5 * DOUBLE_SUPPORT) / (1.0 - DOUBLE_SUPPORT), 0.0, 1.0)
    plan_landing(m, s, w, begin, swing, step_time)
    s.support[w, LEFT] = True
    s.support[w, RIGHT] = True
    stepping = s.stepping[w]
    if stepping:
        side = s.side[w]
        s.feet[w, side] = swing_pose(m, s, w, swing)
        s.support[w, side] = not (swing > 0.0 and swing < 1.0)
    gait = s.gait[w]
    s.gait[w] = approach(gait[0], gait[1], wp.where(stepping, 1.0, 0.0), GAIT_RATE, GAIT_ACCELERATION, m.tick)


@wp.func
def sway(m: GaitModel, s: GaitState, w: int) -> float:
    """Sideways position of the pelvis [m], left positive."""
    if not s.stepping[w]:
        return 0.0
    phase = s.phase[w]
    shape = wp.sin(PI * wp.clamp(phase, 0.0, 1.0))
    if s.first[w] and phase < 0.5:
        shape = smooth((phase + LEAD_IN) / (0.5 + LEAD_IN))
    if s.final[w] and phase >= 0.5:
        shape = smooth((1.0 + LEAD_IN - phase) / (0.5 + LEAD_IN))
    size = SWAY * s.channels[w, m.at.stance_width] / SWAY_WIDTH
    # Towards the standing foot.
    return wp.where(s.side[w] == LEFT, -size, size) * shape


@wp.func
def move_kicking_foot(m: GaitModel, s: GaitState, w: int):
    """Puts the kicking foot where the time of the kick has it."""
    foot = s.kick_side[w] - LEFT_KICK
    time = s.kick_time[w]
    swing_start = KICK_SHIFT + KICK_WIND
    swing_end = swing_start + s.kick_swing[w]
    part = KICK_OVERLAP * KICK_RETURN
    wind = smooth((time - KICK_SHIFT) / KICK_WIND)
    swing = smooth((time - swing_start) / s.kick_swing[w])
    home = smooth((time - swing_end) / part)
    down = smooth((time - swing_end - (1.0 - KICK_OVERLAP) * KICK_RETURN) / part)
    forward = -KICK_BACK * wind + (KICK_BACK + KICK_FRONT) * swing - KICK_FRONT * home
    height = KICK_LIFT * wind - (KICK_LIFT - KICK_LOW) * swing - KICK_LOW * down
    toe = KICK_TOE[0] * wind + (KICK_TOE[1] - KICK_TOE[0]) * swing - KICK_TOE[1] * home
    home_pose = s.lift_off[w]
    xy = rotate_xy(home_pose[2], forward, 0.0)
    z = m.sole_height + s.floor[w][foot] + height
    s.feet[w, foot] = vec5f(home_pose[0] + xy[0], home_pose[1] + xy[1], z, home_pose[2], toe)
    if height > 1.0e-6:
        s.support[w, foot] = False


@wp.func
def advance_kick(m: GaitModel, s: GaitState, w: int, speed: float):
    """Starts, advances and ends kicks; moves the kicking foot. Comes after `walk`.

    Args:
        m: What all ticks have in common.
        s: State.
        w: World.
        speed: Commanded speed of the foot [m/s].
    """
    still = not s.stepping[w] and at_rest(velocity_of(m, s, w)) and s.gait[w][0] < KICK_GAIT
    if s.kick_pending[w] > 0 and s.kick_side[w] == 0 and still:
        s.kick_swing[w] = swing_seconds(speed)
        s.kick_length[w] = kick_seconds(speed)
        s.kick_side[w] = s.kick_pending[w]
        s.kick_pending[w] = 0
        foot = s.feet[w, s.kick_side[w] - LEFT_KICK]
        s.lift_off[w] = wp.vec3(foot[0], foot[1], foot[3])
    s.kick_weight[w] = 0.0
    if s.kick_side[w] == 0:
        s.kick_time[w] = 0.0
        return
    time = s.kick_time[w] + m.tick
    if time >= s.kick_length[w]:
        s.kick_side[w] = 0
        s.kick_time[w] = 0.0
        return
    s.kick_time[w] = time
    move_kicking_foot(m, s, w)
    settling = time - (KICK_SHIFT + KICK_WIND + s.kick_swing[w]) - KICK_RETURN
    s.kick_weight[w] = smooth(time / KICK_SHIFT) - smooth(settling / KICK_SETTLE)
