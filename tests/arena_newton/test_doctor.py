"""The doctor: extras, what of them works, and trackers and policies by name."""

import importlib.util
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import torch

from arena_newton import doctor, policies, trackers
from arena_newton.__main__ import main
from arena_newton.cli import extras
from arena_newton.data.readers.label_protocols import V4
from arena_newton.files import sandboxed_load
from arena_newton.robot.canonical import STAND_ACTION
from tests.patience import patiently

ROOT = Path(__file__).resolve().parents[2]


def found(findings, subject):
    """The one finding about a subject."""
    (finding,) = [finding for finding in findings if finding.subject == subject]
    return finding


def test_modules_are_tried_in_another_process(tmp_path, monkeypatch):
    """A module that imports has no fault; one that does not, crashes or hangs is reported, in their order."""
    (tmp_path / "dies_at_once.py").write_text("import os\nos.abort()\n")
    (tmp_path / "never_ends.py").write_text("import time\ntime.sleep(100)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    names = ["json", "no_such_module", "dies_at_once", "never_ends"]
    wanted = [None, "No module named 'no_such_module'", sandboxed_load.CRASHED, sandboxed_load.TOO_LONG]

    def check(seconds):
        assert sandboxed_load.faults("module", names, memory=1 << 30, seconds=seconds) == wanted

    patiently(check, (1.0, 10.0, 60.0))


def test_every_extra_is_reported(monkeypatch):
    """Each extra of the package has a line; its name is one of the project's."""
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras.EXTRAS) == set(declared)
    monkeypatch.setattr(doctor, "faults", lambda *_, **__: [None])
    findings = doctor.examine_extras()
    for extra in extras.EXTRAS:
        finding = found(findings, f"extra [{extra}]")
        assert finding.status == "ok" or f"uv sync --extra {extra}" in finding.advice
    for extra, modules in extras.EXTRAS.items():
        monkeypatch.setitem(extras.EXTRAS, extra, (*modules, "no_such_module"))
        assert found(doctor.examine_extras(), f"extra [{extra}]").advice.startswith("needed for ")


def test_a_missing_extra_is_a_note(monkeypatch):
    """A missing library is named with the command that installs it; a bare evaluation runs without."""
    monkeypatch.setattr(doctor, "faults", lambda *_, **__: [None])
    monkeypatch.setitem(extras.EXTRAS, "data", ("json", "no_such_module"))
    finding = found(doctor.examine_extras(), "extra [data]")
    assert finding.status == "note" and finding.value == "without no_such_module"
    assert "uv sync --extra data, or pip install 'arena-newton[data]'" in finding.advice


def test_torchcodec_without_ffmpeg_is_a_note(monkeypatch):
    """A torchcodec that does not load is a note that says what it costs and what to install."""
    if importlib.util.find_spec("torchcodec") is None:
        pytest.skip("needs the extra [data]")
    monkeypatch.setattr(doctor, "faults", lambda *_, **__: ["Could not load libtorchcodec.\nlibavutil.so.56: absent"])
    finding = found(doctor.examine_extras(), "torchcodec")
    assert finding.status == "note" and "libavutil.so.56" in finding.value and "\n" not in finding.value
    assert "apt install ffmpeg" in finding.advice and "2 to 4 times slower" in finding.advice
    whole = "Likely causes: FFmpeg is not installed in your environment. "
    monkeypatch.setattr(doctor, "faults", lambda *_, **__: [whole + "We support versions 4 to 8" + " and more" * 9])
    assert found(doctor.examine_extras(), "torchcodec").value == f"does not load ({whole[:-2]})", "no half sentence"
    monkeypatch.setattr(doctor, "faults", lambda *_, **__: [None])
    assert found(doctor.examine_extras(), "torchcodec").status == "ok"


class Deaf(trackers.Tracker):
    """Answers one row, however many worlds there are."""

    name = "deaf"

    def step(self, command, state, mask=None):
        return command.joints[:1]


def test_a_tracker_by_name(monkeypatch, capsys):
    """A tracker that conforms is 0, one that does not is 1 with its broken promises; both spellings are one command."""
    trackers.register("deaf", lambda checkpoint: Deaf())
    for arguments in (["doctor", "--tracker", "pd"], ["doctor", "--tracker=pd"], ["trackers", "check", "pd"]):
        assert main(arguments) == 0
        assert capsys.readouterr().out.endswith("tracker pd: keeps all 13 promises\n")
    assert main(["doctor", "--tracker", "deaf"]) == 1
    assert "! targets " in (out := capsys.readouterr().out) and "expected a float32 tensor [3, 29]" in out


