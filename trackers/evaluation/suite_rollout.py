"""Every rollout of a suite in one batch of worlds, under one tracker."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypedDict, Unpack

import numpy as np
import torch
import warp as wp

from arena_newton import rule_sets
from arena_newton.errors import ArenaError
from arena_newton.interfaces import Tracker
from arena_newton.robot import g1
from arena_newton.robot.rotations import heading
from arena_newton.trackers.evaluation.lab import Lab, Start, WorldKind
from arena_newton.trackers.evaluation.meter import Meter, TickReference
from arena_newton.trackers.evaluation.suite import Cell, Tables, tabulate
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT, neutral_stance
from arena_newton.trackers.motions.library import FIXTURES
from arena_newton.trackers.motions.navigate import NavigationLimits, Navigator
from arena_newton.trackers.motions.programs import SILL_SIZE, place_platform
from arena_newton.tracking import TrackerLoop

__all__ = ["Outcome", "Plan", "Settings", "SuiteRollout", "begins", "find_sill", "make_plan", "play"]

BALL_RADIUS = 0.11
"""[m]"""
JOINT_NOISE = 0.03
"""Uniform error of the initial joints [rad]."""
POSITION_NOISE, YAW_NOISE = 0.01, 0.02
"""Uniform errors of the initial position [m] and heading [rad]."""
VELOCITY_KICK, TURN_KICK = 0.1, 0.1
"""Uniform kicks of the root when the reference starts [m/s], [rad/s]: they make rollouts of one cell differ."""
TOE, HEEL = 0.12, 0.05
"""Ends of the sole in front of and behind the ankle frame [m]: the foot itself. `motions.programs` adds one or two
centimetres (`SOLE_FRONT`, `SOLE_BACK`) where it draws clips for training, which must leave room for errors."""


class Settings(TypedDict, total=False):
    """Machine and batch on which a plan is played."""

    engine: str
    """`auto` (the default), `mujoco` or `warp`."""
    device: str | None
    """Warp device."""
    threads: int | None
    """CPU threads of engine `mujoco`; all by default."""


@dataclass
class Plan:
    """Assignment of cells and random numbers to worlds, the same for every tracker."""

    cells: list[Cell]
    cell: np.ndarray
    """Cell of each world, [worlds]."""
    noise: dict[str, np.ndarray]
    """Draws of each world."""
    _tables: dict[torch.device, Tables] = field(default_factory=dict, repr=False)
    _whole: Plan | None = field(default=None, repr=False)
    """The plan of which this is one cell."""

    def tables(self, device: torch.device) -> Tables:
        """References of all cells, rolled out once per device."""
        if device not in self._tables:
            if self._whole is None:
                self._tables[device] = tabulate(self.cells, device)
            else:
                whole, at = self._whole.tables(device), [self._whole.cells.index(cell) for cell in self.cells]
                self._tables[device] = Tables(whole.actions[:, at], whole.links[:, at], whole.feet[:, at])
        return self._tables[device]

    def only(self, number: int) -> Plan:
        """One cell with its draws; its references are taken from those of all cells."""
        rows = self.cell == number
        noise = {name: values[rows] for name, values in self.noise.items()}
        return Plan([self.cells[number]], np.zeros(rows.sum(), dtype=int), noise, _whole=self)


@dataclass
class Outcome:
    """Measures of one tracker on a plan."""

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
    errors: np.ndarray | None = None
    """`Meter.errors` of plans with blows, [ticks, worlds, 2]."""


def make_plan(cells: list[Cell], rollouts: int, seed: int) -> Plan:
    """Worlds for cells, `rollouts` for each that does not say; a cell's draws depend on the seed and its name alone."""
    index = np.concatenate([np.full(c.rollouts or rollouts, i) for i, c in enumerate(cells)])
    noise: dict[str, list[np.ndarray]] = {}
    for c in cells:
        count = c.rollouts or rollouts
        rng = np.random.default_rng([seed, zlib.crc32(c.name.encode())])
        draws = {
            "joints": rng.uniform(-JOINT_NOISE, JOINT_NOISE, (count, 29)),
            "position": rng.uniform(-POSITION_NOISE, POSITION_NOISE, (count, 2)),
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
            "blows": rng.uniform(0.0, 1.0, (count, max(one.blows.segments if one.blows else 0 for one in cells), 5)),
        }
        for name, values in draws.items():
            noise.setdefault(name, []).append(values)
    return Plan(cells, index, {name: np.concatenate(parts) for name, parts in noise.items()})


