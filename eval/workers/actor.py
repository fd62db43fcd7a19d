"""A process that plays batches of runs: it is given numbers of episodes and gives journal lines back.

It is imported before the process knows its cores and GPU, so torch, Warp and what needs them load inside the methods.
"""

from __future__ import annotations

import os
import queue
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.workers.messages import Broke, EpisodeBatch, Event, Node, Opened, broke

if TYPE_CHECKING:
    from arena_newton.eval.plan.config import RunConfig
    from arena_newton.eval.play.factories import Factories
    from arena_newton.policies.base import Policy

__all__ = ["EpisodeActor"]


class EpisodeActor:
    """Process that plays episodes, all in one thread, so that episodes are reported while others run."""

    def __init__(self) -> None:
        """Start the thread."""
        self._thread = ThreadPoolExecutor(1, "episodes")
        self._config: RunConfig
        self._factories: Factories | None = None
        self._policy: Policy | None = None
        self._folder: Path

    def node(self) -> Node:
        """Machine, process and GPUs of this process."""
        return Node("", socket.gethostname(), os.getpid(), os.environ.get("CUDA_VISIBLE_DEVICES", ""))

    def open(
        self, options: RunOptions, folder: str, cores: tuple[int, int], factories: Factories | None
    ) -> Broke | Opened:
        """Build tracker and policy of a run, in place of those of the run before; an environment may last.

        Args:
            options: Its resolved flags.
            folder: Results folder, absolute.
            cores: First core of this process and their number, among those that the machine lets it use.
            factories: What runs are built with, the same for all; the real parts by default.
        """
        usable, (first, number) = sorted(os.sched_getaffinity(0)), cores
        if first + number <= len(usable):  # otherwise the cluster counts more cores than there are, or it has them
            os.sched_setaffinity(0, usable[first : first + number])
        os.environ.setdefault("OMP_NUM_THREADS", str(number))
        self._folder = Path(folder)
        return self._thread.submit(self._open, options, factories).result()

    def play(self, part: EpisodeBatch) -> Iterator[Event]:
        """Play episodes; gives what happens when it happens."""
        events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self._thread.submit(self._play, part, events)
        while (event := events.get()) is not None:
            yield event

    def _open(self, options: RunOptions, factories: Factories | None) -> Broke | Opened:
        try:
            from arena_newton.doctor import versions
            from arena_newton.eval.workers.batch_player import device_name, parts

            policy, self._policy = self._policy, None
            if policy is not None:
                policy.close()
            self._config, self._policy, self._factories = parts(options, self._factories or factories)
            config = self._config
            return Opened(
                config.identity(),
                config.labels,
                config.worlds_matter,
                config.tracker_facts,
                config.policy_facts,
                versions(),
                device_name(config.device),
            )
        except (Exception, SystemExit) as error:
            return broke(error)

    def _play(self, part: EpisodeBatch, events: queue.SimpleQueue[Event | None]) -> None:
        try:
            from arena_newton.eval.workers.batch_player import play

            assert self._policy is not None and self._factories is not None, "plays before it has opened a run"
            play(part, self._config, self._folder, self._factories, self._policy, events.put)
        except (Exception, SystemExit) as error:
            events.put(broke(error))
        finally:
            events.put(None)
