"""Audit of results folders: chain, lines, derived files, and the level to which they were checked together."""

from __future__ import annotations

import csv
import html
import io
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.audit.draws import found_by
from arena_newton.eval.audit.line_checks import action_faults, configuration_faults, is_current, line_faults
from arena_newton.eval.folders.original_format import ORIGINAL
from arena_newton.eval.folders.results import OWN_FOLDER, Results, RunRecord, in_plan_order, results_json
from arena_newton.eval.records.chain import broken_links, joint_head
from arena_newton.eval.records.document import CONFIG_FILE, plan_faults, read_document, step_budgets
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeRecord, read_journal, write_atomic
from arena_newton.eval.reports import report
from arena_newton.files.stored_json import JsonObject, parse, read_regular
from arena_newton.files.text import counted, plain_text
from arena_newton.pages.tables import Table, escaped

__all__ = ["AUDIT_FILE", "ENGINE", "LEVELS", "Audit", "audited", "facts_of", "print_findings", "runs_in", "sureness"]
__all__ += ["write_pages"]

RESULTS_FILE, TABLE_FILE = "results.json", "table.csv"
WRITER = "written_by"
"""Key of results.json that names the code that wrote the derived files."""
UNCHANGED = "config_hash planned finished complete head".split()
"""Keys of results.json that all code of a version gives alike."""
MAX_DERIVED_BYTES = 512 << 20
MOST_FAULTS = 1000
"""Contradictions that an audit lists; a forged folder may have many times as many."""


AUDIT_FILE = "audit.json"
"""An audit's findings, by folder."""
ENGINE = "mujoco"
"""The engine whose episodes can be played again to the last bit."""
UNCHAINED = "unchained"
"""Head of a run of which a line is of a version without chain."""
SELF_REPORTED, CONSISTENT, REPLAYED, RERUN = "self-reported", "consistent", "replayed", "re-run"
LEVELS = {
    SELF_REPORTED: "numbers of the owner; nothing was checked, or something contradicts",
    CONSISTENT: "lines, plan, rules, links and derived files agree",
    REPLAYED: "episodes were played again from their actions, and ended as recorded",
    RERUN: "the policy was asked again at its queries, and decided as recorded",
}
"""Level to which a result was checked, from low to high → what is known then."""


def print_findings(faults: Sequence[str], notes: Sequence[str]) -> None:
    """Print contradictions and remarks, a line each."""
    for fault in faults:
        print(f"  contradiction: {fault}")
    for note in notes:
        print(f"  {note}")


@dataclass
class Audit:
    """Findings of an audit."""

    run: RunRecord
    results: Results
    faults: list[str] = field(default_factory=list)
    """Contradictions, a sentence each."""
    notes: list[str] = field(default_factory=list)
    """Remarks: what could not be checked, and why."""
    lacking: list[int] = field(default_factory=list)
    """Numbers of the episodes whose actions are not there, or were not kept."""
    absent: int = 0
    """Number of those among the episodes that should have been played again."""
    replayed: int | None = None
    """Episodes that were played again; None: that was not asked for."""
    draw: int | None = None
    """The auditor's number by which they were drawn; None: all were taken."""
    played: list[int] = field(default_factory=list)
    """Their numbers in the plan."""
    policy: str | None = None
    """Spec of the policy that was asked again."""
    asked_policy: JsonObject | None = None
    """File, labels and facts of that policy, and the code that gives them."""
    tolerance: float = 0.0
    """Largest difference of an action that was still taken for the policy's."""
    asked: int | None = None
    """Episodes at whose queries the policy was asked again."""
    fresh: int | None = None
    """Episodes on seeds of the auditor."""
    largest: dict[str, float] = field(default_factory=dict)
    """Largest differences that were measured, by name: `answer` of a policy; `position` [m] and `velocity` [m/s, rad/s]
    after a tick of another engine, and of both the sum over a second."""

    @property
    def head(self) -> str:
        """Head of the chain, or `unchained`."""
        return self.results.get("head", UNCHAINED)

    def to_json(self) -> JsonObject:
        """Content of audit.json."""
        return dict(facts_of([self])) | {
            "levels": LEVELS,
            "contradictions": self.faults,
            "notes": self.notes,
            "replayed": self.replayed,
            "draw": self.draw,
            "played": self.played,
            "policy": self.policy,
            "asked": self.asked,
            "asked_policy": self.asked_policy,
            "tolerance": self.tolerance,
            "largest differences": self.largest,
        }


def level_of(audits: Sequence[Audit]) -> str:
    """Highest level without a contradiction, of runs whose episodes were drawn together."""
    if any(one.faults for one in audits):
        return SELF_REPORTED
    if not any(one.replayed for one in audits) or any(one.absent for one in audits):
        return CONSISTENT
    return RERUN if any(one.asked for one in audits) else REPLAYED


