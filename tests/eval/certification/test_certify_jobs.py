"""Certification by several processes: what each is asked for, in which order, and that a broken one stops nothing."""

import signal
import sys
import threading
import time
from types import SimpleNamespace

import pytest
import tyro

import arena_newton
from arena_newton import tasks
from arena_newton.eval.certification import jobs
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import agreement
from arena_newton.eval.certification.checks.failures import failures
from arena_newton.pages.tables import Table


def stand_in(tmp_path, monkeypatch, code=0):
    """Make processes write down their arguments instead of playing; returns the file."""
    log, program = tmp_path / "log", tmp_path / "python"
    program.write_text(f'#!/bin/sh\necho "$@" >> {log}\necho "error: broken" >&2\nexit {code}\n')
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    return log


def test_each_process_plays_one_check_of_one_task(tmp_path, monkeypatch):
    """Recordings come first, by task and tracker; then the others, longest first, in as many parts as they have."""
    log, said = stand_in(tmp_path, monkeypatch), []
    # One at a time: of two that run side by side either may write its line first.
    options = CertifyOptions(out=str(tmp_path / "out"), jobs=1, episodes=7, worlds=3, twist2_checkpoint="a b.onnx")
    jobs.play_ahead(options, ["football", "boxing"], ["solvable", "visible", "semantic", "swap"], said.append)
    lines = log.read_text().splitlines()
    asked = [tuple(line.split(f"--{flag} ")[1].split(" --")[0] for flag in ("checks", "task")) for line in lines]
    assert sorted(asked[:4]) == sorted([("solvable", "football"), ("solvable", "boxing")] * 2)
    assert sorted(asked[4:6]) == [("swap", "boxing"), ("swap", "football")]
    assert sorted(asked[6:]) == [
        *[("semantic", "boxing")] * 2,
        *[("semantic", "football")] * 2,
        ("visible", "boxing"),
        ("visible", "football"),
    ]
    of_semantic = [line.split("--tracker ")[1].split(" --")[0] for line in lines if "--checks semantic" in line]
    assert sorted(of_semantic) == ["sonic", "sonic", "twist2", "twist2"]
    assert all("--tracker" not in line for line in lines if "--checks swap" in line)  # both, as by default
    assert all("--tracker twist2" in line for line in lines if "--checks visible" in line)
    assert all("--jobs 0" in line and "--episodes 7" in line and "--resume" in line for line in lines)
    assert len(said) == 12 and all(text.endswith("played") for text in said)


def test_a_broken_process_is_named_and_the_others_go_on(tmp_path, monkeypatch):
    """A process that is refused leaves its piece to the end, with its reason, and the rest is played."""
    log, said = stand_in(tmp_path, monkeypatch, code=2), []
    jobs.play_ahead(CertifyOptions(out="x", jobs=1, quick=True), ["football", "boxing"], ["swap"], said.append)
    assert len(log.read_text().splitlines()) == 2
    left = "twist2 sonic: left to the end: error: broken"
    assert said == [f"solvable swap {task} {left}" for task in ("boxing", "football")]


def test_a_process_runs_the_code_that_started_it(tmp_path, monkeypatch):
    """A package of this one's name in the folder of the call is not what a certification's processes play."""
    python, log = sys.executable, stand_in(tmp_path, monkeypatch)
    found = "-c 'import arena_newton; print(arena_newton.__file__)'"
    (tmp_path / "python").write_text(f'#!/bin/sh\n[ "$1" = -P ] && p=-P\n{python} $p {found} >> {log}\n')
    (tmp_path / "arena_newton").mkdir()
    (tmp_path / "arena_newton" / "__init__.py").touch()
    monkeypatch.chdir(tmp_path)
    jobs.play_ahead(CertifyOptions(out="x", jobs=1, quick=True), ["boxing"], ["swap"], lambda text: None)
    assert log.read_text().splitlines() == [arena_newton.__file__]


def test_a_quick_process_plays_all_checks_of_a_task(tmp_path, monkeypatch):
    """A process's start is the longest part of a few episodes: one per task, and one for what measures tasks unlike."""
    log = stand_in(tmp_path, monkeypatch)
    checks = ["physics", "camera", "rules", "batches", "swap", "shards", "statistics"]
    options = CertifyOptions(out="x", jobs=1, quick=True)
    jobs.play_ahead(options, ["football", "boxing", "sit_sofa"], checks, lambda text: None)
    asked = [line.split("--checks ")[1].split(" --")[0] for line in log.read_text().splitlines()]
    few = "solvable rules batches swap"  # of the first two, and the task with the longest episodes first
    assert asked == ["shards", "physics camera", few, few, "solvable rules swap"]


