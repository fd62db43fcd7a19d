"""Pictures of motion clips: the robot posed frame by frame in the lab scene, no physics."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from arena_newton.errors import InputError
from arena_newton.physics.scene import load_scene
from arena_newton.pictures.camera import Camera, WorldLights
from arena_newton.robot import g1
from arena_newton.robot.rotations import heading_np, quat_from_yaw_np
from arena_newton.tasks import LightDraw
from arena_newton.trackers.motions.library import FIXTURES, SUPPORTS, MotionLibrary

__all__ = ["ClipRenderer"]

FOCAL_LENGTH, APERTURE = 37.0, 20.0
"""The lens: 1.5 m wide at the robot [mm]."""
TARGET_HEIGHT = 0.68
"""Height that the camera looks at [m]; it does not follow the pelvis down, so that squats show."""
EYE = (1.1, -2.6, 0.35)
"""Eye from there [m]: from the robot's right, a little ahead."""
LIGHT_DIRECTION = (-0.35, 0.45, -1.0)
"""Direction from the light to the scene; its shadows show whether a foot is on the floor."""
LIGHT_INTENSITY = 4000.0
_FIXTURE = {kind: f"/World/{name}" for kind, name in zip(SUPPORTS[1:], FIXTURES, strict=True)}
"""Support → the lab's prim of it."""


class ClipRenderer:
    """Poses the robot as a library's frames say and takes pictures that follow it."""

    def __init__(self, library: MotionLibrary, *, width: int = 240, height: int = 320):
        """Build the scene for pictures of `width` by `height` [px].

        Raises:
            InputError: A size below 16 px.
        """
        if min(width, height) < 16:
            raise InputError(f"render: pictures of {width}x{height} px, expected at least 16 each way")
        self.library, self.width, self.height = library, width, height
        self.scene = load_scene("lab", worlds=1, device="cpu", native=True)
        self._data = mujoco.MjData(self.scene.mj_model)
        self._parked = self._data.mocap_pos.copy()
        self._state = self.scene.model.state()
        self._lights = WorldLights.allocate(1, self.scene.device, self.scene.stage)
        self._lights.set(0, LightDraw(LIGHT_DIRECTION, LIGHT_INTENSITY, (1.0, 1.0, 1.0)))

    def pictures(self, clip: int, frames: np.ndarray) -> Iterator[np.ndarray]:
        """Pictures of a clip, uint8 [height, width, 3], of frames counted from its start.

        The clip is turned to start towards +x, and its path centred on the floor.
        """
        rows = self.library.rows(clip)
        pos, quat = (getattr(self.library, name)[rows].astype(np.float64) for name in ("root_pos", "root_quat"))
        turn = quat_from_yaw_np(-heading_np(quat[0]))
        matrix = np.zeros((3, 3))
        mujoco.mju_quat2Mat(matrix.reshape(9), turn)
        pos = pos @ matrix.T
        middle = (pos[:, :2].min(axis=0) + pos[:, :2].max(axis=0)) / 2
        pos[:, :2] -= middle
        self._place_support(clip, turn, matrix, middle)
        joints, hands = self.library.joint_pos[rows], self.library.hands[rows]
        for frame in frames:
            root = np.zeros(4)
            mujoco.mju_mulQuat(root, turn, quat[frame])
            self._pose(pos[frame], root, joints[frame], hands[frame])
            yield self._camera(pos[frame]).render(self._state)[0].cpu().numpy().copy()

    def _place_support(self, clip: int, turn: np.ndarray, matrix: np.ndarray, middle: np.ndarray) -> None:
        self._data.mocap_pos[:] = self._parked
        kind = SUPPORTS[self.library.support_kind[clip]]
        if kind not in _FIXTURE:
            return
        box = self.library.support_box[clip].astype(np.float64)
        mocap = self.scene.mocap_id(_FIXTURE[kind])
        self._data.mocap_pos[mocap] = matrix @ box[:3] - [*middle, 0.0]
        mujoco.mju_mulQuat(self._data.mocap_quat[mocap], turn, quat_from_yaw_np(box[3]))

    def _pose(self, pos: np.ndarray, quat: np.ndarray, joints: np.ndarray, hands: np.ndarray) -> None:
        robot, data = self.scene.robot, self._data
        data.qpos[robot.root_qpos : robot.root_qpos + 3] = pos
        data.qpos[robot.root_qpos + 3 : robot.root_qpos + 7] = quat
        data.qpos[robot.joint_qpos] = joints
        closed = (g1.HAND_CLOSE_LEFT, g1.HAND_CLOSE_RIGHT)
        for side in range(2):
            fingers = robot.hand_qpos[7 * side : 7 * side + 7]
            data.qpos[fingers] = closed[side] if hands[side] >= 0.5 else g1.HAND_OPEN
        mujoco.mj_kinematics(self.scene.mj_model, data)
        poses = self._state.body_q.numpy()
        bodies = self.scene.body_to_newton[0]
        moving = bodies >= 0
        poses[bodies[moving], :3] = data.xpos[moving]
        poses[bodies[moving], 3:] = data.xquat[moving][:, [1, 2, 3, 0]]
        self._state.body_q.assign(poses)

    def _camera(self, pos: np.ndarray) -> Camera:
        eye = np.array([pos[0], pos[1], TARGET_HEIGHT]) + EYE
        back = np.array(EYE) / np.linalg.norm(EYE)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).ravel())
        return Camera(
            self.scene.model,
            np.array([-1]),
            tuple(eye),
            tuple(quat),
            width=self.width,
            height=self.height,
            focal_length=FOCAL_LENGTH,
            horizontal_aperture=APERTURE,
            lights=self._lights,
            samples=2,
        )
