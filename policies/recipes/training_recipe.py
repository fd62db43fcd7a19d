"""Training recipe of a policy: one record, by family and name.

`paper` is read from the file of the family, a configuration of LeRobot's own trainer, so that both trainers have the
same numbers. The other recipes say only what they change (docs/howto/train/recipes.md gives the reasons).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from arena_newton.errors import InputError

__all__ = ["FAMILIES", "REALIGN", "RECIPES", "TrainingRecipe", "paper_file", "recipe", "with_pretrained"]

FAMILIES: dict[str, str] = {
    "act": "act",
    "diffusion": "diffusion",
    "flow": "multi_task_dit",
    "pi05": "pi05",
}
"""Family → LeRobot's type of policy."""
RECIPES: dict[str, tuple[str, ...]] = {
    "paper": tuple(FAMILIES),
    "released": tuple(FAMILIES),
    "fast": tuple(FAMILIES),
    "small": tuple(FAMILIES),
    "compact": ("act",),
}
"""Recipe → families that have it."""
BETAS = (0.9, 0.999)
"""Betas of AdamW where the policy's configuration has none: LeRobot's `AdamWConfig`."""
GRAD_CLIP = 10.0
"""Norm of the gradient where the policy's configuration has none: LeRobot's `AdamConfig`, `AdamWConfig`."""
REALIGN = 0.002
"""Fraction of the gap to the measured heading that is closed each tick, of labels of v4: the experts' own rate."""
_OPTIMIZER_FIELDS = ("optimizer_", "scheduler_")
_SCHEDULES = ("constant", "cosine")
_PRECISIONS = ("float32", "bfloat16")


