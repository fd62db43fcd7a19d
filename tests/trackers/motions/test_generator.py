"""The streaming reference generator."""

import ast
import importlib
import math
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp

from arena_newton.kernels.canonical import ReferencePose, launch_integrate, launch_reset_reference
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, DEFAULT_POSE, TICK
from arena_newton.trackers.motions import commands, kinematics
from arena_newton.trackers.motions.commands import CHANNELS, COMMAND_WIDTH, LIMITED_COLUMNS, MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator
from arena_newton.trackers.motions.kinematics import SOLE_HEIGHT

FEET = [kinematics.link_index(f"{side}_ankle_roll_link") for side in ("left", "right")]


class Played:
    """Frames of a batch, stacked over time."""

    def __init__(self, command, ticks, generator=None):
        """`command(time)` gives the command of a tick."""
        first = command(0.0)
        self.generator = g = generator or ReferenceGenerator(len(first.height))
        rows = {k: [] for k in ("root", "quat", "joints", "support", "feet", "com", "error", "action", "kick")}
        for tick in range(ticks):
            f = g.step(command(tick * TICK))
            for name, value in {
                "root": f.root_pos,
                "quat": f.root_quat,
                "joints": f.joint_pos,
                "support": g.support,
                "feet": g.feet_pos,
                "com": g.com,
                "error": g.ik_error,
                "action": g.action(),
                "kick": g.kick_progress,
            }.items():
                rows[name].append(value.clone())
        for name, values in rows.items():
            setattr(self, name, torch.stack(values, 1))

    def poses(self) -> kinematics.Poses:
        """Kinematics of every frame."""
        return kinematics.forward(self.root.double(), self.quat.double(), self.joints.double())


def constant(worlds: int = 1, **channels) -> MotionCommand:
    """A neutral command with some channels, each a row for all worlds or one a world."""
    command = MotionCommand.neutral(worlds)
    for name, value in channels.items():
        channel = getattr(command, name)
        channel[:] = torch.tensor(value, dtype=channel.dtype)
    return command


def test_starts_in_the_default_pose():
    """Before the first tick the frame is the robot's default pose on the ground, and standing stays there."""
    g = ReferenceGenerator(2)
    np.testing.assert_allclose(g.frames.joint_pos, np.tile(DEFAULT_POSE, (2, 1)), atol=1e-6)
    for _ in range(50):
        g.step(MotionCommand.neutral(2))
    np.testing.assert_allclose(g.frames.joint_pos, np.tile(DEFAULT_POSE, (2, 1)), atol=5e-3)
    np.testing.assert_allclose(g.frames.root_pos[:, :2], 0.0, atol=1e-3)
    assert g.settled.all() and g.support.all()


WALKS = {
    "forward": (0.6, 0.0, 0.0),
    "fast": (0.8, 0.0, 0.0),
    "back": (-0.35, 0.0, 0.0),
    "side": (0.0, 0.3, 0.0),
    "turn": (0.0, 0.0, 0.8),
    "arc": (0.4, 0.1, -0.5),
}


@pytest.fixture(scope="module")
def walks() -> Played:
    """6 s of each walk, then 3 s of nothing."""
    on, off = constant(len(WALKS), velocity=list(WALKS.values())), MotionCommand.neutral(len(WALKS))
    return Played(lambda t: on if t < 6.0 else off, 450)


def test_walks_cover_the_commanded_way(walks):
    """A straight walk covers the integral of its velocity, rate limits aside, and a turn its angle."""
    way = walks.root[:, 300] - walks.root[:, 100]
    names = list(WALKS)
    for name in ("forward", "fast", "back"):
        assert float(way[names.index(name), 0]) == pytest.approx(4.0 * WALKS[name][0], abs=0.02)
    assert float(way[names.index("side"), 1]) == pytest.approx(1.2, abs=0.1)
    yaw = 2.0 * torch.atan2(walks.quat[:, :, 3], walks.quat[:, :, 0])[names.index("turn")]
    turned = np.unwrap(yaw.numpy())
    assert turned[300] - turned[100] == pytest.approx(4.0 * 0.8, abs=0.03)


def test_walks_are_within_reach(walks):
    """Legs reach every footstep, joints keep a margin to their limits and stay below 12 rad/s."""
    low, high = kinematics.chain().limits[1:].T
    assert float(walks.error.max()) < 1e-4
    joints = walks.joints.numpy()
    assert (joints > low + 0.029).all() and (joints < high - 0.029).all()
    assert float((walks.joints[:, 1:] - walks.joints[:, :-1]).abs().max()) / TICK < 12.0


