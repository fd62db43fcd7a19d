"""Episodes that processes decode: the same pictures as threads give, and nothing left behind, whatever happens."""

import contextlib
import errno
import os
import resource
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.policies.train.frames import decoder_pool
from arena_newton.policies.train.frames.decoder_pool import DecoderPool, decoding_processes
from arena_newton.policies.train.frames.demonstration_rows import read_rows
from arena_newton.policies.train.frames.frame_store import episode_films, load_frames
from tests.children import Child
from tests.patience import wait_for
from tests.policies.train.small_dataset import BAND, LENGTHS, SIZE, make_dataset

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def rows(dataset):
    """The dataset without its pictures."""
    return read_rows(dataset, "v3.1")


@pytest.fixture(autouse=True)
def few_pictures_at_once(monkeypatch):
    """Slots of five pictures, so that an episode goes through each of them several times."""
    monkeypatch.setattr(decoder_pool, "SLOT_BYTES", 5 * SIZE * SIZE * 3)


@pytest.fixture(autouse=True)
def earlier_children():
    """Children of earlier tests, which others did not wait for, are none of a pool."""
    EARLIER.clear()
    EARLIER.update(decoders())


EARLIER = set()


def decoders():
    """Processes of this one that decode, and those that it did not wait for."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            stat, command = (folder / "stat").read_text(), (folder / "cmdline").read_bytes()
        except OSError:
            continue
        parent = int(stat.rpartition(")")[2].split()[1])
        state = stat.rpartition(")")[2].split()[0]
        if parent == os.getpid() and (b"decoder_process" in command or state == "Z"):
            found.append(int(folder.name))
    return [number for number in found if number not in EARLIER]


def shared_files():
    """Open files of memory for pictures."""
    names = []
    for fd in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # another thread has closed it meanwhile
            names.append(os.readlink(f"/proc/self/fd/{fd}"))
    return [name for name in names if "arena_newton_decoded" in name]


def test_processes_give_what_threads_give(rows, tmp_path):
    """Pictures, their order, black rows and the reported number of pictures are the same."""
    both = [rows, read_rows(make_dataset(tmp_path, lengths=(22,), task="football"), "v3.1")]
    told = []
    by_threads = load_frames(both, CPU, jobs=2, processes=0)
    by_processes = load_frames(both, CPU, processes=2, on_frames=told.append)
    assert torch.equal(by_threads.pictures, by_processes.pictures)
    assert (by_processes.top, by_processes.bottom) == (by_threads.top, by_threads.bottom) == (BAND, BAND)
    assert sorted(told) == sorted((*LENGTHS, 22))
    assert not decoders() and not shared_files()


def test_processes_find_a_late_bright_picture(tmp_path):
    """Rows that are black in the first pictures only are decoded in a second pass."""

    def brightening(number, size, seed):
        pictures = np.full((number, size, size, 3), 90, np.uint8)
        pictures[:, -BAND:] = 0
        pictures[:10, :BAND] = 0
        return pictures

    late = [read_rows(make_dataset(tmp_path, lengths=(20, 20), pictures=brightening), "v3.1")]
    told = []
    by_processes = load_frames(late, CPU, processes=1, on_frames=told.append)
    by_threads = load_frames(late, CPU, jobs=1, processes=0)
    assert (by_processes.top, by_processes.bottom) == (by_threads.top, by_threads.bottom)
    assert by_processes.top == 0 and by_processes.bottom >= BAND - 1 and told == [20, 20]
    assert torch.equal(by_processes.pictures, by_threads.pictures)


@pytest.mark.parametrize("processes", [0, 1])
def test_what_is_broken_off_is_in_nobodys_pictures(rows, processes):
    """A decoding that is given up after an episode leaves nothing to the next one."""
    films = episode_films([rows])
    wanted, found = (np.zeros((rows.frames, SIZE, SIZE, 3), np.uint8) for _ in range(2))

    def put_into(pictures):
        return lambda row, part: pictures.__setitem__(slice(row, row + len(part)), part)

    with DecoderPool(SIZE, SIZE, threads=1) as pool:
        list(pool.decode(films, 0, 0, put_into(wanted)))
    with DecoderPool(SIZE, SIZE, threads=1, processes=processes) as pool:
        given_up = pool.decode(films, 0, 0, put_into(np.zeros_like(found)))
        next(given_up)
        given_up.close()
        assert sorted(number for number, _ in pool.decode(films[::-1], 0, 0, put_into(found))) == [0, 1, 2]
    assert np.array_equal(found, wanted)
    assert not decoders() and not shared_files()


@pytest.mark.parametrize("processes", [0, 1])
def test_a_damaged_film_is_named(dataset, tmp_path, processes):
    """A film that is cut or of zeros gives one error with dataset and episode, and no process remains."""
    copy = shutil.copytree(dataset, tmp_path / "copy")
    film = next(copy.rglob("*.mp4"))
    sound = film.read_bytes()
    for content in (sound[: len(sound) // 2], bytes(len(sound)), b""):
        film.write_bytes(content)
        with pytest.raises(InputError, match=rf"{copy}: episode \d: .*{film.name}: .*") as error:
            load_frames([read_rows(copy, "v3.1")], CPU, jobs=2, processes=processes)
        assert "Traceback" not in str(error.value)
        assert not decoders() and not shared_files()


def test_a_process_that_dies_is_an_error(rows):
    """A process that is killed while it decodes gives one error that names the episode and the signal."""
    films = episode_films([rows])
    with (
        pytest.raises(ArenaError, match=rf"{rows.root}: episode \d: the process .* ended \(SIGKILL"),
        DecoderPool(SIZE, SIZE, threads=1, processes=1) as pool,
    ):

        def put(row, pictures):
            for number in decoders():
                os.kill(number, signal.SIGKILL)

        list(pool.decode(films, 0, 0, put))
    assert not decoders() and not shared_files()


def test_ctrl_c_leaves_nothing(rows):
    """An interrupt between two episodes ends all processes and gives their memory back."""
    with pytest.raises(KeyboardInterrupt):
        load_frames([rows], CPU, processes=2, on_frames=lambda count: os.kill(os.getpid(), signal.SIGINT))
    assert not decoders() and not shared_files()


def test_processes_end_with_a_training_that_is_killed():
    """`kill -9` of whoever asked for pictures leaves no process."""
    training = Child("tests.policies.train.pool_owners:idle", [])
    numbers = " ".join(training.lines(1)).split()
    training.kill()
    assert len(numbers) == 2, training.printed()
    # A process hears of it when its libraries are loaded.
    wait_for(lambda: not any(running(number) for number in numbers), "end of the processes", 400.0)


def running(number):
    """True if a process is there and no zombie."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_no_memory_to_share_is_an_error(rows):
    """An error about memory that cannot be shared says how much was asked for, why not, and what to do."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(ArenaError, match=r"no 0 MB of memory that 2 processes could share \(File too large\)"):
            load_frames([rows], CPU, processes=2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not decoders() and not shared_files()


@pytest.mark.parametrize(
    ("owner", "name"), [(decoder_pool.subprocess, "Popen"), (decoder_pool, "mapped")], ids=["process", "memory"]
)
def test_threads_decode_where_no_process_starts(rows, monkeypatch, owner, name):
    """A system that lets no process start, or has no memory to map, costs time and nothing else."""

    def refused(*given, **more):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    wanted = load_frames([rows], CPU, jobs=1, processes=0)
    monkeypatch.setattr(owner, name, refused)
    assert torch.equal(load_frames([rows], CPU, jobs=1, processes=2).pictures, wanted.pictures)
    assert not decoders() and not shared_files()


def test_words_of_an_interpreters_start_are_no_messages(rows, tmp_path, monkeypatch):
    """A machine whose interpreter greets on its output decodes all the same."""
    (tmp_path / "sitecustomize.py").write_text('print("Welcome")\n')
    monkeypatch.syspath_prepend(tmp_path)
    wanted = load_frames([rows], CPU, jobs=1, processes=0)
    assert torch.equal(load_frames([rows], CPU, processes=1).pictures, wanted.pictures)


def test_processes_start_where_the_standard_input_is_closed():
    """A training whose standard input is closed puts no memory in its position."""
    child = Child("tests.policies.train.pool_owners:without_input", [])
    assert child.wait(300) == 0, child.printed()


@pytest.mark.parametrize(
    ("cores", "pictures", "processes"),
    [(1, 10**6, 0), (3, 10**6, 0), (4, 10**6, 3), (32, 10**6, 31), (128, 10**6, 32), (32, 1999, 0), (32, 5000, 5)],
)
def test_number_of_processes(cores, pictures, processes):
    """Processes decode from four cores on, one core is left to whoever reads, and few pictures need few."""
    assert decoding_processes(cores, pictures) == processes
