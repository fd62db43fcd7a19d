"""``python -m arena_newton.eval loop``: record, build, train, evaluate, report; every stage resumes, in one process.

`loop.json` in the folder says what was asked and which stages are finished. A stage that was interrupted goes on where
its own folder says: a run by its journal, a training by its last checkpoint; a dataset appears whole or not at all.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from arena_newton.cli.flags import check_least, flag_name, shell_command, words
from arena_newton.data.datasets import lerobot_dataset
from arena_newton.data.datasets.data_options import BuildOptions
from arena_newton.doctor import versions
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.loop import loop_report
from arena_newton.eval.loop.loop_options import LoopOptions
from arena_newton.eval.loop.loop_report import DATASET, EVALUATION, RECORDINGS, TRAINING, LoopRecord, StageRecord
from arena_newton.eval.loop.loop_requirements import check_disk, check_folder, check_libraries, recorded_bytes
from arena_newton.eval.plan.config import recorded_cameras, recording_run, resolve
from arena_newton.eval.plan.episode_plan import PROTOCOL_SEEDS
from arena_newton.eval.plan.options import RecordOptions, RunOptions
from arena_newton.eval.play.run import Factories, execute
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.reports.progress import duration
from arena_newton.files.own_files import file_label
from arena_newton.files.text import counted
from arena_newton.physics.devices import resolve_engine
from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE as CHECKPOINT_CONFIG
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.policy_options import PolicyTrainOptions, check_numbers

__all__ = ["LOOP_FILE", "LoopParts", "held", "resolved", "run"]

LOOP_FILE = "loop.json"
"""Options of the loop, and its finished stages."""
LOCK_FILE = "loop.lock"
"""Locked while a process works in the folder."""
FORMAT = 1
"""Version of the file."""
RECORD_WORLDS = {True: 100, False: 20}
"""Episodes simulated at once, with CUDA and without."""
FULL = {"episodes": 100, "repeats": 20, "recipe": "fast", "size": "224x224"}
"""Options that a loop leaves open."""
SMALL_STEPS = 20
"""Optimizer steps of a small loop."""
SMALL = {"episodes": 3, "repeats": 1, "recipe": "small", "size": "64x64", "max_steps": 60, "worlds": 3}
SMALL |= {"steps": SMALL_STEPS}
"""Options that a loop leaves open which only tries the machinery."""
UNRESOLVED = ("out",)
"""Flags that may differ when a loop goes on."""


def _train(options: PolicyTrainOptions) -> Path:
    """Train; the libraries of training load only when it begins."""
    from arena_newton.policies.train.training import train

    return train(options)


def _check_training(options: PolicyTrainOptions) -> int:
    """See `check_training`."""
    from arena_newton.policies.train.training_check import check_training

    return check_training(options)


@dataclass(frozen=True)
class LoopParts:
    """Calls of the stages; tests put their own in."""

    check: Callable[[PolicyTrainOptions], int] = _check_training
    """Refuses a training that cannot begin, and gives the bytes of its checkpoints."""
    train: Callable[[PolicyTrainOptions], Path] = _train
    """Trains, and gives the folder of the last checkpoint."""
    clock: Callable[[], float] = time.perf_counter


def run(options: LoopOptions, factories: Factories | None = None, parts: LoopParts | None = None) -> int:
    """Run or continue a loop.

    Returns:
        Exit code: 0 when the report is written, 1 when episodes of the evaluation ended with errors or nothing
        was recorded, 130 interrupted.

    Raises:
        InputError: A flag or the folder is wrong, or something is missing that a later stage needs; said before
            anything is played.
    """
    options = resolved(options)
    out = Path(str(options.out)).expanduser()
    loop = _Loop(options, out, factories, parts or LoopParts())
    new = not (out / LOOP_FILE).exists()
    if new:  # one that cannot end leaves no folder
        _check_out(out)
        loop.check()
    else:  # one that cannot go on leaves no lock; what another process writes meanwhile is read again below
        loop.read()
    with held(out):
        return loop.play(checked=new)


def resolved(options: LoopOptions) -> LoopOptions:
    """The flags with everything filled in that was left open, and checked.

    Raises:
        InputError: A flag is wrong, or two contradict each other.
    """
    if options.out is not None and not options.out.strip():
        raise InputError("--out: is empty, name a folder")
    engine, device = resolve_engine(options.engine, options.device)
    defaults = (SMALL if options.small else FULL) | {"engine": engine, "device": device}
    if options.minutes is not None:
        defaults.pop("steps", None)
    defaults.setdefault("worlds", RECORD_WORLDS[device.startswith("cuda")])
    opened = {
        name: value
        for name, value in defaults.items()
        if getattr(options, name) is None or name in ("engine", "device")
    }
    options = dataclasses.replace(options, **opened)  # type: ignore[arg-type]  # each is of its flag's kind
    if options.steps is not None and options.minutes is not None:
        raise InputError("--steps: is given by --minutes too; drop one of them")
    check_least(options, 1, "episodes", "repeats", "worlds", "steps", "max_steps")
    if options.minutes is not None and not options.minutes > 0:
        raise InputError(f"--minutes {options.minutes:g}: expected more than 0")
    check_numbers(dataclasses.replace(_training(options, Path()), dataset=(Path(),)))  # its dataset is not there yet
    picture, flag = recipe(options.policy, str(options.recipe)).picture, f"--size {options.size}"
    cameras = recorded_cameras(RunOptions(record=True, record_size=str(options.size)), "--")
    if any((camera.width, camera.height) != (picture, picture) for camera in cameras.values()):
        raise InputError(f"{flag}: recipe {options.policy}/{options.recipe} takes {picture}x{picture}")
    if options.out is None:
        named = ["loop", *options.task, options.tracker, options.policy, str(options.recipe)]
        options = dataclasses.replace(options, out=str(Path("results") / file_label("_".join(named))))
    resolve(recording_run(_recording(options, Path())))  # tasks, tracker, engine and size, before anything is written
    resolve(dataclasses.replace(_evaluation(options, Path()), policy="stand"))
    return options


def _recording(options: LoopOptions, out: Path) -> RecordOptions:
    assert options.episodes is not None and options.size is not None and options.worlds is not None
    return RecordOptions(
        task=options.task,
        tracker=(options.tracker,),
        episodes=options.episodes,
        only_success=not options.small,  # a few ticks hold none
        seed_series=options.seed,
        size=options.size,
        worlds=min(options.worlds, options.episodes),
        engine=options.engine,
        device=options.device,
        max_steps=options.max_steps,
        out=str(out / RECORDINGS),
    )


def _training(options: LoopOptions, out: Path) -> PolicyTrainOptions:
    return PolicyTrainOptions(
        policy=options.policy,
        recipe=str(options.recipe),
        dataset=(out / DATASET,),
        out=out / TRAINING,
        steps=options.steps or 0,
        minutes=options.minutes or 0.0,
        seed=options.seed,
        device=str(options.device),
        weights=options.weights or "",
        log_every=max(1, (options.steps or SMALL_STEPS) // 10) if options.small else PolicyTrainOptions.log_every,
    )


def _evaluation(options: LoopOptions, out: Path) -> RunOptions:
    assert options.worlds is not None
    return RunOptions(
        task=options.task,
        tracker=(options.tracker,),
        seeds=PROTOCOL_SEEDS,
        repeats=options.repeats,
        worlds=options.worlds,
        engine=options.engine,
        device=options.device,
        max_steps=options.max_steps,
        strip=True,
        follow=True,
        out=str(out / EVALUATION),
    )


def _check_out(out: Path) -> None:
    check_folder(out)
    known = {LOOP_FILE, LOCK_FILE}
    if out.is_dir() and not (out / LOOP_FILE).is_file() and any(path.name not in known for path in out.iterdir()):
        raise InputError(f"--out {out}: is not empty and holds no loop; choose another folder")


@contextlib.contextmanager
def held(out: Path) -> Iterator[None]:
    """Make the folder and hold it, so that no two processes work in it.

    Raises:
        InputError: It is another process's, holds something else, or cannot be made.
    """
    _check_out(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = os.fdopen(os.open(out / LOCK_FILE, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o644), "w")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"--out {out}: another process works in it") from None
        yield


@dataclass
class _Loop:
    """One loop in its folder."""

    options: LoopOptions
    out: Path
    factories: Factories | None
    parts: LoopParts
    stages: dict[str, StageRecord] = field(default_factory=dict)
    """Stages that have begun, in their order."""

    def check(self) -> None:
        """Refuse a loop whose later stages lack something; stages that are finished need nothing."""

        def unfinished(name: str) -> bool:
            return not self.stages.get(name, StageRecord()).finished

        needed = 0
        if unfinished("record") or unfinished("build"):
            config = resolve(recording_run(_recording(self.options, self.out)))
            budgets = {episode.task: episode.max_steps for episode in config.episodes}
            needed += recorded_bytes(budgets, self.options.episodes or 0, str(self.options.size))
        if unfinished("train"):
            check_libraries(self.options.policy)
            needed += self.parts.check(_training(self.options, self.out))
        if needed:
            check_disk(self.out, needed)

    def play(self, *, checked: bool = True) -> int:
        """Play what is left, after a check of what it needs."""
        self.read()
        if not checked:
            self.check()
        stages: Mapping[str, Callable[[], int]] = {
            "record": self._record,
            "build": self._build,
            "train": self._train,
            "evaluate": self._evaluate,
        }
        command = shell_command("arena_newton.eval", "loop", *words(self.options))
        code = 0
        for number, (name, work) in enumerate(stages.items(), 1):
            stage = self.stages.setdefault(name, StageRecord())
            title = f"[{number}/{len(stages)}] {name}"
            if stage.finished:
                print(f"{title}: finished before, {duration(stage.seconds)}", flush=True)
                code = stage.code
                continue
            stage.attempts += 1
            self._write()
            print(title, flush=True)
            began = self.parts.clock()
            try:
                code = work()
            except KeyboardInterrupt:
                code = 130
            finally:
                stage.seconds += self.parts.clock() - began
                self._write()  # a kill loses the time of its attempt, never a finished stage
            if code == 130:
                print(f"\ninterrupted; continue with: {command}")
                return 130
            stage.finished, stage.code = True, code
            self._write()
            if name == "record" and not self._recorded():
                stage.finished = False
                self._write()
                print("record: not one episode was kept; nothing to train on")
                return 1
        page = loop_report.write(self.out, self._record_of_loop(), command)
        for line in loop_report.lines(self.out, self._record_of_loop()):
            print(line)
        print(f"report: {page}")
        return 1 if code else 0

    def _record_of_loop(self) -> LoopRecord:
        return LoopRecord(dataclasses.asdict(self.options), self.stages)

    def read(self) -> None:
        """Take over the stages of an earlier call.

        Raises:
            InputError: `loop.json` is damaged, or was begun with other flags.
        """
        path = self.out / LOOP_FILE
        if not path.is_file():
            return
        stored = loop_report.read(path, FORMAT)
        mine = json.loads(json.dumps(dataclasses.asdict(self.options)))
        for name, now in mine.items():
            was = stored.options.get(name)
            if name not in UNRESOLVED and was != now:
                raise InputError(f"--out {self.out}: was begun with {flag_name(name)} {_said(was)}, now {_said(now)}")
        self.stages = stored.stages

    def _write(self) -> None:
        stages = {name: dataclasses.asdict(stage) for name, stage in self.stages.items()}
        content = {"format": FORMAT, "options": dataclasses.asdict(self.options), "stages": stages}
        write_atomic(self.out / LOOP_FILE, json.dumps(content, indent=2) + "\n")

    def _run(self, options: RunOptions) -> int:
        """One run of the product in its folder; its journal makes it resumable."""
        config = resolve(options)
        folder = ResultsFolder(Path(str(options.out)), config, versions())
        try:
            folder.check()
        except InputError as error:
            again = f"or remove {folder.path}, and the loop's command plays this stage again"
            raise InputError(f"{error}, {again}") from None
        return execute(folder, self.factories)

    def _record(self) -> int:
        code = self._run(recording_run(_recording(self.options, self.out)))
        return 130 if code == 130 else 0  # attempts that failed are in the report; too few successes are still data

    def _recorded(self) -> bool:
        folder = self.out / RECORDINGS / "episodes"
        return any(folder.glob("*.npz"))

    def _build(self) -> int:
        dataset = self.out / DATASET
        if dataset.is_dir():  # it gets its name when it is whole
            return 0
        return lerobot_dataset.build([self.out / RECORDINGS], BuildOptions(out=dataset))

    def _train(self) -> int:
        options, folder = _training(self.options, self.out), self.out / TRAINING
        if (folder / "checkpoints" / "last").exists():
            options = PolicyTrainOptions(resume=folder, device=options.device)  # the rest is the training's own
        elif folder.exists():  # killed before its first checkpoint
            shutil.rmtree(folder)
        checkpoint = self.parts.train(options)
        if not (checkpoint / CHECKPOINT_CONFIG).is_file():
            raise InputError(f"{checkpoint}: the training left no checkpoint there")
        self.stages["train"].checkpoint = os.path.relpath(checkpoint, self.out)
        return 0

    def _evaluate(self) -> int:
        checkpoint = self.out / str(self.stages["train"].checkpoint)
        options = dataclasses.replace(_evaluation(self.options, self.out), policy=f"lerobot:{checkpoint}")
        code = self._run(options)
        if code == 1:
            errors = sum(record.outcome == "error" for record in load_run(self.out / EVALUATION).records)
            print(f"evaluate: {counted(errors, 'episode')} ended with an error")
        return code


def _said(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else "-" if value is None else str(value)
