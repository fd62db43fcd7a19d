"""Run a plan: validate everything, build one environment per task and mode, journal every episode, write the report."""

from __future__ import annotations

import dataclasses
import datetime
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

from arena_newton.errors import InputError
from arena_newton.eval import config as configs
from arena_newton.eval import report
from arena_newton.eval.config import RunConfig, RunOptions
from arena_newton.eval.journal import Journal, StorageError, write_atomic
from arena_newton.eval.plan import Episode
from arena_newton.eval.recordings import RecordingPolicy

__all__ = ["Factories", "execute", "stored_options"]


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
    stored = report.read_config(folder)["options"]
    known = {field.name for field in dataclasses.fields(RunOptions)}
    values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in stored.items() if key in known}
    return dataclasses.replace(RunOptions(**values), out=str(folder))


def execute(options: RunOptions, factories: Factories | None = None) -> int:
    """Run or continue the run that ``options`` describe.

    Returns:
        Exit code: 0 when every planned episode has an outcome other than error, 1 otherwise.

    Raises:
        InputError: a flag, file or folder is wrong; raised before the first episode.
        StorageError: the results folder cannot be written; finished episodes are kept.
    """
    factories = factories or Factories()
    config = configs.resolve(options)
    folder = Path(options.out).expanduser() if options.out else _new_folder()
    episodes = configs.episodes(config)
    policy = _check_parts(config, episodes, factories)
    config = dataclasses.replace(config, worlds_matter=policy.depends_on_worlds)
    document = _document(options, config)
    _check_folder(folder, document)
    document["planned"] = len(episodes)
    _open_folder(folder, document)
    print(f"configuration {config.hash}")
    for key, value in config.identity().items():
        print(f"  {key:<13} {_shown(value)}")
    print(f"  {len(episodes)} episodes -> {folder}", flush=True)
    if config.worlds_matter and config.worlds > 1:
        print(
            f"  the policy server does not declare that it honours seeds: if it draws random numbers, results depend "
            f"on --worlds {config.worlds} and on timing; --worlds 1 is reproducible"
        )
    if config.tracker == "pd":
        print("  --tracker pd cannot balance: expect falls; for an evaluation: --tracker twist2")

    began = time.perf_counter()
    resume = f"python -m arena_newton.eval resume {shlex.quote(str(folder))}"
    with Journal(folder / report.JOURNAL_FILE) as journal:
        if journal.torn_bytes:
            print(f"  cut a torn last line of {journal.torn_bytes} bytes off the journal", file=sys.stderr)
        done = {r["index"]: r for r in journal.records}
        if options.retry_errors:
            done = {index: record for index, record in done.items() if record["outcome"] != "error"}
        waiting = [episode for episode in episodes if episode.index not in done]
        if done:
            print(f"  {len(done)} episodes are finished, {len(waiting)} remain", flush=True)
        try:
            if waiting:
                _run_groups(config, folder, waiting, journal, factories, policy, len(done), len(episodes))
        except KeyboardInterrupt:
            kept = len({record["index"] for record in journal.records})
            print(f"\ninterrupted: {kept} of {len(episodes)} episodes are kept; continue with: {resume}")
            return 130
        except StorageError as error:
            raise StorageError(f"{error}; free space, then: {resume}") from None
        finally:
            policy.close()
    try:
        results = report.write_reports(report.load_run(folder))
    except StorageError as error:
        again = f"python -m arena_newton.eval report {shlex.quote(str(folder))}"
        raise StorageError(f"{error}; free space, then: {again}") from None
    print(f"\n{report.table(results)}")
    for note in report.notes(results):
        print(note)
    print(f"{results['finished']} episodes, this run took {time.perf_counter() - began:.0f} s")
    print(f"report: {folder / 'report.html'}")
    errors = sum(cell["errors"] for cell in results["cells"])
    return 0 if results["complete"] and not errors else 1


def _new_folder() -> Path:
    return Path("results") / datetime.datetime.now().strftime("%Y%m%d_%H%M%S")


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "-" if value is None else str(value)


def _document(options: RunOptions, config: RunConfig) -> dict[str, Any]:
    """Content of config.json."""
    from arena_newton import rules, tasks
    from arena_newton.doctor import versions

    return {
        "config_hash": config.hash,
        "config": config.identity(),
        "rule_set": dict(rules.get(config.rules).table()),
        "gym_ids": {name: tasks.get(name).gym_id for name in config.tasks},
        "options": json.loads(json.dumps(dataclasses.asdict(configs.explicit(options, config)))),
        "versions": versions(),
        "planned": 0,
    }


