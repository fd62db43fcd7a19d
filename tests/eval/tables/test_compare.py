"""`eval compare`: what is paired, what is refused, and what the files say."""

import csv
import html
import json
import os
import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest
from made_folders import folder_with
from made_suites import cell_of, outcomes, write_suite
from rows import episodes

from arena_newton.eval.__main__ import main
from arena_newton.eval.records.sharding import Shard, dealt
from arena_newton.eval.statistics.comparison import Contender, compare
from arena_newton.eval.statistics.stats import Contrast, mcnemar, wilson
from arena_newton.eval.suites.suite_records import CellEvent, event_line
from arena_newton.eval.tables.comparison_text import difference_text, p_text, verdict


def run_in(folder, per_seed, *, task="football", tracker="t", policy="p", strips=False, rules="paper", **config):
    """A results folder of 3 seeds x 20, with so many successes of each seed."""
    rows = episodes(task, per_seed)
    for row in rows:
        row |= {"tracker": tracker, "policy": policy, "rules": rules, "engine": config.get("engine", "mujoco")}
        if strips:
            name = f"{task}__base__seed{row['group_seed']}__repeat{row['repeat']}__world.jpg"
            row["media"] = {"world strip": f"strips/{name}"}
            (folder / "strips").mkdir(parents=True, exist_ok=True)
            (folder / "strips" / name).touch()
    config = {"tracker": [tracker], "task": [task], "policy": policy, "rules": rules, "engine": "mujoco"} | config
    return folder_with(folder, rows, len(rows), **config)


def compared(tmp_path, *arguments):
    """JSON that the command wrote; it must have ended well."""
    assert main(["compare", *map(str, arguments), "--out", str(tmp_path / "out")]) == 0
    return json.loads((tmp_path / "out" / "compare.json").read_text())


def test_two_runs_are_paired_by_episode(tmp_path, capsys):
    """Counts, test, interval and letters of two runs follow from who succeeded in which episode, in the same bytes."""
    a, b = run_in(tmp_path / "a", (4, 5, 7), strips=True), run_in(tmp_path / "b", (10, 5, 12))
    found = compared(tmp_path, a, b)
    (pair,) = found["pairs"]
    (task,) = pair["tasks"]
    assert [task[key] for key in ("both", "only_first", "only_second", "neither")] == [16, 0, 11, 33]
    assert task["p"] == pair["p"] == pair["p_holm"] == mcnemar(0, 11) and pair["differs"]
    assert task["difference"][0] == pytest.approx(-11 / 60)
    assert [one["all"]["letters"] for one in found["policies"]] == ["b", "a"]
    assert found["policies"][1]["all"]["ci95"] == wilson(27, 60)
    said = capsys.readouterr().out
    assert "b succeeds more often than a" in said and said.splitlines()[0].startswith("b ")
    rows = list(csv.DictReader((tmp_path / "out" / "compare.csv").open()))
    assert [(row["task"], row["only_second"]) for row in rows] == [("football", "11"), ("all", "11")]
    markdown = (tmp_path / "out" / "compare.md").read_text()
    assert "| football | a     | b      |   16 |          0 |          11 |      33 |" in markdown
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    compared(tmp_path, a, b)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    assert sorted(before) == ["compare.csv", "compare.html", "compare.json", "compare.md"]


