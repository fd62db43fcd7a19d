"""One checkpoint through our runner and through LeRobot's: the same ticks and the same outcomes."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from lerobot.scripts.lerobot_eval import eval_main
from made_checkpoints import SIDE, facts, save

from arena_newton import trackers
from arena_newton.eval.__main__ import main
from arena_newton.eval.adapters import gym
from arena_newton.eval.plan import episode_plan
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.rollout import Rollout

sys.path.insert(0, str(Path(__file__).parents[2] / "eval"))
from watched import WatchedEnv

TICKS = 13
"""Step budget of an episode, more than two chunks."""


@pytest.fixture(scope="module")
def fast(tmp_path_factory):
    """A random ACT of v4 that looks through three cameras and turns, realigned so that it matters in a second."""
    about = facts(labels="v4", realign=0.05, family="act")
    return save(
        tmp_path_factory.mktemp("fast"), "act", facts=about, spread=0.1, cameras=("front", "left_wrist", "right_wrist")
    )


def test_a_v4_checkpoint_through_lerobot_eval(fast, tmp_path, monkeypatch):
    """Actions are decoded per world, with the heading measured at the policy's queries: every tick is the same."""
    monkeypatch.setattr(gym, "ArenaEnv", WatchedEnv)
    policy = LeRobotPolicy(fast)
    env = WatchedEnv(
        "boxing", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", device="cpu", cameras=policy.cameras
    )
    episodes = episode_plan.expand(["boxing"], trackers=["twist2"], policy="test", seeds=[0], repeats=2)
    ours = {}
    for policy.realign in (0.0, 0.05):
        WatchedEnv.history.clear()
        results = Rollout(env, read_by(policy, "v4"), episodes, max_steps=TICKS).run()
        ours[policy.realign] = dict(WatchedEnv.history)
    env.close()
    assert ours[0.0] != ours[0.05], "realignment does something"
    WatchedEnv.history.clear()
    flags = ["--env.discover_packages_path=arena_newton.eval.adapters.lerobot_env", "--env.type=arena_newton"]
    flags += ["--env.task=boxing", "--env.engine=mujoco", "--env.device=cpu", f"--env.image_width={SIDE}"]
    flags += [f"--env.image_height={SIDE}", f"--env.episode_length={TICKS}", "--env.labels=v4"]
    flags += ["--env.realign=0.05", f"--env.query_ticks={policy.chunk_size}", f"--policy.path={fast}"]
    # One row per forward pass, as on our CPU: with more, libraries sum in another order.
    flags += ["--policy.device=cpu", "--eval.n_episodes=2", "--eval.batch_size=1", "--seed=0"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags, f"--output_dir={tmp_path}"])
    eval_main()
    assert all(len(ticks) == 50 + TICKS for ticks in ours[0.05].values())
    assert WatchedEnv.history == ours[0.05]
    info = json.loads((tmp_path / "eval_info.json").read_text())
    assert [result.outcome == "success" for result in results] == info["per_task"][0]["metrics"]["successes"]


def test_eval_run_gives_the_same_results_for_any_number_of_worlds(fast, tmp_path):
    """Boxing, 3 episodes in 1 and in 3 worlds: journals agree in all that an episode did; the checkpoint is named."""
    rows = {}
    for worlds in (1, 3):
        out = tmp_path / f"w{worlds}"
        flags = ["--task", "boxing", "--policy", f"lerobot:{fast}", "--seeds", "0", "--repeats", "3"]
        flags += ["--max-steps", "13", "--engine", "mujoco", "--device", "cpu"]
        flags += ["--worlds", str(worlds), "--out", str(out)]
        assert main(["run", *flags]) == 0
        lines = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
        found = [line for line in lines if "margin" in line]
        assert len(found) == 3
        rows[worlds] = sorted((r["episode_seed"], r["outcome"], r["steps"], r["margin"]) for r in found)
    assert rows[1] == rows[3]
    assert len({row[3] for row in rows[1]}) == 3
    said = json.loads((tmp_path / "w1" / "results.json").read_text())
    assert LeRobotPolicy(fast).checkpoint.digest in json.dumps(said)
    assert np.isfinite([row[3] for row in rows[1]]).all()
