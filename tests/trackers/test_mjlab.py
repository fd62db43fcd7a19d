"""Networks that mjlab and BeyondMimic export are played by their metadata: what they see, what moves, what drives."""

import numpy as np
import onnx
import pytest
import torch
from made_inputs import inputs
from onnx import TensorProto, helper
from onnx_files import Builder
from test_sonic import matrix

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.robot.g1 import CANONICAL_JOINTS, MUJOCO_JOINTS, TWIST2_DRIVE
from arena_newton.testing import check_tracker
from arena_newton.trackers.mjlab import MjlabTracker
from arena_newton.trackers.motions import kinematics

INERTIA = {"hip_roll": 0.025101925, "knee": 0.025101925, "hip": 0.010177520, "waist_yaw": 0.010177520}
INERTIA |= {"ankle": 2 * 0.003609725, "waist": 2 * 0.003609725, "wrist_pitch": 0.00425, "wrist_yaw": 0.00425}
"""Rotor inertia [kg·m²] by a part of the joint's name, the first that fits (mjlab's constants of the G1)."""
HOME = {"hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2, "shoulder_pitch": 0.2, "elbow": 1.28}
HOME |= {"left_shoulder_roll": 0.2, "right_shoulder_roll": -0.2}
PLAIN = ["command", "motion_anchor_ori_b", "base_ang_vel", "joint_pos", "joint_vel", "actions"]
"""Terms without state estimation, 154 numbers."""
ESTIMATED = [*PLAIN[:1], "motion_anchor_pos_b", PLAIN[1], "base_lin_vel", *PLAIN[2:]]
"""With it, 160."""
IMU = np.array([0.04525, 0.0, -0.08339])


def of(joint: str, table: dict[str, float], otherwise: float) -> float:
    return next((value for part, value in table.items() if part in joint), otherwise)


def written(values) -> str:
    """Numbers as mjlab's exporter writes them."""
    return ",".join(f"{value:.3f}" for value in values)


def metadata(joints=MUJOCO_JOINTS, terms=ESTIMATED) -> dict[str, str]:
    """The public configuration of the G1: gains by rotor inertia at 10 Hz and a damping ratio of 2."""
    inertia = np.array([of(joint, INERTIA, 0.003609725) for joint in joints])
    effort = dict(zip(MUJOCO_JOINTS, TWIST2_DRIVE.effort, strict=True))
    kp = inertia * (20 * np.pi) ** 2
    return {
        "joint_names": ",".join(joints),
        "joint_stiffness": written(kp),
        "joint_damping": written(4 * inertia * 20 * np.pi),
        "default_joint_pos": written(of(joint, HOME, 0.0) for joint in joints),
        "action_scale": written(0.25 * effort[joint] / k for joint, k in zip(joints, kp, strict=True)),
        "observation_names": ",".join(terms),
        "observation_terms_scale": written([1.0] * len(terms)),
        "observation_terms_history_length": written([0] * len(terms)),
        "observation_terms_clip": ",".join(["-inf;inf"] * len(terms)),
        "command_names": "motion",
        "anchor_body_name": "torso_link",
    }


def export(path, texts: dict[str, str], width: int):
    """A network of random weights with a clock as second input and a motion as second output."""
    b = Builder()
    hidden = b.add("Elu", b.linear("obs", width, 32))
    b.linear(hidden, 32, 29, output="actions")
    b.add("Mul", "time_step", b.weight(1, 29), output="joint_pos")
    shapes = {"obs": width, "time_step": 1, "actions": 29, "joint_pos": 29}
    ports = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, w]) for n, w in shapes.items()]
    model = helper.make_model(
        helper.make_graph(b.nodes, "network", ports[:2], ports[2:], b.weights),
        opset_imports=[helper.make_opsetid("", 11)],
        ir_version=8,
    )
    helper.set_model_props(model, texts)
    onnx.save(model, str(path))
    return path


def expected(command, state, last, joints, terms, world: int) -> np.ndarray:
    """The observation of one world in NumPy, by the formulas of the two projects' documentation."""

    def row(tensor):
        return tensor[world].numpy().astype(float)

    order = [MUJOCO_JOINTS.index(joint) for joint in joints]
    torso = kinematics.link_index("torso_link")
    poses = {}
    for name, position, quat, joint_pos in (
        ("robot", state.position, state.quat, state.joint_pos),
        ("motion", command.position, command.quat, command.joints),
    ):
        links = kinematics.forward(position[world].double(), quat[world].double(), joint_pos[world].double())
        poses[name] = links.position[torso].numpy(), matrix(links.quat[torso].numpy())
    (here, turn), (there, wanted) = poses["robot"], poses["motion"]
    spin = row(state.ang_vel_body)
    home = np.array([round(of(joint, HOME, 0.0), 3) for joint in joints])
    values = {
        "command": np.concatenate([row(command.joints)[order], row(command.joint_vel)[order]]),
        "motion_anchor_pos_b": turn.T @ (there - here),
        "motion_anchor_ori_b": (turn.T @ wanted)[:, :2].reshape(-1),
        "base_lin_vel": matrix(row(state.quat)).T @ row(state.lin_vel) + np.cross(spin, IMU),
        "base_ang_vel": spin,
        "joint_pos": row(state.joint_pos)[order] - home,
        "joint_vel": row(state.joint_vel)[order],
        "actions": row(last),
    }
    return np.concatenate([values[term] for term in terms])


