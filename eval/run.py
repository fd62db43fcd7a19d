"""Run a plan: validate, build one environment per task, tracker and mode, journal every episode, write the report."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import gc
import math
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import warp as wp

from arena_newton import policies, trackers
from arena_newton.command_line import INTERRUPTED
from arena_newton.data.demonstration import DemonstrationRecorder
from arena_newton.env import ArenaEnv
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval import console, recording, report, rounds
from arena_newton.eval.config import DRIVES, RunConfig
from arena_newton.eval.episode_signals import EpisodeSignals
from arena_newton.eval.folder import ResultsFolder, iso
from arena_newton.eval.journal import SCHEMA, EpisodeRecord, Journal, StorageError
from arena_newton.eval.options import RunOptions
from arena_newton.eval.plan import Episode
from arena_newton.eval.progress import Progress, kernels_to_compile
from arena_newton.eval.recordings import ActionRecorder
from arena_newton.eval.results import Results, RunRecord, load_run
from arena_newton.eval.signal_recorder import SignalRecorder
from arena_newton.files import file_label
from arena_newton.interfaces import EpisodeResult, Recorder, World
from arena_newton.pictures.recorder import EpisodeRecorder
from arena_newton.policies.base import Policy, PolicyUnavailable
from arena_newton.policies.label_reader import read_by
from arena_newton.quiet import quiet_warp
from arena_newton.robot import TICK
from arena_newton.rollout import Rollout
from arena_newton.text import counted, plain_text
from arena_newton.trackers.base import Tracker
from arena_newton.usd_scenes import validate
from arena_newton.viewing import FailureRecorder, WorldViewer

__all__ = ["Factories", "RunStopped", "execute"]


class RunStopped(ArenaError):
    """Something other than an episode failed; what was played is kept, what was running stays unplayed."""

    exit_code = 2


@dataclass(frozen=True)
class Factories:
    """What a run builds its parts with; tests put their own in."""

    env: Callable[..., World] = ArenaEnv
    tracker: Callable[[str, Path | None], Tracker] = trackers.get
    policy: Callable[..., Policy] = policies.get
    check_variant: Callable[[Path, str], None] = validate.check
    """Raises InputError for a file that is not a scene of the task."""


def execute(folder: ResultsFolder, factories: Factories | None = None, beside: ResultsFolder | None = None) -> int:
    """Run or continue the run of a folder that was checked, and that of a folder inside, whose rows join its table.

    Returns:
        Exit code: 0 when every planned episode has an outcome other than error, 1 otherwise, 130 when interrupted.

    Raises:
        InputError: A flag, file or folder is wrong; raised before the first episode.
        StorageError: The results folder cannot be written; finished episodes are kept.
        RunStopped: Simulator, tracker or policy broke down as a whole; finished episodes are kept.
    """
    quiet_warp()
    factories = factories or Factories()
    began = time.perf_counter()
    if not _played(folder, factories):
        return INTERRUPTED
    whole, code = True, 0
    try:
        if beside is not None:
            whole = _played(beside, factories)
            if whole:
                code = _exit_code(beside, *_reported(beside))
    finally:  # whatever happened to the other, this one is told
        loaded, results = _reported(folder)
        console.result(loaded, results, _command(folder, "resume"), time.perf_counter() - began)
        for line in recording.outcome_lines(folder.config, folder.path, loaded.records):
            print(line)
    return max(code, _exit_code(folder, loaded, results)) if whole else INTERRUPTED


def _command(folder: ResultsFolder, name: str) -> str:
    """The command line that does something to a folder."""
    return f"python -m arena_newton.eval {name} {shlex.quote(str(folder.path))}"


def _played(folder: ResultsFolder, factories: Factories) -> bool:
    """Play what is missing in a folder; False when it was interrupted."""
    config = folder.config
    try:
        config, policy = _check_parts(config, factories)
    except SystemExit as stop:
        parts = f"--tracker {' '.join(config.flags.tracker)} or --policy {config.policy_label}"
        raise RunStopped(f"{parts}: left with SystemExit: {stop.code} before the first episode") from None
    with contextlib.ExitStack() as ended:
        ended.callback(policy.close)
        viewer = _viewer(config, folder.path)
        if viewer is not None:
            ended.callback(viewer.close)
        return _play(config, folder, factories, policy, viewer, _command(folder, "resume"))


def _reported(folder: ResultsFolder) -> tuple[RunRecord, Results]:
    """Write the reports of a folder."""
    try:
        loaded = load_run(folder.path)
        return loaded, report.write_reports(loaded)
    except StorageError as error:
        raise StorageError(f"{error}; free space, then: {_command(folder, 'report')}") from None


def _exit_code(folder: ResultsFolder, loaded: RunRecord, results: Results) -> int:
    """0 when the run has all that was asked for, 1 otherwise."""
    config = folder.config
    if config.flags.keep is not None:
        kept = sum(record.outcome == "success" for record in loaded.records)
        return 0 if kept >= config.flags.keep * len(_groups(config.episodes)) else 1
    return 0 if results["complete"] and not any(record.outcome == "error" for record in loaded.records) else 1


def _check_parts(config: RunConfig, factories: Factories) -> tuple[RunConfig, Policy]:
    """Build trackers and policy and check plan and variant, so that wrong input shows before the first episode.

    Returns:
        The configuration with what they say of themselves, and the policy.
    """
    made = {name: factories.tracker(name, config.checkpoint) for name in config.flags.tracker}
    policy = factories.policy(config.policy, **config.policy_options)
    policy.check()
    for (task, _, mode), group in _groups(config.episodes).items():
        policy.check_task(task, mode, [episode.episode_seed for episode in group])
    if config.variant is not None:
        factories.check_variant(config.variant, config.flags.task[0])
    config = config.with_parts(made, policy)
    late, chunk = config.flags.latency_ticks, getattr(policy, "chunk_size", 1)
    if 1 < chunk <= late:  # of one that does not say it, 1, the first chunk will show
        raise InputError(f"--latency-ticks {late}: expected fewer ticks than the policy's chunk of {chunk} has")
    return config, read_by(policy, config.labels, late)


def _play(
    config: RunConfig,
    folder: ResultsFolder,
    factories: Factories,
    policy: Policy,
    viewer: WorldViewer | None,
    resume: str,
) -> bool:
    """Play what is missing; False when it was interrupted. Errors say how to go on: by the command `resume`."""
    folder.make()
    with Journal(folder.journal) as journal:
        folder.settle(config, journal.records)
        folder.sweep()
        run = _Run(config, folder, journal, factories, policy, viewer)
        try:
            run.play()
        except KeyboardInterrupt:
            print(f"\ninterrupted: {run.kept()}; continue with: {resume}")
            return False
        except StorageError as error:
            raise StorageError(f"{error}; free space, then: {resume}") from None
        except PolicyUnavailable as error:
            raise RunStopped(f"{error}; {run.kept()}; when it is back: {resume}") from None
        except RunStopped as error:
            raise RunStopped(f"{error}; {run.kept()}; continue with: {resume}") from None
        finally:
            folder.sweep()
    return True


def _groups(episodes: Iterable[Episode]) -> dict[tuple[str, str, str], list[Episode]]:
    """Episodes by task, tracker and mode: a group runs in one environment."""
    groups: dict[tuple[str, str, str], list[Episode]] = {}
    for episode in episodes:
        groups.setdefault((episode.task, episode.tracker, episode.mode), []).append(episode)
    return groups


@dataclass
class _Run:
    """What all groups of a run share."""

    config: RunConfig
    folder: ResultsFolder
    journal: Journal
    factories: Factories
    policy: Policy
    viewer: WorldViewer | None = None
    """What shows the worlds, if anything does."""
    progress: Progress = field(init=False)
    hashes: dict[str, str | None] = field(default_factory=dict)
    """What the present environment's episodes name their run by; empty before it is built."""
    ended: dict[int, EpisodeRecord] = field(default_factory=dict)
    """Episodes that are in the journal, their files whole, by number; of two lines the last."""

    def kept(self) -> str:
        """How many of the planned episodes are in the journal, in words."""
        kept = len({record.index for record in self.journal.records})
        return f"{kept} of {counted(len(self.config.episodes), 'episode')} kept"

    def play(self) -> None:
        """Run what is missing, environment by environment."""
        if self.journal.torn_bytes:
            torn = counted(self.journal.torn_bytes, "byte")
            print(f"  cut a torn last line of {torn} off the journal", file=sys.stderr)
        done = self.ended = self._done()
        waiting = self._waiting()
        console.announce(self.config, self.folder.path, waiting)
        if not waiting:
            self.folder.finished()
            return
        budget = {episode.index: episode.max_steps for episode in self.config.episodes}
        finished = sum(budget[index] for index in done)
        coming = [episode.max_steps for group in waiting.values() for episode in group]
        self.progress = Progress(
            finished + sum(coming), planned=len(done) + len(coming), finished=len(done), done=finished
        )
        try:
            with self.folder.running():
                for names, group in waiting.items():
                    self.progress.group(" ".join(names))
                    self._play_group(" ".join(names), group)
        finally:
            self.progress.close()

    def _done(self) -> dict[int, EpisodeRecord]:
        """The finished episodes; one whose recording is missing is none."""
        ended = {record.index: record for record in self.journal.records}
        again, planned = self.config.flags.retry_errors, {e.index: e for e in self.config.episodes}
        done = {index: record for index, record in ended.items() if not (again and record.outcome == "error")}
        where = self.folder.path
        lost = [i for i, r in done.items() if not recording.is_recorded(self.config, where, r, planned[i])]
        if lost:
            print(f"  of {counted(len(lost), 'episode')} the recording is missing: played again", file=sys.stderr)
        return {index: record for index, record in done.items() if index not in lost}

    def _waiting(self) -> dict[tuple[str, str, str], list[Episode]]:
        """Episodes to play next, by task, tracker and mode."""
        outcomes = {index: record.outcome for index, record in self.ended.items()}
        found = {}
        for names, group in _groups(self.config.episodes).items():
            wanted = set(rounds.due([e.index for e in group], outcomes, self.config.flags.keep))
            if wanted:
                found[names] = [episode for episode in group if episode.index in wanted]
        return found

    def _play_group(self, group: str, episodes: list[Episode]) -> None:
        """Run the episodes of one task, tracker and mode, which name the group.

        What breaks an environment as a whole says nothing about its episodes: it stops the run and leaves them
        unplayed. On --skip-broken those that were running end as errors, and the rest goes on in a new environment.
        """
        left = {episode.index: episode for episode in episodes}
        while left:
            started = min(self.config.flags.worlds, len(left))
            order = list(left.values())
            try:
                self._play_in_one(group, list(order), order, left)
                return
            except (InputError, StorageError, PolicyUnavailable, RunStopped):
                raise
            except OSError as error:
                self.folder.keep_trace()
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    where = plain_text(error.filename or self.folder.path)
                    raise StorageError(f"{where}: disk full; {self.kept()}, what was running is not") from None
                raise RunStopped(console.failed(group, error)) from None
            except (Exception, SystemExit) as error:  # a part that leaves must not end the run as if all were played
                self.folder.keep_trace()
                # The next episode starts as soon as a world is free, so these are what was running.
                running = [e for e in order[: started + len(order) - len(left)] if e.index in left]
                message = plain_text(f"{type(error).__name__}: {error}", 300)
                if not self.config.flags.skip_broken or not self.hashes:
                    raise RunStopped(console.broken(group, message, running if self.hashes else [])) from None
                self.progress.say(f"  {group}: {message}; {counted(len(running), 'episode')} end as errors")
                for episode in running:
                    self._keep(EpisodeResult(episode, "error", "environment", 0, math.nan, error=message), {})
                    del left[episode.index]
                    self.progress.episode(episode.max_steps, 0)

    def _play_in_one(self, group: str, episodes: list[Episode], order: list[Episode], left: dict[int, Episode]) -> None:
        """Run episodes in one environment; those that end are taken out of `left`, later rounds are added to both."""
        config, flags = self.config, self.config.flags
        task, tracker, mode = episodes[0].task, episodes[0].tracker, episodes[0].mode
        self.hashes = {}
        env = recorder = files = None
        if kernels_to_compile(Path(wp.config.kernel_cache_dir or "."), flags.engine or "", config.device):
            self.progress.say("  compiling kernels, once; this takes a minute or some")
        try:
            env = self.factories.env(
                task,
                tracker=self.factories.tracker(tracker, config.checkpoint),
                worlds=min(flags.worlds, len(episodes)),
                engine=flags.engine,
                device=config.device,
                rules=flags.rules,
                mode=mode,
                variant_file=str(config.variant) if config.variant else None,
                fast_physics=flags.fast_physics,
                camera=config.camera,
                drive=DRIVES[flags.drive],
            )
            facts = self.folder.register(group, env.describe())
            if flags.verbose:
                self.progress.say(console.environment(group, facts))
            recorder = _recorder(config, self.folder.path, tracker)
            recorders: list[Recorder] = [] if recorder is None else [recorder]
            recorders += [ActionRecorder(self.folder.path / "actions")] if flags.actions else []
            if flags.viewer_failures:
                recorders.append(FailureRecorder(self.folder.path / "failures", _prefix(flags, tracker)))
            signals = SignalRecorder(env) if flags.failures else None
            recorders += [] if signals is None else [signals]
            if self.viewer is not None:
                self.viewer.open(env, group)
                recorders.append(self.viewer)
            noise = recording.disturbance_of(config, task, episodes[0].max_steps)
            recorders += [] if noise is None else [noise]
            described = recording.facts_of(config, task, tracker, facts, self.folder.installed)
            files = recording.demonstration_recorder(config, self.folder.path, described)
            recorders += [] if files is None else [files]

            def keep(result: EpisodeResult, media: dict[str, str]) -> None:
                pictures = recorder.media(result.episode) if recorder is not None else {}
                found = None if signals is None else signals.taken(result.episode.index)
                self._keep(result, pictures | media, found)
                left.pop(result.episode.index, None)

            def on_finish(result: EpisodeResult) -> None:
                if files is None:
                    keep(result, {})
                self.progress.episode(result.episode.max_steps, round(result.sim_s / TICK))

            def on_tick(active: int) -> None:
                self.progress.tick(active)
                if files is not None:
                    self._keep_saved(files, keep)

            self.hashes = self.folder.hashes(tracker, facts)
            while episodes:
                Rollout(
                    env,
                    self.policy,
                    episodes,
                    recorder=recorders,
                    disturbance=noise,
                    max_steps=episodes[0].max_steps,
                    latency=flags.latency_ticks,
                    on_finish=on_finish,
                    on_tick=on_tick,
                ).run()
                if files is not None:
                    self._keep_saved(files, keep, wait=True)
                    files.check()
                episodes = self._next_round(task, tracker, mode, order, left)
        finally:
            try:
                if files is not None:  # what has ended is kept, whatever happened to the others
                    self._keep_saved(files, keep, wait=True)
            finally:
                for one in (files, recorder, env):
                    if one is not None:
                        one.close()
                env = recorder = files = None
                gc.collect()

    def _next_round(
        self, task: str, tracker: str, mode: str, order: list[Episode], left: dict[int, Episode]
    ) -> list[Episode]:
        """More attempts where successes are missing; they are added to what is left."""
        if self.config.flags.keep is None:
            return []
        more = self._waiting().get((task, tracker, mode), [])
        order += more
        left |= {episode.index: episode for episode in more}
        self.progress.more([episode.max_steps for episode in more])
        return more

    def _keep_saved(
        self, files: DemonstrationRecorder, keep: Callable[[EpisodeResult, dict[str, str]], None], *, wait: bool = False
    ) -> None:
        """Journal the episodes whose files are on the disk."""
        for saved in files.saved(wait=wait):
            where = {name: path.relative_to(self.folder.path).as_posix() for name, path in saved.files.items()}
            keep(saved.result, where)

    def _keep(self, result: EpisodeResult, media: dict[str, str], signals: EpisodeSignals | None = None) -> None:
        """Append an episode to the journal.

        Raises:
            RunStopped: It was played again for its recording, and ended in another way.
        """
        before = next((r for r in reversed(self.journal.records) if r.index == result.episode.index), None)
        if before is not None and before.outcome != "error" and not recording.agrees(before, result):
            for path in media.values():
                (self.folder.path / path).unlink(missing_ok=True)
            raise RunStopped(
                f"{result.episode.key}: was played again for its recording and ended as {result.outcome} after "
                f"{result.steps} steps, the journal has {before.outcome} after {before.steps}: engine "
                f"{self.config.flags.engine} does not repeat an episode bit for bit; record into another --out"
            )
        record = _record(result, media, self.hashes, signals)
        self.journal.append(record)
        self.ended[record.index] = record


