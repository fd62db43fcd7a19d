"""Pages of the leaderboard: a board of all rates, and a page for each entry. Each opens from a disk, offline."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.audit.folder_audit import LEVELS
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.eval.leaderboard.checked_entry import CheckedEntry
from arena_newton.eval.leaderboard.entry_file import BUNDLE_FILE
from arena_newton.eval.leaderboard.result_bundle import MAX_BUNDLE_BYTES, strips_of
from arena_newton.eval.reports.failure_text import SENTENCES
from arena_newton.eval.reports.html_report import FOLDER
from arena_newton.eval.statistics.stats import contrast, suites, wilson
from arena_newton.eval.tables.condition_rates import SETTINGS, ConditionRate
from arena_newton.eval.tables.episode_table import NAMED
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.stored_json import read_regular
from arena_newton.files.text import plain
from arena_newton.pages.html import FILES, render
from arena_newton.pages.tables import between, percent
from arena_newton.rules import modes
from arena_newton.tasks.semantic_mode import semantic_notes, task_title

__all__ = ["write_site"]

MOST_STRIPS = 12
"""Film strips on the page of an entry."""
TITLE = b"HumanoidArena leaderboard</title>"
"""End of the title of every page, by which a former build is known."""
MAX_PAGE_BYTES = 64 << 20
BASE = "base"


@dataclass(frozen=True)
class _Cell:
    """A number of the board."""

    label: str
    text: str = ""
    interval: str = ""
    value: float | str = ""
    """Number by which its column is sorted; empty without one."""


@dataclass(frozen=True)
class _Row:
    """Rates of an entry in all tasks under one set of conditions."""

    checked: CheckedEntry
    mode: str
    trained_on: str
    tracker: str
    unusual: str
    """Conditions that are not the protocol's."""
    cells: tuple[_Cell, ...]
    """Mean over all tasks, then each task."""
    order: float

    @property
    def level(self) -> str:
        return self.checked.entry.level


@dataclass(frozen=True)
class _Section:
    """A table of the board."""

    title: str
    about: str
    rows: Sequence[_Row]


def _rows(checked: CheckedEntry) -> Iterator[tuple[str, _Row]]:
    """Setting and row of every set of conditions of an entry."""
    groups: dict[tuple[str, ...], dict[str, ConditionRate]] = {}
    for rate in checked.rates:
        groups.setdefault((*rate.row, rate.unusual), {})[rate.task] = rate
    for (setting, mode, trained_on, tracker, unusual), rates in groups.items():
        cells = [_cell(task_title(task), rates.get(task)) for task in suites()["ALL_AVG"]]
        mean = sum(rate.rate for rate in rates.values()) / len(rates)
        yield setting, _Row(checked, mode, trained_on, tracker, unusual, (_mean(rates, mean), *cells), mean)


def _cell(label: str, rate: ConditionRate | None) -> _Cell:
    if rate is None:
        return _Cell(label)
    interval = wilson(sum(rate.held.values()), len(rate.held)) if rate.held is not None else None
    return _Cell(label, percent(rate.rate), "" if interval is None else between(interval), rate.rate)


def _mean(rates: dict[str, ConditionRate], mean: float) -> _Cell:
    """Mean over all tasks of the suites; a part of them has none."""
    held = [rate.held for rate in rates.values() if rate.held is not None]
    if set(rates) != set(suites()["ALL_AVG"]):
        return _Cell("mean", f"{len(rates)} of {len(suites()['ALL_AVG'])} tasks")
    found = contrast([[(1 / len(held), one)] for one in held]) if len(held) == len(rates) else None
    return _Cell("mean", percent(mean), "" if found is None else between((found.low, found.high)), mean)


def _sections(entries: Sequence[CheckedEntry]) -> list[_Section]:
    """Tables of the board: each setting in base mode, and after the first the other modes."""
    rows = [pair for one in entries for pair in _rows(one)]
    rows.sort(key=lambda pair: (pair[1].cells[0].value == "", -pair[1].order, pair[1].checked.name))

    def of(setting: str, base: bool) -> list[_Row]:
        return [row for name, row in rows if name == setting and (row.mode == BASE) is base]

    sections = []
    for setting, about in SETTINGS.items():
        others = of(setting, False)
        changed = [f"{about}; placements, light or looks differ from base mode."]
        changed += semantic_notes(row.mode for row in others)
        sections.append(_Section(setting, f"{about}; mode base.", of(setting, True)))
        sections.append(_Section(f"{setting}, other modes", " ".join(changed), others))
    return [one for one in sections if one.rows]


