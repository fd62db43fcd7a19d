"""Cheats that `eval certify --quick` must find, each a small patch of the product, by the name of the check that fails.

`CHEATS` has a row a cheat: the check that finds it, and its patch. Without a patch the same checks pass.
"""

import json
import re
import shutil

import pytest
import warp as wp

from arena_newton.env import ArenaEnv
from arena_newton.eval.certification import certify
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import inputs, replays, solvable
from arena_newton.eval.folders.recordings import ActionRecorder
from arena_newton.eval.play.factories import Factories
from arena_newton.policies.experts.base import ExpertPolicy
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding
from arena_newton.trackers.twist2 import Twist2Tracker

HONEST = ("journal", "recording", "policy-inputs", "tracker-inputs")
"""Checks of an honest certification, from whose folder cheats go on."""


@pytest.fixture(scope="module")
def certified(kept_worlds):
    """Exit code of a certification of Football through TWIST2, one episode a cell."""
    given = {"task": ("football",), "tracker": ("twist2",), "episodes": 1, "quick": True, "resume": True}

    def code(folder, *checks):
        options = CertifyOptions(out=str(folder), checks=checks, **given)
        return certify.run(options, Factories(env=kept_worlds))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solvable, "rule_sets", lambda: ("paper",))
        patch.setattr(replays, "RECORDED_TICKS", 60)
        patch.setattr(inputs, "HEARD_TICKS", 60)
        patch.setattr(inputs, "SEEDS_TRIED", 1)  # in the world of the others
        yield code


@pytest.fixture(scope="module")
def honest(certified, tmp_path_factory):
    """A folder in which nothing cheated, and its exit code."""
    folder = tmp_path_factory.mktemp("honest")
    return folder, certified(folder, *HONEST)


def behind(monkeypatch, kind, method, after):
    """Call `after` with each object of a class whose method is called: the back door of all cheats here."""
    began = getattr(kind, method)

    def called(self, *given, **named):
        answer = began(self, *given, **named)
        after(self)
        return answer

    monkeypatch.setattr(kind, method, called)


def teleporting_expert(monkeypatch, folder):
    """It puts the ball into the goal when it is near."""
    envs, act = [], ExpertPolicy.act
    behind(monkeypatch, ArenaEnv, "reset", envs.append)

    def cheat(self, observation):
        env = envs[-1]
        ball = env.scene.joint_qpos("/World/Ball")
        for data in env.physics.data:
            if abs(data.qpos[ball : ball + 2] - data.qpos[:2]).max() < 1.5:
                data.qpos[ball : ball + 2] = self.expert._goal()[0, :2].numpy()
        return act(self, observation)

    monkeypatch.setattr(ExpertPolicy, "act", cheat)


def expert_that_holds_the_clock(monkeypatch, folder):
    """Each second tick does not count."""
    envs, act = [], ExpertPolicy.act
    behind(monkeypatch, ArenaEnv, "reset", envs.append)

    def cheat(self, observation):
        envs[-1].tick -= envs[-1].tick > 40
        return act(self, observation)

    monkeypatch.setattr(ExpertPolicy, "act", cheat)


def moved_targets(monkeypatch, look):
    """TWIST2, with a thousandth of what it looks at behind the back of the interface added to its targets."""
    step = Twist2Tracker.step

    def cheat(self, command, state, mask=None):
        targets = step(self, command, state) if mask is None else step(self, command, state, mask)
        return targets + 1e-3 * look()

    monkeypatch.setattr(Twist2Tracker, "step", cheat)


def tracker_that_reads_the_coming_reference(monkeypatch, folder):
    """It looks into the chunk that the policy has given, five ticks ahead."""
    rollouts = []
    behind(monkeypatch, Rollout, "__init__", rollouts.append)

    def ahead():
        chunk = rollouts[-1]._chunk
        return chunk[0, min(int(rollouts[-1]._next[0]) + 5, chunk.shape[1] - 1), 9:38]

    moved_targets(monkeypatch, ahead)


