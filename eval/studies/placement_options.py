"""Flags of the commands that choose placements themselves."""

from __future__ import annotations

from dataclasses import dataclass

from arena_newton.cli.flags import Several

__all__ = ["AdversaryOptions", "PlacementOptions", "SensitivityOptions"]


@dataclass(frozen=True)
class PlacementOptions:
    """Options of the episodes at every placement."""

    task: str = ""
    """Task whose placements are moved."""
    policy: str = "expert"
    """Policy: expert, stand, learned, lerobot:<checkpoint or training>, remote:<url> ..."""
    tracker: str = "twist2"
    """Tracker that executes the 40D action."""
    checkpoint: str | None = None
    """Its weights; those that come with the package when none are named."""
    mode: str = "base"
    """Mode whose ranges are searched: base, execution (wider), semantic, visual."""
    rules: str = "paper"
    """Rule set: paper or released."""
    axes: Several[str] = ()
    """Numbers that are moved, such as football.x football.y; the seeds draw the others. An unknown name lists all."""
    seed: int = 0
    """Group seed of what is drawn; the same seeds are played at every placement."""
    repeats: int = 1
    """Episodes, with one seed each, at every placement."""
    worlds: int = 20
    """Episodes simulated at once."""
    engine: str = "auto"
    """Physics engine: mujoco (CPU), warp (CUDA or CPU), auto (warp where there is CUDA)."""
    device: str | None = None
    """Device of engine warp and of the networks: cpu, cuda, cuda:1."""
    fast_physics: bool = False
    """Run a 1 ms tracker at 5 ms x 4 substeps."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""
    labels: str | None = None
    """Protocol of the policy's actions: v3.1 or v4; what the policy says of itself when none is named."""
    replan: int | None = None
    """For --policy lerobot: execute only the first so many actions of each chunk, then look again."""
    ensemble: bool = False
    """For --policy lerobot: execute at each tick the mean of all chunks that cover it."""
    latency_ticks: int = 0
    """Ticks from a policy's look to the first action of its chunk."""


@dataclass(frozen=True)
class SensitivityOptions(PlacementOptions):
    """Map success and margin of a policy over the placements of a task: a grid over one or two numbers.

    At every point the same seeds are played (common random numbers), so that neighbours differ by the placement alone.
    Needs the extra [plots].
    """

    grid: tuple[int, ...] = (7, 7)
    """Points along each axis, the ends of its range among them."""
    out: str | None = None
    """Folder to write, which must not exist; results/sensitivity_<task>_<tracker>_<mode> when none is named."""


@dataclass(frozen=True)
class AdversaryOptions(PlacementOptions):
    """Search the placement of a task at which a policy does worst, and report it beside the mean over the range.

    The cross-entropy method on margins: batches of placements, all played at once; on CUDA thousands of worlds.
    """

    batch: int = 60
    """Placements of a batch; the first is drawn from the whole range and gives the mean."""
    batches: int = 5
    """Batches, each drawn where the ones before did worst."""
    confirm: int = 10
    """Episodes with new seeds at the placement that was found worst."""
    search_seed: int = 0
    """Seed of the search itself."""
    out: str | None = None
    """Folder to write, which must not exist; results/adversary_<task>_<tracker>_<mode> when none is named."""
