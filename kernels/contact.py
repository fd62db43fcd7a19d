"""Contact forces of the Warp engine per body and between two groups of geoms.

Reads the flat contact list of mujoco_warp's `Data`. Sums run over atomic additions: on CUDA their order, and so the
last bits of a sum, may change from run to run; on the CPU backend they are the same every time.
"""

# ruff: noqa: UP018 - `int(0)` declares a variable in Warp, `0` a constant that a loop may not change

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["GROUP_A", "GROUP_B", "launch_contact_force"]

wp.set_module_options({"enable_backward": False})

GROUP_A = 1
"""Bit of `geom_group` that puts a geom in the first watched group."""
GROUP_B = 2
"""Bit of `geom_group` that puts a geom in the second watched group."""
_A = wp.constant(GROUP_A)
_B = wp.constant(GROUP_B)

vec5 = wp.types.vector(length=5, dtype=wp.float32)


@wp.kernel
def contact_force_kernel(
    contact_count: wp.array[int],
    geom: wp.array[wp.vec2i],
    world_id: wp.array[int],
    frame: wp.array[wp.mat33],
    friction: wp.array[vec5],
    dim: wp.array[int],
    efc_address: wp.array2d[int],
    efc_force: wp.array2d[float],
    pyramidal: int,
    geom_body: wp.array[int],
    geom_group: wp.array[int],
    net_force: wp.array2d[wp.vec3],
    pair_force: wp.array[float],
):
    """One thread per contact."""
    i = wp.tid()
    if i >= contact_count[0]:
        return
    address = efc_address[i, 0]
    if address < 0:
        return
    g0 = geom[i][0]
    g1 = geom[i][1]
    if g0 < 0 or g1 < 0:
        return
    w = world_id[i]
    rows = efc_force.shape[1]
    condim = dim[i]
    mu = friction[i]
    f = wp.vec3(0.0, 0.0, 0.0)
    if condim == 1:
        if address < rows:
            f[0] = efc_force[w, address]
    elif pyramidal != 0:
        # Two opposite edges per friction direction; torsion and rolling (k > 1) add to the normal force alone.
        for k in range(condim - 1):
            row = address + 2 * k
            plus = float(0.0)
            minus = float(0.0)
            if row < rows:
                plus = efc_force[w, row]
            if row + 1 < rows:
                minus = efc_force[w, row + 1]
            f[0] = f[0] + plus + minus
            if k < 2:
                f[k + 1] = (plus - minus) * mu[k]
    else:
        for k in range(3):
            row = efc_address[i, k]
            if row >= 0 and row < rows:
                f[k] = efc_force[w, row]
    force = wp.transpose(frame[i]) * f
    wp.atomic_add(net_force, w, geom_body[g1], force)
    wp.atomic_add(net_force, w, geom_body[g0], -force)
    a = geom_group[g0]
    b = geom_group[g1]
    if ((a & _A) != 0 and (b & _B) != 0) or ((a & _B) != 0 and (b & _A) != 0):
        wp.atomic_add(pair_force, w, f[0])


@wp.kernel
def force_norm_kernel(net_force: wp.array2d[wp.vec3], force_norm: wp.array2d[float]):
    """One thread per world and body."""
    w, b = wp.tid()
    force_norm[w, b] = wp.length(net_force[w, b])


def launch_contact_force(
    contact_count: wp.array,
    geom: wp.array,
    world_id: wp.array,
    frame: wp.array,
    friction: wp.array,
    dim: wp.array,
    efc_address: wp.array,
    efc_force: wp.array,
    *,
    pyramidal: bool,
    geom_body: wp.array,
    geom_group: wp.array,
    net_force: wp.array,
    force_norm: wp.array,
    pair_force: wp.array,
) -> None:
    """Sums contact forces of the last step.

    The force on a body is the vector sum over its contacts, in the world frame; the normal of a contact points from its
    first geom to its second, so the second is pushed along it. Rows beyond the constraint buffer count as zero.

    Args:
        contact_count: Contacts in the list (`Data.nacon`), int32, shape [1].
        geom: Geom pair of each contact, vec2i, shape [naconmax]; -1 (flex) is skipped.
        world_id: World of each contact, int32, shape [naconmax].
        frame: Contact frame, rows are axes, the first the normal, mat33, shape [naconmax].
        friction: Friction of each contact, vec5, shape [naconmax].
        dim: Dimension of each contact (1, 3, 4, 6), int32, shape [naconmax].
        efc_address: First constraint rows of each contact, -1 = none, int32, shape [naconmax, rows].
        efc_force: Constraint forces, shape [worlds, njmax].
        pyramidal: Whether the friction cone is a pyramid, else elliptic.
        geom_body: Body of each geom, int32, shape [ngeom].
        geom_group: Bits `GROUP_A`, `GROUP_B` of each geom, int32, shape [ngeom].
        net_force: Output, net contact force [N] on each body in the world frame, vec3, shape [worlds, nbody].
        force_norm: Output, its norm [N], shape [worlds, nbody].
        pair_force: Output, sum of normal forces [N] between the two groups, shape [worlds].
    """
    net_force.zero_()
    pair_force.zero_()
    contacts = [contact_count, geom, world_id, frame, friction, dim, efc_address, efc_force]
    inputs = [*contacts, int(pyramidal), geom_body, geom_group]
    launch(contact_force_kernel, geom.shape[0], inputs, [net_force, pair_force])
    launch(force_norm_kernel, net_force.shape, [net_force], [force_norm])
