"""A run that was killed, interrupted or left without disk continues and ends in the same bytes."""

import errno
import json
import os
import re
import shutil
import signal
import sys
from types import SimpleNamespace

import pytest
from eval_fakes import FakeEnv, FakePolicy, factories

from arena_newton import doctor, tasks
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records import journal as journal_module
from arena_newton.policies.base import PolicyUnavailable
from arena_newton.rules import seeding
from tests.children import Child
from tests.patience import PLENTY, wait_for

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


@pytest.fixture
def copied(uninterrupted, tmp_path):
    """A copy of it that a test may change."""
    return shutil.copytree(uninterrupted, tmp_path / "copied")


@pytest.fixture
def half(copied):
    """A copy whose journal ends after 30 episodes."""
    path = copied / "episodes.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:30]))
    return copied


def journal(folder):
    """Lines of a journal as JSON."""
    return [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]


@pytest.fixture
def start(tmp_path, uninterrupted):
    """Starts the command line in a process of its own, which stops in the plan's second half."""
    poison = tmp_path / "poison.txt"
    poison.write_text(f"hang {journal(uninterrupted)[40]['episode_seed']}")

    def start(folder, *flags):
        process = Child("eval_fakes", ["run", *FLAGS, *flags, "--out", str(folder)], FAKE_POISON=str(poison))
        wait_for(lambda: lines(folder) > 6 or process.poll() is not None, "line of the journal")
        assert process.poll() is None, process.communicate()
        return process

    return start


def test_kill_and_resume_gives_the_same_bytes(tmp_path, uninterrupted, start):
    """`kill -9` in the middle, with a torn last line, then resume: every table equals the undisturbed run's."""
    folder = tmp_path / "b"
    process = start(folder, "--worlds", "5")
    process.send_signal(signal.SIGKILL)
    process.communicate()
    before = lines(folder)
    assert 7 <= before < 48
    with (folder / "episodes.jsonl").open("ab") as handle:
        handle.write(b'{"index": 40, "task": "box')
    assert main(["resume", str(folder)], factories()) == 0
    assert lines(folder) == 48
    assert tables(folder) == tables(uninterrupted)


def test_environments_are_stored_in_the_plans_order(tmp_path):
    """Processes of a cluster build them in any order; config.json, and the report with it, has them in the plan's."""
    options = RunOptions(task=("football", "boxing"), mode=("base", "visual"), seeds=(0,), repeats=1, engine="mujoco")
    folder = ResultsFolder(tmp_path, resolve(options), doctor.versions())
    folder.make()
    folder.prepare(folder.config, ())
    names = [f"{task} twist2 {mode}" for task in ("football", "boxing") for mode in ("base", "visual")]
    for name in (names[2], names[3], names[0], names[2], names[1]):
        assert folder.register(name, {"engine": name}) == {"engine": name}
    folder.register(names[0], {"engine": names[0], "processor": "AVX2"})  # nodes of a cluster differ
    stored = json.loads((tmp_path / "config.json").read_text())["environments"]
    assert list(stored) == names and stored[names[1]] == {"engine": names[1]}


def test_interrupt_says_how_to_go_on(tmp_path, uninterrupted, start):
    """Ctrl-C ends with code 130, keeps what was finished and prints the command that continues."""
    folder = tmp_path / "with space"
    process = start(folder)
    process.send_signal(signal.SIGINT)
    output, complaint = process.communicate(timeout=PLENTY)
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
    """Breaks when two episodes of boxing have ended."""

    error: Exception = RuntimeError("device lost")

    def step(self, action):
        """The simulator dies."""
        if self.task == "boxing" and self.ended >= 2:
            raise self.error
        return super().step(action)


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (RuntimeError("device lost"), "device lost; running were base/s0/r1 base/s0/r3 base/s1/r0"),
        (RuntimeError("CUDA out of memory"), "fewer --worlds"),
        (SystemExit(0), "boxing twist2 base execution: SystemExit: 0; running were"),
        (OSError(errno.ENOSPC, "No space left on device", "v.mp4.part"), "v.mp4.part: disk full"),
        (ConnectionResetError("peer left"), "boxing twist2 base execution: ConnectionResetError: peer left"),
        (PolicyUnavailable("http://host:1 does not\x1b[2J answer"), "http://host:1 does not answer"),
    ],
)
def test_a_break_stops_the_run_and_leaves_episodes_unplayed(tmp_path, uninterrupted, capsys, error, says):
    """A break of the whole run is no episode's error: one line, code 2, nothing lost; resume ends in the same bytes."""
    folder = tmp_path / "d"
    breaks = type("Breaks", (BreaksOnce,), {"error": error})
    assert main(["run", *FLAGS, "--worlds", "3", "--out", str(folder)], factories(env=breaks)) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert says in line and "26 of 48 episodes kept" in line and f"resume {folder}" in line
    assert "\x1b" not in line
    records = journal(folder)
    assert len(records) == 26 and all(r["outcome"] != "error" for r in records)
    assert main(["resume", str(folder)], factories()) == 0
    assert tables(folder) == tables(uninterrupted)