def _check_folder(folder: Path, document: dict[str, Any]) -> None:
    """Refuse a folder of another configuration, or one that holds something else."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is a file")
    if (folder / report.CONFIG_FILE).exists():
        stored = report.read_config(folder)
        difference = configs.differing_key(stored["config"], document["config"])
        if difference is not None:
            key, was, now = difference
            raise InputError(
                f"{folder}: holds results of another configuration: {key} was {_shown(was)}, now {_shown(now)}; "
                "choose another --out"
            )
    elif folder.exists() and any(folder.iterdir()):
        raise InputError(f"--out {folder}: is not empty and holds no results; choose another folder")


def _open_folder(folder: Path, document: dict[str, Any]) -> None:
    path = folder / report.CONFIG_FILE
    if path.exists():
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(document, indent=2) + "\n")
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be created ({error.strerror})") from None


def _check_parts(config: RunConfig, episodes: Sequence[Episode], factories: Factories) -> Any:
    """Build tracker and policy and look into plan and variant, so that wrong input shows before the first episode."""
    factories.tracker(config.tracker, config.checkpoint)
    policy = factories.policy(config.policy, **config.policy_options)
    policy.check()
    for (task, mode), group in _groups(episodes).items():
        policy.check_task(task, mode, [episode.episode_seed for episode in group])
    if config.variant is not None:
        factories.check_variant(config.variant, config.tasks[0])
    return policy


def _groups(episodes: Sequence[Episode]) -> dict[tuple[str, str], list[Episode]]:
    """Episodes by task and mode: a group runs in one environment."""
    groups: dict[tuple[str, str], list[Episode]] = {}
    for episode in episodes:
        groups.setdefault((episode.task, episode.mode), []).append(episode)
    return groups


def _run_groups(
    config: RunConfig,
    folder: Path,
    waiting: Sequence[Any],
    journal: Journal,
    factories: Factories,
    policy: Any,
    finished: int,
    planned: int,
) -> None:
    from tqdm import tqdm

    groups = _groups(waiting)
    with tqdm(total=planned, initial=finished, unit="episode", dynamic_ncols=True, smoothing=0.05) as bar:
        for (task, mode), episodes in groups.items():
            bar.set_description(f"{task} {mode}")
            _run_group(config, folder, task, mode, episodes, journal, factories, policy, bar)


def _run_group(
    config: RunConfig,
    folder: Path,
    task: str,
    mode: str,
    episodes: list[Any],
    journal: Journal,
    factories: Factories,
    policy: Any,
    bar: Any,
) -> None:
    """Run the episodes of one task and mode in one environment.

    Something that breaks the environment itself, other than wrong input or a full disk, ends this group's remaining
    episodes as errors; the other groups still run.
    """
    left = {episode.index: episode for episode in episodes}
    rate = _TickRate(bar)
    env = recorder = None
    worlds = min(config.worlds, len(episodes))
    try:
        env = factories.env(
            task,
            tracker=factories.tracker(config.tracker, config.checkpoint),
            worlds=worlds,
            engine=config.engine,
            device=config.device,
            rules=config.rules,
            mode=mode,
            variant_file=str(config.variant) if config.variant else None,
            fast_physics=config.fast_physics,
            camera=_policy_camera(policy),
        )
        if config.video or config.strip:
            from arena_newton.recorder import EpisodeRecorder

            recorder = EpisodeRecorder(folder, video=config.video, strip=config.strip)

        actor = RecordingPolicy(policy, folder / "actions") if config.actions else policy

        def on_finish(result: Any) -> None:
            if isinstance(actor, RecordingPolicy):
                assert env is not None
                actor.write(result, env.spec.gym_id)
            media = recorder.media(result.episode) if recorder is not None else {}
            journal.append(_record(config, result, media))
            left.pop(result.episode.index, None)
            bar.update()

        env.run_episodes(
            actor, episodes, on_finish=on_finish, on_tick=rate.tick, recorder=recorder, max_steps=episodes[0].max_steps
        )
    except (InputError, StorageError):
        raise
    except Exception as error:
        bar.clear()
        traceback.print_exc()
        message = f"{type(error).__name__}: {error}"
        for episode in list(left.values()):
            journal.append(_error_record(config, episode, message))
            bar.update()
    finally:
        if recorder is not None:
            recorder.close()
        env = recorder = None
        gc.collect()


def _policy_camera(policy: Any) -> Any:
    """Camera that a policy asks for; None for one that does not see."""
    if not policy.needs_image:
        return None
    own = getattr(policy, "camera", None)
    if own is not None:
        return own
    from arena_newton.camera import CameraConfig

    return CameraConfig()


class _TickRate:
    """Shows simulated world-ticks per second on the progress bar."""

    def __init__(self, bar: Any):
        self._bar, self._world_ticks, self._since = bar, 0, 0.0

    def tick(self, active: int) -> None:
        now = time.perf_counter()
        if not self._since:
            self._since = now
            return
        self._world_ticks += active
        if now - self._since >= 1.0:
            self._bar.set_postfix_str(f"{self._world_ticks / (now - self._since):.0f} world-ticks/s, {active} worlds")
            self._world_ticks, self._since = 0, now


def _record(config: RunConfig, result: Any, media: dict[str, str]) -> dict[str, Any]:
    """Journal line of a finished episode."""
    finished = time.time()
    return _base_record(config, result.episode) | {
        "outcome": result.outcome,
        "reason": result.reason,
        "steps": int(result.steps),
        "margin": float(result.margin) if math.isfinite(result.margin) else None,
        "startup_fall": bool(result.startup_fall),
        "overflow": bool(result.overflow),
        "error": result.error,
        "durations": {"wall_s": round(float(result.wall_s), 6), "sim_s": round(float(result.sim_s), 6)},
        "started_at": _iso(finished - float(result.wall_s)),
        "finished_at": _iso(finished),
        "media": media,
        "video": media.get("ego", ""),
    }


def _error_record(config: RunConfig, episode: Any, message: str) -> dict[str, Any]:
    """Journal line of an episode whose environment broke."""
    now = _iso(time.time())
    return _base_record(config, episode) | {
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


def _base_record(config: RunConfig, episode: Any) -> dict[str, Any]:
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
        },
    }


def _iso(seconds: float) -> str:
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="milliseconds")
