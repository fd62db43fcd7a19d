"""The command line: defaults, one-line answers to bad input, exit codes, quick help."""

import dataclasses
import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import factories

from arena_newton import doctor, rule_sets, tasks
from arena_newton.cli.command_line import exit_code
from arena_newton.cli.command_table import CommandRow
from arena_newton.cli.flags import parse_flags, words
from arena_newton.errors import InputError
from arena_newton.eval import commands
from arena_newton.eval.__main__ import COMMANDS, main
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RecordOptions, RunOptions
from arena_newton.eval.play import run
from arena_newton.eval.suites.suite_options import MatrixOptions
from arena_newton.policies.learned import learned_card
from arena_newton.rules import modes
from arena_newton.rules.modes import Mode
from arena_newton.tasks import football

TASKS = ["football", "double_desk", "pp_box", "open_door", "sit_sofa", "boxing", "vis_navi"]
CELLS = [(tracker, mode) for tracker in ("twist2", "sonic") for mode in ("base", "visual")]
SHORT = ["--engine", "mujoco", "--task", "football", "--repeats", "1", "--seeds", "0"]


def test_default_run(tmp_path, capsys, monkeypatch):
    """Without flags the experts do their tasks through both trackers, with full budgets, film strips and a report."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(learned_card, "SHIPPED", tmp_path / "none")  # its row: test_learned_row.py
    filmed = []
    # These worlds have nothing to draw.
    monkeypatch.setattr(run, "_recorder", lambda config, folder, tracker: filmed.append((config.flags.strip, tracker)))
    assert main(["--device", "cpu"], factories()) == 0
    output = capsys.readouterr().out
    planned = [name for name in TASKS if tasks.get(name).expert is not None]
    assert planned and all(re.search(rf"^\| {task} ", output, re.M) for task in planned)
    report = re.search(r"^report: (.*)$", output, re.M)[1]
    assert Path(report).is_file() and Path(report).parts[0] == "results"
    results = json.loads((Path(report).parent / "results.json").read_text())
    cells = [(cell["task"], cell["tracker"], cell["policy"]) for cell in results["cells"]]
    assert cells == [(task, tracker, "expert") for task in planned for tracker in ("twist2", "sonic")]
    assert filmed == [(True, tracker) for _ in planned for tracker in ("twist2", "sonic")]
    lines = (Path(report).parent / "episodes.jsonl").read_text().splitlines()
    budgets = {row["task"]: row["max_steps"] for row in map(json.loads, lines)}
    assert budgets == {task: tasks.get(task).max_steps(rule_sets.get("paper")) for task in planned}
    assert main(["resume", str(Path(report).parent)], factories()) == 0
    assert f"{len(lines)} episodes, all finished" in capsys.readouterr().out


def test_configuration_is_two_lines(tmp_path, capsys):
    """A run opens with two lines; -v prints all that the results depend on."""
    assert main([*SHORT, "--out", str(tmp_path / "a")], factories()) == 0
    brief = capsys.readouterr().out.split("\n\n")[0].splitlines()
    assert len(brief) == 2
    assert re.match(
        r"configuration [0-9a-f]{12}: football, base, tracker twist2, policy expert, rules paper, ", brief[0]
    )
    assert "  1 episode, 1 world at once, at most 1,300 world-ticks (26 s simulated) -> " in brief[1]
    assert main(["resume", str(tmp_path / "a")], factories()) == 0
    assert capsys.readouterr().out.splitlines()[1] == f"  1 episode, all finished -> {tmp_path / 'a'}"
    assert main([*SHORT, "--max-steps", "1", "--out", str(tmp_path / "c")], factories()) == 0
    assert "at most 1 world-tick (0.02 s simulated) -> " in capsys.readouterr().out.splitlines()[1]
    assert main([*SHORT, "-v", "--out", str(tmp_path / "b")], factories()) == 0
    captured = capsys.readouterr()
    full = captured.out.split("\n\n")[0].splitlines()
    assert {"rules_hash", "code", "tracker_facts", "drive"} <= {line.split()[0] for line in full}
    assert "  football twist2 base: engine mujoco, device cpu, physics_dt 0.001, startup_ticks 0" in captured.err


def test_a_log_file_gets_lines(tmp_path, monkeypatch, capsys):
    """Without a terminal nothing is drawn over: no carriage return, and few lines."""
    monkeypatch.setenv("FAKE_TICK_S", "0.002")
    flags = ["--task", "football", "boxing", "--engine", "mujoco", "--out", str(tmp_path / "o")]
    assert main(flags, factories()) == 0
    said = capsys.readouterr()
    assert "\r" not in said.err + said.out
    assert 1 <= said.err.count("\n") < 10
    assert "boxing twist2 base: 120 of 120 episodes, 100% of the tick budget" in said.err


def test_protocol_is_the_default_of_a_named_task(tmp_path):
    """With a task named, 3 seeds x 20 repeats run under the paper's step budget."""
    out = tmp_path / "o"
    assert main(["run", "--task", "football", "--engine", "mujoco", "--out", str(out)], factories()) == 0
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert len(records) == 60
    assert {r["max_steps"] for r in records} == {1300}
    first = next(r for r in records if (r["group_seed"], r["repeat"]) == (0, 0))
    assert first["episode_seed"] == 1132158683
    keys = """task tracker policy mode rules engine group_seed repeat episode_seed outcome steps margin durations hashes
    reason startup_fall overflow error"""
    assert set(keys.split()) <= set(first)


