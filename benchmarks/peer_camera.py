"""``peers --what camera``: the head camera's colour pictures beside those of Newton's own `SensorCamera`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import newton
import warp as wp
from newton.sensors import SensorCamera
from pxr import Usd, UsdGeom

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.timing import BenchFigure, seconds_of
from arena_newton.pictures.camera import CAMERA_PRIMS, Camera
from arena_newton.pictures.settings import CameraConfig
from arena_newton.tasks.base import LightDraw
from benchmarks.bench_options import PeerOptions
from benchmarks.peer_pairs import Pair, on_cpu

__all__ = ["NewtonPictures", "camera_figures"]

PAIR = Pair("camera", 1.0, "pictures/s", ("newton", "warp-lang"))
CPU_WORLDS = 2
"""Worlds without CUDA, where the bar is not judged."""
SCENE = "football"
"""Task whose scene is drawn: a room, a ball and the robot's own hands."""
LIGHT = LightDraw(direction=(-0.577, 0.577, -0.577), intensity=3000.0, color=(1.0, 1.0, 1.0))
"""Distant light of the pictures with shadows, along the direction of Newton's default light."""


class NewtonPictures:
    """Newton's sensor at the head camera's poses, with its lens and as many pixels."""

    def __init__(self, model: newton.Model, camera: Camera, lens: UsdGeom.Camera, shadows: bool):
        """Allocate the pictures.

        Args:
            model: The scene of both.
            camera: Ours; its poses are taken from its last render.
            lens: The head camera's prim.
            shadows: Newton's default light, with shadows, instead of ambient light.
        """
        self.model, self.camera = model, camera
        config = SensorCamera.RenderConfig(
            enable_textures=True,
            enable_particles=False,
            # As our own camera uses it: the order that is fast on this device.
            render_order=SensorCamera.RenderOrder.TILED
            if model.device.is_cuda
            else SensorCamera.RenderOrder.VIEW_PRIORITY,
            enable_shadows=shadows,
            enable_ambient_lighting=not shadows,
        )
        self.sensor = SensorCamera(model, default_render_config=config)
        if shadows:
            self.sensor.create_default_light(enable_shadows=True)
        aperture = float(lens.GetHorizontalApertureAttr().Get())
        self.rays = SensorCamera.compute_camera_rays_pinhole(
            camera.width,
            camera.height,
            focal_length=float(lens.GetFocalLengthAttr().Get()),
            horizontal_aperture=aperture,
            vertical_aperture=aperture * camera.height / camera.width,
            device=model.device,
        )
        self.image = self.sensor.allocate_image_color(camera.views, camera.width, camera.height)
        """RGBA, one uint32 a pixel, shape [views, height, width]."""

    def render(self, state: newton.State) -> None:
        """Draw all worlds; shapes have moved since the last picture, as our camera assumes too."""
        self.model.bvh_refit_shapes(state)
        self.sensor.update(state, self.camera.poses, self.rays, color_image=self.image)


def camera_figures(options: PeerOptions) -> Iterator[BenchFigure]:
    """Pictures per second, without shadows and with those of one distant light."""
    cuda = bool(wp.is_cuda_available())
    worlds, size = options.camera_worlds if cuda else CPU_WORLDS, options.size
    env = ArenaEnv(
        SCENE,
        worlds=worlds,
        tracker=trackers.get("pd"),
        engine="warp" if cuda else "mujoco",
        device="cuda:0" if cuda else "cpu",
        # The whole picture is drawn by both: no bars.
        camera=CameraConfig(width=size, height=size, fit="native"),
    )
    camera = env.camera
    assert camera is not None
    try:
        env.reset(list(range(worlds)))
        state = env.scene.model.state()
        env.physics.write_newton_state(state)
        lens = _lens(env.scene.stage)
        for shadows in (False, True):
            for world in range(worlds):
                camera.lights.set(world, LIGHT if shadows else None)
            camera.render(state)  # the poses
            theirs = NewtonPictures(env.scene.model, camera, lens, shadows)
            ours, peer = partial(camera.render, state), partial(theirs.render, state)
            ours(), peer()  # kernels are compiled
            rounds = [(worlds / seconds_of(ours), worlds / seconds_of(peer)) for _ in range(options.rounds)]
            light = "one light's shadows" if shadows else "no shadows"
            label = f"head-camera pictures/s / Newton's SensorCamera, {worlds} worlds, {size}x{size}, {light}"
            yield PAIR.judge(options, label, rounds, unjudged=on_cpu(cuda))
    finally:
        env.close()


def _lens(stage: Usd.Stage) -> UsdGeom.Camera:
    """The head camera's prim."""
    robot = stage.GetPrimAtPath("/World/Robot")
    return UsdGeom.Camera(next(prim for prim in Usd.PrimRange(robot) if prim.GetName() == CAMERA_PRIMS["ego"]))
