"""Ctrl-C waits for what must not be torn apart."""

import signal
import threading

import pytest

from arena_newton.files.interrupts import Uninterrupted


def test_a_signal_waits_for_the_end_of_the_block():
    """A block that was begun is done, then the interrupt comes, and the handler is the one from before."""
    before, done, whole = signal.getsignal(signal.SIGINT), [], Uninterrupted()
    with pytest.raises(KeyboardInterrupt), whole, whole:
        signal.raise_signal(signal.SIGINT)
        done.append("inner")
    assert done == ["inner"] and signal.getsignal(signal.SIGINT) is before
    with whole:  # nothing of the last one is left
        done.append("again")
    assert done == ["inner", "again"]


def test_a_second_signal_comes_at_once():
    """A second Ctrl-C does not wait for a block that hangs."""
    done, whole = [], Uninterrupted()
    with pytest.raises(KeyboardInterrupt), whole:
        signal.raise_signal(signal.SIGINT)
        done.append("first")
        signal.raise_signal(signal.SIGINT)
        done.append("second")
    assert done == ["first"]
    with whole:
        done.append("again")
    assert done == ["first", "again"]


def test_an_error_of_the_block_is_not_hidden():
    """A block that fails by itself says so, and the interrupt that waited comes with it."""
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt) as caught, Uninterrupted():
        signal.raise_signal(signal.SIGINT)
        raise ValueError("broken")
    assert isinstance(caught.value.__context__, ValueError) and signal.getsignal(signal.SIGINT) is before


def test_other_threads_pass(monkeypatch):
    """Signals are the main thread's: in another one the context does nothing."""
    whole, errors = Uninterrupted(), []

    def work():
        try:
            with whole:
                assert signal.getsignal(signal.SIGINT) is before
        except BaseException as error:
            errors.append(error)

    before = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not errors
