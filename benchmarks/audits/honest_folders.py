"""``python -m benchmarks honest``: folders of real runs of many kinds, none of which an audit may accuse.

Every folder is played, in environments that runs of one scene share and whose start-up is short; none is a copy.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from arena_newton import policies, tasks
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.eval.plan.options import QUICK_TRACKERS
from arena_newton.eval.play.env_cache import CachedEnv, EnvCache
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.records.journal import JOURNAL_FILE
from arena_newton.files.untrusted_files import read_arrays
from arena_newton.interfaces import Chunk, Observation
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.base import Policy
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from benchmarks.bench_options import HonestOptions

__all__ = ["HISTORIES", "accusations", "honest_figures"]

SHORT = (2, 3, 4, 6, 8)
"""Step budgets of the runs [ticks]: an audit asks the same of two ticks as of two thousand."""
LAST_LINES = 700
"""Bytes at the end of a journal of which a killed run may have written none or a part."""

type Mask = Sequence[bool] | np.ndarray | torch.Tensor | None


class SeeingPolicy(Policy):
    """A policy that stands, moves a joint by how bright its picture is, and fails where that says so."""

    name, needs_image, chunk_size = "stand", True, 4
    camera = CameraConfig(width=32, height=24, fit="native")

    def __init__(self, fails: bool):
        """Without an episode yet; with `fails` every third ends as an error."""
        self._fails, self._seeds = fails, list[int]()

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Take up the seeds."""
        self._seeds = list(seeds)

    def act(self, observation: Observation) -> Chunk:
        """Decide."""
        assert observation.image is not None
        actions = torch.tensor(STAND_ACTION).repeat(len(observation.mask), self.chunk_size, 1)
        actions[:, :, ACTION["joint_pos"].start] += observation.image.float().mean(dim=(1, 2, 3))[:, None] / 2550
        asking = np.flatnonzero(observation.mask).tolist() if self._fails else []
        return Chunk(actions, errors={world: "no answer" for world in asking if self._seeds[world] % 3 == 0})


class BriefEnv(CachedEnv):
    """An environment in which a robot stands for five ticks before its episode, not for a second."""

    def __init__(self, task: str, **options: object):
        """Build it."""
        super().__init__(task, **options)  # type: ignore[arg-type]
        self.startup_ticks = 5


class Worlds:
    """Builder of environments that keeps those of one task."""

    def __init__(self) -> None:
        """Begin without any."""
        self._kept: dict[str, EnvCache] = {}
        self._task = ""

    def __call__(self, task: str, **options: object) -> CachedEnv:
        """The environment of a run."""
        if task != self._task:
            self.drop()
        self._task = task
        kind = {name: value for name, value in sorted(options.items()) if name not in ("tracker", "mode")}
        made = self._kept.setdefault(f"{options['tracker'].name} {options.get('mode')} {kind}", EnvCache(BriefEnv))  # type: ignore[attr-defined]
        return made(task, **options)  # type: ignore[arg-type]

    def drop(self) -> None:
        """Release all."""
        for cache in self._kept.values():
            cache.drop()
        self._kept.clear()


def played(arguments: list[str], parts: Factories) -> int:
    """Exit code of a command line of `eval`, whose output is not shown.

    Raises:
        InputError: It was refused; the message is its last line.
    """
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(arguments, parts)
    if code == 2:
        raise InputError(f"{' '.join(arguments)}: {said.getvalue().strip().splitlines()[-1]}")
    return code


def flags_of_a_run(chance: random.Random, task: str, late: bool) -> list[str]:
    """Flags of a run of a few ticks.

    Args:
        chance: By which they are drawn.
        task: Its task.
        late: True for the last runs of a task, which have other rules or gains, and so environments of their own.
    """
    flags = ["--task", task, "--engine", "mujoco", "--max-steps", str(chance.choice(SHORT)), "--worlds", "2"]
    flags += ["--seeds", *map(str, chance.sample(range(100), chance.choice((1, 1, 2))))]
    flags += ["--repeats", str(chance.choice((2, 3))), "--policy", chance.choice(("expert", "stand"))]
    flags += ["--tracker", *chance.choice((*([one] for one in QUICK_TRACKERS), QUICK_TRACKERS[:1], QUICK_TRACKERS))]
    flags += ["--mode", *chance.choice((["base"], ["base"], ["execution"], ["visual", "base"], ["dynamics"]))]
    flags += [chance.choice(("--rules=released", "--drive=humanoidarena"))] * late
    flags += ["--failures"] * (chance.randrange(3) == 0) + ["--no-actions"] * (chance.randrange(8) == 0)
    return flags + (chance.choice(([], [], ["--latency-ticks", "1"])) if "stand" in flags else [])


