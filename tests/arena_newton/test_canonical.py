"""Canonical vectors: slices tile the vector, and a bad action is answered with the name of the slice."""

import numpy as np
import pytest

from arena_newton.errors import InputError
from arena_newton.kernels import canonical as kernels
from arena_newton.robot import canonical, g1


def neutral(*shape: int) -> np.ndarray:
    """A valid action."""
    action = np.zeros((*shape, canonical.ACTION_WIDTH), dtype=np.float32)
    action[..., 2] = 0.79
    action[..., canonical.ACTION["root_rot6d"]] = canonical.IDENTITY_ROT6D
    return action


@pytest.mark.parametrize(
    ("parts", "width", "protocol"),
    [
        (canonical.STATE, canonical.STATE_WIDTH, 64),
        (canonical.ACTION, canonical.ACTION_WIDTH, 40),
        (canonical.MIMIC, canonical.MIMIC_WIDTH, 35),
    ],
)
def test_slices_tile_the_vector(parts, width, protocol):
    """Slices follow each other without gap or overlap; with the G1's joints the widths are those of the protocol."""
    covered = [i for part in parts.values() for i in range(part.start, part.stop)]
    assert covered == list(range(width)) and width == protocol


def test_kernels_know_the_same_joints():
    """The kernels' joints and widths are those of the robot."""
    assert len(g1.MUJOCO_JOINTS) == kernels.JOINTS and kernels.ACTION_SIZE == canonical.ACTION_WIDTH
    assert kernels.STATE_VEL == canonical.STATE["joint_vel"].start
    assert kernels.ACTION_JOINTS == canonical.ACTION["joint_pos"].start
    assert kernels.ACTION_HANDS == canonical.ACTION["hands"].start
    assert kernels.MIMIC_JOINTS == canonical.MIMIC["joint_pos"].start


def test_a_valid_action_passes_unchanged():
    """Values survive, type and shape are float32 [..., 40]."""
    action = neutral(3, 5)
    checked = canonical.validate_action(action.tolist(), "policy")
    assert checked.dtype == np.float32
    np.testing.assert_array_equal(checked, action)


def test_39_numbers_are_refused_with_the_layout():
    """The message says how many numbers came and what they should have been."""
    with pytest.raises(InputError, match=r"policy x: action has 39 numbers, expected 40 .*root_rot6d 3:9"):
        canonical.validate_action(neutral()[:39], "policy x")


@pytest.mark.parametrize("bad", [None, "forty", [[1.0, 2.0], [3.0]], object(), 3.0])
def test_what_is_no_array_of_numbers_is_refused(bad):
    """Anything but numbers is an InputError, not a traceback."""
    with pytest.raises(InputError, match="policy"):
        canonical.validate_action(bad, "policy")


@pytest.mark.parametrize(
    ("index", "name"),
    [
        (1, r"root_xy_delta\[1\]"),
        (2, "root_z"),
        (8, r"root_rot6d\[5\]"),
        (9, r"joint_pos\[left_hip_pitch_joint\]"),
        (37, r"joint_pos\[right_wrist_yaw_joint\]"),
        (39, r"hands\[right\]"),
    ],
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_is_named(index, name, value):
    """NaN and infinity are refused by row and by name."""
    action = neutral(4)
    action[2, index] = value
    with pytest.raises(InputError, match=rf"w, row 2: action {name} \(index {index}\) is (nan|inf)"):
        canonical.validate_action(action, "w")


def test_a_number_beyond_float32_is_refused():
    """A double that overflows float32 is not finite."""
    action = neutral().astype(np.float64)
    action[2] = 1e300
    with pytest.raises(InputError, match="root_z"):
        canonical.validate_action(action, "policy")


@pytest.mark.parametrize("rot", [[0] * 6, [1, 1, 0, 0, 0, 0], [1, 2, 1, 2, 1, 2], [0, 0, 0, 1, 0, 0]])
def test_degenerate_orientation_is_refused(rot):
    """Two zero or parallel columns name no rotation."""
    action = neutral(2)
    action[1, canonical.ACTION["root_rot6d"]] = rot
    with pytest.raises(InputError, match=r"row 1: action root_rot6d \(indices 3:9\)"):
        canonical.validate_action(action, "policy")
    with pytest.raises(InputError, match=r"policy: action root_rot6d"):
        canonical.validate_action(action[1], "policy")


def test_unnormalised_orientation_passes():
    """A policy's rot6d need not be orthonormal."""
    action = neutral()
    action[canonical.ACTION["root_rot6d"]] = [0.5, -0.1, 0.2, 2.0, 0.0, 0.3]
    canonical.validate_action(action, "policy")
