"""Run a plan: validate everything, build one environment per task and mode, journal every episode, write the report."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import errno
import gc
import json
import math
import shlex
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval import config as configs
from arena_newton.eval import records, report, stats
from arena_newton.eval.config import RunConfig, RunOptions
from arena_newton.eval.journal import Journal, StorageError, write_atomic
from arena_newton.eval.plan import Episode
from arena_newton.eval.progress import Progress, duration, kernels_to_compile, simulated
from arena_newton.eval.records import counted, plain_text
from arena_newton.policies.base import PolicyUnavailable

__all__ = ["Factories", "RunStopped", "execute", "new_folder", "results_folder", "stored_options"]

Versions = dict[str, str | None]

TICK_S = 0.02
"""Length of a tick [s]."""
BREAK_FILE = "break.txt"
"""Where the trace of a break is kept for who looks into it."""


class RunStopped(ArenaError):
    """Something other than an episode failed; what was played is kept, what was running stays unplayed."""


def _make_env(task: str, **options: Any) -> Any:
    from arena_newton.env import ArenaEnv

    return ArenaEnv(task, **options)


def _make_tracker(spec: str, checkpoint: Path | None) -> Any:
    from arena_newton import trackers

    return trackers.get(spec, checkpoint=str(checkpoint) if checkpoint else None)


def _make_policy(spec: str, **options: Any) -> Any:
    from arena_newton import policies

    return policies.get(spec, **options)


def _check_variant(path: Path, task: str) -> None:
    from arena_newton.usd_scenes import validate

    validate.check(path, task)


@dataclass(frozen=True)
class Factories:
    """What a run builds its parts with; tests put their own in."""

    env: Callable[..., Any] = _make_env
    tracker: Callable[[str, Path | None], Any] = _make_tracker
    policy: Callable[..., Any] = _make_policy
    check_variant: Callable[[Path, str], None] = _check_variant
    """Raises InputError for a file that is no scene of the task."""


def stored_options(folder: Path) -> RunOptions:
    """The flags that a results folder was made with, to be resumed."""
    stored = records.read_document(folder)["options"]
    where = f"{folder / records.CONFIG_FILE}: options"
    return dataclasses.replace(RunOptions(**records.check_types(where, stored, RunOptions)), out=str(folder))


def execute(options: RunOptions, factories: Factories | None = None) -> int:
    """Run or continue the run that ``options`` describe.

    Returns:
        Exit code: 0 when every planned episode has an outcome other than error, 1 otherwise, 130 when interrupted.

    Raises:
        InputError: a flag, file or folder is wrong; raised before the first episode.
        StorageError: the results folder cannot be written; finished episodes are kept.
        RunStopped: simulator, tracker or policy broke down as a whole; finished episodes are kept.
    """
    factories = factories or Factories()
    from arena_newton.doctor import versions

    config = configs.resolve(options)
    installed = versions()
    folder = results_folder(options)
    _check_folder(folder, config, options, installed)
    episodes = configs.episodes(config)
    try:
        config, policy = _check_parts(config, episodes, factories)
    except SystemExit as stop:
        parts = f"--tracker {config.tracker} or --policy {configs.policy_label(config.policy)}"
        raise RunStopped(f"{parts}: left with SystemExit: {stop.code} before the first episode") from None
    began = time.perf_counter()
    resume = f"python -m arena_newton.eval resume {shlex.quote(str(folder))}"
    try:
        _make_folder(folder)
        with Journal(folder / records.JOURNAL_FILE) as journal:
            document = _settle(folder, options, config, len(episodes), installed, journal.records)
            run = _Run(options, config, folder, episodes, journal, factories, policy, document)
            run.hashes["config"] = document["config_hash"]
            run.hashes["versions"] = configs.config_hash(configs.moving_versions(installed))
            try:
                run.play()
            except KeyboardInterrupt:
                print(f"\ninterrupted: {run.kept()}; continue with: {resume}")
                return 130
            except StorageError as error:
                raise StorageError(f"{error}; free space, then: {resume}") from None
            except PolicyUnavailable as error:
                raise RunStopped(f"{error}; {run.kept()}; when it is back: {resume}") from None
            except RunStopped as error:
                raise RunStopped(f"{error}; {run.kept()}; continue with: {resume}") from None
            finally:
                _sweep(folder)
    finally:
        policy.close()
    try:
        loaded = report.load_run(folder)
        results = report.write_reports(loaded)
    except StorageError as error:
        again = f"python -m arena_newton.eval report {shlex.quote(str(folder))}"
        raise StorageError(f"{error}; free space, then: {again}") from None
    print(f"\n{report.table(results)}")
    for note in report.notes(results):
        print(note)
    errors = sum(cell["errors"] for cell in results["cells"])
    if errors:
        print(_reasons(loaded.records, f"{resume} --retry-errors"))
    print(f"{counted(results['finished'], 'episode')}, this run took {duration(time.perf_counter() - began)}")
    print(f"report: {folder / 'report.html'}")
    return 0 if results["complete"] and not errors else 1


def _reasons(played: Sequence[dict[str, Any]], again: str) -> str:
    """Why episodes ended as errors, with counts, and how to run them again."""
    lines = [f"  {cause['count']:>4} x {cause['reason']}: {cause['message']}" for cause in stats.error_reasons(played)]
    return "\n".join(["Errors:", *lines, f"Run them again with: {again}"])


def _sweep(folder: Path) -> None:
    """Remove what unfinished recordings left."""
    for pattern in ("videos/*.part", "strips/*.part", "actions/*.partial"):
        for part in folder.glob(pattern):
            with contextlib.suppress(OSError):
                part.unlink()


def results_folder(options: RunOptions) -> Path:
    """Folder of --out; a new one where none is named.

    Raises:
        InputError: --out names nothing.
    """
    if options.out is None:
        return new_folder()
    if not options.out.strip():
        raise InputError("--out: is empty, name a folder")
    return Path(options.out).expanduser()


def new_folder() -> Path:
    """Results folder of a run that names none, by the time of day."""
    return Path("results") / datetime.datetime.now().strftime("%Y%m%d_%H%M%S")


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "-" if value is None else str(value)


def _document(options: RunOptions, config: RunConfig, planned: int, installed: Versions) -> dict[str, Any]:
    """Content of config.json; what the environments say of themselves is added when they are built."""
    from arena_newton import rule_sets, tasks

    return {
        "config_hash": config.hash,
        "config": config.identity(),
        "rule_set": dict(rule_sets.table(rule_sets.get(config.rules))),
        "gym_ids": {name: tasks.get(name).gym_id for name in config.tasks},
        "options": json.loads(json.dumps(dataclasses.asdict(configs.explicit(options, config)))),
        "versions": installed,
        "planned": planned,
        "environments": {},
    } | _variant_changes(config)


def _variant_changes(config: RunConfig) -> dict[str, list[str]]:
    """What a variant changes of robot, gravity and rules, in sentences."""
    if config.variant is None:
        return {}
    from arena_newton.usd_scenes import validate

    return {"variant_changes": validate.differences(config.variant, config.tasks[0])}


def _check_folder(folder: Path, config: RunConfig, options: RunOptions, installed: Versions) -> dict[str, Any] | None:
    """Refuse a folder of another configuration or of other libraries, or one that holds something else.

    Returns:
        The stored config.json; None in a new folder.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is a file")
    if not (folder / records.CONFIG_FILE).exists():
        begun = {records.JOURNAL_FILE}  # what a run leaves that was killed at its very start
        found = {path.name: path for path in folder.iterdir()} if folder.exists() else {}
        if any(name not in begun or path.is_symlink() or path.stat().st_size for name, path in found.items()):
            raise InputError(f"--out {folder}: is not empty and holds no results; choose another folder")
        return None
    records.check_folder(folder)
    stored = records.read_document(folder)
    unknown = () if config.tracker_facts is not None else ("tracker_facts", "policy_facts", "worlds")
    difference = configs.differing_key(stored["config"], config.identity(), unknown)
    if difference is not None:
        key, was, now = difference
        raise InputError(
            f"{folder}: holds results of another configuration: {key} was {_shown(was)}, now {_shown(now)}; "
            "choose another --out"
        )
    known = [configs.moving_versions(v) for v in (stored.get("versions", {}), *stored.get("later_versions", ()))]
    now = configs.moving_versions(installed)
    if now not in known and not options.accept_versions:
        library, was, is_now = configs.differing_key(known[-1], now) or ("versions", None, None)
        raise InputError(
            f"{folder}: was run with {library} {_shown(was)}, installed is {_shown(is_now)}, and results may differ; "
            "install that version, choose another --out, or mix both with --accept-versions"
        )
    return stored


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be created ({error.strerror})") from None


