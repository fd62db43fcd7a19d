"""Messages between processes and the run that they play for: small values, never pictures."""

from __future__ import annotations

import traceback
from dataclasses import dataclass

from arena_newton.errors import InputError, UnknownName
from arena_newton.eval.records.document import Identity
from arena_newton.eval.records.journal import StorageError
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import plain_text
from arena_newton.policies.base import PolicyUnavailable

__all__ = ["Broke", "Built", "Done", "Ended", "EpisodeBatch", "ActionFile", "Event", "Node", "Opened", "Ticks"]
__all__ += ["broke"]


@dataclass(frozen=True)
class Node:
    """Location of a process."""

    name: str
    """Ray's name of the node; empty on this machine."""
    host: str
    pid: int
    gpus: str = ""
    """Numbers of the GPUs that it sees, as `CUDA_VISIBLE_DEVICES` names them."""


@dataclass(frozen=True)
class Opened:
    """Descriptions of a run's parts in a process."""

    identity: Identity
    labels: str
    worlds_matter: bool
    tracker_facts: JsonObject | None
    policy_facts: JsonObject | None
    versions: dict[str, str | None]
    device: str
    """Name of what it computes on, such as `NVIDIA H200` or `cpu`."""


@dataclass(frozen=True)
class EpisodeBatch:
    """Episodes that a process plays in one environment."""

    group: str
    """Name of their group."""
    episodes: tuple[int, ...]
    """Their numbers in the plan."""
    worlds: int
    """Worlds of the environment, which lasts until another one is needed."""
    config_hash: str


@dataclass(frozen=True)
class Built:
    """The environment of a batch is built."""

    facts: JsonObject
    """The policy's or tracker's own description."""


@dataclass(frozen=True)
class Ticks:
    """Ticks of worlds that have passed."""

    count: int


@dataclass(frozen=True)
class ActionFile:
    """File of the actions of an episode whose line follows, for the results folder."""

    name: str
    """Path below the folder."""
    content: bytes


@dataclass(frozen=True)
class Ended:
    """An episode ended, and its files are on the disk."""

    line: JsonObject
    """Its line of the journal."""


@dataclass(frozen=True)
class Done:
    """The process of a batch has reported all that it played, and waits."""


@dataclass(frozen=True)
class Broke:
    """A batch ended early, or a process could not begin."""

    kind: str
    """`unknown`, `input` and `storage` stop the run as such errors; `stop` stops it; of `broken` another attempt is
    made."""
    message: str
    trace: str


Event = Built | Ticks | ActionFile | Ended | Broke


def broke(error: BaseException) -> Broke:
    """Message about an exception that is being handled."""
    trace = traceback.format_exc()
    if isinstance(error, InputError):
        return Broke("unknown" if isinstance(error, UnknownName) else "input", str(error), trace)
    if isinstance(error, StorageError):
        return Broke("storage", str(error), trace)
    message = plain_text(f"{type(error).__name__}: {error}", 300)
    if isinstance(error, PolicyUnavailable):
        return Broke("stop", str(error), trace)
    return Broke("stop" if isinstance(error, OSError) else "broken", message, trace)
