"""Checkpoints of a training: LeRobot's folders, whole or not there at all, and what a resumed training needs.

`<out>/checkpoints/<step>/pretrained_model` is the policy, `training_state` next to it LeRobot's files of optimizer,
random numbers and step, and one of ours; `<out>/checkpoints/last` is a relative link. A folder grows under a temporary
name and is renamed when all of it is on the disk: whatever kills a training leaves the last whole checkpoint.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    OPTIMIZER_PARAM_GROUPS,
    OPTIMIZER_STATE,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
    TRAINING_STEP,
)
from lerobot.utils.random_utils import save_rng_state
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from arena_newton.errors import InputError
from arena_newton.files.own_files import PARTIAL, replace_atomically
from arena_newton.files.stored_json import Fit, loaded, read_object
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.train.policy_trainer import PolicyTrainer

__all__ = [
    "PROGRESS_FILE",
    "TrainingProgress",
    "check_new",
    "checkpoint_name",
    "last_checkpoint",
    "put_weights",
    "read_tensors",
    "remove_older",
    "restore",
    "write_checkpoint",
]

PROGRESS_FILE = "arena_training.json"
"""File of a training state that holds its `TrainingProgress`."""
WEIGHTS = "model.safetensors"
"""LeRobot's file of a policy's weights."""
FORMAT = 1
"""Version of the file."""
FEWEST_DIGITS = 6
"""Digits of a step in a folder's name, as LeRobot writes them."""
BATCH_COUNTER = "num_batches_tracked"
"""Buffer of a batch normalization that checkpoints leave out; with a fixed momentum nothing reads it."""

