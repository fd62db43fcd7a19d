"""The journal survives whatever kills its writer."""

import dataclasses
import errno
import json
import os

import pytest
import rows

from arena_newton.errors import InputError
from arena_newton.eval.records import journal as module
from arena_newton.eval.records.journal import Journal, StorageError, read_journal, write_atomic

ROWS = rows.episodes("football", (1, 0, 0))


def record(number, **changes):
    """A journal record."""
    return rows.record(ROWS[number] | changes)


def fill(path, n):
    """A journal of n records."""
    with Journal(path) as journal:
        for i in range(n):
            journal.append(record(i))


@pytest.mark.parametrize("tail", [b'{"index": 2, "out', b'{"index": 2}', b"{", b"\x00\x00\n"])
def test_torn_last_line_is_cut(tmp_path, tail):
    """A last line that is not whole is cut, what stands before is kept, and writing goes on."""
    path = tmp_path / "episodes.jsonl"
    fill(path, 2)
    with path.open("ab") as handle:
        handle.write(tail)
    with Journal(path) as journal:
        assert journal.torn_bytes == len(tail)
        assert [r.index for r in journal.records] == [0, 1]
        journal.append(record(2))
    assert [json.loads(line)["index"] for line in path.read_text().splitlines()] == [0, 1, 2]


def test_any_cut_leaves_whole_lines(tmp_path):
    """Cut anywhere, the journal reads back as the lines that were complete."""
    path = tmp_path / "episodes.jsonl"
    fill(path, 3)
    whole = path.read_bytes()
    # Every seventh byte, and all about the line ends.
    ends = [at for at, byte in enumerate(whole) if byte == ord("\n")]
    lengths = {*range(0, len(whole), 7), *(at + near for at in ends for near in (-1, 0, 1, 2)), len(whole)}
    for length in sorted(length for length in lengths if length <= len(whole)):
        path.write_bytes(whole[:length])
        records, size = read_journal(path)
        assert len(records) == whole[:length].count(b"\n")
        assert size == sum(len(line) for line in whole.splitlines(keepends=True)[: len(records)])


def test_damage_in_the_middle_is_named(tmp_path):
    """A broken line that is not the last is no torn tail: it is refused by number."""
    path = tmp_path / "episodes.jsonl"
    fill(path, 3)
    first, _, last = path.read_text().splitlines(keepends=True)
    path.write_text(first + "nonsense\n" + last)
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
    """A disk that fills in the middle of a line: the line is taken back and the error says what is kept."""
    path = tmp_path / "episodes.jsonl"
    write = os.pwrite

    def full_disk(file, data, offset):
        if offset > size + 30:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data[:20], offset)

    with Journal(path) as journal:
        journal.append(record(0))
        before = path.read_bytes()
        size = len(before)
        monkeypatch.setattr(module.os, "pwrite", full_disk)
        with pytest.raises(StorageError, match="disk full; kept: 1 episode$"):
            journal.append(record(1))
        monkeypatch.undo()
        assert path.read_bytes() == before
        journal.append(record(1))
    assert len(read_journal(path)[0]) == 2


def test_atomic_write_onto_a_full_disk(tmp_path, monkeypatch):
    """A report that finds no room leaves the old one and says so in one line."""
    target = tmp_path / "report.md"
    target.write_text("old")

    def no_room(file):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_room)
    with pytest.raises(StorageError, match="disk full"):
        write_atomic(target, "new" * 10000)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["report.md"]


def test_atomic_write_where_nothing_can_be_written(tmp_path):
    """If even the partial file cannot be removed, the first cause is reported."""
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        write_atomic(tmp_path / "file" / "report.md", "new")


def test_writing_follows_no_link(tmp_path):
    """A link that a foreign folder brings as partial file, as target or as journal leads nowhere."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "report.md.part").symlink_to(victim)
    (folder / "report.md").symlink_to(victim)
    (folder / "episodes.jsonl").symlink_to(victim)
    write_atomic(folder / "report.md", "new")
    assert (folder / "report.md").read_text() == "new" and not (folder / "report.md").is_symlink()
    with pytest.raises(InputError, match="is a link"):
        Journal(folder / "episodes.jsonl")
    with pytest.raises(InputError, match="is a link"):
        read_journal(folder / "episodes.jsonl")
    assert victim.read_text() == "mine"


def test_a_pipe_is_no_journal(tmp_path):
    """A path that is not a regular file is refused at once instead of waiting for a writer."""
    os.mkfifo(tmp_path / "episodes.jsonl")
    for read in (Journal, read_journal):
        with pytest.raises(InputError, match="not a regular file"):
            read(tmp_path / "episodes.jsonl")


def test_a_folder_is_no_file_of_a_run(tmp_path):
    """A folder in the place of a journal or configuration is refused in one line that names it, as a pipe is."""
    (tmp_path / "episodes.jsonl").mkdir()
    with pytest.raises(InputError, match=r"episodes\.jsonl: is not a regular file"):
        read_journal(tmp_path / "episodes.jsonl")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("steps", "many", "steps is .many., expected a number of ticks"),
        ("steps", True, "steps is true"),
        ("task", "golf", "task is .golf., known are football"),
        ("task", "../../escape", "task is"),
        ("task", ["football"], "task is"),
        ("mode", "night", "mode is .night., known are base"),
        ("outcome", "won", "outcome is .won., expected success fall timeout error"),
        ("index", -1, "index is -1"),
        ("tracker", "a\x1b[2J", "tracker is"),
        ("policy", "", "policy is"),
        ("margin", "near", "margin is"),
        ("media", {"ego": 1}, "media is"),
    ],
)
def test_unfit_record_is_named(tmp_path, key, value, message):
    """A record with an unknown name or a value of another kind is refused with line and key."""
    path = tmp_path / "episodes.jsonl"
    path.write_text(json.dumps(rows.full(ROWS[0])) + "\n" + json.dumps(rows.full(ROWS[1] | {key: value})) + "\n")
    with pytest.raises(InputError, match=f"line 2: {message}"):
        read_journal(path)


def test_a_fall_contradicts_steps_after_it_and_no_error_of_the_start_up():
    """A start-up whose state ends non-finite may fall in that tick; an episode that went on after a fall was edited."""
    fell = {"events": [{"kind": "fall", "tick": -46, "detail": "tilt"}], "outcome": "error"}
    assert module.contradiction(rows.record(ROWS[0] | fell | {"steps": 0})) is None
    assert "at step 5 after a fall at -46" in module.contradiction(rows.record(ROWS[0] | fell | {"steps": 5}))


def test_nan_never_enters(tmp_path):
    """The journal is strict JSON: NaN is an error of the caller, not a line."""
    path = tmp_path / "episodes.jsonl"
    with Journal(path) as journal, pytest.raises(ValueError):
        journal.append(dataclasses.replace(record(0), margin=float("nan")))
    assert path.read_bytes() == b""