def tracker_that_reads_the_objects(monkeypatch, folder):
    """It looks where the ball is, as seen from the robot."""
    envs = []
    behind(monkeypatch, ArenaEnv, "reset", envs.append)

    def ball():
        env = envs[-1]
        there = wp.to_torch(env.physics.xpos)[0]
        return there[env.scene.body_id("/World/Ball"), 0] - there[int(env.scene.robot.bodies[0]), 0]

    moved_targets(monkeypatch, ball)


def recorder_that_drops_a_tick(monkeypatch, folder):
    """Actions lack one of tick 50."""
    keep = ActionRecorder.before_physics

    def cheat(self, env, observation, action):
        if env.tick[0] != 50:
            keep(self, env, observation, action)

    monkeypatch.setattr(ActionRecorder, "before_physics", cheat)
    for one in (folder / "runs" / "football").glob("*_recording_*"):
        shutil.rmtree(one)


def recorder_that_repeats_a_tick(monkeypatch, folder):
    """Actions have that of tick 50 twice and that of tick 51 not, so that their number is right."""
    keep, last = ActionRecorder.before_physics, []

    def cheat(self, env, observation, action):
        last.append(action.clone())
        keep(self, env, observation, last[-2] if env.tick[0] == 51 else action)

    monkeypatch.setattr(ActionRecorder, "before_physics", cheat)
    for one in (folder / "runs" / "football").glob("*_recording_*"):
        shutil.rmtree(one)


def policy_that_draws_the_placements_from_its_seed(monkeypatch, folder):
    """It is given the episode's own seed, and the rules' draws are public."""
    monkeypatch.setattr(seeding, "policy_seed", int)


def edited(folder, **changes):
    """Change the journal of the expert's episodes."""
    path = folder / "runs" / "football" / "twist2_paper_base" / "episodes.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps(line | changes) + "\n" for line in lines))
    return lines[-1]


def journal_with_edited_outcomes(monkeypatch, folder):
    """A word was changed and nothing else."""
    edited(folder, outcome="timeout", reason="timeout")


def journal_edited_with_care(monkeypatch, folder):
    """A success comes earlier than it did, and all keys of the line say so."""
    line = edited(folder)
    sooner = line["predicates"] | {list(line["predicates"])[-1]: line["steps"] - 25}
    edited(folder, steps=line["steps"] - 25, predicates=sooner)


def journal_that_lost_a_line(monkeypatch, folder):
    """An episode was taken out after the run had ended."""
    (folder / "runs/football/twist2_paper_base/episodes.jsonl").write_text("")


def journal_without_its_mark(monkeypatch, folder):
    """The policy that takes the world itself is no longer called privileged."""
    edited(folder, privileged=False)
    path = folder / "runs/football/twist2_paper_base/config.json"
    document = json.loads(path.read_text())
    document["config"]["policy_facts"]["privileged"] = False
    path.write_text(json.dumps(document))


CHEATS = [
    ("solvable", teleporting_expert),
    ("solvable", expert_that_holds_the_clock),
    ("tracker-inputs", tracker_that_reads_the_coming_reference),
    ("tracker-inputs", tracker_that_reads_the_objects),
    ("recording", recorder_that_drops_a_tick),
    ("recording", recorder_that_repeats_a_tick),
    ("policy-inputs", policy_that_draws_the_placements_from_its_seed),
    ("journal", journal_with_edited_outcomes),
    ("journal", journal_edited_with_care),
    ("journal", journal_that_lost_a_line),
    ("journal", journal_without_its_mark),
]
"""The check that finds a cheat, and its patch: `cheat(monkeypatch, folder)` of a folder that is certified again."""


def test_the_honest_pass(honest, capsys):
    """Without a patch every check that finds a cheat passes."""
    assert honest[1] == 0


@pytest.mark.parametrize(("check", "cheat"), CHEATS, ids=[cheat.__name__ for _, cheat in CHEATS])
def test_a_cheat_is_found_by_name(honest, certified, tmp_path, monkeypatch, capsys, check, cheat):
    """`certify --quick` fails, and its line names the check."""
    folder = tmp_path / "cheat"
    if check != "solvable":
        shutil.copytree(honest[0], folder)
        shutil.rmtree(folder / "measured")
    cheat(monkeypatch, folder)
    assert certified(folder, check) == 1
    assert re.search(rf"^fail  {check} ", capsys.readouterr().out, re.MULTILINE)
