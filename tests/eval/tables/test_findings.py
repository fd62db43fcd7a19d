"""The paper's findings tested on suites and counts: a training is the unit, and pages are those of their records."""

import csv
import itertools
import re
import shutil
import statistics
from pathlib import Path

import pytest
from made_suites import HOI, HSI, cell_of, outcomes

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.commands.tables import BEGIN, END
from arena_newton.eval.statistics.stats import contrast, holm, paired_rates, suites, wilson
from arena_newton.eval.statistics.trainings import DROP_SPREAD, MATCHED_SPREAD, SWAPPED_SPREAD
from arena_newton.eval.tables import findings_text, paper_claims
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.evaluated_cells import read_cells
from arena_newton.eval.tables.paper_numbers import paper_numbers
from arena_newton.tasks.semantic_mode import semantic_note

RESULTS = Path(__file__).parents[3] / "docs" / "results"


@pytest.fixture(scope="module")
def counts(made_suite, tmp_path_factory):
    """Their counts, as `tables` writes them."""
    folder = tmp_path_factory.mktemp("counts")
    assert main(["tables", str(made_suite), "--format", "csv", "--out", str(folder)]) == 0
    return folder / "cells.csv"


def verdicts(found):
    """Verdict by name of the finding."""
    return {one.name: one.verdict for one in found}


def played_by(trainings, swapped=45, visual=45, won=45, families=(("act", "act"),)):
    """A plan of so many trainings of each recipe on all tasks, matched, swapped and in visual mode."""
    cells = []
    for task, (tracker, other), number in itertools.product(
        (*HOI, *HSI), (("twist2", "sonic"), ("sonic", "twist2")), range(trainings)
    ):
        for name, family in families:
            policy = f"{name}#{number + 1}"
            cells.append((cell_of(policy, family, tracker, task), outcomes(won + number)))
            cells.append((cell_of(policy, family, tracker, task, mode="visual"), outcomes(visual + number)))
            cells.append((cell_of(policy, family, other, task, trained_on=(tracker,)), outcomes(swapped + number)))
    return cells


def findings_of(plan):
    """Findings of cells with these outcomes, by name; episodes of one number begin alike."""
    names = "policy family trained_on trained_tasks tracker task mode labels latency".split()
    rest = {"replan": None, "ensemble": False, "records": (), "folder": Path("made")}
    cells = [
        EvaluatedCell(
            **{name: getattr(cell, name) for name in names},
            **rest,
            tallied={kind: {n: one == kind for n, one in enumerate(ended)} for kind in ("success", "fall")},
        )
        for cell, ended in plan
    ]
    return {one.name: one for one in paper_claims.findings(cells, paper_numbers())}


def test_findings_follow_the_data(cells):
    """Claims without data are not measured; one training a cell tells little, and the paper's numbers are its own."""
    found = {one.name: one for one in paper_claims.findings(cells.cells, paper_numbers())}
    assert found["perturbation: visual drop"].verdict == "undecided"  # three networks
    assert found["perturbation: visual drop"].ours.startswith("+25.0 points (")
    assert found["perturbation: visual drop"].paper == "+9.2 points"
    assert found["perturbation: visual against execution"].verdict == "not measured"
    assert semantic_note() in found["perturbation: visual against semantic"].remark
    assert "clutter 0.0 (1 cell), texture 0.0 (2 cells)" in found["perturbation: visual against semantic"].ours
    assert found["cross-GMT: twist2 → sonic"].paper == "+39.9 points on average; nothing left in 22 of 28 cells"
    said = "twist2 HOI: FM 36.1 %; twist2 HSI: FM 58.8 %; sonic HOI: DP 52.2 %; sonic HSI: DP 65.8 %"
    assert found["tracker-conditioned: best family"].paper == said
    assert found["tracker-conditioned: same family"].paper == "most: FM sit_sofa, 68.3 % with TWIST2, 15.0 % with SONIC"
    assert found["SR and AFR disagree: sonic"].paper == "highest success: DP, fewest falls: π0.5 (5.24 %)"
    assert found["tracker-conditioned: SONIC ahead on HSI"].verdict == "not measured"
    assert found["tracker-conditioned: SONIC ahead on HOI"].paper == "+16.1 points"
    text = findings_text.findings_text(list(found.values()))
    assert "## cross-GMT: twist2 → sonic: undecided" in text and "these networks" in text.splitlines()[2]
    assert "13 points" in text and "26 through another" in text and "28 for a difference" in text


