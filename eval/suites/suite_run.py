"""Play a suite: check all its cells, then run what is missing, each cell as an ordinary results folder.

Cells that differ in their mode alone play in one batch of worlds where their modes have one scene.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import time
from collections.abc import Iterator, Sequence

from arena_newton import doctor, rule_sets, tasks
from arena_newton.cli.flags import shell_command
from arena_newton.cli.quiet import quiet_warp
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.folders.joined_folders import JoinedFolders
from arena_newton.eval.folders.run_folder import ResultsFolder, setting, timestamp
from arena_newton.eval.plan.config import RunConfig, resolve
from arena_newton.eval.plan.options import Workers, flags_of
from arena_newton.eval.play.env_cache import EnvCache
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run import RunStopped, execute
from arena_newton.eval.records.document import SUITE_FILE
from arena_newton.eval.records.journal import StorageError
from arena_newton.eval.reports.progress import duration
from arena_newton.eval.suites.matrix_cells import matrix_table, run_options
from arena_newton.eval.suites.suite_call import SuiteCall
from arena_newton.eval.suites.suite_file import SuiteFile
from arena_newton.eval.suites.suite_folder import SuiteFolder
from arena_newton.eval.suites.suite_options import MatrixOptions
from arena_newton.eval.suites.suite_records import CellEnding, CellEvent, SuiteCell
from arena_newton.eval.workers.batch_player import device_name
from arena_newton.files.text import counted, plain_text
from arena_newton.rules.seeding import policy_seed

__all__ = ["CellPlayer", "run"]

CHECKED_POLICIES = ("expert", "stand", "replay")
"""Policies that are made before the first cell to be checked; others take seconds and memory, or a server."""
OF_CODE = ("version", "code", "scenes")
"""Parts of a run's identity that another version of the product changes."""
OF_PARTS = ("tracker_facts", "policy_facts", "worlds", "labels")
"""Parts that are known only when tracker and policy were made."""


def run(call: SuiteCall, factories: Factories | None = None) -> int:
    """Play the cells of a call.

    Returns:
        Exit code: 0 when all cells that this call was to play are done, 1 when cells failed under --keep-going or
        episodes ended as errors, 130 when interrupted.

    Raises:
        InputError: A condition, a policy or the folder is wrong; raised before the first cell.
        RunStopped: A cell could not be played.
        StorageError: The folder cannot be written.
    """
    suite = call.suite
    folder = SuiteFolder(call.out, suite, *call.shard)
    with folder.locked(call.cells):
        return CellPlayer(suite, folder, call.options, factories, again=call.again).play(call.chosen)


