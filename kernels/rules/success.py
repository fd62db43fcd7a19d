"""Success predicates of the seven tasks in both rule sets, each with a signed continuous margin.

A margin is the smallest slack [m] of the conditions of one instant: at least 0 exactly when all hold. Conditions other
than lengths enter by a length that the docstring of their launch names. Margins are differentiable almost everywhere.
Success is the margin's sign, or, where a rule asks for several ticks in a row, a counter of ticks with margin >= 0.
A minimum may drop a NaN: `reset.launch_nonfinite` flags broken worlds, whose verdict is meaningless.

Arguments that mean the same in every launch:
    xpos, xipos: Positions of bodies and of their centres of mass [m], shape [worlds, nbody, 3].
    xquat: Orientations of bodies, wxyz, shape [worlds, nbody, 4].
    qpos, qvel: Positions and velocities, MuJoCo layout, shape [worlds, nq] and [worlds, nv].
    root_qpos_adr: Address of the robot's free joint in `qpos`.
    stand_height: Smallest root height of a standing robot [m], 0.45.
    stand_up: Smallest up-axis z of a standing robot, 0.60; its slack counts as metres at 1 m up the robot's axis.
    counter: Ticks in a row so far, updated, int32, shape [worlds]; clear it at reset.
    success: Output, 1 = success, int32, shape [worlds].
    margin: Output [m], shape [worlds].
"""

from arena_newton.kernels.boxes import Boxes, upload_boxes
from arena_newton.kernels.rules.success_hoi import (
    launch_double_desk,
    launch_football,
    launch_pp_box_paper,
    launch_pp_box_released,
)
from arena_newton.kernels.rules.success_hsi import (
    launch_boxing,
    launch_open_door_paper,
    launch_open_door_released,
    launch_sit_sofa_paper,
    launch_sit_sofa_released,
    launch_vis_navi,
)

__all__ = [
    "Boxes",
    "launch_boxing",
    "launch_double_desk",
    "launch_football",
    "launch_open_door_paper",
    "launch_open_door_released",
    "launch_pp_box_paper",
    "launch_pp_box_released",
    "launch_sit_sofa_paper",
    "launch_sit_sofa_released",
    "launch_vis_navi",
    "upload_boxes",
]
