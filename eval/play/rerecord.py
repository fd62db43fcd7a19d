"""`eval record --from`: recorded episodes are played again, action by action, and get the pictures that they lack.

What was executed is replayed from the episode's seed through its tracker, so that on engine `mujoco` every position of
every tick is the recorded one, bit for bit; that is checked. The source is only read, and its pictures of other cameras
are copied.
"""

from __future__ import annotations

import dataclasses
import errno
import shutil
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from arena_newton.cli.flags import flag_name
from arena_newton.cli.quiet import quiet_warp
from arena_newton.data.recording.demonstration import DemonstrationRecorder, RecordedEpisode
from arena_newton.data.recording.episode import (
    CAMERAS,
    VIDEO_FOLDER,
    EpisodeFile,
    camera_fields,
    episode_files,
    opened,
    vision,
)
from arena_newton.doctor import versions
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.folders.run_folder import EPISODES, SUBFOLDERS, setting
from arena_newton.eval.plan.config import RunConfig, plain_facts, recorded_cameras, resolve
from arena_newton.eval.plan.flag_checks import DRIVES
from arena_newton.eval.plan.options import RecordOptions, RunOptions, Workers, flags_of
from arena_newton.eval.play import recording
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.records.identity import differing_key
from arena_newton.eval.records.journal import StorageError
from arena_newton.eval.reports.progress import Progress
from arena_newton.files.own_files import PARTIAL, replace_atomically
from arena_newton.files.text import counted, plain_text
from arena_newton.interfaces import EpisodeResult, World
from arena_newton.kernels import tick as codes
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION

__all__ = ["run"]

MOVING = """checkpoint code drive engine environment fast_physics rules_hash scenes tracker_facts variant
    versions""".split()
"""Facts of a recording on which its motion depends."""


class ReplayDiffers(ArenaError):
    """An episode that was played again did not move as the recorded one."""

    exit_code = 1


def run(options: RecordOptions, factories: Factories | None = None) -> int:
    """Play recorded episodes again and write them with other cameras.

    Returns:
        Exit code: 0 done, 130 interrupted.

    Raises:
        InputError: A flag, a file or the folder is unfit, or the recording was made with other code, weights or rules.
        ReplayDiffers: A position differs on engine `mujoco`; names the episode and its first such tick.
        StorageError: A file cannot be written; whole episodes are kept.
    """
    quiet_warp()
    source, out = _folders(options)
    files = list(opened(episode_files([source])))
    stems = [file.stem for file in files]
    groups: dict[tuple[str, ...], list[EpisodeFile]] = {}
    for file in files:
        if "arena_cleaned" in file:
            raise InputError(f"{file.path}: was cleaned, rows are missing; name the recording that it was made of")
        if stems.count(file.stem) > 1:
            raise InputError(f"{source}: {file.stem} is there twice")
        names = ("arena_task", "arena_tracker", "arena_mode", "arena_rules")
        groups.setdefault((*map(file.text, names), file.text("arena_configuration")), []).append(file)
    checked = {key: _checked(options, key, group, factories or Factories()) for key, group in groups.items()}
    waiting = {key: [f for f in group if not _done(out, f, checked[key])] for key, group in groups.items()}
    left = sum(map(len, waiting.values()))
    print(f"{counted(len(files), 'episode')} of {source}, {left} to play again -> {out}", flush=True)
    replay = _Replay(out, options, factories or Factories())
    total, finished = sum(file.rows for file in files), [f for key in groups for f in groups[key]]
    finished = [file for file in finished if not any(file in group for group in waiting.values())]
    progress = Progress(total, planned=len(files), finished=len(finished), done=sum(file.rows for file in finished))
    try:
        for key, group in waiting.items():
            if group:
                progress.group(" ".join(key[:3]))
                replay.play(checked[key], group, progress)
    except KeyboardInterrupt:
        print("\ninterrupted; the same command continues")
        return 130
    except OSError as error:
        cause = "disk full" if error.errno in (errno.ENOSPC, errno.EDQUOT) else error.strerror or str(error)
        raise StorageError(f"{plain_text(error.filename or out)}: {cause}; the same command continues") from None
    finally:
        progress.close()
        for part in (*(out / EPISODES).glob(f"*{PARTIAL}"), *(out / EPISODES / VIDEO_FOLDER).glob(f"*{PARTIAL}")):
            part.unlink(missing_ok=True)
    if left:
        print(f"largest deviation of a position from the recording: {replay.deviation:g}")
    print(f"recorded: {counted(len(files), 'episode')} -> {out / EPISODES}")
    print(f"dataset: python -m arena_newton.data build {out} --out <dataset>")
    return 0


