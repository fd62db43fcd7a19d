"""``--policy lerobot:<checkpoint>``: a learned policy, for all worlds that ask at once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from arena_newton.errors import InputError
from arena_newton.pictures.settings import FRONT
from arena_newton.policies.base import Chunk, Json, Mask, Observation, Policy, hub_name, world_mask
from arena_newton.policies.lerobot.checkpoint_network import PolicyNetwork
from arena_newton.policies.lerobot.checkpoint_reader import (
    FAMILY_TYPES,
    IMAGES,
    STATE,
    TASK_VECTOR,
    PolicyCheckpoint,
    read_checkpoint,
)
from arena_newton.policies.lerobot.chunk_memory import ChunkMemory
from arena_newton.policies.lerobot.hub_folder import fetched
from arena_newton.policies.lerobot.network_noise import NOISE_RULE, Draw
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION

__all__ = ["ENSEMBLE_TICKS", "LeRobotPolicy", "from_spec"]

ENSEMBLE_TICKS = 1
"""Ticks between two queries where chunks are averaged and no number is given, as LeRobot's ensembling has it."""
CUDA_ROWS = {"act": 64, "diffusion": 64, "flow": 64, "pi05": 8}
"""Family → rows of every forward pass on a GPU: one size always, so that no kernels are chosen again and a row's
answer does not depend on how many others ask. 64 holds the 60 episodes of a cell; pi0.5 costs what its rows cost."""
TICKS_TYPES = ("diffusion", "multi_task_dit")
"""LeRobot's types whose observations have a dimension of ticks, also where it is 1."""
CPU_ROWS = 1
"""Rows of a forward pass on the CPU: libraries sum in another order where the number of rows differs."""


