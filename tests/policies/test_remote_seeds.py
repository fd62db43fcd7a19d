"""Stochastic policy servers: what of their results is the same for any number of worlds, and what is not."""

import random
from types import SimpleNamespace

import numpy as np
import pytest
from json_server import JsonHandler, JsonServer

from arena_newton import trackers
from arena_newton.env import STAND_ACTION, ArenaEnv
from arena_newton.policies import Observation
from arena_newton.policies.remote.arena_client import RemotePolicy
from arena_newton.rollout import Rollout

CHUNK = 4
STEPS = 10
SEEDS = tuple(1000 + 7 * i for i in range(20))


class Handler(JsonHandler):
    """A policy that looks at the state and adds noise, from the request's seed and step or from one generator."""

    def do_POST(self):  # noqa: N802 (the name that http.server calls)
        server = self.server
        asked = self.asked()
        with server.lock:
            server.count += 1
            request = self.path, asked["seed"], asked.get("step")
            if server.drop_every and server.count % server.drop_every == 0 and request not in server.dropped:
                server.dropped.add(request)  # once: what is asked again is answered
                self.close_connection = True
                return
            if self.path == "/reset":
                server.rng = np.random.default_rng(asked["seed"])
                reply = {"ok": True, "seeded": server.seeded}
            else:
                rng = np.random.default_rng([asked["seed"], asked["step"]]) if server.seeded else server.rng
                state = np.array(asked["observation"]["state"])
                actions = np.tile(STAND_ACTION, (CHUNK, 1))
                actions[:, 9:38] += 0.05 * np.sin(10.0 * state[6:35]) + 0.05 * rng.standard_normal((CHUNK, 29))
                reply = {"action_chunk": actions.tolist()}
                server.seen[asked["seed"], asked["step"]] = tuple(asked["observation"]["state"])
        self.answer(200, reply)


@pytest.fixture
def server():
    running = JsonServer(
        Handler, rng=np.random.default_rng(0), seeded=True, seen={}, count=0, drop_every=0, dropped=set()
    )
    yield running
    running.close()


def observe(states, asks):
    return Observation(states.copy(), None, asks, "boxing", "Isaac-Boxing", "Strike.")


def play(policy, seeds, worlds):
    """Episodes of bodies that follow the actions, each as long as its seed says, so that worlds are out of step."""
    states, tick, end = np.zeros((worlds, 64), np.float32), np.zeros(worlds, int), np.zeros(worlds, int)
    queues, running = [[] for _ in range(worlds)], [0] * worlds
    waiting, ends = list(seeds), {}
    while True:
        free = [w for w in range(worlds) if tick[w] == end[w]]
        for w in free:
            if running[w]:
                ends[running[w]] = states[w].tobytes()
            running[w] = waiting.pop(0) if waiting else 0
            states[w] = np.random.default_rng(running[w]).standard_normal(64)
            queues[w], tick[w], end[w] = [], 0, 5 + running[w] % 11 if running[w] else -1
        begin = np.isin(np.arange(worlds), free) & (np.array(running) > 0)
        if begin.any():
            policy.reset(running, ["Isaac-Boxing"] * worlds, begin)
        if not any(running):
            return ends
        asks = np.array([bool(running[w]) and not queues[w] for w in range(worlds)])
        if asks.any():
            chunk = policy.act(observe(states, asks))
            assert chunk.errors == {}
            for w in np.flatnonzero(asks):
                queues[w] = list(chunk.actions[w])
        for w in np.flatnonzero(running):
            states[w, 6:35] += 0.1 * (queues[w].pop(0)[9:38] - states[w, 6:35])
            tick[w] += 1


def run(server, worlds, seeds=SEEDS, loop=play, **options):
    """Endings of the episodes by seed, and all that the server saw, by seed and step, to the last bit."""
    server.seen = {}
    policy = RemotePolicy(server.url, timeout=120.0, retries=3, backoff=0.01, **options)
    policy.needs_image = False
    policy.check()
    ends = loop(policy, seeds, worlds)
    policy.close()
    return ends, server.seen


def simulate(policy, seeds, worlds):
    """The same with the simulator."""
    env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=worlds, engine="mujoco", device="cpu")
    results = Rollout(env, policy, [SimpleNamespace(episode_seed=s) for s in seeds], max_steps=STEPS).run()
    return {r.episode.episode_seed: (r.outcome, r.steps, r.margin, r.error) for r in results}


def test_seeded_server_gives_the_same_for_any_batch(server):
    """A server whose noise follows from seed and step gives every episode the same bits, whatever runs beside it."""
    ends, seen = run(server, 1)
    assert len(set(ends.values())) == 20 and {step for _, step in seen} == {0, 4, 8, 12}
    shuffled = list(SEEDS)
    random.Random(1).shuffle(shuffled)
    assert run(server, 3) == (ends, seen)
    assert run(server, 20) == (ends, seen)
    assert run(server, 3, SEEDS[::-1]) == (ends, seen)
    assert run(server, 7, shuffled, sequential=True) == (ends, seen)
    server.drop_every = 5  # requests that are asked again get the same answer
    assert run(server, 20, shuffled) == (ends, seen)
    assert len(server.dropped) > 5


def test_seeded_server_in_the_simulator(server):
    """The same with the simulator: one world and three end with the same bits."""
    ends, seen = run(server, 1, SEEDS[:3], simulate)
    assert {error for *_, error in ends.values()} == {None} and {step for _, step in seen} == {0, 4, 8}
    assert run(server, 3, SEEDS[2::-1], simulate) == (ends, seen)


def test_server_of_one_generator_needs_one_world(server):
    """With one generator for all, one world gives the same bits in any order; several in sequence the same twice."""
    server.seeded = False
    alone = run(server, 1)
    assert run(server, 1, SEEDS[::-1]) == alone
    together = run(server, 3, sequential=True)
    assert run(server, 3, sequential=True) == together
    assert together != alone and run(server, 2, sequential=True) != together
