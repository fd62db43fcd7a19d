"""Gradients through `wp.Tape` agree with central differences of the very kernels, and torch's autograd sees them."""

import numpy as np
import pytest
import torch
import warp as wp

from arena_newton.differentiable import ReferenceState, reference_step, success_margin
from arena_newton.kernels import canonical
from arena_newton.kernels.rules import predicates, success
from arena_newton.kernels.rules.success_conditions import launch_conditions
from arena_newton.robot import g1
from tests.children import Child

WORLDS = 64
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
STAND = {"stand_height": 0.45, "stand_up": 0.60}


def _directional(function, tensors, seed, step):
    """Per world: derivative along a random direction by autograd, by central difference, and where the two sides agree.

    `function` maps tensors [worlds, ..] to one number a world; a kink between the two sides tells itself by one-sided
    differences that disagree, and is left out.
    """
    generator = torch.Generator().manual_seed(seed)
    ways = [torch.randn(t.shape, generator=generator).to(t.device) for t in tensors]
    leaves = [t.clone().requires_grad_() for t in tensors]
    value = function(*leaves)
    grads = torch.autograd.grad(value.sum(), leaves)
    exact = sum((g * v).flatten(1).sum(1) if g.ndim > 1 else g * v for g, v in zip(grads, ways, strict=True))

    def at(h):
        return function(*(t + h * v for t, v in zip(tensors, ways, strict=True))).detach()

    ahead, behind = (at(step) - at(0.0)) / step, (at(0.0) - at(-step)) / step
    return exact, (ahead + behind) / 2, (ahead - behind).abs()


def _agree(exact, numeric, bend, tolerance, kept=0.6):
    """Derivatives agree in every world without a kink nearby, and most worlds are such."""
    smooth = bend < 0.1 * (1 + numeric.abs())
    assert smooth.float().mean() > kept
    error = ((exact - numeric).abs() / (1 + numeric.abs()))[smooth]
    assert error.max() < tolerance, float(error.max())
    assert (exact[smooth].abs() > 1e-3).float().mean() > 0.3


def _state(device, twin, rng):
    qpos = np.zeros((WORLDS, 7), np.float32)
    qpos[:, :3] = rng.normal(size=(WORLDS, 3))
    qpos[:, 3:] = twin.random_quats(rng, WORLDS, tilt=0.3)
    ref = canonical.ReferencePose.allocate(WORLDS, device, canonical_to_mujoco=g1.CANONICAL_TO_MUJOCO, tick=g1.TICK)
    ones = wp.full(WORLDS, 1, dtype=wp.int32, device=device)
    canonical.launch_reset_reference(ref, wp.array(qpos, dtype=wp.float32, device=device), 0, ones)
    return ref, ones


def _action(device, twin, rng):
    action = np.zeros((WORLDS, 40), np.float32)
    action[:, :2] = rng.normal(scale=0.01, size=(WORLDS, 2))
    action[:, 2] = rng.uniform(0.7, 0.8, WORLDS)
    action[:, 3:9] = twin.matrix(twin.random_quats(rng, WORLDS, tilt=0.4))[..., :2].reshape(-1, 6)
    action[:, 9:] = rng.normal(scale=0.4, size=(WORLDS, 31))
    return torch.from_numpy(action).to(wp.device_to_torch(device))


# Rates are differences over one tick of 0.02 s; weighed by it they are of order one.
WEIGHT = torch.ones(35)
WEIGHT[[0, 1, 5]] = g1.TICK


@pytest.mark.parametrize("limit_deg", [0.0, 26.0])
def test_reference_step_gradients(device, twin, limit_deg):
    """Mimic, target pose and joint rates of three chained steps have the gradients of central differences."""
    rng = np.random.default_rng(0)
    ref, _ = _state(device, twin, rng)
    start = ReferenceState.of(ref)
    actions = [_action(device, twin, rng) for _ in range(3)]
    weight = (WEIGHT * torch.randn(35, generator=torch.Generator().manual_seed(1))).to(actions[0].device)

    def function(a, b, c):
        state, total = start, 0.0
        for action in (a, b, c):
            mimic, state = reference_step(action, state, max_root_delta_deg=limit_deg)
            total = total + mimic @ weight + state.position.sum(1) + state.quat.sum(1) + 0.02 * state.joint_vel.sum(1)
        return total

    exact, numeric, bend = _directional(function, actions, seed=2, step=2e-3)
    _agree(exact, numeric, bend, 5e-3)


