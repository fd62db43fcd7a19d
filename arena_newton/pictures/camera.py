"""Ego, wrist and world cameras: all worlds in one batch, one light per world.

Newton's `SensorCamera` has lights that are global to the sensor, so `lighting` (these are in `kernels.pictures`) shades
albedo, normal and depth per world (formula and exposure are documented there). `raster` draws those three from
triangles: on the football scene 3 times faster than the sensor's ray tracer on one CPU core, 5 times on an H200.
`shadow` draws the same triangles along each distant light for its shadows: 5 ms for 1024 worlds on an H200, where rays
took 62.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import newton
import numpy as np
import torch
import warp as wp
from newton._src.geometry.raycast import ray_intersect_shape_no_normal
from newton.sensors import SensorCamera
from pxr import Gf, Usd, UsdGeom, UsdLux

from arena_newton.errors import InputError
from arena_newton.kernels.pictures.lighting import display_curve, launch_camera_poses, launch_shade
from arena_newton.kernels.pictures.raster import launch_rasterize
from arena_newton.kernels.pictures.shadow import MAPPED, Occluders, ShadowMaps, launch_shadow_maps, traced
from arena_newton.physics.devices import drawing_threads
from arena_newton.pictures.settings import DOME_COLOR, DOME_INTENSITY, CameraConfig, Fit
from arena_newton.pictures.triangles import srgb_to_linear, triangles

if TYPE_CHECKING:
    from arena_newton.physics.scene import Scene
    from arena_newton.tasks import LightDraw

__all__ = ["CAMERA_PRIMS", "Buffers", "Camera", "CameraConfig", "WorldLights"]

CAMERA_PRIMS = {
    "ego": "front_cam",
    "left_wrist": "left_wrist_cam",
    "right_wrist": "right_wrist_cam",
    "world": "/World/WorldCamera",
}
"""Camera name → prim (a path, or a name under the robot)."""
LIGHT_PRIM = "/World/Light"
SHADOW_BYTES = 2 << 30
"""Memory of a camera's shadow maps; more worlds than fit are drawn in several parts [B]."""


class WorldLights:
    """One light per world: a uniform dome, or a distant light with shadows."""

    def __init__(self, worlds: int, device: wp.DeviceLike, stage: Usd.Stage | None = None):
        """See `allocate`."""
        self.worlds = worlds
        self.device = wp.get_device(device)
        with wp.ScopedDevice(self.device):
            self.distant = wp.zeros(worlds, dtype=wp.int32)
            """1 for a distant light, 0 for a dome, shape [worlds]."""
            self.direction = wp.zeros(worlds, dtype=wp.vec3)
            """Unit vector from the light to the scene, shape [worlds]."""
            self.radiance = wp.zeros(worlds, dtype=wp.vec3)
            """Intensity times colour, linear RGB, shape [worlds]."""
        self._host = {
            "distant": np.zeros(worlds, dtype=np.int32),
            "direction": np.tile(np.array([0, 0, -1], dtype=np.float32), (worlds, 1)),
            "radiance": np.zeros((worlds, 3), dtype=np.float32),
        }
        self._base = _stage_light(stage)
        for world in range(worlds):
            self.set(world, None)

    @classmethod
    def allocate(cls, worlds: int, device: wp.DeviceLike, stage: Usd.Stage | None = None) -> WorldLights:
        """Lights of a batch, all set to the base light.

        Args:
            worlds: Number of worlds.
            device: Warp device, the one of the model.
            stage: USD stage whose `/World/Light` is the base light; without one, the original's dome.
        """
        return cls(worlds, device, stage)

    def set(
        self,
        world: int,
        light: LightDraw | None,
        dome_intensity: float | None = None,
        dome_color: Sequence[float] | None = None,
    ) -> None:
        """Set the light of one world, from the next render on.

        Args:
            world: World index.
            light: A distant light (`direction` from the light to the scene, `intensity`, `color`), or None for the base
                light.
            dome_intensity: With `light` None: a dome of this intensity instead of the base light.
            dome_color: With `light` None: a dome of this colour, linear RGB.
        """
        direction: Sequence[float] | None
        color: Sequence[float]
        if light is not None:
            direction, intensity, color = light.direction, light.intensity, light.color
        elif dome_intensity is None and dome_color is None:
            direction, intensity, color = self._base
        else:
            direction = None
            intensity = DOME_INTENSITY if dome_intensity is None else dome_intensity
            color = DOME_COLOR if dome_color is None else dome_color
        host = self._host
        host["distant"][world] = direction is not None
        if direction is not None:
            vector = np.asarray(direction, dtype=np.float64)
            length = np.linalg.norm(vector)
            if vector.shape != (3,) or not np.isfinite(length) or length == 0.0:
                raise InputError(f"light of world {world}: direction must be three finite numbers, got {direction}")
            host["direction"][world] = vector / length
        host["radiance"][world] = float(intensity) * np.asarray(color, dtype=np.float64)
        self._dirty = True

    @property
    def any_distant(self) -> bool:
        """True if any world has a distant light."""
        return bool(self._host["distant"].any())

    def upload(self) -> None:
        """Bring changes to the device (a render does it)."""
        if self._dirty:
            for name, values in self._host.items():
                getattr(self, name).assign(values)
            self._dirty = False


