"""Promises of the kernels that draw triangles, from the camera and from the light."""

import numpy as np
import pytest
import warp as wp

from arena_newton.kernels.pictures import raster, shadow


def srgb(value):
    """NumPy twin of the sRGB encoding."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055)


def _soup(vertices, faces, color, uvs=None, texels=None, table=True):
    soup = raster.Soup()

    def array(values, kind):
        return wp.array(values, dtype=kind, device="cpu")

    soup.world_start, soup.world_end = array([0, len(faces)], wp.int32), array([len(faces)] * 2, wp.int32)
    soup.large_end, soup.small_end = array([0, len(faces)], wp.int32), array([len(faces), len(faces)], wp.int32)
    soup.shape, soup.face = array(np.zeros(len(faces)), wp.int32), array(np.arange(len(faces)), wp.int32)
    soup.bounds, soup.scales = array([[0, 0, 0, 1e3]], wp.vec4), array([[1, 1, 1]], wp.vec3)
    soup.transforms = array([[0, 0, 0, 0, 0, 0, 1]], wp.transform)
    soup.colors, soup.texture = array([color], wp.vec3), array([-1 if texels is None else 0], wp.int32)
    soup.faces, soup.vertices = array(faces, wp.vec3i), array(vertices, wp.vec3)
    soup.normals = array(np.zeros((len(vertices), 3)), wp.vec3)
    soup.uvs = array(np.zeros((len(vertices), 2)) if uvs is None else uvs, wp.vec2)
    texels = np.zeros((0, 0, 3), np.uint8) if texels is None else texels
    soup.texels = array(texels.ravel(), wp.uint8)
    soup.texture_layout = array([[0, texels.shape[1], texels.shape[0]]], wp.vec3i)
    soup.packed = wp.zeros(1, dtype=wp.uint32, device="cpu")
    soup.levels = wp.zeros(256 * table, dtype=wp.float32, device="cpu")
    raster.launch_albedo(soup)
    return soup


def _draw(vertices, faces, tangents=(1.0, 0.75), width=64, height=48, color=(0.25, 0.5, 1.0), **texture):
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (np.arange(height) + 0.5) / height * 2
    rays = np.zeros((height, width, 1, 2, 3), np.float32)
    rays[:, :, 0, 1] = np.stack(np.broadcast_arrays(x[None] * tangents[0], y[:, None] * tangents[1], -1.0), -1)
    rays[:, :, 0, 1] /= np.linalg.norm(rays[:, :, 0, 1], axis=-1, keepdims=True)

    def empty(kind):
        return wp.zeros((1, height, width), dtype=kind, device="cpu")

    out = {"albedo": empty(wp.uint32), "normals": empty(wp.vec3), "depth": empty(wp.float32)}
    out["depth"].fill_(7.0)  # of an earlier picture
    raster.launch_rasterize(
        view_world=wp.zeros(1, dtype=wp.int32, device="cpu"),
        poses=wp.array([[0, 0, 0, 0, 0, 0, 1]], dtype=wp.transform, device="cpu"),
        rays=wp.array(rays, dtype=wp.vec3, device="cpu"),
        soup=_soup(vertices, faces, color, **texture),
        tangents=tangents,
        triangles=len(faces),
        nearest=empty(wp.uint64),
        **out,
    )
    return rays[:, :, 0, 1], {k: v.numpy()[0] for k, v in out.items()}


def test_drawn_triangles_meet_the_rays():
    """Random triangles, some through the camera's plane, are found where ray–triangle intersection finds them."""
    rng = np.random.default_rng(3)
    vertices = rng.uniform(-3, 3, (60, 3)).astype(np.float32)
    faces = np.arange(60).reshape(-1, 3)
    rays, out = _draw(vertices, faces)
    best = np.full(rays.shape[:2], np.inf)
    for p0, p1, p2 in vertices[faces].astype(np.float64):
        d = rays.astype(np.float64)
        h = np.cross(d, p2 - p0)
        det = h @ (p1 - p0)
        u = h @ -p0 / det
        q = np.cross(-p0, p1 - p0)
        v, t = d @ q / det, q @ (p2 - p0) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t * -d[..., 2] > 0.002)
        best = np.where(hit & (t < best), t, best)
    assert (out["depth"] != 7.0).all()
    found = np.where(out["depth"] > 0, out["depth"], np.inf)
    assert np.isclose(found, best, rtol=1e-3, atol=1e-3).mean() > 0.995
    assert np.isfinite(best).mean() > 0.3


