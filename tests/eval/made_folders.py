"""Results folders and suites for tests, of lines that are given, and the parts of them that a rerun repeats."""

import json
import re
import shutil
from pathlib import Path

from rows import record

from arena_newton import tasks
from arena_newton.eval.records.journal import Journal

JOURNALS = Path(__file__).parent / "journals"
TIMES = re.compile(rb'"(wall_s|started_at|finished_at|duration_sec|previous)": ?("[^"]*"|[0-9.e+-]+)')
SUITE = """
name = "small"
[defaults]
seeds = [0, 1]
repeats = 2
worlds = 2
engine = "mujoco"
[matrix]
tasks = ["boxing", "football"]
trackers = ["twist2", "sonic"]
modes = ["base", "visual"]
[[policies]]
name = "expert"
spec = "expert"
[[policies]]
name = "still"
spec = "stand"
modes = "base"
"""
WIDE, SUITE = SUITE, SUITE.replace('["twist2", "sonic"]', '"twist2"')
"""A suite of 12 cells, which is expanded only, and one of 6 that is played: 2 tasks x (2 modes + 1)."""


def document_of(planned, **config):
    """Content of a config.json."""
    identity = {"rules": "paper", "seeds": [0, 1, 2], "repeats": 20, "max_steps": None, "tracker": "t"} | config
    return {
        "config": identity,
        "config_hash": "0123456789ab",
        "options": {},
        "planned": planned,
        "gym_ids": {n: tasks.get(n).gym_id for n in tasks.names()},
        "rule_set": {"fall": "tilt > 60° <&>"},
    }


def folder_with(tmp_path, rows, planned, **config):
    """A results folder with these journal records."""
    tmp_path.mkdir(exist_ok=True)
    (tmp_path / "config.json").write_text(json.dumps(document_of(planned, **config)))
    with Journal(tmp_path / "episodes.jsonl") as journal:
        for row in rows:
            journal.append(record(row))
    return tmp_path


def recorded(row, *names):
    """A record with recordings."""
    stem = f"{row['task']}__base__seed{row['group_seed']}__repeat{row['repeat']}"
    paths = {n: f"strips/{stem}__{n[:-6]}.jpg" if n.endswith("strip") else f"videos/{stem}__{n}.mp4" for n in names}
    return row | {"media": paths}


def stored(schema, folder):
    """A results folder that a real run of two episodes wrote, with a journal of this schema."""
    folder.mkdir()
    shutil.copy(JOURNALS / f"schema_{schema}.jsonl", folder / "episodes.jsonl")
    shutil.copy(JOURNALS / f"schema_{schema}.config.json", folder / "config.json")
    return folder


def contents(folder):
    """Every file of a results folder but its configuration, without the times at which episodes were played."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "config.json"]
    found = {}
    for path in files:
        data, name = path.read_bytes(), str(path.relative_to(folder))
        timed = path.name == "episodes.jsonl" or path.parent.name == "episodes"
        found[name] = TIMES.sub(rb"\1", data) if timed else data
    return found


def configuration(folder):
    """The part of a config.json that says what was played."""
    document = json.loads((folder / "config.json").read_text())
    return {key: value for key, value in document.items() if key not in ("status", "options")}


def journals(out):
    """Journal lines of every cell without clock times, by cell."""
    found = {}
    for path in sorted(out.glob("*/*/*/*/episodes.jsonl")):
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines:
            for key in ("durations", "started_at", "finished_at", "previous"):
                del line[key]
        found[path.parent.relative_to(out).as_posix()] = sorted(lines, key=lambda line: line["index"])
    return found
