"""A checkpoint of LeRobot as it is on disk: read and checked before its network is built.

Only JSON and safetensors are read: nothing of a checkpoint is code, and pickles in it are left alone. Its processors
are steps of LeRobot by their registered names, of those that a policy of our families can have.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import draccus
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig

from arena_newton.cli.extras import require
from arena_newton.errors import InputError
from arena_newton.files.stored_json import read_object
from arena_newton.files.untrusted_files import check_size, file_digest
from arena_newton.pictures.settings import CAMERAS, CameraConfig, Fit, recorded_camera
from arena_newton.policies.lerobot.checkpoint_facts import (
    CONFIG_FILE,
    FACTS_FILE,
    NORMALISES,
    CheckpointFacts,
    checkpoint_folder,
)
from arena_newton.policies.lerobot.checkpoint_tensors import check_family, check_layers, check_statistics
from arena_newton.policies.lerobot.picture_preparation import MOST_JSON, PicturePreparation
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

__all__ = [
    "FAMILY_TYPES",
    "IMAGES",
    "PROCESSORS",
    "STATE",
    "TASK_VECTOR",
    "WEIGHTS",
    "PolicyCheckpoint",
    "lerobot_silent",
    "read_checkpoint",
]

IMAGES = "observation.images."
"""Beginning of the key of a camera's picture, before its name (`pictures.settings.CAMERAS`)."""
STATE = "observation.state"
"""Key of the canonical state."""
TASK_VECTOR = "observation.environment_state"
"""Key of the one-hot vector of the task."""
WEIGHTS = "model.safetensors"
"""File of a checkpoint's weights."""
MOST_WEIGHTS = 64 * 2**30
"""Largest file of weights that is read [bytes]; pi0.5 in float32 has 15 GB."""
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
"""Files of what comes before and after the network."""
FAMILY_TYPES: Mapping[str, str] = {"act": "act", "diffusion": "diffusion", "multi_task_dit": "flow", "pi05": "pi05"}
"""LeRobot's type of policy → our name of the family; those that can be run."""
EXTRA_MODULES: Mapping[str, tuple[str, ...]] = {
    "diffusion": ("diffusers",),
    "multi_task_dit": ("diffusers", "transformers"),
    "pi05": ("transformers",),
}
"""LeRobot's type of policy → modules of the extra `policies` that it needs."""
STEPS = frozenset(
    {
        "absolute_actions_processor",
        "device_processor",
        "normalizer_processor",
        "pi05_prepare_state_tokenizer_processor_step",
        "relative_actions_processor",
        "rename_observations_processor",
        "to_batch_processor",
        "tokenizer_processor",
        "unnormalizer_processor",
    }
)
"""Processor steps that a checkpoint may name; all are LeRobot's own and run no code of the checkpoint."""
DEVICE_STEP = "device_processor"
"""Step that every processor of LeRobot's policies has."""
NATIVE = (640, 480)
"""Width and height of the head camera's picture in the original [px]."""


@dataclass(frozen=True)
class PolicyCheckpoint:
    """Contents of a checkpoint, checked."""

    folder: Path
    """Folder with `config.json`."""
    config: PreTrainedConfig
    """LeRobot's configuration of the policy; nothing in it makes LeRobot download or compile."""
    facts: CheckpointFacts
    """Facts that it gives; a foreign one gets actions of v3.1."""
    cameras: Mapping[str, CameraConfig]
    """Pictures that are rendered, by the names of their cameras; none for a policy without pictures."""
    preparation: PicturePreparation | None
    """Preparation of pictures before LeRobot's processors, in checkpoints of the original."""
    digest: str
    """First 12 hex digits of the SHA-256 of the weights."""
    ignored: tuple[str, ...] = ()
    """Fields of its `config.json` that this LeRobot does not have."""

    @property
    def type(self) -> str:
        """LeRobot's type of policy."""
        return str(self.config.type)

    @property
    def observations(self) -> int:
        """Ticks that the policy looks at: this one and those before it."""
        return int(self.config.n_obs_steps)

    @property
    def predicted(self) -> int:
        """Actions of an answer of the network, from this tick on."""
        chunk = getattr(self.config, "chunk_size", None)
        return int(self.config.n_action_steps if chunk is None else chunk)

    @property
    def executed(self) -> int:
        """Actions of an answer that are executed before the next query."""
        return int(self.config.n_action_steps)


@contextmanager
def lerobot_silent() -> Iterator[None]:
    """Keeps LeRobot from warning about a device that only its training had."""
    root = logging.getLogger()
    disabled = root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(disabled)


