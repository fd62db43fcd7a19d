"""Promises of the cameras, on a small Newton model with one light per world."""

from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp
from pxr import Gf, Usd, UsdGeom, UsdLux

from arena_newton.errors import InputError
from arena_newton.kernels import launching
from arena_newton.physics import devices
from arena_newton.physics.devices import torch_threads
from arena_newton.pictures.camera import Camera, CameraConfig, WorldLights

WORLDS = 3
DOWN = (0.0, 0.0, -1.0)


def _light(direction, intensity=5000.0, color=(0.75, 0.75, 0.75)):
    direction = np.asarray(direction, float)
    return SimpleNamespace(direction=direction / np.linalg.norm(direction), intensity=intensity, color=color)


@pytest.fixture(scope="module")
def model():
    """Ground, a textured mesh, a sphere and a free box at (0, 0, 1) in each of three worlds."""
    world = newton.ModelBuilder()
    world.add_ground_plane(color=(0.6, 0.6, 0.6))
    body = world.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, 1.0), wp.quat_identity()))
    world.add_shape_box(body, hx=0.2, hy=0.2, hz=0.2, color=(0.8, 0.1, 0.1))
    # One of each primitive, lying at different angles beyond what the other tests look at.
    tilt = wp.quat_from_axis_angle(wp.normalize(wp.vec3(1.0, 0.5, 0.2)), 0.9)
    world.add_shape_capsule(-1, xform=wp.transform(wp.vec3(-1.5, -1.2, 0.3), tilt), radius=0.1, half_height=0.3)
    world.add_shape_cylinder(-1, xform=wp.transform(wp.vec3(-0.5, -1.2, 0.3), tilt), radius=0.1, half_height=0.3)
    world.add_shape_cone(-1, xform=wp.transform(wp.vec3(0.5, -1.2, 0.3), tilt), radius=0.2, half_height=0.3)
    world.add_shape_ellipsoid(-1, xform=wp.transform(wp.vec3(1.5, -1.2, 0.3), tilt), rx=0.1, ry=0.2, rz=0.3)
    ball = wp.transform(wp.vec3(-1.0, 0.0, 0.3), wp.quat_identity())
    world.add_shape_sphere(-1, xform=ball, radius=0.3, color=(0.1, 0.1, 0.8))
    stripes = np.zeros((8, 8, 3), np.uint8)
    stripes[:, ::2] = 255
    quad = newton.Mesh(
        np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], np.float32),
        np.array([0, 1, 2, 0, 2, 3], np.int32),
        uvs=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
        texture=stripes,
        compute_inertia=False,
    )
    carpet = wp.transform(wp.vec3(1.2, 0.0, 0.01), wp.quat_identity())
    world.add_shape_mesh(-1, xform=carpet, mesh=quad, color=(1.0, 1.0, 1.0))
    builder = newton.ModelBuilder()
    builder.replicate(world, WORLDS)
    return builder.finalize(device="cpu")


def _camera(model, lights, width=80, height=60, **options):
    # 5 m above the floor, looking straight down, +x to the right and +y up.
    lens = {"focal_length": 7.6, "horizontal_aperture": 7.6}
    body = np.full(WORLDS, -1)
    position, quat = (0.0, 0.0, 5.0), (1.0, 0.0, 0.0, 0.0)
    options = lens | options
    return Camera(model, body, position, quat, width=width, height=height, lights=lights, **options)


def _pixel(x, y, z=0.0, width=80, height=60):
    scale = width / (5.0 - z)
    return int(height / 2 - y * scale), int(width / 2 + x * scale)


