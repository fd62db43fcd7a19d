"""Flags of `eval bench`."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Several

__all__ = ["BenchOptions"]


@dataclass(frozen=True)
class BenchOptions:
    """Measure this machine against the figures to reach; ratios are taken side by side in one run."""

    what: tuple[str, ...] = ("all",)
    """What to measure: help tick generator throughput camera pictures recording episodes policy learned start tests, or
    `all`
    (all but tests)."""
    checkpoint: str | None = None
    """Weights of TWIST2; those that come with the package when none are named."""
    worlds: int = 20
    """Worlds of engine mujoco."""
    cuda_worlds: int = 4096
    """Worlds on CUDA."""
    camera_worlds: int = 1024
    """Worlds of the camera on CUDA."""
    rounds: int = 20
    """Rounds of each ratio; their medians are compared."""
    recording_episodes: int = 2
    """Episodes of `recording`; the figure to reach is for 100 VisNavi ones."""
    recording_worlds: int = 2
    """Worlds of `recording`; 100 on CUDA for the figure to reach."""
    recording_size: str = "224x224"
    """Size of the recorded pictures [px]."""
    recording_task: str = "vis_navi"
    """Task that is recorded."""
    policy_checkpoint: str | None = None
    """Checkpoint of `policy`; one of `--policy-family` of full size with random weights when none is named."""
    policy_family: str = "act"
    """Family of those random weights: act, diffusion, flow or pi05 (4 billion, which takes minutes to make)."""
    policy_tasks: tuple[str, ...] = ("vis_navi", "boxing")
    """Tasks of `policy`."""
    policy_episodes: int = 0
    """Episodes of `policy`, all at once; 0: 60 on CUDA, for which the figures to reach are, and 2 on the CPU."""
    policy_steps: int = 0
    """Ticks of an episode of `policy` at most; 0: what the rules or the length of usual successes say."""
    learned_ticks: int = 300
    """Ticks of an episode of `learned`, and of the expert's beside it."""
    peers: Several[str] = ()
    """Measure beside other programs instead: tick world_ticks act_training tracker_training lerobot_eval camera, or
    `all`."""
    peers_dataset: str | None = None
    """Dataset of `act_training`, read by both sides."""
    mjlab_python: str | None = None
    """Interpreter that has mjlab, for `tracker_training`."""
    peers_worlds: Several[int] = ()
    """Worlds of `tracker_training`; 4096 and 8192 on CUDA, 4 on the CPU when none are named."""
    peers_iterations: int = 10
    """Iterations of PPO in a round of `tracker_training`."""
    peers_rounds: int = 3
    """Rounds of `tracker_training` and `lerobot_eval`."""
    peers_episodes: int = 0
    """Episodes of `lerobot_eval`, all at once, by `--policy-checkpoint` or the policy of the package; 0: 60 on CUDA, 2
    on the CPU."""
    peers_steps: int = 0
    """Cap on the ticks of an episode of `lerobot_eval`; 0: what the rules say."""
    peers_size: int = 224
    """Width and height of the pictures of `camera` [px]."""
    peers_history: str | None = None
    """File to which each pair that was measured is appended as a JSON line."""
    json: bool = False
    """Print one JSON array instead of the table."""
