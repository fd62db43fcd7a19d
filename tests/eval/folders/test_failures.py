"""Failures get the stage of the paper's taxonomy that their signals show, in journal, figures and reports."""

import dataclasses
import json
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_folders import document_of, folder_with
from made_signals import UNTOUCHED, WELL, signals, without_signals
from rows import episodes, full, record

from arena_newton import tasks, trackers
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks.failures import HELD_OUT, LEAST, TUNED, confusion, failures
from arena_newton.eval.certification.checks.labelled_failures import (
    LABELLED,
    LabelledFailure,
    agreements,
    labelled_failures,
    labelled_sheets,
)
from arena_newton.eval.certification.checks.traces import StateTrace, first_difference
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.stand_ins.sabotage import (
    HALTS,
    PERCHED,
    SABOTAGES,
    MisledSight,
    RelocatingEnv,
    WeakTracker,
)
from arena_newton.eval.folders.failure_counts import failure_cells
from arena_newton.eval.folders.failure_rules import BARS, near_bars, sees_at_start, stage_of, waits_in_view
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.eval.folders.results import OWN_FOLDER, load_run
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.interaction_view import InteractionView
from arena_newton.eval.play.own_tracker import own_options
from arena_newton.eval.play.signal_recorder import SEEN, SignalRecorder
from arena_newton.eval.records.journal import EpisodeRecord, Journal, read_journal
from arena_newton.eval.reports import report
from arena_newton.policies.experts import ExpertPolicy, Sight
from arena_newton.robot.g1 import DEFAULT_POSE, LEGS, TOE
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding
from arena_newton.tasks.football import BALL, GOAL
from arena_newton.trackers.motions.commands import MotionCommand

NOT_NEAR = UNTOUCHED | {"engaged_ticks": 0, "aligned_ticks": 0, "stop_distance": None, "stop_bearing": None}
BESIDE = UNTOUCHED | {"aligned_ticks": 0, "stop_distance": 0.9}


def judged(outcome="timeout", startup_fall=False, steps=900, task="boxing", reason="", predicates=None, **changes):
    """An ended episode."""
    ended = {"task": task, "outcome": outcome, "reason": reason, "steps": steps, "startup_fall": startup_fall}
    return SimpleNamespace(**ended, predicates=predicates or {}, signals=signals(**changes))


@pytest.mark.parametrize(
    ("stage", "outcome", "changes"),
    [
        ("perception", "timeout", NOT_NEAR),
        ("approach", "timeout", BESIDE),
        ("posture", "timeout", UNTOUCHED),
        ("posture", "fall", NOT_NEAR),
        ("posture", "fall", {"first_touch": 900 - int(BARS.first_touch) + 1}),
        ("recovery", "fall", {"first_touch": 900 - int(BARS.first_touch)}),
        ("posture", "fall", UNTOUCHED | {"tracking_error": 0.4, "reference_tilt": 1.0}),
        ("contact", "timeout", {}),
        ("contact", "timeout", {"touches": 3, "moved": 0.4, "touches_moved": 1}),
        ("recovery", "fall", {}),
        ("recovery", "timeout", {"moved": 0.4}),
        ("contact", "timeout", {"moved": 4.0, "task": "football", "reason": "ball_out"}),
        ("recovery", "timeout", {"moved": 4.0, "task": "football"}),
        ("recovery", "fall", {"moved": 4.0, "task": "football"}),
        ("contact", "timeout", {"moved": 1.0, "task": "pp_box"}),
        ("recovery", "timeout", {"moved": 1.2, "task": "pp_box"}),
        ("contact", "timeout", {"moved": 0.9, "task": "double_desk"}),
        ("recovery", "timeout", {"moved": 0.9, "task": "open_door"}),
        ("approach", "timeout", {"task": "vis_navi"}),
        ("recovery", "timeout", {"moved": 0.4, "task": "vis_navi"}),
        ("approach", "timeout", {"moved": 0.4, "task": "push_crate"}),
        ("tracking (legs)", "timeout", NOT_NEAR | {"tracking_error": 0.4, "tracking_worst": 0.6}),
        ("tracking (legs)", "fall", UNTOUCHED | {"tracking_error": 0.4, "tracking_worst": 0.6}),
    ],
)
def test_signals_name_a_stage(push_crate, stage, outcome, changes):
    """Each stage has its picture of signals, in tasks of other names by what their records declare."""
    assert stage_of(judged(outcome, **changes)) == stage


