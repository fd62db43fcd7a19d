"""What is compared, read from results folders and suites: policies with their episodes, alike in what must be alike."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import (
    RunRecord,
    changed_conditions,
    check_whole_plan,
    is_complete,
    load_run,
    width_rule,
)
from arena_newton.eval.records.document import CONFIG_FILE, SUITE_FILE
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.records.schema import Json, shown
from arena_newton.eval.statistics.comparison import Contender
from arena_newton.eval.suites.suite_records import SuiteCell, load_cell, read_suite
from arena_newton.files.text import counted, plain_text
from arena_newton.rules import seeding

__all__ = ["CONDITIONS", "MOST_CONTENDERS", "ContenderSet", "PlayedEpisode", "read_contenders"]

CONDITIONS = ("rules", "engine", "max_steps", "variant", "fast_physics")
"""What must be alike in everything that is compared, unless it is what is compared (`--differ`)."""
NOTED = ("device", "drive", "labels", "replan", "ensemble", "latency_ticks")
"""What may differ; every value is named."""
HASHED = {"rules_hash": "The rules", "scenes": "The scenes"}
"""What is known by its content, of the tasks of a run; that it differs is named."""
NOT_GIVEN = "not given"
"""How a condition is shown that a run leaves open."""
USUAL = {"labels": "v3.1"}
"""What a run had that does not say it."""
MOST_CONTENDERS = 12
"""Policies of one comparison: 66 pairs, whose page is of some megabytes."""

type Stratum = tuple[str, ...]


@dataclass(frozen=True)
class PlayedEpisode:
    """An episode and the results folder whose recordings it names."""

    record: EpisodeRecord
    run: RunRecord


@dataclass(frozen=True)
class ContenderSet:
    """Everything that a comparison is made of."""

    contenders: tuple[Contender, ...]
    played: tuple[Mapping[tuple[Stratum, Hashable], PlayedEpisode], ...]
    """Of each contender its episodes, by stratum and what names the episode in it."""
    facts: tuple[tuple[tuple[str, str], ...], ...]
    """Of each contender what it is, by name: policy, tracker, folder."""
    folders: tuple[Path, ...]
    """Of each contender the folder that was named on the command line."""
    alike: tuple[tuple[str, str], ...]
    """Conditions that all share, by name."""
    notes: tuple[str, ...]
    """What a reader must know besides the figures."""


@dataclass
class _Gathered:
    """A contender while its folders are read."""

    name: str
    where: Path
    """Folder that was named on the command line."""
    episodes: list[PlayedEpisode] = dataclasses.field(default_factory=list)

    def values(self, name: str) -> list[str]:
        """Values of a condition, as texts."""
        found = []
        for run in dict.fromkeys(map(id, (one.run for one in self.episodes))):
            first = next(one for one in self.episodes if id(one.run) == run)
            own: Json = getattr(first.record, name, "") if name in ("rules", "engine") else None
            value = own or first.run.config.get(name) or USUAL.get(name) or None  # absent, null and false are alike
            found.append(NOT_GIVEN if value is None else shown(value).strip('"'))
        return list(dict.fromkeys(found))


def read_contenders(
    folders: Sequence[Path],
    *,
    differ: Sequence[str] = (),
    only: Sequence[str] = (),
    per_tracker: bool = False,
) -> ContenderSet:
    """Read results folders and suites.

    A results folder is a contender of the folder's name; a suite has one for each of its policies and conditions.

    Args:
        folders: Each of them.
        differ: Names of `CONDITIONS` that may differ.
        only: Names of the contenders to keep; all by default.
        per_tracker: Whether each tracker of a folder makes a contender of its own.

    Raises:
        InputError: A folder holds neither, recordings for training, or is unfinished or damaged; a name is unknown; or
            conditions differ.
    """
    for name in differ:
        if name not in CONDITIONS:
            raise InputError(f"--differ {plain_text(name, 60)}: choose from {' '.join(CONDITIONS)}")
    notes: list[str] = []
    titles = _titles(folders)
    gathered: list[_Gathered] = []
    for folder, title in zip(folders, titles, strict=True):
        if (folder / SUITE_FILE).is_file():
            gathered += _of_suite(folder, title if len(folders) > 1 else "", per_tracker, notes)
        else:
            gathered += _of_run(folder, title, per_tracker, notes)
    gathered = _chosen(gathered, only)
    _check_alike(gathered, differ)
    notes += _notes(gathered, differ)
    with_tracker = not all(len(_trackers(one)) == 1 for one in gathered)
    modes = len({played.record.mode for one in gathered for played in one.episodes}) > 1

    def stratum(record: EpisodeRecord) -> Stratum:
        return (record.task, *([record.tracker] if with_tracker else []), *([record.mode] if modes else []))

    contenders, played = [], []
    for one in gathered:
        found = _by_episode(one, stratum)
        outcomes: dict[Stratum, dict[Hashable, bool]] = {}
        for (where, key), episode in found.items():
            outcomes.setdefault(where, {})[key] = episode.record.outcome == "success"
        contenders.append(Contender(one.name, outcomes))
        played.append(found)
    alike = [(name, gathered[0].values(name)) for name in CONDITIONS]
    shared = [(name.replace("_", " "), values[0]) for name, values in alike if _all_alike(gathered, name)]
    shared = [(name, value) for name, value in shared if value != NOT_GIVEN]
    if not modes:
        shared.append(("mode", gathered[0].episodes[0].record.mode))
    return ContenderSet(
        contenders=tuple(contenders),
        played=tuple(played),
        facts=tuple(map(_facts, gathered)),
        folders=tuple(one.where for one in gathered),
        alike=tuple(shared),
        notes=tuple(notes),
    )


def _titles(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of the folders' paths by which they can be told apart."""
    paths = [folder.resolve() for folder in folders]
    for number in range(1, max(len(path.parts) for path in paths) + 1):
        names = [plain_text("/".join(path.parts[-number:]), None) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [plain_text(path, None) for path in paths]


def _check_evaluation(run: RunRecord) -> None:
    if run.config.get("seed_range", seeding.EVALUATION) != seeding.EVALUATION:
        raise InputError(f"{run.folder}: holds recordings for training; what is compared are evaluations")


def _of_run(folder: Path, title: str, per_tracker: bool, notes: list[str]) -> list[_Gathered]:
    run = load_run(folder)
    _check_evaluation(run)
    check_whole_plan(run)
    played, planned = len(run.records), run.document["planned"]
    if not played:
        raise InputError(f"{folder}: holds no finished episode")
    if not is_complete(run):
        # Successes end before timeouts do: the first episodes of a run are no fair sample of it.
        raise InputError(
            f"{folder}: is unfinished ({played} of {planned} episodes), and what ends first is no fair sample; "
            f"finish it by eval resume {folder}"
        )
    if (rule := width_rule(run.config)) is not None:
        notes.append(
            f"{folder}: rows ended when their interval was at most {100 * rule.width:g} points wide, or at "
            f"{rule.most:,} episodes; tests are of the episodes that a pair shares."
        )
    found: dict[tuple[str, str], _Gathered] = {}
    policies = {record.shown_policy for record in run.records}
    for record in run.records:
        key = (record.shown_policy if len(policies) > 1 else "", record.tracker if per_tracker else "")
        name = " ".join([title, *(plain_text(word, None) for word in key if word)])
        found.setdefault(key, _Gathered(name, folder)).episodes.append(PlayedEpisode(record, run))
    return list(found.values())


def _of_suite(folder: Path, title: str, per_tracker: bool, notes: list[str]) -> list[_Gathered]:
    suite = read_suite(folder)
    words = {cell.id: _conditions(cell) for cell in suite.cells}
    found: dict[tuple[str, ...], _Gathered] = {}
    waiting = 0
    for cell in suite.cells:
        if cell.status == "failed":
            notes.append(f"{folder / cell.folder}: failed ({plain_text(cell.error or 'no reason', 200)}).")
        # A cell that is beginning has a folder before it has a configuration.
        run = load_cell(suite, cell) if (folder / cell.folder / CONFIG_FILE).exists() else None
        if run is None or not run.records:
            waiting += cell.status != "failed"
            continue
        _check_evaluation(run)
        if not is_complete(run):
            notes.append(
                f"{run.folder} is unfinished, and left out: {len(run.records)} of {run.document['planned']} episodes."
            )
            continue
        alike = [words[other.id] for other in suite.cells if other.policy == cell.policy]
        said = [word for position, word in enumerate(words[cell.id]) if len({one[position] for one in alike}) > 1]
        name = " ".join(filter(None, [title, cell.policy, *said, cell.tracker if per_tracker else ""]))
        key = (cell.policy, *words[cell.id], cell.tracker if per_tracker else "")
        one = found.setdefault(key, _Gathered(plain_text(name, None), folder))
        one.episodes += [PlayedEpisode(record, run) for record in run.records]
    if waiting:
        notes.append(f"{folder}: {counted(waiting, 'cell')} of {len(suite.cells)} not played yet.")
    if not found:
        raise InputError(f"{folder}: no cell of the suite is finished")
    return list(found.values())


def _conditions(cell: SuiteCell) -> tuple[str, ...]:
    """What tells cells of one policy of a suite apart, besides task, tracker and mode.

    Checkpoints of one policy, each executed by the tracker of its training, are one contender.
    """
    return (
        f"of {'+'.join(cell.trained_on)}" if len(cell.trained_on) > 1 else "",
        "swapped" if cell.matched is False else "",
        cell.labels,
        cell.rules,
        f"{counted(cell.latency, 'tick')} late" if cell.latency else "",
        f"replan {cell.replan}" if cell.replan is not None else "",
        "ensemble" if cell.ensemble else "",
    )


def _chosen(gathered: Sequence[_Gathered], only: Sequence[str]) -> list[_Gathered]:
    known = [one.name for one in gathered]
    for name in known:
        if known.count(name) > 1:
            raise InputError(f"compare: two of what is compared have the name {name}")
    for name in only:
        if name not in known:
            raise InputError(f"--only {plain_text(name, 60)}: unknown, found are {', '.join(known)}")
    kept = [one for one in gathered if not only or one.name in only]
    if only and len(kept) < 2 <= len(gathered):
        raise InputError(f"--only {kept[0].name}: keeps one, which has nothing to be compared with")
    if len(kept) < 2:
        raise InputError(
            f"compare: {kept[0].name} alone has nothing to be compared with; name two results folders or more, "
            "or a suite of several policies; --per-tracker compares the trackers of one folder"
        )
    if len(kept) > MOST_CONTENDERS:
        raise InputError(
            f"compare: found {len(kept)} policies, at most {MOST_CONTENDERS} fit one comparison; choose some by --only"
        )
    return kept


def _check_alike(gathered: Sequence[_Gathered], differ: Sequence[str]) -> None:
    """Refuse what differs in a condition, and name what does not."""
    for name in CONDITIONS:
        if name in differ or _all_alike(gathered, name):
            continue
        groups: dict[str, list[str]] = {}
        for one in gathered:
            groups.setdefault(" and ".join(one.values(name)), []).append(one.name)
        said = "; ".join(f"{value} in {', '.join(names)}" for value, names in groups.items())
        alike = [", ".join(names) for value, names in groups.items() if len(names) > 1]
        alone = f"; alike, and to be compared, are: {' or: '.join(alike)}" if alike else ""
        flag = "--max-steps" if name == "max_steps" else name
        raise InputError(
            f"compare: {flag} differs: {said}{alone}; --differ {name} compares them nevertheless, and says so"
        )


def _all_alike(gathered: Sequence[_Gathered], name: str) -> bool:
    return len({value for one in gathered for value in one.values(name)}) == 1


def _trackers(one: _Gathered) -> list[str]:
    return list(dict.fromkeys(played.record.tracker for played in one.episodes))


def _notes(gathered: Sequence[_Gathered], differ: Sequence[str]) -> list[str]:
    """Conditions under which runs are no results of the benchmark, needless differences, and errors."""
    runs = {id(played.run): played.run for one in gathered for played in one.episodes}
    found = list(dict.fromkeys(said for run in runs.values() for said in changed_conditions(run)))
    for name in dict.fromkeys((*differ, *NOTED)):
        if not _all_alike(gathered, name):
            said = "; ".join(f"{one.name}: {' and '.join(one.values(name))}" for one in gathered)
            found.append(f"{name.replace('_', ' ').capitalize()} differs: {said}.")
    trackers = {one.name: " ".join(_trackers(one)) for one in gathered}
    if len(set(trackers.values())) > 1:
        found.append(f"Trackers differ: {'; '.join(f'{name}: {words}' for name, words in trackers.items())}.")
    weights: dict[str, dict[str, None]] = {}
    for one in gathered:
        for played in one.episodes:
            now = played.record.hashes.get("checkpoint")
            if now is not None:
                weights.setdefault(played.record.tracker, {})[now] = None
    found += [f"Weights of {tracker} differ: {' '.join(kept)}." for tracker, kept in weights.items() if len(kept) > 1]
    codes = {run.config.get("code") for run in runs.values()}
    found += [f"The runs were made with {len(codes)} versions of the code."] if len(codes) > 1 else []
    found += [
        f"{what} have changed between the runs: {' '.join(sorted(versions))}, of the same tasks."
        for key, what in HASHED.items()
        for versions in _versions(gathered, key)
    ]
    for one in gathered:
        errors = sum(played.record.outcome == "error" for played in one.episodes)
        if errors:
            found.append(
                f"{one.name}: {counted(errors, 'episode')} of {len(one.episodes)} ended with an error; they count as "
                "no success."
            )
    return [plain_text(text) for text in found]


def _versions(gathered: Sequence[_Gathered], key: str) -> list[set[str]]:
    """Hashes of something that depends on a run's tasks, where runs of the same tasks have several."""
    by_tasks: dict[tuple[str, ...], set[str]] = {}
    for run in {id(played.run): played.run for one in gathered for played in one.episodes}.values():
        tasks, value = run.config.get("task"), run.config.get(key)
        if tasks is not None and isinstance(value, str):
            by_tasks.setdefault((run.config["rules"], *sorted(tasks)), set()).add(value)
    return [versions for versions in by_tasks.values() if len(versions) > 1]


def _by_episode(
    one: _Gathered, stratum: Callable[[EpisodeRecord], Stratum]
) -> dict[tuple[Stratum, Hashable], PlayedEpisode]:
    """Episodes by stratum and by what names an episode in every folder: its group seed, repeat and episode seed."""
    found: dict[tuple[Stratum, Hashable], PlayedEpisode] = {}
    for played in one.episodes:
        record = played.record
        key = (stratum(record), (record.group_seed, record.repeat, record.episode_seed))
        if key in found:
            where = " ".join(key[0])
            raise InputError(
                f"{played.run.folder}: episode {where} seed {record.group_seed} repeat {record.repeat} of {one.name} "
                f"is in {found[key].run.folder} too"
            )
        found[key] = played
    return found


def _facts(one: _Gathered) -> tuple[tuple[str, str], ...]:
    policies = dict.fromkeys(plain_text(played.record.shown_policy, 120) for played in one.episodes)
    shown_policies = " ".join(list(policies)[:3]) + (f" and {len(policies) - 3} more" if len(policies) > 3 else "")
    return (
        ("policy", shown_policies),
        ("tracker", plain_text(" ".join(_trackers(one)), 120)),
        ("folder", plain_text(one.where, 200)),
    )
