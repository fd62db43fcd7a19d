"""Triangles to pictures: albedo, normal and depth of the nearest surface of each pixel, all worlds in one launch.

Each triangle is drawn once into a depth buffer of 64-bit keys (nearness above, triangle below), on CPU and CUDA alike.
"""

import warp as wp

from arena_newton.kernels.launching import launch, launch_divided
from arena_newton.kernels.pictures.levels import level_of, settled

__all__ = ["Soup", "launch_albedo", "launch_rasterize"]

NEAR = wp.constant(wp.float32(0.002))
"""Smallest distance from the camera's plane at which a surface is drawn [m]."""
EDGE = wp.constant(wp.float32(1.0e-3))
"""Overlap of neighbouring triangles, against cracks by rounding [px]."""


@wp.struct
class Soup:
    """The visible shapes as triangles: what `launch_rasterize` draws."""

    world_start: wp.array[wp.int32]
    """First entry of each world in `shape` and `face`, then that of the shapes of no world, shape [worlds + 1]."""
    world_end: wp.array[wp.int32]
    """End of the same entries, shape [worlds + 1]."""
    large_end: wp.array[wp.int32]
    """End of the entries, first of their world's, that cast shadows and are large, shape [worlds + 1]."""
    small_end: wp.array[wp.int32]
    """End of the smaller ones, which follow; what comes after casts no shadow, shape [worlds + 1]."""
    shape: wp.array[wp.int32]
    """Shape of each entry, one entry for every visible triangle of every world."""
    face: wp.array[wp.int32]
    """Triangle in `faces` of each entry."""
    bounds: wp.array[wp.vec4]
    """Bounding sphere of each shape in its own frame, scaled: centre and radius [m]."""
    scales: wp.array[wp.vec3]
    transforms: wp.array[wp.transform]
    """World pose of each shape [m]."""
    colors: wp.array[wp.vec3]
    """Linear albedo of each shape."""
    packed: wp.array[wp.uint32]
    """The same as sRGB, packed as RGBA."""
    levels: wp.array[wp.float32]
    """Least sRGB value in a white shape's texture that gives each byte, shape [256]; empty on CUDA, where powers are
    quick."""
    texture: wp.array[wp.int32]
    """Texture of each shape, −1 for none."""
    faces: wp.array[wp.vec3i]
    vertices: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    """Normal of each vertex, zero for flat shading."""
    uvs: wp.array[wp.vec2]
    texels: wp.array[wp.uint8]
    """sRGB bytes of all textures, row by row from the top, RGB."""
    texture_layout: wp.array[wp.vec3i]
    """First texel, width and height of each texture."""


@wp.func
def corner(soup: Soup, shape: wp.int32, vertex: wp.int32, pose: wp.transform) -> wp.vec3:
    """A vertex of a shape under a pose."""
    return wp.transform_point(pose, wp.cw_mul(soup.scales[shape], soup.vertices[vertex]))


@wp.func
def soup_entry(start: wp.array[wp.int32], end: wp.array[wp.int32], world: wp.int32, number: wp.int32) -> wp.int32:
    """Entry of the triangle `number` of a world: first its own ones, then those of no world; −1 after the last.

    Args:
        start: First entry of each world and of no world, shape [worlds + 1].
        end: End of these entries, same shape.
        world: World.
        number: Counts from 0.
    """
    own = end[world] - start[world]
    if number < own:
        return start[world] + number
    common = end.shape[0] - 1
    entry = start[common] + number - own
    if entry >= end[common]:
        entry = -1
    return entry


@wp.func
def span(edge: wp.vec2, limits: wp.vec2) -> wp.vec2:
    """Part of a row inside an edge: least and greatest x [px], within `limits`.

    Args:
        edge: Slope and offset of the edge function, slope · x + offset, which is positive inside.
        limits: Least and greatest x so far [px].
    """
    low = limits[0]
    high = limits[1]
    if edge[0] > 0.0:
        low = wp.max(low, -edge[1] / edge[0] - EDGE)
    elif edge[0] < 0.0:
        high = wp.min(high, -edge[1] / edge[0] + EDGE)
    elif edge[1] < 0.0:
        high = -1.0
    return wp.vec2(low, high)


@wp.kernel(enable_backward=False)
def _clear(view_world: wp.array[wp.int32], nearest: wp.array3d[wp.uint64]):
    view, y, x = wp.tid()
    if view_world[view] >= 0:
        nearest[view, y, x] = wp.uint64(0)