def test_a_process_understands_its_flags():
    """The command line of a piece is one that the command reads back as the same options."""
    options = CertifyOptions(out="some folder", jobs=4, quick=True, engine="warp", device="cuda", episodes=2)
    flags = jobs.flags(options, jobs.Piece(("swap",), ("boxing",), ("sonic",)))
    read = tyro.cli(CertifyOptions, args=flags)
    assert (read.task, read.tracker, read.checks, read.jobs) == (("boxing",), ("sonic",), ("swap",), 0)
    assert (read.out, read.quick, read.engine, read.device, read.episodes) == ("some folder", True, "warp", "cuda", 2)
    assert read.resume


def test_an_interrupt_stops_all_processes(tmp_path, monkeypatch):
    """Ctrl-C ends the processes that play and starts no other one."""
    log = stand_in(tmp_path, monkeypatch)
    program = tmp_path / "python"
    program.write_text(f'#!/bin/sh\necho "$@" >> {log}\nexec sleep 600\n')

    def interrupt():
        while not log.exists() or log.read_text().count("\n") < 2:
            time.sleep(0.01)
        signal.raise_signal(signal.SIGINT)

    began, both = time.monotonic(), threading.Thread(target=interrupt)
    both.start()
    with pytest.raises(KeyboardInterrupt):
        jobs.play_ahead(CertifyOptions(out="x", jobs=2), ["football", "boxing"], ["solvable"], lambda text: None)
    both.join()
    assert time.monotonic() - began < 300.0 and log.read_text().count("\n") == 2


def test_engines_is_left_to_the_check_without_cuda_unless_it_was_named(tmp_path, monkeypatch):
    """Without a CUDA device it is skipped unless a user names it; a process of --jobs must not name it for him."""
    log = stand_in(tmp_path, monkeypatch)
    for named, device in (((), "cpu"), (("engines",), "cpu"), ((), "cuda:0")):
        log.unlink(missing_ok=True)
        monkeypatch.setattr(jobs, "resolve_engine", lambda engine, given, device=device: (engine, device))
        options = CertifyOptions(out="x", jobs=1, checks=named)
        jobs.play_ahead(options, ["boxing"], ["engines", "execution"], lambda text: None)
        asked = [line.split("--checks ")[1].split(" --")[0] for line in log.read_text().splitlines()]
        played = ["engines"] * 2 if named or device != "cpu" else []
        assert asked == ["solvable", "solvable", *played, "execution"]


def test_a_process_of_a_quick_certification_compares_no_rates_on_a_cpu(monkeypatch):
    """Its flags name all checks of its task, `engines` among them, and nobody asked for hours on Warp's CPU backend."""
    monkeypatch.setattr(agreement, "_same_start", lambda *_: ("first ticks", Table((), ()), []))
    monkeypatch.setattr(agreement, "_rates", lambda *_: ("pass", "rates", Table((), ()), ()))
    monkeypatch.setattr(agreement, "resolve_engine", lambda engine, device: (engine, "cpu"))
    for jobs_, verdict in ((0, "note"), (2, "pass")):
        given = CertifyOptions(quick=True, jobs=jobs_, checks=("engines",))
        assert agreement.engines(SimpleNamespace(options=given)).verdict == verdict


def test_a_quick_check_of_any_task_has_an_outcome():
    """Also of a task in which none of the kinds is scripted then: the real failures are read all the same."""
    for task in tasks.OWN:
        given = {"tasks": (task,), "sample": ("twist2",), "evaluate": lambda cell: [], "episodes": 2}
        found = failures(SimpleNamespace(options=SimpleNamespace(quick=True), **given))
        assert found.verdict == "pass" and "0 of 0 scripted" in found.summary


def test_one_plan_is_not_divided(tmp_path, monkeypatch):
    """A check that plays one plan of all tasks is one piece, and one that plays nothing is left to itself."""
    log = stand_in(tmp_path, monkeypatch)
    checks = ["statistics", "shards", "ray", "gradients"]
    jobs.play_ahead(CertifyOptions(out="x", jobs=2), ["boxing", "football"], checks, lambda text: None)
    lines = log.read_text().splitlines()
    asked = [line.split("--checks ")[1].split(" --")[0] for line in lines]
    assert sorted(asked) == [*["gradients"] * 4, "shards ray"]
    assert all(("--task boxing football" in line) == ("shards ray" in line) for line in lines)


def test_the_command_line_on_the_page():
    """It names what differs from the defaults, and not that a stopped certification went on."""
    given = CertifyOptions(quick=True, task=("boxing", "vis_navi"), resume=True, episodes=7)
    program = "python -m arena_newton.eval certify"
    assert jobs.command_line(given) == f"{program} --quick --task boxing vis_navi --episodes 7"
    assert jobs.command_line(CertifyOptions(out="my page")) == f"{program} --out 'my page'"


def test_a_check_without_recordings_asks_for_itself_alone(tmp_path, monkeypatch):
    """One process plays the one check of the one task."""
    log = stand_in(tmp_path, monkeypatch)
    jobs.play_ahead(CertifyOptions(out="x", jobs=2), ["boxing"], ["execution"], lambda text: None)
    assert [line.split("--checks ")[1].split()[0] for line in log.read_text().splitlines()] == ["execution"]
