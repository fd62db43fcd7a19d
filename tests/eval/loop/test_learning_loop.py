"""The whole loop: every stage resumes, none is repeated, other folders are refused, the report says what happened."""

import dataclasses
import importlib.util
import json
import os
import random
import shutil
import signal
from collections import namedtuple

import pytest
import torch
from safetensors.torch import save_file

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.loop import learning_loop
from arena_newton.eval.loop.learning_loop import LOOP_FILE, is_begun, resolved
from arena_newton.eval.loop.loop_options import LoopOptions
from arena_newton.eval.loop.loop_report import worked_seconds
from arena_newton.eval.records.journal import Journal
from arena_newton.files.new_folder import held_folder
from arena_newton.files.text import is_printable
from tests.children import Child
from tests.fuzz.mutants import damaged

FLAGS = ["--small", "--task", "boxing", "--tracker", "pd", "--engine", "mujoco", "--device", "cpu", "--episodes", "2"]
FLAGS += ["--steps", "6", "--max-steps", "12", "--worlds", "2", "--seed", "3"]


@pytest.fixture(scope="module")
def looped(tmp_path_factory, parts):
    """A small loop: interrupted in recording and before training, killed in training, interrupted in evaluation."""
    out, codes, append = tmp_path_factory.mktemp("loop") / "out", [], Journal.append
    flags = [*FLAGS, "--out", str(out)]

    def stop(*_):
        signal.raise_signal(signal.SIGINT)

    def played(owner, name, call):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(owner, name, call)
            codes.append(main(["loop", *flags], parts))

    played(Journal, "append", lambda *given: (append(*given), stop()))
    first = [record.index for record in load_run(out / "demonstrations").records]
    played(learning_loop, "train", stop)
    made = {path: path.stat().st_mtime_ns for path in sorted((out / "dataset").rglob("*")) if path.is_file()}
    process = Child("killed_loop", flags)
    assert process.wait() == -signal.SIGKILL, process.communicate()
    played(Journal, "append", lambda *given: (append(*given), stop()))
    assert len(load_run(out / "evaluation").records) == 1
    played(Journal, "append", append)
    return out, codes, first, made


def test_kills_cost_no_finished_stage(looped):
    """After Ctrl-C and kill -9 in its stages the same command finishes; what was finished is not made again."""
    out, codes, first, made = looped
    assert codes == [130, 130, 130, 0] and len(first) == 1 and made
    assert {path: path.stat().st_mtime_ns for path in made} == made
    assert len((out / "demonstrations" / "episodes.jsonl").read_text().splitlines()) == 2
    assert len((out / "evaluation" / "episodes.jsonl").read_text().splitlines()) == 3
    checkpoint = (out / "training" / "checkpoints" / "last").resolve()
    assert (checkpoint / "pretrained_model" / "model.safetensors").is_file() and checkpoint.name == "000006"


def test_the_trained_policy_sees_and_is_evaluated(looped):
    """The evaluation plays 3 group seeds with the checkpoint of this loop and with a camera of the recorded size."""
    out, *_ = looped
    run = load_run(out / "evaluation")
    assert len(run.records) == 3 and {record.outcome for record in run.records} <= {"success", "fall", "timeout"}
    assert run.config["policy"].startswith("lerobot:") and run.config["policy_facts"]
    assert all(record.media for record in run.records)


def test_the_report_has_times_rate_curve_and_strips(looped):
    """Markdown and page name stages, the rate with its interval, the training and a strip that exists."""
    out, *_ = looped
    text, page = (out / "loop.md").read_text(), (out / "loop.html").read_text()
    won = sum(record.outcome == "success" for record in load_run(out / "evaluation").records)
    for words in ("record demonstrations", "95 % Wilson", "recipe small, 6 steps", "evaluate", f"{won}/3"):
        assert words in text and words in page, words
    assert "<polyline" in page and "script-src" not in page and "<script" not in page
    strips = [line.split("](")[1].rstrip(")") for line in text.splitlines() if line.startswith("![")]
    assert strips and all((out / path).is_file() and path in page for path in strips)


def test_a_finished_loop_only_writes_its_report(looped, tmp_path, capsys, monkeypatch):
    """The same command trains and plays nothing, also in a folder that was moved or lacks what earlier stages left."""
    out = tmp_path / "moved"
    shutil.copytree(looped[0], out, symlinks=True)
    flags = ["loop", *FLAGS, "--out", str(out)]
    monkeypatch.setattr(learning_loop, "train", lambda options: pytest.fail("trained again"))
    monkeypatch.setattr(learning_loop, "execute", lambda *a: pytest.fail("played again"))
    texts = []
    for _ in range(2):
        assert main(flags) == 0 and capsys.readouterr().out.count("finished before") == 4
        texts.append((out / "loop.md").read_text())
        (out / "loop.html").unlink()
    assert texts[0] == texts[1] and "| record demonstrations" in texts[0]
    for name in ("demonstrations", "dataset", "training/checkpoints"):
        shutil.rmtree(out / name)
    assert main(flags) == 0 and capsys.readouterr().out.count("finished before") == 4
    assert (out / "loop.html").is_file()


