"""Threads that encode: order, back-pressure, errors; what an episode's thread leaves on the disk."""

import threading
import time

import pytest
import torch

from arena_newton.data.recording.encoding import Encoders, PictureSlots


@pytest.mark.parametrize("threads", [0, 1, 3])
def test_jobs_of_an_episode_are_done_in_order(threads):
    """Each episode's jobs run one after the other, whatever the others do."""
    encoders, done = Encoders(threads), {number: [] for number in range(4)}
    numbers = {number: encoders.join() for number in done}
    for job in range(50):
        for number, jobs in done.items():
            encoders.submit(numbers[number], lambda jobs=jobs, job=job: jobs.append(job))
    encoders.wait()
    encoders.check()
    encoders.close()
    assert all(jobs == list(range(50)) for jobs in done.values())


def test_episodes_are_spread_over_threads():
    """A new episode goes to the thread with the fewest, one that left makes room."""
    encoders = Encoders(2)
    first, second = encoders.join(), encoders.join()
    assert {first, second} == {0, 1}
    encoders.leave(second)
    assert encoders.join() == second
    encoders.close()


@pytest.mark.parametrize("threads", [0, 2])
def test_an_error_of_a_job_reaches_whoever_checks_and_stops_no_other_job(threads):
    """The first exception is raised by `check`, once; later jobs are done nevertheless."""
    encoders, done = Encoders(threads), []

    def fail():
        raise OSError(28, "No space left on device", "film.mp4")

    encoders.submit(0, fail)
    encoders.submit(0, lambda: done.append(1))
    encoders.wait()
    with pytest.raises(OSError, match="film.mp4"):
        encoders.check()
    encoders.check()
    encoders.close()
    assert done == [1]


def test_full_slots_hold_back_whoever_brings_pictures():
    """With all slots taken the next pictures wait until a user has released one; none is overwritten."""
    slots = PictureSlots((2, 3), torch.uint8, 2)
    first, second = slots.take(2), slots.take(1)
    first.fill(torch.full((2, 3), 7, dtype=torch.uint8))
    taken = []
    waiting = threading.Thread(target=lambda: taken.append(slots.take(1)))
    waiting.start()
    slots.release(first)
    time.sleep(0.05)
    assert not taken and (first.picture(1) == 7).all() and second is not first  # it has another user
    slots.release(first)
    waiting.join(60)
    assert taken == [first]


def test_closing_does_what_was_submitted():
    """No job is lost by an end."""
    encoders, done = Encoders(1), []
    for job in range(5):
        encoders.submit(0, lambda job=job: (time.sleep(0.01), done.append(job)))
    encoders.close()
    assert done == list(range(5))