def read_checkpoint(path: Path) -> PolicyCheckpoint:
    """Read a checkpoint, or the last one of a training's folder, without its weights.

    Raises:
        InputError: There is none, a file is damaged, or it was trained for other observations or actions; the message
            names file and field.
    """
    folder = checkpoint_folder(path)
    if not (folder / WEIGHTS).is_file():
        raise InputError(f"{folder}: holds no {WEIGHTS}; weights in other files, such as pickles, are not read")
    check_size(folder / WEIGHTS, MOST_WEIGHTS)
    content = read_object(folder / CONFIG_FILE, MOST_JSON)
    kind = content.pop("type", None)
    known = PreTrainedConfig.get_known_choices()
    if not isinstance(kind, str) or kind not in known:
        names = ", ".join(sorted(FAMILY_TYPES))
        raise InputError(f"{folder / CONFIG_FILE}: type is {kind!r:.60}, which LeRobot does not have; run are {names}")
    if kind not in FAMILY_TYPES:
        names = ", ".join(sorted(FAMILY_TYPES))
        raise InputError(f"{folder / CONFIG_FILE}: type {kind} is not run here, expected one of {names}")
    if content.get("use_peft"):
        raise InputError(f"{folder / CONFIG_FILE}: use_peft is set; merge the adapter into the weights first")
    if kind in EXTRA_MODULES:
        require("policies", f"--policy lerobot:{path}", EXTRA_MODULES[kind])
    config, ignored = _configuration(folder / CONFIG_FILE, kind, content)
    own = CheckpointFacts.read(folder)
    facts = own or CheckpointFacts(family=FAMILY_TYPES[kind])
    renamed = _processors(folder, config)
    pictures = _features(folder, config, facts, own is not None, renamed)
    preparation = PicturePreparation.read(folder) if pictures and own is None else None
    fit = None if own is None else facts.camera.fit
    cameras = {name: _camera(name, size, preparation, fit) for name, size in pictures.items()}
    check_family(folder / WEIGHTS, kind)
    check_layers(folder / WEIGHTS, kind, config)
    digest = file_digest(folder / WEIGHTS, MOST_WEIGHTS)
    return PolicyCheckpoint(folder, config, facts, cameras, preparation, digest, ignored)


def _configuration(path: Path, kind: str, content: Mapping[str, object]) -> tuple[PreTrainedConfig, tuple[str, ...]]:
    """LeRobot's configuration, and the fields that it does not know: those of the original's fork, or of later ones."""
    chosen = PreTrainedConfig.get_choice_class(kind)
    known = {field.name for field in dataclasses.fields(chosen)}
    # A training's device, pretrained weights and compilation mean nothing here; the first two would be looked for.
    fixed = {"device": "cpu", "pretrained_backbone_weights": None, "pretrained_path": None, "compile_model": False}
    fixed |= {"gradient_checkpointing": False, "push_to_hub": False, "use_amp": False}
    kept = {name: value for name, value in content.items() if name in known and name not in fixed}
    kept |= {name: value for name, value in fixed.items() if name in known}
    with lerobot_silent():
        try:
            config = draccus.decode(chosen, kept)
            config.validate_features()
        except Exception as error:  # draccus has errors of many kinds
            raise InputError(f"{path}: {_reason(error)}") from None
    for one in dataclasses.fields(config):
        value = getattr(config, one.name)
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{path}: {one.name} is {value}, expected a finite number")
    for name, most in (("n_obs_steps", 16), ("n_action_steps", 4096), ("chunk_size", 4096)):
        value = getattr(config, name, 1)
        if not isinstance(value, int) or not 1 <= value <= most:
            raise InputError(f"{path}: {name} is {value!r:.40}, expected 1 to {most}")
    return config, tuple(sorted(set(content) - known))


def _reason(error: BaseException) -> str:
    """Message of an error and of its cause, which draccus leaves out."""
    text = " ".join(str(error).split())[:300]
    behind = " ".join(str(error.__cause__ or error.__context__ or "").split())[:200]
    return text if not behind or behind in text else f"{text} ({behind})"


def _processors(folder: Path, config: PreTrainedConfig) -> dict[str, str]:
    """Check the processors' files; returns how observations are renamed, from our name to the network's."""
    renamed: dict[str, str] = {}
    for name in PROCESSORS:
        path = folder / name
        if not path.is_file():
            raise InputError(
                f"{folder}: holds no {name}; LeRobot's migrate_policy_normalization.py makes one for old checkpoints"
            )
        steps = read_object(path, MOST_JSON).get("steps")
        if not isinstance(steps, list):
            raise InputError(f"{path}: steps is {type(steps).__name__}, expected a list")
        for index, step in enumerate(steps):
            where = f"{path}: steps[{index}]"
            registered = step.get("registry_name") if isinstance(step, dict) else None
            if not isinstance(registered, str) or registered not in STEPS or "class" in step:
                raise InputError(f"{where} is {registered!r:.60}, expected one of {', '.join(sorted(STEPS))}")
            options = step.get("config") or {}
            if not isinstance(options, dict) or options.get("trust_remote_code"):
                raise InputError(f"{where}.config is not an object of plain options")
            state = step.get("state_file")
            if registered in NORMALISES:
                _check_normaliser(where, options, state, config)
            if state is not None:
                if not isinstance(state, str) or Path(state).name != state or not state.endswith(".safetensors"):
                    raise InputError(f"{where}.state_file is {state!r:.60}, expected a name of a safetensors file")
                check_size(folder / state, MOST_JSON)
                if registered in NORMALISES and (folder / state).is_file():
                    check_statistics(folder / state, _modes(registered, config))
            names = options.get("rename_map") or {} if registered == "rename_observations_processor" else {}
            if not isinstance(names, dict) or not all(isinstance(value, str) for value in names.values()):
                raise InputError(f"{where}.config.rename_map is not an object of names")
            renamed |= names
        if DEVICE_STEP not in (step["registry_name"] for step in steps):
            raise InputError(f"{path}: steps hold no {DEVICE_STEP}, by which its numbers come to the network's device")
    return renamed


