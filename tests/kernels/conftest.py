"""Fixtures of the kernel tests: devices, random stages, and rotations and boxes in plain NumPy (matrices, float64)."""

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels.rules import success

sys.path.insert(0, str(Path(__file__).parent))
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


class Stage:
    """Random body poses on a device, and outputs that start dirty."""

    def __init__(self, device, worlds=400, seed=0, spread=0.3, quats=None):
        """Draws positions within `spread` of the origin."""
        rng = np.random.default_rng(seed)
        self.device, self.worlds, self.rng = device, worlds, rng
        self.xpos = rng.uniform(-spread, spread, (worlds, 8, 3)).astype(np.float32)
        self.xquat = np.tile(np.float32([1, 0, 0, 0]), (worlds, 8, 1)) if quats is None else quats
        self.qpos = np.zeros((worlds, 20), np.float32)
        self.qpos[:, 6:10] = [1, 0, 0, 0]
        self.qpos[:, 5] = 0.75
        self.outputs = {
            name: wp.full(worlds, 9, dtype=dtype, device=device)
            for name, dtype in (("success", wp.int32), ("margin", wp.float32), ("event", wp.int32))
        }
        self.counter = wp.zeros(worlds, dtype=wp.int32, device=device)

    def up(self, values, dtype=wp.float32):
        """Uploads."""
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def boxes(self, *markers):
        """Uploads markers."""
        return success.upload_boxes(markers, self.device)

    def judge(self, launch, *arrays, outputs=("success", "margin"), **options):
        """Runs a launch on uploaded arrays; gives its outputs as NumPy."""
        for name in outputs:
            options[name] = self.counter if name == "counter" else self.outputs[name]
        launch(*(self.up(a) if isinstance(a, np.ndarray) else a for a in arrays), **options)
        return [options[name].numpy().copy() for name in outputs]


def check(verdict: np.ndarray, margin: np.ndarray, expected: np.ndarray) -> None:
    """Margins agree, success is their sign, and the draw has some of both."""
    expected = np.asarray(expected)
    np.testing.assert_allclose(margin, expected, atol=2e-6)
    clear = np.abs(expected) > 4e-6
    assert np.array_equal(verdict[clear], (expected[clear] >= 0).astype(int))
    assert np.array_equal(verdict, (margin >= 0).astype(int))
    assert 0.02 < (expected >= 0).mean() < 0.98


def world_box(centre: np.ndarray, rotation: np.ndarray, half: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the world-axis box, from the eight corners."""
    corners = np.array(list(itertools.product(*[(-h, h) for h in np.float32(half).astype(np.float64)])))
    corners = centre[:, None] + corners @ np.swapaxes(rotation, 1, 2)
    return corners.min(1), corners.max(1)


def inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Smallest distance of points to the faces of an axis-aligned box, negative outside."""
    return np.minimum(points - low, high - points).min(-1)


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
        Stage=Stage,
        check=check,
        world_box=world_box,
        inside=inside,
    )