def test_reference_step_is_the_kernel(device, twin):
    """Forward values equal those of the running reference bit for bit, over several steps."""
    rng = np.random.default_rng(1)
    ref, ones = _state(device, twin, rng)
    state = ReferenceState.of(ref)
    for _ in range(3):
        action = _action(device, twin, rng)
        mimic, state = reference_step(action, state, max_root_delta_deg=26.0)
        canonical.launch_integrate(ref, wp.from_torch(action), ones, 26.0)
        assert torch.equal(mimic, wp.to_torch(ref.mimic))
        for name in ReferenceState._fields:
            assert torch.equal(getattr(state, name), wp.to_torch(getattr(ref, name))), name


def test_reference_step_gradients_have_the_known_ones(device, twin):
    """Simple entries: mimic velocity by displacement is 1/tick, mimic joint by joint is 1 at its reordered place."""
    rng = np.random.default_rng(2)
    ref, _ = _state(device, twin, rng)
    action = _action(device, twin, rng).requires_grad_()
    mimic, _ = reference_step(action, ReferenceState.of(ref))
    (grad,) = torch.autograd.grad(mimic[:, 0].sum(), action, retain_graph=True)
    torch.testing.assert_close(grad[:, 0], torch.full_like(grad[:, 0], 50.0))
    assert not grad[:, 1:].any()
    canonical_knee = g1.CANONICAL_JOINTS.index("left_knee_joint")
    (grad,) = torch.autograd.grad(mimic[:, 6 + g1.MUJOCO_JOINTS.index("left_knee_joint")].sum(), action)
    assert grad[:, 9 + canonical_knee].eq(1).all() and grad.sum() == WORLDS


def _box(twin, device, body, half, quat=(0.9, 0.05, -0.1, 0.3)):
    return success.upload_boxes([twin.Marker(body, (0.05, -0.02, 0.04), quat, half)], device)


def _cases(twin, device):
    """Each predicate: launch, fixed arguments, names of its float arrays."""
    ids = [wp.array(v, dtype=wp.int32, device=device) for v in ([1, 2], [2, 6, 1], [1, 2, 6, 5])]
    offsets = wp.array([(0.1, 0.02, 0.0), (0.05, 0.0, 0.03)], dtype=wp.vec3, device=device)
    decks = success.upload_boxes(
        [twin.Marker(3, (0, 0, z), (0.95, 0.02, 0.03, 0.2), (0.5, 0.4, 0.05)) for z in (-0.4, 0.0, 0.4)], device
    )
    free = {"latched": wp.zeros(WORLDS, dtype=wp.int32, device=device)}
    poses = ("xpos", "xquat")
    football = {"ball_body": 1, "goal": _box(twin, device, 3, (0.9, 0.8, 0.7)), "min_z": -9.0, "judge_out": True}
    football["pitch"] = _box(twin, device, 0, (5, 5, 5))
    desk = {"hammer_body": 2, "inside": _box(twin, device, 3, (0.4, 0.3, 0.2))}
    cube = _box(twin, device, 5, (0.105, 0.1, 0.11))
    box = {"box": cube, "decks": decks, "height_tolerance": 0.06}
    paper_box = {"box_qvel_adr": 2, "max_speed": 0.05, "confirm_ticks": 10, "tick": 0.02}
    root = {"root_qpos_adr": 1}
    seat = {"bodies": ids[1], "seat": _box(twin, device, 3, (0.5, 0.4, 0.2)), "below": 0.1, "above": 0.35}
    punch = {"palm_body": ids[0], "palm_offset": offsets, "target": _box(twin, device, 3, (0.05, 0.05, 0.05))}
    door = {"doorway": _box(twin, device, 3, (0.5, 0.1, 1)), "half_width": 0.55, "min_y": 0.02}
    zone = {"feet": ids[2], "zone": _box(twin, device, 3, (0.5, 0.6, 1))}
    sofa = {"min_force": 50.0, "max_root_z": 0.8, "confirm_ticks": 25, "stiffness": 1.0}
    near, slow, upright, toward, away, angle = (
        int(getattr(predicates, kind)) for kind in ("NEAR", "SLOW", "UPRIGHT", "TOWARD", "AWAY", "ANGLE")
    )
    terms = [(near, 0, 0, 0, 2, 0, 3), (slow, 1, 0, 0, 0, 0, 0), (upright, 0, 0, 1, 2, 0, 0)]
    terms += [(toward, 1, 0, 0, 1, 1, 2), (away, 0, 0, 1, 2, 2, 3), (angle, 0, 9, 0, 0, 0, 0)]
    every = {"terms": wp.array(np.array(terms, np.int32), dtype=wp.int32, device=device), "ticks": 2}
    every["limits"] = wp.array([0.3, 0.6, -0.6, -0.4, -0.6, 0.2], dtype=wp.float32, device=device)
    return {
        "football paper": (success.launch_football, football | {"rear_bound": True}, poses),
        "football released": (success.launch_football, football | {"rear_bound": False}, poses),
        "double_desk paper": (success.launch_double_desk, desk, (*poses, "xipos")),
        "double_desk released": (success.launch_double_desk, desk | {"min_z": -0.2}, (*poses, "xipos")),
        "pp_box paper": (success.launch_pp_box_paper, box | paper_box, (*poses, "qvel", "robot_force")),
        "pp_box released": (success.launch_pp_box_released, box | {"deck": 1, "plane_below": 0.15}, poses),
        "open_door paper": (success.launch_open_door_paper, door | root | STAND, (*poses, "qpos")),
        "open_door released": (
            success.launch_open_door_released,
            free | root | STAND | {"leaf_qpos_adr": 9, "min_angle": 1.0472},
            ("qpos",),
        ),
        "sit_sofa paper": (success.launch_sit_sofa_paper, root | sofa, ("qpos", "seat_force")),
        "sit_sofa released": (
            success.launch_sit_sofa_released,
            seat | {"min_force": 0.5, "stiffness": 1.0},
            (*poses, "contact_force"),
        ),
        "boxing": (success.launch_boxing, punch | {"min_radius": 0.1, "pad": 0.08}, poses),
        "vis_navi": (success.launch_vis_navi, zone | root | STAND, (*poses, "qpos")),
        "vis_navi ring": (success.launch_vis_navi, zone | root | STAND | {"round_zone": True}, (*poses, "qpos")),
        "conditions": (
            launch_conditions,
            free | every | {"point_body": ids[0], "point_pos": offsets, "boxes": decks},
            (*poses, "qpos", "qvel"),
        ),
    }


