"""A batch of episodes in a process that does not own the journal: it sends events."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import torch
import warp as wp

from arena_newton.cli.quiet import quiet_warp
from arena_newton.doctor import versions
from arena_newton.errors import InputError
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import RunConfig, plain_facts, resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play.env_cache import EnvCache
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run import RunPlayer, RunStopped, check_parts
from arena_newton.eval.records.document import Document
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeRecord
from arena_newton.eval.reports.progress import kernels_to_compile
from arena_newton.eval.workers.messages import ActionFile, Broke, Built, Ended, EpisodeBatch, Event, Ticks, broke
from arena_newton.files.new_folder import held
from arena_newton.files.stored_json import JsonObject
from arena_newton.policies.base import Policy

__all__ = ["device_name", "parts", "play"]

TICKS_EVERY = 1.0
"""Ticks are sent so often [s]."""
SHARED_WITHIN = 10.0
"""A shared folder shows a new file to another machine within this time [s]."""
COMPILE_LOCK = "arena_newton.lock"
"""File in a machine's kernel cache that the one process locks which compiles."""


def parts(options: RunOptions, factories: Factories | None) -> tuple[RunConfig, Policy, Factories]:
    """Check the flags of a run in this process, and build its tracker and policy.

    Args:
        options: Resolved flags.
        factories: The real parts by default, with environments that last from one batch to the next.
    """
    quiet_warp()
    made_of = factories or Factories(env=EnvCache())
    return *check_parts(resolve(options), made_of), made_of


def play(
    part: EpisodeBatch,
    config: RunConfig,
    path: Path,
    factories: Factories,
    policy: Policy,
    send: Callable[[Event], None],
) -> None:
    """Play the episodes of a batch.

    Args:
        config: The run, with all its episodes.
        path: Its results folder.
        send: Takes events.

    Raises:
        InputError: The folder is not that of the run: files would not be where the journal says.
        StorageError: A file cannot be written.
        PolicyUnavailable: The policy cannot go on.
    """
    wanted = set(part.episodes)
    episodes = [episode for episode in config.episodes if episode.index in wanted]
    # Episodes of a broken environment are played again by the driver, which also says when it is enough.
    flags = dataclasses.replace(config.flags, skip_broken=False)
    config = dataclasses.replace(config, flags=flags, episodes=tuple(episodes))
    if flags.video or flags.strip or flags.record or flags.viewer_failures:
        _check_shared(path)
    folder = _BatchFolder(path, config, part.config_hash, send)
    with contextlib.ExitStack() as compiling:
        compiling.enter_context(_alone_while_compiling(flags.engine, config.device))
        player = _BatchPlayer(config, folder, _Lines(send), factories, policy, batch=part.worlds)
        player.progress = _Counts(send, compiling.close)
        try:
            player.play_group(part.group, list(episodes))
        except RunStopped as error:
            send(folder.broke or broke(error))


def device_name(device: str) -> str:
    """Name of a device of this process, such as `NVIDIA H200`, or `cpu`."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") else "cpu"


def _check_shared(path: Path) -> None:
    """Refuse a results folder that is not shared with the process that keeps the journal."""
    until = time.monotonic() + SHARED_WITHIN
    while not (path / JOURNAL_FILE).is_file():
        if time.monotonic() > until:
            raise InputError(
                f"{os.uname().nodename}: {path} is not there; films, strips, recordings and scenes of failures are "
                "written into the results folder, which must be on a disk that all nodes share"
            )
        time.sleep(0.2)


@contextlib.contextmanager
def _alone_while_compiling(engine: str, device: str) -> Iterator[None]:
    """Let one process of a machine compile missing kernels while the others wait for its cache."""
    cache = Path(wp.config.kernel_cache_dir or ".")  # named once Warp has begun
    if not wp.config.kernel_cache_dir or not kernels_to_compile(cache, engine, device):
        yield
        return
    cache.mkdir(parents=True, exist_ok=True)
    with held(cache / COMPILE_LOCK, wait=True):
        if kernels_to_compile(cache, engine, device):
            yield
            return
    yield


class _BatchFolder(ResultsFolder):
    """The results folder in a process that writes only files of episodes into it."""

    def __init__(self, path: Path, config: RunConfig, config_hash: str, send: Callable[[Event], None]):
        super().__init__(path, config, versions())
        self.document: Document = {"config_hash": config_hash}  # type: ignore[typeddict-item]  # all that is asked for
        self._send = send
        self.broke: Broke | None = None
        """The last break."""

    def register(self, group: str, facts: Mapping[str, object]) -> JsonObject:
        """Send the description of an environment."""
        plain = plain_facts(facts)
        self._send(Built(plain))
        return plain

    def keep_file(self, name: str, content: bytes) -> None:
        """Send a file of an episode."""
        self._send(ActionFile(name, content))

    def keep_trace(self) -> None:
        """Keep the error, to be sent."""
        error = sys.exception()
        if error is not None:
            self.broke = broke(error)


class _BatchPlayer(RunPlayer):
    """Plays a batch without the journal."""

    def kept(self) -> str:
        return "episodes that have ended are kept"


class _Lines:
    """Sends lines of episodes that ended."""

    def __init__(self, send: Callable[[Event], None]):
        self.records: list[EpisodeRecord] = []
        self._send = send

    def append(self, record: EpisodeRecord) -> None:
        self._send(Ended(record.to_json()))


class _Counts:
    """Sends counts of ticks."""

    def __init__(self, send: Callable[[Event], None], first: Callable[[], None]):
        """`first` is called when the first tick is over, after which no kernel is compiled."""
        self._send, self._first = send, first
        self._count, self._at = 0, time.monotonic()

    def tick(self, active: int) -> None:
        self._first()
        self._count += active
        if time.monotonic() - self._at >= TICKS_EVERY:
            self._send(Ticks(self._count))
            self._count, self._at = 0, time.monotonic()

    def episode(self, budget: int, used: int) -> None:
        """The driver knows it from the line."""

    def more(self, budgets: Sequence[int]) -> None:
        """The driver plans."""

    def say(self, text: str) -> None:
        """A node has no terminal."""
