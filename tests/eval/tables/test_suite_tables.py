"""The paper's tables from suites: numbers in closed form, paired tests, text that stays text, the same bytes again."""

import csv
import dataclasses
import io
import json
import re
import shutil
import subprocess

import pytest
from made_suites import cell_of, outcomes, plan, write_cell, write_suite

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.records.document import SUITE_FILE
from arena_newton.eval.statistics.stats import contrast, holm, mcnemar, wilson
from arena_newton.eval.tables import table_text
from arena_newton.eval.tables.evaluated_cells import read_cells
from arena_newton.eval.tables.paper_numbers import paper_numbers, published, read_paper
from arena_newton.eval.tables.suite_tables import suite_tables
from arena_newton.eval.tables.table_entries import SuiteTable, interval_text, probability
from arena_newton.pages.tables import points
from arena_newton.tasks.semantic_mode import semantic_note


@pytest.fixture(scope="module")
def suite(made_suite):
    """The suite's folder."""
    return made_suite


@pytest.fixture(scope="module")
def tables(cells):
    """Its tables by name."""
    return {table.name: table for table in suite_tables(cells.cells, paper_numbers())}


def entry(table, **wanted):
    """The one entry with these values."""
    (found,) = [e for e in table.entries if all(getattr(e, key) == value for key, value in wanted.items())]
    return found


def row(table, *start):
    """The one row that begins with these texts, by its head."""
    (found,) = [r for r in table.rows if r[: len(start)] == start]
    return dict(zip(table.head, found, strict=True))


def test_every_kind_of_table_is_made(tables):
    """All tables that the cells can fill are there, and each row has a text for each column."""
    names = "in_gmt in_gmt_visual in_gmt_semantic merged untrained best families perturbation cross_gmt merge_all"
    assert list(tables) == [*names.split(), "latency", "labels", "cost"]
    for table in tables.values():
        assert all(len(r) == len(table.head) for r in table.rows)
        assert all(group < len(table.rows) for group in table.groups)


def test_in_gmt_by_the_conventions_of_the_paper(tables):
    """Means and population std of seeds, falls of all episodes of a row, Wilson's interval, the paper's row below."""
    table = tables["in_gmt"]
    first = entry(table, policy="act v3.1", tracker="twist2", task="football")
    # 30 successes of the first 60 episodes: seeds with 20, 10 and 0 of 20.
    assert (first.successes, first.episodes, first.sr) == (30, 60, 0.5)
    assert first.sr_std == pytest.approx((1 / 6) ** 0.5)
    assert [first.low, first.high] == pytest.approx(wilson(30, 60))
    shown = row(table, "twist2", "act v3.1", "ours")
    assert shown["AFR"] == "5.00" and shown["n"] == "60"
    assert shown["Football"] == "50.0 ± 40.8 (38 to 62)"
    assert shown["Boxing"] == "" and not {"VisNavi", "HSI avg"} & set(shown)
    average = entry(table, policy="act v3.1", tracker="twist2", task="HOI_AVG")
    rates = [1, 0.5, 0, 1, 0.8, 0, 1, 1, 0.1]
    mean = sum(rates) / 9
    assert average.sr == pytest.approx(mean) and average.episodes == 180
    assert average.sr_std == pytest.approx((sum((r - mean) ** 2 for r in rates) / 9) ** 0.5)
    assert average.low < mean < average.high
    theirs = row(table, "twist2", "ACT", "paper")
    assert theirs["Football"] == "26.7 ± 6.2 (17 to 39)" and theirs["HOI avg"] == "28.33 ± 13.94"
    assert (
        theirs["AFR"] == "6.43" and entry(table, source="paper", family="act", tracker="twist2", task="boxing").derived
    )
    assert not [r for r in table.rows if r[1] in ("all", "expert")]


def test_what_was_not_trained_is_under_no_tracker_of_its_training(tables):
    """The expert has a table of its own, where the plan has a tracker of nobody's training."""
    assert row(tables["untrained"], "twist2", "expert")["Football"] == "100.0 ± 0.0 (94 to 100)"
    assert "of their training" not in tables["untrained"].caption


