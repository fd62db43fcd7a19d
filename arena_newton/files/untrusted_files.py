"""Files from unknown sources: read within the bounds of `limits`, and new files created next to them."""

from __future__ import annotations

import hashlib
import io
import math
import os
import stat
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal

import numpy as np

from arena_newton.errors import InputError
from arena_newton.files import limits

__all__ = ["array_digest", "check_size", "create", "file_digest", "numbers", "read_arrays", "read_bytes", "zip_members"]
_HEADERS: dict[tuple[int, int], Callable[..., tuple[tuple[int, ...], bool, np.dtype[Any]]]] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def create(path: Path) -> BinaryIO:
    """Open a new file for writing in a folder that may not be ours: a file of that name is removed, no link followed.

    Raises:
        OSError: It cannot be created; the error carries its name.
    """
    path.unlink(missing_ok=True)
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644), "wb")


def check_size(path: str | Path, most: int, *, where: str = "") -> None:
    """Refuse what is not a regular file, or larger than `most` bytes; nothing is opened.

    Raises:
        InputError: The file is absent, not a regular file, unreadable or larger; named as `where`, or by its path.
    """
    where = where or str(path)
    try:
        about = os.stat(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{where}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    # A folder is refused where it is opened, with a message of its own.
    if not (stat.S_ISREG(about.st_mode) or stat.S_ISDIR(about.st_mode)):
        raise InputError(f"{where}: is no regular file")
    if stat.S_ISREG(about.st_mode) and about.st_size > most:
        size, allowed = about.st_size / limits.MIB, most // limits.MIB
        raise InputError(f"{where}: has {size:.0f} MiB, expected at most {allowed}")


def read_bytes(path: str | Path, most: int, *, where: str = "") -> bytes:
    """The content of a regular file.

    Args:
        most: Largest size that is read [bytes].
        where: What errors name; the path by default.

    Raises:
        InputError: The file is absent, not a regular file, unreadable or larger.
    """
    where = where or str(path)
    check_size(path, most, where=where)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{where}: cannot be read ({error.strerror})") from error


def file_digest(path: Path, most: int) -> str:
    """First 12 hex digits of the SHA-256 of a regular file of any size, by which weights are known.

    Args:
        path: The file; never all of it is in memory.
        most: Largest size that is read [bytes].

    Raises:
        InputError: The file is absent, not a regular file, unreadable or larger.
    """
    check_size(path, most)
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:12]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def zip_members(archive: zipfile.ZipFile, where: str, most: int) -> list[zipfile.ZipInfo]:
    """Members of an archive, each stored or deflated: of other methods a read of few bytes unpacks all that follow.

    Raises:
        InputError: There are more than `most`, or one is packed by another method.
    """
    members = archive.infolist()
    if len(members) > most:
        raise InputError(f"{where}: holds {len(members):,} members, expected at most {most:,}")
    for one in members:
        if one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            name = one.filename[:60]
            raise InputError(f"{where}: {name!r} is packed by method {one.compress_type}, expected deflate or none")
    return members


def array_digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of arrays by name, data type, shape and content, however a file packs them; 64 hex digits."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def read_arrays(
    path: str | Path, wanted: Iterable[str] | None = None, *, where: str = "", content: bytes | None = None
) -> dict[str, np.ndarray]:
    """Read arrays of an NPZ file; no object arrays, and none that is larger than `limits` says.

    Args:
        wanted: Names of the arrays to read, where the file has them; all by default. The others are not
            unpacked and are returned as empty arrays.
        where: What errors name; the path by default.
        content: The file's content, where it was read before; the path is not opened then.

    Returns:
        Array by name, in the file's order.

    Raises:
        InputError: The file is absent, damaged, not an NPZ file, or larger than allowed.
    """
    where = where or str(path)
    chosen = None if wanted is None else set(wanted)
    try:
        if content is None:
            size = os.stat(path).st_size
            check_size(path, max(size, 1), where=where)
        else:
            size = len(content)
        allowed = max(limits.ARRAY_BYTES, limits.ARRAY_GROWTH * size)
        with zipfile.ZipFile(path if content is None else io.BytesIO(content)) as archive:
            arrays, total = {}, 0
            for member in zip_members(archive, where, limits.ARCHIVE_MEMBERS):
                name = member.filename.removesuffix(".npy")
                if chosen is not None and name not in chosen:
                    arrays[name] = np.empty(0)
                    continue
                with archive.open(member) as file:
                    shape, by_columns, dtype = _header(file, member, f"{where}: not a readable NPZ file: array {name}")
                    needed = math.prod(shape) * dtype.itemsize
                    total += max(needed, math.prod(shape))
                    if total > allowed:
                        raise InputError(
                            f"{where}: array {name} would make its arrays {total / limits.MIB:.0f} MiB, expected at "
                            f"most {allowed / limits.MIB:.0f}"
                        )
                    order: Literal["F", "C"] = "F" if by_columns else "C"
                    arrays[name] = np.ndarray(shape, dtype, bytearray(file.read(needed)), order=order)
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{where}: no such file") from error
    except Exception as error:  # a damaged archive or header fails anywhere inside zipfile, tokenize and NumPy
        raise InputError(f"{where}: not a readable NPZ file ({type(error).__name__})") from error
    return arrays


def _header(file: IO[bytes], member: zipfile.ZipInfo, where: str) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type of the array whose header comes next; true: column after column.

    Raises:
        InputError: The header promises more bytes than the member has, or objects.
    """
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"version {version}")
    shape, by_columns, dtype = _HEADERS[version](file, max_header_size=limits.HEADER_BYTES)
    if dtype.hasobject:
        raise InputError(f"{where} holds objects, expected numbers or text")
    if min(shape, default=0) < 0 or math.prod(shape) * max(dtype.itemsize, 1) > member.file_size:
        raise InputError(f"{where} has shape {list(shape)} of {dtype}, but {member.file_size} bytes")
    return shape, by_columns, dtype


def numbers(array: np.ndarray, where: str, dtype: Any) -> np.ndarray:
    """The array as floating-point numbers of type `dtype`.

    Raises:
        InputError: It does not hold real numbers.
    """
    if array.dtype.kind not in "fiub":
        raise InputError(f"{where} holds {array.dtype}, expected numbers")
    with np.errstate(over="ignore"):
        return np.asarray(array, dtype=dtype)