def test_only_failures_with_signals_have_a_stage():
    """A success, an error and an episode without signals have none; a fall in the start-up is the tracker's."""
    assert stage_of(judged("success")) is stage_of(judged("error")) is None
    assert stage_of(SimpleNamespace(outcome="fall", startup_fall=False, signals=None)) is None
    assert stage_of(judged("fall", startup_fall=True)) == "tracking (legs)"
    assert FailureStage("tracker") is FailureStage.TRACKING  # in folders of before


def test_a_touch_is_one_that_the_journal_knows():
    """In a task with a predicate of the touch an episode without it has touched nothing; unknown, signals say."""
    touched = {"task": "pp_box", "aligned_ticks": 300}
    assert stage_of(judged(**touched, predicates={"approach": 40, "contact": 300})) == "contact"
    assert stage_of(judged(**touched, predicates={"approach": 40, "contact": None})) == "posture"
    assert stage_of(judged(**touched)) == "contact"  # a line of schema 1
    assert stage_of(judged("fall", task="pp_box", predicates={"contact": 880})) == "posture"  # a part of the fall
    assert stage_of(judged(predicates={"contact": None})) == "contact"  # Boxing's is its success
    for task in tasks.names():
        spec = tasks.get(task).interaction
        assert not spec.predicate or spec.predicate in [one.name for one in tasks.get(task).predicates][:-1]


def test_a_touch_that_moves_nothing_has_not_reached_a_loose_object():
    """It is posture, unless the object moved, a later predicate held, or hands that are still there hide how far."""
    brushed = {"approach": 40, "contact": 300, "lift": None, "place": None}
    for task, moved in (("pp_box", 0.016), ("double_desk", 0.016), ("football", 0.0)):
        assert stage_of(judged(task=task, predicates=brushed, moved=moved)) == "posture"
        assert stage_of(judged("fall", task=task, predicates=brushed, moved=moved)) == "posture"
        assert stage_of(judged(task=task, predicates=brushed, moved=BARS.effect)) == "contact"
        assert stage_of(judged(task=task, predicates=brushed | {"place": 500}, moved=moved)) == "contact"
        assert stage_of(judged(task=task, moved=moved)) == "contact"  # a line of schema 1
    assert stage_of(judged(task="pp_box", predicates=brushed)) == "contact"  # it may be in the hands
    assert stage_of(judged(task="open_door", predicates=brushed)) == "contact"  # a lever is not loose
    assert near_bars(judged(task="football", predicates=brushed, moved=0.048)) == ("effect",)


def test_who_passes_through_the_pose_has_not_come_into_it():
    """Staying there for 60 ticks is posture; crossing it nearby is so only for who stays half the episode."""
    passes = UNTOUCHED | {"task": "open_door", "stop_distance": 0.12, "stop_bearing": 0.82}
    assert stage_of(judged(**passes | {"engaged_ticks": 161, "aligned_ticks": 1})) == "approach"
    assert stage_of(judged(**passes | {"engaged_ticks": 161, "aligned_ticks": 61})) == "posture"
    assert stage_of(judged(**passes | {"engaged_ticks": 450, "aligned_ticks": 1})) == "posture"
    strolls = passes | {"task": "football", "engaged_ticks": 161, "stop_bearing": 1.2}  # slow is a walk there
    assert stage_of(judged(**strolls | {"aligned_ticks": 68})) == "approach"
    assert stage_of(judged(**strolls | {"aligned_ticks": 105})) == "posture"


def test_one_behaviour_beside_a_bar_has_one_name():
    """A robot that stays near is held to a bar a tenth wider, and what lies within a tenth of its bar is reported."""
    stays = UNTOUCHED | {"task": "pp_box", "engaged_ticks": 1500, "stop_bearing": 0.1, "reach_distance": 0.2}
    inside = judged(**stays | {"stop_distance": 0.39, "aligned_ticks": 900})
    beside = judged(**stays | {"stop_distance": 0.47, "aligned_ticks": 0})
    away = judged(**stays | {"stop_distance": 0.60, "aligned_ticks": 0})
    assert [stage_of(one) for one in (inside, beside, away)] == ["posture", "posture", "approach"]
    assert [near_bars(one) for one in (inside, beside, away)] == [(), ("stop_distance",), ()]
    far = UNTOUCHED | {"aligned_ticks": 0, "stop_distance": 1.2, "reach_distance": 0.9}
    assert near_bars(judged(**far | {"engaged_ticks": 96})) == ("engaged_ticks",)
    assert near_bars(judged(**far | {"engaged_ticks": 80})) == () == near_bars(judged("success"))
    assert near_bars(judged(**far | {"tracking_error": 0.084})) == ("tracking_error",)
    assert near_bars(judged(**stays | {"stop_distance": 0.39, "reach_distance": 0.086})) == ("reach_distance",)