def test_rows_of_others_are_marked(tables):
    """Numbers that others published are next to the paper's, marked as self-reported in another simulator."""
    (other,) = published()
    assert other.policy == "WB-WAM" and sum(other.rates.values()) / 7 == pytest.approx(0.819, abs=5e-4)
    assert row(tables["in_gmt"], "sonic", "WB-WAM", "self-reported")["DoubleDesk"] == "65.0"
    assert row(tables["best"], "sonic", "DoubleDesk")["self-reported"] == "WB-WAM 65.0"
    assert row(tables["best"], "twist2", "Football")["self-reported"] == ""
    for name in ("in_gmt", "best"):
        assert "Self-reported: WB-WAM by its authors" in tables[name].caption and "Isaac Sim" in tables[name].caption
    assert not [r for r in tables["in_gmt_visual"].rows if "WB-WAM" in r]


def test_semantic_numbers_say_what_was_changed(tables):
    """Tables of semantic mode name what it changes in each task, and that its strength is this project's choice."""
    assert {"Football (texture)", "P&PBox (clutter)"} <= set(tables["in_gmt_semantic"].head)
    for name, table in tables.items():
        semantic = name in ("in_gmt_semantic", "perturbation")
        assert (semantic_note() in table.caption) == semantic, name


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"max_steps": 100}, "--max-steps cut the step budgets to 100 ticks (2 s): no benchmark result."),
        ({"variant": "0123456789ab"}, "The scene is the variant 0123456789ab: no benchmark result."),
    ],
)
def test_changed_runs_stand_beside_nothing(tmp_path, capsys, change, said):
    """Runs with cut budgets or another scene say so everywhere, have no row of others beside them, and no findings."""
    facts = {"family": "act", "facts": {"trackers": ["twist2"], "tasks": ["boxing"]}}
    for name in "ab":
        write_cell(tmp_path / name, cell_of("x", "x", "twist2", "boxing"), outcomes(9), policy_facts=facts, **change)
    assert main(["tables", str(tmp_path / "a"), "--format", "md", "tex", "csv", "--out", str(tmp_path / "t")]) == 0
    assert said in capsys.readouterr().out
    text = (tmp_path / "t" / "tables.md").read_text()
    assert text.count(said) == text.count("\n## ") and not re.search(r"\| (paper|WB-WAM)", text)
    assert main(["tables", str(tmp_path / "a"), "--findings", "--out", str(tmp_path / "f")]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "f").exists()
    assert main(["tables", str(tmp_path / "t" / "cells.csv"), "--findings", "--out", str(tmp_path / "f")]) == 2
    assert "has no cell of ours that is a result" in capsys.readouterr().err and not (tmp_path / "f").exists()
    assert main(["report", str(tmp_path / "a"), "--table"]) == 0
    assert said in capsys.readouterr().out
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "c")]) == 0
    assert said in capsys.readouterr().out
    for name in ("compare.html", "compare.md"):
        assert said in (tmp_path / "c" / name).read_text().replace("&#39;", "'")


def test_best_next_to_the_best_of_the_paper(tables):
    """The highest of ours, the highest of the paper with its family, and whether the intervals are apart."""
    shown = row(tables["best"], "twist2", "Football")
    assert shown["best of ours"] == "act v4" and shown["best of the paper"] == "FM"
    assert row(tables["best"], "twist2", "Boxing")["ours is"] == "not higher"
    assert row(tables["best"], "sonic", "DoubleDesk")["ours is"] == "apart"
    assert row(tables["best"], "twist2", "P&PBox")["ours is"] in ("higher", "apart")


