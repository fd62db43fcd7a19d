"""Pictures of a batch as a network sees them in training: shifted and tinted, each sample by itself, on the device.

Only tensors of fixed shapes and the device's default generator are used, so that the work can be captured in a CUDA
graph; whoever trains seeds that generator before each step.
"""

from __future__ import annotations

import torch

from arena_newton.pictures.changed_looks import changed_looks
from arena_newton.policies.train.frames.frame_store import FrameStore
from arena_newton.policies.train.frames.image_transforms import drawn_transforms, transformed

__all__ = ["gathered_pictures"]


def gathered_pictures(
    store: FrameStore,
    rows: torch.Tensor,
    *,
    camera: int = 0,
    tall: int = 0,
    changed: torch.Tensor | None = None,
    shift: int = 0,
    colour: float = 0.0,
    transforms: bool = False,
) -> torch.Tensor:
    """Pictures of rows, whole again and on the scale 0 to 1.

    A shift repeats the edge of what the camera saw and leaves the black rows around it where they are: a policy always
    sees them there.

    Args:
        rows: Rows of the samples, int64, shape [B].
        tall: Height of the pictures that are wanted, cut about the middle of the camera's [px]; 0: its own.
        changed: Samples whose looks are changed, bool, shape [B], each at a row that has looks; None: none of them.
        shift: Most pixels by which a picture is shifted in each direction.
        colour: Most relative change of the brightness, and of each colour on top.
        transforms: Apply LeRobot's image transforms, to the whole picture as LeRobot does.

    Returns:
        float32, shape [B, 3, tall, width].
    """
    batch, device, tall = len(rows), store.device, tall or store.height
    stored, above = store.middle(tall)
    height, width = int(stored.shape[1]), int(stored.shape[2])
    numbers = store.picture[rows] + camera * (len(store.pictures) // len(store.cameras))
    if shift:
        moved = torch.randint(-shift, shift + 1, (2, batch, 1), device=device)
        down = (torch.arange(height, device=device) + moved[0]).clamp_(0, height - 1)
        right = (torch.arange(width, device=device) + moved[1]).clamp_(0, width - 1)
        window = down[:, :, None], right[:, None, :]
        seen = stored[numbers[:, None, None], *window]
    else:
        window = torch.arange(height, device=device)[:, None], torch.arange(width, device=device)
        seen = stored[numbers]
    if changed is not None and (looks := store.looks) is not None:
        first = max(0, (store.height - tall) // 2 - store.top)
        frames = looks.frames[:, first : first + height][looks.number[rows].clamp_min(0)[:, None, None], *window]
        table = looks.table[rows]
        about = looks.chances[table], looks.objects[table], looks.colours[table], store.task[rows]
        pictures = changed_looks(seen, frames, *about, looks.changes, changed)
    else:
        pictures = seen.float().div_(255.0)
    pictures = pictures.permute(0, 3, 1, 2)
    if colour:
        change = torch.rand((batch, 4, 1, 1), device=device).mul_(2.0 * colour).add_(1.0 - colour)
        pictures = pictures.mul_(change[:, :1] * change[:, 1:]).clamp_(0.0, 1.0)
    if height < tall:
        # Channels last, as the pictures are stored and as a GPU's convolutions read them.
        whole = pictures.new_zeros((batch, tall, width, 3)).permute(0, 3, 1, 2)
        whole[:, :, above : above + height] = pictures
        pictures = whole
    if transforms:
        pictures = transformed(pictures, drawn_transforms(batch, tall, width, device))
    return pictures