def test_support_feet_are_flat_and_do_not_slide(walks):
    """A foot on the ground moves less than 2 mm a step, at sole height, level to a milliradian."""
    poses = walks.poses()
    position, quat = poses.position[:, :, FEET], poses.quat[:, :, FEET]
    both = walks.support[:, 1:] & walks.support[:, :-1]
    moved = (position[:, 1:] - position[:, :-1]).norm(dim=-1)
    assert float(moved[both].max()) < 2e-4
    assert float((moved * both).sum(1).max()) / 10 < 2e-3
    down = walks.support
    assert float((position[..., 2][down] - SOLE_HEIGHT).abs().max()) < 2e-4
    tilt = quat[..., 1].square() + quat[..., 2].square()
    assert float(tilt[down].max().sqrt()) < 1e-3


def test_pelvis_does_not_bob(walks):
    """Once a walk is under way its pelvis keeps its height to a millimetre."""
    assert float(walks.root[:, 100:300, 2].std(1).max()) < 1e-3


def test_one_foot_always_stands(walks):
    """No frame has both feet in the air."""
    assert walks.support.any(2).all()


def test_walks_end_side_by_side(walks):
    """Three seconds after the command ends all stand still, feet parallel at the stance width."""
    g = walks.generator
    assert g.settled.all()
    assert float((g.feet_yaw[:, 0] - g.feet_yaw[:, 1]).abs().max()) < 0.02
    apart = (g.feet_pos[:, 0] - g.feet_pos[:, 1]).norm(dim=1)
    np.testing.assert_allclose(apart, 0.22, atol=0.01)
    assert float((walks.root[:, -1] - walks.root[:, -10]).norm(dim=1).max()) < 1e-3


def test_squat_keeps_balance():
    """Down to 0.40 m the feet stay and the centre of mass stays over the soles."""
    on, off = constant(2, height=[0.40, 0.55], pitch=[0.35, 0.2]), MotionCommand.neutral(2)
    played = Played(lambda t: on if t < 4.0 else off, 350)
    assert float(played.root[0, 199, 2]) == pytest.approx(0.40, abs=1e-3)
    assert played.support.all() and float(played.error.max()) < 5e-3
    com = played.poses().com[..., 0] - played.feet[:, :, :, 0].mean(2)
    assert float(com.min()) > -0.01 and float(com.max()) < 0.08
    np.testing.assert_allclose(played.root[:, -1, 2], kinematics.neutral_stance().height, atol=1e-3)


def test_shift_moves_the_centre_of_mass():
    """The centre of mass goes where the shift says, from where it balances."""
    played = Played(lambda t: constant(1, shift=[0.03, -0.06]), 150)
    com = played.poses().com
    moved = com[0, -1, :2] - com[0, 0, :2]
    np.testing.assert_allclose(moved, [0.03, -0.06], atol=5e-3)


def test_kick_runs_once():
    """A held kick command gives one kick, whose foot swings at the commanded speed over the other foot's support."""
    speeds = (2.0, 3.0)
    on = constant(2, kick=[1, 2], kick_speed=speeds)
    played = Played(lambda t: on if t > 0.1 else MotionCommand.neutral(2), 400)
    assert float(played.error.max()) < 1e-3
    foot = torch.stack([played.feet[0, :, 0], played.feet[1, :, 1]])
    speed = (foot[:, 1:] - foot[:, :-1])[..., 0] / TICK
    np.testing.assert_allclose(speed.amax(1), speeds, rtol=0.06)
    starts = ((played.kick[:, 1:] > 0) & (played.kick[:, :-1] == 0)).sum(1)
    assert starts.tolist() == [1, 1] and played.generator.settled.all()
    lifted = ~torch.stack([played.support[0, :, 0], played.support[1, :, 1]])
    standing = torch.stack([played.feet[0, :, 1], played.feet[1, :, 0]])
    away = (played.poses().com[..., :2] - standing[..., :2]).norm(dim=-1)
    assert float(away[lifted].max()) < 0.09