def _settle(
    folder: Path,
    options: RunOptions,
    config: RunConfig,
    planned: int,
    installed: Versions,
    played: Sequence[dict[str, Any]],
) -> dict[str, Any]:
    """Write config.json into a new folder, or hold the run to the one that is there; the journal's lock is held.

    Returns:
        Content of config.json.
    """
    path = folder / records.CONFIG_FILE
    stored = _check_folder(folder, config, options, installed)
    document = _document(options, config, planned, installed) if stored is None else stored
    records.check_plan(folder / records.JOURNAL_FILE, played, document)
    sets = [document.get("versions", {}), *document.get("later_versions", ())]
    if configs.moving_versions(installed) not in map(configs.moving_versions, sets):
        document["later_versions"] = [*sets[1:], installed]
    elif stored is not None:
        return document
    write_atomic(path, json.dumps(document, indent=2) + "\n")
    return document


def _check_parts(config: RunConfig, episodes: Sequence[Episode], factories: Factories) -> tuple[RunConfig, Any]:
    """Build tracker and policy and look into plan and variant, so that wrong input shows before the first episode.

    Returns:
        The configuration with what both say of themselves, and the policy.
    """
    tracker = factories.tracker(config.tracker, config.checkpoint)
    policy = factories.policy(config.policy, **config.policy_options)
    policy.check()
    for (task, mode), group in _groups(episodes).items():
        policy.check_task(task, mode, [episode.episode_seed for episode in group])
    if config.variant is not None:
        factories.check_variant(config.variant, config.tasks[0])
    known = dataclasses.replace(
        config,
        worlds_matter=policy.depends_on_worlds,
        tracker_facts=_facts(tracker),
        policy_facts=_facts(policy),
    )
    return known, policy