def test_waiting_in_view_is_an_ending():
    """It is shown with the stage of a robot that stays near what it sees for half of its episode, and of no other."""
    waiting = {"engaged_ticks": 450, "looks": 10, "looks_seen": 5}
    assert waits_in_view(judged(**waiting)) and stage_of(judged(**waiting)) == "contact"
    assert not waits_in_view(judged(**waiting | {"engaged_ticks": 449}))
    assert not waits_in_view(judged(**waiting | {"looks_seen": 4}))
    assert not waits_in_view(judged("fall", **waiting)) and not waits_in_view(judged("success", **waiting))


def test_a_line_holds_signals_only_if_they_were_kept():
    """The bytes of an ordinary line stay as they were; signals come back from a line as they went in."""
    plain = record(episodes("boxing", (1,))[0])
    assert plain.signals is None and "signals" not in plain.to_json()
    kept = dataclasses.replace(plain, signals=signals())
    line = json.loads(json.dumps(kept.to_json()))
    assert line["signals"] == WELL
    assert EpisodeRecord.from_json("here", line) == kept
    assert {key: line[key] for key in line if key != "signals"} == json.loads(json.dumps(plain.to_json()))


@pytest.mark.parametrize("key", WELL)
def test_unfit_signals_are_refused(key):
    """A signal that is missing, of another type or out of range is no signal."""
    line = full(episodes("boxing", (1,))[0])
    for value in ("much", [1], {}, True, -1e9, 1e300, -(10**400)):
        with pytest.raises(InputError, match="here: signals is"):
            EpisodeRecord.from_json("here", line | {"signals": WELL | {key: value}})
    with pytest.raises(InputError, match="here: signals is"):
        EpisodeRecord.from_json("here", line | {"signals": {k: v for k, v in WELL.items() if k != key}})


def rows_with(*given):
    """Journal lines of boxing with outcomes and signals."""
    rows = episodes("boxing", (0,))[: len(given)]
    return [row | {"outcome": o, "signals": WELL | s} for row, (o, s) in zip(rows, given, strict=True)]


MIXED = (
    ("success", {}),
    ("success", {"first_pixels": SEEN - 1}),
    ("timeout", NOT_NEAR | {"first_pixels": 0, "first_seen": None, "looks_seen": 0}),
    ("timeout", BESIDE),
    ("fall", {"first_touch": 20}),
)


def test_figures_count_stages_and_what_was_seen(tmp_path):
    """Stages, of them the falls, and successes apart by the first picture; errors and lines without signals are out."""
    rows = rows_with(*MIXED)
    plain = [row | {"index": 7 + n, "repeat": 10 + n} for n, row in enumerate(episodes("boxing", (2,))[:2])]
    found = [record(row) for row in [*rows, *plain, rows[0] | {"index": 9, "repeat": 9, "outcome": "error"}]]
    (cell,) = failure_cells(found)
    assert (cell["episodes"], cell["successes"]) == (5, 2)
    counted = {name: count for name, count in cell["stages"].items() if count}
    assert counted == {"perception": 1, "approach": 1, "recovery": 1}
    assert cell["falls"]["recovery"] == 1 and sum(cell["falls"].values()) == 1
    assert [(cell[key]["successes"], cell[key]["episodes"]) for key in ("seen", "unseen")] == [(1, 3), (1, 2)]
    assert failure_cells([record(row) for row in plain]) == []
    assert not sees_at_start(signals(first_pixels=SEEN - 1)) and sees_at_start(signals(first_pixels=SEEN))


def test_reports_show_stages_and_what_was_seen(tmp_path):
    """results.json, report.md and the page hold them; a folder without signals has no such part."""
    run = load_run(folder_with(tmp_path / "a", rows_with(*MIXED), 60))
    results = report.write_reports(run)
    assert json.loads((tmp_path / "a" / "results.json").read_text())["failures"] == results["failures"]
    text = (tmp_path / "a" / "report.md").read_text()
    assert "## Failures by stage" in text and "| seen at the start |" in text and " 1/3 |" in text
    page = (tmp_path / "a" / "report.html").read_text()
    assert page.count('class="stage perception"') == 2 and "1 perception, 1 approach, 1 recovery" in page
    assert '<div class="why">perception</div>' in page
    without = report.write_reports(load_run(folder_with(tmp_path / "b", episodes("boxing", (2,)), 60)))
    assert "failures" not in without
    assert "Failures by stage" not in (tmp_path / "b" / "report.html").read_text()


