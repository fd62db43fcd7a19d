"""Whole-body inverse kinematics."""

import numpy as np
import pytest
import torch
import warp as wp

from arena_newton.kernels import ik
from arena_newton.robot import rotations
from arena_newton.robot.g1 import DEFAULT_POSE
from arena_newton.trackers.motions import kinematics

WORLDS = 24


class Solver:
    """Arrays of one batch, standing in the default pose."""

    def __init__(self, device: str, worlds: int = WORLDS):
        self.device, self.worlds = device, worlds
        self.model = ik.upload_model(kinematics.chain(), device)
        stance = kinematics.neutral_stance()
        self.goal = np.zeros((worlds, ik.GOAL_WIDTH), np.float32)
        g = self.goal
        g[:, ik.GOAL["com"]] = (stance.ankle + 0.03, 0.0)
        g[:, ik.GOAL["height"]] = 0.70
        feet = g[:, ik.GOAL["feet"]].reshape(worlds, 2, 5)
        feet[:, :, 0], feet[:, :, 2] = stance.ankle, kinematics.SOLE_HEIGHT
        feet[:, :, 1] = (0.11, -0.11)
        g[:, ik.GOAL["upper"]] = DEFAULT_POSE[12:]
        default = np.tile(np.float32(DEFAULT_POSE), (worlds, 1))
        up = self.up
        self.state = ik.IkState(
            pelvis=up(np.zeros((worlds, 2))),
            joints=up(default),
            arms=up(default[:, [15, 16, 17, 18, 22, 23, 24, 25]]),
            palms=up(np.zeros((worlds, 6))),
            com=up(np.zeros((worlds, 3))),
            error=up(np.zeros(worlds)),
        )

    @property
    def feet(self) -> np.ndarray:
        """Goals of the feet, a view."""
        return self.goal[:, ik.GOAL["feet"]].reshape(self.worlds, 2, 5)

    def up(self, values: np.ndarray, dtype=wp.float32) -> wp.array:
        """Uploads."""
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=dtype, device=self.device)

    def solve(self, ticks: int = 10, mask: np.ndarray | None = None) -> None:
        """Launches some ticks at the same goal."""
        on = np.ones(self.worlds) if mask is None else mask
        mask_array = wp.array(on.astype(np.int32), dtype=wp.int32, device=self.device)
        goal = self.up(self.goal)
        for _ in range(ticks):
            ik.launch_ik(self.model, goal, mask_array, self.state)

    def poses(self) -> kinematics.Poses:
        """Kinematics of the result, by torch."""
        g = self.goal.astype(float)
        half = 0.5 * np.concatenate([g[:, ik.GOAL[name]] for name in ("yaw", "pitch", "roll")], 1)
        (cz, cy, cx), (sz, sy, sx) = np.cos(half).T, np.sin(half).T
        quat = np.stack(
            [
                cz * cy * cx + sz * sy * sx,
                cz * cy * sx - sz * sy * cx,
                cz * sy * cx + sz * cy * sx,
                sz * cy * cx - cz * sy * sx,
            ],
            1,
        )
        root = np.concatenate([self.state.pelvis.numpy(), g[:, ik.GOAL["height"]]], 1)
        return kinematics.forward(*(torch.tensor(v, dtype=torch.float64) for v in (root, quat, self.joints)))

    @property
    def joints(self) -> np.ndarray:
        """Joint angles."""
        return self.state.joints.numpy()


def foot_rows() -> list[int]:
    """Links of the feet."""
    return [kinematics.link_index(f"{side}_ankle_roll_link") for side in ("left", "right")]


@pytest.fixture
def posed(device) -> Solver:
    """Random stances."""
    s, rng = Solver(device), np.random.default_rng(0)
    n = s.worlds
    s.goal[:, ik.GOAL["height"]] = rng.uniform(0.6, 0.74, (n, 1))
    s.goal[:, ik.GOAL["pitch"]] = rng.uniform(0.0, 0.4, (n, 1))
    s.goal[:, ik.GOAL["roll"]] = rng.uniform(-0.05, 0.05, (n, 1))
    yaw = s.goal[:, ik.GOAL["yaw"]] = rng.uniform(-3, 3, (n, 1)).astype(np.float32)
    s.goal[:, ik.GOAL["upper"]] += rng.uniform(-0.3, 0.3, (n, 17))
    c, k = np.cos(yaw), np.sin(yaw)
    x = s.feet[:, :, 0] + rng.uniform(-0.04, 0.04, (n, 2))
    y = s.feet[:, :, 1] + rng.uniform(-0.02, 0.02, (n, 2))
    com = np.stack([x.mean(1) + 0.03, y.mean(1)], 1)
    s.goal[:, ik.GOAL["com"]] = np.concatenate([c * com[:, :1] - k * com[:, 1:], k * com[:, :1] + c * com[:, 1:]], 1)
    s.feet[:, :, 0], s.feet[:, :, 1] = c * x - k * y, k * x + c * y
    s.feet[:, :, 3] = yaw + rng.uniform(-0.2, 0.2, (n, 2))
    s.solve(30)
    return s


