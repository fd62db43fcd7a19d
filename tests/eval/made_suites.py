"""Suites with known outcomes for tests, by the product's own writers: every number has a closed form."""

import json

from made_folders import document_of
from rows import full, record

from arena_newton import tasks
from arena_newton.eval.records.document import SUITE_FILE
from arena_newton.eval.records.journal import Journal
from arena_newton.eval.statistics.stats import suites
from arena_newton.eval.suites.suite_records import CellEvent, SuiteCell, SuitePlan, event_line, journal_file, suite_json
from arena_newton.rules import seeding

HOI, HSI = suites()["HOI_AVG"], suites()["HSI_AVG"]
SEEDS, REPEATS = (0, 1, 2), 20


def outcomes(won, falls=0, offset=0):
    """60 outcomes: the first `won` after `offset` succeed (around the end), `falls` of the others are falls."""
    found = ["timeout"] * 60
    for number in range(won):
        found[(offset + number) % 60] = "success"
    for number in [n for n, outcome in enumerate(found) if outcome == "timeout"][:falls]:
        found[number] = "fall"
    return found


def cell_of(policy, family, tracker, task, *, trained_on=None, mode="base", labels="v3.1", latency=0, tasks_of=None):
    """A cell of the plan, with its outcomes to come."""
    trained = (tracker,) if trained_on is None else tuple(trained_on)
    name = f"{policy}-{'+'.join(trained)}-{labels}/{tracker}/{task}/{mode}.latency{latency}"
    return SuiteCell(
        id=name,
        policy=policy,
        family=family,
        spec=f"lerobot:runs/{policy}_{task}_{'_'.join(trained)}",
        trained_on=trained,
        trained_tasks=(task,) if tasks_of is None else tuple(tasks_of),
        tracker=tracker,
        task=task,
        mode=mode,
        rules="paper",
        labels=labels,
        latency=latency,
        folder=name,
        episodes=60,
        ticks=60 * 1300,
    )


def write_cell(folder, cell, results, rules="paper", played=None, **config):
    """The results folder of a cell: seeds 0 1 2 x 20, ended as `results` says; `played` of them, all by default."""
    identity = {"task": [cell.task], "mode": [cell.mode], "tracker": [cell.tracker], "policy": cell.spec}
    executed = {"latency_ticks": cell.latency, "replan": cell.replan, "ensemble": cell.ensemble}
    identity |= {"labels": cell.labels} | {key: value for key, value in executed.items() if value} | config
    document = document_of(len(SEEDS) * REPEATS, rules=rules, **identity)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(document))
    with Journal(folder / "episodes.jsonl") as journal:
        for number, outcome in enumerate(results if played is None else results[:played]):
            seed = seeding.episode_seed(tasks.get(cell.task).gym_id, number // REPEATS, number % REPEATS)
            row = {"index": number, "task": cell.task, "tracker": cell.tracker, "policy": cell.spec, "mode": cell.mode}
            row |= {"group_seed": number // REPEATS, "repeat": number % REPEATS, "rules": rules, "episode_seed": seed}
            row |= {"object_seed": seeding.object_seed(seed), "outcome": outcome, "steps": 100}
            journal.append(record(full(row)))


def write_suite(folder, cells, name="made"):
    """A suite of (cell, outcomes); cells without outcomes wait. Returns the folder."""
    folder.mkdir(parents=True)
    lines = b""
    for number, (cell, results) in enumerate(cells):
        if results is not None:
            write_cell(folder / cell.folder, cell, results)
            at = f"2026-01-01T00:{number // 60:02d}:{number % 60:02d}+00:00"
            lines += event_line(
                CellEvent(cell=cell.id, event="done", at=at, finished=len(results), device="cpu", wall_s=90.0)
            )
    (folder / journal_file(1, 1)).write_bytes(lines)
    plan = SuitePlan(folder, name, "made.toml", "0123456789ab", tuple(cell for cell, _ in cells))
    (folder / SUITE_FILE).write_text(json.dumps(suite_json(plan)))
    return folder


def plan():
    """Cells of a suite: two families on HOI, swaps, modes, merged training, latency, both label protocols."""
    cells = []
    for number, task in enumerate(HOI):
        cells.append((cell_of("act", "act", "twist2", task), outcomes(30 + 6 * number, falls=3)))
        cells.append((cell_of("dp", "diffusion", "twist2", task), outcomes(12 + 6 * number, offset=3)))
        cells.append((cell_of("act", "act", "sonic", task), outcomes(48)))
        cells.append((cell_of("act", "act", "twist2", task, mode="visual"), outcomes(15 + 6 * number)))
        cells.append((cell_of("act", "act", "twist2", task, mode="semantic"), outcomes(30 + 6 * number)))
        for tracker, won in (("twist2", 20), ("sonic", 40)):
            both = cell_of("all", "act", tracker, task, trained_on=("sonic", "twist2"), tasks_of=HOI + HSI)
            cells.append((both, outcomes(won)))
    cells.append((cell_of("act", "act", "sonic", "football", trained_on=("twist2",)), outcomes(5, falls=12)))
    cells.append((cell_of("dp", "diffusion", "sonic", "football", trained_on=("twist2",)), outcomes(0)))
    cells.append((cell_of("act", "act", "twist2", "football", trained_on=("sonic",)), outcomes(40)))
    cells.append((cell_of("pi", "pi05", "twist2", "boxing"), outcomes(0)))
    cells.append((cell_of("pi", "pi05", "sonic", "boxing", trained_on=("twist2",)), outcomes(0)))
    cells.append((cell_of("act", "act", "twist2", "football", latency=10), outcomes(20)))
    cells.append((cell_of("act", "act", "twist2", "football", labels="v4"), outcomes(45)))
    cells.append((cell_of("expert", "expert", "twist2", "football", trained_on=(), tasks_of=()), outcomes(60)))
    cells.append((cell_of("act", "act", "twist2", "vis_navi"), None))
    return cells
