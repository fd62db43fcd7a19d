"""Cells of the tracker suite: each a reference, the world that it is tracked in, and a number of rollouts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from arena_newton.robot.canonical import ACTION, ACTION_WIDTH, STAND_ACTION
from arena_newton.robot.g1 import FEET, TICK
from arena_newton.robot.rotations import heading, quat_apply, quat_from_yaw
from arena_newton.trackers.evaluation.meter import LINKS
from arena_newton.trackers.motions.formats import read_library
from arena_newton.trackers.motions.frames import actions_to_motion, motion_actions
from arena_newton.trackers.motions.generator import ReferenceGenerator
from arena_newton.trackers.motions.kinematics import forward, link_index
from arena_newton.trackers.motions.playback import startup_actions
from arena_newton.trackers.motions.primitives import Program, Script

__all__ = ["Ball", "Blows", "Cell", "Navigation", "Placed", "Push", "Tables", "clip_cells", "tabulate"]

BLEND = 1.0
"""Time from standing to a clip's first pose [s]."""


@dataclass(frozen=True)
class Placed:
    """A support in front of or behind the robot, which starts at the origin and faces +x."""

    name: str
    """`Seat`, `Sill` or `Platform`."""
    height: float
    """Height of its top [m]."""
    x: float | None = None
    """Centre [m]; None: where the reference's feet step over a sill with the most clearance, or tread on a platform."""


@dataclass(frozen=True)
class Ball:
    """Position of the ball, drawn per rollout."""

    distance: tuple[float, float]
    """Least and largest distance in front of the ankles [m]."""
    lateral: float
    """Offset to the left of the robot's middle [m]."""
    spread: float = 0.01
    """Uniform error of the lateral position [m]."""


@dataclass(frozen=True)
class Push:
    """A force on the chest."""

    newtons: float
    """Size [N]."""
    start: tuple[float, float]
    """Earliest and latest begin [s], drawn per rollout."""
    seconds: float
    """Duration [s]."""
    backward: bool = False
    """Against the robot's heading; otherwise in any direction, drawn per rollout."""


@dataclass(frozen=True)
class Blows:
    """One short force in each segment of a reference, on a drawn link of the robot in a drawn direction."""

    newtons: float
    """Size, or the largest one where it is drawn [N]."""
    segments: int
    """Number of blows."""
    spacing: float = 5.0
    """Length of a segment [s]."""
    begin: tuple[float, float] = (0.1, 2.0)
    """Earliest and latest begin within a segment [s], drawn for each blow."""
    seconds: float = 0.08
    """Duration [s]."""
    ramp: bool = False
    """Draw each from half of a bound to the bound, which climbs in equal steps from a third of `newtons`, and would be
    `newtons` at one blow more."""


@dataclass(frozen=True)
class Navigation:
    """A goal reached in closed loop; the goals of a suite are drawn once, from the seed."""

    x: float
    """[m]"""
    y: float
    """[m]"""
    yaw: float
    """[rad]"""


@dataclass(frozen=True)
class Cell:
    """One row of the tables."""

    name: str
    """Its name in tables."""
    group: str
    """Primitive or condition that it tests."""
    seconds: float
    """Length after the start-up [s]."""
    script: Script | None = None
    """Commands of the reference generator."""
    actions: np.ndarray | None = field(default=None, repr=False, compare=False)
    """Canonical actions instead, shape [ticks, 40]."""
    goal: Navigation | None = None
    """A goal instead."""
    friction: float = 1.0
    payload: float = 0.0
    """Mass in each hand [kg]."""
    support: Placed | None = None
    ball: Ball | None = None
    push: Push | None = None
    blows: Blows | None = None
    latency: int = 0
    """Age of the state that the tracker gets, and lateness of its joint targets [ticks]."""
    window: float = 2.0
    """Mean speeds are taken from here on [s]."""
    rollouts: int | None = None
    """Instead of the suite's number."""

    @property
    def ticks(self) -> int:
        """Length [ticks]."""
        return round(self.seconds / TICK)


@dataclass
class Tables:
    """References of all cells by tick, on the device; cells that have ended hold their last frame."""

    actions: torch.Tensor
    """[ticks, cells, 40]."""
    links: torch.Tensor
    """Reference of `meter.LINKS` relative to the root in its heading frame [m], [ticks, cells, links, 3]."""
    feet: torch.Tensor
    """Ankle frames of the nominal reference in the world [m], [ticks, cells, 2, 3]."""


def clip_cells(paths: list[Path]) -> list[Cell]:
    """One cell per clip: files in any format that `motions.formats` reads, or motion libraries.

    Raises:
        InputError: A file is missing or cannot be used.
    """
    if not paths:
        return []
    library, _ = read_library(paths)
    cells = []
    for clip in range(library.clips):
        rows = library.rows(clip)
        arrays = (library.root_pos, library.root_quat, library.joint_pos, library.hands)
        parts = (torch.as_tensor(array[rows], dtype=torch.float32) for array in arrays)
        actions = motion_actions(*parts).numpy()
        whole = np.concatenate([startup_actions(actions[0], stand=0.2, blend=BLEND), actions])
        name = f"clip {library.clip_names[clip]}"
        cells.append(Cell(name, "clip", len(whole) * TICK, actions=whole, window=BLEND + 0.2))
    return cells


def tabulate(cells: list[Cell], device: torch.device) -> Tables:
    """Roll out every cell's reference; cells with a goal stand here and get their actions in closed loop later."""
    ticks = max(cell.ticks for cell in cells)
    actions = torch.empty(ticks, len(cells), ACTION_WIDTH, device=device)
    actions[:] = torch.as_tensor(STAND_ACTION, device=device)
    programs = [i for i, cell in enumerate(cells) if cell.script is not None]
    if programs:
        actions[:, programs] = _generate([cells[i] for i in programs], ticks, device)
    for i, cell in enumerate(cells):
        if cell.actions is not None:
            actions[: len(cell.actions), i] = torch.as_tensor(cell.actions, device=device)
        if cell.goal is None:
            # A finished cell holds its last frame without displacement.
            actions[cell.ticks :, i] = actions[cell.ticks - 1, i].clone()
            actions[cell.ticks :, i, ACTION["root_xy_delta"]] = 0.0
    motion = actions_to_motion(actions.transpose(0, 1))
    links, feet = [], []
    for block in range(0, ticks, 256):
        part = [a[:, block : block + 256] for a in (motion.root_pos, motion.root_quat, motion.joint_pos)]
        poses = forward(*part).position
        level = quat_from_yaw(-heading(part[1]))[..., None, :]
        offset = poses[..., [link_index(n) for n in LINKS], :] - part[0][..., None, :]
        links.append(quat_apply(level, offset).transpose(0, 1))
        feet.append(poses[..., [link_index(n) for n in FEET], :].transpose(0, 1))
    return Tables(actions, torch.cat(links), torch.cat(feet))


def _generate(cells: list[Cell], ticks: int, device: torch.device) -> torch.Tensor:
    program = Program([cell.script for cell in cells if cell.script is not None], device)
    generator = ReferenceGenerator(len(cells), device)
    out = []
    for tick in range(ticks):
        generator.step(program(tick * TICK))
        out.append(generator.action().clone())
    return torch.stack(out)