def test_cross_gmt_is_paired(tables):
    """Drop, retention and exact test over the same episodes; undefined where nothing succeeded matched."""
    table = tables["cross_gmt"]
    swap = entry(table, source="ours", policy="act v3.1", trained_on="twist2", task="football")
    assert (swap.matched_sr, swap.sr, swap.drop) == (0.5, 5 / 60, pytest.approx(25 / 60))
    assert swap.retention == pytest.approx(5 / 30)
    assert (swap.pairs, swap.unpaired, swap.only_first, swap.only_second) == (60, 0, 25, 0)
    assert swap.p == mcnemar(25, 0) and swap.afr == 0.2
    tests = [e.p for e in table.entries if e.source == "ours"]
    assert [e.p_holm for e in table.entries if e.source == "ours"] == pytest.approx(holm(tests))
    pi = row(table, "twist2 → sonic", "Boxing", "pi")
    assert pi["Ret %"] == "—" and pi["p"] == "1.000"
    dp = row(table, "twist2 → sonic", "Football", "dp")
    assert dp["Ret %"] == "0.0" and dp["paper Ret %"] == "46.5" and dp["paper Δ"] == "+25.0"
    assert row(table, "sonic → twist2", "Football", "act v3.1")["matched %"] == "80.0"
    theirs = entry(table, source="paper", family="act", trained_on="twist2", task="football")
    assert (theirs.drop, theirs.retention) == (0.267, 0.0)


def test_families_are_compared_on_the_same_episodes(tables):
    """Every pair of policies of a tracker and task has discordant pairs and an adjusted p."""
    shown = row(tables["families"], "twist2", "Football", "act v3.1", "dp")
    # act succeeds in episodes 0 to 29, dp in 3 to 14.
    assert (
        shown["alone"] == "18/0" and shown["n"] == "60" and shown["first %"] == "50.0" and shown["second %"] == "20.0"
    )
    (found,) = [
        e for e in tables["families"].entries if (e.policy, e.task) == ("dp", "football") and e.only_first == 18
    ]
    assert found.p == mcnemar(18, 0) <= found.p_holm


def test_a_mode_that_the_paper_lacks_changes_no_other_table(cells, tables):
    """A further mode gets its table; the paper's numbers are read as ever, and the profile says that it lacks it."""
    further = [dataclasses.replace(c, mode="dynamics") for c in cells.cells if c.mode == "visual"]
    found = {t.name: t for t in suite_tables([*cells.cells, *further], read_paper())}
    assert set(found) == {*tables, "in_gmt_dynamics"}
    assert found["perturbation"].rows == tables["perturbation"].rows
    assert "Without dynamics" in found["perturbation"].caption and "Without" not in tables["perturbation"].caption


def test_perturbation_profile(tables):
    """Averages over the tasks that every mode has, and the paired change from base."""
    shown = row(tables["perturbation"], "twist2", "act v3.1", "ours", "HOI")
    assert shown["base"] == "60.0" and shown["semantic"].startswith("60.0, 0.0 (")
    assert shown["visual"].startswith("35.0, −25.0 (")
    drop = entry(tables["perturbation"], source="ours", policy="act v3.1", task="HOI_AVG", mode="visual")
    one = [dict(enumerate([True] * won + [False] * (60 - won))) for won in (30, 36, 42, 15, 21, 27)]
    found = contrast([[(1 / 3, one[k]), (-1 / 3, one[k + 3])] for k in range(3)])
    assert (drop.drop, drop.drop_low, drop.drop_high) == pytest.approx((found.value, found.low, found.high))
    assert drop.pairs == 180
    assert row(tables["perturbation"], "twist2", "ACT", "paper", "HOI")["visual"] == "14.4, −13.9"


def test_merged_training_pools_both_trackers(tables):
    """A policy of both trackers' demonstrations has 120 episodes a task, next to the paper's x14."""
    shown = row(tables["merge_all"], "TWIST2+SONIC ×14", "all", "ours")
    assert shown["n"] == "120" and shown["Football"].startswith("50.0 ± 50.0 (")
    theirs = row(tables["merge_all"], "TWIST2+SONIC ×14", "ACT", "paper")
    assert theirs["Football"].startswith("32.5 ± 18.4") and theirs["n"] == "100 to 120"


