"""Checkpoints of a training: one record whose fields are the file's keys, and the card that is written into weights."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from arena_newton.errors import InputError
from arena_newton.files.own_files import replace_atomically

__all__ = ["Card", "Checkpoint", "TrainingPart"]


@dataclass(kw_only=True)
class TrainingPart:
    """Entry of the card for one part of a training; a resumed training has several."""

    command: str
    """Command line."""
    commit: str
    """Commit of the code."""
    worlds: int
    """Worlds of each process."""
    processes: int
    """Number of processes."""
    seed: int
    """Seed."""
    data: dict[str, Any]
    """Clips and minutes per family, and their sources."""
    licences: dict[str, int]
    """Licence → number of clips."""


@dataclass(kw_only=True)
class Card(TrainingPart):
    """Card of the weights, which describes their training; keys of a file are the names of the fields."""

    tracker: str
    """Interface."""
    action_form: dict[str, Any]
    """`ActionForm` as a dictionary."""
    drive: dict[str, Any]
    """`DriveGains` as a dictionary."""
    physics: dict[str, Any]
    """`PhysicsRate` as a dictionary."""
    rewards: dict[str, float] = field(default_factory=dict)
    """Weights of the reward terms."""
    events: dict[str, dict[str, float]] = field(default_factory=dict)
    """Settings of the events of the randomisation; none without it."""
    started_from: str | None = None
    """Commit of the weights with which the training started."""
    earlier: list[dict[str, Any]] = field(default_factory=list)
    """Parts before this one: a `TrainingPart` each, with `iter`, `samples` and `seconds` at its end."""

    def to_dict(self) -> dict[str, Any]:
        """The card as JSON, without what does not apply."""
        return {k: v for k, v in vars(self).items() if not (k in ("events", "started_from", "earlier") and not v)}

    def resume(self, previous: Checkpoint) -> None:
        """Add the parts of the training that this one continues, and all of their licences."""
        card = previous.card
        part = {f.name: getattr(card, f.name) for f in dataclasses.fields(TrainingPart)}
        part |= {name: getattr(previous, name) for name in ("iter", "samples", "seconds")}
        self.earlier = [*card.earlier, part]
        self.licences = {**card.licences, **self.licences}
        self.started_from = card.started_from or self.started_from


@dataclass(kw_only=True)
class Checkpoint:
    """Everything that a resumed training needs; a file must have the keys of the fields without a default."""

    actor_state_dict: dict[str, Any]
    """Network and action noise."""
    critic_state_dict: dict[str, Any]
    """The critic with its input statistics."""
    optimizer_state_dict: dict[str, Any] | None = None
    """Moments of the optimiser; None in a slim checkpoint, where a resumed training estimates them again."""
    iter: int
    """Iterations that are done."""
    infos: dict[str, Any] | None = None
    """Anything the caller of `save` wants back from `load`."""
    network: dict[str, Any]
    """Widths of the network."""
    norm_counts: dict[str, torch.Tensor]
    """Number of observations behind each input statistic of the network."""
    learning_rate: float
    """Current learning rate."""
    samples: int
    """Samples of all processes."""
    seconds: float
    """Seconds of training."""
    started: bool = False
    """True if the training started from given weights."""
    families: list[str]
    """Families of the references."""
    critic_widths: dict[str, int] = field(default_factory=dict)
    """Width of each term of the critic's observation; empty in files of versions that did not store it."""
    sampler: dict[str, Any]
    """Evidence of the adaptive sampling."""
    rng: torch.Tensor
    """State of torch's random numbers on the CPU."""
    cuda_rng: torch.Tensor | None
    """State of torch's random numbers on the GPU."""
    card: Card
    """The card so far."""
    last: dict[str, Any]
    """The last logged iteration."""

    def write(self, path: str | Path) -> None:
        """Write the file atomically."""
        state = vars(self) | {"card": self.card.to_dict()}
        if self.optimizer_state_dict is None:
            del state["optimizer_state_dict"]
        with replace_atomically(path) as file:
            torch.save(state, file)

    @classmethod
    def read(cls, path: str | Path, device: str = "cpu") -> Checkpoint:
        """Read a file, tensors and plain containers only, onto a device.

        Raises:
            InputError: The file is absent or not a checkpoint of this training.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about files that are something else altogether
                state = torch.load(path, weights_only=True, map_location=device)
        except FileNotFoundError:
            raise InputError(f"{path}: no such checkpoint") from None
        except Exception as error:
            raise InputError(f"{path}: not a training checkpoint ({type(error).__name__})") from error
        if not isinstance(state, dict) or not isinstance(state.get("card"), dict):
            raise InputError(f"{path}: not a checkpoint of this training")
        if missing := sorted(_missing(cls, state) | _missing(Card, state["card"])):
            raise InputError(f"{path}: not a checkpoint of this training, it lacks {', '.join(missing)}")
        return cls(**_known(cls, state) | {"card": Card(**_known(Card, state["card"]))})

    def check_same(self, tracker: str, kind: str, path: str | Path) -> None:
        """Refuse to continue the training of another tracker or kind of action form.

        Raises:
            InputError: They differ; it names the checkpoint's file.
        """
        if self.card.tracker != tracker:
            raise InputError(f"{path}: a training of {self.card.tracker}, not of {tracker}")
        if self.card.action_form["kind"] != kind:
            raise InputError(f"{path}: its action form is {self.card.action_form['kind']}, not {kind}")


def _missing(record: type[Checkpoint] | type[Card], state: Mapping[str, Any]) -> set[str]:
    absent = dataclasses.MISSING
    required = {f.name for f in dataclasses.fields(record) if f.default is absent and f.default_factory is absent}
    return required - set(state)


def _known(record: type[Checkpoint] | type[Card], state: Mapping[str, Any]) -> dict[str, Any]:
    return {f.name: state[f.name] for f in dataclasses.fields(record) if f.name in state}
