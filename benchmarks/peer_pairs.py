"""Common parts of pairs with other programs: the judged ratio, versions, names of devices, the history."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import platform
import re
import statistics
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from arena_newton.eval.bench.timing import NEEDS_CUDA, BenchFigure
from benchmarks.bench_options import PeerOptions

__all__ = ["Pair", "device_name", "on_cpu", "processor_name"]


@dataclass(frozen=True)
class Pair:
    """A measure of this product and of another program."""

    name: str
    bar: float
    unit: str
    """Unit of both sides."""
    packages: tuple[str, ...]
    """Packages whose versions are named with its figures."""
    digits: int = 0
    """Decimals of both sides as they are printed."""
    at_most: bool = False
    """True when the ratio must be small."""

    def missing(self, label: str, reason: str) -> BenchFigure:
        """The figure of a pair that was not measured, which does not count as reached."""
        return BenchFigure(label, self.bar, "x", self.at_most, None, reason)

    def judge(
        self,
        options: PeerOptions,
        label: str,
        rounds: Sequence[tuple[float, float]],
        *,
        unjudged: str = "",
        notes: Iterable[str] = (),
        device: str = "",
        peer_versions: Mapping[str, str] | None = None,
    ) -> BenchFigure:
        """The median of the rounds' ratios, which is not the ratio of the medians; a line of the history is added.

        Args:
            rounds: Ours and the peer's of each round.
            unjudged: Why the bar is not judged; it is judged where this is empty.
            device: Device; the GPU, or the processor where there is none, by default.
            peer_versions: Versions of a peer that has an interpreter of its own.
        """
        ours, peer = (statistics.median(column) for column in zip(*rounds, strict=True))
        ratio = statistics.median(one / other for one, other in rounds)
        versions = {one: importlib.metadata.version(one) for one in self.packages}
        texts = [f"{ours:,.{self.digits}f} / {peer:,.{self.digits}f} {self.unit}, median of {len(rounds)} ratios"]
        texts += [*notes, ", ".join(f"{one} {version}" for one, version in versions.items())]
        note = f"{unjudged}: {ratio:.2f} x, {'; '.join(texts)}" if unjudged else "; ".join(texts)
        figure = BenchFigure(label, self.bar, "x", self.at_most, None if unjudged else ratio, note)
        if options.history:
            line = {
                "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                "pair": self.name,
                "name": label,
                "device": device or device_name(),
                "commit": _commit(),
                "versions": versions,
                "ours": ours,
                "peer": peer,
                "unit": self.unit,
                "ratio": ratio,
                "bar": self.bar,
                "verdict": "information" if unjudged else figure.verdict,
            }
            line |= {} if peer_versions is None else {"peer_versions": dict(peer_versions)}
            with Path(options.history).open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        return figure


def on_cpu(cuda: bool) -> str:
    """Reason for which no bar is judged without CUDA."""
    return "" if cuda else f"{NEEDS_CUDA}; for information, on the CPU"


def _commit() -> str:
    """Commit of the checkout, with ``+`` where files differ from it; empty without Git."""
    root = Path(__file__).resolve().parent.parent
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return done.stdout.strip()


def device_name() -> str:
    """Name of the GPU, or of the processor where there is none."""
    return str(wp.get_device("cuda:0").name) if wp.is_cuda_available() else processor_name()


def processor_name() -> str:
    """Name of the processor."""
    facts = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.+)", facts.read_text()) if facts.is_file() else None
    return found[1] if found else platform.machine()
