"""The bench `policy`: parts of a tick add up, random weights need neither GPU nor hub, wrong flags are named."""

import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.eval.bench import timing
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families, pi05_family
from benchmarks import policy_bench
from benchmarks.bench_options import PolicyBenchOptions


def small(folder):
    """A tiny ACT that sees 64x64 pictures and answers v4."""
    settings = recipe("act", "small")
    ones = {
        name: {"mean": torch.zeros(n), "std": torch.ones(n), "min": -torch.ones(n), "max": torch.ones(n)}
        | {"q01": -torch.ones(n), "q99": torch.ones(n)}
        for name, n in (("observation.state", 64), ("action", 40))
    }
    facts = CheckpointFacts(labels="v4", width=64, height=64, family="act", recipe="small")
    families.build(settings, ones, "cpu").save(folder, facts)
    return folder


@pytest.mark.parametrize("family", ["act", "flow", "pi05"])
def test_random_weights_are_made_without_a_gpu(tmp_path, monkeypatch, family):
    """Machines with several GPUs start none of them, and the generator of whoever asks stays where it was."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    before = torch.random.get_rng_state()
    policy_bench.random_checkpoint(tmp_path / family, "small", family=family)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert (tmp_path / family / "model.safetensors").is_file()


def test_weights_of_full_size_need_no_download(tmp_path, monkeypatch):
    """Random weights of pi0.5 have the recipe's sizes and a tokenizer of this package; no hub is asked."""
    wanted = []

    def stopped(config):
        wanted.append((config.paligemma_variant, config.action_expert_variant, config.pretrained_path))
        raise KeyboardInterrupt

    monkeypatch.setattr(pi05_family, "new_policy", stopped)
    with pytest.raises(KeyboardInterrupt):
        policy_bench.random_checkpoint(tmp_path / "pi05", family="pi05")
    ((*sizes, path),) = wanted
    assert sizes == ["gemma_2b", "gemma_300m"] and not path
    with pytest.raises(InputError, match="--family cat: unknown, choose from act, diffusion, flow, pi05"):
        next(policy_bench.policy_figures(PolicyBenchOptions(family="cat")))


def test_parts_of_a_tick_are_measured(tmp_path, monkeypatch):
    """Every part takes time, together no more than the whole; the environment keeps its own methods afterwards."""
    monkeypatch.setattr(policy_bench, "WARM_UP", 2)
    parts, made = timing.RepeatedEpisodes.parts, []

    def kept(bench, ticks):
        spent, whole = parts(bench, ticks)
        made.append((bench.env, bench.policy, dict(spent), whole))
        return spent, whole

    monkeypatch.setattr(timing.RepeatedEpisodes, "parts", kept)
    options = PolicyBenchOptions(checkpoint=str(small(tmp_path / "act")), tasks=("boxing",), episodes=1, steps=4)
    (figure,) = policy_bench.policy_figures(options)
    ((env, policy, spent, whole),) = made
    assert set(spent) == {"physics", "pictures", "tracker", "policy"} and all(one > 0 for one in spent.values())
    assert sum(spent.values()) <= whole
    assert "step" not in vars(env.physics) and "act" not in vars(policy) and "render" not in vars(env)
    assert figure.verdict == "-" and "physics" in figure.note and "4 ticks" in figure.note


def test_a_checkpoint_that_is_not_there_is_named():
    """A wrong --checkpoint is bad input, not a figure that was missed."""
    with pytest.raises(InputError, match="nowhere"):
        list(policy_bench.policy_figures(PolicyBenchOptions(checkpoint="/nowhere", tasks=("boxing",))))
