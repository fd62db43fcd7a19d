"""Whole-body inverse kinematics of a reference: flat feet and hands at given points, the pelvis above the feet.

Damped Gauss-Newton with the analytic Jacobian of each limb. One thread per world, not per limb: the position of the
pelvis depends on the centre of mass, and that on all limbs. `newton.ik` has no goal for the centre of mass, and solves
for all joints at once; here a tick starts from the last one's solution and four joints or six suffice per limb.
"""

# ruff: noqa: UP018 - `float(0)` declares a variable in Warp, `0.0` a constant that a loop may not change

from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["GOAL", "GOAL_WIDTH", "IkState", "Model", "launch_ik", "upload_model"]

# Unrolled, the nested loops take the CUDA compiler a minute instead of six seconds, for no faster a kernel on CPU.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_WIDTHS = {
    "com": 2,
    "pelvis": 2,
    "pelvis_weight": 1,
    "height": 1,
    "seat": 1,
    "anchor": 2,
    "yaw": 1,
    "pitch": 1,
    "roll": 1,
    "feet": 10,
    "upper": 17,
    "hand_point": 6,
    "reach": 2,
    "seat_weight": 1,
}
_ENDS = tuple(accumulate(_WIDTHS.values()))
GOAL: dict[str, slice] = {
    name: slice(end - width, end) for (name, width), end in zip(_WIDTHS.items(), _ENDS, strict=True)
}
"""One row of goals: centre of mass [m]; pelvis of the gait [m] and its weight in the pelvis' position (0 = the centre
of mass decides, 1 = the gait); pelvis height [m]; how far ahead of `anchor` along the heading the pelvis may be [m];
orientation of the pelvis [rad]; left and right ankle x, y, z [m], yaw, pitch [rad]; waist and arm posture [rad]; left
and right hand points in the pelvis' heading frame [m] and the weight of the arm that goes there against the posture;
weight of the seat's bound on the pelvis."""
GOAL_WIDTH = _ENDS[-1]

_COM = wp.constant(GOAL["com"].start)
_PELVIS = wp.constant(GOAL["pelvis"].start)
_WEIGHT = wp.constant(GOAL["pelvis_weight"].start)
_HEIGHT = wp.constant(GOAL["height"].start)
_SEAT = wp.constant(GOAL["seat"].start)
_ANCHOR = wp.constant(GOAL["anchor"].start)
_YAW = wp.constant(GOAL["yaw"].start)
_PITCH = wp.constant(GOAL["pitch"].start)
_ROLL = wp.constant(GOAL["roll"].start)
_FEET = wp.constant(GOAL["feet"].start)
_UPPER = wp.constant(GOAL["upper"].start)
_HANDS = wp.constant(GOAL["hand_point"].start)
_REACH = wp.constant(GOAL["reach"].start)
_SEAT_WEIGHT = wp.constant(GOAL["seat_weight"].start)

LEFT_LEG, RIGHT_LEG, WAIST, LEFT_ARM = wp.constant(1), wp.constant(7), wp.constant(13), wp.constant(16)
"""First links of the limbs; a leg has 6 of them, the waist 3, an arm 7. Link i is moved by joint i - 1."""
KNEE = wp.constant(3)
"""Link of the knee, counted from the first one of its leg."""
FOOT = wp.constant(5)
"""Numbers of a foot's goal."""

