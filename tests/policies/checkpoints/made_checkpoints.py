"""Tiny checkpoints with random weights, as LeRobot saves them, and observations to ask them with."""

import json

import numpy as np
import torch
import torchvision
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
from tokenizers import Tokenizer, models, pre_tokenizers
from torch import nn
from torchvision.models.resnet import BasicBlock, ResNet
from transformers import CLIPConfig, CLIPModel, PreTrainedTokenizerFast

from arena_newton.data.readers.label_protocols import encode_v4
from arena_newton.policies import Observation
from arena_newton.policies.learned import act_network
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.robot.canonical import STAND_ACTION

SIDE = 64
"""Width and height of pictures [px]."""
CHUNK = 6
"""Actions that are executed of a chunk."""
FRONT, STATE, TASK = "observation.images.front", "observation.state", "observation.environment_state"
WIDTHS = (16, 32, 64, 128)
"""Channels of the stages of a vision encoder, a quarter of a ResNet18's."""


class NarrowResNet(ResNet):
    """ResNet18 of fewer channels: 0.7 million weights."""

    def __init__(self, norm_layer=nn.BatchNorm2d, **_):
        nn.Module.__init__(self)
        self._norm_layer, self.inplanes, self.dilation, self.groups, self.base_width = norm_layer, WIDTHS[0], 1, 1, 64
        self.conv1, self.bn1 = nn.Conv2d(3, WIDTHS[0], 7, stride=2, padding=3, bias=False), norm_layer(WIDTHS[0])
        self.relu, self.maxpool = nn.ReLU(inplace=True), nn.MaxPool2d(3, stride=2, padding=1)
        for stage, width in enumerate(WIDTHS, start=1):
            self.add_module(f"layer{stage}", self._make_layer(BasicBlock, width, 2, 1 if stage == 1 else 2))
        self.avgpool, self.fc = nn.AdaptiveAvgPool2d(1), nn.Linear(WIDTHS[-1], 1)


def install(patch):
    """Let every ResNet18 be narrow, LeRobot's and ours."""
    patch.setattr(torchvision.models, "resnet18", NarrowResNet)
    patch.setattr(act_network, "WIDTHS", WIDTHS)


def made_clip(folder):
    """A CLIP of a few thousand weights, with a tokenizer of words."""
    common = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    text = common | {"vocab_size": 64, "max_position_embeddings": 16, "bos_token_id": 1, "eos_token_id": 2}
    vision = common | {"image_size": SIDE, "patch_size": 32}
    CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=16)).save_pretrained(folder)
    words = ["[PAD]", "[UNK]", "[END]", *"strike the green markers on punching bag avoid obstacles and move to".split()]
    tokenizer = Tokenizer(models.WordLevel({word: i for i, word in enumerate(words)}, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    fast = PreTrainedTokenizerFast(tokenizer_object=tokenizer, pad_token="[PAD]", unk_token="[UNK]", eos_token="[END]")
    fast.save_pretrained(folder)
    return folder


def configuration(family, features, clip=None, **changes):
    """LeRobot's configuration of a tiny policy."""
    modes = {kind: NormalizationMode.MEAN_STD for kind in ("VISUAL", "STATE", "ACTION", "ENV")}
    common = {
        "input_features": features,
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (40,))},
        "normalization_mapping": modes,
        "n_action_steps": CHUNK,
        "device": "cpu",
    }
    if family == "act":
        sizes = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "use_vae": False}
        own = sizes | {"chunk_size": 10, "pretrained_backbone_weights": None}
        return ACTConfig(**common | own | changes)
    if family == "diffusion":
        sizes = {
            "down_dims": (16, 32),
            "diffusion_step_embed_dim": 16,
            "spatial_softmax_num_keypoints": 4,
            "n_groups": 4,
        }
        own = sizes | {"n_obs_steps": 1, "horizon": 8, "num_train_timesteps": 4, "pretrained_backbone_weights": None}
        return DiffusionConfig(**common | own | {"crop_shape": None, "drop_n_last_frames": 2} | changes)
    own = {"n_obs_steps": 1, "horizon": 8, "hidden_dim": 16, "num_layers": 1, "num_heads": 2, "timestep_embed_dim": 16}
    own |= {
        "objective": "flow_matching",
        "num_integration_steps": 4,
        "image_crop_shape": None,
        "tokenizer_max_length": 16,
    }
    return MultiTaskDiTConfig(
        **common | own | {"vision_encoder_name": str(clip), "text_encoder_name": str(clip)} | changes
    )


