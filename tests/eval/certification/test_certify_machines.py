"""Checks of who plays a plan: shards, and a cluster that loses a process; each finds what it is there to find."""

import json
import shutil
import subprocess
import sys
import threading

import pytest
from eval_fakes import factories

from arena_newton.errors import InputError
from arena_newton.eval.certification import certify
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import machines
from arena_newton.eval.certification.checks.same_files import contents
from arena_newton.eval.workers.shard_merge import merge
from tests.patience import wait_for


def certified(folder, check, **changes):
    """Exit code and finding of a quick certification by one check."""
    given = {"out": str(folder), "task": ("football", "boxing"), "quick": True, "checks": (check,)} | changes
    code = certify.run(CertifyOptions(**given), factories())
    return code, json.loads((folder / "certify.json").read_text())["checks"][check]


@pytest.fixture
def by_copy(monkeypatch):
    """Lets a run by a cluster be a copy of that of one process, changed by a function of its folder."""
    monkeypatch.setattr(machines, "require", lambda *_: None)

    def use(change, **facts):
        def play(plan, folder):
            shutil.copytree(plan.out, folder)
            lines = (folder / "episodes.jsonl").read_text().splitlines(keepends=True)
            (folder / "episodes.jsonl").write_text("".join(lines[::-1]))  # as episodes happen to end
            change(folder)
            return machines.RayRun(**({"code": 0, "killed_after": 1, "lost": 1, "last_line": "report"} | facts))

        monkeypatch.setattr(machines, "play_by_ray", play)

    return use