def facts_of(audits: Sequence[Audit]) -> list[tuple[str, str]]:
    """Facts of the audit of one or several runs, by name."""

    def total(name: str) -> int | None:
        known = [number for one in audits if (number := getattr(one, name)) is not None]
        return sum(known) if known else None

    head, again = joint_head([one.results.get("head") for one in audits]) or UNCHAINED, total("replayed")
    finished, planned = sum(one.results["finished"] for one in audits), sum(one.results["planned"] for one in audits)
    found = [("level", level_of(audits)), ("head", head), ("episodes", f"{finished} of {planned}")]
    found += [("replayed", "none" if again is None else f"{again} of {finished}")]
    played = [("asked again", total("asked")), ("fresh", total("fresh"))]
    found += [(name, str(number)) for name, number in played if number is not None]
    found += [("contradictions", str(sum(len(one.faults) for one in audits)))]
    return found + [("configuration", one.results["config_hash"]) for one in audits if len(audits) == 1]


def sureness(audits: Sequence[Audit]) -> list[str]:
    """Sentence about how probably the episodes that were played again show a forged line; none where none were."""
    again = sum(one.replayed or 0 for one in audits)
    sure = found_by(again, sum(one.results["finished"] for one in audits))
    return [f"{counted(again, 'episode')} played again: that finds {sure}."] * bool(again)


def audited(folder: Path) -> Audit:
    """Check a results folder without the simulator.

    Args:
        folder: The folder; nothing in it is written.

    Raises:
        InputError: It holds no run, or journal or configuration cannot be read as one.
    """
    document = read_document(folder)
    path = folder / JOURNAL_FILE
    records, whole = read_journal(path)
    if not path.exists():
        raise InputError(f"{path}: no such file")
    seeds, known = document["config"]["seeds"], document["gym_ids"]
    planned = [record for record in records if record.task in known and record.group_seed in seeds]
    run = RunRecord(folder, document, in_plan_order(planned))
    found = Audit(run, results_json(run))
    for fault in _faults(run, records, found):
        found.faults.append(plain_text(fault, 2000))
        if len(found.faults) == MOST_FAULTS:
            found.notes.append(f"The audit stopped after {counted(MOST_FAULTS, 'contradiction')}.")
            break
    if "head" not in found.results:
        found.notes.append("Unchained: a line was written by a version without chain, or there is none.")
    if not step_budgets(run.config):
        found.notes.append(
            "The rules are of another version: step budgets, predicates and rule texts were not checked."
        )
    if found.lacking:
        found.notes.append(f"{counted(len(found.lacking), 'episode')} cannot be replayed: the actions are not there.")
    if unshown := sum(record.actions is not None and record.shown is None for record in run.records):
        found.notes.append(f"{counted(unshown, 'episode')} without a hash of what the policy was shown: not compared.")
    if retried := len({one.index for one in records if one.outcome == "error"} & _ended(records)):
        found.notes.append(f"{counted(retried, 'episode')} ended as an error first, and was played again.")
    if (left := path.stat().st_size - whole) > 0:
        found.notes.append(f"The last {left:,} bytes of {JOURNAL_FILE} are no whole line: they were not read.")
    if not found.results["complete"]:
        found.notes.append(f"Incomplete: {found.results['finished']} of {found.results['planned']} episodes.")
    return found


def _ended(records: Sequence[EpisodeRecord]) -> set[int]:
    """Numbers of the episodes that ended otherwise than as an error."""
    return {one.index for one in records if one.outcome != "error"}


def _faults(run: RunRecord, records: list[EpisodeRecord], found: Audit) -> Iterator[str]:
    """All contradictions, in the order of a reader: configuration, lines, chain, actions, tables."""
    yield from configuration_faults(run)
    yield from map(str, plan_faults(run.folder, records, run.document))
    yield from line_faults(run, records)
    yield from broken_links(run.folder / JOURNAL_FILE, records)
    yield from action_faults(run, run.records, found.lacking)
    yield from _derived_faults(run, found)


