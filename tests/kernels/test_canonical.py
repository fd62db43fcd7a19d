"""State 64, reference integration and mimic 35 agree with a NumPy transcription of the specification (§5, §6.1)."""

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels import canonical
from arena_newton.robot import g1

TICK = 0.02


def _array(values, device, dtype=wp.float32):
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)


def _reference(worlds, device):
    return canonical.ReferencePose.allocate(worlds, device, canonical_to_mujoco=g1.CANONICAL_TO_MUJOCO, tick=g1.TICK)


class Runtime:
    """One world of the original's runtime, float64, after §5.5: the twin of the integration kernel."""

    def __init__(self, twin, qpos):
        """Anchors at a robot."""
        self.twin = twin
        self.target = twin.matrix(qpos[3:7])
        self.yaw = twin.roll_pitch_yaw(self.target)[2]
        self.heading = twin.about_z(self.yaw)
        self.xy = np.float64(qpos[:2])
        self.z = self.joints = None

    def step(self, action, limit_deg):
        """Executes one action; gives position, target matrix, joint velocity, mimic."""
        action = np.float64(action)
        goal = self.heading @ self.twin.gram_schmidt(action[3:9])
        if limit_deg:
            goal = self._limited(goal, np.radians(limit_deg))
        dz = 0.0 if self.z is None else action[2] - self.z
        # The local displacement is the one with the given xy whose world height is dz.
        local_z = np.linalg.solve([[1, 0, 0], [0, 1, 0], goal[2]], [action[0], action[1], dz])[2]
        self.xy = self.xy + (goal @ [action[0], action[1], local_z])[:2]
        velocity = np.zeros(29) if self.joints is None else (action[9:38] - self.joints) / TICK
        roll, pitch, yaw = self.twin.roll_pitch_yaw(goal)
        turn = np.angle(np.exp(1j * (yaw - self.yaw)))
        mimic = np.zeros(35)
        mimic[:6] = action[0] / TICK, action[1] / TICK, action[2], roll, pitch, turn / TICK
        for name, value in zip(g1.CANONICAL_JOINTS, action[9:38], strict=True):
            mimic[6 + g1.MUJOCO_JOINTS.index(name)] = value
        self.target, self.yaw, self.z, self.joints = goal, yaw, action[2], action[9:38]
        return np.array([*self.xy, action[2]]), goal, velocity, mimic

    def _limited(self, goal, limit):
        values, vectors = np.linalg.eig(self.target.T @ goal)
        angle = np.abs(np.angle(values)).max()
        if angle <= limit:
            return goal
        powers = np.exp(1j * np.angle(values) * limit / angle)
        return self.target @ np.real(vectors @ np.diag(powers) @ np.linalg.inv(vectors))


def _actions(rng, twin, steps, worlds, tilt=0.5):
    actions = np.zeros((steps, worlds, 40), np.float32)
    actions[..., :2] = rng.normal(scale=0.01, size=(steps, worlds, 2))
    actions[..., 2] = 0.75 + np.cumsum(rng.normal(scale=0.004, size=(steps, worlds)), 0)
    quats = twin.random_quats(rng, steps, worlds, tilt=tilt)
    actions[..., 3:9] = twin.matrix(quats)[..., :2].reshape(steps, worlds, 6)
    actions[..., 9:38] = rng.normal(scale=0.4, size=(steps, worlds, 29))
    actions[..., 38:] = rng.uniform(0, 1, size=(steps, worlds, 2))
    return actions


def _robot(rng, twin, worlds, nq=50, adr=0):
    qpos = rng.normal(size=(worlds, nq)).astype(np.float32)
    qpos[:, adr + 3 : adr + 7] = twin.random_quats(rng, worlds, tilt=0.4)
    return qpos


def test_state_is_rot6d_without_heading_and_joints(device, twin):
    """The state holds rot6d of heading0^-1 q, then absolute joint positions and velocities through the index arrays."""
    rng = np.random.default_rng(0)
    worlds, adr = 64, 5
    qpos = _robot(rng, twin, worlds, nq=60, adr=adr)
    qvel = rng.normal(size=(worlds, 58)).astype(np.float32)
    joint_qpos, joint_qvel = rng.permutation(np.arange(12, 60))[:29], rng.permutation(np.arange(11, 58))[:29]
    heading0 = rng.uniform(-np.pi, np.pi, worlds).astype(np.float32)
    state = wp.zeros((worlds, 64), dtype=wp.float32, device=device)
    canonical.launch_state64(
        _array(qpos, device),
        _array(qvel, device),
        adr,
        _array(joint_qpos, device, wp.int32),
        _array(joint_qvel, device, wp.int32),
        _array(heading0, device),
        state,
    )
    relative = np.swapaxes(twin.about_z(heading0), 1, 2) @ twin.matrix(qpos[:, adr + 3 : adr + 7])
    out = state.numpy()
    np.testing.assert_allclose(out[:, :6], relative[..., :2].reshape(-1, 6), atol=1e-6)
    assert np.array_equal(out[:, 6:35], qpos[:, joint_qpos])
    assert np.array_equal(out[:, 35:], qvel[:, joint_qvel])