def test_trackers_are_an_axis(tmp_path, capsys):
    """Two trackers play the same episodes into one folder: one journal, a cell each, hashes of their own weights."""
    out = tmp_path / "o"
    flags = ["--task", "football", "boxing", "--tracker", "twist2", "sonic", "--mode", "base", "visual"]
    assert main([*flags, "--engine", "mujoco", "--repeats", "2", "--out", str(out)], factories()) == 0
    assert ", trackers twist2 sonic, policy expert, " in capsys.readouterr().out
    rows = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    seeds = {(t, m): {r["episode_seed"] for r in rows if (r["tracker"], r["mode"]) == (t, m)} for t, m in CELLS}
    assert len(rows) == 48 and len(set(map(frozenset, seeds.values()))) == 1
    results = json.loads((out / "results.json").read_text())
    assert [(c["tracker"], c["mode"]) for c in results["cells"]] == CELLS * 2
    weights = {row["tracker"]: row["hashes"]["checkpoint"] for row in rows}
    assert weights["twist2"] != weights["sonic"] and results["config"]["checkpoint"] == weights
    assert set(results["config"]["tracker_facts"]) == {"twist2", "sonic"}
    assert (out / "original" / "boxing__sonic__visual").is_dir()
    assert re.search("--task boxing --mode visual --tracker sonic --seeds 2 ", (out / "report.html").read_text())
    assert main(["resume", str(out)], factories()) == 0
    line = json.dumps(rows[0] | {"tracker": "pd"})
    (out / "episodes.jsonl").write_text("\n".join([line, *map(json.dumps, rows[1:])]) + "\n")
    capsys.readouterr()
    assert main(["report", str(out)], factories()) == 2
    assert (
        'tracker is "pd", this run\'s is "twist2 or sonic"; the journal was changed by hand' in capsys.readouterr().err
    )


