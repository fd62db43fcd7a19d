"""The paper's tables from cells of evaluations: in-GMT, modes, cross-GMT, merged training, latency, label protocols.

Each is filled with our numbers next to those that the paper prints. Differences are taken over episodes that both
conditions played, and tested by the exact McNemar test, adjusted for the number of tests in a table (Holm).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from arena_newton import tasks
from arena_newton.eval.statistics.stats import contrast, paired_rates, suites
from arena_newton.eval.tables.cost_table import cost_table
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.paired_rows import PAIRED, RowPair, paired_rows
from arena_newton.eval.tables.paper_numbers import (
    FAMILIES,
    TRAINING_SETS,
    PaperNumbers,
    PaperRate,
    PublishedRow,
    published,
)
from arena_newton.eval.tables.table_entries import (
    PAPER_NAMES,
    UNDEFINED,
    SuiteTable,
    TableEntry,
    interval_text,
    ordered,
    ours,
    ours_average,
    paper_entry,
    probability,
    published_entry,
    rate_text,
)
from arena_newton.eval.tables.trainings_table import trainings_table
from arena_newton.pages.tables import percent, points
from arena_newton.tasks.semantic_mode import semantic_notes, task_title

__all__ = ["MODE_ORDER", "suite_tables", "tracker_order"]

MODE_ORDER = ("base", "visual", "semantic", "execution")
"""Order of the paper's columns."""
HALVES = ("HOI_AVG", "HSI_AVG")
SHORT = {"HOI_AVG": "HOI avg", "HSI_AVG": "HSI avg"}
OURS = (
    "Success rate in %: mean ± population std over seeds, in parentheses the 95 % interval (Wilson's of a cell; of an "
    "average from the spread of its episodes). n: episodes of a cell. AFR: falls of all episodes of the row. Empty: "
    "not evaluated."
)
INTERVALS = (
    f"{OURS} Intervals are of these networks, and leave out how much trainings differ. Rows of the paper: as printed; "
    "their intervals are derived from rate × episodes."
)


def suite_tables(cells: Sequence[EvaluatedCell], paper: PaperNumbers, changed: Sequence[str] = ()) -> list[SuiteTable]:
    """All tables that the cells can fill, in the paper's order; those without an entry of ours are left out.

    `changed` says why episodes are no results of the benchmark: each table begins with it, and none has numbers of
    others, which were played under the rules.
    """
    if changed:
        paper = PaperNumbers({}, {}, {})
    cells = [cell for cell in cells if cell.records]
    prompt = [cell for cell in cells if cell.latency == 0]
    modes = ordered({c.mode for c in prompt}, MODE_ORDER)
    found: list[SuiteTable | None] = [_in_gmt(prompt, paper, mode) for mode in modes]
    found += [table(prompt, mode) for table in (_merged, _untrained) for mode in modes]
    found += [
        trainings_table(prompt),
        _best(prompt, paper),
        _families(prompt),
        _perturbation(prompt, paper),
        _cross_gmt(prompt, paper),
        _merge_all(prompt, paper),
        _latency(cells),
        _labels(prompt),
        cost_table(cells),
    ]
    return [_with_rules(table, changed) for table in found if table is not None]


def _with_rules(table: SuiteTable, changed: Sequence[str]) -> SuiteTable:
    """The table without groups that have no row, and with what makes it no result in front of its caption."""
    begun = dict.fromkeys(number for number in table.groups if number < len(table.rows))
    return dataclasses.replace(table, groups=tuple(begun), caption=" ".join([*changed, table.caption]))


def tracker_order(names: set[str]) -> list[str]:
    """Trackers, the paper's first."""
    return ordered(names, ("twist2", "sonic"))


def _policies(cells: Sequence[EvaluatedCell]) -> list[tuple[str, str]]:
    """Policy and family of rows: the paper's families in its order, then the others."""
    order = {family: number for number, family in enumerate(FAMILIES.values())}
    pairs = dict.fromkeys((cell.policy, cell.family) for cell in cells)
    return sorted(pairs, key=lambda pair: (order.get(pair[1], len(order)), pair[0]))


