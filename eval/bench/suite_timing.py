"""``eval matrix --estimate``: measure a few cells of each kind on this machine, and say how long the suite takes.

Each measured cell is played as `eval run` plays it, in a folder that is removed: with one batch of worlds at two short
step budgets, whose difference is the time of a tick. With --ray two processes and then one play as much each, to
see what a second GPU costs the first.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from arena_newton import doctor, rule_sets
from arena_newton.cli.quiet import quiet_warp
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench.bench_policy import random_checkpoint
from arena_newton.eval.bench.suite_estimate import (
    CellSize,
    DeviceTime,
    MeasuredCell,
    Slowdown,
    SuiteTime,
    drawn,
    suite_time,
)
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import RunConfig, resolve
from arena_newton.eval.plan.options import Ray, flags_of
from arena_newton.eval.play.lasting_env import EnvironmentKeeper
from arena_newton.eval.play.run import Factories, execute
from arena_newton.eval.reports.wording import markdown_table
from arena_newton.eval.suites.matrix_cells import check_policies, run_options
from arena_newton.eval.suites.suite_call import SuiteCall
from arena_newton.eval.suites.suite_records import SuiteCell
from arena_newton.eval.workers.slice_player import device_name
from arena_newton.files.text import counted, plain_text

__all__ = ["run"]

EACH = 2
"""Measured cells of each kind."""
TICKS = {True: (60, 180), False: (20, 60)}
"""Step budgets that are played, with CUDA and without; multiples of the 20 actions that a chunk usually has."""
CPU_WORLDS = 2
"""Worlds without CUDA, where a tick of a batch costs as much as its worlds one after the other."""
ROUNDS = 3
"""Rounds of one process and of two, after one that is not counted."""
STAND_INS = {True: ("act", "diffusion", "flow", "pi05"), False: ("act", "diffusion", "flow")}
"""Families of which random weights are made where a checkpoint is absent, with CUDA and without: π0.5's are 7 GB, and a
look of it takes minutes on a CPU."""


def run(call: SuiteCall, factories: Factories | None = None) -> int:
    """Measure and print.

    Returns:
        Exit code 0.

    Raises:
        InputError: A condition is wrong, or no cell can be measured.
    """
    quiet_warp()
    with tempfile.TemporaryDirectory() as folder:
        print("\n".join(_Timing(call, factories, Path(folder)).lines()), flush=True)
    return 0


class _Timing:
    """One estimate."""

    def __init__(self, call: SuiteCall, factories: Factories | None, folder: Path):
        self.call, self.suite, self.options = call, call.suite, call.options
        self.given, self.folder = factories, folder
        self.keeper = EnvironmentKeeper()
        self.factories = factories or Factories(env=self.keeper)
        self.installed = doctor.versions()
        self.cells = {cell.id: cell for cell in call.cells if cell.id in set(call.chosen)}
        self.specs: dict[str, str] = {}
        """What is played instead of an absent checkpoint, by family; an empty text where nothing is."""
        self.replaced: set[str] = set()
        """Families of which cells were measured with random weights."""
        self.left_out: dict[str, str] = {}
        """Families, or policies without one, that were not measured, and why."""
        self.plays = 0
        self.cuda = False

    def lines(self) -> list[str]:
        """Measure, and say what came of it."""
        first = next(iter(self.cells.values()))
        self.cuda = cuda = self._config(first, "stand", 1, 1).device.startswith("cuda")
        worlds = {name: self._worlds(cell, cuda) for name, cell in self.cells.items()}
        sizes = [self._size(cell, worlds[name]) for name, cell in self.cells.items()]
        measured = self._measured(drawn(sizes, EACH), worlds, TICKS[cuda])
        if not measured:
            causes = "; ".join(f"{name}: {cause}" for name, cause in self.left_out.items())
            raise InputError(f"{self.suite.path}: no cell can be measured: {causes}")
        kinds = {one.size.kind for one in measured}
        known = [size for size in sizes if size.kind in kinds]
        slowdown = None if self.options.ray is None else self._slowdown(measured[0], worlds, TICKS[cuda][1])
        processes = tuple(dict.fromkeys(self.options.estimate or (1, 2, 8)))
        found = suite_time(known, measured, processes, slowdown)
        device = device_name("cuda:0" if cuda else "cpu")
        return self._told(sizes, known, measured, found, slowdown, device, TICKS[cuda], worlds)

    # What is played

    def _worlds(self, cell: SuiteCell, cuda: bool) -> int:
        wanted = min(run_options(self.suite, cell, self.folder).worlds, cell.episodes)
        return wanted if cuda else min(wanted, CPU_WORLDS)

    def _size(self, cell: SuiteCell, worlds: int) -> CellSize:
        batches, startup = math.ceil(cell.episodes / worlds), rule_sets.get(cell.rules).startup.ticks
        ticks = batches * (startup + cell.ticks // cell.episodes)
        return CellSize(cell.id, (cell.family or cell.policy, cell.mode), (cell.task, cell.tracker, cell.mode), ticks)

    def _config(self, cell: SuiteCell, policy: str, episodes: int, ticks: int, **changes: object) -> RunConfig:
        """A run of so many episodes of a cell, all at once, which end after so many ticks."""
        self.plays += 1
        options = run_options(self.suite, cell, self.folder, self.options.device)
        wanted = {"policy": policy, "seeds": (0,), "repeats": episodes, "worlds": episodes, "max_steps": ticks}
        wanted |= {"out": str(self.folder / f"run{self.plays}")} | changes
        return resolve(dataclasses.replace(options, **wanted))  # type: ignore[arg-type]  # each is of its flag's kind

    def _spec(self, cell: SuiteCell) -> str:
        """What a cell is measured with.

        Raises:
            InputError: Its checkpoint is absent, and none can be made.
        """
        try:
            check_policies(self.suite, [cell])
        except InputError as error:
            family = cell.family
            if family not in self.specs:
                self.specs[family] = self._made(family)
            if not self.specs[family]:
                raise error
            self.replaced.add(family)
            return self.specs[family]
        return cell.spec

    def _made(self, family: str) -> str:
        """A checkpoint of random weights; an empty text where none can be made."""
        if family not in STAND_INS[self.cuda]:
            return ""
        with contextlib.suppress(ArenaError):
            return f"lerobot:{random_checkpoint(self.folder / family, family=family)}"
        return ""

    # Measured

    def _measured(
        self, sample: Sequence[CellSize], worlds: Mapping[str, int], ticks: tuple[int, int]
    ) -> list[MeasuredCell]:
        found: list[MeasuredCell] = []
        try:
            for number, size in enumerate(sample, 1):
                cell = self.cells[size.name]
                try:
                    one = self._measure(cell, size, worlds[size.name], ticks, warm=bool(found))
                except ArenaError as error:
                    self.left_out.setdefault(size.kind[0], plain_text(f"{error}", 200))
                    continue
                found.append(one)
                print(f"[{number}/{len(sample)}] {size.name}: about {_time(one.seconds)}", flush=True)
        finally:
            self.keeper.drop()
        return found

    def _measure(
        self, cell: SuiteCell, size: CellSize, worlds: int, ticks: tuple[int, int], *, warm: bool
    ) -> MeasuredCell:
        spec = self._spec(cell)
        if not warm:  # kernels are compiled, libraries loaded
            self._seconds(cell, spec, worlds, ticks[0])
            self.keeper.drop()
        cold, short, long = (self._seconds(cell, spec, worlds, n) for n in (ticks[0], ticks[0], ticks[1]))
        per_tick = max(0.0, long - short) / (ticks[1] - ticks[0])
        startup = rule_sets.get(cell.rules).startup.ticks
        fixed = max(0.0, short - per_tick * (startup + ticks[0]))
        return MeasuredCell(size, fixed + per_tick * size.ticks, max(0.0, cold - short))

    def _seconds(self, cell: SuiteCell, spec: str, worlds: int, ticks: int) -> float:
        config = self._config(cell, spec, worlds, ticks)
        folder = ResultsFolder(Path(str(config.flags.out)), config, self.installed)
        began = time.perf_counter()
        quiet = io.StringIO()
        with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
            if execute(folder, self.factories) == 130:
                raise KeyboardInterrupt
        return time.perf_counter() - began

    def _slowdown(self, one: MeasuredCell, worlds: Mapping[str, int], ticks: int) -> Slowdown | None:
        """Rounds of one process and of two, each of which plays as much; None where there is no room for two."""
        from arena_newton.eval.workers.ray_run import round_seconds

        cell = self.cells[one.size.name]
        spec, flags = self._spec(cell), {name: getattr(self.options, name) for name in flags_of(Ray)}
        rounds: dict[int, tuple[float, ...]] = {}
        for number in (2, 1):  # first two: there may be no room for them
            count = worlds[cell.id] * number
            wanted = {**flags, "ray_actors": number, "worlds": worlds[cell.id]}
            folders = []
            for _ in range(ROUNDS + 1):
                config = self._config(cell, spec, count, ticks, **wanted)
                folders.append(ResultsFolder(Path(str(config.flags.out)), config, self.installed))
            with contextlib.redirect_stdout(io.StringIO()):
                seconds = round_seconds(folders, number, self.given)
            if seconds is None:
                return None
            rounds[number] = tuple(seconds[1:])
        return Slowdown(alone=rounds[1], pair=rounds[2])

    # Said

    def _told(
        self,
        sizes: Sequence[CellSize],
        known: Sequence[CellSize],
        measured: Sequence[MeasuredCell],
        found: SuiteTime,
        slowdown: Slowdown | None,
        device: str,
        ticks: tuple[int, int],
        worlds: Mapping[str, int],
    ) -> list[str]:
        many = sorted({worlds[one.size.name] for one in measured})
        batch = counted(many[0], "world") if len(many) == 1 else f"{many[0]} to {many[-1]} worlds"
        rows = []
        for kind, rate in found.rates.items():
            mine = [size for size in known if size.kind == kind]
            sample = sum(one.size.kind == kind for one in measured)
            each = _time(rate * sum(size.ticks for size in mine) / len(mine))
            rows.append([*kind, str(len(mine)), str(sample), f"{1 / rate:.1f}" if rate else "–", each])
        head = ["policy", "mode", "cells", "measured", "ticks/s", "a cell"]
        lines = ["", markdown_table(head, sorted(rows), 2).rstrip()]
        lines.append(
            f"measured on {device}: {counted(len(measured), 'cell')} with {batch}, {ticks[0]} and {ticks[1]} ticks; "
            "extrapolated to the step budgets: episodes that succeed or fall take less"
        )
        if self.replaced:
            names = " ".join(sorted(self.replaced))
            lines.append(f"random weights of recipe fast where checkpoints are absent: {names}")
        lines.append(f"environments: {_time(found.building)} in all, each built once")
        if slowdown is not None:
            low, high = slowdown.range
            lines.append(
                f"two processes at once take {slowdown.ratio:.2f} times as long as one alone ({low:.2f} to {high:.2f}, "
                f"{ROUNDS} rounds each, {measured[0].size.name})"
            )
        times = [
            [str(one.devices), _basis(one, slowdown), _time(one.seconds), f"{_time(one.low)} to {_time(one.high)}"]
            for one in found.on
        ]
        lines += ["", markdown_table(["processes", "how it is known", "time", "95 %"], times, 2).rstrip()]
        for name, cause in self.left_out.items():
            number = sum(size.kind[0] == name and size not in known for size in sizes)
            if number:
                lines.append(f"not in it: {counted(number, 'cell')} of {name}: {cause}")
        return lines


def _time(seconds: float) -> str:
    """A length of time to three digits."""
    unit, name = (1.0, "s") if seconds < 90 else (60.0, "min") if seconds < 5400 else (3600.0, "h")
    return f"{seconds / unit:.3g} {name}"


def _basis(one: DeviceTime, slowdown: Slowdown | None) -> str:
    """What of a time was measured, and what follows by an assumption."""
    if one.devices == 1:
        return "measured cells"
    if slowdown is None:
        return "assumes that processes do not slow each other (--ray measures two)"
    return "measured cells, two at once measured" if one.devices == 2 else "each more slows as the second does"
