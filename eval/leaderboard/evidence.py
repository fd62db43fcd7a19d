"""Level of an entry by what it carries: a bundle, and the findings of an audit (`audit.json`) held to that bundle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from arena_newton.errors import InputError
from arena_newton.eval.audit.claimed_conditions import misnamed_policy, named_policy, policy_kind
from arena_newton.eval.audit.draws import drawn
from arena_newton.eval.audit.folder_audit import AUDIT_FILE, CONSISTENT, ENGINE, REPLAYED, RERUN, Audit
from arena_newton.eval.leaderboard.entry_file import BUNDLE_FILE
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.files.stored_json import Facts, Fit, JsonObject, Name, loaded, parse, read_regular, shown
from arena_newton.files.text import counted, plain_text

__all__ = ["LEAST", "AuditStatement", "earned_level", "read_statements"]

LEAST = 20
"""Episodes of all runs of an entry together that must have been played again for level `replayed`, or all: they find
one forged line of ten with 88 %."""
MOST_TOLERANCE = 1e-4
"""Largest --tolerance under which answers of a policy are still the recorded ones."""

SERVED = ("remote", "process")
"""Policies of another program, whose own name a run does not know."""

Number = Annotated[int, Fit("a number from 0 on", lambda v: v >= 0)]


@dataclass(frozen=True)
class AuditStatement:
    """Findings of an audit of one run, as `audit.json` has them."""

    head: Name
    contradictions: tuple[str, ...]
    draw: int | None
    """The auditor's number; None: all episodes were played again."""
    played: tuple[Number, ...]
    """Numbers of the episodes that were played again."""
    policy: str | None
    """Spec of the policy that was asked again."""
    asked: Number | None
    """Episodes at whose queries it was asked."""
    tolerance: float
    """Largest difference of an action that was taken for its."""
    asked_policy: Annotated[Facts | None, Fit("facts by name or null")] = None
    """File, labels and facts of that policy (`claimed_conditions.named_policy`)."""


def read_statements(folder: Path) -> dict[str, AuditStatement]:
    """Findings in the `audit.json` next to an entry, by the head of their run; none where there is no such file.

    Raises:
        InputError: It is damaged; the message names file and key.
    """
    path = folder / AUDIT_FILE
    try:
        content = parse(read_regular(path, MAX_CONFIG_BYTES))
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise InputError(f"{path}: not readable as JSON ({plain_text(error, 200)})") from None
    rows: list[object] = list(content.values()) if isinstance(content, dict) else []
    if not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path}: expected an object of runs, as `eval audit --out` writes it")
    objects: list[JsonObject] = rows  # type: ignore[assignment]  # each was just seen to be one
    found = [loaded(str(path), row, AuditStatement) for row in objects]
    return {one.head: one for one in found}


def earned_level(audits: Sequence[Audit], stated: Mapping[str, AuditStatement]) -> tuple[str, str]:
    """Highest level that the evidence gives, and what keeps it from the next.

    Who drew the episodes, and when, no file can show: that is the maintainer's word (`checked`).

    Args:
        audits: Of the runs in a bundle; none has a contradiction.
        stated: What `audit.json` says, by head.
    """
    if missing := _not_replayed(audits, stated):
        return CONSISTENT, missing
    missing = _not_asked(audits, stated)
    return (REPLAYED, missing) if missing else (RERUN, "")


def _not_replayed(audits: Sequence[Audit], stated: Mapping[str, AuditStatement]) -> str:
    """First thing that an audit that played the bundle's episodes again would have; empty: nothing is missing."""
    if not stated:
        return f"there is no {AUDIT_FILE}"
    used = []
    for audit in audits:
        one = stated.get(audit.head)
        if one is None:
            return f"{AUDIT_FILE}: head of no run is {audit.head}"
        if one.contradictions:
            return f"{AUDIT_FILE}: contradictions: {plain_text(one.contradictions[0], 200)}"
        if (engine := audit.run.config.get("engine")) != ENGINE:
            return f"{BUNDLE_FILE}: engine is {shown(engine)}, {ENGINE} alone repeats bits"
        used.append(one)
    draw, number = used[0].draw, sum(len(one.played) for one in used)
    wanted = drawn(audits, None if draw is None else number, draw or 0)
    for audit, one, records in zip(audits, used, wanted, strict=True):
        if one.draw != draw or list(one.played) != [record.index for record in records]:
            by = "all episodes" if draw is None else f"what draw {draw} draws by the head of all runs"
            return f"{AUDIT_FILE}: played is not {by}"
        if gone := sorted(set(one.played) & set(audit.lacking)):
            return f"{BUNDLE_FILE}: actions of episode {gone[0]}, which was played again, are not there"
    if number < (least := min(LEAST, sum(map(len, drawn(audits, None, 0))))):
        return f"{AUDIT_FILE}: played is {counted(number, 'episode')}, expected at least {least}"
    return ""


def _not_asked(audits: Sequence[Audit], stated: Mapping[str, AuditStatement]) -> str:
    """First thing that an audit that asked the policy again would have; empty: nothing is missing.

    A run of which no episode was drawn must name a policy that was asked in another.
    """
    known = [named_policy(one.asked_policy or {}) for audit in audits if (one := stated[audit.head]).played]
    for audit in audits:
        one, played = stated[audit.head], str(audit.run.config["policy"])
        if one.policy is None or one.asked != len(one.played):
            return f"{AUDIT_FILE}: asked is {shown(one.asked)} of {counted(len(one.played), 'episode')} played again"
        kind, own = policy_kind(one.policy), policy_kind(played)
        if kind not in (own, *SERVED) and own not in SERVED:
            return f"{AUDIT_FILE}: policy is {shown(one.policy)}, its run has {shown(played)}"
        asked = [named_policy(one.asked_policy or {})] if one.played or not known else known
        if policy_kind(asked[0]["policy"]) != kind:
            return f"{AUDIT_FILE}: asked_policy: policy is {shown(asked[0]['policy'])}, expected {shown(one.policy)}"
        named = named_policy(audit.run.config)
        for text in min((list(misnamed_policy(named, other)) for other in asked), key=len):
            return f"{CONFIG_FILE}: {text}"
        if not 0 <= one.tolerance <= MOST_TOLERANCE:
            return f"{AUDIT_FILE}: tolerance is {one.tolerance:g}, expected at most {MOST_TOLERANCE:g}"
    return ""