def _supports(plan: Plan, tables: Tables) -> dict[str, np.ndarray]:
    """Poses of the supports, as `Start.supports`."""
    out = {name: np.full((len(plan.cell), 4), np.nan) for name in FIXTURES}
    for i, cell in enumerate(plan.cells):
        if cell.support is not None:
            feet, height = tables.feet[: cell.ticks, i], cell.support.height
            x = cell.support.x
            if x is None and cell.support.name == "Platform":
                position, room = place_platform(feet[None, ..., :2].mean(2), feet[None], feet.new_tensor([height]))
                if float(room) < 0.0:
                    raise ArenaError(f"{cell.name}: the reference's feet do not tread on the platform")
                x = float(position[0, 0])
            elif x is None:
                x, clearance = find_sill(feet.cpu().numpy())
                if clearance < height:
                    raise ArenaError(f"{cell.name}: the reference's feet clear only {clearance:.3f} m")
            out[cell.support.name][plan.cell == i] = (x, 0.0, height, 0.0)
    return out


def find_sill(feet: np.ndarray) -> tuple[float, float]:
    """Position of a sill across a walk along x that a reference's feet step over with the most clearance.

    Args:
        feet: Ankle frames [m], shape [ticks, 2, 3].

    Returns:
        Middle of the sill and the least height of a sole above the floor while it is over the sill [m].
    """
    best, middle = -np.inf, 0.0
    for x in np.arange(0.4, max(0.45, float(feet[..., 0].max()) - 0.6), 0.01):
        low, high = x - SILL_SIZE[0] / 2 - TOE, x + SILL_SIZE[0] / 2 + HEEL
        over = (feet[..., 0] > low) & (feet[..., 0] < high)
        if over.any():
            clearance = float(feet[over][:, 2].min())
            if clearance > best + 1e-3:
                best, middle = clearance, float(x)
    return middle, best - SOLE_HEIGHT


def _start(plan: Plan, tables: Tables) -> Start:
    """Initial state of every world."""
    first = tables.actions[0].cpu().numpy()[plan.cell]
    n, w = plan.noise, len(plan.cell)
    root = np.zeros((w, 7))
    root[:, :2], root[:, 2] = n["position"], first[:, 2]
    root[:, 3], root[:, 6] = np.cos(0.5 * n["yaw"]), np.sin(0.5 * n["yaw"])
    joints = first[:, 9:38][:, list(g1.MUJOCO_TO_CANONICAL)] + n["joints"]
    ball, ankle = np.full((w, 3), np.nan), neutral_stance().ankle
    for i, cell in enumerate(plan.cells):
        if cell.ball is not None:
            rows = plan.cell == i
            near, far = cell.ball.distance
            u = n["unit"][rows]
            ball[rows, 0] = ankle + near + (far - near) * u[:, 0]
            ball[rows, 1] = cell.ball.lateral + cell.ball.spread * (2 * u[:, 1] - 1)
            ball[rows, 2] = BALL_RADIUS
    return Start(root=root, joints=joints, supports=_supports(plan, tables), ball=ball)


class _Forces:
    """Forces on the chests per tick, computed on the device."""

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


class _Blows:
    """Blows of all worlds, computed on the device; worlds and blows without one have a force of 0."""

    def __init__(self, plan: Plan, lab: Lab):
        unit = plan.noise["blows"]
        worlds, most = unit.shape[:2]
        size, length = np.zeros((worlds, most)), np.zeros((worlds, 1))
        self.begin = begins(plan)
        for i, cell in enumerate(plan.cells):
            if (blows := cell.blows) is not None:
                rows, numbers = plan.cell == i, np.arange(blows.segments)
                size[rows, : blows.segments] = blows.newtons
                if blows.ramp:
                    bound = 1 / 3 + 2 / 3 * numbers / blows.segments
                    size[rows, : blows.segments] *= bound * (0.5 + 0.5 * unit[rows, : blows.segments, 4])
                length[rows] = round(blows.seconds / g1.TICK)
        robot, m = lab.scene.robot, lab.scene.mj_model
        links = m.jnt_bodyid[m.dof_jntid[robot.joint_qvel]]
        turn, up = 2 * np.pi * unit[..., 1], 2 * unit[..., 2] - 1
        level = np.sqrt(1 - up**2)
        force = size[..., None] * np.stack([level * np.cos(turn), level * np.sin(turn), up], axis=-1)
        device = lab.device
        self._links = torch.as_tensor(links[(unit[..., 3] * len(links)).astype(int)], dtype=torch.long, device=device)
        self._force = torch.as_tensor(force, dtype=torch.float32, device=device)
        self._begin, self._end = (torch.as_tensor(at, device=device) for at in (self.begin, self.begin + length))
        self._rows = torch.arange(worlds, device=device)[:, None]

    def add(self, tick: int, forces: torch.Tensor) -> None:
        """Add this tick's forces [N], world frame, to those on the bodies, [worlds, bodies, 3]."""
        now = (self._begin <= tick) & (tick < self._end)
        forces.index_put_((self._rows, self._links), self._force * now[..., None], accumulate=True)