def test_a_swapped_run_says_what_its_swap_made(tmp_path, capsys):
    """Replays through the own tracker in the folder `own` count the failures that they solve, in every report."""
    rows, folder = rows_with(*MIXED), tmp_path / "a"
    run = load_run(folder_with(folder, rows, 60))
    assert "own_tracker" not in report.write_reports(run)["failures"][0]
    outcomes = ("timeout", "success", "success", "timeout", "error")  # of two failures one, and one that broke off
    replays = [
        row | {"tracker": "twist2", "outcome": o} for row, o in zip(episodes("boxing", (0,))[:5], outcomes, strict=True)
    ]
    folder_with(folder / OWN_FOLDER, replays, 60, tracker="twist2")
    (cell,) = report.write_reports(run)["failures"]
    assert cell["own_tracker"] == {"tracker": "twist2", "replayed": 2, "successes": 1}
    said = "1 of 2 failures succeed with the same actions through their own tracker, twist2"
    assert all(said in (folder / name).read_text() for name in ("report.md", "report.html"))


def test_the_own_tracker_plays_the_same_episodes(tmp_path, capsys):
    """The replay has the run's tasks, modes, seeds and physics; a run that has no actions is refused in a line."""
    given = {"task": ("boxing",), "tracker": ("sonic",), "seeds": (3,), "repeats": 2, "engine": "mujoco"}
    (tmp_path / "a" / "actions").mkdir(parents=True)
    document = document_of(2) | {"options": dataclasses.asdict(RunOptions(**given, failures=True))}
    (tmp_path / "a" / "config.json").write_text(json.dumps(document))
    found = own_options(tmp_path / "a", "twist2")
    assert (found.tracker, found.policy) == (("twist2",), f"replay:{tmp_path / 'a' / 'actions'}")
    assert (found.task, found.seeds, found.repeats, found.engine) == (("boxing",), (3,), 2, "mujoco")
    assert found.out == str(tmp_path / "a" / OWN_FOLDER) and not found.actions and not found.failures
    for name, changed in (("b", {"actions": False}), ("c", {"tracker": ["sonic", "pd"]})):
        (tmp_path / name / "actions").mkdir(parents=True)
        (tmp_path / name / "config.json").write_text(json.dumps(document | {"options": document["options"] | changed}))
    for name, tracker, said in (
        ("a", "sonic", "was played through it"),
        ("c", "twist2", "was played through sonic pd; name a run through one"),
        ("b", "twist2", "holds no signals or no actions; play it with --failures"),
    ):
        assert main(["report", str(tmp_path / name), "--own-tracker", tracker]) == 2
        error = capsys.readouterr().err
        assert f"error: --own-tracker {tracker}: " in error and said in error and error.count("\n") == 1


def test_readers_and_rules_agree_as_often_as_is_counted(tmp_path):
    """Agreement is counted for each pair of judges, even and odd numbers apart; an answer that is no stage is named."""
    lines = [record(row | {"index": n}) for n, row in enumerate(rows_with(*MIXED[2:]), start=1)]
    with Journal(tmp_path / "episodes.jsonl") as journal:
        for line in lines:
            journal.append(line)
    answers = "number,reader 1,reader 2\n1,perception,perception\n2,approach,posture\n3,contact,tracker\n"
    (tmp_path / "readers.csv").write_text(answers)
    judged = labelled_failures(tmp_path)
    assert judged[2].stages == ("recovery", "contact", "tracking (legs)")
    rates = {(one.judges, one.part): (one.same, one.failures) for one in agreements(judged)}
    assert rates[("rules", "reader 1"), "all"] == (2, 3) and rates[("rules", "reader 1"), "even"] == (1, 1)
    assert rates[("rules", "reader 2"), "odd"] == (1, 2) and rates[("reader 1", "reader 2"), "all"] == (1, 3)
    sheets = labelled_sheets(judged)
    assert sheets[1].rows[0] == ("perception", "1", "0", "0", "0", "0", "0") and len(sheets) == 4
    assert sheets[3].title == "real failures: reader 2 (rows) and what reader 1 says (columns)"
    assert sheets[3].rows[2] == ("posture", "0", "1", "0", "0", "0", "0")  # number 2
    (tmp_path / "readers.csv").write_text(answers.replace("posture", "posing"))
    with pytest.raises(InputError, match="number 2"):
        labelled_failures(tmp_path)
    (tmp_path / "readers.csv").write_text(answers.rsplit("3,", 1)[0])
    with pytest.raises(InputError, match="not those of"):
        labelled_failures(tmp_path)


