"""Runs of `eval` with servers of other protocols: one that dies stops the run, `resume` ends it with the same bytes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from foreign_servers import Gr00tServer, SocketServer, facts

from arena_newton import policies
from arena_newton.eval.__main__ import main
from tests.eval.eval_fakes import FakeEnv, factories

TABLES = ("results.json", "table.md", "table.csv", "report.md", "report.html")
SHORT = ["--engine", "mujoco", "--task", "football", "--repeats", "4", "--seeds", "0", "1"]


class FollowingEnv(FakeEnv):
    """Worlds that show their seed, and whose margin is made of every action that they executed."""

    def __init__(self, task, **options):
        super().__init__(task, **options)
        self.body = np.zeros(self.worlds)

    def reset(self, seeds, worlds=None, **options):
        super().reset(seeds, worlds, **options)
        self.body[list(range(self.worlds) if worlds is None else worlds)] = 0.0

    def observe(self, mask=None, *, image=False):
        seen = super().observe(mask, image=image)
        seen.state[:, 6] = torch.from_numpy(self.body + self.seeds % 89 / 89)
        return seen

    def step(self, action, worlds=None):
        rows = np.asarray(action, np.float64)[:, 9:38].sum(axis=1)
        self.body[self.active] = np.sin(self.body + rows)[self.active]
        return super().step(action, worlds)

    def verdict(self, world):
        verdict = super().verdict(world)
        return replace(verdict, margin=math.copysign(1.0 + float(self.body[world]), verdict.margin))


def parts():
    """Stand-ins for all but the policy."""
    return factories(policy=policies.get, env=FollowingEnv)


def server_of(protocol, port=0):
    """A server that declares itself."""
    if protocol == "gr00t":
        return Gr00tServer(declared=facts(), port=port)
    return SocketServer(protocol, facts(), config=facts(), port=port)


def results(folder):
    """Tables and the sorted journal without times."""
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    timed = ("durations", "started_at", "finished_at", "previous")
    kept = sorted(json.dumps({k: v for k, v in line.items() if k not in timed}, sort_keys=True) for line in lines)
    return {name: (folder / name).read_bytes() for name in TABLES}, kept


@pytest.mark.parametrize("protocol", ["openpi", "roboarena", "vla-eval", "gr00t"])
def test_server_killed_in_mid_run(tmp_path, capsys, protocol):
    """The run stops with exit code 2, no episode is called an error, and `resume` ends with the same bytes."""
    server = server_of(protocol)
    flags = [*SHORT, "--worlds", "3", "--remote-retries", "0", "--policy", f"remote:{server.url}"]
    assert main([*flags, "--out", str(tmp_path / "whole")], parts()) == 0
    queries = sum(kind in ("query", "get_action") for kind, _ in server.seen)
    count = [0]
    note = server.note

    def dying(kind, content):
        note(kind, content)
        count[0] += kind in ("query", "get_action")
        if count[0] == queries // 2:
            server.behave = {"any": "dies"}

    server.note = dying
    capsys.readouterr()
    assert main([*flags, "--out", str(tmp_path / "cut")], parts()) == 2
    error = capsys.readouterr().err
    assert "the server is gone" in error and "resume" in error
    lines = [json.loads(line) for line in (tmp_path / "cut" / "episodes.jsonl").read_text().splitlines()]
    assert 0 < len(lines) < 8 and not any(line.get("outcome") == "error" for line in lines)
    server.close()
    server = server_of(protocol, server.port)
    assert main(["resume", str(tmp_path / "cut")], parts()) == 0
    assert results(tmp_path / "cut") == results(tmp_path / "whole")
    margins = {json.loads(line)["margin"] for line in results(tmp_path / "whole")[1]}
    assert len(margins) == 8


def test_another_server_under_the_same_address(tmp_path, capsys):
    """A run that was begun with one policy is not resumed with another one that has its address."""
    server = server_of("openpi")
    out = ["--out", str(tmp_path / "o")]
    assert main([*SHORT, "--policy", f"remote:{server.url}", *out], parts()) == 0
    server.close()
    server = SocketServer("openpi", facts(policy="another"), port=server.port)
    assert main(["resume", str(tmp_path / "o")], parts()) == 2
    assert "another" in capsys.readouterr().err


@pytest.mark.parametrize("protocol", ["openpi", "vla-eval", "gr00t"])
def test_server_that_declares_nothing_is_said_once(tmp_path, capsys, protocol):
    """An assumption is one line on stderr and part of the configuration; the number of worlds then counts."""
    server = Gr00tServer() if protocol == "gr00t" else SocketServer(protocol, metadata={})
    flags = [*SHORT, "--worlds", "2", "--policy", f"remote:{server.url}", "--out", str(tmp_path / "o")]
    assert main(flags, parts()) == 0
    assert capsys.readouterr().err.count("what stands in brackets is assumed") == 1
    config = json.loads((tmp_path / "o" / "config.json").read_text())["config"]
    assert config["policy_facts"]["assumed"]["rate"] == "50 Hz" and config["worlds"] == 2


def test_refusals_before_the_first_episode(tmp_path, monkeypatch, capsys):
    """A server for another robot, and an unknown protocol, end with exit code 2 and one line; nothing is written."""
    monkeypatch.chdir(tmp_path)
    server = SocketServer("openpi", facts(rate_hz=15.0))
    for spec, text in ((server.url, "are for 15 Hz, the robot executes 50 Hz"), ("mqtt://host", "unknown protocol")):
        assert main([*SHORT, "--policy", f"remote:{spec}"], parts()) == 2
        said = capsys.readouterr()
        assert text in said.err and said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
