"""A small network that is given the true poses: what a policy without memory can learn of demonstrations at best.

Three layers, 20 actions ahead, L1, labels v4. It sees the canonical state, where the robot is, and every recorded
object from the robot, so that whatever it does not learn is neither a matter of pictures nor of seeing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from arena_newton.data.readers.label_protocols import encode_v4
from arena_newton.data.recording.episode import EpisodeFile, episode_files
from arena_newton.errors import InputError
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH
from arena_newton.robot.rotations import heading

__all__ = ["Demonstrations", "PoseNetwork", "fitted", "pose_features", "read_demonstrations"]

WIDTH = 512
"""Width of the layers."""
NOISE = 0.01
"""Standard deviation of what is added to poses in training [m, and units of sines], so that a pose is no timetable."""
STATE_FLOOR, ACTION_FLOOR = 1e-3, 1e-4
"""Least standard deviations by which states and actions are divided, those of the recipes."""
POSE_FLOOR = 0.05
"""The same of poses [m, and units of sines]: the noise on what never moves must not look large."""
LEARNING_RATE, WEIGHT_DECAY = 1e-3, 1e-4
"""Rate and decay of AdamW, in one cycle."""


@dataclass(frozen=True)
class Demonstrations:
    """Rows of all episodes, one after the other."""

    objects: tuple[str, ...]
    """Names of the objects that the recording has, in the order of the features."""
    features: Tensor
    """float32, shape [rows, n]."""
    actions: Tensor
    """Actions of v4, float32, shape [rows, 40]."""
    lengths: tuple[int, ...]
    """Rows of each episode."""


def pose_features(state: Tensor, position: Tensor, quat: Tensor, objects: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    """Inputs of the network.

    Args:
        state: Canonical state, shape [rows, 64].
        position: Of the pelvis [m], shape [rows, 3].
        quat: Of the pelvis, wxyz, shape [rows, 4].
        objects: Position [m] and orientation of each object, as of the pelvis.

    Returns:
        The state, x and y of the pelvis, sine and cosine of its heading; of each object x and y from the robot and in
        its heading, height, sine and cosine of its heading from the robot's and of twice that, and how upright it is.
        Shape [rows, 64 + 4 + 8 * objects].
    """
    yaw = heading(quat)
    parts = [state, torch.stack([position[:, 0], position[:, 1], yaw.sin(), yaw.cos()], dim=1)]
    for there, turned in objects:
        away, angle = there - position, heading(turned) - yaw
        ahead = yaw.cos() * away[:, 0] + yaw.sin() * away[:, 1]
        left = yaw.cos() * away[:, 1] - yaw.sin() * away[:, 0]
        upright = 1.0 - 2.0 * (turned[:, 1] ** 2 + turned[:, 2] ** 2)
        turns = [angle.sin(), angle.cos(), (2.0 * angle).sin(), (2.0 * angle).cos()]
        parts.append(torch.stack([ahead, left, there[:, 2], *turns, upright], dim=1))
    return torch.cat(parts, dim=1)


def read_demonstrations(folder: Path, task: str, tracker: str) -> Demonstrations:
    """Successful episodes of a task that were recorded through a tracker.

    Args:
        folder: As `eval record` writes it.

    Raises:
        InputError: There are none, they have different objects, or a file is damaged.
    """
    features, actions, lengths = [], [], []
    objects: tuple[str, ...] | None = None
    seen: set[str] = set()
    for path in episode_files([folder]):
        episode = EpisodeFile(path)
        of = episode.text("arena_task"), episode.text("arena_tracker")
        seen.add(f"{of[0]} through {of[1]}, {episode.text('arena_outcome')}")
        if of != (task, tracker) or episode.text("arena_outcome") != "success":
            continue
        if objects is None:
            objects = episode.objects
        if set(objects) != set(episode.objects):
            raise InputError(f"{path}: has objects {' '.join(episode.objects)}, others have {' '.join(objects)}")
        poses = [_pose(episode, f"env_obj_{name}_position", f"env_obj_{name}_orientation") for name in objects]
        robot = _pose(episode, "robot_root_position", "robot_root_orientation")
        features.append(pose_features(torch.from_numpy(episode.state), *robot, poses))
        actions.append(torch.from_numpy(encode_v4(episode.action).astype(np.float32)))
        lengths.append(episode.rows)
    if objects is None:
        raise InputError(
            f"--recording {folder}: holds no success of {task} through {tracker}, but {'; '.join(sorted(seen))}"
        )
    return Demonstrations(objects, torch.cat(features), torch.cat(actions), tuple(lengths))


def _pose(episode: EpisodeFile, position: str, orientation: str) -> tuple[Tensor, Tensor]:
    """Position and orientation of each row, float32."""
    found = episode.array(position, episode.rows, 3), episode.array(orientation, episode.rows, 4)
    return torch.from_numpy(found[0].astype(np.float32)), torch.from_numpy(found[1].astype(np.float32))


class PoseNetwork(nn.Module):
    """Features to a chunk of actions."""

    def __init__(self, inputs: int, chunk: int):
        """New weights.

        Args:
            chunk: Actions of an answer.
        """
        super().__init__()
        self.chunk = chunk
        for name, width in (("seen", inputs), ("done", ACTION_WIDTH)):
            self.register_buffer(f"{name}_mean", torch.zeros(width))
            self.register_buffer(f"{name}_std", torch.ones(width))
        layers: list[nn.Module] = []
        for width in (inputs, WIDTH, WIDTH):
            layers += [nn.Linear(width, WIDTH), nn.GELU()]
        self.layers = nn.Sequential(*layers, nn.Linear(WIDTH, chunk * ACTION_WIDTH))

    def normalised(self, features: Tensor) -> Tensor:
        """Answers in units of the actions' standard deviations, shape [rows, chunk, 40]."""
        answer: Tensor = self.layers((features - self.get_buffer("seen_mean")) / self.get_buffer("seen_std"))
        return answer.view(len(features), self.chunk, ACTION_WIDTH)

    def forward(self, features: Tensor) -> Tensor:
        """Actions of v4, shape [rows, chunk, 40]."""
        return self.normalised(features) * self.get_buffer("done_std") + self.get_buffer("done_mean")


