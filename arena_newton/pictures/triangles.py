"""A model's visible shapes as triangles, for the cameras and their shadows."""

from collections.abc import Hashable

import newton
import numpy as np
import warp as wp
from newton import Axis, GeoType, Mesh
from newton.utils import load_texture, normalize_texture

from arena_newton.errors import InputError
from arena_newton.kernels.pictures.raster import Soup, launch_albedo

__all__ = ["srgb_to_linear", "triangles"]

FLOOR_TOP = 0.02
"""A fixed shape that ends below this height throws no shadow: nothing is under it [m]."""
LARGE_TRIANGLE = 0.2
"""The triangles of a mesh are drawn into shadow maps by many threads each, if twice their mean area is more [m²]."""


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Linear value of an sRGB value in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _as_mesh(kind: int, scale: np.ndarray, source: Mesh | None) -> Mesh:
    """A shape as a triangle mesh; only one that has a source is still to be scaled."""
    quiet = {"compute_inertia": False}
    # The axis of Newton's shapes is z, that of its mesh makers y by default.
    along_z = {"up_axis": Axis.Z, **quiet}
    size = [float(v) for v in scale]
    if kind == GeoType.SPHERE:
        return Mesh.create_sphere(size[0], **quiet)
    if kind == GeoType.BOX:
        return Mesh.create_box(*size, duplicate_vertices=True, **quiet)
    if kind == GeoType.CAPSULE:
        return Mesh.create_capsule(size[0], size[1], **along_z)
    if kind == GeoType.CYLINDER:
        return Mesh.create_cylinder(size[0], size[1], barrel_radius=size[2], **along_z)
    if kind == GeoType.CONE:
        return Mesh.create_cone(size[0], size[1], **along_z)
    if kind == GeoType.ELLIPSOID:
        return Mesh.create_ellipsoid(*size, **quiet)
    if kind == GeoType.PLANE:
        # 0 is an unbounded plane: as far as the renderer's rays reach.
        return Mesh.create_plane(size[0] or 2000.0, size[1] or 2000.0, **quiet)
    if source is None or not hasattr(source, "vertices"):
        raise InputError(f"a shape of type {GeoType(kind).name} cannot be drawn: use a mesh or a primitive")
    return source


