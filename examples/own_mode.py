"""A mode of your own: everything is slippery, and objects start as in execution mode.

Shows: that a mode is a record of ranges. A package offers `WET` as an entry point of the group `arena_newton.modes`;
every command then knows `--mode wet`. More: docs/howto/bring/add_a_task.md.

    python examples/own_mode.py
"""

import argparse

from arena_newton import ArenaEnv, Rollout, policies, trackers
from arena_newton.eval.plan.episode_plan import expand
from arena_newton.rules import modes

WET = modes.Mode(
    name="wet",
    sentence="everything is slippery, and objects start in wider ranges",
    placements=lambda rule: rule.execution,
    dynamics={"friction": (0.2, 0.5)},
)

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--max-steps", type=int, default=None, help="ticks of 0.02 s; the task's own budget by default")
    args = parser.parse_args()
    modes.register(WET)
    env = ArenaEnv("football", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", mode="wet")
    episodes = expand(["football"], trackers=["twist2"], policy="expert", modes=["wet"], seeds=[0], repeats=2)
    for result in Rollout(env, policies.get("expert"), episodes, max_steps=args.max_steps).run():
        print(f"{result.episode.key}: {result.outcome} after {result.steps * 0.02:.1f} s")
    env.close()
