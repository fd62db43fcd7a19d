"""Check of a packed policy: its card against the files next to it."""

from __future__ import annotations

from arena_newton.errors import InputError
from arena_newton.policies.learned.learned_card import CARD_FILE, PolicyCard
from arena_newton.policies.learned.packed_checkpoint import WEIGHTS_NAME, ActCheckpoint
from arena_newton.policies.lerobot.checkpoint_facts import FACTS_FILE, CheckpointFacts

__all__ = ["check_facts", "check_weights", "training_entries"]

REMEDY = "take all files of one policy, or pack the checkpoint again"
"""Advice where they differ."""


def training_entries(facts: CheckpointFacts) -> dict[str, object]:
    """Fields of a `PolicyCard` that repeat what a checkpoint says of its training."""
    return {
        "trackers": facts.trackers,
        "family": facts.family or "act",
        "recipe": facts.recipe,
        "steps": facts.steps,
        "seed": facts.seed,
        "started_from": facts.started_from,
        "gpu_minutes": facts.minutes,
        "processes": facts.processes,
        "device": facts.device,
        "datasets": facts.datasets,
    }


def check_facts(card: PolicyCard, checkpoint: ActCheckpoint) -> None:
    """Refuse a card of another training; the weights are not compared.

    Raises:
        InputError: A task is none of the checkpoint's, or a field differs; the message names the card and the field.
    """
    path, facts = checkpoint.folder / CARD_FILE, checkpoint.facts
    stray = [task for task in card.tasks if facts.task_vector and task not in facts.task_vector]
    if stray:
        raise InputError(f"{path}: tasks names {stray[0]}, which its task vector lacks")
    for name, value in training_entries(facts).items():
        declared = getattr(card, name)
        if declared != value:
            raise InputError(f"{path}: {name} is {declared!r:.80}, but {FACTS_FILE} has {value!r:.80}; {REMEDY}")


def check_weights(card: PolicyCard, checkpoint: ActCheckpoint) -> None:
    """Refuse a card of other weights, or of files of another size.

    Raises:
        InputError: They differ; the message names the card and the field.
    """
    path = checkpoint.folder / CARD_FILE
    if card.weights != checkpoint.digest:
        held = f"{WEIGHTS_NAME} has {checkpoint.digest!r}"
        raise InputError(f"{path}: weights is {card.weights!r:.40}, but {held}; {REMEDY}")
    size = sum((checkpoint.folder / name).stat().st_size for name in set(checkpoint.files))
    if card.bytes != size:
        raise InputError(f"{path}: bytes is {card.bytes}, but the files next to it have {size}; {REMEDY}")
