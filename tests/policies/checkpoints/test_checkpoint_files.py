"""Files of a checkpoint: the original's are read as its server does, foreign and damaged ones are one clear error."""

import json
import random
import shutil
import socket
import sys
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest
import torch
from made_checkpoints import FRONT, SIDE, STATE, edit, facts, follow, save, seen
from safetensors.torch import load_file, save_file

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.policies.lerobot import checkpoint_network, hub_folder
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.policies.lerobot.picture_preparation import PicturePreparation, PictureStep

sys.path.insert(0, str(Path(__file__).parents[2] / "fuzz"))
from mutants import damaged

TRANSFORMS = {
    "enable": True,
    "max_num_transforms": 3,
    "random_order": False,
    "tfs": {
        "resize": {"weight": 1.0, "type": "Resize", "kwargs": {"size": [48, 64], "interpolation": "bilinear"}},
        "colour": {"weight": 1.0, "type": "ColorJitter", "kwargs": {"brightness": [0.8, 1.2]}},
        "pad": {"weight": 1.0, "type": "Pad", "kwargs": {"padding": [0, 8, 0, 8], "fill": 0}},
    },
}
"""Preparation of 640x480 pictures in the original's training, at a size for tests."""


@pytest.fixture
def folder(checkpoints, tmp_path):
    """A copy of the ACT checkpoint that may be damaged."""
    return Path(shutil.copytree(checkpoints["act"], tmp_path / "act"))


def test_the_originals_checkpoints_load_unchanged(tmp_path):
    """640x480 pictures are asked for, resized and padded as the original's server does, and actions are v3.1."""
    made = save(tmp_path / "out" / "checkpoints" / "000100" / "pretrained_model", "act", side=(480, 640))
    (made / "train_config.json").write_text(json.dumps({"dataset": {"image_transforms": TRANSFORMS}}))
    edit(made / "config.json", a_field_of_the_fork=1)
    (tmp_path / "out" / "checkpoints" / "last").symlink_to("000100")
    policy = policies.get(f"lerobot:{tmp_path / 'out'}")
    assert (policy.camera.width, policy.camera.height, policy.camera.fit) == (640, 480, "native")
    assert (policy.labels, policy.describe()["prepared"], policy.describe()["ignored"]) == (
        "v3.1",
        True,
        ["a_field_of_the_fork"],
    )
    policy.reset([11], ["boxing"])
    shown = seen([11], [0], side=(480, 640))
    # Step by step as torchvision does it, and rounded to whole values in between.
    from torchvision.transforms import v2

    small = v2.Resize([48, 64], antialias=True)(shown.image.permute(0, 3, 1, 2).float() / 255.0)
    padded = (v2.Pad([0, 8, 0, 8])(small) * 255.0).round().to(torch.uint8)
    network = policy._on(torch.device("cpu"))
    batch = network.before({STATE: shown.state, FRONT: padded.float() / 255.0})
    wanted = network.after(network.policy.predict_action_chunk(batch)[0])[: policy.chunk_size]
    assert torch.allclose(policy.act(shown).actions[0], wanted, atol=1e-6)


def test_a_picture_is_prepared_as_torchvision_does():
    """A constant picture keeps its value, padding is black, a shrunk edge is filtered, and values are rounded."""
    picture = torch.zeros((1, 480, 640, 3), dtype=torch.uint8)
    picture[:, :, 320:] = 200
    steps = (PictureStep(size=(48, 64)), PictureStep(padding=(0, 8, 0, 8)))
    done = PicturePreparation(steps)(picture)
    assert done.shape == (1, 64, 64, 3)
    assert done.dtype == torch.uint8
    assert not done[:, :8].any()
    assert not done[:, -8:].any()
    assert (done[0, 8:-8, :30] == 0).all()
    assert (done[0, 8:-8, 34:] == 200).all()
    assert 0 < done[0, 30, 31, 0] < 100 < done[0, 30, 32, 0] < 200


