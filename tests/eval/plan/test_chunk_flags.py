"""Execution of chunks: --latency-ticks, --replan, --ensemble, and the protocol that a policy says of itself."""

import dataclasses
import json

import pytest
import torch
from eval_fakes import FakePolicy, factories
from made_folders import document_of
from rows import episodes, record

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.results import RunRecord, load_run
from arena_newton.eval.plan.config import recording_run, resolve
from arena_newton.eval.plan.options import RecordOptions, RunOptions
from arena_newton.eval.play.recording import disturbance_of, facts_of
from arena_newton.eval.play.run import check_parts
from arena_newton.eval.reports.wording import replay_command
from arena_newton.eval.tables.run_table import joint_table
from arena_newton.interfaces import Chunk

PLAIN = ["--task", "boxing", "--seeds", "0", "--repeats", "3", "--worlds", "2", "--max-steps", "50"]


def run(out, *flags, **parts):
    """The command with stand-ins; its exit code."""
    return main(["run", *PLAIN, "--engine", "mujoco", "--device", "cpu", "--out", str(out), *flags], factories(**parts))


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--latency-ticks", "-1"], "--latency-ticks -1: expected at least 0"),
        (["--latency-ticks", "100"], "--latency-ticks 100: expected fewer ticks than the policy's chunk of 100"),
        (["--replan", "0"], "--replan 0: expected at least 1"),
        (["--replan", "5"], "--replan: belongs to --policy lerobot:<checkpoint>, not expert"),
        (["--ensemble"], "--ensemble: belongs to --policy lerobot:<checkpoint>, not expert"),
        (["--replan", "5", "--latency-ticks", "5"], "--latency-ticks 5: expected fewer ticks than --replan 5"),
        (["--ensemble", "--latency-ticks", "2"], "--latency-ticks 2: --ensemble queries every tick"),
        (["--replan", "5", "--policy", "remote:http://h:1"], "--replan: belongs to --policy lerobot:"),
        (["--mode", "base", "base+picture_noise=2"], "picture_noise=2: picture_noise, but the policy wants no picture"),
    ],
)
def test_flags_that_contradict_are_refused(tmp_path, capsys, flags, says):
    """One line that names the flag, exit code 2, and no folder."""
    assert run(tmp_path / "out", *flags) == 2
    assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_actions_are_replayed_in_a_mode_with_noise_of_pictures():
    """A replay wants no picture; the policy whose actions it has did."""
    options = RunOptions(task=("boxing",), seeds=(0,), repeats=1, engine="mujoco", mode=("base+picture_noise=2",))
    config, _ = check_parts(resolve(options), factories(), replayed=True)
    assert not config.cameras


def test_a_chunk_that_shows_to_be_too_short_stops_the_run(tmp_path, capsys):
    """A policy that does not say its chunk's length is refused at its first query; nothing is journalled."""

    class Short(FakePolicy):
        chunk_size = 1

        def act(self, observation):
            return Chunk(torch.zeros(len(observation.mask), 3, 40))

    assert run(tmp_path / "out", "--latency-ticks", "3", policy=Short) == 2
    assert "--latency-ticks 3: policy expert gives chunks of 3 actions" in capsys.readouterr().err
    assert not load_run(tmp_path / "out").records


def test_latency_belongs_to_a_run(tmp_path, capsys):
    """It is part of the identity, kept by resume, named by the report, and a folder of another one is refused."""
    out = tmp_path / "late"
    assert run(out, "--latency-ticks", "4") == 0
    assert load_run(out).config["latency_ticks"] == 4
    assert "Each chunk starts 4 ticks (80 ms) after the policy's query." in (out / "report.md").read_text()
    assert main(["resume", str(out)], factories()) == 0
    capsys.readouterr()
    assert run(out) == 2
    assert "latency_ticks was 4, now -" in capsys.readouterr().err
    options = json.loads((out / "config.json").read_text())["options"]
    assert "--latency-ticks 4" in replay_command(options, load_run(out).records[0])


def test_the_usual_is_not_in_the_identity():
    """Chunks executed whole and at once are known as before these flags."""
    config = resolve(RunOptions(task=("boxing",), engine="mujoco", device="cpu"))
    assert not {"latency_ticks", "replan", "ensemble"} & set(config.identity())


