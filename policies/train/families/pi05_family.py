"""pi0.5: LeRobot's policy, with its base weights loaded completely or not at all.

LeRobot's own loader prints what it could not load and goes on with random weights. Here every tensor of the file is in
the policy afterwards, which a checksum says; the two projections of actions are wider than the base's 32 numbers, and
what the base has not is zero, so that the policy begins as the base.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from lerobot.policies.common.vla_utils import pad_vector
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from torch import nn
from transformers import PreTrainedTokenizerBase

from arena_newton.errors import InputError
from arena_newton.files.own_files import replace_atomically
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.lerobot.encoder_sources import (
    GEMMA_FILE,
    TOKENIZER_FOLDER,
    gemma_of,
    made_tokenizer,
    read_tokenizer,
    tokenizer_from,
)
from arena_newton.policies.recipes.training_recipe import TrainingRecipe
from arena_newton.policies.train.families.policy_model import (
    ACTION,
    STATE,
    WEIGHTS_FILE,
    Losses,
    TrainableModel,
    finished,
    new_policy,
    prepared,
)
from arena_newton.policies.train.families.pretrained_weights import (
    check_safetensors,
    checksum,
    read_safetensors,
    weights_folder,
)
from arena_newton.policies.train.families.prompts import MASK, TOKENS, set_tokenizer_name, tokenized
from arena_newton.policies.train.frames.feature_scaling import Stats

__all__ = ["BASE_FILES", "PADDED", "TOKENIZER", "Pi05Model", "build", "check_weights", "load_base", "prompts"]

TOKENIZER = "google/paligemma-3b-pt-224"
"""Tokenizer that LeRobot's processors of pi0.5 name."""
BASE_FILES = ("*.json", "*.model", WEIGHTS_FILE)
"""Files of the base weights that are used."""
TOKENIZER_FILES = ("tokenizer*", "special_tokens_map.json", "added_tokens.json", "config.json")
PADDED = {
    "model.action_in_proj.weight": 1,
    "model.action_out_proj.weight": 0,
    "model.action_out_proj.bias": 0,
}
"""Tensors whose size is that of the action, and in which dimension."""
BEYOND = 2.0
"""A normalised number above all bins: the last one, which has the most digits."""
STATE_BINS = 256
"""Bins of a number of the state in the prompt, from -1 to 1."""
_EMBEDDING = "model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
_HEAD = "model.paligemma_with_expert.paligemma.lm_head.weight"
_RENAMED = {"model.action_time_mlp_in.": "model.time_mlp_in.", "model.action_time_mlp_out.": "model.time_mlp_out."}
_DROPPED = "model.state_proj."


