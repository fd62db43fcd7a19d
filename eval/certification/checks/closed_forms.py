"""Does the world move as mechanics says? Fall, weight, masses, drives, sliding and bounce against their closed forms.

Everything is measured on the worlds that episodes are played in, by positions after forces.
No number of the compiled model is read, so that a change of it anywhere between its source and the motion shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple, cast

import mujoco
import numpy as np

from arena_newton.eval.certification.checks.traces import world_of
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding
from arena_newton.pages.tables import Table, percent
from arena_newton.physics.ball import BALL
from arena_newton.physics.devices import resolve_engine
from arena_newton.physics.engines import make_physics
from arena_newton.robot import g1
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.robot.g1 import FEET
from arena_newton.usd_scenes.g1.links import LINKS

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv
    from arena_newton.files.stored_json import Json
    from arena_newton.physics.batch import Physics

__all__ = ["CHECKS", "TOLERANCE", "Bench", "Measurement", "measured_in"]

TOLERANCE = 0.005
"""Largest deviation from a closed form, as a part of it."""
GRAVITY = 9.81
"""[m/s²]."""
MASS = 34.395
"""The robot with its hands [kg]: Unitree's G1."""
SOLES, BOXES = 1.0, 1.0
"""Coefficients of friction of the soles and of boxes on the floor, ..."""
FRICTION_TOLERANCE = 0.02
"""... and by what part of it one may be off: a sliding contact chatters."""
SLIDES: Mapping[str, tuple[str, float, float]] = {
    "pp_box": ("/World/Box", 0.05, 0.105),
    "sit_sofa": ("/World/Carton_1", 0.05, 0.21),
    "vis_navi": ("/World/Beam_a", 12.0, 0.14),
}
"""Task → what slides on its floor, its mass [kg], and the height of its centre of mass above the floor [m]."""
PULL = 1.05
"""Pull on a sliding body, as a part of its friction."""
PUSH = 20.0
"""Force that weighs a link [N]."""
DRIVE_TOLERANCE = 0.01
"""Relative tolerance of stiffness and damping of one joint's drive."""
BOUNCE = (-0.005, 0.03)
"""Allowed error of a ball's coefficient of restitution: its contact adds up to 0.025 with the depth at which a physics
step finds it (`ball.BALL_SPRING`)."""
DROPS = (1.0, 3.0)
"""Heights of its falls [m]."""
DIVERGED = 1e300
"""Measurement of a world that diverged."""
WORLDS = 12
HIGH = 6.0
"""Height from which a body falls freely for a second without a touch [m]."""
FALL_TICKS = 5
"""Half of the fall's length."""
DEFLECTION = 0.005
"""Angle by which a drive is bent [rad]."""
HELD_STEPS, REST_STEPS = 200, 4000
"""Physics steps for which it is held, and in which it comes to rest."""
SETTLING_TICKS, STARTING_TICKS, SLIDING_TICKS = 15, 5, 25
"""Ticks in which what slides comes to rest, starts to move, and is watched."""
STANDING_HEIGHT = 0.79
"""Height of the pelvis at which the soles of the default pose touch the floor [m]."""
STANDING_TICKS = (100, 50)
"""Ticks after which the robot stands still, and over which its weight is averaged."""


class Measurement(NamedTuple):
    """A number that was measured, and what it is to be."""

    what: str
    measured: float
    expected: float
    low: float
    """Least deviation that is allowed, in the number's unit."""
    high: float

    @property
    def deviation(self) -> float:
        """Difference from the expected value, as a part of it."""
        return self.measured / self.expected - 1.0

    def finite(self) -> Measurement:
        """The same as JSON can say it: a world that diverged measures a number beyond all bounds."""
        return self if math.isfinite(self.measured) else self._replace(measured=DIVERGED)

    def text(self) -> str:
        """The number in words."""
        return f"{self.what} is {self.measured:.4g}, expected {self.expected:.4g}"

    @property
    def holds(self) -> bool:
        """The deviation is allowed."""
        return self.low <= self.measured - self.expected <= self.high


def _within(what: str, measured: float, expected: float, tolerance: float = TOLERANCE) -> Measurement:
    return Measurement(what, float(measured), expected, -tolerance * abs(expected), tolerance * abs(expected))


