"""``run --jobs`` and ``run --ray``: processes play batches of the plan; this one deals them out and owns the journal.

Numbers of episodes go out, journal lines come back; pictures and recordings are written by the processes themselves
into the results folder. This process loads neither Warp nor torch for it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from math import ceil
from typing import TYPE_CHECKING

from arena_newton.cli.command_line import INTERRUPTED
from arena_newton.errors import ArenaError
from arena_newton.eval.folders.run_folder import BREAK_FILE, ResultsFolder, iso
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.play.run_flow import (
    Group,
    RunStopped,
    begun,
    check_again,
    command,
    due,
    group_of,
    groups,
    kept,
    naming_the_command,
    progress_of,
    reported,
)
from arena_newton.eval.records.journal import SCHEMA, EpisodeLines, EpisodeRecord, write_atomic
from arena_newton.eval.reports.progress import Progress
from arena_newton.eval.workers.messages import ActionFile, Built, Done, Ended, Event, Opened, Ticks
from arena_newton.eval.workers.worker_pool import Assignment, Job, Lost, Worker, WorkerPool, backend_of
from arena_newton.files.text import counted, plain_text
from arena_newton.robot.g1 import TICK

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["DealtRun", "execute"]

LARGEST = 2
"""Most episodes of a batch for each of --worlds."""
SMALLER = 4
"""Episodes that were running when a process was lost are played again in batches so many times smaller, then alone."""
ALONE = 2
"""Losses after which an episode is played alone."""
GIVEN_UP = 5
"""Number of episodes of a task, tracker and mode that stop the run if they end as errors before one ends otherwise."""


def execute(folders: Sequence[ResultsFolder], factories: Factories | None = None) -> int:
    """Run or continue runs whose folders were checked, one after the other, by other processes.

    Args:
        folders: Of the runs; the flags of the first say which processes.
        factories: What the processes build the runs with, importable there; the real parts by default.

    Returns:
        Exit code: 0 when every planned episode has an outcome other than error, 1 otherwise, 130 when interrupted.

    Raises:
        InputError: A flag, file or folder is wrong, here or on a node; raised before the first episode.
        StorageError: The results folder cannot be written; finished episodes are kept.
        RunStopped: Simulator, tracker, policy or cluster broke down as a whole; finished episodes are kept.
    """
    first, code = folders[0].config, 0
    with backend_of(first.flags, first.device) as backend, contextlib.ExitStack() as ended:
        pool = WorkerPool(backend, max(len(folder.config.episodes) for folder in folders), factories)
        ended.callback(pool.dismiss)
        planned = counted(sum(len(folder.config.episodes) for folder in folders), "episode")
        said = f"  loading tracker and policy for {planned}; processes: {len(pool.workers)}"
        print(said, file=sys.stderr, flush=True)
        for folder in folders:
            began = time.perf_counter()
            if not _played(pool, folder):
                return INTERRUPTED
            code = max(code, reported(folder, time.perf_counter() - began))
    return code


def _played(pool: WorkerPool, folder: ResultsFolder) -> bool:
    """Play what is missing in a folder; False when it was interrupted."""
    job, resume = Job(folder), f"{command(folder, 'resume')} {pool.backend.flag}"
    config = pool.opened(job)
    with folder.opened(config) as journal:
        try:
            with naming_the_command(resume, lambda: kept(config, journal.records)):
                done, waiting = begun(config, folder, journal.records)
                if waiting:
                    _play(DealtRun(job, journal, pool, done, waiting, progress_of(config, done, waiting)))
        except KeyboardInterrupt:
            print(f"\ninterrupted: {kept(config, journal.records)}; continue with: {resume}")
            return False
        finally:
            if any(worker.assignment is not None for worker in pool.workers):
                pool.dismiss()  # who writes files has ended before those that are not whole are removed
    return True


def _play(run: DealtRun) -> None:
    """Play a run until nothing is left."""
    pool = run.pool
    try:
        with run.folder.running():
            run.shown.group(f"{len(pool.workers)} processes")
            while _dealt(run):
                for _, assignment, message in pool.messages():
                    if assignment is not None and not isinstance(message, Opened):
                        run.take(assignment, message)
                    elif isinstance(message, ArenaError):
                        raise message
    finally:
        run.shown.close()


def _dealt(run: DealtRun) -> bool:
    """Give a batch to each process that waits for one; False when all is played."""
    for worker in run.pool.idle():
        if worker.job is not run.job:
            run.pool.prepare(worker, run.job)
        elif (assignment := run.next(worker)) is not None:
            run.pool.assign(worker, assignment)
    return not run.finished


class DealtRun:
    """A run whose episodes are dealt out to a pool: its batches, and the journal of what comes back."""

    def __init__(
        self,
        job: Job,
        journal: EpisodeLines,
        pool: WorkerPool,
        ended: dict[int, EpisodeRecord],
        waiting: dict[Group, list[Episode]],
        shown: Progress,
        besides: Callable[[], int] = lambda: 0,
        least: int = 1,
    ):
        """Take what is to be played of a run whose folder was prepared.

        Args:
            pool: Who plays.
            ended: Finished episodes by number.
            waiting: Those to play by group.
            shown: What shows how far all is.
            besides: Episodes of other runs that nobody plays yet.
            least: Episodes that are not divided among processes, where --worlds has room for them.
        """
        self.job, self.folder, self.config, self.journal, self.pool = job, job.folder, job.folder.config, journal, pool
        self.ended, self._besides = ended, besides
        self.shown = pool.shown = shown
        self._queues: dict[tuple[Group, int], deque[Episode]] = {}
        """Episodes to play, by group and by how often they were lost."""
        for group, episodes in waiting.items():
            self._queues[group, 0] = deque(episodes)
        self._worlds = max(1, min(self.config.flags.worlds, max(self._fair(), least)))
        """Worlds of environments, ..."""
        self._most = {group: len(episodes) for group, episodes in waiting.items()}
        """... no more than a group has episodes."""
        self._losses: Counter[int] = Counter()
        """Losses of each episode while it was played alone."""
        self._given_up: Counter[Group] = Counter()
        """Episodes given up, by task, tracker and mode."""

    @property
    def waiting(self) -> int:
        """Episodes that no process has."""
        return sum(map(len, self._queues.values()))

    @property
    def batches(self) -> int:
        """Fewest batches that the waiting episodes make."""
        return ceil(self.waiting / self._worlds)

    @property
    def assigned(self) -> bool:
        """True if a process plays a batch."""
        return any(one.assignment is not None and one.assignment.job is self.job for one in self.pool.workers)

    @property
    def finished(self) -> bool:
        """True if nothing is left to play."""
        return not self.waiting and not self.assigned

    def _fair(self) -> int:
        """Episodes for each process, if what nobody plays were divided now."""
        return ceil((self.waiting + self._besides()) / len(self.pool.workers))

    def next(self, worker: Worker) -> Assignment | None:
        """The next batch for a process: of its environment if possible, else of the group that has the most to do."""
        taken = Counter(one.assignment.group for one in self.pool.workers if one.assignment is not None)
        work = {
            key: (key == (worker.last, 0), sum(e.max_steps for e in queue) / (1 + taken[key[0]]))
            for key, queue in self._queues.items()
            if queue
        }
        if not work:
            return None
        group, level = key = max(work, key=lambda one: work[one])
        queue, worlds = self._queues[key], self.config.flags.worlds
        size = min(LARGEST * worlds, max(self._worlds, self._fair())) if not level else max(1, worlds // SMALLER)
        size = 1 if level == ALONE else min(size, len(queue))
        episodes = [queue.popleft() for _ in range(size)]
        worlds = size if level else min(self._worlds, self._most[group])
        return Assignment(self.job, group, {e.index: e for e in episodes}, worlds, level)

    def take(self, assignment: Assignment, message: Event | Done | Lost | ArenaError) -> None:
        """Take a message of a process about its batch.

        Raises:
            ArenaError: The run cannot go on.
        """
        if isinstance(message, Built):
            for names in groups(assignment.left.values()):
                self.folder.register(" ".join(names), message.facts)
            assignment.built = True
        elif isinstance(message, Ticks):
            self.shown.tick(message.count)
        elif isinstance(message, ActionFile):
            self.folder.keep_file(message.name, message.content)
        elif isinstance(message, Ended):
            self._keep(assignment, EpisodeRecord.from_json(f"a process of {self.pool.backend.flag}", message.line))
        elif isinstance(message, Lost):
            self._again(assignment, message)
        elif isinstance(message, Done) and assignment.left:  # reported as ended without a line: no process does that
            self._again(assignment, Lost("episodes were left out"))
        elif isinstance(message, ArenaError):
            raise message

    def _keep(self, assignment: Assignment, record: EpisodeRecord) -> None:
        """Append an episode to the journal, once."""
        episode = assignment.left.pop(record.index, None)
        if episode is None:
            return
        check_again(self.config, self.folder.path, self.journal.records, record, episode, (record.media or {}).values())
        self._append(episode, record)
        self.shown.episode(episode.max_steps, round((record.durations or {}).get("sim_s", 0.0) / TICK))

    def _append(self, episode: Episode, record: EpisodeRecord) -> None:
        self.journal.append(record)
        self.ended[record.index] = record
        if self.config.flags.keep is not None or self.config.width_rule is not None:
            self._next_round(group_of(self.config, episode))

    def _next_round(self, group: Group) -> None:
        """More attempts where successes are missing, when all of a round have ended."""
        mine = [
            one.assignment for one in self.pool.workers if one.assignment is not None and one.assignment.job is self.job
        ]
        if any(assignment.left for assignment in mine if assignment.group == group):
            return
        if any(queue for (name, _), queue in self._queues.items() if name == group):
            return
        more = due(self.config, self.ended).get(group, [])
        self._queues[group, 0] = deque(more)
        self.shown.more([episode.max_steps for episode in more])

    def _again(self, assignment: Assignment, lost: Lost) -> None:
        """Deal out again what a lost process had not finished; episodes that were running come into a smaller batch."""
        if lost.trace:
            with contextlib.suppress(ArenaError):
                write_atomic(self.folder.path / BREAK_FILE, lost.trace)
        left, suspects = (
            list(assignment.left.values()),
            set() if lost.with_node else {e.index for e in assignment.running()},
        )
        assignment.left.clear()
        for episode in reversed(left):
            suspected = episode.index in suspects
            if suspected and assignment.size == 1:
                self._losses[episode.index] += 1
                if self._losses[episode.index] >= self.config.flags.ray_attempts:
                    self._give_up(assignment, episode, lost.cause)
                    continue
            level = min(ALONE, assignment.level + 1) if suspected else assignment.level
            self._queues.setdefault((assignment.group, level), deque()).appendleft(episode)

    def _give_up(self, assignment: Assignment, episode: Episode, cause: str) -> None:
        """End an episode as an error: it takes its process with it."""
        cell = episode.task, episode.tracker, episode.mode
        facts, now = self.folder.document["environments"][" ".join(cell)], iso(time.time())
        attempts = f"played alone {self._losses[episode.index]} times, each time its process was lost"
        planned = dataclasses.asdict(episode)
        del planned["rank"]
        record = EpisodeRecord(
            schema=SCHEMA,
            **planned,
            privileged=self.config.privileged,
            hashes=self.folder.hashes(episode.tracker, facts),
            outcome="error",
            reason="environment",
            steps=0,
            error=plain_text(f"{attempts}: {cause}", 400),
            durations={"wall_s": 0.0, "sim_s": 0.0},
            started_at=now,
            finished_at=now,
            media={},
            video="",
            progress=0.0,
        )
        self.shown.say(f"  {episode.key} ends as an error: {record.error}")
        self._append(episode, record)
        self.shown.episode(episode.max_steps, 0)
        self._given_up[cell] += 1
        played = any((e.task, e.tracker, e.mode) == cell and e.outcome != "error" for e in self.ended.values())
        if self._given_up[cell] >= GIVEN_UP and not played:
            raise RunStopped(f"{' '.join(cell)}: {GIVEN_UP} episodes and no other: {cause}; see {BREAK_FILE}")