def _facts(part: Any) -> dict[str, Any]:
    """What a tracker or policy says of itself as JSON, and the hash of its code where that is another package's."""
    code = configs.own_code(part)
    return _plain(part.describe() | ({} if code is None else {"code": code}))


def _plain(facts: dict[str, Any]) -> dict[str, Any]:
    """Facts as strict JSON gives them back; anything else as text."""
    return json.loads(json.dumps(facts, default=str))


def _groups(episodes: Sequence[Episode]) -> dict[tuple[str, str], list[Episode]]:
    """Episodes by task and mode: a group runs in one environment."""
    groups: dict[tuple[str, str], list[Episode]] = {}
    for episode in episodes:
        groups.setdefault((episode.task, episode.mode), []).append(episode)
    return groups


@dataclass
class _Run:
    """What all groups of a run share."""

    options: RunOptions
    config: RunConfig
    folder: Path
    episodes: list[Episode]
    journal: Journal
    factories: Factories
    policy: Any
    document: dict[str, Any]
    """Content of config.json."""
    progress: Progress = dataclasses.field(init=False)
    _built: bool = False
    """Whether the environment stands, so that a break is one of its episodes."""
    hashes: dict[str, str] = dataclasses.field(default_factory=dict)
    """Of the environment and of the libraries' versions."""

    def kept(self) -> str:
        """How many of the planned episodes are in the journal, in words."""
        finished = len({record["index"] for record in self.journal.records})
        return f"{finished} of {counted(len(self.episodes), 'episode')} kept"

    def play(self) -> None:
        """Run what is missing, task by task and mode by mode."""
        if self.journal.torn_bytes:
            torn = counted(self.journal.torn_bytes, "byte")
            print(f"  cut a torn last line of {torn} off the journal", file=sys.stderr)
        done = self._done()
        waiting = [episode for episode in self.episodes if episode.index not in done]
        self._announce(len(done), waiting)
        if not waiting:
            return
        budget = {episode.index: episode.max_steps for episode in self.episodes}
        self.progress = Progress(
            sum(budget.values()),
            planned=len(self.episodes),
            finished=len(done),
            done=sum(budget[index] for index in done),
        )
        try:
            for (task, mode), group in _groups(waiting).items():
                self.progress.group(f"{task} {mode}")
                self._play_group(task, mode, group)
        finally:
            self.progress.close()

    def _done(self) -> dict[int, dict[str, Any]]:
        """Finished episodes by number; each must be the plan's."""
        planned = {episode.index: episode for episode in self.episodes}
        done = {}
        for record in self.journal.records:
            episode = planned.get(record["index"])
            same = ("task", "mode", "group_seed", "repeat", "episode_seed", "object_seed", "max_steps")
            parts = ("tracker", "policy", "rules", "engine")
            if episode is None or any(record.get(key) != getattr(episode, key) for key in (*same, *parts)):
                raise InputError(
                    f"{self.journal.path}: episode {record['index']} is not that of the plan; the journal was changed "
                    "by hand"
                )
            done[record["index"]] = record
        if self.options.retry_errors:
            done = {index: record for index, record in done.items() if record["outcome"] != "error"}
        return done

    def _announce(self, finished: int, waiting: Sequence[Episode]) -> None:
        """Configuration and size of the run in two lines, or as a whole."""
        c = self.config
        if self.options.verbose:
            print(f"configuration {c.hash}")
            for key, value in c.identity().items():
                print(f"  {key:<13} {_shown(value)}")
        else:
            tasks = " ".join(c.tasks) if len(c.tasks) < 4 else f"{len(c.tasks)} tasks"
            parts = (tasks, " ".join(c.modes), f"tracker {c.tracker}", f"policy {configs.policy_label(c.policy)}")
            print(f"configuration {c.hash}: {', '.join(parts)}, rules {c.rules}, engine {c.engine} on {c.device}")
        size = f"{finished} finished, {len(waiting)} remain" if finished else ""
        size = ", ".join(filter(None, (counted(len(self.episodes), "episode"), size)))
        if not waiting:
            print(f"  {counted(len(self.episodes), 'episode')}, all finished -> {self.folder}", flush=True)
            return
        worlds = min(c.worlds, max(map(len, _groups(waiting).values())))
        most = simulated(sum(episode.max_steps for episode in waiting))
        print(f"  {size}, {counted(worlds, 'world')} at once, {most} -> {self.folder}", flush=True)
        if c.worlds_matter and c.worlds > 1:
            print(
                f"  the policy server does not declare that it honours seeds: if it draws random numbers, results "
                f"depend on --worlds {c.worlds} and on timing; --worlds 1 is reproducible"
            )
        if c.tracker == "pd":
            print("  --tracker pd cannot balance: expect falls; for an evaluation: --tracker twist2")

    def _play_group(self, task: str, mode: str, episodes: list[Episode]) -> None:
        """Run the episodes of one task and mode.

        What breaks an environment as a whole says nothing about its episodes: it stops the run and leaves them
        unplayed. On --skip-broken those that were running end as errors, and the rest goes on in a new environment.
        """
        left = {episode.index: episode for episode in episodes}
        while left:
            started = min(self.config.worlds, len(left))
            order = list(left.values())
            try:
                self._play_in_one(task, mode, order, left)
                return
            except (InputError, StorageError, PolicyUnavailable, RunStopped):
                raise
            except OSError as error:
                self._keep_trace()
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    where = plain_text(error.filename or self.folder)
                    raise StorageError(f"{where}: disk full; {self.kept()}, what was running is not") from None
                raise RunStopped(_failed(task, mode, error)) from None
            except (Exception, SystemExit) as error:  # a part that leaves must not end the run as if all were played
                self._keep_trace()
                # The next episode starts as soon as a world is free, so these are what was running.
                running = [e for e in order[: started + len(order) - len(left)] if e.index in left]
                message = plain_text(f"{type(error).__name__}: {error}", 300)
                if not self.options.skip_broken or not self._built:
                    raise RunStopped(_broken(task, mode, message, running if self._built else [])) from None
                self.progress.say(f"  {task} {mode}: {message}; {counted(len(running), 'episode')} end as errors")
                for episode in running:
                    self.journal.append(_error_record(self.config, episode, message, self.hashes))
                    del left[episode.index]
                    self.progress.episode(episode.max_steps, 0)

    def _play_in_one(self, task: str, mode: str, episodes: list[Episode], left: dict[int, Episode]) -> None:
        """Run episodes in one environment; those that end are taken out of ``left``."""
        from arena_newton.eval.recordings import ActionRecorder
        from arena_newton.rollout import Rollout

        c = self.config
        self._built = False
        env = recorder = None
        if kernels_to_compile(_kernel_cache(), c.engine, c.device):
            self.progress.say("  compiling kernels, once; this takes a minute or some")
        try:
            env = self.factories.env(
                task,
                tracker=self.factories.tracker(c.tracker, c.checkpoint),
                worlds=min(c.worlds, len(episodes)),
                engine=c.engine,
                device=c.device,
                rules=c.rules,
                mode=mode,
                variant_file=str(c.variant) if c.variant else None,
                fast_physics=c.fast_physics,
                camera=_policy_camera(self.policy),
                drive=_drive(c.drive),
            )
            self._register(f"{task} {mode}", env)
            recorder = _recorder(c, self.folder)
            recorders: list[Any] = [] if recorder is None else [recorder]
            recorders += [ActionRecorder(self.folder / "actions")] if c.actions else []

            def on_finish(result: Any) -> None:
                media = recorder.media(result.episode) if recorder is not None else {}
                self.journal.append(_record(c, result, media, self.hashes))
                left.pop(result.episode.index, None)
                self.progress.episode(result.episode.max_steps, round(result.sim_s / TICK_S))

            self._built = True
            Rollout(
                env,
                self.policy,
                episodes,
                recorder=recorders,
                max_steps=episodes[0].max_steps,
                on_finish=on_finish,
                on_tick=self.progress.tick,
            ).run()
        finally:
            if recorder is not None:
                recorder.close()
            if env is not None:
                env.close()
            env = recorder = None
            gc.collect()

    def _register(self, group: str, env: Any) -> None:
        """Keep what an environment says of itself, once per task and mode; refuse another one than before.

        Raises:
            InputError: Earlier episodes of this task and mode were run in an environment that differs.
        """
        facts = _plain(env.describe())
        known = self.document.setdefault("environments", {})
        if group in known:
            difference = configs.differing_key(_comparable(known[group]), _comparable(facts))
            if difference is not None:
                key, was, now = difference
                raise InputError(
                    f"{self.folder}: {group} was run with {key} {_shown(was)}, now it is {_shown(now)}; "
                    "choose another --out"
                )
        else:
            known[group] = facts
            write_atomic(self.folder / records.CONFIG_FILE, json.dumps(self.document, indent=2) + "\n")
        if self.options.verbose:
            told = ", ".join(f"{key} {_shown(value)}" for key, value in facts.items() if key != "tracker")
            self.progress.say(f"  {group}: {told}, tracker {_shown(facts.get('tracker'))}")
        self.hashes["environment"] = configs.config_hash(_comparable(facts))

    def _keep_trace(self) -> None:
        with contextlib.suppress(ArenaError, ValueError):
            write_atomic(self.folder / BREAK_FILE, traceback.format_exc())


