"""Whole-body inverse kinematics of a reference: flat feet at given places, hands at given points, the pelvis over them.

Damped Gauss-Newton with the analytic Jacobian of each limb. One thread a world, not a limb: where the pelvis stands
depends on the centre of mass, and that on all limbs.
"""

# ruff: noqa: UP018 - `float(0)` declares a variable in Warp, `0.0` a constant that a loop may not change

from dataclasses import dataclass
from typing import Any

import warp as wp

__all__ = ["GOAL", "GOAL_WIDTH", "IkState", "Model", "launch_ik", "upload_model"]

# Unrolled, the nested loops take the CUDA compiler a minute instead of six seconds, for no faster a kernel on CPU.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

GOAL: dict[str, slice] = {
    "com": slice(0, 2),
    "pelvis": slice(2, 4),
    "pelvis_weight": slice(4, 5),
    "height": slice(5, 6),
    "seat": slice(6, 7),
    "anchor": slice(7, 9),
    "yaw": slice(9, 10),
    "pitch": slice(10, 11),
    "roll": slice(11, 12),
    "feet": slice(12, 22),
    "upper": slice(22, 39),
    "hand_point": slice(39, 45),
    "reach": slice(45, 47),
    "seat_weight": slice(47, 48),
}
"""One row of goals: centre of mass [m]; pelvis of the gait [m] and its share of the pelvis' place (0 = the centre of
mass decides, 1 = the gait); pelvis height [m]; how far before `anchor` along the heading the pelvis may be [m];
orientation of the pelvis [rad]; left and right ankle x, y, z [m], yaw, pitch [rad]; waist and arm posture [rad]; left
and right hand points in the pelvis' heading frame [m] and the share of the arm that goes there instead of the posture;
share of the seat's bound on the pelvis."""
GOAL_WIDTH = 48

_COM = wp.constant(0)
_PELVIS = wp.constant(2)
_WEIGHT = wp.constant(4)
_HEIGHT = wp.constant(5)
_SEAT = wp.constant(6)
_ANCHOR = wp.constant(7)
_YAW = wp.constant(9)
_PITCH = wp.constant(10)
_ROLL = wp.constant(11)
_FEET = wp.constant(12)
_UPPER = wp.constant(22)
_HANDS = wp.constant(39)
_REACH = wp.constant(45)
_SEAT_WEIGHT = wp.constant(47)

PELVIS_ROUNDS = wp.constant(4)
"""Corrections of the pelvis' place a tick, from the last tick's; each leaves about a tenth of the error."""
LEG_ROUNDS = wp.constant(2)
"""Gauss-Newton steps of a leg a correction."""
LAST_ROUNDS = wp.constant(4)
"""Gauss-Newton steps of a leg after the pelvis stands."""
ARM_ROUNDS = wp.constant(6)
ARM_RESTART = wp.constant(16)
ARM_LOST = wp.constant(0.03)
"""An arm farther than this from its point starts anew [m]."""
LEG_DAMPING = wp.constant(1.0e-6)
"""Square of the damping of `trackers_measured`'s solver."""
LEG_CARE = wp.constant(0.5)
"""Further damping by the square of the distance left [1/m²]: a target out of reach stretches the leg and no more."""
ARM_DAMPING = wp.constant(2.0e-4)
ARM_PULL = wp.constant(3.0e-4)
"""Pull of the arm towards its posture: picks one of the elbow's many places, costs less than a millimetre."""
LIMIT_MARGIN = wp.constant(0.03)
"""Distance kept from a joint's limit [rad]."""
KNEE_MIN = wp.constant(0.1)
"""Least bend of a knee [rad]: a straight leg no longer knows which way to bend."""
LOST = wp.constant(0.01)
"""A leg farther than this from its target starts anew from a bent one [m]."""
RESTART_ROUNDS = wp.constant(16)
STEP = wp.constant(0.4)
"""Largest change of a joint in one Gauss-Newton step [rad]."""
ARM_SPEED = wp.constant(0.12)
"""Largest change of an arm joint by IK in a tick [rad]: 6 rad/s."""
SEAT_SOFTNESS = wp.constant(0.02)
"""Width of the change from balance to the seat [m]."""
HAND_POINT = wp.constant(0.10)
REACH_MIN = wp.constant(0.16)
REACH_MAX = wp.constant(0.465)
"""Shell around the shoulder in which hand points lie [m]; outside, the nearest point of it counts."""

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


