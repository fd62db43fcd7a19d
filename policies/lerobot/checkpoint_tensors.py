"""A checkpoint's files of tensors, compared with what its configuration says, before a network is built.

Of the weights only the header is read: a network of another family, of pi0.5 say, takes minutes to build and is refused
in milliseconds.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE

__all__ = ["check_family", "check_layers", "check_spread", "check_statistics", "within_weights"]


@dataclass(frozen=True)
class _Names:
    """Prefixes of a family's tensor names, as LeRobot 0.6 saves them."""

    always: tuple[str, ...]
    """Each begins a name of every checkpoint of the family."""
    sometimes: tuple[str, ...] = ()
    """These too, where there are pictures or a training's own parts."""


_FAMILIES: Mapping[str, _Names] = {
    "act": _Names(
        ("model.encoder.", "model.decoder.", "model.decoder_pos_embed.", "model.action_head."),
        ("model.backbone.", "model.encoder_", "model.vae_encoder"),
    ),
    "diffusion": _Names(("diffusion.unet.",), ("diffusion.rgb_encoder.",)),
    "multi_task_dit": _Names(("observation_encoder.", "noise_predictor.")),
    "pi05": _Names(
        (
            "model.paligemma_with_expert.",
            "model.action_in_proj.",
            "model.action_out_proj.",
            "model.time_mlp_in.",
            "model.time_mlp_out.",
        )
    ),
}
"""LeRobot's type of policy → names of its tensors."""
_LAYERS: Mapping[str, Mapping[str, str]] = {
    "act": {
        "n_encoder_layers": "model.encoder.layers.",
        "n_decoder_layers": "model.decoder.layers.",
        "n_vae_encoder_layers": "model.vae_encoder.layers.",
    },
    "diffusion": {"down_dims": "diffusion.unet.down_modules."},
    "multi_task_dit": {"num_layers": "noise_predictor.transformer_blocks."},
}
"""LeRobot's type of policy → field of its configuration → how the names of the layers begin that it counts or lists."""
PARAMETER_COST = 10_000
"""Least count of a parameter, in numbers: modules take memory too."""
SPARE = 2**26
"""Numbers that a network may be built with beyond twice its weights, in parts that it drops again: 256 MiB."""
_SPREADS: Mapping[str, tuple[str, ...]] = {
    "MEAN_STD": ("std",),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""LeRobot's `NormalizationMode` → the statistics by whose value, or difference, it divides."""


def check_family(path: Path, kind: str) -> None:
    """Refuse weights of another family than the one that `config.json` names.

    Args:
        path: The file of the weights, of which the header is read.
        kind: LeRobot's type of policy, one of those that are run.

    Raises:
        InputError: The file is damaged, or a tensor does not belong to the family or is missing; the message names it.
    """
    with _opened(path) as file:
        found = sorted(file.keys())
    text = f"but {CONFIG_FILE} says type {kind}"
    belongs = _FAMILIES[kind].always + _FAMILIES[kind].sometimes
    for name in found:
        if not name.startswith(belongs):
            own = [one for one, names in _FAMILIES.items() if name.startswith(names.always + names.sometimes)]
            whose = f" of {own[0]}" if own else ""
            raise InputError(f"{path}: holds the tensor {name:.120}{whose}, {text}, which has none of that name")
    for start in _FAMILIES[kind].always:
        if not any(name.startswith(start) for name in found):
            raise InputError(f"{path}: holds no tensor {start}*, {text}, which needs it")


def check_layers(path: Path, kind: str, config: object) -> None:
    """Refuse a configuration with another number of layers than the weights have.

    Args:
        path: The file of the weights, of which the header is read.
        kind: LeRobot's type of policy.
        config: LeRobot's configuration of it.

    Raises:
        InputError: They differ; the message names the field.
    """
    with _opened(path) as file:
        names = list(file.keys())
    for field, start in _LAYERS.get(kind, {}).items():
        held = len({name[len(start) :].partition(".")[0] for name in names if name.startswith(start)})
        declared = getattr(config, field)
        declared = declared if isinstance(declared, int) else len(declared)
        if held and declared != held:
            raise InputError(f"{path}: holds {held} layers {start}*, but {CONFIG_FILE} says {field} {declared}")


@contextmanager
def within_weights(path: Path) -> Iterator[None]:
    """Stop the building of a network, in this thread, that takes far more than a file of weights holds.

    Raises:
        InputError: The file is damaged, or the network too large.
    """
    with _opened(path) as file:
        held = sum(max(math.prod(file.get_slice(name).get_shape()), PARAMETER_COST) for name in file.keys())  # noqa: SIM118 (not a mapping)
    left, builder = 2 * held + SPARE, threading.get_ident()

    def count(module: torch.nn.Module, name: str, made: torch.nn.Parameter | None) -> None:
        nonlocal left
        if made is not None and threading.get_ident() == builder:
            left -= max(made.numel(), PARAMETER_COST)
            if left < 0:
                raise InputError(f"{path}: holds {held:,} numbers, the network of its {CONFIG_FILE} far more")

    watch = torch.nn.modules.module.register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        watch.remove()


def check_statistics(path: Path, modes: Mapping[str, str]) -> None:
    """Refuse a processor's statistics that say of all numbers of a feature that they never change.

    Args:
        path: A file of a normalising step.
        modes: Feature that it normalises, by its name in the file → LeRobot's `NormalizationMode`.

    Raises:
        InputError: The file is damaged, or has such statistics; the message names the feature.
    """
    with _opened(path) as file:
        held = set(file.keys())
        for feature, mode in modes.items():
            wanted = {name: f"{feature}.{name}" for name in _SPREADS.get(mode, ())}
            if wanted and held.issuperset(wanted.values()):  # others are refused where the processors are tried
                check_spread(path, feature, {name: file.get_tensor(key) for name, key in wanted.items()})


def check_spread(path: Path, feature: str, stats: Mapping[str, torch.Tensor]) -> None:
    """Refuse a feature of several numbers whose spread is zero in each; single numbers may well be constant.

    Args:
        path: File of the statistics.
        feature: Its name in the file.
        stats: The standard deviation, or lower and upper end, by name.

    Raises:
        InputError: All numbers are constant.
    """
    ends = list(stats.values())
    if ends[0].numel() < 2:
        return
    constant = torch.equal(*ends) if len(ends) > 1 else not bool(ends[0].any())
    if constant:
        text = " equals ".join(stats) if len(ends) > 1 else f"{next(iter(stats))} is 0"
        raise InputError(
            f"{path}: {feature}: {text} in all {ends[0].numel()} numbers, by which nothing can be normalised; "
            "compute the statistics of its dataset again"
        )


@contextmanager
def _opened(path: Path) -> Iterator[safe_open]:
    """A file of tensors, of which only the header is read at first.

    Raises:
        InputError: It is damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except (OSError, SafetensorError, ValueError) as error:
        raise InputError(f"{path}: not readable as safetensors ({' '.join(str(error).split())[:300]})") from None
