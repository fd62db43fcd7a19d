"""The closed loop as one graph of torch: it is the episode, and its slopes are those of differences."""

import re

import numpy as np
import pytest
import torch

from arena_newton import ArenaEnv, Rollout, canonical, policies, trackers
from arena_newton.differentiable import closed_loop, reach, reset_state, soft_onset
from arena_newton.errors import InputError
from arena_newton.interfaces import Chunk

SEED = 5
PARAMETERS = ("friction", "mass:/World/Robot/torso_link", "kp", "kd")


def worlds(task="vis_navi", tracker="twist2", rules="released", checkpoint=None):
    """One world of a task."""
    follows = trackers.get(tracker, checkpoint)
    return ArenaEnv(task, tracker=follows, worlds=1, engine="mujoco", rules=rules, fast_physics=True)


@pytest.fixture(scope="module")
def hall():
    """One world of VisNavi with TWIST2, without a start-up."""
    env = worlds()
    yield env
    env.close()


def plan(ticks, speed=0.4):
    """Actions that walk ahead and swing the joints a little, shape [1, ticks, 40]."""
    actions = torch.from_numpy(canonical.STAND_ACTION).double().repeat(1, ticks, 1)
    actions[..., 0] = 0.02 * speed
    actions[..., 9:38] += 0.05 * torch.sin(torch.arange(ticks) / 3.0)[:, None]
    return actions


def precise(env):
    """The environment with a solver without tolerance: its differences are otherwise those of where it stops."""
    for model in env.physics.models:
        model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 100, 100
    return env


def played(env, actions):
    """Positions and margins after each tick of the environment's own episode."""
    env.reset([SEED])
    for _ in range(env.startup_ticks):
        env.step(canonical.STAND_ACTION[None])
    rows = []
    for action in actions.float().unbind(1):
        env.step(action)
        rows.append((env.physics.data[0].qpos.copy(), float(env.judge.margin.numpy()[0])))
    env.release([0])
    return tuple(torch.tensor(np.array(column)) for column in zip(*rows, strict=True))


OFFICIAL = "reference/twist2/twist2_1017_20k.onnx"
CASES = [("pd", "vis_navi", "released"), ("twist2", "football", "paper"), ("sonic", "sit_sofa", "released")]


