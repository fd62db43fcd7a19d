"""``--policy learned``: the policy that comes with the package, for all worlds that ask at once."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.physics.devices import torch_threads
from arena_newton.policies.base import Chunk, Json, Observation, Policy, world_mask
from arena_newton.policies.learned import learned_card
from arena_newton.policies.learned.act_network import ActNetwork
from arena_newton.policies.learned.card_check import check_facts, check_weights
from arena_newton.policies.learned.packed_checkpoint import FRONT, STATE, TASK_VECTOR, Spread, read_act_checkpoint
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION

__all__ = ["LearnedPolicy", "from_spec"]

CUDA_ROWS = 64
"""Rows of every forward pass on a GPU: one size always, so that no kernels are chosen again and a row's answer does not
depend on how many others ask. 64 holds the 60 episodes of a cell."""
CPU_ROWS = 1
"""Rows of a forward pass on the CPU: libraries sum in another order where the number of rows differs."""
HELPED = 4
"""Most cores of a query on the CPU; each number of them that is used holds the weights once more."""


class LearnedPolicy(Policy):
    """Runs a packed ACT: one query per chunk, executed open loop, draws no random numbers and remembers nothing."""

    name = "learned"
    needs_image = True

    def __init__(self, folder: Path, *, device: str | torch.device | None = None):
        """Read what the folder says; its weights are loaded by `check`, or when it first acts.

        Args:
            folder: As `eval pack` writes it.
            device: Torch device of the network; that of the observations by default.

        Raises:
            InputError: The folder holds no packed policy, a damaged one, or the card of another one.
        """
        self.card = learned_card.read_card(folder)
        self.checkpoint = read_act_checkpoint(folder)
        check_facts(self.card, self.checkpoint)
        facts = self.checkpoint.facts
        self.camera = facts.camera
        self.labels = facts.labels
        self.realign = facts.realign
        self.chunk_size = self.checkpoint.executed
        self._device = None if device is None else torch.device(device)
        self._network: ActNetwork | None = None
        self._spreads: dict[str, Spread] = {}
        self._at: torch.device | None = None

    def check(self) -> None:
        """Load the weights.

        Raises:
            InputError: They do not fit, or are not those of the card.
        """
        self._on(self._device or torch.device("cpu"))

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """Refuse a task that its card does not name."""
        self.card.check_tasks([task])

    def act(self, observation: Observation) -> Chunk:
        """The next actions of the worlds that ask; a world whose state or answer is not finite gets an error.

        Raises:
            InputError: It is given no pictures, some of another size, or a task that it does not do.
        """
        state = observation.state
        worlds, device = len(state), self._device or state.device
        network = self._on(device)
        if device.type == "cpu":  # not in `check`, which does not know where the queries will be
            network.on_host(self.checkpoint.facts.height, self.checkpoint.facts.width)
        pictures = self._pictures(observation)
        asking = np.flatnonzero(world_mask(observation.mask, worlds)).tolist()
        finite = torch.isfinite(state[asking]).all(dim=1).tolist()
        errors = {w: "its state is not finite" for w, ok in zip(asking, finite, strict=True) if not ok}
        serving = [world for world in asking if world not in errors]
        # Who does not ask stands, in v3.1, of which orientations must name a rotation.
        filler = torch.from_numpy(STAND_ACTION) if self.labels == "v3.1" else torch.zeros(ACTION_WIDTH)
        actions = filler.to(state.device).repeat(worlds, self.chunk_size, 1)
        vector = self._vector(observation, device)
        size = CPU_ROWS if device.type == "cpu" else CUDA_ROWS

        @torch.inference_mode()
        def query(some: list[int], threads: int) -> torch.Tensor:
            """Chunks of some worlds, filled up to the size of a forward pass."""
            filled = [*some, *([some[0]] * (size - len(some)))]
            seen = pictures[filled].to(device).permute(0, 3, 1, 2).float() / 255.0
            given = state[filled].to(device, torch.float32)
            tasks = None if vector is None else self._normalised(TASK_VECTOR, vector.expand(size, -1))
            chunk = network.answer(self._normalised(FRONT, seen), self._normalised(STATE, given), tasks, threads)
            spread = self._spreads.get("action")
            chunk = chunk if spread is None else spread.restored(chunk)
            return chunk[: len(some), : self.chunk_size]

        parts = [serving[first : first + size] for first in range(0, len(serving), size)]
        for some, chunk in zip(parts, _answers(device, query, parts), strict=True):
            actions[some] = chunk.to(state.device)
        usable = torch.isfinite(actions[serving]).all(dim=2).all(dim=1).tolist()
        errors |= {w: "the network's answer is not finite" for w, ok in zip(serving, usable, strict=True) if not ok}
        return Chunk(actions, errors)

    def describe(self) -> Json:
        """Family, weights, what it was made of, and how its answers are executed."""
        facts = self.checkpoint.facts
        return {
            "name": self.name,
            "family": facts.family,
            "weights": self.checkpoint.digest,
            "recipe": facts.recipe,
            "offered": list(self.card.tasks),
            "tasks": list(facts.tasks),
            "trackers": list(facts.trackers),
            "steps": facts.steps,
            "minutes": facts.minutes,
            "seed": facts.seed,
            "labels": facts.labels,
            "realign": facts.realign,
            "task_vector": list(facts.task_vector),
            **({"tracker_vector": list(facts.tracker_vector)} if facts.tracker_vector else {}),
            "picture": [facts.width, facts.height, facts.fit],
            "predicted": self.checkpoint.sizes.chunk_size,
            "replan": self.chunk_size,
        }

    def close(self) -> None:
        """Release the network."""
        self._network = None

    def _on(self, device: torch.device) -> ActNetwork:
        """The network on a device; its weights are loaded once."""
        if self._network is None:
            network = self.checkpoint.network()  # says itself what is wrong with damaged weights
            check_weights(self.card, self.checkpoint)
            self._network, self._at = network, None
        if self._at != device:
            self._network = self._network.to(device)
            self._spreads = {name: one.to(device) for name, one in self.checkpoint.spreads.items()}
            self._at = device
        return self._network

    def _normalised(self, feature: str, value: torch.Tensor) -> torch.Tensor:
        spread = self._spreads.get(feature)
        return value if spread is None else spread.normalised(value)

    def _pictures(self, observation: Observation) -> torch.Tensor:
        """The pictures of all worlds, uint8, shape [worlds, H, W, 3]."""
        facts, pictures = self.checkpoint.facts, observation.image
        size = (facts.height, facts.width, 3)
        if pictures is None or tuple(pictures.shape[1:]) != size:
            given = "none" if pictures is None else str(list(pictures.shape[1:]))
            raise InputError(f"policy {self.name}: expected pictures of {list(size)}, was given {given}")
        return pictures

    def _vector(self, seen: Observation, device: torch.device) -> torch.Tensor | None:
        """The one-hot vector of task and tracker; None for policies without one."""
        self.check_task(seen.task)
        numbers = self.checkpoint.facts.vector(seen.task, seen.tracker)
        return torch.tensor(numbers, device=device) if numbers else None


@functools.cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads for queries, each of one core; a process that was forked has its own."""
    return ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))


