"""Flow matching: LeRobot's multi-task DiT with a loss whose random numbers are given, and CLIP from wherever it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from torch import nn
from transformers import CLIPTextModel, CLIPVisionModel, PreTrainedModel, PreTrainedTokenizerBase
from transformers.utils import logging as transformers_logging

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.lerobot.encoder_sources import (
    CLIP_FOLDER,
    TOKENIZER_FOLDER,
    ClipShape,
    clip_from,
    made_clip,
    made_tokenizer,
    read_clip,
    read_tokenizer,
    tokenizer_from,
    write_clip,
)
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families.policy_model import (
    ACTION,
    Losses,
    TrainableModel,
    finished,
    new_policy,
    prepared,
    with_time_axis,
)
from arena_newton.policies.train.families.pretrained_weights import weights_folder
from arena_newton.policies.train.families.prompts import MASK, TOKENS, set_tokenizer_name, tokenized
from arena_newton.policies.train.frames.feature_scaling import Stats

__all__ = ["FlowModel", "build", "check_weights"]

CLIP_FILES = ("*.json", "*.txt", "model.safetensors")
"""Files of a CLIP that are used."""
WEIGHTS_FILES = ("*.safetensors", "*.bin")
"""Files one of which holds weights, as transformers writes them."""


class FlowModel(TrainableModel):
    """Flow matching and its loss."""

    reads_task: ClassVar[bool] = True

    def __init__(
        self,
        recipe: TrainingRecipe,
        stats: Stats,
        device: torch.device,
        policy: PreTrainedPolicy,
        clip: ClipShape,
        tokenizer: PreTrainedTokenizerBase,
        own: bool,
    ):
        """Make one with its encoders.

        Args:
            stats: As `usable_stats` returns them.
            clip: Architecture of its encoders.
            own: Whether the encoders are in no other folder or hub, so that a checkpoint must hold them.
        """
        self.clip, self.tokenizer, self.own = clip, tokenizer, own
        super().__init__(recipe, stats, device, policy)

    def noise(self, rows: int, generator: torch.Generator | None = None) -> dict[str, torch.Tensor]:
        """`noise` [rows, horizon, 40], standard normal, and `time` [rows], 0 (noise) to 1 (actions)."""
        config = self.policy.config
        shape = (rows, config.horizon, config.action_feature.shape[0])
        noise = torch.randn(shape, device=self.device, generator=generator)
        uniform = torch.rand(rows, device=self.device, generator=generator)
        if config.timestep_sampling_strategy == "beta":
            # Beta(a, 1) has the distribution function u^a; torch's own sampler waits for the host.
            uniform = config.timestep_sampling_s * (1.0 - uniform ** (1.0 / config.timestep_sampling_alpha))
        return {"noise": noise, "time": uniform}

    def losses(self, batch: Mapping[str, object], noise: Mapping[str, torch.Tensor] | None = None) -> Losses:
        """Squared error of the velocity (`FlowMatchingObjective.compute_loss`)."""
        actions = batch[ACTION]
        assert isinstance(actions, torch.Tensor)
        drawn = self.noise(len(actions)) if noise is None else noise
        if TOKENS not in batch:
            batch = {**batch, **self.tokens(_strings(batch.get("task"), len(actions)))}
        policy, kept = self.policy, 1.0 - self.policy.config.sigma_min
        seen = policy.observation_encoder.encode(with_time_axis(policy.config, batch))
        time = drawn["time"][:, None, None]
        noisy = time * actions + (1.0 - kept * time) * drawn["noise"]
        velocity = policy.noise_predictor(noisy, drawn["time"], conditioning_vec=seen)
        return self.mean_error((velocity - (actions - kept * drawn["noise"])) ** 2, batch)

    def tokens(self, tasks: Sequence[str], state: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Tokens of the instructions; one that would be cut is refused."""
        config = self.policy.config
        ids, mask = tokenized(self.tokenizer, list(tasks), config.tokenizer_max_length, config.tokenizer_padding_side)
        return {TOKENS: ids.to(self.device), MASK: mask.to(self.device)}

    def compiled_parts(self) -> list[nn.Module]:
        """CLIP's vision encoder and the transformer; the text encoder is frozen."""
        return [self.policy.observation_encoder.vision_encoder, self.policy.noise_predictor]

    def is_backbone(self, parameter: str) -> bool:
        """Those of CLIP's vision encoder."""
        return parameter.startswith("observation_encoder.vision_encoder")

    def save(self, folder: Path, facts: CheckpointFacts, precision: str = "float32") -> None:
        """Save as every family does, with the architecture of CLIP and the tokenizer."""
        encoder = self.policy.observation_encoder
        if self.own:
            name = str(finished(folder) / CLIP_FOLDER)
            self.policy.config.vision_encoder_name = self.policy.config.text_encoder_name = name
            set_tokenizer_name(self.preprocess, str(finished(folder) / TOKENIZER_FOLDER))
        super().save(folder, facts, precision)
        parts = (encoder.vision_encoder.model, encoder.text_encoder.text_encoder) if self.own else (None, None)
        write_clip(folder / CLIP_FOLDER, self.clip, *parts)
        self.tokenizer.save_pretrained(folder / TOKENIZER_FOLDER)

    def _processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        with tokenizer_from(self.tokenizer):
            return super()._processors()


