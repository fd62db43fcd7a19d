"""A checkpoint behind the server gives each robot what it gives alone in one process, to the last bit."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from served_policies import together

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "checkpoints"))
from made_checkpoints import SIDE, facts, save

from arena_newton.interfaces import Observation
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.policies.protocols.policy_messages import Begin, Query
from arena_newton.policies.serve.serve_command import make_policy
from arena_newton.policies.serve.serve_options import ServeOptions

pytestmark = pytest.mark.usefixtures("_offline")
SENTENCE = "Strike the green markers on the punching bag."


@pytest.fixture
def _offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@pytest.fixture(scope="module")
def checkpoints(narrow_resnet, tmp_path_factory):
    """Family → folder: ACT in v4 with realignment, and a Diffusion Policy, which draws noise."""
    root = tmp_path_factory.mktemp("served")
    act = save(root / "act", "act", facts=facts(family="act", labels="v4", realign=0.002))
    return {"act": act, "diffusion": save(root / "diffusion", "diffusion", facts=facts(family="diffusion"))}


def shown(seed, number):
    """State and picture of a robot's query."""
    rng = np.random.default_rng([seed, number])
    state = 0.1 * rng.standard_normal(64).astype(np.float32)
    state[[0, 3]] = 1.0
    return state, rng.integers(0, 256, (SIDE, SIDE, 3), np.uint8)


def alone(policy, seed, queries):
    """Chunks of one world in this process."""
    policy.reset([seed], ["boxing"])
    chunks = []
    for number in range(queries):
        state, image = shown(seed, number)
        seen = Observation(
            torch.from_numpy(state)[None],
            torch.from_numpy(image)[None],
            np.ones(1, bool),
            "boxing",
            "Isaac-Move-Boxing-Bag-G129-Dex3-Wholebody",
            SENTENCE,
        )
        chunks.append(np.asarray(policy.act(seen).actions[0]))
    return chunks


@pytest.mark.parametrize(
    ("family", "options"), [("act", {}), ("act", {"replan": 2}), ("act", {"ensemble": True}), ("diffusion", {})]
)
def test_robots_are_served_as_if_alone(served, checkpoints, family, options):
    """Three robots that ask together, and one that comes later, get the chunks of a policy with one world."""
    spec = f"lerobot:{checkpoints[family]}"
    policy = make_policy(ServeOptions(policy=spec, **options), torch.device("cpu"))
    one = served(policy, max_sessions=4, max_wait=0.2)
    assert one.server.facts.labels == "v3.1" and one.server.facts.picture.width == SIDE
    assert one.server.facts.chunk_length == {"replan": 2, "ensemble": 1}.get(next(iter(options), ""), 6)

    def play(seed, queries=4):
        one.server.begin(str(seed), Begin("", seed, "boxing"))
        chunks, step = [], 0
        for number in range(queries):
            state, image = shown(seed, number)
            query = Query(state, {"front": image}, "boxing", SENTENCE, seed=seed, step=step)
            chunks.append(one.server.query(str(seed), query).actions)
            step += len(chunks[-1])
        one.server.leave(str(seed))
        return chunks

    got = dict(zip((3, 4, 5), together(*[lambda seed=seed: play(seed) for seed in (3, 4, 5)]), strict=True))
    got[6] = play(6)
    assert max(one.server.counts.batches) > 1
    own = LeRobotPolicy(checkpoints[family], **options)
    own = read_by(own, own.labels)
    for seed, chunks in got.items():
        assert np.array_equal(chunks, alone(own, seed, 4))


def test_raw_labels_are_the_networks(served, checkpoints):
    """With raw labels the server declares v4 with its realignment and gives what the network gives."""
    options = ServeOptions(policy=f"lerobot:{checkpoints['act']}", raw_labels=True)
    one = served(make_policy(options, torch.device("cpu")), max_sessions=2)
    assert one.server.facts.labels == "v4" and one.server.facts.realign == 0.002
    state, image = shown(3, 0)
    chunk = one.server.query("a", Query(state, {"front": image}, "boxing", SENTENCE, seed=3, step=0)).actions
    assert np.array_equal(chunk, alone(LeRobotPolicy(checkpoints["act"]), 3, 1)[0])