PELVIS_ROUNDS = wp.constant(4)
"""Corrections of the pelvis' position per tick, from the last tick's; each leaves about a tenth of the error."""
LEG_ROUNDS = wp.constant(2)
"""Gauss-Newton steps of a leg per correction."""
LAST_ROUNDS = wp.constant(4)
"""Gauss-Newton steps of a leg after the last correction of the pelvis."""
ARM_ROUNDS = wp.constant(6)
"""Gauss-Newton steps of an arm per tick."""
ARM_RESTART = wp.constant(16)
"""The same of an arm that starts again."""
ARM_LOST = wp.constant(0.03)
"""An arm farther than this from its point starts again [m]."""
ARM_GAIN = wp.constant(0.7)
"""The second start counts when its residual is below this fraction of the first one's."""
LEG_DAMPING = wp.constant(1.0e-6)
"""Square of the damping of a leg."""
LEG_CARE = wp.constant(0.5)
"""Further damping by the square of the residual [1/m²]: a target out of reach stretches the leg and no more."""
ARM_DAMPING = wp.constant(2.0e-4)
ARM_PULL = wp.constant(3.0e-4)
"""Pull of the arm towards its posture: picks one of the elbow's many positions, costs less than a millimetre."""
LIMIT_MARGIN = wp.constant(0.03)
"""Distance kept from a joint's limit [rad]."""
KNEE_MIN = wp.constant(0.1)
"""Least bend of a knee [rad]: the Jacobian of a straight leg is singular."""
LOST = wp.constant(0.01)
"""A leg farther than this from its target starts again from a bent one [m]."""
LEG_GAIN = wp.constant(0.5)
"""The second start counts when its residual is below this fraction of the first one's."""
RESTART_ROUNDS = wp.constant(16)
"""Gauss-Newton steps of a leg that starts again."""
STEP = wp.constant(0.4)
"""Largest change of a joint in one Gauss-Newton step [rad]."""
SETTLED = wp.constant(1.0e-6)
"""A limb whose joints change by less than this in a step has arrived [rad]: more steps would change its last bits."""
ARM_SPEED = wp.constant(0.12)
"""Largest change of an arm joint by IK per tick [rad]: 6 rad/s."""
SEAT_SOFTNESS = wp.constant(0.02)
"""Width of the change from balance to the seat [m]."""
REACH_MIN = wp.constant(0.16)
REACH_MAX = wp.constant(0.465)
"""Shell around the shoulder that contains the hand points [m]; outside, the nearest point of it counts."""

mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)
mat63 = wp.types.matrix(shape=(6, 3), dtype=wp.float32)
vec6f = wp.types.vector(length=6, dtype=wp.float32)


@wp.struct
class Model:
    """Links of `kinematics.Chain` on a device."""

    offset: wp.array(dtype=wp.vec3)
    quat: wp.array(dtype=wp.quat)
    axis: wp.array(dtype=wp.vec3)
    low: wp.array(dtype=float)
    high: wp.array(dtype=float)
    mass: wp.array(dtype=float)
    com: wp.array(dtype=wp.vec3)
    total: float
    hand_point: float


@dataclass
class IkState:
    """State and outputs of the solver; rows are worlds."""

    pelvis: wp.array
    """Position of the pelvis [m], shape [worlds, 2]."""
    joints: wp.array
    """Joint angles [rad], MuJoCo order, shape [worlds, 29]."""
    arms: wp.array
    """Shoulders and elbow of the reaching arms [rad], left then right, shape [worlds, 8]."""
    palms: wp.array
    """Hand points of the pose [m], pelvis' heading frame, shape [worlds, 6]."""
    com: wp.array
    """Centre of mass [m], world, shape [worlds, 3]."""
    error: wp.array
    """Larger residual of the two feet [m], shape [worlds]."""


def upload_model(chain: Any, device: wp.DeviceLike = None) -> Model:
    """The link table on a device; `chain` has the fields of `kinematics.Chain`."""

    def up(values: Any, dtype: Any) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    model = Model()
    model.offset, model.com = up(chain.offset, wp.vec3), up(chain.com, wp.vec3)
    model.quat, model.axis = up(chain.quat[:, [1, 2, 3, 0]], wp.quat), up(chain.axis, wp.vec3)
    model.low, model.high = up(chain.limits[:, 0].copy(), float), up(chain.limits[:, 1].copy(), float)
    model.mass, model.total = up(chain.mass, float), float(chain.mass.sum())
    model.hand_point = chain.hand_point
    return model


@wp.func
def link_quat(m: Model, link: int, parent: wp.quat, angle: float) -> wp.quat:
    """Orientation of a link whose joint is at `angle`."""
    s = wp.sin(0.5 * angle)
    a = m.axis[link]
    return parent * m.quat[link] * wp.quat(a[0] * s, a[1] * s, a[2] * s, wp.cos(0.5 * angle))


