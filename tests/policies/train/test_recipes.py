"""Recipes: the paper's table, LeRobot's own trainer reads and runs them, what the others change."""

import functools
import json
import re
import sys
from dataclasses import fields, replace
from pathlib import Path

import draccus
import lerobot.policies  # noqa: F401  # registers the configurations of policies
import numpy as np
import pytest
import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.scripts import lerobot_train

from arena_newton.data.readers.label_protocols import LABELS
from arena_newton.errors import InputError
from arena_newton.policies.recipes.training_recipe import FAMILIES, RECIPES, TrainingRecipe, paper_file, recipe
from arena_newton.policies.train.policy_options import PolicyTrainOptions, check_numbers
from arena_newton.policies.train.training import chosen_recipe

TABLE = {
    "act": {"lr": 1.0e-5, "chunk": 20, "horizon": 20, "precision": "float32"},
    "diffusion": {"lr": 1.0e-4, "chunk": 20, "horizon": 24, "precision": "float32"},
    "flow": {"lr": 2.0e-5, "chunk": 20, "horizon": 40, "precision": "float32"},
    "pi05": {"lr": 2.5e-5, "chunk": 20, "horizon": 20, "precision": "bfloat16"},
}
"""Table "Training configurations of policy baselines" of the paper's appendix; common to all: batch 64, 100K steps,
seed 42, one observation."""
ALL = [(family, name) for name, families in RECIPES.items() for family in families]


@functools.cache
def parsed(family):
    """The file as LeRobot's trainer reads it."""
    return draccus.decode(TrainPipelineConfig, json.loads(paper_file(family).read_text()))


@pytest.mark.parametrize("family", FAMILIES)
def test_paper_file_has_the_papers_numbers(family):
    """LeRobot's trainer reads the file, and every number of the paper's table is in it."""
    config, row = parsed(family), TABLE[family]
    policy, optimizer = config.policy, config.policy.get_optimizer_preset()
    assert (config.batch_size, config.steps, config.seed, policy.n_obs_steps) == (64, 100_000, 42, 1)
    assert policy.type == FAMILIES[family] and optimizer.lr == row["lr"]
    assert policy.n_action_steps == row["chunk"]
    assert (getattr(policy, "horizon", None) or policy.chunk_size) == row["horizon"]
    assert getattr(policy, "dtype", "float32") == row["precision"] and not policy.use_amp
    assert config.dataset.image_transforms.enable == (family == "pi05")
    assert config.use_policy_training_preset and config.env_eval_freq == 0 and not policy.push_to_hub
    match family:
        case "act":
            assert policy.vision_backbone == "resnet18" and policy.pretrained_backbone_weights
        case "diffusion":
            assert policy.vision_backbone == "resnet18" and policy.pretrained_backbone_weights
            assert policy.drop_n_last_frames == policy.horizon - policy.n_action_steps - policy.n_obs_steps + 1
        case "flow":
            assert policy.objective == "flow_matching" and policy.vision_encoder_name == "openai/clip-vit-base-patch16"
            assert policy.image_crop_shape is None and policy.drop_n_last_frames == 20
        case "pi05":
            assert str(policy.pretrained_path) == "lerobot/pi05_base"
            assert policy.max_action_dim >= 40 and policy.max_state_dim >= 64 and policy.tokenizer_max_length >= 320