def _tasks(cells: Sequence[EvaluatedCell]) -> list[str]:
    return ordered({cell.task for cell in cells}, suites()["ALL_AVG"])


def _in_gmt_cells(cells: Sequence[EvaluatedCell], mode: str = "base") -> list[EvaluatedCell]:
    """Cells of policies of one task's demonstrations that were executed by the tracker of their training."""
    return [cell for cell in cells if cell.mode == mode and cell.trained_on and cell.matched and not cell.merged]


def _rate_columns(cells: Sequence[EvaluatedCell]) -> tuple[str, ...]:
    """Tasks that were played and averages of which all are, as the paper orders them, then tasks outside its suites."""
    played = {cell.task for cell in cells}
    columns: list[str] = []
    for half in HALVES:
        columns += [task for task in suites()[half] if task in played]
        columns += [half] if played >= set(suites()[half]) else []
    return (*columns, *sorted(played - set(suites()["ALL_AVG"])))


def _rate_row(table: str, cells: Sequence[EvaluatedCell], columns: Sequence[str]) -> tuple[list[str], list[TableEntry]]:
    """n, AFR and rates of one policy; several cells of a task (of several trackers) are pooled."""
    entries: list[TableEntry] = []
    texts = []
    for column in columns:
        average = column in HALVES
        mine = [cell for cell in cells if cell.task == column]
        entry: TableEntry | None
        if average:
            entry = ours_average(table, column, cells, suites()[column])
        elif len(mine) == 1:
            entry = ours(table, mine[0])
        else:
            entry = ours_average(table, column, mine, (column,))
        texts.append(rate_text(entry, 2 if average else 1) if entry else "")
        entries += [entry] if entry else []
    sizes = sorted({e.episodes or 0 for e in entries if e.task not in HALVES})
    falls = sum(record.outcome == "fall" for cell in cells for record in cell.records)
    total = sum(len(cell.records) for cell in cells)
    size = "" if not sizes else str(sizes[0]) if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
    return [size, percent(falls / total, 2) if total else "", *texts], entries


def _paper_row(
    table: str, rates: Mapping[str, PaperRate | None], trained_on: str = ""
) -> tuple[list[str], list[TableEntry]]:
    entries = {column: paper_entry(table, rate, trained_on) for column, rate in rates.items() if rate is not None}
    texts = [rate_text(entries[c], 2 if c in HALVES else 1) if c in entries else "" for c in rates]
    sizes = sorted({e.episodes or 0 for c, e in entries.items() if c not in HALVES})
    size = str(sizes[0]) if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
    afr = next(iter(entries.values())).afr
    return [size, percent(afr, 2) if afr is not None else "", *texts], list(entries.values())


def _in_gmt(cells: Sequence[EvaluatedCell], paper: PaperNumbers, mode: str) -> SuiteTable | None:
    mine = _in_gmt_cells(cells, mode)
    if not mine:
        return None
    name = "in_gmt" if mode == "base" else f"in_gmt_{mode}"
    columns = _rate_columns(mine)
    rows: list[tuple[str, ...]] = []
    entries: list[TableEntry] = []
    groups = []
    for tracker in tracker_order({cell.tracker for cell in mine}):
        here = [cell for cell in mine if cell.tracker == tracker]
        groups.append(len(rows))
        done = set()
        for policy, family in _policies(here):
            texts, found = _rate_row(name, [c for c in here if (c.policy, c.family) == (policy, family)], columns)
            rows.append((tracker, policy, "ours", *texts))
            entries += found
            known = (tracker, mode, family, "HOI_AVG") in paper.in_gmt
            if known and family not in done:
                done.add(family)
                printed = {task: paper.in_gmt.get((tracker, mode, family, task)) for task in columns}
                texts, found = _paper_row(name, printed)
                rows.append((tracker, PAPER_NAMES[family], "paper", *texts))
                entries += found
        for other in _published(paper, tracker, mode):
            found = [published_entry(name, other, task) for task in columns if task in other.rates]
            texts = [percent(other.rates[task]) if task in other.rates else "" for task in columns]
            rows.append((tracker, other.policy, "self-reported", "", "", *texts))
            entries += found
    named = [SHORT.get(c, task_title(c)) + _change(mode, c) for c in columns]
    title = "In-GMT evaluation" + ("" if mode == "base" else f", mode {mode}")
    about = _reported(paper) if mode == "base" else _about(mode)
    caption = f"Policies executed by the tracker of their training. {INTERVALS}{about}"
    head = ("tracker", "policy", "source", "n", "AFR", *named)
    return SuiteTable(head, rows, "lllr", title, caption, name, groups, entries)