@wp.func
def solve_spd(a: mat66, b: vec6f, n: int) -> vec6f:
    """Solution of a positive definite system of the first n rows by Cholesky."""
    low = mat66()
    inverse = vec6f()  # of the diagonal: a division takes as long as five products
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s = s - low[i, k] * low[j, k]
            if i == j:
                inverse[i] = 1.0 / wp.sqrt(wp.max(s, 1.0e-12))
            else:
                low[i, j] = s * inverse[j]
    y = vec6f()
    for i in range(n):
        s = b[i]
        for k in range(i):
            s = s - low[i, k] * y[k]
        y[i] = s * inverse[i]
    x = vec6f()
    for r in range(n):
        i = n - 1 - r
        s = y[i]
        for k in range(i + 1, n):
            s = s - low[k, i] * x[k]
        x[i] = s * inverse[i]
    return x


@wp.func
def settle_joint(m: Model, link: int, angle: float) -> float:
    """The angle within its limits."""
    low = m.low[link] + LIMIT_MARGIN
    if link == LEFT_LEG + KNEE or link == RIGHT_LEG + KNEE:
        low = KNEE_MIN
    return wp.clamp(angle, low, m.high[link] - LIMIT_MARGIN)


@wp.func
def solve_leg(
    m: Model, w: int, first: int, target_p: wp.vec3, target_q: wp.quat, rounds: int, joints: wp.array2d[float]
) -> float:
    """Moves the joints from link `first` on towards an ankle pose of the pelvis frame; residual at the last step."""
    residual = float(0.0)
    for _ in range(rounds):
        p = wp.vec3(0.0, 0.0, 0.0)
        q = wp.quat(0.0, 0.0, 0.0, 1.0)
        axes = mat63()
        origins = mat63()
        for i in range(6):
            link = first + i
            p = p + wp.quat_rotate(q, m.offset[link])
            q = link_quat(m, link, q, joints[w, link - 1])
            a = wp.quat_rotate(q, m.axis[link])
            for k in range(3):
                axes[i, k] = a[k]
                origins[i, k] = p[k]
        away = target_p - p
        residual = wp.length(away)
        turn = target_q * wp.quat_inverse(q)
        if turn[3] < 0.0:
            turn = wp.quat(-turn[0], -turn[1], -turn[2], -turn[3])
        v = wp.vec3(turn[0], turn[1], turn[2])
        size = wp.length(v)
        spin = 2.0 * v
        if size > 1.0e-6:
            spin = v * (2.0 * wp.atan2(size, turn[3]) / size)
        jac = mat66()
        for i in range(6):
            a = wp.vec3(axes[i, 0], axes[i, 1], axes[i, 2])
            o = wp.vec3(origins[i, 0], origins[i, 1], origins[i, 2])
            lever = wp.cross(a, p - o)
            for k in range(3):
                jac[k, i] = lever[k]
                jac[3 + k, i] = a[k]
        normal = wp.transpose(jac) * jac
        for i in range(6):
            normal[i, i] = normal[i, i] + LEG_DAMPING + LEG_CARE * wp.dot(away, away)
        rhs = wp.transpose(jac) * vec6f(away[0], away[1], away[2], spin[0], spin[1], spin[2])
        step = solve_spd(normal, rhs, 6)
        largest = float(0.0)
        for i in range(6):
            link = first + i
            before = joints[w, link - 1]
            angle = settle_joint(m, link, before + wp.clamp(step[i], -STEP, STEP))
            joints[w, link - 1] = angle
            largest = wp.max(largest, wp.abs(angle - before))
        if largest < SETTLED:
            break
    return residual


@wp.func
def leg_end(m: Model, w: int, first: int, joints: wp.array2d[float]) -> wp.vec3:
    """Ankle in the pelvis frame."""
    p = wp.vec3(0.0, 0.0, 0.0)
    q = wp.quat(0.0, 0.0, 0.0, 1.0)
    for i in range(6):
        p = p + wp.quat_rotate(q, m.offset[first + i])
        q = link_quat(m, first + i, q, joints[w, first + i - 1])
    return p