@dataclass(frozen=True)
class TrainingRecipe:
    """Everything that a training does not take from its data."""

    family: str
    name: str
    network: Mapping[str, object] = field(default_factory=dict)
    """Fields of LeRobot's configuration of the policy, without those of optimizer and schedule."""
    labels: str = "v3.1"
    """Protocol of the actions that are learned (`data.readers.label_protocols`)."""
    realign: float = 0.0
    """Fraction of the gap from the commanded to the measured heading that execution closes each tick; of v4 only."""
    steps: int = 100_000
    """Optimizer steps."""
    batch_size: int = 64
    lr: float = 1e-4
    """Highest learning rate."""
    lr_backbone: float = 1e-4
    """Highest learning rate of the vision encoder."""
    optimizer: str = "adamw"
    """`adamw`, or `adam`, whose decay is part of the gradient."""
    weight_decay: float = 0.0
    betas: tuple[float, float] = BETAS
    eps: float = 1e-8
    warmup_steps: int = 0
    """Steps in which the learning rate grows linearly."""
    schedule: str = "constant"
    """`constant` or `cosine`."""
    final_lr_fraction: float = 0.0
    """Learning rate at the end of the cosine, as a fraction of the highest."""
    decay_steps: int = 0
    """Steps at which the cosine ends, the learning rate stays constant after it; 0: those of the training."""
    grad_clip: float = GRAD_CLIP
    """Largest norm of the gradient."""
    precision: str = "float32"
    """`float32`, or `bfloat16` of autocast (of pi0.5: of the weights)."""
    seed: int = 42
    chunk: int = 20
    """Actions that are executed without a new query."""
    horizon: int = 20
    """Actions that the network predicts."""
    picture: int = 224
    """Width and height of the datasets' pictures [px]."""
    cut_pad: bool = False
    """The network sees the 4:3 picture without the black rows around it."""
    shift_px: int = 0
    """Training pictures are shifted by up to this in each direction [px]."""
    colour: float = 0.0
    """Brightness and each colour of training pictures are scaled by up to this fraction."""
    image_transforms: bool = False
    """Training pictures have LeRobot's default image transforms (`train.image_transforms`)."""
    batch_norm: bool = False
    """ACT's vision encoder is normalised by its batches. LeRobot's has the statistics of its pretrained weights, and
    without such weights none."""
    frozen_norms: float = 0.0
    """Last fraction of the steps in which the vision encoder is normalised by the statistics that it has when it plays,
    those of the pictures before; of `batch_norm` alone."""
    use_task_vector: bool = False
    """The one-hot vector of the task is an input, `observation.environment_state`."""
    state_std_floor: float = 1e-3
    """Smallest standard deviation, and half of the smallest range, by which a number of the state is divided."""
    action_std_floor: float = 1e-4
    """The same of the action."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: One cannot be; the message names the recipe and the field.
        """
        at = f"recipe {self.family}/{self.name}"
        for name in ("steps", "batch_size", "chunk", "horizon"):
            if getattr(self, name) < 1:
                raise InputError(f"{at}: {name} is {getattr(self, name)}, expected at least 1")
        for name in ("lr", "state_std_floor", "action_std_floor", "grad_clip", "eps"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"{at}: {name} is {getattr(self, name)}, expected a positive number")
        for name in ("lr_backbone", "weight_decay", "warmup_steps", "decay_steps", "shift_px"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise InputError(f"{at}: {name} is {getattr(self, name)}, expected 0 or more")
        for name in ("realign", "final_lr_fraction", "colour", "frozen_norms"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"{at}: {name} is {getattr(self, name)}, expected 0 to 1")
        choices = {"schedule": _SCHEDULES, "precision": _PRECISIONS, "optimizer": ("adam", "adamw")}
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise InputError(f"{at}: {name} is {getattr(self, name)!r}, choose from {', '.join(allowed)}")
        if self.horizon < self.chunk:
            raise InputError(f"{at}: horizon is {self.horizon}, less than chunk {self.chunk}")
        if not 16 <= self.picture <= 4096:
            raise InputError(f"{at}: picture is {self.picture}, expected 16 to 4096")

    @property
    def type(self) -> str:
        """LeRobot's name of the policy."""
        return FAMILIES[self.family]

    @property
    def height(self) -> int:
        """Height of the picture that the network sees [px]; its width is `picture`."""
        return self.picture * 3 // 4 if self.cut_pad else self.picture

    def lr_factor(self, step: int) -> float:
        """Factor of the learning rates in the step of a number, the first being 0.

        The same as LeRobot's schedulers: of diffusers for `diffusion` and `flow`, of openpi for `pi05`, whose warm-up
        does not begin at 0.
        """
        warmup, end = self.warmup_steps, self.decay_steps or self.steps
        if self.family == "pi05" and self.steps < end:
            warmup, end = int(warmup * self.steps / end), self.steps
        openpi = self.family == "pi05"
        if step < warmup:
            begin = 1.0 / (warmup + 1) if openpi else 0.0
            return begin + (1.0 - begin) * step / warmup
        if self.schedule == "constant":
            return 1.0
        begin = 0 if openpi else warmup
        progress = min(1.0, (step - begin) / max(1, end - begin))
        low = self.final_lr_fraction
        return low + (1.0 - low) * 0.5 * (1.0 + math.cos(math.pi * progress))


def paper_file(family: str) -> Path:
    """The configuration of LeRobot's trainer with the paper's settings.

    Raises:
        InputError: There is no such family.
    """
    if family not in FAMILIES:
        raise InputError(f"--policy {family}: unknown, choose from {', '.join(FAMILIES)}")
    return Path(__file__).with_name(f"{family}_paper.json")


def recipe(family: str, name: str = "fast", **overrides: object) -> TrainingRecipe:
    """The recipe of a family and a name.

    Args:
        family: A key of `FAMILIES`.
        name: A key of `RECIPES`.
        overrides: Fields of `TrainingRecipe` that differ; those of `network` are put over the recipe's.

    Raises:
        InputError: There is no such family, recipe or field, or a value cannot be.
    """
    paper = _read_paper(family)
    if name not in RECIPES or family not in RECIPES[name]:
        known = ", ".join(one for one, families in RECIPES.items() if family in families)
        raise InputError(f"--recipe {name}: unknown for --policy {family}, choose from {known}")
    for layer in (_CHANGES.get(("*", name), {}), _CHANGES.get((family, name), {}), {"name": name}, overrides):
        paper = _changed(paper, layer)
    return paper


def with_pretrained(recipe: TrainingRecipe) -> TrainingRecipe:
    """The recipe for a vision encoder that begins with `--weights`.

    Where the paper's recipe tunes a pretrained encoder more slowly than the rest (flow matching: LeRobot's
    `vision_encoder_lr_multiplier` 0.1 of 2e-5), the encoder has that learning rate, whatever the recipe gives new
    weights: the rest's would wash out what CLIP knows.
    """
    paper = _read_paper(recipe.family)
    if paper.lr_backbone >= paper.lr:
        return recipe
    return replace(recipe, lr_backbone=min(recipe.lr_backbone, paper.lr_backbone))


def _changed(recipe: TrainingRecipe, changes: Mapping[str, object]) -> TrainingRecipe:
    known = {one.name for one in fields(TrainingRecipe)}
    for name in changes:
        if name not in known:
            raise InputError(f"recipe {recipe.family}/{recipe.name}: no field {name}, choose from {', '.join(known)}")
    network = changes.get("network", {})
    if not isinstance(network, Mapping):
        raise InputError(f"recipe {recipe.family}/{recipe.name}: network is {network!r}, expected names and values")
    return replace(recipe, **(dict(changes) | {"network": {**recipe.network, **network}}))  # type: ignore[arg-type]


def _read_paper(family: str) -> TrainingRecipe:
    """The paper's recipe, from LeRobot's configuration."""
    path = paper_file(family)
    content = json.loads(path.read_text())
    policy = content["policy"]
    network = {
        name: value for name, value in policy.items() if name != "type" and not name.startswith(_OPTIMIZER_FIELDS)
    }
    transforms = content["dataset"]["image_transforms"]
    if set(transforms) != {"enable"}:
        raise InputError(f"{path}: dataset.image_transforms: only LeRobot's defaults are known, with the field enable")
    lr = policy["optimizer_lr"]
    backbone = policy.get("optimizer_lr_backbone", lr * policy.get("vision_encoder_lr_multiplier", 1.0))
    return TrainingRecipe(
        family=family,
        name="paper",
        network=network,
        steps=content["steps"],
        batch_size=content["batch_size"],
        lr=lr,
        lr_backbone=backbone,
        optimizer="adam" if family in ("diffusion", "flow") else "adamw",
        weight_decay=policy["optimizer_weight_decay"],
        betas=tuple(policy.get("optimizer_betas", BETAS)),
        warmup_steps=policy.get("scheduler_warmup_steps", 0),
        schedule="constant" if family == "act" else "cosine",
        final_lr_fraction=policy.get("scheduler_decay_lr", 0.0) / lr,
        decay_steps=policy.get("scheduler_decay_steps", 0),
        grad_clip=policy.get("optimizer_grad_clip_norm", GRAD_CLIP),
        precision=policy.get("dtype", "float32"),
        seed=content["seed"],
        chunk=policy["n_action_steps"],
        horizon=policy.get("horizon", policy.get("chunk_size")),
        image_transforms=transforms["enable"],
    )


_FAST: dict[str, object] = {
    "labels": "v4",
    "realign": REALIGN,
    "steps": 15_000,
    "lr": 1e-4,
    "lr_backbone": 1e-4,
    "optimizer": "adamw",
    "weight_decay": 1e-4,
    "betas": BETAS,
    "warmup_steps": 500,
    "schedule": "cosine",
    "final_lr_fraction": 0.01,
    "decay_steps": 0,
    "precision": "bfloat16",
    "shift_px": 6,
    "colour": 0.1,
    "image_transforms": False,
}
"""Settings measured for ACT (60 of 60 episodes of VisNavi after three GPU minutes)."""
_BY_DEVIATION = {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
"""Every number by its standard deviation. By its range, as the paper has it, the turning of labels v4 is a seventh of
the range and a fiftieth of the squared error that walking legs have: policies walked and did not steer."""
_SMALL: dict[str, object] = {
    "steps": 4,
    "batch_size": 2,
    "lr": 1e-4,
    "lr_backbone": 1e-4,
    "warmup_steps": 1,
    "schedule": "cosine",
    "decay_steps": 0,
    "final_lr_fraction": 0.01,
    "precision": "float32",
    "labels": "v4",
    "realign": REALIGN,
    "picture": 64,
    "shift_px": 2,
    "colour": 0.1,
    "image_transforms": False,
}
_SMALL_CLIP = {"hidden": 32, "layers": 1, "heads": 2, "patch": 16}
_CHANGES: dict[tuple[str, str], dict[str, object]] = {
    # The original's files, `lerobot/configs/humanoidarena_batch_train/{act,dp,mtp,pi05}.json` of its code: what
    # they set otherwise than the paper's table, or leave at LeRobot's default. ACT's agrees with the table.
    ("diffusion", "released"): {"network": {"drop_n_last_frames": 7}},
    ("flow", "released"): {"steps": 50_000},
    ("pi05", "released"): {
        "batch_size": 8,
        "image_transforms": False,
        "network": {"freeze_vision_encoder": True},
    },
    ("*", "fast"): _FAST,
    ("act", "fast"): {
        "batch_norm": True,
        "cut_pad": True,
        "network": {"pretrained_backbone_weights": None, "use_vae": False},
    },
    ("diffusion", "fast"): {
        "cut_pad": True,
        "weight_decay": 1e-6,
        "betas": (0.95, 0.999),
        "network": {
            "pretrained_backbone_weights": None,
            "down_dims": [256, 512, 1024],
            "noise_scheduler_type": "DDIM",
            "num_inference_steps": 10,
            "normalization_mapping": _BY_DEVIATION,
            "prediction_type": "sample",
            "clip_sample": False,
        },
    },
    ("flow", "fast"): {
        "betas": (0.95, 0.999),
        "network": {
            "num_integration_steps": 10,
            "normalization_mapping": _BY_DEVIATION,
            "clip": {"hidden": 384, "layers": 6, "heads": 6, "patch": 16},
        },
    },
    # A pretrained network of 3.6 billion parameters is tuned: its own learning rate, decay and gradient norm stay.
    ("pi05", "fast"): {"lr": 2.5e-5, "lr_backbone": 2.5e-5, "weight_decay": 0.01, "betas": (0.9, 0.95)},
    ("*", "compact"): _FAST,
    ("act", "compact"): {
        "batch_norm": True,
        "frozen_norms": 0.3,
        "cut_pad": True,
        "use_task_vector": True,
        "network": {
            "pretrained_backbone_weights": None,
            "dim_model": 256,
            "n_heads": 8,
            "dim_feedforward": 1024,
            "use_vae": False,
        },
    },
    ("*", "small"): _SMALL,
    ("act", "small"): {
        "batch_norm": True,
        "network": {
            "pretrained_backbone_weights": None,
            "dim_model": 32,
            "n_heads": 2,
            "dim_feedforward": 64,
            "n_encoder_layers": 1,
            "n_vae_encoder_layers": 1,
            "latent_dim": 8,
        },
    },
    ("diffusion", "small"): {
        "network": {
            "pretrained_backbone_weights": None,
            "down_dims": [16, 32, 64],
            "diffusion_step_embed_dim": 16,
            "spatial_softmax_num_keypoints": 8,
            "noise_scheduler_type": "DDIM",
            "num_inference_steps": 2,
        },
    },
    ("flow", "small"): {
        "network": {
            "hidden_dim": 32,
            "num_layers": 1,
            "num_heads": 2,
            "timestep_embed_dim": 16,
            "num_integration_steps": 2,
            "tokenizer_max_length": 32,
            "clip": _SMALL_CLIP,
        },
    },
    ("pi05", "small"): {
        "network": {
            "image_resolution": [64, 64],
            "num_inference_steps": 2,
            "gradient_checkpointing": False,
            "tokenizer_max_length": 384,
            "gemma": {"width": 32, "depth": 1, "mlp": 64, "head": 8, "vision": 32},
        },
    },
}
"""Changes of a recipe to the paper's: of all families, then of one."""