def test_the_real_failures_are_at_hand():
    """The set that the check counts has 60 failures and more of a learned policy, several of each of five tasks."""
    kept, _ = read_journal(LABELLED / "episodes.jsonl")
    strips = Path(__file__).parents[3] / "docs" / "results" / "failures_labelled"
    assert len(labelled_failures()) == len(kept) >= 60
    assert min(Counter(line.task for line in kept).values()) >= 6 and len({line.task for line in kept}) == 5
    assert {file.stem for file in strips.glob("*.webp")} == {f"{line.index:02d}" for line in kept}
    assert all(one.rate >= LEAST for one in agreements(labelled_failures()))


def test_a_confusion_has_precision_and_recall():
    """Recall is of what was scripted, precision of what is found; what did not fail counts for neither."""
    a, b = FailureStage.APPROACH, FailureStage.CONTACT
    matrix = confusion([(a, a)] * 8 + [(a, b)] * 2 + [(b, b)] * 6 + [(b, None)] * 5)
    assert (matrix.recall(a), matrix.precision(a)) == (0.8, 1.0)
    assert (matrix.recall(b), matrix.precision(b)) == (1.0, 0.75)
    assert matrix.recall(FailureStage.TRACKING) is None and matrix.precision(FailureStage.TRACKING) is None


def played(signals_of):
    """A context of the check whose episodes of a sabotage have the signals that a function says."""

    def evaluate(cell):
        return [judged(outcome, **changes) for outcome, changes in signals_of(cell.body)]

    whole = SimpleNamespace(quick=False)
    return SimpleNamespace(tasks=("boxing", "football"), sample=("twist2",), evaluate=evaluate, options=whole)


@pytest.fixture
def agreed(monkeypatch):
    """Real failures on which readers and rules agree."""
    same = [LabelledFailure(number, (FailureStage.CONTACT,) * 3) for number in range(1, 11)]
    monkeypatch.setattr("arena_newton.eval.certification.checks.failures.labelled_failures", lambda: same)
    return same


OF = {
    "blinded": [("timeout", NOT_NEAR)],
    "misaimed": [("timeout", BESIDE)],
    "unbalanced": [("fall", UNTOUCHED)],
    "reluctant": [("timeout", UNTOUCHED)],
    "clumsy": [("timeout", {})],
    "stubborn": [("timeout", {"moved": 1.5})],
    "weakened": [("timeout", NOT_NEAR | {"tracking_error": 0.5, "tracking_worst": 0.7})],
}


def test_the_check_fails_below_the_bar(capsys, monkeypatch, agreed):
    """Scripted failures with their stages pass; one kind that is mostly taken for another fails and is named."""
    without_signals(monkeypatch, "football")
    assert set(OF) == set(SABOTAGES)
    assert {SABOTAGES[name].stage for name in OF} == set(FailureStage)
    good = failures(played(lambda body: OF[body] * 5))
    assert good.verdict == "pass" and good.summary.startswith("30 of 30")
    assert "| perception      |                5 |" in capsys.readouterr().out
    assert good.sheets[0].rows[0] == ("perception", "5", "0", "0", "0", "0", "0", "1.00", "1.00")
    assert any("football" in note for note in good.notes)
    one = failures(played(lambda body: OF[body] * 5 + OF["clumsy"] * (body == "misaimed")))
    assert one.verdict == "pass" and one.summary.startswith("30 of 31")
    bad = failures(played(lambda body: OF["misaimed" if body == "blinded" else body] * 5))
    assert bad.verdict == "fail" and f"expected at least {LEAST:g}" in bad.notes[0]
    for times, verdict in ((1, "note"), (5, "fail")):  # 3 of 4 may well be 4 of 5, 15 of 20 are counted
        few = failures(played(lambda body, n=times: n * (OF[body] * 3 + OF["clumsy" if body == "misaimed" else body])))
        assert few.verdict == verdict and f"recall of approach is {3 * times} of {4 * times}" in few.notes[0]
        assert ("too few episodes" in few.notes[0]) is (verdict == "note")
    assert any("recall of perception" in note for note in bad.notes)
    apart = (FailureStage.CONTACT, FailureStage.POSTURE, FailureStage.CONTACT)
    agreed[0:6:2] = [LabelledFailure(number, apart) for number in (1, 3, 5)]
    unlike = failures(played(lambda body: OF[body] * 5))
    assert unlike.verdict == "fail" and "rules and reader 1 agree on 7 of 10 (all numbers)" in " ".join(unlike.notes)
    assert "1.00 rules with reader 2" in unlike.summary


