"""The update on synthetic rollouts: with and without CUDA graphs, across devices."""

import copy
import io

import pytest
import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from arena_newton.trackers.train import ppo as ppo_module
from arena_newton.trackers.train.model import TrackerActor, TrackerCritic
from arena_newton.trackers.train.ppo import TrackerPPO

WORLDS, STEPS = 16, 8
cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")


def learner(device: str, graph: bool = False) -> TrackerPPO:
    """PPO of a small twist2 network with the same start on every device."""
    torch.manual_seed(0)
    obs = TensorDict({"actor": torch.zeros(WORLDS, 1432), "critic": torch.zeros(WORLDS, 40)}, batch_size=[WORLDS])
    groups = {"actor": ["actor"], "critic": ["critic"]}
    actor = TrackerActor(obs, groups, "actor", 29, interface="twist2", network={"hidden": [32]}, init_std=0.6)
    critic = TrackerCritic(obs, groups, "critic", 1, hidden_dims=[32], activation="elu", obs_normalization=True)
    storage = RolloutStorage("rl", WORLDS, STEPS, obs, [29], device)
    settings = {"entropy_coef": 0.01, "use_clipped_value_loss": False, "mirror_loss": 0.0, "graph": graph}
    return TrackerPPO(actor, critic, storage, **settings, device=device)


def update(ppo: TrackerPPO, seed: int) -> dict[str, float]:
    """Roll out noise and learn from it; the numbers are drawn on the CPU, so that devices agree."""
    rng = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng).to(ppo.device)

    with torch.no_grad():
        for _ in range(STEPS):
            groups = {"actor": noise(WORLDS, 1432), "critic": noise(WORLDS, 40)}
            obs = TensorDict(groups, batch_size=[WORLDS]).to(ppo.device)
            ppo.act(obs)
            actions = ppo.actor.output_mean + 0.5 * noise(WORLDS, 29)
            ppo.transition.actions = actions
            ppo.transition.actions_log_prob = ppo.actor.get_output_log_prob(actions)
            ppo.process_env_step(obs, noise(WORLDS), torch.zeros(WORLDS, device=ppo.device), {})
        ppo.compute_returns(obs)
    with torch.random.fork_rng(devices=[ppo.device] if ppo.device != "cpu" else []):
        torch.manual_seed(seed)  # the shuffle
        return ppo.update()


def weights(ppo: TrackerPPO) -> torch.Tensor:
    """All parameters in a row."""
    return torch.cat([p.detach().flatten().cpu() for p in ppo.parameters])


def carried(state: dict, device: str) -> dict:
    """A checkpoint through a file."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True, map_location=device)


def test_an_update_from_a_checkpoint_is_the_update_itself():
    """Moments, counts and rate are all there is to know."""
    first, second = learner("cpu"), learner("cpu")
    update(first, 1)
    second.load(carried(first.save(), "cpu"), None, True)
    assert torch.equal(weights(first), weights(second))
    assert update(first, 2) == update(second, 2)
    assert torch.equal(weights(first), weights(second))


def test_a_minibatch_learns_only_what_may_learn():
    """A critic alone leaves the actor as it is, then both move."""
    ppo = learner("cpu")
    actor = [*ppo.actor.parameters()]
    for parameter in actor:
        parameter.requires_grad_(False)
    before = [p.detach().clone() for p in ppo.parameters]
    update(ppo, 1)
    moved = [not torch.equal(p, b) for p, b in zip(ppo.parameters, before, strict=True)]
    assert moved == [False] * len(actor) + [True] * (len(moved) - len(actor))
    for parameter in actor:
        parameter.requires_grad_(True)
    update(ppo, 2)
    assert not any(torch.equal(p, b) for p, b in zip(ppo.parameters, before, strict=True))


class Tape(TorchDispatchMode):
    """A CUDA graph's meaning on the CPU: the operations of some work, done again on the very same tensors."""

    def __init__(self):
        super().__init__()
        self.operations = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        self.operations.append((func, args, kwargs or {}, out))
        return out

    def replay(self) -> None:
        """Do it again; results go where they went."""
        with torch.no_grad():
            for func, args, kwargs, out in self.operations:
                given = {t.untyped_storage().data_ptr() for t in tree_leaves((args, kwargs)) if torch.is_tensor(t)}
                for old, new in zip(tree_leaves(out), tree_leaves(func(*args, **kwargs)), strict=True):
                    if torch.is_tensor(old) and old.untyped_storage().data_ptr() not in given:
                        old.copy_(new)


