"""What a policy is: it looks at all worlds that ask and answers a chunk of canonical actions for each."""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton.errors import ArenaError, InputError
from arena_newton.interfaces import Chunk, Observation

if TYPE_CHECKING:
    from arena_newton.pictures.camera import CameraConfig

__all__ = [
    "Chunk",
    "Observation",
    "Policy",
    "PolicyError",
    "PolicyUnavailable",
    "check_spec",
    "get",
    "names",
    "register",
    "world_mask",
]

ENTRY_POINT_GROUP = "arena_newton.policies"
"""Other packages offer policies under this entry point group: a callable of the text after the colon (or None)."""

_BUILT_IN = {
    "expert": "arena_newton.policies.experts:from_spec",
    "remote": "arena_newton.policies.remote:from_spec",
    "replay": "arena_newton.policies.replay:from_spec",
    "stand": "arena_newton.policies.stand:from_spec",
}
_registered: dict[str, Callable[..., Policy]] = {}


class PolicyError(ArenaError):
    """A policy gave no usable action for one world; that world's episode ends as `error`, the others go on."""

    def __init__(self, world: int, message: str):
        """Name the world and what is wrong."""
        super().__init__(f"world {world}: {message}")
        self.world = world
        self.message = message


class PolicyUnavailable(ArenaError):
    """The policy cannot go on at all (its server is gone); the run stops and its unfinished episodes stay unplayed."""

    exit_code = 2


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


def register(name: str, factory: Callable[..., Policy]) -> None:
    """Offer a policy under `name` in this process.

    Args:
        name: What stands before the colon of a spec.
        factory: Takes the text after the colon, or None; and the options of `get` as keywords, if it knows any.
    """
    _registered[name] = factory


def _entry_points() -> list[importlib.metadata.EntryPoint]:
    return list(importlib.metadata.entry_points(group=ENTRY_POINT_GROUP))


def names() -> tuple[str, ...]:
    """Names of all policies that `get` knows, sorted."""
    return tuple(sorted({*_BUILT_IN, *_registered, *(point.name for point in _entry_points())}))


def check_spec(spec: str) -> None:
    """Look at a spec without making the policy; what a results folder may not hold is refused and not printed.

    Args:
        spec: As for `get`.

    Raises:
        InputError: Unknown name, a name that is offered twice, or an address with a user name or password in it.
    """
    name, _, argument = spec.partition(":")
    if "@" in argument and (name == "remote" or "://" in argument):
        raise InputError(
            f"--policy {name}: the address holds a user name or a password (an @), which results would publish; "
            "give a token in the environment variable ARENA_POLICY_TOKEN instead"
        )
    points = [point for point in _entry_points() if point.name == name]
    if name not in _BUILT_IN and name not in _registered and not points:
        raise InputError(f"--policy {name}: unknown policy; known are {', '.join(names())}")
    offers = [*(["this package"] if name in _BUILT_IN else []), *(_package(point) for point in points)]
    if len(offers) > 1 and name not in _registered:
        raise InputError(f"--policy {name}: offered by {' and by '.join(offers)}; uninstall or rename all but one")


def get(spec: str, **options: Any) -> Policy:
    """Make a policy from `name` or `name:argument`, such as `stand`, `replay:clip.pkl` or `remote:http://host:8443`.

    Args:
        spec: Name and argument.
        options: Keywords for a policy that takes some, such as `timeout` of `remote`.

    Raises:
        InputError: Unknown name, or an argument that is missing or unfit.
    """
    check_spec(spec)
    name, colon, rest = spec.partition(":")
    argument = rest if colon else None
    if name in _registered:
        return _made(name, _registered[name], argument, options)
    if name in _BUILT_IN:
        module, _, attribute = _BUILT_IN[name].partition(":")
        return getattr(importlib.import_module(module), attribute)(argument, **options)
    point = next(point for point in _entry_points() if point.name == name)
    try:
        factory = point.load()
    except Exception as error:
        reason = " ".join(str(error).split())
        raise InputError(f"--policy {name}: its package does not load ({type(error).__name__}: {reason})") from error
    return _made(name, factory, argument, options)


def _made(name: str, factory: Callable[..., Policy], argument: str | None, options: dict[str, Any]) -> Policy:
    try:
        inspect.signature(factory).bind(argument, **options)
    except TypeError as error:
        raise InputError(f"--policy {name}: its factory does not take what it is given ({error})") from None
    except ValueError:  # some of those written in C have no signature
        pass
    policy = factory(argument, **options)
    if not isinstance(policy, Policy):
        raise InputError(f"--policy {name}: its factory makes a {type(policy).__name__}, not a Policy")
    return policy


def _package(point: importlib.metadata.EntryPoint) -> str:
    return f"package {point.dist.name}" if point.dist else "another package"
