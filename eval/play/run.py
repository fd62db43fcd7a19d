"""Run a plan: validate, build one environment per task, tracker and scene, journal every episode, write the report."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import functools
import gc
import math
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol

import torch
import warp as wp

from arena_newton import tasks
from arena_newton.cli.command_line import INTERRUPTED
from arena_newton.cli.quiet import quiet_warp
from arena_newton.errors import InputError
from arena_newton.eval.folders.recordings import ActionRecorder
from arena_newton.eval.folders.run_folder import PROCESSOR, ResultsFolder, actions_folder, iso, shown_by
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.plan.flag_checks import DRIVES
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run_flow import (
    Group,
    RunStopped,
    begun,
    check_again,
    command,
    due,
    groups,
    kept,
    naming_the_command,
    progress_of,
    reported,
)
from arena_newton.eval.play.signal_recorder import SignalRecorder
from arena_newton.eval.records.episode_signals import EpisodeSignals
from arena_newton.eval.records.identity import config_hash, own_code
from arena_newton.eval.records.journal import SCHEMA, EpisodeLines, EpisodeRecord, StorageError
from arena_newton.eval.reports import console
from arena_newton.eval.reports.progress import kernels_to_compile
from arena_newton.files.own_files import file_label
from arena_newton.files.stored_json import is_name
from arena_newton.files.text import counted, plain_text
from arena_newton.interfaces import EpisodeResult, Recorder, World
from arena_newton.pictures.viewing import FailureRecorder, WorldViewer
from arena_newton.policies.base import Policy, PolicyUnavailable
from arena_newton.policies.label_reader import read_by
from arena_newton.robot.g1 import TICK
from arena_newton.rollout import Rollout
from arena_newton.rules import modes, seeding

if TYPE_CHECKING:
    from arena_newton.data.recording.demonstration import DemonstrationRecorder
    from arena_newton.pictures.recorder import EpisodeRecorder

__all__ = [
    "ProgressSink",
    "RunPlayer",
    "RunStopped",
    "check_parts",
    "execute",
    "make_env",
]


def execute(folder: ResultsFolder, factories: Factories | None = None) -> int:
    """Run or continue the run of a folder that was checked.

    Returns:
        Exit code: 0 when every planned episode has an outcome other than error, 1 otherwise, 130 when interrupted.

    Raises:
        InputError: A flag, file or folder is wrong; raised before the first episode.
        StorageError: The results folder cannot be written; finished episodes are kept.
        RunStopped: Simulator, tracker or policy broke down as a whole; finished episodes are kept.
    """
    quiet_warp()
    began = time.perf_counter()
    if not _played(folder, factories or Factories()):
        return INTERRUPTED
    seconds = time.perf_counter() - began
    return max(reported(part, seconds) for part in folder.parts)


def _played(folder: ResultsFolder, factories: Factories) -> bool:
    """Play what is missing in a folder; False when it was interrupted."""
    config = folder.config
    try:
        config, policy = check_parts(config, factories)
    except SystemExit as stop:
        parts = f"--tracker {' '.join(config.flags.tracker)} or --policy {config.policy_label}"
        raise RunStopped(f"{parts}: left with SystemExit: {stop.code} before the first episode") from None
    with contextlib.ExitStack() as ended:
        ended.callback(policy.close)
        viewer = _viewer(config, folder.path)
        if viewer is not None:
            ended.callback(viewer.close)
        return _play(config, folder, factories, policy, viewer, command(folder, "resume"))


def check_parts(config: RunConfig, factories: Factories, *, replayed: bool = False) -> tuple[RunConfig, Policy]:
    """Build trackers and policy and check plan and layers, so that wrong input shows before the first episode.

    Args:
        config: The run.
        factories: What makes its parts.
        replayed: True for actions of a policy that may have seen pictures, whatever they are played by.

    Returns:
        The configuration with what they say of themselves, and the policy.
    """
    made = {name: factories.tracker(name, config.checkpoint) for name in config.flags.tracker}
    policy = factories.policy(config.policy, **config.policy_options)
    policy.check()
    for (task, _, mode), group in groups(config.episodes).items():
        policy.check_task(task, mode, [seeding.policy_seed(episode.episode_seed) for episode in group])
    if config.variant is not None:
        factories.check_variant(config.variant, config.flags.task[0])
    for task, mode in sorted({(episode.task, episode.mode) for episode in config.episodes}):
        if modes.get(mode).layers is not None and (layer := tasks.get(task).own_layer(mode)) is not None:
            factories.check_variant(layer, task)
    config = config.with_parts(made, policy)
    for mode in config.flags.mode:
        if not (replayed or config.cameras) and any(modes.get(mode).dynamics.get("picture_noise", ())):
            raise InputError(f"--mode {mode}: picture_noise, but the policy wants no picture")
    late, chunk = config.flags.latency_ticks, getattr(policy, "chunk_size", 1)
    if 1 < chunk <= late:  # of one that does not say it, 1, the first chunk will show
        raise InputError(f"--latency-ticks {late}: expected fewer ticks than the policy's chunk of {chunk} has")
    return config, read_by(policy, config.labels, late)


@functools.cache
def _freeze_libraries() -> None:
    """Leave what loaded libraries hold out of the search for garbage at the end of each cell, which took seconds."""
    gc.freeze()


def make_env(config: RunConfig, factories: Factories, episode: Episode, worlds: int) -> World:
    """The environment of an episode's task, tracker and mode, as the run's flags say.

    Args:
        config: The run, with the parts of `check_parts`.
        episode: One of its episodes.
    """
    _freeze_libraries()
    flags = config.flags
    return factories.env(
        episode.task,
        tracker=factories.tracker(episode.tracker, config.checkpoint),
        worlds=worlds,
        engine=flags.engine,
        device=config.device,
        rules=flags.rules,
        mode=episode.mode,
        variant_file=str(config.variant) if config.variant else None,
        fast_physics=flags.fast_physics,
        cameras=config.cameras,
        drive=DRIVES[flags.drive],
    )


def _play(
    config: RunConfig,
    folder: ResultsFolder,
    factories: Factories,
    policy: Policy,
    viewer: WorldViewer | None,
    resume: str,
) -> bool:
    """Play what is missing; False when it was interrupted. Errors say how to go on: by the command `resume`."""
    with folder.opened(config) as journal:
        run = RunPlayer(config, folder, journal, factories, policy, viewer)
        try:
            with naming_the_command(resume, run.kept):
                ended, waiting = begun(config, folder, journal.records)
                if waiting:
                    run.play(ended, waiting)
        except KeyboardInterrupt:
            print(f"\ninterrupted: {run.kept()}; continue with: {resume}")
            return False
        except PolicyUnavailable as error:
            raise RunStopped(f"{error}; {run.kept()}; when it is back: {resume}") from None
    return True


class ProgressSink(Protocol):
    """Sink of the progress of episodes while they run (`progress.Progress`)."""

    def tick(self, active: int) -> None:
        """One tick of so many worlds is over."""

    def episode(self, budget: int, used: int) -> None:
        """An episode is over, with its planned ticks and those that it took."""

    def more(self, budgets: Sequence[int]) -> None:
        """Episodes with these budgets are planned besides."""

    def say(self, text: str) -> None:
        """A line for who looks on."""


@dataclass
class RunPlayer:
    """Plays episodes of a run in this process, one environment after the other."""

    config: RunConfig
    folder: ResultsFolder
    journal: EpisodeLines
    factories: Factories
    policy: Policy
    viewer: WorldViewer | None = None
    """Viewer of the worlds, if any."""
    batch: int | None = None
    """Worlds of every environment; None: as --worlds says, no more than there are episodes."""
    progress: ProgressSink = field(init=False)
    hashes: dict[str, str | None] = field(default_factory=dict)
    """Hashes by which the present environment's episodes name their run; empty before it is built."""
    ended: dict[int, EpisodeRecord] = field(default_factory=dict)
    """Episodes that are in the journal, their files whole, by number; of two lines the last."""

    def kept(self) -> str:
        """Number of planned episodes in the journal, in words."""
        return kept(self.config, self.journal.records)

    def play(self, ended: dict[int, EpisodeRecord], waiting: Mapping[Group, list[Episode]]) -> None:
        """Run what is missing, environment by environment.

        Args:
            ended: Finished episodes by number.
            waiting: Those to play, by group.
        """
        self.ended = ended
        shown = self.progress = progress_of(self.config, ended, waiting)
        try:
            with self.folder.running():
                for names, group in waiting.items():
                    shown.group(" ".join(names))
                    self.play_group(" ".join(names), group)
        finally:
            shown.close()

    def play_group(self, group: str, episodes: list[Episode]) -> None:
        """Run the episodes of a group, which has a name.

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
            env = make_env(config, self.factories, episodes[0], self.batch or min(flags.worlds, len(episodes)))
            own = env.describe() | {PROCESSOR: torch.backends.cpu.get_cpu_capability()} | shown_by(config.cameras)
            research = self.factories.measuring(env, flags.recorder)
            measuring = (self.factories.recorders, *research) if research else ()  # numbers may stand in either
            own |= {"recorders": config_hash(sorted({own_code(one) or "" for one in measuring}))} if measuring else {}
            for names in groups(order):
                facts = self.folder.register(" ".join(names), own)
            if flags.verbose:
                self.progress.say(console.environment(group, facts))
            recorder = _recorder(config, self.folder.path, tracker)
            recorders: list[Recorder] = [] if recorder is None else [recorder]
            inside = actions_folder(flags.tracker, tracker)
            actions = ActionRecorder(self.folder.keep_file, inside) if flags.actions else None
            recorders += [] if actions is None else [actions]
            if flags.viewer_failures:
                recorders.append(FailureRecorder(self.folder.path / "failures", _prefix(flags, tracker)))
            signals = SignalRecorder(env) if flags.failures else None
            recorders += [] if signals is None else [signals]
            if self.viewer is not None:
                self.viewer.open(env, group)
                recorders.append(self.viewer)
            noise = None
            if flags.disturb or config.recording is not None:
                from arena_newton.eval.play import recording  # its codecs, for which other runs do not wait

                noise = recording.disturbance_of(config, task, episodes[0].max_steps)
            recorders += [*([] if noise is None else [noise]), *research]
            if config.recording is not None:
                described = recording.facts_of(config, task, tracker, mode, facts, self.folder.installed)
                files = recording.demonstration_recorder(config, self.folder.path, described)
                recorders.append(files)

            def keep(result: EpisodeResult, media: dict[str, str]) -> None:
                pictures = recorder.media(result.episode) if recorder is not None else {}
                found = None if signals is None else signals.taken(result.episode.index)
                files, evidence = ({}, {}) if actions is None else actions.taken(result.episode.index)
                self._keep(result, pictures | files | media, found, evidence)
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
                    modes=operator.attrgetter("mode"),
                    latency=flags.latency_ticks,
                    on_finish=on_finish,
                    on_tick=on_tick,
                ).run()
                if files is not None:
                    self._keep_saved(files, keep, wait=True)
                    files.check()
                episodes = self._next_round(group, order, left)
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

    def _next_round(self, group: str, order: list[Episode], left: dict[int, Episode]) -> list[Episode]:
        """More attempts where successes are missing; they are added to what is left."""
        if self.config.flags.keep is None and self.config.width_rule is None:
            return []
        more = next((found for names, found in due(self.config, self.ended).items() if " ".join(names) == group), [])
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

    def _keep(
        self,
        result: EpisodeResult,
        media: dict[str, str],
        signals: EpisodeSignals | None = None,
        evidence: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Append an episode to the journal.

        Raises:
            RunStopped: It was played again for its recording, and ended in another way.
        """
        where, records = self.folder.path, self.journal.records
        check_again(self.config, where, records, result, result.episode, media.values())
        record = _record(result, media, self.hashes, signals, evidence, privileged=self.config.privileged)
        self.journal.append(record)
        self.ended[record.index] = record