def _folders(options: RecordOptions) -> tuple[Path, Path]:
    """Source and target."""
    source = Path(str(options.source)).expanduser()
    if options.out is None:
        raise InputError("record --from: name a folder for the new files with --out")
    recorded = (
        "task tracker mode policy rules episodes only_success disturb disturb_scale seed_series max_steps drive shard"
    )
    for name in (*recorded.split(), *flags_of(Workers)):
        if getattr(options, name) != getattr(RecordOptions, name):
            why = "plays a plan" if name in flags_of(Workers) else "is in the recording"
            raise InputError(f"{flag_name(name)}: {why}; drop it beside --from")
    if not options.cameras:
        raise InputError("--cameras: names none; record --from is for pictures")
    pictures = RunOptions(record_cameras=options.cameras, record_size=options.size, record_depth=options.depth)
    recorded_cameras(dataclasses.replace(pictures, record_looks=options.looks), "--")
    out = Path(options.out).expanduser()
    if out.resolve() == source.resolve() or source.resolve().is_relative_to(out.resolve()):
        raise InputError(f"--out {out}: is the source, which stays as it is; choose another folder")
    if out.exists() and (not out.is_dir() or any(path.name != EPISODES for path in out.iterdir())):
        raise InputError(f"--out {out}: is no folder of episodes; choose another folder")
    for name in SUBFOLDERS:
        if (out / name).is_symlink():
            raise InputError(f"{out / name}: is a link; episodes are written inside their own folder only")
    return source, out


def _done(out: Path, source: EpisodeFile, config: RunConfig) -> bool:
    """True if an earlier call wrote the episode with these cameras."""
    path = out / EPISODES / source.path.name
    try:
        if not path.is_file() or path.is_symlink():
            return False
        file = EpisodeFile(path)
        for camera, picture in (config.recording or {}).items():
            file.video(camera)
            size = file.array(f"arena_{vision(camera, 'size')}", 2).tolist()
            if size != [picture.width, picture.height]:
                return False
            if config.flags.record_depth and vision(camera, "depth") not in file:
                return False
        if config.flags.record_looks and config.flags.record_looks != recording.lights_of(file):
            return False
        return file.integer("arena_episode_seed") == source.integer("arena_episode_seed")
    except InputError:
        return False


def _checked(options: RecordOptions, key: tuple[str, ...], group: Sequence[EpisodeFile], made: Factories) -> RunConfig:
    """Configuration with which the episodes of a group are played: as they were recorded.

    Raises:
        InputError: It was recorded with something else than what is installed here.
    """
    task, tracker, mode, rules, _ = key
    stored = group[0].json("arena_configuration")
    drive, fast = stored.get("drive", "auto"), stored.get("fast_physics", False) or options.fast_physics
    if "environment" not in stored:  # a person's session names the environment's drive, which --drive may not know
        drive = "auto"
    engine = stored.get("engine", "mujoco") if options.engine == "auto" else options.engine
    flags = RunOptions(
        task=(task,),
        tracker=(tracker,),
        mode=(mode,),
        rules=rules,
        policy="stand",
        checkpoint=options.checkpoint,
        drive=str(drive),
        fast_physics=bool(fast),
        engine=str(engine),
        device=options.device,
        variant=options.variant,
        worlds=options.worlds,
        seeds=(0,),
        repeats=1,
        record=True,
        record_cameras=options.cameras,
        record_size=options.size,
        record_depth=options.depth,
        record_looks=options.looks,
        verbose=options.verbose,
    )
    config = resolve(flags)
    # Of the policy only its name is known here, and it moves nothing: its actions are in the file.
    config = dataclasses.replace(
        config, tracker_facts={tracker: plain_facts(made.tracker(tracker, config.checkpoint).describe())}
    )
    _refuse_differences(options, config, group[0], {})
    return config


