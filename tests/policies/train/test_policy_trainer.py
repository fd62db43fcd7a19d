"""Steps of a training of a narrow ACT: processes, frozen statistics, compiled networks, the loss."""

import contextlib
import itertools
import re

import pytest
import torch

from arena_newton.errors import ArenaError
from arena_newton.policies.train import policy_trainer
from tests.policies.train import narrow_network
from tests.policies.train.plain_trainer import plain_trainer


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    """A vision encoder that trains in milliseconds."""
    narrow_network.install(monkeypatch.setattr)


def test_processes_that_differ_are_refused(monkeypatch):
    """Weights that drift apart end a training of several processes before they are saved."""
    monkeypatch.setattr(torch.distributed, "broadcast", lambda tensor, source: None)
    trainer = plain_trainer(2, ranks=2)
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda tensor, operation: None)
    trainer.check_agreement()
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda tensor, operation: tensor.add_(float(operation)))
    with pytest.raises(ArenaError, match="2 processes hold different weights"):
        trainer.check_agreement()


def test_the_last_steps_keep_the_statistics_of_the_encoder(monkeypatch):
    """In the last fraction of the steps that a recipe names the encoder's weights change and its statistics do not."""
    trainer = plain_trainer(2, batch_norm=True, frozen_norms=0.5)
    norm = next(m for m in trainer.model.policy.modules() if isinstance(m, torch.nn.BatchNorm2d))
    means, scales = [norm.running_mean.clone()], [norm.weight.detach().clone()]
    for _ in range(6):
        trainer.advance()
        trainer.held_out_losses()
        means.append(norm.running_mean.clone())
        scales.append(norm.weight.detach().clone())
    assert [not torch.equal(a, b) for a, b in itertools.pairwise(means)] == [True] * 3 + [False] * 3
    assert not any(torch.equal(a, b) for a, b in itertools.pairwise(scales))


@pytest.mark.parametrize("wrong_calls", [0, 1, 2])
def test_a_wrong_compiled_gradient_is_not_used(monkeypatch, wrong_calls):
    """It is compared before the first step and where the statistics freeze, and computed twice before it is left."""
    plain, compiled = (plain_trainer(2, batch_norm=True, frozen_norms=0.5) for _ in range(2))
    factor, calls = [], []
    real = compiled.model.losses

    @contextlib.contextmanager
    def uncompiled():
        factor.append(1.0)
        yield
        factor.pop()

    def losses(batch, noise):
        loss, each = real(batch, noise)
        if not factor:
            calls.append(compiled.step)
        wrong = not factor and compiled.step >= 3 and calls.count(3) <= wrong_calls
        return loss * (1000.0 if wrong else 1.0), each

    monkeypatch.setattr(policy_trainer, "uncompiled", uncompiled)
    monkeypatch.setattr(compiled.model, "losses", losses)
    compiled._agrees, compiled._compiled = False, True
    for _ in range(6):
        plain.advance()
        compiled.advance()
    pairs = zip(plain.model.policy.parameters(), compiled.model.policy.parameters(), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
    assert calls == [[0, 0, 1, 2, 3, 3, 4, 5], [0, 0, 1, 2, 3, 3, 3, 4, 5], [0, 0, 1, 2, 3, 3]][wrong_calls]
    fault = r"--compile: step 3: the compiled network's gradient .* \(most in .*\): .* trains on without"
    assert bool(re.match(fault, compiled.compiler_fault)) == (wrong_calls == 2)


def test_two_processes_take_the_step_of_one_with_twice_the_batch(monkeypatch):
    """The mean of two processes' gradients is that of both batches together, and both end with the same weights."""
    one = plain_trainer(4)
    monkeypatch.setattr(torch.distributed, "broadcast", lambda tensor, source: None)
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda tensor: None)
    pair = [plain_trainer(2, rank, 2) for rank in range(2)]
    for _ in range(3):
        one.advance()
        for trainer in pair:  # what `advance` does, with the exchange in the middle
            trainer._prepare(trainer.step)
            trainer._descend()
        total = pair[0]._flat + pair[1]._flat
        for trainer in pair:
            trainer._flat.copy_(total)
            trainer._average()
            trainer._update()
            trainer.step += 1
    single, first, second = (t.model.policy.state_dict() for t in (one, *pair))
    for name in single:
        assert torch.equal(first[name], second[name]), name
        assert torch.allclose(single[name], first[name], atol=2e-5), name


def test_training_lowers_the_loss(monkeypatch):
    """Forty steps on forty rows: the loss of rows that are trained on falls by a fifth at least."""
    trainer = plain_trainer(20, lr=5e-3, lr_backbone=5e-3)
    trainer.fix_steps(40)
    losses = []
    for _ in range(40):
        trainer.advance()
        losses.append(float(trainer.loss))
    assert sum(losses[-4:]) < 0.8 * sum(losses[:4]), losses
