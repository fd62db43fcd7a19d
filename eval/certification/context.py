"""Context that the checks of one certification share: what to measure, and evaluations to resume instead of repeat."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from arena_newton import tasks
from arena_newton.cli.flags import shared
from arena_newton.doctor import versions
from arena_newton.errors import InputError, check_once
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.stand_ins.bodies import BODIES, Body
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.episode_plan import PROTOCOL_REPEATS
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play import run
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.records.identity import PACKAGE, config_hash, hash_paths, package_files
from arena_newton.eval.records.journal import ContradictionError, EpisodeRecord, write_atomic
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.files.stored_json import Json, read_object
from arena_newton.files.text import counted
from arena_newton.rules import seeding

__all__ = ["CertifyCell", "Context", "with_expert"]

QUICK_EPISODES = 2
"""Episodes of each cell under --quick."""
FULL_EPISODES = 60
"""Episodes of each cell otherwise: the protocol's."""


@dataclass(frozen=True)
class CertifyCell:
    """One evaluation: a task played many times in one way."""

    task: str
    tracker: str
    rules: str = "paper"
    mode: str = "base"
    body: str = "robot"
    """Name in `bodies.BODIES`."""
    policy: str = "expert"
    label: str = ""
    """Name of the policy in the folder's name, where it is not the expert."""
    checkpoint: str | None = None
    """The tracker's weights; those that come with the package when None."""
    engine: str | None = None
    """Engine instead of the certification's."""
    actions: bool = False
    """Record the policy's actions."""
    strip: bool = False
    """Draw film strips."""
    failures: bool = False
    """Keep the signals of failures."""
    first_seed: int = 0
    """The first of its group seeds; the protocol's is 0."""
    episodes: int | None = None
    """Its first episodes alone; None: as many as the certification says."""

    @property
    def folder(self) -> str:
        """Path below the certification's `runs`, unique among the cells of one certification."""
        ways = [self.tracker, self.rules, self.mode]
        ways += [self.body] * (self.body != "robot") + [self.label] * bool(self.label)
        ways += ["weights"] * (self.checkpoint is not None) + [f"engine-{self.engine}"] * (self.engine is not None)
        ways += [f"from-{self.first_seed}"] * (self.first_seed != 0)
        return f"{self.task}/{'_'.join(ways)}"


