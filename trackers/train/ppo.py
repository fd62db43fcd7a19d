"""rsl_rl's PPO with one modification: the learning rate follows the KL divergence once per iteration.

rsl_rl changes the rate after every minibatch, when the policy has hardly moved; the divergence of the last epoch
measures the whole iteration. The update waits for the device once, where the original reads three losses per minibatch.
On CUDA a minibatch is two graphs, its gradients and the step, instead of about three hundred launches; between them the
processes average the gradients.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import nn

from arena_newton.trackers.front_end import Mirror
from arena_newton.trackers.train.graphs import captured
from arena_newton.trackers.train.model import TrackerActor

__all__ = ["TrackerPPO"]

_WARM = 3
"""Minibatches before a capture: libraries allocate what they need, the optimiser its moments."""
_LARGEST_CUT, _LARGEST_RISE = 0.6, 1.15
"""Bounds of the factor on the learning rate: the divergence of one iteration is a noisy measure."""
_MIRRORED = 4
"""One row in four is mirrored for the mirror loss: the second pass of the actor costs time."""


class TrackerPPO(PPO):
    """PPO whose learning rate is set once per iteration from the mean divergence of its last epoch."""

    actor: TrackerActor
    learning_rate: float
    """Current learning rate."""
    lowest_rate: float = 2e-5
    """Lower bound of the learning rate."""
    highest_rate: float = 1e-3
    """Upper bound of the learning rate."""

    def __init__(self, *args: Any, mirror_loss: float, graph: bool, **kwargs: Any):
        """Take rsl_rl's arguments and two of our own; `graph` allows CUDA graphs on a GPU."""
        self.mirror_loss = mirror_loss
        """Weight of the squared difference between the action of a mirrored observation and the mirrored action."""
        self.mirrors: tuple[Mirror, Mirror] | None = None
        """Mirror images of the actor's observation and of the action."""
        super().__init__(*args, **kwargs)
        self.last_kl = 0.0
        self.parameters = [*self.actor.parameters(), *self.critic.parameters()]
        """Trained parameters, the actor's first."""
        self.stream = torch.cuda.Stream(self.device) if str(self.device).startswith("cuda") else None
        """Stream of the updates on CUDA."""
        self.use_graphs = graph and self.stream is not None
        """True if a minibatch is captured."""
        self.captured: _Captured | None = None
        """A minibatch's graphs, once they are recorded."""
        self._entropy_weight = torch.zeros((), device=self.device)
        self._fit_optimizer()

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load a checkpoint of this or another kind of device; see rsl_rl."""
        iteration = super().load(loaded_dict, load_cfg, strict)
        self.learning_rate = float(self.learning_rate)
        self._fit_optimizer()
        return iteration

    def _fit_optimizer(self) -> None:
        """Keep the optimiser's rate and counts on the device, on CUDA, so that a graph can hold a step."""
        self.captured = None
        on_cuda = self.stream is not None
        for group in self.optimizer.param_groups:
            rate = torch.tensor(self.learning_rate, device=self.device) if on_cuda else self.learning_rate
            group.update(capturable=on_cuda, fused=True if on_cuda else None, lr=rate)
        for state in self.optimizer.state.values():
            state["step"] = state["step"].to(self.device)

    def update(self) -> dict[str, float]:
        """Optimise over the stored rollout; mean losses by name."""
        if self.rnd or self.symmetry or self.actor.is_recurrent or self.critic.is_recurrent:
            return super().update()
        self._entropy_weight.fill_(self.entropy_coef)
        with self._own_stream():
            totals, divergence = self._descend()
        observations = self.storage.observations.flatten(0, 1)
        self.actor.update_normalization(observations)
        self.critic.update_normalization(observations)
        self.storage.clear()
        divergence /= self.num_mini_batches
        if self.is_multi_gpu:
            torch.distributed.all_reduce(divergence)
            divergence /= self.gpu_world_size
        losses = (totals / (self.num_learning_epochs * self.num_mini_batches)).tolist()
        self.last_kl = float(divergence)
        self._set_rate(self.last_kl)
        return dict(zip(("value", "surrogate", "entropy", "kl"), (*losses, self.last_kl), strict=True))

    @contextlib.contextmanager
    def _own_stream(self) -> Iterator[None]:
        """Gradients must be captured on the stream on which autograd used the parameters before."""
        if self.stream is None:
            yield
            return
        outside = torch.cuda.current_stream(self.device)
        self.stream.wait_stream(outside)
        with torch.cuda.stream(self.stream):
            yield
        outside.wait_stream(self.stream)

    def _descend(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Step along all minibatches; sums of value loss, surrogate loss and entropy, and of the last epoch's KL."""
        last_epoch = (self.num_learning_epochs - 1) * self.num_mini_batches
        totals, divergence = torch.zeros(3, device=self.device), torch.zeros((), device=self.device)
        learning = [parameter.requires_grad for parameter in self.parameters]
        if self.captured is not None and self.captured.learning != learning:
            self.captured = None
        for k, batch in enumerate(self.storage.mini_batch_generator(self.num_mini_batches, self.num_learning_epochs)):
            if self.captured is None:
                self.optimizer.zero_grad(set_to_none=True)
                if self.use_graphs and k == _WARM:
                    self.captured = _Captured(self, batch, learning)
            work = self.captured or self
            losses = work.gradients(batch)
            if self.is_multi_gpu:
                self.reduce_parameters()
            work.step()
            totals += losses[:3]
            if k >= last_epoch:
                divergence += losses[3]
        return totals, divergence

    def gradients(self, batch: RolloutStorage.Batch) -> torch.Tensor:
        """Gradients of a minibatch; its value loss, surrogate loss, entropy and divergence, shape [4]."""
        self.actor.distribution.update(self.actor(batch.observations))
        log_prob = self.actor.get_output_log_prob(batch.actions)
        values = self.critic(batch.observations)
        parameters = self.actor.output_distribution_params
        entropy = self.actor.output_entropy.mean()
        with torch.no_grad():
            divergence = self.actor.get_kl_divergence(batch.old_distribution_params, parameters).mean()
        ratio = torch.exp(log_prob - batch.old_actions_log_prob.squeeze(-1))
        advantages = batch.advantages.squeeze(-1)
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = -torch.min(advantages * ratio, advantages * clipped).mean()
        if self.use_clipped_value_loss:
            near = batch.values + (values - batch.values).clamp(-self.clip_param, self.clip_param)
            value = torch.max((values - batch.returns).square(), (near - batch.returns).square()).mean()
        else:
            value = (values - batch.returns).square().mean()
        loss = surrogate + self.value_loss_coef * value - self._entropy_weight * entropy
        if self.mirror_loss > 0.0 and self.mirrors is not None:
            loss = loss + self.mirror_loss * self._asymmetry(batch.observations)
        loss.backward()
        return torch.stack((value.detach(), surrogate.detach(), entropy.detach(), divergence))

    def step(self) -> None:
        """One step along the gradients."""
        nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
        nn.utils.clip_grad_norm_(self.critic.parameters(), self.max_grad_norm)
        self.optimizer.step()

    def _asymmetry(self, observations: TensorDict) -> torch.Tensor:
        """Mean squared difference between the action of mirrored observations and the mirrored action, on some rows."""
        assert self.mirrors is not None
        rows = len(observations) // _MIRRORED
        mirror_obs, mirror_action = self.mirrors
        straight = self.actor.output_mean[:rows]
        mirrored = self.actor(TensorDict({"actor": mirror_obs(observations["actor"][:rows])}, batch_size=[rows]))
        return (mirrored - mirror_action(straight.detach())).square().mean()

    def _set_rate(self, divergence: float) -> None:
        """Every process computes the same rate, for the divergence is the mean of all."""
        if self.schedule != "adaptive" or self.desired_kl is None:
            return
        # Divergence grows with the square of the rate.
        factor = min(max((self.desired_kl / max(divergence, 1e-8)) ** 0.5, _LARGEST_CUT), _LARGEST_RISE)
        self.set_learning_rate(min(max(self.learning_rate * factor, self.lowest_rate), self.highest_rate))

    def set_learning_rate(self, rate: float) -> None:
        """Set the rate of the optimiser."""
        self.learning_rate = rate
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], torch.Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate


