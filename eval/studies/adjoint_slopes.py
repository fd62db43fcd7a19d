"""Slopes of an episode's margin to its placements, masses, friction and gains, from one backward run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch

from arena_newton.differentiable import EngineState, EngineStep, closed_loop, reach
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run import make_env
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.studies.placed_play import PlacedWorlds
from arena_newton.eval.studies.placement_files import SLOPES, PlacedStudy, summary_json
from arena_newton.eval.studies.placement_options import PlacementOptions
from arena_newton.pages.tables import Table, csv_lines
from arena_newton.physics.devices import torch_threads
from arena_newton.tasks.handles import ROBOT

__all__ = ["KINDS", "Slope", "groups", "play_slopes", "slope_head", "worth"]

FORMAT = 1
"""Version of slopes.json."""
CHECKPOINT = 25
"""Ticks that the graph keeps the start of."""
STEP = 1e-2
"""Move of a placement that gives the slope of the start pose in it [m, rad]; what is moved are float32 numbers."""
NOTHING = 1e-9
"""Slope and differences below which a number moves nothing [m per unit]: rounding of the margin alone is left."""
HOLDS, VOID, FIXTURE = "holds", "means nothing at these scales", "no slope: a fixture"
MULTIPLIED = "chaotic: the episode multiplies the smallest change"
UNTOUCHED = "no influence: nothing that it moves reaches the margin"
KINDS = {
    HOLDS: "slopes that hold",
    VOID: "void slopes, not to be followed",
    MULTIPLIED: "void slopes, not to be followed",
    UNTOUCHED: "no influence",
    FIXTURE: "no slope, differences alone",
}
"""Group of each worth, in the order in which they are told."""
CHAOTIC = 100.0
"""Change of the margin within the smaller scale above which a motion is chaotic [m]: no scene is so wide."""


@dataclass(frozen=True)
class Slope:
    """Slope of the margin to one number."""

    name: str
    unit: str
    """Unit of the number; empty for a factor."""
    slope: float | None
    """Exact slope of the played actions [m per unit]; None where nothing moves that has one."""
    near: float
    """Differences of the same actions at the smaller scale; not finite where a world fell."""
    far: float
    """The same at the larger one."""
    grid: float | None
    """Differences at the larger scale in which the policy acts again, at each episode's end; None for a factor."""
    verdict: str
    """Worth of the slope in words, of `KINDS`."""

    def cells(self) -> tuple[str, ...]:
        """Its row under `slope_head`."""
        numbers = map(_text, (self.slope, self.near, self.far, self.grid))
        return (self.name, f"m/{self.unit}".rstrip("/"), *numbers, self.verdict)


def play_slopes(
    options: PlacementOptions, scales: Sequence[float], worlds: PlacedWorlds, folder: Path, factories: Factories
) -> list[str]:
    """Play an episode, differentiate it and compare; writes slope_episodes.csv, slopes.csv and slopes.json.

    Returns:
        Lines to print.

    Raises:
        InputError: The episode fell or had an error, or engine, tracker or mode have no gradient.
    """
    axes = worlds.axes
    seed = worlds.config.episodes[0].episode_seed
    drawn = worlds.drawn(seed)
    at = tuple(float(drawn[axis.record][axis.key]) for axis in axes)
    points = [at, *(tuple(_shifted(at, number, side * scales[1])) for number in range(len(at)) for side in (1, -1))]
    with PlacedStudy(worlds, folder, len(points), SLOPES, method="adjoint", reach=list(scales)) as study:
        played, *others = study.play(points)
    if played.outcome not in ("success", "timeout"):
        raise InputError(
            f"--method adjoint: the episode ended by {played.reason} after {played.steps} ticks, across which a slope "
            "has no meaning; choose another --seed, or --max-steps before it"
        )
    grid = [(a.margin - b.margin) / (2.0 * scales[1]) for a, b in zip(others[::2], others[1::2], strict=True)]
    env = cast("ArenaEnv", make_env(worlds.config, factories, worlds.config.episodes[0], 1))
    try:
        with torch_threads(1):  # as `closed_loop` does, for the gradient
            found, answers = _slopes(_Moved(env, worlds, seed, at), played.steps, scales, grid)
    finally:
        env.close()
    head = slope_head(scales)
    cells = [one.cells() for one in found]
    write_atomic(folder / "slopes.csv", csv_lines([head, *cells]))
    lines = [f"{played.outcome} after {played.steps} ticks; slopes of the margin then, of what was played"]
    if not answers:
        lines.append("the policy's actions are constants: what it would answer shows in the column `policy acts again`")
    lines += groups(found)
    rows = [{key: value if value == value else None for key, value in vars(one).items()} for one in found]
    described = [dataclasses.asdict(axis) | {"name": axis.name, "value": v} for axis, v in zip(axes, at, strict=True)]
    ended = {"outcome": played.outcome, "ticks": played.steps, "policy_has_gradient": answers, "summary": lines}
    write_atomic(folder / "slopes.json", summary_json(FORMAT, options, described, slopes=rows, **ended))
    return [*lines, Table(head, cells).markdown()]


