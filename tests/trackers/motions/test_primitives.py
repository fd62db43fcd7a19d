"""Primitives, their programs, and random clips."""

import dataclasses

import numpy as np
import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.robot.g1 import TICK
from arena_newton.trackers.motions import kinematics, primitives, programs
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator
from arena_newton.trackers.motions.primitives import Program, Script, Segment

EVERY: dict[str, Script] = {
    "stand": primitives.stand(1.0, height=0.7),
    "shift": primitives.shift(0.03, 0.06),
    "step": primitives.step(2.0),
    "walk": primitives.walk(0.6, 0.0, 0.2, 3.0),
    "step over": primitives.step_over(seconds=4.0),
    "step up": primitives.step_up(0.10),
    "step up and down": primitives.step_up(0.08, pairs=3, down=True),
    "squat": primitives.squat(0.42),
    "reach": primitives.reach("left", (0.35, 0.2, 0.4)),
    "crouch and reach": primitives.crouch_reach("right", (0.35, -0.15, 0.0), 0.5),
    "kick": primitives.kick("right", 3.0),
    "punch": primitives.punch("left", height=0.65, times=2),
    "sit and rise": primitives.sit(0.42, hold=1.0) + primitives.rise(0.42),
    "carry": primitives.carry(0.25, 0.0, 0.2, 2.0),
    "push": primitives.push(0.35, 2.0),
    "walk, then kick": primitives.walk(0.4, 0.0, 0.0, 2.0, pause=0.0) + primitives.kick("left"),
    "walk, then squat and reach": primitives.walk(0.5, 0.0, 0.0, 2.0, pause=0.0)
    + primitives.crouch_reach("left", (0.3, 0.2, 0.1), 0.55),
}


@pytest.fixture(scope="module")
def played() -> dict[str, torch.Tensor]:
    """Every primitive in a world of its own, three seconds past the longest."""
    program = Program(list(EVERY.values()))
    generator = ReferenceGenerator(program.worlds)
    rows = {name: [] for name in ("joints", "root", "error", "support", "settled", "feet")}
    for tick in range(round((program.seconds + 3.0) / TICK)):
        frames = generator.step(program(tick * TICK))
        for name, value in {
            "joints": frames.joint_pos,
            "root": frames.root_pos,
            "error": generator.ik_error,
            "support": generator.support,
            "settled": generator.settled,
            "feet": generator.feet_pos,
        }.items():
            rows[name].append(value.clone())
    return {name: torch.stack(values, 1) for name, values in rows.items()}


@pytest.mark.parametrize("world", range(len(EVERY)), ids=list(EVERY))
def test_primitive_is_feasible_and_ends(played, world):
    """Within reach (1 cm), off the joint limits, below 15 rad/s, one foot down, and at rest once the script is over."""
    low, high = kinematics.chain().limits[1:].T
    joints = played["joints"][world].numpy()
    assert float(played["error"][world].max()) < 0.01
    assert (joints > low + 0.029).all() and (joints < high - 0.029).all()
    assert np.abs(np.diff(joints, axis=0)).max() / TICK < 15.0
    assert played["support"][world].any(1).all()
    assert played["settled"][world, -1]
    assert float((played["root"][world, -1] - played["root"][world, -25]).abs().max()) < 2e-3


def test_planted_feet_do_not_slide(played):
    """In every primitive a foot on the ground stays where it is."""
    both = played["support"][:, 1:] & played["support"][:, :-1]
    moved = (played["feet"][:, 1:] - played["feet"][:, :-1]).norm(dim=-1)
    assert float(moved[both].max()) < 1e-4


def test_program_times_and_ramps():
    """Segments begin when the last ends, ramps move evenly, and the last one is held."""
    script = Script((Segment(1.0, {"height": 0.7}), Segment(2.0, {"height": 0.5}, ramp=True)))
    program = Program([script, primitives.stand(0.5) + script])
    assert float(program(0.5).height[0]) == pytest.approx(0.7)
    assert float(program(2.0).height[0]) == pytest.approx(0.6, abs=1e-6)
    assert program(torch.tensor([2.0, 2.5])).height.tolist() == pytest.approx([0.6, 0.6], abs=1e-6)
    assert program(99.0).height.tolist() == pytest.approx([0.5, 0.5])


def test_over_fills_only_what_is_free():
    """`over` sets channels that segments leave, and keeps those that they set."""
    script = primitives.squat(0.5).over(height=0.7, stance_width=0.26)
    heights = [segment.channels["height"] for segment in script.segments]
    assert heights[0] == 0.5 and heights[-1] == 0.7
    assert all(segment.channels["stance_width"] == 0.26 for segment in script.segments)


def test_command_packs_and_unpacks():
    """A packed command gives the same command back."""
    command = MotionCommand.neutral(3)
    command.kick[:] = torch.tensor([0, 1, 2])
    command.hand_point[1, 0] = torch.tensor([0.1, 0.2, 0.3])
    command.step_in_place[2] = True
    again = MotionCommand.unpack(command.pack())
    for name, value in vars(command).items():
        assert torch.equal(getattr(again, name), value), name


