"""Sizes and lenses that a run asks for: checked while it is planned, so nothing heavy is imported here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.interfaces import Policy

__all__ = [
    "CAMERAS",
    "DOME_COLOR",
    "DOME_INTENSITY",
    "FRONT",
    "MOST_PORT",
    "MOST_VIEWED",
    "SIZE_LIMITS",
    "STRIP_SIZES",
    "VIEWERS",
    "CameraConfig",
    "Fit",
    "policy_cameras",
    "recorded_camera",
    "robot_fit",
    "video_sizes",
    "FIGURES",
    "FIRST_SHAPE",
]

DOME_INTENSITY = 3000.0
"""Intensity of the original's dome light."""
DOME_COLOR = (0.75, 0.75, 0.75)
"""Colour of the original's dome light, linear RGB."""
FIRST_SHAPE = 2
"""First byte of a frame of looks that names a shape; 0 is the background, 1 the robot."""
FIGURES = 4
"""The last bytes are of no shape of a scene, but of figures that a training draws into its pictures."""
Fit = Literal["native", "pad"]
FRONT = "front"
"""Name of the head camera in datasets, and of its picture among those that a policy observes."""
CAMERAS = {FRONT: "ego", "left_wrist": "left_wrist", "right_wrist": "right_wrist", "world": "world"}
"""Name in datasets (the original's), and of what policies observe → camera of the scene."""
STRIP_SIZES = {"ego": (320, 240), "world": (480, 270)}
"""Size of a strip's frames (width, height) [px]."""
VIDEO_SIZE = (480, 270)
"""Size of world videos (width, height) [px]."""
SIZE_LIMITS = (32, 4096)
"""Smallest and largest width and height of a video, the head camera's too [px]; H.264 encoders end at 4096."""
VIEWERS = ("viser", "rerun", "usd")
"""Kinds of --viewer."""
MOST_VIEWED = 16
"""Most worlds that a viewer shows."""
MOST_PORT = 65534
"""Highest TCP port of a viewer's page: rerun takes the next one too."""


@dataclass(frozen=True)
class CameraConfig:
    """A camera for policies or videos."""

    width: int = 224
    """Image width [px]."""
    height: int = 224
    """Image height [px]."""
    prim: str = "ego"
    """`ego`, `left_wrist`, `right_wrist`, `world`, or the path of a camera prim."""
    fit: Fit = "pad"
    """`native`: the lens fills width × height with square pixels, horizontal view kept; `pad`: the sensor's own aspect
    (4:3 for the robot's cameras) inside width × height, black around it, as the original prepares policy images."""
    samples: int = 1
    """Rays per pixel along each axis (2 is 4 rays per pixel: smooth edges for videos)."""
    depth: bool = False
    """Observe depth next to the picture; for policies."""

    def named(self, name: str) -> CameraConfig:
        """The camera of a name in `CAMERAS`, where `prim` is left at its default."""
        return self if self.prim != CameraConfig.prim else replace(self, prim=CAMERAS.get(name, self.prim))


def policy_cameras(policy: Policy) -> dict[str, CameraConfig]:
    """Pictures that a policy wants, by name: its `cameras`, or the head camera's alone where it `needs_image`."""
    named: Mapping[str, CameraConfig] | None = getattr(policy, "cameras", None)  # a plug-in need not know of several
    if named is None:
        return {FRONT: getattr(policy, "camera", None) or CameraConfig()} if policy.needs_image else {}
    return dict(named)


def robot_fit(width: int, height: int) -> Fit:
    """Default fit of a robot's camera into a size [px]: whole where the size is its own 4:3, else padded."""
    return "native" if 3 * width == 4 * height else "pad"


def recorded_camera(name: str, width: int, height: int, fit: Fit | None = None) -> CameraConfig:
    """A camera of `CAMERAS` as demonstrations show it in a size [px]; the world camera has no sensor to keep to."""
    fit = "native" if name == "world" else fit or robot_fit(width, height)
    return CameraConfig(width=width, height=height, prim=CAMERAS[name], fit=fit)


def video_sizes(size: tuple[int, int] | None) -> dict[str, tuple[int, int]]:
    """Width and height of the videos of each camera [px].

    Args:
        size: Those of world videos; head camera videos are as high, 4:3. None for 480×270 and 320×240.

    Raises:
        InputError: A video would be smaller or larger than encoders take.
    """
    if size is None:
        return {"ego": STRIP_SIZES["ego"], "world": VIDEO_SIZE}
    low, high = SIZE_LIMITS
    if not all(low <= n <= high for n in size):
        raise InputError(f"--video-size {size[0]}x{size[1]}: expected {low} to {high} pixels each")
    ego = (round(size[1] * 4 / 3), size[1])
    if max(ego) > high:
        raise InputError(
            f"--video-size {size[0]}x{size[1]}: makes head camera videos of {ego[0]}x{ego[1]}, expected at most {high} "
            f"pixels each: a height of at most {high * 3 // 4}"
        )
    return {"ego": ego, "world": size}
