"""Packed policies: the same answers as LeRobot's, in half the size, and clear refusals."""

import dataclasses
import json
import random
import resource
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from made_checkpoints import CHUNK, edit, facts, follow, save, seen
from safetensors.torch import load_file, save_file

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.policies import Observation
from arena_newton.policies.learned import learned_card
from arena_newton.policies.learned.learned_card import CARD_FILE, PolicyCard, read_card
from arena_newton.policies.learned.learned_policy import LearnedPolicy
from arena_newton.policies.learned.packed_checkpoint import read_act_checkpoint
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.policies.train import checkpoint_packing
from arena_newton.policies.train.checkpoint_packing import changed_looks, pack, packed_digest, training_command
from tests.fuzz.mutants import damaged

TASKS = ("boxing", "vis_navi")
OURS = {
    "family": "act",
    "labels": "v4",
    "realign": 0.002,
    "task_vector": TASKS,
    "tracker_vector": ("sonic", "twist2"),
    "tasks": TASKS,
    "trackers": ("twist2",),
}
CARD = PolicyCard(tasks=("boxing",))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny checkpoint of ours, with the encoder of a latent that only training uses."""
    folder = tmp_path_factory.mktemp("trained") / "act"
    options = {"flags": {"policy": "act", "recipe": "small", "dataset": ["/data/sets/navi"], "steps": 4, "out": "/x/y"}}
    said = facts(**OURS, steps=4, minutes=1.5, device="a device", options=options)
    return save(folder, "act", facts=said, use_vae=True, n_vae_encoder_layers=1)


@pytest.fixture(scope="module")
def packed(trained, tmp_path_factory):
    """Its packed form."""
    out = tmp_path_factory.mktemp("packed") / "act"
    pack(trained, out, CARD)
    return out


def copy(folder, tmp_path):
    """A packed policy that a test may damage."""
    return shutil.copytree(folder, tmp_path / "copy")


@pytest.mark.parametrize(
    ("changes", "side"),
    [
        ({}, (64, 64)),
        ({"pre_norm": True, "n_encoder_layers": 2, "n_decoder_layers": 2}, (64, 64)),
        ({"feedforward_activation": "gelu", "n_heads": 4, "latent_dim": 5}, (48, 64)),
    ],
    ids=["post-norm", "pre-norm", "gelu, 4:3"],
)
def test_answers_are_those_of_lerobot(tmp_path, changes, side):
    """The same files give the same actions, to 1e-5, through LeRobot and through our own forward pass."""
    seen_as = {"height": side[0], "width": side[1], "fit": "pad" if side[0] == side[1] else "native"}
    folder = save(tmp_path / "act", "act", facts=facts(**OURS, **seen_as), spread=1.0, side=side, **changes)
    pack(folder, tmp_path / "out", CARD)
    ours, theirs = LearnedPolicy(tmp_path / "out"), LeRobotPolicy(tmp_path / "out")
    first, second = (follow(policy, [1, 2], 2, side=side) for policy in (ours, theirs))
    assert ours.chunk_size == theirs.chunk_size == CHUNK and ours.labels == theirs.labels == "v4"
    assert ours.realign == theirs.realign and ours.camera == theirs.camera
    for seed, actions in first.items():
        torch.testing.assert_close(actions, second[seed], atol=1e-5, rtol=0)
    assert (first[1] - first[2]).abs().max() > 1e-3


def test_lerobot_is_not_imported(packed, monkeypatch):
    """A packed policy is read, loaded and run without LeRobot and torchvision, whose import takes seconds."""
    absent = {"lerobot", "torchvision", "draccus", "transformers"}
    for name in (*absent, *sys.modules):
        if name.partition(".")[0] in absent:
            monkeypatch.setitem(sys.modules, name, None)
    policy = policies.get(f"learned:{packed}")
    policy.check()
    assert policy.act(seen([5], [0])).actions.shape == (1, CHUNK, 40)


def test_a_task_vector_decides(packed):
    """Task and tracker are inputs: another one changes the answer."""
    policy = LearnedPolicy(packed)
    policy.card = dataclasses.replace(policy.card, tasks=TASKS)
    looks = [seen([5], [0], task=task, tracker=tracker) for task in TASKS for tracker in ("sonic", "twist2", "")]
    assert len({tuple(policy.act(look).actions.flatten().tolist()) for look in looks}) == 6


def test_one_task_needs_no_vector(tmp_path):
    """A checkpoint of one task without a task vector is packed; one of two cannot tell them apart and is refused."""
    folder = save(tmp_path / "one", "act", facts=facts(family="act", tasks=("boxing",)))
    pack(folder, tmp_path / "out", CARD)
    ours, theirs = (kind(tmp_path / "out") for kind in (LearnedPolicy, LeRobotPolicy))
    torch.testing.assert_close(follow(ours, [3], 1)[3], follow(theirs, [3], 1)[3], atol=1e-5, rtol=0)
    facts(family="act", tasks=TASKS).write(folder)
    with pytest.raises(InputError, match="was trained on 2 tasks without a task vector"):
        pack(folder, tmp_path / "other", CARD)


def test_packed_weights_are_the_trained_ones(trained, packed):
    """Matrices are the trained ones rounded to float16, vectors the same bits; what only training uses is left out."""
    before, after = load_file(trained / "model.safetensors"), load_file(packed / "model.safetensors")
    assert set(after) == {name for name in before if not name.startswith("model.vae_encoder")} < set(before)
    for name, value in after.items():
        assert value.dtype == (torch.float16 if value.dim() >= 2 else torch.float32), name
        assert torch.equal(value, before[name].to(value.dtype)), name
    network = read_act_checkpoint(packed).network()
    for name in ("action_head.weight", "encoder.layers.0.linear1.weight", "decoder.norm.bias"):
        stored = network.state_dict()[name]
        assert stored.dtype == torch.float32 and torch.equal(stored, after[f"model.{name}"].float())
    assert packed_digest(trained) == packed_digest(packed) == read_card(packed).weights


def test_the_number_of_worlds_changes_nothing(packed):
    """On the CPU an episode is the same for any number of worlds, bit for bit, whenever the others ask."""
    alone = {seed: follow(LearnedPolicy(packed), [seed], 2)[seed] for seed in (1, 2, 3)}
    together = follow(LearnedPolicy(packed), [1, 2, 3], 2, asks=[0, 2, 5])
    assert all(torch.equal(alone[seed], together[seed]) for seed in alone)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_packed_rows_are_independent_on_a_gpu(packed):
    """On CUDA each forward pass has one size: 1 and 20 worlds give the same bits, those of the CPU to 1e-3."""
    policy = LearnedPolicy(packed, device="cuda")
    many = follow(policy, [*range(100, 119), 1], 3)
    assert torch.equal(follow(policy, [1], 3)[1], many[1])
    torch.testing.assert_close(many[1], follow(LearnedPolicy(packed), [1], 3)[1], atol=1e-3, rtol=0)


def test_the_number_of_cores_changes_nothing(packed):
    """With one thread of torch or several, an answer has the same bits, and the number is what it was afterwards."""
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = follow(LearnedPolicy(packed), [4], 1)[4]
        torch.set_num_threads(3)
        assert torch.equal(follow(LearnedPolicy(packed), [4], 1)[4], alone)
        assert torch.equal(follow(LearnedPolicy(packed), [*range(4, 9)], 1)[4], alone)  # five queries side by side
        assert torch.get_num_threads() == 3
        with ThreadPoolExecutor(1) as later:
            assert later.submit(torch.get_num_threads).result() == 3
    finally:
        torch.set_num_threads(before)


def test_worlds_that_cannot_be_served_get_an_error(packed):
    """A state that is not finite is its world's error; worlds that do not ask are left alone."""
    policy, query = LearnedPolicy(packed), seen([1, 2, 3], [0, 0, 0], [True, True, False])
    query.state[1, 7] = float("nan")
    answer = policy.act(query)
    assert list(answer.errors) == [1] and "not finite" in answer.errors[1]
    assert torch.equal(answer.actions[0], policy.act(seen([1], [0])).actions[0])
    blind = Observation(query.state, None, query.mask, "boxing", "boxing", "Strike.")
    with pytest.raises(InputError, match=r"expected pictures of \[64, 64, 3\], was given none"):
        policy.act(blind)


