"""Contact forces per body and between two groups agree with MuJoCo's own decoding of its constraint forces."""

import mujoco
import mujoco_warp
import numpy as np
import pytest
import warp as wp

from arena_newton.kernels import contact

SCENE = """
<mujoco>
  <option cone="{cone}" timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="5 5 .1" friction="0.8 0.01 0.001" condim="{condim}"/>
    <body pos="0 0 .11"><freejoint/><geom type="box" size=".1 .1 .1" mass="3" condim="{condim}"/></body>
    <body pos="0.03 0.02 .32" euler="5 3 20"><freejoint/>
      <geom type="box" size=".1 .1 .1" mass="2" condim="{condim}"/></body>
    <body pos="1 0 .12"><freejoint/><geom type="sphere" size=".1" mass="1" condim="{condim}"/></body>
  </worldbody>
</mujoco>
"""


def _launch(model, data, worlds, nbody, geom_body, groups, pyramidal, device):
    net = wp.full((worlds, nbody), wp.vec3(9.0), dtype=wp.vec3, device=device)
    norm = wp.full((worlds, nbody), 9.0, dtype=wp.float32, device=device)
    pair = wp.full(worlds, 9.0, dtype=wp.float32, device=device)
    contact.launch_contact_force(
        data.nacon,
        data.contact.geom,
        data.contact.worldid,
        data.contact.frame,
        data.contact.friction,
        data.contact.dim,
        data.contact.efc_address,
        data.efc.force,
        pyramidal=pyramidal,
        geom_body=wp.array(geom_body, dtype=wp.int32, device=device),
        geom_group=wp.array(groups, dtype=wp.int32, device=device),
        net_force=net,
        force_norm=norm,
        pair_force=pair,
    )
    return net.numpy(), norm.numpy(), pair.numpy()


@pytest.mark.parametrize("condim", [1, 3, 4, 6])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_agrees_with_mujoco(device, cone, condim):
    """On a tumbling stack the net forces and the force between lower box and plane are those of mj_contactForce."""
    model = mujoco.MjModel.from_xml_string(SCENE.format(cone=cone, condim=condim))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(condim)
    data.qvel[:] = rng.normal(scale=0.5, size=model.nv)
    for _ in range(60):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    assert data.ncon >= 3
    groups = [contact.GROUP_A, contact.GROUP_B, contact.GROUP_A | contact.GROUP_B, 0]
    expected, pair = np.zeros((model.nbody, 3)), 0.0
    for i in range(data.ncon):
        c, force = data.contact[i], np.zeros(6)
        mujoco.mj_contactForce(model, data, i, force)
        world = force[:3] @ c.frame.reshape(3, 3)
        for geom, sign in zip(c.geom, (-1, 1), strict=True):
            expected[model.geom_bodyid[geom]] += sign * world
        pair += force[0] if 3 not in c.geom else 0.0  # all pairs of the plane and the two boxes are A-B
    with wp.ScopedDevice(device):
        flat = mujoco_warp.put_data(model, data, nworld=2, nconmax=64, njmax=256)
    net, norm, seat = _launch(model, flat, 2, model.nbody, model.geom_bodyid, groups, cone == "pyramidal", device)
    assert np.abs(expected).max() > 5
    for w in range(2):
        np.testing.assert_allclose(net[w], expected, rtol=1e-6, atol=1e-4)
        np.testing.assert_allclose(norm[w], np.linalg.norm(expected, axis=1), rtol=1e-6, atol=1e-4)
        np.testing.assert_allclose(seat[w], pair, rtol=1e-6, atol=1e-4)


class _Flat:
    """A contact list by hand."""

    def __init__(self, device):
        def ints(values):
            return wp.array(values, dtype=wp.int32, device=device)

        frame = np.tile(np.float32([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), (6, 1, 1))
        self.nacon = ints([5])
        self.contact = self
        self.geom = wp.array([(0, 1), (1, 2), (0, 1), (-1, 1), (0, 1), (0, 1)], dtype=wp.vec2i, device=device)
        self.worldid = ints([0, 1, 0, 0, 1, 0])
        self.frame = wp.array(frame, dtype=wp.mat33, device=device)
        self.friction = wp.array(np.full((6, 5), 0.5, np.float32), dtype=contact.vec5, device=device)
        self.dim = ints([1, 3, 3, 1, 3, 1])
        # third: not included; fourth: a flex; fifth: its rows reach beyond the buffer; sixth: beyond the count
        self.efc_address = ints([[0] * 4, [1, 2, 3, 4], [-1] * 4, [0] * 4, [6, 7, 8, 9], [0] * 4])
        self.efc = self
        self.force = wp.array(np.arange(1, 17, dtype=np.float32).reshape(2, 8), dtype=wp.float32, device=device)


def test_list_by_hand(device):
    """Contacts not included, beyond the count, of a flex, or with rows beyond the buffer add nothing of their own."""
    net, norm, pair = _launch(None, _Flat(device), 2, 3, [0, 1, 2], [1, 2, 1], True, device)
    # world 0: one frictionless contact of row 0, force 1 along z
    np.testing.assert_allclose(net[0], [[0, 0, -1], [0, 0, 1], [0, 0, 0]])
    # world 1: rows 1-4 are 10..13 (normal 46, tangents -0.5 each); rows 6-7 are 15, 16 and the rest is missing
    second = np.array([-0.5, -0.5, 46.0])
    third = np.array([-0.5, 0.0, 31.0])
    np.testing.assert_allclose(net[1], [-third, third - second, second], rtol=1e-6)
    np.testing.assert_allclose(norm[1], np.linalg.norm(net[1], axis=1), rtol=1e-6)
    np.testing.assert_allclose(pair, [1, 77])