@wp.func
def place_leg(m: Model, w: int, first: int, target_p: wp.vec3, target_q: wp.quat, joints: wp.array2d[float]) -> float:
    """Final steps of a leg, from a bent one if the present one is lost; residual [m]."""
    solve_leg(m, w, first, target_p, target_q, LAST_ROUNDS, joints)
    residual = wp.length(target_p - leg_end(m, w, first, joints))
    if residual > LOST:
        kept = vec6f()
        for i in range(6):
            kept[i] = joints[w, first + i - 1]
            joints[w, first + i - 1] = 0.0
        joints[w, first - 1] = -0.5
        joints[w, first + 2] = 1.0
        joints[w, first + 3] = -0.5
        solve_leg(m, w, first, target_p, target_q, RESTART_ROUNDS, joints)
        again = wp.length(target_p - leg_end(m, w, first, joints))
        if again < LEG_GAIN * residual:
            residual = again
        else:
            for i in range(6):
                joints[w, first + i - 1] = kept[i]
    return residual


@wp.func
def limb_moment(
    m: Model, w: int, first: int, count: int, base_p: wp.vec3, base_q: wp.quat, joints: wp.array2d[float]
) -> wp.vec3:
    """Sum of mass times centre over a limb, in the frame of its base's coordinates."""
    p = base_p
    q = base_q
    moment = wp.vec3(0.0, 0.0, 0.0)
    for i in range(count):
        link = first + i
        p = p + wp.quat_rotate(q, m.offset[link])
        q = link_quat(m, link, q, joints[w, link - 1])
        moment = moment + m.mass[link] * (p + wp.quat_rotate(q, m.com[link]))
    return moment


@wp.func
def palm(m: Model, w: int, first: int, base_p: wp.vec3, base_q: wp.quat, joints: wp.array2d[float]) -> wp.vec3:
    """Hand point of an arm, in the frame of its base's coordinates."""
    p = base_p
    q = base_q
    for i in range(7):
        p = p + wp.quat_rotate(q, m.offset[first + i])
        q = link_quat(m, first + i, q, joints[w, first + i - 1])
    return p + wp.quat_rotate(q, wp.vec3(m.hand_point, 0.0, 0.0))


@wp.func
def step_arm(
    m: Model,
    w: int,
    first: int,
    goal: wp.vec3,
    base_p: wp.vec3,
    base_q: wp.quat,
    posture: wp.array2d[float],
    rounds: int,
    joints: wp.array2d[float],
) -> float:
    """Moves shoulder and elbow in `joints` towards a hand point; residual [m]."""
    for _ in range(rounds):
        p = base_p
        q = base_q
        axes = mat63()
        origins = mat63()
        for i in range(7):
            link = first + i
            p = p + wp.quat_rotate(q, m.offset[link])
            q = link_quat(m, link, q, joints[w, link - 1])
            if i < 4:
                a = wp.quat_rotate(q, m.axis[link])
                for k in range(3):
                    axes[i, k] = a[k]
                    origins[i, k] = p[k]
        p = p + wp.quat_rotate(q, wp.vec3(m.hand_point, 0.0, 0.0))
        away = goal - p
        jac = mat63()
        rhs = vec6f()
        for i in range(4):
            a = wp.vec3(axes[i, 0], axes[i, 1], axes[i, 2])
            o = wp.vec3(origins[i, 0], origins[i, 1], origins[i, 2])
            lever = wp.cross(a, p - o)
            for k in range(3):
                jac[i, k] = lever[k]
            wish = posture[w, _UPPER + first - WAIST + i] - joints[w, first + i - 1]
            rhs[i] = wp.dot(lever, away) + ARM_PULL * wish
        normal = mat66()
        for i in range(4):
            for j in range(4):
                s = float(0.0)
                for k in range(3):
                    s = s + jac[i, k] * jac[j, k]
                normal[i, j] = s
            normal[i, i] = normal[i, i] + ARM_DAMPING + ARM_PULL
        step = solve_spd(normal, rhs, 4)
        largest = float(0.0)
        for i in range(4):
            link = first + i
            before = joints[w, link - 1]
            angle = settle_joint(m, link, before + wp.clamp(step[i], -STEP, STEP))
            joints[w, link - 1] = angle
            largest = wp.max(largest, wp.abs(angle - before))
        if largest < SETTLED:
            break
    return wp.length(goal - palm(m, w, first, base_p, base_q, joints))


