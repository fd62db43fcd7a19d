"""Which robot walked? Masses, friction, gains and latency of another robot from two seconds of its walk, with noise.

Shows: `differentiable.Windows`, least squares through contacts with standard errors, and what a walk cannot tell; then
the cross-entropy method (CEM) on the same windows for three times as long. Minutes on a CPU.

    python examples/identify.py --seed 0
"""

import argparse
import math
import time
from typing import cast

import mujoco
import torch

from arena_newton import ArenaEnv, canonical, differentiable, trackers
from arena_newton.differentiable.implicit import scaled
from arena_newton.interfaces import RobotState, TrackerCommand

ROBOT, LEG = "/World/Robot", ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
NAMES = {"friction": "friction", "mass torso": f"mass:{ROBOT}/torso_link", "mass pelvis": f"mass:{ROBOT}/pelvis"}
for one, links in {"legs": LEG, "arms": ARM}.items():
    NAMES[f"mass {one}"] = "mass:" + ",".join(f"{ROBOT}/left_{n}_link,{ROBOT}/right_{n}_link" for n in links)
for kind in ("kp", "kd"):
    for n in LEG:
        NAMES[f"{kind} {n}"] = f"{kind}:{ROBOT}/joints/left_{n}_joint,{ROBOT}/joints/right_{n}_joint"
DOFS = 49  # of the robot, fingers included; the ball's come after them


class Late:
    """A tracker whose targets reach the drives late, by a fraction of a tick too; it keeps what was sent."""

    def __init__(self, tracker: trackers.Tracker, ticks: float):
        self.tracker, self.ticks, self.sent = tracker, ticks, list[torch.Tensor]()

    def __getattr__(self, name: str) -> object:
        return getattr(self.tracker, name)

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Targets of a tick."""
        self.sent.append(self.tracker.step(command, state, mask).clone())
        newer, older = (self.sent[max(len(self.sent) - late - int(self.ticks), 0)] for late in (1, 2))
        return torch.lerp(newer, older, self.ticks % 1.0)


def recorded(truth: torch.Tensor, ticks: int, noise: torch.Tensor) -> differentiable.Recorded:
    """A walk of the other robot from its third second on, as its sensors see it."""
    late, states = Late(trackers.get("twist2"), float(truth[-1])), list[differentiable.EngineState]()
    tracker = cast(trackers.Tracker, late)  # by `__getattr__`
    env = ArenaEnv("football", tracker=tracker, worlds=1, engine="mujoco", rules="released", fast_physics=True)
    model, action = env.physics.mj_model, torch.from_numpy(canonical.STAND_ACTION).repeat(1, 1)
    for name, factor in zip(NAMES.values(), truth.exp().tolist(), strict=False):
        for field, index in scaled(name, env.scene):
            getattr(model, field)[index] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    env.reset([5])
    read = differentiable.EngineStep(env.physics)
    for tick in range(-env.startup_ticks, ticks + 100):
        if tick == 0:
            env.observe()  # at step 0 the reference starts where the robot is
        if tick >= 0:
            action[:, :2] = torch.tensor([0.01 + 0.005 * math.sin(tick / 8.0), 0.003 * math.sin(tick / 11.0)])
        states.append(read.state())
        env.step(action)
    qpos, qvel = (torch.cat(column[-ticks:]) for column in list(zip(*states, read.state(), strict=True))[:2])
    errors = (noise.nan_to_num(posinf=0.0) * torch.randn(ticks, len(noise)).double()).chunk(2, dim=1)
    for row, error in zip(qpos.numpy(), errors[0].numpy(), strict=True):
        mujoco.mj_integratePos(model, row, error.copy(), 1.0)
    targets = torch.from_numpy(env.physics.ctrl.numpy()).double().repeat(ticks - 1, 1)
    targets[:, env.scene.robot.joint_ctrl] = torch.cat(late.sent[1 - ticks :]).double()
    return differentiable.Recorded(qpos, qvel + errors[1], targets, noise)


def main() -> None:
    """Record, fit, and search for three times as long."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the other robot, of the noise and of the search")
    parser.add_argument("--windows", type=int, default=10, help="windows of 10 ticks")
    parser.add_argument("--iterations", type=int, default=20, help="most steps of the fit")
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    truth = torch.empty(len(NAMES) + 1).double().uniform_(-0.22, 0.22)  # factors of 0.8 to 1.25
    truth[-1] = 0.2 + torch.rand(1).item()  # ticks: 4 to 24 ms
    env = ArenaEnv("football", tracker=trackers.get("twist2"), worlds=args.windows, rules="released", fast_physics=True)
    noise = torch.full((2, env.scene.mj_model.nv), torch.inf, dtype=torch.float64)
    noise[:, :DOFS] = torch.tensor([[5e-4], [1e-2]])  # of joints: rad, rad/s
    noise[:, :6] = torch.tensor([[1e-4], [1e-3]])  # of the pelvis: m and rad, m/s and rad/s
    env.reset([5] * args.windows)
    walk = recorded(truth, 11 * args.windows + 3, noise.flatten())
    windows = differentiable.Windows(env.physics, walk, tuple(NAMES.values()))
    guess, spread, scale = torch.zeros_like(truth), torch.full_like(truth, 0.15), torch.ones_like(truth)
    guess[-1], spread[-1], scale[-1] = 0.7, 0.3, truth[-1]

    def told(who: str, numbers: torch.Tensor, misfit: float) -> torch.Tensor:
        apart = 100.0 * ((numbers - truth) / scale).abs()
        line = f"misfit {misfit:8.3f}  error {apart.mean():5.2f} %, largest {apart.max():5.2f} %"
        print(f"{who}  {line}  {time.process_time() - began:6.1f} s", flush=True)
        return apart

    began = time.process_time()
    for fit in windows.fit(guess, spread, iterations=args.iterations):
        apart = told("fit", fit.numbers, fit.misfit)
    budget, wide = 3.0 * (time.process_time() - began), torch.linalg.inv(fit.information).diagonal().sqrt() / scale
    print("singular values:", *torch.linalg.eigvalsh(fit.information).sqrt().int().tolist())
    for name, true, expected, error in zip((*NAMES, "latency"), truth, 100.0 * wide, apart, strict=True):
        print(f"{name:15s} {true:+.2f}  standard error {expected:5.2f} %  error {error:5.2f} %")
    search, began = lambda rows: torch.tensor([windows.misfit(row) for row in rows]), time.process_time()
    generations = differentiable.cross_entropy(search, guess, spread, draws=32)
    while time.process_time() - began < budget:
        mean, values = next(generations)
        told("CEM", mean, float(values.min()))


if __name__ == "__main__":
    main()
