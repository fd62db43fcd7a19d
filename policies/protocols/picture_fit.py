"""A picture of another size made into the one that a policy looks at, as the original's server does."""

from __future__ import annotations

import numpy as np
import torch

from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.protocols.wire_error import WireError

__all__ = ["fitted_picture"]

SAME_ASPECT = 0.01
"""Relative difference of two aspects below which a picture is scaled and nothing added or cut."""


def fitted_picture(image: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """The picture in the size of a camera.

    It is scaled (bilinear, antialiased, rounded to whole numbers) and, for `fit="pad"`, gets black bars: what the
    original's server does with the 640x480 pixels of its client.

    Args:
        image: uint8, shape [H, W, 3].
        camera: Its width, height and fit; a picture of this size stays as it is.

    Returns:
        uint8, shape [camera.height, camera.width, 3].

    Raises:
        WireError: `fit` is `native` and the picture has another aspect: it shows less than the policy must see.
    """
    height, width = image.shape[:2]
    if (width, height) == (camera.width, camera.height):
        return image
    aspect = width / height
    inner_w, inner_h = camera.width, camera.height
    if camera.fit == "pad":  # as `pictures.camera.Camera` has it
        inner_w = min(camera.width, max(1, round(camera.height * aspect)))
        inner_h = min(camera.height, max(1, round(camera.width / aspect)))
    elif abs(aspect * camera.height / camera.width - 1.0) > SAME_ASPECT:
        wanted = f"{camera.width}x{camera.height}"
        raise WireError(f"a picture of {width}x{height} cannot be made {wanted}: send {wanted}, native")
    made = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    top, left = (camera.height - inner_h) // 2, (camera.width - inner_w) // 2
    for colour in range(3):  # one after the other: in float32 a picture takes four times its memory
        channel = torch.from_numpy(np.ascontiguousarray(image[..., colour]))[None, None].float()
        scaled = torch.nn.functional.interpolate(
            channel, size=(inner_h, inner_w), mode="bilinear", antialias=True, align_corners=False
        )
        inner = scaled[0, 0].round().clamp(0.0, 255.0).to(torch.uint8)
        made[top : top + inner_h, left : left + inner_w, colour] = inner.numpy()
    return made