def _refuse_differences(
    options: RecordOptions, config: RunConfig, file: EpisodeFile, environment: Mapping[str, object]
) -> None:
    """Hold what is installed here to what a file says; what it does not say is not compared."""
    stored, (tracker,) = dict(file.json("arena_configuration")), config.flags.tracker
    if environment and "environment" not in stored:
        named = {key: stored[key] for key in environment if key in stored}
        stored, environment = {"environment": named}, {key: environment[key] for key in named}
    elif "environment" not in stored:
        return
    flags, now_here = config.flags, plain_facts(environment)
    facts = recording.facts_of(config, flags.task[0], tracker, flags.mode[0], now_here, versions())
    compared = [key for key in MOVING if key in stored and (key != "environment" or environment)]
    now = {key: facts.get(key) for key in compared}
    if "versions" in now:
        was = stored["versions"] if isinstance(stored["versions"], dict) else {}
        now["versions"] = was | {k: v for k, v in dict(facts["versions"]).items() if k in was and k != "av"}
    difference = differing_key({key: stored[key] for key in compared}, now)
    if difference is not None and not options.accept_differences:
        key, old, new = difference
        raise InputError(
            f"{file.path}: was recorded with {key} {setting(old)}, here it is {setting(new)}; --accept-differences "
            "plays it nevertheless, and reports how far it deviates"
        )


