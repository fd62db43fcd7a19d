"""Progress of a run: a bar on a terminal, a line now and then in a log file."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn, TextIO

from tqdm import tqdm

from arena_newton.files.text import counted
from arena_newton.robot.g1 import TICK

__all__ = ["Progress", "duration", "kernels_to_compile", "simulated"]

LINE_SECONDS = 30.0
"""Longest time between two lines in a log file while ticks go on [s]."""
LINE_FRACTION = 0.1
"""A line appears also when so much more of the budget is done, if that took a while."""
LINE_PAUSE = 5.0
"""Least time between two lines [s]."""
MEASURED_SECONDS = 5.0
"""Time over which the first speed is measured before an estimate is given [s]."""
ESTIMATE_FROM = 60.0
"""An estimate is worth a line from this length on [s]."""


def duration(seconds: float) -> str:
    """A length of time in words, such as ``40 s``, ``12 min`` and ``3 h 20 min``."""
    if seconds < 90.0:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def simulated(ticks: int) -> str:
    """Size of a run in words: its largest number of ticks, and the time that they simulate."""
    seconds = TICK * ticks
    length = f"{seconds:g} s" if seconds < 1.0 else duration(seconds)
    return f"at most {counted(ticks, 'world-tick')} ({length} simulated)"


def kernels_to_compile(cache: Path, engine: str, device: str) -> bool:
    """True if Warp's cache lacks kernels of ours for a device, so that the first steps compile them.

    A look at the folder's names, which costs nothing; kernels that a newer version changed are not noticed. Engine
    `warp` has kernels of its own.
    """
    binaries = ("*.cubin", "*.ptx") if device.startswith("cuda") else ("*.o",)
    wanted = ["wp_arena_newton.kernels.*", *(["wp_mujoco_warp*"] if engine == "warp" else [])]
    return not all(any(any(cache.glob(f"{name}/{binary}")) for binary in binaries) for name in wanted)


class Progress:
    """Counts the ticks of the planned budget; an episode that ends early adds the ticks that it did not need."""

    def __init__(
        self,
        budget: int,
        *,
        planned: int,
        finished: int = 0,
        done: int = 0,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ):
        """Show the beginning.

        Args:
            planned: Number of planned episodes.
            finished: Number of them that have ended already.
            done: Their ticks.
            stream: The error stream by default.
            clock: Gives seconds.
        """
        self.budget, self.planned, self.finished, self.done = max(budget, 1), planned, finished, done
        self._stream = stream or sys.stderr
        self._clock = clock
        self._name = ""
        self._first_done = self._line_done = self._over = done
        self._running = 0
        self._line_at = clock()
        self._last: float | None = None
        self._stepping = self._ticks = 0.0
        self._window = [0.0, 0.0]
        self._rate = 0.0
        self._estimated = False
        self._bar: tqdm[NoReturn] | None = None
        if self._stream.isatty():
            bar = "{desc} {percentage:3.0f}%|{bar}|{postfix}"
            self._bar = tqdm(
                total=self.budget, initial=done, file=self._stream, dynamic_ncols=True, bar_format=bar, mininterval=0.2
            )

    @property
    def seconds_left(self) -> float | None:
        """Time that the rest takes at the speed so far, early ends included [s]; None before there is one."""
        gained = self.done - self._first_done
        return (self.budget - self.done) * self._stepping / gained if gained > 0 else None

    def group(self, name: str) -> None:
        """The coming episodes belong to this group; worlds are built first, whose time no speed counts."""
        self._name, self._last = name, None
        self._describe()

    def tick(self, active: int) -> None:
        """One tick of so many worlds is over."""
        now = self._clock()
        if self._last is not None:
            passed = now - self._last
            self._stepping += passed
            self._ticks += active
            self._window[0] += active
            self._window[1] += passed
            self._running += active
            self._advance()
            if self._window[1] >= 1.0:
                self._rate = self._window[0] / self._window[1]
                self._window = [0.0, 0.0]
                self._describe()
                self._estimate()
            self._line(now)
        self._last = now

    def more(self, budgets: Sequence[int]) -> None:
        """Episodes with these budgets [ticks] are planned besides."""
        self.planned += len(budgets)
        self.budget += sum(budgets)
        if self._bar is not None:
            self._bar.total = self.budget

    def episode(self, budget: int, used: int) -> None:
        """An episode is over.

        Args:
            budget: Its planned ticks, all of which are done now.
            used: Ticks that it took, its start-up included.
        """
        self.finished += 1
        self._over += budget
        self._running = max(0, self._running - used) if self.finished < self.planned else 0
        self._advance()
        self._describe()

    def say(self, text: str) -> None:
        """Print a line next to the bar."""
        if self._bar is not None:
            self._bar.write(text, file=self._stream)
        else:
            print(text, file=self._stream, flush=True)

    def close(self) -> None:
        """Leave the bar, or the last line, as it is."""
        if self._bar is not None:
            self._bar.close()
        elif self.done != self._line_done:
            self.say(self._text())
        self._line_done = self.done

    def _advance(self) -> None:
        before = self.done
        self.done = max(before, min(self.budget, self._over + self._running))
        if self._bar is not None:
            self._bar.update(self.done - before)

    def _describe(self) -> None:
        if self._bar is not None:
            self._bar.set_description_str(f"{self._name} {self.finished}/{self.planned}", refresh=False)
            self._bar.set_postfix_str(self._speed())

    def _speed(self) -> str:
        parts = [f"{self._rate:.0f} world-ticks/s"] if self._rate else []
        left = self.seconds_left
        if left is not None and self.done < self.budget:
            parts.append(f"about {duration(left)} left")
        return ", ".join(parts)

    def _estimate(self) -> None:
        """Once, when the speed is known: how long the run takes if no episode ends early."""
        if self._estimated or self._stepping < MEASURED_SECONDS:
            return
        self._estimated = True
        seconds = (self.budget - self.done) * self._stepping / max(self._ticks, 1.0)
        if seconds >= ESTIMATE_FROM:
            speed = f"{self._ticks / self._stepping:.0f} world-ticks/s"
            self.say(f"  at the measured {speed}: at most {duration(seconds)}, less as episodes end early")

    def _line(self, now: float) -> None:
        if self._bar is not None or now - self._line_at < LINE_PAUSE:
            return
        if now - self._line_at >= LINE_SECONDS or self.done - self._line_done >= LINE_FRACTION * self.budget:
            self._line_at, self._line_done = now, self.done
            self.say(self._text())

    def _text(self) -> str:
        finished = f"{self._name}: {self.finished} of {counted(self.planned, 'episode')}"
        return ", ".join(filter(None, (finished, f"{self.done / self.budget:.0%} of the tick budget", self._speed())))