class Poison(FakeEnv):
    """Breaks whenever one certain episode of boxing starts."""

    def reset(self, seeds, worlds=None, *, modes, **options):
        """The poison is known by its mode and its seed, which both modes have."""
        poison = seeding.episode_seed(self.spec.gym_id, 1, 1)
        if self.task == "boxing" and (poison, "base") in zip(seeds, modes, strict=True):
            raise RuntimeError("always here")
        super().reset(seeds, worlds, modes=modes, **options)


def test_an_episode_that_always_breaks_can_be_passed(tmp_path, uninterrupted, capsys):
    """--skip-broken ends what was running as errors and goes on; --retry-errors runs it again later."""
    folder = tmp_path / "d"
    for _ in range(2):
        command = ["resume", str(folder)] if folder.exists() else ["run", *FLAGS, "--worlds", "3", "--out", str(folder)]
        assert main(command, factories(env=Poison)) == 2
        assert "--skip-broken" in capsys.readouterr().err
    assert main(["resume", str(folder), "--worlds", "1", "--skip-broken"], factories(env=Poison)) == 1
    output = capsys.readouterr().out
    assert "   1 x environment: RuntimeError: always here" in output
    assert f"resume {folder} --retry-errors" in output
    records = journal(folder)
    assert len(records) == 48
    broken = [(r["task"], r["mode"], r["group_seed"], r["repeat"]) for r in records if r["outcome"] == "error"]
    assert broken == [("boxing", "base", 1, 1)]
    assert main(["resume", str(folder)], factories()) == 1
    assert main(["resume", str(folder), "--retry-errors"], factories()) == 0
    assert tables(folder) == tables(uninterrupted)


def test_an_environment_that_cannot_be_built_is_no_error_of_episodes(tmp_path, capsys):
    """--skip-broken does not turn a machine without room for one world into a journal of errors."""

    def no_memory(task, **options):
        raise MemoryError("no room")

    folder = tmp_path / "d"
    assert main(["run", *FLAGS, "--skip-broken", "--out", str(folder)], factories(env=no_memory)) == 2
    said = "football twist2 base execution: MemoryError: no room (fewer --worlds need less); trace in"
    assert said in capsys.readouterr().err
    assert "no_memory" in (folder / "break.txt").read_text()
    assert lines(folder) == 0


def test_errors_are_told_with_reasons(tmp_path, capsys):
    """Terminal and counts name why episodes ended as errors, without what a server put between, and how to go on."""
    said = ["policy: HTTP 500\x1b[31m busy", "policy: HTTP 500 busy", "no answer"]

    gym_id = tasks.get("football").gym_id
    seeds = {(seed, repeat): seeding.episode_seed(gym_id, seed, repeat) for seed in (0, 1) for repeat in range(3)}
    broken = {seeding.policy_seed(seed): said[repeat] for (_, repeat), seed in seeds.items()}

    class Failing(FakePolicy):
        def act(self, observation):
            chunk = super().act(observation)
            chunk.errors = {w: broken[seed] for w, seed in enumerate(self.seeds) if seed in broken}
            return chunk

    folder = tmp_path / "e"
    flags = ["--task", "football", "--engine", "mujoco", "--seeds", "0", "1", "--repeats", "4", "--out", str(folder)]
    assert main(flags, factories(policy=Failing)) == 1
    captured = capsys.readouterr()
    told = [line for line in captured.out.splitlines() if " x " in line]
    assert told == ["     4 x policy: policy: HTTP 500 busy", "     2 x policy: no answer"]
    assert f"resume {folder} --retry-errors" in captured.out
    assert "\\u001b" not in (folder / "episodes.jsonl").read_text()


def test_partial_recordings_are_removed(tmp_path):
    """Partial files of an interrupted recording are gone when a run ends, however it ends."""
    folder = tmp_path / "s"

    class Leaves(FakeEnv):
        def step(self, action):
            for part in ("videos/a.mp4.part", "strips/a.png.part", "actions/a.npz.part"):
                (folder / part).parent.mkdir(exist_ok=True)
                (folder / part).write_text("half")
            raise KeyboardInterrupt

    assert main(["run", *FLAGS, "--out", str(folder)], factories(env=Leaves)) == 130
    assert sorted(path.name for path in folder.rglob("*") if path.is_file()) == ["config.json", "episodes.jsonl"]


