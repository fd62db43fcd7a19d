"""Every rollout of a suite in one batch of worlds, under one tracker."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from arena_newton import robot as g1
from arena_newton.errors import ArenaError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.trackers.evaluation.lab import Lab, Start, WorldKind
from arena_newton.trackers.evaluation.meter import Meter, Reference
from arena_newton.trackers.evaluation.suite import Cell, Tables, tabulate
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT
from arena_newton.trackers.motions.library import FIXTURES
from arena_newton.trackers.motions.programs import place_platform

if TYPE_CHECKING:
    from arena_newton.trackers.base import Tracker

__all__ = ["Outcome", "Plan", "plan", "run"]

SETTLE_TICKS = 50
"""Standing before the reference starts [ticks], as in an episode: the tracker takes its stance."""
JOINT_NOISE = 0.03
"""Uniform error of the initial joints [rad]."""
PLACE_NOISE, YAW_NOISE = 0.01, 0.02
"""Uniform errors of the initial place [m] and heading [rad]."""
VELOCITY_KICK, TURN_KICK = 0.1, 0.1
"""Uniform kicks of the root when the reference starts [m/s], [rad/s]: rollouts of one cell part ways."""
SILL_LENGTH, FOOT_FRONT, FOOT_BACK = 0.10, 0.12, 0.05
"""Sill and sole along the way, the sole's from the ankle frame [m]."""


@dataclass
class Plan:
    """Which cell each world plays and what is drawn for it; the same for every tracker."""

    cells: list[Cell]
    cell: np.ndarray
    """Cell of each world, [worlds]."""
    noise: dict[str, np.ndarray]
    """Draws of each world."""
    _tables: dict[torch.device, Tables] = field(default_factory=dict, repr=False)

    def tables(self, device: torch.device) -> Tables:
        """References of all cells, rolled out once a device."""
        if device not in self._tables:
            self._tables[device] = tabulate(self.cells, device)
        return self._tables[device]


@dataclass
class Outcome:
    """What one tracker did."""

    measures: dict[str, np.ndarray]
    """`Meter.results` and, of worlds that have one, `support_x` [m], `goal_distance` [m] and `goal_turn` [deg]."""
    overflows: int
    """Worlds whose contact buffers overflowed."""
    ticks: int
    engine: str
    device: str
    rate: g1.PhysicsRate
    """Physics rate of the rollouts."""
    setup_s: float
    """Wall-clock time of building worlds and references [s]."""
    rollout_s: float
    """Wall-clock time of the rollouts [s]."""


def plan(cells: list[Cell], rollouts: int, seed: int) -> Plan:
    """Worlds for cells; a cell's draws depend on the seed and its name alone.

    Args:
        cells: The suite.
        rollouts: Worlds a cell, where the cell does not say.
        seed: Seed of all draws.
    """
    index = np.concatenate([np.full(c.rollouts or rollouts, i) for i, c in enumerate(cells)])
    noise: dict[str, list[np.ndarray]] = {}
    for c in cells:
        count = c.rollouts or rollouts
        rng = np.random.default_rng([seed, zlib.crc32(c.name.encode())])
        draws = {
            "joints": rng.uniform(-JOINT_NOISE, JOINT_NOISE, (count, 29)),
            "place": rng.uniform(-PLACE_NOISE, PLACE_NOISE, (count, 2)),
            "yaw": rng.uniform(-YAW_NOISE, YAW_NOISE, count),
            "kick": np.concatenate(
                [
                    rng.uniform(-VELOCITY_KICK, VELOCITY_KICK, (count, 2)),
                    np.zeros((count, 3)),
                    rng.uniform(-TURN_KICK, TURN_KICK, (count, 1)),
                ],
                axis=1,
            ),
            "unit": rng.uniform(0.0, 1.0, (count, 3)),
        }
        for name, values in draws.items():
            noise.setdefault(name, []).append(values)
    return Plan(cells, index, {name: np.concatenate(parts) for name, parts in noise.items()})


