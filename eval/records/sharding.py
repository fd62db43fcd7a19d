"""Shards of a plan: which episodes each of several machines plays. Pure, and the same on every machine."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

from arena_newton.errors import InputError
from arena_newton.files.text import plain_text

__all__ = ["MOST_SHARDS", "SCHEDULER", "Shard", "dealt", "parse_shard", "read_shard"]

MOST_SHARDS = 9_999
"""Parts of one plan."""
SCHEDULER = "slurm"
"""Value of --shard that takes the number from a Slurm array."""
_GROUP = 3
"""Leading parts of a key that name an environment: task, tracker, mode."""


@dataclass(frozen=True)
class Shard:
    """One part of a plan."""

    number: int
    """Number of the shard, from 1."""
    count: int
    """Parts of the plan."""

    def __str__(self) -> str:
        """Text as in --shard: `3/16`."""
        return f"{self.number}/{self.count}"

    def size(self, planned: int) -> int:
        """Episodes of this part of a plan of so many."""
        return len(range(self.number - 1, planned, self.count))


def read_shard(text: str) -> Shard | None:
    """The shard that a text such as `3/16` names; None where it names none."""
    found = re.fullmatch(r"([0-9]{1,4})/([0-9]{1,4})", text)
    shard = Shard(int(found[1]), int(found[2])) if found else Shard(0, 0)
    return shard if 1 <= shard.number <= shard.count else None


def parse_shard(text: str, environ: Mapping[str, str] | None = None) -> Shard:
    """The shard that --shard names.

    Args:
        text: `3/16`; `slurm`: number and count of the Slurm array that this process is a task of; `slurm/16`: its
            number in an array that need not have all of the 16 tasks.
        environ: Variables of the process by default.

    Raises:
        InputError: It names none, or the variables of the array do not fit.
    """
    if text == SCHEDULER or text.startswith(f"{SCHEDULER}/"):
        return _scheduled(text, os.environ if environ is None else environ)
    shard = read_shard(text)
    if shard is None:
        raise InputError(
            f"--shard {plain_text(text, 60) or repr('')}: expected n/N with n from 1 to N, such as 3/16, and N at most "
            f"{MOST_SHARDS:,}, or {SCHEDULER}"
        )
    return shard


def _scheduled(text: str, environ: Mapping[str, str]) -> Shard:
    """The shard of a task of a Slurm array."""

    def number(name: str, default: int | None = None) -> int:
        given = environ.get(f"SLURM_ARRAY_TASK_{name}")
        if given is None and default is not None:
            return default
        if given is None or not re.fullmatch("[0-9]{1,9}", given):
            message = "is not set" if given is None else f"is {plain_text(given, 40) or 'empty'}"
            raise InputError(
                f"--shard {text}: SLURM_ARRAY_TASK_{name} {message}; submit an array, such as --array=1-16"
            )
        return int(given)

    task = number("ID")
    _, slash, given = text.partition("/")
    if slash:
        shard = read_shard(f"1/{given}")
        if shard is None:
            raise InputError(f"--shard {plain_text(text, 60)}: expected {SCHEDULER}/N with N from 1 to {MOST_SHARDS:,}")
        if not 1 <= task <= shard.count:
            raise InputError(f"--shard {text}: SLURM_ARRAY_TASK_ID is {task}, expected 1 to {shard.count}")
        return Shard(task, shard.count)
    count, first = number("COUNT"), number("MIN", 1)
    last = number("MAX", first + count - 1)
    if count < 2:
        raise InputError(
            f"--shard {text}: the array has one task, which would play the whole plan; to play one shard again "
            f"name their number, such as {SCHEDULER}/16"
        )
    if count > MOST_SHARDS:
        raise InputError(f"--shard {text}: SLURM_ARRAY_TASK_COUNT is {count:,}, expected at most {MOST_SHARDS:,}")
    if first > 1 or last - first + 1 != count or not first <= task <= last:
        raise InputError(
            f"--shard {text}: {count} array ids from {first} to {last}, this one {task}; expected all of 0 to N-1 or 1 "
            f"to N; for other arrays name the number of shards, such as {SCHEDULER}/16"
        )
    return Shard(task - first + 1, count)


def dealt(keys: Sequence[tuple[Hashable, ...]], shard: Shard) -> list[int]:
    """Numbers of the episodes of one shard, in the plan's order.

    The episodes of each task, tracker and mode are shuffled by the hashes of their names and dealt one by one; the
    deal goes on from one to the next. So each shard has episodes of all of them, as long ones as any other shard, and
    shards differ by one episode at most.

    Args:
        keys: Of each planned episode, in the plan's order: task, tracker, mode, group seed, repeat.
    """
    groups: dict[tuple[Hashable, ...], list[tuple[bytes, int]]] = {}
    for index, key in enumerate(keys):
        digest = hashlib.sha256("/".join(map(str, key)).encode()).digest()
        groups.setdefault(key[:_GROUP], []).append((digest, index))
    order = [index for group in groups.values() for _, index in sorted(group)]
    return sorted(order[shard.number - 1 :: shard.count])
