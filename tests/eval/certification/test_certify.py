"""`eval certify` as a command: verdicts become lines, a page and an exit code, and a stopped one goes on."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import LEAP, SLOW, FakeEnv, FakePolicy, factories, fake_tracker

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.certification import certificate, certify, certify_options, claims
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import legs, solvable, swap
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Picture
from arena_newton.eval.certification.stand_ins.bodies import Body
from arena_newton.eval.play import run as runs
from arena_newton.eval.records.journal import ContradictionError
from arena_newton.eval.statistics.stats import mcnemar
from arena_newton.interfaces import Verdict
from arena_newton.kernels import tick as codes
from arena_newton.pages.tables import Table


class SolvedEnv(FakeEnv):
    """Every episode succeeds after five ticks, but not under a replay through another tracker than the recording's."""

    built = 0
    lost = swapped = False

    def __init__(self, task, **options):
        super().__init__(task, **options)
        type(self).built += 1

    def verdict(self, world):
        return Verdict(margin=-1.0 if self.lost or self.swapped else 1.0)

    def step(self, action, worlds=None):
        leapt = (self.tick // LEAP + 1) * LEAP
        self.tick[self.active] = np.where(self.tick < SLOW, self.tick + 1, leapt)[self.active]
        over = self.active & (self.tick > 5) & (not (self.lost or self.swapped))
        return np.where(over, codes.SUCCESS, codes.RUNNING).astype(np.int32)


class StuckEnv(SolvedEnv):
    """No episode succeeds."""

    lost = True


class SwappedPolicy(FakePolicy):
    """Tells the worlds whether it replays what was recorded through another tracker."""

    def attach(self, env):
        recorded = re.search(r"replay:.*/(\w+?)_(paper|released)", self.name)
        SolvedEnv.swapped = recorded is not None and recorded[1] != env.tracker.name


def bodies(**envs):
    """Robots of the checks of legs, by the worlds that stand in for them."""
    equip = {name: lambda given, env=env: factories(env=env, policy=given.policy) for name, env in envs.items()}
    return {name: Body(name, name, equip.get(name, lambda given: given)) for name in ("robot", "frozen", "gliding")}


PARTS = {"env": SolvedEnv, "policy": SwappedPolicy}
LEGS = bodies(frozen=StuckEnv, gliding=StuckEnv)
CHECKS = (*solvable.CHECKS, *legs.CHECKS, *swap.CHECKS)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """These worlds have nothing to draw, and eight episodes of a swap are enough."""
    monkeypatch.setattr(runs, "_recorder", lambda *_: None)
    monkeypatch.setattr(swap, "ENOUGH", 8)


def options(folder, **changes):
    """Flags of a small certification."""
    given = {"out": str(folder), "task": ("boxing", "vis_navi"), "quick": True, "episodes": 4}
    return CertifyOptions(**(given | changes))


def read(folder):
    """The certificate's verdicts and tables."""
    return json.loads((folder / "certify.json").read_text())["checks"]


def test_a_sound_benchmark_passes(tmp_path, capsys):
    """Solvable tasks that need legs and a swap that costs success: a line each, pages, exit code 0."""
    assert certify.run(options(tmp_path / "o"), factories(**PARTS), bodies=LEGS, checks=CHECKS) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in ("solvable", "frozen-legs", "gliding-base", "swap"):
        assert any(re.match(rf"pass  {name} ", line) for line in lines), name
    assert lines[0].startswith("--quick: 4 episodes") and "intervals are wide" in lines[0]
    assert "Certified: 3 claims hold." in lines and any(
        line.startswith("pass  Experts need their legs") for line in lines
    )
    checks = read(tmp_path / "o")
    assert [row[:4] for row in checks["solvable"]["tables"][0]["rows"]] == [
        [task, tracker, rules, "4/4"]
        for tracker, rules in (("twist2", "paper"), ("sonic", "paper"))
        for task in ("boxing", "vis_navi")
    ]
    swapped = {tuple(row[:3]): row[3:] for row in checks["swap"]["tables"][0]["rows"]}
    assert swapped["all", "twist2", "sonic"] == ["8/8", "0/8", "0 % to 32 %", "", "-100", "0 %"]
    assert f"twist2 to sonic keeps 0 % (p = {mcnemar(8, 0):.2g})" in checks["swap"]["summary"]
    for name in ("certify.html", "certify.md"):
        page = (tmp_path / "o" / name).read_text()
        assert "gliding-base" in page and "privileged: they read the world itself" in page
    journal = tmp_path / "o" / "runs" / "boxing" / "twist2_paper_base" / "episodes.jsonl"
    assert json.loads(journal.read_text().splitlines()[0])["privileged"] is True


@pytest.mark.parametrize(
    ("envs", "name", "verdict", "said"),
    [
        ({"frozen": SolvedEnv, "gliding": StuckEnv}, "frozen-legs", "fail", "boxing: 4 successes with frozen legs"),
        ({"frozen": StuckEnv, "gliding": SolvedEnv}, "gliding-base", "note", "the arms alone reach down to it"),
    ],
)
def test_tasks_that_need_no_legs_are_named(tmp_path, envs, name, verdict, said):
    """Success with frozen legs fails the benchmark; of a gliding base the reason is given where it is known."""
    code = certify.run(options(tmp_path), factories(**PARTS), bodies=bodies(**envs), checks=legs.CHECKS)
    assert code == (verdict == "fail")
    found = read(tmp_path)[name]
    claim = json.loads((tmp_path / "certify.json").read_text())["claims"][0]["claim"]
    assert ("a gliding base solves 2 of 2 tasks" in claim) == (verdict == "note")
    assert found["verdict"] == verdict and any(said in note for note in found["notes"])


def test_a_gliding_base_without_a_known_reason_fails(tmp_path, monkeypatch):
    """A task that a gliding base solves and that no sentence explains fails the benchmark."""
    monkeypatch.setattr("arena_newton.tasks.boxing.TASK", dataclasses.replace(tasks.get("boxing"), without_legs=""))
    given = options(tmp_path, checks=("gliding-base",))
    assert certify.run(given, factories(**PARTS), bodies=bodies(gliding=SolvedEnv), checks=CHECKS) == 1
    assert "boxing, 4 successes: no reason is known" in " ".join(read(tmp_path)["gliding-base"]["notes"])


def test_unsolved_tasks_fail(tmp_path, capsys):
    """An expert that is significantly below nine of ten fails the benchmark, and the line names it."""
    given = options(tmp_path, checks=("solvable",), task=("boxing",), tracker=("twist2",), episodes=12)
    assert certify.run(given, factories(), checks=CHECKS) == 1
    assert "1 of 1 checks failed: solvable" in capsys.readouterr().out
    assert "below that are boxing through twist2" in read(tmp_path)["solvable"]["notes"][0]


def test_a_swap_that_costs_nothing_is_told_apart_from_one_with_few_episodes(tmp_path):
    """Replays that succeed fail the check if there were enough episodes; with few of them it is a note."""
    parts = {"env": SolvedEnv}  # a policy that does not tell: replays succeed as recordings do
    few, many = options(tmp_path / "a", episodes=2), options(tmp_path / "b")
    assert certify.run(few, factories(**parts), checks=swap.CHECKS) == 0
    assert read(tmp_path / "a")["swap"]["verdict"] == "note"
    assert certify.run(many, factories(**parts), checks=swap.CHECKS) == 1


def test_the_control_of_the_swap(tmp_path):
    """Each recording is replayed through its own tracker too, under --quick some; one that ends otherwise fails."""
    given = {"quick": False, "task": ("boxing",), "checks": ("swap",), "episodes": 4}

    class Forgetful(SwappedPolicy):
        def attach(self, env):
            SolvedEnv.swapped = self.name.startswith("replay:")

    assert certify.run(options(tmp_path / "a", **given), factories(**PARTS), checks=CHECKS) == 0
    rows = {tuple(row[:3]): row[3:5] for row in read(tmp_path / "a")["swap"]["tables"][0]["rows"]}
    assert rows["boxing", "twist2", "twist2"] == rows["boxing", "sonic", "sonic"] == ["4/4", "4/4"]
    assert rows["boxing", "twist2", "sonic"] == ["4/4", "0/4"]
    parts = PARTS | {"policy": Forgetful}
    assert certify.run(options(tmp_path / "b", **given), factories(**parts), checks=CHECKS) == 1
    said = "ends otherwise: boxing through twist2 under paper, seed 0 repeat 0: outcome success, in the replay timeout"
    assert said in read(tmp_path / "b")["swap"]["notes"][0]
    quick = given | {"quick": True, "episodes": 2}
    assert certify.run(options(tmp_path / "c", **quick), factories(**parts), checks=CHECKS) == 1
    solved = options(tmp_path / "d", **quick | {"checks": ("solvable",)})
    assert certify.run(solved, factories(**parts), checks=CHECKS) == 1
    assert "not by their actions alone: boxing through twist2" in read(tmp_path / "d")["solvable"]["summary"]


def test_it_goes_on_where_it_was(tmp_path, capsys):
    """Nothing that was played is played again; without --resume a folder is not touched."""
    given = options(tmp_path, checks=("solvable",))
    assert certify.run(given, factories(**PARTS), checks=CHECKS) == 0
    before, built = (tmp_path / "certify.json").read_text(), SolvedEnv.built
    with pytest.raises(InputError, match="go on with it by --resume"):
        certify.run(given, factories(**PARTS), checks=CHECKS)
    assert certify.run(options(tmp_path, checks=("solvable",), resume=True), factories(**PARTS), checks=CHECKS) == 0
    assert SolvedEnv.built == built and (tmp_path / "certify.json").read_text() == before
    with pytest.raises(InputError, match="another configuration: repeats was 4, now 3"):
        certify.run(options(tmp_path, episodes=3, resume=True), factories(**PARTS), checks=CHECKS)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--task", "golf"], "task golf"),
        (["--task", "boxing", "boxing"], "--task boxing: given twice"),
        (["--tracker", "nobody"], "--tracker nobody"),
        (["--tracker", "twist2", "twist2"], "--tracker twist2: given twice"),
        (["--checks", "everything"], "--checks everything: unknown, choose from journal"),
        (["--episodes", "0"], "--episodes 0"),
        (["--worlds", "0"], "--worlds 0"),
        (["--engine", "bullet"], "--engine bullet"),
        (["--twist2-checkpoint", "absent.onnx"], "--twist2-checkpoint absent.onnx: no such file"),
        (["--twist2-checkpoint", "full/diary.txt"], "--twist2-checkpoint full/diary.txt: --tracker twist2 reads .onnx"),
        (["--twist2-checkpoint", "full"], "--twist2-checkpoint full: "),
        (["--checks", "--quick"], "--checks: cannot read it without a value"),
        (["--quick", "--task"], "--task: cannot read it without a value"),
        (["--out", ""], "--out: is empty"),
        (["--out", "full"], "--out full: is not empty and holds no certification"),
        (["--quik"], "--quik: unknown argument, did you mean --quick"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, flags, message):
    """Wrong input ends with code 2 and one line before anything is measured."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "diary.txt").write_text("mine")
    assert main(["certify", *flags]) == 2
    assert re.fullmatch(rf"error: .*{re.escape(message)}.*\n", capsys.readouterr().err)
    assert not (tmp_path / "results").exists()


def test_a_window_is_refused_by_name(tmp_path):
    """Recorded actions do not hold what a look-ahead tracker reads: it is refused, not accused of unequal replays."""

    def seeing(spec, checkpoint):
        made = fake_tracker(spec, checkpoint)
        made.lookahead = 2 if spec == "sonic" else 0
        return made

    with pytest.raises(InputError, match="--tracker sonic: reads the coming reference, which recorded actions do not"):
        certify.run(options(tmp_path), factories(**PARTS, tracker=seeing), checks=CHECKS)
    assert not (tmp_path / "runs").exists()


def test_an_interrupt_says_how_to_go_on(tmp_path, capsys):
    """Ctrl-C leaves what was played and the command that continues it."""

    def interrupted(context):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        certify.run(options(tmp_path), factories(**PARTS), checks=(Check("late", "?", interrupted),))
    assert re.search(r"what was played is kept; go on by python -m .* --resume$", capsys.readouterr().err.strip())


def test_a_line_that_contradicts_itself_fails_by_name(tmp_path, capsys):
    """A check that reads a journal with such a line fails; the others still run."""

    def read_one(context):
        raise ContradictionError(f"{context.folder}/runs/episodes.jsonl: episode 0: a success with a margin of -1")

    found = (Check("edited", "?", read_one), Check("later", "?", lambda context: CheckFinding("pass", "ran")))
    assert certify.run(options(tmp_path), factories(**PARTS), checks=found) == 1
    said = capsys.readouterr().out
    assert (
        "fail  edited        runs/episodes.jsonl: episode 0: a success with a margin" in said and "pass  later" in said
    )


def test_a_certification_of_nothing_is_no_success(tmp_path, capsys):
    """A certification whose checks are all skipped does not end well."""
    assert main(["certify", "--checks", "official", "--task", "boxing", "--out", str(tmp_path / "c")]) == 1
    said = capsys.readouterr().out
    assert "nothing was measured; this took" in said and "no check failed" not in said


@pytest.mark.parametrize("text", ["[]", "null", '{"known_by": "KNOWN", "value": {}}', '{"known_by": "KNOWN", "di', ""])
def test_a_damaged_measurement_is_measured_again(tmp_path, text):
    """A kept measurement counts only as it was written."""
    context = Context(options(tmp_path), tmp_path, ("boxing",), lambda _: None)
    measured, counts = [{"ticks": 3}, {"ticks": 4}], iter(range(2))

    def look():
        return context.measured("ticks", "boxing", "twist2", {}, lambda: measured[next(counts)])

    assert look() == look() == measured[0]
    (file,) = (tmp_path / "measured").iterdir()
    file.write_text(text.replace("KNOWN", json.loads(file.read_text())["known_by"]))
    assert look() == measured[1]


FACTS = {
    "tasks": ["boxing"],
    "without_expert": [],
    "trackers": ["twist2"],
    "episodes": 4,
    "quick": True,
    "engine": "mujoco",
    "device": "cpu",
    "code": "0" * 12,
    "planned": ["legs", "swap"],
    "command": "python -m arena_newton.eval certify --quick",
    "cores": 2,
    "versions": {"python": "3.12", "arena-newton": "1.2.3"},
}


def test_evidence_is_in_pages_that_can_be_read():
    """Rows that differ in task, tracker or rules alone are one; a page has at most 250 lines, and claims lead to it."""
    rows = [(task, tracker, "20/20") for tracker in ("twist2", "sonic") for task in ("boxing", "vis_navi")]
    sheet = Table(("task", "tracker", "successes"), [*rows, ("football", "sonic", "19/20")])
    long = Table(("number",), [(number,) for number in range(100)])
    findings = {Check(n, "?", print): CheckFinding("pass", "x", (sheet, long)) for n in ("solvable", "swap", "sill")}
    pages = certificate.markdown(FACTS, findings)
    assert list(pages) == ["certify.md", "certify_1.md", "certify_2.md"]
    assert all(page.count("\n") <= 250 for page in pages.values())
    for check, number in (("solvable", 1), ("swap", 1), ("sill", 2)):
        assert f"(certify_{number}.md#{check}-pass)" in pages["certify.md"]
        assert f"## {check}: pass" in pages[f"certify_{number}.md"]
    assert "| boxing, vis_navi | twist2, sonic | 20/20 |\n| football | sonic | 19/20 |" in pages["certify_2.md"]


def test_the_page_needs_no_other_file(tmp_path):
    """Pictures are inside, texts stay texts, and what is missing is named."""
    picture = tmp_path / "strip.png"
    picture.write_bytes(b"\x89PNG")
    check = Check("legs", "Are <legs> needed?", lambda context: found)
    found = CheckFinding(
        "note",
        "three of four",
        (Table(("task",), (("<script>alert(1)</script>",),), title="A table"),),
        ("a | note",),
        (Picture('a "picture"', picture),),
    )
    certificate.write(tmp_path, FACTS, {check: found})
    page = (tmp_path / "certify.html").read_text()
    addresses = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in addresses)
    assert "data:image/png;base64," in page and "<script>" not in page and "&lt;script&gt;" in page
    assert "1 of 2 checks have not run" in page and "intervals are wide" in page and "not asked for: journal" in page
    assert page.index("Not finished") < page.index('id="claims"') < page.index("2 CPU cores") < page.index("A table")
    text, evidence = ((tmp_path / name).read_text() for name in ("certify.md", "certify_1.md"))
    assert r"a \| note" in evidence and "data:" not in text + evidence
    assert "[legs](certify_1.md#legs-note): three of four" in text and "## legs: note" in evidence
    stored = json.loads((tmp_path / "certify.json").read_text())
    assert not stored["complete"] and stored["checks"]["legs"]["pictures"][0]["path"] == "strip.png"


def test_every_check_shows_a_claim():
    """Each check is named by one claim, and the page has claims in their order, with the worst of their verdicts."""
    named = [name for claim in claims.CLAIMS for name in claim.checks]
    assert sorted(named) == sorted(check.name for check in certify.CHECKS)
    verdicts = {
        "sill": "note",
        "batches": "pass",
        "ray": "skip",
        "shards": "fail",
        "engines": "skip",
        "solvable": "pass",
    }
    findings = {check: CheckFinding(verdicts[check.name], "x") for check in certify.CHECKS if check.name in verdicts}
    found = claims.claimed(findings)
    assert [one.verdict for one in found] == ["pass", "fail", "skip", "note"]
    assert [check.name for check, _ in found[1].findings] == ["batches", "shards", "ray"]
    said = claims.verdict_of(findings, planned=6)
    assert said == (
        "Not certified (shards): 1 claim does not hold, 1 claim holds, 1 claim holds with what its notes say, "
        "1 claim was not measured."
    )
    good = {check: finding for check, finding in findings.items() if finding.verdict == "pass"}
    assert claims.verdict_of(good, planned=2) == "Certified: 2 claims hold."
    assert claims.verdict_of(good, planned=3).startswith("Not finished, 1 of 3 checks have not run: 2 claims hold")
    skip = {check: finding for check, finding in findings.items() if finding.verdict == "skip"}
    assert claims.verdict_of(skip, planned=2) == "Nothing was certified: 2 claims were not measured."


def test_names_in_the_help_are_the_checks():
    """The flag's text lists every check, in their order."""
    text = Path(certify_options.__file__).read_text()
    named = re.search(r"Names of checks to run: ([\w\s-]+?); all", text)[1].split()
    assert named == [check.name for check in certify.CHECKS]
