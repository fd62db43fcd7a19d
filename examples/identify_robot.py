"""Stiffness and damping of six leg joints and the torso's mass are read from one recorded walk with joint noise.

Shows: the engine's tick as a function of factors of its model, followed by Adam, and CEM for three times its time.

    python examples/identify_robot.py
"""

import argparse
import time

import torch

from arena_newton import ArenaEnv, canonical, differentiable, trackers

LEGS = [f"{side}_{part}_joint" for side in ("left", "right") for part in ("hip_pitch", "knee", "ankle_pitch")]
NAMES = ["mass:/World/Robot/torso_link"] + [f"{k}:/World/Robot/joints/{leg}" for k in ("kp", "kd") for leg in LEGS]


def main() -> None:
    """Record a walk of another robot, then find out what it is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--windows", type=int, default=10, help="windows of 0.2 s of the walk")
    parser.add_argument("--iterations", type=int, default=40, help="iterations of Adam")
    args, twist2, _ = parser.parse_args(), trackers.get("twist2"), torch.manual_seed(0)
    one, many = (ArenaEnv("football", tracker=twist2, worlds=n, rules="released") for n in (1, args.windows))
    truth = torch.exp(0.2 * (2 * torch.rand(len(NAMES)).double() - 1))  # the other robot is within 20 % of the model
    walk = (torch.tensor(canonical.STAND_ACTION) + 0.008 * torch.eye(40)[0]).repeat(1, 10 * args.windows, 1)  # 0.4 m/s
    real = differentiable.closed_loop(one, walk, [3], walk.shape[1], parameters=NAMES, factors=truth[None])
    for rows, order, noise in ((real.qpos, "joint_qpos", 0.0001), (real.qvel, "joint_qvel", 0.002)):  # rad, rad/s
        rows[..., getattr(one.scene.robot, order)] += noise * torch.randn(len(rows), 1, 29).double()
    step = differentiable.EngineStep(many.physics, NAMES)
    start = step.state()._replace(qpos=real.qpos[:-1:10, 0], qvel=real.qvel[:-1:10, 0])
    seen = [part[:, 0].unflatten(0, (-1, 10)).unbind(1) for part in (real.qpos[1:], real.qvel[1:], real.targets)]
    logs = torch.zeros(len(NAMES), dtype=torch.float64, requires_grad=True)

    def misfit(logs: torch.Tensor) -> torch.Tensor:
        state, total = start, torch.zeros(())
        for qpos, qvel, targets in zip(*seen, strict=True):
            state = step(state, targets, logs.exp().expand(args.windows, -1))
            total = total + (state.qpos - qpos).square().sum() + 1e-3 * (state.qvel - qvel).square().sum()
        (logs.grad,) = torch.autograd.grad(total, logs) if logs.requires_grad else (None,)
        return total.detach()

    def report(name: str, logs: torch.Tensor) -> float:
        wrong, spent = 100 * (logs.detach().exp() / truth - 1).abs(), time.process_time() - began
        print(f"{name:<8}  {spent:6.1f} s  error {wrong.mean():4.1f} %, at most {wrong.max():4.1f} %", flush=True)
        return spent

    solver, began = torch.optim.Adam([logs], lr=0.03), time.process_time()
    for _ in range(args.iterations):
        misfit(logs)
        solver.step()
        budget = 3.0 * report("gradient", logs)
    began, none = time.process_time(), torch.zeros(len(NAMES)).double()
    search = differentiable.cross_entropy(lambda p: torch.stack([*map(misfit, p)]), none, 0.15, draws=40)
    any(report("CEM", mean) > budget for mean, _ in search)


if __name__ == "__main__":
    main()
