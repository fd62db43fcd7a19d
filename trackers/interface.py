"""Interfaces that are trained here: one record per tracker, from which training, weights files and bars are derived.

A module such as `twist2` ends with its record, `INTERFACE`, and is listed in `MODULES`; another package offers its own
under the entry point group `arena_newton.interfaces`. Nothing here imports torch, so that command lines can list names.
"""

from __future__ import annotations

import dataclasses
import importlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from arena_newton.cli.registry import Registry
from arena_newton.errors import InputError
from arena_newton.robot.g1 import MUJOCO_JOINTS, DriveGains, PhysicsRate

if TYPE_CHECKING:
    from arena_newton.trackers.front_end import FrontEnd
    from arena_newton.trackers.inference.networks import TrackerNetwork

__all__ = ["JOINTS", "MODULES", "ActionForm", "Interface", "get", "names", "residual_form", "slices"]

MODULES: dict[str, str] = {"sonic": "arena_newton.trackers.sonic", "twist2": "arena_newton.trackers.twist2"}
"""Interface → module with its `INTERFACE`, and with `from_checkpoint`, which makes the tracker."""

JOINTS = len(MUJOCO_JOINTS)
_OFFERED: Registry[Interface] = Registry("tracker", "arena_newton.interfaces", lambda: Interface, MODULES)
"""Interfaces of other packages, under the entry point group: a callable without arguments that makes the record."""

_WIDEST = 8192
"""Widest layer that a file may ask for."""


@dataclass(frozen=True)
class ActionForm:
    """Conversion of a network's raw output to joint targets: base + scale * clip(raw)."""

    kind: str
    """`default`: the base is the tracker's default pose. `residual`: the base is the reference of the tick."""
    scale: tuple[float, ...]
    """Radians per unit of raw output, 29, MuJoCo order."""
    clip: float = 0.0
    """Largest magnitude of the raw output that counts, 0 = no limit."""

    def __post_init__(self) -> None:
        if self.kind not in ("default", "residual"):
            raise InputError(f"action form {self.kind!r}: known are default, residual")
        if len(self.scale) != JOINTS or self.clip < 0.0:
            raise InputError(f"action form {self.kind!r}: needs {JOINTS} scales and a clip of at least 0")


def residual_form(drive: DriveGains) -> ActionForm:
    """Residual action: one unit commands a quarter of a joint's torque limit through its position gain; 6 at most."""
    return ActionForm("residual", tuple(0.25 * e / k for e, k in zip(drive.effort, drive.kp, strict=True)), clip=6.0)


def slices(layout: Mapping[str, int]) -> dict[str, slice]:
    """Named parts of a row, from their widths in order."""
    ends = [*itertools.accumulate(layout.values(), initial=0)]
    return {name: slice(*bounds) for name, bounds in zip(layout, itertools.pairwise(ends), strict=True)}


@dataclass(frozen=True)
class Interface:
    """Inputs of a trainable tracker's network, and the physics and bars for its training and evaluation."""

    name: str
    """Name in weights files and on the command line."""
    front_end: Callable[[ActionForm], FrontEnd]
    """Makes the front end with an action form."""
    network: Callable[..., TrackerNetwork]
    """Class of the network; its arguments are hidden widths, with defaults."""
    layout: Mapping[str, int]
    """Parts of the observation in order → their widths; `slices` makes indices of them."""
    drive: DriveGains
    """PD drive that training simulates."""
    rate: PhysicsRate
    """Physics rate of training."""
    official_form: ActionForm
    """Action form of the official checkpoints."""
    bars: Mapping[str, float] = field(default_factory=dict)
    """Limits that `trackers.evaluation.figures` sets for this interface alone, by the figure's key."""

    @property
    def obs_width(self) -> int:
        """Width of the observation."""
        return sum(self.layout.values())

    def action_form(self, kind: str) -> ActionForm:
        """The action form of a training: `auto` and `residual` correct the reference, `default` is the official one.

        Raises:
            InputError: Another kind.
        """
        if kind not in ("auto", "residual", "default"):
            raise InputError(f"--action-form {kind}: expected auto, residual or default")
        return dataclasses.replace(self.official_form, clip=10.0) if kind == "default" else residual_form(self.drive)

    def make_network(self, config: Mapping[str, Any] | None = None) -> TrackerNetwork:
        """A new network with the hidden widths of `TrackerNetwork.config`; the defaults without them.

        Raises:
            InputError: Arguments that do not fit.
        """
        config = dict(config or {})
        where = f"network of interface {self.name!r}"
        widths = [w for value in config.values() for w in (value if isinstance(value, list | tuple) else [value])]
        if not all(isinstance(w, int) and 0 < w <= _WIDEST for w in widths):
            raise InputError(f"{where}: widths must be whole numbers up to {_WIDEST}: {config}")
        try:
            return self.network(**config)
        except TypeError as error:
            raise InputError(f"{where}: unfit arguments {config}: {error}") from error


def names() -> tuple[str, ...]:
    """Names of the interfaces, sorted."""
    return _OFFERED.names()


def get(name: str) -> Interface:
    """An interface by name.

    Raises:
        InputError: Unknown name, a name that is offered twice, or a package that does not load.
    """
    if name not in names():
        raise InputError(f"interface {name!r}: unknown; trained here are {', '.join(names())}")
    if name in MODULES and not _OFFERED.points(name):
        return importlib.import_module(MODULES[name]).INTERFACE
    return _OFFERED.make(name)
