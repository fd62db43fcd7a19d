"""The examples: each runs, says what it shows, is short, and prints what its page promises."""

import ast
import contextlib
import importlib.util
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from arena_newton import rule_sets
from arena_newton.cli.extras import EXTRAS
from arena_newton.eval.__main__ import main

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
MOST_LINES = 60
LONGER = {"finetune": 245, "fit_motion": 65, "identify": 164, "slopes": 75, "word_agent": 123}
"""Example of more lines → their number: three methods, or a method and its peer, on one problem; a whole agent."""
RUN = "--task boxing --tracker twist2 --seeds 0 --repeats 1 --engine mujoco --max-steps 4 --out OUT".split()
SHORT: dict[str, list[str]] = {
    "aim_a_kick": ["--kick", "7.34", "6.03", "--max-steps", "20"],
    "compare_runs": ["--max-steps", "4", "--out", "OUT"],
    "drive_by_code": ["--max-steps", "55"],
    "finetune": ["--seconds", "0.1", "--max-steps", "4"],
    "fit_motion": ["--iterations", "2", "--plays", "2", "--max-steps", "6"],
    "identify": ["--windows", "1", "--iterations", "1", "--most", "2"],
    "first_episode": ["--max-steps", "8", "--out", "OUT"],
    "own_policy": ["--max-steps", "15"],
    "own_tracker": ["--max-steps", "4"],
    "record_and_build": ["--episodes", "2", "--size", "64x64", "--max-steps", "8", "--out", "OUT"],
    "refine_reference": ["--rounds", "1"],
    "release_depth": [*(flag.replace("boxing", "double_desk") for flag in RUN), "--policy", "stand"],
    "research": [*RUN, "--policy", "stand"],
    "slopes": ["--max-steps", "4", "--points", "3"],
    "swap": ["--max-steps", "4", "--episodes", "2"],
    "word_agent": ["--seeds", "0", "--repeats", "1", "--max-steps", "110", "--out", "OUT"],
    "worst_start": ["--max-steps", "2", "--iterations", "1"],
    "usd_variant": ["--max-steps", "4", "--out", "OUT"],
}
"""Example → flags with which it takes seconds; OUT is a folder of the test's own."""
SAYS = {
    "aim_a_kick": r" margin \+0.0\d+ m\n(.*\n)?.*  margin \+0.1\d+ m\nin the engine: margin \+0.\d+ m, .* cm apart",
    "compare_runs": r"expert: 0 of 4, 0 that the other loses\n.*stand: 0 of 4.*\nprobability .* by luck: 1\n",
    "drive_by_code": r"1 s  x [+-]0.\d\d  y -1.\d\d  height 0.7\d m\ntimeout; ahead from 0 s\n",
    "finetune": r"(gradient  error 0\.\d+ rad .*\n){2,}(PPO .* s\n){2,}(ES .* s\n){2,}",
    "fit_motion": r"(gradient  misfit 0\.\d+ .* s\n){2}(CEM       misfit \d\.\d+ .* s\n)+",
    "identify": (
        r"((fit  misfit .*\n)+dropped: the misfit is \d+\.\d standard .*\n){2}fit  misfit .*\n"
        r"singular values:( \d+){18}\n"
        r"(.* standard error .* %\n){18}(CEM  misfit .* s\n)+\| robot .*\n.*\n\| 0 \| 2 \| .* s \|\n"
    ),
    "first_episode": r"Kick the soccer ball into the goal\. timeout after 0.2 s .*\n.*\n +0.0 s  approach\n",
    "own_policy": r"11 promises kept\n(boxing/base/s\d/r\d: timeout after 15 ticks\n){6}",
    "own_tracker": r"13 promises kept\n(football/base/s0/r\d: timeout after 0.1 s of standing\n){2}",
    "record_and_build": r"2 episodes, 16 rows at 50 per second: .*\n  action  \[40\]\n.*images.front  \[3, 64, 64\]\n",
    "refine_reference": r"played 0: a palm comes within -0.0\d+ m after 4.9 s\n",  # a miss to refine
    "release_depth": r"double_desk \| twist2  \| stand  \| base \| 1 \|.* 1 \|      0 \|        4\.0 \|\n",
    "research": r"boxing \| twist2  \| stand  \| base \| 1 \|.* 1 \|      0 \|        4\.0 \|\n",
    "slopes": r"speed .*: exact slope .*\nball's start .*: exact slope [+-]\d\.\d+, of the line .*\n",
    "swap": r"success rate through twist2: 0 of 2\nsuccess rate through sonic: 0 of 2\n",
    "word_agent": r"policy process:python word_agent.py answer, (.*\n)*1 episode, this run took",
    "worst_start": r"moved \+0.00 \+0.00 m  margin -\d.\d+ m  holds .*\nby gradient: .*\nby cross-entropy: .* s\n",
    "usd_variant": r"green_sofa.png\nthe expert on the green sofa: timeout after 0.1 s\n",
}
"""Example → what its output holds."""
BARS = {"new_metric": 30, "new_mode": 40, "new_policy": 50, "new_program": 40, "new_task": 250, "new_tracker": 75}
"""Example that is a package → most lines of its code; each is installed and played below or next to what it extends."""


def test_every_example_is_run():
    """No example is without a test, and no test without its example."""
    assert {path.stem for path in EXAMPLES} == set(SHORT) == set(SAYS)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_says_what_it_shows(path):
    """An example is short, begins with what it shows and how it is called, and uses public names alone."""
    text = path.read_text()
    said = ast.get_docstring(ast.parse(text)) or ""
    assert text.count("\n") <= LONGER.get(path.stem, MOST_LINES)
    assert "Shows: " in said and f"python examples/{path.name}" in said
    assert not re.search(r"\b(?!self)\w+\._[a-z]|import _[a-z]", text)


