"""A small library that needs no generator: a stand and a squat, made with the forward kinematics."""

import numpy as np
import pytest
import torch

from arena_newton.robot.g1 import DEFAULT_POSE
from arena_newton.trackers.motions import kinematics
from arena_newton.trackers.motions.library import MotionLibrary


def squats(depths: tuple[float, ...] = (0.0, 0.3), ticks: int = 150, arms: float = 0.0) -> MotionLibrary:
    """Clips whose knees bend by `depths` [rad] and back, feet flat on the ground; `arms` raises both shoulders."""
    clips = len(depths)
    bend = np.outer(depths, 0.5 * (1.0 - np.cos(2.0 * np.pi * np.arange(ticks) / ticks)))
    joints = np.tile(np.array(DEFAULT_POSE), (clips, ticks, 1))
    for leg in (0, 6):
        joints[..., leg] -= 0.5 * bend
        joints[..., leg + 3] += bend
        joints[..., leg + 4] -= 0.5 * bend
    joints[..., [15, 22]] -= arms
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (clips * ticks, 1))
    at = torch.zeros(clips * ticks, 3, dtype=torch.float64)
    poses = kinematics.forward(at, torch.tensor(quat), torch.tensor(joints.reshape(-1, 29)))
    ankle = poses.position[:, kinematics.link_index("left_ankle_roll_link")].numpy()
    stance = kinematics.neutral_stance()
    pos = np.stack([stance.ankle - ankle[:, 0], 0.0 * ankle[:, 0], kinematics.SOLE_HEIGHT - ankle[:, 2]], 1)
    return MotionLibrary(
        root_pos=pos,
        root_quat=quat,
        joint_pos=joints.reshape(-1, 29),
        hands=np.zeros((clips * ticks, 2)),
        clip_start=np.arange(clips) * ticks,
        clip_length=np.full(clips, ticks),
        family=(np.asarray(depths) > 0.0).astype(np.int64),
        family_names=np.array(["stand", "squat"]),
        clip_names=np.array([f"clip {i}" for i in range(clips)]),
        licence=np.full(clips, "Apache-2.0"),
        source=np.full(clips, "test"),
        support_kind=np.array([0] * (clips - 1) + [1]),
        support_box=np.array([[0.0] * 7] * (clips - 1) + [[-0.6, 0.0, 0.4, 0.0, 0.5, 0.6, 0.4]]),
    )


@pytest.fixture(scope="session")
def library() -> MotionLibrary:
    """A stand and a squat in front of a seat."""
    return squats()
