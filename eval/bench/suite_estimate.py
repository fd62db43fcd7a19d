"""How long a suite takes on some devices, from cells that were measured: a ratio estimate with its interval.

Cells are of one kind when policies of one family play them in one mode. A few cells of each kind are drawn by the hash
of their names and measured. A cell's size is known: ticks of its batches of worlds up to their step budget. The time of
a kind is the time of its measured cells by their size times the size of all its cells (Cochran, Sampling Techniques,
3rd ed., 1977, chapter 6), its variance that of the residuals; the interval is Student's, of the logarithm.
"""

from __future__ import annotations

import hashlib
import heapq
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from scipy import stats

__all__ = ["CellSize", "DeviceTime", "MeasuredCell", "SuiteTime", "Slowdown", "drawn", "suite_time"]

LEVEL = 0.95
"""Of intervals."""

type Kind = tuple[str, str]
"""Family, or name of a policy without one, and mode."""


@dataclass(frozen=True)
class CellSize:
    """A cell before it is measured."""

    name: str
    kind: Kind
    group: tuple[str, str, str]
    """Task, tracker and mode, whose environment is built once where cells follow each other."""
    ticks: int
    """Ticks of all its batches of worlds, start-up included, when every episode takes its step budget."""


@dataclass(frozen=True)
class MeasuredCell:
    """What a cell takes on one device."""

    size: CellSize
    seconds: float
    """In an environment that is there: its episodes to their step budget, policy and reports [s]."""
    build: float
    """To build its environment [s]."""


@dataclass(frozen=True)
class Slowdown:
    """How much longer one device takes for its work when a second one of the machine works too."""

    alone: tuple[float, ...]
    """Rounds of one process [s]."""
    pair: tuple[float, ...]
    """Rounds of two, each with the work of the one [s]."""

    @property
    def ratio(self) -> float:
        """Time of a pair as a multiple of one's, by the medians; at least 1."""
        return max(1.0, statistics.median(self.pair) / statistics.median(self.alone))

    @property
    def range(self) -> tuple[float, float]:
        """The same by the fastest and the slowest rounds."""
        return max(1.0, min(self.pair) / max(self.alone)), max(1.0, max(self.pair) / min(self.alone))


@dataclass(frozen=True)
class DeviceTime:
    """Time of the whole on a number of devices [s]."""

    devices: int
    seconds: float
    low: float
    high: float


@dataclass(frozen=True)
class SuiteTime:
    """Time of a suite."""

    rates: Mapping[Kind, float]
    """Seconds per tick of a batch of worlds."""
    seconds: float
    """On one device, without environments [s]."""
    error: float
    """Standard error of it [s]."""
    building: float
    """Environments, if each is built once [s]."""
    degrees: int
    """Degrees of freedom of the interval."""
    on: tuple[DeviceTime, ...]
    """On as many devices as were asked for."""


def drawn(cells: Sequence[CellSize], each: int) -> list[CellSize]:
    """So many cells of each kind, by the hash of their names, in the order of the plan."""
    kept: set[str] = set()
    for kind in {cell.kind for cell in cells}:
        names = [cell.name for cell in cells if cell.kind == kind]
        kept |= set(sorted(names, key=lambda name: hashlib.sha256(name.encode()).digest())[:each])
    return [cell for cell in cells if cell.name in kept]


def suite_time(
    cells: Sequence[CellSize],
    measured: Sequence[MeasuredCell],
    devices: Sequence[int],
    slowdown: Slowdown | None = None,
) -> SuiteTime:
    """Time of all cells.

    Of a kind with one measured cell the variance relative to its mean is that of all others. Devices are given cells
    in the order of the plan, each as soon as it is free; among n of them each is slower by n - 1 times what a second
    one costs the first.

    Args:
        cells: All cells of kinds that were measured, in the order in which they are played.
        measured: At least one cell of each kind.
        devices: Numbers of devices.
        slowdown: What a second device costs; None: nothing is known of it, and none is assumed.
    """
    of_kind = {kind: [one for one in measured if one.size.kind == kind] for kind in {c.kind for c in cells}}
    rates = {k: sum(m.seconds for m in ms) / sum(m.size.ticks for m in ms) for k, ms in of_kind.items()}
    relative, degrees = [], 0
    for kind, ms in of_kind.items():
        spread = [(m.seconds - rates[kind] * m.size.ticks) / (rates[kind] * m.size.ticks) for m in ms]
        relative += spread if len(ms) > 1 else []
        degrees += len(ms) - 1
    pooled = sum(value**2 for value in relative) / degrees if degrees else 0.0
    variance = 0.0
    for kind, ms in of_kind.items():
        whole = [cell for cell in cells if cell.kind == kind]
        n, many = len(ms), len(whole)
        if n > 1:
            residuals = sum((m.seconds - rates[kind] * m.size.ticks) ** 2 for m in ms) / (n - 1)
        else:
            residuals = pooled * (rates[kind] * sum(c.ticks for c in whole) / many) ** 2
        # Without the correction for a finite plan: where all cells are measured, chance in the measuring is left.
        variance += many**2 * residuals / n
    seconds = sum(rates[cell.kind] * cell.ticks for cell in cells)
    build = statistics.fmean(max(0.0, m.build) for m in measured)
    building = build * (1 + sum(a.group != b.group for a, b in pairwise(cells)))
    error = math.sqrt(variance)
    reach = error * float(stats.t.ppf((1 + LEVEL) / 2, degrees)) if degrees else 0.0
    part = math.exp(reach / seconds)  # of the logarithm: no time is below 0
    found = []
    for number in devices:
        alone = _makespan(cells, rates, build, number)
        ratio, (low, high) = (1.0, (1.0, 1.0)) if slowdown is None else (slowdown.ratio, slowdown.range)
        more = [1 + (r - 1) * (number - 1) for r in (ratio, low, high)]
        found.append(DeviceTime(number, alone * more[0], alone * more[1] / part, alone * more[2] * part))
    return SuiteTime(rates, seconds, error, building, degrees, tuple(found))


def _makespan(cells: Sequence[CellSize], rates: Mapping[Kind, float], build: float, devices: int) -> float:
    """Time until all cells are played when each device takes the next one as soon as it is free [s].

    A device builds an environment where the cell before it, on that device, was of another group.
    """
    free: list[tuple[float, int, tuple[str, str, str]]] = [(0.0, n, ("", "", "")) for n in range(devices)]
    heapq.heapify(free)
    for cell in cells:
        at, number, last = heapq.heappop(free)
        at += rates[cell.kind] * cell.ticks + (build if cell.group != last else 0.0)
        heapq.heappush(free, (at, number, cell.group))
    return max(at for at, _, _ in free)