def test_merged_training_has_each_tracker_and_mode(tables, cells):
    """A policy of many tasks has a number for each of its cells, in every mode; a swapped one too."""
    rates = [row(tables["merged"], tracker, "all")["Football"] for tracker in ("twist2", "sonic")]
    assert [rate.split(" ")[0] for rate in rates] == ["33.3", "66.7"]
    merged = [cell for cell in cells.cells if cell.merged]
    assert len([e for e in tables["merged"].entries if e.task != "HOI_AVG"]) == len(merged) == 6
    others = [dataclasses.replace(cell, mode="dynamics") for cell in merged]
    others += [dataclasses.replace(cell, policy="one", trained_on=("twist2",)) for cell in merged]
    found = {table.name: table for table in suite_tables(others, paper_numbers())}
    assert row(found["merged_dynamics"], "sonic", "all")["n"] == row(found["merged"], "sonic", "one")["n"] == "60"


def test_latency_and_labels(tables):
    """A delay is compared with none, v4 with v3.1, over the same episodes."""
    shown = row(tables["latency"], "twist2", "act v3.1", "Football")
    assert shown["0 ms"] == "50.0 (38 to 62)" and shown["200 ms"] == "33.3 (23 to 46), p 0.002"
    assert mcnemar(10, 0) == pytest.approx(0.00195, abs=1e-5)
    shown = row(tables["labels"], "twist2", "twist2", "matched", "Football")
    assert shown["v3.1 %"] == "50.0" and shown["v4 %"] == "75.0" and shown["alone"] == "0/15"


def test_time_is_summed(tables):
    """Minutes of the cells by policy and tracker, as the suite's journal says."""
    shown = row(tables["cost"], "act v3.1", "sonic", "sonic", "cpu")
    assert shown["cells"] == "3" and shown["episodes"] == "180"
    assert shown["evaluation min"] == "4.5" and shown["min per cell"] == "1.50" and shown["training min"] == ""


def test_trainings_count_once(tmp_path):
    """Minutes of a training are in the first row that uses its weights."""
    for tracker in ("twist2", "sonic"):
        facts = {"family": "act", "trackers": ["twist2"], "tasks": ["boxing"], "weights": "aa", "minutes": 3.5}
        write_cell(tmp_path / tracker, cell_of("x", "x", tracker, "boxing"), outcomes(9), policy_facts=facts)
    found = read_cells([tmp_path / "twist2", tmp_path / "sonic"])
    (table,) = [t for t in suite_tables(found.cells, paper_numbers()) if t.name == "cost"]
    assert row(table, "act", "twist2", "twist2")["training min"] == "3.5"
    assert row(table, "act", "twist2", "sonic")["training min"] == "above"


def test_what_is_missing_is_said(cells, suite):
    """Cells that were not played are a note, and no row."""
    assert f"{suite}: 1 cell of {len(plan())} not played yet." in cells.notes
    assert f"{60 * (len(plan()) - 1):,} episodes in {len(plan()) - 1} cells.".replace(",", "") in [
        note.replace(",", "") for note in cells.notes
    ]


def test_an_unfinished_cell_is_no_sample(tmp_path):
    """Successes end before timeouts do, so that a cell's first episodes are left out and named, not tabulated."""
    matched, swapped = (
        cell_of("act", "act", tracker, "football", trained_on=("twist2",)) for tracker in ("twist2", "sonic")
    )
    write_suite(tmp_path / "suite", [(matched, outcomes(30)), (swapped, None)])
    write_cell(tmp_path / "suite" / swapped.folder, swapped, outcomes(10), played=20)
    found = read_cells([tmp_path / "suite"])
    folder = tmp_path / "suite" / swapped.folder
    assert f"{folder} is incomplete, and left out: 20 of 60 episodes." in found.notes
    assert [(cell.tracker, len(cell.records)) for cell in found.cells] == [("twist2", 60)]


