"""Films that processes encode: the bytes of one process, clear errors of those that end, none that outlives its own."""

import contextlib
import errno
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from arena_newton.data.recording.encoder_pool import EncoderPool
from arena_newton.data.recording.encoding import EncoderThreads, Pictured
from tests.children import Child
from tests.patience import wait_for

WORLDS, TICKS, SIZE = 5, 14, 64
CPU = torch.device("cpu")


def pictures(tick):
    """Pictures and depths of a tick, of as many worlds as act in it."""
    draw = np.random.default_rng(tick)
    worlds = WORLDS - tick % 2
    depths = torch.from_numpy(draw.random((worlds, SIZE, SIZE)).astype(np.float16))
    return torch.from_numpy(draw.integers(0, 255, (worlds, SIZE, SIZE, 3), np.uint8)), depths


def begin(encoder, folder, worlds=WORLDS, depth=True):
    """Films of some worlds."""
    encoder.bind({"front": Pictured(worlds, SIZE, SIZE, depth)}, CPU)
    workers = [encoder.join() for _ in range(worlds)]
    return [encoder.open(w, folder / f"{n}.mp4", folder / f"{n}.raw", 50) for n, w in enumerate(workers)]


def film(encoder, folder):
    """Facts of the films of all worlds; the last one has no picture in every other tick."""
    folder.mkdir()
    streams, facts = begin(encoder, folder), {}
    every = [streams, streams[:-1]]
    for tick in range(TICKS):
        encoder.add("front", every[tick % 2], *pictures(tick))
        encoder.check()
    for number, stream in enumerate(streams):
        encoder.finish(stream.worker, {"front": stream}, lambda films, n=number: facts.update({n: films["front"]}))
        encoder.leave(stream.worker)
    encoder.wait()
    encoder.check()
    encoder.close()
    return facts


def dropped(encoder, streams):
    """Drop films; True for each that was reported."""
    said = []
    for stream in streams:
        encoder.discard(stream.worker, {"front": stream}, lambda: said.append(1))
    encoder.wait()
    encoder.close()
    return len(said) == len(streams)


def test_bytes_are_those_of_threads_and_of_neither(tmp_path):
    """Two processes, two threads and none make the same videos, depths and numbers of frames."""
    makers = {"pool": EncoderPool(2, 1), "threads": EncoderThreads(2), "none": EncoderThreads(0)}
    facts = {name: film(encoder, tmp_path / name) for name, encoder in makers.items()}
    for name in ("threads", "none"):
        for world in range(WORLDS):
            for ending in ("mp4", "raw"):
                file = f"{world}.{ending}"
                assert (tmp_path / "pool" / file).read_bytes() == (tmp_path / name / file).read_bytes(), (name, file)
            assert facts["pool"][world] == facts[name][world]
    assert facts["pool"][0].frames == TICKS and facts["pool"][WORLDS - 1].frames == TICKS // 2
    assert not list(tmp_path.rglob("*.part"))


def test_dropped_films_leave_no_file(tmp_path):
    """Films dropped in the middle are gone, and the pool takes other pictures afterwards."""
    pool = EncoderPool(1, 1)
    streams = begin(pool, tmp_path)
    pool.add("front", streams, *pictures(0))
    pool.wait()
    assert len(list(tmp_path.iterdir())) == 2 * WORLDS
    for stream in streams:
        pool.discard(stream.worker, {"front": stream}, lambda: None)
    more = begin(pool, tmp_path, worlds=2, depth=False)
    pool.add("front", more, torch.zeros(2, SIZE, SIZE, 3, dtype=torch.uint8), None)
    assert dropped(pool, more) and list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    """The error of a process arrives with number and file; the episode has no films, the others have theirs."""
    pool = EncoderPool(1, 1)
    pool.bind({"front": Pictured(2, SIZE, SIZE, False)}, CPU)
    (tmp_path / "file").touch()
    whole = pool.open(pool.join(), tmp_path / "a.mp4", tmp_path / "a.raw", 50)
    broken = pool.open(pool.join(), tmp_path / "file" / "b.mp4", tmp_path / "b.raw", 50)
    pool.add("front", [whole, broken], torch.zeros(2, SIZE, SIZE, 3, dtype=torch.uint8), None)
    told = {}
    for stream in (whole, broken):
        pool.finish(stream.worker, {"front": stream}, lambda films, stream=stream: told.update({stream: films}))
    pool.wait()
    with pytest.raises(OSError, match=r"file") as caught:
        pool.check()
    assert caught.value.errno in (errno.EEXIST, errno.ENOTDIR)
    pool.check()
    pool.close()
    assert told[broken] is None and told[whole]["front"].frames == 1 and (tmp_path / "a.mp4").is_file()


