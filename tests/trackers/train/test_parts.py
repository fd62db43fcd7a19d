"""Parts of the training, nearly all without physics."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.robot import rotations
from arena_newton.trackers import interface
from arena_newton.trackers.motions import kinematics
from arena_newton.trackers.train import __main__ as command_line
from arena_newton.trackers.train import session
from arena_newton.trackers.train.references import KEY_LINKS, ReferenceBank
from arena_newton.trackers.train.sampling import ClipSampler
from arena_newton.trackers.train.tally import Tally
from arena_newton.trackers.train.terms import events
from arena_newton.trackers.train.terms.measurement import TickMeasurement, TrainingError
from arena_newton.trackers.train.terms.rewards import REWARDS, configured, maximum
from arena_newton.trackers.train.terms.terminations import TERMINATIONS
from arena_newton.trackers.train.tracker_env import TrackerEnv
from arena_newton.trackers.train.train_options import TrainOptions
from arena_newton.trackers.twist2 import Twist2FrontEnd


@pytest.fixture(scope="module")
def bank(library):
    return ReferenceBank(library.to("cpu"), "cpu")


def perfect(bank: ReferenceBank, frame: torch.Tensor) -> TickMeasurement:
    """A tick in which the robot does what it was asked for: the measured state is the reference's own."""
    reference = bank.gather(frame)
    n, heading = len(frame), rotations.heading(reference.root_quat)[:, None]
    state = SimpleNamespace(
        qpos=torch.zeros(n, 36),
        qvel=torch.zeros(n, 35),
        root_pos=reference.root_pos,
        root_quat=reference.root_quat,
        root_vel=reference.lin_vel,
        root_ang_vel=reference.ang_vel,
        joint_pos=reference.joint_pos,
        joint_vel=reference.joint_vel,
        joint_acc=torch.zeros(n, 29),
        torque=torch.zeros(n, 29),
        joint_range=torch.tensor([[-3.0, 3.0]]).repeat(29, 1),
        key_links=lambda: rotations.turn(heading, reference.keys),
    )
    return TickMeasurement(
        state=state,
        reference=reference,
        foot_vel=torch.zeros(n, 2, 3),
        action=torch.zeros(n, 29),
        last_action=torch.zeros(n, 29),
        since_push=torch.full((n,), 1e3),
    )


def test_perfect_tracking_earns_every_positive_weight(bank):
    """Each positive weight is what perfect tracking earns per second, penalties are zero, and nothing ends."""
    motion = perfect(bank, torch.tensor([10, 200, 250]))
    for name, term in REWARDS.items():
        expected = 1.0 if term.weight > 0.0 else 0.0
        assert torch.allclose(term.value(motion), torch.full((3,), expected)), name
    assert not any((bound.value(motion) > bound.limit).any() for bound in TERMINATIONS.values())
    assert maximum(REWARDS) == pytest.approx(sum(t.weight * float(t.value(motion)[0]) for t in REWARDS.values()))


@pytest.mark.parametrize("error", ["velocity_error", "heading_error", "tilt_error", "yaw_rate_error"])
def test_an_error_costs_its_own_term(bank, error):
    """An error of the size of its term's scale lowers the term to 1/e, and no other tracking term."""
    worse, name = perfect(bank, torch.tensor([10, 200])), error.removesuffix("_error")
    setattr(worse, error, torch.zeros_like(getattr(worse, error)))
    getattr(worse, error).view(2, -1)[:, 0] = REWARDS[name].scale
    values = {n: t.value(worse) for n, t in REWARDS.items() if t.scale is not None}
    assert values.pop(name).tolist() == pytest.approx([math.exp(-1.0)] * 2)
    assert all((value > 0.99).all() for value in values.values())


def test_joint_errors_cost_all_joints_and_the_legs(bank):
    """An error of every joint lowers the terms of joint positions and legs and no other tracking term."""
    worse = perfect(bank, torch.tensor([10, 200]))
    worse.state.joint_pos = worse.state.joint_pos + 0.2
    fallen = {n for n, t in REWARDS.items() if t.weight > 0.0 and (t.value(worse) < 0.99).any()}
    assert fallen == {"joint_position", "legs"}


