"""Are two results folders the same bytes, whoever played them, in whatever order episodes ended?"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.journal import JOURNAL_FILE

__all__ = ["contents", "digest"]

TIMES = re.compile(rb'"(wall_s|started_at|finished_at|duration_sec|previous)": ?("[^"]*"|[0-9.e+-]+)')
"""Values of a journal line, or of an episode's file, that differ when an episode is played again."""
TIMED = (JOURNAL_FILE, "original/*/episodes/*.json")
"""Files in which these are."""
HOW = ("options", "shard", "status")
"""Keys of config.json that say how a plan was played, not which."""


def contents(folder: Path) -> dict[str, bytes]:
    """Contents of every file of a results folder, by its path.

    Times at which episodes were played are left out of the journal, whose lines are brought into the plan's order, and
    out of the episodes' own files; of config.json what says how the plan was played is left out.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        if not path.is_file():
            continue
        name, data = path.relative_to(folder).as_posix(), path.read_bytes()
        if name == CONFIG_FILE:
            kept = {key: value for key, value in json.loads(data).items() if key not in HOW}
            data = json.dumps(kept, sort_keys=True).encode()  # environments are in the order in which they were built
        elif any(path.match(pattern) for pattern in TIMED):
            data = TIMES.sub(rb"\1", data)
        if name == JOURNAL_FILE:
            data = b"".join(sorted(data.splitlines(keepends=True), key=lambda line: _index(bytes(line))))
        found[name] = data
    return found


def _index(line: bytes) -> int:
    """Number in the plan of a journal line whose times were left out, so that it is no JSON any more."""
    number = re.search(rb'"index": ?([0-9]+)', line)
    return int(number[1]) if number else -1


def digest(data: bytes) -> str:
    """First 12 hex digits of the SHA-256."""
    return hashlib.sha256(data).hexdigest()[:12]