class Bench:
    """Worlds of a task without their judge: bodies are put somewhere, pushed, and watched."""

    def __init__(self, env: ArenaEnv, physics: Physics | None = None):
        self.physics: Physics = physics or cast("Physics", env.physics)
        self.scene, self.env = env.scene, env
        self.every = np.arange(env.worlds)
        mocap = self.physics.mocap_pos0, self.physics.mocap_quat0
        self._mocap = tuple(np.tile(rows, (env.worlds, 1, 1)) for rows in mocap)
        model = self.scene.mj_model
        free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        self.free = {int(model.jnt_bodyid[j]): int(model.jnt_qposadr[j]) for j in free}
        """Body with a free joint → its address in qpos."""

    def step_by_step(self) -> Bench:
        """The same worlds and engine with one physics step a tick."""
        rate = g1.PhysicsRate(self.physics.rate.dt, 1)
        return Bench(self.env, make_physics(self.scene, rate, self.env.engine, 1))

    def start(self, qpos: np.ndarray) -> None:
        """Put all worlds at rest, with joint targets where the joints are."""
        p, h = self.physics, self.scene.robot
        p.set_active(np.ones(p.worlds, dtype=bool))
        p.reset_worlds(self.every, qpos, *self._mocap)
        ctrl = p.ctrl.numpy()
        ctrl[:, h.joint_ctrl], ctrl[:, h.hand_ctrl] = qpos[:, h.joint_qpos], qpos[:, h.hand_qpos]
        p.ctrl.assign(ctrl)
        self.push({})

    def push(self, wrenches: Mapping[int, np.ndarray]) -> None:
        """Forces and torques on bodies from now on: body → [6] or [worlds, 6], N and N·m in the world's frame."""
        force = self.physics.external_force.numpy()
        force[:] = 0.0
        for body, wrench in wrenches.items():
            force[:, body] = wrench
        self.physics.external_force.assign(force)

    def pose(self, raised: float = HIGH) -> np.ndarray:
        """The start of an episode with everything that is free raised [m], qpos [worlds, nq]."""
        h, qpos = self.scene.robot, self.physics.qpos0.copy()
        qpos[:, h.root_qpos : h.root_qpos + 7] = [*self.env.spec.spawn_position, *self.env.spec.spawn_quat]
        qpos[:, h.joint_qpos], qpos[:, h.hand_qpos] = g1.DEFAULT_POSE, 0.0
        for address in self.free.values():
            qpos[:, address + 2] += raised
        return qpos

    def rows(self, name: str) -> np.ndarray:
        """A copy of an array of the physics, float64."""
        values: np.ndarray = getattr(self.physics, name).numpy().astype(float)
        return values


def fall(bench: Bench) -> Iterator[Measurement]:
    """Everything that is free falls with g: of a constant acceleration the second difference is exact."""
    bench.start(bench.pose())
    heights = []
    for tick in range(2 * FALL_TICKS + 1):
        if tick % FALL_TICKS == 0:
            heights.append(bench.rows("qpos")[:, [address + 2 for address in bench.free.values()]])
        bench.physics.step()
    gravity = -np.diff(heights, n=2, axis=0)[0] / (FALL_TICKS * g1.TICK) ** 2
    worst = gravity.flat[np.abs(gravity - GRAVITY).argmax()]
    yield _within("free fall [m/s²]", worst, GRAVITY)


def weight(bench: Bench) -> Iterator[Measurement]:
    """The floor carries the standing robot."""
    env, model = bench.env, bench.scene.mj_model
    robot = np.isin(model.geom_bodyid, bench.scene.robot.bodies)
    bench.physics.watch_pair(np.flatnonzero(robot).tolist(), np.flatnonzero(~robot).tolist())
    env.reset(list(range(1, env.worlds + 1)))
    bench.push({})
    carried = []
    for tick in range(sum(STANDING_TICKS)):
        env.step(np.tile(STAND_ACTION, (env.worlds, 1)))
        if tick >= STANDING_TICKS[0]:
            carried.append(bench.rows("pair_force"))
    env.release(bench.every)
    yield _within("force of the floor on the standing robot [N]", np.mean(carried), MASS * GRAVITY)


