"""Tracking networks of mjlab and of BeyondMimic: an ONNX file whose metadata say what it sees and what drives it.

Facts are those of mjlab 1.6 (its task `tracking` and its ONNX exporter) and of BeyondMimic (HybridRobotics'
whole_body_tracking), from which it has names and formulas: the networks with state estimation and without. Of their
further inputs and outputs, the clock and the motion that they were trained on, nothing is used: the reference is that
of the policy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.g1 import MUJOCO_JOINTS, TWIST2_DRIVE, DriveGains, PhysicsRate
from arena_newton.robot.rotations import gravity_in_body, matrix_from_quat, quat_apply, quat_conjugate, quat_multiply
from arena_newton.trackers.front_end import FrontEnd, NetworkTracker
from arena_newton.trackers.inference import onnx_mlp
from arena_newton.trackers.inference.onnx_session import OnnxSession
from arena_newton.trackers.interface import JOINTS, ActionForm
from arena_newton.usd_scenes.g1.links import LINKS

__all__ = ["TERMS", "MjlabFrontEnd", "MjlabTracker", "ObservedTerm", "from_checkpoint"]

IMU = (0.04525, 0.0, -0.08339)
"""Position of the IMU in the pelvis [m] (mjlab's model of the G1), whose velocity is `base_lin_vel`."""
NATURAL_FREQUENCY, DAMPING_RATIO = 20.0 * math.pi, 2.0
"""Both projects' drives [rad/s]: stiffness is rotor inertia × frequency², damping 2 × ratio × inertia × frequency."""
_AXES = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
_WAIST = [
    (link.offset, _AXES[link.hinge.axis], MUJOCO_JOINTS.index(link.hinge.name))
    for link in LINKS
    if link.hinge is not None and link.hinge.name.startswith("waist_")
]
"""Offset from the link below [m], axis and joint of the waist's links, from the pelvis to the torso."""
_ANCHORS = {"pelvis": [], "torso_link": _WAIST}
"""Links that a reference can be compared at, and the links that lead to them."""
_PER_JOINT = ("joint_stiffness", "joint_damping", "default_joint_pos", "action_scale")


@dataclass(frozen=True)
class ObservedTerm:
    """A term of the observation, by its name in the metadata."""

    width: int
    value: Callable[[MjlabFrontEnd, TrackerCommand, RobotState], torch.Tensor]
    """Its value, shape [worlds, width], joints in the file's order."""
    needs: tuple[str, ...] = ()
    """Fields of `interfaces.NEEDS` that it reads."""


TERMS: Mapping[str, ObservedTerm] = {
    "command": ObservedTerm(2 * JOINTS, lambda f, c, s: torch.cat((f.ordered(c.joints), f.ordered(c.joint_vel)), 1)),
    "motion_anchor_pos_b": ObservedTerm(3, lambda f, c, s: f.anchor_offset(c, s), ("position",)),
    "motion_anchor_ori_b": ObservedTerm(6, lambda f, c, s: f.anchor_turn(c, s)),
    "base_lin_vel": ObservedTerm(3, lambda f, c, s: f.imu_velocity(s), ("lin_vel",)),
    "base_ang_vel": ObservedTerm(3, lambda f, c, s: s.ang_vel_body),
    "projected_gravity": ObservedTerm(3, lambda f, c, s: gravity_in_body(s.quat)),
    "joint_pos": ObservedTerm(JOINTS, lambda f, c, s: f.ordered(s.joint_pos - f.pose)),
    "joint_vel": ObservedTerm(JOINTS, lambda f, c, s: f.ordered(s.joint_vel)),
    "actions": ObservedTerm(JOINTS, lambda f, c, s: f.last_action),
}
"""Terms that networks of the two projects see."""


class MjlabFrontEnd(FrontEnd):
    """The terms that a file names, in its order; nothing is remembered but the last action."""

    graphable = True
    pose: torch.Tensor
    """Default pose [rad], MuJoCo order, shape [29]."""

    def __init__(
        self,
        terms: Sequence[str],
        order: Sequence[int],
        default_pose: tuple[float, ...],
        action_form: ActionForm,
        *,
        scales: Sequence[float] | None = None,
        anchor: str = "torso_link",
    ):
        """Take what the metadata say.

        Args:
            terms: Names in `TERMS`.
            order: MuJoCo index of each of the file's joints.
            default_pose: [rad], MuJoCo order.
            action_form: Scale per joint, MuJoCo order.
            scales: Factor of each term; 1 by default.
            anchor: Link whose pose is compared with the reference's.
        """
        super().__init__(action_form)
        self.terms, self.order, self.default_pose, self.anchor = tuple(terms), tuple(order), default_pose, anchor
        self.scales = tuple(scales or (1.0,) * len(self.terms))
        self.obs_width = sum(TERMS[name].width for name in terms)
        self.needs = tuple(dict.fromkeys(need for name in terms for need in TERMS[name].needs))

    def bind(self, worlds: int, device: torch.device | str = "cpu", obs: torch.Tensor | None = None) -> None:
        """Allocate buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device, obs)
        self.pose = torch.tensor(self.default_pose, device=self.device)
        self._order = torch.tensor(self.order, device=self.device)
        self._to_mujoco = torch.argsort(self._order)
        self._imu = torch.tensor(IMU, device=self.device)
        self._scales = torch.cat(
            [torch.full((TERMS[n].width,), s, device=self.device) for n, s in zip(self.terms, self.scales, strict=True)]
        )
        self._chain = [
            (self._imu.new_tensor(offset), self._imu.new_tensor(axis), joint)
            for offset, axis, joint in _ANCHORS[self.anchor]
        ]

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Nothing: there is no history."""

    def write(self, command: TrackerCommand, state: RobotState) -> None:
        """Write the terms."""
        values = [TERMS[name].value(self, command, state) for name in self.terms]
        self.obs.copy_(torch.cat(values, 1)).mul_(self._scales)

    def advance(self, rows: torch.Tensor | None = None) -> None:
        """Nothing: the last action is the base's."""

    def to_mujoco(self, raw: torch.Tensor) -> torch.Tensor:
        """The raw output, which is in the file's order, in MuJoCo order."""
        return raw.index_select(1, self._to_mujoco)

    def ordered(self, joints: torch.Tensor) -> torch.Tensor:
        """Joints in the file's order, shape [worlds, 29]."""
        return joints.index_select(1, self._order)

    def anchor_turn(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """Two columns of the rotation from the robot's anchor to the reference's, row by row, shape [worlds, 6]."""
        here, there = self._anchor(state.quat, state.joint_pos)[1], self._anchor(command.quat, command.joints)[1]
        return matrix_from_quat(quat_multiply(quat_conjugate(here), there))[..., :2].flatten(1)

    def anchor_offset(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """Position of the reference's anchor in the frame of the robot's [m], shape [worlds, 3]."""
        assert command.position is not None and state.position is not None
        offset, turn = self._anchor(state.quat, state.joint_pos)
        there = command.position + self._anchor(command.quat, command.joints)[0]
        return quat_apply(quat_conjugate(turn), there - (state.position + offset))

    def imu_velocity(self, state: RobotState) -> torch.Tensor:
        """Velocity of the IMU in the pelvis' frame [m/s], shape [worlds, 3]."""
        assert state.lin_vel is not None
        lever = torch.cross(state.ang_vel_body, self._imu.expand_as(state.ang_vel_body), dim=1)
        return quat_apply(quat_conjugate(state.quat), state.lin_vel) + lever

    def _anchor(self, quat: torch.Tensor, joints: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Anchor's offset from the root in the world [m] and its orientation, shapes [worlds, 3] and [worlds, 4]."""
        offset = torch.zeros_like(quat[:, 1:])
        for step, axis, joint in self._chain:
            offset = offset + quat_apply(quat, step.expand_as(offset))
            half = 0.5 * joints[:, joint, None]
            quat = quat_multiply(quat, torch.cat((torch.cos(half), torch.sin(half) * axis), 1))
        return offset, quat


class MjlabTracker(NetworkTracker):
    """A tracking network of mjlab or BeyondMimic, with the gains, pose and scales of its file."""

    name = "mjlab"
    physics_rate = fast_physics_rate = PhysicsRate(dt=0.005, substeps=4)


def _numbers(where: str, metadata: Mapping[str, str], key: str, count: int, default: str = "") -> tuple[float, ...]:
    """Finite numbers of a key; one alone counts for all."""
    text = metadata.get(key, default)
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    values = values * count if len(values) == 1 else values
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{where}: its metadata's {key} must be {count} numbers, as mjlab writes them: {text[:80]!r}")
    return values


def from_checkpoint(checkpoint: Path | None) -> MjlabTracker:
    """Make the tracker of a network that mjlab or BeyondMimic exported.

    Raises:
        InputError: No file, or one that lacks metadata, is for another robot, or sees what no reference holds.
    """
    if checkpoint is None:
        raise InputError("--tracker mjlab: pass --checkpoint with an .onnx file that mjlab or BeyondMimic exported")
    where = f"--checkpoint {checkpoint}"
    metadata = onnx_mlp.metadata(checkpoint)
    names = [name.rsplit("/", 1)[-1] for name in metadata.get("joint_names", "").split(",")]
    if sorted(names) != sorted(MUJOCO_JOINTS):
        raise InputError(f"{where}: its metadata's joint_names are not the {JOINTS} body joints of the G1")
    in_file = {key: _numbers(where, metadata, key, JOINTS) for key in _PER_JOINT}
    given = {key: tuple(values[names.index(joint)] for joint in MUJOCO_JOINTS) for key, values in in_file.items()}
    kp, kd, pose, scale = (given[key] for key in _PER_JOINT)
    terms = metadata.get("observation_names", "").split(",")
    for name in terms:
        if name not in TERMS:
            raise InputError(f"{where}: it sees {name or 'nothing'}; known terms are {', '.join(TERMS)}")
    if max(_numbers(where, metadata, "observation_terms_history_length", len(terms), "0")) > 1:
        raise InputError(f"{where}: it sees histories of its terms, expected the present alone")
    if set(metadata.get("observation_terms_clip", "-inf;inf").split(",")) != {"-inf;inf"}:
        raise InputError(f"{where}: it sees clipped terms, expected terms without limits")
    anchor = metadata.get("anchor_body_name", "torso_link")
    if anchor not in _ANCHORS:
        raise InputError(f"{where}: its anchor_body_name {anchor!r} is not one of {', '.join(_ANCHORS)}")
    front = MjlabFrontEnd(
        terms,
        [MUJOCO_JOINTS.index(name) for name in names],
        pose,
        ActionForm("default", scale),
        scales=_numbers(where, metadata, "observation_terms_scale", len(terms), "1"),
        anchor=anchor,
    )
    network = OnnxSession(checkpoint, in_width=front.obs_width, out_width=JOINTS)
    tracker = MjlabTracker(front, network, checkpoint=str(checkpoint), checkpoint_hash=network.sha256[:12])
    # Made by the two projects' rule, the gains say for which rotor inertia; otherwise the robot keeps its own.
    ratio = 2.0 * DAMPING_RATIO / NATURAL_FREQUENCY
    designed = all(math.isclose(d, p * ratio, rel_tol=0.02) for p, d in zip(kp, kd, strict=True))
    armature = tuple(p / NATURAL_FREQUENCY**2 for p in kp) if designed else None
    tracker.drive = DriveGains("mjlab", kp, kd, TWIST2_DRIVE.effort, armature=armature)
    tracker.ignores = () if "motion_anchor_pos_b" in terms else ("root xy", "root height")
    return tracker
