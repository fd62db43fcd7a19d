"""The start of the ball that spoils a recorded plan most: by gradient, and by cross-entropy in the same time.

Shows: a plan recorded from the expert, slopes of the margin to where things start, and their reach. Minutes on a CPU.

    python examples/worst_start.py --max-steps 380
"""

import argparse
import time

import torch

from arena_newton import ArenaEnv, differentiable, policies, trackers
from arena_newton.tasks.football import BALL

RANGE = 0.3  # the ball starts at most so far from its place in x and y [m]


def main() -> None:
    """Search twice."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-steps", type=int, default=380, help="ticks of 0.02 s")
    parser.add_argument("--iterations", type=int, default=3, help="gradients")
    parser.add_argument("--seed", type=int, default=5, help="of the episode, and of the cross-entropy method's draws")
    args = parser.parse_args()
    torch.set_num_threads(1)
    ticks, track = args.max_steps, trackers.get("twist2")
    env = ArenaEnv("football", tracker=track, worlds=1, engine="mujoco", rules="released", fast_physics=True)
    with torch.no_grad():
        plan = differentiable.closed_loop(env, policies.get("expert"), [args.seed], ticks).actions.transpose(0, 1)
    start, ball = differentiable.reset_state(env, [args.seed]), env.scene.joint_qpos(BALL)

    def margin(move: torch.Tensor) -> torch.Tensor:
        qpos = start.qpos.index_add(1, torch.tensor([ball, ball + 1]), move[None])
        moved = differentiable.EngineState(qpos, start.qvel, start.carried)
        return differentiable.closed_loop(env, plan, [args.seed], ticks, start=moved, checkpoint=25).margin[-1]

    move, began = torch.zeros(2).double(), time.process_time()
    for _ in range(args.iterations):
        leaf = move.clone().requires_grad_()
        value = margin(leaf)
        (slope,) = torch.autograd.grad(value.sum(), leaf)
        found = differentiable.reach(lambda points: margin(points[0]), move, slope, (0.001, 0.01), rows=1)
        print(f"moved {move[0]:+.2f} {move[1]:+.2f} m  margin {value.item():+.3f} m  holds {found.holds.tolist()}")
        move = (move - 0.1 * slope / slope.norm().clamp_min(1e-9)).clamp(-RANGE, RANGE)
    with torch.no_grad():
        spent = time.process_time() - began
        print(f"by gradient: margin {margin(move).item():+.3f} m after {spent:.0f} s")
        draws, best, began = torch.Generator().manual_seed(args.seed), torch.inf, time.process_time()
        mean, spread = torch.zeros(2), torch.full((2,), 0.5 * RANGE)
        while time.process_time() - began < spent:
            tried = (mean + spread * torch.randn(6, 2, generator=draws)).clamp(-RANGE, RANGE)
            values = torch.stack([margin(one.double())[0] for one in tried])
            elite, best = tried[values.argsort()[:2]], min(best, values.min().item())
            mean, spread = elite.mean(0), elite.std(0) + 0.01
        print(f"by cross-entropy: margin {best:+.3f} m after {time.process_time() - began:.0f} s")


if __name__ == "__main__":
    main()