@wp.kernel(enable_backward=False)
def _rasterize(
    first_view: wp.int32,
    view_world: wp.array[wp.int32],
    poses: wp.array[wp.transform],
    soup: Soup,
    tan_x: wp.float32,
    tan_y: wp.float32,
    nearest: wp.array3d[wp.uint64],
):
    view, number = wp.tid()
    view += first_view
    world = view_world[view]
    if world < 0:
        return
    entry = soup_entry(soup.world_start, soup.world_end, world, number)
    if entry < 0:
        return
    height = nearest.shape[1]
    width = nearest.shape[2]
    # A pixel's ray is (x0 + px · dx, y0 − py · dy, −1).
    dx = 2.0 * tan_x / wp.float32(width)
    dy = 2.0 * tan_y / wp.float32(height)
    x0 = -tan_x + 0.5 * dx
    y0 = tan_y - 0.5 * dy
    shape = soup.shape[entry]
    pose = wp.transform_inverse(poses[view]) * soup.transforms[shape]
    bounds = soup.bounds[shape]
    centre = wp.transform_point(pose, wp.vec3(bounds[0], bounds[1], bounds[2]))
    if centre[2] - bounds[3] > -NEAR:
        return
    if wp.abs(centre[0]) > -centre[2] * tan_x + bounds[3] * wp.sqrt(1.0 + tan_x * tan_x):
        return
    if wp.abs(centre[1]) > -centre[2] * tan_y + bounds[3] * wp.sqrt(1.0 + tan_y * tan_y):
        return
    corners = soup.faces[soup.face[entry]]
    p0 = corner(soup, shape, corners[0], pose)
    p1 = corner(soup, shape, corners[1], pose)
    p2 = corner(soup, shape, corners[2], pose)
    if wp.min(p0[2], wp.min(p1[2], p2[2])) > -NEAR:
        return
    lower = wp.vec2(1.0e9, 1.0e9)
    upper = wp.vec2(-1.0e9, -1.0e9)
    for k in range(3):
        a = p0
        b = p1
        if k == 1:
            a = p1
            b = p2
        elif k == 2:
            a = p2
            b = p0
        if a[2] <= -NEAR:
            q = wp.vec2(a[0] / -a[2], a[1] / -a[2])
            lower = wp.min(lower, q)
            upper = wp.max(upper, q)
        if (a[2] <= -NEAR) != (b[2] <= -NEAR):
            s = (-NEAR - a[2]) / (b[2] - a[2])
            c = a + (b - a) * s
            q = wp.vec2(c[0] / NEAR, c[1] / NEAR)
            lower = wp.min(lower, q)
            upper = wp.max(upper, q)
    columns = wp.float32(width)
    rows = wp.float32(height)
    left = wp.int32(wp.ceil(wp.clamp((lower[0] - x0) / dx - EDGE, 0.0, columns)))
    right = wp.int32(wp.floor(wp.clamp((upper[0] - x0) / dx + EDGE, -1.0, columns - 1.0)))
    top = wp.int32(wp.ceil(wp.clamp((y0 - upper[1]) / dy - EDGE, 0.0, rows)))
    bottom = wp.int32(wp.floor(wp.clamp((y0 - lower[1]) / dy + EDGE, -1.0, rows - 1.0)))
    if left > right or top > bottom:
        return
    normal = wp.cross(p1 - p0, p2 - p0)
    volume = wp.dot(normal, p0)
    if wp.abs(volume) < 1.0e-16:
        return
    side = wp.sign(volume)
    # Edge functions e · ray, positive inside; edge vectors keep the digits of small triangles.
    e0 = wp.cross(p1, p2 - p1) * side
    e1 = wp.cross(p2, p0 - p2) * side
    e2 = wp.cross(p0, p1 - p0) * side
    slope = normal / volume
    for y in range(top, bottom + 1):
        ray_y = y0 - wp.float32(y) * dy
        row = wp.vec2(wp.float32(left), wp.float32(right))
        for k in range(3):
            e = e0
            if k == 1:
                e = e1
            elif k == 2:
                e = e2
            row = span(wp.vec2(e[0] * dx, e[0] * x0 + e[1] * ray_y - e[2]), row)
        if row[0] <= row[1]:
            base = slope[0] * x0 + slope[1] * ray_y - slope[2]
            for x in range(wp.int32(wp.ceil(row[0])), wp.int32(wp.floor(row[1])) + 1):
                near = base + slope[0] * dx * wp.float32(x)
                if near > 0.0 and near < 1.0 / NEAR:
                    # Positive floats are ordered as their bits, so the nearest triangle wins whatever the order.
                    key = (wp.uint64(wp.cast(near, wp.uint32)) << wp.uint64(32)) | wp.uint64(entry)
                    wp.atomic_max(nearest, view, y, x, key)


