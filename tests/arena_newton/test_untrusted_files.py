"""Archives of arrays are checked by their headers: what a small file promises is not taken before it is known."""

import hashlib
import io
import os
import resource
import zipfile

import numpy as np
import pytest

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.untrusted_files import file_digest, read_arrays, read_bytes


def member(shape, dtype="<f8", data=b"") -> bytes:
    """An array whose header says this, over these bytes."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue() + data


def archive(path, **members: bytes):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(f"{name}.npy", data)
    return path


def test_reads_what_numpy_writes(tmp_path):
    """All arrays, some of them, or only their names."""
    np.savez(tmp_path / "a.npz", x=np.arange(6.0).reshape(2, 3).T, text=np.array(["", "two"]), one=np.int64(3))
    arrays = read_arrays(tmp_path / "a.npz")
    np.testing.assert_array_equal(arrays["x"], np.arange(6.0).reshape(2, 3).T)
    assert arrays["text"].tolist() == ["", "two"] and int(arrays["one"]) == 3
    some = read_arrays(tmp_path / "a.npz", ("x",))
    assert list(some) == ["x", "text", "one"] and some["x"].shape == (3, 2) and some["text"].size == 0


def test_a_bomb_is_not_unpacked(tmp_path, monkeypatch):
    """Gigabytes of zeros in a megabyte, an array that is larger than its bytes, and text of no width: one line each."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    zeros = tmp_path / "zeros.npz"
    assert limits.ARRAY_BYTES == 256 * limits.MIB
    monkeypatch.setattr(limits, "ARRAY_BYTES", 128 * limits.MIB)
    with zipfile.ZipFile(zeros, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file, file.open("a.npy", "w") as packed:
        packed.write(member((20 * 2**20,)))
        for _ in range(160):
            packed.write(bytes(2**20))
    assert zeros.stat().st_size < 2**20
    with pytest.raises(InputError, match=r"zeros\.npz: array a would make its arrays 160 MiB, expected at most 128"):
        read_arrays(zeros)
    for shape, dtype in (((2**40,), "<f8"), ((2**31, 2**31), "<f8"), ((2**40,), "<U0"), ((-1,), "<f8")):
        path = archive(tmp_path / "shape.npz", action=member(shape, dtype, bytes(64)))
        with pytest.raises(InputError, match=r"shape\.npz: not a readable NPZ file: array action has shape"):
            read_arrays(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_a_large_file_may_hold_large_arrays(tmp_path, monkeypatch):
    """A file that is large itself may hold a few times its size."""
    monkeypatch.setattr(limits, "ARRAY_BYTES", 1000)
    np.savez(tmp_path / "a.npz", x=np.arange(10_000.0))
    assert read_arrays(tmp_path / "a.npz")["x"].size == 10_000


@pytest.mark.parametrize(
    "damage",
    [b"", b"not an archive", member((3,))[:20], b"\x93NUMPY\x01\x00\x10\x00{'descr': '<f8', (\n  "],
    ids=["empty", "text", "cut", "header"],
)
def test_damaged_members_are_one_line(tmp_path, damage):
    """A member that is no array is named with its file; so is a file that is no archive."""
    with pytest.raises(InputError, match=r"a\.npz: not a readable NPZ file") as caught:
        read_arrays(archive(tmp_path / "a.npz", action=damage))
    assert "\n" not in str(caught.value)
    (tmp_path / "b.npz").write_bytes(damage)
    with pytest.raises(InputError, match=r"b\.npz: not a readable NPZ file"):
        read_arrays(tmp_path / "b.npz")


def test_many_members(tmp_path):
    """An archive of more members than any of ours is refused."""
    path = archive(tmp_path / "a.npz", **{f"x{n}": member((0,)) for n in range(limits.ARCHIVE_MEMBERS + 1)})
    with pytest.raises(InputError, match="holds 1,001 members, expected at most 1,000"):
        read_arrays(path, ())


def test_only_regular_files_are_read(tmp_path):
    """A pipe is refused unopened; a file that is too large, or absent, is named."""
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "big").write_bytes(bytes(3 * 2**20))
    with pytest.raises(InputError, match=r"pipe\.npz: is no regular file"):
        read_arrays(tmp_path / "pipe.npz")
    with pytest.raises(InputError, match=r"pipe\.npz: is no regular file"):
        read_bytes(tmp_path / "pipe.npz", 10)
    with pytest.raises(InputError, match="big: has 3 MiB, expected at most 2"):
        read_bytes(tmp_path / "big", 2 * 2**20)
    with pytest.raises(InputError, match="none: cannot be read"):
        read_bytes(tmp_path / "none", 10)


def test_a_file_is_known_by_its_digest(tmp_path):
    """The first 12 digits of SHA-256, within the size that is allowed; what cannot be read is one error."""
    path = tmp_path / "weights"
    path.write_bytes(bytes(range(256)) * 20)
    assert file_digest(path, 5120) == hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    faults = {path: "expected at most 0", tmp_path: "Is a directory", tmp_path / "no": "No such file"}
    for refused, said in faults.items():
        with pytest.raises(InputError, match=f"{refused}: .*{said}"):
            file_digest(refused, 5119)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_only_deflate_is_unpacked(tmp_path, method):
    """An archive packed by a method of which a kilobyte unpacks to gigabytes at one read is refused."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as packed:
        packed.writestr("x.npy", member((3,)))
    with pytest.raises(InputError, match=f"a.npz: 'x.npy' is packed by method {method}, expected deflate or none"):
        read_arrays(tmp_path / "a.npz")
