"""Boxes touch each other alike on both engines: a foot that grazes an obstacle decides over a fall."""

import numpy as np
import pytest

from arena_newton.physics.scene import load_scene
from arena_newton.robot.g1 import DEFAULT_POSE


@pytest.fixture(scope="module")
def scenes():
    """The lab for native MuJoCo and for mujoco_warp on the CPU."""
    return tuple(load_scene("lab", device="cpu", hands="fixed", native=native) for native in (True, False))


@pytest.mark.parametrize("yaw", [0.0, 0.03, -0.06, 0.1, 0.3])
def test_normals_of_a_grazing_foot(scenes, yaw):
    """A left foot turned by a few degrees against a sill's long side has the same contacts on both engines."""
    import mujoco
    import mujoco_warp as mjw

    native, batched = scenes
    m, h = native.mj_model, native.robot
    d = mujoco.MjData(m)
    d.qpos[h.root_qpos : h.root_qpos + 7] = [0, 0, 0.79, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    d.qpos[h.joint_qpos] = DEFAULT_POSE
    mujoco.mj_kinematics(m, d)
    (foot,) = [g for g in native.geom_ids("/World/Robot") if m.geom_bodyid[g] == native.link("left_ankle_roll_link")][
        :1
    ]
    (sill,) = native.geom_ids("/World/Sill")
    corners = np.stack(np.meshgrid(*3 * [[-1, 1]]), -1).reshape(-1, 3) * m.geom_size[foot]
    corners = d.geom_xpos[foot] + corners @ d.geom_xmat[foot].reshape(3, 3).T
    thin, mocap = float(m.geom_size[sill][0]), native.mocap_id("/World/Sill")
    # Its long side, turned to run along x, lies 1 mm inside the outermost corner of the foot.
    side = corners[:, 1].max() - 1e-3
    d.mocap_pos[mocap] = [d.geom_xpos[foot][0], side + thin, d.geom_xpos[foot][2]]
    d.mocap_quat[mocap] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    mujoco.mj_forward(m, d)

    warp_model, warp_data = batched.solver.mjw_model, batched.solver.mjw_data
    for name in ("qpos", "mocap_pos", "mocap_quat"):
        array = getattr(warp_data, name)
        array.assign(np.asarray(getattr(d, name), dtype=np.float32).reshape(array.numpy().shape))
    mjw.forward(warp_model, warp_data)

    def touching(pairs, frames):
        rows = [
            tuple(np.round(f.reshape(9)[:3], 4) + 0.0)
            for p, f in zip(pairs, frames, strict=True)
            if sill in p and foot in p
        ]
        return sorted(rows)

    count = int(warp_data.nacon.numpy()[0])
    ours = touching(warp_data.contact.geom.numpy()[:count], warp_data.contact.frame.numpy()[:count])
    theirs = touching(d.contact.geom, d.contact.frame)
    assert theirs, "the foot should touch the sill"
    assert abs(abs(theirs[0][1]) - 1.0) < 1e-3, "the sill's side should bear, not the foot's"
    np.testing.assert_allclose(ours, theirs, atol=1e-3)
