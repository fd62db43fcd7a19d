"""Trackers: a tracker turns the reference of one 50 Hz tick into 29 joint targets for every world at once.

Torch is imported only by the trackers themselves, so that listing their names stays quick.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arena_newton.cli.registry import Registry
from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot.g1 import MUJOCO_JOINTS, TWIST2_DRIVE, DriveGains, PhysicsRate
from arena_newton.trackers import interface

if TYPE_CHECKING:
    import torch

__all__ = [
    "ENTRY_POINT_GROUP",
    "RobotState",
    "Tracker",
    "TrackerCommand",
    "check_spec",
    "get",
    "names",
    "register",
    "shipped_weights",
    "weights_path",
]

ENTRY_POINT_GROUP = "arena_newton.trackers"
"""Other packages offer trackers under this entry point group: a callable that takes `checkpoint: Path | None` and,
where the tracker has variants (`--tracker name:argument`), the argument as a text."""


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
    needs: Sequence[str] = ()
    """Fields of `interfaces.NEEDS` that this tracker reads; it gets None for the others."""
    lookahead: int = 0
    """Ticks after this one whose reference it reads in `TrackerCommand.ahead`."""
    worlds: int = 0
    """Worlds this tracker is bound to."""
    loop: int = 0
    """Number of the loop that it belongs to, the last that bound it."""

    def rate(self, *, fast: bool = False) -> PhysicsRate:
        """Physics step and substeps per tick."""
        return self.fast_physics_rate if fast else self.physics_rate

    def bind(self, worlds: int, device: torch.device | str = "cpu") -> None:
        """Allocate buffers for `worlds` worlds on a torch device."""
        self.worlds = worlds
        self.device = device

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Forget the past of the worlds in `mask` (all without one); shape [worlds], bool."""

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the observation history of the masked worlds with the current frame."""

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Joint targets of this tick [rad], MuJoCo order, shape [worlds, 29]; see `interfaces.Tracker`."""
        raise TypeError(f"tracker {self.name!r} defines no step()")

    def graded(self, worlds: int) -> Tracker:
        """The same tracker with ticks that autograd records, in float64 on the CPU, with no past.

        Raises:
            InputError: It has none.
        """
        raise InputError(f"tracker {self.name} has no gradient: it defines no graded()")

    def memory(self) -> tuple[torch.Tensor, ...]:
        """All that the next tick of a `graded` tracker starts from."""
        return ()

    def resumed(self, memory: Sequence[torch.Tensor]) -> Tracker:
        """A `graded` tracker that goes on from a memory."""
        return self

    def describe(self) -> dict[str, Any]:
        """Facts to record with every result to name this tracker exactly; drive and rate are the environment's."""
        window = {"lookahead": self.lookahead} if self.lookahead else {}
        return {"name": self.name, "checkpoint_hash": self.checkpoint_hash, "ignores": list(self.ignores), **window}


_TRACKERS: Registry[Tracker] = Registry(
    "tracker",
    ENTRY_POINT_GROUP,
    lambda: Tracker,
    {name: f"arena_newton.trackers.{name}:from_checkpoint" for name in ("mjlab", "pd")}
    | {name: f"{module}:from_checkpoint" for name, module in interface.MODULES.items()},
)


def register(name: str, factory: Callable[..., Tracker]) -> None:
    """Offer a tracker under `name` in this process; `factory` takes what an entry point's does.

    Raises:
        InputError: A built-in tracker has that name.
    """
    _TRACKERS.register(name, factory)


def names() -> tuple[str, ...]:
    """Names of all trackers that `get` knows, sorted."""
    return _TRACKERS.names()


def weights_path(name: str) -> Path:
    """Path of the weights that come with the package: `trackers/weights/<interface>.safetensors`."""
    return Path(__file__).parent / "weights" / f"{name}.safetensors"


def shipped_weights(spec: str) -> Path | None:
    """The weights that come with the package for a built-in tracker; None without any."""
    path = weights_path(spec)
    return path if spec in _TRACKERS.built_in and path.is_file() else None


def check_spec(spec: str) -> None:
    """Validate a tracker's name without making the tracker.

    Raises:
        InputError: Unknown name, a name that is offered twice, or an argument that is empty or has a `+` or a space,
            which divide names in tables.
    """
    name, *argument = _split(spec)
    _TRACKERS.check(name)
    if argument and (not argument[0] or "+" in argument[0] or len(argument[0].split()) != 1):
        raise InputError(f"--tracker {spec}: expected {name}:<argument>, without + and spaces")


def get(spec: str, checkpoint: str | Path | None = None) -> Tracker:
    """Make a built-in, registered or entry-point tracker from `name` or `name:argument`, such as `sonic:v1_1`.

    A checkpoint is a file, or whatever path the tracker documents; without one a tracker takes its own weights.

    Raises:
        InputError: Unknown name, an argument that the tracker does not take, or a checkpoint that is absent or unfit.
    """
    check_spec(spec)
    name, *argument = _split(spec)
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and not all(Path(part).exists() for part in str(path).split(",")) and not path.exists():
        raise InputError(f"--checkpoint {path}: no such file")
    return _TRACKERS.make(name, path, *argument)


def _split(spec: str) -> list[str]:
    """Name and, where there is one, argument of a tracker; names that were registered may have a colon themselves."""
    return [spec] if spec in _TRACKERS.names() else spec.split(":", 1)