def test_wrong_commands_are_named():
    """Channels, sides, numbers and shapes that do not fit are refused by name."""
    with pytest.raises(InputError, match="no channel 'speed'"):
        Program([Script((Segment(1.0, {"speed": 1.0}),))])
    with pytest.raises(InputError, match="waist takes 3 numbers, got 2"):
        Program([Script((Segment(1.0, {"waist": (1.0, 2.0)}),))])
    with pytest.raises(InputError, match="no side 'up'"):
        primitives.kick("up")
    with pytest.raises(InputError, match="velocity has shape"):
        dataclasses.replace(MotionCommand.neutral(2), velocity=torch.zeros(2)).pack()
    with pytest.raises(InputError, match="no family 'dance'"):
        programs.random_clips({"dance": 1})


@pytest.fixture(scope="module")
def clips() -> dict:
    """Two clips of every family."""
    return programs.random_clips({name: 2 for name in programs.FAMILIES}, seconds=12.0, seed=5)


def test_random_clips_are_complete(clips):
    """Every family has its clips, all finite, with unit quaternions and hands of 0 or 1."""
    count = 2 * len(programs.FAMILIES)
    assert clips["root_pos"].shape == (count, 600, 3) and clips["joint_pos"].shape == (count, 600, 29)
    assert clips["family_names"] == list(programs.FAMILIES)
    assert clips["family"].tolist() == [i // 2 for i in range(count)]
    for name in ("root_pos", "root_quat", "joint_pos", "hands", "support_box"):
        assert clips[name].isfinite().all()
    assert float((clips["root_quat"].norm(dim=-1) - 1.0).abs().max()) < 1e-5
    assert set(clips["hands"].unique().tolist()) <= {0.0, 1.0}


def test_no_foot_enters_the_ground_or_a_sill(clips):
    """Feet stay above the floor, and cross a sill with 5 cm to spare, as torch's kinematics finds them."""
    rows = [kinematics.link_index(f"{side}_ankle_roll_link") for side in ("left", "right")]
    poses = kinematics.forward(*(clips[k].double() for k in ("root_pos", "root_quat", "joint_pos")))
    feet = poses.position[:, :, rows]
    assert float(feet[..., 2].min()) > kinematics.SOLE_HEIGHT - 0.02
    sills = clips["support_kind"] == programs.SUPPORTS.index("sill")
    assert int(sills.sum()) == 2
    for clip in torch.nonzero(sills).flatten().tolist():
        x, y, top, yaw, length, _, _ = clips["support_box"][clip].double().tolist()
        assert programs.SILL_HEIGHTS[0] <= top <= programs.SILL_HEIGHTS[1]
        along = (feet[clip, ..., 0] - x) * np.cos(yaw) + (feet[clip, ..., 1] - y) * np.sin(yaw)
        assert float(along.min()) < -0.3 and float(along.max()) > 0.3
        over = (along > -0.12 - 0.5 * length) & (along < 0.05 + 0.5 * length)
        assert float(feet[clip, ..., 2][over].min()) - kinematics.SOLE_HEIGHT >= top + 0.045


def test_platforms_carry_both_feet(clips):
    """The robot walks up from the floor; then a foot stands whole on the platform or off it, and never in it."""
    rows = [kinematics.link_index(f"{side}_ankle_roll_link") for side in ("left", "right")]
    poses = kinematics.forward(*(clips[k].double() for k in ("root_pos", "root_quat", "joint_pos")))
    platforms = torch.nonzero(clips["support_kind"] == programs.SUPPORTS.index("platform")).flatten().tolist()
    assert len(platforms) == 2
    for clip in platforms:
        x, y, top, yaw, length, _, _ = clips["support_box"][clip].double().tolist()
        assert programs.PLATFORM_HEIGHTS[0] <= top <= programs.PLATFORM_HEIGHTS[1]
        feet = poses.position[clip, :, rows]
        along = (feet[..., 0] - x) * np.cos(yaw) + (feet[..., 1] - y) * np.sin(yaw)
        height = feet[..., 2] - kinematics.SOLE_HEIGHT
        assert float(height[0].abs().max()) < 0.005 and float(along[0].max()) < -0.5 * length - 0.12
        above = (along + 0.13 > -0.5 * length) & (along - 0.05 < 0.5 * length)
        assert float(height[above].min()) > top - 0.012
        stood = ((height - top).abs() < 0.012).all(1)
        assert int(stood.sum()) > 20, "both feet stand on it for a while"
        root = clips["root_pos"][clip, :, 2]
        assert float(root[stood].mean() - root[:25].mean()) == pytest.approx(top, abs=0.06)


def test_a_step_up_needs_room_for_the_edge():
    """Short steps stay on their ground; a long one goes up, and the other foot follows without such a lead."""
    short = Script((Segment(3.0, {"velocity": (0.2, 0.0, 0.0), "ground": 0.1}),))
    program = Program([short, primitives.step_up(0.1)])
    generator = ReferenceGenerator(2)
    for tick in range(round((program.seconds + 3.0) / TICK)):
        generator.step(program(tick * TICK))
    height = generator.feet_pos[..., 2] - kinematics.SOLE_HEIGHT
    assert float(height[0].max()) < 0.09 and generator.floor[0].tolist() == [0.0, 0.0]
    assert height[1].tolist() == pytest.approx([0.1, 0.1], abs=1e-6)


def test_seats_are_loaded(clips):
    """A sitting pelvis goes down over its seat, to within its own depth of the top, and comes up again."""
    seats = torch.nonzero(clips["support_kind"] == programs.SUPPORTS.index("seat")).flatten().tolist()
    assert len(seats) == 4
    for clip in seats:
        x, y, top, yaw, length, width, _ = clips["support_box"][clip].tolist()
        root = clips["root_pos"][clip]
        lowest = int(root[:, 2].argmin())
        assert 0.085 < float(root[lowest, 2]) - top < 0.145
        d = root[lowest, :2] - torch.tensor([x, y])
        forward = float(d[0] * np.cos(yaw) + d[1] * np.sin(yaw))
        assert -0.5 * length < forward < 0.5 * length - 0.12
        assert float(root[-1, 2]) > float(root[lowest, 2]) + 0.1


def test_the_weight_is_over_the_feet_before_a_seat_is_left():
    """Rising from any seat of the training, the centre of mass is over the soles when the pelvis leaves the seat."""
    settings = [(top, *where) for top in (0.36, 0.42, 0.48) for where in ((0.25, 0.12), (0.36, 0.14))]
    scripts = [
        primitives.sit(top, hold=1.0, depth=depth, press=press) + primitives.rise(top, depth=depth, press=press)
        for top, depth, press in settings
    ]
    program = Program(scripts)
    generator = ReferenceGenerator(program.worlds)
    height, ahead = [], []
    for tick in range(round(program.seconds / TICK)):
        height.append(generator.step(program(tick * TICK)).root_pos[:, 2].clone())
        ahead.append((generator.com[:, 0] - generator.feet_pos[..., 0].mean(1)).clone())
    for world, (top, *_) in enumerate(settings):
        z, com = torch.stack(height)[:, world], torch.stack(ahead)[:, world]
        seated = int(z.argmin())
        rising = z[seated:] > top + 0.16  # the robot's own pelvis rests 0.16 to 0.19 m above a seat
        assert float(com[seated]) < -0.05 and rising.any()
        assert float(com[seated:][rising].min()) > 0.0
        assert float(z[-1]) > 0.77


def test_random_clips_repeat_with_their_seed():
    """The same seed gives the same clips, another one gives others."""
    first, same, other = (programs.random_clips({"walk": 2}, seconds=2.0, seed=s)["joint_pos"] for s in (1, 1, 2))
    assert torch.equal(first, same) and not torch.equal(first, other)


def test_a_clip_depends_on_its_seed_family_and_number_alone():
    """The same seed gives the same squats, whatever families stand in front of them and however many there are."""
    alone = programs.random_clips({"squat": 2}, seconds=2.0, seed=7)
    among = programs.random_clips({"turn": 2, "walk": 1, "squat": 3, "kick": 1}, seconds=2.0, seed=7)
    for name in ("root_pos", "root_quat", "joint_pos", "hands"):
        assert torch.equal(alone[name], among[name][3:5]), name
    assert not torch.equal(among["joint_pos"][3], among["joint_pos"][4])
    assert not torch.equal(among["joint_pos"][4], among["joint_pos"][5])


def test_official_tracker_walks_these_references(shared):
    """TWIST2's released weights, in plain MuJoCo, reach 90 % of a commanded 0.3 and 0.6 m/s and stay up."""
    from tests import oracle

    names = {0.3: "walk 0.3", 0.6: "walk 0.6"}
    program = Program([primitives.stand(0.5) + primitives.walk(v, seconds=8.0) for v in names])
    generator, actions = ReferenceGenerator(len(names)), []
    for tick in range(400):
        generator.step(program(tick * TICK))
        actions.append(generator.action())
    streams = [oracle.ActionStream(n, a) for n, a in zip(names.values(), torch.stack(actions, 1).numpy(), strict=True)]
    root = shared / "reference"
    tracks = oracle.run_oracle(root / "twist2/twist2_1017_20k.onnx", root / "g1/g1_sim2sim_29dof.xml", streams)
    for speed, stream, track in zip(names, streams, tracks, strict=True):
        assert oracle.measure_track(stream, track).fell is None
        reached = np.linalg.norm(track.position[-1, :2] - track.position[200, :2]) / (199 * TICK)
        assert reached > 0.9 * speed