def test_feet_and_balance(posed):
    """Feet stand flat where they should and the centre of mass is above its target, as torch's kinematics finds it."""
    poses = posed.poses()
    feet = posed.feet
    np.testing.assert_allclose(poses.position[:, foot_rows()], feet[:, :, :3], atol=5e-5)
    half = 0.5 * feet[:, :, 3]
    flat = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], -1)
    turned = np.abs((poses.quat[:, foot_rows()].numpy() * flat).sum(-1))
    assert (turned > np.cos(0.5 * 5e-4)).all()
    np.testing.assert_allclose(poses.com[:, :2], posed.goal[:, ik.GOAL["com"]], atol=1e-3)
    np.testing.assert_allclose(posed.state.com.numpy(), poses.com, atol=1e-4)
    assert posed.state.error.numpy().max() < 5e-5


def test_limits_keep_their_margin(posed):
    """No joint comes nearer to its limit than the margin."""
    low, high = kinematics.chain().limits[1:].T
    assert (posed.joints >= low + 0.0299).all() and (posed.joints <= high - 0.0299).all()


def test_hands_reach(device):
    """A reached hand point is met, near the posture's elbow, as torch's kinematics finds it."""
    s, rng = Solver(device), np.random.default_rng(1)
    points = np.stack(
        [
            rng.uniform(0.2, 0.36, (s.worlds, 2)),
            rng.uniform(0.05, 0.3, (s.worlds, 2)),
            rng.uniform(0.0, 0.4, (s.worlds, 2)),
        ],
        -1,
    )
    points[:, 1, 1] *= -1
    s.goal[:, ik.GOAL["hand_point"]] = points.reshape(-1, 6)
    s.goal[:, ik.GOAL["reach"]] = 1.0
    s.solve(60)
    poses = s.poses()
    wrist = [kinematics.link_index(f"{side}_wrist_yaw_link") for side in ("left", "right")]
    palm = torch.tensor([kinematics.HAND_POINT, 0.0, 0.0], dtype=torch.float64).expand(s.worlds, 2, 3)
    hands = poses.position[:, wrist] + rotations.quat_apply(poses.quat[:, wrist], palm)
    root = np.concatenate([s.state.pelvis.numpy(), s.goal[:, ik.GOAL["height"]]], 1)
    np.testing.assert_allclose(hands.numpy() - root[:, None], points, atol=3e-3)
    np.testing.assert_allclose(s.state.palms.numpy().reshape(-1, 2, 3), points, atol=3e-3)


def test_out_of_reach_stays_finite_and_comes_back(device):
    """A foot and a hand too far away stretch the limbs within limits; once back in reach they are met again."""
    s = Solver(device, worlds=4)
    here = s.goal.copy()
    s.feet[:, 0, 0] += (0.7, -0.7, 0.0, 0.7)
    s.feet[:, 0, 2] += (0.0, 0.0, -0.5, 0.5)
    s.goal[:, ik.GOAL["hand_point"]] = 2.0
    s.goal[:, ik.GOAL["reach"]] = 1.0
    s.solve(20)
    low, high = kinematics.chain().limits[1:].T
    assert np.isfinite(s.joints).all() and (s.joints >= low).all() and (s.joints <= high).all()
    assert s.state.error.numpy().min() > 0.01
    s.goal[:] = here
    s.solve(10)
    assert s.state.error.numpy().max() < 1e-4


def test_mask_leaves_worlds_alone(device):
    """Worlds outside the mask keep every number."""
    s = Solver(device, worlds=2)
    before = s.joints.copy()
    s.solve(5, mask=np.array([1, 0]))
    assert not np.array_equal(s.joints[0], before[0])
    assert np.array_equal(s.joints[1], before[1])


def test_seat_holds_the_pelvis_back(device):
    """With the seat's weight the pelvis stays behind its bound and the centre of mass is given up."""
    s = Solver(device, worlds=2)
    s.goal[:, ik.GOAL["height"]] = 0.55
    s.goal[:, ik.GOAL["seat"]] = -0.30
    s.goal[1, ik.GOAL["seat_weight"]] = 1.0
    s.solve(40)
    assert s.state.pelvis.numpy()[0, 0] > -0.2
    assert s.state.pelvis.numpy()[1, 0] == pytest.approx(-0.30, abs=0.02)
    assert s.state.error.numpy().max() < 1e-3
