"""What the kernel tests share: devices, markers, and rotations in plain NumPy (matrices, float64)."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

wp.config.quiet = True


@pytest.fixture(params=["cpu", "cuda:0"])
def device(request: pytest.FixtureRequest) -> str:
    """Each device that Warp finds."""
    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


@dataclass
class Marker:
    """A box in the frame of a body."""

    body_id: int
    pos: tuple
    quat: tuple
    half: tuple


def matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrices of wxyz quaternions, built from the outer product of the vector part."""
    quat = np.asarray(quat, np.float64)
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    w, v = quat[..., :1, None], quat[..., 1:]
    zero = np.zeros(v.shape[:-1])
    cross = np.stack(
        [zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero], axis=-1
    ).reshape(*v.shape[:-1], 3, 3)
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def about_z(yaw: np.ndarray) -> np.ndarray:
    """Rotation matrices about z."""
    yaw = np.asarray(yaw, np.float64)
    c, s, o, i = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    return np.stack([c, -s, o, s, c, o, o, o, i], axis=-1).reshape(*yaw.shape, 3, 3)


def roll_pitch_yaw(r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles of rotation matrices Rz(yaw) Ry(pitch) Rx(roll)."""
    return (
        np.arctan2(r[..., 2, 1], r[..., 2, 2]),
        -np.arcsin(np.clip(r[..., 2, 0], -1, 1)),
        np.arctan2(r[..., 1, 0], r[..., 0, 0]),
    )


def gram_schmidt(rot6d: np.ndarray) -> np.ndarray:
    """Rotation matrices of rot6d rows, by a QR decomposition with positive diagonal."""
    columns = np.asarray(rot6d, np.float64).reshape(*np.shape(rot6d)[:-1], 3, 2)
    q, r = np.linalg.qr(columns)
    q = q * np.sign(np.einsum("...ii->...i", r))[..., None, :]
    return np.concatenate([q, np.cross(q[..., 0], q[..., 1])[..., None]], axis=-1)


def random_quats(rng: np.random.Generator, *shape: int, tilt: float | None = None) -> np.ndarray:
    """Random unit quaternions, float32; with `tilt` the up-axis stays within about that angle [rad]."""
    if tilt is None:
        q = rng.normal(size=(*shape, 4))
        return (q / np.linalg.norm(q, axis=-1, keepdims=True)).astype(np.float32)
    yaw, lean, toward = rng.uniform(-np.pi, np.pi, shape), rng.uniform(0, tilt, shape), rng.uniform(0, 7, shape)
    c, s = np.cos(lean / 2), np.sin(lean / 2)
    a = np.stack([c, s * np.cos(toward), s * np.sin(toward), np.zeros_like(c)], -1)
    cz, sz = np.cos(yaw / 2), np.sin(yaw / 2)
    q = [
        cz * a[..., 0] - sz * a[..., 3],
        cz * a[..., 1] - sz * a[..., 2],
        cz * a[..., 2] + sz * a[..., 1],
        cz * a[..., 3] + sz * a[..., 0],
    ]
    return np.stack(q, -1).astype(np.float32)


def box_pose(marker: Marker, xpos: np.ndarray, xquat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World centres and rotation matrices of a marker, per world."""
    r, p = matrix(xquat[:, marker.body_id]), np.asarray(xpos[:, marker.body_id], np.float64)
    if marker.body_id == 0:
        r, p = np.broadcast_to(np.eye(3), r.shape), np.zeros_like(p)
    return p + r @ np.float32(marker.pos).astype(np.float64), r @ matrix(np.float32(marker.quat))


@pytest.fixture(scope="session")
def twin() -> SimpleNamespace:
    """The NumPy side."""
    return SimpleNamespace(
        Marker=Marker,
        matrix=matrix,
        about_z=about_z,
        roll_pitch_yaw=roll_pitch_yaw,
        gram_schmidt=gram_schmidt,
        random_quats=random_quats,
        box_pose=box_pose,
    )
