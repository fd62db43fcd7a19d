"""Facts about the policy that a batch of worlds needs; a checkpoint of ours holds them itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import parser
from lerobot.utils.constants import OBS_IMAGES

from arena_newton.errors import InputError
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.files.stored_json import read_object
from arena_newton.pictures.settings import CAMERAS, FRONT, CameraConfig, recorded_camera

__all__ = ["PolicyWorlds", "policy_worlds"]


@dataclass(frozen=True)
class PolicyWorlds:
    """Meaning of a policy's pictures and actions."""

    labels: str = "v3.1"
    """Label protocol of its actions, v3.1 or v4."""
    realign: float = 0.0
    """Fraction of the gap between commanded and measured heading that v4 closes each tick."""
    query_ticks: int = 20
    """Ticks between two queries of the policy, at which v4 measures the heading."""
    task_vector: tuple[str, ...] = ()
    """Tasks in the order of the one-hot vector that the policy is given; none: it is given no such vector."""
    tracker_vector: tuple[str, ...] = ()
    """Trackers in the order of the numbers that follow, as of `CheckpointFacts`."""
    cameras: Mapping[str, CameraConfig] = field(default_factory=lambda: {FRONT: CameraConfig()})
    """Its pictures, by camera."""
    source: Path | None = None
    """File that says so; None: these are the defaults of what says nothing."""

    @property
    def sentence(self) -> str:
        """The values, as flags of the environment."""
        first = next(iter(self.cameras.values()))
        flags = {"labels": self.labels, "image_width": first.width, "image_height": first.height, "fit": first.fit}
        if [*self.cameras] != [FRONT]:
            flags["cameras"] = ",".join(self.cameras)
        if self.labels == "v4":
            flags |= {"realign": self.realign, "query_ticks": self.query_ticks}
        for name in ("task_vector", "tracker_vector"):
            if getattr(self, name):
                flags[name] = ",".join(getattr(self, name))
        return " ".join(f"--env.{name}={value}" for name, value in flags.items())


def policy_worlds() -> PolicyWorlds:
    """Facts of the policy of LeRobot's flag `--policy.path`; defaults without one that is a folder.

    Of a checkpoint without `arena_policy.json`, such as one of `lerobot-train`, the size of its pictures is known.

    Raises:
        InputError: A file of the checkpoint is damaged.
    """
    given = parser.get_path_arg("policy")
    if not given:
        return PolicyWorlds()
    # Loads Warp: a help, or a check of the flags without a policy, does not wait for it.
    from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE, FACTS_FILE, CheckpointFacts

    if not (Path(given) / CONFIG_FILE).is_file():
        return PolicyWorlds()
    path = Path(given) / CONFIG_FILE
    content = read_object(path, MAX_CONFIG_BYTES)
    facts, ticks = CheckpointFacts.read(path.parent), _query_ticks(path, content)
    fit = None if facts is None else facts.camera.fit
    cameras = {name: recorded_camera(name, *size, fit) for name, size in _pictures(path, content).items()}
    if facts is None:
        return PolicyWorlds(query_ticks=ticks, cameras=cameras or PolicyWorlds().cameras, source=path)
    return PolicyWorlds(
        labels=facts.labels,
        realign=facts.realign,
        query_ticks=ticks,
        task_vector=facts.task_vector,
        tracker_vector=facts.tracker_vector,
        cameras=cameras or {FRONT: facts.camera},
        source=path.with_name(FACTS_FILE),
    )


def _pictures(path: Path, content: Mapping[str, object]) -> dict[str, tuple[int, int]]:
    """Width and height of the pictures of each camera that a policy names [px]."""
    inputs = content.get("input_features")
    found = {}
    for name in CAMERAS:
        feature = inputs.get(f"{OBS_IMAGES}.{name}") if isinstance(inputs, dict) else None
        if feature is None:
            continue
        shape = feature.get("shape") if isinstance(feature, dict) else None
        if (
            not isinstance(shape, list)
            or len(shape) != 3
            or not all(isinstance(n, int) and 1 <= n <= 4096 for n in shape)
        ):
            raise InputError(f"{path}: input {OBS_IMAGES}.{name} has shape {shape!r:.40}, expected [3, height, width]")
        found[name] = shape[2], shape[1]
    return found


def _query_ticks(path: Path, content: Mapping[str, object]) -> int:
    """Ticks between two queries, by LeRobot's flags of the policy where they change them."""
    values: dict[str, object] = {}
    for name in ("n_action_steps", "temporal_ensemble_coeff"):
        flag = parser.parse_arg(f"policy.{name}")
        values[name] = content.get(name) if flag is None else flag
    if values["temporal_ensemble_coeff"] not in (None, "null", "None"):
        return 1  # LeRobot's ensembling looks at every tick
    if values["n_action_steps"] is None:
        return 1
    try:
        return int(str(values["n_action_steps"]))
    except ValueError:
        raise InputError(f"{path}: n_action_steps is {values['n_action_steps']!r:.40}, expected a number") from None
