"""Runs with a policy server: what flags reach it, what results are known by, and what no results folder holds."""

import json
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from arena_newton import policies, trackers
from arena_newton.cli import registry
from arena_newton.env import ArenaEnv
from arena_newton.eval.__main__ import main
from arena_newton.policies import PolicyUnavailable
from arena_newton.policies.serve_example import Handler, Server
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.rollout import Rollout
from arena_newton.rules.seeding import policy_seed
from tests.eval.eval_fakes import factories

SHORT = ["--engine", "mujoco", "--task", "football", "--repeats", "3", "--seeds", "0"]


class Undeclared(Handler):
    """A server that does not say that it honours seeds."""

    def do_POST(self):  # noqa: N802 (the name that http.server calls)
        self.rfile.read(int(self.headers["Content-Length"]))
        reply = json.dumps({"ok": True, "action_chunk": [[float(v) for v in STAND_ACTION]] * 50}).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(reply)))
        self.end_headers()
        self.wfile.write(reply)


def serve(handler, monkeypatch):
    monkeypatch.setattr(handler, "log_message", lambda *_: None)
    server = Server(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
    return server, f"remote:http://127.0.0.1:{server.server_port}"


def real_policy():
    return factories(policy=policies.get)


@pytest.mark.parametrize("command", [[], ["list"]])
def test_password_in_the_address_is_nowhere(tmp_path, monkeypatch, capsys, command):
    """A user name or password in the policy's address ends a run before anything is written or printed."""
    monkeypatch.chdir(tmp_path)
    for address in ("http://user:sekret@localhost:1", "user:sekret@localhost:1"):
        assert main([*command, *SHORT, "--policy", f"remote:{address}"], factories()) == 2
        captured = capsys.readouterr()
        assert captured.err.count("\n") == 1 and "ARENA_POLICY_TOKEN" in captured.err
        assert "sekret" not in captured.out + captured.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [[], ["list"]])
@pytest.mark.parametrize("spec", ["gizmo:someone/policy", "http://user:sekret@localhost", "dance"])
def test_unknown_policy(tmp_path, monkeypatch, capsys, command, spec):
    """A policy that nobody offers is called unknown, whatever stands behind the colon."""
    monkeypatch.chdir(tmp_path)
    assert main([*command, *SHORT, "--policy", spec], factories()) == 2
    captured = capsys.readouterr()
    if "@" not in spec:
        assert captured.err.startswith(f"error: --policy {spec.split(':')[0]}: unknown policy; known are expert, ")
    assert captured.err.count("\n") == 1 and "sekret" not in captured.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "flags", [["--remote-timeout", "5"], ["--remote-retries", "1"], ["--remote-sequential"], ["--remote-insecure"]]
)
def test_flags_of_the_remote_policy_belong_to_it(tmp_path, monkeypatch, capsys, flags):
    """A flag that would do nothing is refused by name."""
    monkeypatch.chdir(tmp_path)
    assert main([*SHORT, *flags], factories()) == 2
    assert capsys.readouterr().err == f"error: {flags[0]}: belongs to --policy remote:<url>, not expert\n"


def test_flags_reach_the_policy(tmp_path):
    """Timeout, attempts, order and certificate check are what the flags say, also after a resume."""
    made = []

    def policy(spec, **options):
        made.append(options)
        return factories().policy(spec)

    flags = ["--remote-timeout", "7.5", "--remote-retries", "0", "--remote-sequential", "--remote-insecure"]
    out = ["--out", str(tmp_path / "o")]
    assert main([*SHORT, "--policy", "remote:https://host", *flags, *out], factories(policy=policy)) == 0
    assert main(["resume", str(tmp_path / "o")], factories(policy=policy)) == 0
    wanted = {"timeout": 7.5, "retries": 0, "sequential": True, "verify_ssl": False, "labels": "v3.1"}
    assert made == [wanted] * 2
    other = ["--out", str(tmp_path / "other")]
    assert main([*SHORT, "--policy", "remote:https://host", *other], factories(policy=policy)) == 0
    assert made[2] == {"timeout": 60.0, "retries": 4, "sequential": False, "verify_ssl": True, "labels": "v3.1"}


