"""A picture as its sender packed it: its head is read at once, its pixels when there is memory for them."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from arena_newton.policies.protocols.policy_messages import check_picture_size
from arena_newton.policies.protocols.wire_error import WireError

__all__ = ["PICTURE_FORMATS", "PackedPicture"]

PICTURE_FORMATS: dict[str, type[ImageFile]] = {"png": PngImageFile, "jpeg": JpegImageFile}
"""Name of a format → its reader. `Image.open` would warn of a large picture, and warnings belong to the process."""


@dataclass(frozen=True)
class PackedPicture:
    """A PNG or JPEG whose head has been read."""

    data: bytes
    format: str
    """One of `PICTURE_FORMATS`."""
    width: int
    height: int

    @staticmethod
    def read(data: bytes, format: str, where: str) -> PackedPicture:
        """Read the head.

        Raises:
            WireError: It is not a picture of this format, or too large or small.
        """
        width, height = _opened(data, format, where).size
        check_picture_size(width, height, where)
        return PackedPicture(data, format, width, height)

    @property
    def nbytes(self) -> int:
        """Bytes of the unpacked picture."""
        return 3 * self.width * self.height

    def unpacked(self, where: str = "message") -> np.ndarray:
        """The picture, uint8, shape [height, width, 3].

        Raises:
            WireError: It is damaged.
        """
        try:
            return np.array(_opened(self.data, self.format, where).convert("RGB"))
        except WireError:
            raise
        except Exception as error:  # a damaged picture fails anywhere inside Pillow
            raise WireError(f"{where}: not a picture of format {self.format} ({type(error).__name__})") from None


def _opened(data: bytes, format: str, where: str) -> ImageFile:
    try:
        return PICTURE_FORMATS[format](io.BytesIO(data))
    except Exception as error:
        raise WireError(f"{where}: not a picture of format {format} ({type(error).__name__})") from None
