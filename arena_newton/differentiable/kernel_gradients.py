"""Gradients of the kernels for torch: reference integration and success margins as `torch.autograd.Function`.

Forward runs the very kernel that the benchmark runs, recorded on a `wp.Tape`; backward replays the tape. Gradients are
those of a function that is smooth almost everywhere: at ties of a minimum they are one of the one-sided ones. Kernels
compute in float32; in float64 the reference is integrated by torch.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import warp as wp

from arena_newton.cli.quiet import quiet_warp
from arena_newton.kernels.canonical import LEVEL_FLOOR, ReferencePose, launch_integrate
from arena_newton.physics.streams import on_torch_stream
from arena_newton.robot import rotations
from arena_newton.robot.canonical import ACTION
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO, MUJOCO_TO_CANONICAL, TICK

__all__ = ["Recording", "ReferenceState", "recorded", "reference_step", "success_margin"]

quiet_warp()  # a tensor handed over may be the first that the process asks of Warp

Recording = Callable[..., tuple[wp.Tape, list[wp.array]]]
"""Launches on a tape: (arrays) → the tape and its outputs."""
JOINTS = len(CANONICAL_TO_MUJOCO)
_FLOAT_STATE = ("position", "quat", "joints", "prev_yaw", "prev_z")


class ReferenceState(NamedTuple):
    """State of the reference between two steps, as torch tensors."""

    position: torch.Tensor
    """World position [m], shape [worlds, 3]."""
    quat: torch.Tensor
    """World orientation of the target, wxyz, shape [worlds, 4]."""
    joints: torch.Tensor
    """Joint targets [rad], canonical order, shape [worlds, 29]."""
    prev_yaw: torch.Tensor
    """Yaw of the last target [rad], shape [worlds]."""
    prev_z: torch.Tensor
    """Height of the last action [m], shape [worlds]."""
    heading: torch.Tensor
    """Heading of the robot at reset [rad], shape [worlds]; in float32 a constant."""
    steps: torch.Tensor
    """Steps since the reset, int32, shape [worlds]."""
    joint_vel: torch.Tensor
    """Backward difference of the joint targets [rad/s], shape [worlds, 29]; an output only."""

    @classmethod
    def of(cls, ref: ReferencePose) -> ReferenceState:
        """Copies the state of a reference pose."""
        return cls(*(wp.to_torch(getattr(ref, name), requires_grad=False).clone() for name in cls._fields))

    @classmethod
    def anchored(cls, root: torch.Tensor) -> ReferenceState:
        """State of a reference that starts at the robot, as `kernels.canonical.launch_reset_reference` sets it.

        Args:
            root: Position [m] and orientation wxyz of the robot, shape [worlds, 7].
        """
        quat = torch.nn.functional.normalize(root[:, 3:7], dim=1)
        yaw, still = rotations.heading(quat), root.new_zeros(len(root), JOINTS)
        steps = torch.zeros(len(root), dtype=torch.int32, device=root.device)
        return cls(root[:, :3], quat, still, yaw, root[:, 2], yaw, steps, still)


def _backpropagate(
    tape: wp.Tape, inputs: Sequence[wp.array], outputs: Sequence[wp.array], grads: Sequence[torch.Tensor | None]
) -> list[torch.Tensor | None]:
    """Runs a tape backward from gradients of its outputs; gives gradients of its inputs, None where none is kept."""
    seeds = {
        array: wp.from_torch(grad.detach().contiguous(), dtype=array.dtype)
        for array, grad in zip(outputs, grads, strict=True)
        if grad is not None
    }
    tape.backward(grads=seeds)
    result = [wp.to_torch(a.grad).clone() if a is not None and a.requires_grad else None for a in inputs]
    tape.zero()
    return result


class _Recorded(torch.autograd.Function):
    """`record(*arrays) -> (tape, outputs)` as a torch function of the tensors behind the arrays."""

    @staticmethod
    def forward(ctx: Any, record: Recording, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        with on_torch_stream(tensors[0].device):
            arrays = [
                wp.from_torch(t.detach().contiguous(), requires_grad=need)
                for t, need in zip(tensors, ctx.needs_input_grad[1:], strict=True)
            ]
            tape, outputs = record(*arrays)
            results = tuple(wp.to_torch(o, requires_grad=False).clone() for o in outputs)
        ctx.tape, ctx.arrays, ctx.outputs = tape, arrays, outputs
        return results

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        with on_torch_stream(next(g for g in grads if g is not None).device):
            return None, *_backpropagate(ctx.tape, ctx.arrays, ctx.outputs, grads)


def recorded(record: Recording, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Outputs of launches on a tape as torch tensors, differentiable in the tensors that they read.

    Args:
        record: Launches; it gets the tensors as float32 arrays and returns its tape and the arrays that are outputs.
        *tensors: What it reads, float32.
    """
    outputs: tuple[torch.Tensor, ...] = _Recorded.apply(record, *tensors)
    return outputs