class _Captured:
    """A minibatch's work in CUDA graphs, for one set of parameters that learn."""

    def __init__(self, ppo: TrackerPPO, batch: RolloutStorage.Batch, learning: list[bool]):
        """Capture it; gradients must be None before, for the graph allocates them."""
        self.learning = learning
        mine = RolloutStorage.Batch(
            batch.observations.clone(),
            **{name: getattr(batch, name).clone() for name in _FIELDS},
            old_distribution_params=tuple(parameter.clone() for parameter in batch.old_distribution_params),
        )
        self._inputs = _tensors(mine)

        def gradients() -> None:
            self._losses = ppo.gradients(mine)

        self._gradients = captured(gradients, "update-graph", ppo.stream)
        self._step = captured(ppo.step, "update-graph", ppo.stream)

    def gradients(self, batch: RolloutStorage.Batch) -> torch.Tensor:
        """Gradients as of `TrackerPPO.gradients`; the result's buffer is reused by the next call."""
        torch._foreach_copy_(self._inputs, _tensors(batch))
        self._gradients.replay()
        return self._losses

    def step(self) -> None:
        """Step as `TrackerPPO.step` does."""
        self._step.replay()


_FIELDS = ("actions", "values", "advantages", "returns", "old_actions_log_prob")


def _tensors(batch: RolloutStorage.Batch) -> list[torch.Tensor]:
    fields = [getattr(batch, name) for name in _FIELDS]
    return [*fields, *(batch.observations[name] for name in batch.observations.keys()), *batch.old_distribution_params]