MOST_BYTES = 64 << 20
"""Largest file that is read."""
FROM_0 = Fit("an integer of at least 0", lambda value: 0 <= value < 2**40)
FROM_1 = Fit("an integer of at least 1", lambda value: 1 <= value < 2**40)


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a training, and its identity."""

    step: Annotated[int, FROM_0]
    """Steps that are done."""
    steps: Annotated[int, FROM_0]
    """Steps at which the schedule ends; 0 while --minutes has not fixed them."""
    minutes: Annotated[float, Fit("a time", lambda value: 0.0 <= value < 1e9)]
    """Time of the optimization so far [min]."""
    processes: Annotated[int, FROM_1]
    """Processes that trained."""
    batch_size: Annotated[int, FROM_1]
    """Samples of a step, of each process."""
    options: Mapping[str, object] = field(default_factory=dict)
    """Flags by the names of `PolicyTrainOptions`."""
    datasets: tuple[Mapping[str, object], ...] = ()
    """Datasets as in `CheckpointFacts`."""

    @classmethod
    def read(cls, folder: Path) -> TrainingProgress:
        """Progress of a checkpoint.

        Raises:
            InputError: The file is absent or damaged.
        """
        path = folder / TRAINING_STATE_DIR / PROGRESS_FILE
        if not path.is_file():
            raise InputError(f"{path}: is missing; the checkpoint is of no training that can go on")
        return loaded(str(path), read_object(path, MOST_BYTES, FORMAT), cls)

    def write(self, folder: Path) -> None:
        """Write the file of a checkpoint."""
        text = json.dumps({"format": FORMAT} | dataclasses.asdict(self), indent=2, sort_keys=True, default=str) + "\n"
        with replace_atomically(folder / TRAINING_STATE_DIR / PROGRESS_FILE) as file:
            file.write(text.encode())


def checkpoint_name(step: int) -> str:
    """Name of the folder of a step."""
    return f"{step:0{FEWEST_DIGITS}d}"


def check_new(out: Path) -> None:
    """Refuse a folder that holds checkpoints.

    Raises:
        InputError: It does.
    """
    if any(one.name.isdecimal() for one in out.glob(f"{CHECKPOINTS_DIR}/*")):
        raise InputError(f"--out {out}: holds a training already; --resume {out} goes on with it")


def last_checkpoint(out: Path, flag: str = "--resume") -> Path:
    """The last whole checkpoint of a training.

    Raises:
        InputError: There is none.
    """
    named = [one for one in (out / CHECKPOINTS_DIR).glob("*") if one.name.isdecimal()]
    for folder in sorted(named, key=lambda one: int(one.name), reverse=True):
        if (folder / TRAINING_STATE_DIR).is_dir() and (folder / PRETRAINED_MODEL_DIR).is_dir():
            return folder
    raise InputError(
        f"{flag} {out}: holds no checkpoint of a training (no {CHECKPOINTS_DIR}/<step>/{TRAINING_STATE_DIR})"
    )


def write_checkpoint(out: Path, trainer: PolicyTrainer, facts: CheckpointFacts, progress: TrainingProgress) -> Path:
    """Write a checkpoint of the current step, and let `last` lead to it.

    Returns:
        Its folder, `<out>/checkpoints/<step>`.

    Raises:
        InputError: It cannot be written.
    """
    parent = out / CHECKPOINTS_DIR
    final = parent / checkpoint_name(progress.step)
    growing = parent / f"{final.name}{PARTIAL}"
    try:
        shutil.rmtree(growing, ignore_errors=True)
        state = growing / TRAINING_STATE_DIR
        state.mkdir(parents=True)
        trainer.model.save(growing / PRETRAINED_MODEL_DIR, facts)
        _say_final_paths(growing, final)
        _write_optimizer(trainer.optimizer, state)
        save_rng_state(state)
        step = {"step": progress.step, "num_processes": progress.processes, "batch_size": progress.batch_size}
        (state / TRAINING_STEP).write_text(json.dumps(step, indent=4))
        progress.write(growing)
        for file in [one for one in growing.rglob("*") if one.is_file()]:
            _synced(file)
        if final.is_dir():  # the same step, written just before an interruption: it is whole
            shutil.rmtree(growing)
        else:
            growing.rename(final)
        _synced(parent)
        link = parent / f"{LAST_CHECKPOINT_LINK}{PARTIAL}"
        link.unlink(missing_ok=True)
        link.symlink_to(final.name)
        os.replace(link, parent / LAST_CHECKPOINT_LINK)
    except (OSError, SafetensorError) as error:  # safetensors says a full disk in an error of its own
        shutil.rmtree(growing, ignore_errors=True)
        reason = (error.strerror if isinstance(error, OSError) else None) or " ".join(str(error).split())[:160]
        raise InputError(f"{final}: the checkpoint cannot be written ({reason})") from error
    return final


def remove_older(out: Path, keep: int) -> None:
    """Remove all but the latest checkpoints, and what killed trainings left; 0 keeps all of them."""
    folder = out / CHECKPOINTS_DIR
    for left in folder.glob(f"*{PARTIAL}"):
        shutil.rmtree(left, ignore_errors=True)
    if keep:
        whole = sorted((one for one in folder.glob("*") if one.name.isdecimal()), key=lambda one: int(one.name))
        for old in whole[:-keep]:
            shutil.rmtree(old, ignore_errors=True)


def restore(trainer: PolicyTrainer, checkpoint: Path) -> None:
    """Put weights, moments and step of a checkpoint into a trainer.

    Raises:
        InputError: A file is absent, damaged or of another network.
    """
    put_weights(trainer.model.policy, checkpoint / PRETRAINED_MODEL_DIR / WEIGHTS)
    _read_optimizer(trainer.optimizer, checkpoint / TRAINING_STATE_DIR)
    trainer.step = TrainingProgress.read(checkpoint).step


def put_weights(
    policy: torch.nn.Module,
    path: Path,
    fit: Callable[[dict[str, torch.Tensor], dict[str, torch.Tensor]], None] | None = None,
) -> None:
    """Put the weights of a file into a policy, all of them.

    Args:
        fit: Changes the file's tensors, given them and the policy's own.

    Raises:
        InputError: The file is absent, damaged or of another network.
    """
    weights, own = read_tensors(path), policy.state_dict()
    if fit is not None:
        fit(weights, own)
    tied = {tensor.data_ptr() for name, tensor in own.items() if name in weights}
    missing = [
        name
        for name, tensor in own.items()
        if name not in weights and not name.endswith(BATCH_COUNTER) and tensor.data_ptr() not in tied
    ]
    unknown = sorted(set(weights) - set(own))
    unlike = [name for name in own if name in weights and own[name].shape != weights[name].shape]
    for names, words in ((missing, "lacks"), (unknown, "has unknown"), (unlike, "has another shape of")):
        if names:
            raise InputError(f"{path}: {words} {names[0]}")
    for name, tensor in weights.items():
        if not bool(torch.isfinite(tensor).all()):
            raise InputError(f"{path}: {name} has numbers that are not finite")
    with torch.no_grad():
        for name, tensor in weights.items():
            own[name].copy_(tensor)


def _say_final_paths(growing: Path, final: Path) -> None:
    """Let a policy's files name the folder that will be: those of some families say where their encoders lie."""
    before, after = (json.dumps(str(folder.resolve()))[1:-1] for folder in (growing, final))
    for file in (growing / PRETRAINED_MODEL_DIR).glob("*.json"):
        text = file.read_text()
        if before in text:
            file.write_text(text.replace(before, after))


