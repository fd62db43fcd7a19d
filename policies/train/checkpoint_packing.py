"""Packing of a trained checkpoint into the form in which a policy ships: half precision, a card, at most 32 MB.

What is written is still a checkpoint that a stock LeRobot loads. Matrices are stored in float16, vectors (statistics of
batches among them, whose variances can exceed float16's range) in float32; both loaders compute in float32.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save

from arena_newton.cli.flags import shell_command, typed
from arena_newton.errors import InputError
from arena_newton.files.own_files import PARTIAL
from arena_newton.files.untrusted_files import create
from arena_newton.policies.learned.card_check import training_entries
from arena_newton.policies.learned.learned_card import CARD_FILE, CARD_PAGE, PolicyCard, read_card
from arena_newton.policies.learned.packed_checkpoint import (
    PROCESSOR_FILES,
    WEIGHTS_NAME,
    ActCheckpoint,
    loaded_network,
    read_act_checkpoint,
    read_weights,
)
from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE, FACTS_FILE, CheckpointFacts
from arena_newton.policies.train.policy_options import PolicyTrainOptions

__all__ = ["MOST_BYTES", "changed_looks", "half_weights", "pack", "packed_digest", "training_command"]

MOST_BYTES = 32_000_000
"""Largest size of a packed policy, card included [bytes]."""
MIN_HALF_DIMS = 2
"""Tensors with fewer dimensions stay in float32: all together they are less than a hundredth of a network."""
LATENT = "model.vae_encoder"
"""Name prefix of weights that only training uses."""
PRIVATE = {"device": "cpu", "repo_id": None, "pretrained_path": None, "use_vae": False}
"""Fields of `config.json` that say where it was trained, and of what is left out of the file."""
UNTOLD = ("out", "resume", "device", "log_every", "save_every", "keep", "jobs", "quiet")
"""Flags of a training that its result does not depend on."""


def half_weights(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights as they are packed; those of the latent's encoder are left out.

    Raises:
        InputError: A weight is too large for float16.
    """
    packed = {}
    for name, value in weights.items():
        if name.startswith(LATENT):
            continue
        stored = value.to(torch.float16 if value.dim() >= MIN_HALF_DIMS else torch.float32)
        if not bool(torch.isfinite(stored).all()):
            raise InputError(f"{WEIGHTS_NAME}: {name} has a weight that does not fit into float16")
        packed[name] = stored.contiguous()
    return packed


def _file(packed: Mapping[str, torch.Tensor]) -> bytes:
    return save(dict(packed), metadata={"format": "pt"})


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]


def packed_digest(folder: Path) -> str:
    """First 12 hex digits of the SHA-256 of the weights that a checkpoint would be packed to."""
    return _digest(_file(half_weights(read_weights(folder / WEIGHTS_NAME))))


def pack(folder: Path, out: Path, card: PolicyCard) -> PolicyCard:
    """Write the packed form of a checkpoint.

    Args:
        folder: The checkpoint, with `config.json`.
        out: New, empty, or an earlier packed policy, which is replaced.
        card: With what the checkpoint itself does not say: tasks, results, commands, note.

    Returns:
        The whole card.

    Raises:
        InputError: It is no ACT of ours, it is too large, a task is not one of its own, or the folder cannot be
            written.
    """
    checkpoint = read_act_checkpoint(folder)
    facts = checkpoint.facts
    known = facts.task_vector or facts.tasks
    for task in card.tasks:
        if known and task not in known:
            raise InputError(f"--tasks {task}: the checkpoint was trained on {', '.join(known)}")
    if len(known) > 1 and not facts.task_vector:
        raise InputError(
            f"{folder}: was trained on {len(known)} tasks without a task vector, so it cannot tell them apart"
        )
    packed = half_weights(read_weights(folder / WEIGHTS_NAME))
    _try(checkpoint, packed)
    weights = _file(packed)
    files = _small_files(checkpoint) | {WEIGHTS_NAME: weights}
    card = dataclasses.replace(
        card,
        weights=_digest(weights),
        bytes=sum(map(len, files.values())),
        **training_entries(facts),  # type: ignore[arg-type]  # each is of its field's kind
    )
    files |= {CARD_PAGE: card.to_markdown().encode(), CARD_FILE: card.to_json().encode()}
    size = sum(map(len, files.values()))
    if size > MOST_BYTES:
        raise InputError(
            f"{folder}: {size / 1e6:.1f} MB in half precision, at most {MOST_BYTES / 1e6:.0f} are shipped; "
            "train it with --recipe compact"
        )
    _write(out, files)
    read_act_checkpoint(out).network()
    return read_card(out)


