"""Units in which ticks of two engines are compared."""

import mujoco
import numpy as np

from arena_newton.eval.audit.tick_check import surface_radii

SCENE = """<mujoco><worldbody>
  <body pos="0 0 1"><freejoint/><geom type="sphere" size="0.11" pos="0.2 0 0"/></body>
  <body pos="1 0 1"><freejoint/><geom size="0.1"/>
    <body pos="0 0 0.3"><joint/><geom size="0.1"/></body></body>
</worldbody></mujoco>"""


def test_spin_of_a_lone_body_counts_at_its_surface():
    """Of a ball by the distance of its farthest point; bodies with joints and all speeds keep their units."""
    factors = surface_radii(mujoco.MjModel.from_xml_string(SCENE))
    np.testing.assert_allclose(factors, [1, 1, 1, *[0.31] * 3, *[1] * 7])
