"""Units in which ticks of two engines are compared."""

import mujoco
import numpy as np
import pytest

from arena_newton.eval.audit.tick_check import LoneBodies

SCENE = """<mujoco><worldbody>
  <body pos="0 0 1"><freejoint/><geom type="sphere" size="0.11" pos="0.2 0 0"/></body>
  <body pos="1 0 1"><freejoint/><geom size="0.1"/>
    <body pos="0 0 0.3"><joint/><geom size="0.1"/></body></body>
</worldbody></mujoco>"""


def test_spin_of_a_lone_body_counts_at_its_surface():
    """Of a ball by the distance of its farthest point; bodies with joints and all speeds keep their units."""
    factors = LoneBodies(mujoco.MjModel.from_xml_string(SCENE)).radii
    np.testing.assert_allclose(factors, [1, 1, 1, *[0.31] * 3, *[1] * 7])


@pytest.mark.parametrize(("what", "dof", "share"), [("moved", 0, 1.0), ("gained", 1, 1.0), ("gained", 3, 0.4)])
def test_a_body_that_nothing_moved_must_not_get_going(what, dof, share):
    """Distance, speed and spin of a lone body add up until something that moves is near it, and then begin again."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    lone, far = LoneBodies(model), np.array([[0.0, 0, 0], [0, 0, 1], [5, 0, 1], [5, 0, 1.3]])
    near = np.where(far == 5.0, 0.4, far)
    given = {"moved": np.zeros((4, 3)), "gained": np.zeros(model.nv), "speed": np.zeros(model.nv)}
    given["moved"][2] = given["gained"][6:] = 9.0  # of the body with a joint, which a tick's tolerance alone holds
    (given["moved"][1] if what == "moved" else given["gained"])[dof] = 0.03
    quats = np.tile([1.0, 0, 0, 0], (4, 1))
    for at, expected in ((far, 0.6), (far, 1.2), (near, 0.0), (far, 0.6)):
        assert lone.worst(far, at, **given, quats=quats) == pytest.approx(share * expected)
    given["speed"][1] = 3.0  # a tenth of it is allowed on top
    assert lone.worst(far, far, **given, quats=quats) == pytest.approx(1.2 if what == "moved" else 0.0)
