"""A checkpoint of ACT as files, read without LeRobot: sizes, statistics and weights, all checked.

What is read is what LeRobot writes (`config.json`, the processors' files, `model.safetensors`), JSON and safetensors
only. Whatever a query would be computed differently by is refused, so that a packed policy answers as LeRobot does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open

from arena_newton.errors import InputError
from arena_newton.files.stored_json import read_object
from arena_newton.files.untrusted_files import check_size, file_digest
from arena_newton.policies.learned.act_network import ACTIVATIONS, BLOCKS, ActNetwork, ActSizes
from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE, FACTS_FILE, NORMALISES, CheckpointFacts
from arena_newton.policies.lerobot.checkpoint_tensors import check_spread
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

__all__ = [
    "PROCESSOR_FILES",
    "WEIGHTS_NAME",
    "ActCheckpoint",
    "Spread",
    "loaded_network",
    "read_act_checkpoint",
    "read_weights",
]

WEIGHTS_NAME = "model.safetensors"
"""File of the weights."""
PROCESSOR_FILES = ("policy_preprocessor.json", "policy_postprocessor.json")
"""Files of what comes before and after the network."""
STEPS = {
    "policy_preprocessor.json": (
        "rename_observations_processor",
        "to_batch_processor",
        "device_processor",
        "normalizer_processor",
    ),
    "policy_postprocessor.json": ("unnormalizer_processor", "device_processor"),
}
"""Steps of ACT's processors in LeRobot 0.6; others would change a query."""
FRONT, STATE, TASK_VECTOR = "observation.images.front", "observation.state", "observation.environment_state"
"""Keys of the observations."""
KINDS = {FRONT: "VISUAL", STATE: "STATE", TASK_VECTOR: "ENV", "action": "ACTION"}
"""Feature → its kind in a configuration."""
MOST_JSON = 8 << 20
"""Largest JSON file that is read [bytes]."""
MOST_WEIGHTS = 1 << 30
"""Largest file of weights that is read [bytes]; ACT at full size in float32 has 0.2 GB."""
MOST_WIDTH, MOST_LAYERS, MOST_CHUNK = 4096, 32, 4096
"""Largest sizes that a configuration may name."""


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation by which numbers are normalised."""

    mean: torch.Tensor
    std: torch.Tensor
    eps: float

    def normalised(self, value: torch.Tensor) -> torch.Tensor:
        """Value as the network receives it."""
        return (value - self.mean) / (self.std + self.eps)

    def restored(self, value: torch.Tensor) -> torch.Tensor:
        """Value converted from the network's units."""
        return value * self.std + self.mean

    def to(self, device: torch.device) -> Spread:
        """The same on a device."""
        return Spread(self.mean.to(device), self.std.to(device), self.eps)


@dataclass(frozen=True)
class ActCheckpoint:
    """Contents of an ACT checkpoint, checked; without its weights."""

    folder: Path
    sizes: ActSizes
    executed: int
    """Actions of an answer that are executed before the next query."""
    facts: CheckpointFacts
    spreads: Mapping[str, Spread]
    """Feature → how it is normalised; a feature that is not here goes in, or comes out, as it is."""
    digest: str
    """First 12 hex digits of the SHA-256 of the weights."""
    files: tuple[str, ...]
    """Names of its files, the weights' first."""
    trains_latent: bool
    """True if the file has weights of the latent's encoder, which only training uses."""

    def network(self) -> ActNetwork:
        """The network with its weights, on the CPU, in float32.

        Raises:
            InputError: They do not fit.
        """
        path = self.folder / WEIGHTS_NAME
        weights = read_weights(path)
        kept = {name: value for name, value in weights.items() if not name.startswith("model.vae_encoder")}
        return loaded_network(path, self.sizes, kept if self.trains_latent else weights)