@pytest.mark.parametrize(("tracker", "task", "rules"), [*CASES, ("official", "vis_navi", "released")])
def test_the_loop_replays_the_episode(tracker, task, rules, request):
    """Positions and margins are those of the environment's own episode, start-up included, but for rounding."""
    checkpoint = request.getfixturevalue("shared") / OFFICIAL if tracker == "official" else None
    env = worlds(task, "twist2" if checkpoint else tracker, rules, checkpoint)
    actions = plan(12)
    with torch.no_grad():
        rolled = closed_loop(env, actions, [SEED], 12)
    qpos, margin = played(env, actions)
    torch.testing.assert_close(rolled.qpos[1:, 0], qpos, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(rolled.margin[:, 0], margin.double(), atol=1e-4, rtol=0.0)
    env.close()


@pytest.mark.parametrize("tracker", ["twist2", "sonic"])
def test_slopes_are_those_of_differences(tracker):
    """Through ten ticks, slopes to actions, start poses, speeds and factors of the model are right to 0.1 %."""
    env = precise(worlds(tracker=tracker))
    robot, start = env.scene.robot, reset_state(env, [SEED])
    weights = torch.zeros(env.physics.nq).double()
    weights[robot.root_qpos : robot.root_qpos + 3] = torch.tensor([1.0, -0.7, 0.4]).double()
    given = [plan(10), start.qpos, start.qvel, torch.ones(1, len(PARAMETERS)).double()]

    def ended(actions, qpos, qvel, factors):
        moved = start._replace(qpos=qpos, qvel=qvel)
        rolled = closed_loop(env, actions, [SEED], 10, parameters=PARAMETERS, factors=factors, start=moved)
        return rolled.qpos[-1, 0] @ weights

    leaves = [part.clone().requires_grad_() for part in given]
    gradients = torch.autograd.grad(ended(*leaves), leaves)
    draws, width = torch.Generator().manual_seed(0), 1e-6
    for part, gradient in enumerate(gradients):
        direction = torch.randn(gradient.shape, generator=draws).double()
        if part == 0:
            direction[..., 38:] = 0.0  # hands
        if part == 1:
            keep = torch.zeros_like(direction)
            keep[:, robot.joint_qpos] = 1.0
            direction *= keep
        ends = [[g + width * side * direction if n == part else g for n, g in enumerate(given)] for side in (1, -1)]
        with torch.no_grad():
            ahead, behind = (ended(*end) for end in ends)
        slope = float((gradient * direction).sum())
        assert abs(slope) > 1e-4
        assert slope == pytest.approx(float(ahead - behind) / (2 * width), rel=1e-3), part
    env.close()


def test_parts_that_are_computed_again(hall):
    """Checkpoints change no bit of a gradient and keep a third at most; truncation cuts off what was before."""
    found = {}
    for name, options in {"whole": {}, "again": {"checkpoint": 4}, "cut": {"truncate": 4}}.items():
        actions = plan(8).requires_grad_()
        rolled = closed_loop(hall, actions, [SEED], 8, parameters=["kp"], **options)
        found[name] = rolled, *torch.autograd.grad(rolled.margin[-1].sum(), (actions, rolled.factors))
    whole, again, cut = (found[name] for name in ("whole", "again", "cut"))
    assert all(torch.equal(a, b) for a, b in zip(whole[1:], again[1:], strict=True))
    assert again[0].memory < whole[0].memory / 3 and whole[0].memory < 100_000
    assert torch.equal(whole[0].qpos, cut[0].qpos)
    assert whole[1][:, :4].any() and cut[1][:, 4:].any() and not cut[1][:, :4].any()


def test_the_margin_leads_to_where_things_start():
    """A ball that is a little nearer to the goal has the margin of the judge's own differences."""
    env = worlds("football", "pd")
    start, ball = reset_state(env, [SEED]), env.scene.joint_qpos("/World/Ball")
    qpos = start.qpos.clone().requires_grad_()
    margin = closed_loop(env, plan(2, 0.0), [SEED], 2, start=start._replace(qpos=qpos)).margin[-1]
    (gradient,) = torch.autograd.grad(margin.sum(), qpos)
    slopes = []
    with torch.no_grad():
        for axis in range(3):
            ends = [
                start.qpos.index_add(1, torch.tensor([ball + axis]), torch.full((1, 1), h).double())
                for h in (-1e-2, 1e-2)
            ]
            below, above = (
                closed_loop(env, plan(2, 0.0), [SEED], 2, start=start._replace(qpos=end)).margin[-1] for end in ends
            )
            slopes.append(float(above - below) / 2e-2)
    assert max(map(abs, slopes[:2])) > 0.3
    assert gradient[0, ball : ball + 2].tolist() == pytest.approx(slopes[:2], abs=1e-3)
    env.close()


class Leaning(torch.nn.Module):
    """A policy of one layer: the standing action, moved by the state."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(64, 29, bias=False, dtype=torch.float64)
        torch.nn.init.normal_(self.layer.weight, std=0.02, generator=torch.Generator().manual_seed(1))

    def forward(self, state):
        stand = torch.from_numpy(canonical.STAND_ACTION).double()
        return torch.cat(
            [stand[:9].expand(len(state), 9), stand[9:38] + self.layer(state), stand[38:].expand(len(state), 2)], 1
        )


class Asked(policies.Policy):
    """The same as a policy of the benchmark."""

    name = "asked"

    def __init__(self):
        self.network = Leaning()

    def act(self, observation):
        return Chunk(self.network(observation.state.double())[:, None])


def test_policies_that_compute_in_torch_have_gradients(hall):
    """A module's weights have the slope of differences, as a benchmark's policy the same; an expert's actions none."""
    slopes = []
    for actor in (Leaning(), Asked()):
        network = actor if isinstance(actor, Leaning) else actor.network
        rolled = closed_loop(hall, actor, [SEED], 3)
        assert rolled.answers
        (gradient,) = torch.autograd.grad(rolled.qpos[-1].sum(), network.layer.weight)
        slopes.append(gradient)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-3, atol=1e-4)
    way, ends = torch.randn(29, 64, generator=torch.Generator().manual_seed(2)).double(), []
    for side in (1e-6, -1e-6):
        moved = Leaning()
        with torch.no_grad():
            moved.layer.weight += side * way
            ends.append(closed_loop(hall, moved, [SEED], 3).qpos[-1].sum())
    assert float((slopes[0] * way).sum()) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-2)
    assert not closed_loop(hall, policies.get("expert"), [SEED], 2).answers