class CellPlayer:
    """One call: what all its cells share. It plays one batch of cells after the other."""

    def __init__(
        self, suite: SuiteFile, folder: SuiteFolder, options: MatrixOptions, factories: Factories | None, *, again: str
    ):
        self.suite, self.folder, self.options, self.again = suite, folder, options, again
        self.env_cache = EnvCache()
        self.given = factories
        self.factories = factories or Factories(env=self.env_cache)
        self.installed = doctor.versions()
        self.configs: dict[str, RunConfig] = {}
        self.devices: dict[str, str] = {}
        """Devices on which the cells of this call are played."""
        self.failed: list[tuple[str, str]] = []
        self.spent = self.done_ticks = 0.0

    def play(self, chosen: Sequence[str]) -> int:
        """Check the chosen cells and play those that are not done."""
        quiet_warp()
        todo = self._check(chosen)
        cells = [cell for cell in self.folder.plan.cells if cell.id in set(chosen)]
        print(f"suite {self.suite.name} -> {self.folder.path}\n{matrix_table(cells)}", flush=True)
        if self.options.limit is not None:
            todo = todo[: self.options.limit]
        self._measure_before(cells)
        try:
            whole = self.play_cells(self._joined(todo))
        except KeyboardInterrupt:  # as a cell begins or ends
            whole = False
        if not whole:
            print(f"\ninterrupted; {self._kept(chosen)}; continue with: {self.again}", flush=True)
            return 130
        return self._end(chosen)

    def _joined(self, todo: Sequence[str]) -> list[tuple[str, ...]]:
        """Cells by what plays at once: those that differ in their mode alone, where their modes have one scene."""
        found: dict[object, tuple[str, ...]] = {}
        for name in todo:
            cell, flags = self.folder.plan.cell(name), dataclasses.replace(self.configs[name].flags, mode=(), out=None)
            alike = cell.policy, cell.trained_on, flags, self.scene(name)
            found[alike] = (*found.get(alike, ()), name)
        return list(found.values())

    def scene(self, name: str) -> str:
        """Name of the scene of a cell's task in its mode."""
        cell = self.folder.plan.cell(name)
        return tasks.get(cell.task).scene_name(cell.mode, rule_sets.get(cell.rules))

    def play_cells(self, todo: Sequence[tuple[str, ...]]) -> bool:
        """Play cells that were checked, each tuple of them at once; False when it was interrupted."""
        try:
            return all(self._play_joined(names, number, todo) for number, names in enumerate(todo))
        finally:
            self.env_cache.drop()

    def _kept(self, chosen: Sequence[str]) -> str:
        done = sum(self.folder.plan.cell(name).status == "done" for name in chosen)
        return f"{done} of {counted(len(chosen), 'cell')} done"

    # Checks

    def _check(self, chosen: Sequence[str]) -> list[str]:
        """Check every chosen cell with its folder, before anything is played.

        Returns:
            Ids of the cells to play.
        """
        for name in chosen:
            cell = self.folder.plan.cell(name)
            options = run_options(self.suite, cell, self.folder.path, self.options.device)
            given = {flag: getattr(self.options, flag) for flag in ("retry_errors", *flags_of(Workers))}
            try:
                self.configs[name] = resolve(dataclasses.replace(options, **given))
            except InputError as error:
                raise InputError(f"{self.suite.path}: cell {name}: {error}") from None
        self._check_parts(chosen)
        again = self._changed(chosen)
        for name in again:
            print(f"  {name}: is played again, what it held is in {self.folder.set_aside(name)}", flush=True)
        todo = []
        for name in chosen:
            if self._is_done(name):
                continue
            todo.append(name)
            try:
                self.results(name).check()
            except InputError as error:
                raise InputError(f"cell {name}: {error}") from None
        self.folder.configured({name: config.hash for name, config in self.configs.items()})
        return todo

    def results(self, name: str) -> ResultsFolder:
        """Results folder of a cell that was checked."""
        return ResultsFolder(self.folder.cell_path(name), self.configs[name], self.installed)

    def results_of(self, names: Sequence[str]) -> ResultsFolder:
        """Results folder of cells that are played at once."""
        parts = [self.results(name) for name in names]
        return parts[0] if len(parts) == 1 else JoinedFolders(parts)

    def _check_parts(self, chosen: Sequence[str]) -> None:
        """Make each tracker, and each policy that is made quickly, once."""
        made: set[tuple[str, str]] = set()
        for name in chosen:
            cell, config = self.folder.plan.cell(name), self.configs[name]
            with _named(self.suite, name):
                if ("tracker", cell.tracker) not in made:
                    self.factories.tracker(cell.tracker, config.checkpoint)
                    made.add(("tracker", cell.tracker))
                if cell.spec.partition(":")[0] in CHECKED_POLICIES and (cell.spec, cell.task + cell.mode) not in made:
                    policy = self.factories.policy(config.policy, **config.policy_options)
                    with contextlib.closing(policy):
                        policy.check()
                        policy.check_task(
                            cell.task, cell.mode, [policy_seed(one.episode_seed) for one in config.episodes]
                        )
                    made.add((cell.spec, cell.task + cell.mode))

    def _changed(self, chosen: Sequence[str]) -> list[str]:
        """Cells whose folder holds what the suite no longer says, to be played again.

        Raises:
            InputError: There are some, and their flag was not given.
        """
        changed, code, names = [], [], []
        for name in chosen:
            run = self.folder.stored(name)
            if run is None:
                continue
            difference = self.folder.difference(run, self.configs[name], self.installed, OF_PARTS, OF_CODE)
            if difference is None:
                continue
            key, was, now, is_code = difference
            text = f"{name}: {key} was {setting(was)}, now {setting(now)}"
            finished = len(run.records) == run.document["planned"]
            if not is_code:
                changed.append(text)
            elif finished and self.options.accept_code:
                continue
            elif not (self.options.accept_code and not finished):
                code.append(text)
            names.append(name)
        if changed and not self.options.accept_changes:
            raise InputError(
                f"{self.folder.path}: {counted(len(changed), 'cell')} hold results of other conditions than "
                f"{self.suite.path} says now, the first is {changed[0]}; choose another --out, or play them again "
                "with --accept-changes"
            )
        if code and not self.options.accept_changes:
            raise InputError(
                f"{self.folder.path}: {counted(len(code), 'cell')} were played by another version, the first is "
                f"{code[0]}; keep what is finished with --accept-code, or play them again with --accept-changes"
            )
        gone = self.folder.gone
        if gone and not self.options.accept_changes:
            raise InputError(
                f"{self.folder.path}: holds {counted(len(gone), 'played cell')} that {self.suite.path} no longer has, "
                f"the first is {gone[0]}; choose another --out, or leave them out of the suite with --accept-changes"
            )
        return names

    def _is_done(self, name: str) -> bool:
        """True if a cell is done; one whose results are gone is not."""
        cell = self.folder.plan.cell(name)
        if cell.status != "done":
            return False
        run = self.folder.stored(name)
        if run is None or len(run.records) < run.document["planned"]:
            print(f"  {name}: was done, its results are gone or not whole: played again", flush=True)
            self.folder.reopen(name)
            return False
        return not (self.options.retry_errors and cell.errors)

    # Play

    def _measure_before(self, cells: Sequence[SuiteCell]) -> None:
        """Begin the estimate with the cells that are done."""
        for cell in cells:
            if cell.status == "done" and cell.wall_s > 0:
                self.spent, self.done_ticks = self.spent + cell.wall_s, self.done_ticks + cell.ticks

    def _play_joined(self, names: tuple[str, ...], number: int, todo: Sequence[tuple[str, ...]]) -> bool:
        """Play cells at once; False when it was interrupted."""
        print(f"[{number + 1}/{len(todo)}] {self.shown_names(names)}", flush=True)
        self.begun(names, device_name(self.configs[names[0]].device))
        began = time.perf_counter()
        error: Exception | None = None
        try:
            with self.silence():
                code = execute(self.results_of(names), self.factories)
        except KeyboardInterrupt:
            code = 130
        except StorageError:
            raise
        except Exception as caught:
            code, error = 2, caught
        wall = time.perf_counter() - began
        if code:
            self.env_cache.drop()  # what broke off in it may have left it in any state
        return self.ended(names, code, error, wall, [name for later in todo[number + 1 :] for name in later])

    def shown_names(self, names: Sequence[str]) -> str:
        """Cells that are played at once, in a line: the first, then the modes of the others."""
        return " ".join([names[0], *(self.folder.plan.cell(name).mode for name in names[1:])])

    def silence(self) -> contextlib.AbstractContextManager[object]:
        """Context that hides the output of a run unless --verbose shows it."""
        return contextlib.nullcontext() if self.options.verbose else contextlib.redirect_stdout(io.StringIO())

    def begun(self, names: Sequence[str], device: str) -> None:
        """Journal that cells begin on a device."""
        for name in names:
            self.devices[name] = device
            self.folder.add(
                CellEvent(cell=name, event="begun", at=timestamp(), config=self.configs[name].hash, device=device)
            )

    def ended(self, names: Sequence[str], code: int, error: Exception | None, wall: float, left: Sequence[str]) -> bool:
        """Journal and say how cells ended that were played at once.

        Args:
            code: Exit code of their run; 130 when it was interrupted.
            error: Why they could not be played.
            wall: Time that they took [s].
            left: Cells that are to be played after them.

        Returns:
            False when it was interrupted.

        Raises:
            RunStopped: They could not be played, and --keep-going was not given.
        """
        planned = self.folder.plan.cell(names[0]).episodes
        if error is None and code != 130 and any(self.folder.counts(name)["finished"] < planned for name in names):
            error = RunStopped(f"ended before all of {counted(planned, 'episode')} were played")
        wall /= len(names)
        found = [self._journalled(name, code, error, wall) for name in names]
        if error is not None:
            message = plain_text(f"{error}", 400) or type(error).__name__
            if not self.options.keep_going:
                if not isinstance(error, ArenaError):
                    raise error
                raise RunStopped(
                    f"cell {self.shown_names(names)}: {message}; continue with: {self.again} (--keep-going passes "
                    "cells that fail)"
                ) from None
            self.failed += [(name, message) for name in names]
            print(f"  failed: {message}", flush=True)
            return True
        if code == 130:
            return False
        for cell in found:
            self.spent, self.done_ticks = self.spent + wall, self.done_ticks + cell.ticks
            print(f"  {self._line(cell, wall, left)}", flush=True)
        return True

    def _journalled(self, name: str, code: int, error: Exception | None, wall: float) -> SuiteCell:
        """Journal how a cell ended; the cell as it is then."""
        message = None if error is None else plain_text(f"{type(error).__name__}: {error}", 400)
        kind: CellEnding = "failed" if error is not None else "interrupted" if code == 130 else "done"
        self.folder.add(
            CellEvent(
                cell=name,
                event=kind,
                at=timestamp(),
                config=self.configs[name].hash,
                device=self.devices.get(name, ""),
                wall_s=round(wall, 3),
                error=message,
                **self.folder.counts(name),
            )
        )
        return self.folder.plan.cell(name)

    def _line(self, cell: SuiteCell, wall: float, left: Sequence[str]) -> str:
        """Line about a cell that is done, with the time that the others take."""
        parts = [f"{cell.mode}: {cell.successes}/{cell.episodes} successes"]
        parts += [f"{counted(cell.errors, 'error')}"] if cell.errors else []
        parts.append(duration(wall))
        if not left:
            return ", ".join(parts)
        coming = self.coming(sum(self.folder.plan.cell(name).ticks for name in left))
        return f"{', '.join(parts)}; {counted(len(left), 'cell')} left, about {duration(coming)}"

    def coming(self, ticks: int) -> float:
        """Time that cells with step budgets of so many ticks take, at the speed so far [s]."""
        return ticks * self.spent / max(self.done_ticks, 1.0)

    def _end(self, chosen: Sequence[str]) -> int:
        """Print the end of the call; the exit code."""
        cells = [self.folder.plan.cell(name) for name in chosen]
        minutes = sum(cell.wall_s for cell in cells) / 60.0
        errors = sum(cell.errors for cell in cells)
        print(f"{self._kept(chosen)}, {minutes:.1f} min in all; {self.folder.path / SUITE_FILE}")
        for name, message in self.failed:
            print(f"failed: {name}: {message}")
        if errors:
            print(f"{counted(errors, 'episode')} ended with an error; run them again with: {self.again} --retry-errors")
        print(f"tables: {shell_command('arena_newton.eval', 'tables', self.folder.path)}")
        return 1 if self.failed or errors else 0


@contextlib.contextmanager
def _named(suite: SuiteFile, name: str) -> Iterator[None]:
    """Put suite file and cell in front of what is wrong with a part."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{suite.path}: cell {name}: {error}") from None