def _answers(
    device: torch.device, query: Callable[[list[int], int], torch.Tensor], parts: list[list[int]]
) -> Iterator[torch.Tensor]:
    """Answers to queries: on the CPU each on one core, as many at once as torch may have threads.

    Cores that the last queries leave idle help them, up to `HELPED` a query. Where the machine is busy cores lose more
    by waiting for each other than they win, so no more queries are divided than must be.
    """
    threads = torch.get_num_threads()
    if device.type != "cpu" or threads == 1:
        yield from (query(some, 1) for some in parts)
        return
    last = len(parts) % threads
    whole, divided = parts[: len(parts) - last], parts[len(parts) - last :]
    pool = _pool(threads, os.getpid())
    with torch_threads(1):
        yield from pool.map(lambda some: query(some, 1), whole)
        yield from pool.map(lambda some: query(some, min(threads - last + 1, HELPED)), divided)


def from_spec(argument: str | None, *, device: str | torch.device | None = None) -> LearnedPolicy:
    """Make the policy for `--policy learned`, or `learned:<folder>` for another folder of `eval pack`.

    Raises:
        InputError: There is none.
    """
    if argument is None and learned_card.shipped_card() is None:
        raise InputError(learned_card.NOT_SHIPPED)
    if argument == "":
        raise InputError("--policy learned: needs a folder after the colon, or no colon")
    return LearnedPolicy(learned_card.SHIPPED if argument is None else Path(argument).expanduser(), device=device)