def _published(paper: PaperNumbers, tracker: str, mode: str) -> list[PublishedRow]:
    """Rows of others, in base mode; none where the paper's have no place."""
    return [row for row in published() if paper.in_gmt and (row.tracker, mode) == (tracker, "base")]


def _change(mode: str, task: str) -> str:
    """Change that semantic mode makes in a task, to follow its name."""
    change = tasks.get(task).semantic_change if mode == "semantic" and task in tasks.names() else None
    return f" ({change})" if change else ""


def _about(*modes: str) -> str:
    """Sentences for a reader of numbers of semantic modes."""
    return "".join(f" {note}" for note in semantic_notes(modes))


def _reported(paper: PaperNumbers) -> str:
    """Sentences that name whose the rows are which others published."""
    return "".join(f" Self-reported: {row}." for row in published() if paper.in_gmt)


def _untrained(cells: Sequence[EvaluatedCell], mode: str) -> SuiteTable | None:
    """Policies without training, such as the expert, which no tracker is the own one of."""
    mine = [cell for cell in cells if cell.mode == mode and not cell.trained_on]
    about = "Policies that were not trained, or do not say on what."
    return _by_tracker(mine, mode, "untrained", "Policies without training", about)


def _merged(cells: Sequence[EvaluatedCell], mode: str) -> SuiteTable | None:
    """Policies of merged demonstrations through each tracker, also those that none of these were recorded through."""
    mine = [cell for cell in cells if cell.mode == mode and cell.trained_on and cell.merged]
    about = "Policies of the demonstrations of several tasks or trackers, through each tracker by itself."
    return _by_tracker(mine, mode, "merged", "Merged training by tracker", about)


def _by_tracker(cells: Sequence[EvaluatedCell], mode: str, kind: str, title: str, about: str) -> SuiteTable | None:
    """Rates of each policy through each tracker in a mode."""
    if not cells:
        return None
    name = kind if mode == "base" else f"{kind}_{mode}"
    columns = _rate_columns(cells)
    rows: list[tuple[str, ...]] = []
    entries: list[TableEntry] = []
    groups = []
    for tracker in tracker_order({cell.tracker for cell in cells}):
        groups.append(len(rows))
        here = [cell for cell in cells if cell.tracker == tracker]
        for policy, family in _policies(here):
            texts, found = _rate_row(name, [c for c in here if (c.policy, c.family) == (policy, family)], columns)
            rows.append((tracker, policy, *texts))
            entries += found
    head = ("tracker", "policy", "n", "AFR", *(SHORT.get(c, task_title(c)) + _change(mode, c) for c in columns))
    named = title + ("" if mode == "base" else f", mode {mode}")
    return SuiteTable(head, rows, "llr", named, f"{about} {OURS}{_about(mode)}", name, groups, entries)