@dataclass
class IkState:
    """What the solver remembers and gives; rows are worlds."""

    pelvis: wp.array
    """Place of the pelvis [m], shape [worlds, 2]."""
    joints: wp.array
    """Joint angles [rad], MuJoCo order, shape [worlds, 29]."""
    arms: wp.array
    """Shoulders and elbow of the reaching arms [rad], left then right, shape [worlds, 8]."""
    hands: wp.array
    """Hand points of the pose [m], pelvis' heading frame, shape [worlds, 6]."""
    com: wp.array
    """Centre of mass [m], world, shape [worlds, 3]."""
    error: wp.array
    """What is left of feet, and of reached hand points as far as an arm is long, the largest [m], shape [worlds]."""


def upload_model(chain: Any, device: wp.DeviceLike = None) -> Model:
    """The link table on a device; `chain` has the fields of `kinematics.Chain`."""

    def up(values: Any, dtype: Any) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    model = Model()
    model.offset, model.com = up(chain.offset, wp.vec3), up(chain.com, wp.vec3)
    model.quat, model.axis = up(chain.quat[:, [1, 2, 3, 0]], wp.quat), up(chain.axis, wp.vec3)
    model.low, model.high = up(chain.limits[:, 0].copy(), float), up(chain.limits[:, 1].copy(), float)
    model.mass, model.total = up(chain.mass, float), float(chain.mass.sum())
    return model


@wp.func
def link_quat(m: Model, link: int, parent: wp.quat, angle: float) -> wp.quat:
    """Orientation of a link whose joint stands at `angle`."""
    s = wp.sin(0.5 * angle)
    a = m.axis[link]
    return parent * m.quat[link] * wp.quat(a[0] * s, a[1] * s, a[2] * s, wp.cos(0.5 * angle))


@wp.func
def solve_spd(a: mat66, b: vec6f, n: int) -> vec6f:
    """Solution of a positive definite system of the first n rows by Cholesky."""
    low = mat66()
    for i in range(n):
        for j in range(i + 1):
            s = a[i, j]
            for k in range(j):
                s = s - low[i, k] * low[j, k]
            if i == j:
                low[i, i] = wp.sqrt(wp.max(s, 1.0e-12))
            else:
                low[i, j] = s / low[j, j]
    y = vec6f()
    for i in range(n):
        s = b[i]
        for k in range(i):
            s = s - low[i, k] * y[k]
        y[i] = s / low[i, i]
    x = vec6f()
    for r in range(n):
        i = n - 1 - r
        s = y[i]
        for k in range(i + 1, n):
            s = s - low[k, i] * x[k]
        x[i] = s / low[i, i]
    return x


@wp.func
def settle_joint(m: Model, link: int, angle: float) -> float:
    """The angle within its limits."""
    low = m.low[link] + LIMIT_MARGIN
    if link == 4 or link == 10:
        low = KNEE_MIN
    return wp.clamp(angle, low, m.high[link] - LIMIT_MARGIN)


