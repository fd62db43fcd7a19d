"""Claims of the benchmark, in the order in which a reader of the paper asks, each with the checks that show it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from arena_newton.eval.certification.finding import Check, CheckFinding, Verdict
from arena_newton.files.text import counted

__all__ = ["CLAIMS", "Claim", "ClaimFinding", "claimed", "verdict_of"]

WORST_FIRST: tuple[Verdict, ...] = ("fail", "note", "pass", "skip")
"""Order of verdicts: a claim's is the first that one of its checks has; what was not measured counts last."""

WORDS: Mapping[Verdict, tuple[str, str]] = {
    "fail": ("does not hold", "do not hold"),
    "pass": ("holds", "hold"),
    "note": ("holds with what its notes say", "hold with what their notes say"),
    "skip": ("was not measured", "were not measured"),
}
"""Verdict → its wording for one claim and for several."""


@dataclass(frozen=True)
class Claim:
    """A sentence about the benchmark."""

    text: str
    checks: tuple[str, ...]
    """Names of the checks that show it."""


@dataclass(frozen=True)
class ClaimFinding:
    """Finding about a claim."""

    claim: Claim
    findings: tuple[tuple[Check, CheckFinding], ...]
    """Those of its checks that have run, at least one, in its order."""

    @property
    def text(self) -> str:
        """The claim, with what its checks found that belongs into its line."""
        message = "; ".join(finding.claim for _, finding in self.findings if finding.claim)
        return f"{self.claim.text.removesuffix('.')}: {message}." if message else self.claim.text

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of its checks."""
        found = {finding.verdict for _, finding in self.findings}
        return next(verdict for verdict in WORST_FIRST if verdict in found)


CLAIMS = (
    Claim("What is written down is what happened, and a replay of it shows it.", ("journal", "recording")),
    Claim("Every task can be solved, by actions alone, through each tracker and under both rule sets.", ("solvable",)),
    Claim("Policy and tracker know no more than they are given.", ("policy-inputs", "tracker-inputs")),
    Claim("Experts need their legs, but where a gliding base is known to do.", ("frozen-legs", "gliding-base")),
    Claim(
        "Each axis of generalisation moves what its name says, and nothing else.",
        ("visual", "semantic", "execution", "dynamics", "modes"),
    ),
    Claim("Another tracker costs success although nothing else changes.", ("swap",)),
    Claim("The trackers' weights that come with the package are as good as the official ones.", ("official",)),
    Claim("A policy that sees can find what its instruction names.", ("visible",)),
    Claim("A failure is named by the stage at which it happened.", ("failures",)),
    Claim("Of two policies one is called better no more often by mistake than the page says.", ("statistics",)),
    Claim(
        "An episode depends on its seed alone, not on its batch, on which processes of one machine play it or on one "
        "that is lost.",
        ("batches", "shards", "ray"),
    ),
    Claim("The world moves as mechanics says, on both engines.", ("physics",)),
    Claim("Both physics engines move alike, and their rates are equivalent within 5 points.", ("engines",)),
    Claim("The head camera's picture is as wide as the original's.", ("camera",)),
    Claim("An episode succeeds at the tick at which the rule set's condition holds.", ("rules",)),
    Claim("Exact gradients are those that differences estimate.", ("gradients",)),
    Claim("What no rule counts is measured: feet on DoubleDesk's sill.", ("sill",)),
)
"""All claims, the first that a reader asks for first."""


def claimed(findings: Mapping[Check, CheckFinding], claims: Sequence[Claim] = CLAIMS) -> list[ClaimFinding]:
    """Findings by claim; a check of no claim is one of its own, its question.

    Args:
        claims: In their order.
    """
    known = {name for claim in claims for name in claim.checks}
    own = tuple(Claim(check.question, (check.name,)) for check in findings if check.name not in known)
    by_name = {check.name: (check, finding) for check, finding in findings.items()}
    found = []
    for claim in (*claims, *own):
        parts = tuple(by_name[name] for name in claim.checks if name in by_name)
        found += [ClaimFinding(claim, parts)] if parts else []
    return found


def verdict_of(findings: Mapping[Check, CheckFinding], planned: int) -> str:
    """The whole in one sentence.

    Args:
        planned: How many checks are to be run.
    """
    counts = Counter(one.verdict for one in claimed(findings))
    lines = [
        f"{counted(counts[verdict], 'claim')} {words[counts[verdict] != 1]}"
        for verdict, words in WORDS.items()
        if counts[verdict]
    ]
    failed = " ".join(check.name for check, finding in findings.items() if finding.verdict == "fail")
    left = planned - len(findings)
    if failed:
        begin = f"Not certified ({failed})"
    elif left:
        begin = f"Not finished, {left} of {planned} checks have not run"
    else:
        begin = "Certified" if counts["pass"] or counts["note"] else "Nothing was certified"
    return f"{begin}: {', '.join(lines) or 'nothing was measured'}."