@wp.func
def srgb(value: wp.float32) -> wp.float32:
    """Encode a linear value in [0, 1] as sRGB (IEC 61966-2-1)."""
    if value <= 0.0031308:
        return 12.92 * value
    return 1.055 * wp.pow(value, 1.0 / 2.4) - 0.055


@wp.func
def _linear(value: wp.float32) -> wp.float32:
    """Linear value of an sRGB value in [0, 1] (IEC 61966-2-1)."""
    if value <= 0.04045:
        return value / 12.92
    return wp.pow((value + 0.055) / 1.055, 2.4)


@wp.func
def _albedo_byte(value: wp.float32) -> wp.uint32:
    """Byte of a linear albedo in sRGB, rounded down."""
    return wp.uint32(wp.clamp(srgb(value), 0.0, 1.0) * 255.0)


@wp.func
def _pack(red: wp.uint32, green: wp.uint32, blue: wp.uint32) -> wp.uint32:
    return red | (green << wp.uint32(8)) | (blue << wp.uint32(16))


@wp.kernel(enable_backward=False)
def _pack_colors(soup: Soup):
    shape = wp.tid()
    colour = soup.colors[shape]
    soup.packed[shape] = _pack(_albedo_byte(colour[0]), _albedo_byte(colour[1]), _albedo_byte(colour[2]))


@wp.func
def _seen_byte(seen: wp.float32) -> wp.uint32:
    """Byte of a white shape where its texture has an sRGB value."""
    return _albedo_byte(_linear(seen))


_seen_level = level_of(_seen_byte)


@wp.kernel(enable_backward=False)
def _fill_levels(soup: Soup):
    byte = wp.tid()
    soup.levels[byte] = _seen_level(byte)


@wp.func
def _texture_byte(soup: Soup, seen: wp.float32) -> wp.uint32:
    return settled(soup.levels, seen, wp.int32(seen * 255.0))


@wp.func
def _textured(soup: Soup, shape: wp.int32, seen: wp.vec3) -> wp.uint32:
    """Packed albedo of a shape where its texture has an sRGB value, in [0, 1]."""
    colour = soup.colors[shape]
    white = colour == wp.vec3(1.0)
    if soup.levels.shape[0] == 0 or not white:
        colour = wp.cw_mul(colour, wp.vec3(_linear(seen[0]), _linear(seen[1]), _linear(seen[2])))
        return _pack(_albedo_byte(colour[0]), _albedo_byte(colour[1]), _albedo_byte(colour[2]))
    return _pack(_texture_byte(soup, seen[0]), _texture_byte(soup, seen[1]), _texture_byte(soup, seen[2]))


@wp.func
def _texel(soup: Soup, texel: wp.int32) -> wp.vec3:
    """Texel as sRGB in [0, 1]."""
    i = texel * 3
    scale = 1.0 / 255.0
    return wp.vec3(wp.float32(soup.texels[i]), wp.float32(soup.texels[i + 1]), wp.float32(soup.texels[i + 2])) * scale


@wp.func
def _wrapped(index: wp.int32, count: wp.int32) -> wp.int32:
    """Row or column of a texture that repeats."""
    rest = index % count
    if rest < 0:
        rest += count
    return rest


