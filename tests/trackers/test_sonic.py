"""SONIC sees the observation of its released controller, world by world, and its two networks run as one."""

import numpy as np
import pytest
import torch
from made_inputs import inputs

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.robot.g1 import CANONICAL_JOINTS, MUJOCO_JOINTS, SONIC_DRIVE
from arena_newton.robot.rotations import heading, heading_quat
from arena_newton.testing import check_tracker
from arena_newton.trackers import TrackerCommand
from arena_newton.trackers.sonic import SONIC_DEFAULT_POSE, SONIC_FORM, SonicFrontEnd, SonicTracker, official_pair

ORDER = [MUJOCO_JOINTS.index(name) for name in CANONICAL_JOINTS]


def matrix(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * k + 2 * k @ k


class Oracle:
    """The observation of one world in NumPy, written from its description."""

    def __init__(self):
        self.histories = None

    def observe(self, command, state, world):
        def row(tensor):
            return tensor[world].numpy().astype(float)

        turn = matrix(row(state.quat)).T @ matrix(row(command.quat))
        anchor = turn[:, :2].reshape(-1)
        gravity = matrix(row(state.quat)).T @ [0.0, 0.0, -1.0]
        joints = (row(state.joint_pos) - np.array(SONIC_DEFAULT_POSE))[ORDER]
        speeds = row(state.joint_vel)[ORDER]
        if self.histories is None:
            zeros = [np.zeros(3)] * 10
            self.histories = [zeros, [joints] * 10, [speeds] * 10, [np.zeros(29)] * 10, zeros]
        spin, pos, vel, actions, down = self.histories
        latest = zip((spin, pos, vel, down), (row(state.ang_vel_body), joints, speeds, gravity), strict=True)
        spin, pos, vel, down = ([*old[1:], new] for old, new in latest)
        self.histories = [spin, pos, vel, actions, down]
        encoder = np.concatenate(
            [
                np.zeros(4),
                np.tile(row(command.joints)[ORDER], 10),
                np.tile(row(command.joint_vel)[ORDER], 10),
                np.zeros(11),
                anchor,
                np.tile(anchor, 10),
                np.zeros(1101),
            ]
        )
        return encoder, np.concatenate([np.concatenate(h) for h in self.histories])

    def advance(self, raw):
        self.histories[3] = [*self.histories[3][1:], raw]


def test_observation_and_targets():
    """1762 encoder inputs of which mode 0 fills 646, 930 numbers of proprioception, targets without a clip."""
    worlds = 5
    front = SonicFrontEnd()
    front.bind(worlds)
    front.reset()
    oracles = [Oracle() for _ in range(worlds)]
    rng = torch.Generator().manual_seed(0)
    for tick in range(14):
        command, state = inputs(tick, worlds)
        if tick == 8:
            front.reset(torch.tensor([False, True, False, False, True]))
            oracles[1], oracles[4] = Oracle(), Oracle()
        front.observe(*inputs(99, worlds))  # an observation that is replaced before the tick ends leaves no trace
        seen = front.observe(command, state).clone()
        raw = 20.0 * torch.randn(worlds, 29, generator=rng)
        targets = front.act(raw)
        for world, oracle in enumerate(oracles):
            encoder, proprio = oracle.observe(command, state, world)
            assert encoder.shape == (1762,) and proprio.shape == (930,)
            np.testing.assert_allclose(seen[world].numpy(), np.concatenate([encoder, proprio]), atol=2e-5)
            oracle.advance(raw[world].numpy())
            goal = np.array(SONIC_DEFAULT_POSE)
            goal[ORDER] += raw[world].numpy() * np.array(SONIC_FORM.scale)[ORDER]
            np.testing.assert_allclose(targets[world].numpy(), goal, atol=1e-5)


def test_scales_and_gains():
    """The action scales are a quarter of the actuator's torque over its stiffness before the benchmark raised some."""
    scale = dict(zip(MUJOCO_JOINTS, SONIC_FORM.scale, strict=True))
    actuators = {
        (139.0, 99.02755): ("left_hip_pitch", "right_hip_roll", "left_knee"),
        (88.0, 40.168964): ("right_hip_yaw", "waist_yaw"),
        (50.0, 28.445627): ("left_ankle_pitch", "right_ankle_roll", "waist_roll", "waist_pitch"),
        (25.0, 14.222814): ("left_shoulder_pitch", "right_shoulder_yaw", "left_elbow", "right_wrist_roll"),
        (5.0, 16.77876): ("left_wrist_pitch", "right_wrist_yaw"),
    }
    for (effort, stiffness), joints in actuators.items():
        for joint in joints:
            assert scale[f"{joint}_joint"] == pytest.approx(0.25 * effort / stiffness, rel=3e-3)


def test_prefill():
    """Prefill repeats the measured present ten times in the worlds of the mask; past actions stay zero."""
    front = SonicFrontEnd()
    front.bind(3)
    front.reset()
    command, state = inputs(0, 3)
    front.prefill(command, state, torch.tensor([True, False, True]))
    spin = front.obs[:, 1762:1792].view(3, 10, 3)
    np.testing.assert_allclose(spin[2].numpy(), np.tile(state.ang_vel_body[2].numpy(), (10, 1)))
    assert (spin[1, :9] == 0).all() and (front.obs[:, 1762 + 610 : 1762 + 900] == 0).all()


def test_nan_leaves_with_reset():
    """NaN in one world leaves the others' bits alone and is gone after that world's reset."""
    clean, dirty = SonicFrontEnd(), SonicFrontEnd()
    for front in (clean, dirty):
        front.bind(3)
        front.reset()
    for tick in range(3):
        command, state = inputs(tick, 3)
        raw = torch.full((3, 29), float(tick))
        expected, targets = clean.observe(command, state).clone(), clean.act(raw).clone()
        state.joint_pos[1], state.quat[1] = float("nan"), float("nan")
        assert torch.equal(dirty.observe(command, state)[[0, 2]], expected[[0, 2]])
        assert torch.equal(dirty.act(raw), targets)
    for front in (clean, dirty):
        front.reset(torch.tensor([False, True, False]))
    command, state = inputs(9, 3)
    assert torch.equal(clean.observe(command, state), dirty.observe(command, state))


def test_declares():
    """SONIC declares what it cannot see, its gains, and 5 ms physics."""
    assert SonicTracker.ignores == ("root xy", "root height") and SonicTracker.drive is SONIC_DRIVE
    assert (SonicTracker.physics_rate.dt, SonicTracker.physics_rate.substeps) == (0.005, 4)
    assert SonicTracker.max_root_delta_deg == 26.0


def onnx_file(path, layers: list[int], *, batch: int | str = "batch", levels: int = 0):
    """An ELU network in ONNX, with its output rounded to `levels` if given, as the official encoder's latent is."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(layers[0])
    nodes, weights, x = [], [], "obs"
    for i, (a, b) in enumerate(zip(layers, layers[1:], strict=False)):
        w = (rng.standard_normal((b, a)) / np.sqrt(a)).astype(np.float32)
        weights += [numpy_helper.from_array(w, f"w{i}"), numpy_helper.from_array(np.zeros(b, np.float32), f"b{i}")]
        nodes.append(helper.make_node("Gemm", [x, f"w{i}", f"b{i}"], [f"y{i}"], transB=1))
        x = f"y{i}"
        if i < len(layers) - 2:
            nodes.append(helper.make_node("Elu", [x], [f"e{i}"]))
            x = f"e{i}"
    if levels:
        weights.append(numpy_helper.from_array(np.float32(levels), "levels"))
        for op, ins, out in (("Tanh", [x], "t"), ("Mul", ["t", "levels"], "m"), ("Round", ["m"], "r")):
            nodes.append(helper.make_node(op, ins, [out]))
        nodes.append(helper.make_node("Div", ["r", "levels"], ["latent"]))
        x = "latent"
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [batch, layers[0]])],
        [helper.make_tensor_value_info(x, TensorProto.FLOAT, [batch, layers[-1]])],
        weights,
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), str(path))


def official_like(folder, width=1762, **encoder):
    folder.mkdir(exist_ok=True)
    onnx_file(folder / "model_encoder.onnx", [width, 48, 64], **encoder)
    onnx_file(folder / "model_decoder.onnx", [994, 48, 29], batch=encoder.get("batch", "batch"))
    return folder


@pytest.mark.parametrize(
    "encoder", [{}, {"levels": 16}, {"levels": 16, "batch": 1}], ids=["plain", "rounded", "single"]
)
def test_official_networks(tmp_path, encoder):
    """Encoder and decoder files of the official shapes run as onnxruntime runs them, with rounding and fixed batch."""
    import onnxruntime

    folder = official_like(tmp_path / "sonic", **encoder)
    tracker = trackers.get("sonic", folder)
    tracker.bind(3)
    front = SonicFrontEnd()
    front.bind(3)
    front.reset()
    sessions = [onnxruntime.InferenceSession(str(folder / f"model_{n}.onnx")) for n in ("encoder", "decoder")]
    for tick in range(3):
        command, state = inputs(tick, 3)
        seen = front.observe(command, state).numpy()
        raw = np.zeros((3, 29), np.float32)
        for world in range(3):
            latent = sessions[0].run(None, {"obs": seen[world : world + 1, :1762]})[0]
            decoder_input = np.concatenate([latent, seen[world : world + 1, 1762:]], 1)
            raw[world] = sessions[1].run(None, {"obs": decoder_input})[0]
        expected = front.act(torch.from_numpy(raw))
        torch.testing.assert_close(tracker.step(command, state), expected, atol=1e-4, rtol=1e-4)


def test_ways_to_name_the_pair(tmp_path):
    """A folder, either file, or both with a comma name the same networks; what is absent is named."""
    folder = official_like(tmp_path / "sonic")
    pair = [folder / f"model_{n}.onnx" for n in ("encoder", "decoder")]
    assert {official_pair(c) for c in (folder, *pair, f"{pair[0]},{pair[1]}")} == {tuple(pair)}
    pair[1].unlink()
    for checkpoint in (folder, pair[0]):
        with pytest.raises(InputError, match="model_decoder.onnx is absent") as caught:
            trackers.get("sonic", checkpoint)
        assert "\n" not in str(caught.value)
    onnx_file(pair[1], [500, 29])
    with pytest.raises(InputError, match="takes 500 numbers, expected 994"):
        trackers.get("sonic", folder)
    pair[1].write_bytes(b"noise")
    with pytest.raises(InputError, match="not a usable ONNX file"):
        trackers.get("sonic", folder)


def heading_only(quat: np.ndarray) -> np.ndarray:
    turn = matrix(quat)
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])


PARTS = {
    "default": (1762, 5, {"ref_pos": 4, "ref_vel": 294, "anchors": 601}),
    "low_latency": (1247, 1, {"ref_pos": 4, "ref_vel": 294, "anchors": 584}),
    "v1_1": (1751, 5, {"ref_pos": 4, "ref_vel": 294, "anchors": 584}),
}
"""Release → width of the encoder's input, ticks between frames, first columns of what mode `g1` fills."""


@pytest.mark.parametrize("variant", PARTS)
def test_releases(tmp_path, variant):
    """Ten frames of the coming reference at the release's step, in canonical order; other modes' inputs are zero."""
    width, step, first = PARTS[variant]
    tracker = trackers.get(f"sonic:{variant}", official_like(tmp_path / "sonic", width))
    assert tracker.lookahead == 9 * step and tracker.describe()["variant"] == variant
    tracker.bind(3)
    command, state = inputs(0, 3)
    coming = [inputs(1 + tick, 3)[0] for tick in range(9 * step)]
    parts = zip(*(one.tensors().values() for one in coming), strict=True)
    command.ahead = TrackerCommand(*(torch.stack(part, 1) for part in parts))
    tracker.step(command, state)
    seen = tracker.observation().clone()
    assert seen.shape == (3, width + 930)
    for world in range(3):
        frames = [command, *coming[step - 1 :: step]]
        robot = state.quat[world].numpy().astype(float)
        turn = heading_only(robot) if variant == "v1_1" else matrix(robot)
        anchors = [(turn.T @ matrix(f.quat[world].numpy().astype(float)))[:, :2].reshape(-1) for f in frames]
        expected = np.zeros(width)
        expected[first["ref_pos"] :][:290] = np.concatenate([f.joints[world].numpy()[ORDER] for f in frames])
        expected[first["ref_vel"] :][:290] = np.concatenate([f.joint_vel[world].numpy()[ORDER] for f in frames])
        expected[first["anchors"] :][:60] = np.concatenate(anchors)
        np.testing.assert_allclose(seen[world, :width].numpy(), expected, atol=2e-5)


def test_a_release_conforms(tmp_path):
    """The release with window and heading keeps every promise, the bits of a world alone and among others included."""
    tracker = trackers.get("sonic:v1_1", official_like(tmp_path / "sonic", 1751))
    assert all(result.ok for result in check_tracker(tracker))


@pytest.mark.parametrize(
    "spec, checkpoint, said",
    [
        ("sonic:v2", "sonic", "--tracker sonic:v2: unknown; known are default, low_latency, v1_1"),
        ("sonic:v1_1", None, "--tracker sonic:v1_1: pass --checkpoint with the folder of its official networks"),
        ("sonic:low_latency", "sonic", "the network takes 1762 numbers, expected 1247"),
    ],
)
def test_unfit_releases(tmp_path, spec, checkpoint, said):
    """An unknown release, one without networks and networks of another release are one line each."""
    official_like(tmp_path / "sonic")
    with pytest.raises(InputError, match=said):
        trackers.get(spec, checkpoint and tmp_path / checkpoint)


def test_heading_quat():
    """The turn about the vertical of any orientation, also backwards and without one; a unit quaternion."""
    quat = torch.nn.functional.normalize(torch.randn(200, 4, generator=torch.Generator().manual_seed(0)), dim=1)
    special = torch.tensor([[1.0, 0, 0, 0], [0, 0, 0, 1], [0.70710678, 0, 0.70710678, 0], [1e-4, 0, 0, -1]])
    quat = torch.cat([quat, special])
    found = heading_quat(quat)
    torch.testing.assert_close(found.norm(dim=1), torch.ones(len(quat)), atol=1e-6, rtol=0)
    level = heading(quat)
    off = torch.remainder(heading(found) - level + torch.pi, 2 * torch.pi) - torch.pi
    assert (off[torch.arange(len(quat)) != 202].abs() < 1e-5).all() and (found[:, 1:3] == 0).all()