def test_a_claim_that_fails_does_not_reproduce():
    """If in three trainings a cell neither visual perturbations nor swaps cost anything, the verdict says so."""
    said = verdicts(findings_of(played_by(3)).values())
    assert said["perturbation: visual drop"] == said["cross-GMT: sonic → twist2"] == "does not"
    assert said["cross-GMT: asymmetric drop"] == said["cross-GMT: asymmetric falls"] == "does not"
    assert said["tracker-conditioned: same family"] == "does not"
    assert said["SR and AFR disagree: sonic"] == "not measured"


def test_a_claim_that_holds_in_three_trainings_reproduces():
    """Drops that all trainings share reproduce, by their own spread, which the page names."""
    found = findings_of(played_by(3, swapped=12, visual=20))
    assert found["perturbation: visual drop"].verdict == found["cross-GMT: sonic → twist2"].verdict == "reproduces"
    assert "42 trainings" not in found["cross-GMT: sonic → twist2"].ours.replace("21 trainings", "")
    assert "their standard deviation measured" in found["cross-GMT: sonic → twist2"].ours


def test_one_training_decides_nothing_small():
    """A difference of 20 points in one training of one task is within what trainings differ by."""
    plan = [
        (cell_of("act", "act", tracker, "boxing"), outcomes(won)) for tracker, won in (("twist2", 50), ("sonic", 38))
    ]
    found = findings_of(plan)["tracker-conditioned: same family"]
    assert found.verdict == "undecided" and found.p_holm > 0.2 and "+20.0 points" in found.ours


def test_verdicts_are_adjusted_for_all_claims():
    """Each p counts the claims that were tested; a verdict stands only below the level after that."""
    found = findings_of(played_by(1, swapped=30, visual=30))
    tested = [one for one in found.values() if one.p is not None]
    assert [one.p_holm for one in tested] == pytest.approx(holm([one.p for one in tested]))
    assert all((one.verdict == "undecided") == (one.p_holm >= 0.05) for one in tested)


def test_more_policies_are_compared_on_fewer_tasks():
    """The runner-up that has three of seven tasks is compared on these, and who is left out is named."""
    plan = []
    for task, tracker in itertools.product((*HOI, *HSI), ("twist2", "sonic")):
        plan += [(cell_of("act", "act", tracker, task), outcomes(55))]
        plan += [(cell_of("dp", "diffusion", tracker, task), outcomes(53))] if task in HSI[:3] else []
        plan += [(cell_of("other", "act", tracker, task), outcomes(3))] if task == HOI[0] else []
    said = findings_of(plan)["tracker-conditioned: best family"]
    assert said.verdict == "undecided" and "act is best with both; leads over the second, dp: +3.3 points" in said.ours
    assert said.ours.endswith(f"Compared: act, dp on {' '.join(HSI[:3])}; left out: other ({HOI[0]})")


def test_merged_training_is_judged_by_its_own_trackers():
    """A merged policy of one tracker that another one executes is a swap, no effect of merging."""
    plan = []
    for task in HOI:
        plan += [(cell_of("act", "act", tracker, task), outcomes(45)) for tracker in ("twist2", "sonic")]
        for tracker, won in (("twist2", 45), ("sonic", 0)):
            both = cell_of("all", "act", tracker, task, trained_on=("twist2",), tasks_of=HOI + HSI)
            plan.append((both, outcomes(won)))
    one = findings_of(plan)["merged training: TWIST2x7 HOI"]
    assert one.ours.startswith("act: 0.0 points (") and "4 trainings" in one.ours
    assert one.verdict == "undecided" and "not separated" in one.remark