@wp.kernel(enable_backward=False)
def _resolve(
    first_row: wp.int32,
    lanes: wp.int32,
    view_world: wp.array[wp.int32],
    poses: wp.array[wp.transform],
    rays: wp.array4d[wp.vec3],
    soup: Soup,
    nearest: wp.array3d[wp.uint64],
    albedo: wp.array3d[wp.uint32],
    normals: wp.array3d[wp.vec3],
    depth: wp.array3d[wp.float32],
):
    view, y, lane = wp.tid()
    y += first_row
    if view_world[view] < 0:
        return
    for x in range(lane, depth.shape[2], lanes):
        if nearest[view, y, x] == wp.uint64(0):
            depth[view, y, x] = 0.0
            continue
        entry = wp.int32(nearest[view, y, x] & wp.uint64(0xFFFFFFFF))
        shape = soup.shape[entry]
        pose = soup.transforms[shape]
        inverse = wp.transform_inverse(pose)
        # The ray in the shape's frame, where the triangle needs no transform.
        start = wp.transform_point(inverse, wp.transform_get_translation(poses[view]))
        along = wp.transform_vector(inverse, wp.transform_vector(poses[view], rays[y, x, 0, 1]))
        corners = soup.faces[soup.face[entry]]
        scale = soup.scales[shape]
        p0 = wp.cw_mul(scale, soup.vertices[corners[0]]) - start
        p1 = wp.cw_mul(scale, soup.vertices[corners[1]]) - start
        p2 = wp.cw_mul(scale, soup.vertices[corners[2]]) - start
        normal = wp.cross(p1 - p0, p2 - p0)
        t = wp.dot(normal, p0) / wp.dot(normal, along)
        # Weights from the triangle's own edges around the hit point; outside by rounding at most.
        hit = along * t
        square = wp.dot(normal, normal)
        w1 = wp.clamp(wp.dot(wp.cross(p2 - hit, p0 - hit), normal) / square, 0.0, 1.0)
        w2 = wp.clamp(wp.dot(wp.cross(p0 - hit, p1 - hit), normal) / square, 0.0, 1.0)
        w0 = wp.max(1.0 - w1 - w2, 0.0)
        smooth = soup.normals[corners[0]] * w0 + soup.normals[corners[1]] * w1 + soup.normals[corners[2]] * w2
        if wp.dot(smooth, smooth) > 0.0:
            normal = wp.cw_div(smooth, scale)
        colour = soup.packed[shape]
        if soup.texture[shape] >= 0:
            layout = soup.texture_layout[soup.texture[shape]]
            uv = soup.uvs[corners[0]] * w0 + soup.uvs[corners[1]] * w1 + soup.uvs[corners[2]] * w2
            u = uv[0] * wp.float32(layout[1]) - 0.5
            v = (1.0 - uv[1]) * wp.float32(layout[2]) - 0.5
            column = _wrapped(wp.int32(wp.floor(u)), layout[1])
            row = _wrapped(wp.int32(wp.floor(v)), layout[2])
            right = wp.where(column + 1 == layout[1], 0, column + 1)
            upper = layout[0] + row * layout[1]
            lower = layout[0] + wp.where(row + 1 == layout[2], 0, row + 1) * layout[1]
            fu = u - wp.floor(u)
            fv = v - wp.floor(v)
            above = _texel(soup, upper + column) * (1.0 - fu) + _texel(soup, upper + right) * fu
            below = _texel(soup, lower + column) * (1.0 - fu) + _texel(soup, lower + right) * fu
            seen = above * (1.0 - fv) + below * fv
            colour = _textured(soup, shape, seen)
        albedo[view, y, x] = colour
        normals[view, y, x] = wp.normalize(wp.transform_vector(pose, normal))
        depth[view, y, x] = t


def launch_albedo(soup: Soup) -> None:
    """Fill `packed` and `levels`, which have memory, by what the soup says besides; once, as neither changes."""
    launch(_pack_colors, soup.packed.shape, [soup], [], soup.packed.device)
    launch(_fill_levels, soup.levels.shape, [soup], [], soup.packed.device)


def launch_rasterize(
    *,
    view_world: wp.array,
    poses: wp.array,
    rays: wp.array,
    soup: Soup,
    tangents: tuple[float, float],
    triangles: int,
    nearest: wp.array,
    albedo: wp.array,
    normals: wp.array,
    depth: wp.array,
    threads: int = 1,
) -> None:
    """Albedo, normal and depth of the nearest triangle of each pixel.

    Rays search every tree again; drawing each triangle once takes a third of that on a CPU core, a fifth on a GPU.

    Args:
        view_world: int32 [views], world of each view, negative to leave its picture as it is.
        poses: Camera poses [m], shape [views].
        rays: Camera-space origin (zero) and unit direction, shape [H, W, 1, 2].
        soup: Triangles of the model.
        tangents: Tangents of half the horizontal and half the vertical view.
        triangles: Largest number of triangles that a view can see, those of no world included.
        nearest: Work space, uint64 [views, H, W]: nearness (bits of 1/distance along the view axis) and entry.
        albedo: Out, sRGB packed as RGBA, uint32, same shape.
        normals: Out, world-space normals, same shape.
        depth: Out, distance along the ray [m], 0 where it met nothing, same shape.
        threads: Threads on the CPU; their number changes no bit.
    """
    launch(_clear, nearest.shape, [view_world], [nearest])
    inputs = [view_world, poses, soup, *tangents]
    launch_divided(_rasterize, (poses.shape[0], triangles), 0, inputs, [nearest], threads)
    lanes = depth.shape[2] if depth.device.is_cuda else 1  # copying the arguments takes as long as a pixel on the CPU
    inputs = [lanes, view_world, poses, rays, soup, nearest]
    launch_divided(_resolve, (*depth.shape[:2], lanes), 1, inputs, [albedo, normals, depth], threads)
