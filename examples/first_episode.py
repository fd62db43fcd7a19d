"""The first episode: a scripted expert kicks a ball into a goal, and you get a film strip of it.

Shows: the environment, a tracker, a policy, a plan, a rollout, a recorder, and what a result says. 20 s on a CPU.

    python examples/first_episode.py --out first_episode
"""

import argparse

from arena_newton import ArenaEnv, EpisodeRecorder, Rollout, policies, trackers
from arena_newton.eval.plan.episode_plan import expand


def main() -> None:
    """Play one episode."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="football", help="football double_desk pp_box open_door sit_sofa boxing ...")
    parser.add_argument("--max-steps", type=int, default=None, help="ticks of 0.02 s; the task's own budget by default")
    parser.add_argument("--out", default="first_episode", help="folder of the film strip")
    args = parser.parse_args()

    env = ArenaEnv(args.task, tracker=trackers.get("twist2"), worlds=1, engine="mujoco")
    episodes = expand([args.task], trackers=["twist2"], policy="expert", seeds=[0], repeats=1)
    recorder = EpisodeRecorder(args.out, video=False, follow=True)
    (result,) = Rollout(env, policies.get("expert"), episodes, recorder=recorder, max_steps=args.max_steps).run()
    recorder.close()
    env.close()

    print(f"{env.spec.instruction} {result.outcome} after {result.steps * 0.02:.1f} s ({result.reason})")
    print(f"margin to success: {result.margin:+.3f} (at least 0 is a success)")
    for name, tick in result.phases:
        print(f"  {tick * 0.02:5.1f} s  {name}")
    print(f"film strip in {args.out}")


if __name__ == "__main__":
    main()
