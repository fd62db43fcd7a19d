"""Chain of a journal: every line names the line before it, and one hash, the head, names what came of all episodes.

The links are over the lines as they were written, by the one process that keeps the journal. The head is over the
plan's order, without times of day and recordings, so that it is the same whoever played, in whatever order: resumed, in
shards that were joined, by several processes or on a cluster.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from arena_newton.eval.records.journal import CHAINED, EpisodeRecord
from arena_newton.eval.records.schema import MAX_JOURNAL_BYTES
from arena_newton.files.stored_json import JsonObject, read_regular

__all__ = ["broken_links", "head", "joint_head", "outcome_of"]

TIMES = ("started_at", "finished_at")
"""Keys of a journal line that differ when an episode is played again, as `durations.wall_s` does."""
PICTURES = ("media", "video")
"""Keys that say what was recorded of an episode: not what came of it."""


def outcome_of(record: EpisodeRecord) -> JsonObject:
    """Line of an episode without times of day, recordings, the link and the libraries' versions.

    The hash of its actions stays: two episodes that ended alike may have been decided otherwise.
    """
    line = record.to_json()
    for key in (*TIMES, *PICTURES, "previous"):
        line.pop(key, None)
    line["durations"] = {key: value for key, value in (record.durations or {}).items() if key != "wall_s"}
    line["hashes"] = {key: value for key, value in line.pop("hashes").items() if key != "versions"}
    return line


def head(records: Iterable[EpisodeRecord]) -> str | None:
    """Head of a run: SHA-256 of its episodes, each with the hash of all before it.

    Args:
        records: The line that counts of each episode, in the plan's order.

    Returns:
        64 hex digits; None where a line is of a version without chain, or there is none.
    """
    digest = ""
    for record in records:
        if record.previous is None:
            return None
        line = json.dumps(outcome_of(record), sort_keys=True, separators=(",", ":"))
        digest = hashlib.sha256((digest + line).encode()).hexdigest()
    return digest or None


def joint_head(heads: Collection[str | None]) -> str | None:
    """Head of several runs, the same in whatever order they are given: SHA-256 of their sorted heads.

    Args:
        heads: Of each run; of a single one it is the joint head itself.

    Returns:
        64 hex digits; None where a run has none.
    """
    known = sorted(filter(None, heads))
    if not known or len(known) < len(heads):
        return None
    return known[0] if len(known) == 1 else hashlib.sha256("".join(known).encode()).hexdigest()


def broken_links(path: Path, records: Iterable[EpisodeRecord]) -> Iterator[str]:
    """Lines of a journal that do not name the line before them, a sentence each.

    Args:
        path: The journal.
        records: Its records in file order.

    Raises:
        InputError: It cannot be read.
    """
    before = b""
    lines = read_regular(path, MAX_JOURNAL_BYTES).split(b"\n")
    for number, (record, line) in enumerate(zip(records, lines, strict=False), start=1):
        if record.schema >= CHAINED and record.previous != hashlib.sha256(before).hexdigest():
            came = f"line {number - 1}" if before else "the journal's beginning"
            yield f"{path}: line {number} is not linked to {came}: a line was changed, added, removed or moved"
        before = line + b"\n"
