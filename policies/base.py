"""Policies: a policy observes all worlds that ask and returns a chunk of canonical actions for each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arena_newton.cli.registry import Registry
from arena_newton.errors import ArenaError, InputError
from arena_newton.interfaces import Chunk, Observation

if TYPE_CHECKING:
    import numpy as np
    import torch

    from arena_newton.interfaces import World
    from arena_newton.pictures.camera import CameraConfig

__all__ = [
    "DATASET_FILE",
    "Chunk",
    "Observation",
    "Policy",
    "PolicyUnavailable",
    "check_spec",
    "dataset_target",
    "get",
    "hub_name",
    "is_privileged",
    "names",
    "register",
    "world_mask",
]

Json = dict[str, Any]
"""A JSON object."""
DATASET_FILE = "meta/info.json"
"""File by which a folder is known to be a LeRobot dataset."""
type Mask = Sequence[bool] | np.ndarray | torch.Tensor | None
"""Worlds, bool, shape [worlds]; None: all."""


class PolicyUnavailable(ArenaError):
    """The policy cannot continue (its server is gone); the run stops and its unfinished episodes stay open."""

    exit_code = 2


class Policy:
    """Base of all policies; a subclass writes `act` and, where it has a memory, `reset`."""

    name: str = "policy"
    """Name in reports."""
    needs_image: bool = False
    """True if the head camera must be rendered for `act`."""
    camera: CameraConfig | None = None
    """The picture that the policy wants; None: 224×224 with black bars, as the original prepares policy images."""
    cameras: Mapping[str, CameraConfig] | None = None
    """Pictures that a policy of several cameras wants, by the names of `Observation.images`: `front`, `left_wrist`,
    `right_wrist`, `world`, or another name for the `prim` of a camera of the scene. None: `camera` alone, where
    `needs_image`."""
    labels: str | None = None
    """Protocol of its actions (`data.readers.label_protocols`), if always the same; None: as `--labels` says."""
    realign: float = 0.0
    """Fraction of the gap between commanded and measured heading that is closed each tick, by who decodes v4."""
    chunk_size: int = 1
    """Actions per chunk, where the policy knows it in advance."""
    in_pieces: bool = False
    """True if a chunk is given in pieces, so that the policy observes more ticks than those at which it decides. A
    piece may be shorter than the latency of a run; the chunk must not."""
    depends_on_worlds: bool = False
    """True if an episode may depend on the number of worlds that ask at once; the number is then part of a run's
    identity. Final after `check`."""

    def check(self) -> None:
        """Validate the policy before the first episode.

        Raises:
            InputError: It cannot work, for a reason that the user can repair.
        """

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """Check before the first episode that the policy can do a task, in a mode and with seeds if known yet.

        Args:
            task: Name of the task.
            mode: Evaluation mode.
            seeds: What `reset` will be given.

        Raises:
            InputError: It cannot.
        """

    def attach(self, env: World) -> None:
        """Take a view of the worlds of the next episodes, to read (`arena_newton.physics.policy_view`).

        A policy that overrides this is privileged, and marked so in every result.

        Raises:
            InputError: The policy cannot work in this environment.
        """

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Begin new episodes in the worlds of `mask`, given a seed and a Gym id per world of the batch.

        The seeds are for noise alone: `seeding.policy_seed` of the episodes, from which no placement follows.
        """

    def act(self, observation: Observation) -> Chunk:
        """Actions for the worlds that ask."""
        raise TypeError(f"policy {self.name!r} defines no act()")

    def describe(self) -> Json:
        """Facts to record with every result so that this policy is named exactly."""
        return {"name": self.name}

    def close(self) -> None:
        """Release connections and buffers."""


POLICIES: Registry[Policy] = Registry(
    "policy",
    "arena_newton.policies",
    lambda: Policy,
    {
        "expert": "arena_newton.policies.experts:from_spec",
        "learned": "arena_newton.policies.learned.learned_policy:from_spec",
        "lerobot": "arena_newton.policies.lerobot.checkpoint_policy:from_spec",
        "process": "arena_newton.policies.remote.process_client:ProcessPolicy",
        "remote": "arena_newton.policies.remote.arena_client:from_spec",
        "replay": "arena_newton.policies.replay:from_spec",
        "stand": "arena_newton.policies.stand:from_spec",
    },
)
"""Makers of policies; each takes the text after the colon, or None, and the options of `get` that it knows."""
register = POLICIES.register
names = POLICIES.names


def is_privileged(policy: Policy) -> bool:
    """A policy takes the world itself, so that it knows more of an episode than state and picture show."""
    return getattr(policy.attach, "__func__", None) is not Policy.attach


def world_mask(mask: Mask, worlds: int) -> np.ndarray:
    """A mask as bool array of shape [worlds]."""
    import numpy as np  # here, so that --help does not wait for it

    if mask is None:
        return np.ones(worlds, dtype=bool)
    values = mask if isinstance(mask, Sequence | np.ndarray) else mask.detach().cpu()
    return np.asarray(values).astype(bool).reshape(worlds)


def dataset_target(argument: str) -> tuple[Path, str | None]:
    """Path and episode of `<path>#<episode>`; a path that has a `#` in its own name is taken as it is."""
    if Path(argument).exists():
        return Path(argument), None
    path, hash_sign, episode = argument.rpartition("#")
    return (Path(path), episode) if hash_sign else (Path(argument), None)


def hub_name(argument: str) -> bool:
    """True if text names a repository of the Hugging Face hub, `owner/name`, and no file or folder here."""
    return bool(re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", argument)) and not Path(argument).expanduser().exists()


def check_spec(spec: str) -> None:
    """Check a spec without making the policy; secrets, which results would publish, are refused and not printed.

    Raises:
        InputError: Unknown name, a name that is offered twice, or an address with a user name or password in it.
    """
    name, _, argument = spec.partition(":")
    if "@" in argument and (name == "remote" or "://" in argument):
        raise InputError(
            f"--policy {name}: the address holds a user name or a password (an @), which results would publish; "
            "give a token in the environment variable ARENA_POLICY_TOKEN instead"
        )
    POLICIES.check(name)


def get(spec: str, **options: Any) -> Policy:
    """Make a policy from `name` or `name:argument`, such as `stand`, `replay:clip.pkl` or `remote:http://host:8443`.

    Some policies take `options`, such as `timeout` of `remote`.

    Raises:
        InputError: Unknown name, or an argument that is missing or unfit.
    """
    check_spec(spec)
    name, colon, rest = spec.partition(":")
    return POLICIES.make(name, rest if colon else None, **options)
