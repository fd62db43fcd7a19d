"""Real time: a clock of 50 Hz that says when it falls behind, and pictures that are left out before a tick is late."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from arena_newton.robot.g1 import TICK

__all__ = ["Pace", "TimedPicture"]

LATE = TICK
"""A tick that begins so much after its time is late [s]."""
LOST = 0.2
"""A loop that is so far behind does not catch up: the time is lost [s]."""
WINDOW = 250
"""Ticks over which the real-time factor is measured."""
DEBT = TICK
"""A picture may make the next tick begin so much late [s]; the ticks after it catch up."""
STARVED = 1.0
"""A picture is drawn after this pause whatever it costs [s]: a person who sees nothing cannot drive."""


class Pace:
    """Timing of the ticks: their begin, delays and cost."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep):
        """Begin now.

        Args:
            clock: Time [s].
            sleep: Waits [s].
        """
        self.clock, self._sleep = clock, sleep
        self.ticks = 0
        """Ticks so far."""
        self.late = 0
        """Those that began late."""
        self.passed = 0.0
        """Time that passed during them [s]."""
        self._recent: deque[float] = deque(maxlen=WINDOW)
        self.restart()

    def restart(self) -> None:
        """The next tick begins now: what happened since the last one, such as a reset, counts for nothing."""
        self._due = self._last = self.clock()
        self._recent.clear()

    @property
    def spare(self) -> float:
        """Time until the next tick must begin [s]; negative when it is late."""
        return self._due - self.clock()

    @property
    def recent(self) -> float:
        """Simulated time over time that passed, of the last seconds."""
        if len(self._recent) < 2:
            return 1.0
        return min(1.0, (len(self._recent) - 1) * TICK / max(self._recent[-1] - self._recent[0], 1e-9))

    @property
    def factor(self) -> float:
        """The same of all ticks."""
        return min(1.0, self.ticks * TICK / self.passed) if self.passed > 0.0 else 1.0

    def wait(self) -> None:
        """Wait until the next tick begins."""
        spare = self.spare
        if spare > 0.0:
            self._sleep(spare)
        now = self.clock()
        self.late += now - self._due > LATE
        self._due = max(self._due, now - LOST) + TICK
        self.ticks += 1
        self.passed += now - self._last
        self._last = now
        self._recent.append(now)


class TimedPicture:
    """A picture that is drawn now and then, when the time between two ticks allows it."""

    def __init__(self, draw: Callable[[], None], period: float):
        """Draw at the first occasion.

        Args:
            period: Shortest time between two [s].
        """
        self._draw, self.period = draw, period
        self.drawn = 0
        """Pictures so far."""
        self.shed = 0
        """Those that came later than they were due, for lack of time."""
        self.cost = 0.0
        """Cost of a picture [s], of the last ones."""
        self._next = 0.0
        self._waits = False

    def try_draw(self, pace: Pace) -> bool:
        """Draw if it is due and there is time.

        Returns:
            Whether it was drawn.
        """
        begin = pace.clock()
        if begin < self._next:
            return False
        if self.drawn and self.cost > pace.spare + DEBT and begin < self._next + STARVED:
            self.shed += not self._waits
            self._waits = True
            return False
        self._draw()
        cost = pace.clock() - begin
        # The first one compiles and allocates: it says nothing of the others.
        self.cost = cost if self.drawn == 1 else 0.8 * self.cost + 0.2 * cost if self.drawn else 0.0
        self.drawn += 1
        self._waits = False
        self._next = max(self._next + self.period, begin + 0.5 * self.period)
        return True
