"""Shadows of distant lights: depth maps per view, drawn along the light; or by ray, the measure of the maps.

Two maps cover what a view sees, one up to `SPLIT` from the camera, the other from there to `RANGE`. Their frame has its
origin at the camera, +z towards the light and +y along the view; a map's window in x and y is the extent of the lit
surfaces that a grid of the view's pixels shows in its part. Points outside the window count as lit. The look-up
weighs the four nearest texels bilinearly and compares each with the depth of the receiver's own tangent plane at that
texel, so that a slope needs no bias of its own.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from arena_newton.kernels.pictures.raster import EDGE, Soup, corner, soup_entry, span

__all__ = ["MAPPED", "Occluders", "ShadowMaps", "launch_shadow_maps", "traced"]

RANGE = wp.constant(wp.float32(16.0))
"""Largest distance from the camera at which a surface gets shadows [m]; the rooms of the benchmark are hardly
longer."""
SPLIT = wp.constant(wp.float32(2.5))
"""Distance from the camera at which the coarser map takes over [m]."""
PROBES = (112, 32)
"""Rows and columns of the grid of pixels that a window is fitted to: the far end of a floor is a low, wide strip."""
MARGIN = wp.constant(wp.float32(0.02))
"""Part of its extent by which a window is wider than the points of the grid, on each side."""
DEPTH_ORIGIN = wp.constant(wp.float32(256.0))
"""Added to a depth, which makes it positive: a caster counts up to this far behind the camera [m]."""
BIAS = wp.constant(wp.float32(3.0e-3))
"""Least height of a caster above the receiver's tangent plane, in addition to a fraction of a texel [m]."""
TEXEL_BIAS = wp.constant(wp.float32(0.35))
"""Fraction of a texel: smooth normals tilt the tangent planes of facets."""
STEEPEST = wp.constant(wp.float32(10.0))
"""Largest slope of a receiver's tangent plane; steeper ones get little light."""
LANES = (32, 4)
"""Threads that draw a large triangle on CUDA, along x and y: neighbours write neighbouring texels."""
RAY_BIAS = wp.constant(wp.float32(1.0e-3))
"""Start of a shadow ray above its surface [m]."""
RAY_LENGTH = wp.constant(wp.float32(100.0))
"""Length of a shadow ray [m]."""


@wp.struct
class ShadowMaps:
    """The maps of consecutive views: the near map of the first, its far map, the near map of the second and so on."""

    frames: wp.array[wp.transform]
    """Pose of each view's maps [m], shape [maps / 2]."""
    window: wp.array2d[wp.float32]
    """Least x, least y, −greatest x, −greatest y in the map's frame [m], shape [maps, 4]."""
    depth: wp.array3d[wp.uint32]
    """Bits of the greatest z + DEPTH_ORIGIN [m], 0 for nothing, shape [maps, size, size]."""


@wp.kernel(enable_backward=False)
def _aim(
    first: wp.int32,
    view_world: wp.array[wp.int32],
    poses: wp.array[wp.transform],
    distant: wp.array[wp.int32],
    direction: wp.array[wp.vec3],
    maps: ShadowMaps,
):
    number = wp.tid()
    world = view_world[first + number]
    if world < 0 or distant[world] == 0:
        return
    pose = poses[first + number]
    z = -direction[world]
    x = wp.cross(wp.transform_vector(pose, wp.vec3(0.0, 0.0, -1.0)), z)
    if wp.length(x) < 1.0e-3:
        x = wp.cross(wp.transform_vector(pose, wp.vec3(0.0, 1.0, 0.0)), z)
    x = wp.normalize(x)
    turn = wp.quat_from_matrix(wp.matrix_from_cols(x, wp.cross(z, x), z))
    maps.frames[number] = wp.transform(wp.transform_get_translation(pose), turn)
    for k in range(4):
        maps.window[2 * number, k] = 1.0e9
        maps.window[2 * number + 1, k] = 1.0e9