def test_somebody_elses_checkpoint_sees_what_it_was_trained_on(tmp_path):
    """Without facts and transforms the picture has the size of its input; the fit follows from the shape."""
    square = LeRobotPolicy(save(tmp_path / "square", "act"))
    assert (square.camera.width, square.camera.fit) == (SIDE, "pad")
    wide = LeRobotPolicy(save(tmp_path / "wide", "act", side=(48, 64)))
    assert (wide.camera.width, wide.camera.height, wide.camera.fit) == (64, 48, "native")


def rename(path, old, new):
    """Rename a feature of a configuration."""
    content = json.loads(path.read_text())
    content["input_features"][new] = content["input_features"].pop(old)
    path.write_text(json.dumps(content))


def shape(path, kind, name, numbers):
    """Change the shape of a feature."""
    content = json.loads(path.read_text())
    content[kind][name]["shape"] = numbers
    path.write_text(json.dumps(content))


def step(path, **changes):
    """Change the first step of a processor."""
    content = json.loads(path.read_text())
    content["steps"][0] |= changes
    path.write_text(json.dumps(content))


def normaliser(path, *, drop=(), **changes):
    """Change the step of a processor that has statistics, and its options."""
    content = json.loads(path.read_text())
    (one,) = (one for one in content["steps"] if one["registry_name"].endswith("normalizer_processor"))
    one["config"] |= changes
    for name in drop:
        del one[name]
    path.write_text(json.dumps(content))


def other_statistics(folder):
    """Statistics of a picture with five colours."""
    (path,) = folder.glob("policy_preprocessor_step_*_normalizer_processor.safetensors")
    save_file(load_file(path) | {f"{FRONT}.mean": torch.zeros(5, 1, 1)}, path)


def other_weights(folder, *, add="", drop="-"):
    """Leave out the weights whose names begin like this, and add one."""
    path = folder / "model.safetensors"
    kept = {name: value for name, value in load_file(path).items() if not name.startswith(drop)}
    save_file(kept | ({add: torch.zeros(1)} if add else {}), path)


def without_device(path):
    """Take the step out that brings numbers to the network's device."""
    content = json.loads(path.read_text())
    content["steps"] = [one for one in content["steps"] if one["registry_name"] != "device_processor"]
    path.write_text(json.dumps(content))


