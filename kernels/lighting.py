"""Camera poses, visible surfaces, and shading per world: Lambert under a dome or a distant light with shadow rays.

Every world of a batch has its own light. A surface of linear albedo a, normal n (turned towards the viewer) and a
light of radiance L (intensity · colour) gives the linear radiance

    dome:     a · L · A(n)
    distant:  a · L · (AMBIENT · A(n) + DIRECT · max(n·l, 0) · v)

with A(n) = BOUNCE + (1 − BOUNCE) · (n_z + 1)/2, the light from above and what the floor gives back, l towards the light
and v = 0 in its shadow. A ray that leaves the scene shows L · SKY_DOME or L · SKY_DISTANT. The picture is
sRGB(1 − exp(−EXPOSURE · radiance)): the dome of intensity 3000 and colour 0.75 puts albedo 0.5 at 0.48 linear,
and no light of the visual mode (3000 to 7000, colour 0.65 to 0.85) clips a white wall.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

__all__ = ["Occluders", "Soup", "launch_camera_poses", "launch_rasterize", "launch_shade"]

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
NEAR = wp.constant(wp.float32(0.002))
"""What is closer to the camera's plane than this is not drawn [m]."""
EDGE = wp.constant(wp.float32(1.0e-3))
"""Overlap of neighbouring triangles, against cracks by rounding [px]."""


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


@wp.struct
class Soup:
    """The visible shapes as triangles: what `launch_rasterize` draws."""

    world_start: wp.array[wp.int32]
    """First entry of each world in `shape` and `face`, then of no world's shapes, then the end, shape [worlds + 2]."""
    shape: wp.array[wp.int32]
    """Shape of each entry, one entry for every visible triangle of every world."""
    face: wp.array[wp.int32]
    """Triangle in `faces` of each entry."""
    spheres: wp.array[wp.vec4]
    """Bounding sphere of each shape in its own frame, scaled: centre and radius [m]."""
    scales: wp.array[wp.vec3]
    transforms: wp.array[wp.transform]
    """World pose of each shape [m]."""
    colors: wp.array[wp.vec3]
    """Linear albedo of each shape."""
    texture: wp.array[wp.int32]
    """Texture of each shape, −1 for none."""
    faces: wp.array[wp.vec3i]
    vertices: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    """Normal of each vertex, zero for flat shading."""
    uvs: wp.array[wp.vec2]
    texels: wp.array[wp.uint8]
    """sRGB bytes of all textures, row by row from the top, RGB."""
    texture_place: wp.array[wp.vec3i]
    """First texel, width and height of each texture."""


@wp.func
def _corner(soup: Soup, shape: wp.int32, vertex: wp.int32, pose: wp.transform) -> wp.vec3:
    return wp.transform_point(pose, wp.cw_mul(soup.scales[shape], soup.vertices[vertex]))


@wp.kernel(enable_backward=False)
def _clear(view_world: wp.array[wp.int32], nearest: wp.array3d[wp.uint64]):
    view, y, x = wp.tid()
    if view_world[view] >= 0:
        nearest[view, y, x] = wp.uint64(0)


@wp.kernel(enable_backward=False)
def _rasterize(
    view_world: wp.array[wp.int32],
    poses: wp.array[wp.transform],
    soup: Soup,
    tan_x: wp.float32,
    tan_y: wp.float32,
    nearest: wp.array3d[wp.uint64],
):
    view, number = wp.tid()
    world = view_world[view]
    if world < 0:
        return
    # The triangles of the view's world, then those that belong to no world.
    entry = soup.world_start[world] + number
    own = soup.world_start[world + 1] - soup.world_start[world]
    if number >= own:
        entry = soup.world_start[soup.world_start.shape[0] - 2] + number - own
        if entry >= soup.world_start[soup.world_start.shape[0] - 1]:
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
    ball = soup.spheres[shape]
    centre = wp.transform_point(pose, wp.vec3(ball[0], ball[1], ball[2]))
    if centre[2] - ball[3] > -NEAR:
        return
    if wp.abs(centre[0]) > -centre[2] * tan_x + ball[3] * wp.sqrt(1.0 + tan_x * tan_x):
        return
    if wp.abs(centre[1]) > -centre[2] * tan_y + ball[3] * wp.sqrt(1.0 + tan_y * tan_y):
        return
    corners = soup.faces[soup.face[entry]]
    p0 = _corner(soup, shape, corners[0], pose)
    p1 = _corner(soup, shape, corners[1], pose)
    p2 = _corner(soup, shape, corners[2], pose)
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
        low = wp.float32(left)
        high = wp.float32(right)
        for k in range(3):
            e = e0
            if k == 1:
                e = e1
            elif k == 2:
                e = e2
            step = e[0] * dx
            start = e[0] * x0 + e[1] * ray_y - e[2]
            if step > 0.0:
                low = wp.max(low, -start / step - EDGE)
            elif step < 0.0:
                high = wp.min(high, -start / step + EDGE)
            elif start < 0.0:
                high = -1.0
        if low <= high:
            base = slope[0] * x0 + slope[1] * ray_y - slope[2]
            for x in range(wp.int32(wp.ceil(low)), wp.int32(wp.floor(high)) + 1):
                near = base + slope[0] * dx * wp.float32(x)
                if near > 0.0 and near < 1.0 / NEAR:
                    # Positive floats are ordered as their bits, so the nearest triangle wins whatever the order.
                    key = (wp.uint64(wp.cast(near, wp.uint32)) << wp.uint64(32)) | wp.uint64(entry)
                    wp.atomic_max(nearest, view, y, x, key)