def _write_optimizer(optimizer: torch.optim.Optimizer, folder: Path) -> None:
    """Moments and settings in LeRobot's files."""
    content = optimizer.state_dict()
    flat = {
        f"state/{number}/{name}": tensor.detach().cpu().contiguous()
        for number, state in content["state"].items()
        for name, tensor in state.items()
    }
    save_file(flat, folder / OPTIMIZER_STATE)
    groups = [{name: _plain(value) for name, value in group.items()} for group in content["param_groups"]]
    (folder / OPTIMIZER_PARAM_GROUPS).write_text(json.dumps(groups, indent=4))


def _plain(value: object) -> object:
    """A setting of the optimizer as JSON."""
    return float(value) if isinstance(value, torch.Tensor) else value


def _read_optimizer(optimizer: torch.optim.Optimizer, folder: Path) -> None:
    path = folder / OPTIMIZER_STATE
    own = optimizer.state_dict()
    parameters = {
        number: parameter
        for group, stored in zip(optimizer.param_groups, own["param_groups"], strict=True)
        for number, parameter in zip(stored["params"], group["params"], strict=True)
    }
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in read_tensors(path).items():
        parts = name.split("/")
        if len(parts) != 3 or parts[0] != "state" or not parts[1].isdigit() or int(parts[1]) not in parameters:
            raise InputError(f"{path}: {name[:80]} is no moment of this network's optimizer")
        number = int(parts[1])
        if tensor.dim() and tensor.shape != parameters[number].shape:
            raise InputError(f"{path}: {name[:80]} has shape {list(tensor.shape)}, another network's")
        # In the memory format of its parameter, as fused optimizers need it; a file has one format only.
        state.setdefault(number, {})[parts[2]] = (
            torch.empty_like(parameters[number], dtype=tensor.dtype).copy_(tensor) if tensor.dim() else tensor
        )
    # Settings are the recipe's: learning rates follow from the step.
    optimizer.load_state_dict({"state": state, "param_groups": own["param_groups"]})


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Tensors of a file.

    Raises:
        InputError: It is absent or damaged.
    """
    try:
        return load_file(path)
    except FileNotFoundError:
        raise InputError(f"{path}: is missing") from None
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: not a readable safetensors file ({' '.join(str(error).split())[:120]})") from None


def _synced(path: Path) -> None:
    """Wait until a file or a folder's entries are on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