def whole(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """A run that ends by itself."""
    played([*flags, "--out", str(folder / "run")], parts)
    return folder / "run"


def resumed(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """A run that is killed while it writes its journal, or before, and goes on."""
    run = whole(folder, flags, parts, chance)
    journal = run / JOURNAL_FILE
    text = journal.read_bytes()
    journal.write_bytes(text[: len(text) - chance.randrange(min(LAST_LINES * 3, len(text)))])
    played(["resume", str(run), *chance.choice(([], [], ["--no-actions"]))], parts)
    return run


def retried(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """A run whose policy does not always answer, and that plays what ended as an error again."""
    failing = dataclasses.replace(parts, policy=lambda spec, **options: SeeingPolicy(fails=True))
    run = whole(folder, [*flags, "--policy", "stand"], failing, chance)
    if chance.randrange(3):
        played(["resume", str(run), "--retry-errors"], parts)
    return run


def unfinished(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """A part of a plan, of which the others were not played."""
    return whole(folder, [*flags, "--shard", f"{chance.choice((1, 2))}/2"], parts, chance)


def merged(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """Two parts of a plan that are joined; one may have been played without actions or signals."""
    for number in (1, 2):
        own = [] if number == 1 or "--no-actions" in flags else chance.choice(([], [], ["--no-actions"]))
        played([*flags, *own, "--shard", f"{number}/2", "--out", str(folder / str(number))], parts)
    order = chance.sample(["1", "2"], 2)
    played(["merge", *(str(folder / name) for name in order), "--out", str(folder / "run")], parts)
    return folder / "run"


def narrow(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """A run until its interval is narrow."""
    at = flags.index("--repeats")
    flags = [*flags[:at], *flags[at + 2 :], "--until-width", "0.99", "--max", "4"]
    return whole(folder, flags, parts, chance)


def packed_otherwise(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """A run whose actions were packed again by another program, without compression, and that was moved."""
    run = whole(folder, flags, parts, chance).rename(folder / "moved")
    for path in run.glob("actions/**/*.npz"):
        np.savez(path, **read_arrays(path))  # type: ignore[arg-type]  # its flags are named alike
    return run


def reported(folder: Path, flags: list[str], parts: Factories, chance: random.Random) -> Path:
    """A run whose tables were lost, and made again or not, and whose actions were left at home."""
    run = whole(folder, flags, parts, chance)
    for path in run.glob("*.md"):
        path.unlink()
    if chance.randrange(2):
        played(["report", str(run)], parts)
    if chance.randrange(2) and (run / "actions").exists():
        shutil.rmtree(run / "actions")
    return run


HISTORIES: dict[str, Callable[[Path, list[str], Factories, random.Random], Path]] = {
    "whole": whole,
    "resumed": resumed,
    "retried": retried,
    "unfinished": unfinished,
    "merged": merged,
    "until narrow": narrow,
    "packed otherwise": packed_otherwise,
    "reported again": reported,
}
"""Histories of a folder, by name."""


def accusations(count: int, replayed: int, seed: int = 0) -> Iterator[tuple[str, list[str], int]]:
    """History, contradictions and replayed episodes of honest folders, one after the other.

    Args:
        count: Number of folders.
        replayed: Every so many folders episodes are played again too.
        seed: By which they are drawn.

    Raises:
        InputError: A run was refused.
    """
    from arena_newton.eval.audit.action_replay import replay
    from arena_newton.eval.audit.draws import drawn
    from arena_newton.eval.audit.folder_audit import audited

    worlds = Worlds()

    def policy(spec: str, **options: object) -> Policy:
        return SeeingPolicy(fails=False) if spec == "stand" else policies.get(spec, **options)

    parts = Factories(env=worlds, policy=policy)
    try:
        for number in range(count):
            task = tasks.PAPER[number * len(tasks.PAPER) // count]
            chance = random.Random(f"{seed} {number}")
            name, history = list(HISTORIES.items())[number % len(HISTORIES)]
            with tempfile.TemporaryDirectory() as folder:
                late = number * len(tasks.PAPER) % count >= 0.9 * count
                flags = flags_of_a_run(chance, task, late)
                run = history(Path(folder), flags, parts, chance)
                with contextlib.redirect_stdout(io.StringIO()):
                    found = audited(run)
                    if number % replayed == 0:
                        replay(found, drawn([found], 2, number, at_hand=True)[0], parts)
                yield name, [f"{fault} ({' '.join(flags)})" for fault in found.faults], found.replayed or 0
    finally:
        worlds.drop()


def honest_figures(options: HonestOptions) -> Iterator[BenchFigure]:
    """Folders of each kind, and those that an audit accuses."""
    folders, accused, again = Counter[str](), Counter[str](), 0
    first: dict[str, str] = {}
    found = accusations(options.count, options.replay_every, options.seed)
    for name, faults, episodes in tqdm(
        found, total=options.count, unit="folder", desc="audited", disable=None, leave=False
    ):
        folders[name] += 1
        accused[name] += bool(faults)
        again += episodes
        first |= {name: first.get(name, faults[0])} if faults else {}
    for name in HISTORIES:
        if folders[name]:
            note = f"of {folders[name]}; {first.get(name, '')}".rstrip("; ")
            yield BenchFigure(f"accused: {name}", 0, "folders", True, accused[name], note)
    note = f"of {folders.total()}, {again} episodes of them played again"
    yield BenchFigure("honest folders accused", 0, "folders", True, accused.total(), note)