def test_light_differs_by_world_in_one_batch(model):
    """One render shows a dome without shadow, and two suns whose shadows fall to opposite sides."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    lights.set(1, _light((1, 0, -2)))
    lights.set(2, _light((-1, 0, -2), color=(0.85, 0.65, 0.65)))
    image = _camera(model, lights).render(model.state()).numpy().astype(int)
    # The box hangs 0.8 to 1.2 m above the floor: light that travels along +x throws its shadow to 0.2 < x < 0.8.
    shadow, open_floor = _pixel(0.55, 0.0), _pixel(0.4, 1.2)
    dome, right, left = (image[w] for w in range(WORLDS))
    assert abs(dome[shadow] - dome[open_floor]).max() <= 2
    assert right[shadow].sum() < 0.75 * right[open_floor].sum()
    assert left[shadow].sum() > 0.95 * left[open_floor].sum()
    # Likewise beside the ball that lies at x = -1.
    assert right[_pixel(-0.6, 0.0)].sum() < 0.75 * right[open_floor].sum()
    assert left[open_floor][0] > left[open_floor][1]


def test_texture_and_colour_arrive(model):
    """The carpet shows its eight stripes, the box is red, the ball blue."""
    image = _camera(model, WorldLights.allocate(WORLDS, "cpu"), 320, 240).render(model.state()).numpy()[0].astype(int)
    row, left = _pixel(0.72, 0.2, width=320, height=240)
    _, right = _pixel(1.68, 0.2, width=320, height=240)
    bright = image[row, left:right].mean(-1) > 120
    assert np.abs(np.diff(bright.astype(int))).sum() >= 6
    red, blue = (
        image[_pixel(0, 0, 1.2, 320, 240)],
        image[_pixel(-1, 0, 0.6, 320, 240)],
    )
    assert red[0] > 1.5 * red[2]
    assert blue[2] > 1.5 * blue[0]


def test_mask_leaves_other_worlds_alone(model):
    """Only the worlds asked for are drawn; torch tensors and arrays are accepted as masks."""
    import torch

    lights = WorldLights.allocate(WORLDS, "cpu")
    camera = _camera(model, lights)
    before = camera.render(model.state()).numpy().copy()
    for world in range(WORLDS):
        lights.set(world, None, dome_intensity=1000.0)
    for mask in (np.array([False, True, False]), torch.tensor([False, True, False])):
        after = camera.render(model.state(), mask).numpy()
        assert (after[0] == before[0]).all()
        assert (after[2] == before[2]).all()
        assert after[1].mean() < before[1].mean() - 20


def test_camera_rides_its_body(model):
    """A camera fixed to a body moves with it, each in its own world."""
    body = np.arange(WORLDS) * (model.body_count // WORLDS)
    state = model.state()
    poses = state.body_q.numpy()
    poses[body[1], 2] = 3.0
    state.body_q.assign(poses)
    lights = WorldLights.allocate(WORLDS, "cpu")
    camera = Camera(
        model, body, (0, 0, 1), (1, 0, 0, 0), width=16, height=16, focal_length=1, horizontal_aperture=1, lights=lights
    )
    camera.render(state)
    np.testing.assert_allclose(camera.poses.numpy()[:, 2], [2.0, 4.0, 2.0], atol=1e-6)


def test_pad_keeps_the_sensor_aspect(model):
    """`pad` puts the 4:3 picture in the middle of a square with black above and below."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    square = _camera(model, lights, 64, 64, fit="pad").render(model.state()).numpy()[0]
    plain = _camera(model, lights, 64, 48).render(model.state()).numpy()[0]
    assert (square[:8] == 0).all()
    assert (square[-8:] == 0).all()
    assert (square[8:-8] == plain).all()
    assert CameraConfig().fit == "pad"


def test_samples_smooth_edges(model):
    """Several rays per pixel keep the picture's brightness and add shades between box and floor."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    hard = _camera(model, lights).render(model.state()).numpy()[0].astype(float)
    soft = _camera(model, lights, samples=3).render(model.state()).numpy()[0].astype(float)
    fine = _camera(model, lights, 240, 180).render(model.state()).numpy()[0].reshape(60, 3, 80, 3, 3).mean(axis=(1, 3))
    assert abs(fine - soft).max() <= 1
    assert abs(hard.mean() - soft.mean()) < 2
    assert len(np.unique(soft.reshape(-1, 3), axis=0)) > len(np.unique(hard.reshape(-1, 3), axis=0))


def test_threads_draw_the_same_bits(model, monkeypatch):
    """Several threads draw what one draws, under a dome and a sun; few pixels are drawn by one."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    lights.set(1, _light((1, 0, -2)))
    used = []
    divided = launching.ThreadPoolExecutor
    monkeypatch.setattr(launching, "ThreadPoolExecutor", lambda threads: used.append(threads) or divided(threads))
    with torch_threads(3):
        alone = _camera(model, lights).render(model.state()).numpy().copy()
        assert not used
        monkeypatch.setattr(devices, "ALONE", 0)
        shared = _camera(model, lights).render(model.state()).numpy()
    assert used == [3, 3, 3]
    assert (shared == alone).all()


