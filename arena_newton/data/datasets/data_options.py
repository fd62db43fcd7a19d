"""Flags of `python -m arena_newton.data`, one dataclass per command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from arena_newton.cli.flags import Several

__all__ = [
    "BuildOptions",
    "CleanOptions",
    "InspectOptions",
    "MergeOptions",
    "SplitOptions",
    "StatsOptions",
    "VerifyOptions",
]


@dataclass(frozen=True)
class BuildOptions:
    """Make a LeRobot v3.0 dataset of recorded episodes."""

    out: Path = Path("dataset")
    """Folder of the dataset, which must not exist yet."""
    labels: str = "v3.1"
    """Meaning of the actions: v3.1 (reference pose, the original's) or v4 (root velocities)."""
    layout: str = "arena"
    """Names of the features: arena (the original's), sonic (GR00T-WholeBodyControl) or lerobot (Unitree G1)."""
    cameras: Several[str] = ()
    """Cameras to take: front left_wrist right_wrist world; all that the episodes have by default."""
    repo_id: str = ""
    """Name of the dataset in LeRobot, such as local/boxing; local/<folder> by default. It is not stored."""
    only_success: bool = False
    """Leave out episodes that did not succeed."""
    allow_evaluation_seeds: bool = False
    """Take episodes whose seeds are those of evaluations, on which nothing should be trained."""
    file_mb: int = 0
    """Size of a video file [MB]; 0: 5 for pictures up to 256 px high, 25 for larger ones."""


@dataclass(frozen=True)
class VerifyOptions:
    """Check a dataset against itself and against the recordings that it was built from."""

    recordings: Several[Path] = ()
    """Folders of the recorded episodes; without them only the dataset itself is checked."""
    jobs: int = 0
    """Threads that decode videos, a file each; 0: one per core that the process may use."""


@dataclass(frozen=True)
class CleanOptions:
    """Drop rows that a stalled or jumping source spoiled; each of five rules may be turned off."""

    out: Path = Path("cleaned")
    """Folder to write, which must not exist yet; the recordings stay as they are."""
    count: bool = False
    """Only count and print; nothing is written."""
    nonmonotonic: bool = True
    """Drop a row whose frame index does not grow."""
    gap: bool = True
    """Drop a row whose frame index grows by more than --max-gap."""
    backward: bool = True
    """Drop a row at which the clock does not go on."""
    slow: bool = True
    """Drop a row at which the clock goes on by more than --max-step control steps."""
    held: bool = True
    """Drop a row whose action is that of the row before while a joint moves by 0.02 rad."""
    max_gap: int = 1
    """Largest step of the frame index."""
    max_step: float = 2.5
    """Longest step of the clock [control steps]."""


@dataclass(frozen=True)
class MergeOptions:
    """Write one dataset of several, in the order given."""

    out: Path = Path("merged")
    """Folder of the dataset, which must not exist yet."""


@dataclass(frozen=True)
class SplitOptions:
    """Write two sets: an episode's side depends on its seed alone, so that merged sets are split alike."""

    out_train: Path = Path("train")
    """Folder of the episodes to train on, which must not exist yet."""
    out_held_out: Path = Path("held_out")
    """Folder of the episodes held out, which must not exist yet."""
    fraction: float = 0.1
    """Probability that an episode is held out."""
    seed: int = 0
    """Another number draws other sides."""


@dataclass(frozen=True)
class StatsOptions:
    """Print length, jerk, stillness, final pose and tracking error, and rank the episodes unlike the others."""

    json: bool = False
    """Print one JSON array of all episodes, the most unusual first."""


@dataclass(frozen=True)
class InspectOptions:
    """Write one page that needs nothing else: figures, outliers, phases, curves and film strips."""

    out: Path = Path("episodes.html")
    """The page; one of that name is replaced."""
    episodes: int = 40
    """Most episodes in full, the most unusual ones; the table has all."""
    pictures: int = 10
    """Pictures of a film strip."""
    looks: int = 0
    """Rows of the same pictures under changed looks below each strip, of episodes that were recorded with --looks."""
