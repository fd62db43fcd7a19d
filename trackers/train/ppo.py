"""rsl-rl's PPO with one change of rule: the learning rate follows the KL divergence once an iteration.

rsl-rl changes the rate after every minibatch, when the policy has hardly moved; the divergence of the last epoch tells
how far the whole iteration went. The update waits for the device once, where the original reads three losses a
minibatch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import nn

if TYPE_CHECKING:
    from arena_newton.trackers.front_end import Mirror

__all__ = ["IterationPPO"]


class IterationPPO(PPO):
    """PPO whose learning rate is set once an iteration from the mean divergence of its last epoch."""

    learning_rate: float
    """Present learning rate."""
    lowest_rate: float = 2e-5
    """Lower bound of the learning rate."""
    highest_rate: float = 1e-3
    """Upper bound of the learning rate."""

    def __init__(self, *args: Any, **kwargs: Any):
        """Take rsl-rl's arguments and `mirror_loss`.

        Args:
            args: rsl-rl's.
            kwargs: rsl-rl's; `schedule` is `adaptive` or `fixed`, `desired_kl` the divergence aimed at. `mirror_loss`
                weighs the squared difference between the action of a mirrored observation and the mirrored action.
        """
        self.mirror_loss: float = kwargs.pop("mirror_loss", 0.0)
        self.mirrors: tuple[Mirror, Mirror] | None = None
        """Mirror images of the actor's observation and of the action."""
        super().__init__(*args, **kwargs)
        self.last_kl = 0.0
        self._parameters = [*self.actor.parameters(), *self.critic.parameters()]

    def update(self) -> dict[str, float]:
        """Optimise over the stored rollout; mean losses by name."""
        if self.rnd or self.symmetry or self.actor.is_recurrent or self.critic.is_recurrent:
            return super().update()
        batches = self.num_learning_epochs * self.num_mini_batches
        last_epoch = batches - self.num_mini_batches
        totals = torch.zeros(3, device=self.device)
        divergence = torch.zeros((), device=self.device)
        generator = self.storage.mini_batch_generator(self.num_mini_batches, self.num_learning_epochs)
        for k, batch in enumerate(generator):
            self.actor(batch.observations, stochastic_output=True)
            log_prob = self.actor.get_output_log_prob(batch.actions)
            values = self.critic(batch.observations)
            parameters = self.actor.output_distribution_params
            entropy = self.actor.output_entropy.mean()
            if k >= last_epoch:
                with torch.no_grad():
                    divergence += self.actor.get_kl_divergence(batch.old_distribution_params, parameters).mean()
            ratio = torch.exp(log_prob - batch.old_actions_log_prob.squeeze(-1))
            advantages = batch.advantages.squeeze(-1)
            clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
            surrogate = -torch.min(advantages * ratio, advantages * clipped).mean()
            if self.use_clipped_value_loss:
                near = batch.values + (values - batch.values).clamp(-self.clip_param, self.clip_param)
                value = torch.max((values - batch.returns).square(), (near - batch.returns).square()).mean()
            else:
                value = (values - batch.returns).square().mean()
            loss = surrogate + self.value_loss_coef * value - self.entropy_coef * entropy
            if self.mirror_loss > 0.0 and self.mirrors is not None:
                loss = loss + self.mirror_loss * self._asymmetry(batch.observations)
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            if self.is_multi_gpu:
                self.reduce_parameters()
            nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
            nn.utils.clip_grad_norm_(self.critic.parameters(), self.max_grad_norm)
            self.optimizer.step()
            totals += torch.stack((value.detach(), surrogate.detach(), entropy.detach()))
        observations = self.storage.observations.flatten(0, 1)
        self.actor.update_normalization(observations)
        self.critic.update_normalization(observations)
        self.storage.clear()
        if self.is_multi_gpu:
            # The actor's input statistics are summed over the processes, the critic's are each process' own.
            for statistic in self.critic.buffers():
                torch.distributed.broadcast(statistic, 0)
        divergence /= self.num_mini_batches
        if self.is_multi_gpu:
            torch.distributed.all_reduce(divergence)
            divergence /= self.gpu_world_size
        losses = (totals / batches).tolist()
        self.last_kl = float(divergence)
        self._set_rate(self.last_kl)
        named = dict(zip(("value", "surrogate", "entropy"), losses, strict=True))
        return named | {"kl": self.last_kl}

    def _asymmetry(self, observations: TensorDict) -> torch.Tensor:
        """Mean squared difference between both ways to a mirrored action, on a quarter of the rows."""
        assert self.mirrors is not None
        rows = len(observations) // 4
        mirror_obs, mirror_action = self.mirrors
        straight = self.actor.output_mean[:rows]
        mirrored = self.actor(TensorDict({"actor": mirror_obs(observations["actor"][:rows])}, batch_size=[rows]))
        return (mirrored - mirror_action(straight.detach())).square().mean()

    def _set_rate(self, divergence: float) -> None:
        """Every process computes the same rate, for the divergence is the mean of all."""
        if self.schedule != "adaptive" or self.desired_kl is None:
            return
        # Divergence grows with the square of the rate; one iteration's is a noisy measure, so changes are bounded.
        factor = min(max((self.desired_kl / max(divergence, 1e-8)) ** 0.5, 0.6), 1.15)
        self.set_learning_rate(min(max(self.learning_rate * factor, self.lowest_rate), self.highest_rate))

    def set_learning_rate(self, rate: float) -> None:
        """Use this rate from now on."""
        self.learning_rate = rate
        for group in self.optimizer.param_groups:
            group["lr"] = rate