def test_its_module_is_the_doctor(monkeypatch, capsys):
    """`python -m arena_newton.doctor` is the command of that name, with all its flags."""
    for arguments, said in (["--x"], "doctor --x: unknown"), (["--tracker"], "doctor --tracker: name the tracker"):
        monkeypatch.setattr(sys, "argv", [doctor.__file__, *arguments])
        with pytest.raises(SystemExit) as stopped:
            runpy.run_path(doctor.__file__, run_name="__main__")
        assert stopped.value.code == 2 and capsys.readouterr().err.startswith(f"error: {said}")


def test_an_unknown_name_is_refused_at_once():
    """A name that nobody offers is one line before torch and Warp are loaded, which takes seconds."""
    code = (
        "import sys\nfrom arena_newton.__main__ import main\n"
        "print([main(['doctor', flag, 'nope']) for flag in ('--tracker', '--policy')])\n"
        "print({'torch', 'warp', 'newton', 'mujoco'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500, cwd=ROOT)
    assert done.stdout == "[2, 2]\nset()\n" and done.stderr.count("nope: unknown") == done.stderr.count("\n") == 2


def test_a_strangers_tracker_by_name(installed_falcon, shared, capsys):
    """An installed package's tracker is examined by its name, with the checkpoint that it needs."""
    assert main(["doctor", "--tracker", "falcon"]) == 2
    assert "g1_29dof.onnx" in capsys.readouterr().err
    checkpoint = shared / "reference/falcon/falcon_g1_29dof.onnx"
    assert main(["doctor", "--tracker", "falcon", "--checkpoint", str(checkpoint)]) == 0


class Rash(policies.Policy):
    """Answers an action without a chunk."""

    name = "rash"

    def act(self, observation):
        return policies.Chunk(STAND_ACTION[None])


class Turns(policies.Policy):
    """Turns on the spot by labels of v4, which are no actions of v3.1."""

    name, labels = "turns", "v4"

    def act(self, observation):
        actions = torch.zeros(len(observation.state), 1, 40)
        actions[..., V4["root_z"]], actions[..., V4["yaw_rate"]] = 0.8, 0.5
        return policies.Chunk(actions)


def test_a_policy_by_name(capsys):
    """A policy that conforms in its own labels is 0, one that does not is 1; one that reads the world is given one."""
    policies.register("rash", lambda argument: Rash())
    policies.register("turns", lambda argument: Turns())
    assert main(["doctor", "--policy", "turns"]) == 0
    assert main(["doctor", "--policy", "stand"]) == 0
    assert main(["doctor", "--policy", "expert", "--task", "boxing", "--seeds", "3", "4"]) == 0
    assert "not tried in real worlds" in capsys.readouterr().out
    assert main(["policies", "check", "rash"]) == 1
    assert "! chunk " in (out := capsys.readouterr().out) and "[1, 40], expected [3, n, 40]" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("doctor --tracker", "doctor --tracker: name the tracker behind it"),
        ("doctor --policy --task boxing", "doctor --policy: name the policy behind it"),
        ("doctor --tracker nothing", "--tracker nothing: unknown tracker"),
        ("doctor --tracker pd --worlds 1", "--worlds 1: masks need at least 2"),
        ("doctor --tracker pd --worlds x", "--worlds: invalid int value"),
        ("doctor --tracker twist2 --checkpoint none.onnx", "none.onnx: no such file"),
        ("doctor --policy nothing", "--policy nothing: unknown policy"),
        ("doctor --policy stand --task nothing", "nothing"),
        ("doctor --policy stand --seeds 1 1", "--seeds 1 1: masks need at least 2 different ones"),
        ("doctor --scene", "doctor --scene: unknown, expected --tracker NAME or --policy SPEC"),
    ],
)
def test_bad_input_is_one_line(arguments, said, capsys):
    """Names that cannot be examined are one line with exit code 2."""
    assert main(arguments.split()) == 2
    error = capsys.readouterr().err
    assert said in error and error.startswith("error: ") and error.count("\n") == 1