def test_environments_stand_in_configuration_and_journal(uninterrupted):
    """Facts of each task's and mode's environment are once in config.json; every journal line carries their hash."""
    document = json.loads((uninterrupted / "config.json").read_text())
    assert list(document["environments"]) == [
        f"{t} twist2 {m}" for t in ("football", "boxing") for m in ("base", "execution")
    ]
    facts = {"engine": "mujoco", "device": "cpu", "physics_dt": 0.001, "startup_ticks": 0}
    found = [dict(value) for value in document["environments"].values()]
    assert all(value.pop("processor") for value in found) and all(value == facts for value in found)
    assert document["config"]["tracker_facts"] == {"twist2": {"name": "twist2", "drive": "none"}}
    facts = document["config"]["policy_facts"]
    assert facts.pop("code") and facts == {"name": "expert"}
    hashes = [line["hashes"] for line in journal(uninterrupted)]
    assert len({h["environment"] for h in hashes}) == len({h["versions"] for h in hashes}) == 1


def test_drive_reaches_the_environment(tmp_path):
    """--drive names the gains that the environment is built with; without it tracker and rule set decide."""
    built = []

    class Notes(FakeEnv):
        def __init__(self, task, *, drive=None, **options):
            super().__init__(task, **options)
            built.append(drive.name if drive is not None else None)

    for number, flags in enumerate(([], ["--drive", "twist2"], ["--drive", "humanoidarena"])):
        short = ["--task", "football", "--engine", "mujoco", "--seeds", "0", "--repeats", "1"]
        assert main([*short, *flags, "--out", str(tmp_path / str(number))], factories(env=Notes)) == 0
    assert built == [None, "twist2", "twist2-humanoidarena"]


def test_another_environment_is_refused(half, uninterrupted, capsys):
    """A resume whose world runs at another physics rate is refused by name before its first episode."""
    kept = journal(half)

    class Faster(FakeEnv):
        def describe(self):
            return super().describe() | {"physics_dt": 0.005}

    assert main(["resume", str(half)], factories(env=Faster)) == 2
    assert "was run with physics_dt 0.001, now it is 0.005" in capsys.readouterr().err
    assert journal(half) == kept
    other = factories(tracker=lambda *_: SimpleNamespace(describe=lambda: {"name": "twist2", "drive": "stiff"}))
    assert main(["resume", str(half)], other) == 2
    assert "tracker_facts.twist2.drive was none, now stiff" in capsys.readouterr().err
    assert main(["resume", str(half)], factories()) == 0
    assert tables(half) == tables(uninterrupted)


def test_other_versions_are_refused_unless_accepted(half, uninterrupted, capsys, monkeypatch):
    """Other libraries are named and refused; accepted ones are added to config.json and kept apart in the journal."""
    installed = doctor.versions()
    monkeypatch.setattr(doctor, "versions", lambda: installed | {"tqdm": "9.9"})
    flags = ["--worlds", "1", "--task", "football", "boxing", "--seeds", "9"]
    assert main(["resume", str(half), *flags], factories()) == 2
    assert "seeds was 0 1 2, now 9" in capsys.readouterr().err  # a progress bar changes nothing
    monkeypatch.setattr(doctor, "versions", lambda: installed | {"torch": "9.9"})
    assert main(["resume", str(half)], factories()) == 2
    assert f"torch {installed['torch']}, installed is 9.9" in capsys.readouterr().err
    for _ in range(2):
        assert main(["resume", str(half), "--accept-versions"], factories()) == 0
    document = json.loads((half / "config.json").read_text())
    assert document["versions"] == installed and [v["torch"] for v in document["later_versions"]] == ["9.9"]
    hashes = [line["hashes"]["versions"] for line in journal(half)]
    assert len(set(hashes[:30])) == len(set(hashes[30:])) == 1 and hashes[0] != hashes[-1]
    assert tables(half) == tables(uninterrupted)


def test_a_killed_beginning_can_be_begun_again(tmp_path):
    """A folder with an empty journal, or half a configuration, holds nothing: the run begins in it."""
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / "episodes.jsonl").touch()
    (folder / "config.json.part").write_text('{"schema": 2, "opt')
    flags = ["--task", "football", "--engine", "mujoco", "--seeds", "0", "--repeats", "1", "--out", str(folder)]
    assert main(flags, factories()) == 0
    assert not (folder / "config.json.part").exists()


