"""The start of the ball that spoils a recorded kick most, by gradient and by the cross-entropy method at equal time.

Shows: a plan recorded from the expert, slopes of the margin to where things start, and their reach. A minute on a CPU.

    python examples/worst_start.py --max-steps 40
"""

import argparse
import time

import torch

from arena_newton import ArenaEnv, differentiable, policies, trackers
from arena_newton.tasks.football import BALL

RANGE = 0.3
"""The ball starts at most so far from its place in x and y [m]."""


def main() -> None:
    """Search twice."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-steps", type=int, default=380, help="ticks of 0.02 s")
    parser.add_argument("--iterations", type=int, default=3, help="gradients")
    args = parser.parse_args()
    torch.set_num_threads(1)
    twist2, ticks = trackers.get("twist2"), args.max_steps
    env = ArenaEnv("football", tracker=twist2, worlds=1, engine="mujoco", rules="released", fast_physics=True)
    with torch.no_grad():
        plan = differentiable.closed_loop(env, policies.get("expert"), [5], ticks).actions.transpose(0, 1)
    start, ball = differentiable.reset_state(env, [5]), env.scene.joint_qpos(BALL)

    def margin(move: torch.Tensor, **options: int) -> torch.Tensor:
        qpos = start.qpos.index_add(1, torch.tensor([ball, ball + 1]), move[None])
        return differentiable.closed_loop(env, plan, [5], ticks, start=start._replace(qpos=qpos), **options).margin[-1]

    move, began = torch.zeros(2, dtype=torch.float64), time.perf_counter()
    for number in range(args.iterations):
        leaf = move.clone().requires_grad_()
        value = margin(leaf, checkpoint=25)
        (slope,) = torch.autograd.grad(value.sum(), leaf)
        found = differentiable.reach(lambda points: margin(points[0]), move, slope, (0.001, 0.01), rows=1)
        print(
            f"gradient {number}: ball {move.tolist()}  margin {value.item():+.3f} m  slope holds {found.holds.tolist()}"
        )
        move = (move - 0.1 * slope / slope.norm().clamp_min(1e-9)).clamp(-RANGE, RANGE)
    with torch.no_grad():
        print(f"by gradient: {margin(move).item():+.3f} m after {time.perf_counter() - began:.0f} s")

    limit, began = time.perf_counter() - began, time.perf_counter()
    draws, mean, spread, best = (
        torch.Generator().manual_seed(0),
        torch.zeros(2).double(),
        torch.full((2,), RANGE / 2),
        9.0,
    )
    while time.perf_counter() - began < limit:
        tried = (mean + spread * torch.randn(6, 2, generator=draws)).clamp(-RANGE, RANGE).double()
        with torch.no_grad():
            values = torch.stack([margin(one)[0] for one in tried])
        elite = tried[values.argsort()[:2]]
        mean, spread, best = elite.mean(0), elite.std(0) + 0.01, min(best, float(values.min()))
    print(f"by cross-entropy: {best:+.3f} m after {time.perf_counter() - began:.0f} s")
    env.close()


if __name__ == "__main__":
    main()
