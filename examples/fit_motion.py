"""A heavier, softer robot executes a recorded second of walking: 320 numbers of its actions are fitted.

Shows: gradients to every action, followed by Adam; then cross-entropy (CEM) for as much processor time. Minutes.

    python examples/fit_motion.py
"""

import argparse
import time

import torch

from arena_newton import ArenaEnv, canonical, differentiable, trackers

KNOTS, NAMES = 10, ("mass:/World/Robot/torso_link", "kp")
WALK = torch.from_numpy(canonical.STAND_ACTION).double().index_fill(0, torch.tensor(0), 0.008)  # at 0.4 m/s
NUMBERS = torch.tensor([0, 1, 2, *range(9, 38)])  # of an action: displacement, height, 29 joints
SIZE = torch.tensor([0.002, 0.002, 0.01] + [0.05] * 29).double()  # of a move: m per tick, m, rad


def played(env: ArenaEnv, moves: torch.Tensor, args: argparse.Namespace, factors: torch.Tensor) -> torch.Tensor:
    """Pelvis [m] and joints [rad] of the walk with moved actions, shape [ticks, worlds, 32]."""
    ticks, seeds, factors = args.max_steps, [args.seed] * env.worlds, factors.expand(env.worlds, 2)
    smooth = torch.nn.functional.interpolate((moves * SIZE).mT, ticks, mode="linear", align_corners=True).mT
    plan = WALK.repeat(env.worlds, ticks, 1).index_add(2, NUMBERS, smooth)
    rolled = differentiable.closed_loop(env, plan, seeds, ticks, parameters=NAMES, factors=factors)
    root, joints = env.scene.robot.root_qpos, env.scene.robot.joint_qpos
    return rolled.qpos[1:, :, [*range(root, root + 3), *joints]]


def main() -> None:
    """Record the second, then fit it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--iterations", type=int, default=25, help="iterations of Adam")
    parser.add_argument("--plays", type=int, default=32, help="plays of a generation of CEM")
    parser.add_argument("--max-steps", type=int, default=50, help="ticks of 0.02 s")
    parser.add_argument("--seed", type=int, default=3, help="of the other robot and of CEM")
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    real = torch.tensor([1.2, 0.8]).double() + torch.rand(2).double() * torch.tensor(
        [0.4, 0.1]
    )  # torso's mass, stiffness
    one, many = (
        ArenaEnv("football", tracker=trackers.get("twist2"), worlds=n, rules="released") for n in (1, args.plays)
    )
    moves = torch.zeros(1, KNOTS, 32, dtype=torch.float64, requires_grad=True)
    wanted = played(one, moves.detach(), args, torch.ones(2).double())

    def misfit(env: ArenaEnv, moves: torch.Tensor) -> torch.Tensor:
        return (played(env, moves, args, real) - wanted).square().sum(2).mean(0)

    adam, began = torch.optim.Adam([moves], lr=0.2), time.process_time()
    for _ in range(args.iterations):
        loss = misfit(one, moves).sum()
        print(f"gradient  misfit {loss.detach():.5f}  {time.process_time() - began:6.1f} s", flush=True)
        (moves.grad,) = torch.autograd.grad(loss, moves)
        adam.step()
    budget, began = time.process_time() - began, time.process_time()
    search = differentiable.cross_entropy(lambda m: misfit(many, m), 0.0 * moves.detach()[0], 0.2, draws=args.plays)
    while time.process_time() - began < budget:
        print(f"CEM       misfit {next(search)[1].min():.5f}  {time.process_time() - began:6.1f} s", flush=True)


if __name__ == "__main__":
    main()
