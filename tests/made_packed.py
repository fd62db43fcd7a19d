"""A packed policy with random weights, made without LeRobot."""

import functools
import json

import torch
from safetensors.torch import save, save_file

from arena_newton.policies.learned import act_network
from arena_newton.policies.learned.act_network import ActNetwork, ActSizes
from arena_newton.policies.learned.learned_card import PolicyCard
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.train.checkpoint_packing import pack

WIDTH = 16
CHUNK = 5
SMALL = {"dim_model": WIDTH, "n_heads": 2, "dim_feedforward": WIDTH, "n_encoder_layers": 1, "latent_dim": 4}


@functools.cache
def _weights(tasks, widths):
    """Content of a file of random weights for so many tasks; the vision encoder has these widths."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        network = ActNetwork(ActSizes(state=64, tasks=tasks, actions=40, chunk_size=CHUNK, **SMALL))
    return save({f"model.{name}": value.contiguous() for name, value in network.state_dict().items()})


def checkpoint(folder, tasks=("boxing", "vis_navi"), *, size=(48, 64), trackers=("twist2",), **said):
    """A checkpoint of ACT as LeRobot writes it, whose actions are near zero in units of v4."""
    folder.mkdir(parents=True)
    facts = {"width": size[1], "height": size[0], "labels": "v4", "family": "act", "recipe": "compact"} | said
    CheckpointFacts(task_vector=tasks, tasks=tasks, trackers=trackers, **facts).write(folder)
    (folder / "model.safetensors").write_bytes(_weights(len(tasks), act_network.WIDTHS))
    shapes = {
        "observation.images.front": ("VISUAL", [3, *size]),
        "observation.state": ("STATE", [64]),
        "observation.environment_state": ("ENV", [len(tasks)]),
    }
    config = {"type": "act", "n_obs_steps": 1, "chunk_size": CHUNK, "n_action_steps": CHUNK, "n_decoder_layers": 1}
    config |= {"vision_backbone": "resnet18", "replace_final_stride_with_dilation": False, "use_vae": False}
    config |= {"pre_norm": False, "feedforward_activation": "relu", "temporal_ensemble_coeff": None} | SMALL
    config["input_features"] = {name: {"type": kind, "shape": shape} for name, (kind, shape) in shapes.items()}
    config["output_features"] = {"action": {"type": "ACTION", "shape": [40]}}
    (folder / "config.json").write_text(json.dumps(config))
    modes = {"VISUAL": "MEAN_STD", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}
    steps = {
        "pre": ("rename_observations_processor", "to_batch_processor", "device_processor", "normalizer_processor"),
        "post": ("unnormalizer_processor", "device_processor"),
    }
    state, action = torch.zeros(64), torch.zeros(40)
    stats = {"observation.state.mean": state, "observation.state.std": state + 1.0}
    stats |= {"action.mean": action, "action.std": action + 1e-3}
    for name, registered in steps.items():
        save_file(stats, folder / f"{name}.safetensors")
        normalises = {"config": {"eps": 1e-8, "norm_map": modes}, "state_file": f"{name}.safetensors"}
        rows = [{"registry_name": one, "config": {}} | (normalises if "norm" in one else {}) for one in registered]
        (folder / f"policy_{name}processor.json").write_text(json.dumps({"steps": rows}))
    return folder


def packed(folder, tasks=("vis_navi",), **changes):
    """The same, packed and offered for some tasks."""
    made = checkpoint(folder.with_name(folder.name + "_trained"), **changes)
    pack(made, folder, PolicyCard(tasks=tasks))
    return folder