def write_site(entries: Sequence[CheckedEntry], folders: Sequence[Path], out: Path) -> None:
    """Write `index.html`, a page for each entry with its film strips, and its bundle.

    Args:
        entries: Entries without contradictions; their unpacked bundles are still there.
        folders: Folder of each.
        out: Folder of the site; pages of a former build are replaced, other files stay.

    Raises:
        InputError: A page would replace one of something else.
        OSError: A file cannot be written.
    """
    for name in ("index", *(one.name for one in entries)):
        if (path := out / f"{name}.html").exists() and TITLE not in read_regular(path, MAX_PAGE_BYTES):
            raise InputError(f"--out {out}: {path.name} is of something else than a leaderboard; name another folder")
    sections = _sections(entries)
    shown = [row for section in sections for row in section.rows]
    filters = {
        "level": [level for level in LEVELS if any(row.level == level for row in shown)],
        "tracker": sorted({one for row in shown for one in row.tracker.split("+")}),
        "mode": [mode for mode in modes.names() if any(row.mode == mode for row in shown)],
        "data": sorted({row.checked.entry.training_data for row in shown}),
    }
    columns = ("mean", *map(task_title, suites()["ALL_AVG"]))
    styles = ["report.css", "board.css"]
    index = FOLDER / "board.html"
    text = render(
        index, styles=styles, script="board.js", sections=sections, filters=filters, columns=columns, levels=LEVELS
    )
    for one, folder in zip(entries, folders, strict=True):
        own = [_Section(section.title, "", [r for r in section.rows if r.checked is one]) for section in sections]
        strips = []
        for caption, path in [strip for audit in one.audits for strip in strips_of(audit.run)][:MOST_STRIPS]:
            data = read_regular(path, MAX_BUNDLE_BYTES)
            name = f"{one.name}/{hashlib.sha256(data).hexdigest()[:16]}{path.suffix}"
            _write(out / name, data)
            strips.append((caption, name))
        bundle = f"{one.name}/{BUNDLE_FILE}" if one.audits else ""
        if bundle:
            _write(out / bundle, read_regular(folder / BUNDLE_FILE, MAX_BUNDLE_BYTES))
        failures = [cell for audit in one.audits for cell in audit.results.get("failures", [])]
        page = render(
            FOLDER / "entry.html",
            styles=styles,
            sources=FILES,
            checked=one,
            sections=[section for section in own if section.rows],
            columns=columns,
            meaning=LEVELS[one.entry.level],
            facts=_facts(one),
            failures=failures,
            stages={str(stage): SENTENCES[stage] for stage in FailureStage},
            strips=strips,
            bundle=bundle,
        )
        _write(out / f"{one.name}.html", page.encode())
    _write(out / "index.html", text.encode())  # last: all that it links to is there


def _facts(one: CheckedEntry) -> list[tuple[str, str]]:
    """Facts that an entry and its runs say, by name; nothing empty."""
    entry, audits = one.entry, one.audits
    played = sum(audit.results["finished"] for audit in audits)
    again = sum(audit.replayed or 0 for audit in audits)
    found = [("authors", entry.authors), ("date", entry.date), ("source", entry.source)]
    found += [("simulator", entry.simulator), ("trackers", " ".join(entry.trackers)), ("hardware", entry.hardware)]
    found += [("training", entry.training), ("training data", entry.training_data), ("weights", entry.checkpoint)]
    found += [("head", entry.head), ("bundle, SHA-256", entry.bundle), ("checked", entry.checked)]
    found += [("policy of its runs", " ".join(sorted({audit.run.config["policy"] for audit in audits})))]
    for name in NAMED:
        values = {plain(audit.run.config.get(name, "")) for audit in audits}
        found += [(name.replace("_", " "), " ".join(sorted(values)))]
    used = {(one.tracker, str(one.hashes.get("checkpoint"))) for audit in audits for one in audit.run.records}
    found += [("weights of trackers", ", ".join(f"{tracker} {weights}" for tracker, weights in sorted(used)))]
    found += [("audit of this board", f"{played} episodes, {again} played again, no contradiction" * bool(audits))]
    return [(name, value) for name, value in found if value]


def _write(path: Path, data: bytes) -> None:
    with replace_atomically(path) as file:
        file.write(data)