WRONG = {
    "no network of LeRobot": (
        lambda f: edit(f / "config.json", type="magic"),
        "config.json: type is 'magic'",
    ),
    "another network": (lambda f: edit(f / "config.json", type="vqbet"), "type vqbet is not run here"),
    "an adapter": (lambda f: edit(f / "config.json", use_peft=True), "use_peft is set"),
    "a wrong number": (lambda f: edit(f / "config.json", dim_model="many"), "config.json: .*many"),
    "no actions": (lambda f: edit(f / "config.json", chunk_size=0), "config.json: "),
    "a camera": (lambda f: rename(f / "config.json", FRONT, "observation.images.top"), "input observation.images.top"),
    "a state": (lambda f: shape(f / "config.json", "input_features", STATE, [14]), r"input observation.state \[14\]"),
    "an action": (lambda f: shape(f / "config.json", "output_features", "action", [14]), r"output action is \[14\]"),
    "a picture": (
        lambda f: edit(f / "arena_policy.json", width=96),
        "64x64, but arena_policy.json says 96x64",
    ),
    "code": (lambda f: step(f / "policy_preprocessor.json", **{"class": "os.system"}), r"steps\[0\] is"),
    "a step": (
        lambda f: step(f / "policy_postprocessor.json", registry_name="libero_processor"),
        r"\[0\] is 'libero",
    ),
    "remote code": (
        lambda f: step(f / "policy_preprocessor.json", config={"trust_remote_code": True}),
        r"steps\[0\].config is not",
    ),
    "a path": (
        lambda f: step(f / "policy_preprocessor.json", state_file="../x.safetensors"),
        "state_file is '../x",
    ),
    "a step that is a list": (
        lambda f: step(f / "policy_preprocessor.json", registry_name=["a"]),
        r"steps\[0\] is \['a'\], expected one of",
    ),
    "eps": (lambda f: normaliser(f / "policy_preprocessor.json", eps="x"), r"steps\[\d\].config.eps is 'x'"),
    "eps below 0": (lambda f: normaliser(f / "policy_postprocessor.json", eps=-1.0), r"config.eps is -1.0"),
    "no map": (
        lambda f: normaliser(f / "policy_preprocessor.json", norm_map=None),
        "norm_map is None, but config.json",
    ),
    "another map": (
        lambda f: normaliser(f / "policy_postprocessor.json", norm_map={"ACTION": "MIN_MAX"}),
        "norm_map is {'ACTION': 'MIN_MAX'}, but config.json has normalization_mapping",
    ),
    "no statistics": (
        lambda f: normaliser(f / "policy_preprocessor.json", drop=["state_file"]),
        "names no state_file",
    ),
    "no number": (lambda f: edit(f / "config.json", dropout=float("nan")), "config.json: dropout is nan"),
    "a task twice": (
        lambda f: edit(f / "arena_policy.json", task_vector=["boxing", "boxing"]),
        "task_vector: boxing: given twice",
    ),
    "statistics of another shape": (other_statistics, "its processors or their statistics do not fit"),
    "no device": (lambda f: without_device(f / "policy_preprocessor.json"), "steps hold no device_processor"),
    "a network that LeRobot does not build": (
        lambda f: edit(f / "config.json", dim_feedforward=-4),
        "config.json: its network cannot be built: ",
    ),
    "a hidden reason": (
        lambda f: edit(f / "config.json", n_action_steps=500),
        "config.json: .*Got 500 for `n_action_steps`",
    ),
    "no processor": (lambda f: (f / "policy_preprocessor.json").unlink(), "holds no policy_preprocessor.json"),
    "no weights": (lambda f: (f / "model.safetensors").rename(f / "pytorch_model.bin"), "holds no model.safetensors"),
    "other weights": (lambda f: edit(f / "config.json", dim_model=64), "does not hold the weights of this network"),
    "cut weights": (
        lambda f: (f / "model.safetensors").write_bytes((f / "model.safetensors").read_bytes()[:-9]),
        "model.safetensors: not readable as safetensors",
    ),
    "weights of another family": (
        lambda f: edit(f / "config.json", type="pi05"),
        r"model.safetensors: holds the tensor model.action_head.bias of act, but config.json says type pi05, which has",
    ),
    "more layers than weights": (
        lambda f: edit(f / "config.json", n_encoder_layers=3000),
        r"holds 1 layers model.encoder.layers.\*, but config.json says n_encoder_layers 3000",
    ),
    "layers without end": (
        lambda f: edit(f / "config.json", n_decoder_layers=10**9),
        r"holds 1 layers model.decoder.layers.\*, but config.json says n_decoder_layers 1000000000",
    ),
    "wider layers than weights": (
        lambda f: edit(f / "config.json", dim_feedforward=10**8),
        r"model.safetensors: holds [0-9,]+ numbers, the network of its config.json far more",
    ),
    "a tracker that is no name": (
        lambda f: edit(f / "arena_policy.json", trackers=["<script>"]),
        "arena_policy.json: trackers holds '<script>', which is no name",
    ),
    "weights of no family": (
        lambda f: other_weights(f, add="normalize_inputs.buffer"),
        r"model.safetensors: holds the tensor normalize_inputs.buffer, but config.json says type act",
    ),
    "weights that are a part": (
        lambda f: other_weights(f, drop="model.decoder."),
        r"model.safetensors: holds no tensor model.decoder.\*, but config.json says type act, which needs it",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_what_cannot_be_run_is_one_clear_error(folder, kind):
    """Before the first episode, naming the file and what is wrong in it."""
    damage, message = WRONG[kind]
    damage(folder)
    with pytest.raises(InputError, match=message):
        LeRobotPolicy(folder).check()


def test_no_network_is_built_for_another_number_of_layers(folder, monkeypatch):
    """The weights' header says how many there are, before memory or time is spent on those that the file says."""
    monkeypatch.setattr(checkpoint_network, "get_policy_class", lambda kind: pytest.fail("built"))
    for field in ("n_encoder_layers", "n_decoder_layers"):
        edit(folder / "config.json", **{field: 2})
        with pytest.raises(InputError, match=f"says {field} 2"):
            LeRobotPolicy(folder).check()
        edit(folder / "config.json", **{field: 1})


def test_no_network_is_built_for_weights_of_another_family(folder, monkeypatch):
    """pi0.5's takes minutes; the weights' header says at once that they are an ACT's."""
    monkeypatch.setattr(checkpoint_network, "get_policy_class", lambda kind: pytest.fail("built"))
    for kind in ("pi05", "diffusion", "multi_task_dit"):
        edit(folder / "config.json", type=kind)
        with pytest.raises(InputError, match=f"{folder}.*(type {kind}|config.json: )"):
            LeRobotPolicy(folder).check()


WIDTHS = {STATE: 64, "action": 40}
CONSTANT = {
    "MEAN_STD": ({"std": torch.zeros}, "std is 0"),
    "MIN_MAX": ({"min": torch.ones, "max": torch.ones}, "min equals max"),
    "QUANTILES": ({"q01": torch.zeros, "q99": torch.zeros}, "q01 equals q99"),
}
"""Mode → statistics that say that nothing ever changes, and how they are called."""


@pytest.mark.parametrize("mode", CONSTANT)
@pytest.mark.parametrize(("feature", "part"), [(STATE, "pre"), ("action", "post")])
def test_statistics_of_a_feature_that_never_changes_are_refused(folder, mode, feature, part):
    """They make noise of every query, or one action of every answer; a feature of which one number changes is taken."""
    made, said = CONSTANT[mode]
    modes = {kind: mode for kind in ("VISUAL", "STATE", "ACTION", "ENV")} | {"VISUAL": "MEAN_STD"}
    edit(folder / "config.json", normalization_mapping=modes)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        normaliser(folder / name, norm_map=modes)
    for path in folder.glob("*normalizer_processor.safetensors"):
        ends = {"min": -1.0, "max": 1.0, "q01": -1.0, "q99": 1.0}
        ranges = {f"{one}.{name}": torch.full((n,), end) for one, n in WIDTHS.items() for name, end in ends.items()}
        save_file(load_file(path) | ranges, path)
    LeRobotPolicy(folder).check()
    (path,) = folder.glob(f"policy_{part}processor_step_*normalizer_processor.safetensors")
    constant = {f"{feature}.{name}": make(WIDTHS[feature]) for name, make in made.items()}
    save_file(load_file(path) | constant, path)
    with pytest.raises(InputError, match=f"{path}: {feature}: {said} in all {WIDTHS[feature]} numbers"):
        LeRobotPolicy(folder)
    constant[f"{feature}.{list(made)[-1]}"][3] += 1.0
    save_file(load_file(path) | constant, path)
    LeRobotPolicy(folder).check()


def test_statistics_that_nothing_uses_may_be_anything(folder):
    """Features that go in as they are, and the actions' for an input, which only a training normalises."""
    modes = {"VISUAL": "IDENTITY", "STATE": "MEAN_STD", "ACTION": "MEAN_STD", "ENV": "MEAN_STD"}
    edit(folder / "config.json", normalization_mapping=modes)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        normaliser(folder / name, norm_map=modes)
    (path,) = folder.glob("policy_preprocessor_step_*_normalizer_processor.safetensors")
    unused = {f"{FRONT}.std": torch.zeros(3, 1, 1), "action.std": torch.zeros(40), "index.std": torch.zeros(2)}
    save_file(load_file(path) | unused, path)
    LeRobotPolicy(folder).check()


def test_transforms_at_random_are_refused(tmp_path):
    """Pictures are refused as by the original's server; a size or a colour that cannot be is named."""
    for changes, message in (
        ({"random_order": True}, "random_order false"),
        ({"max_num_transforms": 1}, "max_num_transforms of at least"),
        ({"tfs": {"r": {"type": "Resize", "kwargs": {"size": 224}}}}, "tfs.r.kwargs.size is 224, expected height and"),
        ({"tfs": {"p": {"type": "Pad", "kwargs": {"padding": "all"}}}}, "tfs.p.kwargs.padding is 'all'"),
    ):
        config = {"dataset": {"image_transforms": TRANSFORMS | changes}}
        (tmp_path / "train_config.json").write_text(json.dumps(config))
        with pytest.raises(InputError, match=message):
            PicturePreparation.read(tmp_path)


def test_damaged_files_raise_nothing_else(folder, mutants):
    """Dozens of damaged JSON files of a checkpoint are read, or are an input error."""
    draw, refused = random.Random(3), 0
    (folder / "train_config.json").write_text(json.dumps({"dataset": {"image_transforms": TRANSFORMS}}))
    sound = {path: path.read_bytes() for path in sorted(folder.glob("*.json"))}
    for _ in range(mutants):
        path = draw.choice(list(sound))
        path.write_bytes(damaged(sound[path], draw, text=True))
        try:
            LeRobotPolicy(folder)
        except InputError:
            refused += 1
        path.write_bytes(sound[path])
    assert refused > mutants // 4


def test_a_name_of_the_hub_that_is_not_here(tmp_path, monkeypatch, capsys):
    """Offline: one clear line, exit code 2, no waiting; a path that is not there is named as a path."""
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    out = str(tmp_path / "out")
    assert main(["run", "--task", "boxing", "--policy", "lerobot:nobody/nothing", "--out", out]) == 2
    assert "lerobot:nobody/nothing: is no folder here, and the Hugging Face hub" in capsys.readouterr().err
    assert main(["run", "--task", "boxing", "--policy", "lerobot:no/such/folder", "--out", out]) == 2
    assert "--policy lerobot:no/such/folder: no such file or folder" in capsys.readouterr().err
    assert not Path(out).exists()


def test_a_name_of_the_hub_that_was_fetched_before(checkpoints, tmp_path, monkeypatch):
    """Is opened from the hub's cache, without a network, unless a folder of that name is here."""
    cache = tmp_path / "models--owner--act"
    shutil.copytree(checkpoints["act"], cache / "snapshots" / "0123456789")
    (cache / "refs").mkdir()
    (cache / "refs" / "main").write_text("0123456789")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    policy = policies.get("lerobot:owner/act")
    assert policy.describe() == LeRobotPolicy(checkpoints["act"]).describe()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "owner" / "act").mkdir(parents=True)
    with pytest.raises(InputError, match="owner/act: holds no checkpoint"):
        policies.get("lerobot:owner/act")


def test_a_hub_that_does_not_answer(tmp_path, monkeypatch):
    """Is given up after a few seconds, with one clear error."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}"
        monkeypatch.setattr(hub_folder, "PATIENCE", 0.2)
        for name, value in {"ENDPOINT": address, "HF_HUB_OFFLINE": False, "HF_HUB_CACHE": str(tmp_path)}.items():
            monkeypatch.setattr(huggingface_hub.constants, name, value)
        with pytest.raises(InputError, match="--policy lerobot:nobody/nothing: is no folder here, .*timed out"):
            hub_folder.fetched("nobody/nothing")


def test_a_picture_of_another_size_is_refused(checkpoints):
    """Given by a server's client, say: the message names both sizes."""
    policy = LeRobotPolicy(checkpoints["act"])
    policy.reset([11], ["boxing"])
    with pytest.raises(InputError, match=r"expected pictures of \[64, 64, 3\], was given \[32, 32, 3\]"):
        policy.act(seen([11], [0], side=(32, 32)))


def test_it_works_without_a_reset_or_an_environment(checkpoints):
    """A first request like a policy server's: memory is made for the worlds that are shown."""
    policy = LeRobotPolicy(checkpoints["act"])
    assert policy.act(seen([1, 2, 3], [0, 0, 0])).actions.shape == (3, policy.chunk_size, 40)
    assert set(follow(policy, [1, 2], 1)) == {1, 2}
    assert facts().camera.width == SIDE
    assert np.isfinite(policy.act(seen([1, 2], [0, 0])).actions.numpy()).all()
