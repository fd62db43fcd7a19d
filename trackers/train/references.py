"""Reference motions on the device, packed so that one gather per tick fetches a whole frame of every world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from arena_newton.robot import g1, rotations
from arena_newton.trackers.motions import kinematics

if TYPE_CHECKING:
    from arena_newton.trackers.motions.library import DeviceLibrary

__all__ = ["FEET", "KEY_LINKS", "Frame", "ReferenceBank"]

KEY_LINKS: tuple[str, ...] = (
    *g1.FEET,
    "left_knee_link",
    "right_knee_link",
    "torso_link",
    "left_elbow_link",
    "right_elbow_link",
    "left_wrist_yaw_link",
    "right_wrist_yaw_link",
)
"""Links whose positions are rewarded; the feet come first."""
FEET = slice(0, 2)
"""The feet among `KEY_LINKS`."""
_CHUNK = 1 << 16
"""Frames of one pass of the forward kinematics."""
_FIELDS = {
    "root_pos": 3,
    "root_quat": 4,
    "joint_pos": 29,
    "joint_vel": 29,
    "lin_vel": 3,
    "ang_vel": 3,
    "keys": 3 * len(KEY_LINKS),
    "mimic": 35,
}


@dataclass
class Frame:
    """One reference frame of every world."""

    root_pos: torch.Tensor
    """Pelvis [m], shape [worlds, 3]."""
    root_quat: torch.Tensor
    """Orientation wxyz, shape [worlds, 4]."""
    joint_pos: torch.Tensor
    """[rad], shape [worlds, 29]."""
    joint_vel: torch.Tensor
    """Backward difference [rad/s], shape [worlds, 29]."""
    lin_vel: torch.Tensor
    """World frame [m/s], shape [worlds, 3]."""
    ang_vel: torch.Tensor
    """Body frame [rad/s], shape [worlds, 3]."""
    keys: torch.Tensor
    """Key links in the heading frame on the ground below the pelvis [m], shape [worlds, links, 3]."""
    mimic: torch.Tensor
    """Mimic command, shape [worlds, 35]."""


class ReferenceBank:
    """Frames of all clips and what training derives from them."""

    def __init__(self, library: DeviceLibrary, device: str):
        """Pack a library, which may be on another device."""
        self.start = library.clip_start.to(device=device, dtype=torch.long)
        """First frame of each clip, shape [clips]."""
        self.length = library.clip_length.to(device=device, dtype=torch.long)
        """Frames of each clip, shape [clips]."""
        self.family = library.family.to(device=device, dtype=torch.long)
        """Family of each clip, shape [clips]."""
        self.family_names = [str(name) for name in library.family_names]
        self.support_kind = library.support_kind.to(device=device, dtype=torch.long)
        box = library.support_box.to(device=device, dtype=torch.float32)
        self.support_pos, self.support_quat = box[:, :3].contiguous(), rotations.quat_from_yaw(box[:, 3])
        """Centre of the support's top face [m] and its orientation wxyz, shapes [clips, 3] and [clips, 4]."""
        parts = {
            name: getattr(library, name).to(device=device, dtype=torch.float32) for name in _FIELDS if name != "keys"
        }
        parts["keys"] = _key_links(parts["root_pos"], parts["root_quat"], parts["joint_pos"])
        self.data = torch.cat([parts[name] for name in _FIELDS], dim=1)
        self.mimic = parts["mimic"].contiguous()
        self.frames = len(self.data)
        self.clip_of = torch.repeat_interleave(torch.arange(len(self.start), device=device), self.length)
        """Clip of each frame, shape [frames]."""
        self.last = (self.start + self.length - 1)[self.clip_of]
        """Last frame of each frame's clip, shape [frames]."""

    def rows(self, frame: torch.Tensor) -> torch.Tensor:
        """Packed frames of an index tensor, shape [worlds] to [worlds, width]."""
        return self.data.index_select(0, frame)

    def split(self, rows: torch.Tensor) -> Frame:
        """Views of packed frames."""
        parts = dict(zip(_FIELDS, rows.split(list(_FIELDS.values()), dim=1), strict=True))
        parts["keys"] = parts["keys"].unflatten(1, (len(KEY_LINKS), 3))
        return Frame(**parts)

    def gather(self, frame: torch.Tensor) -> Frame:
        """The frames of an index tensor, shape [worlds]."""
        return self.split(self.rows(frame))


def _key_links(root_pos: torch.Tensor, root_quat: torch.Tensor, joint_pos: torch.Tensor) -> torch.Tensor:
    """Key links in the heading frame below the pelvis, shape [frames, 3 * links]."""
    index = torch.tensor([kinematics.link_index(name) for name in KEY_LINKS], device=root_pos.device)
    out = []
    for first in range(0, len(root_pos), _CHUNK):
        part = slice(first, first + _CHUNK)
        at = root_pos[part] * root_pos.new_tensor((0.0, 0.0, 1.0))
        keys = kinematics.forward(at, root_quat[part], joint_pos[part]).position.index_select(1, index)
        heading = rotations.heading(root_quat[part])
        out.append(rotations.turn(-heading[:, None], keys).flatten(1))
    return torch.cat(out)
