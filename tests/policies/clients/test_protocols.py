"""One policy behind every protocol: the same actions as in this process, to the last bit."""

import numpy as np
import pytest
from foreign_servers import OPENED, SIZE, NoisePolicy, asking, declared_servers, observation

from arena_newton.policies import PolicyUnavailable
from arena_newton.policies.serve.connection_guard import ConnectionGuard
from arena_newton.policies.serve.policy_server import PolicyServer
from arena_newton.policies.serve.serve_command import open_endpoint
from arena_newton.policies.serve.serve_options import ServeOptions
from arena_newton.testing import check_policy
from tests.patience import PLENTY

SERVERS = declared_servers()
OWN = {"arena": "http", "openpi": "openpi", "roboarena": "roboarena", "vla-eval": "vla-eval"}
"""Protocols of this package's own server, and what stands in front of its address."""


class OwnServer:
    """This package's server with the same policy."""

    def __init__(self, protocol, port=0):
        OPENED.append(self)
        self.server = PolicyServer(NoisePolicy(), max_batch_size=8, max_wait=0.002, max_sessions=16)
        self.server.start("football")
        options = ServeOptions(policy="stand", protocol=protocol, port=port)
        self.endpoint = open_endpoint(self.server, options, ConnectionGuard(16))
        self.url = f"{OWN[protocol]}://127.0.0.1:{self.endpoint.port}"

    def close(self):
        self.endpoint.close()
        self.server.close()


SERVERS |= {f"own {protocol}": lambda protocol=protocol: OwnServer(protocol) for protocol in OWN}


def ask(policy, seeds):
    """Chunks of worlds that begin and ask at different times."""
    worlds, found = len(seeds), []
    policy.reset(seeds, ["Isaac-Football"] * worlds)
    for turn in range(3):
        mask = np.arange(worlds) % 3 != turn
        if turn == 2:
            policy.reset([s + 100 for s in seeds], ["Isaac-Football"] * worlds, np.arange(worlds) == 0)
        chunk = policy.act(observation(worlds, mask))
        assert chunk.errors == {}
        found.append(np.asarray(chunk.actions)[mask])
    return found


@pytest.mark.parametrize("name", SERVERS)
def test_actions_are_the_same_through_every_protocol(name):
    """Each protocol carries state, picture, seed and step so that the actions are those of the policy itself."""
    server = SERVERS[name]()
    policy = asking(server.url, timeout=PLENTY, retries=1, backoff=0.01)
    policy.check()
    if not name.startswith("own"):
        assert not policy.depends_on_worlds and policy.describe()["server"].startswith("noise")
    assert (policy.camera.width, policy.camera.height) == (SIZE, SIZE)
    for got, wanted in zip(ask(policy, [5, 6, 7, 8]), ask(NoisePolicy(), [5, 6, 7, 8]), strict=True):
        assert got.tobytes() == wanted.tobytes()


@pytest.mark.parametrize("name", ["own openpi", "own roboarena", "own vla-eval", "own arena", "gr00t"])
def test_promises_of_a_policy_hold_through_every_protocol(name):
    """Seeds, resets, neighbours, broken states: what a policy promises, its client promises too."""
    server = SERVERS[name]()
    policy = asking(server.url, timeout=PLENTY, retries=1, backoff=0.01)
    assert all(result.ok for result in check_policy(policy))


@pytest.mark.parametrize("protocol", OWN)
def test_own_server_that_was_restarted(protocol):
    """A restarted server knows no running episode: the run stops, and the same episodes then give the same actions."""
    server = OwnServer(protocol)
    policy = asking(server.url, timeout=PLENTY, retries=4, backoff=0.05)
    policy.check()
    tasks = ["Isaac-Football"] * 2
    policy.reset([5, 6], tasks)
    first = policy.act(observation(2)).actions.tobytes()
    server.close()
    with pytest.raises(PolicyUnavailable, match="the server is (gone|closing)"):
        policy.retries = 0
        policy.act(observation(2))
    policy.retries = 4
    server = OwnServer(protocol, port=int(server.url.rpartition(":")[2]))
    with pytest.raises(PolicyUnavailable, match="episode"):
        policy.close()  # as the process that resumes the run
        policy.act(observation(2))
    policy.reset([5, 6], tasks)
    assert policy.act(observation(2)).actions.tobytes() == first