def edit(path, old, new):
    """Replace a text of a file, which must be there."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_shards_of_a_plan_are_one_run(tmp_path):
    """All files of three merged shards are those of one process; a second time nothing is played."""
    code, found = certified(tmp_path, "shards")
    assert code == 0 and found["verdict"] == "pass"
    assert found["summary"] == "23 of 23 files of 3 merged shards (6 episodes) are those of one process, byte for byte"
    rows = {row[0]: row[1:] for row in found["tables"][0]["rows"]}
    assert {"config.json", "episodes.jsonl", "results.json", "table.md", "report.html"} <= set(rows)
    assert all(one == other for one, other in rows.values()) and len(set(map(tuple, rows.values()))) == len(rows)
    before = (tmp_path / "certify.json").read_text()
    assert certified(tmp_path, "shards", resume=True)[0] == 0
    assert (tmp_path / "certify.json").read_text() == before
    (tmp_path / "measured" / "shards.json").unlink()
    edit(tmp_path / "runs" / "plan" / "alone" / "report.html", "</h1>", " of an older version</h1>")
    assert certified(tmp_path, "shards", resume=True)[0] == 0


@pytest.mark.parametrize("name", ["episodes.jsonl", "results.json"])
def test_a_merge_that_loses_a_line_fails(tmp_path, monkeypatch, name):
    """A merged journal without its last line, or a table with another number, is found and named."""

    def lossy(folders, out, **options):
        merge(folders, out, **options)
        if name == "episodes.jsonl":
            (out / name).write_text("".join((out / name).read_text().splitlines(keepends=True)[:-1]))
        else:
            edit(out / name, '"mean_steps": ', '"mean_steps": 9')

    monkeypatch.setattr(machines.shard_merge, "merge", lossy)
    code, found = certified(tmp_path, "shards")
    assert code == 1 and found["notes"] == [f"{name} differs"] and found["summary"].startswith("22 of 23 files")


def test_shards_that_are_not_merged_fail(tmp_path, monkeypatch):
    """A merge that is refused is the finding, not a complaint about flags."""

    def refuse(*_, **__):
        raise InputError("episode 3 differs")

    monkeypatch.setattr(machines.shard_merge, "merge", refuse)
    assert certified(tmp_path, "shards") == (1, {**certified_refusal(), "question": machines.CHECKS[0].question})


def certified_refusal():
    """Text that is written of it."""
    said = "shards are not merged: episode 3 differs"
    return {"verdict": "fail", "summary": said, "tables": [], "notes": [], "pictures": []}


def test_a_cluster_that_plays_alike_passes(tmp_path, by_copy):
    """Lines in another order and at other times are the same; a process was killed, and it says after how many."""
    by_copy(lambda folder: edit(folder / "episodes.jsonl", '"wall_s":', '"wall_s":1'))
    code, found = certified(tmp_path, "ray")
    assert code == 0 and found["verdict"] == "pass" and found["notes"] == []
    assert found["summary"].endswith("byte for byte; one actor was killed with SIGKILL after 1 episode")


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [("episodes.jsonl", '"steps":', '"steps":1'), ("table.md", "boxing", "Boxing"), ("config.json", '"mujoco"', '"m"')],
)
def test_an_actor_that_plays_otherwise_fails(tmp_path, by_copy, name, old, new):
    """One line of one episode, a table or what was played: whatever differs fails the check, by its name."""
    by_copy(lambda folder: edit(folder / name, old, new))
    code, found = certified(tmp_path, "ray")
    assert code == 1 and found["notes"] == [f"{name} differs"]


def test_a_file_that_an_actor_did_not_write_fails(tmp_path, by_copy):
    """An episode without its recorded actions is not the same."""
    by_copy(lambda folder: next((folder / "actions").iterdir()).unlink())
    code, found = certified(tmp_path, "ray")
    assert code == 1 and found["notes"][0].startswith("actions/")


@pytest.mark.parametrize(
    ("facts", "verdict", "said"),
    [
        ({"code": 2, "last_line": "error: no Ray cluster"}, "fail", "ended with code 2: error: no Ray cluster"),
        ({"code": None}, "fail", "took longer than 60 min"),
        ({"killed_after": None, "lost": 0}, "note", "files of 2 Ray actors (6 episodes) are those"),
        ({"lost": 0}, "note", "files of 2 Ray actors (6 episodes) are those"),
    ],
)
def test_a_run_that_shows_nothing_does_not_pass(tmp_path, by_copy, facts, verdict, said):
    """A cluster that does not end fails; one that lost no process shows only half of it."""
    by_copy(lambda folder: None, **facts)
    code, found = certified(tmp_path, "ray")
    assert (code, found["verdict"]) == (int(verdict == "fail"), verdict) and said in found["summary"]


def test_without_ray_it_says_so(tmp_path, monkeypatch):
    """Without the extra the check is skipped in one line that says how to install it; alone it is no success."""

    def absent(extra, purpose, modules=()):
        raise InputError(f"{purpose}: needs the extra [{extra}]")

    monkeypatch.setattr(machines, "require", absent)
    code, found = certified(tmp_path / "a", "ray")
    assert code == 1 and (found["verdict"], found["summary"]) == ("skip", "not run: needs the extra [ray]")
    code, found = certified(tmp_path / "b", "shards", engine="warp")
    assert code == 1 and found["verdict"] == "skip" and "engine mujoco alone" in found["summary"]


def test_an_actor_is_found_and_killed(tmp_path, monkeypatch):
    """The process below a run that plays is killed, once an episode has ended and not before."""
    monkeypatch.setattr(machines, "POLL", 0.01)
    (tmp_path / "episodes.jsonl").write_text("")
    waits = "import time; time.sleep(600)"
    idle, plays = (f'(exec -a ray::RayActor{what} {sys.executable} -c "{waits}")' for what in ("", ".play"))
    run = subprocess.Popen(["bash", "-c", f"{idle} & other=$!; {plays}; touch {tmp_path}/gone; kill $other"])
    try:
        wait_for(lambda: machines._actors(run.pid), "actor")
        assert len(machines._actors(run.pid)) == 1 and not (tmp_path / "gone").exists()
        timer = threading.Timer(0.1, lambda: (tmp_path / "episodes.jsonl").write_text("{}\n{}\n"))
        timer.start()
        assert machines._kill_one(run, tmp_path) == 2
        wait_for((tmp_path / "gone").exists, "end of the actor")
        assert not machines._actors(run.pid)
    finally:
        run.kill()
        run.wait()


def test_contents_of_a_folder(tmp_path):
    """Times and the order of lines do not matter, anything else of a journal line does."""
    lines = [
        '{"index":1,"steps":4,"durations":{"wall_s":0.1,"sim_s":1},"started_at":"a","finished_at":null}\n',
        '{"index":0,"steps":3,"durations":{"wall_s":2e-3,"sim_s":1},"started_at":"b","finished_at":"c"}\n',
    ]
    found = []
    for number, text in enumerate(("".join(lines), "".join(lines[::-1]).replace("0.1", "7").replace('"b"', '"d"'))):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "episodes.jsonl").write_text(text)
        (folder / "config.json").write_text(json.dumps({"status": number, "config": {"a": 1}}))
        found.append(contents(folder))
    assert found[0] == found[1] and found[0]["episodes.jsonl"].count(b"\n") == 2
    (tmp_path / "1" / "episodes.jsonl").write_text(lines[0].replace('"steps":4', '"steps":5') + lines[1])
    assert contents(tmp_path / "1") != found[0]


@pytest.mark.slow
def test_a_real_cluster_loses_an_actor(tmp_path, monkeypatch):
    """A Ray cluster on this machine plays stand-ins, an actor is killed, and all files are those of one process."""
    pytest.importorskip("ray", reason="needs the extra [ray]")
    monkeypatch.setattr(machines, "PROGRAM", "fakes_by_name")
    monkeypatch.setenv("FAKE_TICK_S", "0.05")
    code, found = certified(tmp_path, "ray")
    assert code == 0 and found["verdict"] == "pass", found
    assert "killed with SIGKILL" in found["summary"]
    assert "is replaced:" in (tmp_path / "runs" / "plan" / "ray_1.log").read_text()