def test_drawing_agrees_with_ray_tracing(model):
    """The CPU draws what Newton's ray tracer sees: albedo, normal and depth, but for silhouettes."""
    camera = _camera(model, WorldLights.allocate(WORLDS, "cpu"), 160, 120)
    surfaces = (camera.buffers.depth, camera.buffers.normals, camera.buffers.albedo)
    camera.render(model.state())
    drawn = [a.numpy().copy() for a in surfaces]
    camera.trace(model.state())
    traced = [a.numpy() for a in surfaces]
    # Tessellated round shapes lie up to 1 % of their radius inside the exact ones.
    assert (np.abs(drawn[0] - traced[0]) > 1e-2).mean() < 0.003
    assert (np.abs(drawn[1] - traced[1]).max(-1) > 0.05).mean() < 0.01
    albedo = [a.view(np.uint8).reshape(*a.shape, 4)[..., :3].astype(int) for a in (drawn[2], traced[2])]
    assert (np.abs(albedo[0] - albedo[1]).max(-1) > 2).mean() < 0.01


def _difference(camera, state):
    """Fraction of pixels that shadow maps show otherwise than shadow rays, by more than a twentieth of the range."""
    mapped = camera.render(state).numpy().astype(int)
    camera.trace_shadows = True
    traced = camera.render(state).numpy().astype(int)
    camera.trace_shadows = False
    return (np.abs(mapped - traced).max(-1) > 13).mean()


def test_shadow_maps_agree_with_shadow_rays(model):
    """Maps shade at most 3 % of the pixels otherwise than rays, whichever way the light falls; no map shades more."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    for world, direction in enumerate(((1, 0, -2), (-0.3, 0.35, -1), (0.1, -1, -0.6))):
        lights.set(world, _light(direction))
    camera = _camera(model, lights, 160, 120)
    assert _difference(camera, model.state()) < 0.03
    shadowed = camera.render(model.state()).numpy().astype(int)
    # The measure sees shadows at all: without any, far more pixels differ.
    lights.set(0, None)
    lights.set(1, None)
    lights.set(2, None)
    assert (np.abs(camera.render(model.state()).numpy().astype(int) - shadowed).max(-1) > 13).mean() > 0.1


def test_shadow_touches_its_thrower(model):
    """A shadow starts where a ball touches the floor, and the lit floor before the ball is clean."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    lights.set(0, _light((1, 0, -1)))
    image = _camera(model, lights, 320, 240).render(model.state()).numpy()[0].astype(int).sum(-1)
    # Seen from above, the ball at x = -1 hides the floor up to its radius of 0.3 m; its shadow reaches beyond.
    row, start = _pixel(-0.66, 0.0, width=320, height=240)
    _, end = _pixel(-0.3, 0.0, width=320, height=240)
    open_floor = image[_pixel(-1.6, 0.6, width=320, height=240)]
    assert (image[row, start:end] < 0.75 * open_floor).all()
    _, before = _pixel(-1.8, 0.0, width=320, height=240)
    _, contact = _pixel(-1.42, 0.0, width=320, height=240)
    assert (abs(image[row, before:contact] - open_floor) <= 3).all()


