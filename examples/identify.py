"""Which robot walked? Masses, friction, gains and latency of another robot from seconds of its walk, with noise.

Shows: `differentiable.Windows`, least squares through contacts. Standard errors say when enough is recorded, a misfit
above that of noise which fit is wrong. Then the cross-entropy method (CEM), begun again where it collapses, for three
times as long.

    python examples/identify.py --seeds 0
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


def recorded(truth: torch.Tensor, ticks: int, noise: torch.Tensor) -> differentiable.RobotRecording:
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
    return differentiable.RobotRecording(qpos, qvel + errors[1], targets, noise)


def main() -> None:
    """Identify a robot for each seed, and print a table of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of other robots, of noise and search")
    parser.add_argument("--windows", type=int, default=10, help="windows of 10 ticks that are recorded at once")
    parser.add_argument("--most", type=int, default=5, help="most times that so many are recorded")
    parser.add_argument("--within", type=float, default=5.0, help="two standard errors at which this is enough [%%]")
    parser.add_argument(
        "--surprise", type=float, default=2.5, help="most that the misfit is above noise's [deviations]"
    )
    parser.add_argument("--iterations", type=int, default=20, help="most steps of each descent of the fit")
    parser.add_argument("--measured-starts", action="store_true", help="fit no starts, as the search does")
    args = parser.parse_args()
    if min(args.windows, args.most, args.iterations) < 1:
        parser.error("--windows, --most and --iterations are at least 1")
    torch.set_num_threads(1)
    rows = [identified(seed, args) for seed in args.seeds]
    print("| robot | windows | fit: mean, largest error | after | CEM: mean, largest error | after |")
    print("|---|--:|--:|--:|--:|--:|", *rows, sep="\n")


def identified(seed: int, args: argparse.Namespace) -> str:
    """Fit, record on until it is right and exact, and search for three times as long: a row of the table."""
    torch.manual_seed(seed)
    truth = torch.empty(len(NAMES) + 1).double().uniform_(-0.22, 0.22)  # factors of 0.8 to 1.25
    truth[-1] = 0.2 + torch.rand(1).item()  # ticks: 4 to 24 ms
    env = ArenaEnv("football", tracker=trackers.get("twist2"), worlds=args.windows, rules="released", fast_physics=True)
    noise = torch.full((2, env.scene.mj_model.nv), torch.inf, dtype=torch.float64)
    noise[:, :DOFS] = torch.tensor([[5e-4], [1e-2]])  # of joints: rad, rad/s
    noise[:, :6] = torch.tensor([[1e-4], [1e-3]])  # of the pelvis: m and rad, m/s and rad/s
    env.reset([5] * args.windows)
    walk = recorded(truth, 11 * args.windows * args.most + 3, noise.flatten())
    guess, spread, scale = torch.zeros_like(truth), torch.full_like(truth, 0.15), torch.ones_like(truth)
    guess[-1], spread[-1], scale[-1] = 0.7, 0.3, truth[-1]

    def told(who: str, numbers: torch.Tensor, misfit: float) -> torch.Tensor:
        apart = 100.0 * ((numbers - truth) / scale).abs()
        line = f"misfit {misfit:8.3f}  error {apart.mean():5.2f} %, largest {apart.max():5.2f} %"
        print(f"{who}  {line}  {time.process_time() - began:6.1f} s", flush=True)
        return apart

    def expected(fit: differentiable.FactorFit) -> torch.Tensor:
        errors: torch.Tensor = torch.linalg.inv(fit.information).diagonal().sqrt()
        return 100.0 * errors / scale

    began, parts, numbers, known = time.process_time(), list[differentiable.Windows](), guess, spread
    names, fits = (*NAMES, "latency"), list[differentiable.FactorFit]()
    while len(parts) < args.most:
        first = 3 + 11 * args.windows * len(parts)
        parts.append(differentiable.Windows(env.physics, walk, tuple(NAMES.values()), first=first))
        for fit in parts[-1].fit(numbers, known, iterations=args.iterations, starts=not args.measured_starts):
            told("fit", fit.numbers, fit.misfit)
        fits.append(fit)
        if fit.surprise > args.surprise:
            print(f"dropped: the misfit is {fit.surprise:.1f} standard deviations above that of noise", flush=True)
            continue
        numbers, known = fit.numbers, fit.information
        wide = 2.0 * expected(fit)
        if wide.max() <= args.within:
            break
        print(f"{names[int(wide.argmax())]}: two standard errors are {wide.max():.1f} %", flush=True)
    *_, best = [one for one in fits if one.surprise <= args.surprise] or [min(fits, key=lambda one: one.surprise)]
    spent, apart = time.process_time() - began, told("fit", best.numbers, best.misfit)
    print("singular values:", *torch.linalg.eigvalsh(best.information).sqrt().int().tolist())
    for name, true, error_bar, error in zip(names, truth, expected(best), apart, strict=True):
        print(f"{name:15s} {true:+.2f}  standard error {error_bar:5.2f} %  error {error:5.2f} %")

    def misfits(points: torch.Tensor) -> torch.Tensor:
        return torch.tensor([sum(part.misfit(point) for part in parts) / len(parts) for point in points])

    began, at, least, draws, search = time.process_time(), guess, math.inf, 32, None
    while time.process_time() - began < 3.0 * spent:
        search = search or differentiable.cross_entropy(misfits, guess, spread, draws=draws)
        mean, values = next(search)
        if values.min() < least:
            at, least = mean, float(values.min())
        peer = told("CEM", at, least)
        if values.max() - values.min() < 1e-4 * values.min():  # collapsed: again, with twice the draws
            search, draws = None, 2 * draws
    env.close()
    fitted, found = (f"{one.mean():.2f} %, {one.max():.2f} %" for one in (apart, peer))
    took = f"{time.process_time() - began:.0f} s"
    return f"| {seed} | {args.windows * len(parts)} | {fitted} | {spent:.0f} s | {found} | {took} |"


if __name__ == "__main__":
    main()