def reference_step(
    action: torch.Tensor, state: ReferenceState, *, max_root_delta_deg: float = 0.0
) -> tuple[torch.Tensor, ReferenceState]:
    """One step of the canonical reference, differentiable in the action and in the state before it.

    Args:
        action: Canonical actions, float32 (the kernel itself) or float64 (the same by torch), shape [worlds, 40].
        state: The state before; `ReferenceState.of` copies it from a running reference.
        max_root_delta_deg: Largest rotation [deg] between consecutive targets; 0 = no limit.

    Returns:
        The mimic command, shape [worlds, 35], and the state after, whose position and quat are the target pose.
    """
    if action.dtype == torch.float64:
        return _double_step(action, state, math.radians(max_root_delta_deg))
    worlds = action.shape[0]
    steps = torch.empty_like(state.steps)

    def record(action_array: wp.array, *floats: wp.array) -> tuple[wp.Tape, list[wp.array]]:
        device = action_array.device
        after = ReferencePose.allocate(
            worlds, device, canonical_to_mujoco=CANONICAL_TO_MUJOCO, tick=TICK, requires_grad=True
        )
        before = dataclasses.replace(
            after,
            heading=wp.from_torch(state.heading.detach().contiguous()),
            steps=wp.from_torch(state.steps.contiguous()),
            **dict(zip(_FLOAT_STATE, floats, strict=True)),
        )
        mask = wp.full(worlds, 1, dtype=wp.int32, device=device)
        tape = wp.Tape()
        with tape:
            launch_integrate(before, action_array, mask, max_root_delta_deg, out=after)
        steps.copy_(wp.to_torch(after.steps))
        return tape, [after.mimic, *(getattr(after, name) for name in _FLOAT_STATE), after.joint_vel]

    mimic, position, quat, joints, prev_yaw, prev_z, joint_vel = recorded(
        record, action, *(getattr(state, name) for name in _FLOAT_STATE)
    )
    return mimic, ReferenceState(position, quat, joints, prev_yaw, prev_z, state.heading, steps, joint_vel)


def _double_step(
    action: torch.Tensor, state: ReferenceState, max_root_delta: float
) -> tuple[torch.Tensor, ReferenceState]:
    """`kernels.canonical.integrate_kernel` in float64."""
    first = state.steps == 0
    moved, z = action[:, ACTION["root_xy_delta"]], action[:, 2]
    target = rotations.quat_multiply(
        rotations.quat_from_yaw(state.heading), rotations.quat_from_rot6d(action[:, ACTION["root_rot6d"]])
    )
    if max_root_delta > 0.0:
        turn = rotations.rotation_vector(rotations.quat_multiply(rotations.quat_conjugate(state.quat), target))
        half = 0.5 * turn.norm(dim=1, keepdim=True).clamp_min(max_root_delta)  # of those beyond the limit
        axis, sine, cosine = 0.5 * turn / half, math.sin(0.5 * max_root_delta), math.cos(0.5 * max_root_delta)
        limit = torch.cat([torch.full_like(half, cosine), sine * axis], dim=1)
        limited = rotations.quat_multiply(state.quat, limit)
        target = torch.where(2.0 * half > max_root_delta, limited, target)
    rotation = rotations.matrix_from_quat(target)
    level = rotation[:, 2, 2]
    rise = torch.where(first, 0.0, z - state.prev_z) - (rotation[:, 2, :2] * moved).sum(1)
    flat = level.abs() > LEVEL_FLOOR
    local = torch.cat([moved, torch.where(flat, rise / torch.where(flat, level, 1.0), 0.0)[:, None]], dim=1)
    position = torch.cat([state.position[:, :2] + (rotation[:, :2] @ local[:, :, None])[..., 0], z[:, None]], dim=1)
    yaw, joints = rotations.heading(target), action[:, ACTION["joint_pos"]]
    joint_vel = torch.where(first[:, None], 0.0, (joints - state.joints) / TICK)
    yaw_rate = rotations.wrap_angle(yaw - state.prev_yaw) / TICK
    ordered = joints[:, list(MUJOCO_TO_CANONICAL)]
    parts = moved / TICK, z[:, None], rotations.roll_pitch(target), yaw_rate[:, None], ordered
    after = ReferenceState(position, target, joints, yaw, z, state.heading, state.steps + 1, joint_vel)
    return torch.cat(parts, dim=1), after


def success_margin(launch: Callable[..., None], **arguments: object) -> torch.Tensor:
    """The margin of a success predicate, differentiable in every floating-point tensor among the arguments.

    Args:
        launch: A wrapper of `kernels.rules.success`, such as `launch_football`.
        **arguments: Its arguments by name. Tensors (float32 or int32) stand for Warp arrays; boxes, numbers and Warp
            arrays pass through. Leave out the outputs and the counter: they are made here, the counter as zero.

    Returns:
        The margin [m], shape [worlds].
    """
    floats = {k: v for k, v in arguments.items() if isinstance(v, torch.Tensor) and v.is_floating_point()}
    if not floats:
        raise TypeError(f"{launch.__name__} needs at least one floating-point tensor to differentiate")
    fixed = {
        k: wp.from_torch(v.contiguous()) if isinstance(v, torch.Tensor) else v
        for k, v in arguments.items()
        if k not in floats
    }
    worlds = next(iter(floats.values())).shape[0]

    def record(*arrays: wp.array) -> tuple[wp.Tape, list[wp.array]]:
        device = arrays[0].device
        margin = wp.zeros(worlds, dtype=wp.float32, device=device, requires_grad=True)
        made = {
            name: wp.zeros(worlds, dtype=wp.int32, device=device)
            for name in ("success", "counter", "event")
            if name in inspect.signature(launch).parameters
        }
        tape = wp.Tape()
        with tape:
            launch(**dict(zip(floats, arrays, strict=True)), **fixed, **made, margin=margin)
        return tape, [margin]

    return recorded(record, *floats.values())[0]
