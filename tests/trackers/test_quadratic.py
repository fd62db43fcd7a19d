"""Each table of `Quadratic` gives the bits of its formula, written out beside it."""

import torch

from arena_newton.robot.rotations import atan2
from arena_newton.trackers.inference.quadratic import Quadratic
from arena_newton.trackers.sonic import DOWN, IDENTITY_6D, RELATIVE_AND_DOWN, ROT6D
from arena_newton.trackers.twist2 import TILT_TERMS, UPRIGHT


def quaternions(seed: int) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(200, 4, generator=rng))


def test_tilt_terms():
    """TWIST2: sine and cosine of the roll, sine of the pitch."""
    q = quaternions(0)
    w, x, y, z = q.unbind(1)
    expected = (2 * (w * x) + 2 * (y * z), 1.0 + (-2 * (x * x) - 2 * (y * y)), 2 * (w * y) - 2 * (z * x))
    assert torch.equal(Quadratic(TILT_TERMS, UPRIGHT)(q, q), torch.stack(expected, 1))


def test_relative_and_down():
    """SONIC: the reference's rotation seen from the robot, and where down is."""
    a, b = quaternions(1), quaternions(2)
    w, x, y, z = a.unbind(1)
    b0, b1, b2, b3 = b.unbind(1)
    expected = (
        w * b0 + x * b1 + y * b2 + z * b3,
        w * b1 - x * b0 - y * b3 + z * b2,
        w * b2 + x * b3 - y * b0 - z * b1,
        w * b3 - x * b2 + y * b1 - z * b0,
        2 * (w * y) - 2 * (x * z),
        -2 * (y * z) - 2 * (w * x),
        2 * (x * x) + 2 * (y * y) - 1.0,
    )
    table = Quadratic(RELATIVE_AND_DOWN, DOWN, width=8)
    assert torch.equal(table(a, torch.cat((a, b), 1)), torch.stack(expected, 1))


def test_rot6d():
    """SONIC: two columns of the rotation matrix, row by row."""
    q = quaternions(3)
    w, x, y, z = q.unbind(1)
    expected = (
        1.0 + (-2 * (y * y) - 2 * (z * z)),
        2 * (x * y) - 2 * (w * z),
        2 * (x * y) + 2 * (w * z),
        1.0 + (-2 * (x * x) - 2 * (z * z)),
        2 * (x * z) - 2 * (w * y),
        2 * (y * z) + 2 * (w * x),
    )
    assert torch.equal(Quadratic(ROT6D, IDENTITY_6D)(q, q), torch.stack(expected, 1))


def test_the_roll_of_columns_has_the_bits_of_single_rows():
    """`atan2` of two columns of a table gives a row the same bits alone and among any others."""
    q = quaternions(6)
    sine, cosine, _ = Quadratic(TILT_TERMS, UPRIGHT)(q, q).unbind(1)
    together = atan2(sine, cosine)
    alone = torch.cat([atan2(sine[i : i + 1].clone(), cosine[i : i + 1].clone()) for i in range(len(q))])
    assert torch.equal(together, alone)
    for rows in (1, 2, 7, 31, 32, 33, 64):
        few, other, _ = Quadratic(TILT_TERMS, UPRIGHT)(q[:rows], q[:rows]).unbind(1)
        assert torch.equal(atan2(few, other), together[:rows])
