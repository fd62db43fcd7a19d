"""Audits accuse no honest folder, and find forgeries at the level at which they can be found."""

import csv
import hashlib
import io
import json
import shutil

import numpy as np
import pytest
from eval_fakes import factories
from made_folders import stored

from arena_newton.eval.__main__ import main
from arena_newton.eval.records.chain import head
from arena_newton.eval.records.journal import read_journal
from arena_newton.eval.workers.shard_merge import merge

FLAGS = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "3", "--repeats", "5"]
FLAGS += ["--tracker", "twist2", "sonic"]


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """A run of forty episodes through two trackers, `run`, and its two shards."""
    folder = tmp_path_factory.mktemp("audit")
    assert main([*FLAGS, "--out", str(folder / "run")], factories()) == 0
    for part in ("1/2", "2/2"):
        assert main([*FLAGS, "--worlds", "3", "--shard", part, "--out", str(folder / part[0])], factories()) == 0
    return folder


@pytest.fixture
def folder(honest, tmp_path):
    """A copy of the run, to be changed."""
    return shutil.copytree(honest / "run", tmp_path / "run")


def audit(folder, capsys, *flags):
    """Exit code of an audit, and its contradictions."""
    capsys.readouterr()
    code = main(["audit", str(folder), *flags])
    found = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  contradiction: ")]
    return code, found


def lines_of(folder):
    return [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]


def write(folder, lines, *, relink=True):
    """Write a journal, by default as a forger does who knows the chain."""
    before, texts = b"", []
    for line in lines:
        if relink:
            line = line | {"previous": hashlib.sha256(before).hexdigest()}
        before = json.dumps(line, separators=(",", ":")).encode() + b"\n"
        texts.append(before)
    (folder / "episodes.jsonl").write_bytes(b"".join(texts))


def first(lines, outcome):
    return next(line for line in lines if line["outcome"] == outcome)


def test_the_head_is_the_same_whoever_played(honest, tmp_path, capsys):
    """Order, worlds and shards change the links and not the head, which stands in results, tables and reports."""
    merge([honest / "1", honest / "2"], tmp_path / "m")
    names = json.loads((honest / "run" / "results.json").read_text())["head"]
    for name in ("results.json", "table.md", "report.md", "report.html"):
        texts = [(folder / name).read_text() for folder in (honest / "run", tmp_path / "m")]
        assert texts[0] == texts[1] and names in texts[0], name
    links = [[line["previous"] for line in lines_of(f)] for f in (honest / "run", tmp_path / "m")]
    assert links[0] != links[1] and audit(tmp_path / "m", capsys, "--head", names) == (0, [])
    assert {path.name for path in (tmp_path / "m" / "actions").iterdir()} == {"twist2", "sonic"}
    capsys.readouterr()
    assert main(["report", str(tmp_path / "m"), "--table"]) == 0
    assert f"Head of 1 journal: {names}." in capsys.readouterr().out
    records, _ = read_journal(honest / "run" / "episodes.jsonl")
    assert head(sorted(records, key=lambda one: one.index)) == names


def test_honest_folders_are_not_accused(honest, tmp_path, capsys):
    """Finished, sharded, resumed and interrupted runs, with errors, without actions and moved, contradict nothing."""
    flags = ["--task", "football", "--engine", "mujoco", "--repeats", "3", "--no-actions", "--failures"]
    assert main([*flags[:-1], "--out", str(tmp_path / "bare")], factories()) == 0
    cut = shutil.copytree(honest / "run", tmp_path / "cut")
    (cut / "episodes.jsonl").write_bytes(b"".join((cut / "episodes.jsonl").read_bytes().splitlines(True)[:-7]))
    assert main(["resume", str(cut)], factories()) == 0
    for one in (honest, tmp_path):
        code = main(["audit", str(one), "--out", str(tmp_path / "pages")])
        said = capsys.readouterr().out
        assert code == 0 and "contradictions 0" in said and "level consistent" in said, said
    assert "6 episodes cannot be replayed" not in said and "9 episodes cannot be replayed" in said
    page, content = ((tmp_path / "pages" / f"audit.{end}").read_text() for end in ("md", "json"))
    assert all(level in page and level in content for level in ("self-reported", "consistent", "replayed", "re-run"))