def test_kick_shifts_no_faster_than_the_feet_can_push():
    """Sideways, the weight shifts of a kick need a centre of pressure within the outer edge of the standing foot."""
    on = constant(2, kick=[1, 2], kick_speed=1.5)
    played = Played(lambda t: on if t > 0.1 else MotionCommand.neutral(2), 250)
    com = played.poses().com
    apart = 5
    pull = (com[:, 2 * apart :] - 2.0 * com[:, apart:-apart] + com[:, : -2 * apart]) / (apart * TICK) ** 2
    pressure = com[:, apart:-apart, 1] - com[:, apart:-apart, 2] / 9.81 * pull[..., 1]
    feet = played.feet[:, apart:-apart, :, 1]
    assert float((pressure - feet[..., 0]).max()) < 0.035
    assert float((feet[..., 1] - pressure).max()) < 0.035
    # The whole weight is over the standing foot.
    assert float(pressure[0].min() - feet[0, 0, 1]) < 0.02 and float(feet[1, 0, 0] - pressure[1].max()) < 0.02


def test_kick_waits_for_the_end_of_a_walk():
    """A kick asked for in the middle of a walk ends the walk first."""
    walk, kick = constant(velocity=[0.5, 0.0, 0.0]), constant(velocity=[0.5, 0.0, 0.0], kick=1)
    played = Played(lambda t: kick if 2.0 < t < 2.2 else walk, 490)
    during = played.kick[0] > 0
    assert during.any()
    assert float((played.feet[0, 1:, 1] - played.feet[0, :-1, 1])[during[1:]].abs().max()) < 1e-6
    assert float(played.root[0, -1, 0]) > 1.5 and float(played.error.max()) < 1e-3


def test_reach_meets_the_point():
    """A palm arrives at its point in the pelvis' heading frame and leaves it when let go."""
    point = [[0.3, 0.2, 0.3], [0.35, -0.15, 0.1]]
    on, off = constant(1, hand_point=[point], reach=[0.0, 1.0]), MotionCommand.neutral(1)
    played = Played(lambda t: on if t < 3.0 else off, 150)
    np.testing.assert_allclose(played.generator.hand_points[0, 1], point[1], atol=4e-3)
    Played(lambda t: off, 150, played.generator)
    np.testing.assert_allclose(played.generator.frames.joint_pos[0, 15:], DEFAULT_POSE[15:], atol=1e-3)


def test_push_sets_the_feet_back():
    """Walking with a foot offset keeps the middle of the feet behind the pelvis by that much more."""
    offsets = [0.0, 0.08]
    on = constant(2, velocity=[0.35, 0.0, 0.0], foot_offset=offsets)
    played = Played(lambda t: on, 300)
    behind = (played.root[:, 200:, 0] - played.feet[:, 200:, :, 0].mean(2)).mean(1)
    assert float(behind[1] - behind[0]) == pytest.approx(0.08, abs=0.01)


def test_seat_lets_the_pelvis_go_back():
    """With `pelvis_back` the pelvis ends that far behind the ankles at the commanded height, feet in place."""
    on = constant(1, height=0.51, pelvis_back=0.36)
    played = Played(lambda t: on, 200)
    behind = float(played.feet[0, -1, :, 0].mean() - played.root[0, -1, 0])
    assert behind == pytest.approx(0.36, abs=0.02)
    assert float(played.root[0, -1, 2]) == pytest.approx(0.51, abs=1e-3)
    assert played.support.all() and float(played.error.max()) < 0.01


def test_actions_integrate_to_the_frames():
    """The environment's integration of the emitted actions gives the generator's own frames and velocities."""
    worlds = 3
    rng = np.random.default_rng(0)
    start, yaw = torch.tensor([[0.0, 0.0], [1.0, 2.0], [-1.0, 0.5]]), torch.tensor([0.0, 1.0, 2.5])
    g = ReferenceGenerator(worlds)
    g.reset(root_xy=start, yaw=yaw)
    qpos = np.zeros((worlds, 7), np.float32)
    qpos[:, :2], qpos[:, 2] = start, kinematics.neutral_stance().height
    qpos[:, 3], qpos[:, 6] = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    reference = ReferencePose.allocate(worlds, "cpu", canonical_to_mujoco=CANONICAL_TO_MUJOCO, tick=TICK)
    ones = wp.array(np.ones(worlds, np.int32), dtype=wp.int32, device="cpu")
    launch_reset_reference(reference, wp.array(qpos, dtype=wp.float32, device="cpu"), 0, ones)
    command = constant(
        worlds,
        velocity=rng.uniform(-0.5, 0.5, (worlds, 3)),
        pitch=[0.1, 0.3, 0.0],
        roll=[0.0, 0.1, -0.1],
        arms=rng.uniform(-0.5, 0.5, (worlds, 14)),
        hands=[[1.0, 0.0]] * 3,
    )
    for _ in range(200):
        frames = g.step(command)
        launch_integrate(reference, wp.array(g.action().numpy(), dtype=wp.float32, device="cpu"), ones)
    np.testing.assert_allclose(reference.position.numpy(), frames.root_pos, atol=2e-3)
    agree = np.abs((reference.quat.numpy() * frames.root_quat.numpy()).sum(1))
    np.testing.assert_allclose(agree, 1.0, atol=1e-5)
    np.testing.assert_allclose(reference.mimic.numpy()[:, 6:], frames.joint_pos, atol=1e-6)
    np.testing.assert_allclose(reference.hands.numpy(), frames.hands)
    np.testing.assert_allclose(reference.mimic.numpy()[:, 5], command.velocity[:, 2], atol=0.02)


