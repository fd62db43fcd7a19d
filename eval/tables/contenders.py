"""Policies of a comparison with their episodes, alike in what must be alike."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, changed_conditions, is_complete, width_rule
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.statistics.comparison import Contender
from arena_newton.eval.suites.suite_records import SuiteCell
from arena_newton.eval.tables.episode_table import PlayedCell, code_notes, error_note, head_notes, read_folder, runs_of
from arena_newton.files.stored_json import Json, shown
from arena_newton.files.text import counted, plain_text
from arena_newton.tasks.semantic_mode import semantic_notes

__all__ = ["CONDITIONS", "MOST_CONTENDERS", "ContenderSet", "PlayedEpisode", "read_contenders"]

CONDITIONS = ("rules", "engine", "max_steps", "variant", "fast_physics")
"""Conditions that must be alike in everything that is compared, unless they are compared (`--differ`)."""
NOTED = ("device", "drive", "labels", "replan", "ensemble", "latency_ticks")
"""Conditions that may differ; every value is named."""
HASHED = {"rules_hash": "The rules", "scenes": "The scenes"}
"""Contents that belong to the tasks of a run, known by their hashes; a difference is named."""
NOT_GIVEN = "not given"
"""Text for a condition that a run leaves open."""
USUAL = {"labels": "v3.1"}
"""Values of a run that does not say them."""
MOST_CONTENDERS = 12
"""Policies of one comparison: 66 pairs, whose page is of some megabytes."""

type Stratum = tuple[str, ...]


@dataclass(frozen=True)
class PlayedEpisode:
    """An episode and the results folder whose recordings it names."""

    record: EpisodeRecord
    run: RunRecord


@dataclass
class Compared:
    """One of what is compared: a policy with its cells."""

    name: str
    folder: Path
    """Folder as it was named on the command line."""
    cells: list[PlayedCell] = dataclasses.field(default_factory=list)
    episodes: dict[tuple[Stratum, Hashable], PlayedEpisode] = dataclasses.field(default_factory=dict)
    """Its episodes, by stratum and what names the episode in every folder: group seed, repeat and episode seed."""

    @property
    def trackers(self) -> list[str]:
        """Trackers that executed its actions."""
        return list(dict.fromkeys(cell.tracker for cell in self.cells))

    @property
    def facts(self) -> tuple[tuple[str, str], ...]:
        """Policy, tracker and folder, by name."""
        policies = list(dict.fromkeys(plain_text(cell.records[0].shown_policy, 120) for cell in self.cells))
        more = f" and {len(policies) - 3} more" if len(policies) > 3 else ""
        trackers = plain_text(" ".join(self.trackers), 120)
        return (
            ("policy", " ".join(policies[:3]) + more),
            ("tracker", trackers),
            ("folder", plain_text(self.folder, 200)),
        )

    def values(self, name: str) -> list[str]:
        """Values of a condition, as texts."""
        found = []
        for cell in self.cells:
            own: Json = getattr(cell.records[0], name, "") if name in ("rules", "engine") else None
            value = own or cell.run.config.get(name) or USUAL.get(name) or None  # absent, null and false are alike
            found.append(NOT_GIVEN if value is None else shown(value).strip('"'))
        return list(dict.fromkeys(found))

    def stratified(self, with_tracker: bool, with_mode: bool) -> Contender:
        """Put the episodes into strata: tasks, and trackers and modes where these vary.

        Raises:
            InputError: Two of its folders hold the same episode.
        """
        outcomes: dict[Stratum, dict[Hashable, bool]] = {}
        for cell in self.cells:
            stratum = (cell.task, *([cell.tracker] if with_tracker else []), *([cell.mode] if with_mode else []))
            for record in cell.records:
                key = (record.group_seed, record.repeat, record.episode_seed)
                if (other := self.episodes.get((stratum, key))) is not None:
                    name = f"{' '.join(stratum)} seed {record.group_seed} repeat {record.repeat} of {self.name}"
                    raise InputError(f"{cell.folder}: episode {name} is in {other.run.folder} too")
                self.episodes[stratum, key] = PlayedEpisode(record, cell.run)
                outcomes.setdefault(stratum, {})[key] = record.outcome == "success"
        return Contender(self.name, outcomes)


@dataclass(frozen=True)
class ContenderSet:
    """Everything that a comparison is made of."""

    compared: tuple[Compared, ...]
    contenders: tuple[Contender, ...]
    """Contenders with their outcomes."""
    alike: tuple[tuple[str, str], ...]
    """Conditions that all share, by name."""
    notes: tuple[str, ...]
    """Sentences for a reader besides the figures."""


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
    gathered: list[Compared] = []
    for folder, title in zip(folders, titles, strict=True):
        gathered += _of_folder(folder, title, len(folders) == 1, per_tracker, notes)
    gathered = _chosen(gathered, only)
    _check_alike(gathered, differ)
    with_tracker = not all(len(one.trackers) == 1 for one in gathered)
    modes = {cell.mode for one in gathered for cell in one.cells}
    alike = [(name.replace("_", " "), gathered[0].values(name)[0]) for name in CONDITIONS if _all_alike(gathered, name)]
    alike = [(name, value) for name, value in alike if value != NOT_GIVEN]
    return ContenderSet(
        tuple(gathered),
        tuple(one.stratified(with_tracker, len(modes) > 1) for one in gathered),
        (*alike, *(("mode", mode) for mode in modes if len(modes) == 1)),
        (*notes, *_notes(gathered, differ)),
    )


def _titles(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of the folders' paths by which they differ."""
    paths = [folder.resolve() for folder in folders]
    for number in range(1, max(len(path.parts) for path in paths) + 1):
        names = [plain_text("/".join(path.parts[-number:]), None) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [plain_text(path, None) for path in paths]


def _of_folder(folder: Path, title: str, alone: bool, per_tracker: bool, notes: list[str]) -> list[Compared]:
    """Contenders of a results folder or a suite; in the name of a suite's the folder counts unless it is alone."""
    suite, cells = read_folder(folder, notes)
    if not cells:
        raise InputError(
            f"{folder}: {'holds no finished episode' if suite is None else 'no cell of the suite is finished'}"
        )
    if suite is None:
        _check_sample(runs_of(cells)[0], notes)
    alike: dict[str, list[tuple[str, ...]]] = {}
    for planned in suite.cells if suite is not None else ():
        alike.setdefault(planned.policy, []).append(_conditions(planned))
    several = len({cell.records[0].shown_policy for cell in cells}) > 1
    found: dict[tuple[str, ...], Compared] = {}
    for cell in cells:
        policy, words, differing = cell.records[0].shown_policy if several else "", tuple[str, ...](), list[str]()
        if cell.planned is not None:
            policy, words = cell.planned.policy, _conditions(cell.planned)
            differing = [word for word, *others in zip(words, *alike[policy], strict=True) if len(set(others)) > 1]
        tracker = cell.tracker if per_tracker else ""
        name = " ".join(filter(None, ["" if alone and suite else title, policy, *differing, tracker]))
        found.setdefault((policy, *words, tracker), Compared(plain_text(name, None), folder)).cells.append(cell)
    return list(found.values())


def _check_sample(run: RunRecord, notes: list[str]) -> None:
    """Refuse a run that is unfinished: successes end before timeouts, so that its first episodes are no fair sample."""
    if not is_complete(run):
        raise InputError(
            f"{run.folder}: is unfinished ({len(run.records)} of {run.document['planned']} episodes), and what ends "
            f"first is no fair sample; finish it by eval resume {run.folder}"
        )
    if (rule := width_rule(run.config)) is not None:
        notes.append(
            f"{run.folder}: rows ended when their interval was at most {100 * rule.width:g} points wide, or at "
            f"{rule.most:,} episodes; tests are of the episodes that a pair shares."
        )


def _conditions(cell: SuiteCell) -> tuple[str, ...]:
    """Conditions that tell cells of one policy of a suite apart, besides task, tracker and mode.

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


def _chosen(gathered: Sequence[Compared], only: Sequence[str]) -> list[Compared]:
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


def _check_alike(gathered: Sequence[Compared], differ: Sequence[str]) -> None:
    """Refuse what differs in a condition, and name what does not."""
    for name in CONDITIONS:
        if name in differ or _all_alike(gathered, name):
            continue
        groups: dict[str, list[str]] = {}
        for one in gathered:
            groups.setdefault(" and ".join(one.values(name)), []).append(one.name)
        text = "; ".join(f"{value} in {', '.join(names)}" for value, names in groups.items())
        alike = [", ".join(names) for value, names in groups.items() if len(names) > 1]
        alone = f"; alike, and to be compared, are: {' or: '.join(alike)}" if alike else ""
        flag = "--max-steps" if name == "max_steps" else name
        raise InputError(
            f"compare: {flag} differs: {text}{alone}; --differ {name} compares them nevertheless, and says so"
        )


def _all_alike(gathered: Sequence[Compared], name: str) -> bool:
    return len({value for one in gathered for value in one.values(name)}) == 1


def _notes(gathered: Sequence[Compared], differ: Sequence[str]) -> list[str]:
    """Conditions under which runs are no results of the benchmark, needless differences, and errors."""
    cells = [cell for one in gathered for cell in one.cells]
    runs = runs_of(cells)
    found = list(dict.fromkeys(message for run in runs for message in changed_conditions(run)))
    found += semantic_notes(cell.mode for cell in cells)
    for name in dict.fromkeys((*differ, *NOTED)):
        if not _all_alike(gathered, name):
            message = "; ".join(f"{one.name}: {' and '.join(one.values(name))}" for one in gathered)
            found.append(f"{name.replace('_', ' ').capitalize()} differs: {message}.")
    trackers = {one.name: " ".join(one.trackers) for one in gathered}
    if len(set(trackers.values())) > 1:
        found.append(f"Trackers differ: {'; '.join(f'{name}: {words}' for name, words in trackers.items())}.")
    weights: dict[str, dict[str, None]] = {}
    for record in (record for cell in cells for record in cell.records):
        if (now := record.hashes.get("checkpoint")) is not None:
            weights.setdefault(record.tracker, {})[now] = None
    found += [f"Weights of {tracker} differ: {' '.join(kept)}." for tracker, kept in weights.items() if len(kept) > 1]
    found += code_notes(runs) + head_notes(runs)
    found += [
        f"{what} have changed between the runs: {' '.join(sorted(versions))}, of the same tasks."
        for key, what in HASHED.items()
        for versions in _versions(runs, key)
    ]
    found += [f"{one.name}: {message}" for one in gathered if (message := error_note(one.cells))]
    return [plain_text(text) for text in found]


def _versions(runs: Sequence[RunRecord], key: str) -> list[set[str]]:
    """Hashes of something that depends on a run's tasks, where runs of the same tasks have several."""
    by_tasks: dict[tuple[str, ...], set[str]] = {}
    for run in runs:
        tasks, value = run.config.get("task"), run.config.get(key)
        if tasks is not None and isinstance(value, str):
            by_tasks.setdefault((run.config["rules"], *sorted(tasks)), set()).add(value)
    return [versions for versions in by_tasks.values() if len(versions) > 1]
