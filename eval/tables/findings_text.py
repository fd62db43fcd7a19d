"""The paper's findings as Markdown: a page, and one table for a page of results."""

from __future__ import annotations

from collections.abc import Sequence

from arena_newton.eval.statistics.trainings import DROP_SPREAD, ENOUGH, MATCHED_SPREAD, SWAPPED_SPREAD
from arena_newton.eval.tables.paper_claims import NEGLIGIBLE, SIGNIFICANT, ClaimResult
from arena_newton.eval.tables.table_entries import probability
from arena_newton.pages.tables import Table, escaped

__all__ = ["findings_table", "findings_text"]


def findings_text(found: Sequence[ClaimResult], notes: Sequence[str] = ()) -> str:
    """The findings as Markdown."""
    parts = ["# The paper's findings, tested on the trainings that were evaluated\n"]
    parts.append(
        "The paper's claims, tested on these networks. They are claims about families, trackers and modes, so that "
        "their unit is a training, not an episode: the 95 % intervals in parentheses cover other trainings of the "
        f"same recipes. {DECLARED}\n"
    )
    parts.append(
        "Reproduces: the interval is on the claim's side of 0; where the claim is a difference of either sign, it is "
        f"beyond {100 * NEGLIGIBLE:.0f} points. Does not: the interval excludes an effect of {100 * NEGLIGIBLE:.0f} "
        f"points. Undecided: neither, or p, adjusted for all claims of this page (Holm), is at least {SIGNIFICANT:g}.\n"
    )
    parts += ["".join(f"- {escaped(note)}\n" for note in notes)] if notes else []
    for one in found:
        parts.append(f"## {escaped(one.name)}: {one.verdict}\n")
        parts.append(f"- Claim: {escaped(one.claim)}\n- Paper: {escaped(one.paper)}\n- Ours: {escaped(one.ours)}")
        parts[-1] += f". {escaped(one.remark)}" if one.remark else ""
        if one.p is not None:
            parts[-1] += f"\n- p {probability(one.p)}, adjusted {probability(one.p_holm)}"
        parts[-1] += "\n"
    return "\n".join(parts)


DECLARED = (
    "The standard deviation between trainings of a recipe is measured where "
    f"{ENOUGH} or more were evaluated. Elsewhere it is declared, after eight cells of three trainings: "
    f"{100 * MATCHED_SPREAD:.0f} points for a rate through the tracker of the training, {100 * SWAPPED_SPREAD:.0f} "
    f"through another, and {100 * DROP_SPREAD:.0f} for a difference between trackers or modes; for falls it is that "
    "between the cells compared."
)


def findings_table(found: Sequence[ClaimResult]) -> str:
    """The findings as one Markdown table, for a page of results."""
    rows = [(one.name, one.verdict, one.paper, one.ours, probability(one.p_holm)) for one in found]
    head = ("finding", "here", "the paper", "these networks", "p (Holm)")
    return Table(head, rows, "llllr").markdown()
