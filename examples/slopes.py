"""A slope that means something and one that does not: values about a point, and the tangent that a gradient gives.

Shows: exact slopes of a walk to its speed, and of a kicked ball to where it started, over what the engine does there.

    python examples/slopes.py --out slopes.png
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from arena_newton import ArenaEnv, differentiable, policies, trackers
from arena_newton.tasks.football import BALL

SEED, WALK = 8, 150
"""Episode, whose ball is kicked after 234 ticks; ticks of the walk."""


def main() -> None:
    """Play all values at once, then once more for the slope."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-steps", type=int, default=260, help="ticks until the ball is looked at")
    parser.add_argument("--points", type=int, default=41, help="values of each number")
    parser.add_argument("--out", type=Path, default=Path("slopes.png"), help="the picture")
    args = parser.parse_args()
    torch.set_num_threads(1)
    one, many = (
        ArenaEnv("football", tracker=trackers.get("twist2"), worlds=n, fast_physics=True) for n in (1, args.points)
    )
    with torch.no_grad():
        plan = differentiable.closed_loop(one, policies.get("expert"), [SEED], args.max_steps).actions.transpose(0, 1)
    ball, root = one.scene.joint_qpos(BALL), one.scene.robot.root_qpos

    def forward(env: ArenaEnv, values: torch.Tensor) -> torch.Tensor:
        """Distance of the pelvis [m] after the walk at factors of its displacement."""
        faster = torch.zeros(40).double().index_fill(0, torch.tensor([0, 1]), 1.0)
        given = plan[:, :WALK] * (1.0 + faster * (values[:, None, None] - 1.0))
        walk = differentiable.closed_loop(env, given, [SEED] * env.worlds, given.shape[1])
        return walk.qpos[-1, :, root + 1]

    def kicked(env: ArenaEnv, values: torch.Tensor) -> torch.Tensor:
        """Position of the ball [m] after the kick if it starts some centimetres farther."""
        start = differentiable.reset_state(env, [SEED] * env.worlds)
        qpos = start.qpos.index_add(1, torch.tensor([ball + 1]), 0.01 * values[:, None])
        start = differentiable.EngineState(qpos, start.qvel, start.carried)
        given, seeds = plan.repeat(env.worlds, 1, 1), [SEED] * env.worlds
        kick = differentiable.closed_loop(env, given, seeds, args.max_steps, start=start, checkpoint=20)
        return kick.qpos[-1, :, ball + 1]

    figure, panels = plt.subplots(1, 2, figsize=(9.0, 3.4), layout="constrained")
    words = ("speed [factor]", "pelvis after 3 s of walking [m]"), ("ball's start [cm]", "ball after the kick [m]")
    for panel, function, at, wide, labels in zip(
        panels, (forward, kicked), (1.0, 0.0), (0.05, 1.0), words, strict=True
    ):
        values, leaf = at + wide * torch.linspace(-1.0, 1.0, args.points).double(), torch.tensor([at]).double()
        with torch.no_grad():
            found = function(many, values)
        value = function(one, leaf.requires_grad_())
        (slope,) = torch.autograd.grad(value.sum(), leaf)
        panel.plot(values, found, ".", color="0.3")
        panel.plot(values, value.detach() + slope * (values - at), color="tab:red", label=f"slope {slope.item():+.4f}")
        panel.set(xlabel=labels[0], ylabel=labels[1], ylim=(found.min() - 0.01, found.max() + 0.01))
        panel.legend()
        fitted = ((values - at) * (found - found.mean())).sum() / (values - at).square().sum()
        print(f"{labels[0]}: exact slope {slope.item():+.4f}, of the line through all points {fitted:+.4f}")
    figure.savefig(args.out, dpi=110)


if __name__ == "__main__":
    main()