@pytest.mark.parametrize("family", FAMILIES)
def test_paper_recipe_is_the_file(family):
    """Our trainer's recipe has the file's numbers, optimizer and schedule included."""
    found, config = recipe(family, "paper"), parsed(family)
    optimizer, scheduler = config.policy.get_optimizer_preset(), config.policy.get_scheduler_preset()
    assert (found.steps, found.batch_size, found.seed) == (config.steps, config.batch_size, config.seed)
    assert (found.lr, found.weight_decay, found.eps) == (optimizer.lr, optimizer.weight_decay, optimizer.eps)
    assert found.betas == tuple(optimizer.betas) and found.grad_clip == optimizer.grad_clip_norm
    assert found.optimizer == {"AdamConfig": "adam", "AdamWConfig": "adamw"}[type(optimizer).__name__]
    assert {name: getattr(found, name) for name in TABLE[family]} == TABLE[family]
    assert (found.labels, found.shift_px, found.colour, found.batch_norm) == ("v3.1", 0, 0.0, False)
    parameter = torch.nn.Parameter(torch.zeros(1))
    for steps in (found.steps, 5_000):
        ours = replace(found, steps=steps)
        made = torch.optim.SGD([parameter], lr=1.0)
        theirs = scheduler.build(made, steps).lr_lambdas[0] if scheduler else lambda step: 1.0
        for step in (0, 1, 100, 499, 500, 999, 1000, 2500, 4999, 29_999, 30_000, 60_000, 99_999):
            if step < steps:
                assert ours.lr_factor(step) == pytest.approx(theirs(step), abs=1e-9), (steps, step)


def test_the_papers_table(shared):
    """The numbers above are those of the paper's source."""
    text = (shared / "paper" / "humanoidarena.tex").read_text()
    table = text[text.index(r"\label{tab:policy_training_config}") :].split(r"\end{table*}")[0]
    rows = {}
    for line in table.split(r"\\"):
        cells = [
            re.sub(r"[$\s]|\\midrule|\\times10\^", lambda m: "e" if "times" in m[0] else "", c) for c in line.split("&")
        ]
        if len(cells) == 5:
            rows[cells[0]] = [cell.replace("{", "").replace("}", "") for cell in cells[1:]]
    families = list(TABLE)
    assert [float(cell) for cell in rows["Learningrate"]] == [TABLE[family]["lr"] for family in families]
    assert (
        rows["Batchsize"] == ["64"] * 4 and rows["Trainingsteps"] == ["100K"] * 4 and rows["Randomseed"] == ["42"] * 4
    )
    assert rows["Actionchunklength"] == rows["Inferenceactionsteps"] == ["20"] * 4
    assert rows["Policyhorizon"] == ["--", "24", "40", "--"] and rows["Observationsteps"] == ["1"] * 4
    assert rows["Precision"] == [TABLE[family]["precision"] for family in families]


@pytest.mark.parametrize(("family", "name"), ALL)
def test_every_recipe_is_complete(family, name):
    """Each can be made, says its name, and has a protocol that exists."""
    found = recipe(family, name)
    assert (found.family, found.name) == (family, name)
    assert found.labels in LABELS and found.horizon >= found.chunk
    assert found.lr_factor(found.steps - 1) <= 1.0
    if name == "fast":
        assert (found.labels, found.realign, found.steps, found.precision) == ("v4", 0.002, 15_000, "bfloat16")
        assert (found.warmup_steps, found.schedule, found.shift_px, found.colour) == (500, "cosine", 6, 0.1)
        assert found.lr_factor(500) == pytest.approx(1.0, abs=0.01)
        assert found.lr_factor(15_000) == pytest.approx(found.final_lr_fraction)


RELEASED = {
    "act": (64, 100_000, 0, False),
    "diffusion": (64, 100_000, 7, False),
    "flow": (64, 50_000, 20, False),
    "pi05": (8, 100_000, 0, True),
}
"""Batch of a process, steps, frames without a sample at an episode's end, frozen vision encoder: of the original's
`lerobot/configs/humanoidarena_batch_train/{act,dp,mtp,pi05}.json`, LeRobot's default where they set none."""