def test_the_check_plays_episodes_that_nothing_was_set_on(push_crate, agreed):
    """Its group seeds lie above all that were looked at, whatever their number, and a note says both."""
    cells = []

    def evaluate(cell):
        cells.append(cell)
        return [judged(outcome, **changes) for outcome, changes in OF[cell.body] * 5]

    context = vars(played(None)) | {"tasks": tasks.names(), "evaluate": evaluate}
    found = failures(SimpleNamespace(**context))
    scripted = [(task, name) for task in tasks.names() for name, one in SABOTAGES.items() if one.fits(task)]
    reached = [task for task in tasks.names() if (task, "clumsy") not in scripted]
    assert reached == ["vis_navi", push_crate]
    assert [(cell.task, cell.body) for cell in cells] == scripted
    said = f"push_crate: played from group seed {HELD_OUT} on; thresholds and saboteurs were set on none"
    assert said in " ".join(found.notes)
    for task, looked_at in TUNED.items():
        assert max(looked_at) < HELD_OUT
        said = f"{task}: played from group seed {HELD_OUT} on; thresholds and saboteurs were set on "
        assert said + " ".join(map(str, looked_at)) in found.notes
    assert {(cell.task, cell.first_seed) for cell in cells} == {(task, HELD_OUT) for task in tasks.names()}


@pytest.mark.parametrize(("count", "seeds"), [(4, 1), (20, 1), (60, 3)])
def test_a_cell_may_begin_at_another_group_seed(tmp_path, count, seeds):
    """Seeds and repeats are as many as from 0 on; the folder is another one, and the protocol's keeps its name."""
    context = Context(CertifyOptions(episodes=count), tmp_path, ("boxing",), print)
    (first, repeats), (later, same) = context.plan(), context.plan(HELD_OUT)
    assert repeats == same and len(first) == seeds
    assert later == tuple(HELD_OUT + seed for seed in first)
    assert CertifyCell("boxing", "twist2", first_seed=HELD_OUT).folder == f"boxing/twist2_paper_base_from-{HELD_OUT}"
    assert CertifyCell("boxing", "twist2").folder == "boxing/twist2_paper_base"


def test_tasks_without_signals_are_refused(capsys, monkeypatch):
    """--failures says of which tasks there are none, and plays nothing."""
    without_signals(monkeypatch, "football")
    assert main(["run", "--failures", "--task", "football", "boxing", "--out", "nowhere"]) == 2
    error = capsys.readouterr().err
    assert "--failures: no signals are defined for football" in error and error.count("\n") == 1


SEEDS = [seeding.episode_seed(tasks.get("boxing").gym_id, 0, repeat) for repeat in range(2)]


