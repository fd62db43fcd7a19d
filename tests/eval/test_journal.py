"""The journal survives whatever kills its writer."""

import errno
import json
import os

import pytest

from arena_newton.errors import InputError
from arena_newton.eval import journal as module
from arena_newton.eval.journal import Journal, StorageError, read_journal, write_atomic


def fill(path, n):
    """A journal of n records."""
    with Journal(path) as journal:
        for i in range(n):
            journal.append({"index": i})


@pytest.mark.parametrize("tail", [b'{"index": 2, "out', b'{"index": 2}', b"{", b"\x00\x00\n"])
def test_torn_last_line_is_cut(tmp_path, tail):
    """A last line that is not whole is cut, what stands before is kept, and writing goes on."""
    path = tmp_path / "episodes.jsonl"
    fill(path, 2)
    with path.open("ab") as handle:
        handle.write(tail)
    with Journal(path) as journal:
        assert journal.torn_bytes == len(tail)
        assert [r["index"] for r in journal.records] == [0, 1]
        journal.append({"index": 2})
    assert [json.loads(line)["index"] for line in path.read_text().splitlines()] == [0, 1, 2]


def test_any_cut_leaves_whole_lines(tmp_path):
    """Cut anywhere, the journal reads back as the lines that were complete."""
    path = tmp_path / "episodes.jsonl"
    fill(path, 3)
    whole = path.read_bytes()
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        records, size = read_journal(path)
        assert len(records) == whole[:length].count(b"\n")
        assert size == sum(len(line) for line in whole.splitlines(keepends=True)[: len(records)])


def test_damage_in_the_middle_is_named(tmp_path):
    """A broken line that is not the last is no torn tail: it is refused by number."""
    path = tmp_path / "episodes.jsonl"
    path.write_text('{"index":0}\nnonsense\n{"index":2}\n')
    with pytest.raises(InputError, match="line 2"):
        Journal(path)


def test_second_writer_is_refused(tmp_path):
    """Two runs cannot write one journal."""
    path = tmp_path / "episodes.jsonl"
    with Journal(path), pytest.raises(InputError, match="another run"):
        Journal(path)
    with Journal(path):
        pass


def test_full_disk_keeps_the_lines_before(tmp_path, monkeypatch):
    """When the disk fills in the middle of a line, that line is taken back and the error says what is kept."""
    path = tmp_path / "episodes.jsonl"
    write = os.pwrite

    def full(file, data, offset):
        if offset > 30:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data[:20], offset)

    with Journal(path) as journal:
        journal.append({"index": 0})
        monkeypatch.setattr(module.os, "pwrite", full)
        with pytest.raises(StorageError, match="disk full; the 1 episodes before are kept"):
            journal.append({"index": 1, "text": "x" * 50})
        monkeypatch.undo()
        assert path.read_text() == '{"index":0}\n'
        journal.append({"index": 1})
    assert len(read_journal(path)[0]) == 2


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_atomic_write_onto_a_full_disk(tmp_path):
    """A report that finds no room leaves the old one and says so in one line."""
    target = tmp_path / "report.md"
    target.write_text("old")
    (tmp_path / "report.md.part").symlink_to("/dev/full")
    with pytest.raises(StorageError, match="disk full"):
        write_atomic(target, "new" * 10000)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["report.md"]


def test_nan_never_enters(tmp_path):
    """The journal is strict JSON: NaN is an error of the caller, not a line."""
    path = tmp_path / "episodes.jsonl"
    with Journal(path) as journal, pytest.raises(ValueError):
        journal.append({"margin": float("nan")})
    assert path.read_bytes() == b""
