"""Trainings with --compile: the losses of one without it, the same names, clear errors."""

import csv
import shutil

import pytest
import torch
from safetensors.torch import load_file
from torch._inductor.utils import fresh_cache

from arena_newton.errors import ArenaError, InputError
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import FAMILIES, recipe
from arena_newton.policies.train import network_compiler, training
from arena_newton.policies.train.__main__ import main
from arena_newton.policies.train.families import families
from arena_newton.policies.train.families.act_family import ActModel
from arena_newton.policies.train.policy_options import UNCOMPILED, PolicyTrainOptions
from arena_newton.policies.train.training import train
from tests.policies.train import narrow_network
from tests.policies.train.made_stats import made_stats
from tests.policies.train.stock_lerobot import opened, raw_observation

STEPS = 3
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    """A vision encoder that trains in milliseconds."""
    narrow_network.install(monkeypatch.setattr)


@pytest.fixture
def compiler(monkeypatch):
    """A network that draws no random numbers, of which a compiler draws others, and is compiled in seconds."""
    if not shutil.which("g++"):
        pytest.skip("needs g++ (Debian: apt-get install g++)")
    sizes = {"dropout": 0.0, "use_vae": False, "n_encoder_layers": 1, "n_decoder_layers": 1}
    monkeypatch.setattr(training, "recipe", lambda family, name, **more: recipe(family, name, network=sizes, **more))
    with torch._inductor.config.patch(compile_threads=1):
        yield
    torch.compiler.reset()


def options(data, out, **changes):
    """Flags of a small training."""
    given = {"recipe": "small", "dataset": (data,), "out": out, "device": "cpu", "steps": STEPS, "quiet": True}
    return PolicyTrainOptions(**(given | {"log_every": 1, "hold_out": 1, "hold_out_every": STEPS} | changes))


def losses(out):
    """Losses of a training's log, held-out ones last."""
    with (out / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [float(row[key]) for key in ("loss", "held_out_loss") for row in rows if row.get(key)]


@pytest.mark.release
def test_a_compiled_training_is_the_training(dataset, tmp_path, compiler):
    """Losses, also of held-out rows, and weights are those without a compiler; LeRobot loads it; it resumes without."""
    plain = train(options(dataset, tmp_path / "plain"))
    compiled = train(options(dataset, tmp_path / "compiled", compile=True))
    assert losses(tmp_path / "compiled") == pytest.approx(losses(tmp_path / "plain"), rel=1e-4)
    assert len(losses(tmp_path / "plain")) == STEPS + 1
    tensors = [load_file(folder / "model.safetensors") for folder in (plain, compiled)]
    assert list(tensors[0]) == list(tensors[1])
    assert all(torch.allclose(tensors[0][name], tensors[1][name], atol=1e-4) for name in tensors[0])
    policy, before, after = opened(compiled)
    policy.eval()
    assert after(policy.predict_action_chunk(before(raw_observation()))).isfinite().all()
    assert CheckpointFacts.read(compiled).options["flags"]["compile"] is True
    assert CheckpointFacts.read(plain).options["flags"]["compile"] is False
    for name in ("plain", "compiled"):  # goes on without, as nothing else is said
        resumed = train(PolicyTrainOptions(resume=tmp_path / name, steps=STEPS + 1, quiet=True))
        assert CheckpointFacts.read(resumed).options["flags"]["compile"] is False
    assert losses(tmp_path / "compiled") == pytest.approx(losses(tmp_path / "plain"), rel=1e-4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_compiled_step_is_captured(dataset, tmp_path, compiler):
    """On a GPU compiled networks are part of the step's graph, with the losses of a step that is neither."""
    plain, compiled = tmp_path / "plain", tmp_path / "compiled"
    train(options(dataset, plain, device="cuda", graph=False))
    train(options(dataset, compiled, device="cuda", compile=True))
    assert losses(compiled) == pytest.approx(losses(plain), rel=0.02)


@pytest.mark.parametrize("family", [name for name in FAMILIES if name not in UNCOMPILED])
def test_nearly_all_parameters_are_compiled(family):
    """Compiled parts of a family hold nearly all parameters that learn, and keep their names."""
    model = families.build(recipe(family, "small"), made_stats(), "cpu")
    names = list(model.policy.state_dict())
    called = {id(p) for part in model.compiled_parts() for p in part.parameters()}
    learning = [p for group in model.groups() for p in group["params"]]
    assert sum(p.numel() for p in learning if id(p) in called) > 0.9 * sum(p.numel() for p in learning)
    network_compiler.compile_networks(model)
    assert list(model.policy.state_dict()) == names and list(model.state_dict()) == [
        name for name in names if name in model.state_dict()
    ]


def test_families_that_cannot_be_compiled_say_so(tmp_path, capsys):
    """pi0.5 is refused by name before anything is read, on the command line and by its model."""
    (tmp_path / "data").mkdir()
    assert main(["--dataset", str(tmp_path / "data"), "--policy", "pi05", "--compile"]) == 2
    assert "--compile: pi05 cannot be compiled" in capsys.readouterr().err
    for family in FAMILIES:
        model = families.build(recipe(family, "small"), made_stats(), "cpu")
        assert model.compilable == (family not in UNCOMPILED)
        if not model.compilable:
            with pytest.raises(InputError, match="--compile: pi05 cannot be compiled"):
                network_compiler.compile_networks(model)


def test_a_missing_compiler_is_said_at_once(dataset, tmp_path, monkeypatch):
    """Without a compiler nothing is decoded or made, and the error names a package; CXX may name another compiler."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(InputError, match=r"--compile: needs a compiler, g\+\+ or clang\+\+ is not there .*apt-get"):
        train(options(dataset, tmp_path / "out", compile=True))
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv("CXX", "my-c++")
    with pytest.raises(InputError, match=r"my-c\+\+ is not there"):
        network_compiler.check_compiler(CPU)
    (tmp_path / "my-c++").touch(0o755)
    network_compiler.check_compiler(CPU)
    with pytest.raises(InputError, match="gcc or clang is not there"):
        network_compiler.check_compiler(torch.device("cuda"))


def test_a_compiler_that_fails_is_one_error(dataset, tmp_path, monkeypatch):
    """A compiler's complaint is in one line of ours; errors of other kinds stay what they are."""
    broken = tmp_path / "g++"
    broken.write_text("#!/bin/sh\necho broken >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CXX", str(broken))
    monkeypatch.setattr(torch._inductor.config.cpp, "cxx", (None, str(broken)))
    torch.compiler.reset()
    # One layer is enough for a complaint.
    monkeypatch.setattr(ActModel, "compiled_parts", lambda self: [self.policy.model.action_head])
    # A cache that other processes fill could spare this one the compiler, and a pool of processes be slow to start.
    own = fresh_cache(dir=str(tmp_path)), torch._inductor.config.patch(compile_threads=1)
    with own[0], own[1], pytest.raises(ArenaError, match="--compile: the network could not be compiled") as error:
        train(options(dataset, tmp_path / "out", compile=True))
    assert "\n" not in str(error.value)
    with pytest.raises(RuntimeError, match="other"), network_compiler.compiler_errors():
        raise RuntimeError("other")
    torch.compiler.reset()