def test_what_has_no_gradient_is_refused(hall):
    """A fall, an episode that has ended, a tracker without torch functions and actions of another shape are named."""
    tilted = plan(60)
    tilted[..., 9:38] += 1.5
    with pytest.raises(InputError, match=r"closed_loop: world 0 ended after tick \d+ \(fall\)"):
        closed_loop(hall, tilted, [SEED], 60)
    with torch.no_grad():
        assert closed_loop(hall, tilted, [SEED], 60).margin[-1, 0] == -torch.inf
    with pytest.raises(InputError, match=r"closed_loop: actions of shape \[1, 3, 40\], expected \[1, 4, 40\]"):
        closed_loop(hall, plan(3), [SEED], 4)
    with pytest.raises(InputError, match=r"tracker tracker has no gradient"):
        trackers.Tracker().graded(1)


def test_dynamics_without_a_gradient_are_refused():
    """An episode of mode dynamics whose latency or push acts is refused by the name of what acts; others are played."""
    env = ArenaEnv(
        "vis_navi", tracker=trackers.get("pd"), worlds=1, engine="mujoco", mode="dynamics", fast_physics=True
    )
    said = set()
    for seed in range(12):
        try:
            with torch.no_grad():
                assert closed_loop(env, plan(1), [seed], 1).qpos.isfinite().all()
        except InputError as error:
            said.add(re.sub("closed_loop: mode dynamics draws a (.*), which has no gradient", r"\1", str(error)))
    assert {"state_latency", "action_latency"} <= said <= {"state_latency", "action_latency", "push"}
    env.close()


def test_reach_tells_a_slope_that_holds_from_one_that_does_not():
    """A slope that differences at one of two scales contradict is flagged, as of a sawtooth on a trend."""

    def sawtooth(points):
        return points[:, 0] + points[:, 1] - 5.0 * ((points[:, 1] / 4e-3) % 1.0 - 0.5) * 4e-3

    found = reach(
        sawtooth, torch.tensor([0.1, 0.0501]).double(), torch.tensor([1.0, -4.0]).double(), (5e-4, 2e-2), rows=5
    )
    torch.testing.assert_close(found.near, found.slope, atol=1e-6, rtol=0.0)
    assert abs(found.far[1] - 1.0) < 0.3 and found.holds.tolist() == [True, False]


def test_a_slope_next_to_a_fall_does_not_hold():
    """Nothing holds within a scale in which a world falls, to one side or to both: differences are not finite."""

    def falls(points):
        return points.masked_fill(points > 0.5, -torch.inf)[:, 0]

    at, slope = torch.zeros(1).double(), torch.ones(1).double()
    assert reach(falls, at, slope, (0.1, 0.4), rows=3).holds.all()
    assert not reach(falls, at, slope, (0.1, 1.0), rows=3).holds.any()
    assert not reach(falls, at + 3.0, slope, (0.1, 1.0), rows=3).holds.any()


def test_a_planning_model_is_no_engine():
    """A contact that begins smoothly is another world: it names itself, plays no episode and refuses unfit prims."""
    env = worlds("football", "pd")
    robot = env.scene.geom_ids("/World/Robot")
    before = env.physics.mj_model.geom_solimp.copy()
    with pytest.raises(InputError, match="prim /World/Light holds no collision geometry"):
        soft_onset(env, "/World/Light")
    with pytest.raises(InputError, match="width 0 m, expected more than 0"):
        soft_onset(env, "/World/Ball", width=0.0)
    soft_onset(env, "/World/Ball", width=0.02)
    after, ball = env.physics.mj_model.geom_solimp, env.scene.geom_ids("/World/Ball")
    assert (after[ball, 0] == 1e-4).all() and (after[ball, 2] == 0.02).all()
    assert np.array_equal(after[robot], before[robot])
    damping = -env.physics.mj_model.geom_solref[ball, 1] * env.physics.mj_model.opt.timestep
    assert (damping < 0.2).all()  # 1 takes the approach away within a step
    assert env.describe()["engine"] == "mujoco, planning model: /World/Ball touches over 0.02 m"
    with pytest.raises(InputError, match="planning model .* no episode is played"):
        Rollout(env, policies.get("stand"), [])
    with torch.no_grad():
        assert closed_loop(env, plan(2), [SEED], 2).qpos.isfinite().all()
    env.close()