def test_files_of_several_trackers_have_names_of_their_own(tmp_path):
    """Recordings are named by the tracker where a run has several."""
    one = resolve(RunOptions(task=("football",), tracker=("twist2",), engine="mujoco", strip=True))
    two = resolve(RunOptions(task=("football",), tracker=("twist2", "sonic"), engine="mujoco", strip=True))
    episode = two.episodes[-1]
    assert run._recorder(one, tmp_path, "twist2").label(episode) == "football__base__seed2__repeat19"
    assert run._recorder(two, tmp_path, "sonic").label(episode) == "sonic__football__base__seed2__repeat19"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--task", "footbal"], "--task footbal: .*football"),
        (["--task", "all", "football"], "--task all"),
        (["--task", "football", "football"], "given twice"),
        (["--task", "football", "--mode", "bases"], "--mode bases: .*execution"),
        (["--rules", "mine"], "--rules mine: .*released"),
        (["--engine", "bullet"], "--engine bullet"),
        (["--device", "tpu"], "--device tpu"),
        (["--engine", "mujoco", "--device", "cuda:0"], "--device cuda:0"),
        (["--tracker", "nobody"], "--tracker nobody"),
        (["--checkpoint", "absent.onnx"], "--checkpoint absent.onnx: no such file"),
        (["--checkpoint", "absent.onnx", "--tracker", "twist2", "sonic"], "--checkpoint absent.onnx: name the one"),
        (["--tracker", "pd", "pd"], "--tracker pd: given twice"),
        (["--policy", "replay:absent.npz"], "--policy replay:absent.npz: no such file"),
        (["--variant", "absent.usda"], "--variant absent.usda: no such file"),
        (["--repeats", "0"], "--repeats 0"),
        (["--worlds", "0"], "--worlds 0"),
        (["--max-steps", "0"], "--max-steps 0"),
        (["--drive", "stiff"], "--drive stiff: .*humanoidarena"),
        (["--strip", "--video-size", "big"], "--video-size big"),
        (["bench", "--what", "all", "nosuch"], "--what nosuch: known are tick throughput learned gradients start all"),
        (["--seeds", "1", "1"], "--seeds 1: given twice"),
        (["--seeds", "-1"], "seeds"),
        (["--task", "football", "--seeds", "99999999999999999999999"], "--seeds 99999999999999999999999: expected at"),
        (["--task", "football", "--max-steps", "99999999"], "--max-steps 99999999: expected at most"),
        (["--video", "--video-size", "40x4000"], "--video-size 40x4000: .* a height of at most 3072"),
        (["--task", "football", "--out", ""], "--out: is empty, name a folder"),
        (["--out", " "], "--out: is empty, name a folder"),
        (["--repeats", "two"], "--repeats: cannot read two"),
        (["--worlds=x"], "--worlds: cannot read x"),
        (["--worlds"], "--worlds: cannot read it without a value"),
        (["--tasks", "football"], "--tasks: unknown argument, did you mean --task"),
        (["--worlds", "3", "4"], "4: unknown argument; see"),
        (["list", "--seeds", "1.5"], "--seeds: cannot read 1.5"),
        (["resume"], "name the results folder"),
        (["resume", "absent"], "no results folder"),
        (["report", "absent"], "no results folder"),
    ],
)
def test_bad_input_gets_one_line(tmp_path, monkeypatch, capsys, flags, message):
    """Wrong input ends with code 2 and one line on stderr before anything is written."""
    monkeypatch.chdir(tmp_path)
    assert main(flags, factories()) == 2
    captured = capsys.readouterr()
    assert re.fullmatch(rf"error: .*{message}.*\n", captured.err)
    assert list(tmp_path.iterdir()) == []


def test_variant_is_looked_into(tmp_path, capsys, monkeypatch):
    """A variant or a mode's layer with a fault, and a variant without its one task, are refused before an episode."""
    variant = tmp_path / "room.usda"
    variant.write_text("#usda 1.0\n")
    out = ["--out", str(tmp_path / "o")]

    def refuse(path, task):
        raise InputError(f"{path}: /World/Ball: missing in a scene of {task}")

    assert main([*SHORT, "--variant", str(variant), *out], factories(check_variant=refuse)) == 2
    assert "/World/Ball: missing in a scene of football" in capsys.readouterr().err
    night = Mode(name="night", sentence="it is dark", scene="layer", layers=tmp_path)
    monkeypatch.setitem(modes._MODES._registered, "night", night)
    variant.rename(tmp_path / "football.usda")
    assert main([*SHORT, "--mode", "night", *out], factories(check_variant=refuse)) == 2
    assert "football.usda: /World/Ball: missing in a scene of football" in capsys.readouterr().err
    variant.write_text("#usda 1.0\n")
    assert main(["--task", "all", "--engine", "mujoco", "--variant", str(variant), *out], factories()) == 2
    assert "--task" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_out_folder_is_checked(tmp_path, capsys):
    """A file, a folder with foreign content and one that cannot be created or written are named in one line."""
    (tmp_path / "file").write_text("")
    (tmp_path / "closed").mkdir(mode=0o500)
    cases = {"file": "is a file", "": "not empty", "file/o": "", "closed/o": "cannot be"}
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        del cases["closed/o"]  # root writes everywhere
    for name, said in cases.items():
        assert main([*SHORT, "--out", str(tmp_path / name)], factories()) == 2, name
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1, error