def masses(bench: Bench) -> Iterator[Measurement]:
    """Masses of the links: pushed without a floor, the robot gains the momentum that the push gives.

    Whatever links and drives do among themselves, the links' accelerations under a push on one of them are a linear
    equation of their masses. Half the difference of a push to either side leaves gravity and second orders out; third
    orders are small in one physics step, also under a push of which single precision leaves enough.
    """
    own = bench.step_by_step()
    p, scene = own.physics, own.scene
    bodies = [scene.link(link.name) for link in LINKS]
    velocity = _velocities(own, bodies)
    pushes = [(body, axis) for body in bodies for axis in range(3)]
    rows, gains = [], []
    for first in range(0, len(pushes), p.worlds):
        part, ends = pushes[first : first + p.worlds], []
        for side in (1.0, -1.0):
            wrenches: dict[int, np.ndarray] = {}
            for world, (body, axis) in enumerate(part):
                wrenches.setdefault(body, np.zeros((p.worlds, 6)))[world, axis] = side * PUSH
            own.start(own.pose())
            own.push(wrenches)
            p.step()
            ends.append(own.rows("qvel"))
        gained = 0.5 * (ends[0] - ends[1])
        for world, (_, axis) in enumerate(part):
            rows.append(velocity @ gained[world] / (PUSH * p.rate.dt))
            gains.append(np.eye(3)[axis])
    found = np.linalg.lstsq(np.concatenate([row.T for row in rows]), np.concatenate(gains), rcond=None)[0]
    for link, mass in zip(LINKS, found, strict=True):
        yield _within(f"mass of {link.name} [kg]", mass, link.mass)


def _velocities(bench: Bench, bodies: list[int]) -> np.ndarray:
    """Velocity of bodies' centres of mass per unit of qvel at the start, [bodies, 3, nv]: geometry alone."""
    model = bench.scene.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = bench.pose()[0]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    found = np.zeros((len(bodies), 3, model.nv))
    for row, body in enumerate(bodies):
        mujoco.mj_jacBodyCom(model, data, found[row], None, body)
    return found


def drives(bench: Bench, damping: bool = True) -> Iterator[Measurement]:
    """Stiffness and, if asked, damping of every joint, of a robot without weight.

    A drive that holds a torque is bent by torque over stiffness. One that is let go comes to rest when spring and
    damper have given the same impulse: the area under its deflection is damping over stiffness times the deflection.
    Half the difference of either side leaves second orders out.
    """
    scene, h = bench.scene, bench.scene.robot
    own = bench.step_by_step()
    physics = own.physics
    hinges = {link.hinge.name: link for link in LINKS if link.hinge is not None}
    names = (*g1.MUJOCO_JOINTS, *g1.HAND_JOINTS)
    links = [hinges[name] for name in names]
    low, high = np.array([link.hinge.limits for link in links if link.hinge]).T
    address = np.concatenate([h.joint_qpos, h.hand_qpos])
    drive = bench.env.tracker.drive
    fingers = len(g1.HAND_JOINTS)
    kp = np.array([*drive.kp, *[drive.finger_kp] * fingers])
    kd = np.array([*drive.kd, *[drive.finger_kd] * fingers])
    side = np.where(own.every % 2, -1.0, 1.0)[:, None]
    qpos = own.pose()
    rest = np.clip(qpos[:, address], low + 0.1, high - 0.1)
    qpos[:, address] = rest + side * DEFLECTION
    lift = {scene.link(link.name): np.array([0.0, 0.0, link.mass * GRAVITY, 0.0, 0.0, 0.0]) for link in LINKS}
    carried = {body: np.tile(wrench, (physics.worlds, 1)) for body, wrench in lift.items()}
    pairs = [
        (scene.link(link.name), scene.link(str(link.parent)), "XYZ".index(link.hinge.axis))
        for link in links
        if link.hinge
    ]

    def begin() -> None:
        own.start(qpos)
        ctrl = physics.ctrl.numpy()
        ctrl[:, np.concatenate([h.joint_ctrl, h.hand_ctrl])] = rest
        physics.ctrl.assign(ctrl)
        physics.set_active(own.every < 2)

    def bent() -> np.ndarray:
        angles: np.ndarray = (side * (own.rows("qpos")[:, address] - rest))[:2].mean(axis=0)
        return angles

    begin()
    angles = []
    for step in range(HELD_STEPS):
        if step % 4 == 0:
            wrenches = {body: wrench.copy() for body, wrench in carried.items()}
            turn = own.rows("xquat")
            for (body, parent, axis), stiffness in zip(pairs, kp, strict=True):
                torque = stiffness * DEFLECTION * side * _axis(turn[:, body], axis)
                wrenches[body][:, 3:] += torque
                wrenches[parent][:, 3:] -= torque
            own.push(wrenches)
        physics.step()
        angles.append(bent())
    for name, wanted, angle in zip(names, kp, np.mean(angles, axis=0), strict=True):
        measured = wanted * DEFLECTION / angle if angle else 0.0
        yield _within(f"stiffness at {name} [N·m/rad]", measured, wanted, DRIVE_TOLERANCE)
    if not damping:
        return
    begin()
    own.push(carried)
    first, area = bent(), np.zeros(len(names))
    for _ in range(REST_STEPS):
        area += bent() * physics.rate.dt
        physics.step()
    physics.close()
    for name, wanted, stiffness, found in zip(names, kd, kp, area / (first - bent()), strict=True):
        yield _within(f"damping at {name} [N·m·s/rad]", stiffness * found, wanted, DRIVE_TOLERANCE)