def recorded(ppo: TrackerPPO, work) -> Tape:
    """A tape of work that leaves parameters and optimiser as they were, as recording a CUDA graph does."""
    kept = [p.detach().clone() for p in ppo.parameters]
    moments = copy.deepcopy(ppo.optimizer.state_dict()["state"])
    with Tape() as tape:
        work()
    with torch.no_grad():
        for parameter, before in zip(ppo.parameters, kept, strict=True):
            parameter.copy_(before)
        for k, state in moments.items():
            for name, before in state.items():
                ppo.optimizer.state[ppo.parameters[k]][name].copy_(before)
    return tape


def compare(graphed: TrackerPPO, plain: TrackerPPO) -> None:
    """Updates of both agree, also when the parameters that learn, the rate and the entropy's weight change."""
    for ppo in (graphed, plain):
        for parameter in ppo.actor.parameters():
            parameter.requires_grad_(False)
    for seed in range(6):
        for ppo in (graphed, plain):
            if seed == 2:
                for parameter in ppo.actor.parameters():
                    parameter.requires_grad_(True)
            if seed == 4:
                ppo.set_learning_rate(1e-4)
                ppo.entropy_coef = 0.5
        losses = [update(ppo, seed) for ppo in (graphed, plain)]
        assert graphed.captured is not None and plain.captured is None
        assert losses[0] == pytest.approx(losses[1], rel=1e-3, abs=1e-4)
    assert torch.allclose(weights(graphed), weights(plain), atol=1e-4)


def test_an_update_can_be_replayed(monkeypatch):
    """Done again on the same tensors, a minibatch is a minibatch: nothing that it reads or writes has moved."""
    graphed, plain = learner("cpu"), learner("cpu")
    monkeypatch.setattr(ppo_module, "captured", lambda work, option, stream: recorded(graphed, work))
    graphed.use_graphs = True
    for ppo in (graphed, plain):
        # As on CUDA: the optimiser's counts and rate are tensors.
        ppo.optimizer.param_groups[0].update(fused=True, lr=torch.tensor(ppo.learning_rate))
    compare(graphed, plain)


@cuda
def test_a_captured_update_is_the_update():
    """On the device itself."""
    compare(learner("cuda:0", graph=True), learner("cuda:0"))


@pytest.mark.parametrize(
    ("source", "target"),
    [
        ("cpu", "cpu"),
        *(pytest.param(*pair, marks=cuda) for pair in (("cpu", "cuda:0"), ("cuda:0", "cpu"), ("cuda:0", "cuda:0"))),
    ],
)
def test_a_checkpoint_goes_on_on_another_kind_of_device(source, target):
    """Moments and rate arrive; what is learnt then differs by the shuffle, which each device draws its own way."""
    here, there = learner(source, graph=True), learner(target, graph=True)
    update(here, 1)
    there.load(carried(here.save(), target), None, True)
    assert torch.equal(weights(here), weights(there)) and there.learning_rate == pytest.approx(here.learning_rate)
    moments = [
        torch.cat([v.flatten().cpu() for s in ppo.optimizer.state.values() for v in s.values()])
        for ppo in (here, there)
    ]
    assert torch.equal(*moments)
    before = weights(here)
    for ppo in (here, there):
        update(ppo, 2)
    moved = [float((weights(ppo) - before).norm()) for ppo in (here, there)]
    assert 0.0 < moved[0] == pytest.approx(moved[1], rel=0.2)
