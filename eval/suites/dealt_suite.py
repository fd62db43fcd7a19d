"""``eval matrix --jobs`` and ``--ray``: one pool of processes plays the cells of a suite, several at once.

A cell, with those that play in one batch of worlds with it, is begun when a process has opened it, and is an ordinary
results folder with a journal of its own, as `dealing` writes it. Processes keep their environment from cell to cell
where the next one asks for the same.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run_flow import begun, reported
from arena_newton.eval.records.journal import StorageError
from arena_newton.eval.reports.progress import Progress
from arena_newton.eval.suites.suite_call import SuiteCall
from arena_newton.eval.suites.suite_folder import SuiteFolder
from arena_newton.eval.suites.suite_run import CellPlayer
from arena_newton.eval.workers.dealing import DealtRun
from arena_newton.eval.workers.messages import Done, Event, Opened
from arena_newton.eval.workers.worker_pool import Assignment, Job, Lost, Worker, WorkerPool, backend_of

__all__ = ["run"]

CPU = "cpu"
"""Device of a process that has no GPU."""
OF_A_GPU = 256
"""Episodes that a GPU plays in hardly more time than a few, so that they are not divided among its processes: fourteen
of them on an H200 took 18 ms a tick of 17 worlds each and 21 ms a tick of 133."""


def run(call: SuiteCall, factories: Factories | None = None) -> int:
    """Play the cells of a call by other processes.

    Args:
        call: Its flags say which processes.
        factories: What runs are built with, importable in the processes; the real parts by default.

    Returns:
        Exit code: 0 when all cells that this call was to play are done, 1 when cells failed under --keep-going or
        episodes ended as errors, 130 when interrupted.

    Raises:
        InputError: A condition, a policy or the folder is wrong, here or on a node.
        RunStopped: A cell could not be played, or no process begins.
        StorageError: The folder cannot be written.
    """
    folder = SuiteFolder(call.out, call.suite, *call.shard)
    with folder.locked(call.cells):
        return _PoolPlayer(call.suite, folder, call.options, factories, again=call.again).play(call.chosen)


@dataclass(eq=False)
class _Cell:
    """A cell of this call, or several that play in one batch of worlds."""

    names: tuple[str, ...]
    number: int
    """Its position among those to play."""
    env: tuple[str, str, str]
    """Task, tracker and scene of its environment."""
    episodes: int
    """Not yet in its journal."""
    ticks: int
    """Their step budgets [ticks]."""
    job: Job
    opening: bool = False
    """True if a process opens it that has not been opened before."""
    dealt: DealtRun | None = None
    """Run whose episodes are assigned, once it has begun."""
    held: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    """Journal and status, while it is played."""
    error: ArenaError | None = None
    """Error after which no more of it is dealt out."""
    ended: bool = False

    @property
    def open(self) -> bool:
        """True if a process could be of use now."""
        if self.ended or self.opening or self.error is not None:
            return False
        return self.dealt is None or self.dealt.waiting > 0


class _PoolPlayer(CellPlayer):
    """Plays cells by a pool."""

    def play_cells(self, todo: Sequence[tuple[str, ...]]) -> bool:
        """Play cells that were checked; False when it was interrupted."""
        if not todo:
            return True
        self.cells = [self._cell(names, number) for number, names in enumerate(todo)]
        self.jobs = {cell.job: cell for cell in self.cells}
        planned = sum(cell.episodes for cell in self.cells)
        self.shown = Progress(sum(cell.ticks for cell in self.cells), planned=planned)
        self.done = 0
        self.played_ticks, self.began = 0.0, time.monotonic()
        with backend_of(self.options, self.configs[todo[0][0]].device) as backend, contextlib.ExitStack() as ended:
            self.pool = WorkerPool(backend, planned, self.given)
            self.pool.shown = self.shown
            self.shown.group(f"{len(self.pool.workers)} processes")
            ended.callback(self.shown.close)
            ended.callback(self.pool.dismiss)
            try:
                self._play()
            except KeyboardInterrupt as error:
                self._leave(error)
                return False
            except BaseException:
                self._leave(None)
                raise
        return True

    def coming(self, ticks: int) -> float:
        """Time that cells with step budgets of so many ticks take, at the speed so far of all processes [s]."""
        return ticks * (time.monotonic() - self.began) / max(self.played_ticks, 1.0)

    def _cell(self, names: tuple[str, ...], number: int) -> _Cell:
        cells = [self.folder.plan.cell(name) for name in names]
        left = [max(cell.episodes - self.folder.counts(cell.id)["finished"], 1) for cell in cells]
        ticks = sum(cell.ticks * few // cell.episodes for cell, few in zip(cells, left, strict=True))
        env = cells[0].task, cells[0].tracker, self.scene(names[0])
        return _Cell(names, number, env, sum(left), ticks, Job(self.results_of(names)))

    def _play(self) -> None:
        """Play until nothing is left."""
        while not all(cell.ended for cell in self.cells):
            for worker in self.pool.idle():
                self._give(worker)
            for job, assignment, message in self.pool.messages():
                self._hear(self.jobs[job], assignment, message)
            for cell in self.cells:
                if not cell.ended and (cell.error is not None or cell.dealt is not None) and not self._is_played(cell):
                    self._finish(cell)

    def _give(self, worker: Worker) -> None:
        """Give work to a process that waits: a batch of the run that it has open, or another run to open."""
        busy = {self.jobs[one.assignment.job].env for one in self.pool.workers if one.assignment is not None}
        there = None if worker.job is None else self.jobs[worker.job].env

        def wanted(cell: _Cell) -> bool:
            if not cell.open or cell.dealt is None or cell.job is worker.job:
                return cell.open
            coming = [one for one in self.pool.workers if one.job is cell.job and one.assignment is None]
            return len(coming) < cell.dealt.batches  # no more open it than find something to play

        def order(cell: _Cell) -> tuple[bool, bool, bool, bool, int, int]:
            new = cell.job is not worker.job, cell.env != there, cell.dealt is None, cell.env in busy
            return *new, -(cell.ticks // cell.episodes), cell.number  # those that may take longest begin first

        found = min(filter(wanted, self.cells), key=order, default=None)
        if found is None:
            return
        if found.job is not worker.job:
            found.opening = found.job.opened is None
            self.pool.prepare(worker, found.job)
        elif found.dealt is not None and (assignment := found.dealt.next(worker)) is not None:
            self.pool.assign(worker, assignment)

    def _hear(
        self, cell: _Cell, assignment: Assignment | None, message: Opened | Event | Done | Lost | ArenaError
    ) -> None:
        """Take what a process tells of a cell."""
        try:
            if assignment is not None and cell.dealt is not None and not isinstance(message, Opened):
                cell.dealt.take(assignment, message)
                return
            cell.opening = False
            if isinstance(message, ArenaError):
                raise message
            if isinstance(message, Opened) and cell.dealt is None and cell.error is None:
                self._begin(cell)
        except StorageError:
            raise
        except ArenaError as error:
            cell.error = cell.error or error

    def _begin(self, cell: _Cell) -> None:
        """Begin a cell that a process has opened."""
        folder, config = cell.job.folder, cell.job.configured()
        assert cell.job.opened is not None
        self.begun(cell.names, cell.job.opened.device)
        with self.silence():
            journal = cell.held.enter_context(folder.opened(config))
            done, waiting = begun(config, folder, journal.records)
            if waiting:
                cell.held.enter_context(folder.running())
            least = 1 if cell.job.opened.device == CPU else OF_A_GPU
            besides = functools.partial(self._besides, cell)
            cell.dealt = DealtRun(cell.job, journal, self.pool, done, waiting, self.shown, besides, least)

    def _besides(self, cell: _Cell) -> int:
        """Episodes of other cells that nobody plays yet."""
        others = [one for one in self.cells if one is not cell and one.open]
        return sum(one.episodes if one.dealt is None else one.dealt.waiting for one in others)

    def _is_played(self, cell: _Cell) -> bool:
        """True if a process plays something of a cell, or is to."""
        if cell.dealt is None:
            return False
        return cell.dealt.assigned or (cell.error is None and cell.dealt.waiting > 0)

    def _finish(self, cell: _Cell) -> None:
        """End a cell of which nothing is left to play, or no more can be played."""
        cell.ended, code = True, 2
        try:
            self._close(cell, cell.error)
            if cell.error is None:
                with self.silence():
                    code = max(reported(part, cell.job.seconds) for part in cell.job.folder.parts)
        except StorageError:
            raise
        except ArenaError as error:
            cell.error = cell.error or error
        self.done += 1
        if cell.error is None:
            self.played_ticks += cell.ticks
        print(f"[{self.done}/{len(self.cells)}] {self.shown_names(cell.names)}", flush=True)
        left = [name for one in self.cells if not one.ended for name in one.names]
        self.ended(cell.names, code, cell.error, cell.job.seconds, left)

    def _close(self, cell: _Cell, error: BaseException | None) -> None:
        """Let go of the journal; the folder's status says how the run ended."""
        cell.held.__exit__(None if error is None else type(error), error, None)

    def _leave(self, interrupt: KeyboardInterrupt | None) -> None:
        """End all cells that have begun, before they are whole."""
        self.pool.dismiss()  # who writes files has ended
        stop = interrupt or KeyboardInterrupt()
        for cell in self.cells:
            if cell.dealt is not None and not cell.ended:
                cell.ended = True
                with contextlib.suppress(InputError, StorageError):
                    self._close(cell, stop)
                    self.ended(cell.names, 130, None, cell.job.seconds, ())
