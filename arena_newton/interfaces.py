"""What passes between the world, a tracker and a policy: plain records, no behaviour."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

__all__ = ["Chunk", "EpisodeResult", "Observation", "RobotState", "TrackerCommand"]


@dataclass
class Observation:
    """What a policy sees; rows are worlds."""

    state: Any
    """Canonical state, float32 torch tensor [worlds, 64]."""
    image: Any
    """Head camera, uint8 torch tensor [worlds, H, W, 3], or None when the policy needs none."""
    mask: Any
    """bool NumPy array [worlds]: the worlds that ask for a new chunk."""
    task: str
    """Task name."""
    gym_id: str
    """The original benchmark's task id (sent to policy servers)."""
    instruction: str
    """Natural-language instruction."""


@dataclass
class Chunk:
    """A policy's answer."""

    actions: Any
    """Canonical actions, float32 torch tensor or array [worlds, n, 40]; only rows of the asking worlds are read."""
    errors: dict[int, str] = field(default_factory=dict)
    """World → what went wrong; those episodes end as `error`, the others go on."""


@dataclass
class RobotState:
    """Measured robot state as torch views; rows are worlds, joints in MuJoCo order."""

    quat: Any
    """Root orientation wxyz, [worlds, 4]."""
    ang_vel_body: Any
    """Root angular velocity in the body frame [rad/s], [worlds, 3]."""
    joint_pos: Any
    """[rad], [worlds, 29]."""
    joint_vel: Any
    """[rad/s], [worlds, 29]."""


@dataclass
class TrackerCommand:
    """The reference of one tick as torch views; rows are worlds, joints in MuJoCo order."""

    mimic: Any
    """TWIST2's mimic command, [worlds, 35]."""
    joints: Any
    """Reference joint positions [rad], [worlds, 29]."""
    joint_vel: Any
    """Backward difference of the reference joints [rad/s], [worlds, 29]."""
    quat: Any
    """Reference root orientation in the world, wxyz, [worlds, 4]."""


@dataclass
class EpisodeResult:
    """How one planned episode ended."""

    episode: Any
    """The plan's object."""
    outcome: str
    """`success`, `fall`, `timeout` or `error`."""
    reason: str
    """Finer cause, such as `ball_out`, `startup_fall`, `nonfinite_state`."""
    steps: int
    """Control ticks executed after the start-up."""
    margin: float
    """Signed distance to success at the end."""
    startup_fall: bool = False
    """The robot fell while settling, before the policy acted."""
    overflow: bool = False
    """A contact or constraint buffer overflowed in this episode's world."""
    sim_s: float = 0.0
    """Simulated time [s]."""
    wall_s: float = 0.0
    """Wall-clock time from reset to end [s]."""
    error: str | None = None
    """Message of an `error`."""
