"""Sources of the encoders of LeRobot's policies: a folder, new weights, or a checkpoint.

LeRobot fetches CLIP, tokenizers and the sizes of Gemma by fixed names while it builds a policy or its processors. Here
those names are replaced for the time of a `with` block. A checkpoint of flow matching or pi0.5 holds the architecture
of its encoders and its tokenizer, so that it opens without a hub (`checkpoint_encoders`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import torch
from lerobot.policies.multi_task_dit import modeling_multi_task_dit
from lerobot.policies.pi05 import modeling_pi05
from lerobot.processor import tokenizer_processor
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from transformers import (
    AutoTokenizer,
    CLIPConfig,
    CLIPModel,
    CLIPTextConfig,
    CLIPTextModel,
    CLIPVisionConfig,
    CLIPVisionModel,
    PreTrainedTokenizerBase,
    PreTrainedTokenizerFast,
)
from transformers.utils import logging as transformers_logging

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.stored_json import read_object

__all__ = [
    "CLIP_FOLDER",
    "GEMMA_FILE",
    "TOKENIZER_FOLDER",
    "ClipShape",
    "checkpoint_encoders",
    "clip_from",
    "gemma_of",
    "made_clip",
    "made_tokenizer",
    "read_clip",
    "read_tokenizer",
    "tokenizer_from",
    "write_clip",
]

CLIP_FOLDER = "clip"
"""Folder of a checkpoint with the architecture of its CLIP, where it was trained from new weights also with weights."""
TOKENIZER_FOLDER = "tokenizer"
"""Folder of a checkpoint with its tokenizer."""
GEMMA_FILE = "gemma.json"
"""File of a checkpoint of pi0.5 that was trained at a smaller size than LeRobot has."""
VOCABULARY = 1024
"""Tokens of a tokenizer that is made from the tasks' instructions."""
_PADDING, _BEGIN, _END = "<pad>", "<s>", "</s>"
_SIZES = {"width", "depth", "mlp", "head", "vision"}
_GEMMA_HEADS = 8
"""Heads of attention, which LeRobot's pi0.5 has written into its code."""
_CLIP_HEADS = {"hidden", "layers", "heads", "patch"}


@dataclass(frozen=True)
class ClipShape:
    """Architecture of a CLIP."""

    vision: CLIPVisionConfig
    text: CLIPTextConfig

    def new(self) -> contextlib.AbstractContextManager[None]:
        """Let LeRobot's flow matching build its encoders with new weights."""
        return clip_from(lambda: CLIPVisionModel(self.vision), lambda: CLIPTextModel(self.text))

    def whole(self) -> CLIPConfig:
        """Configuration as transformers write it."""
        width = self.vision.hidden_size
        parts = {"text_config": self.text.to_dict(), "vision_config": self.vision.to_dict()}
        return CLIPConfig.from_dict({**parts, "projection_dim": width})


class _Made:
    """Stands for a class of transformers: gives what was made already."""

    def __init__(self, make: Callable[[], object]):
        self._make = make

    def from_pretrained(self, *_: object, **__: object) -> object:
        """Object that was made, whatever the name."""
        return self._make()


@contextlib.contextmanager
def _replaced(module: ModuleType, **names: object) -> Iterator[None]:
    kept = {name: getattr(module, name) for name in names}
    try:
        for name, value in names.items():
            setattr(module, name, value)
        yield
    finally:
        for name, value in kept.items():
            setattr(module, name, value)


@contextlib.contextmanager
def clip_from(vision: Callable[[], torch.nn.Module], text: Callable[[], torch.nn.Module]) -> Iterator[None]:
    """Let LeRobot's flow matching build its encoders with these."""
    with _replaced(modeling_multi_task_dit, CLIPVisionModel=_Made(vision), CLIPTextModel=_Made(text)):
        yield


@contextlib.contextmanager
def tokenizer_from(tokenizer: PreTrainedTokenizerBase) -> Iterator[None]:
    """Let LeRobot's processors tokenize with this one."""
    with _replaced(tokenizer_processor, AutoTokenizer=_Made(lambda: tokenizer)):
        yield


def made_clip(sizes: Mapping[str, int], picture: int, tokens: int, tokenizer: PreTrainedTokenizerBase) -> ClipShape:
    """Architecture of a CLIP that is trained from new weights.

    Args:
        sizes: `hidden` width, `layers`, `heads`, `patch` [px].
        picture: Width and height [px].
        tokens: Longest instruction.

    Raises:
        InputError: A size is missing or cannot be.
    """
    if set(sizes) != _CLIP_HEADS or sizes["hidden"] % sizes["heads"] or picture % sizes["patch"]:
        raise InputError(f"clip {dict(sizes)}: expected {', '.join(sorted(_CLIP_HEADS))} that divide each other")
    common = {
        "hidden_size": sizes["hidden"],
        "intermediate_size": 4 * sizes["hidden"],
        "num_hidden_layers": sizes["layers"],
        "num_attention_heads": sizes["heads"],
    }
    text = CLIPTextConfig.from_dict(
        {
            **common,
            "vocab_size": len(tokenizer),
            "max_position_embeddings": tokens,
            "pad_token_id": tokenizer.pad_token_id,
            "bos_token_id": tokenizer.bos_token_id,
            "eos_token_id": tokenizer.eos_token_id,
        }
    )
    vision = CLIPVisionConfig.from_dict({**common, "image_size": picture, "patch_size": sizes["patch"]})
    return ClipShape(vision, text)