def test_a_floor_has_no_cracks():
    """A fan of triangles covers its plane without a hole, and its colour and depth are the plane's."""
    angle = np.linspace(0, 2 * np.pi, 40)[:-1]
    rim = np.stack([30 * np.cos(angle), 30 * np.sin(angle), np.full_like(angle, -2.0)], 1)
    vertices = np.vstack([[0.1, -0.2, -2.0], rim]).astype(np.float32)
    faces = [[0, 1 + i, 1 + (i + 1) % 39] for i in range(39)]
    rays, out = _draw(vertices, np.array(faces))
    np.testing.assert_allclose(out["depth"] * -rays[..., 2], 2.0, rtol=1e-4)
    colour = out["albedo"].view(np.uint8).reshape(*out["albedo"].shape, 4)[..., :3]
    assert np.abs(colour.astype(int) - np.round(srgb(np.array([0.25, 0.5, 1.0])) * 255)).max() <= 1


def test_a_shadow_map_holds_the_highest_surface():
    """Every texel has the depth of the triangle nearest to the light there, and its window encloses what is seen."""
    rng = np.random.default_rng(4)
    vertices = rng.uniform(-3, 3, (60, 3)).astype(np.float32)
    faces = np.arange(60).reshape(-1, 3)
    vertices[:, 2] -= 4.0
    width, height, size = 64, 48, 96
    x, y = (np.arange(width) + 0.5) / width * 2 - 1, 1 - (np.arange(height) + 0.5) / height * 2
    along = np.stack(np.broadcast_arrays(x[None], y[:, None], -1.0), -1)
    length = np.linalg.norm(along, axis=-1)
    rays = np.zeros((height, width, 1, 2, 3), np.float32)
    rays[:, :, 0, 1] = along / length[..., None]
    maps = shadow.ShadowMaps()
    with wp.ScopedDevice("cpu"):
        maps.frames = wp.zeros(1, dtype=wp.transform)
        maps.window = wp.zeros((2, 4), dtype=wp.float32)
        maps.depth = wp.zeros((2, size, size), dtype=wp.uint32)
        # The view shows a floor 4 m below the camera, so all of it belongs to the far map.
        shadow.launch_shadow_maps(
            first=0,
            view_world=wp.zeros(1, dtype=wp.int32),
            poses=wp.array([[0, 0, 0, 0, 0, 0, 1]], dtype=wp.transform),
            rays=wp.array(rays, dtype=wp.vec3),
            normals=wp.array(np.tile(np.float32([0, 0, 1]), (1, height, width, 1)), dtype=wp.vec3),
            depth=wp.array(4.0 * length[None].astype(np.float32), dtype=wp.float32),
            soup=_soup(vertices, faces, (1, 1, 1)),
            casters=(0, len(faces)),
            distant=wp.ones(1, dtype=wp.int32),
            direction=wp.array([[0, 0, -1]], dtype=wp.vec3),
            maps=maps,
        )
    window = maps.window.numpy()
    assert window[0, 0] > 1e8
    np.testing.assert_allclose(np.sort(np.abs(window[1]))[[0, 3]], [4 * y.max(), 4 * x.max()], rtol=1e-5)
    found = maps.depth.numpy()[1].view(np.float32).astype(float)
    low, extent = window[1, :2].astype(float), -window[1, 2:] - window[1, :2].astype(float)
    low, texel = low - 0.02 * extent, 1.04 * extent / size
    u, v = np.meshgrid(low[0] + (np.arange(size) + 0.5) * texel[0], low[1] + (np.arange(size) + 0.5) * texel[1])
    turn = maps.frames.numpy()[0, 3:]
    right = np.array(wp.quat_rotate(wp.quat(*turn), wp.vec3(1.0, 0.0, 0.0)))
    forward = np.array(wp.quat_rotate(wp.quat(*turn), wp.vec3(0.0, 1.0, 0.0)))
    points = vertices[faces].astype(float)
    best = np.full(u.shape, -np.inf)
    for p0, p1, p2 in np.stack([points @ right, points @ forward, points[..., 2]], -1):
        (a, b), (c, d) = (p1 - p0)[:2], (p2 - p0)[:2]
        s = ((u - p0[0]) * d - (v - p0[1]) * c) / (a * d - b * c)
        t = ((v - p0[1]) * a - (u - p0[0]) * b) / (a * d - b * c)
        z = p0[2] + s * (p1 - p0)[2] + t * (p2 - p0)[2]
        best = np.where((s >= 0) & (t >= 0) & (s + t <= 1), np.maximum(best, z), best)
    expected = np.where(np.isfinite(best), best + 256.0, 0.0)
    assert (np.abs(found - expected) < 2e-3).mean() > 0.995
    assert 0.2 < np.isfinite(best).mean() < 1.0