def test_the_card_says_what_the_training_was(packed):
    """The card has data, command, minutes and size, and names nothing of the machine of the training."""
    card, page = read_card(packed), (packed / "card.md").read_text()
    assert (card.tasks, card.trackers, card.steps, card.gpu_minutes) == (("boxing",), ("twist2",), 4, 1.5)
    files = [path for path in packed.iterdir() if not path.name.startswith("card.")]
    assert card.bytes == sum(path.stat().st_size for path in files)
    assert "1.5 on a device" in page and "| tasks | boxing |" in page
    two = dataclasses.replace(card, processes=2, looks=("0.6", "double_desk=0.3")).to_markdown()
    assert "3.0 on 2 x a device" in two and "| samples with changed looks | 0.6, double_desk 0.3 |" in two
    assert not any(b"/data" in path.read_bytes() for path in packed.iterdir() if path.suffix in (".json", ".md"))


def test_the_command_of_a_training():
    """A training's flags become its command, defaults and paths of its machine left out."""
    flags = {"policy": "act", "recipe": "compact", "dataset": ["/a/navi", "/b/boxing"], "steps": 20, "out": "/x/y"}
    wanted = "python -m arena_newton.policies.train --policy act --dataset navi boxing --recipe compact --steps 20"
    told = facts(options={"flags": flags | {"device": "cuda", "lr": 0.0}})
    assert training_command(told) == wanted and changed_looks(told) == ()
    assert training_command(facts()) == ""
    looks = facts(options={"flags": flags | {"looks": ["0.6", "double_desk=0.3"]}}, processes=2)
    assert training_command(looks).startswith("torchrun --nproc-per-node 2 -m arena_newton.policies.train --policy act")
    assert changed_looks(looks) == ("0.6", "double_desk=0.3")


