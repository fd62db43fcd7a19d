"""Options of mujoco_warp that the benchmark sets on every model."""

from __future__ import annotations

import mujoco
import mujoco_warp

__all__ = ["collide_boxes_as_mujoco"]


def collide_boxes_as_mujoco(warp_model: mujoco_warp.Model) -> None:
    """Let mujoco_warp collide boxes by its port of MuJoCo's own routine.

    By default it treats them as any convex shapes, and the normal of a foot that grazes an edge at a few degrees is
    then the foot's instead of the obstacle's: with it a walk along a sill fell in 10 % of the rollouts, against 3 %.
    """
    warp_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