def _supports(plan: Plan, tables: Tables) -> dict[str, np.ndarray]:
    out = {name: np.full((len(plan.cell), 4), np.nan) for name in FIXTURES}
    for i, cell in enumerate(plan.cells):
        if cell.support is not None:
            x = cell.support.x
            if x is None and cell.support.name == "Platform":
                feet = tables.feet[None, : cell.ticks, i]
                height = feet.new_tensor([cell.support.height])
                place, room = place_platform(feet[..., :2].mean(2), feet, height)
                if float(room) < 0.0:
                    raise ArenaError(f"{cell.name}: the reference's feet do not tread on the platform")
                x = float(place[0, 0])
            elif x is None:
                x, clear = sill_place(tables.feet[: cell.ticks, i].cpu().numpy())
                if clear < cell.support.height:
                    raise ArenaError(f"{cell.name}: the reference's feet clear only {clear:.3f} m")
            out[cell.support.name][plan.cell == i] = (x, 0.0, cell.support.height, 0.0)
    return out


def sill_place(feet: np.ndarray) -> tuple[float, float]:
    """Where across the way a sill stands that a reference's feet step over with the most clearance.

    Args:
        feet: Ankle frames [m], shape [ticks, 2, 3].

    Returns:
        Middle of the sill and the least height of a sole above the floor while it is over the sill [m].
    """
    best, place = -np.inf, 0.0
    for x in np.arange(0.4, max(0.45, float(feet[..., 0].max()) - 0.6), 0.01):
        low, high = x - SILL_LENGTH / 2 - FOOT_FRONT, x + SILL_LENGTH / 2 + FOOT_BACK
        over = (feet[..., 0] > low) & (feet[..., 0] < high)
        if over.any():
            clearance = float(feet[over][:, 2].min())
            if clearance > best + 1e-3:
                best, place = clearance, float(x)
    return place, best - SOLE_HEIGHT


def _start(plan: Plan, tables: Tables, feet_ahead: float) -> Start:
    first = tables.actions[0].cpu().numpy()[plan.cell]
    n, w = plan.noise, len(plan.cell)
    root = np.zeros((w, 7))
    root[:, :2], root[:, 2] = n["place"], first[:, 2]
    root[:, 3], root[:, 6] = np.cos(0.5 * n["yaw"]), np.sin(0.5 * n["yaw"])
    joints = first[:, 9:38][:, list(g1.MUJOCO_TO_CANONICAL)] + n["joints"]
    ball = np.full((w, 3), np.nan)
    for i, cell in enumerate(plan.cells):
        if cell.ball is not None:
            rows = plan.cell == i
            near, far = cell.ball.distance
            u = n["unit"][rows]
            ball[rows, 0] = feet_ahead + near + (far - near) * u[:, 0]
            ball[rows, 1] = cell.ball.lateral + cell.ball.spread * (2 * u[:, 1] - 1)
            ball[rows, 2] = 0.11
    return Start(root=root, joints=joints, supports=_supports(plan, tables), ball=ball)