def test_list_runs_nothing(tmp_path, monkeypatch, capsys):
    """`list --json` prints one object per episode with seeds, draws, poses and step budget."""
    monkeypatch.chdir(tmp_path)
    flags = ["list", "--json", "--engine", "mujoco", "--task", "football", "--mode", "base", "visual", "--repeats", "2"]
    assert main(flags, factories()) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 12
    keys = "task mode rules group_seed repeat episode_seed object_seed sampled placed".split()
    assert all(set(keys) <= set(row) for row in rows)
    assert rows[0]["episode_seed"] == 1132158683 and rows[0]["object_seed"] == 11400714786159236188
    assert main([flag for flag in flags if flag != "--json"], factories()) == 0
    assert len(capsys.readouterr().out.splitlines()) == 14  # two lines of the plan as a whole
    assert list(tmp_path.iterdir()) == []


def test_report_from_journal(tmp_path, capsys):
    """`report` writes deleted reports again, byte for byte."""
    out = tmp_path / "o"
    assert main([*SHORT, "--out", str(out)], factories()) == 0
    before = (out / "report.html").read_bytes()
    (out / "report.html").unlink()
    assert main(["report", str(out)], factories()) == 0
    assert (out / "report.html").read_bytes() == before
    capsys.readouterr()
    assert main(["report", str(out), "--json"], factories()) == 0
    assert json.loads(capsys.readouterr().out)["complete"]


def test_a_new_command_is_its_file_and_its_row(tmp_path, monkeypatch, capsys):
    """A file in `eval/commands` and a row of the table give help, folders, flags, extras and the exit code."""
    (tmp_path / "greet.py").write_text(
        "from dataclasses import dataclass\n"
        "@dataclass(frozen=True)\n"
        "class GreetOptions:\n"
        '    """Greet folders."""\n'
        "    times: int = 1\n"
        '    """How often."""\n'
        "def run(folders, options: 'GreetOptions'):\n"
        "    print([folder.name for folder in folders] * options.times)\n"
        "    return 7\n"
    )
    monkeypatch.setattr(commands, "__path__", [*commands.__path__, str(tmp_path)])
    monkeypatch.setitem(COMMANDS, "greet", CommandRow("say hello", "<out> [<out> ...]", "the results folder"))
    assert main(["greet", "a", "b", "--times", "2"]) == 7
    assert capsys.readouterr().out == "['a', 'b', 'a', 'b']\n"
    assert main(["greet", "--times", "2"]) == main(["greet", "a", "a"]) == main(["greet", "a", "--time", "x"]) == 2
    assert "greet: name the results folder: " in capsys.readouterr().err
    for typed, shown in ((["greet", "--help"], "How often. (default: 1)"), (["--help"], "say hello")):
        with pytest.raises(SystemExit):
            main(typed)
        assert shown in capsys.readouterr().out
    monkeypatch.setitem(COMMANDS, "greet", CommandRow("say hello", "<out>", extras={"data": ("nosuch",)}))
    assert main(["greet", "a"]) == 2
    assert "eval greet: needs the extra [data] (nosuch" in capsys.readouterr().err


def test_every_command_has_its_file():
    """Each command is in the file of its name, or in the one of another command that its row names; no file is left."""
    files = {path.stem for path in Path(commands.__file__).parent.glob("*.py")} - {"__init__"}
    named = {name: row.work.removeprefix("commands.").partition(":")[0] or name for name, row in COMMANDS.items()}
    assert files == set(named.values()) and all(named[file] == file for file in files)


def test_options_are_written_as_they_are_typed():
    """Options as a command prints them give the same options again."""
    for options in (
        RunOptions(task=("boxing", "vis_navi"), ray=(), follow=True, remote_timeout=2.5, until_width=0.1),
        MatrixOptions(only="policy=act task=boxing", shard="1/4", ray=("auto",), ray_gpus=0.5, keep_going=True),
        RecordOptions(disturb=False, cameras=(), episodes=3),
    ):
        assert parse_flags(type(options), words(options), "eval") == options
    assert words(RunOptions()) == []