def test_pauses_are_no_time_of_a_stage(looped):
    """A stage's time is that in which its last call worked or an episode of an earlier one was played."""
    run = load_run(looped[0] / "demonstrations")
    at = "2026-01-01T{}+00:00".format
    spans = [("10:00:00.000", "10:00:30.000"), ("10:00:20.000", "10:00:50.000")]
    records = [dataclasses.replace(run.records[0], started_at=at(a), finished_at=at(b)) for a, b in spans]
    status = {"state": "success", "started_at": at("12:00:00"), "finished_at": at("12:01:00"), "error": None}
    found = dataclasses.replace(run, records=records, document=run.document | {"status": status})
    assert worked_seconds(found) == 50.0 + 60.0


def test_another_loop_is_refused(looped, capsys):
    """A folder that was begun with other flags, and one that holds something else, is one line and code 2."""
    out, *_ = looped
    flags = [*FLAGS[:-1], "4"]
    assert main(["loop", *flags, "--out", str(out)]) == 2
    assert "was begun with --seed 3, now 4" in capsys.readouterr().err
    assert main(["loop", *FLAGS, "--out", str(out / "dataset")]) == 2
    assert "is not empty and holds no loop" in capsys.readouterr().err


def test_a_stage_of_other_code_says_how_to_go_on(tmp_path):
    """A stage whose folder was begun by other code names the folder to remove, not a flag that the loop lacks."""
    options = resolved(dataclasses.replace(_small(), out=str(tmp_path)))
    stage = tmp_path / "demonstrations"
    stage.mkdir()
    (stage / "config.json").write_text("{}")
    with pytest.raises(InputError) as caught:
        learning_loop._Loop(options, tmp_path).play()
    assert str(caught.value).endswith(f", or remove {stage}, and the loop's command plays this stage again")


def test_ctrl_c_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    """An interruption in training is code 130 and the command to continue; the next call resumes the training."""
    given = []

    def stop(options):
        given.append(options)
        (tmp_path / "training" / "checkpoints" / "last").mkdir(parents=True, exist_ok=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(learning_loop, "train", stop)
    (tmp_path / "dataset").mkdir()
    for _ in range(2):
        assert learning_loop._Loop(resolved(dataclasses.replace(_small(), out=str(tmp_path))), tmp_path).play() == 130
    assert "continue with: python -m arena_newton.eval loop --task boxing" in capsys.readouterr().out
    assert given[0].resume is None and given[1].resume == tmp_path / "training"


def _small():
    return LoopOptions(task=("boxing",), tracker="pd", engine="mujoco", device="cpu", small=True)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--minutes", "0"], "--minutes 0: expected more than 0"),
        (["--minutes", "2", "--steps", "5"], "--steps: is given by --minutes too"),
        (["--episodes", "0"], "--episodes 0: expected at least 1"),
        (["--policy", "ppo"], "--policy ppo: unknown"),
        (["--recipe", "mine"], "--recipe mine: unknown"),
        (["--task", "chess"], "chess"),
        (["--tracker", "nobody"], "--tracker nobody"),
        (["--size", "63x63"], "--size 63x63"),
        (["--size", "128x128"], "--size 128x128: recipe act/fast takes 224x224"),
        (["--recipe", "compact", "--policy", "flow"], "compact"),
    ],
)
def test_unfit_flags_are_refused_first(tmp_path, capsys, flags, says):
    """One line that names the flag, exit code 2, and no folder."""
    out = tmp_path / "out"
    assert main(["loop", "--engine", "mujoco", "--device", "cpu", *flags, "--out", str(out)]) == 2
    assert says in capsys.readouterr().err and not out.exists()


LACKING = [
    (["--weights", "{tmp}/absent"], "--weights {tmp}/absent: no such folder"),
    (["--weights", "somebody/absent-resnet"], "HF_HUB_OFFLINE forbids"),
    (["--weights", "{tmp}/empty"], "holds no weights"),
    (["--weights", "{tmp}/other"], "not those of a resnet18"),
    (["--policy", "pi05", "--recipe", "fast", "--size", "224x224"], "lerobot/pi05_base: neither a folder nor"),
    (["--seed", "-1"], "--seed -1"),
]


