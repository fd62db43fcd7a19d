"""The lab in many worlds as torch tensors: the physics of a 50 Hz tick are one graph, torch and Warp share one stream.

All views are zero-copy. Nothing here waits for the device.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco_warp
import numpy as np
import torch
import warp as wp

from arena_newton.physics.scene import load_scene
from arena_newton.robot.g1 import DriveGains, PhysicsRate
from arena_newton.trackers.motions.library import FIXTURES
from arena_newton.trackers.train.references import KEY_LINKS
from arena_newton.trackers.train.train_options import TrainOptions

__all__ = ["Simulation", "share_stream"]


def share_stream(device: str) -> None:
    """Let torch work on Warp's stream of a CUDA device: kernels of both then run in the order of their launches."""
    if device.startswith("cuda"):
        wp.set_device(device)
        torch.cuda.set_device(torch.device(device))
        torch.cuda.set_stream(wp.stream_to_torch(device))


def _span(indices: Sequence[int] | np.ndarray) -> slice:
    """Consecutive addresses as a slice, which makes torch views instead of copies."""
    first = int(indices[0])
    if list(indices) != list(range(first, first + len(indices))):
        raise ValueError("the robot's addresses in the model are not consecutive")
    return slice(first, first + len(indices))


class Simulation:
    """State and per-world model fields of the lab as torch views; rows are worlds, joints in MuJoCo order."""

    def __init__(self, drive: DriveGains, rate: PhysicsRate, options: TrainOptions, device: str):
        """Build the lab with a tracker's gains and physics rate on `cpu` or `cuda:N`."""
        self.worlds, self.device, self.rate = options.worlds, device, rate
        self.scene = load_scene(
            "lab",
            worlds=options.worlds,
            device=device,
            hands="fixed",
            drive=drive,
            contacts_per_world=options.contacts_per_world,
            constraints_per_world=options.constraints_per_world,
        )
        self._m, self._d = self.scene.solver.mjw_model, self.scene.solver.mjw_data
        self._m.opt.timestep.fill_(rate.dt)
        # A full contact buffer would print a line per world and step; it is counted by `overflow` instead.
        self._m.opt.warn_overflow = 0
        host, handles, d, m = self.scene.mj_model, self.scene.robot, self._d, self._m
        view = wp.to_torch
        self.qpos, self.qvel, self.ctrl = view(d.qpos), view(d.qvel), view(d.ctrl)
        self.warmstart, self.acceleration = view(d.qacc_warmstart), view(d.qacc)
        self.body_pos = view(d.xpos)
        """Body positions [m], shape [worlds, nbody, 3]."""
        self.body_force = view(d.xfrc_applied)
        """Force and torque on each body, world frame [N, N·m], shape [worlds, nbody, 6]."""
        self.overflow = view(d.overflow)
        self.mocap_pos, self.mocap_quat = view(d.mocap_pos), view(d.mocap_quat)
        root_q, root_v = handles.root_qpos, handles.root_qvel
        joints_q, joints_v = _span(handles.joint_qpos), _span(handles.joint_qvel)
        self.root_pos, self.root_quat = self.qpos[:, root_q : root_q + 3], self.qpos[:, root_q + 3 : root_q + 7]
        self.root_vel, self.root_ang_vel = self.qvel[:, root_v : root_v + 3], self.qvel[:, root_v + 3 : root_v + 6]
        self.joint_pos, self.joint_vel = self.qpos[:, joints_q], self.qvel[:, joints_v]
        self.joint_acc = self.acceleration[:, joints_v]
        self.torque = view(d.qfrc_actuator)[:, joints_v]
        self.targets = self.ctrl[:, _span(handles.joint_ctrl)]
        # Model fields, one row per world as Newton allocates them: writing them is enough.
        self.body_mass, self.body_inertia, self.body_com = view(m.body_mass), view(m.body_inertia), view(m.body_ipos)
        self.geom_friction = view(m.geom_friction)
        self.gain, self.bias = view(m.actuator_gainprm), view(m.actuator_biasprm)
        actuated = np.array([host.dof_jntid[a] for a in handles.joint_qvel])
        self.effort_range = view(m.jnt_actfrcrange)[:, _span(actuated)]
        """Torque limits [N·m], shape [worlds, 29, 2]."""
        limits = host.jnt_range[actuated]
        self.joint_range = torch.tensor(limits, dtype=torch.float32, device=device)
        """Lower and upper joint angle [rad], shape [29, 2]."""
        self.bodies = {
            n: self.scene.link(n) for n in (p.rsplit("/", 1)[1] for p in self.scene.body_ids if "/Robot/" in p)
        }
        """Link name to body index."""
        self._key_bodies = torch.tensor([self.bodies[name] for name in KEY_LINKS], device=device)
        self._on_ground = torch.tensor((1.0, 1.0, 0.0), device=device)
        self._fixtures = [self.scene.mocap_id(f"/World/{name}") for name in FIXTURES]
        self._parked_pos = self.mocap_pos[:, self._fixtures].clone()
        self._parked_quat = self.mocap_quat[:, self._fixtures].clone()
        self._graph: wp.Graph | None = None
        self._want_graph = options.graph

    def _launch(self) -> None:
        for _ in range(self.rate.substeps):
            mujoco_warp.step(self._m, self._d)
        # Body poses of the new state: `step` leaves those of the last substep's start.
        mujoco_warp.kinematics(self._m, self._d)

    def finish(self) -> None:
        """Derive what depends on changed masses and capture the tick; call once, after the model's fields are set."""
        with wp.ScopedDevice(self.device):
            mujoco_warp.set_const(self._m, self._d)
            if not self._want_graph:
                return
            self._launch()
            with wp.ScopedCapture(self.device) as capture:
                self._launch()
            self._graph = capture.graph

    def step(self) -> None:
        """Advance all worlds by one 50 Hz tick."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        with wp.ScopedDevice(self.device):
            self._launch()

    def key_links(self) -> torch.Tensor:
        """`KEY_LINKS` relative to the ground below the pelvis, world axes [m], shape [worlds, links, 3]."""
        return self.body_pos.index_select(1, self._key_bodies) - (self.root_pos * self._on_ground)[:, None]

    def place_supports(self, mask: torch.Tensor, kind: torch.Tensor, top: torch.Tensor, quat: torch.Tensor) -> None:
        """Pose the fixtures of the masked worlds: the clip's one where the clip needs it, the others out of reach.

        Args:
            mask: Worlds to change, bool, shape [worlds].
            kind: 0 none, 1 seat, 2 sill, 3 platform, shape [worlds].
            top: Centre of the support's top face [m], shape [worlds, 3].
            quat: Orientation of the support wxyz, shape [worlds, 4].
        """
        row = mask[:, None]
        for i, fixture in enumerate(self._fixtures):
            used = (kind == i + 1)[:, None]
            pos, rot = self.mocap_pos[:, fixture], self.mocap_quat[:, fixture]
            pos.copy_(torch.where(row, torch.where(used, top, self._parked_pos[:, i]), pos))
            rot.copy_(torch.where(row, torch.where(used, quat, self._parked_quat[:, i]), rot))
