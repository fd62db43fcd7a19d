"""Camera poses, visible surfaces, and shading per world: Lambert under a dome or a distant light with shadows.

Every world of a batch has its own light. A surface of linear albedo a, normal n (turned towards the viewer) and a
light of radiance L (intensity · colour) gives the linear radiance

    dome:     a · L · A(n)
    distant:  a · L · (AMBIENT · A(n) + DIRECT · max(n·l, 0) · v)

with A(n) = BOUNCE + (1 − BOUNCE) · (n_z + 1)/2, the light from above and what the floor gives back, l towards the light
and v the fraction of its light that arrives. A ray that leaves the scene shows L · SKY_DOME or L · SKY_DISTANT. The
picture is sRGB(1 − exp(−EXPOSURE · radiance)): the dome of intensity 3000 and colour 0.75 puts albedo 0.5 at 0.48
linear, and no light of the visual mode (3000 to 7000, colour 0.65 to 0.85) clips a white wall.
"""

from functools import cache
from typing import Any

import warp as wp

from arena_newton.kernels.launching import launch, launch_divided
from arena_newton.kernels.pictures.levels import as_float, level_of, settled
from arena_newton.kernels.pictures.raster import srgb

__all__ = ["FULL_LIGHT", "DisplayCurve", "display_curve", "launch_camera_poses", "launch_shade"]

FULL_LIGHT = 1700.0
"""Light intensity at 1 of the tone curve, which puts the original's dome (3000 · 0.75) at 1.32."""
EXPOSURE = wp.constant(wp.float32(1.0 / FULL_LIGHT))
"""Scale from light intensity units to the tone curve."""
BOUNCE = wp.constant(wp.float32(0.45))
"""Fraction of the dome's light that a surface facing straight down receives from the floor."""
AMBIENT = wp.constant(wp.float32(0.2))
"""Ambient fraction of a distant light, so that shadows keep their texture."""
DIRECT = wp.constant(wp.float32(0.5))
"""Direct fraction of a distant light: with AMBIENT, intensity 5000 from above looks as bright as the dome of 3000."""
SKY_DOME = wp.constant(wp.float32(2.0))
"""Brightness of the background under the dome: nearly white, as at the original's horizon."""
SKY_DISTANT = wp.constant(wp.float32(0.2))
"""Brightness of the background under a distant light: a darker grey."""


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
    launch(_camera_poses, poses.shape[0], [body_q, body, local], [poses])


@wp.func
def _radiance(
    albedo: wp.vec3, normal: wp.vec3, distant: wp.int32, to_light: wp.vec3, light: wp.vec3, visible: wp.float32
) -> wp.vec3:
    """Linear radiance of a surface; see the module's formula."""
    ambient = BOUNCE + (1.0 - BOUNCE) * 0.5 * (normal[2] + 1.0)
    fraction = ambient
    if distant != 0:
        fraction = AMBIENT * ambient + DIRECT * wp.max(wp.dot(normal, to_light), 0.0) * visible
    return wp.cw_mul(albedo, light) * fraction


@wp.func
def _display(radiance: wp.float32) -> wp.float32:
    """Tone curve and sRGB encoding to [0, 1]."""
    return srgb(1.0 - wp.exp(-EXPOSURE * radiance))


@wp.func
def _byte(value: wp.float32) -> wp.uint8:
    return wp.uint8(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5)


@wp.struct
class DisplayCurve:
    """Bytes of the display by table; empty on CUDA, where powers are quick."""

    levels: wp.array[wp.float32]
    """Least radiance of each byte, shape [256]."""
    guesses: wp.array[wp.uint8]
    """Byte of the first radiance of each of `GUESSES` steps: upper bits of a float, from those of `DARKEST` on."""


GUESSES = wp.constant(4096)
"""256 steps for each doubling of the radiance."""
STEP_BITS = wp.constant(wp.uint32(15))
"""Bits of a float within a step."""
DARKEST = wp.constant(wp.uint32(0x3E800000))
"""Bits of the radiance 0.25, below byte 1; 16 doublings later all is white."""


@wp.func
def _display_byte(radiance: wp.float32) -> wp.uint8:
    return _byte(_display(radiance))


_display_level = level_of(_display_byte)


@wp.kernel(enable_backward=False)
def _fill_curve(curve: DisplayCurve):
    number = wp.tid()
    curve.guesses[number] = _display_byte(as_float(DARKEST + (wp.uint32(number) << STEP_BITS)))
    if number < 256:
        curve.levels[number] = _display_level(number)


def display_curve(device: wp.Device) -> DisplayCurve:
    """The table of a device."""
    curve = DisplayCurve()
    steps = 0 if device.is_cuda else GUESSES
    curve.levels = wp.zeros(min(256, steps), dtype=wp.float32, device=device)
    curve.guesses = wp.zeros(steps, dtype=wp.uint8, device=device)
    launch(_fill_curve, steps, [curve], [], device)
    return curve