def fitted(
    data: Demonstrations,
    *,
    chunk: int,
    steps: int,
    batch_size: int,
    seed: int,
    on_step: Callable[[int, float], None] | None = None,
) -> PoseNetwork:
    """Train a network.

    Args:
        chunk: Actions of an answer; after an episode's end nothing is asked.
        seed: Of weights, rows and noise.
        on_step: Called with each step and its loss, in standard deviations of the actions.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = PoseNetwork(data.features.shape[1], chunk)
    drawn = torch.Generator().manual_seed(seed)
    buffers = dict(network.named_buffers())
    floor = torch.full((data.features.shape[1],), POSE_FLOOR)
    floor[:STATE_WIDTH] = STATE_FLOOR
    least = {"seen": floor, "done": torch.full((ACTION_WIDTH,), ACTION_FLOOR)}
    for name, values in (("seen", data.features), ("done", data.actions)):
        buffers[f"{name}_mean"].copy_(values.mean(0))
        buffers[f"{name}_std"].copy_(values.std(0, correction=0).clamp_min(least[name]))
    lengths = torch.tensor(data.lengths)
    last = torch.repeat_interleave(lengths.cumsum(0) - 1, lengths)
    ahead = torch.arange(chunk)
    optimizer = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=max(steps, 2))
    poses = data.features.shape[1] - STATE_WIDTH
    for step in range(steps):
        rows = torch.randint(len(data.features), (batch_size,), generator=drawn)
        seen = data.features[rows].clone()
        seen[:, STATE_WIDTH:] += NOISE * torch.randn(batch_size, poses, generator=drawn)
        wanted = torch.minimum(rows[:, None] + ahead, last[rows][:, None])
        known = (rows[:, None] + ahead <= last[rows][:, None])[..., None]
        target = (data.actions[wanted] - buffers["done_mean"]) / buffers["done_std"]
        loss = ((network.normalised(seen) - target).abs() * known).sum() / (known.sum() * ACTION_WIDTH)
        if not math.isfinite(loss.item()):
            raise InputError(f"step {step}: the loss is not finite")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if on_step is not None:
            on_step(step, loss.item())
    return network.eval()