def save(folder, family, *, clip=None, facts=None, side=(SIDE, SIDE), spread=0.02, cameras=("front",), **changes):
    """A checkpoint that sways about standing; `facts` None: somebody else's."""
    torch.manual_seed(7)
    features = {
        STATE: PolicyFeature(FeatureType.STATE, (64,)),
    }
    features |= {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, *side)) for name in cameras}
    stand = torch.from_numpy(STAND_ACTION)
    if facts is not None and facts.labels == "v4":
        stand = torch.from_numpy(encode_v4(STAND_ACTION[None])[0])
    stats = {
        STATE: {"mean": torch.zeros(64), "std": torch.ones(64)},
        "action": {"mean": stand, "std": torch.full((40,), spread)},
    }
    colours = {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)}
    stats |= {f"observation.images.{name}": colours for name in cameras}
    if facts is not None and facts.task_vector:
        features[TASK] = PolicyFeature(FeatureType.ENV, (facts.vector_width,))
        stats[TASK] = {"mean": torch.zeros(facts.vector_width), "std": torch.ones(facts.vector_width)}
    config = configuration(family, features, clip, **changes)
    policy = get_policy_class(config.type)(config)
    for parameter in policy.parameters():  # some begin at 0, which would hide what they are multiplied with
        if parameter.requires_grad and parameter.std() == 0 and parameter.ndim > 1:
            torch.nn.init.normal_(parameter, std=0.05)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    if facts is not None:
        facts.write(folder)
    return folder


def facts(**changes):
    """Facts of a checkpoint of ours, with tiny pictures."""
    return CheckpointFacts(**{"width": SIDE, "height": SIDE} | changes)


def seen(seeds, ticks, mask=None, *, side=(SIDE, SIDE), task="boxing", tracker="twist2", cameras=("front",)):
    """Observation of worlds, which follows from each world's seed and tick alone."""
    state, pictures = [], {name: [] for name in cameras}
    for key in zip(seeds, ticks, strict=True):
        rng = np.random.default_rng(key)
        state.append(0.3 * rng.standard_normal(64).astype(np.float32))
        for name in cameras:
            pictures[name].append(rng.integers(0, 256, (*side, 3), np.uint8))
    return Observation(
        state=torch.from_numpy(np.stack(state)),
        image=None,
        images={name: torch.from_numpy(np.stack(shown)) for name, shown in pictures.items()},
        mask=np.ones(len(seeds), bool) if mask is None else np.asarray(mask, bool),
        task=task,
        gym_id=task,
        instruction="Strike the green markers on the punching bag.",
        tracker=tracker,
    )


def follow(policy, seeds, queries, *, asks=None, side=(SIDE, SIDE)):
    """Actions of each world by seed, tick by tick, over `queries` answers of full length.

    Args:
        policy: Is reset.
        seeds: Episode seeds of the worlds.
        queries: Ticks that are played are `queries` times the policy's chunk.
        asks: World → tick at which its episode begins, so that worlds ask at different ticks.
        side: Height and width of pictures.
    """
    worlds = len(seeds)
    begins = [0] * worlds if asks is None else list(asks)
    policy.reset(seeds, ["boxing"] * worlds)
    ticks, left = [0] * worlds, [[] for _ in range(worlds)]
    played = [[] for _ in range(worlds)]
    total = queries * policy.chunk_size
    for now in range(total + max(begins)):
        acting = [now >= begin and ticks[w] < total for w, begin in enumerate(begins)]
        mask = [acting[w] and not left[w] for w in range(worlds)]
        if any(mask):
            answer = policy.act(seen(seeds, ticks, mask, side=side))
            assert not answer.errors
            for world in np.flatnonzero(mask):
                left[world] = list(torch.as_tensor(answer.actions)[world].clone())
        for world in np.flatnonzero(acting):
            played[world].append(left[world].pop(0))
            ticks[world] += 1
    return {seed: torch.stack(rows) for seed, rows in zip(seeds, played, strict=True)}


def edit(path, **changes):
    """Change fields of a JSON file."""
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | changes))