@pytest.mark.parametrize("joints", [MUJOCO_JOINTS, CANONICAL_JOINTS], ids=["mjlab", "beyondmimic"])
@pytest.mark.parametrize("terms", [ESTIMATED, PLAIN], ids=["estimated", "plain"])
def test_observation_and_targets(tmp_path, joints, terms):
    """160 or 154 numbers in the file's joint order; targets are its pose and scaled output by joint name."""
    width = 160 if terms is ESTIMATED else 154
    tracker = trackers.get("mjlab", export(tmp_path / "policy.onnx", metadata(joints, terms), width))
    assert isinstance(tracker, MjlabTracker) and tracker.front_end.obs_width == width
    assert tuple(tracker.needs) == (("position", "lin_vel") if terms is ESTIMATED else ())
    tracker.bind(3)
    last = torch.zeros(3, 29)
    for tick in range(3):
        command, state = inputs(tick, 3)
        rng = torch.Generator().manual_seed(tick)
        state.position, state.lin_vel, command.position = (torch.randn(3, 3, generator=rng) for _ in range(3))
        targets = tracker.step(command, state).clone()
        for world in range(3):
            seen = expected(command, state, last, joints, terms, world)
            np.testing.assert_allclose(tracker.observation()[world].numpy(), seen, atol=2e-5)
        last = tracker.last_action.clone()
        for k, joint in enumerate(joints):
            goal = round(of(joint, HOME, 0.0), 3) + last[:, k] * float(metadata(joints)["action_scale"].split(",")[k])
            torch.testing.assert_close(targets[:, MUJOCO_JOINTS.index(joint)], goal, atol=1e-5, rtol=1e-5)


def test_it_conforms(tmp_path):
    """Every promise is kept, the bits of a world alone and among others included."""
    tracker = trackers.get("mjlab", export(tmp_path / "policy.onnx", metadata(), 160))
    assert all(result.ok for result in check_tracker(tracker))


def test_gains_name_their_rotor_inertia(tmp_path):
    """The drive has the file's gains, and the rotor inertia for which they were made; other gains keep the robot's."""
    texts = metadata(CANONICAL_JOINTS)
    drive = trackers.get("mjlab", export(tmp_path / "policy.onnx", texts, 160)).drive
    wanted = [of(joint, INERTIA, 0.003609725) for joint in MUJOCO_JOINTS]
    np.testing.assert_allclose(drive.armature, wanted, rtol=1e-3)
    np.testing.assert_allclose(drive.kp, np.array(wanted) * (20 * np.pi) ** 2, rtol=1e-3)
    texts["joint_damping"] = written([2.0] * 29)
    assert trackers.get("mjlab", export(tmp_path / "other.onnx", texts, 160)).drive.armature is None


@pytest.mark.parametrize(
    "changed, said",
    [
        ({"joint_names": "hip,knee"}, "joint_names are not the 29 body joints of the G1"),
        ({"joint_stiffness": ""}, "joint_stiffness must be 29 numbers, as mjlab writes them: ''"),
        ({"action_scale": "0.5,0.5"}, "action_scale must be 29 numbers"),
        ({"observation_names": "command,height_scan"}, "it sees height_scan; known terms are command"),
        ({"observation_terms_history_length": "5"}, "it sees histories of its terms"),
        ({"observation_terms_clip": "-1.000;1.000"}, "it sees clipped terms"),
        ({"anchor_body_name": "left_knee_link"}, "'left_knee_link' is not one of pelvis, torso_link"),
        ({"observation_names": "command"}, "the network takes 160 numbers, expected 58"),
    ],
)
def test_what_cannot_be_played_is_one_line(tmp_path, changed, said):
    """Metadata that are absent, of another robot or of another observation are refused by file and key."""
    texts = metadata() | changed
    if "observation_names" in changed:
        texts = {key: text for key, text in texts.items() if not key.startswith("observation_terms")}
    path = export(tmp_path / "policy.onnx", texts, 160)
    with pytest.raises(InputError, match=f"--checkpoint {path}: ") as caught:
        trackers.get("mjlab", path)
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_a_scale_is_applied_and_a_scalar_counts_for_all(tmp_path):
    """Factors of terms multiply what is seen; an action scale that is one number is every joint's."""
    texts = metadata(terms=PLAIN) | {
        "observation_terms_scale": written([1, 1, 0.25, 1, 0.05, 1]),
        "action_scale": "0.5",
    }
    tracker = trackers.get("mjlab", export(tmp_path / "policy.onnx", texts, 154))
    tracker.bind(2)
    command, state = inputs(0, 2)
    tracker.step(command, state)
    seen = tracker.observation()
    torch.testing.assert_close(seen[:, 64:67], 0.25 * state.ang_vel_body)
    torch.testing.assert_close(seen[:, 96:125], 0.05 * state.joint_vel)
    assert tracker.front_end.action_form.scale == (0.5,) * 29
