"""Journals of every schema are read, and a line says all that an episode's result holds."""

import dataclasses
import json
import math
from typing import Annotated

import pytest
from made_folders import JOURNALS, stored
from rows import episodes, full, record

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.plan.episode_plan import expand
from arena_newton.eval.play.run import _record
from arena_newton.eval.records import journal
from arena_newton.eval.records.journal import SCHEMA, EpisodeRecord, Journal, read_journal
from arena_newton.files.stored_json import Fit
from arena_newton.interfaces import EpisodeEvent, EpisodeResult

NEW_KEYS = ("schema", "phases", "predicates", "progress", "events")
RAN = {1: ("stand", 20), 2: ("expert", 150), 3: ("expert", 150), 4: ("expert", 150)}
"""Schema → policy and steps of its run."""


@pytest.mark.parametrize("schema", range(1, SCHEMA + 1))
def test_journals_of_every_schema_are_reported(tmp_path, capsys, schema):
    """A folder that any version wrote is read whole and gives all reports."""
    folder = stored(schema, tmp_path / "run")
    run = load_run(folder)
    policy, steps = RAN[schema]
    lines = [(r.schema, r.task, r.policy, r.outcome, r.steps) for r in run.records]
    assert lines == [(schema, "boxing", policy, "timeout", steps)] * 2
    assert (run.status is None) == (schema == 1)
    reached = [(r.phases, r.predicates) for r in run.records]
    if schema == 2:
        phases = (("approach", 0),)
        nothing, near = {"approach": None, "contact": None}, {"approach": 128, "contact": None}
        assert reached == [(phases, nothing), (phases, near)]
    assert main(["report", str(folder)]) == 0
    assert f"| boxing | twist2  | {run.records[0].shown_policy:<6} | base | 2 |" in capsys.readouterr().out
    assert {"report.html", "table.csv", "results.json", "original"} <= {path.name for path in folder.iterdir()}
    assert ("head" in json.loads((folder / "results.json").read_text())) == (schema > 2)


@pytest.mark.parametrize("schema", range(1, SCHEMA + 1))
def test_old_keys_keep_name_order_and_format(schema):
    """A line of an older schema is a part of the same line today, in the same order and bytes."""
    lines = [json.loads(line) for line in (JOURNALS / f"schema_{schema}.jsonl").read_text().splitlines()]
    for line, found in zip(lines, read_journal(JOURNALS / f"schema_{schema}.jsonl")[0], strict=True):
        written = found.to_json()
        assert json.dumps({key: written[key] for key in written if key in line}) == json.dumps(line)
        assert set(written) - set(line) == (set(NEW_KEYS) if schema == 1 else set())


def test_a_journal_from_the_future_is_refused(tmp_path, capsys):
    """A line of a newer schema is refused by number instead of being read in part."""
    folder = stored(SCHEMA, tmp_path / "run")
    text = (folder / "episodes.jsonl").read_text()
    (folder / "episodes.jsonl").write_text(text.replace(f'"schema":{SCHEMA}', f'"schema":{SCHEMA + 1}'))
    for command in ("report", "resume"):
        assert main([command, str(folder)]) == 2
        error = capsys.readouterr().err
        if command == "report":
            assert error.count("\n") == 1 and f"line 1: schema {SCHEMA + 1} was written by a newer version" in error


def test_a_line_says_what_the_result_holds(tmp_path):
    """Phases, predicates, progress and events of a result are in its line and come back from it."""
    (episode,) = expand(["boxing"], trackers=["twist2"], policy="expert", seeds=(0,), repeats=1)
    events = (EpisodeEvent("contact", 12, "left_palm"), EpisodeEvent("fall", 40, "tilt"))
    result = EpisodeResult(episode, "fall", "fall", 40, math.inf, phases=(("walk", 0), ("strike", 31)))
    result = dataclasses.replace(result, predicates={"approach": 30, "contact": None}, progress=0.5, events=events)
    line = _record(result, {"ego": "videos/a.mp4"}, {"config": "0123456789ab"})
    with Journal(tmp_path / "episodes.jsonl") as journal:
        journal.append(line)
    text = (tmp_path / "episodes.jsonl").read_text()
    assert '"phases":[["walk",0],["strike",31]],"predicates":{"approach":30,"contact":null},"progress":0.5' in text
    assert '"events":[{"kind":"contact","tick":12,"detail":"left_palm"},' in text
    (found,) = read_journal(tmp_path / "episodes.jsonl")[0]
    assert dataclasses.replace(found, previous=None) == line
    assert (line.schema, line.margin, line.video) == (SCHEMA, None, "videos/a.mp4")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("schema", 0, "schema is 0, expected a number of at least 1"),
        ("schema", True, "schema is true"),
        ("progress", 1.5, "progress is 1.5, expected a number from 0 to 1"),
        ("progress", "half", "progress is"),
        ("phases", [["walk"]], "phases is"),
        ("phases", [["walk\x1b[2J", 3]], "phases is"),
        ("phases", [["walk", -1]], "phases is"),
        ("predicates", {"": 3}, "predicates is"),
        ("predicates", [3], "predicates is"),
        ("events", [{"kind": "fall"}], "events is"),
        ("events", [{"kind": "fall", "tick": 3, "more": 1}], "events is"),
        ("events", [{"kind": "fall", "tick": "3"}], "events is"),
    ],
)
def test_unfit_values_of_new_keys_are_named(key, value, message):
    """New keys are held to their types and ranges as the old ones are."""
    with pytest.raises(InputError, match=f"here: {message}"):
        EpisodeRecord.from_json("here", full(episodes("football", (1,))[0]) | {key: value})


def test_a_new_key_is_one_field(tmp_path, monkeypatch, capsys):
    """One field of the record is all that writing, reading, checking and reporting a new key need; a run fills it."""
    hint = Annotated[float | None, Fit("a number of joules")]
    longer = dataclasses.make_dataclass("Longer", [("energy", hint, None)], bases=(EpisodeRecord,), frozen=True)
    monkeypatch.setattr(journal, "EpisodeRecord", longer)
    folder = stored(SCHEMA, tmp_path / "run")
    (folder / "episodes.jsonl").unlink()
    with Journal(folder / "episodes.jsonl") as written:
        for old in read_journal(JOURNALS / f"schema_{SCHEMA}.jsonl")[0]:
            written.append(dataclasses.replace(old, energy=7.5))
    assert [r.energy for r in load_run(folder).records] == [7.5, 7.5]
    assert main(["report", str(folder)]) == 0
    text = (folder / "episodes.jsonl").read_text()
    (folder / "episodes.jsonl").write_text(text.replace('"energy":7.5', '"energy":"much"', 1))
    capsys.readouterr()
    assert main(["report", str(folder)]) == 2
    assert 'line 1: energy is "much", expected a number of joules' in capsys.readouterr().err


def test_unknown_keys_are_left_out():
    """A key that this version does not know does not keep a line of the same schema from being read."""
    line = full(episodes("football", (1,))[0])
    assert EpisodeRecord.from_json("here", line | {"more": [1]}) == record(line)
