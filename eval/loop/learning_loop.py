"""``python -m arena_newton.eval loop``: record, build, train, evaluate, report; every stage resumes, in one process.

A stage's folder says whether it is finished and where it goes on: a run by its status and its journal, a training by
its last checkpoint, a dataset by its name, which it has when it is whole. `loop.json` holds the loop's flags alone.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

from arena_newton.cli.flags import flag_name, shell_command, words
from arena_newton.data.datasets import lerobot_dataset
from arena_newton.data.datasets.data_options import BuildOptions
from arena_newton.doctor import versions
from arena_newton.errors import InputError
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.folders.run_folder import ResultsFolder, results_folder, setting
from arena_newton.eval.loop import loop_report
from arena_newton.eval.loop.loop_options import LoopOptions
from arena_newton.eval.loop.loop_report import DATASET, EVALUATION, RECORDINGS, TRAINING
from arena_newton.eval.loop.loop_requirements import check_disk, check_folder, check_libraries, recorded_bytes
from arena_newton.eval.loop.stage_state import continued, succeeded, trained
from arena_newton.eval.plan.config import recorded_cameras, recording_run, resolve
from arena_newton.eval.plan.episode_plan import PROTOCOL_SEEDS
from arena_newton.eval.plan.options import RecordOptions, RunOptions
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run import execute
from arena_newton.eval.records.journal import write_atomic
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.files.new_folder import held_folder
from arena_newton.files.own_files import PARTIAL, file_label
from arena_newton.files.stored_json import parse, read_regular
from arena_newton.files.text import counted, plain_text
from arena_newton.physics.devices import resolve_engine
from arena_newton.policies.lerobot.checkpoint_facts import checkpoint_folder
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.policy_options import PolicyTrainOptions, check_numbers
from arena_newton.policies.train.training import train
from arena_newton.policies.train.training_check import check_training
from arena_newton.policies.train.training_state import last_checkpoint

__all__ = ["LOOP_FILE", "is_begun", "resolved", "run"]

LOOP_FILE = "loop.json"
"""The flags of the loop in its folder."""
RECORD_WORLDS = {True: 100, False: 20}
"""Episodes simulated at once, with CUDA and without."""
FULL = {"episodes": 100, "repeats": 20, "recipe": "fast", "size": "224x224"}
"""Values of flags that are not given."""
SMALL_STEPS = 20
"""Optimizer steps of a small loop."""
SMALL = {"episodes": 3, "repeats": 1, "recipe": "small", "size": "64x64", "max_steps": 60, "worlds": 3}
SMALL |= {"steps": SMALL_STEPS}
"""Values of flags that are not given to a loop that only tries the machinery."""


def run(options: LoopOptions, factories: Factories | None = None) -> int:
    """Run or continue a loop.

    Returns:
        Exit code: 0 when the report is written, 1 when episodes of the evaluation ended with errors or nothing
        was recorded, 130 interrupted.

    Raises:
        InputError: A flag or the folder is wrong, or something is missing that a later stage needs, before
            anything is played.
    """
    options = resolved(options)
    loop = _Loop(options, results_folder(options.out), factories)
    loop.check()  # one that cannot end leaves no folder
    with held_folder(loop.out, "works in it"):
        if not is_begun(loop.out, options):  # another process may have begun one meanwhile
            write_atomic(loop.out / LOOP_FILE, json.dumps({"options": _flags(options)}, indent=2) + "\n")
        return loop.play()


def resolved(options: LoopOptions) -> LoopOptions:
    """The flags with everything filled in that was left open, and checked.

    Raises:
        InputError: A flag is wrong, or two contradict each other.
    """
    engine, device = resolve_engine(options.engine, options.device)
    defaults = {"worlds": RECORD_WORLDS[device.startswith("cuda")]} | (SMALL if options.small else FULL)
    if options.minutes is not None:
        defaults.pop("steps", None)
    opened = {name: value for name, value in defaults.items() if getattr(options, name) is None}
    options = dataclasses.replace(options, **opened, engine=engine, device=device)  # type: ignore[arg-type]
    for name, value in (("steps", options.steps), ("minutes", options.minutes)):
        if value is not None and not value > 0:
            raise InputError(f"--{name} {value:g}: expected more than 0")
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


def _flags(options: LoopOptions) -> dict[str, object]:
    """Flags as JSON, without the folder, which may be moved."""
    flags: dict[str, object] = json.loads(json.dumps(dataclasses.asdict(options)))
    del flags["out"]
    return flags


def is_begun(out: Path, options: LoopOptions) -> bool:
    """True if the folder holds this loop already, False where it is empty or not there.

    Raises:
        InputError: It is a loop's with other flags, holds something else, or cannot be written.
    """
    check_folder(out)
    path = out / LOOP_FILE
    try:
        content = parse(read_regular(path, MAX_CONFIG_BYTES))
    except FileNotFoundError:
        if out.is_dir() and {file.name for file in out.iterdir()} - {LOOP_FILE + PARTIAL}:
            raise InputError(f"--out {out}: is not empty and holds no loop; choose another folder") from None
        return False
    except ValueError as error:
        raise InputError(f"{path}: not readable as JSON ({plain_text(error, 200)})") from None
    stored = content.get("options") if isinstance(content, dict) else None
    if not isinstance(stored, dict):
        raise InputError(f"{path}: expected an object with the options of a loop")
    for name, now in _flags(options).items():
        if stored.get(name) != now:
            flag, was = flag_name(name), plain_text(setting(stored.get(name)), 200)
            raise InputError(f"--out {out}: was begun with {flag} {was}, now {setting(now)}")
    return True


@dataclass
class _Loop:
    """One loop in its folder."""

    options: LoopOptions
    out: Path
    factories: Factories | None = None

    def check(self) -> None:
        """Refuse another loop's folder, and a loop whose later stages lack something; finished ones need nothing."""
        is_begun(self.out, self.options)
        finished, needed = self.finished(), 0
        if finished < 2:
            config = resolve(recording_run(_recording(self.options, self.out)))
            budgets = {episode.task: episode.max_steps for episode in config.episodes}
            needed += recorded_bytes(budgets, self.options.episodes or 0, str(self.options.size))
        if finished < 3:
            check_libraries(self.options.policy)
            needed += check_training(_training(self.options, self.out))
        if needed:
            check_disk(self.out, needed)

    def finished(self) -> int:
        """Number of finished stages; what those before the last of them left may be gone."""
        whole = (
            succeeded(self.out / RECORDINGS),
            (self.out / DATASET).is_dir(),
            trained(self.out / TRAINING),
            succeeded(self.out / EVALUATION),
        )
        return max((number for number, one in enumerate(whole, 1) if one), default=0)

    def play(self) -> int:
        """Play what is left, and report."""
        stages = {"record": self._record, "build": self._build, "train": self._train, "evaluate": self._evaluate}
        command = shell_command("arena_newton.eval", "loop", *words(self.options))
        finished = self.finished()
        for number, (name, work) in enumerate(stages.items(), 1):
            print(f"[{number}/{len(stages)}] {name}{': finished before' if number <= finished else ''}", flush=True)
            try:
                code = work() if number > finished else 0
            except KeyboardInterrupt:
                code = 130
            if code == 130:
                print(f"\ninterrupted; continue with: {command}")
            if code:
                return code
        for line in loop_report.write(self.out, self.options, command):
            print(line)
        errors = sum(record.outcome == "error" for record in load_run(self.out / EVALUATION).records)
        if errors:
            print(f"evaluate: {counted(errors, 'episode')} ended with an error")
        return 1 if errors else 0

    def _run(self, options: RunOptions) -> int:
        """One run of the product in its folder; its journal makes it resumable.

        Returns:
            130 when interrupted; else 0, whatever its episodes ended as.
        """
        config = resolve(options)
        folder = ResultsFolder(Path(str(options.out)), config, versions())
        try:
            folder.check()
        except InputError as error:
            again = f"or remove {folder.path}, and the loop's command plays this stage again"
            raise InputError(f"{error}, {again}") from None
        return 130 if execute(folder, self.factories) == 130 else 0

    def _record(self) -> int:
        return self._run(recording_run(_recording(self.options, self.out)))

    def _build(self) -> int:
        recordings = self.out / RECORDINGS
        if not any((recordings / "episodes").glob("*.npz")):
            print("record: not one episode was kept; nothing to train on")
            return 1
        return lerobot_dataset.build([recordings], BuildOptions(out=self.out / DATASET))

    def _train(self) -> int:
        train(continued(_training(self.options, self.out)))
        return 0

    def _evaluate(self) -> int:
        checkpoint = checkpoint_folder(last_checkpoint(self.out / TRAINING))
        return self._run(dataclasses.replace(_evaluation(self.options, self.out), policy=f"lerobot:{checkpoint}"))
