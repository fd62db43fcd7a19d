"""MessagePack with NumPy arrays in it, as policy servers of robots exchange it, read within strict limits.

Two styles differ in the keys of an array's map only: openpi writes them as bytes (`b"__ndarray__"`), vla-eval as text.
A message is scanned before it is unpacked, so that a small one cannot become a large number of Python objects. Nothing
is ever unpickled: arrays hold booleans, integers and floats of known sizes, in just the bytes that their shape needs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import msgpack
import numpy as np

from arena_newton.policies.protocols.raw_arrays import MAX_FRAME, MAX_OBJECTS, checked_array, is_number_type
from arena_newton.policies.protocols.wire_error import WireError

__all__ = [
    "MAX_DEPTH",
    "MAX_FRAME",
    "MAX_LENGTH",
    "MAX_OBJECTS",
    "MAX_TEXT",
    "OPENPI_KEYS",
    "TEXT_KEYS",
    "ArrayKeys",
    "Value",
    "WireError",
    "checked_array",
    "pack",
    "unpack",
]

type Value = None | bool | int | float | str | bytes | np.ndarray | list[Value] | dict[str, Value]
"""Values that a message may hold."""

MAX_LENGTH = 8192
"""Most entries of one map or list."""
MAX_TEXT = 65536
"""Longest text [bytes of UTF-8]."""
MAX_DEPTH = 16
"""Most maps and lists inside each other."""


class ArrayKeys:
    """Keys of the map that stands for an array in a protocol."""

    def __init__(self, *, as_bytes: bool, scalars: bool):
        """Name the keys.

        Args:
            as_bytes: Keys are bytes, as openpi writes them; text otherwise.
            scalars: NumPy's scalars are marked with `__npgeneric__`; otherwise they are plain numbers.
        """

        def key(text: str) -> str | bytes:
            return text.encode() if as_bytes else text

        self.array, self.scalar = key("__ndarray__"), key("__npgeneric__")
        self.data, self.dtype, self.shape = key("data"), key("dtype"), key("shape")
        self.scalars = scalars


OPENPI_KEYS = ArrayKeys(as_bytes=True, scalars=True)
"""openpi and RoboArena (`openpi_client/msgpack_numpy.py` of github.com/Physical-Intelligence/openpi at 15a9616)."""
TEXT_KEYS = ArrayKeys(as_bytes=False, scalars=False)
"""vla-eval (`vla_eval/protocol/numpy_codec.py` of github.com/allenai/vla-evaluation-harness at e1ee9ad)."""


def pack(
    value: object, keys: ArrayKeys, special: Callable[[np.ndarray], Mapping[str, object] | None] | None = None
) -> bytes:
    """A message as bytes.

    Args:
        value: Maps, lists, numbers, texts, bytes and arrays in each other.
        keys: How arrays are written.
        special: Writes some arrays differently, such as pictures; None from it: not this one.

    Raises:
        WireError: It holds something that no message can.
    """

    def other(item: object) -> object:
        if isinstance(item, np.generic) and is_number_type(item.dtype.str):
            if not keys.scalars:
                return item.item()
            return {keys.scalar: True, keys.data: item.item(), keys.dtype: item.dtype.str}
        if isinstance(item, np.ndarray) and is_number_type(item.dtype.str):
            made = special(item) if special is not None else None
            if made is not None:
                return made
            return {
                keys.array: True,
                keys.data: item.tobytes(),
                keys.dtype: item.dtype.str,
                keys.shape: list(item.shape),
            }
        what = f"an array of {item.dtype}" if isinstance(item, np.ndarray | np.generic) else type(item).__name__
        raise WireError(f"a message cannot hold {what}")

    try:
        return cast(bytes, msgpack.packb(value, default=other, use_bin_type=True))
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError(f"not a message ({error})") from None


def unpack(
    data: bytes,
    keys: ArrayKeys,
    where: str,
    special: Callable[[Mapping[str, object], str], object] | None = None,
) -> Value:
    """Content of a message; arrays own their memory.

    Args:
        data: MessagePack.
        keys: How arrays are written.
        where: What errors name as the origin.
        special: Reads maps that stand for something else, such as pictures; None from it: a map as any other.

    Raises:
        WireError: Longer, deeper or with more values than the limits say, damaged, or with an array that is none.
    """
    if len(data) > MAX_FRAME:
        raise WireError(f"{where}: {len(data)} bytes, expected at most {MAX_FRAME}")
    _scan(data, where)

    def read_map(item: dict[object, object]) -> object:
        if item.get(keys.array) is True:
            return checked_array(item.get(keys.data), item.get(keys.dtype), item.get(keys.shape), where)
        if item.get(keys.scalar) is True:
            return _scalar(item.get(keys.data), item.get(keys.dtype), where)
        named: dict[str, object] = {}
        for key, content in item.items():
            if isinstance(key, bytes):
                try:
                    key = key.decode()
                except UnicodeDecodeError:
                    raise WireError(f"{where}: a key is not text") from None
            if not isinstance(key, str):
                raise WireError(f"{where}: a key is not text")
            named[key] = content
        made = special(named, where) if special is not None else None
        return named if made is None else made

    try:
        return cast(
            Value,
            msgpack.unpackb(
                data,
                object_hook=read_map,
                raw=False,
                strict_map_key=True,
                max_str_len=MAX_TEXT,
                max_array_len=MAX_LENGTH,
                max_map_len=MAX_LENGTH,
                max_ext_len=0,
            ),
        )
    except WireError:
        raise
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise WireError(f"{where}: not MessagePack ({type(error).__name__})") from None


def _scalar(data: object, dtype: object, where: str) -> bool | int | float:
    if isinstance(dtype, bytes):
        dtype = dtype.decode(errors="replace")
    if not isinstance(dtype, str) or not is_number_type(dtype) or not isinstance(data, bool | int | float):
        raise WireError(f"{where}: a number of type {str(dtype)[:40]!r}, expected bool, integer or float")
    return data


_FIXED = {0xC0: 0, 0xC2: 0, 0xC3: 0, 0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4}
_FIXED |= {0xD3: 8}
"""First byte of a value without length → bytes that follow (the MessagePack specification)."""
_SIZED = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
"""First byte of bytes (C4 to C6) and texts → size of their length."""
_NESTED = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}
"""First byte of lists and maps → size of their length, values of an entry."""


def _scan(data: bytes, where: str) -> None:
    """Check the limits by the heads of all values; nothing is made of them."""
    at, count, end = 0, 0, len(data)
    left = [1]  # values that are still to come, of each list or map around
    while left:
        if left[-1] == 0:
            left.pop()
            continue
        left[-1] -= 1
        count += 1
        if count > MAX_OBJECTS:
            raise WireError(f"{where}: more than {MAX_OBJECTS} values")
        if at >= end:
            raise WireError(f"{where}: not MessagePack (it breaks off)")
        head = data[at]
        at += 1
        entries = -1
        if head <= 0x7F or head >= 0xE0:
            continue
        if head in _FIXED:
            at += _FIXED[head]
        elif 0xA0 <= head <= 0xBF:
            at += head & 0x1F
        elif head in _SIZED:
            size = _SIZED[head]
            length = int.from_bytes(data[at : at + size], "big")
            if head >= 0xD9 and length > MAX_TEXT:
                raise WireError(f"{where}: a text of {length} bytes, expected at most {MAX_TEXT}")
            at += size + length
        elif 0x80 <= head <= 0x8F:
            entries, each = head & 0x0F, 2
        elif 0x90 <= head <= 0x9F:
            entries, each = head & 0x0F, 1
        elif head in _NESTED:
            size, each = _NESTED[head]
            entries = int.from_bytes(data[at : at + size], "big")
            at += size
        else:
            raise WireError(f"{where}: not MessagePack that holds data only (byte {head:#04x})")
        if entries >= 0:
            if entries > MAX_LENGTH:
                raise WireError(f"{where}: a list or map of {entries} entries, expected at most {MAX_LENGTH}")
            if len(left) > MAX_DEPTH:
                raise WireError(f"{where}: more than {MAX_DEPTH} lists and maps in each other")
            left.append(entries * each)
    if at != end:
        raise WireError(f"{where}: not MessagePack ({'it breaks off' if at > end else 'bytes after its end'})")
