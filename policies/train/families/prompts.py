"""Prompts of a policy: instructions as tokens, none of them cut."""

from __future__ import annotations

import torch
from lerobot.processor import PolicyProcessorPipeline, TokenizerProcessorStep
from transformers import PreTrainedTokenizerBase

from arena_newton.errors import InputError

__all__ = ["MASK", "TOKENS", "set_tokenizer_name", "tokenized"]

TOKENS = "observation.language.tokens"
"""Key of the tokens, int64 [B, L]."""
MASK = "observation.language.attention_mask"
"""Key of the mask of those that are not padding, bool [B, L]."""


def tokenized(
    tokenizer: PreTrainedTokenizerBase, texts: list[str], longest: int, side: str = "right"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tokens and their mask, padded to one length, int64 and bool [texts, longest].

    Raises:
        InputError: A text has more tokens, so that its end would be cut.
    """
    found = tokenizer(texts, max_length=longest, padding="max_length", padding_side=side, truncation=False)
    counts = [len(row) for row in found["input_ids"]]
    if max(counts) > longest:
        text = texts[counts.index(max(counts))]
        raise InputError(
            f"prompt {text[:60]!r}...: has {max(counts)} tokens, the policy reads {longest} (tokenizer_max_length)"
        )
    return torch.tensor(found["input_ids"]), torch.tensor(found["attention_mask"], dtype=torch.bool)


def set_tokenizer_name(pipeline: PolicyProcessorPipeline, name: str) -> None:
    """Let a saved pipeline name its tokenizer: a folder, or a name on the hub."""
    for step in pipeline.steps:
        if isinstance(step, TokenizerProcessorStep):
            step.tokenizer_name = name
