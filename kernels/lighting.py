"""Camera poses and shading per world: Lambert under a uniform dome or a distant light with shadow rays.

Every world of a batch has its own light. A surface of linear albedo a, normal n (turned towards the viewer) and a
light of radiance L (intensity · colour) gives the linear radiance

    dome:     a · L · A(n)
    distant:  a · L · (AMBIENT · A(n) + DIRECT · max(n·l, 0) · v)

with A(n) = BOUNCE + (1 − BOUNCE) · (n_z + 1)/2, the light from above and what the floor gives back, l towards the light
and v = 0 in its shadow. A ray that leaves the scene shows L · SKY_DOME or L · SKY_DISTANT. The picture is
sRGB(1 − exp(−EXPOSURE · radiance)): a dome of intensity 3000 and colour 0.75 puts a mid grey (albedo 0.5) at 0.48 linear,
and no light of the visual mode (3000 to 7000, colour 0.65 to 0.85) clips a white wall.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

__all__ = ["Occluders", "launch_camera_poses", "launch_shade"]

EXPOSURE = wp.constant(wp.float32(1.0 / 1700.0))
"""Scale from light intensity units to the tone curve; puts the original's dome (3000 · 0.75) at 1.32."""
BOUNCE = wp.constant(wp.float32(0.45))
"""Share of the dome's light that a surface facing straight down receives from the floor."""
AMBIENT = wp.constant(wp.float32(0.2))
"""Ambient share of a distant light, so that shadows keep their texture."""
DIRECT = wp.constant(wp.float32(0.5))
"""Direct share of a distant light: with AMBIENT, intensity 5000 from above looks as bright as the dome of 3000."""
SKY_DOME = wp.constant(wp.float32(2.0))
"""Brightness of the background under the dome: nearly white, as at the original's horizon."""
SKY_DISTANT = wp.constant(wp.float32(0.2))
"""Brightness of the background under a distant light: a darker grey."""
SHADOW_BIAS = wp.constant(wp.float32(1.0e-3))
"""Start of a shadow ray above its surface [m]."""
SHADOW_RANGE = wp.constant(wp.float32(100.0))
"""Length of a shadow ray [m]."""


@wp.struct
class Occluders:
    """What a shadow ray can hit: the shapes of the model and their BVH, grouped by world."""

    bvh: wp.uint64
    group_roots: wp.array[wp.int32]
    """Root node of each world's group, then of the shapes that belong to no world (−1: none), shape [worlds + 1]."""
    leaves: wp.array[wp.uint32]
    """Shape of each BVH leaf."""
    types: wp.array[wp.int32]
    sizes: wp.array[wp.vec3]
    """Size or mesh scale of each shape [m]."""
    transforms: wp.array[wp.transform]
    """World pose of each shape [m]."""
    meshes: wp.array[wp.uint64]
    """Warp mesh of each shape, 0 for primitives."""


@wp.kernel(enable_backward=False)
def _camera_poses(
    body_q: wp.array[wp.transform], body: wp.array[wp.int32], local: wp.transform, poses: wp.array[wp.transform]
):
    world = wp.tid()
    pose = local
    if body[world] >= 0:
        pose = body_q[body[world]] * local
    poses[world] = pose


def launch_camera_poses(body_q: wp.array, body: wp.array, local: wp.transform, poses: wp.array) -> None:
    """World pose of each world's camera: pose of its body (index −1: none) times the camera's pose in that body.

    Args:
        body_q: Newton body poses [m].
        body: int32 [worlds], Newton body that carries the camera.
        local: Camera in the body's frame.
        poses: Out, shape [worlds].
    """
    wp.launch(_camera_poses, dim=poses.shape[0], inputs=[body_q, body, local], outputs=[poses], device=poses.device)


@wp.func
def _radiance(
    albedo: wp.vec3, normal: wp.vec3, distant: wp.int32, to_light: wp.vec3, light: wp.vec3, visible: wp.float32
) -> wp.vec3:
    """Linear radiance of a surface; see the module's formula."""
    ambient = BOUNCE + (1.0 - BOUNCE) * 0.5 * (normal[2] + 1.0)
    share = ambient
    if distant != 0:
        share = AMBIENT * ambient + DIRECT * wp.max(wp.dot(normal, to_light), 0.0) * visible
    return wp.cw_mul(albedo, light) * share


@wp.func
def _display(radiance: wp.float32) -> wp.float32:
    """Tone curve and sRGB encoding (IEC 61966-2-1) to [0, 1]."""
    y = 1.0 - wp.exp(-EXPOSURE * radiance)
    if y <= 0.0031308:
        return 12.92 * y
    return 1.055 * wp.pow(y, 1.0 / 2.4) - 0.055


@wp.func
def _byte(value: wp.float32) -> wp.uint8:
    return wp.uint8(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5)


@wp.func
def _channel(packed: wp.uint32, shift: wp.uint32, decode: wp.array[wp.float32]) -> wp.float32:
    return decode[wp.int32((packed >> shift) & wp.uint32(0xFF))]