@pytest.mark.release
def test_examples_have_the_types_that_they_say():
    """The examples pass mypy, as CONTRIBUTING asks: a reader who copies one begins without errors."""
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", "mypy", *map(str, EXAMPLES)]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, tmp_path, monkeypatch, capsys):
    """An example runs through, with less to do than it does by default, and prints what it is about."""
    if path.stem == "record_and_build":
        for module in EXTRAS["data"]:
            if importlib.util.find_spec(module) is None:
                pytest.skip(f"needs the extra [data]: {module} is not installed")
    flags = [str(tmp_path / "out") if flag == "OUT" else flag for flag in SHORT[path.stem]]
    monkeypatch.setattr(sys, "argv", [str(path), *flags])
    monkeypatch.chdir(tmp_path)
    with contextlib.suppress(SystemExit):
        runpy.run_path(str(path), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(SAYS[path.stem], printed), printed
    if "OUT" in SHORT[path.stem]:
        assert any((tmp_path / "out").rglob("*.*"))


def test_packages_say_what_they_show():
    """Each example that is a package is short, and says in its code how it is installed, or its page does."""
    folders = sorted(file.parent for file in (ROOT / "examples").glob("*/pyproject.toml"))
    assert [folder.name for folder in folders] == sorted(BARS)
    page = (ROOT / "docs" / "howto" / "bring" / "add_a_task.md").read_text(encoding="utf-8")
    for folder in folders:
        texts = [file.read_text(encoding="utf-8") for file in folder.rglob("*.py")]
        assert sum(text.count("\n") for text in texts) <= BARS[folder.name]
        assert f"uv pip install -e examples/{folder.name}\n" in "".join([*texts, page])


def test_a_mode_of_a_package_is_studied_and_certified(installed, tmp_path, capsys):
    """A mode of another package is known by name to the map, the search and the certificate, which says what moves."""
    installed(ROOT / "examples" / "new_mode")
    names = "--task boxing --mode wet".split()
    short = [*names, *"--policy stand --max-steps 4 --engine mujoco --out".split()]
    assert main(["sensitivity", *short, str(tmp_path / "map"), *"--axes dynamics.friction --grid 2".split()]) == 0
    assert [axis["grid"] for axis in json.loads((tmp_path / "map" / "sensitivity.json").read_text())["axes"]] == [
        [0.2, 0.5]
    ]
    search = "--axes boxing_target.z dynamics.friction --batch 10 --batches 1 --confirm 1".split()
    assert main(["adversary", *short, str(tmp_path / "search"), *search]) == 0
    found = json.loads((tmp_path / "search" / "adversary.json").read_text())
    height, friction = found["worst"]["values"]
    assert 0.65 <= height <= 0.95 and 0.2 <= friction <= 0.5
    checks = [*names, *"--checks modes --episodes 1 --tracker twist2 --out".split(), str(tmp_path / "certify")]
    assert main(["certify", *checks]) == 0
    moved = "modes         wet moves boxing_target z, dynamics friction; nothing else"
    assert moved in capsys.readouterr().out


def test_packages_play_together(installed, tmp_path, capsys):
    """Installed together, they are known by name; a run has four of them, goes on, and is played again as it was."""
    for name in BARS:
        installed(ROOT / "examples" / name)
    out = tmp_path / "out"
    names = "--task push_bin --mode base wet --recorder speed --policy wary".split()
    assert main([str(out) if flag == "OUT" else flag for flag in RUN[2:]] + names) == 0
    said = capsys.readouterr().out
    assert re.search(r"push_bin \| twist2  \| wary   \| wet  \| highest_speed \| 1 \| 0\.\d+ ", said)
    config = json.loads((out / "config.json").read_text())["config"]
    assert list(config["mode_facts"]) == ["wet"] and config["policy_facts"]["code"]
    assert main(["resume", str(out)]) == 0
    assert main(["audit", str(out), "--replay", "2"]) == 0
    lines = (out / "episodes.jsonl").read_text()
    assert lines.count('"highest_speed"') == 2
    assert main([*RUN, "--policy", "stand", "--recorder", "pace"]) == 2
    assert re.match("error: --recorder pace: unknown recorder; known are .*speed", capsys.readouterr().err)
    assert rule_sets.main([]) == 0
    assert capsys.readouterr().out == (ROOT / "docs" / "reference" / "rules.md").read_text(encoding="utf-8")


def test_a_program_of_a_package_plays_by_its_command(installed, tmp_path, capsys):
    """Installed, a program plays by its command, through another package's tracker; results know the program's code."""
    installed(ROOT / "examples" / "new_tracker")
    code = installed(ROOT / "examples" / "new_program") / "squat_program.py"
    names = {"twist2": "homing:0.5", "OUT": str(tmp_path / "out")}
    run = [*(names.get(flag, flag) for flag in RUN), "--policy", "process:squat"]
    assert main(run) == 0
    assert "| boxing | homing:0.5 | process:squat | base |" in capsys.readouterr().out
    facts = json.loads((tmp_path / "out" / "config.json").read_text())["config"]["policy_facts"]
    assert facts["command"] == "squat" and re.fullmatch("squat [0-9a-f]{8}", facts["server"])
    assert not facts["worlds_matter"]
    assert main(run) == 0
    code.write_text(code.read_text().replace("0.05", "0.06"))
    assert main(run) == 2
    assert f"another configuration: policy_facts.server was {facts['server']}, now squat " in capsys.readouterr().err
