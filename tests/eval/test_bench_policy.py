"""bench --what policy and start: parts add up, bars are judged at full size only, a start that fails is said."""

import json
import subprocess
from types import SimpleNamespace

import pytest
import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench import bench_learned, bench_policy, bench_start
from arena_newton.eval.bench.bench_options import BenchOptions
from arena_newton.policies.learned import learned_card
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train.families import families, pi05_family
from tests.made_packed import packed


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
    """Where there are several GPUs none of them is started, and the generator of whoever asks stays where it was."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    before = torch.random.get_rng_state()
    bench_policy.random_checkpoint(tmp_path / family, "small", family=family)
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
        bench_policy.random_checkpoint(tmp_path / "pi05", family="pi05")
    ((*sizes, path),) = wanted
    assert sizes == ["gemma_2b", "gemma_300m"] and not path
    with pytest.raises(InputError, match="--policy-family cat: unknown, choose from act, diffusion, flow, pi05"):
        next(bench_policy.policy_figures(BenchOptions(policy_family="cat")))


def test_parts_of_a_tick_are_measured(tmp_path, monkeypatch):
    """Every part takes time, together no more than the whole; the environment keeps its own methods afterwards."""
    monkeypatch.setattr(bench_policy, "WARM_UP", 2)
    parts, made = bench_policy.timed_parts, []

    def kept(env, policy, play):
        found = parts(env, policy, play)
        made.append((env, policy, *found))
        return found

    monkeypatch.setattr(bench_policy, "timed_parts", kept)
    options = BenchOptions(
        policy_checkpoint=str(small(tmp_path / "act")), policy_tasks=("boxing",), policy_episodes=1, policy_steps=4
    )
    (figure,) = bench_policy.policy_figures(options)
    ((env, policy, spent, whole),) = made
    assert set(spent) == set(bench_policy.PARTS) and all(seconds > 0 for seconds in spent.values())
    assert sum(spent.values()) <= whole
    assert "step" not in vars(env.physics) and "act" not in vars(policy) and "render" not in vars(env)
    assert figure.verdict == "-" and "physics" in figure.note and "4 ticks" in figure.note


def test_the_policy_that_ships_is_compared_with_the_expert(tmp_path, monkeypatch):
    """Ticks of both, in turn, as a ratio that is judged; the note says where the time of the one that sees goes."""
    monkeypatch.setattr(learned_card, "SHIPPED", packed(tmp_path / "policy", ("boxing",)))
    for name, value in (("WARM_UP", 2), ("ROUNDS", 1), ("WORLDS", (1,))):
        monkeypatch.setattr(bench_learned, name, value)
    (figure,) = bench_learned.learned_figures(BenchOptions(learned_ticks=6))
    assert figure.value > 0.0 and figure.bar == 2.0 and figure.verdict in ("pass", "MISS")
    assert "boxing, 1 world" in figure.name and "pictures" in figure.note and "policy of the package" in figure.note


def test_a_checkpoint_that_is_not_there_is_named():
    """A wrong --policy-checkpoint is bad input, not a figure that was missed."""
    with pytest.raises(InputError, match="nowhere"):
        list(bench_policy.policy_figures(BenchOptions(policy_checkpoint="/nowhere", policy_tasks=("boxing",))))


def test_three_starts_with_two_caches(monkeypatch):
    """The second start has the first one's cache, the third an empty one and one thread; off CUDA nothing is judged."""
    calls = []

    def fake(command, env, **options):
        calls.append((env["WARP_CACHE_PATH"], command[-1]))
        return SimpleNamespace(returncode=0, stderr="", stdout=json.dumps({"environment": 2.0}) + "\n")

    monkeypatch.setattr(subprocess, "run", fake)
    figures = list(bench_start.start_figures(BenchOptions()))
    caches = [cache for cache, _ in calls]
    assert caches[0] == caches[1] != caches[2] and calls[2][1].endswith(", 1)") and calls[0][1].endswith(", 0)")
    assert [figure.bar for figure in figures] == [40.0, 8.0]
    assert torch.cuda.is_available() or [figure.value for figure in figures] == [None, None]
    for figure in figures:  # what comes before the environment is said, but not judged
        assert "environment 2.0 s" in figure.note and "not in the figure: interpreter and libraries" in figure.note
        assert figure.value == 2.0 or figure.note.startswith("2.0 s, judged on CUDA only")


def test_a_start_that_fails_says_why(monkeypatch):
    """The last words of the process are in the error."""
    monkeypatch.setattr(
        subprocess, "run", lambda *a, **k: SimpleNamespace(returncode=1, stderr="no\nmemory left", stdout="")
    )
    with pytest.raises(ArenaError, match="the first tick was not reached: no memory left"):
        list(bench_start.start_figures(BenchOptions()))