def test_weights_and_scales_are_options():
    """Terms take another weight or scale by name; a name without one is refused with its flag."""
    changed = configured({"alive": 2.0}, {"legs": 0.1})
    assert changed["alive"].weight == 2.0 and changed["legs"].scale == 0.1
    assert changed["legs"].weight == REWARDS["legs"].weight and changed["feet"] == REWARDS["feet"]
    for arguments, words in (
        (({"leg": 1.0}, {}), "--rewards leg: no such"),
        (({}, {"alive": 1.0}), "--reward-scales a"),
    ):
        with pytest.raises(InputError, match=words):
            configured(*arguments)


def test_a_foot_that_stays_behind_ends_the_episode_unless_a_push_may_ask_for_steps(bank):
    """A kick that is left out ends the episode; a foot that catches a push does not."""
    motion = perfect(bank, torch.tensor([10, 200]))
    motion.keys[1, 0, 0] -= 0.3
    bound = TERMINATIONS["feet"]
    assert (bound.value(motion) > bound.limit).tolist() == [False, True]
    assert (REWARDS["feet"].value(motion) < 0.5).tolist() == [False, True]
    motion.since_push = torch.tensor([0.1, 0.1])
    assert not (bound.value(motion) > bound.limit).any()


def test_pushes_strike_as_often_and_as_hard_as_set():
    """Jumps have any direction and every size up to the largest; a struck world remembers when."""
    torch.manual_seed(0)
    worlds = 20000
    sim = SimpleNamespace(
        worlds=worlds,
        qpos=torch.zeros(worlds, 36),
        root_vel=torch.zeros(worlds, 3),
        root_ang_vel=torch.zeros(worlds, 3),
    )
    env = SimpleNamespace(sim=sim, since_push=torch.full((worlds,), 1e3))
    mask = torch.arange(worlds) % 2 == 0
    events.push(env, mask, every=0.04, planar=1.2, vertical=0.0, turn=0.0)
    speed = sim.root_vel[:, :2].norm(dim=1)
    struck = env.since_push == 0.0
    assert (struck == (speed > 0.0)).all() and not struck[~mask].any()
    assert float(struck[mask].float().mean()) == pytest.approx(0.5, abs=0.02)
    assert float(speed.max()) <= 1.2 and float(speed[struck].mean()) == pytest.approx(0.6, abs=0.02)
    assert float(sim.root_vel[struck, :2].mean(0).norm()) < 0.03


def test_key_links_are_seen_from_the_heading_frame(library):
    """Key links do not change when a clip is moved and turned on the floor."""
    yaw = rotations.quat_from_yaw(torch.tensor(1.1)).float().expand(library.frames, 4)
    turned = dataclasses.replace(
        library,
        root_pos=rotations.quat_apply(yaw, torch.tensor(library.root_pos)).numpy() + [3.0, -2.0, 0.0],
        root_quat=rotations.quat_multiply(yaw, torch.tensor(library.root_quat)).numpy(),
    )
    here, there = (
        ReferenceBank(lib.to("cpu"), "cpu").gather(torch.tensor([70, 220])).keys for lib in (library, turned)
    )
    assert torch.allclose(here, there, atol=1e-5)
    assert torch.allclose(here[:, :2, 2], torch.full((2, 2), kinematics.SOLE_HEIGHT), atol=1e-5)
    assert here.shape == (2, len(KEY_LINKS), 3)


def test_turning_a_quaternion_by_a_small_vector():
    """`turned_by` turns in the body's frame, so that gravity seen from the body moves by the vector's length."""
    quat = rotations.quat_from_yaw(torch.tensor([0.7]))
    turned = rotations.turned_by(quat, torch.tensor([[0.02, 0.0, 0.0]]))
    assert torch.allclose(rotations.roll_pitch(turned), torch.tensor([[0.02, 0.0]]), atol=1e-5)
    assert torch.allclose(rotations.heading(turned), torch.tensor([0.7]), atol=1e-5)
    assert torch.allclose(
        rotations.gravity_in_body(turned),
        rotations.quat_apply(rotations.quat_conjugate(turned), torch.tensor([[0.0, 0.0, -1.0]])),
        atol=1e-6,
    )


