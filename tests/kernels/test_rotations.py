"""Rotations on the device agree with plain NumPy matrices."""

import numpy as np
import warp as wp

from arena_newton.kernels import rotations as rot


@wp.func
def wxyz(q: wp.quat) -> wp.vec4:
    """The numbers (w, x, y, z) of a quaternion."""
    return wp.vec4(q[3], q[0], q[1], q[2])


@wp.kernel
def _angles(quat: wp.array2d[float], out: wp.array2d[float]):
    w = wp.tid()
    q = rot.load_quat2(quat, w, 0)
    out[w, 0] = rot.roll_of(q)
    out[w, 1] = rot.pitch_of(q)
    out[w, 2] = rot.heading_yaw(q)
    out[w, 3] = rot.up_of(q)
    v = wxyz(rot.quat_from_wxyz(wp.vec4(quat[w, 0], quat[w, 1], quat[w, 2], quat[w, 3])))
    for i in range(4):
        out[w, 4 + i] = v[i]


@wp.kernel
def _encode(quat: wp.array2d[float], out: wp.array2d[float]):
    w = wp.tid()
    v = rot.rot6d_from_quat(rot.load_quat2(quat, w, 0))
    for i in range(6):
        out[w, i] = v[i]


@wp.kernel
def _decode(rot6d: wp.array2d[float], out: wp.array2d[float], degenerate: wp.array[int]):
    w = wp.tid()
    v = rot.vec6(rot6d[w, 0], rot6d[w, 1], rot6d[w, 2], rot6d[w, 3], rot6d[w, 4], rot6d[w, 5])
    q = wxyz(rot.quat_from_rot6d(v))
    for i in range(4):
        out[w, i] = q[i]
    degenerate[w] = wp.where(rot.rot6d_is_degenerate(v), 1, 0)


@wp.kernel
def _wrap(angle: wp.array[float], out: wp.array[float]):
    out[wp.tid()] = rot.wrap_angle(angle[wp.tid()])


@wp.kernel
def _heading(yaw: wp.array[float], out: wp.array2d[float]):
    w = wp.tid()
    q = wxyz(rot.heading_quat(yaw[w]))
    for i in range(4):
        out[w, i] = q[i]


@wp.kernel
def _limit(a: wp.array2d[float], b: wp.array2d[float], limit: float, out: wp.array2d[float]):
    w = wp.tid()
    q = wxyz(rot.limit_rotation(rot.load_quat2(a, w, 0), rot.load_quat2(b, w, 0), limit))
    for i in range(4):
        out[w, i] = q[i]


def _run(kernel, device, columns, *inputs):
    rows = inputs[0].shape[0]
    arrays = [
        wp.array(np.float32(a), dtype=wp.float32, device=device) if isinstance(a, np.ndarray) else a for a in inputs
    ]
    out = wp.zeros((rows, columns) if columns else rows, dtype=wp.float32, device=device)
    wp.launch(kernel, rows, inputs=arrays, outputs=[out], device=device)
    return out.numpy()


def _log_angle(a, b):
    relative = np.swapaxes(a, -1, -2) @ b
    off = relative - np.swapaxes(relative, -1, -2)
    sine = np.linalg.norm(np.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1), axis=-1) / 2
    return np.arctan2(sine, (np.einsum("...ii", relative) - 1) / 2)


def test_angles_agree_with_matrices(device, twin):
    """Roll, pitch, heading and up-axis are those of the rotation matrix; wxyz survives the round trip bit for bit."""
    quat = twin.random_quats(np.random.default_rng(0), 500)
    r = twin.matrix(quat)
    quat, r = quat[np.abs(r[:, 2, 0]) < 0.99], r[np.abs(r[:, 2, 0]) < 0.99]
    out = _run(_angles, device, 8, quat)
    roll, pitch, yaw = twin.roll_pitch_yaw(r)
    np.testing.assert_allclose(np.cos(out[:, 0] - roll), 1, atol=1e-6)
    wrapped = [(out[:, i] - a + np.pi) % (2 * np.pi) - np.pi for i, a in ((0, roll), (2, yaw))]
    np.testing.assert_allclose(np.where(np.hypot(r[:, 2, 1], r[:, 2, 2]) > 0.2, wrapped, 0), 0, atol=2e-6)
    np.testing.assert_allclose(out[:, 1], pitch, atol=2e-6)
    np.testing.assert_allclose(out[:, 3], r[:, 2, 2], atol=1e-6)
    assert np.array_equal(out[:, 4:], quat)


