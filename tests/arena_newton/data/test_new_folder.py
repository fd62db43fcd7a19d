"""Folders that appear whole, or not at all."""

import fcntl
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from arena_newton.errors import InputError
from arena_newton.files.new_folder import LOCK, held, held_folder, link, new_folder, scratch_folder
from arena_newton.files.own_files import PARTIAL

SLOW = """
import sys, time
from pathlib import Path
from arena_newton.files.new_folder import new_folder
with new_folder(Path(sys.argv[1])) as folder:
    (folder / "half").write_text("half")
    print("writing", flush=True)
    time.sleep(600)
"""


def test_a_folder_appears_at_the_end(tmp_path):
    """Until the end of the block there is none of that name; afterwards it is whole, and nothing else is left."""
    out = tmp_path / "deep" / "out"
    with new_folder(out) as folder:
        (folder / "a").write_text("a")
        assert not out.exists()
    assert [path.name for path in out.parent.iterdir()] == ["out"] and (out / "a").read_text() == "a"


def test_a_held_folder_is_one_process_s(tmp_path):
    """A folder that is held is refused to another holder by name, and free afterwards."""
    with held_folder(tmp_path / "out", "trains in it"):
        with pytest.raises(InputError, match="--out .*/out: another process trains in it"):
            with held_folder(tmp_path / "out", "trains in it"):
                pass
    with held_folder(tmp_path / "out", "trains in it"):
        pass


def test_a_held_file_is_shared_or_waited_for(tmp_path):
    """Those that share a file hold it together; one that wants it alone is refused, or waits until it is free."""
    path, taken = tmp_path / "lock", "is taken"
    with held(path, taken, shared=True), held(path, taken, shared=True):
        with pytest.raises(InputError, match=taken), held(path, taken):
            pass
    with ThreadPoolExecutor() as pool:
        with held(path):
            waiting = pool.submit(lambda: held(path, wait=True).__enter__())
            with pytest.raises(TimeoutError):
                waiting.result(0.2)
        assert waiting.result(60.0) >= 0


def test_a_file_that_was_removed_meanwhile_is_not_held(tmp_path, monkeypatch):
    """A lock that its holder removed between opening and locking holds nothing, and is refused."""
    path, real = tmp_path / "lock", fcntl.flock
    monkeypatch.setattr(fcntl, "flock", lambda file, how: (real(file, how), path.unlink()))
    with pytest.raises(InputError, match="is taken"), held(path, "is taken"):
        pytest.fail("held")


def test_an_error_leaves_nothing(tmp_path):
    """A block that fails leaves neither folder nor traces."""
    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("a")
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_a_scratch_folder_is_removed(tmp_path):
    """It is empty at first, and gone after the block; what a killed process left of it is swept."""
    for _ in range(2):
        with scratch_folder(tmp_path / "out") as folder:
            assert folder.name == f"out{PARTIAL}" and not list(folder.iterdir())
            (folder / "a").write_text("a")
        assert not list(tmp_path.iterdir())
        (tmp_path / f"out{PARTIAL}").mkdir()
        (tmp_path / f"out{PARTIAL}" / "old").write_text("old")
        (tmp_path / f"out{LOCK}").write_text("")


def test_a_killed_process_leaves_no_folder_and_the_next_one_sweeps(tmp_path):
    """SIGKILL leaves no folder of the name; the next process removes what is left and writes its own."""
    out = tmp_path / "out"
    process = subprocess.Popen([sys.executable, "-c", SLOW, str(out)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "writing\n"
    with pytest.raises(InputError, match="another process is writing it"), new_folder(out):
        pass
    process.send_signal(signal.SIGKILL)
    process.wait()  # the lock goes with the process
    assert not out.exists() and (tmp_path / f"out{PARTIAL}" / "half").exists()
    with new_folder(out) as folder:
        (folder / "whole").write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert [path.name for path in out.iterdir()] == ["whole"]


def test_what_is_not_ours_is_never_removed(tmp_path):
    """An existing folder, a link, and a folder of the temporary name that no command made are refused and stay."""
    (tmp_path / "out").mkdir()
    (tmp_path / f"other{PARTIAL}").mkdir()
    (tmp_path / f"other{PARTIAL}" / "mine").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for name, message in {"out": "exists", "other": "is in the way", "link": "exists", "..": "is no name"}.items():
        with pytest.raises(InputError, match=message), new_folder(tmp_path / name):
            pass
    assert (tmp_path / f"other{PARTIAL}" / "mine").read_text() == "mine"


def test_links_are_second_names(tmp_path):
    """A linked file is the same file; across disks it is copied."""
    source = tmp_path / "a"
    source.write_bytes(b"a")
    link(source, tmp_path / "b" / "a")
    assert os.path.samefile(source, tmp_path / "b" / "a")
