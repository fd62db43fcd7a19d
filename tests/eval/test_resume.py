"""A run that was killed, interrupted or left without disk continues and ends in the same bytes."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from eval_fakes import FakeEnv, factories

from arena_newton.eval import journal as journal_module
from arena_newton.eval.__main__ import main

FLAGS = ["--task", "football", "boxing", "--engine", "mujoco", "--mode", "base", "execution", "--repeats", "4"]
TABLES = ("results.json", "table.md", "table.csv", "report.md", "report.html")


def tables(folder):
    """All derived files without wall-clock times, by name."""
    found = {name: (folder / name).read_bytes() for name in TABLES}
    summaries = (folder / "original").rglob("summary.*")
    return found | {str(path.relative_to(folder)): path.read_bytes() for path in summaries}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """Folder of a run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("run") / "a"
    assert main(["run", *FLAGS, "--worlds", "3", "--out", str(folder)], factories()) == 0
    return folder


def lines(folder):
    """Number of whole journal lines."""
    path = folder / "episodes.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def start(folder, *flags, pause="0.05"):
    """The command line in a process of its own."""
    script = Path(__file__).parent / "eval_fakes.py"
    command = [sys.executable, str(script), "run", *FLAGS, *flags, "--out", str(folder)]
    environment = os.environ | {"FAKE_TICK_S": pause}
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for_lines(process, folder, n):
    """Wait until the journal holds n lines."""
    deadline = time.monotonic() + 60
    while lines(folder) < n:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_kill_and_resume_gives_the_same_bytes(tmp_path, uninterrupted):
    """`kill -9` in the middle, with a torn last line, then resume: every table equals the undisturbed run's."""
    folder = tmp_path / "b"
    process = start(folder, "--worlds", "5")
    wait_for_lines(process, folder, 7)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    before = lines(folder)
    assert 7 <= before < 48
    with (folder / "episodes.jsonl").open("ab") as handle:
        handle.write(b'{"index": 40, "task": "box')
    assert main(["resume", str(folder)], factories()) == 0
    assert lines(folder) == 48
    assert tables(folder) == tables(uninterrupted)


def test_interrupt_says_how_to_go_on(tmp_path, uninterrupted):
    """Ctrl-C ends with code 130, keeps what was finished and prints the command that continues."""
    folder = tmp_path / "with space"
    process = start(folder)
    wait_for_lines(process, folder, 3)
    process.send_signal(signal.SIGINT)
    output, complaint = process.communicate(timeout=60)
    assert process.returncode == 130, complaint
    assert f"resume '{folder}'" in output
    assert "Traceback" not in complaint
    assert main(["resume", str(folder), "--worlds", "20"], factories()) == 0
    assert tables(folder) == tables(uninterrupted)


def test_full_disk_keeps_the_run(tmp_path, uninterrupted, monkeypatch, capsys):
    """A disk that fills up ends the run with one line; after space is made the run continues."""
    folder = tmp_path / "c"
    write = os.pwrite

    def full(file, data, offset):
        if offset > 2500:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data, offset)

    monkeypatch.setattr(journal_module.os, "pwrite", full)
    assert main(["run", *FLAGS, "--out", str(folder)], factories()) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(errors) == 1 and "disk full" in errors[0] and "resume" in errors[0]
    monkeypatch.undo()
    assert 0 < lines(folder) < 48
    assert main(["resume", str(folder)], factories()) == 0
    assert tables(folder) == tables(uninterrupted)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (["--repeats", "5"], "repeats"),
        (["--rules", "released"], "rules"),
        (["--seeds", "0", "1"], "seeds"),
        (["--task", "football"], "task"),
        (["--fast-physics"], "fast_physics"),
        (["--max-steps", "50"], "max_steps"),
        (["--policy", "remote:http://host:1"], "policy"),
    ],
)
def test_changed_configuration_is_refused(uninterrupted, capsys, change, key):
    """`resume` or `run` into a folder of another configuration ends with code 2 and the key that differs."""
    for command in (["resume", str(uninterrupted), *change], ["run", *FLAGS, *change, "--out", str(uninterrupted)]):
        assert main(command, factories()) == 2
        assert f"another configuration: {key} was" in capsys.readouterr().err


def test_finished_run_is_not_run_again(uninterrupted, capsys):
    """Resuming a finished run prints its table and runs nothing."""

    def no_env(task, **options):
        raise AssertionError("built a world")

    before = tables(uninterrupted)
    assert main(["resume", str(uninterrupted)], factories(env=no_env)) == 0
    assert "football" in capsys.readouterr().out
    assert tables(uninterrupted) == before


def test_resume_stays_in_its_folder(tmp_path, uninterrupted, capsys):
    """`resume` does not write elsewhere."""
    assert main(["resume", str(uninterrupted), "--out", str(tmp_path / "o")], factories()) == 2
    assert "drop --out" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


class BreaksOnce(FakeEnv):
    """Breaks after two episodes of boxing."""

    def run_episodes(self, policy, episodes, on_finish=None, **options):
        """Two episodes, then the simulator dies."""
        if self.task != "boxing":
            return super().run_episodes(policy, episodes, on_finish=on_finish, **options)
        super().run_episodes(policy, episodes[:2], on_finish=on_finish, **options)
        raise RuntimeError("device lost")


def test_broken_environment_is_an_error_of_its_episodes(tmp_path, uninterrupted, capsys):
    """When a world breaks, its episodes end as errors, the others run, the code is 1, and --retry-errors mends it."""
    folder = tmp_path / "d"
    assert main(["run", *FLAGS, "--out", str(folder)], factories(env=BreaksOnce)) == 1
    cells = json.loads((folder / "results.json").read_text())["cells"]
    assert [(cell["task"], cell["errors"]) for cell in cells] == [
        ("football", 0),
        ("football", 0),
        ("boxing", 10),
        ("boxing", 10),
    ]
    records = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    assert {r["error"] for r in records if r["outcome"] == "error"} == {"RuntimeError: device lost"}
    assert main(["resume", str(folder)], factories()) == 1
    assert main(["resume", str(folder), "--retry-errors"], factories()) == 0
    assert tables(folder) == tables(uninterrupted)
