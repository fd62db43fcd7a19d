"""Trainings that begin with the weights of a trained policy: a narrow ACT on the CPU."""

import shutil
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

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
        train(PolicyTrainOptions(recipe="small", task_vector=True, **given(dataset, out)))
    return out


def given(dataset, out, **changes):
    """Flags of a small training."""
    return {"dataset": (dataset,), "out": out, "device": "cpu", "steps": 2, "quiet": True} | changes


def weights(out):
    """Weights of a training."""
    return load_file(checkpoint_folder(out) / "model.safetensors")


def begun(dataset, out, start, **changes):
    """A training that begins with another one's weights, and hardly changes them."""
    train(PolicyTrainOptions(**given(dataset, out, start_from=str(start), lr=STILL, **changes)))
    return weights(out)


def learned(tensors):
    """Those without the statistics of batches, which follow the data."""
    return {name: tensor for name, tensor in tensors.items() if "running_" not in name}


def test_a_training_begins_with_the_weights_and_numbers_of_a_policy(trained, sofa, tmp_path):
    """Recipe, labels and statistics are its own too; a task of its vector keeps its column, another one gets one."""
    before, after = learned(weights(trained)), learned(begun(sofa, tmp_path / "out", trained))
    assert before.keys() == after.keys()
    for name in before.keys() - {VECTOR_WEIGHT}:
        torch.testing.assert_close(after[name], before[name], rtol=0.0, atol=1e-6)
    assert after[VECTOR_WEIGHT].shape[1] == 2
    torch.testing.assert_close(after[VECTOR_WEIGHT][:, :1], before[VECTOR_WEIGHT], rtol=0.0, atol=1e-6)
    old, new = (CheckpointFacts.read(checkpoint_folder(one)) for one in (trained, tmp_path / "out"))
    assert (new.recipe, new.labels, new.task_vector) == ("small", old.labels, ("boxing", "sit_sofa"))
    assert (new.tasks, new.trackers) == (("sit_sofa",), ("sonic",))
    assert (old.started_from, new.started_from) == ("", read_checkpoint(checkpoint_folder(trained)).digest)
    for feature, of in read_start(str(trained)).stats.items():
        for name, value in of.items():
            torch.testing.assert_close(read_start(str(tmp_path / "out")).stats[feature][name], value)


def test_it_answers_as_the_policy_did(trained, dataset, tmp_path):
    """With the same data and no change the loss of the first step is that of the policy, not that of new weights."""
    losses = {}
    for name, flags in {"begun": {"start_from": str(trained)}, "new": {"recipe": "small", "task_vector": True}}.items():
        train(PolicyTrainOptions(**given(dataset, tmp_path / name, steps=1, log_every=1, lr=STILL, **flags)))
        losses[name] = float((tmp_path / name / "progress.csv").read_text().splitlines()[1].split(",")[2])
    assert losses["begun"] < losses["new"]


def test_it_goes_on_without_the_policy(trained, sofa, tmp_path):
    """A stopped training needs neither the policy's folder nor its flags, and still says what it began with."""
    start, out = tmp_path / "start", tmp_path / "out"
    shutil.copytree(trained, start, symlinks=True)
    digest = read_start(str(start)).digest
    begun(sofa, out, start)
    shutil.rmtree(start)
    assert main(["--resume", str(out), "--steps", "3", "--quiet"]) == 0
    facts = CheckpointFacts.read(checkpoint_folder(out))
    assert (facts.steps, facts.started_from, facts.task_vector) == (3, digest, ("boxing", "sit_sofa"))


def test_several_trackers_get_a_number_each(dataset, sofa, trained, tmp_path):
    """Of a policy that is told its tracker; columns are kept by what they say."""
    flags = given(dataset, tmp_path / "both", recipe="small", task_vector=True) | {"dataset": (dataset, sofa)}
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
        (["--start-from", "nowhere"], "--start-from nowhere: no such folder"),
        (["--start-from", "{trained}", "--weights", "x"], "--weights: are those of --start-from; drop one of them"),
        (["--start-from", "{trained}", "--labels", "v3.1"], "has labels v4, this training v3.1"),
        (["--start-from", "{trained}", "--policy", "flow"], "has family act, this training flow"),
        (["--start-from", "{trained}", "--recipe-values", "network.dim_model=16"], "has another shape of model."),
        (["--start-from", "learned"], "recipe act/compact takes 224x224"),
    ],
)
def test_an_unfit_start_is_one_error(trained, dataset, tmp_path, capsys, flags, says):
    """It names the flag or file, the code is 2, and no training is left."""
    words = [word.format(trained=trained) for word in flags]
    out = ["--dataset", str(dataset), "--device", "cpu", "--steps", "1", "--out", str(tmp_path / "out")]
    assert main([*words, *out]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "out" / "checkpoints").exists()


def test_a_network_without_a_vector_learns_no_further_task(trained, tmp_path):
    """Where the vector cannot be made longer, the error names what it lacks."""
    start = read_start(str(trained))
    other = replace(start, facts=replace(start.facts, task_vector=("boxing", "chess")))
    with pytest.raises(InputError, match="its vector has no sit_sofa"):
        other._widen({}, {}, ("boxing", "chess", "sit_sofa"), ())