@pytest.fixture(scope="module")
def boxing():
    """Two worlds of boxing."""
    return ArenaEnv("boxing", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", threads=1)


def test_signals_follow_the_episode_and_leave_it_alone(boxing):
    """Distances, looks and tracking are those of the episode, and no bit of it depends on whether they are kept."""
    planned = [SimpleNamespace(index=n, episode_seed=seed) for n, seed in enumerate(SEEDS)]
    kept, traces = SignalRecorder(boxing), (StateTrace(), StateTrace())
    for recorder in ([traces[0]], [traces[1], kept]):
        Rollout(boxing, ExpertPolicy(), planned, recorder=recorder, max_steps=80).run()
    for one, other in zip(traces[0].traces.values(), traces[1].traces.values(), strict=True):
        assert first_difference(one, other) is None
    found = [kept.taken(n) for n in range(2)]
    assert kept.taken(0) is None
    for one in found:
        assert one.looks == 4 and one.touches == 0 and one.first_touch is None
        assert 0.2 < one.start_distance - one.nearest_distance < 1.5
        assert 0.005 < one.tracking_error < 0.15 and 0.005 < one.tracking_worst < 0.15
        assert 0.7 < one.height_min < 0.81 and 0.5 < one.posture_margin < np.radians(60)
        assert EpisodeRecord.from_json("x", full(episodes("boxing", (1,))[0]) | {"signals": dataclasses.asdict(one)})


def test_a_misled_sight_displaces_what_it_says(boxing):
    """Robot, hands and object are believed where the displacements say, and nothing else moves."""
    boxing.reset(SEEDS)
    truth, misled = ExpertPolicy(), ExpertPolicy(MisledSight)
    truth.attach(boxing)
    misled.attach(boxing)
    target, palm = boxing.spec.interaction.box, boxing.spec.interaction.effectors[0]
    readers = [(one.sight.frame(target), one.sight.frame(palm)) for one in (truth, misled)]
    off = misled.sight.object_off.new_tensor([0.1, 0.2, 0.3])
    misled.sight.object_off += off
    moved = [after() - before() for before, after in zip(*readers, strict=True)]
    assert moved[0].numpy() == pytest.approx(np.tile(off, (2, 1)), abs=1e-6) and not moved[1].any()
    misled.sight.hands_off += off
    misled.sight.robot_off += off
    assert (readers[1][1]() - readers[0][1]()).numpy() == pytest.approx(np.tile(2 * off, (2, 1)), abs=1e-6)
    pose = (misled.sight.pose - truth.sight.pose).numpy()
    assert pose == pytest.approx(np.tile([0.1, 0.2, 0.0], (2, 1)), abs=1e-6)


@pytest.fixture(scope="module")
def football():
    """One world of football with a short start-up, in which the ball is moved at its touch."""
    env = RelocatingEnv("football", tracker=trackers.get("twist2"), worlds=1, engine="mujoco", threads=1)
    env.startup_ticks = 5
    return env


def test_a_ball_is_touched_with_the_toe_and_moved_as_a_free_body(football):
    """Reach is from the tip of the shoe to the ball's box; a ball that is put elsewhere lies still there."""
    env = football
    env.reset([SEEDS[0]])
    view, ball = env.view, env.scene.joint_qpos(BALL)
    data, gaps = env.physics.data[0], []
    for link in env.spec.interaction.effectors:
        body = env.scene.link(link)
        toe = data.xpos[body] + data.xmat[body].reshape(3, 3) @ TOE
        gaps.append(np.linalg.norm((np.abs(toe - view.centre[0].numpy()) - view.box.half).clip(0.0)))
    assert env.movable and len(gaps) == 2
    assert float(view.reach[0]) == pytest.approx(min(gaps), abs=1e-4)
    stand = env.loop.action.numpy().copy()
    stand[:, 2], stand[:, 3], stand[:, 6] = 0.8, 1.0, 1.0
    while env.tick.min() < 1:
        env.step(stand)
    kept, view.spec = view.spec, dataclasses.replace(view.spec, touch=10.0)
    before = data.qpos[ball : ball + 3].copy()
    for _ in range(3):
        env.step(stand)
    gone = data.qpos[ball : ball + 3] - before
    assert gone == pytest.approx(env.relocated[0].numpy(), abs=1e-3) and np.linalg.norm(gone) > 1.0
    view.spec = kept


def test_a_reluctant_expert_halts_behind_the_ball(football):
    """It slows down towards the ball and stands from then on, also where it drifts back; a new episode walks again."""
    env = football
    env.reset([SEEDS[0]])
    policy = SABOTAGES["reluctant"].body.equip(Factories()).policy("expert")
    policy.attach(env)
    walking = MotionCommand.neutral(1, env.torch_device)
    walking.velocity[:, 0] = 0.5
    view, speeds = policy.sight.view, []
    for gap in (2.0, HALTS[0] + 0.5 * HALTS[1], HALTS[0] - 0.01, HALTS[0] + 0.2):
        x, y = view.centre[0, 0], view.centre[0, 1] - view.box.half[1] - gap
        view.root[0] = view.root.new_tensor([x, y, 0.8, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
        speeds.append(float(policy.overrule(walking).velocity[0, 0]))
    assert speeds == pytest.approx([0.5, 0.25, 0.0, 0.0], abs=0.02)
    policy.reset([SEEDS[1]], ["football"])
    assert float(policy.overrule(walking).velocity[0, 0]) > 0.1
    policy.sight.goal_off += policy.sight.goal_off.new_tensor([5.0, 0.0, 0.0])
    believed, true = policy.sight.frame(GOAL)(), Sight(env).frame(GOAL)()
    assert (believed - true).numpy() == pytest.approx(np.array([[5.0, 0.0, 0.0]]), abs=1e-6)


@pytest.fixture(scope="module")
def sofa():
    """One world of sit_sofa."""
    return ArenaEnv("sit_sofa", tracker=trackers.get("twist2"), worlds=1, engine="mujoco", threads=1)


def test_a_seat_lies_behind_who_turns_the_back_to_it(sofa):
    """The bearing is the angle between the back and the nearest point of the seat, however wide it is."""
    sofa.reset([SEEDS[0]])
    view = InteractionView(sofa)
    middle, half = view.centre[0], view.box.half
    for aside, turned, expected in ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (-0.6, 0.4, 0.4), (0.0, np.pi, np.pi)):
        yaw = 0.5 * np.pi + turned
        view.root[0] = view.root.new_tensor(
            [middle[0] + aside, middle[1] + half[1] + 0.3, 0.8, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        )
        assert float(view.bearing[0]) == pytest.approx(expected, abs=1e-4)
        assert float(view.distance[0]) == pytest.approx(0.3, abs=1e-4)


def test_a_misled_expert_sits_down_nowhere_or_without_weight(sofa):
    """Beside the seat, or reluctant before it, it does not sit down; without weight, it does not go all the way."""
    sofa.reset([SEEDS[0]])
    command = MotionCommand.neutral(1, sofa.torch_device)
    sitting = dataclasses.replace(command, height=command.height * 0.0 + 0.51, pelvis_back=command.height * 0.0 + 0.34)
    heights = {}
    for name in ("blinded", "misaimed", "reluctant", "clumsy", "stubborn", "unbalanced"):
        policy = SABOTAGES[name].body.equip(Factories()).policy("expert")
        policy.attach(sofa)
        policy.reset([SEEDS[0]], ["sit_sofa"])
        heights[name] = float(policy.overrule(sitting).height[0])
    neutral = float(command.height[0])
    assert {heights[name] for name in ("blinded", "misaimed", "reluctant")} == {neutral}
    assert heights["unbalanced"] == pytest.approx(0.51)
    assert PERCHED[0] <= heights["clumsy"] == heights["stubborn"] <= PERCHED[1]


def test_saboteurs_play_more_episodes_than_worlds():
    """Changes of a saboteur in a world's episode are forgotten in its next one."""
    env = ArenaEnv("boxing", tracker=trackers.get("twist2"), worlds=1, engine="mujoco", threads=1)
    planned = [SimpleNamespace(index=n, episode_seed=seed) for n, seed in enumerate(SEEDS)]
    expert = SABOTAGES["misaimed"].body.equip(Factories()).policy("expert")
    kept, env.startup_ticks = SignalRecorder(env), 5
    Rollout(env, expert, planned, recorder=kept, max_steps=12).run()
    assert kept.taken(0) is not None and kept.taken(1) is not None
    env.close()


def test_a_weak_tracker_does_a_part_of_its_legs():
    """Legs go a part of their way from the default pose; waist and arms go all of it."""

    class Seven(trackers.Tracker):
        def step(self, command, state):
            return torch.full((2, 29), 7.0)

    weak = WeakTracker(Seven(), 0.25)
    weak.bind(2)
    targets = weak.step(None, None)
    rest = np.array([DEFAULT_POSE[i] for i in LEGS])
    assert targets[0, list(LEGS)].numpy() == pytest.approx(rest + 0.25 * (7.0 - rest))
    assert (targets[:, len(LEGS) :] == 7.0).all()


def test_an_object_is_moved_at_its_first_touch():
    """The object leaves the touching hand's world alone, once, and comes back at the reset."""
    env = RelocatingEnv("boxing", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", threads=1)
    env.startup_ticks = 5
    env.reset(SEEDS)
    before = env.view.centre.clone()
    env.view.spec = dataclasses.replace(env.view.spec, touch=0.0)
    stand = np.tile(env.loop.action.numpy(), (1, 1))
    stand[:, 2], stand[:, 3], stand[:, 6] = 0.8, 1.0, 1.0
    while env.tick.min() < 1:
        env.step(stand)
    assert (env.view.centre == before).all()
    near = float(env.view.reach[0])
    env.view.spec = dataclasses.replace(env.view.spec, touch=near + 0.05)
    for _ in range(3):
        env.step(stand)
    gone = (env.view.centre - before).norm(dim=1)
    assert gone[0] > 1.0 and float(env.relocated[0].norm()) == pytest.approx(float(gone[0]), abs=1e-5)
    env.reset(SEEDS)
    assert (env.view.centre == before).all() and not env.relocated.any()
    env.close()