@pytest.mark.parametrize("limit_deg", [0.0, 26.0])
def test_integration_agrees_with_the_specification(device, twin, limit_deg):
    """Twelve random steps in many worlds: position, target, joint velocity, hands and mimic are the specification's."""
    rng = np.random.default_rng(1)
    worlds, steps, adr = 24, 12, 3
    qpos = _robot(rng, twin, worlds, adr=adr)
    actions = _actions(rng, twin, steps, worlds)
    ref = _reference(worlds, device)
    ones = wp.full(worlds, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(ref, _array(qpos, device), adr, ones)
    runtimes = [Runtime(twin, q[adr:]) for q in qpos]
    np.testing.assert_allclose(ref.heading.numpy(), [r.yaw for r in runtimes], atol=1e-6)
    assert np.array_equal(ref.position.numpy(), qpos[:, adr : adr + 3])
    for t in range(steps):
        canonical.launch_integrate(ref, _array(actions[t], device), ones, limit_deg)
        rows = [r.step(a, limit_deg) for r, a in zip(runtimes, actions[t], strict=True)]
        position, target, velocity, mimic = (np.array([row[k] for row in rows]) for k in range(4))
        drift = 1e-6 * (t + 1)  # xy is an open-loop sum
        np.testing.assert_allclose(ref.position.numpy(), position, rtol=1e-6, atol=drift)
        np.testing.assert_allclose(twin.matrix(ref.quat.numpy()), target, atol=1e-6 if not limit_deg else 3e-6)
        np.testing.assert_allclose(ref.joint_vel.numpy(), velocity, rtol=1e-6, atol=1e-5)
        assert np.array_equal(ref.joints.numpy(), actions[t][:, 9:38])
        assert np.array_equal(ref.hands.numpy(), (actions[t][:, 38:] >= 0.5).astype(np.float32))
        out, scale = ref.mimic.numpy(), 1e-6 if not limit_deg else 3e-6
        np.testing.assert_allclose(out[:, :5], mimic[:, :5], rtol=1e-6, atol=scale)
        # A yaw rate is an angle of this accuracy over one tick; turns by half a circle may round to either side.
        turn = np.angle(np.exp(1j * TICK * (out[:, 5] - mimic[:, 5])))
        np.testing.assert_allclose(turn, 0, atol=2 * scale)
        np.testing.assert_allclose(out[:, 6:], mimic[:, 6:], rtol=1e-7)
    assert (ref.steps.numpy() == steps).all()


def test_first_step_has_no_height_or_joint_rate(device, twin):
    """On the first step height and joints make no velocity, and the yaw rate is taken against the robot's heading."""
    qpos = np.zeros((1, 7), np.float32)
    qpos[0] = [1, 2, 0.8, np.cos(0.6), 0, 0, np.sin(0.6)]
    action = np.zeros((1, 40), np.float32)
    action[0, 2] = 0.9
    action[0, 3:9] = twin.about_z(np.array(0.01))[:, :2].reshape(6)
    action[0, 9:38] = 0.3
    ref = _reference(1, device)
    ones = wp.full(1, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(ref, _array(qpos, device), 0, ones)
    canonical.launch_integrate(ref, _array(action, device), ones)
    np.testing.assert_allclose(ref.position.numpy()[0], [1, 2, 0.9], atol=1e-6)
    assert not ref.joint_vel.numpy().any()
    np.testing.assert_allclose(ref.mimic.numpy()[0, 5], 0.01 / TICK, atol=1e-4)
    np.testing.assert_allclose(twin.roll_pitch_yaw(twin.matrix(ref.quat.numpy()))[2], 1.21, atol=1e-6)


def test_height_moves_a_leaning_reference_sideways(device, twin):
    """With the reference pitched by 0.3 rad a pure height change of dz moves it by dz tan(0.3) along its heading."""
    c, s = np.cos(0.3), np.sin(0.3)
    action = np.zeros((1, 40), np.float32)
    action[0, 3:9] = [c, 0, 0, 1, -s, 0]
    ref = _reference(1, device)
    ones = wp.full(1, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(ref, _array([[0, 0, 0, 1, 0, 0, 0]], device), 0, ones)
    for z in (0.7, 0.8):
        action[0, 2] = z
        canonical.launch_integrate(ref, _array(action, device), ones)
    np.testing.assert_allclose(ref.position.numpy()[0], [0.1 * np.tan(0.3), 0, 0.8], atol=1e-6)


def test_yaw_rate_wraps(device, twin):
    """A step across the half circle gives a small yaw rate."""
    ref = _reference(1, device)
    ones = wp.full(1, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(ref, _array([[0, 0, 0.8, 1, 0, 0, 0]], device), 0, ones)
    for yaw in (np.pi - 0.01, -np.pi + 0.01):
        action = np.zeros((1, 40), np.float32)
        action[0, 3:9] = twin.about_z(np.array(yaw))[:, :2].reshape(6)
        canonical.launch_integrate(ref, _array(action, device), ones)
    np.testing.assert_allclose(ref.mimic.numpy()[0, 5], 0.02 / TICK, atol=1e-4)


def test_reference_on_edge_stays_finite(device):
    """A reference pitched by 90 degrees, where height no longer tells local z, gives finite numbers."""
    action = np.zeros((1, 40), np.float32)
    action[0, :9] = [0.01, 0.01, 0.8, 0, 0, 0, 1, -1, 0]
    ref = _reference(1, device)
    ones = wp.full(1, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(ref, _array([[0, 0, 0.8, 1, 0, 0, 0]], device), 0, ones)
    for _ in range(2):
        canonical.launch_integrate(ref, _array(action, device), ones)
    assert np.isfinite(ref.position.numpy()).all() and np.abs(ref.position.numpy()).max() < 1


def test_masked_worlds_stay_as_they_are(device, twin):
    """Reset and integration leave unmasked worlds bit for bit; a world's result does not depend on its neighbours."""
    rng = np.random.default_rng(4)
    qpos, actions = _robot(rng, twin, 4), _actions(rng, twin, 3, 4)
    ones = wp.full(4, 1, dtype=wp.int32, device=device)
    mask = _array([1, 0, 1, 0], device, wp.int32)
    ref, alone = _reference(4, device), _reference(1, device)
    canonical.launch_reset_reference(ref, _array(qpos, device), 0, ones)
    canonical.launch_integrate(ref, _array(actions[0], device), ones)
    before = {k: v.numpy().copy() for k, v in vars(ref).items() if isinstance(v, wp.array)}
    canonical.launch_integrate(ref, _array(actions[1], device), mask)
    canonical.launch_reset_reference(ref, _array(qpos[::-1].copy(), device), 0, _array([0, 0, 1, 0], device, wp.int32))
    for name, old in before.items():
        new = getattr(ref, name).numpy()
        if name != "canonical_to_mujoco":
            assert np.array_equal(new[[1, 3]], old[[1, 3]]), name
    assert ref.steps.numpy().tolist() == [2, 1, 0, 1]
    one = wp.full(1, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(alone, _array(qpos[:1], device), 0, one)
    for t in range(2):
        canonical.launch_integrate(alone, _array(actions[t, :1], device), one)
    assert np.array_equal(alone.mimic.numpy()[0], ref.mimic.numpy()[0])
    assert np.array_equal(alone.position.numpy()[0], ref.position.numpy()[0])


def test_hand_threshold(device, twin):
    """A hand closes from 0.5 on."""
    action = _actions(np.random.default_rng(5), twin, 1, 1)[0]
    action[0, 38:] = [0.5, np.nextafter(np.float32(0.5), np.float32(0))]
    ref = _reference(1, device)
    ones = wp.full(1, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(ref, _array([[0, 0, 0.8, 1, 0, 0, 0]], device), 0, ones)
    canonical.launch_integrate(ref, _array(action, device), ones)
    assert ref.hands.numpy().tolist() == [[1, 0]]


def test_bad_actions_are_flagged(device, twin):
    """NaN or infinity anywhere and a rot6d that spans no plane are flagged, each by its code; good actions are not."""
    action = np.repeat(_actions(np.random.default_rng(6), twin, 1, 1)[0], 46, 0)
    for i in range(40):
        action[i, i] = (np.nan, np.inf, -np.inf)[i % 3]
    action[40, 3:9] = 0
    action[41, 3:9] = [1, 2, 0, 0, 0, 0]
    action[42, 3:9] = [1, 0, 0, 0.9e-6, 0, 0]
    action[43, 3:9] = [1, 0, 0, 1.1e-6, 0, 0]
    bad = wp.full(46, 9, dtype=wp.int32, device=device)
    canonical.launch_validate_action(_array(action, device), bad)
    expected = [canonical.ACTION_NONFINITE] * 40 + [canonical.ACTION_BAD_ROT6D] * 3 + [0] * 3
    assert bad.numpy().tolist() == expected