def test_a_task_that_it_does_not_do_is_refused(packed):
    """Tasks of the card alone are offered; a card that names one which the vector lacks is damaged."""
    policy = LearnedPolicy(packed)
    policy.check_task("boxing")
    with pytest.raises(InputError, match=r"--policy learned: does boxing \(card.md says how well\), not football"):
        policy.check_task("football")
    with pytest.raises(InputError, match="--tasks football: the checkpoint was trained on boxing, vis_navi"):
        pack(packed, packed, PolicyCard(tasks=("football",)))


def test_what_is_too_large_is_not_packed(trained, tmp_path, monkeypatch):
    """More than 32 MB is refused before anything is written; the message names the recipe that fits."""
    monkeypatch.setattr(checkpoint_packing, "MOST_BYTES", 1_000_000)
    with pytest.raises(InputError, match="MB in half precision, at most 1 are shipped; train it with --recipe compact"):
        pack(trained, tmp_path / "out", CARD)
    assert not (tmp_path / "out").exists()


def test_other_families_are_refused(checkpoints, tmp_path):
    """Diffusion Policy and flow matching are not packed."""
    for family, name in (("diffusion", "diffusion"), ("flow", "multi_task_dit")):
        with pytest.raises(InputError, match=f"type is '{name}'; only act is packed"):
            pack(checkpoints[family], tmp_path / family, CARD)


def test_a_foreign_folder_is_not_overwritten(trained, tmp_path):
    """A folder with something else in it is refused and kept; an earlier packed policy is replaced."""
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty and holds no packed policy"):
        pack(trained, tmp_path, CARD)
    assert (tmp_path / "note.txt").read_text() == "mine"
    pack(trained, tmp_path / "out", CARD)
    (tmp_path / "out" / "mine.json").write_text("mine")
    (tmp_path / "out" / "mine.safetensors").write_text("mine")
    assert pack(trained, tmp_path / "out", PolicyCard(tasks=TASKS)).tasks == TASKS
    assert {(tmp_path / "out" / name).read_text() for name in ("mine.json", "mine.safetensors")} == {"mine"}
    (tmp_path / "cards").mkdir()
    kept = {"card.json": '{"my": "card"}', "thesis.json": "{}", "data.safetensors": "x"}
    for name, text in kept.items():
        (tmp_path / "cards" / name).write_text(text)
    with pytest.raises(InputError, match="is not empty and holds no packed policy"):
        pack(trained, tmp_path / "cards", CARD)
    assert {path.name: path.read_text() for path in (tmp_path / "cards").iterdir()} == kept


