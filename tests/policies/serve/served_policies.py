"""Policies made for tests of the server, and a server around one of them."""

import http.client
import json
import threading
import time

import numpy as np
import torch
from websockets.sync.client import connect

from arena_newton.errors import InputError
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.base import Chunk, Policy, world_mask
from arena_newton.policies.protocols.policy_messages import Query
from arena_newton.policies.serve.connection_guard import ConnectionGuard
from arena_newton.policies.serve.policy_server import PolicyServer
from arena_newton.policies.serve.serve_command import open_endpoint
from arena_newton.policies.serve.serve_options import ServeOptions
from arena_newton.robot.canonical import STAND_ACTION
from tests.patience import PLENTY


class Remembers(Policy):
    """Its answer holds noise of the episode's seed, the number of queries so far, their sum, and what is seen now."""

    name, labels, chunk_size = "remembers", "v3.1", 4

    def __init__(self, *, sees=False, pause=0.0):
        self.needs_image, self.pause = sees, pause
        self.camera = CameraConfig(width=32, height=32) if sees else None
        self.calls, self.inside, self.most_inside = [], 0, 0
        self.queries = np.zeros(0)

    def reset(self, seeds, tasks, mask=None):
        if len(self.queries) != len(seeds):
            self.queries, self.sums, self.seeds = np.zeros(len(seeds)), np.zeros(len(seeds)), np.zeros(len(seeds), int)
        chosen = world_mask(mask, len(seeds))
        self.queries[chosen], self.sums[chosen] = 0, 0
        self.seeds[chosen] = np.asarray(seeds)[chosen]

    def act(self, observation):
        self.inside += 1
        self.most_inside = max(self.inside, self.most_inside)
        rows = np.flatnonzero(observation.mask)
        self.calls.append((len(rows), observation.task, observation.instruction))
        self.tracker = observation.tracker
        time.sleep(self.pause)
        self.queries[rows] += 1
        self.sums[rows] += observation.state[rows, 6].numpy()
        actions = np.tile(STAND_ACTION, (len(self.queries), self.chunk_size, 1))
        for row in rows:
            noise = np.random.default_rng([self.seeds[row], int(self.queries[row])]).standard_normal(self.chunk_size)
            actions[row, :, 9] = 0.01 * noise
            actions[row, :, 10], actions[row, :, 11] = 0.001 * self.queries[row], 0.001 * self.sums[row]
            if observation.image is not None:
                actions[row, :, 12] = 0.001 * observation.image[row].float().mean()
        self.inside -= 1
        return Chunk(actions)


class Fails(Remembers):
    """Raises, or gives something unfit, where the state says so."""

    name = "fails"

    def check_task(self, task, mode=None, seeds=()):
        if task == "sit_sofa":
            raise InputError("policy fails: does not know sit_sofa")

    def act(self, observation):
        answer = super().act(observation)
        for row in np.flatnonzero(observation.mask):
            kind = int(observation.state[row, 7])
            if kind == 1:
                raise RuntimeError("a secret of the server in /home/somebody")
            if kind == 2:
                answer.actions[row, 0, 20] = np.nan
            if kind == 3:
                answer.errors[int(row)] = "no plan for this world"
        return answer


class TurnsV4(Policy):
    """A constant yaw rate in the labels of v4."""

    name, labels, chunk_size, realign = "turns", "v4", 5, 0.0

    def act(self, observation):
        actions = torch.zeros(len(observation.state), self.chunk_size, 40)
        actions[..., 2], actions[..., 5] = 0.8, 0.5
        return Chunk(actions)


def state(first=0.0, kind=0):
    """A state that differs in the two numbers that the policies here read."""
    numbers = np.zeros(64, dtype=np.float32)
    numbers[[0, 3]] = 1.0
    numbers[6], numbers[7] = first, kind
    return numbers


def query(first=0.0, *, kind=0, image=None, **more):
    """A look at such a state."""
    return Query(
        state(first, kind),
        {} if image is None else {"front": image},
        **({"task": "boxing", "instruction": "Box."} | more),
    )


class Served:
    """A policy behind a protocol at a free port."""

    def __init__(self, policy, protocol="openpi", token="", connections=None, tls=None, raw=False, **options):
        options = {"max_sessions": 8, "max_wait": 0.002} | options
        self.policy = policy
        self.server = PolicyServer(policy, **options)
        self.server.start()
        guard = ConnectionGuard(connections or self.server.max_sessions, token, local=True)
        self.endpoint = open_endpoint(self.server, ServeOptions(policy="x", protocol=protocol, port=0), guard, tls)
        self.port = self.endpoint.port
        policy.calls = []

    def socket(self, **more):
        """A websocket to it."""
        return connect(f"ws://127.0.0.1:{self.port}", compression=None, max_size=None, **more)

    def http(self, method, route, body=b"", headers=None):
        """Status and JSON of a request on a connection of its own."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PLENTY)
        try:
            connection.request(method, route, body, headers or {})
            reply = connection.getresponse()
            data = reply.read()
        finally:
            connection.close()
        return reply.status, json.loads(data) if data[:1] == b"{" else data

    def close(self):
        """End endpoint and server."""
        self.endpoint.close()
        self.server.close()


def together(*works):
    """Results of several functions that run at the same time."""
    results = [None] * len(works)

    def run(index):
        try:
            results[index] = works[index]()
        except Exception as error:
            results[index] = error

    threads = [threading.Thread(target=run, args=[index]) for index in range(len(works))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PLENTY)
    return results