def _broken(task: str, mode: str, message: str, running: Sequence[Episode]) -> str:
    """What is said of an environment that broke."""
    text = f"{task} {mode}: {message}"
    if "out of memory" in message.lower() or message.startswith("MemoryError"):
        text += " (fewer --worlds need less)"
    if running:
        seeds = " ".join(f"s{e.group_seed}/r{e.repeat}" for e in running[:8]) + (" ..." if len(running) > 8 else "")
        text += f"; running were {seeds}, which stay unplayed (--worlds 1 --skip-broken passes one that always breaks)"
    return f"{text}; trace in {BREAK_FILE}"


def _failed(task: str, mode: str, error: OSError) -> str:
    """What is said of a file that could not be written or a connection that broke."""
    cause = plain_text(error.strerror or error)
    named = f"{plain_text(error.filename)}: {cause}" if error.filename else cause
    return f"{task} {mode}: {type(error).__name__}: {named}; running episodes stay unplayed; trace in {BREAK_FILE}"


def _drive(name: str) -> Any:
    """Drive gains of --drive; None for those that tracker and rule set ask for."""
    from arena_newton import robot

    return {"twist2": robot.TWIST2_DRIVE, "humanoidarena": robot.TWIST2_HUMANOIDARENA_DRIVE}.get(name)