def test_the_page_links_what_differs(tmp_path):
    """The page lists each episode that one alone solved, with links that lead to its strips, or the command."""
    a, b = run_in(tmp_path / "a b", (4, 5, 7), strips=True), run_in(tmp_path / "b", (10, 5, 12))
    (a / "report.html").write_text("")
    compared(tmp_path, a, b)
    page = (tmp_path / "out" / "compare.html").read_text()
    links = re.findall(r'href="([^"]+\.jpg)"', page)
    assert len(links) == 11
    for link in links:
        target = (tmp_path / "out" / unquote(html.unescape(link))).resolve()
        assert target.parent == a / "strips" and target.is_file()
    names = {Path(unquote(link)).name for link in links}
    assert "football__base__seed0__repeat4__world.jpg" in names and not any("seed1" in name for name in names)
    assert page.count("play it again") == 11 and "--seeds 0 --repeats 5" in page  # those of b have no strip
    assert 'href="../a%20b/report.html"' in page
    assert "<script" not in page and "script-src" not in page and "default-src &#39;none&#39;" in page
    shutil.rmtree(a / "strips")  # results that came without their recordings
    compared(tmp_path, a, b)
    page = (tmp_path / "out" / "compare.html").read_text()
    assert ".jpg" not in page and page.count("play it again") == 22


def test_folders_may_have_any_name(tmp_path):
    """Long names that differ at their end, and names that are no text, are compared and linked."""
    odd = os.fsdecode(b"b\xff")
    a, b = run_in(tmp_path / ("a" * 250 + "1"), (4, 5, 7), strips=True), run_in(tmp_path / ("a" * 250 + "2"), (4, 6, 7))
    found = compared(tmp_path, a, b)
    assert [one["name"] for one in found["policies"]] == [a.name, b.name]
    try:
        c = run_in(tmp_path / odd, (10, 5, 12), strips=True)
    except OSError:
        return  # a file system of text alone
    (a / "report.html").touch(), (c / "report.html").touch()
    compared(tmp_path, a, c)
    page = (tmp_path / "out" / "compare.html").read_text()
    assert page.count('href="../b%FF/strips/') == 11 and 'href="../b%FF/report.html"' in page
    assert f'href="../{a.name}/report.html"' in page  # its path is too long for a table, not for a link


def test_text_of_strangers_stays_text(tmp_path):
    """A policy's name cannot become an element, and media outside `strips/` and `videos/` are not linked."""
    a = run_in(tmp_path / "a", (4, 5, 7), policy="<script>x|y</script>")
    lines = (a / "episodes.jsonl").read_text().replace('"media": {}', '"media": {"world strip": "../../secret.jpg"}')
    (a / "episodes.jsonl").write_text(lines)
    compared(tmp_path, a, run_in(tmp_path / "b", (10, 5, 12)))
    page = (tmp_path / "out" / "compare.html").read_text()
    assert "<script" not in page and "&lt;script&gt;x|y" in page and "secret" not in page
    assert r"&lt;script\>x\|y" in (tmp_path / "out" / "compare.md").read_text()


def test_other_seeds_are_compared_unpaired(tmp_path):
    """Runs without a common seed are compared unpaired, with a note; of overlapping ones the common part counts."""
    a = run_in(tmp_path / "a", (4, 5, 7))
    rows = [row | {"group_seed": row["group_seed"] + 3, "tracker": "t"} for row in episodes("football", (14, 15, 17))]
    b = folder_with(tmp_path / "b", rows, 60, tracker=["t"], seeds=[3, 4, 5], engine="mujoco")
    found = compared(tmp_path, a, b)
    (task,) = found["pairs"][0]["tasks"]
    assert (task["test"], task["first"], task["second"]) == ("Boschloo", 16, 46) and not task["paired"]
    assert any("share no episode seed" in note for note in found["notes"])
    assert "compared unpaired" in (tmp_path / "out" / "compare.html").read_text()
    row = (tmp_path / "out" / "compare.md").read_text().split("## Within tasks")[1].splitlines()[4]
    assert [cell.strip() for cell in row.split("|")][4:9] == ["", "", "", "", "16/60, 46/60"]
    shared = [row | {"index": 20 + number} for number, row in enumerate(episodes("football", (9,)))]
    few = folder_with(tmp_path / "few", rows[:20] + shared, 40, tracker=["t"], seeds=[3, 0], engine="mujoco")
    found = compared(tmp_path, a, few)
    (task,) = found["pairs"][0]["tasks"]
    assert task["paired"] and (task["both"], task["only_second"], task["left_out"]) == (4, 5, 60)
    assert any("60 episodes that one of them lacks" in note for note in found["notes"])