def status(folder):
    """Status of the run in config.json."""
    return json.loads((folder / "config.json").read_text())["status"]


def test_a_run_has_a_status(tmp_path, uninterrupted, capsys):
    """config.json says how the last run or resume ended, with times; reports say it when that was no success."""
    assert status(uninterrupted) | {"started_at": "", "finished_at": ""} == {
        "state": "success", "started_at": "", "finished_at": "", "error": None
    }  # fmt: skip
    folder = tmp_path / "s"
    seen = []

    class Watched(FakeEnv):
        stop: BaseException = KeyboardInterrupt()

        def step(self, action):
            seen.append(status(folder))
            raise self.stop

    def shown():
        assert main(["report", str(folder)]) == 0
        return capsys.readouterr().out

    assert main(["run", *FLAGS, "--out", str(folder)], factories(env=Watched)) == 130
    assert seen[0]["state"] == "started" and seen[0]["finished_at"] is None
    assert status(folder)["state"] == "cancelled" and status(folder)["finished_at"] >= status(folder)["started_at"]
    assert "The run was cancelled." in shown()
    Watched.stop = RuntimeError("device \x1b[2J lost")
    assert main(["resume", str(folder)], factories(env=Watched)) == 2
    assert (
        status(folder)["state"] == "error"
        and "football twist2 base execution: RuntimeError: device lost" in status(folder)["error"]
    )
    assert "The run ended with an error: football twist2 base execution: RuntimeError: device lost" in shown()
    before = status(folder)
    Watched.stop = InputError("not that world")
    assert main(["resume", str(folder)], factories(env=Watched)) == 2
    assert status(folder) == before
    assert main(["resume", str(folder)], factories()) == 0
    assert status(folder)["state"] == "success" and tables(folder) == tables(uninterrupted)
    assert "The run" not in (folder / "report.html").read_text()


def test_a_killed_run_says_so(copied, capsys):
    """A run that was killed after its last episode shows as started; resume, with nothing to play, mends that."""
    folder = copied
    document = json.loads((folder / "config.json").read_text())
    document["status"] |= {"state": "started", "finished_at": None}
    (folder / "config.json").write_text(json.dumps(document))
    assert main(["report", str(folder)]) == 0
    assert "it is going on, or it was killed" in capsys.readouterr().out
    assert main(["resume", str(folder)], factories()) == 0
    assert status(folder)["state"] == "success"


def test_linked_folders_are_refused(tmp_path, uninterrupted, capsys):
    """A results folder whose own folders lead elsewhere is neither continued nor reported."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("original", "videos"):
        folder = tmp_path / name
        shutil.copytree(uninterrupted, folder)
        shutil.rmtree(folder / "original")
        (folder / name).symlink_to(elsewhere)
        assert main(["resume", str(folder)], factories()) == 2
        assert "is a link" in capsys.readouterr().err
        if name == "original":
            assert main(["report", str(folder)]) == 2
            assert "lies outside" in capsys.readouterr().err
    assert list(elsewhere.iterdir()) == []


def test_a_journal_of_another_plan_is_refused(copied, capsys):
    """A record that the plan has elsewhere, or not at all, is named by report and resume."""
    folder, rows = copied, journal(copied)
    other = {"repeat": 1 + rows[3]["repeat"] % 3}
    for change in ({"repeat": 4}, {"group_seed": 3}, {"index": 48}, {"task": "pp_box"}, other):
        changed = [row | change if number == 3 else row for number, row in enumerate(rows)]
        (folder / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in changed))
        for command in ("report", "resume"):
            assert main([command, str(folder)], factories()) == 2, (command, change)
            assert re.fullmatch(r"error: .*episodes\.jsonl: episode .*\n", capsys.readouterr().err)


@pytest.mark.parametrize("part", ["tracker", "policy"])
def test_a_part_that_leaves_is_no_run_that_ended_well(tmp_path, capsys, part):
    """SystemExit of a tracker or policy that is being made is reported in one line with code 2."""

    def leaves(*_, **__):
        sys.exit(0)

    assert main(["run", *FLAGS, "--out", str(tmp_path / "d")], factories(**{part: leaves})) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and "left with SystemExit: 0 before the first episode" in error
    assert not (tmp_path / "d").exists()


def test_lines_carry_the_hash_of_their_folder(half):
    """Every line, before and after a resume, has the hash of config.json, by which a journal is known as the run's."""
    assert main(["resume", str(half)], factories()) == 0
    document = json.loads((half / "config.json").read_text())
    written = [line["hashes"]["config"] for line in journal(half)]
    assert len(written) == 48 and set(written) == {document["config_hash"]}
