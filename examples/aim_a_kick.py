"""A kick that misses the goal is turned until it scores, along the gradient of the benchmark's own margin.

Shows: the ball's flight by Newton's differentiable solver, the margin as a torch function, and how far the flight is
from the one of the engine that judges episodes. 20 s on a CPU, plus 40 s of compiling at the first call.

    python examples/aim_a_kick.py --kick 4 2
"""

import argparse

import torch

from arena_newton import ArenaEnv, differentiable, trackers
from arena_newton.kernels.rules import success
from arena_newton.physics.mujoco_engine import MujocoPhysics
from arena_newton.tasks.football import BALL, FootballJudge


def main() -> None:
    """Aim, then kick in the engine."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kick", type=float, nargs=2, default=[4.0, 2.0], help="first guess: x and y [m/s]")
    parser.add_argument("--max-steps", type=int, default=75, help="ticks of 0.02 s that the ball may roll")
    args = parser.parse_args()

    env = ArenaEnv("football", tracker=trackers.get("twist2"), worlds=1, engine="mujoco")
    env.reset([7], spawn=lambda seed: ((0.0, -5.0, 0.8), (1.0, 0.0, 0.0, 0.0)))  # the robot looks on from behind
    judge, physics, ball = env.judge, env.physics, differentiable.RollingBall.of(env.scene)
    assert isinstance(judge, FootballJudge) and isinstance(physics, MujocoPhysics)
    address, speed = env.scene.joint_qpos(BALL), env.scene.joint_qvel(BALL)
    start = torch.tensor(physics.data[0].qpos[address : address + 3]).float()[None]
    poses = torch.tensor(physics.xpos.numpy()).repeat(args.max_steps + 1, 1, 1)  # one row per tick of the flight
    quats = torch.tensor(physics.xquat.numpy()).repeat(args.max_steps + 1, 1, 1)
    rule = {"goal": judge.goal, "pitch": judge.pitch, "rear_bound": True, "judge_out": False, "min_z": -0.5}

    kick = torch.tensor([[*args.kick, 0.0]], requires_grad=True)
    for iteration in range(20):
        path = differentiable.ball_flight(start, kick, ball, ticks=args.max_steps)
        bodies = torch.cat([poses[:, : judge.ball], path, poses[:, judge.ball + 1 :]], dim=1)
        rule |= {"xpos": bodies, "xquat": quats, "ball_body": judge.ball}
        best = differentiable.success_margin(success.launch_football, **rule).max()
        print(f"{iteration:2}  kick {kick[0, 0]:+.2f} {kick[0, 1]:+.2f} m/s  margin {best:+.3f} m")
        if best >= 0.1:
            break
        (grad,) = torch.autograd.grad(best, kick)
        kick = (kick + 0.3 * grad * torch.tensor([1.0, 1.0, 0.0])).detach().requires_grad_()

    physics.data[0].qvel[speed : speed + 3] = kick[0].detach().numpy()
    reached, apart = -torch.inf, 0.0
    for tick in range(1, args.max_steps + 1):
        physics.step()
        judge.evaluate(physics)
        reached = max(reached, float(judge.margin.numpy()[0]))
        apart = max(apart, float((torch.tensor(physics.xpos.numpy()[0, judge.ball]) - path[tick, 0].detach()).norm()))
    print(f"in the engine: margin {reached:+.3f} m, flights at most {100 * apart:.1f} cm apart")
    env.close()


if __name__ == "__main__":
    main()
