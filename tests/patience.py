"""Deadlines of tests: short where the machine is quick, long where it is busy."""

import time

import pytest

PLENTY = 120.0
"""Time that nothing here comes near, however busy the machine is [s]."""


def patiently(check, deadlines=(0.3, 3.0, 30.0)):
    """Call a check with a deadline [s]; where it fails, once more with a longer one, which a fault does not outlast."""
    for deadline in deadlines[:-1]:
        try:
            return check(deadline)
        except (Exception, pytest.fail.Exception):
            pass  # on a busy machine what is quick misses a short deadline too
    return check(deadlines[-1])


def wait_for(check, what, seconds=PLENTY):
    """Wait until a check gives something true, and return it."""
    end = time.monotonic() + seconds
    while not (found := check()):
        if time.monotonic() > end:
            pytest.fail(f"no {what} after {seconds:.0f} s", pytrace=False)
        time.sleep(0.05)
    return found