@wp.func
def solve_leg(
    m: Model, w: int, first: int, target_p: wp.vec3, target_q: wp.quat, rounds: int, joints: wp.array2d[float]
) -> float:
    """Moves the joints from link `first` on towards an ankle pose of the pelvis frame; distance at the last step."""
    left = float(0.0)
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
        left = wp.length(away)
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
        right = wp.transpose(jac) * vec6f(away[0], away[1], away[2], spin[0], spin[1], spin[2])
        step = solve_spd(normal, right, 6)
        for i in range(6):
            link = first + i
            joints[w, link - 1] = settle_joint(m, link, joints[w, link - 1] + wp.clamp(step[i], -STEP, STEP))
    return left


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
    """Final steps of a leg, from a bent one if the present one is lost; what is left [m]."""
    solve_leg(m, w, first, target_p, target_q, LAST_ROUNDS, joints)
    left = wp.length(target_p - leg_end(m, w, first, joints))
    if left > LOST:
        kept = vec6f()
        for i in range(6):
            kept[i] = joints[w, first + i - 1]
            joints[w, first + i - 1] = 0.0
        joints[w, first - 1] = -0.5
        joints[w, first + 2] = 1.0
        joints[w, first + 3] = -0.5
        solve_leg(m, w, first, target_p, target_q, RESTART_ROUNDS, joints)
        again = wp.length(target_p - leg_end(m, w, first, joints))
        if again < 0.5 * left:
            left = again
        else:
            for i in range(6):
                joints[w, first + i - 1] = kept[i]
    return left


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
    return p + wp.quat_rotate(q, wp.vec3(HAND_POINT, 0.0, 0.0))


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
    """Moves shoulder and elbow in `joints` towards a hand point; what is left [m]."""
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
        p = p + wp.quat_rotate(q, wp.vec3(HAND_POINT, 0.0, 0.0))
        away = goal - p
        jac = mat63()
        right = vec6f()
        for i in range(4):
            a = wp.vec3(axes[i, 0], axes[i, 1], axes[i, 2])
            o = wp.vec3(origins[i, 0], origins[i, 1], origins[i, 2])
            lever = wp.cross(a, p - o)
            for k in range(3):
                jac[i, k] = lever[k]
            wish = posture[w, _UPPER + first - 13 + i] - joints[w, first + i - 1]
            right[i] = wp.dot(lever, away) + ARM_PULL * wish
        normal = mat66()
        for i in range(4):
            for j in range(4):
                s = float(0.0)
                for k in range(3):
                    s = s + jac[i, k] * jac[j, k]
                normal[i, j] = s
            normal[i, i] = normal[i, i] + ARM_DAMPING + ARM_PULL
        step = solve_spd(normal, right, 4)
        for i in range(4):
            link = first + i
            angle = joints[w, link - 1] + wp.clamp(step[i], -STEP, STEP)
            joints[w, link - 1] = settle_joint(m, link, angle)
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

    An arm that is folded against its limits starts anew from one held forward.
    """
    shoulder = base_p + wp.quat_rotate(base_q, m.offset[first])
    reach = target - shoulder
    size = wp.length(reach)
    goal = shoulder + reach * (wp.clamp(size, REACH_MIN, REACH_MAX) / wp.max(size, 1.0e-4))
    for i in range(4):
        joints[w, first + i - 1] = arms[w, slot + i]
    for i in range(4, 7):
        joints[w, first + i - 1] = settle_joint(m, first + i, posture[w, _UPPER + first - 13 + i])
    left = step_arm(m, w, first, goal, base_p, base_q, posture, ARM_ROUNDS, joints)
    if left > ARM_LOST:
        found = vec6f()
        for i in range(4):
            found[i] = joints[w, first + i - 1]
        side = wp.where(slot == 0, 1.0, -1.0)
        joints[w, first - 1] = -0.6
        joints[w, first] = 0.3 * side
        joints[w, first + 1] = 0.0
        joints[w, first + 2] = 0.2
        again = step_arm(m, w, first, goal, base_p, base_q, posture, ARM_RESTART, joints)
        if again > 0.7 * left:
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
    """One thread a world."""
    w = wp.tid()
    if mask[w] == 0:
        return
    yaw = goal[w, _YAW]
    heading = wp.quat(0.0, 0.0, wp.sin(0.5 * yaw), wp.cos(0.5 * yaw))
    tilt_y = wp.quat(0.0, wp.sin(0.5 * goal[w, _PITCH]), 0.0, wp.cos(0.5 * goal[w, _PITCH]))
    tilt_x = wp.quat(wp.sin(0.5 * goal[w, _ROLL]), 0.0, 0.0, wp.cos(0.5 * goal[w, _ROLL]))
    tilt = tilt_y * tilt_x
    root = heading * tilt

    for i in range(12, 15):
        joints[w, i] = settle_joint(m, i + 1, goal[w, _UPPER + i - 12])
    torso_p = wp.vec3(0.0, 0.0, 0.0)
    torso_q = wp.quat(0.0, 0.0, 0.0, 1.0)
    for link in range(13, 16):
        torso_p = torso_p + wp.quat_rotate(torso_q, m.offset[link])
        torso_q = link_quat(m, link, torso_q, joints[w, link - 1])
    upper = m.mass[0] * m.com[0]
    upper = upper + limb_moment(m, w, 13, 3, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
    for side in range(2):
        first = 16 + 7 * side
        share = goal[w, _REACH + side]
        at = _HANDS + 3 * side
        if share > 0.0:
            point = wp.vec3(goal[w, at], goal[w, at + 1], goal[w, at + 2])
            solve_arm(m, w, first, 4 * side, wp.quat_rotate_inv(tilt, point), torso_p, torso_q, goal, arms, joints)
        for i in range(7):
            posture = settle_joint(m, first + i, goal[w, _UPPER + first - 13 + i])
            if i < 4:
                if share > 0.0:
                    posture = posture + share * (arms[w, 4 * side + i] - posture)
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
    left_q = foot_quat(goal, w, _FEET, root)
    right_q = foot_quat(goal, w, _FEET + 5, root)
    for _ in range(PELVIS_ROUNDS):
        solve_leg(m, w, 1, foot_in_pelvis(goal, w, _FEET, p, root), left_q, LEG_ROUNDS, joints)
        solve_leg(m, w, 7, foot_in_pelvis(goal, w, _FEET + 5, p, root), right_q, LEG_ROUNDS, joints)
        moment = upper + limb_moment(m, w, 1, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
        moment = moment + limb_moment(m, w, 7, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
        c = p + wp.quat_rotate(root, moment / m.total)
        dx = goal[w, _COM] - c[0]
        dy = goal[w, _COM + 1] - c[1]
        # The seat takes over where balance would leave the pelvis farther ahead than the seat allows.
        place = ahead[0] * (p[0] + dx - goal[w, _ANCHOR]) + ahead[1] * (p[1] + dy - goal[w, _ANCHOR + 1])
        gap = place - goal[w, _SEAT]
        back = goal[w, _SEAT_WEIGHT] * 0.5 * (gap + wp.sqrt(gap * gap + SEAT_SOFTNESS * SEAT_SOFTNESS))
        dx = dx - back * ahead[0]
        dy = dy - back * ahead[1]
        dx = dx + weight * (goal[w, _PELVIS] - p[0] - dx)
        dy = dy + weight * (goal[w, _PELVIS + 1] - p[1] - dy)
        p = wp.vec3(p[0] + dx, p[1] + dy, p[2])
    left = place_leg(m, w, 1, foot_in_pelvis(goal, w, _FEET, p, root), left_q, joints)
    left = wp.max(left, place_leg(m, w, 7, foot_in_pelvis(goal, w, _FEET + 5, p, root), right_q, joints))
    moment = upper + limb_moment(m, w, 1, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
    moment = moment + limb_moment(m, w, 7, 6, wp.vec3(0.0, 0.0, 0.0), wp.quat(0.0, 0.0, 0.0, 1.0), joints)
    c = p + wp.quat_rotate(root, moment / m.total)
    pelvis[w, 0] = p[0]
    pelvis[w, 1] = p[1]
    for k in range(3):
        com[w, k] = c[k]
    error[w] = left


def launch_ik(model: Model, goal: wp.array, mask: wp.array, state: IkState) -> None:
    """Solves one tick.

    Args:
        model: Links.
        goal: Rows laid out as `GOAL`, shape [worlds, 48].
        mask: 1 = solve this world, int32, shape [worlds].
        state: Start and result.
    """
    wp.launch(
        ik_kernel,
        dim=goal.shape[0],
        inputs=[model, goal, mask],
        outputs=[state.pelvis, state.joints, state.arms, state.hands, state.com, state.error],
        device=goal.device,
    )