@wp.kernel(enable_backward=False)
def _bytes(soup: raster.Soup, values: wp.array[wp.float32], found: wp.array2d[wp.uint32]):
    at = wp.tid()
    found[0, at] = raster._texture_byte(soup, values[at])
    found[1, at] = raster._albedo_byte(raster._linear(values[at]))


def test_bytes_of_textures_by_table_are_those_of_powers():
    """Values around every level, and many between, give the byte of the powers."""
    soup = _soup(np.zeros((1, 3)), [[0, 0, 0]], (1.0, 1.0, 1.0))
    levels = soup.levels.numpy()[:255]
    assert (np.diff(levels) > 0).all()
    near = (levels.view(np.int32)[:, None] + np.arange(-20, 21)).clip(0).astype(np.int32).view(np.float32).ravel()
    values = np.concatenate([near, np.random.default_rng(6).random(100_000, np.float32), np.float32([0, 1])])
    found = wp.zeros((2, len(values)), dtype=wp.uint32, device="cpu")
    wp.launch(_bytes, dim=len(values), inputs=[soup, wp.array(values, device="cpu")], outputs=[found], device="cpu")
    table, powers = found.numpy()
    assert (table == powers).all()
    assert (powers.min(), powers.max()) == (0, 254)


@pytest.mark.parametrize("color", [(1.0, 1.0, 1.0), (0.25, 0.5, 1.0)])
def test_textures_repeat_and_blend(color):
    """A wall that a texture of 3 rows and 5 columns covers several times shows its texels blended, and tinted."""
    texels = np.random.default_rng(8).integers(0, 256, (3, 5, 3), np.uint8)
    corners = np.array([[-3, -2.5, -2], [3, -2.5, -2], [3, 2.5, -2], [-3, 2.5, -2]], np.float32)
    low, size = np.array([-3.7, -1.2]), np.array([5.8, 3.5])
    uvs = low + size * (corners[:, :2] + [3, 2.5]) / [6, 5]
    texture = {"color": color, "uvs": uvs, "texels": texels}
    rays, out = _draw(corners, np.array([[0, 1, 2], [0, 2, 3]]), **texture)
    u, v = np.moveaxis(low + size * (rays[..., :2] * 2 / -rays[..., 2:] + [3, 2.5]) / [6, 5], -1, 0)
    column, row = u * 5 - 0.5, (1 - v) * 3 - 0.5
    seen = np.zeros((*column.shape, 3))
    for right in (0, 1):
        for lower in (0, 1):
            i, j = np.floor(row).astype(int) + lower, np.floor(column).astype(int) + right
            weight = (1 - np.abs(row - i)) * (1 - np.abs(column - j))
            seen += weight[..., None] * texels[i % 3, j % 5] / 255
    expected = srgb(np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4) * color) * 255
    found = out["albedo"].view(np.uint8).reshape(*column.shape, 4)[..., :3]
    assert np.abs(found - expected).max() < 1.1
    assert np.ptp(found, axis=(0, 1)).min() > 100
    _, powers = _draw(corners, np.array([[0, 1, 2], [0, 2, 3]]), table=False, **texture)
    assert (powers["albedo"] == out["albedo"]).all()