@wp.func
def _srgb(value: wp.float32) -> wp.float32:
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
def _texel(soup: Soup, place: wp.vec3i, x: wp.int32, y: wp.int32) -> wp.vec3:
    """Texel as sRGB in [0, 1], repeating."""
    column = x % place[1]
    row = y % place[2]
    if column < 0:
        column += place[1]
    if row < 0:
        row += place[2]
    i = (place[0] + row * place[1] + column) * 3
    scale = 1.0 / 255.0
    return wp.vec3(wp.float32(soup.texels[i]), wp.float32(soup.texels[i + 1]), wp.float32(soup.texels[i + 2])) * scale


@wp.kernel(enable_backward=False)
def _resolve(
    view_world: wp.array[wp.int32],
    poses: wp.array[wp.transform],
    rays: wp.array4d[wp.vec3],
    soup: Soup,
    nearest: wp.array3d[wp.uint64],
    albedo: wp.array3d[wp.uint32],
    normals: wp.array3d[wp.vec3],
    depth: wp.array3d[wp.float32],
):
    view, y, x = wp.tid()
    if view_world[view] < 0:
        return
    if nearest[view, y, x] == wp.uint64(0):
        depth[view, y, x] = 0.0
        return
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
    colour = soup.colors[shape]
    if soup.texture[shape] >= 0:
        place = soup.texture_place[soup.texture[shape]]
        uv = soup.uvs[corners[0]] * w0 + soup.uvs[corners[1]] * w1 + soup.uvs[corners[2]] * w2
        u = uv[0] * wp.float32(place[1]) - 0.5
        v = (1.0 - uv[1]) * wp.float32(place[2]) - 0.5
        column = wp.int32(wp.floor(u))
        row = wp.int32(wp.floor(v))
        fu = u - wp.floor(u)
        fv = v - wp.floor(v)
        above = _texel(soup, place, column, row) * (1.0 - fu) + _texel(soup, place, column + 1, row) * fu
        below = _texel(soup, place, column, row + 1) * (1.0 - fu) + _texel(soup, place, column + 1, row + 1) * fu
        seen = above * (1.0 - fv) + below * fv
        colour = wp.cw_mul(colour, wp.vec3(_linear(seen[0]), _linear(seen[1]), _linear(seen[2])))
    albedo[view, y, x] = (
        wp.uint32(wp.clamp(_srgb(colour[0]), 0.0, 1.0) * 255.0)
        | (wp.uint32(wp.clamp(_srgb(colour[1]), 0.0, 1.0) * 255.0) << wp.uint32(8))
        | (wp.uint32(wp.clamp(_srgb(colour[2]), 0.0, 1.0) * 255.0) << wp.uint32(16))
    )
    normals[view, y, x] = wp.normalize(wp.transform_vector(pose, normal))
    depth[view, y, x] = t


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
) -> None:
    """Albedo, normal and depth of the nearest triangle of each pixel.

    A ray searches every tree anew; drawing each triangle once costs a third of that on a CPU core, a fifth on a GPU.

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
    """
    device = depth.device
    wp.launch(_clear, dim=nearest.shape, inputs=[view_world], outputs=[nearest], device=device)
    wp.launch(
        _rasterize,
        dim=(poses.shape[0], triangles),
        inputs=[view_world, poses, soup, *tangents],
        outputs=[nearest],
        device=device,
    )
    wp.launch(
        _resolve,
        dim=depth.shape,
        inputs=[view_world, poses, rays, soup, nearest],
        outputs=[albedo, normals, depth],
        device=device,
    )


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
    """Tone curve and sRGB encoding to [0, 1]."""
    return _srgb(1.0 - wp.exp(-EXPOSURE * radiance))


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