def _check_normaliser(where: str, options: Mapping[str, object], state: object, config: PreTrainedConfig) -> None:
    """Refuse a step that would take its numbers for what they are not, or leave them as they are."""
    eps = options.get("eps", 0.0)
    if isinstance(eps, bool) or not isinstance(eps, int | float) or not 0.0 <= eps < math.inf:
        raise InputError(f"{where}.config.eps is {eps!r:.40}, expected a number of at least 0")
    facts = {kind: mode.value for kind, mode in config.normalization_mapping.items()}
    if options.get("norm_map") != facts:
        given = f"{options.get('norm_map')!r:.120}"
        raise InputError(f"{where}.config.norm_map is {given}, but {CONFIG_FILE} has normalization_mapping {facts}")
    if state is None and set(facts.values()) != {"IDENTITY"}:
        raise InputError(f"{where} names no state_file, the statistics by which it is to normalise")


def _modes(registered: str, config: PreTrainedConfig) -> dict[str, str]:
    """Features that a normalising step is used on: feature → LeRobot's mode of its kind."""
    features = (config.input_features if registered == NORMALISES[0] else config.output_features) or {}
    modes = {str(kind): mode.value for kind, mode in config.normalization_mapping.items()}
    return {name: modes.get(feature.type.value, "IDENTITY") for name, feature in features.items()}


def _features(
    folder: Path, config: PreTrainedConfig, facts: CheckpointFacts, own: bool, renamed: Mapping[str, str]
) -> dict[str, tuple[int, int]]:
    """Check observations and actions; returns height and width of the picture of each camera."""
    path = folder / CONFIG_FILE
    outputs, inputs = dict(config.output_features or {}), dict(config.input_features or {})
    action = outputs.get("action")
    if action is None or tuple(action.shape) != (ACTION_WIDTH,):
        raise InputError(f"{path}: output action is {_shape(action)}, expected [{ACTION_WIDTH}]")
    shown = {f"{IMAGES}{name}": name for name in CAMERAS}
    ours = {renamed.get(name, name): name for name in (STATE, TASK_VECTOR, *shown)}
    pictures: dict[str, tuple[int, int]] = {}
    for name, feature in inputs.items():
        given, shape = ours.get(name), tuple(feature.shape)
        if given == STATE and shape == (STATE_WIDTH,):
            continue
        if given in shown and feature.type is FeatureType.VISUAL and len(shape) == 3 and shape[0] == 3:
            pictures[shown[given]] = (int(shape[1]), int(shape[2]))
            continue
        if given == TASK_VECTOR and facts.task_vector and shape == (facts.vector_width,):
            continue
        if name.startswith("observation.images.empty_camera_") and config.type == "pi05":
            continue  # the network fills it with an empty picture itself
        if given == TASK_VECTOR:
            trackers = f" and {len(facts.tracker_vector)} trackers" if facts.tracker_vector else ""
            message = f"{FACTS_FILE} names {len(facts.task_vector)} tasks{trackers} for it"
            raise InputError(f"{path}: input {name} is {_shape(feature)}, but {message}")
        known = f"{STATE} [{STATE_WIDTH}], {TASK_VECTOR}, and of [3, height, width] {', '.join(shown)}"
        raise InputError(f"{path}: input {name} {_shape(feature)} is not observed here; what is: {known}")
    for name in (STATE, *((TASK_VECTOR,) if facts.task_vector else ())):
        if renamed.get(name, name) not in inputs:
            raise InputError(f"{path}: has no input {renamed.get(name, name)}, which every policy here is given")
    for height, width in pictures.values():
        if own and (height, width) != (facts.height, facts.width):
            text = f"{FACTS_FILE} says {facts.width}x{facts.height}"
            raise InputError(f"{path}: pictures are {width}x{height}, but {text}")
    return pictures


def _shape(feature: PolicyFeature | None) -> str:
    return "absent" if feature is None else str(list(feature.shape))


def _camera(
    name: str, picture: tuple[int, int], preparation: PicturePreparation | None, fit: Fit | None
) -> CameraConfig:
    """Camera for a policy: the picture for the original's server, or the size that the policy was trained on."""
    if preparation is not None:
        return recorded_camera(name, *NATIVE)
    height, width = picture
    if not all(16 <= n <= 4096 for n in picture):
        raise InputError(f"pictures of {width}x{height} pixels, expected 16 to 4096 each")
    return recorded_camera(name, width, height, fit)
