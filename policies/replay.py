"""Policies that play recordings: a motion clip turned into canonical actions, a file of actions, recorded episodes."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from arena_newton import tasks as task_registry
from arena_newton.cli.extras import require
from arena_newton.errors import InputError
from arena_newton.files.untrusted_files import read_arrays
from arena_newton.policies.base import DATASET_FILE, Chunk, Json, Mask, Observation, Policy, dataset_target, world_mask
from arena_newton.policies.open_loop import RecordedEpisodes, played
from arena_newton.rules import seeding
from arena_newton.trackers.motions import load_actions, load_clip
from arena_newton.trackers.motions.playback import clip_actions, startup_actions

__all__ = ["ReplayEpisodes", "ReplayPolicy", "from_spec"]


class ReplayPolicy(Policy):
    """Plays actions from the start of each episode; afterwards it holds the last one without displacement."""

    labels = "v3.1"
    chunk_size = 20

    def __init__(self, path: str | Path, *, startup_stand: float = 1.0, startup_blend: float = 1.0):
        """Read a recording.

        Args:
            path: A TWIST2/GMR clip (`.pkl`), or actions (`.npz`, array `action` of shape [ticks, 40]).
            startup_stand: Time of standing before a clip [s]; actions from an NPZ are played as they are.
            startup_blend: Time of moving from standing to a clip's first pose [s].

        Raises:
            InputError: The file is absent or unfit.
        """
        self.path = Path(path)
        self.name = f"replay-{self.path.stem}"
        self.trimmed = 0
        """Frames of a motion capture jump that were cut off the clip's start."""
        suffix = self.path.suffix.lower()
        if suffix not in (".pkl", ".npz"):
            raise InputError(f"--policy replay:{path}: expected a .pkl clip or an .npz file with an array action")
        if not self.path.is_file():
            raise InputError(f"--policy replay:{path}: no such file")
        if suffix == ".npz":
            self.actions = load_actions(self.path)
            startup_stand = startup_blend = 0.0
        else:
            clip = load_clip(self.path)
            self.trimmed = clip.trimmed
            actions = clip_actions(clip)
            lead = startup_actions(actions[0], stand=startup_stand, blend=startup_blend)
            self.actions = np.concatenate([lead, actions])
        self._startup = {"startup_stand": startup_stand, "startup_blend": startup_blend}
        self._hash = hashlib.sha256(self.path.read_bytes()).hexdigest()[:12]
        self._steps = np.zeros(0, dtype=np.int64)

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """Rewind the worlds in `mask`."""
        self._grow(len(seeds))
        self._steps[world_mask(mask, len(seeds))] = 0

    def act(self, observation: Observation) -> Chunk:
        """The next actions of the worlds that ask."""
        worlds = len(observation.state)
        self._grow(worlds)
        asking = world_mask(observation.mask, worlds)
        ticks = self._steps[:, None] + np.arange(self.chunk_size)
        self._steps[asking] += self.chunk_size
        return Chunk(played(self.actions, ticks))

    def describe(self) -> Json:
        """File name and hash, and the times of the start."""
        played = {"name": self.name, "file": self.path.name, "hash": self._hash, "ticks": len(self.actions)}
        return played | {"trimmed": self.trimmed} | self._startup

    def _grow(self, worlds: int) -> None:
        if len(self._steps) != worlds:
            self._steps = np.zeros(worlds, dtype=np.int64)


class ReplayEpisodes(RecordedEpisodes):
    """Plays each episode's own recording from a folder that `run --actions` wrote, open loop.

    To separate tracker from policy effects, replay the recorded actions through another tracker.
    """

    def __init__(self, folder: str | Path):
        """Read the recordings.

        Args:
            folder: Files with the arrays `action` [ticks, 40] and `episode_seed`, and the texts `task` (a Gym id) and
                `mode`.

        Raises:
            InputError: There are none, one is unfit, or two are of the same episode.
        """
        super().__init__()
        self.path = Path(folder)
        self.name = f"replay-{self.path.parent.name if self.path.name == 'actions' else self.path.name}"
        self._episodes: dict[tuple[str, str, int], np.ndarray] = {}
        """Actions by Gym id, mode and the seed that a policy is given."""
        files = sorted(self.path.glob("*.npz"))
        if not files:
            of_several = "a run through several trackers has a folder for each"
            raise InputError(f"--policy replay:{folder}: no recordings (.npz) here; {of_several}")
        for file in files:
            actions = load_actions(file)
            arrays = read_arrays(file, ("task", "mode", "episode_seed"), where=f"--policy replay:{file}")
            try:
                seed = int(arrays["episode_seed"])
                episode = str(arrays["task"]), str(arrays["mode"]), seeding.policy_seed(seed)
            except (KeyError, TypeError, ValueError, OverflowError):
                where = f"--policy replay:{file}"
                raise InputError(f"{where}: episode_seed, task and mode are missing or unfit") from None
            if episode in self._episodes:
                raise InputError(f"--policy replay:{file}: a second recording of episode seed {seed}, keep one")
            self._episodes[episode] = actions

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """Refuse a task without a recording, or episodes of which none has one."""
        gym_id = task_registry.get(task).gym_id
        here = {(recorded, seed) for name, recorded, seed in self._episodes if name == gym_id}
        where = f"--policy replay:{self.path}"
        if not here:
            raise InputError(f"{where}: no recording of task {task}")
        modes = {recorded for recorded, _ in here}
        if mode is not None and mode not in modes:
            raise InputError(f"{where}: no recording of task {task} in mode {mode}, only {', '.join(sorted(modes))}")
        if seeds and not any((mode, seed) in here for seed in seeds):
            raise InputError(f"{where}: recordings of task {task}, but of other --seeds")

    def recording(self, task: str, mode: str, seed: int) -> np.ndarray | None:
        """See `RecordedEpisodes.recording`."""
        return self._episodes.get((task, mode, seed))

    def describe(self) -> Json:
        """Folder and number of episodes."""
        return {"name": self.name, "folder": self.path.name, "episodes": len(self._episodes)}


def from_spec(argument: str | None) -> Policy:
    """Make the policy for `--policy replay:<path>`; without a path it is refused.

    Raises:
        InputError: What is at the path cannot be played; the message says what can.
    """
    if not argument:
        raise InputError(
            "--policy replay: needs a file or a folder, as in replay:walk.pkl, replay:actions.npz, replay:run/actions, "
            "replay:dataset#0"
        )
    path, episode = dataset_target(argument)
    if (path / DATASET_FILE).is_file():
        require("data", f"--policy replay:{argument}", ("pyarrow",))
        from arena_newton.policies.replay_dataset import ReplayDataset

        return ReplayDataset(path, episode)
    if episode is not None:
        raise InputError(f"--policy replay:{argument}: {path} is no LeRobot dataset (it has no {DATASET_FILE})")
    return ReplayEpisodes(path) if path.is_dir() else ReplayPolicy(path)