def _best(cells: Sequence[EvaluatedCell], paper: PaperNumbers) -> SuiteTable | None:
    """Our best policy per task next to the paper's best."""
    learned = [cell for cell in _in_gmt_cells(cells) if cell.trained_on and cell.task in suites()["ALL_AVG"]]
    if not learned:
        return None
    rows: list[tuple[str, ...]] = []
    entries: list[TableEntry] = []
    groups = []
    for tracker in tracker_order({cell.tracker for cell in learned}):
        groups.append(len(rows))
        for task in _tasks(learned):
            here = [ours("best", cell) for cell in learned if (cell.tracker, cell.task) == (tracker, task)]
            if not here:
                continue
            top = max(here, key=lambda entry: (entry.sr or 0.0, entry.policy))
            entries.append(top)
            row = [tracker, task_title(task), top.policy, f"{top.successes}/{top.episodes}", rate_text(top)]
            if (tracker, "base", "act", task) in paper.in_gmt:
                rate = paper.best(tracker, task)
                theirs = paper_entry("best", rate)
                entries.append(theirs)
                row += [PAPER_NAMES[rate.family], f"{theirs.successes}/{theirs.episodes}", rate_text(theirs)]
                low, high = (top.low or 0.0), (theirs.high or 1.0)
                above = "apart" if low > high else "higher" if (top.sr or 0) > rate.sr else "not higher"
                row.append(above)
            else:
                row += ["", "", "", ""]
            reported = [one for one in _published(paper, tracker, "base") if task in one.rates]
            row.append(", ".join(f"{one.policy} {percent(one.rates[task])}" for one in reported))
            entries += [published_entry("best", one, task) for one in reported]
            rows.append(tuple(row))
    theirs_head = ("best of the paper", "won", "rate", "ours is", "self-reported")
    head = ("tracker", "task", "best of ours", "won", "rate", *theirs_head)
    caption = (
        "The policy with the highest rate of each task, mode base. Apart: our interval is above the paper's. Choosing "
        "the highest of several favours it, on both sides. The paper's successes are derived from its rates."
        f"{_reported(paper)}"
    )
    return SuiteTable(head, rows, "lllr", "Best policy per task", caption, "best", groups, entries)


def _families(cells: Sequence[EvaluatedCell]) -> SuiteTable | None:
    mine = [cell for cell in _in_gmt_cells(cells) if cell.trained_on]
    pairs = []
    groups = []
    for tracker in tracker_order({cell.tracker for cell in mine}):
        groups.append(len(pairs))
        for task in _tasks(mine):
            here: dict[str, EvaluatedCell] = {}
            for cell in mine:
                if (cell.tracker, cell.task) == (tracker, task):
                    here.setdefault(cell.recipe, cell)  # of several trainings the first
            order = [policy for policy, _ in _policies(list(here.values()))]
            ranked = sorted(here.values(), key=lambda cell: order.index(cell.policy))
            for number, first in enumerate(ranked):
                pairs += [
                    RowPair(first, second, (tracker, task_title(task), first.policy, second.policy))
                    for second in ranked[number + 1 :]
                ]
    if not pairs:
        return None
    rows, entries = paired_rows("families", pairs)
    rows = [(*row[:8], *row[9:-1]) for row in rows]
    head = ("tracker", "task", "first", "second", "n", "first %", "second %", "Δ", "alone", "p", "p (Holm)")
    caption = PAIRED + "In-GMT, mode base, of a recipe its first training. They tell networks apart, no families."
    return SuiteTable(head, rows, "llllr", "Policies against each other", caption, "families", groups, entries)


