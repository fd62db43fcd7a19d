"""Weights of our own trackers: one `.safetensors` file that says how it wants to be driven.

The file holds the network's tensors and one metadata entry, `arena_newton`, a JSON object: format, interface, widths,
action form, drive, physics rate, symmetry and the card (how the weights came to be). Nothing in it is code.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as decode
from safetensors.torch import save as encode

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.untrusted_files import read_bytes
from arena_newton.robot.g1 import TICK, DriveGains, PhysicsRate
from arena_newton.trackers import base, interface
from arena_newton.trackers.inference.networks import TrackerNetwork
from arena_newton.trackers.interface import JOINTS, ActionForm

__all__ = ["FORMAT", "METADATA_KEY", "Weights", "action_form", "default", "drive", "load", "physics", "save"]

FORMAT = "arena-newton-tracker-1"
"""Format that this module writes and reads."""
METADATA_KEY = "arena_newton"
"""Metadata entry of the safetensors header."""


@dataclass
class Weights:
    """A network and everything a tracker must know about it."""

    interface: str
    """Name of the interface (`trackers.interface`)."""
    network: TrackerNetwork
    """The network with its input normalisation."""
    action_form: ActionForm
    """Conversion of raw outputs to joint targets."""
    drive: DriveGains
    """Drive that the network was trained with."""
    physics: PhysicsRate
    """Physics rate that it was trained at."""
    card: dict[str, Any] = field(default_factory=dict)
    """Origin of the weights: `commit`, `command`, `samples`, `minutes`, `data`, `licences`, `metrics`, …"""
    symmetric: bool = False
    """True if the tracker averages the action and its mirror image (`networks.Symmetric`)."""
    sha256: str = ""
    """SHA-256 of the file, after loading."""

    def metadata(self) -> dict[str, Any]:
        """The JSON object of the file's header."""
        form, physics = (dataclasses.asdict(x) for x in (self.action_form, self.physics))
        return {
            "format": FORMAT,
            "interface": self.interface,
            "hidden": self.network.config(),
            "action_form": form,
            "drive": self.drive.as_json(),
            "physics": physics,
            "symmetric": self.symmetric,
            "commit": self.card.get("commit"),
            "card": self.card,
        }


def default(name: str, otherwise: str) -> Path:
    """The weights that come with the package.

    Raises:
        InputError: There are none; it says what to pass `otherwise`.
    """
    path = base.weights_path(name)
    if not path.is_file():
        raise InputError(
            f"--tracker {name}: no weights come with this installation ({path} is absent); pass {otherwise}, "
            "or use --tracker pd"
        )
    return path


