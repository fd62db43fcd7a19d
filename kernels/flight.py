"""Bodies that a differentiable solver of Newton moves: their state from plain arrays, their path to one.

Newton keeps poses as `wp.transform` and twists as `wp.spatial_vector` (linear part first); torch tensors hold the
numbers alone. All kernels have adjoints.
"""

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["launch_place_bodies", "launch_trace_bodies"]


@wp.kernel
def place_bodies_kernel(
    position: wp.array2d[float],
    velocity: wp.array2d[float],
    spin: wp.array2d[float],
    body_q: wp.array[wp.transform],
    body_qd: wp.array[wp.spatial_vector],
):
    """One thread per body."""
    b = wp.tid()
    p = wp.vec3(position[b, 0], position[b, 1], position[b, 2])
    v = wp.vec3(velocity[b, 0], velocity[b, 1], velocity[b, 2])
    w = wp.vec3(spin[b, 0], spin[b, 1], spin[b, 2])
    body_q[b] = wp.transform(p, wp.quat_identity())
    body_qd[b] = wp.spatial_vector(v, w)


def launch_place_bodies(
    position: wp.array, velocity: wp.array, spin: wp.array, body_q: wp.array, body_qd: wp.array
) -> None:
    """Writes a state of upright bodies.

    Args:
        position: World positions [m], shape [bodies, 3].
        velocity: Linear velocities [m/s], shape [bodies, 3].
        spin: Angular velocities [rad/s], shape [bodies, 3].
        body_q: Output: poses of a `newton.State`, transform, shape [bodies].
        body_qd: Output: its twists, spatial_vector, shape [bodies].
    """
    launch(place_bodies_kernel, position.shape[0], [position, velocity, spin], [body_q, body_qd])


@wp.kernel
def trace_bodies_kernel(body_q: wp.array[wp.transform], tick: int, path: wp.array3d[float]):
    """One thread per body."""
    b = wp.tid()
    p = wp.transform_get_translation(body_q[b])
    path[tick, b, 0] = p[0]
    path[tick, b, 1] = p[1]
    path[tick, b, 2] = p[2]


def launch_trace_bodies(body_q: wp.array, tick: int, path: wp.array) -> None:
    """Writes the positions of one moment into a path.

    Args:
        body_q: Poses of a `newton.State`, transform, shape [bodies].
        tick: Row of the path.
        path: Output: positions [m], shape [ticks, bodies, 3].
    """
    launch(trace_bodies_kernel, body_q.shape[0], [body_q, tick], [path])