@wp.func
def _curved(curve: DisplayCurve, radiance: wp.float32) -> wp.uint8:
    """Byte of a radiance, at least 0 and no NaN."""
    step = wp.int32(wp.cast(radiance, wp.uint32) >> STEP_BITS) - wp.int32(DARKEST >> STEP_BITS)
    guess = wp.int32(curve.guesses[wp.clamp(step, 0, GUESSES - 1)])
    return wp.uint8(settled(curve.levels, radiance, guess))


@wp.func
def _channel(packed: wp.uint32, shift: wp.uint32, decode: wp.array[wp.float32]) -> wp.float32:
    return decode[wp.int32((packed >> shift) & wp.uint32(0xFF))]


@cache
def _shade_kernel(shadow_type: Any, visibility: Any) -> wp.Kernel:
    """The shading kernel with one kind of shadows built in."""

    @wp.kernel(enable_backward=False, module="unique")
    def shade(
        first_row: wp.int32,
        lanes: wp.int32,
        columns: wp.int32,
        first: wp.int32,
        view_world: wp.array[wp.int32],
        poses: wp.array[wp.transform],
        rays: wp.array4d[wp.vec3],
        albedo: wp.array3d[wp.uint32],
        normals: wp.array3d[wp.vec3],
        depth: wp.array3d[wp.float32],
        decode: wp.array[wp.float32],
        curve: DisplayCurve,
        shadows: shadow_type,
        distant: wp.array[wp.int32],
        direction: wp.array[wp.vec3],
        light: wp.array[wp.vec3],
        samples: wp.int32,
        top: wp.int32,
        left: wp.int32,
        image: wp.array4d[wp.uint8],
    ):
        number, row, lane = wp.tid()
        row += first_row
        view = first + number
        world = view_world[view]
        if world < 0:
            return
        mode = distant[world]
        to_light = -direction[world]
        radiant = light[world]
        by_table = samples == 1 and curve.levels.shape[0] > 0
        for column in range(lane, columns, lanes):
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
                        point = wp.transform_point(poses[view], rays[y, x, 0, 0]) + along * t
                        visible = visibility(shadows, number, world, point, normal, to_light)
                    packed = albedo[view, y, x]
                    colour = wp.vec3(
                        _channel(packed, wp.uint32(0), decode),
                        _channel(packed, wp.uint32(8), decode),
                        _channel(packed, wp.uint32(16), decode),
                    )
                    seen = _radiance(colour, normal, mode, to_light, radiant, visible)
                if by_table:
                    total = seen
                else:
                    total += wp.vec3(_display(seen[0]), _display(seen[1]), _display(seen[2]))
            for c in range(3):
                if by_table:
                    image[view, row + top, column + left, c] = _curved(curve, total[c])
                else:
                    image[view, row + top, column + left, c] = _byte(total[c] / wp.float32(samples * samples))

    return shade


def launch_shade(
    method: tuple[Any, Any],
    shadows: Any,
    *,
    views: tuple[int, int],
    view_world: wp.array,
    poses: wp.array,
    rays: wp.array,
    albedo: wp.array,
    normals: wp.array,
    depth: wp.array,
    decode: wp.array,
    curve: DisplayCurve,
    distant: wp.array,
    direction: wp.array,
    light: wp.array,
    samples: int,
    size: tuple[int, int],
    origin: tuple[int, int],
    image: wp.array,
    threads: int = 1,
) -> None:
    """Shade the surfaces that each view's rays met; only distant lights have shadows.

    Args:
        method: `shadow.MAPPED` or `shadow.traced(…)`.
        shadows: What the method reads; for `MAPPED` the maps of these views.
        views: First view and number of views to shade.
        view_world: int32 [views], world of each view, negative to leave its picture as it is.
        poses: Camera poses [m], shape [views].
        rays: Camera-space origin and direction, shape [H·samples, W·samples, 1, 2].
        albedo: sRGB albedo packed as RGBA, uint32 [views, H·samples, W·samples].
        normals: World-space normals, same shape.
        depth: Distance along the ray [m], 0 where it met nothing, same shape.
        decode: Linear value of each sRGB byte, float32 [256].
        curve: Of `display_curve`; an empty one computes the same bytes by powers.
        distant: int32 [worlds], 1 for a distant light, 0 for a dome.
        direction: Unit vector from the light to the scene, shape [worlds].
        light: Intensity times colour, shape [worlds].
        samples: Rays per pixel along each axis.
        size: Height and width of the shaded part [px].
        origin: Row and column of its first pixel in `image` [px].
        image: Out, uint8 [views, rows, columns, 3].
        threads: Threads on the CPU; their number changes no bit.
    """
    surfaces = [view_world, poses, rays, albedo, normals, depth, decode, curve]
    lanes = size[1] if image.device.is_cuda else 1  # copying the arguments takes as long as a pixel on the CPU
    inputs = [lanes, size[1], views[0], *surfaces, shadows, distant, direction, light, samples, *origin]
    launch_divided(_shade_kernel(*method), (views[1], size[0], lanes), 1, inputs, [image], threads)