@wp.func
def solve_arm(
    m: Model,
    w: int,
    first: int,
    slot: int,
    target: wp.vec3,
    base_p: wp.vec3,
    base_q: wp.quat,
    posture: wp.array2d[float],
    arms: wp.array2d[float],
    joints: wp.array2d[float],
):
    """Moves `arms` towards a hand point; the wrist keeps the posture. Works in `joints`.

    An arm that is folded against its limits starts again from one held forward.
    """
    shoulder = base_p + wp.quat_rotate(base_q, m.offset[first])
    reach = target - shoulder
    size = wp.length(reach)
    goal = shoulder + reach * (wp.clamp(size, REACH_MIN, REACH_MAX) / wp.max(size, 1.0e-4))
    for i in range(4):
        joints[w, first + i - 1] = arms[w, slot + i]
    for i in range(4, 7):
        joints[w, first + i - 1] = settle_joint(m, first + i, posture[w, _UPPER + first - WAIST + i])
    residual = step_arm(m, w, first, goal, base_p, base_q, posture, ARM_ROUNDS, joints)
    if residual > ARM_LOST:
        found = vec6f()
        for i in range(4):
            found[i] = joints[w, first + i - 1]
        side = wp.where(slot == 0, 1.0, -1.0)
        joints[w, first - 1] = -0.6
        joints[w, first] = 0.3 * side
        joints[w, first + 1] = 0.0
        joints[w, first + 2] = 0.2
        again = step_arm(m, w, first, goal, base_p, base_q, posture, ARM_RESTART, joints)
        if again > ARM_GAIN * residual:
            for i in range(4):
                joints[w, first + i - 1] = found[i]
    for i in range(4):
        change = wp.clamp(joints[w, first + i - 1] - arms[w, slot + i], -ARM_SPEED, ARM_SPEED)
        arms[w, slot + i] = arms[w, slot + i] + change


@wp.func
def foot_in_pelvis(goal: wp.array2d[float], w: int, at: int, p: wp.vec3, q: wp.quat) -> wp.vec3:
    """Ankle target in the pelvis frame."""
    return wp.quat_rotate_inv(q, wp.vec3(goal[w, at], goal[w, at + 1], goal[w, at + 2]) - p)


@wp.func
def foot_quat(goal: wp.array2d[float], w: int, at: int, q: wp.quat) -> wp.quat:
    """Orientation of an ankle target in the pelvis frame."""
    z = wp.quat(0.0, 0.0, wp.sin(0.5 * goal[w, at + 3]), wp.cos(0.5 * goal[w, at + 3]))
    y = wp.quat(0.0, wp.sin(0.5 * goal[w, at + 4]), 0.0, wp.cos(0.5 * goal[w, at + 4]))
    return wp.quat_inverse(q) * z * y


