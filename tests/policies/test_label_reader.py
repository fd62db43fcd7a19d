"""Actions of label protocol v4 through the world."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from recorded_actions import Actions

from arena_newton import policies, trackers
from arena_newton.data.readers.label_protocols import encode_v4
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.policies.base import Chunk, Policy
from arena_newton.policies.label_reader import V4Policy, read_by
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding


class Table(Policy):
    """Plays each episode's labels of v4 in chunks of its own length."""

    name = "table"

    def __init__(self, labels, lengths):
        self.table = {seeding.policy_seed(seed): rows for seed, rows in labels.items()}
        self.lengths = lengths

    def reset(self, seeds, tasks, mask=None):
        if mask is None or len(mask) == len(seeds):
            self.at = getattr(self, "at", np.zeros(len(seeds), np.int64))
            self.seeds = getattr(self, "seeds", [0] * len(seeds))
        for world in np.flatnonzero(np.ones(len(seeds), bool) if mask is None else mask):
            self.seeds[world], self.at[world] = seeds[world], 0

    def act(self, observation):
        length = self.lengths
        chunk = np.zeros((len(observation.state), length, 40), np.float32)
        for world in np.flatnonzero(observation.mask):
            rows = self.table[self.seeds[world]]
            take = np.minimum(self.at[world] + np.arange(length), len(rows) - 1)
            chunk[world] = rows[take]
            self.at[world] += length
        return Chunk(chunk)


def episodes(env, n):
    """Planned episodes of boxing."""
    seeds = [seeding.episode_seed(env.spec.gym_id, 0, repeat) for repeat in range(n)]
    return [SimpleNamespace(episode_seed=seed, object_seed=seeding.object_seed(seed)) for seed in seeds]


@pytest.fixture(scope="module")
def played():
    """Boxing, the expert's results and its actions of v3.1 by seed."""
    env = ArenaEnv("boxing", tracker=trackers.get("twist2", None), worlds=2, engine="mujoco")
    kept = Actions(startup=False)
    results = Rollout(env, policies.get("expert"), episodes(env, 3), recorder=kept).run()
    rows = {seed: np.stack(rows) for seed, rows in kept.rows.items()}
    yield env, results, rows
    env.close()


@pytest.mark.parametrize("length", [1, 20])
def test_labels_of_v4_move_the_robot_as_v3_1_does(played, length):
    """The expert's actions, encoded to v4 and read by --labels v4, succeed as they are, and rows agree within 1e-4."""
    env, results, actions = played
    labels = {seed: encode_v4(rows) for seed, rows in actions.items()}
    kept = Actions(startup=False)
    again = Rollout(env, read_by(Table(labels, length), "v4"), episodes(env, 3), recorder=kept).run()
    assert [result.outcome for result in again] == ["success"] * 3 == [result.outcome for result in results]
    for seed, result in zip(actions, again, strict=True):
        rows = np.stack(kept.rows[seed])
        assert len(rows) == result.steps
        n = min(len(rows), len(actions[seed]))
        assert np.abs(rows[:n] - actions[seed][:n]).max() < 1e-4
        assert abs(len(rows) - len(actions[seed])) <= 2


def test_a_policy_of_another_protocol_is_refused():
    """An expert knows v3.1 alone, an unknown protocol is named; v3.1 leaves the policy as it is."""
    expert = policies.get("expert")
    assert read_by(expert, "v3.1") is expert
    with pytest.raises(InputError, match=r"--labels v4: policy expert gives actions of v3\.1"):
        read_by(expert, "v4")
    with pytest.raises(InputError, match="--labels v5: unknown"):
        read_by(expert, "v5")


def test_a_chunk_of_another_shape_is_refused():
    """The message names the policy and the shape."""
    wrong = Table({0: np.zeros((1, 40))}, 1)
    wrong.act = lambda observation: Chunk(np.zeros((1, 1, 39)))
    with pytest.raises(InputError, match=r"policy table: a chunk of shape \[1, 1, 39\]"):
        V4Policy(wrong).act(SimpleNamespace(state=torch.zeros(1, 64), mask=np.ones(1, bool)))


def test_the_command_line_says_what_is_wrong(tmp_path, capsys):
    """--labels with an unknown name, or with a policy that has its own protocol, is one clear line and exit code 2."""
    out = str(tmp_path / "out")
    assert main(["run", "--task", "boxing", "--labels", "v7", "--out", out]) == 2
    assert "--labels v7: unknown, choose from v3.1, v4" in capsys.readouterr().err
    assert main(["run", "--task", "boxing", "--labels", "v4", "--policy", "stand", "--out", out]) == 2
    assert "policy stand gives actions of v3.1" in capsys.readouterr().err
