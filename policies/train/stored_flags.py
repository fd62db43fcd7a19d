"""Flags of a training in its checkpoints, and those with which it goes on."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path

from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from arena_newton.cli.flags import flag_name
from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import FACTS_FILE, CheckpointFacts
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.policy_options import PolicyTrainOptions

__all__ = ["plain", "plain_options", "read_options", "resumed", "stored_recipe"]

FREE_ON_RESUME = frozenset(
    ("resume", "out", "dataset", "steps", "minutes", "device", "save_every", "keep", "hold_out_every", "log_every")
    + ("graph", "compile", "jobs", "quiet")
)
"""Flags that may differ when a training goes on; datasets must have the content that they had."""


def resumed(
    options: PolicyTrainOptions, content: Mapping[str, object], where: Path, named: Collection[str] = ()
) -> PolicyTrainOptions:
    """Flags of a training that goes on.

    Args:
        options: Flags that were given with `--resume`.
        where: Checkpoint that they are of.
        named: Fields that were given though they have their default's value.

    Raises:
        InputError: A flag contradicts the training, or its stored flags are damaged.
    """
    stored = read_options(content, where)
    empty = PolicyTrainOptions()
    chosen = set(named) - {"steps", "minutes"}  # 0 of them is what the training has
    # A machine without a compiler goes on with what another one has begun.
    changes: dict[str, object] = {"resume": options.resume, "out": options.resume, "compile": options.compile}
    for one in dataclasses.fields(PolicyTrainOptions):
        given = getattr(options, one.name)
        if one.name in changes or (given == getattr(empty, one.name) and one.name not in chosen):
            continue
        if one.name not in FREE_ON_RESUME and given != getattr(stored, one.name):
            flag = flag_name(one.name)
            raise InputError(f"{flag} {given}: the training in {options.resume} has {getattr(stored, one.name)}")
        changes[one.name] = given
    for given_flag, other in (("steps", "minutes"), ("minutes", "steps")):  # either says how long a training is
        if given_flag in changes:
            changes.setdefault(other, getattr(empty, other))
    return dataclasses.replace(stored, **changes)  # type: ignore[arg-type]  # fields of the class


def plain_options(options: PolicyTrainOptions) -> dict[str, object]:
    """Flags as JSON; datasets by their whole path."""
    found = plain(dataclasses.asdict(options))
    assert isinstance(found, dict)
    return found | {"dataset": [str(folder.resolve()) for folder in options.dataset]}


def read_options(content: Mapping[str, object], where: Path) -> PolicyTrainOptions:
    """Flags that a checkpoint stores.

    Raises:
        InputError: They are damaged.
    """
    values: dict[str, object] = {"tracker_vector": False}  # as it was before there was the flag
    for one in dataclasses.fields(PolicyTrainOptions):
        if one.name not in content:
            continue
        value, default = content[one.name], one.default
        if isinstance(default, tuple) and isinstance(value, list) and all(isinstance(name, str) for name in value):
            values[one.name] = tuple(Path(name) if one.name == "dataset" else name for name in value)
        elif one.name in ("out", "resume"):
            continue
        elif type(value) is type(default) or (isinstance(default, float) and type(value) is int):
            values[one.name] = value
        elif one.name == "seed" and (value is None or type(value) is int):
            values[one.name] = value
        else:
            raise InputError(f"{where}: options: {one.name} is {str(value)[:60]!r}, which it cannot be")
    return PolicyTrainOptions(**values)  # type: ignore[arg-type]  # each is of its default's kind


def stored_recipe(checkpoint: Path) -> TrainingRecipe:
    """The recipe with which a training began; one of that name may be another one today.

    Raises:
        InputError: The checkpoint does not hold it.
    """
    folder = checkpoint / PRETRAINED_MODEL_DIR
    facts = CheckpointFacts.read(folder)
    found = facts.options.get("recipe") if facts else None
    content = found if isinstance(found, dict) else {}
    try:
        return TrainingRecipe(**content | {"betas": tuple(content["betas"])})
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{folder / FACTS_FILE}: options: recipe is not that of a training ({type(error).__name__})"
        ) from None


def plain(value: object) -> object:
    """A value as JSON."""
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)
