"""What a batch of worlds must know of the policy that plays in it; a checkpoint of ours says it itself."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lerobot.configs import parser

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE, FACTS_FILE, CheckpointFacts

__all__ = ["PolicyWorlds", "policy_worlds"]


@dataclass(frozen=True)
class PolicyWorlds:
    """How a policy's pictures and actions are meant."""

    labels: str = "v3.1"
    """Label protocol of its actions, v3.1 or v4."""
    realign: float = 0.0
    """Of v4: fraction of the gap between commanded and measured heading that is closed each tick."""
    look_ticks: int = 20
    """Of v4: ticks between two looks of the policy, at which the heading is measured."""
    task_vector: tuple[str, ...] = ()
    """Tasks in the order of the one-hot vector that the policy is given; none: it is given no such vector."""
    width: int = 224
    """Width of its pictures [px]."""
    height: int = 224
    """Height of its pictures [px]."""
    fit: Literal["native", "pad"] = "pad"
    """How the camera's 4:3 picture goes into that size, as in `CameraConfig`."""
    source: Path | None = None
    """File that says so; None: these are the defaults of what says nothing."""

    @property
    def sentence(self) -> str:
        """The values, as flags of the environment."""
        flags = {"labels": self.labels, "image_width": self.width, "image_height": self.height, "fit": self.fit}
        if self.labels == "v4":
            flags |= {"realign": self.realign, "look_ticks": self.look_ticks}
        if self.task_vector:
            flags["task_vector"] = ",".join(self.task_vector)
        return " ".join(f"--env.{name}={value}" for name, value in flags.items())


def policy_worlds() -> PolicyWorlds:
    """What the policy of LeRobot's flag `--policy.path` says; defaults without one, or where it is none of ours.

    Raises:
        InputError: A file of the checkpoint is damaged.
    """
    given = parser.get_path_arg("policy")
    folder = Path(given) if given else None
    facts = CheckpointFacts.read(folder) if folder is not None and folder.is_dir() else None
    if folder is None or facts is None:
        return PolicyWorlds()
    camera = facts.camera
    return PolicyWorlds(
        labels=facts.labels,
        realign=facts.realign,
        look_ticks=_look_ticks(folder / CONFIG_FILE),
        task_vector=facts.task_vector,
        width=camera.width,
        height=camera.height,
        fit=camera.fit,
        source=folder / FACTS_FILE,
    )


def _look_ticks(path: Path) -> int:
    """Ticks between two looks, by LeRobot's flags of the policy where they change them."""
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({error})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds {type(content).__name__}, expected an object")
    values: dict[str, object] = {}
    for name in ("n_action_steps", "temporal_ensemble_coeff"):
        flag = parser.parse_arg(f"policy.{name}")
        values[name] = content.get(name) if flag is None else flag
    if values["temporal_ensemble_coeff"] not in (None, "null", "None"):
        return 1  # LeRobot's ensembling looks at every tick
    try:
        return int(str(values["n_action_steps"]))
    except ValueError:
        raise InputError(f"{path}: n_action_steps is {values['n_action_steps']!r:.40}, expected a number") from None
