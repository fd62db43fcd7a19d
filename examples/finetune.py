"""A small policy learns to make a tracker follow clips more closely: by gradients, PPO and ES in equal time.

Shows: truncated gradients through the closed loop to a policy's weights, next to two methods without them. The policy
adds offsets to the joints of a clip, linear in 88 numbers; what counts are held-out clips. Minutes on a CPU.

    python examples/finetune.py --seed 0
"""

import argparse
import time
from collections.abc import Callable, Iterator

import torch

from arena_newton import ArenaEnv, canonical, differentiable, trackers

JOINTS, SEEN, SIZE = slice(9, 38), 88, 0.1
AMPLITUDE = torch.tensor([0.05] * 12 + [0.1] * 3 + [0.3] * 14)  # of legs, waist and arms [rad]


def clips(count: int, ticks: int) -> torch.Tensor:
    """Canonical actions of a robot that stands and sways at 0.5 to 1.5 Hz, shape [count, ticks + 1, 40]."""
    plan = torch.from_numpy(canonical.STAND_ACTION).repeat(count, ticks + 1, 1)
    speed, phase = 3.1 + 6.3 * torch.rand(count, 1, 29), 6.28 * torch.rand(count, 1, 29)
    at = 0.02 * torch.arange(ticks + 1)[:, None]
    plan[..., JOINTS] += AMPLITUDE * torch.rand(count, 1, 29) * ((speed * at + phase).sin() - phase.sin())
    return plan.double()


class Residual(torch.nn.Module):
    """A clip's actions with offsets; it notes what it saw, did and reached."""

    def __init__(self, plan: torch.Tensor, weights: torch.Tensor, noise: torch.Tensor | float = 0.0):
        """Weights of shape [29, 88], or [worlds, 29, 88]."""
        super().__init__()
        self.plan, self.weights, self.noise = plan, weights, noise
        self.seen, self.done, self.errors = list[torch.Tensor](), list[torch.Tensor](), list[torch.Tensor]()

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Actions of a tick."""
        tick, joints, speeds = len(self.seen), state[:, 6:35], state[:, 35:64]
        now, coming = self.plan[:, tick], self.plan[:, tick + 1, JOINTS]
        if tick:
            self.errors.append((self.plan[:, tick - 1, JOINTS] - joints).square().mean(1))
        inputs = now[:, JOINTS] - joints, 0.1 * speeds, 5.0 * (coming - now[:, JOINTS]), torch.ones(len(state), 1)
        self.seen.append(torch.cat(inputs, dim=1))
        mean = (self.weights @ self.seen[-1][..., None])[..., 0]
        self.done.append(mean + self.noise * torch.randn_like(mean))
        return torch.cat([now[:, :9], now[:, JOINTS] + SIZE * self.done[-1], now[:, 38:]], dim=1)


def played(env: ArenaEnv, actor: Residual, truncate: int | None = None) -> torch.Tensor:
    """Mean square error of the joints after each tick but the last [rad²], shape [ticks - 1, worlds]."""
    ticks = actor.plan.shape[1] - 1
    differentiable.closed_loop(env, actor, [5] * env.worlds, ticks, truncate=truncate)
    return torch.stack(actor.errors)


def by_gradient(env: ArenaEnv, ticks: int) -> Iterator[torch.Tensor]:
    """Adam along gradients that reach 10 ticks back."""
    weights = torch.zeros(29, SEEN).double().requires_grad_()
    adam = torch.optim.Adam([weights], lr=0.02)
    while True:
        error = played(env, Residual(clips(env.worlds, ticks), weights), truncate=10)
        (weights.grad,) = torch.autograd.grad(100.0 * error.mean(), weights)
        adam.step()
        yield weights.detach()


@torch.no_grad()
def by_es(env: ArenaEnv, ticks: int) -> Iterator[torch.Tensor]:
    """Adam along antithetic evolution strategies' estimate, a clip per pair (Salimans, T. et al. (2017))."""
    weights, pairs = torch.zeros(29, SEEN).double(), env.worlds // 2
    adam = torch.optim.Adam([weights], lr=0.02)
    while True:
        move = 0.05 * torch.randn(pairs, 29, SEEN).double()
        actor = Residual(clips(pairs, ticks).repeat(2, 1, 1), weights + torch.cat([move, -move]))
        ahead, behind = played(env, actor).mean(0).chunk(2)
        rank = (ahead - behind) / (ahead - behind).std()
        weights.grad = (rank[:, None, None] * move).mean(0) / 0.05
        adam.step()
        yield weights.clone()