class _Forces:
    """Forces on the chests by tick, made on the device."""

    def __init__(self, plan: Plan, device: torch.device):
        w = len(plan.cell)
        size, begin, length, angle = (np.zeros(w) for _ in range(4))
        backward = np.zeros(w, dtype=bool)
        for i, cell in enumerate(plan.cells):
            if cell.push is not None:
                rows = plan.cell == i
                u = plan.noise["unit"][rows]
                early, late = cell.push.start
                size[rows], backward[rows] = cell.push.newtons, cell.push.backward
                begin[rows] = np.round((early + (late - early) * u[:, 0]) / g1.TICK)
                length[rows] = round(cell.push.seconds / g1.TICK)
                angle[rows] = 2 * np.pi * u[:, 1]
        self.any = bool(size.any())

        def up(array: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(array, device=device, dtype=torch.bool if array.dtype == bool else torch.float32)

        self._size, self._begin, self._end = up(size), up(begin), up(begin + length)
        self._angle, self._backward = up(angle), up(backward)

    def at(self, tick: int, yaw: torch.Tensor) -> torch.Tensor:
        """Force [N], world frame, [worlds, 3]."""
        size = self._size * ((self._begin <= tick) & (tick < self._end))
        angle = torch.where(self._backward, yaw + np.pi, self._angle)
        return torch.stack([size * torch.cos(angle), size * torch.sin(angle), torch.zeros_like(size)], dim=1)


class _Goals:
    """Closed-loop references of the worlds that have a goal."""

    def __init__(self, plan: Plan, device: torch.device):
        from arena_newton.trackers.motions.commands import MotionCommand
        from arena_newton.trackers.motions.generator import ReferenceGenerator
        from arena_newton.trackers.motions.navigate import NavigationLimits, Navigator

        goals = [plan.cells[i].goal for i in plan.cell]
        rows = [w for w, goal in enumerate(goals) if goal is not None]
        self.rows = torch.tensor(rows, dtype=torch.long, device=device)
        self.goal = torch.tensor([[g.x, g.y, g.yaw] for g in goals if g is not None], device=device)
        self._generator = ReferenceGenerator(len(rows), device)
        self._navigator = Navigator(len(rows), device, NavigationLimits())
        self._neutral = MotionCommand.neutral(len(rows), device)

    def begin(self, pose: torch.Tensor) -> None:
        """Start at measured poses x, y, yaw, [worlds, 3]."""
        here = pose.index_select(0, self.rows)
        self._generator.reset(root_xy=here[:, :2], yaw=here[:, 2])
        self._navigator.reset()

    def write(self, pose: torch.Tensor, actions: torch.Tensor) -> None:
        """Put this tick's actions of the goal worlds into `actions` [worlds, 40]."""
        here = pose.index_select(0, self.rows)
        asked = self._navigator.command(here, self.goal, g1.TICK)
        self._neutral.velocity = asked.velocity
        self._generator.step(self._neutral)
        actions.index_copy_(0, self.rows, self._generator.action())


@torch.inference_mode()
def run(
    tracker: Tracker,
    plan: Plan,
    *,
    engine: str = "auto",
    device: str | None = None,
    fast_physics: bool = False,
    threads: int | None = None,
    observer: Any = None,
) -> Outcome:
    """Play a plan.

    Args:
        tracker: A tracker, not bound yet.
        plan: What to play.
        engine: `auto`, `mujoco` or `warp`.
        device: Warp device.
        fast_physics: Use the tracker's fast physics rate.
        threads: CPU threads of engine `mujoco`.
        observer: Called as observer(lab, tick) after every tick, for films.
    """
    import warp as wp

    from arena_newton.kernels import canonical
    from arena_newton.rotations import heading
    from arena_newton.trackers.motions.kinematics import neutral_stance

    began = time.perf_counter()
    cells, worlds = plan.cells, len(plan.cell)
    kinds = [WorldKind(cells[i].friction, cells[i].payload) for i in plan.cell]
    watched = np.array([cells[i].support is not None for i in plan.cell])
    rate = tracker.rate(fast=fast_physics)
    lab = Lab(kinds, watched, drive=tracker.drive, rate=rate, engine=engine, device=device, threads=threads)
    tables = plan.tables(lab.device)
    start = _start(plan, tables, neutral_stance().ankle)
    lab.start(start)
    end = np.array([c.ticks for c in cells])[plan.cell]
    meter = Meter(lab, end, np.array([round(c.window / g1.TICK) for c in cells])[plan.cell])
    tracker.bind(worlds, lab.device)

    of_world = torch.as_tensor(plan.cell, dtype=torch.long, device=lab.device)
    to_mujoco = torch.tensor(g1.MUJOCO_TO_CANONICAL, dtype=torch.long, device=lab.device)
    forces = _Forces(plan, lab.device)
    goals = _Goals(plan, lab.device) if any(c.goal is not None for c in cells) else None
    pose_of = canonical.ReferencePose.allocate(
        worlds, lab.physics.device, canonical_to_mujoco=g1.CANONICAL_TO_MUJOCO, tick=g1.TICK
    )
    action = torch.zeros(worlds, 40, device=lab.device)
    action_wp, every = wp.from_torch(action), wp.full(worlds, 1, dtype=wp.int32, device=lab.physics.device)
    ref_position, ref_quat, ref_joints, ref_vel, mimic = (
        wp.to_torch(a) for a in (pose_of.position, pose_of.quat, pose_of.joints, pose_of.joint_vel, pose_of.mimic)
    )

    def anchor() -> None:
        canonical.launch_reset_reference(pose_of, lab.physics.qpos, lab.root_q, every)

    def pose() -> torch.Tensor:
        at = lab.root_q
        return torch.cat([lab.qpos[:, at : at + 2], heading(lab.qpos[:, at + 3 : at + 7])[:, None]], dim=1)

    def drive(fresh: bool) -> torch.Tensor:
        canonical.launch_integrate(pose_of, action_wp, every, tracker.max_root_delta_deg)
        command = TrackerCommand(
            mimic=mimic,
            joints=ref_joints.index_select(1, to_mujoco),
            joint_vel=ref_vel.index_select(1, to_mujoco),
            quat=ref_quat,
        )
        state = RobotState(
            quat=lab.qpos[:, lab.root_q + 3 : lab.root_q + 7],
            ang_vel_body=lab.qvel[:, lab.root_v + 3 : lab.root_v + 6],
            joint_pos=lab.qpos.index_select(1, lab.joint_q),
            joint_vel=lab.qvel.index_select(1, lab.joint_v),
        )
        if fresh:
            tracker.prefill(command, state)
        targets = tracker.step(command, state)
        lab.step(targets)
        return targets

    anchor()
    action.copy_(tables.actions[0].index_select(0, of_world))
    action[:, :2] = 0.0
    setup, ticks = time.perf_counter() - began, int(end.max())
    targets = ref_joints
    for tick in range(-SETTLE_TICKS, ticks):
        if tick == 0:
            lab.add_velocity(plan.noise["kick"])
            anchor()
            meter.anchor(targets, ref_position)
            if goals is not None:
                goals.begin(pose())
        if tick >= 0:
            torch.index_select(tables.actions[tick], 0, of_world, out=action)
            if goals is not None:
                goals.write(pose(), action)
            if forces.any:
                lab.force.copy_(forces.at(tick, pose()[:, 2]))
        targets = drive(fresh=tick == -SETTLE_TICKS)
        joints = ref_joints.index_select(1, to_mujoco)
        links = tables.links[max(tick, 0)].index_select(0, of_world)
        live = meter.update(tick, Reference(ref_position, ref_quat, joints, links), targets)
        lab.set_active(live)
        if observer is not None:
            observer(lab, tick)
    measures = meter.results()
    measures["support_x"] = _support_x(start)
    if goals is not None:
        _add_goals(measures, plan)
    done = time.perf_counter()
    return Outcome(
        measures=measures,
        overflows=lab.overflows(),
        ticks=ticks + SETTLE_TICKS,
        engine=lab.engine,
        device=str(lab.device),
        rate=rate,
        setup_s=setup,
        rollout_s=done - began - setup,
    )


def _support_x(start: Start) -> np.ndarray:
    """Place of each world's support along the way [m], NaN without one, [worlds]."""
    out: np.ndarray = np.full(len(start.root), np.nan)
    for pose in start.supports.values():
        out = np.where(np.isfinite(pose[:, 0]), pose[:, 0], out)
    return out


def _add_goals(measures: dict[str, np.ndarray], plan: Plan) -> None:
    goals = [plan.cells[i].goal for i in plan.cell]
    wanted = np.array([(g.x, g.y, g.yaw) if g is not None else (np.nan,) * 3 for g in goals])
    offset = np.stack([measures["end_x"], measures["end_y"]], axis=1) - wanted[:, :2]
    turn = measures["end_yaw"] - wanted[:, 2]
    # The reference of a goal follows the robot, so that its distance from it says nothing.
    for name in ("drift", "drift_10s", "heading_error", "velocity_error"):
        measures[name] = np.where(np.isfinite(wanted[:, 0]), np.nan, measures[name])
    measures["goal_distance"] = np.linalg.norm(offset, axis=1)
    measures["goal_turn"] = np.degrees(np.abs((turn + np.pi) % (2 * np.pi) - np.pi))