def loaded_network(path: Path, sizes: ActSizes, weights: dict[str, torch.Tensor]) -> ActNetwork:
    """A network of these sizes with the weights of a file, on the CPU, in float32.

    Raises:
        InputError: They do not fit.
    """
    try:
        with torch.device("meta"):  # neither memory for sizes that the file does not have nor random numbers
            network = ActNetwork(sizes)
        network.load(weights)
    except (KeyError, RuntimeError) as error:
        text = " ".join(str(error).split())[:300]
        raise InputError(f"{path}: does not hold the weights of this network: {text}") from None
    return network


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Tensors of a file by name, as they are stored.

    Raises:
        InputError: It is damaged, or holds something else than floating-point numbers.
    """
    check_size(path, MOST_WEIGHTS)
    try:
        with safe_open(path, framework="pt") as file:
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError) as error:
        text = " ".join(str(error).split())[:300]
        raise InputError(f"{path}: not readable as safetensors ({text})") from None
    for name, value in found.items():
        # The extremes tell of infinite numbers and of none in a tenth of the time that a look at each number takes.
        if not value.is_floating_point() or (value.numel() and not torch.stack(value.aminmax()).isfinite().all()):
            raise InputError(f"{path}: {name} holds something else than finite floating-point numbers")
    return found


def read_act_checkpoint(folder: Path) -> ActCheckpoint:
    """Read a folder with `config.json`, without its weights.

    Raises:
        InputError: It is no ACT of our observations and actions, or a file is damaged; the message names file and
            field.
    """
    config = read_object(folder / CONFIG_FILE, MOST_JSON)
    kind = config.get("type")
    if kind != "act":
        raise InputError(f"{folder / CONFIG_FILE}: type is {kind!r:.60}; only act is packed, whose queries are cheap")
    facts = CheckpointFacts.read(folder)
    if facts is None:
        raise InputError(f"{folder}: holds no {FACTS_FILE}, which says how its actions are read")
    sizes = _sizes(folder / CONFIG_FILE, config, facts)
    executed = _count(folder / CONFIG_FILE, config, "n_action_steps", sizes.chunk_size)
    spreads, files = _spreads(folder, sizes)
    digest = file_digest(folder / WEIGHTS_NAME, MOST_WEIGHTS)
    names = (WEIGHTS_NAME, CONFIG_FILE, FACTS_FILE, *PROCESSOR_FILES, *files)
    return ActCheckpoint(folder, sizes, executed, facts, spreads, digest, names, config.get("use_vae") is True)


def _object(path: Path, where: str, value: object) -> dict[str, object]:
    if not isinstance(value, dict):
        raise InputError(f"{path}: {where} is {type(value).__name__}, expected an object")
    return value


def _count(path: Path, config: Mapping[str, object], name: str, most: int) -> int:
    value = config.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
        raise InputError(f"{path}: {name} is {value!r:.40}, expected 1 to {most}")
    return value


def _sizes(path: Path, config: Mapping[str, object], facts: CheckpointFacts) -> ActSizes:
    """Sizes of the network; whatever it would need besides is refused."""
    expected: dict[str, list[int]] = {FRONT: [3, facts.height, facts.width], STATE: [STATE_WIDTH]}
    if facts.task_vector:
        expected[TASK_VECTOR] = [facts.vector_width]
    for field, wanted in (("input_features", expected), ("output_features", {"action": [ACTION_WIDTH]})):
        given = _object(path, field, config.get(field))
        shapes = {name: _object(path, f"{field}.{name}", one).get("shape") for name, one in given.items()}
        kinds = {name: _object(path, f"{field}.{name}", one).get("type") for name, one in given.items()}
        if shapes != wanted or any(kinds[name] != KINDS[name] for name in wanted):
            raise InputError(f"{path}: {field} is {str(shapes)[:200]}, expected {wanted}")
    refused: dict[str, tuple[str | int | None, ...]]
    refused = {
        "n_obs_steps": (1,),
        "replace_final_stride_with_dilation": (0, False),
        "temporal_ensemble_coeff": (None,),
    }
    refused |= {"vision_backbone": tuple(BLOCKS), "feedforward_activation": tuple(ACTIVATIONS)}
    refused |= {"pre_norm": (True, False), "use_vae": (True, False), "use_peft": (None, False)}
    for name, allowed in refused.items():
        value = config.get(name)
        if not isinstance(value, str | int | None) or value not in allowed:
            known = " or ".join(str(one) for one in allowed)
            raise InputError(f"{path}: {name} is {value!r:.60}, expected {known} in a packed policy")
    limits = {"dim_model": MOST_WIDTH, "dim_feedforward": 4 * MOST_WIDTH, "n_heads": 64, "latent_dim": MOST_WIDTH}
    limits |= {"n_encoder_layers": MOST_LAYERS, "n_decoder_layers": MOST_LAYERS, "chunk_size": MOST_CHUNK}
    numbers = {name: _count(path, config, name, most) for name, most in limits.items()}
    if numbers["dim_model"] % numbers["n_heads"] or numbers["dim_model"] % 4:
        raise InputError(f"{path}: dim_model is {numbers['dim_model']}, expected a multiple of n_heads and of 4")
    words = {one.name: config[one.name] for one in fields(ActSizes) if one.name in refused}
    return ActSizes(state=STATE_WIDTH, tasks=facts.vector_width, actions=ACTION_WIDTH, **numbers, **words)  # type: ignore[arg-type]  # checked above


def _spreads(folder: Path, sizes: ActSizes) -> tuple[dict[str, Spread], list[str]]:
    """Normalisation of the features, and the files that give it."""
    found: dict[str, Spread] = {}
    files = []
    for name in PROCESSOR_FILES:
        path = folder / name
        steps = read_object(path, MOST_JSON).get("steps")
        registered = [one.get("registry_name") if isinstance(one, dict) else None for one in _list(path, steps)]
        if tuple(registered) != STEPS[name]:
            raise InputError(f"{path}: steps are {str(registered)[:200]}, expected {', '.join(STEPS[name])}")
        for index, step in enumerate(_list(path, steps)):
            options = _object(path, f"steps[{index}].config", step.get("config") or {})
            if options.get("rename_map"):
                raise InputError(f"{path}: steps[{index}] renames observations, which a packed policy does not")
            if options.get("float_dtype") not in (None, "float32"):
                given = f"{options['float_dtype']!r:.40}"
                raise InputError(f"{path}: steps[{index}] computes in {given}, a packed policy in float32")
            if step["registry_name"] in NORMALISES:
                state, part = _statistics(path, index, step, options, sizes)
                files.append(state)
                outputs = name == PROCESSOR_FILES[1]
                found |= {key: one for key, one in part.items() if (key == "action") == outputs}
    return found, files


def _list(path: Path, value: object) -> list[dict[str, object]]:
    if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
        raise InputError(f"{path}: steps is not a list of objects")
    return value


def _statistics(
    path: Path, index: int, step: Mapping[str, object], options: Mapping[str, object], sizes: ActSizes
) -> tuple[str, dict[str, Spread]]:
    """A normalising step's file, and the spreads that its modes ask for."""
    where, state = f"steps[{index}]", step.get("state_file")
    if not isinstance(state, str) or Path(state).name != state or not state.endswith(".safetensors"):
        raise InputError(f"{path}: {where}.state_file is {state!r:.60}, expected a name of a safetensors file")
    modes = _object(path, f"{where}.config.norm_map", options.get("norm_map"))
    chosen = options.get("normalize_observation_keys")
    if chosen is not None:
        raise InputError(f"{path}: {where} normalises only {str(chosen)[:80]}, a packed policy whatever has statistics")
    features = options.get("features")  # LeRobot normalises what is named here, by the kind that is named
    named = None if features is None else _object(path, f"{where}.config.features", features)
    eps = options.get("eps", 1e-8)
    if not isinstance(eps, int | float) or not 0.0 <= eps < 1.0:
        raise InputError(f"{path}: {where}.config.eps is {eps!r:.40}, expected 0 to 1")
    tensors = read_weights(path.parent / state)
    shapes = {FRONT: (3, 1, 1), STATE: (sizes.state,), TASK_VECTOR: (sizes.tasks,), "action": (sizes.actions,)}
    found = {}
    for feature, shape in shapes.items():
        mode = modes.get(KINDS[feature], "IDENTITY")
        known = any(name.startswith(f"{feature}.") for name in tensors)
        if mode == "IDENTITY" or not known:
            continue
        if mode != "MEAN_STD":
            raise InputError(
                f"{path}: {where} normalises {KINDS[feature]} by {mode!r:.40}, expected MEAN_STD or IDENTITY"
            )
        mean, std = tensors.get(f"{feature}.mean"), tensors.get(f"{feature}.std")
        if named is not None and feature != "action" and path.name == PROCESSOR_FILES[0]:
            kind = _object(path, f"{where}.config.features.{feature}", named.get(feature, {})).get("type")
            if kind != KINDS[feature]:
                raise InputError(f"{path}: {where} takes {feature} for {kind!r:.40}, expected {KINDS[feature]}")
        if mean is None or std is None or mean.shape != shape or std.shape != shape:
            raise InputError(f"{path.parent / state}: {feature} has no mean and std of shape {list(shape)}")
        check_spread(path.parent / state, feature, {"std": std})
        found[feature] = Spread(mean.float(), std.float(), float(eps))
    return state, found