def test_pitch_and_up_are_clamped(device):
    """At the poles pitch and up-axis stay finite and in range."""
    s = np.sqrt(0.5) * 1.0000001
    out = _run(_angles, device, 8, np.array([[s, 0, s, 0], [s, 0, -s, 0], [0, 1, 0, 0], [1, 0, 0, 0]], np.float32))
    np.testing.assert_allclose(out[:2, 1], [np.pi / 2, -np.pi / 2], atol=1e-3)
    np.testing.assert_allclose(out[2:, 3], [-1, 1], atol=1e-6)
    assert np.isfinite(out).all() and np.abs(out[:, 3]).max() <= 1


def test_rot6d_is_row_layout(device, twin):
    """Encoding gives [R00, R01, R10, R11, R20, R21]; the identity is [1, 0, 0, 1, 0, 0]."""
    quat = twin.random_quats(np.random.default_rng(1), 300)
    quat[0] = [1, 0, 0, 0]
    out = _run(_encode, device, 6, quat)
    np.testing.assert_allclose(out, twin.matrix(quat)[..., :2].reshape(-1, 6), atol=1e-6)
    assert out[0].tolist() == [1, 0, 0, 1, 0, 0]


def test_rot6d_decodes_by_gram_schmidt(device, twin):
    """Noisy, scaled rot6d decode to the rotation of a QR decomposition, half turns too; degenerate ones are flagged."""
    rng = np.random.default_rng(2)
    quat = twin.random_quats(rng, 400)
    quat[:4] = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0]]
    rot6d = twin.matrix(quat)[..., :2].reshape(-1, 6) * rng.uniform(0.5, 2, (400, 1))
    rot6d[4:] += rng.normal(scale=0.1, size=(396, 6))
    rot6d = np.float32(rot6d)
    bad = np.float32([[0] * 6, [1, 1, 0, 0, 0, 0], [1, 2, 0, 1e-7, 0, 0], [1, 0, 0, 2e-6, 0, 0]])
    degenerate = wp.zeros(404, dtype=wp.int32, device=device)
    out = wp.zeros((404, 4), dtype=wp.float32, device=device)
    rows = wp.array(np.concatenate([rot6d, bad]), dtype=wp.float32, device=device)
    wp.launch(_decode, 404, inputs=[rows], outputs=[out, degenerate], device=device)
    np.testing.assert_allclose(twin.matrix(out.numpy()[:400]), twin.gram_schmidt(rot6d), atol=1e-6)
    assert degenerate.numpy()[400:].tolist() == [1, 1, 1, 0] and not degenerate.numpy()[:400].any()
    assert out.numpy()[400:].tolist() == [[1, 0, 0, 0]] * 4


def test_wrap_angle(device):
    """Wrapped angles lie in [-pi, pi) and differ by full turns; small ones are untouched."""
    angle = np.float32(np.concatenate([np.linspace(-9, 9, 301), [3.0, -3.0, 0.0, 1e-5]]))
    out = _run(_wrap, device, 0, angle)
    np.testing.assert_allclose(np.exp(1j * out), np.exp(1j * angle.astype(np.float64)), atol=1e-6)
    assert (np.abs(out) <= np.float32(np.pi)).all()
    assert np.array_equal(out[-4:], angle[-4:])


def test_heading_quat(device, twin):
    """The heading quaternion turns about world z."""
    yaw = np.float32(np.linspace(-3.1, 3.1, 51))
    np.testing.assert_allclose(twin.matrix(_run(_heading, device, 4, yaw)), twin.about_z(yaw), atol=1e-6)


def test_limited_rotation(device, twin):
    """A target within the limit is kept, one beyond it is cut to the limit on the shortest arc, whatever its sign."""
    rng = np.random.default_rng(3)
    a, b = twin.random_quats(rng, 300), twin.random_quats(rng, 300)
    b[:50] = a[:50] + np.float32(rng.normal(scale=0.02, size=(50, 4)))
    b[:50] /= np.linalg.norm(b[:50], axis=1, keepdims=True)
    b[0] = a[0]
    limit = float(np.float32(np.radians(26)))
    out = _run(_limit, device, 4, a, b, limit)
    ra, rb, ro = twin.matrix(a), twin.matrix(b), twin.matrix(out)
    whole = _log_angle(ra, rb)
    near = whole <= limit
    assert near.sum() >= 40 and (~near).sum() > 200
    np.testing.assert_allclose(ro[near], rb[near], atol=1e-6)
    np.testing.assert_allclose(_log_angle(ra, ro)[~near], limit, atol=1e-6)
    np.testing.assert_allclose((_log_angle(ra, ro) + _log_angle(ro, rb))[~near], whole[~near], atol=1e-5)
    np.testing.assert_allclose(twin.matrix(_run(_limit, device, 4, a, -b, limit)), ro, atol=2e-6)
