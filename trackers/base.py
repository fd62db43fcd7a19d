"""What a tracker is: it turns the reference of one 50 Hz tick into 29 joint targets for every world at once.

Torch is imported only by the trackers themselves, so that listing their names stays quick.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot import MUJOCO_JOINTS, TWIST2_DRIVE, DriveGains, PhysicsRate

if TYPE_CHECKING:
    import torch

__all__ = [
    "ENTRY_POINT_GROUP",
    "RobotState",
    "Tracker",
    "TrackerCommand",
    "get",
    "names",
    "register",
    "shipped_weights",
]

ENTRY_POINT_GROUP = "arena_newton.trackers"
"""Other packages offer trackers under this entry point group: a callable that takes `checkpoint: Path | None`."""

_BUILT_IN = {
    "pd": "arena_newton.trackers.pd:from_checkpoint",
    "sonic": "arena_newton.trackers.sonic:from_checkpoint",
    "twist2": "arena_newton.trackers.twist2:from_checkpoint",
}
_registered: dict[str, Callable[[Path | None], Tracker]] = {}


class Tracker:
    """Base of all trackers; a subclass sets the attributes and writes `step`."""

    name: str = "tracker"
    """Name in reports and on the command line."""
    checkpoint: str | None = None
    """File the weights came from."""
    checkpoint_hash: str = "none"
    """First 12 hexadecimal digits of the checkpoint's SHA-256."""
    joints: tuple[str, ...] = MUJOCO_JOINTS
    """Order of the joint targets."""
    drive: DriveGains = TWIST2_DRIVE
    """PD drive that executes the targets."""
    original_drive: DriveGains | None = None
    """Drive under which the original benchmark runs this checkpoint, where that is another one (rules `released`)."""
    physics_rate: PhysicsRate = PhysicsRate(dt=0.005, substeps=4)
    """Physics rate the tracker was made for."""
    fast_physics_rate: PhysicsRate = PhysicsRate(dt=0.005, substeps=4)
    """Physics rate under `--fast-physics`."""
    ignores: tuple[str, ...] = ()
    """Parts of the 40-number action that cannot reach the robot through this tracker."""
    max_root_delta_deg: float = 0.0
    """Largest turn of the reference root between ticks [deg], 0 = no limit (the original limits SONIC's to 26)."""
    worlds: int = 0
    """Worlds this tracker is bound to."""

    def rate(self, *, fast: bool = False) -> PhysicsRate:
        """Physics step and substeps a tick."""
        return self.fast_physics_rate if fast else self.physics_rate

    def bind(self, worlds: int, device: Any = "cpu", scene: Any = None) -> None:
        """Allocate buffers for `worlds` worlds on a torch device; `scene` is for trackers that need the model."""
        self.worlds = worlds
        self.device = device

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Forget the past of the worlds in `mask` (all without one); shape [worlds], bool."""

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Pretend that the worlds in `mask` have held this command and state for a while."""

    def step(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """Joint targets of this tick [rad], MuJoCo order, shape [worlds, 29]; valid until the next call."""
        raise TypeError(f"tracker {self.name!r} defines no step()")

    def describe(self) -> dict[str, Any]:
        """What a result must record to name this tracker exactly; drive and physics rate are the environment's."""
        return {
            "name": self.name,
            "checkpoint_hash": self.checkpoint_hash,
            "ignores": list(self.ignores),
        }


def register(name: str, factory: Callable[[Path | None], Tracker]) -> None:
    """Offer a tracker under `name` in this process; `factory` takes the checkpoint's path or None.

    Raises:
        InputError: A built-in tracker has that name.
    """
    if name in _BUILT_IN:
        raise InputError(f"tracker {name!r}: is built in; register yours under another name")
    _registered[name] = factory


def _entry_points() -> dict[str, importlib.metadata.EntryPoint]:
    return {e.name: e for e in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP)}


def names() -> tuple[str, ...]:
    """Names of all trackers that `get` knows, sorted."""
    return tuple(sorted({*_BUILT_IN, *_registered, *_entry_points()}))


def weights_path(interface: str) -> Path:
    """Where the weights that come with the package lie: `trackers/weights/<interface>.safetensors`."""
    return Path(__file__).parent / "weights" / f"{interface}.safetensors"


def shipped_weights(spec: str) -> Path | None:
    """The weights that come with the package for a built-in tracker; None without any."""
    path = weights_path(spec)
    return path if spec in _BUILT_IN and path.is_file() else None


def get(spec: str, checkpoint: str | Path | None = None) -> Tracker:
    """Make a tracker by name.

    Args:
        spec: Name of a built-in, registered or entry-point tracker.
        checkpoint: Weights (`--checkpoint`): a file, or whatever path the tracker documents, such as a folder. Without
            it a tracker takes the weights it comes with.

    Raises:
        InputError: Unknown name, or a checkpoint that is absent or unfit.
    """
    path = None if checkpoint is None else Path(checkpoint)
    if spec not in names():
        raise InputError(f"--tracker {spec}: unknown tracker; known are {', '.join(names())}")
    if spec in _BUILT_IN and spec in _entry_points():
        point = _entry_points()[spec]
        theirs = point.dist.name if point.dist else point.value
        raise InputError(f"--tracker {spec}: is built in, but {theirs} offers another of that name: rename it there")
    if path is not None and not all(Path(part).exists() for part in str(path).split(",")) and not path.exists():
        raise InputError(f"--checkpoint {path}: no such file")
    if spec in _registered:
        return _made(spec, _registered[spec], path)
    if spec in _BUILT_IN:
        module, _, attribute = _BUILT_IN[spec].partition(":")
        return getattr(importlib.import_module(module), attribute)(path)
    try:
        factory = _entry_points()[spec].load()
    except Exception as error:
        reason = " ".join(str(error).split())
        raise InputError(f"--tracker {spec}: its package does not load ({type(error).__name__}: {reason})") from error
    return _made(spec, factory, path)


def _made(spec: str, factory: Callable[[Path | None], Tracker], path: Path | None) -> Tracker:
    try:
        inspect.signature(factory).bind(path)
    except TypeError as error:
        raise InputError(f"--tracker {spec}: its factory takes no checkpoint ({error})") from None
    except ValueError:  # some of those written in C have no signature
        pass
    tracker = factory(path)
    if not isinstance(tracker, Tracker):
        raise InputError(f"--tracker {spec}: its factory makes a {type(tracker).__name__}, not a Tracker")
    return tracker