def test_number_of_worlds_counts_unless_the_server_honours_seeds(tmp_path, monkeypatch, capsys):
    """Results of a server that does not declare that it honours seeds are known by their number of worlds."""
    for handler, counts in ((Undeclared, True), (Handler, False)):
        server, spec = serve(handler, monkeypatch)
        out = tmp_path / handler.__name__
        flags = [*SHORT, "--policy", spec, "--out", str(out)]
        capsys.readouterr()
        assert main([*flags, "--worlds", "2"], real_policy()) == 0
        assert json.loads((out / "config.json").read_text())["config"]["worlds"] == (2 if counts else None)
        note = "does not declare that it honours seeds" in capsys.readouterr().out
        assert note is counts
        assert main(["resume", str(out), "--worlds", "3"], real_policy()) == (2 if counts else 0)
        assert not counts or "worlds was 2, now 3" in capsys.readouterr().err
        assert main(["resume", str(out)], real_policy()) == 0
        server.shutdown()
        server.server_close()


def test_example_server_with_pictures(monkeypatch):
    """The example server gets 640×480 pictures, and answers through an episode."""
    shapes = []

    def act(image, state, instruction, rng):
        shapes.append((image.shape, state.shape, instruction, int(image.max()) > 0))
        return original(image, state, instruction, rng)

    from arena_newton.policies import serve_example

    original = serve_example.act
    monkeypatch.setattr(serve_example, "act", act)
    server, spec = serve(Handler, monkeypatch)
    policy = policies.get(spec)
    policy.check()
    env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=1, engine="mujoco", device="cpu", camera=policy.camera)
    results = Rollout(env, policy, [SimpleNamespace(episode_seed=3)], max_steps=21).run()
    assert [(r.outcome, r.steps, r.error) for r in results] == [("timeout", 21, None)]
    assert shapes == [((480, 640, 3), (64,), "Strike the green markers on the punching bag.", True)] * 2

    # The server goes: the run stops, and the episode that was running is not called an error.
    server.shutdown()
    server.server_close()
    policy.close()
    policy.retries, finished = 0, []
    with pytest.raises(PolicyUnavailable, match="the server is gone"):
        Rollout(env, policy, [SimpleNamespace(episode_seed=3)], on_finish=finished.append, max_steps=21).run()
    assert finished == []
    policy.close()


def test_entry_points_and_options(monkeypatch):
    """A package's policy is found; one that is called like another, or makes none, is one line."""
    points = []
    monkeypatch.setattr(registry, "_installed", lambda group, path: points)

    def offer(name, factory, package="theirs"):
        points.append(SimpleNamespace(name=name, load=lambda: factory, dist=SimpleNamespace(name=package)))

    class Mine(policies.Policy):
        def __init__(self, argument, *, speed=1.0):
            self.argument, self.speed = argument, speed

    offer("mine", Mine)
    assert policies.get("mine:a:b").argument == "a:b" and policies.get("mine", speed=2.0).speed == 2.0
    offer("none", lambda argument: object())
    offer("other", lambda: Mine(None))
    offer("stand", Mine)
    offer("twice", Mine)
    offer("twice", Mine, "yours")
    for spec, options, text in (
        ("none", {}, "--policy none: its factory makes a object, not a Policy"),
        ("other", {}, "--policy other: its factory does not take what it is given"),
        ("mine", {"height": 1}, "--policy mine: its factory does not take what it is given"),
        ("stand", {}, "--policy stand: offered by this package and by package theirs; "),
        ("twice", {}, "--policy twice: offered by package theirs and by package yours; "),
    ):
        with pytest.raises(policies.base.InputError) as caught:
            policies.get(spec, **options)
        assert str(caught.value).startswith(text) and "\n" not in str(caught.value)


@pytest.mark.parametrize("rules", ["paper", "released"])
def test_episode_after_an_error_is_asked_for_its_first_action(rules):
    """An episode that takes the place of one without an answer ends as it does alone, to the last bit."""

    class Sway(policies.Policy):
        def reset(self, seeds, tasks, mask=None):
            self.seeds = list(seeds)

        def act(self, observation):
            actions = np.tile(STAND_ACTION, (len(observation.state), 4, 1))
            actions[:, :, 9:38] += 0.05 * np.sin(10.0 * observation.state.numpy()[:, None, 6:35])
            asked = observation.mask & (np.array(self.seeds) == policy_seed(3))
            return policies.Chunk(actions, dict.fromkeys(np.flatnonzero(asked).tolist(), "no answer"))

    ends = []
    env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=1, engine="mujoco", device="cpu", rules=rules)
    for seeds in ((5,), (3, 3, 5)):
        results = Rollout(env, Sway(), [SimpleNamespace(episode_seed=s) for s in seeds], max_steps=10).run()
        assert [r.outcome for r in results[:-1]] == ["error"] * (len(seeds) - 1)
        ends.append((results[-1].outcome, results[-1].steps, results[-1].margin, results[-1].sim_s))
    assert ends[0] == ends[1] and ends[0][1] == 10
