"""Actions of a policy on observations of a dataset: the first action of each chunk, as the paper's t-SNE figures.

"10 uniformly spaced frames from each of the 100 episodes per source"; the front picture and the state go through the
policy's own pipeline, and the first action of the predicted chunk is taken (the paper's appendix "Predicted Action
Distributions under Cross-GMT Observations"). A policy is asked as if each observation were the first of an episode: no
memory, no queue. Actions are those of the policy's own label protocol.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from arena_newton import tasks
from arena_newton.data.readers.frame_reader import Frames
from arena_newton.data.readers.lerobot_reader import DatasetActions
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.records.identity import hash_path
from arena_newton.interfaces import Observation
from arena_newton.pictures.settings import FRONT, CameraConfig, policy_cameras
from arena_newton.policies.base import DATASET_FILE, Policy
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH
from arena_newton.rules import seeding

__all__ = ["DatasetObservations", "Samples", "as_many_of_each", "predict"]


@dataclass(frozen=True)
class Samples:
    """Observations of one task in a dataset, by their rows."""

    task: str
    episodes: np.ndarray
    """Episode of each, int64, shape [n]."""
    rows: np.ndarray
    """Row of the dataset, int64, shape [n]."""
    states: np.ndarray
    """Canonical states, float32, shape [n, 64]."""

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.rows)


class DatasetObservations:
    """Observations of a dataset by task."""

    def __init__(self, root: Path):
        """Read which task and tracker each episode is of.

        Raises:
            InputError: It is no LeRobot v3.0 dataset of canonical actions at 50 Hz, or of no known task.
        """
        self.actions = DatasetActions(root)
        self.files = self.actions.files
        self.root = self.files.root
        feature = self.files.features.get("observation.state", {})
        if feature.get("shape") != [STATE_WIDTH]:
            raise InputError(f"{self.actions.where}: observation.state has no {STATE_WIDTH} numbers")
        known = [self.actions.task(episode) for episode in range(self.actions.episodes)]
        self.episodes: dict[str, list[int]] = {}
        for episode, task in enumerate(known):
            if task is not None and task in tasks.names():
                self.episodes.setdefault(task, []).append(episode)
        if not self.episodes:
            raise InputError(f"{self.root}: none of its episodes is of a known task")
        seeds = self.actions.seeds()
        trackers = sorted({seed.tracker for seed in seeds})
        self.tracker = trackers[0] if len(trackers) == 1 else ""
        """The tracker that all its episodes were recorded through; empty where it is not one."""
        self.name = self.tracker or self.root.name
        """Name of the tracker, or that of the folder."""
        self._frames: dict[str, Frames] = {}

    @property
    def digest(self) -> str:
        """Hash of `meta/info.json`."""
        return hash_path(self.root / DATASET_FILE)

    def sample(self, task: str, number: int, per_episode: int) -> Samples:
        """Uniformly spaced observations of episodes of a task, `per_episode` of each, of as many as are needed.

        Episodes are spread over the dataset where it has more than are needed; where it has fewer, there are fewer
        observations.

        Raises:
            InputError: Rows of an episode are missing, or a state is not finite.
        """
        mine = self.episodes[task]
        wanted = min(len(mine), -(-number // per_episode))
        chosen = [mine[k] for k in np.linspace(0, len(mine) - 1, wanted).round().astype(int)]
        episodes, rows, states = [], [], []
        for episode in chosen:
            row = self.files.episode_rows[episode]
            columns = self.files.columns(row.data, ("episode_index", "frame_index", "observation.state"))
            own = columns["episode_index"] == episode
            frames = columns["frame_index"][own]
            if not np.array_equal(frames, np.arange(row.length)):
                raise InputError(f"{row.data}: episode {episode}: frame_index is not 0 to {row.length - 1}")
            at = np.linspace(0, row.length - 1, min(per_episode, row.length)).round().astype(np.int64)
            found = columns["observation.state"][own][at].astype(np.float32)
            if not np.isfinite(found).all():
                raise InputError(f"{row.data}: episode {episode}: a state is not finite")
            episodes += [episode] * len(at)
            rows += (row.first + at).tolist()
            states.append(found)
        return Samples(
            task,
            np.asarray(episodes, dtype=np.int64)[:number],
            np.asarray(rows, dtype=np.int64)[:number],
            np.concatenate(states)[:number],
        )

    def pictures(self, rows: Sequence[int], camera: CameraConfig, name: str = FRONT) -> np.ndarray:
        """Pictures of rows by a camera, the head camera by default, uint8, shape [n, H, W, 3].

        Raises:
            InputError: The dataset has none, or of another size than the policy wants; of padded ones the part within
                the pad is taken for a policy that wants it.
        """
        if name not in self._frames:
            self._frames[name] = Frames(self.root, f"observation.images.{name}")
        found = np.stack([self._frames[name][row] for row in rows])
        if 3 * camera.width == 4 * camera.height and found.shape[1] == found.shape[2] == camera.width:
            top = (camera.width - camera.height) // 2
            found = found[:, top : top + camera.height]
        if found.shape[1:3] != (camera.height, camera.width):
            height, width = found.shape[1:3]
            raise InputError(
                f"{self.root}: its pictures have {width}x{height} pixels, the policy wants "
                f"{camera.width}x{camera.height}; build the dataset in that size"
            )
        return found

    def close(self) -> None:
        """Close its videos."""
        for frames in self._frames.values():
            frames.close()


def as_many_of_each(datasets: Sequence[DatasetObservations], task: str, number: int, per_episode: int) -> list[Samples]:
    """Observations of a task from every dataset, as many of each, so that no source is the more frequent one.

    Where one has fewer, fewer are taken of the others, again spread over all their episodes.

    Raises:
        InputError: As `DatasetObservations.sample`.
    """
    found = [data.sample(task, number, per_episode) for data in datasets]
    while len(set(map(len, found))) > 1:
        most = min(map(len, found))
        found = [data.sample(task, most, per_episode) for data in datasets]
    return found


def predict(
    policy: Policy, data: DatasetObservations, samples: Samples, *, batch: int = 50, seed: int = 0
) -> np.ndarray:
    """First action of the chunk that a policy answers to each observation, float32, shape [n, 40].

    Args:
        policy: Asked for `batch` observations at once, after a reset each time, without an environment.
        data: Where the pictures are.
        batch: Observations at once; the last batch is filled up with its first one.
        seed: Chooses the episode seeds that the policy is given.

    Raises:
        InputError: The pictures do not fit, or the policy needs depth or a world, or gives no usable action.
    """
    spec = tasks.get(samples.task)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    cameras = policy_cameras(policy)
    if deep := [name for name, camera in cameras.items() if camera.depth]:
        raise InputError(f"policy {policy.name}: observes the depth of {' '.join(deep)}, which datasets do not hold")
    found = np.zeros((len(samples), ACTION_WIDTH), dtype=np.float32)
    for first in range(0, len(samples), batch):
        some = np.arange(first, min(first + batch, len(samples)))
        filled = np.concatenate([some, np.full(batch - len(some), some[0])])
        images = {}
        for name, camera in cameras.items():
            shown = data.pictures(samples.rows[some].tolist(), camera, name)
            shown = np.concatenate([shown, np.repeat(shown[:1], batch - len(some), axis=0)])
            images[name] = torch.as_tensor(shown, device=device)
        # Of each observation its own, and the same for observation k of both datasets.
        seeds = [seeding.recording_seed(spec.gym_id, seeding.DEMONSTRATION, seed, int(k)) for k in filled]
        policy.reset(seeds, [spec.gym_id] * batch)
        observation = Observation(
            state=torch.as_tensor(samples.states[filled], device=device),
            image=None,
            mask=np.ones(batch, dtype=bool),
            task=samples.task,
            gym_id=spec.gym_id,
            instruction=spec.instruction,
            tracker=data.tracker,
            images=images,
        )
        try:
            answer = policy.act(observation)
            actions = torch.as_tensor(answer.actions).detach().float().cpu().numpy()
        except ArenaError:
            raise
        except Exception as error:
            raise InputError(
                f"policy {policy.name}: gives no action for an observation alone ({type(error).__name__}: {error}); "
                "one that reads the world's state cannot be mapped"
            ) from error
        if actions.ndim != 3 or actions.shape[0] != batch or actions.shape[2] != ACTION_WIDTH or not actions.shape[1]:
            raise InputError(f"policy {policy.name}: a chunk of shape {list(actions.shape)}")
        for world in range(len(some)):
            if world in answer.errors or not np.isfinite(actions[world, 0]).all():
                reason = answer.errors.get(world, "its action is not finite")
                raise InputError(f"policy {policy.name}: row {samples.rows[some[world]]} of {data.root}: {reason}")
        found[some] = actions[: len(some), 0]
    return found
