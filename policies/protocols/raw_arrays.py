"""Arrays from their parts, as messages of policy servers hold them: bytes, type and shape, checked by each other."""

from __future__ import annotations

import math
import re

import numpy as np

from arena_newton.policies.protocols.wire_error import WireError

__all__ = ["MAX_FRAME", "MAX_OBJECTS", "checked_array", "is_number_type"]

MAX_FRAME = 10 * 2**20
"""Longest message that is read [bytes]; a picture of 1920x1200 is 6.9 MB, and 9.2 MB as base64."""
MAX_OBJECTS = 65536
"""Most values in a message, those inside others counted; bytes of an array are one."""
MAX_DIMENSIONS = 8
"""Most dimensions of an array."""
_DTYPE = re.compile(r"[|<>=]?(?:b1|[iu][1248]|f[248])")
"""Types of arrays as `numpy.dtype.str` writes them: bool, integers and floats, in either byte order."""
_NAMED = frozenset("bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64".split())
"""The same by their names, which some clients write."""


def checked_array(data: object, dtype: object, shape: object, where: str) -> np.ndarray:
    """An array from its parts, in the machine's byte order.

    Args:
        data: Its bytes, C order.
        dtype: As `numpy.dtype.str` writes it, or a name such as `float32`.
        shape: List of sizes.
        where: What errors name as the origin.

    Raises:
        WireError: Another type than bool, integer or float, or bytes and shape do not fit.
    """
    if isinstance(dtype, bytes):
        dtype = dtype.decode(errors="replace")
    if not isinstance(dtype, str) or not is_number_type(dtype):
        raise WireError(f"{where}: an array of type {str(dtype)[:40]!r}, expected bool, integers or floats")
    if not isinstance(shape, list | tuple) or len(shape) > MAX_DIMENSIONS:
        raise WireError(f"{where}: an array without a shape of at most {MAX_DIMENSIONS} dimensions")
    if not all(isinstance(n, int) and not isinstance(n, bool) and 0 <= n <= MAX_FRAME for n in shape):
        raise WireError(f"{where}: an array of shape {str(list(shape))[:80]}")
    kind = np.dtype(dtype)
    if not isinstance(data, bytes) or math.prod(shape) * kind.itemsize != len(data):
        size = len(data) if isinstance(data, bytes) else 0
        raise WireError(f"{where}: an array of shape {list(shape)} of {kind} with {size} bytes")
    if kind.kind == "b":  # a byte that is neither 0 nor 1 is no bool
        return np.array(np.frombuffer(data, np.uint8).reshape(shape), dtype=bool)
    native: np.ndarray = np.empty(shape, kind.newbyteorder("="))
    native[...] = np.frombuffer(data, kind).reshape(shape)
    return native


def is_number_type(dtype: str) -> bool:
    """True if a type is bool, an integer or a float of a known size, as `numpy.dtype.str` or by its name."""
    return _DTYPE.fullmatch(dtype) is not None or dtype in _NAMED
