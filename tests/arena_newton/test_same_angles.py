"""Angles have the same bits for any number of worlds."""

import ast
from pathlib import Path

import pytest
import torch

import arena_newton
from arena_newton.robot import rotations
from arena_newton.robot.rotations import atan2, heading, wrap_angle

ROWS = (1, 7, 8, 20, 31, 32, 33, 60, 128)
"""torch computes blocks of 8 to 32 angles otherwise than what is left over."""
PACKAGE = Path(arena_newton.__file__).parent


@pytest.mark.parametrize("rows", ROWS)
def test_an_angle_does_not_depend_on_its_neighbours(rows):
    """Each of many angles has the bits that it has alone."""
    generator = torch.Generator().manual_seed(rows)
    y, x = torch.randn(2, rows, generator=generator)
    quat = torch.nn.functional.normalize(torch.randn(rows, 4, generator=generator), dim=1)
    for name, found, alone in (
        ("atan2", atan2(y, x), lambda i: atan2(y[i : i + 1], x[i : i + 1])),
        ("wrap_angle", wrap_angle(9.0 * y), lambda i: wrap_angle(9.0 * y[i : i + 1])),
        ("heading", heading(quat), lambda i: heading(quat[i : i + 1])),
    ):
        assert torch.equal(found, torch.cat([alone(i) for i in range(rows)])), name
    assert torch.allclose(atan2(y, x), torch.atan2(y, x))


def test_nothing_else_computes_it():
    """No module of the product but `rotations` calls torch.atan2."""
    found = []
    for folder in ("", "policies", "trackers", "eval", "usd_scenes"):
        for path in sorted((PACKAGE / folder).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            for node in ast.walk(ast.parse(text)) if "atan2" in text else ():
                if isinstance(node, ast.Attribute) and node.attr == "atan2" and ast.unparse(node.value) == "torch":
                    found.append(path.name)
    assert set(found) == {Path(rotations.__file__).name}