def test_worlds_do_not_touch_each_other():
    """A world gives the same frames alone, in a batch, and with other worlds paused."""
    one = constant(1, velocity=[0.4, 0.0, 0.3])
    many = constant(3, velocity=[[0.0, 0.2, 0.0], [0.4, 0.0, 0.3], [0.0, 0.0, 0.0]], height=[0.7, 0.7791745, 0.5])
    alone, batch, paused = ReferenceGenerator(1), ReferenceGenerator(3), ReferenceGenerator(3)
    mask = torch.tensor([False, True, False])
    still = paused.frames.joint_pos.clone()
    for _ in range(120):
        alone.step(one)
        batch.step(many)
        paused.step(many, mask)
    for g in (batch, paused):
        np.testing.assert_allclose(g.frames.joint_pos[1], alone.frames.joint_pos[0], atol=1e-5)
        np.testing.assert_allclose(g.frames.root_pos[1], alone.frames.root_pos[0], atol=1e-5)
    assert torch.equal(paused.frames.joint_pos[[0, 2]], still[[0, 2]])
    assert not torch.equal(batch.frames.joint_pos[0], still[0])


def test_reset_of_some_worlds():
    """Resetting one world puts it at its pose and leaves the other's next frames as they were."""
    command = constant(2, velocity=[0.4, 0.0, 0.0])
    touched, free = ReferenceGenerator(2), ReferenceGenerator(2)
    for _ in range(60):
        touched.step(command)
        free.step(command)
    yaw = torch.tensor([0.0, math.pi / 2])
    touched.reset(torch.tensor([False, True]), root_xy=torch.full((2, 2), 5.0), yaw=yaw)
    np.testing.assert_allclose(touched.frames.root_pos[1, :2], 5.0)
    np.testing.assert_allclose(touched.frames.joint_pos[1], DEFAULT_POSE, atol=1e-6)
    for _ in range(60):
        touched.step(command)
        free.step(command)
    np.testing.assert_array_equal(touched.frames.joint_pos[0], free.frames.joint_pos[0])
    assert float(touched.frames.root_pos[1, 1]) > 5.2


def test_realign():
    """Realigning turns the heading by the fraction, about the pelvis, and nothing else."""
    command = constant(2, velocity=[0.4, 0.0, 0.2])
    moved, free = ReferenceGenerator(2), ReferenceGenerator(2)
    for _ in range(100):
        moved.step(command)
        free.step(command)
    before, joints = moved.frames.root_pos.clone(), moved.frames.joint_pos.clone()
    heading = 2.0 * torch.atan2(free.frames.root_quat[:, 3], free.frames.root_quat[:, 0])
    moved.realign(heading + 0.2, 0.5)
    after = 2.0 * torch.atan2(moved.frames.root_quat[:, 3], moved.frames.root_quat[:, 0])
    np.testing.assert_allclose(after - heading, 0.1, atol=2e-3)
    np.testing.assert_allclose(moved.frames.root_pos, before, atol=1e-6)
    for _ in range(1):
        moved.step(command)
        free.step(command)
    assert float((moved.frames.joint_pos - joints).abs().max()) / TICK < 12.0
    np.testing.assert_allclose(moved.frames.joint_pos, free.frames.joint_pos, atol=2e-3)


