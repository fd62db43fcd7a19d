"""Forward kinematics in torch."""

import numpy as np
import pytest
import torch

from arena_newton.robot import rotations
from arena_newton.robot.g1 import DEFAULT_POSE, MUJOCO_JOINTS
from arena_newton.trackers.motions import kinematics


def poses_of(worlds: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random roots and joints, float64."""
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(worlds, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    joints = rng.uniform(-0.5, 0.5, (worlds, 29)) + np.array(DEFAULT_POSE)
    return torch.tensor(rng.normal(size=(worlds, 3))), torch.tensor(quat), torch.tensor(joints)


def test_agrees_with_mujoco(shared):
    """Link poses and centre of mass are MuJoCo's on the published model, to a hundredth of a millimetre."""
    import mujoco

    text = (shared / "reference/g1/g1_sim2sim_29dof_with_hands.xml").read_text()
    import xml.etree.ElementTree as ElementTree

    tree = ElementTree.fromstring(text)
    for parent in tree.iter():
        for child in list(parent):
            if (child.tag == "mesh" and parent.tag == "asset") or (child.tag == "geom" and child.get("mesh")):
                parent.remove(child)
    model = mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding="unicode")).compile()
    data = mujoco.MjData(model)
    root, quat, joints = poses_of(5)
    ours = kinematics.forward(root, quat, joints)
    for w in range(5):
        data.qpos[:3], data.qpos[3:7] = root[w], quat[w]
        for name, angle in zip(MUJOCO_JOINTS, joints[w], strict=True):
            data.qpos[model.joint(name).qposadr[0]] = angle
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for row, name in enumerate(kinematics.LINK_NAMES):
            body = model.body(name).id
            np.testing.assert_allclose(ours.position[w, row], data.xpos[body], atol=1e-5)
            assert abs(abs(float(ours.quat[w, row] @ torch.tensor(data.xquat[body]))) - 1.0) < 1e-6
        np.testing.assert_allclose(ours.com[w], data.subtree_com[model.body("pelvis").id], atol=1e-4)


def test_chain_keeps_the_mass_of_the_fingers():
    """The kernel's 30 links weigh what the whole table weighs, and balance where it balances."""
    chain = kinematics.chain()
    root, quat, joints = poses_of(3, seed=1)
    whole = kinematics.forward(root, quat, joints)
    rows = [0] + [
        next(i for i, k in enumerate(kinematics.LINKS) if k.hinge and k.hinge.name == name) for name in MUJOCO_JOINTS
    ]
    com = torch.tensor(chain.com, dtype=torch.float64)
    centres = whole.position[:, rows] + rotations.quat_apply(whole.quat[:, rows], com.expand(3, 30, 3))
    mass = torch.tensor(chain.mass, dtype=torch.float64)
    np.testing.assert_allclose((centres * mass[:, None]).sum(1) / mass.sum(), whole.com, atol=1e-6)
    assert float(mass.sum()) == pytest.approx(sum(k.mass for k in kinematics.LINKS), rel=1e-6)


def test_neutral_stance_is_flat_and_balanced():
    """In the default pose both soles are level and the centre of mass lies over them."""
    stance = kinematics.neutral_stance()
    poses = kinematics.forward(
        torch.tensor([0.0, 0.0, stance.height]), torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor(DEFAULT_POSE)
    )
    for side in ("left", "right"):
        foot = kinematics.link_index(f"{side}_ankle_roll_link")
        assert float(poses.position[foot, 2]) == pytest.approx(kinematics.SOLE_HEIGHT, abs=1e-5)
        np.testing.assert_allclose(poses.quat[foot].abs(), [1.0, 0.0, 0.0, 0.0], atol=2e-5)
    assert stance.ankle - 0.05 < stance.com < stance.ankle + 0.12
