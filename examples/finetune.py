"""Fine-tuning through the closed loop: by gradients, PPO and ES in equal processor time.

Shows: gradients to a policy's weights (`--what policy`: offsets to the joints of a clip, linear in 88 numbers, so that
TWIST2 follows it more closely), or to the last layer of TWIST2 itself, which walks with swaying arms: for its error of
arms, waist and path (`tracking`), or for the drives' power (`energy`) or the feet's slip (`slip`) next to that error.
What is printed are held-out clips. Minutes on a CPU.

    python examples/finetune.py --what slip --seed 0
"""

import argparse
import time
from collections.abc import Callable, Iterator
from typing import cast

import torch

from arena_newton import ArenaEnv, canonical, differentiable, trackers
from arena_newton.robot import g1
from arena_newton.robot.rotations import quat_apply
from arena_newton.trackers.front_end import NetworkTracker
from arena_newton.trackers.motions import kinematics

JOINTS, SEEN, SIZE = slice(9, 38), 88, 0.1
AMPLITUDE = torch.tensor([0.05] * 12 + [0.1] * 3 + [0.3] * 14)  # of legs, waist and arms [rad]
UPPER, FEET = slice(12, 29), [kinematics.link_index(f"{side}_ankle_roll_link") for side in ("left", "right")]


def clips(count: int, ticks: int) -> torch.Tensor:
    """Canonical actions of a robot that stands and sways at 0.5 to 1.5 Hz, shape [count, ticks + 1, 40]."""
    plan = torch.from_numpy(canonical.STAND_ACTION).repeat(count, ticks + 1, 1)
    speed, phase = 3.1 + 6.3 * torch.rand(count, 1, 29), 6.28 * torch.rand(count, 1, 29)
    at = 0.02 * torch.arange(ticks + 1)[:, None]
    plan[..., JOINTS] += AMPLITUDE * torch.rand(count, 1, 29) * ((speed * at + phase).sin() - phase.sin())
    return plan.double()


