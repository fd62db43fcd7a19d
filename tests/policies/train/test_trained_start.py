"""Trainings that begin with the weights of a trained policy: a narrow ACT on the CPU."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from safetensors.torch import load_file, save_file

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts, checkpoint_folder
from arena_newton.policies.lerobot.checkpoint_reader import read_checkpoint
from arena_newton.policies.train.__main__ import main
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from arena_newton.policies.train.trained_start import VECTOR_WEIGHT, read_start
from arena_newton.policies.train.training import train
from tests.policies.train import narrow_network
from tests.policies.train.small_dataset import make_dataset

STILL = 1e-12
"""A learning rate by which no weight changes visibly."""


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    """A vision encoder that trains in milliseconds."""
    narrow_network.install(monkeypatch.setattr)


@pytest.fixture(scope="module")
def sofa(tmp_path_factory):
    """Demonstrations of another task through another tracker."""
    return make_dataset(tmp_path_factory.mktemp("sofa"), task="sit_sofa", tracker="sonic", lengths=(30, 40))


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    """A training of Boxing that is given its task."""
    out = tmp_path_factory.mktemp("runs") / "trained"
    with pytest.MonkeyPatch.context() as patch:
        narrow_network.install(patch.setattr)
        train(PolicyTrainOptions(task_vector=True, **given(dataset, out)))
    return out


def given(dataset, out, **changes):
    """Flags of a small training."""
    return {"dataset": (dataset,), "recipe": "small", "out": out, "device": "cpu", "steps": 2, "quiet": True} | changes


def weights(out):
    """Weights of a training."""
    return load_file(checkpoint_folder(out) / "model.safetensors")


def begun(dataset, out, start, **changes):
    """A training that begins with another one's weights, and hardly changes them."""
    train(PolicyTrainOptions(**given(dataset, out, start_from=str(start), lr=STILL, **changes)))
    return weights(out)


def learned(tensors):
    """Those without the statistics of batches, which follow the data."""
    return {
        name: tensor for name, tensor in tensors.items() if not name.split(".")[-1].startswith(("running_", "num_"))
    }


def test_a_training_begins_with_the_weights_and_numbers_of_a_policy(trained, sofa, tmp_path):
    """Statistics are its own too; a task of its vector keeps its column, another one gets one."""
    before, after = learned(weights(trained)), learned(begun(sofa, tmp_path / "out", trained))
    assert before.keys() == after.keys()
    for name in before.keys() - {VECTOR_WEIGHT}:
        torch.testing.assert_close(after[name], before[name], rtol=0.0, atol=1e-6)
    assert after[VECTOR_WEIGHT].shape[1] == 2
    torch.testing.assert_close(after[VECTOR_WEIGHT][:, :1], before[VECTOR_WEIGHT], rtol=0.0, atol=1e-6)
    old, new = (CheckpointFacts.read(checkpoint_folder(one)) for one in (trained, tmp_path / "out"))
    assert (new.recipe, new.labels, new.task_vector) == ("small", old.labels, ("boxing", "sit_sofa"))
    assert (new.tasks, new.trackers) == (("sit_sofa",), ("sonic",))
    assert (old.started_from, new.started_from) == ("", read_checkpoint(trained).digest)
    for feature, of in read_start(str(trained)).stats.items():
        for name, value in of.items():
            torch.testing.assert_close(read_start(str(tmp_path / "out")).stats[feature][name], value)


def test_it_answers_as_the_policy_did(trained, dataset, tmp_path):
    """Its normalised answers to the same batch are those of the policy."""
    begun(dataset, tmp_path / "out", trained, recipe_values=("frozen_norms=1",))
    found = []
    for out in (trained, tmp_path / "out"):
        config = PreTrainedConfig.from_pretrained(checkpoint_folder(out))
        policy = get_policy_class("act").from_pretrained(checkpoint_folder(out), config=config).eval()
        torch.manual_seed(1)
        batch = {name: torch.rand(2, *feature.shape) for name, feature in config.input_features.items()}
        with torch.inference_mode():
            found.append(policy.predict_action_chunk(batch))
    torch.testing.assert_close(found[0], found[1], rtol=0.0, atol=1e-5)


def test_it_goes_on_without_the_policy(trained, sofa, tmp_path, monkeypatch):
    """A stopped training needs neither the policy's folder nor its flags, and still says what it began with."""
    monkeypatch.setenv("HOME", str(tmp_path))
    start, out = tmp_path / "start", tmp_path / "out"
    shutil.copytree(trained, start, symlinks=True)
    digest = read_start(str(start)).checkpoint.digest
    begun(sofa, out, "~/start")
    shutil.rmtree(start)
    assert main(["--resume", str(out), "--steps", "3", "--quiet"]) == 0
    facts = CheckpointFacts.read(checkpoint_folder(out))
    assert (facts.steps, facts.started_from, facts.task_vector) == (3, digest, ("boxing", "sit_sofa"))