def test_help_and_plans_import_nothing_heavy():
    """`--help` of each command, a plan, and what is wrong with one need no library of physics, networks or pictures."""
    flags = ["--task football nosuch", "--drive stiff", "--worlds 0", "--policy nosuch", "--checkpoint absent.onnx"]
    flags += ["--rules mine", "--mode bases", "--strip --video-size 9x9", "--engine bullet", "--device tpu"]
    flags += ["--engine mujoco --out /dev/null"]
    code = (
        "import sys; from arena_newton.eval.__main__ import COMMANDS, main\n"
        "HEAVY = {'warp', 'torch', 'pxr', 'mujoco', 'newton', 'lerobot', 'cv2', 'av'}\n"
        "for command in ([], *([name] for name in COMMANDS)):\n"
        "    try: main([*command, '--help'])\n"
        "    except SystemExit as stop: assert not stop.code\n"
        "    heavy = (HEAVY | {'numpy'}) & set(sys.modules)\n"
        "    assert not heavy, (command, heavy)\n"
        "for words in sys.argv[1:]:\n"
        "    code, heavy = main(words.split()), HEAVY & set(sys.modules)\n"
        "    assert not heavy, (words, heavy)\n"
        "    assert code == (2 if words.startswith('run') else 0), words"
    )
    commands = [*(f"run {words}" for words in flags), "list --json --task all --repeats 1 --engine mujoco"]
    done = subprocess.run([sys.executable, "-c", code, *commands], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage: ") == len(COMMANDS) + 1
    answers = [f"error: --{words.split('--')[-1].split()[0]}" for words in flags]
    assert all(map(str.startswith, done.stderr.splitlines(), answers)), done.stderr
    assert done.stderr.count("\n") == len(answers)


def test_doctor_names_what_is_missing(monkeypatch, capsys):
    """A missing required package is a problem with advice and code 1; a missing extra is a note."""
    installed = doctor.versions()
    monkeypatch.setattr(doctor, "versions", lambda: installed | {"usd-core": None, "av": None})
    assert doctor.main() == 1
    output = capsys.readouterr().out
    assert re.search(r"^! usd-core +missing\n +-> needed for scene files", output, re.M)
    assert re.search(r"^- av +missing\n +-> needed for videos", output, re.M)


@pytest.mark.parametrize("command", [[], ["list"]])
def test_broken_variant_is_one_line(command, tmp_path, capsys):
    """A variant file that is no USD is named in one line with code 2, by run and by list."""
    path = tmp_path / "broken.usda"
    path.write_text('#usda 1.0\ndef Xform "World" { over "Ball" {\n')
    assert main([*command, "--task", "football", "--seeds", "0", "--variant", str(path)]) == 2
    answer = capsys.readouterr().err.strip().splitlines()
    assert len(answer) == 1 and "broken.usda" in answer[0]


@pytest.fixture
def without_an_expert(monkeypatch):
    """Football as a task that somebody added without an expert."""
    monkeypatch.setattr(football, "TASK", dataclasses.replace(football.TASK, expert=None))


def test_task_without_an_expert_is_refused_first(tmp_path, capsys, without_an_expert):
    """A policy that cannot do one of the tasks is refused before the first episode of any."""
    out = tmp_path / "out"
    assert main(["--task", "vis_navi", "football", "--policy", "expert", "--tracker", "pd", "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert "task football" in message and "sit_sofa, vis_navi" in message and message.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    "words",
    ["run --task boxing --out", "run --policy learned:", "report", "merge . --out", "merge", "pack", "pack . --out"]
    + ["tables", "compare", "resume", "matrix", "run --task boxing --policy replay:", "film"],
)
def test_a_path_too_long_to_exist_is_one_line(words, capsys, tmp_path, monkeypatch):
    """A name that no file system takes is bad input of every command, not a break."""
    monkeypatch.chdir(tmp_path)
    words = [*words.split()[:-1], words.split()[-1] + "x" * 300] if words.endswith(":") else [*words.split(), "x" * 300]
    assert main(words, factories()) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1, error


def test_a_path_that_may_not_be_read_is_one_line(capsys, monkeypatch, tmp_path):
    """A folder of somebody else's, in which nothing may be looked for, is named; other faults stay faults."""

    def refused(self, **_):
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    with monkeypatch.context() as closed:
        closed.setattr(Path, "exists", refused)
        assert main(["merge", str(tmp_path), "--out", str(tmp_path / "theirs")]) == 2
    error = capsys.readouterr().err
    assert "theirs" in error and "Permission denied" in error and error.count("\n") == 1, error

    def broken():
        raise OSError(errno.EIO, "Input/output error")

    with pytest.raises(OSError, match="Input/output"):
        exit_code(broken)
