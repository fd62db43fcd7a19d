"""Recording as a sink of evaluation: the recorder of an environment, what its files say of the run, what is recorded.

A run with `--record` writes `episodes/<episode>.npz` and `episodes/videos/` beside its journal; an episode's line is
appended once its files are on the disk.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import av

from arena_newton import rule_sets
from arena_newton import tasks as task_specs
from arena_newton.data.recording.demonstration import DemonstrationRecorder, episode_label
from arena_newton.data.recording.disturbed_execution import ActionNoise
from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.data.recording.noise_levels import NoiseLevels
from arena_newton.errors import InputError
from arena_newton.eval.folders.run_folder import EPISODES, comparable
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.records.identity import mode_facts, moving_versions, scenes_hash
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import counted

__all__ = [
    "demonstration_recorder",
    "disturbance_of",
    "encoding_processes",
    "encoding_threads",
    "facts_of",
    "is_recorded",
    "lights_of",
    "outcome_lines",
]

MOST_ENCODERS = 16
"""Threads or processes that encode pictures, at most; otherwise as many as there are cores."""
PROCESS_CORES = 4
"""Cores from which on processes encode: threads of one process use little more than three."""


def facts_of(
    config: RunConfig, task: str, tracker: str, mode: str, environment: JsonObject, versions: Mapping[str, str | None]
) -> JsonObject:
    """Facts about the run in an episode's file: all that its bytes depend on, and no time, folder or number of worlds.

    Only what concerns the episode's own task, tracker and mode: its bytes do not depend on what else was played.
    """
    identity, flags = config.identity(), config.flags
    left_out = (
        "task",
        "mode",
        "tracker",
        "seeds",
        "repeats",
        "keep",
        "checkpoint",
        "tracker_facts",
        "scenes",
        "mode_facts",
        "foreign_tasks",
    )
    facts: JsonObject = {key: value for key, value in identity.items() if key not in left_out}
    own = mode_facts(mode, rule_sets.get(flags.rules), (task,))
    return facts | {
        "checkpoint": config.checkpoint_hashes[tracker],
        "tracker_facts": (config.tracker_facts or {}).get(tracker),
        "rules_hash": rule_sets.get(flags.rules).hash_for((task,)),
        "scenes": scenes_hash((task,), task_specs.OWN, (mode,)),
        "environment": comparable(environment),
        "versions": moving_versions(dict(versions)) | {"av": av.__version__},
        **({"mode_facts": own} if own else {}),
        **({"foreign_task": config.foreign_tasks[task]} if task in config.foreign_tasks else {}),
        **({"disturbance": noise.describe()} if (noise := disturbance_of(config, task, 1)) is not None else {}),
    }


def demonstration_recorder(config: RunConfig, folder: Path, facts: JsonObject) -> DemonstrationRecorder:
    """The recorder of an environment of a run that records."""
    assert config.recording is not None
    return DemonstrationRecorder(
        folder / EPISODES,
        cameras=config.recording,
        depth=config.flags.record_depth,
        looks=config.flags.record_looks,
        only_success=config.flags.keep is not None,
        facts=facts,
        threads=encoding_threads(),
        processes=encoding_processes(),
    )


def encoding_threads() -> int:
    """Threads that encode pictures, and write files: one per core that this process may use, up to `MOST_ENCODERS`."""
    return max(1, min(MOST_ENCODERS, len(os.sched_getaffinity(0))))


def encoding_processes() -> int:
    """Processes that encode pictures instead of threads: all cores but the simulation's, none with few cores."""
    cores = len(os.sched_getaffinity(0))
    return 0 if cores < PROCESS_CORES else min(MOST_ENCODERS, cores - 1)


def disturbance_of(config: RunConfig, task: str, ticks: int) -> ActionNoise | None:
    """Disturbance of the execution of a task's episodes of so many ticks at most; None without one."""
    return ActionNoise(ticks, NoiseLevels().scaled(config.noise_scale(task))) if config.flags.disturb else None


def is_recorded(config: RunConfig, folder: Path, record: EpisodeRecord, episode: Episode) -> bool:
    """True if the files of a journalled episode are whole, or it has none to write.

    Files get their names when they are complete, so that this finds what was removed, cut or exchanged later.
    """
    if config.recording is None or record.outcome == "error" or record.steps < 1:
        return True
    if config.flags.keep is not None and record.outcome != "success":
        return True
    path = folder / EPISODES / f"{episode_label(episode)}.npz"
    try:
        if path.is_symlink():
            return False
        file = EpisodeFile(path)
        same = file.integer("arena_episode_seed") == episode.episode_seed and file.rows == record.steps
        same &= config.flags.record_looks == lights_of(file)
        return same and set(file.cameras) == set(config.recording) and _whole(file, file.cameras)
    except InputError:
        return False


def lights_of(file: EpisodeFile) -> int:
    """Second lights of a recorded episode's looks; 0 without looks.

    Raises:
        InputError: The looks are damaged, or their film is absent.
    """
    found = file.looks("front") if "front" in file.cameras else None
    return 0 if found is None else len(found[0].lights)


def _whole(file: EpisodeFile, cameras: Iterable[str]) -> bool:
    """True if each video has a frame per row, by its index."""
    for camera in cameras:
        try:
            with av.open(str(file.video(camera))) as video:
                if video.streams.video[0].frames != file.rows:
                    return False
        except (av.error.FFmpegError, OSError, IndexError):
            return False
    return True


def outcome_lines(config: RunConfig, folder: Path, records: Sequence[EpisodeRecord]) -> list[str]:
    """Lines on the recorded and dropped episodes, their folder, and the command that makes a dataset of them."""
    if config.recording is None:
        return []
    keep = config.flags.keep
    kept = [r for r in records if r.steps and (r.outcome == "success" if keep is not None else r.outcome != "error")]
    dropped = Counter(r.outcome for r in records) - Counter(r.outcome for r in kept)
    size = sum(file.stat().st_size for file in (folder / EPISODES).rglob("*") if file.is_file())
    rows = sum(r.steps for r in kept)
    line = f"recorded: {counted(len(kept), 'episode')}, {rows:,} ticks, {size / 1e6:,.1f} MB -> {folder / EPISODES}"
    found = [line]
    if dropped:
        words = ", ".join(f"{number} {outcome}" for outcome, number in sorted(dropped.items()))
        found.append(f"not kept: {words}")
    if keep is not None:
        groups = Counter((r.task, r.tracker, r.mode) for r in kept)
        planned = dict.fromkeys((e.task, e.tracker, e.mode) for e in config.episodes)
        found += [
            f"{' '.join(group)}: {groups[group]} of {keep} successes, no attempts left"
            for group in planned
            if groups[group] < keep
        ]
    if not kept:
        return found
    return [*found, f"dataset: python -m arena_newton.data build {folder} --out <dataset>"]
