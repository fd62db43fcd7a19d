"""One checkpoint through each protocol: the same episodes as alone.

A random ACT of v4 whose heading is realigned, and which looks through the cameras of head and wrists.
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from foreign_servers import MODALITIES, Gr00tServer, facts

from arena_newton import policies, trackers
from arena_newton.data.readers.label_protocols import V4, action_names
from arena_newton.env import ArenaEnv
from arena_newton.policies import Observation
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.protocols.handshake import ServedPicture
from arena_newton.policies.serve.connection_guard import ConnectionGuard
from arena_newton.policies.serve.policy_server import PolicyServer
from arena_newton.policies.serve.serve_command import make_policy, open_endpoint
from arena_newton.policies.serve.serve_options import ServeOptions
from arena_newton.rollout import Rollout
from tests.patience import PLENTY

sys.path.insert(0, str(Path(__file__).parents[1] / "checkpoints"))
import made_checkpoints

REALIGN = 0.05
TICKS = 8
"""Ticks of an episode, more than two chunks."""
SEEDS = (3, 5, 8)
CAMERAS = ("left_wrist", "front", "right_wrist")


@pytest.fixture(scope="module")
def checkpoint(narrow_resnet, tmp_path_factory):
    """A tiny ACT that turns this way and that."""
    about = made_checkpoints.facts(labels="v4", realign=REALIGN, family="act")
    return made_checkpoints.save(tmp_path_factory.mktemp("act"), "act", facts=about, spread=0.1, cameras=CAMERAS)


class Gr00tCheckpoint(Gr00tServer):
    """GR00T's protocol in front of the checkpoint, whose chunks follow from what is seen alone."""

    def __init__(self, policy):
        self.policy = policy
        names = list(V4)
        ticks = list(range(policy.chunk_size))
        about = facts(
            labels="v4",
            action_names=tuple(action_names("v4")),
            chunk_length=policy.chunk_size,
            cameras={name: ServedPicture.of(camera) for name, camera in policy.cameras.items()},
            realign=REALIGN,
        )
        video = {"modality_keys": ["ego_view", "left_wrist", "right_wrist"], "delta_indices": [0]}
        action = {"modality_keys": names, "delta_indices": ticks}
        super().__init__(MODALITIES | {"video": video, "action": action}, declared=about)

    def actions(self, data):
        seen, options = data["observation"], data["options"]
        state = np.concatenate([seen["state"][name] for name in MODALITIES["state"]["modality_keys"]], axis=-1)[:, 0]
        tasks = [options["task"]] * len(state)
        self.policy.reset(options["seed"], tasks)
        queries = Observation(
            torch.from_numpy(state.copy()),
            torch.from_numpy(seen["video"].pop("ego_view")[:, 0].copy()),
            np.ones(len(state), bool),
            "boxing",
            options["task"],
            "Strike.",
        )
        queries.images |= {name: torch.from_numpy(one[:, 0].copy()) for name, one in seen["video"].items()}
        chunk = np.asarray(self.policy.act(queries).actions, np.float32)
        return [{name: chunk[..., part] for name, part in V4.items()}, {}]


def started(name, checkpoint):
    """The address of a server of the checkpoint, and how to end it."""
    if name == "gr00t":
        policy = policies.get(f"lerobot:{checkpoint}")
        policy.check()
        server = Gr00tCheckpoint(policy)
        return server.url, server.close
    protocol, _, raw = name.partition(" ")
    options = ServeOptions(policy=f"lerobot:{checkpoint}", protocol=protocol, port=0, raw_labels=bool(raw))
    device = torch.device("cpu")
    server = PolicyServer(make_policy(options, device), max_batch_size=8, max_wait=0.01, max_sessions=16, device=device)
    server.start("boxing")
    opened = open_endpoint(server, options, ConnectionGuard(16))

    def close():
        opened.close()
        server.close()

    return f"{'http' if protocol == 'arena' else protocol}://127.0.0.1:{opened.port}", close


def test_one_checkpoint_through_every_protocol(checkpoint):
    """Outcome, ticks and margin of every episode are those of `lerobot:`, decoded by the server or by the robot."""
    env, ends = None, {}
    for name in ("", "arena", "openpi", "openpi raw", "roboarena", "vla-eval", "vla-eval raw", "gr00t"):
        url, close = started(name, checkpoint) if name else ("", lambda: None)
        policy = policies.get(f"remote:{url}", timeout=PLENTY) if name else policies.get(f"lerobot:{checkpoint}")
        policy.check()
        if name:
            raw = "raw" in name or name == "gr00t"
            assert (policy.labels, policy.realign) == (("v4", REALIGN) if raw else ("v3.1", 0.0))
        env = env or ArenaEnv(
            "boxing", tracker=trackers.get("pd"), worlds=2, engine="mujoco", device="cpu", cameras=policy.cameras
        )
        played = []
        reader = read_by(policy, policy.labels)
        act = reader.act

        def watched(seen, act=act, played=played):
            chunk = act(seen)
            played.append(np.asarray(chunk.actions)[seen.mask].astype(np.float32).tobytes())
            return chunk

        reader.act = watched
        results = Rollout(env, reader, [SimpleNamespace(episode_seed=s) for s in SEEDS], max_steps=TICKS).run()
        ends[name] = {r.episode.episode_seed: (r.outcome, r.steps, r.margin, r.error) for r in results}, played
        policy.close()
        close()
    wanted = ends.pop("")
    assert len(wanted[0]) == len(SEEDS) and all(error is None for *_, error in wanted[0].values())
    assert {name for name, found in ends.items() if found[0] != wanted[0]} == set()
    assert {name for name, found in ends.items() if found[1] != wanted[1]} == set()