def test_each_tracker_plays_its_own_episodes_again(honest, tmp_path, capsys):
    """A replay of a run through two trackers meets all of its lines; one without actions has nothing to play."""
    assert main(["audit", str(honest / "run"), "--all"], factories()) == 0
    assert "replayed 40 of 40, contradictions 0" in capsys.readouterr().out
    bare = shutil.copytree(honest / "run", tmp_path / "bare", ignore=shutil.ignore_patterns("actions"))
    assert main(["audit", str(bare), "--replay", "2"], factories()) == 0
    assert "replayed 0 of 40" in capsys.readouterr().out


def test_older_journals_are_marked(tmp_path, capsys):
    """A folder of every older version is read and reported as unchained."""
    for schema in (1, 2):
        code = main(["audit", str(stored(schema, tmp_path / str(schema)))])
        said = capsys.readouterr().out
        assert code == 0 and "head unchained" in said and "Unchained: a line was written by a version" in said, said


def test_bad_input_is_one_line_and_code_2(tmp_path, capsys):
    """A folder without a run, and a journal that is none, are refused in a line."""
    assert main(["audit", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"error: {tmp_path}: no results folder (it has no config.json)\n"


def edited(of, /, **changes):
    """Forgery of one line: that of the first episode with an outcome."""

    def forge(folder, lines):
        line = first(lines, of)
        line.update({key: value(line) if callable(value) else value for key, value in changes.items()})

    return forge


def won(line):
    """A failure as a careful forger makes a success of it: margin, progress and predicates too, the events removed."""
    held = {name: line["steps"] for name in line["predicates"]}
    line |= {"outcome": "success", "reason": "success", "margin": 0.3, "progress": 1.0, "predicates": held}
    line["events"] = [event for event in line["events"] if event["kind"] != "fall"]


def careful(folder, lines):
    won(first(lines, "timeout"))


def careful_with_tables(folder, lines):
    careful(folder, lines)
    write(folder, lines)
    main(["report", str(folder)])


def dropped(folder, lines):
    lines.remove(first(lines, "fall"))


def dropped_and_unfinished(folder, lines):
    dropped(folder, lines)
    document = json.loads((folder / "config.json").read_text())
    document["status"]["state"] = "cancelled"
    (folder / "config.json").write_text(json.dumps(document, indent=2) + "\n")


def repeated(folder, lines):
    lines.append(first(lines, "success"))


def exchanged(folder, lines):
    """The outcome of one episode under the name of another."""
    keys = ("index", "repeat", "group_seed", "episode_seed", "object_seed")
    one, other = first(lines, "success"), first(lines, "fall")
    for key in keys:
        one[key], other[key] = other[key], one[key]


def other_rules(folder, lines):
    document = json.loads((folder / "config.json").read_text())
    document["config"]["rules"] = "released"
    (folder / "config.json").write_text(json.dumps(document, indent=2) + "\n")


def in_table(name, change):
    def forge(folder, lines):
        path = folder / name
        path.write_text(change(path.read_text()))

    return forge


def cells(text):
    content = json.loads(text)
    content["cells"][0]["successes"] += 1
    return json.dumps(content, indent=2) + "\n"


def rates(text):
    rows = list(csv.reader(io.StringIO(text)))
    rows[1][rows[0].index("sr")] = "1.0"
    return "\n".join(",".join(row) for row in rows) + "\n"


def actions_of(folder, line):
    return folder / line["media"]["actions"]


def exchanged_actions(folder, lines):
    """The files of two episodes, with their hashes."""
    one, other = lines[0], lines[1]
    data = [actions_of(folder, line).read_bytes() for line in (one, other)]
    actions_of(folder, one).write_bytes(data[1])
    actions_of(folder, other).write_bytes(data[0])
    one["actions"], other["actions"] = other["actions"], one["actions"]


def other_actions(folder, lines):
    path = actions_of(folder, lines[0])
    with np.load(path) as arrays:
        np.savez_compressed(path, **dict(arrays) | {"action": arrays["action"] + 1})


FORGERIES = {
    "outcome alone": edited("timeout", outcome="success"),
    "outcome and reason": edited("timeout", outcome="success", reason="success"),
    "a timeout to an error": edited("timeout", outcome="error", error="the server was away"),
    "fall to a timeout": edited("fall", outcome="timeout", reason="timeout"),
    "margin of a success": edited("success", margin=-0.1),
    "steps of a success": edited("success", steps=lambda line: line["steps"] - 1),
    "steps with predicates": edited(
        "success", steps=3, predicates=lambda line: dict.fromkeys(line["predicates"], 3), phases=[]
    ),
    "predicates removed": edited("success", predicates={}),
    "a predicate renamed": edited("timeout", predicates={"goal": None}),
    "a predicate after the end": edited("timeout", predicates=lambda line: line["predicates"] | {"approach": 9999}),
    "progress": edited("timeout", progress=0.75),
    "event of the fall removed": edited("fall", events=[]),
    "fall moved past the end": edited("fall", events=[{"kind": "fall", "tick": 1200, "detail": "tilt"}]),
    "fall at the start": edited("fall", startup_fall=True),
    "ball out without event": edited("timeout", reason="ball_out"),
    "a phase after the end": edited("success", phases=[["walk", 0], ["reach", 5000]]),
    "step budget": edited("success", max_steps=5000),
    "episode seed": edited("fall", episode_seed=1),
    "object seed": edited("fall", object_seed=1),
    "group seed": edited("fall", group_seed=7),
    "tracker": edited("fall", tracker="pd"),
    "policy": edited("fall", policy="learned"),
    "rule set of a line": edited("fall", rules="released"),
    "engine of a line": edited("fall", engine="warp"),
    "privileged": edited("success", privileged=True),
    "hash of the checkpoint": edited("fall", hashes=lambda line: line["hashes"] | {"checkpoint": "0" * 12}),
    "hash of the libraries": edited("fall", hashes=lambda line: line["hashes"] | {"versions": "0" * 12}),
    "hash of the environment": edited("fall", hashes=lambda line: line["hashes"] | {"environment": "0" * 12}),
    "hash of the rules": edited("fall", hashes=lambda line: line["hashes"] | {"rules": "0" * 12}),
    "duration": edited("success", durations={"wall_s": 1.0, "sim_s": 99.0}),
    "actions disowned": edited("success", actions=None),
    "another file of actions": edited("success", media={"actions": "actions/twist2/football_base_s9_r9.npz"}),
    "hash of the actions": edited("success", actions="0" * 64),
    "a line dropped": dropped,
    "a line repeated": repeated,
    "a line moved": lambda folder, lines: lines.insert(0, lines.pop()),
    "two episodes exchanged": exchanged,
    "rule set of the run": other_rules,
    "results.json": in_table("results.json", cells),
    "table.csv": in_table("table.csv", rates),
    "table.md": in_table("table.md", lambda text: text.replace("football", "f00tball", 1)),
    "report.md": in_table("report.md", lambda text: text.replace("| 5", "| 6", 1) + "\n"),
    "report.html": in_table("report.html", lambda text: text.replace("success", "failure", 1)),
    "actions changed": other_actions,
    "actions exchanged": exchanged_actions,
    "a careful outcome": careful,
}
"""Forgeries by name; the links are made again after each."""
ALLOWED = ("a line moved",)
"""Changes that make no result another."""
BY_HEAD = {
    "with tables": careful_with_tables,
    "a line dropped, unfinished": dropped_and_unfinished,
}
"""Forgeries that agree with themselves: only a head that was published finds them, or a replay."""


@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_found_by_lines(folder, capsys, name):
    """A forger who makes the links again is found by what the folder says elsewhere."""
    lines = lines_of(folder)
    FORGERIES[name](folder, lines)
    write(folder, lines)
    code, found = audit(folder, capsys)
    assert (code, bool(found)) == ((0, False) if name in ALLOWED else (1, True)), found


@pytest.mark.parametrize("name", BY_HEAD)
def test_forgeries_are_found_by_the_published_head(folder, capsys, name):
    """A folder whose line, links and tables were edited agrees with itself, and not with the published head."""
    published = json.loads((folder / "results.json").read_text())["head"]
    lines = lines_of(folder)
    BY_HEAD[name](folder, lines)
    write(folder, lines)
    shutil.rmtree(folder / "original")
    main(["report", str(folder)])
    assert audit(folder, capsys) == (0, [])
    code, found = audit(folder, capsys, "--head", published)
    assert code == 1 and len(found) == 1 and f"published was {published}" in found[0]


@pytest.mark.parametrize(
    ("change", "number"),
    [
        (lambda lines: lines[4].update(finished_at="2026-01-01"), 6),
        (lambda lines: lines.pop(4), 5),
        (lambda lines: lines[9].pop("previous"), 10),
    ],
    ids=["changed", "dropped", "unlinked"],
)
def test_a_broken_link_is_named(folder, capsys, change, number):
    """A line that was changed or dropped without its links breaks the next one, whatever it says."""
    lines = lines_of(folder)
    change(lines)
    write(folder, lines, relink=False)
    code, found = audit(folder, capsys)
    assert code == 1 and any(f"line {number} is not linked to line {number - 1}: " in line for line in found), found