def begins(plan: Plan) -> np.ndarray:
    """Ticks at which the blows of each world begin, NaN where a world has fewer, [worlds, blows]."""
    unit = plan.noise["blows"][..., 0]
    out = np.full(unit.shape, np.nan)
    for i, cell in enumerate(plan.cells):
        if (blows := cell.blows) is not None:
            early, late = blows.begin
            drawn = early + (late - early) * unit[plan.cell == i, : blows.segments]
            at = np.round((np.arange(blows.segments) * blows.spacing + drawn) / g1.TICK)
            out[plan.cell == i, : blows.segments] = at
    return out


class _Goals:
    """Closed-loop references of the worlds that have a goal."""

    def __init__(self, plan: Plan, device: torch.device):
        goals = [plan.cells[i].goal for i in plan.cell]
        rows = [w for w, goal in enumerate(goals) if goal is not None]
        self.rows = torch.tensor(rows, dtype=torch.long, device=device)
        self.goal = torch.tensor([[g.x, g.y, g.yaw] for g in goals if g is not None], device=device)
        self._generator = ReferenceGenerator(len(rows), device)
        self._navigator = Navigator(len(rows), device, NavigationLimits())
        self._command = MotionCommand.neutral(len(rows), device)

    def begin(self, pose: torch.Tensor) -> None:
        """Start at measured poses x, y, yaw [m, rad], shape [worlds, 3]."""
        here = pose.index_select(0, self.rows)
        self._generator.reset(root_xy=here[:, :2], yaw=here[:, 2])
        self._navigator.reset()

    def write(self, pose: torch.Tensor, actions: torch.Tensor) -> None:
        """Write this tick's actions of the goal worlds into `actions` [worlds, 40]."""
        here = pose.index_select(0, self.rows)
        self._command.velocity = self._navigator.command(here, self.goal, g1.TICK).velocity
        self._generator.step(self._command)
        actions.index_copy_(0, self.rows, self._generator.action())