def test_worlds_beyond_the_memory_of_the_maps_come_in_parts(model, monkeypatch):
    """The picture does not depend on how many worlds' maps fit the memory."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    for world in range(WORLDS):
        lights.set(world, _light((1 - world, 0.2, -2)))
    whole = _camera(model, lights).render(model.state()).numpy().copy()
    monkeypatch.setattr("arena_newton.pictures.camera.SHADOW_BYTES", 1)
    camera = _camera(model, lights)
    parts = camera.render(model.state()).numpy()
    assert camera._shadows.frames.shape == (1,)
    assert (parts == whole).all()


def test_stage_light_is_the_base_light():
    """The base light is the stage's: a dome, or a distant light along its local −z."""
    stage = Usd.Stage.CreateInMemory()
    dome = UsdLux.DomeLight.Define(stage, "/World/Light")
    dome.CreateIntensityAttr(1200.0)
    dome.CreateColorAttr(Gf.Vec3f(0.5, 0.5, 1.0))
    lights = WorldLights.allocate(2, "cpu", stage)
    lights.upload()
    np.testing.assert_allclose(lights.radiance.numpy()[1], [600, 600, 1200])
    assert (lights.distant.numpy() == 0).all()

    stage = Usd.Stage.CreateInMemory()
    sun = UsdLux.DistantLight.Define(stage, "/World/Light")
    sun.CreateIntensityAttr(5000.0)
    UsdGeom.Xformable(sun.GetPrim()).AddRotateXOp().Set(90.0)
    lights = WorldLights.allocate(1, "cpu", stage)
    lights.upload()
    assert lights.distant.numpy()[0] == 1
    np.testing.assert_allclose(lights.direction.numpy()[0], [0, 1, 0], atol=1e-6)


def test_bad_input_is_named(model):
    """Wrong sizes, fits, lights and light directions are answered with one clear line."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    with pytest.raises(InputError, match="positive"):
        _camera(model, lights, width=0)
    with pytest.raises(InputError, match="native or pad"):
        _camera(model, lights, fit="stretch")
    with pytest.raises(InputError, match="lights of 1 worlds"):
        _camera(model, WorldLights.allocate(1, "cpu"))
    with pytest.raises(InputError, match="direction"):
        lights.set(0, SimpleNamespace(direction=(0, 0, 0), intensity=1.0, color=(1, 1, 1)))


def test_the_last_render_under_other_lights(model):
    """`relit` shows what a render under these lights would, of the worlds asked for; the picture stays."""
    lights, others = WorldLights.allocate(WORLDS, "cpu"), WorldLights.allocate(WORLDS, "cpu")
    others.set(0, _light((1, 0, -2)))
    others.set(2, None, dome_intensity=900.0)
    camera = _camera(model, lights)
    before = camera.render(model.state()).numpy().copy()
    found = camera.relit(others, np.array([True, False, True])).numpy()
    assert np.array_equal(camera.image.numpy(), before)
    wanted = _camera(model, others).render(model.state()).numpy()
    assert np.array_equal(found[[0, 2]], wanted[[0, 2]]) and not found[1].any()
    assert np.array_equal(camera.render(model.state()).numpy(), before)


def test_each_pixel_names_its_shape(model):
    """A pixel names what it shows: the box of its own world in the middle, no shape above the horizon."""
    lights = WorldLights.allocate(WORLDS, "cpu")
    camera = _camera(model, lights)
    camera.render(model.state())
    shapes = camera.shapes()
    assert shapes.shape == (WORLDS, 60, 80)
    types, worlds = model.shape_type.numpy(), model.shape_world.numpy()
    middle = shapes[:, 30, 40].tolist()
    assert [types[shape] for shape in middle] == [int(newton.GeoType.BOX)] * WORLDS
    assert [worlds[shape] for shape in middle] == list(range(WORLDS))
    level = Camera(
        model,
        np.full(WORLDS, -1),
        (0.0, 0.0, 30.0),
        (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
        width=8,
        height=8,
        focal_length=7.6,
        horizontal_aperture=7.6,
        lights=lights,
    )
    level.render(model.state())
    assert (level.shapes()[:, :3] == -1).all() and (level.shapes()[:, -1] >= 0).all()
