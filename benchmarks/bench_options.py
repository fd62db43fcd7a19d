"""Flags of the benches; nothing heavy is loaded here."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from arena_newton.cli.flags import Device, Several, bounds
from arena_newton.eval.plan.options import QUICK_TRACKERS

__all__ = [
    "CameraBenchOptions",
    "DatasetBenchOptions",
    "ForgeryOptions",
    "GradientBenchOptions",
    "AuditTimeOptions",
    "DeviceOptions",
    "HonestOptions",
    "MistakesOptions",
    "ProcessorOptions",
    "PeerOptions",
    "PlainBenchOptions",
    "PolicyBenchOptions",
    "RecordingBenchOptions",
    "RoundsBenchOptions",
    "ServerBenchOptions",
    "TrainingBenchOptions",
]


@dataclass(frozen=True)
class PlainBenchOptions:
    """Measure, and judge by a bar where there is one; exit code 1 when one is missed."""

    json: bool = False
    """Print one JSON array instead of lines."""


@dataclass(frozen=True)
class RoundsBenchOptions(PlainBenchOptions):
    """Measure in rounds, of which the median is taken."""

    rounds: int = 20
    """Rounds."""


@dataclass(frozen=True)
class CameraBenchOptions(RoundsBenchOptions):
    """Measure pictures of the head camera per second."""

    worlds: int = 1024
    """Worlds on CUDA."""


@dataclass(frozen=True)
class PolicyBenchOptions(PlainBenchOptions):
    """Measure the episodes of a policy that sees, and what part of them each step of a tick takes."""

    checkpoint: str | None = None
    """Checkpoint; one of `--family` of full size with random weights when none is named."""
    family: str = "act"
    """Family of those random weights: act, diffusion, flow or pi05 (4 billion, which takes minutes to make)."""
    tasks: tuple[str, ...] = ("vis_navi", "boxing")
    """Tasks."""
    episodes: int = 0
    """Episodes, all at once; 0: 60 on CUDA, for which the figures to reach are, and 2 on the CPU."""
    steps: int = 0
    """Ticks of an episode at most; 0: what the rules or the length of usual successes say."""
    twist2: str | None = None
    """Weights of TWIST2; those that come with the package when none are named."""


@dataclass(frozen=True)
class RecordingBenchOptions(PlainBenchOptions):
    """Measure the recording of demonstrations: with pictures, without them, and without a recorder."""

    episodes: int = 2
    """Episodes; the figure to reach is for 100 VisNavi ones."""
    worlds: int = 2
    """Worlds; 100 on CUDA for the figure to reach."""
    size: str = "224x224"
    """Size of the pictures [px]."""
    task: str = "vis_navi"
    """Task."""


@dataclass(frozen=True)
class TrainingBenchOptions(PlainBenchOptions):
    """Measure steps/s of trainings: alone, and several at once on one device."""

    policy: str = "act"
    """Family: act, diffusion, flow or pi05."""
    recipe: str = "fast"
    """Settings, as of a training."""
    dataset: Several[Path] = ()
    """Datasets; without them pictures are made up."""
    frames: int = field(default=20_000, metadata=bounds(100, 10_000_000))
    """Pictures that are made up."""
    trainings: tuple[int, ...] = (1, 2, 4)
    """Numbers of trainings at once."""
    seconds: float = field(default=20.0, metadata=bounds(0.1, 3600.0))
    """Time of each measurement [s], after the warm-up."""
    batch_size: int = field(default=0, metadata=bounds(0, 65536))
    """Samples of a step; 0: the recipe's."""
    device: Device[str] = "auto"
    weights: str = ""
    """Pretrained weights, as of a training."""
    looks: float = field(default=0.0, metadata=bounds(0.0, 1.0))
    """Fraction of the samples whose looks are changed; without datasets shapes and lights are made up."""
    graph: bool = True
    """Capture batch and step in one CUDA graph, on CUDA."""
    compile: bool = False
    """Compile the network with torch.compile; not for pi05."""
    against_lerobot: bool = False
    """Measure LeRobot's own loop too, its data loader on the dataset; needs --dataset."""
    workers: int = field(default=4, metadata=bounds(0, 256))
    """Processes of LeRobot's data loader."""


@dataclass(frozen=True)
class DatasetBenchOptions(PlainBenchOptions):
    """Measure how fast a dataset is read in random order, and how long it takes to build and to verify."""

    dataset: Path | None = None
    """Dataset to read."""
    reads: int = 2000
    """Pictures that each reader reads."""
    recordings: Several[Path] = ()
    """Folders of recorded episodes: they are built and verified once more, and the time is measured."""
    made: int = 0
    """Number of copies of the recordings under other seeds that are built, verified and read instead of --dataset."""
    seed: int = 0
    """Seed of the order in which pictures are read."""


@dataclass(frozen=True)
class ServerBenchOptions(PlainBenchOptions):
    """Measure what clients with the largest pictures cost the other clients of a policy server."""

    protocol: str = "openpi"
    """Protocol: openpi, which sends pictures as they are, or vla-eval, which packs them."""
    normal: int = 170
    """Clients that ask every two seconds with a picture of 224 x 224."""
    large: int = 30
    """Clients that ask without a pause with one of 1920 x 1200."""
    seconds: float = 20.0
    """Length of each of the three phases: without, with and again without those [s]."""


