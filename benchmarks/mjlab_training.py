"""mjlab's G1 tracking task, trained for as many iterations as asked: run by the interpreter that has mjlab, as a file.

Nothing of this product is imported: mjlab needs other versions of MuJoCo and mujoco_warp. The pair `tracker_training`
of `python -m benchmarks peers` gives it the motion and talks through stdin and stdout: a number of iterations in, one
JSON line out. Nothing is logged or written.
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import mjlab.tasks
import mujoco
import numpy as np
import torch
from mjlab.asset_zoo.robots import get_g1_robot_cfg
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls
from mjlab.utils.torch import configure_torch_backends

__all__ = ["main", "motion_arrays"]

TASK = "Mjlab-Tracking-Flat-Unitree-G1"
"""mjlab's task; its robot's joints have the order of the product's motions."""
PACKAGES = ("mjlab", "mujoco", "mujoco-warp", "rsl-rl-lib", "torch", "warp-lang")
"""Distributions whose versions are named beside the figures."""


def motion_arrays(
    root_pos: np.ndarray, root_quat: np.ndarray, joint_pos: np.ndarray, fps: float
) -> dict[str, np.ndarray]:
    """A motion as mjlab's `csv_to_npz` writes it: joints, and pose and velocity of every body of its G1.

    Args:
        root_pos: Pelvis [m], shape [frames, 3].
        root_quat: Its orientation, wxyz, shape [frames, 4].
        joint_pos: Joints [rad], MuJoCo order, shape [frames, 29].
    """
    model = get_g1_robot_cfg().spec_fn().compile()
    data = mujoco.MjData(model)
    qpos = np.concatenate([root_pos, root_quat, joint_pos], axis=1).astype(np.float64)
    if qpos.shape[1] != model.nq:
        raise SystemExit(f"the motion has {qpos.shape[1] - 7} joints, mjlab's G1 {model.nq - 7}")
    frames, bodies = len(qpos), model.nbody - 1
    qvel = np.zeros((frames, model.nv))
    for frame in range(frames):
        before, after = max(frame - 1, 0), min(frame + 1, frames - 1)
        mujoco.mj_differentiatePos(model, qvel[frame], (after - before) / fps, qpos[before], qpos[after])
    found = {name: np.zeros((frames, bodies, 3)) for name in ("body_pos_w", "body_lin_vel_w", "body_ang_vel_w")}
    found["body_quat_w"] = np.zeros((frames, bodies, 4))
    velocity = np.zeros(6)
    for frame in range(frames):
        data.qpos[:], data.qvel[:] = qpos[frame], qvel[frame]
        mujoco.mj_forward(model, data)
        found["body_pos_w"][frame], found["body_quat_w"][frame] = data.xpos[1:], data.xquat[1:]
        for body in range(bodies):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body + 1, velocity, 0)
            found["body_ang_vel_w"][frame, body], found["body_lin_vel_w"][frame, body] = velocity[:3], velocity[3:]
    found |= {"joint_pos": qpos[:, 7:], "joint_vel": qvel[:, 6:]}
    return {"fps": np.array([fps])} | {name: array.astype(np.float32) for name, array in found.items()}


def main(motion: str, worlds: int, device: str) -> None:
    """Build the task, say so, and train on demand until stdin ends.

    Args:
        motion: NPZ with root_pos, root_quat, joint_pos and fps.
        device: cpu or cuda:0.
    """
    # What libraries print must not be taken for an answer.
    answers, sys.stdout = sys.stdout, sys.stderr
    configure_torch_backends()
    env_cfg, agent_cfg = load_env_cfg(TASK), load_rl_cfg(TASK)
    with tempfile.TemporaryDirectory() as folder, np.load(motion) as given:
        file = Path(folder) / "motion.npz"
        arrays: dict = motion_arrays(given["root_pos"], given["root_quat"], given["joint_pos"], float(given["fps"]))
        np.savez(file, **arrays)
        env_cfg.commands["motion"].motion_file = str(file)
        env_cfg.scene.num_envs, env_cfg.seed = worlds, agent_cfg.seed
        env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg=env_cfg, device=device), clip_actions=agent_cfg.clip_actions)
    runner = load_runner_cls(TASK)(env, asdict(agent_cfg), None, device)

    def answer(**facts: object) -> None:
        print(json.dumps(facts), file=answers, flush=True)

    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    physics = f"{env_cfg.sim.mujoco.timestep * 1e3:g} ms x {env_cfg.decimation}"
    answer(versions=versions, steps=agent_cfg.num_steps_per_env, physics=physics)
    first = True
    for line in sys.stdin:
        iterations = int(line)
        began = time.perf_counter()
        # As mjlab's own `train`: the first episodes end at different times.
        runner.learn(num_learning_iterations=iterations, init_at_random_ep_len=first)
        if device != "cpu":
            torch.cuda.synchronize()
        seconds, first = time.perf_counter() - began, False
        answer(samples=iterations * worlds * agent_cfg.num_steps_per_env, seconds=seconds)
    env.close()


if __name__ == "__main__":
    assert mjlab.tasks  # registers the tasks
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