def _cross_gmt(cells: Sequence[EvaluatedCell], paper: PaperNumbers) -> SuiteTable | None:
    single = [c for c in cells if c.mode == "base" and len(c.trained_on) == 1 and not c.merged]
    matched = {(c.policy, c.trained_on, c.task): c for c in single if c.matched}
    pairs = []
    groups = []
    directions = dict.fromkeys((c.trained_on[0], c.tracker) for c in single if not c.matched)
    for a in tracker_order({a for a, _ in directions}):
        for b in tracker_order({b for x, b in directions if x == a}):
            groups.append(len(pairs))
            for task in _tasks(single):
                here = [c for c in single if (c.trained_on, c.tracker, c.task) == ((a,), b, task)]
                for policy, family in _policies(here):
                    cell = next(c for c in here if (c.policy, c.family) == (policy, family))
                    base = matched.get((policy, (a,), task))
                    if base is None:
                        continue
                    theirs = paper.cross_gmt.get((a, b, family, task))
                    printed = ("", "", "")
                    if theirs is not None:
                        whole = paper.in_gmt[a, "base", family, task].sr > 0
                        kept = percent(theirs.retention) if whole else UNDEFINED
                        printed = (points(theirs.drop), kept, percent(theirs.task_afr, 2))
                    pairs.append(RowPair(base, cell, (f"{a} → {b}", task_title(task), policy), printed))
    if not pairs:
        return None
    rows, entries = paired_rows("cross_gmt", pairs)
    entries += _paper_transfers(pairs, paper)
    head = ("direction", "task", "policy", "n", "matched %", "swapped %", "Δ", "Ret %", "alone", "p", "p (Holm)", "AFR")
    heads = (*head, "paper Δ", "paper Ret %", "paper AFR")
    caption = (
        f"{PAIRED}Δ: matched minus swapped. Ret: swapped over matched; {UNDEFINED} where nothing succeeded when "
        "matched. AFR: falls of the swapped episodes; the paper's is of the task and direction over all its policies."
    )
    return SuiteTable(heads, rows, "lllr", "Cross-GMT evaluation", caption, "cross_gmt", groups, entries)


def _paper_transfers(pairs: Sequence[RowPair], paper: PaperNumbers) -> list[TableEntry]:
    found = {}
    for pair in pairs:
        key = (pair.first.tracker, pair.second.tracker, pair.second.family, pair.second.task)
        cell = paper.cross_gmt.get(key)
        if cell is None:
            continue
        matched = paper.in_gmt[cell.trained_on, "base", cell.family, cell.task]
        found[key] = TableEntry(
            table="cross_gmt",
            source="paper",
            policy=cell.family,
            family=cell.family,
            trained_on=cell.trained_on,
            tracker=cell.tracker,
            task=cell.task,
            sr=max(0.0, matched.sr - cell.drop),
            matched_sr=matched.sr,
            drop=cell.drop,
            retention=cell.retention if matched.sr > 0 else None,
            derived=True,
            afr=cell.task_afr,
        )
    return list(found.values())


def _perturbation(cells: Sequence[EvaluatedCell], paper: PaperNumbers) -> SuiteTable | None:
    """Average rates per mode over the tasks that were played in every mode shown, and drops from base."""
    mine = [c for mode in MODE_ORDER for c in _in_gmt_cells(cells, mode)]
    modes = ordered({c.mode for c in mine}, MODE_ORDER)
    if len(modes) < 2 or "base" not in modes:
        return None
    rows: list[tuple[str, ...]] = []
    entries: list[TableEntry] = []
    groups = []
    for tracker in tracker_order({c.tracker for c in mine}):
        groups.append(len(rows))
        for policy, family in _policies([c for c in mine if c.tracker == tracker]):
            own = [c for c in mine if (c.tracker, c.policy, c.family) == (tracker, policy, family)]
            shown = [mode for mode in modes if any(c.mode == mode for c in own)]
            for suite in HALVES:
                played = [
                    t for t in suites()[suite] if all(any(c.task == t and c.mode == m for c in own) for m in shown)
                ]
                if len(shown) < 2 or not played:
                    continue
                texts, found = _profile(own, shown, modes, suite, played)
                whole = (
                    "" if len(played) == len(suites()[suite]) else f" ({len(played)} of {len(suites()[suite])} tasks)"
                )
                rows.append((tracker, policy, "ours", suite.removesuffix("_AVG") + whole, *texts))
                entries += found
                if (tracker, "base", family, suite) in paper.in_gmt:
                    texts = _paper_profile(paper, tracker, family, played, modes)
                    entries += _paper_means(paper, tracker, family, suite, played, modes)
                    rows.append((tracker, PAPER_NAMES[family], "paper", suite.removesuffix("_AVG") + whole, *texts))
    if not entries:
        return None
    head = ("tracker", "policy", "source", "suite", *modes)
    caption = (
        "Mean success rate in % over a suite's tasks that were played in every mode shown, and its change from base in "
        f"points with the 95 % interval over paired episode seeds.{_about(*modes)}"
    )
    if others := sorted({c.mode for c in cells} - set(MODE_ORDER)):
        caption += f" Without {', '.join(others)}: no mode of the paper, each has a table of its own."
    return SuiteTable(head, rows, "llllr", "Perturbation profile", caption, "perturbation", groups, entries)