def test_declared_spreads_are_those_of_the_page():
    """The standard deviations between trainings are the pooled ones of the table of three trainings."""
    page = (RESULTS / "trainings.md").read_text().split("## One training is one sample")[1].split("\n## ")[0]
    rows = {
        line.split("|")[1].strip(): [int(n) for n in re.findall(r"\| (\d+)", line)]
        for line in page.splitlines()
        if "|" in line
    }
    matched, swapped = (
        [rows[f"{kind}, {which}"] for which in ("first", "second", "now")] for kind in ("matched", "swapped")
    )
    drops = [[a - b for a, b in zip(*pair, strict=True)] for pair in zip(matched, swapped, strict=True)]
    for declared, three in ((MATCHED_SPREAD, matched), (SWAPPED_SPREAD, swapped), (DROP_SPREAD, drops)):
        pooled = sum(statistics.variance(cell) for cell in zip(*three, strict=True)) / len(three[0])
        assert declared == pytest.approx(pooled**0.5 / 60, abs=0.005)


def test_pages_of_results_are_those_of_their_records(tmp_path, monkeypatch):
    """The findings, their table in the results' README and the reproductions are what is made of the stored cells."""
    shutil.copy(RESULTS / "README.md", tmp_path)
    monkeypatch.chdir(RESULTS.parents[1])
    files = sorted(str(path.relative_to(RESULTS.parents[1])) for path in RESULTS.glob("cells*.csv"))
    files.remove("docs/results/cells_second.csv")  # other trainings of the same names
    assert main(["tables", *files, "--findings", "--out", str(tmp_path)]) == 0
    assert main(["reproductions", files[0], "--out", str(tmp_path)]) == 0
    for name in ("README.md", "findings.md", "reproductions.md"):
        assert (tmp_path / name).read_text() == (RESULTS / name).read_text(), name
    text = (RESULTS / "README.md").read_text()
    assert text.count(BEGIN) == text.count(END) == 1 and semantic_note() in text