def test_failures_draw_episodes(bank):
    """A bin in which the tracker fails is drawn more often, and no start lies outside a clip or at its very end."""
    torch.manual_seed(0)
    sampler = ClipSampler(bank, adaptive=0.5)
    before = sampler.bin_of[sampler.sample(20000)]
    worst = int(sampler.bin_of[220])
    for _ in range(200):
        sampler.record(torch.arange(bank.frames), sampler.bin_of == worst, 0.02)
    sampler.renew()
    drawn = sampler.sample(20000)
    share = lambda bins: float(((bins == worst) | (bins == worst - 1)).float().mean())  # noqa: E731
    assert share(sampler.bin_of[drawn]) > 1.3 * share(before)
    assert (bank.last[drawn] - drawn >= 25).all()
    assert (drawn >= bank.start[bank.clip_of[drawn]]).all()


def test_guard_names_term_and_world(bank):
    """A term that is not finite stops the training with its name and its world."""
    tally = Tally(list(REWARDS), list(TERMINATIONS), bank.family_names, "cpu")
    values, seen, action = torch.zeros(4, len(REWARDS)), torch.zeros(4, 7), torch.zeros(4, 29)
    tally.guard(values, seen, seen, action)
    tally.collect()
    values[2, list(REWARDS).index("tilt")] = float("nan")
    tally.guard(values, seen, seen, action)
    with pytest.raises(TrainingError, match="world 2: reward tilt is not finite"):
        tally.collect()
    action[3, 5] = float("inf")
    tally.guard(torch.zeros_like(values), seen, seen, action)
    with pytest.raises(TrainingError, match="world 3: action is not finite"):
        tally.collect()


def test_a_training_says_first_what_it_builds(tmp_path, monkeypatch, capsys):
    """Before references are made, which takes minutes on a CPU; without --worlds a CPU gets 16 of them, not a GPU's."""

    def stop(options, device, seed):
        raise InputError(f"{options.worlds} worlds")

    monkeypatch.setattr(session, "make_library", stop)
    assert command_line.main(["--device", "cpu", "--log-dir", str(tmp_path / "log")]) == 2
    said = capsys.readouterr()
    assert said.out == "generating references, then building 16 worlds on cpu ...\n"
    assert said.err == "error: 16 worlds\n"


DELAYED = {"fraction": 1.0, "ticks": 3.0}


class ForeseeingFrontEnd(Twist2FrontEnd):
    """TWIST2's front end that is given state estimation and a window, and keeps what it is given."""

    needs, lookahead = ("position", "lin_vel"), 3

    def write(self, command, state):
        super().write(command, state)
        self.given = command, state


def test_declared_fields_are_given_in_training(library):
    """A front end with a window gets the next frames of its clip, its last one repeated, and exact state estimation."""
    foreseeing = dataclasses.replace(interface.get("twist2"), front_end=ForeseeingFrontEnd)
    form = foreseeing.action_form("auto")
    env = TrackerEnv(foreseeing, form, library.to("cpu"), TrainOptions(worlds=2, randomise=False))
    last = env.bank.start + env.bank.length - 1
    env.reset(torch.stack([env.bank.start[0], last[0] - 3]))
    command, state = env.front_end.given
    assert torch.equal(state.position, env.sim.root_pos) and torch.equal(state.lin_vel, env.sim.root_vel)
    for world, frame in enumerate(env.frame):
        later = torch.minimum(frame + torch.arange(1, 5), env.bank.last[frame])
        reference = env.bank.gather(later)
        assert torch.equal(command.position[world], reference.root_pos[0])
        assert torch.equal(command.ahead.joints[world], reference.joint_pos[1:])
        assert torch.equal(command.ahead.position[world], reference.root_pos[1:])
    blind = dataclasses.replace(foreseeing, front_end=type("Feet", (Twist2FrontEnd,), {"needs": ("foot_force",)}))
    with pytest.raises(InputError, match="'twist2': needs foot_force, which training does not measure"):
        TrackerEnv(blind, form, library.to("cpu"), TrainOptions(worlds=2))