def _profile(
    own: Sequence[EvaluatedCell], shown: Sequence[str], modes: Sequence[str], suite: str, played: Sequence[str]
) -> tuple[list[str], list[TableEntry]]:
    base = {c.task: c for c in own if c.mode == "base"}
    texts, entries = [], []
    for mode in modes:
        here = [c for c in own if c.mode == mode]
        entry = ours_average("perturbation", suite, here, played) if mode in shown else None
        if entry is None or entry.sr is None:
            texts.append("")
            continue
        text = percent(entry.sr)
        if mode != "base" and base:
            weight = 1 / len(played)
            by_task = {c.task: c for c in here}
            drop = contrast([[(weight, base[t].held()), (-weight, by_task[t].held())] for t in played])
            if drop is not None:
                entry = dataclasses.replace(
                    entry,
                    drop=drop.value,
                    drop_low=drop.low,
                    drop_high=drop.high,
                    pairs=drop.episodes,
                    unpaired=drop.unpaired,
                )
                text += f", {points(-drop.value)} {interval_text(-drop.high, -drop.low)}"
        entries.append(entry)
        texts.append(text)
    return texts, entries


def _paper_profile(
    paper: PaperNumbers, tracker: str, family: str, played: Sequence[str], modes: Sequence[str]
) -> list[str]:
    rates = {m: sum(paper.in_gmt[tracker, m, family, t].sr for t in played) / len(played) for m in modes}
    return [percent(r) + ("" if m == "base" else f", {points(r - rates['base'])}") for m, r in rates.items()]


def _paper_means(
    paper: PaperNumbers, tracker: str, family: str, suite: str, played: Sequence[str], modes: Sequence[str]
) -> list[TableEntry]:
    found = []
    for mode in modes:
        rates = [paper.in_gmt[tracker, mode, family, task] for task in played]
        whole = paper_entry("perturbation", paper.in_gmt[tracker, mode, family, suite])
        mean = sum(rate.sr for rate in rates) / len(rates)
        part = len(played) < len(suites()[suite])
        episodes = sum(rate.episodes for rate in rates)
        found.append(dataclasses.replace(whole, sr=mean, sr_std=None, episodes=episodes) if part else whole)
    return list(dict.fromkeys(found))


def _merge_all(cells: Sequence[EvaluatedCell], paper: PaperNumbers) -> SuiteTable | None:
    merged = [c for c in cells if c.merged and c.mode == "base" and c.tracker in c.trained_on]
    if not merged:
        return None
    names = {trackers: name for name, trackers in TRAINING_SETS.items()}
    columns = _rate_columns(merged)
    rows: list[tuple[str, ...]] = []
    entries: list[TableEntry] = []
    groups = []
    for trained_on in sorted({c.trained_on for c in merged}, key=lambda t: (len(t), t[0] != "twist2", t)):
        here = [c for c in merged if c.trained_on == trained_on]
        known = names.get(trained_on, "")
        for policy, family in _policies(here):
            mine = [c for c in here if (c.policy, c.family) == (policy, family)]
            number = max(len(c.trained_tasks) for c in mine) * len(trained_on)
            label = f"{'+'.join(t.upper() for t in trained_on)} ×{number}"
            if not groups or rows[groups[-1]][0].split(" ")[0] != label.split(" ")[0]:
                groups.append(len(rows))
            texts, found = _rate_row("merge_all", mine, columns)
            rows.append((label, policy, "ours", *texts))
            entries += found
            if (known, family, "HOI_AVG") in paper.merged:
                printed = {task: paper.merged.get((known, family, task)) for task in columns}
                texts, found = _paper_row("merge_all", printed, "+".join(trained_on))
                rows.append((known.replace("x", " ×"), PAPER_NAMES[family], "paper", *texts))
                entries += found
    head = ("training", "policy", "source", "n", "AFR", *(SHORT.get(c, task_title(c)) for c in columns))
    caption = (
        "Policies of merged demonstrations; those of several trackers are executed by each of them and pooled, as in "
        f"the paper. {INTERVALS}"
    )
    return SuiteTable(head, rows, "lllr", "Merged training", caption, "merge_all", groups, entries)