def test_several_trackers_get_a_number_each(dataset, sofa, trained, tmp_path):
    """Of a policy that is told its tracker; columns are kept by what they say."""
    flags = given(dataset, tmp_path / "both", task_vector=True) | {"dataset": (dataset, sofa)}
    train(PolicyTrainOptions(**flags))
    before = weights(tmp_path / "both")[VECTOR_WEIGHT]
    after = begun(dataset, tmp_path / "out", tmp_path / "both")[VECTOR_WEIGHT]
    torch.testing.assert_close(after, before, rtol=0.0, atol=1e-6)
    start = read_start(str(tmp_path / "both"))
    assert start.vector(("boxing",), (), {"pd"}) == (("boxing", "sit_sofa"), ("sonic", "twist2", "pd"))
    assert start.vector(("football",), (), {"sonic"})[0] == ("boxing", "sit_sofa", "football")


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--start-from", "nowhere"], "--start-from nowhere: no such folder, and not learned"),
        (["--start-from", "{trained}", "--weights", "x"], "--weights: are those of --start-from; drop one of them"),
        (["--start-from", "{trained}", "--labels", "v3.1"], ": is of --labels v4, this training of v3.1"),
        (["--start-from", "{trained}", "--policy", "flow"], ": is of --policy act, this training of flow"),
        (["--start-from", "{trained}", "--recipe-values", "network.n_heads=4"], ": n_heads is 2, in this training 4; "),
        (["--start-from", "{untold}", "--task-vector"], ": is given no vector of tasks, which this training has ("),
        (["--start-from", "{told}", "--no-tracker-vector"], "--no-tracker-vector: "),
        (["--start-from", "{broken}"], "model.safetensors: model.action_head.bias has numbers that are not finite"),
        (["--start-from", "learned"], ": dim_model is 256, in this training 32; its recipe is compact ("),
    ],
)
def test_an_unfit_start_is_one_error(trained, dataset, sofa, tmp_path, capsys, flags, says):
    """It names the flag or file, the code is 2, and no training is left."""
    places = {"trained": trained}
    if "{untold}" in flags:
        train(PolicyTrainOptions(**given(dataset, tmp_path / "untold", steps=1)))
    if "{told}" in flags:
        both = given(dataset, tmp_path / "told", task_vector=True, steps=1) | {"dataset": (dataset, sofa)}
        train(PolicyTrainOptions(**both))
    if "{broken}" in flags:
        shutil.copytree(checkpoint_folder(trained), tmp_path / "broken")
        held = load_file(tmp_path / "broken" / "model.safetensors")
        held["model.action_head.bias"][3] = torch.nan
        save_file(held, tmp_path / "broken" / "model.safetensors")
    places |= {name: tmp_path / name for name in ("untold", "told", "broken")}
    words = [word.format(**places) for word in flags]
    out = ["--dataset", str(dataset), "--recipe", "small", "--device", "cpu", "--steps", "1"]
    assert main([*words, *out, "--out", str(tmp_path / "out")]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "out" / "checkpoints").exists()


@pytest.mark.parametrize("family", ["diffusion", "flow"])
def test_other_families_begin_with_a_policy_of_their_own(dataset, tmp_path, family):
    """All their weights are the policy's."""
    flags = given(dataset, tmp_path / "first", policy=family, steps=1)
    train(PolicyTrainOptions(**flags))
    before = learned(weights(tmp_path / "first"))
    after = learned(begun(dataset, tmp_path / "out", tmp_path / "first", policy=family))
    assert before.keys() == after.keys()
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=0.0, atol=1e-6)


def test_pictures_must_be_framed_alike(trained, tmp_path):
    """A policy that sees padded pictures does not begin on others."""
    rng = np.random.default_rng(1)
    whole = make_dataset(
        tmp_path, pictures=lambda rows, size, seed: rng.integers(9, 250, (rows, size, size, 3), np.uint8)
    )
    with pytest.raises(InputError, match=r"sees 64x64 \(pad\), this training 64x64 \(native\)"):
        begun(whole, tmp_path / "out", trained)


def test_a_network_without_a_vector_learns_no_further_task(trained, tmp_path):
    """The error names what its vector lacks and cannot be given."""
    start = read_start(str(trained))
    facts = replace(start.facts, task_vector=("boxing", "chess"))
    other = replace(start, checkpoint=replace(start.checkpoint, facts=facts))
    with pytest.raises(InputError, match="its vector has no sit_sofa"):
        other.put_into(SimpleNamespace(policy=torch.nn.Identity()), ("boxing", "chess", "sit_sofa"), ())