def by_ppo(env: ArenaEnv, ticks: int) -> Iterator[torch.Tensor]:
    """Proximal policy optimisation with generalised advantages (Schulman, J. et al. (2017))."""
    weights, spread = torch.zeros(29, SEEN).double().requires_grad_(), torch.full((29,), -1.5).double().requires_grad_()
    critic = torch.nn.Sequential(torch.nn.Linear(SEEN, 64), torch.nn.ELU(), torch.nn.Linear(64, 1)).double()
    adam = torch.optim.Adam([{"params": [weights, spread], "lr": 0.003}, {"params": critic.parameters(), "lr": 0.003}])
    while True:
        with torch.no_grad():
            actor = Residual(clips(env.worlds, ticks), weights, spread.exp())
            reward = -100.0 * played(env, actor)
            seen, done = torch.stack(actor.seen), torch.stack(actor.done)[:-1]
            value, gain, rows = critic(seen)[..., 0], torch.zeros(env.worlds), []
            for tick in reversed(range(len(reward))):
                gain = reward[tick] + 0.9 * value[tick + 1] - value[tick] + 0.9 * 0.95 * gain
                rows.insert(0, gain)
            gains, seen = torch.stack(rows), seen[:-1]
            wanted = gains + value[:-1]
            before = torch.distributions.Normal(seen @ weights.T, spread.exp()).log_prob(done).sum(-1)
        for part in (order for _ in range(5) for order in torch.randperm(gains.numel()).chunk(4)):
            at, did, gain = (column.flatten(0, 1)[part] for column in (seen, done, gains))
            now = torch.distributions.Normal(at @ weights.T, spread.exp()).log_prob(did).sum(-1)
            ratio, gain = (now - before.flatten()[part]).exp(), (gain - gain.mean()) / (gain.std() + 1e-8)
            loss = -torch.minimum(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
            loss = loss + (critic(at)[:, 0] - wanted.flatten()[part]).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
        yield weights.detach()


def main() -> None:
    """Train three times, and judge each on held-out clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of clips and noise")
    parser.add_argument("--seconds", type=float, default=30.0, help="processor time of each method")
    parser.add_argument("--max-steps", type=int, default=40, help="ticks of a clip")
    args = parser.parse_args()
    torch.set_num_threads(1)
    envs = [ArenaEnv("football", tracker=trackers.get("twist2"), worlds=n, fast_physics=True) for n in (4, 32)]
    torch.manual_seed(1000)
    held_out = clips(32, args.max_steps)
    methods: dict[str, tuple[Callable[[ArenaEnv, int], Iterator[torch.Tensor]], ArenaEnv]]
    methods = {"gradient": (by_gradient, envs[0]), "PPO": (by_ppo, envs[1]), "ES": (by_es, envs[1])}
    for name, (method, env) in methods.items():
        torch.manual_seed(args.seed)
        spent, shown, weights, steps = 0.0, 0.0, torch.zeros(29, SEEN).double(), method(env, args.max_steps)
        while True:
            if spent >= shown:
                with torch.no_grad():
                    error = played(envs[1], Residual(held_out, weights)).mean()
                print(f"{name:8s}  error {error.sqrt():.5f} rad  after {spent:5.1f} s", flush=True)
                shown += args.seconds / 5.0
            if spent >= args.seconds:
                break
            began = time.process_time()
            weights, spent = next(steps), spent + time.process_time() - began


if __name__ == "__main__":
    main()