class SuiteRollout:
    """A plan under one tracker: `prepare` once, `tick` from `-startup_ticks` to `ticks - 1`, then `outcome`."""

    def __init__(self, tracker: Tracker, plan: Plan, *, fast_physics: bool = False, **settings: Unpack[Settings]):
        """Build worlds and references; see `play`."""
        began = time.perf_counter()
        self.plan, self.rate = plan, tracker.rate(fast=fast_physics)
        self.startup_ticks = rule_sets.get("paper").startup.ticks
        """Standing before the references start [ticks], as in an episode of the rule set `paper`."""
        cells, cell = plan.cells, plan.cell
        kinds = [WorldKind(cells[i].friction, cells[i].payload) for i in cell]
        watched = np.array([cells[i].support is not None for i in cell])
        self.lab = Lab(kinds, watched, drive=tracker.drive, rate=self.rate, **settings)
        self.tables = plan.tables(self.lab.device)
        self.start = _start(plan, self.tables)
        end = np.array([c.ticks for c in cells])[cell]
        self.ticks = int(end.max())
        struck = any(c.blows is not None for c in cells)
        window = np.array([round(c.window / g1.TICK) for c in cells])[cell]
        self.meter = Meter(self.lab, end, window, traced=self.ticks if struck else 0)
        self.loop = TrackerLoop(self.lab.physics, self.lab.scene.robot, tracker)
        self._every = np.ones(self.lab.worlds, dtype=bool)
        self._cell = torch.as_tensor(cell, dtype=torch.long, device=self.lab.device)
        self._forces = _Forces(plan, self.lab.device)
        self._blows = _Blows(plan, self.lab) if struck else None
        self._latency = [{"state_latency": n, "action_latency": n} if (n := cells[i].latency) else {} for i in cell]
        self._goals = _Goals(plan, self.lab.device) if any(c.goal is not None for c in cells) else None
        self._position = wp.to_torch(self.loop.reference.position)
        self.setup_s = time.perf_counter() - began
        self._began = time.perf_counter()

    def prepare(self) -> None:
        """Put every world at its start, with the first action as a command to stand still."""
        self.lab.start(self.start)
        self.loop.delay(np.arange(self.lab.worlds), self._latency)
        self.loop.fresh(self._every, prefill=True)
        self.loop.anchor(self._every)
        action = self.loop.action
        action.copy_(self.tables.actions[0].index_select(0, self._cell))
        action[:, :2] = 0.0

    def _pose(self) -> torch.Tensor:
        """Measured x, y and heading of the robots [m, rad], shape [worlds, 3]."""
        lab, at = self.lab, self.lab.root_q
        return torch.cat([lab.qpos[:, at : at + 2], heading(lab.qpos[:, at + 3 : at + 7])[:, None]], dim=1)

    def _begin(self) -> None:
        """Kick the robots and start references and measures where they are now."""
        self.lab.physics.add_velocity(self.plan.noise["kick"])
        self.loop.anchor(self._every)
        self.meter.anchor(self.loop.targets, self._position)
        if self._goals is not None:
            self._goals.begin(self._pose())

    def tick(self, tick: int) -> None:
        """Advance every world by one tick; `tick` counts from the start of the references, the start-up is negative."""
        lab, loop = self.lab, self.loop
        if tick == 0:
            self._begin()
        if tick >= 0:
            torch.index_select(self.tables.actions[tick], 0, self._cell, out=loop.action)
            if self._goals is not None:
                self._goals.write(self._pose(), loop.action)
            if loop.lookahead:
                loop.announce(self._coming(tick))
            if self._blows is not None:
                lab.forces.zero_()
            if self._forces.any:
                lab.force.copy_(self._forces.at(tick, self._pose()[:, 2]))
            if self._blows is not None:
                self._blows.add(tick, lab.forces)
        targets = loop.tick(loop.action, self._every)
        lab.physics.step()
        links = self.tables.links[max(tick, 0)].index_select(0, self._cell)
        reference = TickReference(self._position, loop.command.quat, loop.command.joints, links)
        live = self.meter.update(tick, reference, targets)
        if lab.engine == "mujoco":  # spare the CPU ended worlds; on CUDA the answer would wait for the device
            lab.physics.set_active(live.numpy())

    def _coming(self, tick: int) -> torch.Tensor:
        """Actions after a tick's, shape [worlds, n, 40]; NaN in the worlds of a goal, which decide tick by tick."""
        coming = self.tables.actions[tick + 1 : tick + 1 + self.loop.lookahead].index_select(1, self._cell)
        if self._goals is not None:
            coming[:, self._goals.rows] = torch.nan
        return coming.transpose(0, 1)

    def outcome(self) -> Outcome:
        """The measures; the one transfer from the device."""
        measures = self.meter.results()
        measures["support_x"] = _support_x(self.start)
        if self._goals is not None:
            _add_goals(measures, self.plan)
        return Outcome(
            measures=measures,
            overflows=self.lab.overflows(),
            ticks=self.ticks + self.startup_ticks,
            engine=self.lab.engine,
            device=str(self.lab.device),
            rate=self.rate,
            setup_s=self.setup_s,
            rollout_s=time.perf_counter() - self._began,
            errors=None if self._blows is None else self.meter.errors.cpu().numpy(),
        )


@torch.inference_mode()
def play(
    tracker: Tracker,
    plan: Plan,
    *,
    fast_physics: bool = False,
    observer: Callable[[Lab, int], None] | None = None,
    **settings: Unpack[Settings],
) -> Outcome:
    """Play a plan with a tracker that is not bound yet.

    After every tick `observer(lab, tick)` is called, for films.
    """
    rollout = SuiteRollout(tracker, plan, fast_physics=fast_physics, **settings)
    rollout.prepare()
    for tick in range(-rollout.startup_ticks, rollout.ticks):
        rollout.tick(tick)
        if observer is not None:
            observer(rollout.lab, tick)
    return rollout.outcome()


def _support_x(start: Start) -> np.ndarray:
    """Position of each world's support along x [m], NaN without one, shape [worlds]."""
    out: np.ndarray = np.full(len(start.root), np.nan)
    for pose in start.supports.values():
        out = np.where(np.isfinite(pose[:, 0]), pose[:, 0], out)
    return out


def _add_goals(measures: dict[str, np.ndarray], plan: Plan) -> None:
    """Errors at the end of the worlds that have a goal."""
    goals = [plan.cells[i].goal for i in plan.cell]
    wanted = np.array([(g.x, g.y, g.yaw) if g is not None else (np.nan,) * 3 for g in goals])
    offset = np.stack([measures["end_x"], measures["end_y"]], axis=1) - wanted[:, :2]
    turn = measures["end_yaw"] - wanted[:, 2]
    # The reference of a goal follows the robot, so that the distance between them is not an error.
    for name in ("drift", "drift_10s", "heading_error", "velocity_error"):
        measures[name] = np.where(np.isfinite(wanted[:, 0]), np.nan, measures[name])
    measures["goal_distance"] = np.linalg.norm(offset, axis=1)
    measures["goal_turn"] = np.degrees(np.abs((turn + np.pi) % (2 * np.pi) - np.pi))