def test_any_jumping_commands_stay_feasible():
    """Channels that jump at random every 0.4 s give finite frames in reach, joints in limits and below 25 rad/s."""
    worlds, rng = 16, np.random.default_rng(3)

    def random() -> MotionCommand:
        table = MotionCommand.neutral(worlds).pack()
        table = table + torch.tensor(rng.normal(0.0, 0.3, (worlds, COMMAND_WIDTH)), dtype=torch.float32)
        command = MotionCommand.unpack(table)
        command.height[:] = torch.tensor(rng.uniform(0.55, 0.8, worlds))
        command.pelvis_back[:] = 0.0
        command.stance_width[:] = torch.tensor(rng.uniform(0.18, 0.28, worlds))
        command.stagger[:] = 0.0
        command.foot_offset[:] = torch.tensor(rng.uniform(0.0, 0.1, worlds))
        command.swing_height[:] = 0.08
        command.pitch[:] = torch.tensor(rng.uniform(-0.1, 0.3, worlds))
        command.roll[:] = torch.tensor(rng.uniform(-0.1, 0.1, worlds))
        command.waist[:] = torch.tensor(rng.uniform(-0.2, 0.2, (worlds, 3)))
        command.kick[:] = torch.tensor((rng.random(worlds) < 0.05).astype(int) * rng.integers(1, 3, worlds))
        return command

    commands = [random() for _ in range(30)]
    played = Played(lambda t: commands[min(int(t / 0.4), 29)], 600)
    low, high = kinematics.chain().limits[1:].T
    joints = played.joints.numpy()
    assert np.isfinite(joints).all() and (joints > low).all() and (joints < high).all()
    assert float((played.joints[:, 1:] - played.joints[:, :-1]).abs().max()) / TICK < 25.0
    assert float(played.error.max()) < 0.03
    step = (played.root[:, 1:] - played.root[:, :-1]).norm(dim=-1)
    assert float(step.max()) / TICK < 1.6


PACKAGE = "arena_newton.trackers.motions"


def with_channel(monkeypatch, after: str, row: str) -> types.ModuleType:
    """The generator with one more row in `MotionCommand`, after a channel: nothing else of its source changes."""
    path = Path(commands.__file__)
    source = path.read_text(encoding="utf-8").splitlines(keepends=True)
    body = next(n for n in ast.parse("".join(source)).body if getattr(n, "name", "") == "MotionCommand").body
    at = next(k for k, n in enumerate(body) if isinstance(n, ast.AnnAssign) and ast.unparse(n.target) == after)
    source.insert(body[at + 1].end_lineno, f"    {row}\n")
    changed = types.ModuleType(f"{PACKAGE}.commands")
    monkeypatch.setitem(sys.modules, changed.__name__, changed)
    exec(compile("".join(source), path, "exec"), vars(changed))
    monkeypatch.delitem(sys.modules, f"{PACKAGE}.generator", raising=False)
    monkeypatch.setattr(sys.modules[PACKAGE], "generator", None, raising=False)
    return importlib.import_module(f"{PACKAGE}.generator")


@pytest.mark.parametrize("after", CHANNELS)
def test_a_new_channel_is_one_row(monkeypatch, after):
    """A channel that is added after any other one moves at its rate, and leaves all other channels as they are."""
    generator = with_channel(
        monkeypatch, after, "toe_out: Tensor = _channel((), 0.0, 0.4, rate=0.25, acceleration=5.0)"
    )
    new, old = generator.ReferenceGenerator(1), ReferenceGenerator(1)
    command = constant(1, velocity=[0.3, 0.0, 0.2], arms=0.1)
    more = sys.modules[f"{PACKAGE}.commands"].MotionCommand(**vars(command), toe_out=torch.full((1,), 9.0))
    for _ in range(50):
        moved, same = new.step(more), old.step(command)
    assert float(new.channel("toe_out")) == pytest.approx(0.25 * (1.0 - 0.5 * 0.25 / 5.0), abs=0.01)
    for _ in range(50):
        moved, same = new.step(more), old.step(command)
    assert float(new.channel("toe_out")) == pytest.approx(0.4, abs=1e-6)
    assert torch.equal(moved.joint_pos, same.joint_pos) and torch.equal(moved.root_pos, same.root_pos)
    for name in LIMITED_COLUMNS:
        assert torch.equal(new.channel(name), old.channel(name)), name


@pytest.mark.parametrize(
    "row",
    [
        "_channel((), 0.0, 0.4, rate=0.0, acceleration=5.0)",
        "_channel((), 0.0, 0.4, rate=0.25)",
        "_channel((), 0.4, 0.4)",
        "_channel((2,), (0.0, 0.0, 0.0), 0.4)",
        "field()",
    ],
)
def test_a_channel_without_effect_is_refused_by_name(monkeypatch, row):
    """A row with a rate of zero, half a limit, an empty range, a wrong width, or without a channel does not import."""
    with pytest.raises(TypeError, match="motion command: channel toe_out: "):
        with_channel(monkeypatch, "stagger", f"toe_out: Tensor = {row}")