@dataclass(frozen=True)
class PeerOptions(PlainBenchOptions):
    """Measure this product next to other programs, each pair in one run on one machine."""

    what: tuple[str, ...] = ("all",)
    """Pairs: tick world_ticks act_training tracker_training lerobot_eval camera, or `all`."""
    rounds: int = 20
    """Rounds of `tick`, `world_ticks` and `camera`; the median of their ratios is judged."""
    long_rounds: int = 3
    """Rounds of `tracker_training` and `lerobot_eval`."""
    twist2: str | None = None
    """Weights of TWIST2 for `tick` and `world_ticks`; those that come with the package when none are named."""
    worlds: int = 4096
    """Worlds of `world_ticks` on CUDA."""
    dataset: str | None = None
    """Dataset of `act_training`, read by both sides."""
    mjlab_python: str | None = None
    """Interpreter that has mjlab, for `tracker_training`."""
    training_worlds: Several[int] = ()
    """Worlds of `tracker_training`; 4096 and 8192 on CUDA, 4 on the CPU when none are named."""
    iterations: int = 10
    """Iterations of PPO in a round of `tracker_training`."""
    checkpoint: str | None = None
    """Checkpoint of `lerobot_eval`; the policy that comes with the package when none is named."""
    episodes: int = 0
    """Episodes of `lerobot_eval`, all at once; 0: 60 on CUDA, 2 on the CPU."""
    steps: int = 0
    """Cap on the ticks of an episode of `lerobot_eval`; 0: what the rules say."""
    camera_worlds: int = 1024
    """Worlds of `camera` on CUDA."""
    size: int = 224
    """Width and height of the pictures of `camera` [px]."""
    history: str | None = None
    """File to which each pair that was measured is appended as a JSON line."""


@dataclass(frozen=True)
class ForgeryOptions(PlainBenchOptions):
    """Forge a results folder in some seventy ways, and say at which level `eval audit` finds each."""

    folder: str = ""
    """Honest folder of a run on engine mujoco; copies are forged."""
    policy: str | None = None
    """Policy of the folder, to be asked again."""


@dataclass(frozen=True)
class AuditTimeOptions(PlainBenchOptions):
    """Measure how long an audit takes, and say how probably it finds a forged line."""

    folder: str = ""
    """Honest folder of a run on engine mujoco."""
    replay: int = 60
    """Episodes that are played again; 0: none."""


@dataclass(frozen=True)
class ProcessorOptions(PlainBenchOptions):
    """Replay a folder with other vector instructions and numbers of threads than the run's, and say what changes."""

    folder: str = ""
    """Honest folder of a run on engine mujoco; all of its episodes are played again in each row."""
    policy: str | None = None
    """Policy of the folder, to be asked again."""


@dataclass(frozen=True)
class DeviceOptions(PlainBenchOptions):
    """Record experts on engine warp, and measure what an audit on engine mujoco allows for: ticks and pictures."""

    device: Device[str] | None = None
    """Device of engine warp: the best there is when none is named; on the CPU it takes minutes."""
    tasks: Several[str] = ("football", "pp_box")
    """Tasks."""
    episodes: int = field(default=2, metadata=bounds(1, 10_000))
    """Episodes of each."""
    max_steps: int | None = None
    """Cap on their step budget [ticks]."""


@dataclass(frozen=True)
class HonestOptions(PlainBenchOptions):
    """Play honest folders of many kinds, each a run of its own, and count those that an audit accuses."""

    count: int = field(default=500, metadata=bounds(1, 100_000))
    """Folders."""
    replay_every: int = field(default=3, metadata=bounds(1, 100_000))
    """Folders of which one has two episodes played again too."""
    seed: int = 0
    """Number by which kinds and flags are drawn."""


@dataclass(frozen=True)
class GradientBenchOptions(PlainBenchOptions):
    """Compare exact slopes of engine mujoco with finite differences, in states of the experts' episodes."""

    what: tuple[str, ...] = ("all",)
    """Figures: ticks, closed loops, replay of whole episodes, reach of slopes through a kick, featherstone (Newton's
    solver with its tape, on CUDA where there is one), flights (the ball of `ball_flight` next to the engine's),
    transition (MuJoCo's `mjd_transitionFD` next to a converged solver's), or `all`."""
    tasks: Several[str] = ()
    """Tasks; all that have an expert when none are named."""
    trackers: Several[str] = QUICK_TRACKERS
    """Trackers, whose drives differ."""
    states: int = field(default=20, metadata=bounds(2, 10_000))
    """States of each task and tracker."""
    loops: Several[str] = ("vis_navi", "sit_sofa", "football")
    """Tasks of closed loops and replays: the experts walk, sit down, and kick."""
    episodes: int = field(default=1, metadata=bounds(1, 1000))
    """Episodes of each task that are replayed."""
    step: float = 1e-6
    """Step of the differences of a tick or a closed loop."""
    limit: float = field(default=300.0, metadata=bounds(1.0, 86_400.0))
    """Time after which featherstone is left, by the clock [s]: nearly all of it is compilation, which goes on beside
    what comes after it."""


@dataclass(frozen=True)
class MistakesOptions(PlainBenchOptions):
    """Plant mistakes of sign, order, frame and scale in a tracker on the CPU, and count those that `--stand` finds."""

    tracker: str = "twist2"
    """Tracker with a front end, by name."""
    checkpoint: str | None = None
    """Its weights; those that it comes with when none are named."""