def _axis(quat: np.ndarray, axis: int) -> np.ndarray:
    """One of the axes of rotated frames: quaternions wxyz [n, 4] → [n, 3]."""
    matrix = np.zeros((len(quat), 9))
    for row, one in zip(matrix, quat, strict=True):
        mujoco.mju_quat2Mat(row, one)
    return matrix.reshape(-1, 3, 3)[:, :, axis]


def soles(bench: Bench) -> Iterator[Measurement]:
    """A robot without weight, its feet pressed on the floor, slides once it is pulled harder than the friction holds.

    Each foot carries half of the weight at its own centre, and the torque that keeps it from tipping: nothing of the
    friction passes through a joint.
    """
    scene, p = bench.scene, bench.physics
    mu, pull = SOLES, PULL - 1.0
    qpos = bench.pose()
    root = scene.robot.root_qpos
    qpos[:, root + 2 : root + 7] = STANDING_HEIGHT, 1.0, 0.0, 0.0, 0.0
    wrenches = {scene.link(link.name): np.zeros(6) for link in LINKS}
    for link in LINKS:
        wrenches[scene.link(link.name)][[0, 2]] = 0.0, link.mass * GRAVITY
    feet = [scene.link(name) for name in FEET]
    for foot in feet:
        wrenches[foot][2] -= 0.5 * MASS * GRAVITY
    bench.start(qpos)
    bench.push(wrenches)
    for _ in range(SETTLING_TICKS):
        p.step()
    height = float(bench.rows("xipos")[0, feet, 2].mean())
    for link in LINKS:
        wrenches[scene.link(link.name)][0] += mu * pull * link.mass * GRAVITY
    for foot in feet:
        wrenches[foot][0] += 0.5 * mu * MASS * GRAVITY
        wrenches[foot][4] -= 0.5 * mu * MASS * GRAVITY * height
    bench.push(wrenches)
    yield _slid(bench, scene.robot.root_body, mu, "friction of the soles")


def slides(bench: Bench) -> Iterator[Measurement]:
    """A box on the floor, kept from tipping, slides once it is pulled harder than the friction holds."""
    scene, p = bench.scene, bench.physics
    prim, mass, half = SLIDES[bench.env.spec.name]
    body, at = scene.body_id(prim), scene.joint_qpos(prim)
    qpos = bench.pose()
    qpos[:, at : at + 3] = [*bench.env.spec.spawn_position[:2], -scene.lowest(prim)]
    qpos[:, at + 3 : at + 7] = 1.0, 0.0, 0.0, 0.0
    bench.start(qpos)
    for _ in range(SETTLING_TICKS):
        p.step()
    grip = BOXES * mass * GRAVITY
    bench.push({body: np.array([PULL * grip, 0.0, 0.0, 0.0, -half * grip, 0.0])})
    yield _slid(bench, body, BOXES, f"friction of {prim}")


def _slid(bench: Bench, body: int, mu: float, what: str) -> Measurement:
    """The coefficient of friction from the acceleration of what is pulled with `PULL` times the friction."""
    way = []
    for tick in range(STARTING_TICKS + SLIDING_TICKS):
        bench.physics.step()
        if tick >= STARTING_TICKS:
            way.append(bench.rows("xpos")[:, body, 0].mean())
    time = g1.TICK * np.arange(len(way))
    acceleration = 2.0 * np.polyfit(time, way, 2)[0]
    return _within(what, PULL * mu - acceleration / GRAVITY, mu, FRICTION_TOLERANCE)


def bounces(bench: Bench) -> Iterator[Measurement]:
    """A ball that falls on the floor leaves it with a part of its speed, wherever within a step it lands."""
    scene = bench.scene
    at, speed, radius = scene.joint_qpos(BALL), scene.joint_qvel(BALL) + 2, -scene.lowest(BALL)
    own = bench.step_by_step()
    qpos = own.pose()
    qpos[:, at : at + 3] = [*bench.env.spec.spawn_position[:2], 0.0]
    qpos[:, at + 2] = radius + np.linspace(*DROPS, bench.env.worlds)
    own.start(qpos)
    fastest, slowest = np.zeros(bench.env.worlds), np.zeros(bench.env.worlds)
    for _ in range(round(1.2 * np.sqrt(2.0 * DROPS[1] / GRAVITY) / own.physics.rate.dt)):
        own.physics.step()
        up = own.rows("qvel")[:, speed]
        fastest, slowest = np.maximum(fastest, up), np.minimum(slowest, up)
    own.physics.close()
    wanted = bench.env.rules.bounce(bench.env.spec.name)
    found = float(np.mean(fastest / -slowest))
    yield Measurement("ball's coefficient of restitution", found, wanted, *BOUNCE)


