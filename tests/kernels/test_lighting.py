"""Promises of the camera kernels."""

import numpy as np
import pytest

wp = pytest.importorskip("warp")

from arena_newton.data.recording.image_statistics import VALUES, add_picture  # noqa: E402
from arena_newton.kernels.pictures import histogram, lighting, shadow  # noqa: E402

EXPOSURE, BOUNCE, AMBIENT, DIRECT = 1.0 / 1700.0, 0.45, 0.2, 0.5


@wp.kernel
def _colour(
    albedo: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    distant: wp.array[wp.int32],
    to_light: wp.array[wp.vec3],
    light: wp.array[wp.vec3],
    visible: wp.array[wp.float32],
    out: wp.array[wp.vec3],
):
    i = wp.tid()
    seen = lighting._radiance(albedo[i], normal[i], distant[i], to_light[i], light[i], visible[i])
    out[i] = wp.vec3(lighting._display(seen[0]), lighting._display(seen[1]), lighting._display(seen[2]))


def srgb(value):
    """NumPy twin of the sRGB encoding."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055)


def shade(albedo, normal, distant, to_light, light, visible):
    """NumPy twin of the shading, before quantisation."""
    ambient = BOUNCE + (1 - BOUNCE) * 0.5 * (normal[:, 2] + 1)
    sun = AMBIENT * ambient + DIRECT * np.maximum((normal * to_light).sum(1), 0) * visible
    share = np.where(distant == 1, sun, ambient)
    return srgb(1 - np.exp(-EXPOSURE * albedo * light * share[:, None]))


def _unit(rng, n):
    v = rng.normal(size=(n, 3))
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def test_shading_equals_its_numpy_twin():
    """Dome and distant shading, tone curve and sRGB encoding agree with NumPy to 1e-6 before quantisation."""
    rng, n = np.random.default_rng(0), 4000
    albedo = rng.random((n, 3), dtype=np.float32)
    normal, to_light = _unit(rng, n), _unit(rng, n)
    distant = rng.integers(0, 2, n).astype(np.int32)
    light = (rng.uniform(1000, 7000, n)[:, None] * rng.uniform(0.65, 0.85, (n, 3))).astype(np.float32)
    visible = rng.integers(0, 2, n).astype(np.float32)
    out = wp.zeros(n, dtype=wp.vec3, device="cpu")
    arrays = [albedo, normal, distant, to_light, light, visible]
    kinds = [wp.vec3, wp.vec3, wp.int32, wp.vec3, wp.vec3, wp.float32]
    inputs = [wp.array(a, dtype=k, device="cpu") for a, k in zip(arrays, kinds, strict=True)]
    wp.launch(_colour, dim=n, inputs=inputs, outputs=[out], device="cpu")
    expected = shade(*(a.astype(np.float64) for a in arrays))
    assert np.abs(out.numpy() - expected).max() < 1e-6


def test_exposure_is_as_documented():
    """A mid grey floor is well exposed under the dome, and no light of the visual mode clips a white wall."""
    up = np.array([[0.0, 0, 1]])
    dome = shade(np.full((1, 3), 0.5), up, np.array([0]), up, np.full((1, 3), 2250.0), np.ones(1))
    assert srgb(np.array(0.48)) == pytest.approx(dome.max(), abs=0.01)
    brightest = shade(np.full((1, 3), 0.9), up, np.array([1]), up, np.full((1, 3), 7000 * 0.85), np.ones(1))
    darkest = shade(np.full((1, 3), 0.5), up, np.array([1]), up, np.full((1, 3), 3000 * 0.65), np.ones(1))
    assert brightest.max() < 0.95
    assert darkest.min() > 0.5


def test_camera_pose_follows_its_body():
    """The camera pose is body pose times local pose, and the local pose itself without a body."""
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), np.pi / 2)
    body_q = wp.array([wp.transform(wp.vec3(1, 2, 3), turn)], dtype=wp.transform, device="cpu")
    poses = wp.zeros(2, dtype=wp.transform, device="cpu")
    local = wp.transform(wp.vec3(1.0, 0.0, 0.0), wp.quat_identity())
    lighting.launch_camera_poses(body_q, wp.array([0, -1], dtype=wp.int32, device="cpu"), local, poses)
    found = poses.numpy()
    np.testing.assert_allclose(found[0], [1, 3, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-6)
    np.testing.assert_allclose(found[1], [1, 0, 0, 0, 0, 0, 1], atol=1e-6)


def test_masked_view_keeps_its_picture():
    """A view whose world index is negative is not written."""
    image = wp.full((1, 2, 2, 3), 7, dtype=wp.uint8, device="cpu")
    one = wp.zeros((1, 2, 2), dtype=wp.float32, device="cpu")
    for world, expected in ((-101, 7), (0, 255)):
        lighting.launch_shade(
            shadow.MAPPED,
            shadow.ShadowMaps(),
            views=(0, 1),
            view_world=wp.array([world], dtype=wp.int32, device="cpu"),
            poses=wp.zeros(1, dtype=wp.transform, device="cpu"),
            rays=wp.zeros((2, 2, 1, 2), dtype=wp.vec3, device="cpu"),
            albedo=wp.zeros((1, 2, 2), dtype=wp.uint32, device="cpu"),
            normals=wp.zeros((1, 2, 2), dtype=wp.vec3, device="cpu"),
            depth=one,
            decode=wp.zeros(256, dtype=wp.float32, device="cpu"),
            curve=lighting.DisplayCurve(),
            distant=wp.zeros(1, dtype=wp.int32, device="cpu"),
            direction=wp.zeros(1, dtype=wp.vec3, device="cpu"),
            light=wp.array([[1e5, 1e5, 1e5]], dtype=wp.vec3, device="cpu"),
            samples=1,
            size=(2, 2),
            origin=(0, 0),
            image=image,
        )
        assert (image.numpy() == expected).all()


@wp.kernel(enable_backward=False)
def _bytes(curve: lighting.DisplayCurve, radiance: wp.array[wp.float32], found: wp.array2d[wp.uint8]):
    at = wp.tid()
    found[0, at] = lighting._curved(curve, radiance[at])
    found[1, at] = lighting._display_byte(radiance[at])


def test_bytes_of_the_display_by_table_are_those_of_powers():
    """Radiances around every level, of any size, and many between, give the byte that the formula gives."""
    curve = lighting.display_curve(wp.get_device("cpu"))
    levels = curve.levels.numpy()
    assert (np.diff(levels) > 0).all()
    near = (levels.view(np.int32)[:, None] + np.arange(-40, 41)).clip(0).astype(np.int32).view(np.float32).ravel()
    between = np.random.default_rng(7).uniform(0, 12_000, 100_000).astype(np.float32)
    values = np.concatenate([near, between, np.float32([0, 1e-38, 0.2, 1e5, 3e38])])
    found = wp.zeros((2, len(values)), dtype=wp.uint8, device="cpu")
    wp.launch(_bytes, dim=len(values), inputs=[curve, wp.array(values, device="cpu")], outputs=[found], device="cpu")
    table, formula = found.numpy()
    assert (table == formula).all()
    assert (formula.min(), formula.max()) == (0, 255)


def test_histograms_count_every_pixel_of_chosen_worlds():
    """Noise and flat pictures are counted as OpenCV counts them, added up over ticks; worlds that do not act stay."""
    draw = np.random.default_rng(0)
    counted = np.array([True, False, True])
    found, expected = wp.zeros((3, 3, VALUES), dtype=wp.int64, device="cpu"), np.zeros((3, 3, VALUES), np.int64)
    for _ in range(2):
        pictures = draw.integers(0, 256, (3, 6, 11, 3), np.uint8)
        pictures[0, :4] = 7
        for world in np.flatnonzero(counted):
            add_picture(expected[world], pictures[world])
        at = wp.array(pictures, dtype=wp.uint8, device="cpu"), wp.array(counted, dtype=wp.bool, device="cpu")
        histogram.launch_histogram(*at, found)
    assert np.array_equal(found.numpy(), expected)