def _comparable(facts: dict[str, Any]) -> dict[str, Any]:
    """Facts of an environment without the number of its device: `cuda:0` and `cuda:1` are alike."""
    return {key: str(value).split(":")[0] if key == "device" else value for key, value in facts.items()}


def _kernel_cache() -> Path:
    import warp as wp

    return Path(wp.config.kernel_cache_dir or ".")


def _recorder(config: RunConfig, folder: Path) -> Any:
    """What takes the pictures; None when none are wanted."""
    if not (config.video or config.strip):
        return None
    from arena_newton.pictures.recorder import EpisodeRecorder

    asked: dict[str, Any] = {"episodes": config.video_episodes, "size": config.video_size, "follow": config.follow}
    given = {key: value for key, value in asked.items() if value}
    return EpisodeRecorder(folder, video=config.video, strip=config.strip, **given)


def _policy_camera(policy: Any) -> Any:
    """Camera that a policy asks for; None for one that does not see."""
    if not policy.needs_image:
        return None
    own = getattr(policy, "camera", None)
    if own is not None:
        return own
    from arena_newton.pictures.camera import CameraConfig

    return CameraConfig()


def _record(config: RunConfig, result: Any, media: dict[str, str], hashes: dict[str, str]) -> dict[str, Any]:
    """Journal line of a finished episode."""
    finished = time.time()
    return _base_record(config, result.episode, hashes) | {
        "outcome": result.outcome,
        "reason": result.reason,
        "steps": int(result.steps),
        "margin": float(result.margin) if math.isfinite(result.margin) else None,
        "startup_fall": bool(result.startup_fall),
        "overflow": bool(result.overflow),
        "error": None if result.error is None else plain_text(result.error),
        "durations": {"wall_s": round(float(result.wall_s), 6), "sim_s": round(float(result.sim_s), 6)},
        "started_at": _iso(finished - float(result.wall_s)),
        "finished_at": _iso(finished),
        "media": media,
        "video": media.get("ego", ""),
    }