def save(path: str | Path, weights: Weights) -> None:
    """Write a weights file, `.safetensors`; a reader never sees a part of it.

    Raises:
        InputError: The path cannot be written, or a number of the network is not finite.
    """
    path = Path(path)
    tensors = {name: t.detach().cpu().contiguous() for name, t in _tensors(weights.network).items()}
    bad = [name for name, t in tensors.items() if not torch.isfinite(t).all()]
    if bad:
        raise InputError(f"{path}: not written, {bad[0]} holds numbers that are not finite")
    data = encode(tensors, {METADATA_KEY: json.dumps(weights.metadata(), sort_keys=True)})
    try:
        with replace_atomically(path) as file:
            file.write(data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def load(path: str | Path, wanted: str | None = None, *, flag: str = "--checkpoint") -> Weights:
    """Read a weights file, of the interface `wanted` if one is given; errors name the command line's `flag`.

    Raises:
        InputError: The file is absent, damaged, of another kind or interface, or its tensors do not fit.
    """
    where = f"{flag} {path}"
    data = read_bytes(path, limits.NETWORK_BYTES, where=where)
    try:
        tensors = decode(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        text = header.get("__metadata__", {}).get(METADATA_KEY)
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise InputError(f"{where}: not a readable safetensors file ({_line(error)})") from error
    if text is None:
        raise InputError(
            f"{where}: safetensors without the metadata {METADATA_KEY!r}: not a tracker of this project "
            "(python -m arena_newton.trackers.train export makes one)"
        )
    try:
        meta = json.loads(text)
        if meta["format"] != FORMAT:
            raise InputError(f"{where}: format {meta['format']!r}, expected {FORMAT!r}")
        if wanted is not None and meta["interface"] != wanted:
            raise InputError(
                f"{where}: weights of interface {meta['interface']!r}: use them with --tracker {meta['interface']}"
            )
        network = _network(meta["interface"], meta["hidden"], tensors, where)
        weights = Weights(
            interface=meta["interface"],
            network=network,
            action_form=action_form(meta["action_form"]),
            drive=drive(meta["drive"]),
            physics=physics(meta["physics"]),
            symmetric=bool(meta.get("symmetric", False)),
            card=dict(meta.get("card") or {}),
            sha256=hashlib.sha256(data).hexdigest(),
        )
    except InputError as error:
        raise error if str(error).startswith(flag) else InputError(f"{where}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as error:
        raise InputError(f"{where}: its metadata is incomplete or wrong ({_line(error)})") from error
    network.load_state_dict(dict(tensors), strict=False)
    network.eval()
    return weights


def _tensors(network: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Tensors of a network that a file holds: all but the counts behind its input statistics."""
    return {name: t for name, t in network.state_dict().items() if not name.endswith(".count")}


def _network(name: str, config: Mapping[str, Any], tensors: Mapping[str, torch.Tensor], where: str) -> TrackerNetwork:
    """A network of the widths that a file states, once its tensors are known to be of these widths."""
    count = sum(len(value) for value in config.values() if isinstance(value, list))
    if count > limits.NETWORK_LAYERS:
        raise InputError(f"{where}: states {count} layers, expected at most {limits.NETWORK_LAYERS}")
    make = interface.get(name).make_network
    with torch.device("meta"):
        sketch = make(config)
    _check_tensors(_tensors(sketch), tensors, where)
    return make(config)


def _check_tensors(expected: Mapping[str, torch.Tensor], tensors: Mapping[str, torch.Tensor], where: str) -> None:
    missing, unknown = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or unknown:
        names = f"misses {missing[0]}" if missing else f"holds an unknown {unknown[0]}"
        raise InputError(f"{where}: it {names}; its tensors do not fit its widths")
    for name, tensor in tensors.items():
        if tensor.shape != expected[name].shape or not tensor.is_floating_point():
            shape, wanted = list(tensor.shape), list(expected[name].shape)
            raise InputError(f"{where}: {name} is {tensor.dtype} of shape {shape}, expected float32 of shape {wanted}")
        if not torch.isfinite(tensor).all():
            raise InputError(f"{where}: {name} holds numbers that are not finite")


def action_form(value: Mapping[str, Any]) -> ActionForm:
    """An action form from JSON; ValueError, KeyError or TypeError where it is unfit."""
    scale, clip = tuple(float(v) for v in value["scale"]), float(value["clip"])
    if not all(map(math.isfinite, (*scale, clip))):
        raise ValueError("action_form holds numbers that are not finite")
    return ActionForm(str(value["kind"]), scale, clip)


def drive(value: Mapping[str, Any]) -> DriveGains:
    """A drive from JSON; errors as `action_form`."""
    named = [name for name in ("kp", "kd", "effort", "armature") if name != "armature" or name in value]
    vectors = {name: tuple(float(v) for v in value[name]) for name in named}
    fingers = {f"finger_{name}": float(value[f"finger_{name}"]) for name in ("kp", "kd", "effort", "armature")}
    for name, numbers in vectors.items():
        if len(numbers) != JOINTS or not all(math.isfinite(v) and v >= 0.0 for v in numbers):
            raise ValueError(f"drive {name} needs {JOINTS} finite numbers of at least 0")
    for name, number in fingers.items():
        if not (math.isfinite(number) and number >= 0.0):
            raise ValueError(f"drive {name} is {number}, expected a finite number of at least 0")
    fields: dict[str, Any] = {"name": str(value["name"]), **vectors, **fingers}
    return DriveGains(**fields)


def physics(value: Mapping[str, Any]) -> PhysicsRate:
    """A physics rate from JSON; errors as `action_form`."""
    rate = PhysicsRate(float(value["dt"]), int(value["substeps"]))
    if not rate.dt > 0.0 or rate.substeps < 1 or not abs(rate.dt * rate.substeps - TICK) <= 1e-9:
        raise ValueError(f"physics {rate.dt} s x {rate.substeps} is not a tick of {TICK} s")
    return rate


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