@pytest.mark.parametrize("family", FAMILIES)
def test_the_released_recipe_is_the_originals_files(family):
    """`released` has what the original's stored files say otherwise than the paper's table, and nothing else."""
    found, paper = recipe(family, "released"), recipe(family, "paper")
    frozen = bool(found.network.get("freeze_vision_encoder"))
    dropped = found.network.get("drop_n_last_frames", 0)
    assert (found.batch_size, found.steps, dropped, frozen) == RELEASED[family] and not found.image_transforms
    changed = {"name", "batch_size", "steps", "network", "image_transforms"}
    for one in fields(TrainingRecipe):
        assert one.name in changed or getattr(found, one.name) == getattr(paper, one.name), one.name
    other = {name for name, value in found.network.items() if value != paper.network[name]}
    assert other == {"diffusion": {"drop_n_last_frames"}, "pi05": {"freeze_vision_encoder"}}.get(family, set())
    if family == "diffusion":
        assert DiffusionConfig().drop_n_last_frames == found.network["drop_n_last_frames"]


def test_fast_act_is_what_was_measured():
    """ACT's fast recipe: BatchNorm, no pretrained weights, no latent, no pad, learning rate and weight decay 1e-4."""
    found = recipe("act", "fast")
    assert found.batch_norm and found.network["pretrained_backbone_weights"] is None
    assert (found.lr, found.lr_backbone, found.weight_decay, found.grad_clip) == (1e-4, 1e-4, 1e-4, 10.0)
    assert found.network["dim_model"] == 512 and not found.network["use_vae"]
    assert (found.picture, found.height) == (224, 168) and recipe("act", "paper").height == 224


@pytest.mark.parametrize(
    ("arguments", "overrides", "match"),
    [
        (("vqbet", "fast"), {}, "--policy vqbet: unknown, choose from act, diffusion, flow, pi05"),
        (
            ("act", "quick"),
            {},
            "--recipe quick: unknown for --policy act, choose from paper, released, fast, small, compact",
        ),
        (("flow", "compact"), {}, "--recipe compact: unknown for --policy flow"),
        (("act", "fast"), {"stepz": 3}, "no field stepz"),
        (("act", "fast"), {"steps": 0}, "steps is 0, expected at least 1"),
        (("act", "fast"), {"lr": float("nan")}, "lr is nan, expected a positive number"),
        (("act", "fast"), {"schedule": "step"}, "schedule is 'step', choose from constant, cosine"),
        (("act", "fast"), {"colour": 2.0}, "colour is 2.0, expected 0 to 1"),
        (("diffusion", "fast"), {"chunk": 30}, "horizon is 24, less than chunk 30"),
        (("act", "fast"), {"network": 3}, "network is 3"),
    ],
)
def test_what_cannot_be_is_refused(arguments, overrides, match):
    """One clear error names flag or field."""
    with pytest.raises(InputError, match=re.escape(match)):
        recipe(*arguments, **overrides)


def test_overrides_are_put_over_the_recipe():
    """Fields replace, those of the network are added."""
    found = recipe("act", "fast", steps=7, network={"dropout": 0.0})
    assert (found.steps, found.network["dropout"], found.network["dim_model"]) == (7, 0.0, 512)
    assert isinstance(found, TrainingRecipe) and recipe("act", "fast").steps == 15_000


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ({"policy": "act", "recipe": "paper", "labels": "v4"}, ("v4", 0.002, 1e-5, 1e-5)),
        ({"policy": "act", "recipe": "fast", "labels": "v4"}, ("v4", 0.002, 1e-4, 1e-4)),
        ({"policy": "act", "recipe": "fast", "labels": "v3.1"}, ("v3.1", 0.0, 1e-4, 1e-4)),
        ({"policy": "flow", "recipe": "paper", "lr": 1e-3}, ("v3.1", 0.0, 1e-3, 1e-4)),
    ],
)
def test_flags_change_what_belongs_together(flags, expected):
    """--labels v4 has a realign with every recipe, and --lr keeps the ratio of the encoder's learning rate."""
    found = chosen_recipe(PolicyTrainOptions(**flags))
    labels, *rates = expected
    assert found.labels == labels
    assert [found.realign, found.lr, found.lr_backbone] == pytest.approx(rates)


