"""A camera that follows a robot at a fixed offset and cuts to another one when something hides the robot."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import newton
import numpy as np

from arena_newton.pictures.camera import Camera

__all__ = ["Follower", "follow_pose", "room_walls", "visible"]

FOCAL, APERTURE = 18.0, 20.955
"""Lens: 60° wide [mm]."""
OFFSETS = ((-2.2, 1.7), (-2.2, -1.7), (-0.3, 2.7), (-0.3, -2.7), (2.2, 1.7), (2.2, -1.7))
"""Positions of the camera, ahead of and left of the pelvis in the spawn's heading, the preferred one first [m]."""
EYE_HEIGHT = 1.35
"""Its height above the floor [m]."""
AIM = (0.25, 0.0, 0.7)
"""Point that it looks at: ahead of and left of the pelvis, above the floor [m]."""
WALL_GAP = 0.25
"""It stays this far inside the walls of a room [m]."""
HEIGHTS = (0.3, 0.55, 0.8, 1.0, 1.2)
"""Points above the floor under the pelvis by which a robot counts as seen [m]."""
ENOUGH = 3
"""Number of them that must not be hidden."""
BODY = 0.45
"""Something this much nearer than such a point hides it; less is the robot itself [m]."""
PATIENCE = 50
"""Pause before the next search after no offset showed the robot [ticks]."""


def room_walls(model: mujoco.MjModel) -> tuple[tuple[np.ndarray, float], ...]:
    """Inward normal and offset [m] of the upright planes that bound a scene's room."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    found = [(data.geom_xmat[g].reshape(3, 3)[:, 2].copy(), data.geom_xpos[g].copy()) for g in planes]
    return tuple((normal, float(normal @ point)) for normal, point in found if abs(normal[2]) < 0.5)


def follow_pose(
    pelvis: Sequence[float] | np.ndarray,
    heading: float,
    offset: tuple[float, float] = OFFSETS[0],
    walls: Sequence[tuple[np.ndarray, float]] = (),
) -> np.ndarray:
    """Pose of the camera: position [m] and quaternion xyzw, float32 [7].

    Args:
        pelvis: x and y of the pelvis [m].
        heading: The direction that counts as ahead [rad].
        offset: See `OFFSETS` [m].
        walls: Inward normal and offset [m] of planes that it stays inside of.
    """
    cos, sin = np.cos(heading), np.sin(heading)

    def at(ahead: float, left: float, up: float) -> np.ndarray:
        return np.array([pelvis[0] + cos * ahead - sin * left, pelvis[1] + sin * ahead + cos * left, up])

    eye = at(*offset, EYE_HEIGHT)
    for normal, distance in walls:
        eye = eye + normal * max(0.0, distance + WALL_GAP - float(normal @ eye))
    back = eye - at(*AIM)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    # The camera looks along its −z with +y up: its axes are right, up, back. Yaw about z, then pitch about its own x.
    yaw, pitch = np.arctan2(right[1], right[0]), np.arctan2(np.hypot(back[0], back[1]), back[2])
    cy, sy, cp, sp = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return np.array([*eye, cy * sp, sy * sp, sy * cp, cy * cp], dtype=np.float32)


def visible(camera: Camera, view: int, pose: np.ndarray, pelvis: Sequence[float] | np.ndarray) -> int:
    """Number of `HEIGHTS` that nothing hides in a picture that was just drawn.

    Args:
        camera: The camera.
        view: Which of its pictures.
        pose: Its pose, position [m] and quaternion xyzw.
        pelvis: x and y of the pelvis [m].
    """
    points = np.array([[pelvis[0], pelvis[1], height] for height in HEIGHTS]) - pose[:3]
    axis, w = -pose[3:6].astype(np.float64), float(pose[6])
    cross = np.cross(axis, points)
    local = points + 2.0 * (w * cross + np.cross(axis, cross))
    distances = camera.distances(view, local)
    return int(np.sum((distances == 0.0) | (distances > np.linalg.norm(local, axis=1) - BODY)))


class Follower:
    """Draws pictures of robots from the offset at which each is seen; one per film, so that cuts are few."""

    def __init__(self, headings: dict[int, float], walls: Sequence[tuple[np.ndarray, float]]):
        """Start with the preferred offset everywhere.

        Args:
            headings: World → the direction that counts as ahead [rad].
            walls: See `follow_pose`.
        """
        self.headings, self.walls = headings, walls
        self._offset: dict[int, int] = {}
        self._wait: dict[int, int] = {}

    def draw(
        self, camera: Camera, state: newton.State, worlds: Sequence[int], pelvises: np.ndarray, ticks: Sequence[int]
    ) -> np.ndarray:
        """Pictures of some worlds, uint8 [len(worlds), H, W, 3].

        Args:
            camera: Camera with at least as many views as worlds are given.
            pelvises: x and y of each pelvis [m].
        """

        def pose(index: int, offset: int) -> np.ndarray:
            return follow_pose(pelvises[index], self.headings[worlds[index]], OFFSETS[offset], self.walls)

        poses = np.stack([pose(i, self._offset.get(world, 0)) for i, world in enumerate(worlds)])
        images = camera.render_worlds(state, worlds, poses).cpu().numpy().copy()
        seen = [visible(camera, i, poses[i], pelvises[i]) for i in range(len(worlds))]
        for i, world in enumerate(worlds):
            if seen[i] >= ENOUGH or ticks[i] < self._wait.get(world, 0):
                continue
            for offset in range(len(OFFSETS)):
                other = pose(i, offset)
                image = camera.render_worlds(state, [world], other[None])[0].cpu().numpy()
                count = visible(camera, 0, other, pelvises[i])
                if count > seen[i]:
                    seen[i], self._offset[world], images[i] = count, offset, image
                if count >= ENOUGH:
                    break
            else:
                self._wait[world] = ticks[i] + PATIENCE
        return images

    def forget(self, world: int) -> None:
        """A world's next film starts at the preferred offset."""
        self._offset.pop(world, None)
        self._wait.pop(world, None)
