"""A punch shown at one target is refined until it hits another one, played without looking.

Shows: the exact gradient from a margin to all of an episode's actions; values come from the engine. A minute on a CPU.

    python examples/refine_reference.py --shown 0 --wanted 16
"""

import argparse

import torch

from arena_newton import ArenaEnv, Rollout, differentiable, policies, trackers
from arena_newton.eval.plan.episode_plan import expand
from arena_newton.kernels.rules import success
from arena_newton.robot import canonical
from arena_newton.trackers.motions import kinematics

WRISTS, JOINTS = ("left_wrist_yaw_link", "right_wrist_yaw_link"), canonical.ACTION["joint_pos"]


def main() -> None:
    """Demonstrate, then play and refine."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shown", type=int, default=0, help="repeat of the plan whose expert is recorded")
    parser.add_argument("--wanted", type=int, default=16, help="repeat at which its actions must succeed")
    parser.add_argument("--rounds", type=int, default=8, help="plays at most")
    args = parser.parse_args()
    env = ArenaEnv("boxing", tracker=trackers.get("sonic"), worlds=1, engine="mujoco")
    plan = expand(["boxing"], trackers=["sonic"], policy="expert", seeds=[0], repeats=20)
    kept: list[torch.Tensor] = []
    keep = lambda env, action: kept.append(action.clone()) or action  # type: ignore[func-returns-value]  # noqa: E731
    Rollout(env, policies.get("expert"), plan[args.shown :][:1], disturbance=keep).run()
    actions = torch.cat(kept[env.startup_ticks :] + kept[-1:] * 15)
    rule = {name: getattr(env.judge, name) for name in ("palm_body", "palm_offset", "target")}
    bodies = torch.tensor([env.scene.link(name) for name in WRISTS])
    links = [kinematics.link_index(name) for name in WRISTS]
    for number in range(args.rounds):
        played = differentiable.play(env, actions[None], seed=plan[args.wanted].episode_seed)
        state, leaf, poses = played.start, actions.clone().requires_grad_(), []
        for action in leaf[:, None]:
            mimic, state = differentiable.reference_step(action, state)
            reference = kinematics.forward(state.position, state.quat, mimic[:, canonical.MIMIC["joint_pos"]])
            poses.append(torch.cat([reference.position, reference.quat], dim=-1)[:, links])
        wrists, real = torch.cat(poses), torch.cat([played.xpos, played.xquat], dim=-1)[:, 0]
        xpos, xquat = real.index_add(1, bodies, wrists - wrists.detach()).split([3, 4], dim=-1)  # their gradient alone
        rule |= {"xpos": xpos, "xquat": xquat, "min_radius": 0.0, "pad": 0.08}
        margins = differentiable.success_margin(success.launch_boxing, **rule)
        best, at = margins.max(dim=0)
        print(f"played {number}: a palm comes within {best:+.3f} m after {at * 0.02:.1f} s")
        if best >= 0.0:
            break
        slope = torch.autograd.grad(best, leaf)[0][at, JOINTS]
        near = torch.exp(-0.5 * ((torch.arange(len(actions)) - at) / 12.0) ** 2)[:, None]  # half a second around it
        actions[:, JOINTS] += near * slope * (0.03 - best.detach()) / slope.square().sum()
    env.close()


if __name__ == "__main__":
    main()