def test_marks_of_reproductions_follow_from_both_rates():
    """Each mark is the sign of the interval of Agresti and Caffo (2000) over 60 episodes of each, or none."""
    text = (RESULTS / "reproductions.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith(("| in-GMT", "| cross-GMT"))]
    found = re.findall(r"(\d+\.\d) ([≈▲▼]) (\d+\.\d)", "".join(rows))
    assert len(found) > 90 and {mark for _, mark, _ in found} == set("≈▲▼")
    for ours, mark, theirs in found:
        a, b = ((round(float(rate) * 0.6) + 1) / 62 for rate in (ours, theirs))
        wide = 1.96 * (a * (1 - a) / 62 + b * (1 - b) / 62) ** 0.5
        assert mark == ("≈" if abs(a - b) <= wide else "▲" if a > b else "▼"), (ours, mark, theirs)


def ends(both=0, only_first=0, only_second=0, neither=0):
    """Outcomes of two conditions over the same episodes, from counts."""
    kinds = [(True, True)] * both + [(True, False)] * only_first + [(False, True)] * only_second
    kinds += [(False, False)] * neither
    return [{n: kind[side] for n, kind in enumerate(kinds)} for side in (0, 1)]


@pytest.mark.parametrize("path", sorted(RESULTS.glob("cells*.csv")), ids=lambda path: path.stem)
def test_published_intervals_are_those_of_their_counts(path):
    """Every interval of ours in a published file is what the functions of today give for the counts in that file.

    How episodes of several tasks or trackers pair is in no count: of these the middle is known, and the width is not.
    """
    rows = [row for row in csv.DictReader(path.open(newline="")) if row["source"] == "ours"]
    single = {(r["table"], r["policy"], r["tracker"], r["task"]): r for r in rows if not r["task"].endswith("_AVG")}

    def stratum(row, mode, task, weight):
        """Conditions of a task in the tables of this mode; trackers that were pooled share the successes."""
        table = row["table"]
        if table == "perturbation":
            table = "in_gmt" if mode == "base" else f"in_gmt_{mode}"
        cell = single[table, row["policy"], row["tracker"], task]
        number = len(row["tracker"].split("+"))
        won, episodes = int(cell["successes"]), int(cell["episodes"]) // number
        counts = [won // number + (k < won % number) for k in range(number)]
        return [(weight / number, {n: n < count for n in range(episodes)}) for count in counts]

    for row in rows:
        names = suites().get(row["task"], (row["task"],))
        known = [None, None]
        if row["only_first"]:
            first, second = int(row["only_first"]), int(row["only_second"])
            both = int(row["successes"]) - second
            pair = ends(both, first, second, int(row["pairs"]) - both - first - second)
            found = contrast([[(1.0, pair[0]), (-1.0, pair[1])]])
            assert float(row["drop"]) == pytest.approx(found.value, abs=1e-6), row
            known[1] = found, True
        elif row["drop"]:
            strata = [
                [
                    *stratum(row, "base", task, 1 / len(names)),
                    *stratum(row, row["mode"], task, -1 / len(names)),
                ]
                for task in names
            ]
            known[1] = contrast(strata), False
        if len(names) == 1 and "+" not in row["tracker"]:
            rate = wilson(int(row["successes"]), int(row["episodes"]))
            assert [float(row["low"]), float(row["high"])] == pytest.approx(rate, abs=1e-5), row
        else:
            strata = [stratum(row, row["mode"], task, 1 / len(names)) for task in names]
            known[0] = contrast(strata), "+" not in row["tracker"]
        for found, (low, high), least in zip(known, (("low", "high"), ("drop_low", "drop_high")), (0, -1), strict=True):
            if found is None:
                continue
            interval, width = [float(row[low]), float(row[high])], found[1]
            assert least <= interval[0] <= interval[1] <= 1, row
            if width:
                assert interval == pytest.approx([found[0].low, found[0].high], abs=1e-5), row
            elif interval[1] < 1:
                assert sum(interval) / 2 == pytest.approx(found[0].middle, abs=1e-5), row


def test_counts_say_what_episodes_said(counts, cells, tmp_path):
    """Findings of the written cells.csv have the values of those of the episodes, and know what it says of pairs."""
    assert main(["tables", str(counts), "--out", str(tmp_path / "t")]) == 2
    counted = read_cells([counts]).cells
    told = {one.name: one for one in paper_claims.findings(counted, paper_numbers())}
    assert told["cross-GMT: asymmetric falls"].ours.endswith(" falls in all")
    for one in paper_claims.findings(cells.cells, paper_numbers()):
        assert told[one.name].ours.split(" points")[0] == one.ours.split(" points")[0], one.name
    swap = [c for c in counted if (c.policy, c.task) == ("act v3.1", "football")]
    matched, swapped = (
        next(c for c in swap if (c.tracker, c.mode) == (t, "base") and c.trained_on == ("twist2",))
        for t in ("twist2", "sonic")
    )
    assert paired_rates(matched.held(), swapped.held()).only_first == 25
    assert sum(swapped.held("fall").values()) == 12


@pytest.mark.parametrize(
    ("was", "now", "message"),
    [
        (",60,30,", ",60,99,", r"cells.csv: line \d+: episodes, successes, afr or mode are none of a cell"),
        (",60,30,", ",60,x,", r"cells.csv: line \d+: successes is 'x', expected a number"),
        ("ours", "mine", "has no cell of ours"),
    ],
)
def test_damaged_counts_are_refused(counts, tmp_path, was, now, message):
    """A file of counts with an impossible number is one error that names file and line."""
    path = tmp_path / "cells.csv"
    path.write_text(counts.read_text().replace(was, now))
    with pytest.raises(InputError, match=message):
        read_cells([path])