def _recorder(config: RunConfig, folder: Path, tracker: str) -> EpisodeRecorder | None:
    """What takes the pictures; None when none are wanted. Of several trackers each has its name in its files' names."""
    flags = config.flags
    if not (flags.video or flags.strip):
        return None
    kinds = {"video": flags.video, "strip": flags.strip, "follow": flags.follow}
    prefix = _prefix(flags, tracker)
    return EpisodeRecorder(folder, **kinds, episodes=flags.video_episodes, size=config.video_size, prefix=prefix)


def _prefix(flags: RunOptions, tracker: str) -> str:
    return file_label(tracker) if len(flags.tracker) > 1 else ""


def _viewer(config: RunConfig, folder: Path) -> WorldViewer | None:
    """Start the viewer of --viewer, and say where it is."""
    flags = config.flags
    if flags.viewer is None:
        return None
    viewer = WorldViewer(
        flags.viewer,
        port=flags.viewer_port,
        out=folder / "viewer",
        follow=flags.viewer_follow,
        real_time=flags.viewer_real_time,
    )
    print(f"viewer: {viewer.url or folder / 'viewer'}", flush=True)
    return viewer


def _record(
    result: EpisodeResult,
    media: dict[str, str],
    hashes: dict[str, str | None],
    signals: EpisodeSignals | None = None,
) -> EpisodeRecord:
    """Journal line of an episode that ended now."""
    finished = time.time()
    planned = dataclasses.asdict(result.episode)
    del planned["rank"]
    return EpisodeRecord(
        schema=SCHEMA,
        **planned,
        hashes=hashes,
        outcome=result.outcome,
        reason=result.reason,
        steps=int(result.steps),
        margin=float(result.margin) if math.isfinite(result.margin) else None,
        startup_fall=bool(result.startup_fall),
        overflow=bool(result.overflow),
        error=None if result.error is None else plain_text(result.error),
        durations={"wall_s": round(float(result.wall_s), 6), "sim_s": round(float(result.sim_s), 6)},
        started_at=iso(finished - float(result.wall_s)),
        finished_at=iso(finished),
        media=media,
        video=media.get("ego", ""),
        phases=tuple(result.phases),
        predicates=dict(result.predicates),
        progress=float(result.progress),
        events=tuple(result.events),
        signals=signals,
    )
