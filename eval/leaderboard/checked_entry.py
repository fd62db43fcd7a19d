"""Entries of the leaderboard with their numbers: bundles audited, and everything that an entry says held to them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.eval.audit.draws import drawn, found_by
from arena_newton.eval.audit.folder_audit import (
    AUDIT_FILE,
    CONSISTENT,
    LEVELS,
    SELF_REPORTED,
    Audit,
    audited,
    runs_in,
    sureness,
)
from arena_newton.eval.leaderboard.entry_file import (
    BUNDLE_FILE,
    ENTRY_FILE,
    SIMULATOR,
    UNTRAINED,
    BoardEntry,
    as_read,
    read_entry,
)
from arena_newton.eval.leaderboard.evidence import AuditStatement, earned_level, read_statements
from arena_newton.eval.leaderboard.result_bundle import strays, unpack
from arena_newton.eval.plan.episode_plan import PROTOCOL_REPEATS, PROTOCOL_SEEDS
from arena_newton.eval.records.chain import joint_head
from arena_newton.eval.records.document import SUITE_FILE, step_budgets
from arena_newton.eval.records.identity import hash_path
from arena_newton.eval.tables.condition_rates import (
    IN_GMT,
    ConditionRate,
    rate_of_cell,
    rates_of_paper,
    rates_of_published,
)
from arena_newton.eval.tables.episode_table import PlayedCell
from arena_newton.eval.tables.evaluated_cells import read_cells
from arena_newton.eval.tables.paper_numbers import FAMILIES, published
from arena_newton.files.stored_json import shown
from arena_newton.files.text import counted, plain
from arena_newton.trackers import shipped_weights

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["CheckedEntry", "check_entry", "named_alike", "played_elsewhere"]

PROTOCOL_RULES = "paper"
"""Rule set of the protocol."""
SCRIPTED = ("expert", "stand")
"""Policies of this package that have nothing to train."""


@dataclass
class CheckedEntry:
    """An entry, its numbers, and what its check found."""

    name: str
    """Name of its folder."""
    entry: BoardEntry
    rates: list[ConditionRate] = field(default_factory=list)
    audits: list[Audit] = field(default_factory=list)
    """Audits of the runs in its bundle."""
    faults: list[str] = field(default_factory=list)
    """Contradictions, a sentence each."""
    notes: list[str] = field(default_factory=list)


def check_entry(
    folder: Path, into: Path, *, replays: int = 0, draw: int = 0, factories: Factories | None = None
) -> CheckedEntry:
    """Read an entry, audit its bundle, and gather its numbers.

    Args:
        folder: Folder of the entry.
        into: Empty folder for its bundle.
        replays: Episodes of all its runs together to play again, of those whose actions are there.
        draw: Number by which they are drawn.
        factories: What worlds and trackers are made with; the real ones by default.

    Raises:
        InputError: Its file is unfit, numbers or bundle are missing or cannot be read, or it claims a higher level
            than its evidence gives.
    """
    checked = CheckedEntry(folder.name, read_entry(folder))
    entry, where = checked.entry, f"{checked.name}/{ENTRY_FILE}"
    at_hand = bool(entry.bundle) and (entry.own or (folder / BUNDLE_FILE).exists())
    if at_hand:
        checked.faults += filter(None, [unpack(folder / BUNDLE_FILE, entry.bundle, into)])
        try:
            cells = [] if checked.faults else _audit(checked, into, replays, draw, factories)
        except InputError as error:
            raise InputError(str(error).replace(str(into), str(folder / BUNDLE_FILE))) from None
        checked.rates += [replace(rate_of_cell(cell), unusual=_unusual(cell)) for cell in cells]
        checked.faults += [f"{checked.name}/{BUNDLE_FILE}: {fault}" for fault in _twice(cells, checked.rates)]
        if entry.training_data == UNTRAINED:  # a policy of many tasks without a merged training
            checked.rates = [replace(rate, setting=IN_GMT) for rate in checked.rates]
        checked.faults += [f"{where}: {fault}" for fault in _misstated(entry, cells)]
    elif entry.bundle:
        checked.notes.append(f"Its bundle, SHA-256 {entry.bundle}, is not part of this board: see its source.")
    if checked.faults:
        return checked
    if not entry.own:
        stated = _stated(folder, entry)
        if at_hand and _counts(stated) != _counts(checked.rates):
            checked.faults.append(f"{where}: numbers of {entry.numbers} are not those of its bundle")
        checked.rates = checked.rates or stated
    played = sorted({one for rate in checked.rates for one in rate.tracker.split("+")})
    if played != sorted(entry.trackers):
        checked.faults.append(f"{where}: trackers are {' '.join(entry.trackers)}, its numbers have {' '.join(played)}")
    if not checked.faults:
        _hold_level(checked, folder, at_hand=at_hand)
    return checked


def _misstated(entry: BoardEntry, cells: Sequence[PlayedCell]) -> Iterator[str]:
    """Statements of an entry that are not those of its runs."""
    if not cells:
        return
    if entry.simulator != SIMULATOR:
        yield f"simulator is {shown(entry.simulator)}, its runs are of {SIMULATOR}"
    weights = " ".join(sorted({cell.weights for cell in cells} - {""}))
    if entry.checkpoint != weights:
        yield f"checkpoint is {shown(entry.checkpoint)}, its runs have {shown(weights)}"
    data = shown(entry.training_data)
    if entry.training_data == UNTRAINED:
        if weights:
            yield f"training_data is {data}, the policy of its runs has weights"
    elif scripted := sorted({cell.records[0].policy for cell in cells if cell.records[0].policy in SCRIPTED}):
        yield f"training_data is {data}, policy {scripted[0]} of its runs is not trained"


def _twice(cells: Sequence[PlayedCell], rates: Sequence[ConditionRate]) -> Iterator[str]:
    """Places of the board for which an entry has two rates, of which the board would show one."""
    seen: dict[tuple[str, ...], PlayedCell] = {}
    for cell, rate in zip(cells, rates, strict=True):
        other = seen.setdefault((*rate.row, rate.task, rate.unusual), cell)
        if other is not cell:
            both = " and ".join(shown(one.records[0].policy) for one in (other, cell))
            yield f"{rate.task} {rate.tracker} {rate.mode} has two rates, of the policies {both}; an entry is of one"


def played_elsewhere(entry: CheckedEntry, others: Sequence[CheckedEntry]) -> Iterator[str]:
    """Entries among others that have episodes of one: a run of one head, or equal actions from one seed."""
    mine = _evidence(entry)
    for other in others:
        if shared := mine & _evidence(other):
            yield f"{entry.name}/{BUNDLE_FILE}: {len(shared)} of its runs and episodes are those of entry {other.name}"


def named_alike(entry: CheckedEntry, others: Sequence[CheckedEntry]) -> Iterator[str]:
    """Entries among others whose name a reader would take for that of one."""
    mine = entry.entry.name
    for other in others:
        if as_read(other.entry.name) == as_read(mine):
            both = f"name is {shown(mine)}, which reads as {shown(other.entry.name)}"
            yield f"{entry.name}/{ENTRY_FILE}: {both} of {other.name}/{ENTRY_FILE}"


def _evidence(entry: CheckedEntry) -> set[str]:
    """Hashes that no two entries share: heads of its runs, and of each episode its seed with the actions."""
    actions = (record.actions for audit in entry.audits for record in audit.run.records)
    return {audit.head for audit in entry.audits} | {one for one in actions if one is not None}


def _hold_level(checked: CheckedEntry, folder: Path, *, at_hand: bool) -> None:
    """Hold the level that an entry claims to what it carries, and say what its audit covers.

    Raises:
        InputError: It claims more.
    """
    stated, order = read_statements(folder), list(LEVELS)
    earned, missing = earned_level(checked.audits, stated) if at_hand else (SELF_REPORTED, f"no {BUNDLE_FILE} is there")
    level = checked.entry.level
    if order.index(level) > order.index(earned):
        raise InputError(f"{folder / ENTRY_FILE}: level is {level}, its evidence gives {earned}: {missing}")
    if order.index(earned) > order.index(CONSISTENT):
        checked.notes.append(_covered(checked.audits, stated))


def _covered(audits: Sequence[Audit], stated: Mapping[str, AuditStatement]) -> str:
    """Sentences about the audit next to an entry."""
    used = [stated[audit.head] for audit in audits]
    again, finished = sum(len(one.played) for one in used), sum(audit.results["finished"] for audit in audits)
    draws = " ".join(sorted({str(one.draw) for one in used if one.draw is not None}))
    text = f"{AUDIT_FILE}: {again} of {counted(finished, 'episode')} played again"
    text += f", by draw {draws}; their actions are in the bundle" if draws else ""
    policies = " ".join(sorted({one.policy for one in used if one.policy is not None}))
    text += f". That finds {found_by(again, finished)}."
    return text + f" Policy {policies} was asked again at their queries." * bool(policies)


def _audit(
    checked: CheckedEntry, root: Path, replays: int, draw: int, factories: Factories | None
) -> Sequence[PlayedCell]:
    """Audit every run of an unpacked bundle; its cells."""
    folders, suite, notes = runs_in(root), (root / SUITE_FILE).exists(), Counter[str]()
    checked.audits += [audited(folder) for folder in folders]
    for audit, records in zip(checked.audits, drawn(checked.audits, replays, draw, at_hand=True), strict=True):
        if records:
            from arena_newton.eval.audit.action_replay import replay  # loads the simulator

            replay(audit, records, factories)
        checked.faults += [fault.replace(f"{root}/", f"{checked.name}/") for fault in audit.faults]
        notes.update(note.replace(f"{root}/", f"{checked.name}/") for note in audit.notes)
        if not (suite or audit.results["complete"]):  # failures may be what is left out; a suite's tables leave it out
            number = f"{audit.results['finished']} of {audit.results['planned']} episodes"
            checked.faults.append(f"{checked.name}/{BUNDLE_FILE}: a run of {number}; rates are of whole plans")
    checked.notes += [f"{note} ({counted(runs, 'run')})" if runs > 1 else note for note, runs in notes.items()]
    checked.notes += sureness(checked.audits)
    heads = [audit.results.get("head") for audit in checked.audits]
    for head, times in Counter(heads).items():
        if head is not None and times > 1:  # copies make a draw of another run less likely
            checked.faults.append(f"{checked.name}/{BUNDLE_FILE}: {times} of its runs are one, head {head}")
    found = joint_head(heads) or ""
    if not found:
        checked.faults.append(
            f"{checked.name}/{BUNDLE_FILE}: a version without chain wrote its lines; they have no head"
        )
    elif found != (said := checked.entry.head):
        checked.faults.append(f"{checked.name}/{ENTRY_FILE}: head is {shown(said)}, its runs have {shown(found)}")
    if checked.faults:
        return []
    if stray := strays(root, [audit.run for audit in checked.audits]):
        raise InputError(f"{root}: {shown(stray[0])} is of no run in it")
    cells = read_cells([root] if suite else folders)
    checked.faults += cells.changed
    played = [cell for cell in cells.cells if isinstance(cell, PlayedCell)]
    return [cell for cell in played if cell.latency == 0 and cell.records]


def _unusual(cell: PlayedCell) -> str:
    """Conditions of a cell that are not the protocol's, or not those of a policy that sees pictures, in words."""
    drive = plain(cell.run.config.get("drive", "auto"))
    config = cell.run.config
    found = ["sees the simulator's state"] * bool((config.get("policy_facts") or {}).get("privileged"))
    found += [f"drive {drive}"] * (drive != "auto") + ["fast physics"] * bool(config.get("fast_physics"))
    if tuple(config["seeds"]) != PROTOCOL_SEEDS or config["repeats"] != PROTOCOL_REPEATS:
        found.append(f"seeds {' '.join(map(str, config['seeds'][:9]))}, {counted(config['repeats'], 'repeat')} of each")
    found += [f"rules {plain(config['rules'])}"] * (config["rules"] != PROTOCOL_RULES)
    found += ["rules of another version"] * (not step_budgets(config))
    found += [f"at most {config['max_steps']} steps"] * (config["max_steps"] is not None)
    weights, path = cell.records[0].hashes.get("checkpoint"), shipped_weights(cell.tracker)
    other = weights is not None and (path is None or weights != hash_path(path))
    return ", ".join(found + [f"other weights {plain(weights)}"] * other)


def _counts(rates: Sequence[ConditionRate]) -> set[tuple[object, ...]]:
    return {(*one.row, one.task, len(one.held or ()), sum((one.held or {}).values())) for one in rates}


def _stated(folder: Path, entry: BoardEntry) -> list[ConditionRate]:
    """Numbers of an entry without runs: the paper's, published ones, or those of a `cells.csv`.

    Raises:
        InputError: A row is not known, or the file is missing or damaged.
    """
    if entry.numbers == "paper":
        known = list(FAMILIES.values())
        found = [rate for row in entry.rows if row in known for rate in rates_of_paper(row)]
    elif entry.numbers == "published":
        known = [one.policy for one in published()]
        found = [rate for one in published() if one.policy in entry.rows for rate in rates_of_published(one)]
    else:
        cells = read_cells([folder / entry.numbers]).cells
        known = list(dict.fromkeys(cell.policy for cell in cells))
        found = [rate_of_cell(cell) for cell in cells if cell.policy in entry.rows]
    for row in entry.rows:
        if row not in known:
            raise InputError(
                f"{folder / ENTRY_FILE}: rows: {shown(row)} is not in {entry.numbers}, known are {' '.join(known)}"
            )
    return found
