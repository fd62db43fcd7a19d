"""The swap: the same policy, the same episodes, another tracker underneath.

Shows: what the benchmark is about. A policy decides 40 numbers and never sees which tracker executes them; what it
loses when the tracker is swapped is the price of the interface. Open loop, with recorded actions, it loses more:

    python examples/swap.py
"""

import argparse

from arena_newton import ArenaEnv, Rollout, policies, trackers
from arena_newton.eval.plan.episode_plan import expand


def main() -> None:
    """Play the same episodes through both trackers that come with the package."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="boxing", help="football double_desk pp_box open_door sit_sofa boxing ...")
    parser.add_argument("--policy", default="expert", help="any policy: expert, stand, remote:<url>, replay:<file> ...")
    parser.add_argument("--episodes", type=int, default=4)
    parser.add_argument("--max-steps", type=int, default=None, help="ticks of 0.02 s; the task's own budget by default")
    args = parser.parse_args()

    outcomes = {}
    for name in ("twist2", "sonic"):
        env = ArenaEnv(args.task, tracker=trackers.get(name), worlds=args.episodes, engine="mujoco")
        episodes = expand([args.task], trackers=[name], policy=args.policy, seeds=[0], repeats=args.episodes)
        policy = policies.get(args.policy)
        results = Rollout(env, policy, episodes, max_steps=args.max_steps).run()
        outcomes[name] = [result.outcome for result in results]
        policy.close()
        env.close()

    print(f"{'episode':>8}  " + "  ".join(f"{name:10}" for name in outcomes))
    for number, row in enumerate(zip(*outcomes.values(), strict=True)):
        print(f"{number:>8}  " + "  ".join(f"{outcome:10}" for outcome in row))
    for name, found in outcomes.items():
        print(f"success rate through {name}: {found.count('success')} of {len(found)}")


if __name__ == "__main__":
    main()
