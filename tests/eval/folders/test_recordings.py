"""`run --actions` keeps what a policy decided; `replay:` plays each episode's own recording."""

import hashlib
import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.recordings import ActionRecorder, packed_actions
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.records.journal import write_atomic
from arena_newton.files.untrusted_files import array_digest, read_arrays
from arena_newton.interfaces import Observation
from arena_newton.rules.seeding import policy_seed

RUN = ["--task", "boxing", "--seeds", "3", "--repeats", "2", "--engine", "mujoco", "--max-steps", "20", "--worlds", "2"]


def journal(folder):
    return [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]


def ends(folder):
    return {r["episode_seed"]: (r["outcome"], r["steps"], r["margin"]) for r in journal(folder)}


@pytest.fixture(scope="module")
def play(kept_worlds):
    """Runs the command `run` in environments that stay."""
    return lambda *flags: main(["run", *flags], Factories(env=kept_worlds))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, play):
    """A run of the expert in closed loop, with its actions."""
    out = tmp_path_factory.mktemp("recorded") / "run"
    assert play(*RUN, "--policy", "expert", "--actions", "--out", str(out)) == 0
    return out


def test_what_ran_stands_with_the_results(recorded):
    """Engine, physics rate, drive, start-up, tracker and what runs its network stand in config.json."""
    document = json.loads((recorded / "config.json").read_text())
    facts = document["environments"]["boxing twist2 base"]
    assert {"engine", "device", "physics_dt", "substeps", "drive", "startup_ticks", "history"} <= set(facts)
    assert facts["engine"] == "mujoco" and facts["startup_ticks"] == 50
    assert facts["tracker"]["name"] == "twist2" and facts["tracker"]["inference"]
    assert facts["processor"] == torch.backends.cpu.get_cpu_capability()
    assert document["config"]["policy_facts"]["name"] == "expert"
    hashes = {json.dumps(row["hashes"], sort_keys=True) for row in journal(recorded)}
    assert len(hashes) == 1 and '"environment": "' in hashes.pop()


def test_replay_through_the_same_tracker_is_the_same_run(recorded, tmp_path, play):
    """Open loop, the same tracker comes to the same end, margin included, with other worlds beside it."""
    files = sorted(p.name for p in (recorded / "actions").iterdir())
    assert files == ["boxing_base_s3_r0.npz", "boxing_base_s3_r1.npz"]
    with np.load(recorded / "actions" / files[0]) as arrays:
        assert arrays["action"].shape == (20, 40) and str(arrays["task"]).startswith("Isaac-Move-Boxing")
    out = tmp_path / "again"
    replay = ["--policy", f"replay:{recorded / 'actions'}"]
    assert play(*RUN[:-1], "1", *replay, "--out", str(out)) == 0
    assert ends(out) == ends(recorded)


def test_an_audit_plays_what_the_journal_says(recorded, tmp_path, kept_worlds, capsys):
    """A replay from actions alone confirms an honest line to the last bit, and finds one that agrees with itself."""
    made = Factories(env=kept_worlds)
    assert main(["audit", str(recorded), "--replay", "1", "--draw", "7"], made) == 0
    assert "level replayed" in capsys.readouterr().out
    forged = shutil.copytree(recorded, tmp_path / "forged")
    first, second = journal(forged)
    first["margin"] += 1e-9
    line = json.dumps(first, separators=(",", ":")).encode() + b"\n"
    second["previous"] = hashlib.sha256(line).hexdigest()
    (forged / "episodes.jsonl").write_bytes(line + json.dumps(second, separators=(",", ":")).encode() + b"\n")
    assert main(["report", str(forged)]) == 0 and main(["audit", str(forged)]) == 0
    assert main(["audit", str(forged), "--all", "--out", str(tmp_path)], made) == 1
    content = json.loads((tmp_path / "audit.json").read_text())[str(forged)]
    (found,) = content["contradictions"]
    assert f"episode {first['index']}: margin is " in found and content["level"] == "self-reported"


def test_another_tracker_gets_the_same_actions(recorded, tmp_path, play):
    """The swap: sonic plays what was decided while twist2 walked, and ends elsewhere."""
    out = tmp_path / "swap"
    replay = ["--policy", f"replay:{recorded / 'actions'}", "--tracker", "sonic"]
    assert play(*RUN, *replay, "--out", str(out)) == 0
    assert {r["outcome"] for r in journal(out)} <= {"timeout", "fall", "success"}
    assert ends(out) != ends(recorded)