@wp.kernel(enable_backward=False)
def _fit(
    first: wp.int32,
    view_world: wp.array[wp.int32],
    poses: wp.array[wp.transform],
    rays: wp.array4d[wp.vec3],
    normals: wp.array3d[wp.vec3],
    depth: wp.array3d[wp.float32],
    distant: wp.array[wp.int32],
    direction: wp.array[wp.vec3],
    rows: wp.int32,
    columns: wp.int32,
    maps: ShadowMaps,
):
    number, row = wp.tid()
    view = first + number // 2
    world = view_world[view]
    if world < 0 or distant[world] == 0:
        return
    turn = wp.quat_inverse(wp.transform_get_rotation(maps.frames[number // 2])) * wp.transform_get_rotation(poses[view])
    y = row * (depth.shape[1] - 1) // (rows - 1)
    nearest = wp.where(number % 2 == 0, 0.0, SPLIT)
    furthest = wp.where(number % 2 == 0, SPLIT, RANGE)
    lower = wp.vec2(1.0e9, 1.0e9)
    upper = wp.vec2(-1.0e9, -1.0e9)
    for column in range(columns):
        x = column * (depth.shape[2] - 1) // (columns - 1)
        t = depth[view, y, x]
        if t > nearest and t <= furthest:
            ray = rays[y, x, 0, 1]
            normal = normals[view, y, x]
            away = wp.dot(normal, wp.transform_vector(poses[view], ray)) > 0.0
            if (wp.dot(normal, direction[world]) > 0.0) == away:
                point = wp.quat_rotate(turn, ray) * t
                lower = wp.min(lower, wp.vec2(point[0], point[1]))
                upper = wp.max(upper, wp.vec2(point[0], point[1]))
    if lower[0] <= upper[0]:
        wp.atomic_min(maps.window, number, 0, lower[0])
        wp.atomic_min(maps.window, number, 1, lower[1])
        wp.atomic_min(maps.window, number, 2, -upper[0])
        wp.atomic_min(maps.window, number, 3, -upper[1])


@wp.func
def _texels(maps: ShadowMaps, number: wp.int32) -> wp.vec4:
    """Corner of a map's window and size of its texels [m]; a size of 0 where the view shows nothing lit."""
    size = wp.float32(maps.depth.shape[1])
    wide = -maps.window[number, 2] - maps.window[number, 0]
    high = -maps.window[number, 3] - maps.window[number, 1]
    if wide < 0.0:
        return wp.vec4(0.0)
    # A window of no width would divide by zero.
    more_x = wp.max(MARGIN * wide, 0.01)
    more_y = wp.max(MARGIN * high, 0.01)
    return wp.vec4(
        maps.window[number, 0] - more_x,
        maps.window[number, 1] - more_y,
        (wide + 2.0 * more_x) / size,
        (high + 2.0 * more_y) / size,
    )


@wp.kernel(enable_backward=False)
def _clear(first: wp.int32, view_world: wp.array[wp.int32], distant: wp.array[wp.int32], maps: ShadowMaps):
    number, y, x = wp.tid()
    world = view_world[first + number // 2]
    if world >= 0 and distant[world] != 0:
        maps.depth[number, y, x] = wp.uint32(0)


@wp.kernel(enable_backward=False)
def _cast(
    first: wp.int32,
    view_world: wp.array[wp.int32],
    distant: wp.array[wp.int32],
    soup: Soup,
    start: wp.array[wp.int32],
    end: wp.array[wp.int32],
    lanes_x: wp.int32,
    lanes_y: wp.int32,
    maps: ShadowMaps,
):
    number, thread = wp.tid()
    world = view_world[first + number // 2]
    if world < 0 or distant[world] == 0:
        return
    lane = thread % (lanes_x * lanes_y)
    entry = soup_entry(start, end, world, thread // (lanes_x * lanes_y))
    if entry < 0:
        return
    window = _texels(maps, number)
    if window[2] <= 0.0:
        return
    size = wp.float32(maps.depth.shape[1])
    shape = soup.shape[entry]
    pose = wp.transform_inverse(maps.frames[number // 2]) * soup.transforms[shape]
    bounds = soup.bounds[shape]
    centre = wp.transform_point(pose, wp.vec3(bounds[0], bounds[1], bounds[2]))
    if wp.abs(centre[0] - window[0] - 0.5 * size * window[2]) > 0.5 * size * window[2] + bounds[3]:
        return
    if wp.abs(centre[1] - window[1] - 0.5 * size * window[3]) > 0.5 * size * window[3] + bounds[3]:
        return
    corners = soup.faces[soup.face[entry]]
    # In texels, from the centre of the first; z stays in metres.
    scale = wp.vec3(1.0 / window[2], 1.0 / window[3], 1.0)
    shift = wp.vec3(window[0], window[1], 0.0)
    half = wp.vec3(0.5, 0.5, 0.0)
    p0 = wp.cw_mul(corner(soup, shape, corners[0], pose) - shift, scale) - half
    p1 = wp.cw_mul(corner(soup, shape, corners[1], pose) - shift, scale) - half
    p2 = wp.cw_mul(corner(soup, shape, corners[2], pose) - shift, scale) - half
    lower = wp.min(p0, wp.min(p1, p2))
    upper = wp.max(p0, wp.max(p1, p2))
    left = wp.ceil(wp.max(lower[0] - EDGE, 0.0))
    right = wp.floor(wp.min(upper[0] + EDGE, size - 1.0))
    top = wp.int32(wp.ceil(wp.clamp(lower[1] - EDGE, 0.0, size)))
    bottom = wp.int32(wp.floor(wp.clamp(upper[1] + EDGE, -1.0, size - 1.0)))
    if left > right or top > bottom:
        return
    normal = wp.cross(p1 - p0, p2 - p0)
    # Edge-on to the light: the neighbours cast its shadow.
    if wp.abs(normal[2]) < 1.0e-6:
        return
    slope_x = -normal[0] / normal[2]
    slope_y = -normal[1] / normal[2]
    side = wp.sign(normal[2])
    y = top + lane // lanes_x
    while y <= bottom:
        height = wp.float32(y)
        row = wp.vec2(left, right)
        for k in range(3):
            a = p0
            b = p1
            if k == 1:
                a = p1
                b = p2
            elif k == 2:
                a = p2
                b = p0
            # Inside where side · ((b − a) × (q − a)) ≥ 0.
            step = (a[1] - b[1]) * side
            row = span(wp.vec2(step, ((b[0] - a[0]) * (height - a[1])) * side - step * a[0]), row)
        last = wp.int32(wp.floor(row[1]))
        x = wp.int32(wp.ceil(row[0])) + lane % lanes_x
        base = p0[2] + slope_y * (height - p0[1]) - slope_x * p0[0] + DEPTH_ORIGIN
        # Close to edge-on the plane leaves the triangle between texels.
        while x <= last:
            z = wp.clamp(base + slope_x * wp.float32(x), lower[2] + DEPTH_ORIGIN, upper[2] + DEPTH_ORIGIN)
            if z > 0.0:
                # Positive floats are ordered as their bits.
                key = wp.cast(z, wp.uint32)
                if maps.depth[number, y, x] < key:
                    wp.atomic_max(maps.depth, number, y, x, key)
            x += lanes_x
        y += lanes_y


def launch_shadow_maps(
    *,
    first: int,
    view_world: wp.array,
    poses: wp.array,
    rays: wp.array,
    normals: wp.array,
    depth: wp.array,
    soup: Soup,
    casters: tuple[int, int],
    distant: wp.array,
    direction: wp.array,
    maps: ShadowMaps,
) -> None:
    """Fit and draw the maps of views `first`, `first` + 1, …, as many as fit `maps`, where the light is distant.

    Args:
        first: View of the first two maps.
        view_world: int32 [views], world of each view, negative to leave it out.
        poses: Camera poses [m], shape [views].
        rays: Camera-space origin (zero) and unit direction, shape [H, W, 1, 2].
        normals: World-space normals that the views show, shape [views, H, W].
        depth: Distance along the ray [m], 0 where it met nothing, same shape.
        soup: Triangles of the model.
        casters: Largest numbers of large and of other casting triangles of one world, those of no world included.
        distant: int32 [worlds], 1 for a distant light, 0 for a dome.
        direction: Unit vector from the light to the scene, shape [worlds].
        maps: Out.
    """
    device = depth.device
    count = min(maps.frames.shape[0], poses.shape[0] - first)
    wp.launch(_aim, dim=count, inputs=[first, view_world, poses, distant, direction, maps], device=device)
    wp.launch(
        _fit,
        dim=(2 * count, PROBES[0]),
        inputs=[first, view_world, poses, rays, normals, depth, distant, direction, *PROBES, maps],
        device=device,
    )
    if device.is_cuda:
        # Setting all memory is six times faster than a kernel.
        maps.depth.zero_()
    else:
        size = maps.depth.shape[1:]
        wp.launch(_clear, dim=(2 * count, *size), inputs=[first, view_world, distant, maps], device=device)
    lanes = LANES if device.is_cuda else (1, 1)
    for start, end, most, (wide, high) in (
        (soup.world_start, soup.large_end, casters[0], lanes),
        (soup.large_end, soup.small_end, casters[1], (1, 1)),
    ):
        wp.launch(
            _cast,
            dim=(2 * count, most * wide * high),
            inputs=[first, view_world, distant, soup, start, end, wide, high, maps],
            device=device,
        )


@wp.func
def _unshadowed(
    maps: ShadowMaps, number: wp.int32, world: wp.int32, point: wp.vec3, normal: wp.vec3, to_light: wp.vec3
) -> wp.float32:
    inverse = wp.transform_inverse(maps.frames[number])
    here = wp.transform_point(inverse, point)
    part = 2 * number
    if wp.length(here) > SPLIT:
        part += 1
    window = _texels(maps, part)
    if window[2] <= 0.0:
        return 1.0
    facing = wp.transform_vector(inverse, normal)
    x = (here[0] - window[0]) / window[2] - 0.5
    y = (here[1] - window[1]) / window[3] - 0.5
    size = maps.depth.shape[1]
    if x < -1.0 or y < -1.0 or x > wp.float32(size) or y > wp.float32(size):
        return 1.0
    steep = 1.0 / wp.max(facing[2], 1.0e-6)
    slope_x = wp.clamp(-facing[0] * steep, -STEEPEST, STEEPEST) * window[2]
    slope_y = wp.clamp(-facing[1] * steep, -STEEPEST, STEEPEST) * window[3]
    plane = here[2] + DEPTH_ORIGIN + BIAS + TEXEL_BIAS * wp.max(window[2], window[3])
    column = wp.int32(wp.floor(x))
    row = wp.int32(wp.floor(y))
    lit = wp.float32(0.0)
    for k in range(4):
        i = column + k % 2
        j = row + k // 2
        off_x = wp.float32(i) - x
        off_y = wp.float32(j) - y
        weight = (1.0 - wp.abs(off_x)) * (1.0 - wp.abs(off_y))
        if i < 0 or j < 0 or i >= size or j >= size:
            lit += weight
        elif wp.cast(maps.depth[part, j, i], wp.float32) <= plane + slope_x * off_x + slope_y * off_y:
            lit += weight
    return lit


MAPPED = (ShadowMaps, _unshadowed)
"""Shadows by map for `launch_shade`: the type of what it reads, and the fraction of the light that arrives."""


@wp.struct
class Occluders:
    """Surfaces that a shadow ray can hit: the shapes of the model and their BVH, grouped by world."""

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


@cache
def traced(ray_primitive: Callable[..., Any], mesh_type: int) -> tuple[Any, Any]:
    """Shadows by ray for `launch_shade`: exact and slow, what the maps are measured against.

    Args:
        ray_primitive: Warp function (pose, size, type, origin, direction, cull) → (distance or −1, normal).
        mesh_type: Value of `Occluders.types` that means a triangle mesh.
    """

    @wp.func
    def visible(
        scene: Occluders, number: wp.int32, world: wp.int32, point: wp.vec3, normal: wp.vec3, to_light: wp.vec3
    ) -> wp.float32:
        origin = point + normal * RAY_BIAS
        for group in range(int(2)):  # noqa: UP018  (int() keeps Warp from unrolling the loop)
            root = scene.group_roots[world]
            if group == 1:
                root = scene.group_roots[scene.group_roots.shape[0] - 1]
            if root < 0:
                continue
            query = wp.bvh_query_ray(scene.bvh, origin, to_light, root)
            leaf = wp.int32(0)
            while wp.bvh_query_next(query, leaf, RAY_LENGTH):
                shape = wp.int32(scene.leaves[leaf])
                if scene.types[shape] == wp.static(mesh_type):
                    if scene.meshes[shape] != wp.uint64(0):
                        inverse = wp.transform_inverse(scene.transforms[shape])
                        scale = scene.sizes[shape]
                        start = wp.cw_div(wp.transform_point(inverse, origin), scale)
                        along = wp.cw_div(wp.transform_vector(inverse, to_light), scale)
                        if wp.mesh_query_ray_anyhit(scene.meshes[shape], start, along, RAY_LENGTH, -1):
                            return 0.0
                else:
                    distance, _normal = ray_primitive(
                        scene.transforms[shape], scene.sizes[shape], scene.types[shape], origin, to_light, False
                    )
                    if distance >= 0.0 and distance < RAY_LENGTH:
                        return 0.0
        return 1.0

    return Occluders, visible
