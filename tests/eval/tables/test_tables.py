"""One table of several runs: what it counts, what it says of them, and which runs it does not mix."""

import pytest
from made_folders import document_of, folder_with
from rows import episodes, record

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.results import RunRecord, load_run
from arena_newton.eval.statistics.stats import aggregate, wilson
from arena_newton.eval.tables.run_table import joint_table
from arena_newton.pages.tables import escaped
from arena_newton.policies.learned.learned_card import CellResult, PolicyCard
from arena_newton.tasks.semantic_mode import semantic_notes


def run_of(tmp_path, name, rows, **config):
    """A run of these journal lines, without files."""
    return RunRecord(tmp_path / name, document_of(len(rows), **config), [record(row) for row in rows])


def cells(table):
    """Cells of the table's rows by the texts of their first two columns."""
    lines = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("|")]
    return {(line[0].strip(), line[1].strip()): [text.strip() for text in line[2:]] for line in lines}


def said(won, played):
    """Text of a cell."""
    low, high = wilson(won, played)
    return f"{won}/{played} ({100 * low:.0f} to {100 * high:.0f})"


def test_two_runs_make_one_table(tmp_path):
    """Rows are tasks and trackers, columns modes in their order, and `all` counts the episodes of all tasks."""
    base = episodes("football", (4, 5, 7), falls=3) + episodes("boxing", (20, 20, 20))
    moved = [row | {"tracker": "u", "mode": "visual"} for row in episodes("boxing", (20, 20, 19))]
    runs = [run_of(tmp_path, "a", base), run_of(tmp_path, "b", moved, engine="warp")]
    text = joint_table(runs)
    found = cells(text)
    assert found["task", "tracker"] == ["base", "visual"]
    assert found["football", "t"] == [said(16, 60), "–"] and found["boxing", "t"] == [said(60, 60), "–"]
    assert found["boxing", "u"] == ["–", said(59, 60)]
    assert found["all", "t"] == [said(76, 120), "–"] and found["all", "u"] == ["–", said(59, 60)]
    assert ("football", "u") not in found
    assert list(found)[2] == ("football", "t")  # after head and rule, in the order of the tasks
    assert "policy p, rules paper, engine warp" in text and "3 episodes of 180 ended in a fall." in text


def test_a_privileged_policy_is_marked(tmp_path):
    """Whoever takes the world itself is named so in every table."""
    rows = [row | {"privileged": True} for row in episodes("boxing", (20, 20, 20))]
    run = run_of(tmp_path, "a", rows)
    assert "policy p (privileged), rules paper" in joint_table([run])
    assert {cell["policy"] for cell in aggregate(run.records)["cells"]} == {"p (privileged)"}


def test_what_is_missing_is_said(tmp_path):
    """A run that is not complete, and episodes with errors, are named under the table."""
    rows = episodes("football", (4, 5, 7))[:50]
    rows[9] |= {"outcome": "error"}
    run = run_of(tmp_path, "a", rows)
    run.document["planned"] = 60
    text = joint_table([run])
    assert "a is incomplete: 50 of 60 episodes." in text and "1 episode of 50 ended with an error; they count" in text


@pytest.mark.parametrize("mode", ["base", "semantic", "semantic-3"])
def test_semantic_numbers_say_what_they_are(tmp_path, capsys, mode):
    """Numbers of semantic modes stand beside what they change and who chose their strength; others do not."""
    a, b = tmp_path / "a", tmp_path / "b"
    for folder in (a, b):
        rows = [row | {"mode": mode, "privileged": True} for row in episodes("football", (4, 5, 7))]
        folder_with(folder, rows, 60, policy_facts={"privileged": True})
    assert main(["report", str(a), "--table"]) == 0
    pages = [capsys.readouterr().out]
    assert main(["report", str(a)]) == main(["compare", str(a), str(b), "--out", str(tmp_path / "c")]) == 0
    comparison = (tmp_path / "c" / "compare.md").read_text()
    cell = CellResult(task="football", tracker="twist2", mode=mode, episodes=60, successes=16, falls=0)
    pages += [comparison, (a / "report.md").read_text(), PolicyCard(tasks=("football",), results=(cell,)).to_markdown()]
    notes = semantic_notes(["semantic", "semantic-3"])
    for page in pages:
        said = [note for note in notes if note in page or escaped(note) in page]
        assert said == semantic_notes([mode]), page
    assert "p (privileged)" in comparison


@pytest.mark.parametrize(
    ("change", "config", "message"),
    [
        ({}, {}, "b: episode football t p base seed 0 repeat 0 is in .*a too"),
        ({"mode": "visual"}, {"rules": "released"}, "b: rules is released, in .*a paper"),
        ({"mode": "visual"}, {"max_steps": 50}, "b: max_steps is 50, in .*a null"),
        ({"mode": "visual", "hashes": {"checkpoint": "bb"}}, {}, "b: weights of t are bb, in .*a aa"),
    ],
)
def test_runs_that_one_table_must_not_mix(tmp_path, change, config, message):
    """The same episode twice, other judges, other budgets and other weights of one name are refused."""
    rows = [row | {"hashes": {"checkpoint": "aa"}} for row in episodes("football", (1, 1, 1))]
    other = [row | change for row in rows]
    with pytest.raises(InputError, match=message):
        joint_table([run_of(tmp_path, "a", rows), run_of(tmp_path, "b", other, **config)])


def test_report_of_several_folders(tmp_path, capsys):
    """`report A B` prints the table and writes nothing; a folder twice is one line with code 2."""
    for name, mode in (("a", "base"), ("b", "visual")):
        folder_with(tmp_path / name, [row | {"mode": mode} for row in episodes("boxing", (20, 20, 20))], 60)
    before = sorted(tmp_path.rglob("*"))
    assert main(["report", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    output = capsys.readouterr().out
    assert cells(output)["boxing", "t"] == [said(60, 60)] * 2 and sorted(tmp_path.rglob("*")) == before
    assert main(["report", str(tmp_path / "a"), "--table"]) == 0
    assert capsys.readouterr().out == joint_table([load_run(tmp_path / "a")])
    assert main(["report", str(tmp_path / "a"), str(tmp_path / "a" / ".")]) == 2
    assert "named twice" in capsys.readouterr().err
    assert main(["report", str(tmp_path / "a"), str(tmp_path / "b"), "--json"]) == 2