@pytest.mark.parametrize("fault", ["disk", "folder"])
def test_a_policy_that_cannot_be_replaced_is_kept(packed, tmp_path, monkeypatch, fault):
    """A packed policy that cannot be replaced answers as before."""
    folder = copy(packed, tmp_path)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def full(file):
        raise OSError(28, "No space left on device")

    if fault == "disk":
        monkeypatch.setattr(checkpoint_packing.os, "fsync", full)
    else:
        (folder / "card.md").unlink()
        (folder / "card.md").mkdir()
    with pytest.raises(InputError, match=f"--out {folder}: "):
        pack(folder, folder, PolicyCard(tasks=("vis_navi",)))
    assert not list(folder.glob("*.part"))
    assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == {
        name: data for name, data in before.items() if fault == "disk" or name != "card.md"
    }
    assert LearnedPolicy(folder).card.tasks == ("boxing",)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"n_obs_steps": 2}, "n_obs_steps is 2"),
        ({"vision_backbone": "resnet50"}, "vision_backbone is 'resnet50'"),
        ({"feedforward_activation": "glu"}, "feedforward_activation is 'glu'"),
        ({"dim_model": 10**9}, "dim_model is 1000000000"),
        ({"n_heads": 3}, "multiple of n_heads"),
        ({"n_action_steps": 11}, "n_action_steps is 11, expected 1 to 10"),
        ({"temporal_ensemble_coeff": 0.01}, "temporal_ensemble_coeff is 0.01"),
        ({"replace_final_stride_with_dilation": True}, "replace_final_stride_with_dilation is True"),
        ({"input_features": {}}, "input_features is"),
        ({"chunk_size": True}, "chunk_size is True"),
    ],
)
def test_a_configuration_that_would_be_computed_otherwise_is_refused(packed, tmp_path, changes, said):
    """A setting that our forward pass does not compute is one error that names file and field."""
    folder = copy(packed, tmp_path)
    edit(folder / "config.json", **changes)
    with pytest.raises(InputError, match=said) as error:
        LearnedPolicy(folder)
    assert "config.json" in str(error.value)


@pytest.mark.parametrize(
    ("index", "changes", "said"),
    [
        (2, {"float_dtype": "float16"}, "computes in 'float16', a packed policy in float32"),
        (3, {"normalize_observation_keys": ["observation.state"]}, "normalises only"),
        (3, {"features": {}}, "takes observation.images.front for None, expected VISUAL"),
        (3, {"features": {"observation.images.front": {"type": "STATE"}}}, "for 'STATE', expected VISUAL"),
    ],
)
def test_processors_that_would_compute_otherwise_are_refused(packed, tmp_path, index, changes, said):
    """A step that LeRobot's processors would compute otherwise is one error that names file and step."""
    folder = copy(packed, tmp_path)
    path = folder / "policy_preprocessor.json"
    content = json.loads(path.read_text())
    content["steps"][index]["config"] |= changes
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=said) as error:
        LearnedPolicy(folder)
    assert f"{path}: steps[{index}]" in str(error.value)


def test_sizes_that_the_weights_lack_take_no_memory(packed, tmp_path):
    """A configuration of 100 GB beside small weights is one error, and nothing of that size is allocated."""
    folder = copy(packed, tmp_path)
    sizes = {"dim_model": 4096, "dim_feedforward": 16384, "n_encoder_layers": 32, "n_decoder_layers": 32}
    edit(folder / "config.json", **sizes)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="does not hold the weights of this network"):
        LearnedPolicy(folder).check()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 20, "more than 1 GiB"


def test_a_stock_lerobot_loads_it_without_a_gpu(trained, tmp_path):
    """A checkpoint whose processors name the device of its training is packed for any machine."""
    made = shutil.copytree(trained, tmp_path / "made")
    for name in ("pre", "post"):
        path = made / f"policy_{name}processor.json"
        content = json.loads(path.read_text())
        for step in content["steps"]:
            step["config"] |= {"device": "cuda"} if step["registry_name"] == "device_processor" else {}
        path.write_text(json.dumps(content))
    pack(made, tmp_path / "out", CARD)
    shipped = [learned_card.SHIPPED] if learned_card.shipped_card() is not None else []
    for folder in (tmp_path / "out", *shipped):
        config = PreTrainedConfig.from_pretrained(folder)
        pre, post = make_pre_post_processors(config, pretrained_path=str(folder))
        assert {step.device for step in (*pre.steps, *post.steps) if hasattr(step, "device")} <= {"cpu", None}