@wp.kernel
def ik_kernel(
    m: Model,
    goal: wp.array2d[float],
    mask: wp.array[int],
    pelvis: wp.array2d[float],
    joints: wp.array2d[float],
    arms: wp.array2d[float],
    hands: wp.array2d[float],
    com: wp.array2d[float],
    error: wp.array[float],
):
    """One thread per world."""
    w = wp.tid()
    if mask[w] == 0:
        return
    yaw = goal[w, _YAW]
    heading = wp.quat(0.0, 0.0, wp.sin(0.5 * yaw), wp.cos(0.5 * yaw))
    tilt_y = wp.quat(0.0, wp.sin(0.5 * goal[w, _PITCH]), 0.0, wp.cos(0.5 * goal[w, _PITCH]))
    tilt_x = wp.quat(wp.sin(0.5 * goal[w, _ROLL]), 0.0, 0.0, wp.cos(0.5 * goal[w, _ROLL]))
    tilt = tilt_y * tilt_x
    root = heading * tilt

    for link in range(WAIST, LEFT_ARM):
        joints[w, link - 1] = settle_joint(m, link, goal[w, _UPPER + link - WAIST])
    torso_p = wp.vec3(0.0, 0.0, 0.0)
    torso_q = wp.quat(0.0, 0.0, 0.0, 1.0)
    for link in range(WAIST, LEFT_ARM):
        torso_p = torso_p + wp.quat_rotate(torso_q, m.offset[link])
        torso_q = link_quat(m, link, torso_q, joints[w, link - 1])
    upper = m.mass[0] * m.com[0]
    upper = upper + limb_moment(m, w, WAIST, 3, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
    for side in range(2):
        first = LEFT_ARM + 7 * side
        reach = goal[w, _REACH + side]
        at = _HANDS + 3 * side
        if reach > 0.0:
            point = wp.vec3(goal[w, at], goal[w, at + 1], goal[w, at + 2])
            solve_arm(m, w, first, 4 * side, wp.quat_rotate_inv(tilt, point), torso_p, torso_q, goal, arms, joints)
        for i in range(7):
            posture = settle_joint(m, first + i, goal[w, _UPPER + first - WAIST + i])
            if i < 4:
                if reach > 0.0:
                    posture = posture + reach * (arms[w, 4 * side + i] - posture)
                else:
                    arms[w, 4 * side + i] = posture
            joints[w, first + i - 1] = posture
        hand = wp.quat_rotate(tilt, palm(m, w, first, torso_p, torso_q, joints))
        for k in range(3):
            hands[w, 3 * side + k] = hand[k]
        upper = upper + limb_moment(m, w, first, 7, torso_p, torso_q, joints)

    p = wp.vec3(pelvis[w, 0], pelvis[w, 1], goal[w, _HEIGHT])
    ahead = wp.quat_rotate(heading, wp.vec3(1.0, 0.0, 0.0))
    weight = goal[w, _WEIGHT]
    left_foot = foot_quat(goal, w, _FEET, root)
    right_foot = foot_quat(goal, w, _FEET + FOOT, root)
    for _ in range(PELVIS_ROUNDS):
        solve_leg(m, w, LEFT_LEG, foot_in_pelvis(goal, w, _FEET, p, root), left_foot, LEG_ROUNDS, joints)
        solve_leg(m, w, RIGHT_LEG, foot_in_pelvis(goal, w, _FEET + FOOT, p, root), right_foot, LEG_ROUNDS, joints)
        moment = upper + limb_moment(m, w, LEFT_LEG, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
        moment = moment + limb_moment(m, w, RIGHT_LEG, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
        c = p + wp.quat_rotate(root, moment / m.total)
        dx = goal[w, _COM] - c[0]
        dy = goal[w, _COM + 1] - c[1]
        # The seat takes over where balance would leave the pelvis farther ahead than the seat allows.
        forward = ahead[0] * (p[0] + dx - goal[w, _ANCHOR]) + ahead[1] * (p[1] + dy - goal[w, _ANCHOR + 1])
        gap = forward - goal[w, _SEAT]
        back = goal[w, _SEAT_WEIGHT] * 0.5 * (gap + wp.sqrt(gap * gap + SEAT_SOFTNESS * SEAT_SOFTNESS))
        dx = dx - back * ahead[0]
        dy = dy - back * ahead[1]
        dx = dx + weight * (goal[w, _PELVIS] - p[0] - dx)
        dy = dy + weight * (goal[w, _PELVIS + 1] - p[1] - dy)
        p = wp.vec3(p[0] + dx, p[1] + dy, p[2])
    residual = place_leg(m, w, LEFT_LEG, foot_in_pelvis(goal, w, _FEET, p, root), left_foot, joints)
    right = place_leg(m, w, RIGHT_LEG, foot_in_pelvis(goal, w, _FEET + FOOT, p, root), right_foot, joints)
    residual = wp.max(residual, right)
    moment = upper + limb_moment(m, w, LEFT_LEG, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
    moment = moment + limb_moment(m, w, RIGHT_LEG, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
    c = p + wp.quat_rotate(root, moment / m.total)
    pelvis[w, 0] = p[0]
    pelvis[w, 1] = p[1]
    for k in range(3):
        com[w, k] = c[k]
    error[w] = residual


def launch_ik(model: Model, goal: wp.array, mask: wp.array, state: IkState) -> None:
    """Solves one tick.

    Args:
        goal: Rows laid out as `GOAL`, shape [worlds, `GOAL_WIDTH`].
        mask: 1 = solve this world, int32, shape [worlds].
        state: Start and result.
    """
    launch(
        ik_kernel,
        goal.shape[0],
        [model, goal, mask],
        [state.pelvis, state.joints, state.arms, state.palms, state.com, state.error],
    )