def _stage_light(stage: Usd.Stage | None) -> tuple[tuple[float, ...] | None, float, tuple[float, ...]]:
    """Direction (None for a dome), intensity and colour of the stage's `/World/Light`."""
    if stage is None or not stage.GetPrimAtPath(LIGHT_PRIM):
        return None, DOME_INTENSITY, DOME_COLOR
    prim = stage.GetPrimAtPath(LIGHT_PRIM)
    light = UsdLux.LightAPI(prim)
    intensity = float(light.GetIntensityAttr().Get()) * 2.0 ** float(light.GetExposureAttr().Get())
    color = tuple(float(c) for c in light.GetColorAttr().Get())
    if not prim.IsA(UsdLux.DistantLight):
        return None, intensity, color
    # A distant light shines along its local −z (UsdLux).
    pose = UsdGeom.XformCache().GetLocalToWorldTransform(prim)
    return tuple(pose.TransformDir(Gf.Vec3d(0, 0, -1)).GetNormalized()), intensity, color


class _Tracer:
    """Resources that the cameras of one model share: triangles and textures, and Newton's ray tracer for comparison."""

    _of_model: ClassVar[weakref.WeakKeyDictionary[newton.Model, _Tracer]] = weakref.WeakKeyDictionary()

    def __init__(self, model: newton.Model):
        on_cuda = model.device.is_cuda
        self.sensor = SensorCamera(
            model,
            default_render_config=SensorCamera.RenderConfig(
                enable_textures=True,
                enable_particles=False,
                # Both sides of a mesh are drawn, as in USD; shading turns the normal to the viewer.
                enable_backface_culling=False,
                enable_ambient_lighting=False,
                # Neighbouring threads should meet the same shapes; the CPU walks one view after the other.
                render_order=SensorCamera.RenderOrder.TILED if on_cuda else SensorCamera.RenderOrder.VIEW_PRIORITY,
            ),
        )
        self.preserve = int(SensorCamera.WorldRenderFlag.DISABLE_PRESERVE)
        mesh_type = int(newton.GeoType.MESH)
        self.traced = traced(ray_intersect_shape_no_normal, mesh_type)
        mesh_like = (int(newton.GeoType.HFIELD), int(newton.GeoType.CONVEX_MESH))
        types = model.shape_type.numpy()
        self.occluders = Occluders()
        self.occluders.bvh = model.bvh_shapes.id
        self.occluders.group_roots = model.bvh_shapes_group_roots
        self.occluders.leaves = model.bvh_shape_enabled
        self.occluders.types = wp.array(
            np.where(np.isin(types, mesh_like), mesh_type, types), dtype=wp.int32, device=model.device
        )
        self.occluders.sizes = model.shape_scale
        self.occluders.transforms = model.bvh_shape_world_transforms
        self.occluders.meshes = model.shape_source_ptr
        self.decode = wp.array(srgb_to_linear(np.arange(256) / 255.0), dtype=wp.float32, device=model.device)
        self.curve = display_curve(model.device)
        self.soup, self.triangles, self.casters = triangles(model)

    @classmethod
    def of(cls, model: newton.Model) -> _Tracer:
        """The tracer of a model, made on first use."""
        if model.bvh_shapes is None:
            raise InputError("the scene has no visible shape to render")
        if model not in cls._of_model:
            cls._of_model[model] = cls(model)
        return cls._of_model[model]