def slope_head(scales: Sequence[float]) -> tuple[str, ...]:
    """Head of the table of slopes."""
    return ("number", "unit", "slope", *(f"differences at {scale:g}" for scale in scales), "policy acts again", "worth")


def groups(slopes: Sequence[Slope]) -> list[str]:
    """Names of the numbers whose slopes hold, of those whose slopes are void, and of those without influence."""
    by_kind: dict[str, list[str]] = {}
    for one in slopes:
        by_kind.setdefault(KINDS[one.verdict], []).append(one.name)
    return [f"{kind}: {', '.join(by_kind[kind])}" for kind in dict.fromkeys(KINDS.values()) if kind in by_kind]


@dataclass(frozen=True)
class _Moved:
    """Episodes whose placements are moved, in one world."""

    env: ArenaEnv
    worlds: PlacedWorlds
    seed: int
    at: tuple[float, ...]
    """Placements of the seed."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Factors of the model that every scene has, and the masses of what moves freely."""
        free = [one.prim for one in self.env.spec.objects if not self.env.scene.has_body(f"{one.prim}/Frame")]
        return ("friction", f"mass:{ROBOT}", *(f"mass:{prim}" for prim in free), "kp", "kd")

    def start(self, values: Sequence[float]) -> EngineState:
        """State of the reset with placements at these values."""
        self.env.reset([self.seed], samples=[self.worlds.sampled(self.seed, values)])
        return EngineStep(self.env.physics).state()


def _slopes(moved: _Moved, ticks: int, scales: Sequence[float], grid: Sequence[float]) -> tuple[list[Slope], bool]:
    """Slopes to all axes and parameters, and whether the policy's answers are part of them."""
    env, axes, parameters = moved.env, moved.worlds.axes, moved.parameters
    start = moved.start(moved.at)
    qpos = start.qpos.clone().requires_grad_()
    begun = start._replace(qpos=qpos)
    policy, seeds = moved.worlds.policy, [moved.seed]
    rolled = closed_loop(env, policy, seeds, ticks, parameters=parameters, start=begun, checkpoint=CHECKPOINT)
    at_qpos, at_factors = torch.autograd.grad(rolled.margin[-1, 0], (qpos, rolled.factors))
    plan = rolled.actions.detach().transpose(0, 1)
    exact: list[float | None] = []
    for number in range(len(axes)):
        ends = [moved.start(_shifted(moved.at, number, side * STEP)).qpos for side in (1, -1)]
        way = (ends[0] - ends[1]) / (2.0 * STEP)
        exact.append(float((at_qpos * way).sum()) if way.any() else None)
    exact += at_factors[0].tolist()

    def margins(points: torch.Tensor) -> torch.Tensor:
        values, factors = points[0].tensor_split([len(axes)])
        begin = moved.start(values.tolist())
        found = closed_loop(env, plan, seeds, ticks, parameters=parameters, factors=factors[None], start=begin)
        return found.margin[-1]

    at = torch.tensor([*moved.at, *[1.0] * len(parameters)], dtype=torch.float64)
    known = torch.tensor([math.nan if one is None else one for one in exact], dtype=torch.float64)
    found = reach(margins, at, known, (scales[0], scales[1]), rows=1)
    names = [(axis.name, axis.unit) for axis in axes] + [(name, "") for name in parameters]
    acted = [*grid, *[None] * len(parameters)]
    return [
        Slope(name, unit, one, near, far, again, worth(one, near, far, holds, scales[0]))
        for (name, unit), one, near, far, again, holds in zip(
            names, exact, found.near.tolist(), found.far.tolist(), acted, found.holds.tolist(), strict=True
        )
    ], rolled.answers


def worth(slope: float | None, near: float, far: float, holds: bool, scale: float) -> str:
    """Worth of a slope in words: whether differences hold it, and whether its size within `scale` fits in a scene."""
    if slope is None:
        return FIXTURE
    if max(abs(slope), abs(near), abs(far)) < NOTHING:
        return UNTOUCHED
    if not holds and abs(slope) * scale > CHAOTIC:
        return MULTIPLIED
    return HOLDS if holds else VOID


def _shifted(at: Sequence[float], number: int, change: float) -> list[float]:
    return [value + change * (n == number) for n, value in enumerate(at)]


def _text(value: float | None) -> str:
    if value is None:
        return "-"
    if not math.isfinite(value):
        return "fell"
    return f"{value:+.4f}" if abs(value) < 1e6 else f"{value:+.2e}"
