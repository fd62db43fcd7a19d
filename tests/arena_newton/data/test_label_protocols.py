"""Label protocols: v4 and back."""

import numpy as np
import pytest
import torch

from arena_newton.data.readers.label_decoder import V4Decoder, decode_v4
from arena_newton.data.readers.label_protocols import LABELS, V4, action_names, encode_v4, protocol
from arena_newton.data.recording.layouts import described_protocol
from arena_newton.errors import InputError
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH, STAND_ACTION
from arena_newton.robot.g1 import TICK
from arena_newton.robot.rotations import matrix_from_quat, quat_from_euler


def actions_of(yaw: np.ndarray, roll: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Actions of v3.1 with these angles [rad] and random other numbers."""
    rng = np.random.default_rng(len(yaw))
    actions = np.tile(STAND_ACTION, (len(yaw), 1))
    actions[:, ACTION["root_xy_delta"]] = rng.normal(0, 0.02, (len(yaw), 2))
    actions[:, ACTION["root_z"]] = rng.uniform(0.5, 0.9, (len(yaw), 1))
    actions[:, ACTION["joint_pos"]] = rng.normal(0, 1, (len(yaw), 29))
    actions[:, ACTION["hands"]] = rng.integers(0, 2, (len(yaw), 2))
    quat = quat_from_euler(torch.from_numpy(np.stack([yaw, pitch, roll], axis=1)))
    actions[:, ACTION["root_rot6d"]] = matrix_from_quat(quat)[..., :2].reshape(-1, 6).numpy()
    return actions


def wandering(rows: int, seed: int) -> np.ndarray:
    """Actions of a long walk that turns round many times and leans."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0.01, 0.03, rows))
    return actions_of(yaw, 0.4 * np.sin(np.arange(rows) / 30), 0.9 * np.cos(np.arange(rows) / 50))


def beginning_still(actions: np.ndarray) -> np.ndarray:
    """Actions whose first row moves nothing and has the heading of the start, tilted as it was."""
    still = actions.copy()
    x = actions[0, 3:9].reshape(3, 2).astype(np.float64)
    yaw = np.arctan2(x[1, 0], x[0, 0])
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    still[0, ACTION["root_xy_delta"]] = 0.0
    still[0, ACTION["root_rot6d"]] = (turn @ x).ravel()
    return still


@pytest.mark.parametrize("rows", [1, 2, 700, 10_000])
def test_an_episode_comes_back_exactly(rows):
    """Conversion to v4 and back changes no number of rows after the first by more than 1e-6, however many turns."""
    actions = wandering(rows, rows)
    assert np.abs(decode_v4(encode_v4(actions)) - beginning_still(actions)).max() < 1e-6


def test_the_first_row_commands_no_motion():
    """Rows follow the authors' draft (§6.3); the second row takes the heading from the episode's start."""
    actions = actions_of(np.array([0.02, 0.03, 0.03]), np.full(3, 0.1), np.full(3, 0.2))
    labels = encode_v4(actions)
    assert not labels[0, V4["velocity_xy"]].any() and not labels[0, V4["yaw_rate"]].any()
    assert labels[0, V4["roll_pitch"]] == pytest.approx([0.1, 0.2], abs=1e-6)
    assert labels[:, V4["yaw_rate"]].ravel() == pytest.approx([0.0, 0.03 / TICK, 0.0], abs=1e-5)
    going_on = encode_v4(actions, 0.0)
    assert going_on[0, V4["velocity_xy"]] == pytest.approx(actions[0, ACTION["root_xy_delta"]] / TICK)
    assert going_on[0, V4["yaw_rate"]] == pytest.approx(0.02 / TICK, abs=1e-5)


def test_a_constant_turn_does_not_drift():
    """Ten thousand ticks at one awkward rate end within 1e-6 of where they should."""
    actions = actions_of(0.0213 * np.arange(10_000.0), np.zeros(10_000), np.zeros(10_000))
    assert np.abs(decode_v4(encode_v4(actions)) - actions)[1:].max() < 1e-6


def test_v4_says_velocities():
    """Walking at 0.5 m/s while turning at 0.3 rad/s and leaning has these numbers in its slots, and three zeros."""
    n = 50
    actions = actions_of(0.3 * TICK * np.arange(1, n + 1), np.full(n, 0.1), np.full(n, -0.2))
    actions[:, ACTION["root_xy_delta"]] = 0.5 * TICK, 0.0
    labels = encode_v4(actions, 0.0)
    assert labels[:, V4["velocity_xy"]] == pytest.approx(np.tile([0.5, 0.0], (n, 1)), abs=1e-6)
    assert labels[:, V4["roll_pitch"]] == pytest.approx(np.tile([0.1, -0.2], (n, 1)), abs=1e-6)
    assert labels[:, V4["yaw_rate"]] == pytest.approx(np.full((n, 1), 0.3), abs=1e-5)
    assert not labels[:, V4["reserved"]].any()
    kept = slice(V4["joint_pos"].start, ACTION_WIDTH)
    np.testing.assert_array_equal(labels[:, kept], actions[:, kept])
    np.testing.assert_array_equal(labels[:, V4["root_z"]], actions[:, ACTION["root_z"]])


def test_a_part_of_an_episode_begins_at_its_own_yaw():
    """Rows 100 and on of an episode are its own labels' rows when the yaw before them is given."""
    actions = wandering(300, 5)
    yaw0 = float(np.arctan2(actions[99, 5], actions[99, 3]))
    part = encode_v4(actions[100:], yaw0)
    assert part == pytest.approx(encode_v4(actions)[100:], abs=1e-4)
    assert decode_v4(part, yaw0) == pytest.approx(actions[100:], abs=1e-6)


def test_an_orientation_that_is_not_orthonormal_is_made_so():
    """A network's rot6d comes back as the rotation next to it."""
    actions = wandering(20, 7)
    stretched = actions.copy()
    stretched[:, ACTION["root_rot6d"]] *= 1.7
    assert decode_v4(encode_v4(stretched)) == pytest.approx(beginning_still(actions), abs=1e-6)


def test_chunks_and_worlds_do_not_matter():
    """A batch decoded in chunks of other lengths gives every world the bits of its episode decoded alone, at once."""
    labels = np.stack([encode_v4(wandering(240, seed)) for seed in range(3)])
    labels[:, :, V4["yaw_rate"]] += np.random.default_rng(0).normal(0, 1, (3, 240, 1))  # a network's, on no grid
    wanted = np.stack([decode_v4(one) for one in labels])
    for length in (1, 7, 50):
        decoder = V4Decoder(3)
        parts = [decoder.decode(torch.from_numpy(labels[:, k : k + length])) for k in range(0, 240, length)]
        np.testing.assert_array_equal(torch.cat(parts, dim=1).numpy(), wanted)


def test_only_masked_worlds_go_on():
    """A world that did not ask keeps its yaw, and a reset touches its worlds alone."""
    labels = np.zeros((2, 1, ACTION_WIDTH), np.float32)
    labels[..., V4["yaw_rate"]] = 1.0 / TICK / 4
    decoder = V4Decoder(2)
    chunk = torch.from_numpy(labels)
    decoder.decode(chunk, np.array([True, False]))
    decoder.decode(chunk, np.array([True, True]))
    yaw = torch.atan2(*decoder.decode(chunk)[:, 0, [5, 3]].unbind(-1))
    assert yaw.tolist() == pytest.approx([0.75, 0.5], abs=1e-6)
    decoder.reset(np.array([True, False]))
    yaw = torch.atan2(*decoder.decode(chunk)[:, 0, [5, 3]].unbind(-1))
    assert yaw.tolist() == pytest.approx([0.25, 0.75], abs=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_stays_so(bad):
    """A yaw rate that is no number makes an action that is refused, not one that stands still."""
    labels = encode_v4(wandering(3, 1))
    labels[1, V4["yaw_rate"]] = bad
    decoded = decode_v4(labels)
    assert np.isfinite(decoded[0]).all()
    assert not np.isfinite(decoded[1]).all()


def test_wrong_input_is_named():
    """A wrong width, an unknown protocol and a rotation that is none are errors."""
    with pytest.raises(InputError, match="expected 40"):
        encode_v4(np.zeros((3, 39)))
    with pytest.raises(InputError, match=r"expected \[T, 40\]"):
        decode_v4(np.zeros((3, 41)))
    with pytest.raises(InputError, match="names no rotation"):
        encode_v4(np.zeros((3, 40)))
    with pytest.raises(InputError, match="--labels v5: unknown, choose from v3.1, v4"):
        protocol("v5")


def test_names_fit_the_slots():
    """Each protocol names forty numbers, each once, and its slots cover them."""
    for name, one in LABELS.items():
        names = action_names(name)
        assert len(set(names)) == ACTION_WIDTH
        covered = [i for part in one.slots.values() for i in range(part.start, part.stop)]
        assert covered == list(range(ACTION_WIDTH))


def test_the_names_are_those_of_the_authors_draft():
    """Feature names and schema of UNITREE_G1_GMT_CMD_V4_DATA_PROTOCOL.md §5.2, so that its readers find them."""
    assert [name.removeprefix("action.") for name in action_names("v4")[:9]] == [
        *("root_base_local_vx", "root_base_local_vy", "root_z", "root_roll", "root_pitch", "root_yaw_rate"),
        *("reserved_0", "reserved_1", "reserved_2"),
    ]
    assert LABELS["v4"].robot_type == "unitree_g1_gmt_cmd_v4"
    block = described_protocol("v4", ["twist2"])
    assert (block["schema"], block["control_dt"]) == ("unitree_g1_gmt_cmd_v4", TICK)
    assert block["control_dt_source"] and "control_dt_source" not in described_protocol("v3.1", ["twist2"])