@dataclass
class Buffers:
    """Buffers that a render fills before it shades, one row per view."""

    albedo: wp.array
    """sRGB packed as RGBA, uint32, shape [views, H, W]."""
    normals: wp.array
    """World-space normals, same shape."""
    depth: wp.array
    """Distance along the ray [m], 0 where it met nothing, same shape."""
    nearest: wp.array
    """Work space of the rasterizer, uint64, same shape."""


class Camera:
    """A camera in every world of a model; looks along its −z, +y up."""

    def __init__(
        self,
        model: newton.Model,
        body: np.ndarray,
        position: Sequence[float],
        quat: Sequence[float],
        *,
        width: int,
        height: int,
        focal_length: float,
        horizontal_aperture: float,
        lights: WorldLights,
        fit: Fit = "native",
        aspect: float = 4.0 / 3.0,
        samples: int = 1,
        views: int | None = None,
    ):
        """Allocate the pictures.

        Args:
            model: Newton model with N worlds.
            body: int [worlds], Newton body that carries the camera, −1 for a camera fixed in the world.
            position: Camera in the body's frame [m].
            quat: Camera in the body's frame, wxyz.
            width: Image width [px].
            height: Image height [px].
            focal_length: Focal length, in the unit of the aperture.
            horizontal_aperture: Width of the sensor; pixels are square.
            lights: The worlds' lights.
            fit: See `CameraConfig.fit`.
            aspect: Width over height of the sensor, for `fit="pad"`.
            samples: Rays per pixel along each axis.
            views: Pictures that one render draws; one per world by default. A camera with fewer takes less memory and
                is given the worlds to show at each render (`render_worlds`).

        Raises:
            InputError: A size that is not positive, or an unknown `fit`.
        """
        if min(width, height, samples) < 1:
            raise InputError(f"camera: width, height and samples must be positive, got {width}×{height}, {samples}")
        if fit not in ("native", "pad"):
            raise InputError(f"camera: fit {fit!r} unknown, choose native or pad")
        if min(focal_length, horizontal_aperture, aspect) <= 0.0:
            raise InputError("camera: focal length, aperture and aspect must be positive")
        if lights.worlds != model.world_count:
            raise InputError(f"camera: lights of {lights.worlds} worlds for a model of {model.world_count}")
        self.model, self.lights = model, lights
        self.width, self.height, self.samples = width, height, samples
        self.worlds, self.device = model.world_count, model.device
        self.views = self.worlds if views is None else views
        if not 1 <= self.views <= self.worlds:
            raise InputError(f"camera: {views} views of {self.worlds} worlds, choose 1 to {self.worlds}")
        inner_w, inner_h = width, height
        if fit == "pad":
            inner_w = min(width, max(1, round(height * aspect)))
            inner_h = min(height, max(1, round(width / aspect)))
        self._size = (inner_h, inner_w)
        self._origin = ((height - inner_h) // 2, (width - inner_w) // 2)
        self._tracer = _Tracer.of(model)
        w, h, sensor = inner_w * samples, inner_h * samples, self._tracer.sensor
        self._rays = SensorCamera.compute_camera_rays_pinhole(
            w,
            h,
            focal_length=focal_length,
            horizontal_aperture=horizontal_aperture,
            vertical_aperture=horizontal_aperture * h / w,
            device=self.device,
        )
        half = 0.5 * horizontal_aperture / focal_length
        self._tangents = (half, half * h / w)
        qw, qx, qy, qz = (float(v) for v in quat)
        self._local = wp.transform(wp.vec3(*(float(v) for v in position)), wp.normalize(wp.quat(qx, qy, qz, qw)))
        with wp.ScopedDevice(self.device):
            self._body_of_world = np.broadcast_to(np.asarray(body, dtype=np.int32), self.worlds)
            self._body = wp.array(self._body_of_world[: self.views], dtype=wp.int32)
            self._view_body = wp.zeros(self.views, dtype=wp.int32)
            self.poses = wp.zeros(self.views, dtype=wp.transform)
            """World pose of each camera at the last render [m], shape [views]."""
            self._view_world = wp.array(np.arange(self.views), dtype=wp.int32)
            self.buffers = Buffers(
                sensor.allocate_image_albedo(self.views, w, h),
                sensor.allocate_image_normal(self.views, w, h),
                sensor.allocate_image_depth(self.views, w, h),
                wp.zeros((self.views, h, w), dtype=wp.uint64),
            )
            """Surfaces of the last render, before shading."""
            self.image = wp.zeros((self.views, height, width, 3), dtype=wp.uint8)
            """The pictures of the last render, uint8 [views, height, width, 3]."""
        self._relit: wp.array | None = None
        # Two texels per pixel, and no more than a video needs.
        self._shadow_size = min(max(2 * max(w, h), 256), 1024)
        self._shadows: ShadowMaps | None = None
        self.trace_shadows = False
        """Shadows by ray instead of by map: exact and slow, the reference for the maps."""
        self._torch_image: torch.Tensor = wp.to_torch(self.image)
        self._torch_view_world = wp.to_torch(self._view_world)
        self._every = torch.arange(self.views, dtype=torch.int32, device=self._torch_image.device)

    @classmethod
    def from_scene(
        cls,
        scene: Scene,
        prim: str = "ego",
        width: int = 224,
        height: int = 224,
        lights: WorldLights | None = None,
        *,
        fit: Fit = "native",
        samples: int = 1,
        views: int | None = None,
    ) -> Camera:
        """A camera authored in the scene's stage: its lens, its pose and the body that carries it.

        Args:
            scene: The built scene.
            prim: `ego`, `left_wrist`, `right_wrist`, `world`, or the path of a camera prim.
            width: Image width [px].
            height: Image height [px].
            lights: The worlds' lights; by default the stage's light in every world.
            fit: See `CameraConfig.fit`.
            samples: Rays per pixel along each axis.
            views: Pictures that one render draws; one per world by default.

        Raises:
            InputError: The prim is missing or is not a camera.
        """
        name = CAMERA_PRIMS.get(prim, prim)
        frame = scene.frame(name)
        path = name if name.startswith("/") else _path_under_robot(scene.stage, name)
        lens = UsdGeom.Camera(scene.stage.GetPrimAtPath(path))
        if not lens:
            raise InputError(f"{scene.path}: prim {path} is not a Camera")
        focal, aperture = float(lens.GetFocalLengthAttr().Get()), float(lens.GetHorizontalApertureAttr().Get())
        vertical = float(lens.GetVerticalApertureAttr().Get())
        body = scene.body_to_newton[:, frame.body_id] if frame.body_id else np.full(scene.worlds, -1)
        return cls(
            scene.model,
            body,
            frame.pos,
            frame.quat,
            width=width,
            height=height,
            focal_length=focal,
            horizontal_aperture=aperture,
            lights=lights or WorldLights.allocate(scene.worlds, scene.device, scene.stage),
            fit=fit,
            aspect=aperture / vertical,
            samples=samples,
            views=views,
        )

    @classmethod
    def of_config(cls, scene: Scene, config: CameraConfig, lights: WorldLights) -> Camera:
        """A camera of the scene as a configuration has it; see `from_scene`."""
        size = config.width, config.height
        return cls.from_scene(scene, config.prim, *size, lights, fit=config.fit, samples=config.samples)

    def render(self, state: newton.State, mask: np.ndarray | torch.Tensor | wp.array | None = None) -> torch.Tensor:
        """Render the worlds of a mask; the pictures of the others stay as they were.

        Args:
            state: Newton state whose `body_q` holds the bodies' poses.
            mask: bool [worlds] (array or tensor); None renders all.

        Returns:
            uint8 [worlds, height, width, 3], on the model's device, that shares memory with `image` and is overwritten
            by the next render.

        Raises:
            InputError: The camera has fewer views than there are worlds.
        """
        if self.views != self.worlds:
            raise InputError(f"camera: {self.views} views of {self.worlds} worlds; name the worlds with render_worlds")
        if mask is None:
            self._torch_view_world.copy_(self._every)
        else:
            if isinstance(mask, wp.array):
                mask = mask.numpy()
            asked = torch.as_tensor(mask, device=self._every.device).bool()
            self._torch_view_world.copy_(torch.where(asked, self._every, self._tracer.preserve))
        return self._render(state, self._body)

    def render_worlds(
        self, state: newton.State, worlds: Sequence[int], poses: np.ndarray | None = None
    ) -> torch.Tensor:
        """Render chosen worlds, one after the other in the order given.

        Args:
            state: Newton state whose `body_q` holds the bodies' poses.
            worlds: World of each picture; at most `views`.
            poses: Pose of the camera in each of them instead of the one on its body: float32 [len(worlds), 7],
                position [m] and quaternion xyzw.

        Returns:
            uint8 [len(worlds), height, width, 3], on the model's device, overwritten by the next render.

        Raises:
            InputError: More worlds than views.
        """
        count = len(worlds)
        if count > self.views:
            raise InputError(f"camera: {count} worlds for {self.views} views")
        rows = np.asarray(worlds, dtype=np.int64)
        view_world = np.full(self.views, self._tracer.preserve, dtype=np.int32)
        view_world[:count] = rows
        self._view_world.assign(view_world)
        if poses is None:
            body = np.full(self.views, -1, dtype=np.int32)
            body[:count] = self._body_of_world[rows]
            self._view_body.assign(body)
            self._render(state, self._view_body)
        else:
            placed = np.zeros((self.views, 7), dtype=np.float32)
            placed[:, 6] = 1.0
            placed[:count] = poses
            self.poses.assign(placed)
            self._render(state, None)
        return self._torch_image[:count]

    def distance_picture(self) -> torch.Tensor:
        """Distance along the ray to what each pixel of the last render shows [m], 0 where it shows nothing.

        Returns:
            float32 [views, height, width] on the model's device; with several rays per pixel that of one of them.
        """
        return self.whole(wp.to_torch(self.buffers.depth))

    def whole(self, seen: torch.Tensor) -> torch.Tensor:
        """Values of the part that the lens fills, [views, H, W] with `samples` per pixel, as whole pictures, 0 around.

        Returns:
            [views, height, width], of one of the samples of each pixel.
        """
        seen = seen[:, :: self.samples, :: self.samples]
        if tuple(seen.shape[1:]) == (self.height, self.width):
            return seen
        whole = seen.new_zeros((self.views, self.height, self.width))
        top, left = self._origin
        whole[:, top : top + self._size[0], left : left + self._size[1]] = seen
        return whole

    def distances(self, view: int, points: np.ndarray) -> np.ndarray:
        """Distance to what the last render met in the direction of some points [m], 0 where it met nothing.

        Args:
            view: Which of the pictures.
            points: Points in the camera's frame, [n, 3]; of one outside the picture the nearest pixel counts.
        """
        height, width = self.buffers.depth.shape[1:]
        ahead = np.maximum(-points[:, 2], 1e-6)
        column = 0.5 * (1.0 + points[:, 0] / ahead / self._tangents[0]) * width
        row = 0.5 * (1.0 - points[:, 1] / ahead / self._tangents[1]) * height
        rows = torch.as_tensor(np.clip(row, 0, height - 1).astype(np.int64), device=self._every.device)
        columns = torch.as_tensor(np.clip(column, 0, width - 1).astype(np.int64), device=self._every.device)
        seen: np.ndarray = wp.to_torch(self.buffers.depth)[view, rows, columns].cpu().numpy()
        return seen

    def shapes(self) -> torch.Tensor:
        """Shape of the model that each pixel of the last render shows, −1 where it shows none.

        Returns:
            int64 [views, H, W] on the model's device, of the part of the picture that the lens fills (without the black
            bars of `fit="pad"`), with `samples` rows and columns per pixel.
        """
        # A key's lower half is the triangle (`kernels.pictures.raster`); 0 is a pixel that no triangle reached.
        keys = wp.to_torch(self.buffers.nearest.view(wp.int64))
        shapes: torch.Tensor = wp.to_torch(self._tracer.soup.shape)[keys & 0xFFFFFFFF].long()
        return torch.where(keys == 0, -1, shapes)

    def _render(self, state: newton.State, body: wp.array | None) -> torch.Tensor:
        """Draw the views; `body` carries each one's camera, None leaves `poses` as they are."""
        self.model.bvh_refit_shapes(state)
        if body is not None:
            launch_camera_poses(state.body_q, body, self._local, self.poses)
        self.draw()
        self._shade(self.lights, self.image)
        return self._torch_image

    def relit(self, lights: WorldLights, mask: np.ndarray) -> torch.Tensor:
        """The last render of the worlds of a mask under other lights; pictures of the others stay as they were.

        Args:
            lights: A light per world.
            mask: bool [worlds], worlds that the last `render` drew.

        Returns:
            uint8 [worlds, height, width, 3], on the model's device, overwritten by the next call.
        """
        if self._relit is None:
            self._relit = wp.zeros_like(self.image)
        asked = torch.as_tensor(mask, device=self._every.device)
        self._torch_view_world.copy_(torch.where(asked, self._every, self._tracer.preserve))
        self._shade(lights, self._relit)
        picture: torch.Tensor = wp.to_torch(self._relit)
        return picture

    def _shade(self, lights: WorldLights, image: wp.array) -> None:
        """Shade what was drawn into pictures."""
        tracer, buffers = self._tracer, self.buffers
        lights.upload()
        maps = self._shadow_maps(lights)
        part = maps.frames.shape[0] or self.views
        for first in range(0, self.views, part):
            if lights.any_distant and not self.trace_shadows:
                launch_shadow_maps(
                    first=first,
                    view_world=self._view_world,
                    poses=self.poses,
                    rays=self._rays,
                    normals=buffers.normals,
                    depth=buffers.depth,
                    soup=tracer.soup,
                    casters=tracer.casters,
                    distant=lights.distant,
                    direction=lights.direction,
                    maps=maps,
                )
            launch_shade(
                tracer.traced if self.trace_shadows else MAPPED,
                tracer.occluders if self.trace_shadows else maps,
                views=(first, min(part, self.views - first)),
                view_world=self._view_world,
                poses=self.poses,
                rays=self._rays,
                albedo=buffers.albedo,
                normals=buffers.normals,
                depth=buffers.depth,
                decode=tracer.decode,
                curve=tracer.curve,
                distant=lights.distant,
                direction=lights.direction,
                light=lights.radiance,
                samples=self.samples,
                size=self._size,
                origin=self._origin,
                image=image,
                threads=drawing_threads(buffers.depth.size),
            )

    def _shadow_maps(self, lights: WorldLights) -> ShadowMaps:
        """The maps, without memory as long as no world has needed any."""
        wanted = lights.any_distant and not self.trace_shadows
        if self._shadows is None or (wanted and not self._shadows.frames.shape[0]):
            size = self._shadow_size
            count = min(self.views, max(1, SHADOW_BYTES // (8 * size * size))) if wanted else 0
            self._shadows = ShadowMaps()
            with wp.ScopedDevice(self.device):
                self._shadows.frames = wp.zeros(count, dtype=wp.transform)
                self._shadows.window = wp.zeros((2 * count, 4), dtype=wp.float32)
                self._shadows.depth = wp.zeros((2 * count, size, size), dtype=wp.uint32)
        return self._shadows

    def trace(self, state: newton.State) -> None:
        """Fill `buffers` by Newton's ray tracer: exact round shapes, slower; the reference for `draw`."""
        self._tracer.sensor.update(
            state,
            self.poses,
            self._rays,
            albedo_image=self.buffers.albedo,
            normal_image=self.buffers.normals,
            depth_image=self.buffers.depth,
            world_indices=self._view_world,
        )

    def draw(self) -> None:
        """Fill `buffers` by drawing triangles."""
        buffers = self.buffers
        launch_rasterize(
            view_world=self._view_world,
            poses=self.poses,
            rays=self._rays,
            soup=self._tracer.soup,
            tangents=self._tangents,
            triangles=self._tracer.triangles,
            nearest=buffers.nearest,
            albedo=buffers.albedo,
            normals=buffers.normals,
            depth=buffers.depth,
            threads=drawing_threads(buffers.depth.size),
        )


def _path_under_robot(stage: Usd.Stage, name: str) -> str:
    return next(str(p.GetPath()) for p in Usd.PrimRange(stage.GetPrimAtPath("/World/Robot")) if p.GetName() == name)