class LeRobotPolicy(Policy):
    """Runs a checkpoint of LeRobot.

    It works without `attach`: memory is made at the first `act`, for the number of worlds and the device of its state.
    """

    name = "lerobot"

    def __init__(
        self,
        folder: str | Path,
        *,
        replan: int | None = None,
        ensemble: bool = False,
        device: str | torch.device | None = None,
    ):
        """Read what the checkpoint says; its weights are loaded by `check`, or when it first acts.

        Args:
            folder: A checkpoint, or the folder of a training, whose last one is taken.
            replan: Actions of an answer that are executed before the next query; as many as the checkpoint says by
                default, 1 with `ensemble`.
            ensemble: Execute at each tick the mean of all answers that cover it.
            device: Torch device of the network; that of the observations by default.

        Raises:
            InputError: There is no checkpoint, one of its files is damaged, it was trained for something else than our
                observations and actions, or it does not predict as many actions as `replan` says.
        """
        self.checkpoint: PolicyCheckpoint = read_checkpoint(Path(folder))
        facts, predicted = self.checkpoint.facts, self.checkpoint.predicted
        if replan is None:
            replan = ENSEMBLE_TICKS if ensemble else self.checkpoint.executed
        elif not 1 <= replan <= predicted:
            raise InputError(f"--replan {replan}: expected 1 to {predicted}, which {self.checkpoint.folder} predicts")
        self.cameras = dict(self.checkpoint.cameras)
        self.needs_image, self.camera = bool(self.cameras), self.cameras.get(FRONT)
        self.labels = facts.labels
        self.realign = facts.realign
        self.chunk_size = replan
        self.in_pieces = self.checkpoint.observations > 1
        self.ensemble = ensemble
        self.queried: np.ndarray | None = None
        """Worlds whose last answer began with a query of the network, bool, shape [worlds]."""
        self._device = None if device is None else torch.device(device)
        self._network: PolicyNetwork | None = None
        self._memory: ChunkMemory | None = None
        self._seeds: list[int] = []
        self._queries: list[int] = []

    def check(self) -> None:
        """Load the weights.

        Raises:
            InputError: They do not fit, or a processor's file is damaged or not there.
        """
        self._on(self._device or torch.device("cpu"))

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """Refuse a task for which a task-conditioned policy has no element in its vector."""
        known = self.checkpoint.facts.task_vector
        if known and task not in known:
            raise InputError(
                f"--policy lerobot: {self.checkpoint.folder} was trained on {', '.join(known)}, not on {task}"
            )

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Begin new episodes; forgets everything where the number of worlds is another one than before."""
        worlds = len(seeds)
        if len(self._seeds) != worlds:
            self._seeds, self._queries, self._memory = [0] * worlds, [0] * worlds, None
        for world in np.flatnonzero(world_mask(mask, worlds)).tolist():
            self._seeds[world], self._queries[world] = int(seeds[world]), 0
            if self._memory is not None:
                self._memory.reset(world)

    def act(self, observation: Observation) -> Chunk:
        """The next actions of the worlds that ask; a world whose state or answer is not finite gets an error.

        Raises:
            InputError: The policy looks at pictures and is given none, or one of another size.
        """
        state = observation.state
        worlds, device = len(state), self._device or state.device
        network = self._on(device)
        memory = self._remembering(worlds, device)
        asking = np.flatnonzero(world_mask(observation.mask, worlds)).tolist()
        finite = torch.isfinite(state[asking]).all(dim=1).tolist()
        errors = {w: "its state is not finite" for w, ok in zip(asking, finite, strict=True) if not ok}
        serving = [world for world in asking if world not in errors]
        self._glimpse(observation, serving, device, memory)
        querying = [world for world in serving if not memory.waits(world)]
        rows = CPU_ROWS if device.type == "cpu" else CUDA_ROWS[FAMILY_TYPES[self.checkpoint.type]]
        vector = self._vector(observation, device)
        for first in range(0, len(querying), rows):
            some = querying[first : first + rows]
            chunks = self._predict(network, memory, some, rows, vector, observation.instruction)
            memory.answer(some, chunks)
            for world in some:
                self._queries[world] += 1
        self.queried = np.isin(np.arange(worlds), querying)
        if not serving:
            return Chunk(self._filler(worlds, 1, state.device), errors)
        given = memory.give(serving)
        actions = self._filler(worlds, given.shape[1], state.device)
        actions[serving] = given.to(state.device)
        usable = torch.isfinite(given).all(dim=(1, 2)).tolist()
        errors |= {w: "the network's answer is not finite" for w, ok in zip(serving, usable, strict=True) if not ok}
        return Chunk(actions, errors)

    def describe(self) -> Json:
        """Family, weights and what the checkpoint says of itself, and how its answers are executed."""
        checkpoint, facts = self.checkpoint, self.checkpoint.facts
        pictures = {name: [one.width, one.height, one.fit] for name, one in self.checkpoint.cameras.items()}
        return {
            "name": self.name,
            "family": facts.family,
            "type": checkpoint.type,
            "weights": checkpoint.digest,
            "recipe": facts.recipe,
            "tasks": list(facts.tasks),
            "trackers": list(facts.trackers),
            "steps": facts.steps,
            "minutes": facts.minutes,
            "seed": facts.seed,
            "datasets": [dict(one) for one in facts.datasets],
            "labels": facts.labels,
            "realign": facts.realign,
            "task_vector": list(facts.task_vector),
            **({"tracker_vector": list(facts.tracker_vector)} if facts.tracker_vector else {}),
            "picture": pictures.get(FRONT),
            **({"pictures": pictures} if {*pictures} - {FRONT} else {}),
            "prepared": checkpoint.preparation is not None,
            "observations": checkpoint.observations,
            "predicted": checkpoint.predicted,
            "replan": self.chunk_size,
            "ensemble": self.ensemble,
            "noise": NOISE_RULE if checkpoint.type != "act" else None,
            "ignored": list(checkpoint.ignored),
        }

    def close(self) -> None:
        """Release the network."""
        self._network = self._memory = None

    def _on(self, device: torch.device) -> PolicyNetwork:
        """The network on a device; its weights are loaded once."""
        if self._network is None:
            self._network = PolicyNetwork(self.checkpoint, device)
        elif self._network.device != device:
            self._network.move(device)
        return self._network

    def _remembering(self, worlds: int, device: torch.device) -> ChunkMemory:
        if len(self._seeds) != worlds:  # asked without a reset, as a check of the interface may do
            self._seeds, self._queries, self._memory = [0] * worlds, [0] * worlds, None
        if self._memory is None:
            self._memory = ChunkMemory(
                worlds,
                device,
                observations=self.checkpoint.observations,
                predicted=self.checkpoint.predicted,
                executed=self.chunk_size,
                ensemble=self.ensemble,
            )
        return self._memory

    def _glimpse(self, seen: Observation, worlds: Sequence[int], device: torch.device, memory: ChunkMemory) -> None:
        """Remember what the worlds that ask show; the observation's own buffers are overwritten by the next one."""
        for name, camera in self.checkpoint.cameras.items():
            size, image = [camera.height, camera.width, 3], seen.images.get(name)
            if image is None or list(image.shape[1:]) != size:
                given = "none" if image is None else str(list(image.shape[1:]))
                raise InputError(f"policy {self.name}, camera {name}: expected pictures of {size}, was given {given}")
        for world in worlds:
            glimpse = {STATE: seen.state[world].to(device, torch.float32, copy=True)}
            for name in self.checkpoint.cameras:
                glimpse[IMAGES + name] = seen.images[name][world].to(device, copy=True)
            memory.glimpse(world, glimpse)

    def _predict(
        self,
        network: PolicyNetwork,
        memory: ChunkMemory,
        worlds: Sequence[int],
        rows: int,
        vector: torch.Tensor | None,
        instruction: str,
    ) -> torch.Tensor:
        """Answers to a query of at most `rows` worlds; the forward pass has as many rows always."""
        filled = [*worlds, *([worlds[0]] * (rows - len(worlds)))]
        queries = [memory.queried(world) for world in filled]
        ticks = self.checkpoint.observations
        several = ticks > 1 or self.checkpoint.type in TICKS_TYPES
        states = [[one[STATE] for one in query] for query in queries]
        seen: dict[str, torch.Tensor] = {STATE: self._stacked(states, several)}
        for key in (IMAGES + name for name in self.checkpoint.cameras):
            pictures = self._stacked([[one[key] for one in query] for query in queries], True)
            flat = pictures.flatten(0, 1)
            if self.checkpoint.preparation is not None:
                flat = self.checkpoint.preparation(flat)
            values = flat.permute(0, 3, 1, 2).to(torch.float32) / 255.0
            values = values.reshape(rows, ticks, *values.shape[1:])
            seen[key] = (values if several else values[:, 0]).contiguous()
        if vector is not None:
            repeated = vector.expand(rows, ticks, -1)
            seen[TASK_VECTOR] = (repeated if several else repeated[:, 0]).contiguous()
        draws = [Draw(self._seeds[world], self._queries[world]) for world in filled]
        return network.predict(seen, instruction, draws)[: len(worlds)]

    @staticmethod
    def _stacked(queries: Sequence[Sequence[torch.Tensor]], several: bool) -> torch.Tensor:
        """Rows [rows, ticks, ...], or [rows, ...] of the one tick."""
        return torch.stack([torch.stack(list(query)) if several else query[-1] for query in queries])

    def _vector(self, seen: Observation, device: torch.device) -> torch.Tensor | None:
        """The one-hot vector of task and tracker; None for policies without one.

        Raises:
            InputError: The policy does not know the task.
        """
        if not self.checkpoint.facts.task_vector:
            return None
        self.check_task(seen.task)
        return torch.tensor(self.checkpoint.facts.vector(seen.task, seen.tracker), device=device)

    def _filler(self, worlds: int, length: int, device: torch.device) -> torch.Tensor:
        """Chunks of worlds that do not ask: standing in v3.1, of which orientations must name a rotation."""
        if self.labels == "v3.1":
            return torch.from_numpy(STAND_ACTION).to(device).repeat(worlds, length, 1)
        return torch.zeros((worlds, length, ACTION_WIDTH), device=device)


def from_spec(
    argument: str | None,
    *,
    replan: int | None = None,
    ensemble: bool = False,
    device: str | torch.device | None = None,
) -> LeRobotPolicy:
    """Make the policy for `--policy lerobot:<checkpoint>`: a folder, or a name on the Hugging Face hub.

    Raises:
        InputError: There is no such checkpoint, or it cannot be run.
    """
    if not argument:
        raise InputError("--policy lerobot: needs a checkpoint, as in lerobot:outputs/act/checkpoints/last")
    folder = fetched(argument) if hub_name(argument) else Path(argument).expanduser()
    return LeRobotPolicy(folder, replan=replan, ensemble=ensemble, device=device)