def test_an_episode_without_a_recording_is_an_error_of_its_own(recorded):
    """It names the task; the other worlds go on."""
    policy = policies.get(f"replay:{recorded / 'actions'}")
    seed = journal(recorded)[0]["episode_seed"]
    with np.load(recorded / "actions" / "boxing_base_s3_r0.npz") as arrays:
        task = str(arrays["task"])
    policy.reset([policy_seed(seed), policy_seed(seed + 1)], [task, task])
    chunk = policy.act(Observation(np.zeros((2, 64)), None, np.array([True, True]), "boxing", task, ""))
    assert list(chunk.errors) == [1] and f"no recording of this episode of {task}, mode base" in chunk.errors[1]
    assert np.isfinite(chunk.actions).all() and chunk.actions[0].any()


def test_modes_are_kept_apart(tmp_path, capsys, play):
    """A run of two modes plays again, each mode with its own recordings; another task is refused first."""
    out, again = tmp_path / "run", tmp_path / "again"
    modes = [*RUN, "--mode", "base", "execution", "--max-steps", "5", "--repeats", "1"]
    assert play(*modes, "--policy", "stand", "--actions", "--out", str(out)) == 0
    replay = ["--policy", f"replay:{out / 'actions'}"]
    assert play(*modes, *replay, "--out", str(again)) == 0
    first, second = (sorted((r["mode"], r["outcome"], r["margin"]) for r in journal(f)) for f in (out, again))
    assert first == second and {r["policy"] for r in journal(again)} == {"replay:run"}
    capsys.readouterr()
    assert play("--task", "football", *replay, "--out", str(tmp_path / "no")) == 2
    assert "no recording of task football" in capsys.readouterr().err
    assert play(*RUN, *replay, "--mode", "semantic", "--out", str(tmp_path / "no")) == 2
    assert "in mode semantic, only base, execution" in capsys.readouterr().err
    other = [*modes, "--seeds", "999", *replay, "--out", str(tmp_path / "no")]
    assert play(*other) == 2
    assert "but of other --seeds" in capsys.readouterr().err


def test_unfit_folders_are_refused(recorded, tmp_path):
    """No recordings, no seed in them, or two of one episode."""
    with pytest.raises(InputError, match="no recordings"):
        policies.get(f"replay:{tmp_path}")
    source = recorded / "actions" / "boxing_base_s3_r0.npz"
    for name in ("a.npz", "b.npz"):
        (tmp_path / name).write_bytes(source.read_bytes())
    with pytest.raises(InputError, match="b.npz: a second recording of episode seed"):
        policies.get(f"replay:{tmp_path}")
    (tmp_path / "b.npz").unlink()
    with np.load(source) as arrays:
        np.savez(tmp_path / "c.npz", action=arrays["action"])
    with pytest.raises(InputError, match="c.npz: episode_seed, task and mode are missing or unfit"):
        policies.get(f"replay:{tmp_path}")


def test_recordings_follow_no_link(tmp_path):
    """A link that lies where a recording is written leads nowhere; its temporary name cannot be foreseen."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    folder = tmp_path / "actions"
    folder.mkdir()
    (folder / "boxing_base_s0_r0.npz").symlink_to(victim)
    recorder = ActionRecorder(lambda name, content: write_atomic(folder.parent / name, content), folder.name)
    env = SimpleNamespace(active=np.array([True, True]), tick=np.array([-1, 0]), spec=SimpleNamespace(gym_id="gym"))
    env.physics = SimpleNamespace(qpos=torch.ones(2, 7), qvel=torch.zeros(2, 6))
    for world in (0, 1):
        recorder.start(env, world, None)
    for _ in range(3):
        recorder.before_physics(env, None, torch.ones(2, 40))
    episode = SimpleNamespace(index=0, episode_seed=7, key="boxing/base/s0/r0", mode="base")
    recorder.finish(env, 0, SimpleNamespace(episode=episode, steps=0))  # it never acted
    recorder.finish(env, 1, SimpleNamespace(episode=episode, steps=3))
    (path,) = folder.iterdir()
    assert victim.read_text() == "mine" and not path.is_symlink() and path.name == "boxing_base_s0_r0.npz"
    with np.load(path) as arrays:
        assert arrays["action"].shape == (3, 40)


def test_the_hash_of_actions_is_of_their_content(tmp_path):
    """Actions packed by another zlib have the same hash; another number, type or name has not."""
    file, digest = packed_actions([np.zeros(40, np.float32)] * 3, episode_seed=1, gym_id="a", mode="base", queries=[0])
    (tmp_path / "a.npz").write_bytes(file)
    arrays = read_arrays(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **dict(reversed(arrays.items())))
    assert (tmp_path / "b.npz").read_bytes() != file and array_digest(read_arrays(tmp_path / "b.npz")) == digest
    for change in ({"queries": np.int32([1])}, {"action": arrays["action"].astype(np.float64)}, {"more": np.zeros(1)}):
        assert array_digest(arrays | change) != digest