@cache
def _shade_kernel(ray_primitive: Callable[..., Any], mesh_type: int) -> wp.Kernel:
    """The shading kernel with a model library's ray–primitive test built in."""

    @wp.func
    def occluded(scene: Occluders, world: wp.int32, origin: wp.vec3, direction: wp.vec3) -> wp.bool:
        for group in range(int(2)):  # noqa: UP018  (int() keeps Warp from unrolling the loop)
            root = scene.group_roots[world]
            if group == 1:
                root = scene.group_roots[scene.group_roots.shape[0] - 1]
            if root < 0:
                continue
            query = wp.bvh_query_ray(scene.bvh, origin, direction, root)
            leaf = wp.int32(0)
            while wp.bvh_query_next(query, leaf, SHADOW_RANGE):
                shape = wp.int32(scene.leaves[leaf])
                if scene.types[shape] == wp.static(mesh_type):
                    if scene.meshes[shape] != wp.uint64(0):
                        inverse = wp.transform_inverse(scene.transforms[shape])
                        scale = scene.sizes[shape]
                        start = wp.cw_div(wp.transform_point(inverse, origin), scale)
                        along = wp.cw_div(wp.transform_vector(inverse, direction), scale)
                        if wp.mesh_query_ray_anyhit(scene.meshes[shape], start, along, SHADOW_RANGE, -1):
                            return True
                else:
                    distance, _normal = ray_primitive(
                        scene.transforms[shape], scene.sizes[shape], scene.types[shape], origin, direction, False
                    )
                    if distance >= 0.0 and distance < SHADOW_RANGE:
                        return True
        return False

    @wp.kernel(enable_backward=False, module="unique")
    def shade(
        view_world: wp.array[wp.int32],
        poses: wp.array[wp.transform],
        rays: wp.array4d[wp.vec3],
        albedo: wp.array3d[wp.uint32],
        normals: wp.array3d[wp.vec3],
        depth: wp.array3d[wp.float32],
        decode: wp.array[wp.float32],
        scene: Occluders,
        distant: wp.array[wp.int32],
        direction: wp.array[wp.vec3],
        light: wp.array[wp.vec3],
        samples: wp.int32,
        top: wp.int32,
        left: wp.int32,
        image: wp.array4d[wp.uint8],
    ):
        view, row, column = wp.tid()
        world = view_world[view]
        if world < 0:
            return
        mode = distant[world]
        to_light = -direction[world]
        radiant = light[world]
        total = wp.vec3(0.0)
        for k in range(samples * samples):
            y = row * samples + k // samples
            x = column * samples + k % samples
            t = depth[view, y, x]
            seen = radiant * wp.where(mode != 0, SKY_DISTANT, SKY_DOME)
            if t > 0.0:
                along = wp.transform_vector(poses[view], rays[y, x, 0, 1])
                normal = normals[view, y, x]
                if wp.dot(normal, along) > 0.0:
                    normal = -normal
                visible = wp.float32(1.0)
                if mode != 0 and wp.dot(normal, to_light) > 0.0:
                    start = wp.transform_point(poses[view], rays[y, x, 0, 0]) + along * t + normal * SHADOW_BIAS
                    if occluded(scene, world, start, to_light):
                        visible = 0.0
                packed = albedo[view, y, x]
                colour = wp.vec3(
                    _channel(packed, wp.uint32(0), decode),
                    _channel(packed, wp.uint32(8), decode),
                    _channel(packed, wp.uint32(16), decode),
                )
                seen = _radiance(colour, normal, mode, to_light, radiant, visible)
            total += wp.vec3(_display(seen[0]), _display(seen[1]), _display(seen[2]))
        total = total / wp.float32(samples * samples)
        for c in range(3):
            image[view, row + top, column + left, c] = _byte(total[c])

    return shade


def launch_shade(
    ray_primitive: Callable[..., Any],
    mesh_type: int,
    *,
    view_world: wp.array,
    poses: wp.array,
    rays: wp.array,
    albedo: wp.array,
    normals: wp.array,
    depth: wp.array,
    decode: wp.array,
    scene: Occluders,
    distant: wp.array,
    direction: wp.array,
    light: wp.array,
    samples: int,
    size: tuple[int, int],
    origin: tuple[int, int],
    image: wp.array,
) -> None:
    """Shade the surfaces that each view's rays met; only worlds with a distant light cast shadow rays.

    Args:
        ray_primitive: Warp function (pose, size, type, origin, direction, cull) → (distance or −1, normal).
        mesh_type: Value of `Occluders.types` that means a triangle mesh.
        view_world: int32 [views], world of each view, negative to leave its picture as it is.
        poses: Camera poses [m], shape [views].
        rays: Camera-space origin and direction, shape [H·samples, W·samples, 1, 2].
        albedo: sRGB albedo packed as RGBA, uint32 [views, H·samples, W·samples].
        normals: World-space normals, same shape.
        depth: Distance along the ray [m], 0 where it met nothing, same shape.
        decode: Linear value of each sRGB byte, float32 [256].
        scene: What casts shadows.
        distant: int32 [worlds], 1 for a distant light, 0 for a dome.
        direction: Unit vector from the light to the scene, shape [worlds].
        light: Intensity times colour, shape [worlds].
        samples: Rays per pixel along each axis.
        size: Height and width of the shaded part [px].
        origin: Row and column of its first pixel in `image` [px].
        image: Out, uint8 [views, rows, columns, 3].
    """
    wp.launch(
        _shade_kernel(ray_primitive, mesh_type),
        dim=(poses.shape[0], *size),
        inputs=[
            view_world,
            poses,
            rays,
            albedo,
            normals,
            depth,
            decode,
            scene,
            distant,
            direction,
            light,
            samples,
            *origin,
        ],
        outputs=[image],
        device=image.device,
    )