def _derived_faults(run: RunRecord, found: Audit) -> Iterator[str]:
    """Derived files that are not what journal and configuration give.

    Bytes are held to those that this code writes. Where `results.json` names other code, or none, the figures of
    `results.json` and `table.csv` are held alone: other code words its pages differently.
    """
    wanted = report.derived_files(run, found.results)
    wanted |= {f"{ORIGINAL}/{name}": text for name, text in report.original_of(run).items()}
    here = is_current(run)
    same = here and _same_writer(run.folder / RESULTS_FILE, wanted[RESULTS_FILE])
    missing, other, names = [], [], {one for r in run.records for one in (r.task, r.tracker, r.mode, r.outcome)}
    for name, text in wanted.items():
        path = run.folder / name
        try:
            data = read_regular(path, MAX_DERIVED_BYTES)
        except FileNotFoundError:
            missing.append(name)
            continue
        if data == text.encode():
            continue
        if name == RESULTS_FILE and not same:
            if not _same_figures(data, text, UNCHANGED if here else ()):
                yield f"{path}: its cells or suites are not those of the journal"
        elif name == TABLE_FILE and here and not same:
            if not _same_columns(data, text):
                yield f"{path}: its figures are not those of the journal"
        elif not same:
            other += [name] * here
        elif name != "report.html" or _shown(data.decode(errors="replace"), names) != _shown(text, names):
            yield f"{path}: is not what journal and configuration give; `eval report` writes it again"
        else:
            what = "the figures and names in its text were compared, not what its style and script show"
            found.notes.append(f"{name} was written with another template: {what}.")
    if (run.folder / ORIGINAL).is_symlink():
        yield f"{run.folder / ORIGINAL}: is a link; a run writes inside its own folder only"
        return
    extra = {path.relative_to(run.folder).as_posix() for path in (run.folder / ORIGINAL).rglob("*") if path.is_file()}
    for name in sorted(extra - set(wanted)):
        yield f"{run.folder / name}: is of no episode of the journal"
    if missing:
        found.notes.append(f"{counted(len(missing), 'derived file')} not there, such as {missing[0]}.")
    if other:
        found.notes.append(f"Written by other code, not compared: {' '.join(other)}.")
    if not here:
        found.notes.append("Written by another version: of the tables the figures alone were compared.")


def _same_writer(path: Path, text: str) -> bool:
    """True if a results.json names the code that writes this text, or cannot be read, which is no excuse."""
    try:
        stored = parse(read_regular(path, MAX_DERIVED_BYTES))
    except FileNotFoundError:
        return False
    except ValueError:
        return True
    return not isinstance(stored, dict) or stored.get(WRITER) == json.loads(text)[WRITER]


def _shown(page: str, names: set[str]) -> list[str]:
    """Figures and names that a page shows, in their order, whatever its template, style and script."""
    visible = re.sub(r"(?s)<(style|script)\b.*?</\1>|<[^>]*>", " ", page)
    return [word for word in html.unescape(visible).split() if word in names or any(map(str.isdigit, word))]


def _same_figures(data: bytes, text: str, keys: Sequence[str]) -> bool:
    """True if a results.json of any code has the cells and suites of this text, and the same values of some keys."""
    ours: JsonObject = json.loads(text)
    try:
        stored = parse(data)
    except ValueError:
        return False
    if not isinstance(stored, dict) or any(stored[key] != ours[key] for key in keys if key in stored and key in ours):
        return False
    for kind in ("cells", "suites"):
        given, rows = stored.get(kind), ours[kind]
        if not isinstance(given, list) or len(given) != len(rows):
            return False
        for one, row in zip(given, rows, strict=True):
            if not isinstance(one, dict) or any(one[key] != row[key] for key in one if key in row):
                return False
    return True


def _same_columns(data: bytes, text: str) -> bool:
    """True if a table.csv of any code has the rows of this text, as far as both have a column."""
    try:
        given, rows = (list(csv.DictReader(io.StringIO(one))) for one in (data.decode(errors="replace"), text))
    except csv.Error:
        return False
    return len(given) == len(rows) and all(
        one[key] == row[key] for one, row in zip(given, rows, strict=True) for key in one if key in row
    )


def write_pages(audits: list[Audit], out: Path) -> None:
    """Write audit.json and audit.md of one or several audits into a folder.

    Raises:
        StorageError: A file cannot be written.
    """
    content = {str(one.run.folder): one.to_json() for one in audits}
    write_atomic(out / AUDIT_FILE, json.dumps(content, indent=2) + "\n")
    together = [(counted(len(audits), "run"), audits)] if len(audits) > 1 else []
    lines = ["# Audit", ""]
    for title, some in [*together, *((str(one.run.folder), [one]) for one in audits)]:
        lines += [f"## {escaped(title)}: {level_of(some)}", ""]
        lines += [*Table(("", ""), facts_of(some), "ll").compact(escaped, ("---", "---")), ""]
        if len(some) == 1:
            lines += [f"- contradiction: {escaped(fault)}" for fault in some[0].faults]
            lines += [f"- {escaped(note)}" for note in some[0].notes]
        lines += [f"- {note}" for note in sureness(some) if len(some) == len(audits)] + [""]
    lines += ["## Levels", "", *(f"- {level}: {text}" for level, text in LEVELS.items())]
    write_atomic(out / "audit.md", "\n".join(lines) + "\n")


def runs_in(folder: Path) -> list[Path]:
    """All results folders in a folder: itself, and those below, as of a suite, but for a run's own replays.

    Raises:
        InputError: There is none.
    """
    known = (path.relative_to(folder).parent for path in folder.rglob(CONFIG_FILE))
    found = [folder / inside for inside in sorted(known) if OWN_FOLDER not in inside.parts]
    if not found:
        raise InputError(f"{folder}: no results folder (it has no {CONFIG_FILE})")
    return found