def children(parent, wanted):
    """Process numbers of the encoders of a process, once so many run."""

    def all_of_them():
        found = []
        for entry in os.listdir("/proc"):
            with contextlib.suppress(OSError, ValueError, IndexError):
                with open(f"/proc/{int(entry)}/stat") as file:
                    status = file.read().rsplit(")", 1)[1].split()
                with open(f"/proc/{int(entry)}/cmdline") as file:
                    if int(status[1]) == parent and "encoder_process" in file.read() and status[0] != "Z":
                        found.append(int(entry))
        return found if len(found) == wanted else None

    return wait_for(all_of_them, f"{wanted} encoders")


def test_a_killed_process_is_one_clear_error(tmp_path):
    """The films of a killed process are lost and reported, those of the others are whole; nothing waits for ever."""
    pool = EncoderPool(2, 1)
    streams = begin(pool, tmp_path, worlds=2)
    pool.add("front", streams, torch.zeros(2, SIZE, SIZE, 3, dtype=torch.uint8), torch.zeros(2, SIZE, SIZE).half())
    pool.wait()
    victim = min(children(os.getpid(), 2))  # processes are started in their order
    os.kill(victim, signal.SIGKILL)
    with pytest.raises(ChildProcessError, match=r"a process that encodes pictures ended \(SIGKILL; out of memory\?\)"):
        while True:
            pool.add(
                "front", streams, torch.zeros(2, SIZE, SIZE, 3, dtype=torch.uint8), torch.zeros(2, SIZE, SIZE).half()
            )
            pool.check()
            time.sleep(0.01)
    told = []
    for stream in streams:
        pool.finish(stream.worker, {"front": stream}, told.append)
    pool.wait()
    pool.close()
    assert sorted(films is None for films in told) == [False, True]
    assert len(list(tmp_path.glob("*.mp4"))) == 1 and not list(tmp_path.glob("*.part"))


def half_filmed(arguments):
    """A process that has begun two films."""
    pool = EncoderPool(2, 1)
    streams = begin(pool, Path(arguments[0]), worlds=2, depth=False)
    pool.add("front", streams, torch.zeros(2, SIZE, SIZE, 3, dtype=torch.uint8), None)
    pool.wait()
    print(len(list(Path(arguments[0]).glob("*.part"))), flush=True)
    time.sleep(600)


def test_no_process_outlives_a_killed_recorder(tmp_path):
    """Kill -9 of the recording process ends its encoders, which leave its partial files to the next call."""
    run = Child(f"{__name__}:half_filmed", [str(tmp_path)])
    try:
        assert run.lines(1) == ["2"], run.printed()
        encoders = children(run.pid, 2)
    finally:
        run.kill()
        run.wait()
    wait_for(lambda: not any(os.path.exists(f"/proc/{one}") for one in encoders), "end of the encoders")


@pytest.mark.parametrize("torn", ["_transmit", "_hear"])
def test_an_interrupt_tears_no_message(tmp_path, monkeypatch, torn):
    """Ctrl-C in the middle of a message to or from a process: every film is finished, none is waited for in vain."""
    whole, pending = getattr(EncoderPool, torn), []

    def interrupted(pool, *about):
        if pending:  # one for each step: the second one in a row comes through at once
            signal.raise_signal(pending.pop())
        whole(pool, *about)

    def late(number, frame):
        raise TimeoutError("the pool waits for a message that was lost")

    pool, facts, interrupts = EncoderPool(1, 1), [], 0
    streams = begin(pool, tmp_path)
    monkeypatch.setattr(EncoderPool, torn, interrupted)
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(60)
    try:
        steps = [lambda: pool.add("front", streams, *pictures(0))] * 3
        steps += [lambda r=stream: pool.finish(r.worker, {"front": r}, facts.append) for stream in streams]
        for step in [*steps, pool.wait]:
            pending[:] = [signal.SIGINT]
            try:
                step()
            except KeyboardInterrupt:
                interrupts += 1
        pending.clear()
        pool.wait()
        assert interrupts and len(facts) == WORLDS and all(films["front"].frames == 3 for films in facts)
        pool.close()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