def _error_record(config: RunConfig, episode: Any, message: str, hashes: dict[str, str]) -> dict[str, Any]:
    """Journal line of an episode whose environment broke."""
    now = _iso(time.time())
    return _base_record(config, episode, hashes) | {
        "outcome": "error",
        "reason": "environment",
        "steps": 0,
        "margin": None,
        "startup_fall": False,
        "overflow": False,
        "error": message,
        "durations": {"wall_s": 0.0, "sim_s": 0.0},
        "started_at": now,
        "finished_at": now,
        "media": {},
        "video": "",
    }


def _base_record(config: RunConfig, episode: Any, hashes: dict[str, str]) -> dict[str, Any]:
    return {
        "index": episode.index,
        "task": episode.task,
        "tracker": episode.tracker,
        "policy": episode.policy,
        "mode": episode.mode,
        "rules": episode.rules,
        "engine": episode.engine,
        "group_seed": episode.group_seed,
        "repeat": episode.repeat,
        "episode_seed": episode.episode_seed,
        "object_seed": episode.object_seed,
        "max_steps": episode.max_steps,
        "hashes": {
            "config": config.hash,
            "rules": config.rules_hash,
            "checkpoint": config.checkpoint_hash,
            "policy": config.policy_hash,
            "variant": config.variant_hash,
            **hashes,
        },
    }


def _iso(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="milliseconds")
