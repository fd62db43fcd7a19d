"""Messages unpacked and pictures scaled by two threads, the smallest first, whoever sends how many.

Reading takes several times the memory of a message (a thousand times that of a packed picture of one colour), and the
processor. Of large messages one is read at a time, at most half of the time, and one thread is kept for all others.
"""

from __future__ import annotations

import heapq
import itertools
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future

__all__ = ["LARGE", "MessageReaders"]

LARGE = 4 * 2**20
"""Largest message that is not large [bytes]; a picture of 640x480 is 0.9 MB, one of 1280x960 is 3.7 MB."""
LONGEST_PAUSE = 1.0
"""Longest pause after a large message [s]; it is as long as reading it took."""


class MessageReaders:
    """Two threads that read for all connections."""

    def __init__(self) -> None:
        """Start the threads."""
        self.inside = 0
        """Bytes of the messages that are being read."""
        self.most_inside = 0
        """Largest number of these at a time."""
        self._waiting: list[tuple[int, int, Callable[[], None], Future[None]]] = []
        self._numbers = itertools.count()
        self._news = threading.Condition()
        self._closed = False
        for largest in (LARGE, math.inf):
            threading.Thread(target=self._work, args=[largest], name="message reader", daemon=True).start()

    def run[T](self, size: int, read: Callable[[], T]) -> T:
        """Call a function when it is its turn.

        Args:
            size: Bytes of the message, or of the picture that it unpacks.

        Raises:
            CancelledError: The readers are closed.
        """
        result: list[T] = []
        done: Future[None] = Future()
        with self._news:
            if self._closed:
                done.cancel()
            heapq.heappush(self._waiting, (size, next(self._numbers), lambda: result.append(read()), done))
            self._news.notify_all()
        try:
            done.result()
        finally:
            del done  # an error would keep itself, and the message, through this frame
        return result.pop()

    def close(self) -> None:
        """End the threads; what waits is cancelled."""
        with self._news:
            self._closed = True
            for *_, done in self._waiting:
                done.cancel()
            self._waiting.clear()
            self._news.notify_all()

    def _work(self, largest: float) -> None:
        """Read what is at most so large."""
        while True:
            with self._news:
                self._news.wait_for(lambda: self._closed or self._waiting and self._waiting[0][0] <= largest)
                if self._closed:
                    return
                size, _, read, done = heapq.heappop(self._waiting)
                began = time.monotonic()
                self.inside += size
                self.most_inside = max(self.inside, self.most_inside)
            try:
                read()
                error = None
            except BaseException as raised:
                error = raised
            with self._news:
                self.inside -= size
            if error is None:
                done.set_result(None)
            else:
                done.set_exception(error)
            del read, done, error  # with the message
            if size > LARGE:
                time.sleep(min(time.monotonic() - began, LONGEST_PAUSE))