def made_tokenizer(vocabulary: int = VOCABULARY) -> PreTrainedTokenizerFast:
    """A tokenizer of bytes, with the words of the paper's instructions: every text can be read."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=vocabulary,
        special_tokens=[_PADDING, _BEGIN, _END],
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    tokenizer.train_from_iterator([tasks.get(name).instruction for name in tasks.PAPER], trainer)
    ends = [(_BEGIN, tokenizer.token_to_id(_BEGIN)), (_END, tokenizer.token_to_id(_END))]
    tokenizer.post_processor = processors.TemplateProcessing(single=f"{_BEGIN} $A {_END}", special_tokens=ends)
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token=_PADDING,
        bos_token=_BEGIN,
        eos_token=_END,
        clean_up_tokenization_spaces=False,
    )


def read_clip(folder: Path) -> ClipShape:
    """Architecture of the CLIP in a folder.

    Raises:
        InputError: There is none.
    """
    if not (folder / "config.json").is_file():
        raise InputError(f"{folder}: holds no CLIP (no config.json)")
    try:
        config = CLIPConfig.from_pretrained(folder, local_files_only=True)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{folder}: holds no CLIP ({str(error).splitlines()[0]})") from None
    vision, text = config.vision_config, config.text_config
    if config.model_type != "clip" or not isinstance(vision, CLIPVisionConfig) or not isinstance(text, CLIPTextConfig):
        raise InputError(f"{folder}: holds no CLIP, but a {config.model_type}")
    return ClipShape(vision, text)


def read_tokenizer(folder: Path) -> PreTrainedTokenizerBase:
    """The tokenizer in a folder.

    Raises:
        InputError: There is none.
    """
    try:
        found = AutoTokenizer.from_pretrained(folder, local_files_only=True)
    except Exception as error:  # the libraries below raise what they like
        raise InputError(f"{folder}: holds no tokenizer ({str(error).splitlines()[0]})") from None
    if not isinstance(found, PreTrainedTokenizerBase):
        raise InputError(f"{folder}: holds no tokenizer, but a {type(found).__name__}")
    return found


def write_clip(folder: Path, shape: ClipShape, vision: torch.nn.Module | None, text: torch.nn.Module | None) -> None:
    """Write the architecture of a CLIP, and with `vision` and `text` its weights, as transformers read them."""
    if vision is None or text is None:
        shape.whole().save_pretrained(folder)
        return
    model = CLIPModel(shape.whole())
    tensors = {**vision.state_dict(), **text.state_dict()}
    model.load_state_dict({name: value.cpu() for name, value in tensors.items()}, strict=False)
    shown = transformers_logging.is_progress_bar_enabled()
    transformers_logging.disable_progress_bar()  # of a training that shows one of its own
    try:
        model.save_pretrained(folder)
    finally:
        if shown:
            transformers_logging.enable_progress_bar()


@contextlib.contextmanager
def gemma_of(sizes: Mapping[str, int]) -> Iterator[None]:
    """Let LeRobot build pi0.5 at another size than its own two.

    Args:
        sizes: `width`, `depth`, `mlp` of both transformers, width of a `head` of their attention, width of `vision`.

    Raises:
        InputError: A size is missing or cannot be.
    """
    if set(sizes) != _SIZES or not all(isinstance(size, int) and 1 <= size <= 4096 for size in sizes.values()):
        raise InputError(f"gemma {dict(sizes)}: expected {', '.join(sorted(_SIZES))} from 1 to 4096")
    own = modeling_pi05.PaliGemmaForConditionalGenerationWithPiGemma
    expert = modeling_pi05.PiGemmaForCausalLM
    made = modeling_pi05.GemmaConfig(
        width=sizes["width"],
        depth=sizes["depth"],
        mlp_dim=sizes["mlp"],
        num_heads=_GEMMA_HEADS,
        num_kv_heads=1,
        head_dim=sizes["head"],
    )

    def seeing(config: object) -> torch.nn.Module:
        _put(config, image_token_index=VOCABULARY, _vocab_size=VOCABULARY, projection_dim=sizes["width"])
        _put(_part(config, "text_config"), vocab_size=VOCABULARY, pad_token_id=None)
        width = sizes["vision"]
        _put(_part(config, "vision_config"), hidden_size=width, intermediate_size=2 * width, num_hidden_layers=1)
        _put(_part(config, "vision_config"), num_attention_heads=2, projection_dim=sizes["width"])
        found: torch.nn.Module = own(config=config)
        return found

    def acting(config: object) -> torch.nn.Module:
        _put(config, vocab_size=VOCABULARY, pad_token_id=None)
        found: torch.nn.Module = expert(config=config)
        return found

    with _replaced(
        modeling_pi05,
        get_gemma_config=lambda variant: made,
        PaliGemmaForConditionalGenerationWithPiGemma=seeing,
        PiGemmaForCausalLM=acting,
    ):
        yield


def _part(config: object, name: str) -> object:
    return getattr(config, name)


def _put(config: object, **values: object) -> None:
    for name, value in values.items():
        setattr(config, name, value)


@contextlib.contextmanager
def checkpoint_encoders(folder: Path) -> Iterator[None]:
    """Let LeRobot build the policy of a checkpoint, and its processors, with what the checkpoint holds.

    CLIP is built without its weights: those of the checkpoint are loaded over it. Nothing changes for a checkpoint
    without these files.

    Raises:
        InputError: A file is damaged.
    """
    with contextlib.ExitStack() as stack:
        if (folder / CLIP_FOLDER / "config.json").is_file():
            stack.enter_context(read_clip(folder / CLIP_FOLDER).new())
        if (folder / TOKENIZER_FOLDER).is_dir():
            stack.enter_context(tokenizer_from(read_tokenizer(folder / TOKENIZER_FOLDER)))
        if (folder / GEMMA_FILE).is_file():
            stack.enter_context(gemma_of(read_object(folder / GEMMA_FILE, limits.MIB)))
        yield