def measured_in(env: ArenaEnv, *, whole: bool = True) -> list[Measurement]:
    """Measurements in the worlds of a task.

    Args:
        env: Its worlds.
        whole: Everything; otherwise the drives alone, which are the tracker's.
    """
    bench, found = Bench(env), list[Measurement]()
    if whole:
        for measure in (fall, weight, masses, soles):
            found += measure(bench)
        if env.spec.name in SLIDES:
            found += slides(bench)
        if env.scene.ball_restitution is not None:
            found += bounces(bench)
    # A step of Warp's CPU backend takes as long as hundreds of native ones.
    found += drives(bench, damping=env.engine == "mujoco" or env.device.is_cuda)
    return found


def physics(context: Context) -> CheckFinding:
    """Measure what closed forms say, on both engines, in every task."""
    this = resolve_engine(context.options.engine, context.options.device)
    rows, wrong, count = [], [], 0
    for engine, device, task, tracker, whole in _plan(context, this):

        def measure(
            engine: str = engine, device: str = device, task: str = task, tracker: str = tracker, whole: bool = whole
        ) -> Json:
            env = cast(
                "ArenaEnv",
                world_of(context, task, tracker, worlds=_worlds(engine, device), engine=engine, device=device),
            )
            try:
                return [list(one.finite()) for one in measured_in(env, whole=whole)]
            finally:
                env.close()

        found = context.measured(f"physics_{engine}", task, tracker, {"device": device, "whole": whole}, measure)
        numbers = [Measurement(*one) for one in cast("list[list]", found)]
        where = f"{task} through {tracker} on {engine}"
        wrong += [f"{where}: {one.text()}" for one in numbers if not one.holds]
        count += len(numbers)
        for kind, ones in _by_kind(numbers).items():
            most = max(ones, key=lambda one: abs(one.deviation))
            rows.append((task, tracker, engine, kind, str(len(ones)), f"{100 * most.deviation:+.2f}", most.what))
    head = ("task", "tracker", "engine", "closed form", "numbers", "largest deviation [%]", "of")
    summary = f"{count - len(wrong):,} of {count:,} measured numbers are what closed forms say"
    notes = (
        f"Allowed are {percent(TOLERANCE)} % of gravity, weight and a link's mass, {percent(DRIVE_TOLERANCE, 0)} % of "
        f"stiffness and damping, {percent(FRICTION_TOLERANCE, 0)} % of friction, and {BOUNCE[0]:+g} to {BOUNCE[1]:+g} "
        "of the restitution.",
        "Masses come from the momentum that pushes give, stiffness from a held torque, damping from the impulse of a "
        "drive that comes to rest, friction from what slides: no number of the compiled model is read.",
    )
    sheet = Table(head, rows, title="Measured numbers against their closed forms")
    return CheckFinding("fail" if wrong else "pass", summary, (sheet,), (*wrong, *notes))


def _plan(context: Context, this: tuple[str, str]) -> Iterator[tuple[str, str, str, str, bool]]:
    """Engine, device, task, tracker, and whether everything is measured or the tracker's drives alone."""
    for task in context.tasks:
        yield *this, task, context.trackers[0], True
    for tracker in context.trackers[1:]:
        for task in context.tasks[:1] if context.options.quick else context.tasks:
            yield *this, task, tracker, False
    other = "warp" if this[0] == "mujoco" else "mujoco"
    device = resolve_engine(other, None if other == "warp" else "cpu")[1]
    for task in context.tasks[:1] if context.options.quick or device == "cpu" else context.tasks:
        yield other, device, task, context.trackers[0], True


def _worlds(engine: str, device: str) -> int:
    """Worlds that measure side by side: fewer where each takes time."""
    return 4 if engine == "warp" and device == "cpu" else WORLDS


def _by_kind(numbers: list[Measurement]) -> dict[str, list[Measurement]]:
    """Measurements by the first word of what they are."""
    kinds: dict[str, list[Measurement]] = {}
    for one in numbers:
        kinds.setdefault(one.what.split()[0].removesuffix("'s"), []).append(one)
    return kinds


CHECKS = (
    Check("physics", "Does the world fall, weigh, slide and bounce as mechanics says, on both engines?", physics),
)
"""This module's checks."""