def _recorder(config: RunConfig, folder: Path, tracker: str) -> EpisodeRecorder | None:
    """Recorder of the pictures; None when none are wanted. File names name the tracker where there are several."""
    flags = config.flags
    if not (flags.video or flags.strip):
        return None
    from arena_newton.pictures.recorder import EpisodeRecorder

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


def _metric(name: str, value: float) -> float:
    """A metric as the journal keeps it."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not is_name(name) or not math.isfinite(number):
        shown = f"metric {plain_text(name, 80)} is {plain_text(value, 80)}"
        raise InputError(f"recorder: {shown}, expected a finite number with a name")
    return number


def _record(
    result: EpisodeResult,
    media: dict[str, str],
    hashes: dict[str, str | None],
    signals: EpisodeSignals | None = None,
    evidence: Mapping[str, str] = MappingProxyType({}),
    *,
    privileged: bool = False,
) -> EpisodeRecord:
    """Journal line of an episode that ended now."""
    finished = time.time()
    planned = dataclasses.asdict(result.episode)
    del planned["rank"]
    return EpisodeRecord(
        schema=SCHEMA,
        **planned,
        privileged=privileged,
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
        extra={name: _metric(name, value) for name, value in result.extra.items()},
        actions=evidence.get("actions"),
        final_state=evidence.get("final_state"),
        shown=evidence.get("shown"),
    )
