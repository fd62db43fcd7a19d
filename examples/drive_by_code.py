"""Drive by code: walk, turn, squat and kick by commands such as "0.5 m/s ahead", through any tracker.

Shows: `MotionCommand`, whose channels combine freely, and `ReferenceGenerator`, which makes 50 Hz actions of them.

    python examples/drive_by_code.py --tracker sonic
"""

import argparse
from collections.abc import Sequence

from arena_newton import ArenaEnv, Rollout, policies, trackers
from arena_newton.eval.plan.episode_plan import expand
from arena_newton.policies.base import Mask
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator

SCRIPT = ((0.0, "ahead"), (3.0, "turn"), (5.0, "squat"), (7.0, "kick"), (9.0, "stand"))  # [s] from which each holds


class Driver(policies.Policy):
    """Gives the commands of the script to one world."""

    name = "driver"

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Stand at the origin of a new reference."""
        self.generator, self.tick = ReferenceGenerator(worlds=1), 0

    def act(self, observation: policies.Observation) -> policies.Chunk:
        """One action per tick."""
        name = [word for start, word in SCRIPT if self.tick * 0.02 >= start][-1]
        command = MotionCommand.neutral(1)
        command.velocity[:, 0] = 0.5 * (name == "ahead")  # m/s
        command.velocity[:, 2] = 0.6 * (name == "turn")  # rad/s
        command.height[:] = 0.6 if name == "squat" else 0.785  # m
        command.kick[:] = 2 if name == "kick" else 0  # the right foot
        self.generator.step(command)
        self.tick += 1
        return policies.Chunk(self.generator.action()[:, None], phases=[name])


def report(env: ArenaEnv) -> None:
    """Print once a second where the robot is."""
    if env.tick[0] >= 0 and env.tick[0] % 50 == 0:
        x, y, z = env.physics.qpos.numpy()[0, env.scene.robot.root_qpos :][:3]
        print(f"{env.tick[0] * 0.02:4.0f} s  x {x:+.2f}  y {y:+.2f}  height {z:.2f} m")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracker", default="twist2", help="twist2 or sonic")
    parser.add_argument("--max-steps", type=int, default=500, help="ticks of 0.02 s")
    args = parser.parse_args()
    env = ArenaEnv("football", tracker=trackers.get(args.tracker), worlds=1, engine="mujoco")
    episodes = expand(["football"], trackers=[args.tracker], policy="driver", seeds=[0], repeats=1)
    (result,) = Rollout(env, Driver(), episodes, max_steps=args.max_steps, on_tick=lambda _: report(env)).run()
    print(f"{result.outcome}; " + ", ".join(f"{name} from {tick * 0.02:g} s" for name, tick in result.phases))
    env.close()