def test_events_are_options():
    """Events take other settings by name; what is unknown or out of range is refused with its flag."""
    changed = events.configured([("push", "planar", 2.0), ("push", "every", 3.0), ("action_delay", "ticks", 2.0)])
    assert changed["push"].settings == dict(events.EVENTS["push"].settings) | {"planar": 2.0, "every": 3.0}
    assert changed["action_delay"].settings["ticks"] == 2.0 and changed["friction"] == events.EVENTS["friction"]
    assert list(changed) == list(events.EVENTS)
    for change, words in (
        (("shove", "planar", 1.0), "--events shove: no such event; known are friction"),
        (("push", "planer", 1.0), "--events push planer: no such setting; push has every, planar"),
        (("payload", "fraction", 1.5), "--events payload fraction 1.5: expected a number from 0 to 1"),
        (("action_delay", "ticks", 1.5), "--events action_delay ticks 1.5: expected a whole number"),
        (("state_delay", "ticks", 11.0), "from 1 to 10"),
        (("friction", "low", 2.0), "--events friction: low 2 is above high 1.2"),
        (("push", "planar", float("nan")), "--events push planar nan"),
    ):
        with pytest.raises(InputError, match=words):
            events.configured([change])
    with pytest.raises(InputError, match="--events push planar: given twice"):
        events.configured([("push", "planar", 1.0), ("push", "turn", 1.0), ("push", "planar", 2.0)])


def test_late_signals_are_what_the_tracker_lives_with(library):
    """With both latencies drawn, targets arrive and states are seen as many ticks late as each world drew."""
    twist2 = interface.get("twist2")
    changes = [(name, key, value) for name in ("action_delay", "state_delay") for key, value in DELAYED.items()]
    quiet = [("push", "planar", 0.0), ("push", "vertical", 0.0), ("push", "turn", 0.0)]
    torch.manual_seed(0)
    kept = TrainOptions(worlds=8, episode_s=60.0)
    drawn = events.configured(changes + quiet)
    env = TrackerEnv(twist2, twist2.action_form("auto"), library.to("cpu"), kept, randomisation=drawn)
    assert env.critic_widths["state_delay"] == 1
    targets, given, states, seen = [], [], [], []
    act, observe, noisy = env.front_end.act, env.front_end.observe, env._noisy_state
    env.front_end.act = lambda action: targets.append(act(action).clone()) or targets[-1]
    env._noisy_state = lambda: states.append(noisy()) or states[-1]
    env.front_end.observe = lambda command, state: seen.append(state.joint_pos.clone()) or observe(command, state)
    env.sim.step = lambda: given.append(env.sim.targets.clone())
    env.reset(env.bank.start[torch.zeros(8, dtype=torch.long)])
    ages = {name: getattr(env, f"late_{name}").ticks.clone() for name in ("targets", "state")}
    assert all(1 < len(set(drawn.tolist())) and set(drawn.tolist()) <= {1, 2, 3} for drawn in ages.values()), ages
    for _ in range(8):
        env.sim.joint_pos.add_(0.001)
        env.step(0.1 * torch.randn(8, env.num_actions))
    assert env.episode_length_buf.tolist() == [8] * 8, "a world that starts again forgets"
    states = [state.joint_pos for state in states]
    for world in range(8):
        targets_age, state_age = int(ages["targets"][world]), int(ages["state"][world])
        for tick in range(3, 8):
            assert torch.equal(given[tick][world], targets[tick - targets_age][world])
            assert torch.equal(seen[tick + 1][world], states[tick + 1 - state_age][world])