def test_a_checkpoint_is_made_with_the_flags(tmp_path, monkeypatch):
    """--replan and --ensemble go to `lerobot:` as options, and into the identity."""
    monkeypatch.setattr(policies, "check_spec", lambda spec: None)
    (tmp_path / "config.json").write_text("{}")
    spec = f"lerobot:{tmp_path}"
    chosen = resolve(RunOptions(task=("boxing",), engine="mujoco", device="cpu", policy=spec, replan=5))
    assert chosen.policy_options["replan"] == 5 and chosen.policy_options["ensemble"] is False
    assert chosen.identity()["replan"] == 5 and chosen.stored_flags()["replan"] == 5
    both = resolve(RunOptions(task=("boxing",), engine="mujoco", device="cpu", policy=spec, ensemble=True))
    assert both.policy_options["ensemble"] is True and both.identity()["ensemble"] is True


def test_a_policy_names_its_own_protocol(tmp_path):
    """Without --labels a policy that says v4 is decoded from v4, and the run is known by it; the flag contradicts."""

    class Fourth(FakePolicy):
        labels = "v4"

    assert run(tmp_path / "v4", policy=Fourth) == 0
    assert load_run(tmp_path / "v4").config["labels"] == "v4"
    assert main(["resume", str(tmp_path / "v4")], factories(policy=Fourth)) == 0
    assert run(tmp_path / "other", "--labels", "v3.1", policy=Fourth) == 2
    assert run(tmp_path / "plain") == 0 and load_run(tmp_path / "plain").config["labels"] == "v3.1"


def test_latencies_are_rows_of_one_table(tmp_path):
    """The same episodes at two latencies make two rows, which name them, instead of a conflict."""
    rows = episodes("boxing", (4, 5, 7))
    changes = ({}, {"latency_ticks": 5}, {"latency_ticks": 5, "replan": 10})
    runs = [
        RunRecord(tmp_path / str(n), document_of(len(rows), **config), [record(row) for row in rows])
        for n, config in enumerate(changes)
    ]
    text = joint_table(runs)
    assert "| p, 5 ticks late " in text and "| p, queried every 10 ticks, 5 ticks late " in text
    with pytest.raises(InputError, match="is in .* too"):
        joint_table([runs[1], dataclasses.replace(runs[1], folder=tmp_path / "again")])


def recording(**changes):
    """A resolved recording of three tasks."""
    options = RecordOptions(task=("boxing", "pp_box", "double_desk"), engine="mujoco", device="cpu", **changes)
    return resolve(recording_run(options))


def test_tasks_are_disturbed_by_factors_of_their_own():
    """The factor of task and flag scales deviations, not times; identity and files name both."""
    config = recording()
    levels = {task: disturbance_of(config, task, 10).levels for task in config.flags.task}
    assert levels["boxing"].joints == 0.08 and levels["pp_box"].joints == levels["double_desk"].joints == 0.02
    assert levels["pp_box"].velocity == 0.04 and levels["pp_box"].yaw_rate == 0.06
    assert levels["pp_box"].joints_time == 0.3 and levels["pp_box"].yaw_leak == 10.0
    scales = {"boxing": 2.0, "pp_box": 0.5, "double_desk": 0.5}
    assert config.identity()["disturbance"]["scale"] == scales
    assert facts_of(config, "pp_box", "twist2", "base", {}, {})["disturbance"] == levels["pp_box"].describe()
    half = recording(disturb_scale=0.5)
    assert disturbance_of(half, "pp_box", 10).levels.joints == 0.01 and half.hash != config.hash
    still = recording(disturb=False)
    assert disturbance_of(still, "boxing", 10) is None and still.identity()["disturbance"] is None


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"disturb_scale": -0.1}, "--disturb-scale -0.1: expected 0 to 10"),
        ({"disturb_scale": float("nan")}, "--disturb-scale nan: expected 0 to 10"),
        ({"disturb_scale": 0.5, "disturb": False}, "--disturb-scale: belongs to disturbed execution"),
    ],
)
def test_an_unfit_scale_is_refused(changes, says):
    """A factor out of range, or one of no disturbance, is one error that names the flag."""
    with pytest.raises(InputError, match=says):
        recording_run(RecordOptions(**changes))