class _Replay:
    """Plays groups of recorded episodes."""

    def __init__(self, out: Path, options: RecordOptions, factories: Factories):
        self.out, self.options, self.factories = out, options, factories
        self.deviation = 0.0
        """Largest difference of a position so far [m or rad]."""
        self._lock = threading.Lock()
        self._sources: dict[int, EpisodeFile] = {}
        self._exact = True
        self._successes: dict[int, tuple[bool, bool]] = {}

    def play(self, config: RunConfig, group: Sequence[EpisodeFile], progress: Progress) -> None:
        """Episodes of one task, tracker and mode."""
        flags = config.flags
        self._exact = flags.engine == "mujoco" and not self.options.accept_differences
        env = self.factories.env(
            flags.task[0],
            tracker=self.factories.tracker(flags.tracker[0], config.checkpoint),
            worlds=min(flags.worlds, len(group)),
            engine=flags.engine,
            device=config.device,
            rules=flags.rules,
            mode=flags.mode[0],
            variant_file=str(config.variant) if config.variant else None,
            fast_physics=flags.fast_physics,
            drive=DRIVES[flags.drive],
        )
        try:
            _refuse_differences(self.options, config, group[0], env.describe())
            recorder = DemonstrationRecorder(
                self.out / EPISODES,
                cameras=config.recording,
                depth=flags.record_depth,
                looks=flags.record_looks,
                threads=recording.encoding_threads(),
                processes=recording.encoding_processes(),
                finishing=self._finished,
            )
            with recorder:
                self._play(env, recorder, group, progress)
                recorder.saved(wait=True)
                recorder.check()
        finally:
            env.close()

    def _play(
        self, env: World, recorder: DemonstrationRecorder, group: Sequence[EpisodeFile], progress: Progress
    ) -> None:
        """Each world takes the next episode as soon as it is free."""
        waiting = deque(enumerate(group))
        running: dict[int, tuple[int, EpisodeFile, np.ndarray]] = {}
        stand = np.tile(np.asarray(STAND_ACTION, np.float32), (env.worlds, 1))
        successes = np.zeros((env.worlds, 2), bool)

        def begin(worlds: Sequence[int]) -> None:
            taken = {world: waiting.popleft() for world in worlds[: len(waiting)]}
            env.release(list(worlds))
            if not taken:
                return
            env.reset([file.integer("arena_episode_seed") for _, file in taken.values()], list(taken))
            for world, (number, file) in taken.items():
                actions = file.array("arena_executed_action", file.rows, ACTION_WIDTH)
                running[world] = number, file, actions.astype(np.float32)
                successes[world] = False
                recorder.start(env, world, _planned(number, file))
                self._sources[number] = file

        begin(range(env.worlds))
        while running:
            action = stand.copy()
            for world, (_, _, actions) in running.items():
                if env.tick[world] >= 0:
                    action[world] = actions[env.tick[world]]
            executed = torch.from_numpy(action).to(env.torch_device)
            recorder.before_physics(env, env.observe(), executed)
            status = env.step(executed)
            recorder.tick(env)
            success = status == codes.SUCCESS
            successes[:, 0] |= success
            successes[:, 1] = success
            ended = [world for world, (_, file, _) in running.items() if env.tick[world] >= file.rows]
            for world in ended:
                number, file, _ = running.pop(world)
                self._successes[number] = bool(successes[world, 0]), bool(successes[world, 1])
                recorder.finish(env, world, _result(number, file))
                progress.episode(file.rows, file.rows + env.startup_ticks)
            if ended:
                begin(ended)
            progress.tick(len(running))

    def _finished(
        self, episode: RecordedEpisode, result: EpisodeResult, arrays: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """The recorded arrays with the new pictures; in the episode's thread."""
        source = self._sources.pop(episode.index)
        for name in ("arena_qpos", "arena_final_qpos"):
            self._compare(source, name, source.array(name), arrays[name])
        cameras = [name for name in CAMERAS if vision(name, "rgb_video_path") in arrays]
        remade = {field for name in cameras for field in camera_fields(name)}
        once, last = self._successes.pop(episode.index)
        changes = {name: array for name, array in arrays.items() if name in remade}
        changes |= {
            "rerecord_any_success": np.array(once),
            "rerecord_final_reward": np.array(last, np.float64),
            "rerecord_max_reward": np.array(once, np.float64),
        }
        for name in source.cameras:
            if name not in cameras:
                looks = source.looks(name)
                for film in (source.video(name), *([looks[1]] if looks else [])):
                    _copy(film, self.out / EPISODES / VIDEO_FOLDER / film.name)
        dropped = [name for name in source.names if name in remade and name not in changes]
        return source.copy_of({name: np.asanyarray(array) for name, array in changes.items()}, dropped)

    def _compare(self, source: EpisodeFile, name: str, recorded: np.ndarray, played: np.ndarray) -> None:
        """Hold positions to the recorded ones.

        Raises:
            ReplayDiffers: One differs where all must be equal.
        """
        if recorded.shape != played.shape:
            shapes = f"{list(recorded.shape)}, played again {list(played.shape)}"
            raise ReplayDiffers(f"{source.path}: {name} has shape {shapes}")
        if np.array_equal(recorded, played):
            return
        apart = np.abs(recorded.astype(np.float64) - played).reshape(-1, recorded.shape[-1])
        tick = int(np.flatnonzero(apart.any(axis=1))[0]) if apart.any() else 0
        if self._exact:
            at = f"tick {tick}" if recorded.ndim > 1 else "the end"
            column = int(apart[tick].argmax())
            by = f"position {column} differs by {apart[tick, column]:g}"
            raise ReplayDiffers(f"{source.path}: {name}: at {at} {by} from the recording")
        with self._lock:
            self.deviation = max(self.deviation, float(apart.max()))


def _planned(number: int, file: EpisodeFile) -> RecordedEpisode:
    """The recorded episode as a recorder wants it."""
    texts = {name: file.text(f"arena_{name}") for name in ("task", "tracker", "policy", "mode", "rules")}
    numbers = {name: file.integer(f"arena_{name}") for name in ("group_seed", "repeat", "episode_seed")}
    planned = SimpleNamespace(index=number, object_seed=file.integer("episode_object_seed"), **texts, **numbers)
    return planned


def _result(number: int, file: EpisodeFile) -> EpisodeResult:
    """Ending of the recorded episode."""
    return EpisodeResult(
        number, file.text("arena_outcome"), file.text("arena_reason"), file.rows, float(file.array("arena_margin"))
    )


def _copy(source: Path, target: Path) -> None:
    """A video, whole or not at all."""
    with source.open("rb") as file, replace_atomically(target, sync=True) as copy:
        shutil.copyfileobj(file, copy)
