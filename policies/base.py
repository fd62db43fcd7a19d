"""What a policy is: it looks at all worlds that ask and answers a chunk of canonical actions for each."""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton.errors import ArenaError, InputError
from arena_newton.interfaces import Chunk, Observation

if TYPE_CHECKING:
    from arena_newton.camera import CameraConfig

__all__ = ["Chunk", "Observation", "Policy", "PolicyError", "get", "names", "register", "world_mask"]

ENTRY_POINT_GROUP = "arena_newton.policies"
"""Other packages offer policies under this entry point group: a callable of the text after the colon (or None)."""

_BUILT_IN = {
    "expert": "arena_newton.policies.experts:from_spec",
    "remote": "arena_newton.policies.remote:from_spec",
    "replay": "arena_newton.policies.replay:from_spec",
    "stand": "arena_newton.policies.stand:from_spec",
}
_registered: dict[str, Callable[[str | None], Policy]] = {}


class PolicyError(ArenaError):
    """A policy gave no usable action for one world; that world's episode ends as `error`, the others go on."""

    def __init__(self, world: int, message: str):
        """Name the world and what is wrong."""
        super().__init__(f"world {world}: {message}")
        self.world = world
        self.message = message


class PolicyUnavailable(ArenaError):
    """The policy cannot go on at all (its server is gone); the run stops and its unfinished episodes stay unplayed."""


class Policy:
    """Base of all policies; a subclass writes `act` and, where it has a memory, `reset`."""

    name: str = "policy"
    """Name in reports."""
    needs_image: bool = False
    """Whether the head camera must be rendered for `act`."""
    camera: CameraConfig | None = None
    """The picture that the policy wants; None: 224×224 with black bars, as the original prepares policy images."""
    chunk_size: int = 1
    """Actions a chunk, where the policy knows it beforehand."""
    depends_on_worlds: bool = False
    """Whether an episode may depend on how many worlds ask at once; the number then belongs to what a run is known by.
    Final after `check`."""

    def check(self) -> None:
        """Look, before the first episode, whether the policy can work at all.

        Raises:
            InputError: It cannot, for a reason that the user can mend.
        """

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """Look, before the first episode, whether the policy can do a task.

        Args:
            task: The task.
            mode: The mode of the coming episodes, if it is known yet.
            seeds: Their episode seeds, if they are known yet.

        Raises:
            InputError: It cannot.
        """

    def attach(self, env: Any) -> None:
        """Get to know the environment before its first episode; only privileged policies (experts) look into it.

        Args:
            env: The `ArenaEnv` that the coming calls are about.

        Raises:
            InputError: The policy cannot work in this environment.
        """

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Any = None) -> None:
        """Begin new episodes in the worlds of `mask`.

        Args:
            seeds: Episode seeds, one a world (those outside the mask are ignored).
            tasks: Gym ids, one a world.
            mask: Worlds that begin, bool, shape [worlds]; None: all.
        """

    def act(self, observation: Observation) -> Chunk:
        """Actions for the worlds that ask."""
        raise TypeError(f"policy {self.name!r} defines no act()")

    def describe(self) -> dict[str, Any]:
        """What a result must record to name this policy exactly."""
        return {"name": self.name}

    def close(self) -> None:
        """Let go of connections and memory."""


def world_mask(mask: Any, worlds: int) -> np.ndarray:
    """A mask given as None, NumPy array, torch tensor or list, as bool array of shape [worlds]."""
    if mask is None:
        return np.ones(worlds, dtype=bool)
    if hasattr(mask, "detach"):
        mask = mask.detach().cpu()
    return np.asarray(mask).astype(bool).reshape(worlds)


def register(name: str, factory: Callable[[str | None], Policy]) -> None:
    """Offer a policy under `name` in this process; `factory` takes the text after the colon, or None."""
    _registered[name] = factory


def _entry_points() -> dict[str, importlib.metadata.EntryPoint]:
    return {e.name: e for e in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP)}


def names() -> tuple[str, ...]:
    """Names of all policies that `get` knows, sorted."""
    return tuple(sorted({*_BUILT_IN, *_registered, *_entry_points()}))


def get(spec: str) -> Policy:
    """Make a policy from `name` or `name:argument`, such as `stand`, `replay:clip.pkl` or `remote:http://host:8443`.

    Raises:
        InputError: Unknown name, or an argument that is missing or unfit.
    """
    name, colon, rest = spec.partition(":")
    argument = rest if colon else None
    if name in _registered:
        return _registered[name](argument)
    if name in _BUILT_IN:
        module, _, attribute = _BUILT_IN[name].partition(":")
        return getattr(importlib.import_module(module), attribute)(argument)
    points = _entry_points()
    if name not in points:
        raise InputError(f"--policy {spec}: unknown policy; known are {', '.join(names())}")
    try:
        factory = points[name].load()
    except Exception as error:
        reason = " ".join(str(error).split())
        raise InputError(f"--policy {spec}: its package does not load ({type(error).__name__}: {reason})") from error
    return factory(argument)