def _strings(task: object, rows: int) -> list[str]:
    if not isinstance(task, list | tuple) or len(task) != rows or not all(isinstance(one, str) for one in task):
        raise InputError(f"batch: neither tokens nor a task for each of {rows} rows")
    return list(task)


def check_weights(recipe: TrainingRecipe, weights: str | Path | None) -> None:
    """Check weights as `families.check_weights` does."""
    if weights is not None or not isinstance(recipe.network.get("clip"), Mapping):
        _clip_folder(recipe, weights)


def _clip_folder(recipe: TrainingRecipe, weights: str | Path | None) -> tuple[Path, ClipShape]:
    """Folder of a recipe's CLIP, and its architecture, which fits."""
    name = str(weights if weights is not None else recipe.network["vision_encoder_name"])
    folder = weights_folder(name, "CLIP", CLIP_FILES)
    clip = read_clip(folder)
    _check(clip, recipe, folder)
    if not any(one.is_file() for pattern in WEIGHTS_FILES for one in folder.glob(pattern)):
        raise InputError(f"{folder}: holds no weights of CLIP ({', '.join(WEIGHTS_FILES)})")
    return folder, clip


def build(recipe: TrainingRecipe, stats: Stats, device: torch.device, weights: str | Path | None) -> FlowModel:
    """Flow matching of a recipe; see `families.build`."""
    config, usable = prepared(recipe, stats, device)
    if config.timestep_sampling_strategy == "beta" and config.timestep_sampling_beta != 1.0:
        raise InputError(f"recipe {recipe.name}: timestep_sampling_beta is {config.timestep_sampling_beta}, expected 1")
    sizes = recipe.network.get("clip")
    if weights is None and isinstance(sizes, Mapping):
        tokenizer: PreTrainedTokenizerBase = made_tokenizer()
        clip, own = made_clip(sizes, recipe.picture, config.tokenizer_max_length, tokenizer), True
        with clip.new():
            policy = new_policy(config)
    else:
        name = str(weights if weights is not None else recipe.network["vision_encoder_name"])
        folder, clip = _clip_folder(recipe, weights)
        tokenizer, own = read_tokenizer(folder), False
        with clip_from(lambda: _whole(CLIPVisionModel, folder), lambda: _whole(CLIPTextModel, folder)):
            policy = new_policy(config)
        config.vision_encoder_name = config.text_encoder_name = str(folder.resolve()) if Path(name).is_dir() else name
    policy.to(device).train()
    model = FlowModel(recipe, usable, device, policy, clip, tokenizer, own)
    if not own:
        set_tokenizer_name(model.preprocess, str(config.text_encoder_name))
    return model


def _check(clip: ClipShape, recipe: TrainingRecipe, folder: Path) -> None:
    """A CLIP of other sizes would fail in the first step, with a message about shapes."""
    size, longest = clip.vision.image_size, clip.text.max_position_embeddings
    tokens = int(str(recipe.network["tokenizer_max_length"]))
    if size != recipe.picture:
        raise InputError(f"{folder}: sees pictures of {size} pixels, the recipe's have {recipe.picture}")
    if longest < tokens:
        raise InputError(f"{folder}: reads {longest} tokens, tokenizer_max_length is {tokens}")
    if "clip" not in str(folder.resolve()).lower():
        raise InputError(
            f"--weights {folder}: LeRobot wants a path with clip in its name; rename the folder or link it"
        )


def _whole(kind: type[PreTrainedModel], folder: Path) -> torch.nn.Module:
    """A part of CLIP all of whose weights are in the folder; transformers would draw those that are missing."""
    verbosity = transformers_logging.get_verbosity()
    transformers_logging.set_verbosity_error()  # it would warn about the half of CLIP that the other encoder takes
    try:
        loaded: object = kind.from_pretrained(folder, local_files_only=True, output_loading_info=True)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{folder}: holds no weights of CLIP ({str(error).splitlines()[0]})") from None
    finally:
        transformers_logging.set_verbosity(verbosity)
    assert isinstance(loaded, tuple)
    model, text = loaded
    missing = sorted({*text["missing_keys"], *(one[0] for one in text.get("mismatched_keys", ()))})
    if missing:
        raise InputError(
            f"{folder}: weights of CLIP are incomplete, {missing[0]} and {len(missing) - 1} others are not there"
        )
    found: torch.nn.Module = model
    return found