def _latency(cells: Sequence[EvaluatedCell]) -> SuiteTable | None:
    base = [c for c in cells if c.mode == "base" and (c.matched or c.merged)]
    delays = sorted({c.latency for c in base})
    if len(delays) < 2:
        return None
    rows: list[tuple[str, ...]] = []
    entries: list[TableEntry] = []
    groups = []
    for tracker in tracker_order({c.tracker for c in base}):
        groups.append(len(rows))
        for policy, family in _policies([c for c in base if c.tracker == tracker]):
            for task in _tasks(base):
                own = {
                    c.latency: c
                    for c in base
                    if (c.tracker, c.policy, c.family, c.task) == (tracker, policy, family, task)
                }
                if len(own) < 2:
                    continue
                texts = []
                for delay in delays:
                    if delay not in own:
                        texts.append("")
                        continue
                    entry = ours("latency", own[delay])
                    text = f"{percent(entry.sr or 0.0)} {interval_text(entry.low or 0.0, entry.high or 1.0)}"
                    if delay and 0 in own:
                        r = paired_rates(own[0].held(), own[delay].held())
                        entry = dataclasses.replace(entry, pairs=r.pairs, unpaired=r.unpaired, p=r.p)
                        entry = dataclasses.replace(entry, only_first=r.only_first, only_second=r.only_second)
                        text += f", p {probability(r.p)}" if r.p is not None else ""
                    entries.append(entry)
                    texts.append(text)
                rows.append((tracker, policy, task_title(task), *texts))
    if not rows:
        return None
    head = ("tracker", "policy", "task", *(f"{20 * delay} ms" for delay in delays))
    caption = (
        "Success rate in % (95 % Wilson interval) when each chunk starts late by so much, mode base; p: exact McNemar "
        "test against no delay on the same episodes. The paper has no such table."
    )
    return SuiteTable(head, rows, "lllr", "Latency", caption, "latency", groups, entries)


def _labels(cells: Sequence[EvaluatedCell]) -> SuiteTable | None:
    """Label protocol v3.1 against v4: the same family, training, tracker and task."""
    base = [c for c in cells if c.mode == "base" and c.trained_on]
    pairs = []
    groups: list[int] = []
    for trained_on in sorted({c.trained_on for c in base}, key=lambda t: (len(t), t[0] != "twist2", t)):
        for tracker in tracker_order({c.tracker for c in base}):
            begun = len(pairs)
            for task in _tasks(base):
                here = [c for c in base if (c.trained_on, c.tracker, c.task) == (trained_on, tracker, task)]
                for first in here:
                    for second in here:
                        alike = (first.family, first.merged) == (second.family, second.merged)
                        if alike and (first.labels, second.labels) == ("v3.1", "v4"):
                            kind = "matched" if tracker in trained_on else "swapped"
                            words = ("+".join(trained_on), tracker, kind, task_title(task), first.policy, second.policy)
                            pairs.append(RowPair(first, second, words))
            groups += [begun] if len(pairs) > begun else []
    if not pairs:
        return None
    rows, entries = paired_rows("labels", pairs)
    rows = [(*row[:10], *row[11:-1]) for row in rows]
    named = ("trained on", "tracker", "", "task", "v3.1 policy", "v4 policy")
    head = (*named, "n", "v3.1 %", "v4 %", "Δ", "alone", "p", "p (Holm)")
    caption = (
        f"{PAIRED}Δ: v3.1 minus v4. They tell networks apart, no labels: trainings of one recipe differ too. The paper "
        "has labels of v3.1 only."
    )
    return SuiteTable(head, rows, "llllllr", "Label protocols", caption, "labels", groups, entries)
