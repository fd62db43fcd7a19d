"""Facts of a checkpoint that LeRobot's own files lack: the meaning of its actions and its training.

A checkpoint is a folder as LeRobot writes it (`config.json`, `model.safetensors`, the processors' files), which a stock
LeRobot loads, with one more file, `arena_policy.json`. One without it is somebody else's: its actions are v3.1.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from arena_newton.data.readers.label_protocols import protocol
from arena_newton.errors import InputError, check_once
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.stored_json import Fit, loaded, read_object
from arena_newton.files.text import plain_text
from arena_newton.pictures.settings import CameraConfig

__all__ = ["CONFIG_FILE", "FACTS_FILE", "NORMALISES", "CheckpointFacts", "checkpoint_folder", "vector_of"]

FACTS_FILE = "arena_policy.json"
"""File of a checkpoint that holds its `CheckpointFacts`."""
CONFIG_FILE = "config.json"
"""File by which a folder is known to be a checkpoint of LeRobot."""
NORMALISES = ("normalizer_processor", "unnormalizer_processor")
"""Steps of LeRobot's processors with statistics."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
"""Name of a task or tracker."""
MOST_BYTES = 16 << 20
"""Largest file that is read."""
FORMAT = 1
"""Version of the file."""
INSIDE = ("pretrained_model", "checkpoints/last/pretrained_model", "last/pretrained_model")
"""Folders of a training that may hold a checkpoint, in the order of the search."""


@dataclass(frozen=True)
class CheckpointFacts:
    """Meaning of a policy's pictures and actions, and its origin."""

    labels: str = "v3.1"
    """Protocol of its actions (`data.readers.label_protocols`)."""
    realign: Annotated[float, Fit("0 to 1", lambda value: 0.0 <= value <= 1.0)] = 0.0
    """Fraction of the gap between the commanded and the measured heading that is closed each tick; of v4 only."""
    width: int = 224
    """Width of the head camera's picture [px]."""
    height: int = 224
    """Height of the head camera's picture [px]."""
    fit: Annotated[str, Fit("pad or native", lambda value: value in ("pad", "native"))] = "pad"
    """`pad` or `native`, as in `CameraConfig`."""
    task_vector: tuple[str, ...] = ()
    """Tasks in the order of the one-hot vector that the policy is given as `observation.environment_state`; none: it
    is given no such vector."""
    tracker_vector: tuple[str, ...] = ()
    """Trackers in the order of the numbers that follow those of the tasks, and one more for any other tracker; none:
    the vector says nothing of the tracker."""
    family: str = ""
    """`act`, `diffusion`, `flow`, `pi05`."""
    recipe: str = ""
    """Name of the recipe, such as `fast`."""
    tasks: tuple[str, ...] = ()
    """Tasks of its demonstrations."""
    trackers: tuple[str, ...] = ()
    """Trackers through which they were recorded."""
    steps: int = 0
    """Optimizer steps."""
    seed: int = 0
    started_from: str = ""
    """First 12 hex digits of the SHA-256 of the weights that it began with; empty: new ones."""
    minutes: Annotated[float, Fit("a time", lambda value: abs(value) < 1e12)] = 0.0
    """Time of the training [min]."""
    processes: Annotated[int, Fit("1 or more", lambda value: value >= 1)] = 1
    """Processes of the training, each with a device of its own."""
    device: str = ""
    """Device of the training, such as `NVIDIA H200`."""
    datasets: tuple[Mapping[str, object], ...] = ()
    """Datasets of the training: `name`, `hash` of its content, `episodes`, `frames` of each."""
    options: Mapping[str, object] = field(default_factory=dict)
    """The training's resolved options."""

    @property
    def vector_width(self) -> int:
        """Numbers of the vector of task and tracker; 0: the policy is given none."""
        return len(self.vector("", ""))

    def vector(self, task: str, tracker: str) -> list[float]:
        """The vector of a task and a tracker."""
        return vector_of(self.task_vector, self.tracker_vector, task, tracker)

    @property
    def camera(self) -> CameraConfig:
        """The picture that the policy wants."""
        return CameraConfig(width=self.width, height=self.height, fit="native" if self.fit == "native" else "pad")

    def write(self, folder: Path) -> None:
        """Write the file of a checkpoint."""
        text = json.dumps({"format": FORMAT} | asdict(self), indent=2, sort_keys=True) + "\n"
        with replace_atomically(folder / FACTS_FILE, sync=True) as file:
            file.write(text.encode())

    @classmethod
    def read(cls, folder: Path) -> CheckpointFacts | None:
        """Facts of a checkpoint; None where it has none of ours.

        Raises:
            InputError: The file is damaged, or of a later version.
        """
        path = folder / FACTS_FILE
        if not path.is_file():
            return None
        facts = loaded(str(path), read_object(path, MOST_BYTES, FORMAT), cls)
        if facts.tracker_vector and not facts.task_vector:
            raise InputError(f"{path}: tracker_vector is given without a task_vector, which it is a part of")
        for key in ("task_vector", "tracker_vector", "tasks", "trackers"):
            if key.endswith("vector"):
                check_once(f"{path}: {key}:", getattr(facts, key))
            for name in getattr(facts, key):
                if not _NAME.fullmatch(name):
                    raise InputError(f"{path}: {key} holds {plain_text(name, 60)!r}, which is no name")
        if not all(16 <= n <= 4096 for n in (facts.width, facts.height)):
            raise InputError(f"{path}: a picture of {facts.width}x{facts.height} pixels, expected 16 to 4096 each")
        try:
            protocol(facts.labels)
        except InputError:
            raise InputError(f"{path}: labels is {facts.labels!r}, a protocol that is not known") from None
        return facts


def vector_of(tasks: Sequence[str], trackers: Sequence[str], task: str, tracker: str) -> list[float]:
    """One-hot numbers of a task, then, where trackers are named, of a tracker.

    Args:
        tasks: In the order of their numbers.
        trackers: In the order of their numbers, after which one more is that of any other tracker.
        tracker: Name; empty: not known.
    """
    vector = [float(name == task) for name in tasks]
    if trackers:
        vector += [float(name == tracker) for name in trackers] + [float(tracker not in trackers)]
    return vector


def checkpoint_folder(path: Path, flag: str = "--policy lerobot:") -> Path:
    """The checkpoint at a path: a folder with `config.json`, or the last checkpoint of a training's folder.

    Raises:
        InputError: There is none.
    """
    if not path.is_dir():
        raise InputError(f"{flag}{path}: no such folder")
    for folder in (path, *(path / inside for inside in INSIDE)):
        if (folder / CONFIG_FILE).is_file():
            return folder
    raise InputError(f"{flag}{path}: holds no checkpoint of LeRobot (no {CONFIG_FILE}, also not in {INSIDE[1]})")