def _try(checkpoint: ActCheckpoint, weights: dict[str, torch.Tensor]) -> None:
    """Refuse weights that do not fit the network, or whose answer in half precision is not finite."""
    network = loaded_network(checkpoint.folder / WEIGHTS_NAME, checkpoint.sizes, weights)
    facts, sizes = checkpoint.facts, checkpoint.sizes
    task = torch.zeros(1, sizes.tasks) if sizes.tasks else None
    with torch.inference_mode():
        answer = network(torch.zeros(1, 3, facts.height, facts.width), torch.zeros(1, sizes.state), task)
    if not bool(torch.isfinite(answer).all()):
        raise InputError(f"{checkpoint.folder / WEIGHTS_NAME}: its answer in half precision is not finite")


def _small_files(checkpoint: ActCheckpoint) -> dict[str, bytes]:
    """Content of all files but the weights'; what names the machine of the training is taken out."""
    folder = checkpoint.folder
    files = {name: (folder / name).read_bytes() for name in checkpoint.files if name != WEIGHTS_NAME}
    config = json.loads(files[CONFIG_FILE])
    files[CONFIG_FILE] = (
        json.dumps(config | {k: v for k, v in PRIVATE.items() if k in config}, indent=2) + "\n"
    ).encode()
    for name in PROCESSOR_FILES:  # a stock LeRobot fails to load steps on a device that a machine lacks
        content = json.loads(files[name])
        for step in content["steps"]:
            if "device" in (step.get("config") or {}):
                step["config"]["device"] = PRIVATE["device"]
        files[name] = (json.dumps(content, indent=2) + "\n").encode()
    facts = json.loads(files[FACTS_FILE]) | {"options": {}}
    files[FACTS_FILE] = (json.dumps(facts, indent=2, sort_keys=True) + "\n").encode()
    return files


def _write(out: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder; an earlier packed policy stays whole until all that replaces it is on the disk.

    Raises:
        InputError: The folder holds something else, or cannot be written.
    """
    before = _packed_files(out)
    staged = {name: out / f"{name}{PARTIAL}" for name in files}
    try:
        out.mkdir(parents=True, exist_ok=True)
        try:
            for name, content in files.items():
                if (out / name).is_dir():
                    raise InputError(f"--out {out}: {name} is a folder; choose another one")
                with create(staged[name]) as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
            (out / CARD_FILE).unlink(missing_ok=True)  # without which the folder is no policy
            for name in sorted(files, key=lambda name: name == CARD_FILE):
                os.replace(staged[name], out / name)
        finally:
            for path in staged.values():
                with contextlib.suppress(OSError):
                    path.unlink(missing_ok=True)
        for name in sorted(before - set(files)):
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from None


def _packed_files(out: Path) -> set[str]:
    """Names of the files of the packed policy in a folder; none in a new or an empty one.

    Raises:
        InputError: The folder holds something else.
    """
    try:
        if not out.exists() or (out.is_dir() and not any(out.iterdir())):
            return set()
    except OSError as error:
        raise InputError(f"--out {out}: cannot be read ({error.strerror})") from None
    if not out.is_dir():
        raise InputError(f"--out {out}: is a file; name a folder")
    try:
        read_card(out)
        return {CARD_FILE, CARD_PAGE, *read_act_checkpoint(out).files}
    except InputError as error:
        raise InputError(
            f"--out {out}: is not empty and holds no packed policy; choose another folder ({error})"
        ) from None


def changed_looks(facts: CheckpointFacts) -> tuple[str, ...]:
    """Fraction of a training's samples whose looks were changed and those of single tasks, as typed; empty: none."""
    flags = facts.options.get("flags")
    return tuple(map(str, flags.get("looks") or ())) if isinstance(flags, dict) else ()


def training_command(facts: CheckpointFacts) -> str:
    """The command of a training from what its checkpoint says of its flags, paths shortened to their names."""
    flags = facts.options.get("flags")
    if not isinstance(flags, dict):
        return ""
    words: list[str] = []
    for one in dataclasses.fields(PolicyTrainOptions):
        value = flags.get(one.name)
        default = list(one.default) if isinstance(one.default, tuple) else one.default
        if one.name in UNTOLD or value is None or (value == default and one.name not in ("policy", "recipe")):
            continue
        if one.name in ("dataset", "weights", "start_from"):
            value = [Path(str(path)).name for path in (value if isinstance(value, list) else [value])]
        words += typed(one.name, value)
    command = shell_command("arena_newton.policies.train", *words)
    torchrun = f"torchrun --nproc-per-node {facts.processes} -m "
    return command.replace("python -m ", torchrun, 1) if facts.processes > 1 else command
