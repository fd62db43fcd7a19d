"""FALCON as a tracker of arena_newton: what a stranger's package needs to bring.

FALCON (LeCAR-Lab, MIT) walks to a commanded velocity, stands at a commanded height and follows arm joints; it takes no
leg reference. Its network comes from its own project: `--tracker falcon --checkpoint g1_29dof.onnx`.
"""

from pathlib import Path

import torch

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.g1 import DriveGains, PhysicsRate
from arena_newton.trackers.front_end import ActionForm, FrontEnd, NetworkTracker, column, store
from arena_newton.trackers.inference.onnx_session import OnnxSession

FRAMES, FRAME = 5, 115
LEG = (-0.1, 0.0, 0.0, 0.3, -0.2, 0.0)
LEG_KP, LEG_KD = (100.0, 100.0, 100.0, 200.0, 20.0, 20.0), (2.5, 2.5, 2.5, 5.0, 0.2, 0.1)
ARM_KP, ARM_KD = (90.0, 60.0, 20.0, 60.0, 4.0, 4.0, 4.0), (2.0, 1.0, 0.4, 1.0, 0.2, 0.2, 0.2)
LEG_EFFORT, ARM_EFFORT = (88.0, 88.0, 88.0, 139.0, 50.0, 50.0), (25.0, 25.0, 25.0, 25.0, 25.0, 5.0, 5.0)

HEIGHT = 0.75
"""Height of its stance, the highest it takes [m]."""
WALKS_FROM = 0.08
"""Smoothed command above which it walks instead of standing [m/s, rad/s]."""
SMOOTHING = 0.04
"""Weight of the newest command in the smoothed one: a gait's sway (0.9 s) is not a command to walk sideways."""


class FalconFrontEnd(FrontEnd):
    """Five frames of 115 numbers, oldest first; within a frame the terms are in the order of their names."""

    obs_width = FRAMES * FRAME
    default_pose = (*LEG, *LEG, *(0.0,) * 17)

    def __init__(self):
        super().__init__(ActionForm("default", (0.25,) * 29, clip=100.0))

    def bind(self, worlds, device="cpu", obs=None):
        super().bind(worlds, device, obs)
        self.frames = self.obs.view(worlds, FRAMES, FRAME)
        self.smoothed = torch.zeros(worlds, 3, device=self.device)
        self.pose = torch.tensor(self.default_pose, device=self.device)

    def reset(self, mask=None):
        super().reset(mask)
        store(self.smoothed, torch.zeros_like(self.smoothed), column(mask, self.device))

    def prefill(self, command: TrackerCommand, state: RobotState, mask=None):
        self.write(command, state)
        store(self.frames, self.frames[:, -1:].clone().expand_as(self.frames), column(mask, self.device))

    def write(self, command: TrackerCommand, state: RobotState):
        mimic, frame = command.mimic, self.frames[:, -1]
        wanted = torch.stack((mimic[:, 0], mimic[:, 1], mimic[:, 5]), 1)
        self.now = self.smoothed + SMOOTHING * (wanted - self.smoothed)
        walks = (self.now.abs() > WALKS_FROM).any(1, keepdim=True)
        w, x, y, z = state.quat.unbind(1)
        down = torch.stack((2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1), 1)
        arms = command.joints[:, 15:]
        terms = (
            self.last_action,
            0.25 * state.ang_vel_body,
            self.now[:, 2:] * walks,
            2.0 * mimic[:, 2:3].clamp(max=HEIGHT),
            self.now[:, :2] * walks,
            walks.float(),
            command.joints[:, 12:15],
            state.joint_pos - self.pose,
            0.05 * state.joint_vel,
            down,
            arms,
        )
        frame.copy_(torch.cat(terms, 1))
        self.base[:, 15:] = arms

    def advance(self, rows=None):
        store(self.smoothed, self.now, rows)
        store(self.frames[:, :-1], self.frames[:, 1:].clone(), rows)


class FalconTracker(NetworkTracker):
    """FALCON behind the mimic command; the one class that the entry point names."""

    name = "falcon"
    drive = DriveGains(
        name="falcon",
        kp=(*LEG_KP, *LEG_KP, 300.0, 300.0, 300.0, *ARM_KP, *ARM_KP),
        kd=(*LEG_KD, *LEG_KD, 5.0, 5.0, 5.0, *ARM_KD, *ARM_KD),
        effort=(*LEG_EFFORT, *LEG_EFFORT, 88.0, 50.0, 50.0, *ARM_EFFORT, *ARM_EFFORT),
    )
    physics_rate = fast_physics_rate = PhysicsRate(dt=0.005, substeps=4)
    ignores = ("absolute heading", "absolute position", "leg joints", "root tilt")

    def __init__(self, checkpoint: Path | None):
        if checkpoint is None:
            raise InputError("--tracker falcon: pass --checkpoint with FALCON's g1_29dof.onnx")
        network = OnnxSession(checkpoint, in_width=FRAMES * FRAME, out_width=29)
        super().__init__(FalconFrontEnd(), network, checkpoint=str(checkpoint), checkpoint_hash=network.sha256[:12])
