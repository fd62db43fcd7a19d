"""Inference time of a tracker per tick, without physics."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from arena_newton.interfaces import RobotState, Tracker, TrackerCommand
from arena_newton.robot.g1 import DEFAULT_POSE

__all__ = ["GPU_WORLDS", "inference"]

GPU_WORLDS = 4096
"""Worlds of the measurement on a GPU."""
WARM_UP, CALLS = 30, 200


def inference(make: Callable[[], Tracker]) -> dict[str, float]:
    """Median time of a tick [ms]: `cpu` for one world and, where there is a GPU, `cuda` for `GPU_WORLDS`."""
    out = {"cpu": _median(make(), 1, torch.device("cpu"))}
    if torch.cuda.is_available():
        out["cuda"] = _median(make(), GPU_WORLDS, torch.device("cuda"))
    return out


def _median(tracker: Tracker, worlds: int, device: torch.device) -> float:
    quat = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).repeat(worlds, 1)
    joints = torch.tensor(DEFAULT_POSE, device=device).repeat(worlds, 1)
    zero = torch.zeros(worlds, 29, device=device)
    mimic = torch.zeros(worlds, 35, device=device)
    mimic[:, 2], mimic[:, 6:] = 0.78, joints
    given = {name: zero[:, :2] if name == "foot_force" else zero[:, :3] for name in tracker.needs}
    command = TrackerCommand(mimic=mimic, joints=joints, joint_vel=zero, quat=quat, position=given.get("position"))
    if tracker.lookahead:
        command.ahead = command.mapped(lambda t: t[:, None].expand(-1, tracker.lookahead, -1))
    state = RobotState(quat=quat, ang_vel_body=zero[:, :3], joint_pos=joints, joint_vel=zero, **given)
    tracker.bind(worlds, device)
    tracker.prefill(command, state)
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    times = []
    for _ in range(WARM_UP + CALLS):
        wait()
        began = time.perf_counter()
        tracker.step(command, state)
        wait()
        times.append(time.perf_counter() - began)
    return 1000.0 * sorted(times[WARM_UP:])[CALLS // 2]