def test_mutated_files_are_read_or_refused(packed, tmp_path, mutants):
    """Dozens of damaged small files: each is read, or is one error of one line; nothing else is raised."""
    folder = copy(packed, tmp_path)
    names = [path.name for path in folder.iterdir() if path.name not in ("card.md", "model.safetensors")]
    rng, refused = random.Random(5), 0
    for name in sorted(names):
        whole = (folder / name).read_bytes()
        for _ in range(mutants // 2):
            (folder / name).write_bytes(damaged(whole, rng, text=name.endswith(".json")))
            try:
                read_card(folder)
                read_act_checkpoint(folder)
            except InputError as error:
                refused += 1
                assert "\n" not in str(error) and str(folder) in str(error)
        (folder / name).write_bytes(whole)
    assert refused > mutants // 2 * len(names) / 2
    read_act_checkpoint(folder)


def test_damaged_files_are_one_error(packed, tmp_path):
    """Weights of another network, torn files, unknown steps and renamed observations are refused, each by its file."""
    folder = copy(packed, tmp_path)

    def refused(said, kept):
        with pytest.raises(InputError, match=said):
            LearnedPolicy(folder).check()
        for name, content in kept.items():
            (folder / name).write_bytes(content)

    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    weights = load_file(folder / "model.safetensors")
    save_file({k: v for k, v in weights.items() if "action_head" not in k}, folder / "model.safetensors")
    refused("model.safetensors: does not hold the weights of this network", whole)
    save_file(weights | {"model.stray": torch.zeros(1)}, folder / "model.safetensors")
    refused("does not hold the weights of this network.*stray", whole)
    save_file(weights | {"model.action_head.bias": torch.full((40,), float("inf"))}, folder / "model.safetensors")
    refused("action_head.bias holds something else than finite", whole)
    for name in whole:
        if name != "card.md":
            (folder / name).write_bytes(whole[name][: len(whole[name]) // 2])
            refused(name.split(".")[0], whole)
    steps = json.loads(whole["policy_preprocessor.json"])
    steps["steps"][0]["config"]["rename_map"] = {"a": "b"}
    (folder / "policy_preprocessor.json").write_text(json.dumps(steps))
    refused("renames observations", whole)
    steps["steps"][0] = {"registry_name": "tokenizer_processor", "config": {}}
    (folder / "policy_preprocessor.json").write_text(json.dumps(steps))
    refused("policy_preprocessor.json: steps are", whole)
    (path,) = folder.glob("policy_postprocessor_step_*.safetensors")
    save_file(load_file(path) | {"action.std": torch.zeros(40)}, path)
    refused(f"{path.name}: action: std is 0 in all 40 numbers", whole)
    edit(folder / CARD_FILE, tasks=["football"])
    refused("card.json: tasks names football, which its task vector lacks", whole)
    LearnedPolicy(folder).check()


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("weights", "0123456789ab", "'0123456789ab', but model.safetensors has '"),
        ("bytes", 5, "5, but the files next to it have "),
        ("trackers", ["sonic"], r"\('sonic',\), but arena_policy.json has \('twist2',\)"),
        ("recipe", "paper", "'paper', but arena_policy.json has ''"),
        ("steps", 9, "9, but arena_policy.json has 4"),
        ("datasets", [{"name": "other"}], r"\({'name': 'other'},\), but arena_policy.json has \(\)"),
    ],
)
def test_a_card_of_another_policy_is_refused(packed, tmp_path, field, value, said):
    """Facts that the card repeats of the files next to it are compared with them; the message names card and field."""
    folder = copy(packed, tmp_path)
    edit(folder / CARD_FILE, **{field: value})
    with pytest.raises(InputError, match=f"card.json: {field} is {said}.*; take all files of one policy"):
        LearnedPolicy(folder).check()


def test_other_weights_under_a_card_are_refused(packed, tmp_path):
    """Weights that fit the network but are not those that were packed are not played under their results."""
    folder = copy(packed, tmp_path)
    weights = load_file(folder / "model.safetensors")
    weights["model.action_head.bias"] += 1.0
    save_file(weights, folder / "model.safetensors")
    with pytest.raises(InputError, match="card.json: weights is '.*', but model.safetensors has '"):
        LearnedPolicy(folder).check()
    pack(folder, folder, CARD)  # as the message says
    LearnedPolicy(folder).check()