CASES = (
    "football paper",
    "football released",
    "double_desk paper",
    "double_desk released",
    "pp_box paper",
    "pp_box released",
    "open_door paper",
    "open_door released",
    "sit_sofa paper",
    "sit_sofa released",
    "boxing",
    "vis_navi ring",
    "vis_navi",
    "conditions",
)


@pytest.mark.parametrize("case", CASES)
def test_margin_gradients(device, twin, case):
    """Every margin has the gradient of central differences in all its float arrays, kinks left out."""
    rng = np.random.default_rng(CASES.index(case))
    launch, fixed, names = _cases(twin, device)[case]
    qpos = rng.uniform(0.3, 0.9, (WORLDS, 12))
    qpos[:, 4:8] = twin.random_quats(rng, WORLDS, tilt=0.8)
    draws = {
        "xpos": rng.uniform(-0.5, 0.5, (WORLDS, 8, 3)),
        "xquat": twin.random_quats(rng, WORLDS, 8),
        "xipos": rng.uniform(-0.5, 0.5, (WORLDS, 8, 3)),
        "qpos": qpos,
        "qvel": rng.normal(scale=0.3, size=(WORLDS, 6)),
        "contact_force": rng.uniform(0, 1, (WORLDS, 8)),
        "seat_force": rng.uniform(49.5, 50.5, WORLDS),
        "robot_force": rng.uniform(1.0, 200.0, WORLDS),
    }
    tensors = [torch.tensor(draws[n], dtype=torch.float32, device=wp.device_to_torch(device)) for n in names]

    def function(*arrays):
        return success_margin(launch, **dict(zip(names, arrays, strict=True)), **fixed)

    exact, numeric, bend = _directional(function, tensors, seed=3, step=5e-4)
    _agree(exact, numeric, bend, 1e-2)


def test_margin_leads_to_success(device, twin):
    """Following the football margin's gradient from anywhere brings the ball into the goal."""
    launch, fixed, _ = _cases(twin, device)["football paper"]
    rng = np.random.default_rng(9)
    where = wp.device_to_torch(device)
    xpos = torch.tensor(rng.uniform(-2, 2, (16, 8, 3)), dtype=torch.float32, device=where)
    xquat = torch.tensor(np.tile(np.float32(UPRIGHT), (16, 8, 1)), device=where)
    ball = xpos[:, 1].clone().requires_grad_()
    for _ in range(400):
        poses = torch.cat([xpos[:, :1], ball[:, None], xpos[:, 2:]], 1)
        margin = success_margin(launch, xpos=poses, xquat=xquat, **fixed)
        (grad,) = torch.autograd.grad(margin.sum(), ball)
        ball = (ball + 0.02 * grad).detach().requires_grad_()
    assert (margin >= 0).all()


def test_margin_needs_a_float_tensor(device, twin):
    """Without a tensor to differentiate the error says so."""
    launch, fixed, _ = _cases(twin, device)["boxing"]
    with pytest.raises(TypeError, match="launch_boxing"):
        success_margin(launch, **fixed)


def test_first_call_of_a_process():
    """Both functions work, gradients and all, when nothing in the process has called Warp before."""
    for child in [Child("first_call", [name]) for name in ("reference_step", "success_margin")]:
        _, complaints = child.communicate(300)
        assert child.returncode == 0, complaints[-1500:]
