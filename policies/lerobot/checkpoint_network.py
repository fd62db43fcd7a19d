"""A checkpoint's network with its processors: observations of some rows in, chunks of actions out.

Rows are independent: each has its own noise, and its answer does not depend on what the other rows show.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import AbsoluteActionsProcessorStep
from safetensors.torch import load_model

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CONFIG_FILE
from arena_newton.policies.lerobot.checkpoint_reader import WEIGHTS, PolicyCheckpoint, lerobot_silent
from arena_newton.policies.lerobot.checkpoint_tensors import within_weights
from arena_newton.policies.lerobot.network_noise import Draw, generators, normal

__all__ = ["PolicyNetwork"]

IMAGES = "observation.images"
"""Key under which LeRobot stacks the pictures of all cameras."""


class PolicyNetwork:
    """The network of a checkpoint on a device."""

    def __init__(self, checkpoint: PolicyCheckpoint, device: torch.device):
        """Build it and load its weights.

        Raises:
            InputError: The weights do not fit, a file of the processors is damaged, or a tokenizer is not there.
        """
        self.checkpoint = checkpoint
        self.policy = _loaded(checkpoint)
        self.move(device)

    def move(self, device: torch.device) -> None:
        """Bring it to a device; its processors are made again, since they hold tensors and the name of a device.

        Raises:
            InputError: A file of the processors is damaged, or a tokenizer is not there.
        """
        self.device = device
        self.policy = self.policy.to(device)
        chosen = {"device_processor": {"device": str(device)}}
        try:
            with lerobot_silent(), _own_encoders(self.checkpoint):
                self.before, self.after = make_pre_post_processors(
                    self.checkpoint.config,
                    pretrained_path=str(self.checkpoint.folder),
                    preprocessor_overrides=chosen,
                    postprocessor_overrides=chosen,
                )
        except InputError:
            raise
        except Exception as error:  # LeRobot has errors of many kinds, transformers too
            raise InputError(f"{self.checkpoint.folder}: its processors do not load: {_first(error)}") from None
        try:
            self._rehearse()
        except Exception as error:  # a step computes with what its files say
            where = f"{self.checkpoint.folder}: its processors or their statistics do not fit its observations"
            raise InputError(f"{where}: {_first(error)}") from None
        # Only these read the state of a query, whose shape they expect in every action.
        self._per_tick = any(isinstance(one, AbsoluteActionsProcessorStep) and one.enabled for one in self.after.steps)

    def _rehearse(self) -> None:
        """Pass an empty query and an empty action through the processors."""
        config = self.checkpoint.config
        ticks = (self.checkpoint.observations,) if self.checkpoint.observations > 1 else ()
        seen = {
            name: torch.zeros(1, *ticks, *feature.shape, device=self.device)
            for name, feature in (config.input_features or {}).items()
            if "empty_camera" not in name  # the network fills it itself
        }
        with torch.inference_mode():
            self.before({**seen, "task": [""]})
            self.after(torch.zeros(1, config.action_feature.shape[0], device=self.device))

    def predict(self, seen: Mapping[str, torch.Tensor], instruction: str, draws: Sequence[Draw]) -> torch.Tensor:
        """Actions of a query.

        Args:
            seen: Observations by their names in datasets, float32 on the device, shape [rows, ...], or for policies
                that look at several ticks [rows, ticks, ...]; pictures from 0 to 1, channels first.
            draws: Whose noise each row has.

        Returns:
            In the units of the labels, float32, shape [rows, n, 40].
        """
        with torch.inference_mode():
            rows = len(draws)
            batch = self.before({**seen, "task": [instruction] * rows})
            batch = {name: value for name, value in batch.items() if value is not None and name != "action"}
            chunk = self._chunk(batch, draws).float()
            if self._per_tick:
                done = torch.stack([self.after(action) for action in chunk.unbind(1)], dim=1)
            else:
                done = self.after(chunk.reshape(-1, chunk.shape[-1])).reshape(chunk.shape)
        return done.to(self.device, torch.float32).clone()  # outside of inference mode it may be written to

    def _chunk(self, batch: dict[str, torch.Tensor], draws: Sequence[Draw]) -> torch.Tensor:
        """Chunk that the network predicts from a normalised batch, normalised."""
        policy, config = self.policy, self.checkpoint.config
        match self.checkpoint.type:
            case "act":
                return policy.predict_action_chunk(batch)
            case "diffusion":
                drawn = generators(draws)
                noise = normal(drawn, (config.horizon, config.action_feature.shape[0]), self.device)
                model = policy.diffusion
                # LeRobot passes the noise on, but not the generator from which DDPM draws at every step.
                model.conditional_sample = functools.partial(type(model).conditional_sample, model, generator=drawn)
                try:
                    return policy.predict_action_chunk(batch, noise=noise)
                finally:  # the network would hold itself, and a closed policy its gigabytes
                    del model.conditional_sample
            case "multi_task_dit":
                policy.objective.drawn = generators(draws)
                pictures = torch.stack([batch[key] for key in config.image_features], dim=-4)
                batch = {**batch, IMAGES: pictures}
                return self.policy._generate_actions(batch)  # its public one reads queues, which need all rows at once
            case "pi05":
                shape = (config.chunk_size, config.max_action_dim)
                return policy.predict_action_chunk(batch, noise=normal(generators(draws), shape, self.device))
        raise AssertionError(self.checkpoint.type)


def _loaded(checkpoint: PolicyCheckpoint) -> PreTrainedPolicy:
    """The network with its weights on the CPU; every weight is the checkpoint's."""
    path = checkpoint.folder / WEIGHTS
    try:
        with lerobot_silent(), _own_encoders(checkpoint), within_weights(path):
            if checkpoint.type == "multi_task_dit":
                from arena_newton.policies.lerobot.seeded_dit import build  # imports transformers

                policy = build(checkpoint.config)
            else:
                policy = get_policy_class(checkpoint.type)(checkpoint.config)
    except InputError:
        raise
    except Exception as error:  # what a configuration asks for fails anywhere in LeRobot, torch and transformers
        where = checkpoint.folder / CONFIG_FILE
        raise InputError(f"{where}: its network cannot be built: {_first(error)}") from None
    try:
        # Not LeRobot's own loading, which goes on with random weights where names are missing.
        load_model(policy, str(path), strict=True, device="cpu")
    except Exception as error:  # safetensors has an error of its own
        raise InputError(f"{path}: does not hold the weights of this network: {_first(error)}") from None
    return policy.eval().requires_grad_(False)


@contextmanager
def _own_encoders(checkpoint: PolicyCheckpoint) -> Iterator[None]:
    """Lets LeRobot build with the architecture and the tokenizer that a checkpoint of ours brings.

    Weights are not drawn first: those of the checkpoint are loaded over them, and to draw pi0.5's takes minutes.
    """
    if checkpoint.type not in ("multi_task_dit", "pi05"):
        yield
        return
    from transformers.initialization import no_init_weights

    from arena_newton.policies.lerobot.encoder_sources import checkpoint_encoders  # imports transformers

    with checkpoint_encoders(checkpoint.folder), no_init_weights():
        yield


def _first(error: BaseException) -> str:
    """An error's message in one line of bounded length."""
    return " ".join(str(error).split())[:300] or type(error).__name__