def triangles(model: newton.Model) -> tuple[Soup, int, tuple[int, int]]:
    """Every visible shape as triangles, meshes stored once for all worlds; see `Soup`.

    Returns:
        The triangles, the most that a view can see, and the most that cast shadows in a world, large and small.
    """
    count = model.shape_count
    shapes = np.sort(model.bvh_shape_enabled.numpy()[: model.bvh_shape_count_enabled].astype(np.int64))
    kinds, sizes, worlds = model.shape_type.numpy(), model.shape_scale.numpy(), model.shape_world.numpy()
    scales, bounds = np.ones((count, 3), np.float32), np.zeros((count, 4), np.float32)
    face_range, texture = np.zeros((count, 2), np.int32), np.full(count, -1, np.int32)
    # 0 for a caster of large triangles, 1 for one of small triangles, 2 for the floor, which casts no shadow.
    casts = np.ones(count, np.int32)
    bodies, poses = model.shape_body.numpy(), model.shape_transform.numpy()
    vertices, normals, uvs, faces, texels, layouts = [], [], [], [], [], []
    packed: dict[Hashable, tuple[Mesh, np.ndarray, tuple[int, int]]] = {}
    measured: dict[Hashable, tuple[np.ndarray, np.ndarray, bool]] = {}  # worlds have most shapes in common
    images: dict[int, int] = {}
    at_vertex = at_face = at_texel = 0
    for s in shapes:
        source = model.shape_source[s]
        key = (int(kinds[s]), id(source)) if source is not None else (int(kinds[s]), *sizes[s].tolist())
        if key not in packed:
            mesh = _as_mesh(int(kinds[s]), sizes[s], source)
            points = np.asarray(mesh.vertices, np.float32).reshape(-1, 3)
            corner = np.asarray(mesh.indices, np.int32).reshape(-1, 3)
            vertices.append(points)
            normals.append(np.zeros_like(points) if mesh.normals is None else np.asarray(mesh.normals, np.float32))
            st: np.ndarray = np.zeros((len(points), 2), np.float32)
            if mesh.uvs is not None:
                affine = np.asarray(mesh.texture_transform, np.float32)
                st = np.asarray(mesh.uvs, np.float32).reshape(-1, 2) @ affine[:, :2].T + affine[:, 2]
            uvs.append(st)
            faces.append(corner + at_vertex)
            packed[key] = (mesh, points, (at_face, at_face + len(corner)))
            at_vertex, at_face = at_vertex + len(points), at_face + len(corner)
        mesh, points, face_range[s] = packed[key]
        scales[s] = sizes[s] if source is not None else 1.0
        scaled = (key, *scales[s].tolist())
        if scaled not in measured:
            measured[scaled] = _measured(points * scales[s], np.asarray(mesh.indices).reshape(-1, 3))
        box, bounds[s], is_small = measured[scaled]
        casts[s] = 2 if bodies[s] < 0 and _top(poses[s], box) < FLOOR_TOP else is_small
        image = getattr(source, "texture", None)
        if image is not None and mesh.uvs is not None:
            if source.texture_hash not in images:
                pixels = normalize_texture(load_texture(image), require_channels=True)[..., :3]
                images[source.texture_hash] = len(layouts)
                layouts.append((at_texel, pixels.shape[1], pixels.shape[0]))
                texels.append(np.ascontiguousarray(pixels).reshape(-1))
                at_texel += pixels.shape[0] * pixels.shape[1]
            texture[s] = images[source.texture_hash]

    order = np.where(worlds[shapes] < 0, model.world_count, worlds[shapes])
    sort = np.lexsort((casts[shapes], order))
    first, length = face_range[shapes[sort], 0], np.diff(face_range[shapes[sort]], axis=1)[:, 0]
    entry_shape = np.repeat(shapes[sort], length)
    entry_face = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length - first, length)
    start = np.searchsorted(np.repeat(order[sort], length), np.arange(model.world_count + 2))
    classes = np.repeat(order[sort] * 3 + casts[shapes[sort]], length)
    large, small = (np.searchsorted(classes, np.arange(model.world_count + 1) * 3 + k) for k in (1, 2))

    def most(first: np.ndarray, end: np.ndarray) -> int:
        counts = end - first
        return int(counts[:-1].max(initial=0) + counts[-1])

    def array(values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=model.device)

    soup = Soup()
    soup.world_start, soup.world_end = array(start[:-1], wp.int32), array(start[1:], wp.int32)
    soup.bounds = array(bounds, wp.vec4)
    soup.shape, soup.face = array(entry_shape, wp.int32), array(entry_face, wp.int32)
    soup.large_end, soup.small_end = array(large, wp.int32), array(small, wp.int32)
    soup.scales, soup.transforms = array(scales, wp.vec3), model.bvh_shape_world_transforms
    soup.colors = array(srgb_to_linear(model.shape_color.numpy()), wp.vec3)
    soup.packed = wp.zeros(soup.colors.shape, dtype=wp.uint32, device=model.device)
    soup.levels = wp.zeros(0 if model.device.is_cuda else 256, dtype=wp.float32, device=model.device)
    soup.texture = array(texture, wp.int32)
    soup.faces, soup.vertices = array(np.concatenate(faces), wp.vec3i), array(np.concatenate(vertices), wp.vec3)
    soup.normals, soup.uvs = array(np.concatenate(normals), wp.vec3), array(np.concatenate(uvs), wp.vec2)
    soup.texels = array(np.concatenate(texels) if texels else np.zeros(0, np.uint8), wp.uint8)
    soup.texture_layout = array(np.array(layouts, np.int32).reshape(-1, 3), wp.vec3i)
    launch_albedo(soup)
    return soup, most(start[:-1], start[1:]), (most(start[:-1], large), most(large, small))


def _measured(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Two corners of the box around points [m], its centre and their largest distance from it, small triangles."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre = 0.5 * (low + high)
    p0, p1, p2 = points[faces].swapaxes(0, 1)
    small = bool(np.linalg.norm(np.cross(p1 - p0, p2 - p0), axis=-1).mean() < LARGE_TRIANGLE)
    return np.array([low, high]), np.array([*centre, np.linalg.norm(points - centre, axis=1).max()]), small


def _top(pose: np.ndarray, box: np.ndarray) -> float:
    """Height of the top of a box, given by its two corners in a frame of pose (position, quaternion xyzw) [m]."""
    x, y, z, w = pose[3:]
    up = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    return float(pose[2] + np.maximum(box[0] * up, box[1] * up).sum())