def test_unequal_seeds_are_never_compared_as_pairs(tmp_path):
    """Common episodes alone of two folders, one of which has fewer, are compared, and the others are counted."""
    for tracker, won, played in (("twist2", 30, 60), ("sonic", 10, 20)):
        facts = {"family": "act", "facts": {"trackers": ["twist2"], "tasks": ["football"]}}
        cell = cell_of("x", "x", tracker, "football")
        write_cell(tmp_path / tracker, cell, outcomes(won), played=played, policy_facts=facts)
    found = read_cells([tmp_path / "twist2", tmp_path / "sonic"])
    (table,) = [t for t in suite_tables(found.cells, paper_numbers()) if t.name == "cross_gmt"]
    mine = entry(table, source="ours")
    assert (mine.pairs, mine.unpaired, mine.matched_sr, mine.drop) == (20, 40, 1.0, 0.5)


def test_plain_folders_without_a_suite(tmp_path):
    """Results folders of `eval run` fill the tables with what their policy declared."""
    for tracker, won in (("twist2", 30), ("sonic", 6)):
        cell = cell_of("x", "x", tracker, "boxing")
        facts = {
            "family": "act",
            "facts": {"recipe": "fast", "trackers": ["twist2"], "tasks": ["boxing"], "labels": "v4"},
        }
        write_cell(tmp_path / tracker, cell, outcomes(won), policy_facts=facts, labels="v4")
    write_cell(tmp_path / "stand", dataclasses.replace(cell_of("x", "x", "pd", "boxing"), spec="stand"), outcomes(0))
    found = read_cells([tmp_path / "twist2", tmp_path / "sonic", tmp_path / "stand"])
    made = {t.name: t for t in suite_tables(found.cells, paper_numbers())}
    assert row(made["in_gmt"], "twist2", "act fast", "ours")["Boxing"].startswith("50.0")
    assert row(made["cross_gmt"], "twist2 → sonic", "Boxing", "act fast")["Ret %"] == "20.0"
    assert row(made["untrained"], "pd", "stand")["Boxing"].startswith("0.0")
    assert entry(made["cross_gmt"], source="ours").labels == "v4"


def test_other_rules_are_left_out(tmp_path):
    """Episodes of another rule set are counted in a note; without any of the rules asked for it is an error."""
    cell = cell_of("act", "act", "twist2", "boxing")
    write_cell(tmp_path / "a", cell, outcomes(30))
    write_cell(tmp_path / "b", cell, outcomes(9), rules="released")
    found = read_cells([tmp_path / "a", tmp_path / "b"])
    assert "60 episodes under the rules released left out." in found.notes and len(found.cells) == 1
    with pytest.raises(InputError, match="no episode under the rules paper, only released"):
        read_cells([tmp_path / "b"])


def test_cells_that_one_table_must_not_mix(tmp_path):
    """The same cell twice and other step budgets are refused, with both folders."""
    cell = cell_of("act", "act", "twist2", "boxing")
    write_cell(tmp_path / "a", cell, outcomes(30))
    write_cell(tmp_path / "b", cell, outcomes(9))
    write_cell(tmp_path / "c", cell_of("act", "act", "twist2", "football"), outcomes(9), max_steps=1300)
    with pytest.raises(InputError, match=f"{tmp_path / 'b'}: cell .* is in {tmp_path / 'a'} too"):
        read_cells([tmp_path / "a", tmp_path / "b"])
    with pytest.raises(InputError, match="max_steps is 1300, in"):
        read_cells([tmp_path / "a", tmp_path / "c"])
    write_cell(tmp_path / "d", cell, [], seed_range="demonstration")
    with pytest.raises(InputError, match="d: holds recordings for training; results are of evaluations"):
        read_cells([tmp_path / "d"])


