"""Ctrl-C that waits while what must not be torn apart is done."""

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType

__all__ = ["Uninterrupted"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Uninterrupted:
    """Context in which a signal that would raise waits for the end of the block; a second one comes through at once.

    Python raises `KeyboardInterrupt` between any two steps of the main thread, so also between taking a message off a
    queue and sending it. In other threads, and for signals that nothing in Python handles, the context does nothing. It
    can be entered again, also within itself.
    """

    def __init__(self) -> None:
        """Prepare; entering costs a microsecond or two."""
        self._depth = 0
        self._handlers: dict[int, Callable[[int, FrameType | None], object]] = {}
        self._waiting: tuple[int, FrameType | None] | None = None

    def __enter__(self) -> None:
        """Let signals wait."""
        if threading.current_thread() is not threading.main_thread():
            return
        self._depth += 1
        if self._depth > 1:
            return
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if callable(handler):
                self._handlers[number] = handler
                signal.signal(number, self._keep)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Do what a signal asked for meanwhile."""
        if threading.current_thread() is not threading.main_thread():
            return
        self._depth -= 1
        if self._depth:
            return
        handlers, self._handlers = self._handlers, {}
        for number, handler in handlers.items():
            signal.signal(number, handler)
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            handlers[waiting[0]](*waiting)

    def _keep(self, number: int, frame: FrameType | None) -> None:
        again, self._waiting = self._waiting is not None, (number, frame)
        if again:
            self._waiting = None
            self._handlers[number](number, frame)