@pytest.mark.parametrize(("flags", "says"), LACKING)
def test_what_a_later_stage_lacks_is_said_first(tmp_path, capsys, monkeypatch, flags, says):
    """Weights that are absent or another network's end a loop with code 2 before anything is recorded or made."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(learning_loop, "execute", lambda *a: pytest.fail("recorded"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    save_file({"conv1.weight": torch.zeros(2, 2)}, tmp_path / "other" / "model.safetensors")
    given = [flag.format(tmp=tmp_path) for flag in flags]
    assert main(["loop", *FLAGS, *given, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert says.format(tmp=tmp_path) in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_missing_extra_is_said_first(tmp_path, capsys, monkeypatch):
    """The extra of a family that the training needs is looked for at the beginning."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "diffusers" else find(name))
    assert main(["loop", *FLAGS, "--policy", "diffusion", "--out", str(tmp_path / "out")]) == 2
    assert "needs the extra [policies]" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_folder_that_cannot_hold_the_loop_is_refused(tmp_path, capsys, monkeypatch):
    """A disk that is too full, a path through a file and one without permission are found before anything is made."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(learning_loop, "check_training", lambda options: 3_000_000_000)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**12, 0, 3_000_000_000))
    with pytest.raises(InputError, match=r"take about 3\.1 GB, 3\.0 GB are free there"):
        learning_loop.run(dataclasses.replace(_small(), out=str(tmp_path / "out")))
    assert main(["loop", *FLAGS, "--out", str(tmp_path / "file" / "out")]) == 2
    assert f"{tmp_path}/file is a file" in capsys.readouterr().err
    monkeypatch.setattr(os, "access", lambda *a: False)
    assert main(["loop", *FLAGS, "--out", str(tmp_path / "out")]) == 2
    assert "no permission" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_loop_that_goes_on_is_checked_for_what_is_left(tmp_path, monkeypatch):
    """A loop whose training is to come is checked again when it goes on; what is recorded counts as free."""
    options = resolved(dataclasses.replace(_small(), out=str(tmp_path)))
    write_flags(tmp_path, options)
    (tmp_path / "dataset").mkdir()

    def lacking(options):
        raise InputError("--weights: absent now")

    monkeypatch.setattr(learning_loop, "check_training", lacking)
    with pytest.raises(InputError, match="absent now"):
        learning_loop.run(options)
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**12, 0, 50_000_000))
    (tmp_path / "dataset" / "film.mp4").write_bytes(bytes(2_000_000))
    trained = []
    monkeypatch.setattr(learning_loop, "check_training", lambda options: trained.append(options.out) or 1_000_000)
    learning_loop._Loop(options, tmp_path).check()
    assert trained == [tmp_path / "training"]


def write_flags(out, options):
    """Write loop.json."""
    (out / LOOP_FILE).write_text(json.dumps({"options": dataclasses.asdict(options)}))


def test_two_processes_do_not_share_a_folder(tmp_path, capsys):
    """A folder in which another process works is refused."""
    with held_folder(tmp_path / "out", "works in it"):
        assert main(["loop", *FLAGS, "--out", str(tmp_path / "out")]) == 2
    assert "another process works in it" in capsys.readouterr().err


def test_a_damaged_file_is_one_error(tmp_path, mutants):
    """A damaged loop.json is one error that names the file or the flag, and nothing is overwritten."""
    options = resolved(dataclasses.replace(_small(), out=str(tmp_path)))
    write_flags(tmp_path, options)
    path, refused, rng = tmp_path / LOOP_FILE, 0, random.Random(0)
    good = path.read_bytes()
    assert is_begun(tmp_path, options)
    for _ in range(mutants):
        path.write_bytes(content := damaged(good, rng, text=True))
        try:
            assert is_begun(tmp_path, options)
        except InputError as error:
            assert str(error).startswith((str(path), f"--out {tmp_path}: was begun with --"))
            assert is_printable(str(error))
            refused += 1
        assert path.read_bytes() == content
    assert refused > mutants / 6


def test_a_folder_that_is_refused_stays_as_it_was(tmp_path, capsys):
    """Nothing is left in the folder of a damaged loop.json, or of one of other flags."""
    path, out = tmp_path / LOOP_FILE, ["--out", str(tmp_path)]
    path.write_text("{")
    assert main(["loop", *FLAGS, *out]) == 2
    assert f"error: {path}: not readable as JSON" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == [LOOP_FILE] and path.read_text() == "{"
    path.write_text(json.dumps({"options": {"task": ["football"]}}))
    assert main(["loop", *FLAGS, *out]) == 2
    assert "was begun with --task football" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == [LOOP_FILE]


@pytest.mark.parametrize("given", ["", " "])
def test_an_empty_out_is_refused(tmp_path, capsys, monkeypatch, given):
    """It would be the folder in which the command was typed."""
    monkeypatch.chdir(tmp_path)
    assert main(["loop", *FLAGS, "--out", given]) == 2
    assert capsys.readouterr().err == "error: --out: is empty, name a folder\n"
    assert not list(tmp_path.iterdir())