def test_command_writes_the_same_bytes_again(suite, tmp_path, capsys, monkeypatch):
    """The command writes every form, and two calls write equal bytes; the CSV holds each number once."""
    pytest.importorskip("matplotlib")
    from arena_newton.eval.tables import suite_figures

    draw, twice = suite_figures.write, ("in_gmt", "cross_gmt")
    for name in ("a", "b"):
        assert main(["tables", str(suite), "--out", str(tmp_path / name), "--findings"]) == 0
        monkeypatch.setattr(suite_figures, "write", lambda out, some: draw(out, [t for t in some if t.name in twice]))
    out = capsys.readouterr().out
    assert "tables: in_gmt, in_gmt_visual" in out and "## perturbation: visual drop: undecided" in out
    names = sorted(path.name for path in (tmp_path / "b").iterdir())
    assert {"tables.md", "tables.tex", "cells.csv", "findings.md", "in_gmt.png", "cross_gmt.png"} == set(names)
    assert {"perturbation.png", "latency.png", "merge_all.png"} <= {path.name for path in (tmp_path / "a").iterdir()}
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    assert (tmp_path / "a" / "in_gmt.png").read_bytes()[:4] == b"\x89PNG"
    rows = list(csv.DictReader(io.StringIO((tmp_path / "a" / "cells.csv").read_text())))
    mine = [r for r in rows if r["table"] == "cross_gmt" and r["source"] == "ours" and r["policy"] == "act v3.1"]
    assert mine[0]["retention"] == "0.166667" and mine[0]["drop"] == "0.416667"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tables"], "name the results folder"),
        (["tables", "{suite}", "--format", "docx"], "--format docx: known are md tex csv png"),
        (["tables", "{suite}", "--rules", "house"], "house"),
        (["tables", "/nowhere"], "no results folder"),
        (["tables", "{suite}", "{suite}"], "is named twice"),
    ],
)
def test_wrong_calls_are_one_error(suite, tmp_path, capsys, arguments, message):
    """Each wrong call ends with exit code 2 and one line, and writes nothing."""
    out = tmp_path / "out"
    assert main([a.format(suite=suite) for a in arguments] + ["--out", str(out)] * (len(arguments) > 1)) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def hostile(text):
    """A table whose policy and notes say this."""
    return SuiteTable(("policy", "rate"), ((text, "1"),), "lr", "Title", f"caption {text}", "x")


@pytest.mark.parametrize(
    "text",
    ["a_b & 50 % #1 {x} \\input{/etc/passwd} $1$ ~ ^", "| <b>x</b> `y` [z](w)", "π0.5 ± 1 → — “猫”", "a\x1b[31m\nb"],
)
def test_text_stays_text(text):
    """Names of a results folder can be no element, no command and no further column in any form."""
    table = hostile(text)
    latex = table_text.as_latex([table], [text])
    assert balanced(latex) == []
    assert latex.isascii() and "\\input" not in latex
    (line,) = [line for line in latex.splitlines() if line.endswith("& 1 \\\\")]
    assert len(re.findall(r"(?<!\\)&", line)) == 1
    markdown = table_text.as_markdown([table], [text])
    assert "<b>" not in markdown and "\x1b" not in markdown


def balanced(latex):
    """Faults of a LaTeX text: environments or braces that do not close, columns that a row lacks."""
    found, stack = [], []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", latex):
        if kind == "begin":
            stack.append(name)
        elif not stack or stack.pop() != name:
            found.append(f"end of {name}")
    found += [f"{name} is open" for name in stack]
    bare = re.sub(r"\\[{}]", "", latex)
    found += ["braces"] if bare.count("{") != bare.count("}") else []
    found += ["dollars"] if len(re.findall(r"(?<!\\)\$", latex)) % 2 else []
    for columns, body in re.findall(r"\\begin\{tabular\}\{([lr]+)\}(.*?)\\end\{tabular\}", latex, re.S):
        for line in body.splitlines():
            if line.endswith(r" \\") and len(re.findall(r"(?<!\\)&", line)) + 1 != len(columns):
                found.append(f"columns of {line}")
    found += [f"bare {c}" for c in "#_^~" if re.search(rf"(?<!\\)\{c}", bare.replace("$\\pm$", ""))]
    return found