def test_trackers_are_compared_where_each_has_one(tmp_path):
    """One policy through two trackers is paired across them; one folder of both is split by --per-tracker."""
    a, b = run_in(tmp_path / "a", (4, 5, 7), tracker="t"), run_in(tmp_path / "b", (10, 5, 12), tracker="u")
    found = compared(tmp_path, a, b)
    assert found["pairs"][0]["tasks"][0]["only_second"] == 11
    assert any(note.startswith("Trackers differ: a: t; b: u") for note in found["notes"])
    rows = [row | {"tracker": "t"} for row in episodes("football", (4, 5, 7))]
    rows += [row | {"tracker": "u"} for row in episodes("football", (10, 5, 12), index=60)]
    both = folder_with(tmp_path / "both", rows, 120, tracker=["t", "u"], engine="mujoco")
    found = compared(tmp_path, both, "--per-tracker")
    assert [one["name"] for one in found["policies"]] == ["both t", "both u"]
    assert found["pairs"][0]["tasks"][0]["only_second"] == 11


def test_a_suite_holds_its_policies(tmp_path):
    """Each policy of a suite is compared over the tasks and trackers that all have; what some lack is left out."""
    cells = [
        (cell_of(policy, policy, tracker, task), outcomes(won + 2 * (tracker == "sonic")))
        for policy, won in (("act", 20), ("flow", 40), ("pi05", 41))
        for tracker in ("twist2", "sonic")
        for task in ("football", "boxing")
    ]
    cells += [(cell_of("act", "act", "twist2", "vis_navi"), outcomes(60))]
    cells += [(cell_of("act", "act", "sonic", task, trained_on=["twist2"]), outcomes(5)) for task in ("football",)]
    cells += [(cell_of(policy, policy, "sonic", "vis_navi"), outcomes(9)[:30]) for policy in ("act", "flow", "pi05")]
    suite = write_suite(tmp_path / "suite", cells)
    found = compared(tmp_path, suite, "--only", "act", "flow", "pi05")
    assert [one["name"] for one in found["policies"]] == ["act", "flow", "pi05"]
    assert [one["all"]["successes"] for one in found["policies"]] == [84, 164, 168]
    assert [one["all"]["letters"] for one in found["policies"]] == ["b", "a", "a"]
    strata = [["football", "twist2"], ["boxing", "twist2"], ["football", "sonic"], ["boxing", "sonic"]]
    assert [[task["stratum"] for task in pair["tasks"]] for pair in found["pairs"]] == [strata] * 3
    assert any("Left out, because not all have it: vis_navi" in note for note in found["notes"])
    assert sum("is incomplete, and left out: 30 of 60" in note for note in found["notes"]) == 3
    beginning = cell_of("act", "act", "twist2", "sit_sofa")
    broken = cell_of("act", "act", "sonic", "sit_sofa")
    suite = write_suite(tmp_path / "more", [*cells, (beginning, None), (broken, None)])
    (suite / beginning.folder).mkdir(parents=True)
    with (suite / "suite.1-of-1.jsonl").open("ab") as journal:
        journal.write(event_line(CellEvent(cell=broken.id, event="failed", at="2026-01-02", error="no weights")))
    notes = compared(tmp_path, suite, "--only", "act", "flow")["notes"]
    assert any(note.endswith("more: 1 cell of 19 not played yet.") for note in notes)
    assert any(note.endswith(f"{broken.folder}: failed (no weights).") for note in notes)
    suite = tmp_path / "suite"
    found = compared(tmp_path, suite, "--per-tracker", "--only", "act sonic", "act swapped sonic", "act twist2")
    assert [one["all"]["successes"] for one in found["policies"]] == [20, 22, 5]
    assert [task["task"] for task in found["pairs"][0]["tasks"]] == ["football"]


