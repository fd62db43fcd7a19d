"""Failures by stage as the reports show them: rows of two tables, and bars of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from arena_newton.eval.folders.failure_counts import FailureCell, SeenRate
from arena_newton.eval.folders.failure_stage import FailureStage
from arena_newton.files.text import plain
from arena_newton.pages.tables import Table, between

__all__ = ["SENTENCES", "WAITS", "StageBar", "failures_markdown", "stage_bars"]

SENTENCES: dict[str, str] = {
    FailureStage.PERCEPTION: "what the task names was not found: the robot did not stay near it",
    FailureStage.APPROACH: "it stayed near it, but not where it can be touched",
    FailureStage.POSTURE: "it stood where it could touch it and did not, or lost its balance before",
    FailureStage.CONTACT: "it was touched without the wanted effect",
    FailureStage.RECOVERY: "after a touch it fell, or did not follow what had moved away",
    FailureStage.TRACKING: "its legs did not follow a plausible reference",
}
"""Stage → what happened, in a sentence."""
WAITS = "waits in view"
"""Ending of an episode that has one of its own."""
_HEAD = ["task", "tracker", "policy", "mode", "n", "success", *map(str, FailureStage), WAITS, "near a bar"]
_SEEN_HEAD = ["task", "tracker", "policy", "mode", "seen at the start", "95 % CI", "not seen", "95 % CI"]


def _names(cell: FailureCell) -> list[str]:
    return [plain(cell[key]) for key in ("task", "tracker", "policy", "mode")]


def _rate(rate: SeenRate) -> list[str]:
    if rate["ci95"] is None:
        return ["-", "-"]
    return [f"{rate['successes']}/{rate['episodes']}", between(rate["ci95"])]


def _endings(cell: FailureCell) -> tuple[int, int]:
    """Failures that wait in view, and those near a bar."""
    return sum(cell["waits"].values()), cell["near"]


def _own(cell: FailureCell) -> str:
    """Number of failures that the swap made; empty where nothing was played through another tracker."""
    own = cell.get("own_tracker")
    if own is None:
        return ""
    return (
        f"{own['successes']} of {own['replayed']} failures succeed with the same actions through their own tracker, "
        f"{plain(own['tracker'])}"
    )


def failures_markdown(cells: Sequence[FailureCell]) -> list[str]:
    """Lines of a report in Markdown; none without cells."""
    if not cells:
        return []
    rows = [
        [*_names(cell), *map(str, (cell["episodes"], cell["successes"], *cell["stages"].values(), *_endings(cell)))]
        for cell in cells
    ]
    seen = [[*_names(cell), *_rate(cell["seen"]), *_rate(cell["unseen"])] for cell in cells]
    lines = ["## Failures by stage", "", Table(_HEAD, rows, "llllr").markdown()]
    lines += [f"- {stage}: {sentence}" for stage, sentence in SENTENCES.items()]
    lines += [
        f"- {WAITS}: failures, counted at their stage too, that stayed slow near what they saw for half of the episode",
        "- near a bar: failures with a signal within a tenth of the bar that decides their stage",
    ]
    own = [(" ".join(_names(cell)), _own(cell)) for cell in cells]
    lines += ["", *(f"{name}: {text}." for name, text in own if text)] if any(text for _, text in own) else []
    lines += ["", "## Success by what the first picture shows", "", Table(_SEEN_HEAD, seen, "llllr").markdown()]
    return [*lines, "An object that is not in the first picture must be searched for, or guessed.", ""]


@dataclass(frozen=True)
class StageBar:
    """A cell's episodes as one bar of the page, and its two rates."""

    title: str
    parts: tuple[tuple[str, int, str, str], ...]
    """Stage or `success`, episodes, and start and width of the part in per cent."""
    seen: tuple[str, str]
    """Successes of the episodes whose first picture shows the object, and their interval."""
    unseen: tuple[str, str]
    """The same of the others."""
    counts: str


def stage_bars(cells: Sequence[FailureCell]) -> list[StageBar]:
    """Bars of the page, in the order of the cells."""
    bars = []
    for cell in cells:
        counts = {"success": cell["successes"], **cell["stages"]}
        parts, done = [], 0
        for name, count in counts.items():
            if count:
                share = [f"{100.0 * number / cell['episodes']:.2f}%" for number in (done, count)]
                parts.append((name, count, share[0], share[1]))
                done += count
        message = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        waiting, near = _endings(cell)
        endings = [f"{waiting} {WAITS}"] if waiting else []
        endings += [f"{near} near a bar"] if near else []
        message = "; ".join(text for text in (message, ", ".join(endings), _own(cell)) if text)
        (seen, interval), (unseen, other) = _rate(cell["seen"]), _rate(cell["unseen"])
        title = " ".join(_names(cell))
        bars.append(StageBar(title, tuple(parts), (seen, interval), (unseen, other), message))
    return bars
