"""A tracker of your own: TWIST2 with smoothed joint targets.

Shows: a tracker's methods, a memory that obeys masks, the conformance checks. More: docs/howto/bring/trackers.md.

    python examples/own_tracker.py
"""

import argparse

import torch

from arena_newton import ArenaEnv, Rollout, policies, trackers
from arena_newton.eval.plan.episode_plan import expand
from arena_newton.testing import check_tracker
from arena_newton.trackers import RobotState, TrackerCommand


class Smooth(trackers.Tracker):
    """Follows what another tracker wants with a delay."""

    name = "smooth"

    def __init__(self) -> None:
        """Take the other tracker with the drive that its targets are made for."""
        self.inner = trackers.get("twist2")
        self.drive = self.inner.drive

    def bind(self, worlds: int, device: torch.device | str = "cpu") -> None:
        """Allocate the memory of every world."""
        super().bind(worlds, device)
        self.inner.bind(worlds, device)
        self.last = torch.zeros(worlds, 29, device=device)

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Forget the past of some worlds, or of all."""
        self.inner.reset(mask)
        self.last[slice(None) if mask is None else mask] = 0.0

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Begin as if the first frame had been there for ever."""
        self.inner.prefill(command, state, mask)
        self.last = command.joints.clone() if mask is None else torch.where(mask[:, None], command.joints, self.last)

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Joint targets [rad]; only the worlds of the mask move on."""
        targets = torch.lerp(self.last, self.inner.step(command, state, mask), 0.8)
        self.last = targets if mask is None else torch.where(mask[:, None], targets, self.last)
        return targets


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-steps", type=int, default=250, help="ticks of 0.02 s")
    args = parser.parse_args()
    print(f"{len(check_tracker(Smooth()))} promises kept")
    env = ArenaEnv("football", tracker=Smooth(), worlds=2, engine="mujoco")
    episodes = expand(["football"], trackers=["smooth"], policy="stand", seeds=[0], repeats=2)
    for result in Rollout(env, policies.get("stand"), episodes, max_steps=args.max_steps).run():
        print(f"{result.episode.key}: {result.outcome} after {result.steps * 0.02:.1f} s of standing")
    env.close()