@dataclass
class Context:
    """Context of the checks."""

    options: CertifyOptions
    folder: Path
    tasks: tuple[str, ...]
    """Tasks with an expert, in the order of the registry."""
    say: Callable[[str], None]
    """Prints a line about what is going on."""
    factories: Factories = field(default_factory=Factories)
    bodies: Mapping[str, Body] = field(default_factory=lambda: BODIES)

    @property
    def episodes(self) -> int:
        """Episodes of each cell."""
        return self.options.episodes or (QUICK_EPISODES if self.options.quick else FULL_EPISODES)

    @property
    def trackers(self) -> tuple[str, ...]:
        """Names of the trackers."""
        return self.options.tracker

    @property
    def sample(self) -> tuple[str, ...]:
        """Trackers of checks that compare experts with themselves: under --quick the first one stands for all."""
        return self.trackers[:1] if self.options.quick else self.trackers

    def plan(self, first: int = 0, episodes: int | None = None) -> tuple[tuple[int, ...], int]:
        """Group seeds and repeats: the protocol's 20 repeats of each seed where the episodes are a multiple of 20.

        Args:
            first: The first group seed.
            episodes: How many; the certification's by default.
        """
        episodes = episodes or self.episodes
        groups, rest = divmod(episodes, PROTOCOL_REPEATS)
        return ((first,), episodes) if rest else (tuple(range(first, first + groups)), PROTOCOL_REPEATS)

    def seeds(self, task: str, count: int) -> list[int]:
        """Episode seeds of a task's first episodes in the protocol: 20 repeats of each group seed."""
        gym_id = tasks.get(task).gym_id
        return [seeding.episode_seed(gym_id, *divmod(number, PROTOCOL_REPEATS)) for number in range(count)]

    def path(self, cell: CertifyCell) -> Path:
        """Results folder of a cell."""
        return self.folder / "runs" / cell.folder

    def evaluate(self, cell: CertifyCell) -> list[EpisodeRecord]:
        """Episodes of a cell in plan order; played, or continued where its results folder has some of them.

        Raises:
            InputError: A flag is wrong, or the folder was begun with another configuration.
            KeyboardInterrupt: The run was interrupted; what was played is kept.
        """
        seeds, repeats = self.plan(cell.first_seed, cell.episodes)
        options = shared(
            cell,
            RunOptions,
            task=(cell.task,),
            tracker=(cell.tracker,),
            mode=(cell.mode,),
            seeds=seeds,
            repeats=repeats,
            worlds=min(self.options.worlds, cell.episodes or self.episodes),
            engine=cell.engine or self.options.engine,
            device="cpu" if cell.engine == "mujoco" else self.options.device,
            follow=cell.strip,
            out=str(self.path(cell)),
        )
        return self.play(options, cell.folder.replace("/", " "), self.bodies[cell.body])

    def play(self, options: RunOptions, title: str, body: Body | None = None) -> list[EpisodeRecord]:
        """Episodes of a run in plan order; played, or continued where its results folder has some of them.

        Args:
            options: The run; `out` names its folder.
            title: Its name in lines about progress.
            body: Changes the robot; none by default.

        Raises:
            InputError: A flag is wrong, or the folder was begun with another configuration.
            KeyboardInterrupt: The run was interrupted; what was played is kept.
        """
        config = resolve(options)
        folder = ResultsFolder(Path(str(options.out)), config, versions())
        stored = folder.check()
        if stored is not None and "status" in stored and stored["status"]["state"] == "success":
            records = load_run(folder.path).records
            if len(records) != len(config.episodes):
                lines = f"{len(records)} of {counted(len(config.episodes), 'planned episode')} are in the journal"
                raise ContradictionError(f"{folder.path}: {lines} of a run that ended; it was changed by hand")
            return records
        self.say(f"{title}: {counted(len(config.episodes), 'episode')}")
        with contextlib.redirect_stdout(io.StringIO()):  # its table is part of a larger one here
            code = run.execute(folder, self.factories if body is None else body.equip(self.factories))
        if code == 130:
            raise KeyboardInterrupt
        return load_run(folder.path).records

    def strips(
        self, cell: CertifyCell, outcome: str | None = None, camera: str = "world"
    ) -> list[tuple[EpisodeRecord, Path]]:
        """Film strips of a cell's episodes, those with an outcome alone if one is named."""
        folder, found = self.path(cell), []
        for record in self.evaluate(cell):
            name = record.media.get(f"{camera} strip") if record.media else None
            if name is not None and outcome in (None, record.outcome) and (folder / name).is_file():
                found.append((record, folder / name))
        return found

    def measured(
        self,
        name: str,
        task: str | tuple[str, ...],
        tracker: str | tuple[str, ...],
        settings: Mapping[str, Json],
        measure: Callable[[], Json],
    ) -> Json:
        """Value of a measurement that is no evaluation; read from the folder where the same was measured before.

        Args:
            name: Name of the measurement, unique for a task and tracker; it becomes a file's.
            task: What it plays: a task, or the tasks of a plan.
            tracker: Through which tracker, or those of a plan.
            settings: What it depends on besides these, code, scenes, weights and engine.
            measure: Measures; its answer is JSON.
        """
        played, through = ((given,) if isinstance(given, str) else given for given in (task, tracker))
        known = config_hash([self._ground(played, through), dict(settings)])
        name = f"{name}_{task}_{tracker}" if isinstance(task, str) else name
        path = self.folder / "measured" / f"{name}.json"
        with contextlib.suppress(InputError, ValueError, KeyError):
            stored = read_object(path, MAX_CONFIG_BYTES)
            if stored["known_by"] == known and stored["digest"] == config_hash(stored["value"]):
                value: Json = stored["value"]
                return value
        self.say(f"{name}: measuring")
        value = json.loads(json.dumps(measure(), allow_nan=False))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(
            path, json.dumps({"known_by": known, "digest": config_hash(value), "value": value}, indent=1) + "\n"
        )
        return value

    def _ground(self, played: tuple[str, ...], through: tuple[str, ...]) -> Json:
        """Code, scenes, weights and flags that a measurement of tasks depends on."""
        options = RunOptions(task=played, tracker=through, seeds=(0,), repeats=1)
        options = replace(options, engine=self.options.engine, device=self.options.device)
        folder = PACKAGE / "eval" / "certification"
        checks = hash_paths(folder, [file for file in package_files(folder) if file.suffix == ".py"])
        ground: Json = json.loads(json.dumps([dict(resolve(options).identity()), checks]))
        return ground


def with_expert(names: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Tasks that an expert can be measured on, and those that have none.

    Args:
        names: Task names; empty or `all`: the paper's.

    Raises:
        InputError: An unknown name, or one named twice.
    """
    chosen = tasks.PAPER if tuple(names) in ((), ("all",)) else tuple(names)
    check_once("--task", chosen)
    has = tuple(name for name in chosen if tasks.get(name).expert is not None)
    return has, tuple(name for name in chosen if name not in has)