class Pi05Model(TrainableModel):
    """pi0.5 and its loss."""

    # LeRobot makes masks on the host in every forward pass, and the prompt with the state is text.
    capturable: ClassVar[bool] = False
    compilable: ClassVar[bool] = False
    reads_task: ClassVar[bool] = True

    def __init__(
        self,
        recipe: TrainingRecipe,
        stats: Stats,
        device: torch.device,
        policy: PreTrainedPolicy,
        tokenizer: PreTrainedTokenizerBase,
        name: str,
    ):
        """Make one with its tokenizer.

        Args:
            stats: As `usable_stats` returns them.
            name: Where a stock LeRobot finds the tokenizer; empty where only a checkpoint has it.
        """
        self.tokenizer, self.tokenizer_name = tokenizer, name
        self.weights_checksum = ""
        """Checksum of the base's tensors without `PADDED`; empty with new weights."""
        super().__init__(recipe, stats, device, policy)
        set_tokenizer_name(self.preprocess, name)

    def noise(self, rows: int, generator: torch.Generator | None = None) -> dict[str, torch.Tensor]:
        """`noise` [rows, chunk, max_action_dim], standard normal, and `time` [rows], 0 (actions) to 1 (noise)."""
        config = self.policy.config
        shape = (rows, config.chunk_size, config.max_action_dim)
        noise = torch.randn(shape, device=self.device, generator=generator)
        uniform = torch.rand(rows, device=self.device, generator=generator)
        # Beta(a, 1) has the distribution function u^a; LeRobot's sampler draws on the host.
        time = uniform ** (1.0 / config.time_sampling_beta_alpha) * config.time_sampling_scale
        return {"noise": noise, "time": time + config.time_sampling_offset}

    def losses(self, batch: Mapping[str, object], noise: Mapping[str, torch.Tensor] | None = None) -> Losses:
        """Squared error of the velocity of the 40 numbers (`PI05Policy.forward`)."""
        actions, state = batch[ACTION], batch[STATE]
        assert isinstance(actions, torch.Tensor) and isinstance(state, torch.Tensor)
        drawn = self.noise(len(actions)) if noise is None else noise
        if TOKENS not in batch:
            task = batch.get("task")
            if not isinstance(task, list | tuple) or len(task) != len(actions):
                raise InputError(f"batch: neither tokens nor a task for each of {len(actions)} rows")
            batch = {**batch, **self.tokens([str(one) for one in task], state)}
        pictures, seen = self.policy._preprocess_images(batch)
        padded = pad_vector(actions, self.policy.config.max_action_dim)
        errors = self.policy.model.forward(
            pictures, seen, batch[TOKENS], batch[MASK], padded, drawn["noise"], drawn["time"]
        )
        own: torch.Tensor = errors[:, :, : actions.shape[-1]]
        return own.mean(), own.detach().mean(dim=(1, 2))

    def tokens(self, tasks: Sequence[str], state: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Tokens of prompts with instruction and state; an instruction whose prompt could be cut is refused."""
        if state is None:
            raise InputError("pi05: the prompt holds the state, which was not given")
        longest = int(self.policy.config.tokenizer_max_length)
        known = sorted(set(tasks))
        # Also the longest prompts that running can have, whose end LeRobot's processors would cut.
        tokenized(self.tokenizer, prompts(known, torch.full((len(known), state.shape[-1]), BEYOND)), longest)
        ids, mask = tokenized(self.tokenizer, prompts(tasks, state), longest)
        return {TOKENS: ids.to(self.device), MASK: mask.to(self.device)}

    def compiled_parts(self) -> list[nn.Module]:
        """None: what is compiled ends at each of the masks that are made on the host."""
        return []

    def is_backbone(self, parameter: str) -> bool:
        """Those of the vision tower."""
        return ".vision_tower." in parameter

    def save(self, folder: Path, facts: CheckpointFacts, precision: str = "float32") -> None:
        """Save as every family does, with the tokenizer. A policy in bfloat16 is written as it is."""
        if not self.tokenizer_name:
            set_tokenizer_name(self.preprocess, str(finished(folder) / TOKENIZER_FOLDER))
        super().save(folder, facts, precision)
        self.tokenizer.save_pretrained(folder / TOKENIZER_FOLDER)
        sizes = self.recipe.network.get("gemma")
        if isinstance(sizes, Mapping):
            with replace_atomically(folder / GEMMA_FILE) as file:
                file.write(json.dumps(dict(sizes)).encode())

    def _processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        with tokenizer_from(self.tokenizer):
            return super()._processors()


def prompts(tasks: Sequence[str], state: torch.Tensor) -> list[str]:
    """Prompts of pi0.5 from instructions and normalised states [B, 64] (`Pi05PrepareStateTokenizerProcessorStep`)."""
    edges = np.linspace(-1, 1, STATE_BINS + 1)[:-1]
    bins = np.digitize(state.reshape(len(tasks), -1).float().cpu().numpy(), bins=edges) - 1
    texts = [task.strip().replace("_", " ").replace("\n", " ") for task in tasks]
    return [
        f"Task: {text}, State: {' '.join(map(str, row))};\nAction: "
        for text, row in zip(texts, bins.tolist(), strict=True)
    ]


def load_base(policy: PreTrainedPolicy, path: Path) -> str:
    """Put base weights into a policy: all of them, each in its position.

    The projections of actions may be wider than the file's: what the file has not becomes zero. Everything else must be
    in the file with the policy's shapes.

    Returns:
        SHA-256 of the tensors of the file other than `PADDED`, which is also that of the policy's.

    Raises:
        InputError: A tensor is missing, left over or of another shape; or the policy does not have it afterwards.
    """
    found: dict[str, torch.Tensor] = {}
    for name, tensor in read_safetensors(path).items():
        name = name if name.startswith("model.") else f"model.{name}"
        for old, new in _RENAMED.items():
            name = name.replace(old, new) if name.startswith(old) else name
        if not name.startswith(_DROPPED):
            found[name] = tensor
    # The two are one tensor in the policy; a file holds either.
    for one, other in ((_EMBEDDING, _HEAD), (_HEAD, _EMBEDDING)):
        if one in found:
            found.setdefault(other, found[one])
    own = policy.state_dict()
    missing, left = sorted(set(own) - set(found)), sorted(set(found) - set(own))
    if missing or left:
        lines = [
            f"{len(names)} {what}, {names[0]}" for names, what in ((missing, "missing"), (left, "unknown")) if names
        ]
        raise InputError(f"{path}: not the weights of this policy ({'; '.join(lines)})")
    ready: dict[str, torch.Tensor] = {}
    for name, tensor in own.items():
        given = found[name].to(tensor.dtype)
        if name in PADDED and given.dim() == tensor.dim() and given.shape[PADDED[name]] < tensor.shape[PADDED[name]]:
            wide = torch.zeros_like(tensor, device="cpu")
            wide.narrow(PADDED[name], 0, given.shape[PADDED[name]]).copy_(given)
            given = wide
        if given.shape != tensor.shape:
            raise InputError(f"{path}: {name} has shape {list(given.shape)}, the policy's {list(tensor.shape)}")
        ready[name] = given
    policy.load_state_dict(ready, strict=True)
    backbone = [name for name in own if name not in PADDED]
    wanted = checksum((name, found[name].to(own[name].dtype)) for name in backbone)
    loaded = policy.state_dict()
    if checksum((name, loaded[name]) for name in backbone) != wanted:
        raise InputError(f"{path}: the policy does not hold the file's weights after loading")
    return wanted


def check_weights(recipe: TrainingRecipe, weights: str | Path | None) -> None:
    """Check weights as `families.check_weights` does."""
    folder = _base(recipe, weights)
    if folder is not None and not _holds_tokenizer(folder) and not isinstance(recipe.network.get("gemma"), Mapping):
        weights_folder(TOKENIZER, "tokenizer of PaliGemma", TOKENIZER_FILES)


def _base(recipe: TrainingRecipe, weights: str | Path | None) -> Path | None:
    """Folder of the base weights; none where a recipe has new ones: of other sizes, or without a name of weights."""
    if weights is None and (isinstance(recipe.network.get("gemma"), Mapping) or not recipe.network["pretrained_path"]):
        return None
    name = str(weights if weights is not None else recipe.network["pretrained_path"])
    folder = weights_folder(name, "pi0.5 base weights", BASE_FILES)
    if not (folder / WEIGHTS_FILE).is_file():
        raise InputError(f"--weights {folder}: holds no {WEIGHTS_FILE} of pi0.5")
    check_safetensors(folder / WEIGHTS_FILE)
    return folder


def build(recipe: TrainingRecipe, stats: Stats, device: torch.device, weights: str | Path | None) -> Pi05Model:
    """pi0.5 of a recipe; see `families.build`."""
    config, usable = prepared(recipe, stats, device)
    for name, least in (("max_action_dim", usable[ACTION]["mean"]), ("max_state_dim", usable[STATE]["mean"])):
        if getattr(config, name) < len(least):
            raise InputError(f"recipe {recipe.name}: {name} is {getattr(config, name)}, expected {len(least)} or more")
    if config.time_sampling_beta_beta != 1.0:
        raise InputError(
            f"recipe {recipe.name}: time_sampling_beta_beta is {config.time_sampling_beta_beta}, expected 1"
        )
    sizes = recipe.network.get("gemma")
    folder = _base(recipe, weights)
    if folder is None or (isinstance(sizes, Mapping) and not _holds_tokenizer(folder)):
        found: tuple[PreTrainedTokenizerBase, str] = made_tokenizer(), ""
    else:
        found = _tokenizer(folder)
    with gemma_of(sizes) if isinstance(sizes, Mapping) else contextlib.nullcontext():
        policy = new_policy(config)
    loaded = load_base(policy, folder / WEIGHTS_FILE) if folder else ""
    policy.to(device).train()
    model = Pi05Model(recipe, usable, device, policy, *found)
    model.weights_checksum = loaded
    return model


def _holds_tokenizer(folder: Path) -> bool:
    return any((one / "tokenizer_config.json").is_file() for one in (folder, folder / TOKENIZER_FOLDER))


def _tokenizer(folder: Path) -> tuple[PreTrainedTokenizerBase, str]:
    """The tokenizer next to base weights, or that of the hub; and the name that a checkpoint gives it."""
    for one in (folder, folder / TOKENIZER_FOLDER):
        if (one / "tokenizer_config.json").is_file():
            return read_tokenizer(one), ""
    return read_tokenizer(weights_folder(TOKENIZER, "tokenizer of PaliGemma", TOKENIZER_FILES)), TOKENIZER