REFUSED = [
    (["a"], "a alone has nothing to be compared with"),
    (["a", "none"], "no results folder"),
    (["a", "a"], "is named twice"),
    ([], "name the results folder"),
    (["a", "boxing"], "nothing in common: a has football; boxing has boxing"),
    (["a", "b", "boxing"], "To be compared: a with b"),
    (["a", "released"], "rules differs: paper in a; released in released; --differ rules"),
    (["a", "warp"], "engine differs: mujoco in a; warp in warp; --differ engine"),
    (["a", "b", "warp"], "alike, and to be compared, are: a, b"),
    (["a", "capped"], "--max-steps differs"),
    (["a", "recorded"], "holds recordings for training"),
    (["a", "empty"], "holds no finished episode"),
    (["a", "shard"], "shard: is shard 1/2 of a run; name the folder into which eval merge joins all"),
    (["a", "~nosuchuser/b"], "~nosuchuser/b: no home folder of that user"),
    (["a", "b", "--out", "~nosuchuser/b"], "~nosuchuser/b: no home folder of that user"),
    (["a", "half"], "half: is unfinished (30 of 60 episodes)"),
    (["a", "b", "--only", "c"], "--only c: unknown, found are a, b"),
    (["a", "b", "--only", "a"], "--only a: keeps one, which has nothing to be compared with"),
    (["a", "b", "--differ", "policy"], "--differ policy: choose from rules engine"),
    (["a", "b", "--out", ""], "--out: is empty"),
    (["a", "b", "--out", "a/config.json"], "cannot be made"),
    (["a", "b", "--outt", "x"], "--outt: unknown argument"),
]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Results folders that fit `a`, or do not."""
    root = tmp_path_factory.mktemp("runs")
    for name in ("a", "b"):
        run_in(root / name, (4, 5, 7))
    run_in(root / "boxing", (4, 5, 7), task="boxing")
    run_in(root / "released", (4, 5, 7), rules="released")
    run_in(root / "warp", (4, 5, 8), engine="warp")
    run_in(root / "capped", (4, 5, 7), max_steps=1300)
    folder_with(root / "recorded", [], 60, tracker=["t"], engine="mujoco", seed_range="demonstration")
    folder_with(root / "half", episodes("football", (4, 5))[:30], 60, tracker=["t"], engine="mujoco")
    every_other = dealt([("football", "t", "base", n // 20, n % 20) for n in range(60)], Shard(1, 2))
    rows = [row for row in episodes("football", (4, 5, 7)) if row["index"] in every_other]
    folder_with(root / "shard", rows, 60, tracker=["t"], task=["football"], mode=["base"], engine="mujoco")
    document = json.loads((root / "shard" / "config.json").read_text()) | {"shard": "1/2"}
    (root / "shard" / "config.json").write_text(json.dumps(document))
    folder_with(root / "empty", [], 60, tracker=["t"], engine="mujoco")
    return root


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=[" ".join(a) or "nothing" for a, _ in REFUSED])
def test_what_cannot_be_compared_is_refused(folders, monkeypatch, capsys, arguments, message):
    """One line names what is wrong and what may still be compared; nothing is written, and the exit code is 2."""
    monkeypatch.chdir(folders)
    assert main(["compare", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and message in error
    assert not (folders / "comparison").exists()


def test_a_file_that_cannot_be_written_is_named(folders, tmp_path, capsys):
    """A file of the comparison that cannot be written is named, with exit code 2 and no talk of journals."""
    (tmp_path / "compare.html").mkdir()
    assert main(["compare", str(folders / "a"), str(folders / "b"), "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "compare.html: cannot be written" in error and "journal" not in error and error.count("\n") == 1


def test_what_is_compared_may_differ(folders, tmp_path):
    """--differ compares runs that differ in a condition, and the page says so."""
    found = compared(tmp_path, folders / "a", folders / "warp", "--differ", "engine")
    assert found["pairs"][0]["tasks"][0]["only_second"] == 1 and "engine" not in found["alike"]
    assert any(note.startswith("Engine differs: a: mujoco; warp: warp") for note in found["notes"])


def test_rules_and_scenes_that_have_changed_are_named(tmp_path):
    """Runs under rules of the same name but other content, or in other scenes, are compared, with a note."""
    a, b = (run_in(tmp_path / name, (4, 5, 7), rules_hash=name * 12, scenes=f"{name}1") for name in ("a", "b"))
    notes = compared(tmp_path, a, b)["notes"]
    assert f"The rules have changed between the runs: {'a' * 12} {'b' * 12}, of the same tasks." in notes
    assert "The scenes have changed between the runs: a1 b1, of the same tasks." in notes
    c = run_in(tmp_path / "c", (4, 5, 7), rules_hash="a" * 12, scenes="a1")
    assert not any("changed" in note for note in compared(tmp_path, a, c)["notes"])


def test_a_plan_says_what_it_can_tell(capsys):
    """`eval list` prints the smallest difference of the plan's episodes below their number."""
    assert main(["list", "--task", "boxing", "football"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("120 episodes") and "60 episodes per cell: 13 to 26.5 points, all 120" in said[1]
    assert main(["list", "--task", "boxing", "--seeds", "0", "--repeats", "2001"]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("    0 boxing")  # too many to compute: no empty line


def test_the_sentence_has_the_direction_of_the_test():
    """If few episodes of one task outweigh the mean, the better one is who won more episodes, with a note."""
    outcomes = [
        {("big",): dict(enumerate([won] * 15 + [False] * 45)), ("small",): dict(enumerate([not won] * 4))}
        for won in (True, False)
    ]
    comparison = compare([Contender("a", outcomes[0]), Contender("b", outcomes[1])])
    (pair,) = comparison.pairs
    assert pair.differs and pair.difference.value < 0
    assert verdict(comparison, pair) == "a succeeds in more episodes than b, which has the higher mean rate"
    outcomes = [
        {("big",): dict(enumerate([won] * 15 + [False] * 45)), ("small",): dict(enumerate([not won] + [False] * 3))}
        for won in (True, False)
    ]
    comparison = compare([Contender("a", outcomes[0]), Contender("b", outcomes[1])])
    (pair,) = comparison.pairs
    assert pair.differs and pair.difference.value == 0
    assert verdict(comparison, pair) == "a succeeds in more episodes than b, with equal mean rates"


def test_markdown_of_strangers_folders_opens_no_tag(tmp_path):
    """Names of folders and environments are no HTML in compare.md and report.md, whatever reads these."""
    evil = "<img src=x onerror=alert(1)>"
    runs = [run_in(tmp_path / f"{evil}{name}", (4, 5, 7), policy=f"p{evil}") for name in "ab"]
    compared(tmp_path, *runs)
    document = json.loads((runs[0] / "config.json").read_text())
    (runs[0] / "config.json").write_text(json.dumps(document | {"environments": {evil: {"engine": evil}}}))
    assert main(["report", str(runs[0])]) == 0
    for file in (tmp_path / "out" / "compare.md", runs[0] / "report.md"):
        text = re.sub(r"`[^`]*`", "", file.read_text())  # code stays code
        assert "img src" in text and not re.search("<[A-Za-z/!?]", text), file


def test_figures_have_no_minus_zero():
    """A difference and its bounds that are shown as 0 have no minus, and what is too small for a number is shown so."""
    assert difference_text(Contrast(-0.0001, -0.004, 0.02, 0, 0, 1, 1, 0)) == "+0.0 (0 to 2)"
    assert difference_text(Contrast(0.12, 0.034, 0.206, 0, 0, 1, 1, 0)) == "+12.0 (3 to 21)"
    assert (p_text(mcnemar(1680, 0)), p_text(3e-5), p_text(0.034), p_text(1.0)) == ("<1e-300", "3e-05", "0.034", "1.00")