def test_values_of_a_recipe_are_flags():
    """--recipe-values changes fields that have no flag of their own, and those of the network, and no others."""
    values = ("frozen_norms=0.5", "shift_px=0", "schedule=constant", "network.dim_model=128")
    found, usual = chosen_recipe(PolicyTrainOptions(recipe="compact", recipe_values=values)), recipe("act", "compact")
    assert (found.frozen_norms, found.shift_px, found.schedule) == (0.5, 0, "constant")
    assert found.network == {**usual.network, "dim_model": 128}
    same = {"frozen_norms": 0.3, "shift_px": usual.shift_px, "schedule": "cosine", "network": usual.network}
    assert replace(found, **same) == usual
    with pytest.raises(InputError, match="--recipe-values: nope is not an option"):
        check_numbers(PolicyTrainOptions(recipe_values=("nope=1",)))  # before the libraries are loaded


@pytest.mark.parametrize(
    ("flags", "rates"),
    [
        ({"policy": "flow", "weights": "a/clip"}, (1e-4, 2e-6)),
        ({"policy": "flow", "weights": "a/clip", "lr": 5e-5}, (5e-5, 1e-6)),
        ({"policy": "flow", "weights": "a/clip", "recipe": "paper"}, (2e-5, 2e-6)),
        ({"policy": "flow"}, (1e-4, 1e-4)),
        ({"policy": "act", "weights": "a/resnet"}, (1e-4, 1e-4)),
        ({"policy": "diffusion", "weights": "a/resnet"}, (1e-4, 1e-4)),
        ({"policy": "pi05", "weights": "a/base"}, (2.5e-5, 2.5e-5)),
    ],
)
def test_a_pretrained_encoder_is_tuned_as_slowly_as_the_papers(flags, rates):
    """With --weights CLIP has the paper's learning rate, 2e-6; new weights, and families without one, the recipe's."""
    found = chosen_recipe(PolicyTrainOptions(**flags))
    assert [found.lr, found.lr_backbone] == pytest.approx(rates)


def test_recipe_files_are_in_the_wheel():
    """The files are next to the module, in the folder that the wheel packs."""
    package = Path(__import__("arena_newton").__file__).parent
    for family in FAMILIES:
        file = package / "policies" / "recipes" / f"{family}_paper.json"
        assert file.is_file() and json.loads(file.read_text())["policy"]["type"] == FAMILIES[family]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A LeRobot dataset of two short episodes with small pictures."""
    root = tmp_path_factory.mktemp("made") / "dataset"
    features = {
        "observation.images.front": {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (64,), "names": None},
        "action": {"dtype": "float32", "shape": (40,), "names": None},
    }
    made = LeRobotDataset.create("local/made", fps=50, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for _ in range(2):
        for _ in range(24):
            made.add_frame(
                {
                    "observation.images.front": rng.integers(0, 256, (64, 64, 3), dtype=np.uint8),
                    "observation.state": rng.normal(size=64).astype(np.float32),
                    "action": rng.normal(size=40).astype(np.float32),
                    "task": "Open the door.",
                }
            )
        made.save_episode()
    made.finalize()
    return root


def test_lerobots_trainer_runs_the_paper_recipe(dataset, tmp_path, monkeypatch):
    """`lerobot-train --config_path act_paper.json` trains two steps and writes a checkpoint, at a size for a CPU."""
    out = tmp_path / "out"
    flags = {
        "config_path": paper_file("act"),
        "dataset.repo_id": "local/made",
        "dataset.root": dataset,
        "output_dir": out,
        "policy.device": "cpu",
        "policy.pretrained_backbone_weights": "null",
        "policy.dim_model": 32,
        "policy.n_heads": 2,
        "policy.dim_feedforward": 64,
        "steps": 2,
        "batch_size": 2,
        "num_workers": 0,
        "persistent_workers": "false",
    }
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *(f"--{name}={value}" for name, value in flags.items())])
    lerobot_train.main()
    trained = json.loads((out / "checkpoints" / "last" / "pretrained_model" / "train_config.json").read_text())
    assert trained["optimizer"]["lr"] == 1e-5 and trained["policy"]["chunk_size"] == 20 and trained["seed"] == 42