class Learner(torch.nn.Module):
    """A linear layer that is trained; it notes what it saw and did."""

    shape: tuple[int, int]
    spread: float
    rates: dict[str, float]
    width: float
    truncate: int | None
    """Logarithm of PPO's first noise, rates of learning, spread of ES, and how many ticks gradients reach back."""

    def put(self, weights: torch.Tensor, noise: torch.Tensor | float = 0.0) -> None:
        """Take weights of `shape`, or of each world, and the noise of what they do; forget what was seen."""
        self.weights, self.noise, self.seen, self.done = weights, noise, list[torch.Tensor](), list[torch.Tensor]()

    def played(self, env: ArenaEnv, plan: torch.Tensor, truncate: int | None = None) -> torch.Tensor:
        """Numbers of each tick but the last that the clips end with, shape [numbers, ticks - 1, worlds]."""
        raise NotImplementedError

    def act(self, seen: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Outputs of the weights, with noise, shape [parts, worlds, outputs]."""
        mean = (weights @ seen[..., None])[..., 0]
        self.seen.append(seen)
        self.done.append(mean + self.noise * torch.randn_like(mean))
        return self.done[-1]


class Offsets(Learner):
    """A small policy: a clip's actions with offsets."""

    shape, spread, rates, width = (29, SEEN), -1.5, {"gradient": 0.02, "PPO": 0.003, "ES": 0.02}, 0.05
    truncate = 10

    def played(self, env: ArenaEnv, plan: torch.Tensor, truncate: int | None = None) -> torch.Tensor:
        """Mean square error of the joints after each tick but the last [rad²], shape [1, ticks - 1, worlds]."""
        self.plan, self.errors = plan, list[torch.Tensor]()
        differentiable.closed_loop(env, self, [5] * env.worlds, plan.shape[1] - 1, truncate=truncate)
        return torch.stack(self.errors)[None]

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Actions of a tick."""
        tick, joints, speeds = len(self.seen), state[:, 6:35], state[:, 35:64]
        now, coming = self.plan[:, tick], self.plan[:, tick + 1, JOINTS]
        if tick:
            self.errors.append((self.plan[:, tick - 1, JOINTS] - joints).square().mean(1))
        inputs = now[:, JOINTS] - joints, 0.1 * speeds, 5.0 * (coming - now[:, JOINTS]), torch.ones(len(state), 1)
        done = self.act(torch.cat(inputs, dim=1)[None], self.weights)
        return torch.cat([now[:, :9], now[:, JOINTS] + SIZE * done[0], now[:, 38:]], dim=1)


class LastLayer(Learner):
    """Change of a tracker's last layer; TWIST2's sees each observation and its mirror image, and averages."""

    shape, spread, rates, width = (29, 257), -3.0, {"gradient": 2e-4, "PPO": 1e-4, "ES": 1e-3}, 0.01
    truncate = None  # those of 10 ticks have the wrong sign for slip

    def __init__(self, layer: torch.nn.Module):
        """Begin with no change."""
        super().__init__()
        self.layer = layer

    def __deepcopy__(self, memo: dict[int, object]) -> "LastLayer":
        """The layer itself, in every copy of the network."""
        return self

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """The layer's output and the change of it, of observations and then of mirror images."""
        seen = torch.nn.functional.pad(x, (0, 1), value=1.0).unflatten(0, (2, -1))
        weights = self.weights.detach() if len(self.seen) < self.startup else self.weights
        done: torch.Tensor = self.act(seen, weights).flatten(0, 1) + self.layer(x)
        return done

    def played(self, env: ArenaEnv, plan: torch.Tensor, truncate: int | None = None) -> torch.Tensor:
        """Square error [rad² + m²], power [W] and slip [m/s] in ticks but the last, shape [3, ticks - 1, worlds]."""
        plan, robot, model, ticks = plan[:, 1:].clone(), env.scene.robot, env.scene.mj_model, plan.shape[1] - 1
        plan[..., 0] += 0.3 * g1.TICK  # a walk at 0.3 m/s
        self.startup = env.startup_ticks
        rolled = differentiable.closed_loop(env, plan, [5] * env.worlds, ticks, truncate=truncate)
        self.seen, self.done = self.seen[-ticks:], self.done[-ticks:]
        root, joints = rolled.qpos[:, :, robot.root_qpos :][..., :7], rolled.qpos[1:, :, robot.joint_qpos]
        poses = kinematics.forward(root[..., :3], root[..., 3:], rolled.qpos[:, :, robot.joint_qpos])
        way = quat_apply(root[:1, :, 3:], torch.tensor([1.0, 0.0, 0.0]).double().expand(1, env.worlds, 3))
        path = root[:1, :, :2] + way[..., :2] * rolled.actions[..., :1].cumsum(0)
        wanted = rolled.actions[..., JOINTS][..., list(g1.MUJOCO_TO_CANONICAL)]
        error = (wanted - joints)[..., UPPER].square().mean(2) + (root[1:, :, :2] - path).square().sum(2)
        speed, drives = rolled.qvel[1:, :, robot.joint_qvel], robot.joint_ctrl
        parts = model.actuator_gainprm[drives, 0], model.actuator_biasprm[drives, 2]
        gain, damping = map(torch.from_numpy, parts)
        power = ((gain * (rolled.targets[..., drives] - joints) + damping * speed) * speed).abs().sum(2)
        feet = poses.position[:, :, FEET]
        low = ((kinematics.SOLE_HEIGHT + 0.01 - feet[1:, ..., 2]) / 0.003).sigmoid()
        slip = (low * (feet.diff(dim=0)[..., :2] / g1.TICK).norm(dim=3)).sum(2)
        return torch.stack([error, power, slip])[:, :-1]


Cost = Callable[[torch.Tensor], torch.Tensor]
"""Cost in each tick, of what `played` gives."""


def by_gradient(learner: Learner, cost: Cost, envs: list[ArenaEnv], ticks: int, rate: float) -> Iterator[torch.Tensor]:
    """Adam along gradients."""
    weights = torch.zeros(learner.shape).double().requires_grad_()
    adam = torch.optim.Adam([weights], lr=rate)
    while True:
        learner.put(weights)
        found = cost(learner.played(envs[0], clips(envs[0].worlds, ticks), truncate=learner.truncate))
        (weights.grad,) = torch.autograd.grad(100.0 * found.mean(), weights)
        adam.step()
        yield weights.detach()


@torch.no_grad()
def by_es(learner: Learner, cost: Cost, envs: list[ArenaEnv], ticks: int, rate: float) -> Iterator[torch.Tensor]:
    """Adam along antithetic evolution strategies' estimate, a clip per pair (Salimans, T. et al. (2017))."""
    weights, pairs = torch.zeros(learner.shape).double(), envs[1].worlds // 2
    adam = torch.optim.Adam([weights], lr=rate)
    while True:
        move = learner.width * torch.randn(pairs, *learner.shape).double()
        learner.put(weights + torch.cat([move, -move]))
        ahead, behind = cost(learner.played(envs[1], clips(pairs, ticks).repeat(2, 1, 1))).mean(0).chunk(2)
        rank = (ahead - behind) / (ahead - behind).std()
        weights.grad = (rank[:, None, None] * move).mean(0) / learner.width
        adam.step()
        yield weights.clone()


def by_ppo(learner: Learner, cost: Cost, envs: list[ArenaEnv], ticks: int, rate: float) -> Iterator[torch.Tensor]:
    """Proximal policy optimisation with generalised advantages (Schulman, J. et al. (2017))."""
    outputs, inputs = learner.shape
    weights = torch.zeros(learner.shape).double().requires_grad_()
    spread = torch.full((outputs,), learner.spread).double().requires_grad_()
    critic = torch.nn.Sequential(torch.nn.Linear(inputs, 64), torch.nn.ELU(), torch.nn.Linear(64, 1)).double()
    adam = torch.optim.Adam([{"params": [weights, spread], "lr": rate}, {"params": critic.parameters(), "lr": 0.003}])
    while True:
        with torch.no_grad():
            learner.put(weights.detach(), spread.exp())
            reward = -100.0 * cost(learner.played(envs[1], clips(envs[1].worlds, ticks)))
            # Of each world and tick, what the layer saw and did, once or twice.
            seen, done = (torch.stack(part).transpose(1, 2) for part in (learner.seen, learner.done))
            value, gain, rows, done = critic(seen[:, :, 0])[..., 0], torch.zeros(envs[1].worlds), [], done[:-1]
            for tick in reversed(range(len(reward))):
                gain = reward[tick] + 0.9 * value[tick + 1] - value[tick] + 0.9 * 0.95 * gain
                rows.insert(0, gain)
            gains, seen = torch.stack(rows), seen[:-1]
            wanted = gains + value[:-1]
            before = torch.distributions.Normal(seen @ weights.T, spread.exp()).log_prob(done).sum((-2, -1))
        for part in (order for _ in range(5) for order in torch.randperm(gains.numel()).chunk(4)):
            at, did, gain = (column.flatten(0, 1)[part] for column in (seen, done, gains))
            now = torch.distributions.Normal(at @ weights.T, spread.exp()).log_prob(did).sum((-2, -1))
            ratio, gain = (now - before.flatten()[part]).exp(), (gain - gain.mean()) / (gain.std() + 1e-8)
            loss = -torch.minimum(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
            loss = loss + (critic(at[:, 0])[:, 0] - wanted.flatten()[part]).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
        yield weights.detach()


def main() -> None:
    """Train three times, and judge each on held-out clips."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--what", default="policy", choices=("policy", "tracking", "energy", "slip"), help="to better")
    parser.add_argument("--seed", type=int, default=0, help="of clips and noise")
    parser.add_argument("--seconds", type=float, default=30.0, help="processor time of each method")
    parser.add_argument("--max-steps", type=int, default=40, help="ticks of a clip")
    args = parser.parse_args()
    torch.set_num_threads(1)
    envs = [ArenaEnv("football", tracker=trackers.get("twist2"), worlds=n, fast_physics=True) for n in (4, 32)]
    learner: Learner = Offsets()
    if args.what != "policy":
        networks = [cast("torch.nn.Sequential", cast("NetworkTracker", env.tracker).network.network) for env in envs]
        learner = LastLayer(networks[0][-1])
        for network in networks:
            network[-1] = learner
    torch.manual_seed(1000)
    held_out = clips(32, args.max_steps)

    def judged(weights: torch.Tensor) -> torch.Tensor:
        learner.put(weights)
        with torch.no_grad():
            return learner.played(envs[1], held_out).mean((1, 2))

    first = judged(torch.zeros(learner.shape).double())
    term = {"energy": 1, "slip": 2}.get(args.what, 0)

    def cost(found: torch.Tensor) -> torch.Tensor:
        """Term that is to fall, and the error, each as a part of what it was at first."""
        return found[0] if args.what == "policy" else found[term] / first[term] + (term > 0) * found[0] / first[0]

    for name, method in {"gradient": by_gradient, "PPO": by_ppo, "ES": by_es}.items():
        torch.manual_seed(args.seed)
        spent, shown, weights = 0.0, 0.0, torch.zeros(learner.shape).double()
        steps = method(learner, cost, envs, args.max_steps, learner.rates[name])
        while True:
            if spent >= shown:
                error, *others = judged(weights).tolist()
                more = "".join(
                    f"  {value:.4g} {unit}" for value, unit in zip(others, ("W", "m/s of slip"), strict=False)
                )
                print(f"{name:8s}  error {error**0.5:.5f} rad{more}  after {spent:5.1f} s", flush=True)
                shown += args.seconds / 5.0
            if spent >= args.seconds:
                break
            began = time.process_time()
            weights, spent = next(steps), spent + time.process_time() - began


if __name__ == "__main__":
    main()