def test_latex_is_whole(suite, tmp_path):
    """The document of all tables closes what it opens and has a text for every column; where LaTeX is, it compiles."""
    assert main(["tables", str(suite), "--out", str(tmp_path), "--format", "tex"]) == 0
    text = (tmp_path / "tables.tex").read_text()
    assert balanced(text) == [] and text.count(r"\toprule") == 13
    assert balanced(text.replace(r"\bottomrule", r"\begin{x}", 1)) != []
    if shutil.which("pdflatex"):
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"]
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
        assert (tmp_path / "tables.pdf").stat().st_size > 1000


def test_several_trainings_of_a_recipe_have_a_table(tmp_path):
    """Policies `act#1` to `act#3` are one recipe: their successes, mean and standard deviation are one row."""
    plan = [(cell_of(f"act#{n}", "act", "sonic", "boxing"), outcomes(won)) for n, won in ((1, 30), (2, 36), (3, 42))]
    made = {t.name: t for t in suite_tables(read_cells([write_suite(tmp_path / "suite", plan)]).cells, paper_numbers())}
    shown = row(made["trainings"], "act", "sonic", "sonic", "Boxing", "base")
    assert (shown["successes"], shown["mean %"], shown["sd, points"]) == ("30 36 42", "60.0", "10.0")
    assert "families" not in made


def test_damaged_suites_are_refused(suite, tmp_path):
    """A suite whose file names another cell's folder, or is no JSON, is one error."""
    copy = tmp_path / "suite"
    shutil.copytree(suite, copy)
    content = json.loads((copy / SUITE_FILE).read_text())
    content["cells"][0]["folder"], content["cells"][1]["folder"] = (content["cells"][k]["folder"] for k in (1, 2))
    (copy / SUITE_FILE).write_text(json.dumps(content))
    with pytest.raises(InputError):
        read_cells([copy])
    (copy / SUITE_FILE).write_text("{")
    with pytest.raises(InputError, match=SUITE_FILE):
        read_cells([copy])


def test_texts_of_numbers():
    """Signs, intervals and small p-values are written the one way."""
    assert points(-0.25) == "−25.0" and points(0.0) == points(-1e-9) == "0.0" and points(0.1) == "+10.0"
    assert interval_text(-0.004, 0.5) == "(0 to 50)" and interval_text(-0.31, 0.5) == "(−31 to 50)"
    assert probability(0.0004) == "<0.001" and probability(0.05) == "0.050" and probability(None) == ""


def test_a_suite_claims_nothing_that_its_runs_contradict(tmp_path):
    """Latency, labels, family, trackers and tasks of a training are the run's own, whatever suite.json says of them."""
    facts = {"family": "act", "trackers": ["twist2"], "tasks": ["football"], "weights": "0123456789ab"}
    trained = cell_of("act", "act", "twist2", "football")
    expert = dataclasses.replace(cell_of("expert", "expert", "twist2", "boxing", trained_on=()), trained_tasks=())
    folder = tmp_path / "suite"
    write_suite(folder, [(trained, None), (expert, None)])
    write_cell(folder / trained.folder, trained, outcomes(30), policy_facts=facts)
    write_cell(folder / expert.folder, dataclasses.replace(expert, spec="expert"), outcomes(60))
    honest = read_cells([folder]).cells
    content = json.loads((folder / SUITE_FILE).read_text())
    for cell in content["cells"]:
        cell |= {"latency": 3, "labels": "v4", "family": "pi05", "replan": 2, "ensemble": True}
        cell |= {"trained_on": ["sonic", "twist2"], "trained_tasks": ["football", "boxing"]}
    (folder / SUITE_FILE).write_text(json.dumps(content))

    def claims(cell):
        kept = ("family", "trained_on", "trained_tasks", "labels", "latency", "replan", "ensemble")
        return {name: getattr(cell, name) for name in kept}

    assert [claims(cell) for cell in read_cells([folder]).cells] == [claims(cell) for cell in honest]
    assert claims(honest[0])["trained_on"] == ("twist2",) and claims(honest[1])["trained_on"] == ()
