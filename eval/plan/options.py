"""Flags of a run and of a recording, as a user gives them, and the groups of flags that other commands share.

A command's dataclass inherits the groups that it has, the last one of its `--help` first: fields of a dataclass stand
in the order of its bases from the last to the first, then its own.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated

import tyro

from arena_newton.cli.flags import Device, Engine, Several
from arena_newton.policies.chunk_flags import ChunkFlags

__all__ = [
    "QUICK_REPEATS",
    "QUICK_SEEDS",
    "QUICK_TRACKERS",
    "Batch",
    "Chunks",
    "Conditions",
    "Jobs",
    "Ray",
    "RecordOptions",
    "Recording",
    "Remote",
    "RunOptions",
    "Stepping",
    "Viewer",
    "Workers",
    "flags_of",
    "is_quick",
]

QUICK_SEEDS = (0,)
"""Group seeds of the default run."""
QUICK_REPEATS = 3
"""Episodes per task and tracker of the default run, whose experts take about two minutes on two CPU cores."""
QUICK_TRACKERS = ("twist2", "sonic")
"""Trackers of the default run: those whose weights come with the package."""


def flags_of(group: type) -> tuple[str, ...]:
    """Names of a group's fields."""
    return tuple(one.name for one in dataclasses.fields(group))


@dataclass(frozen=True)
class Tested:
    """Tasks, and the trackers and the policy that do them."""

    task: Several[str] = ()
    """Task names, or `all`, the paper's: football double_desk pp_box open_door sit_sofa boxing vis_navi."""
    tracker: Several[str] = ()
    """Trackers that execute the 40D action, one or several: twist2 (when none is named) sonic pd ..."""
    checkpoint: str | None = None
    """Weights of the one tracker named: a .safetensors or official .onnx file (SONIC: a folder or two files with a
    comma between); those that come with the package when none is named."""
    policy: str = "expert"
    """Policy that decides it: expert, stand, learned (the one that comes with the package; learned:<folder of eval
    pack>), lerobot:<checkpoint or training>, replay:<clip, or actions of a run>, replay:<LeRobot
    dataset>#<episode, or all>, remote:<url>, process:<command>."""


@dataclass(frozen=True)
class Chunks(ChunkFlags):
    """Execution of a policy's chunks."""

    latency_ticks: int = 0
    """Ticks of 0.02 s from a policy's query to the first action of its chunk; the chunk before goes on meanwhile."""


@dataclass(frozen=True)
class Conditions:
    """Conditions under which tasks are done."""

    mode: Several[str] = ()
    """Evaluation modes, one or several: base (when none is named) execution semantic visual, dynamics, and the held-out
    looks semantic-2 semantic-3. Modes with one scene (base execution visual dynamics) play in one batch of worlds.
    base+push=0.5+gyro_noise=0..0.2 adds a push, noise of sensors, latency, friction ... (docs/reference/rules.md)."""
    rules: str = "paper"
    """Rule set: paper or released."""
    drive: str = "auto"
    """Gains of the joints' drives: auto (what rule set and tracker ask for), twist2, humanoidarena."""
    variant: str | None = None
    """USD file that replaces or extends the scene of the one task named."""


@dataclass(frozen=True)
class Batch:
    """Worlds, and what simulates them."""

    worlds: int = 20
    """Episodes simulated at once."""
    engine: Engine = "auto"
    device: Device[str | None] = None


@dataclass(frozen=True)
class Stepping:
    """Rate and length of the simulation."""

    fast_physics: bool = False
    """Run a 1 ms tracker at 5 ms x 4 substeps."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""


@dataclass(frozen=True)
class Pictures:
    """Videos and film strips."""

    video: bool = False
    """Write ego and world videos (H.264 MP4), one pair per episode."""
    strip: bool = False
    """Write the 10-frame picture strip of each episode; the default run always does, and follows the robot."""
    video_episodes: int | None = None
    """Videos of only the first so many episodes of each task, tracker and mode; of all when not given."""
    video_size: str | None = None
    """Size of the world camera's pictures, such as 960x540 [px]."""
    follow: bool = False
    """Let the world camera follow the robot."""


@dataclass(frozen=True)
class Recording:
    """Episodes as files of which datasets are built."""

    record: bool = False
    """Write what a dataset is built of: an NPZ per episode and an MP4 per camera, one frame per tick, in episodes/."""
    record_cameras: tuple[str, ...] = ("front",)
    """Cameras of --record: front left_wrist right_wrist world; without a name after it, none."""
    record_size: str = "224x224"
    """Size of their pictures: 640x480 is the sensor's own shape, a square has black bars as policies see it [px]."""
    record_depth: bool = False
    """Write the depth of each picture too, float16 [m]; 100 MB per 1,000 ticks at 224x224 before compression."""
    record_looks: int = 0
    """Write what every fourth picture shows and its light under so many second lights, 1 or 2
    (docs/howto/train/recording.md)."""


@dataclass(frozen=True)
class Viewer:
    """Worlds shown while they run."""

    viewer: str | None = None
    """Show the first 16 worlds while they run: viser (a page on this machine), rerun (its page), usd (<out>/viewer)."""
    viewer_port: int = 8080
    """TCP port of the viewer's page."""
    viewer_follow: bool = False
    """Let the page's camera go with the first robot."""
    viewer_real_time: bool = False
    """Hold the run back to real time while a viewer shows it."""


@dataclass(frozen=True)
class Ray:
    """Processes of a cluster."""

    ray: tuple[str, ...] | None = None
    """Let processes of a Ray cluster play, and keep the journal here: its address, such as 10.0.0.1:6379, or auto; with
    no address, a Ray of its own on this machine."""
    ray_actors: int | None = None
    """With --ray: processes that play at once; as many as the cluster has room for when not given."""
    ray_cpus: int | None = None
    """With --ray: cores of each of them; 4, or all of the smallest node where it has fewer, when not given."""
    ray_gpus: float | None = None
    """With --ray: GPUs of each of them, such as 0.5 for two on one GPU; 1 when not given, none on engine mujoco."""
    ray_minutes: float = 60.0
    """With --ray: a batch of episodes, at most twice --worlds, that takes longer is stopped and played again."""
    ray_attempts: int = 3
    """With --ray: an episode whose process died so often while it played nothing else ends as an error."""


@dataclass(frozen=True)
class Jobs:
    """Processes of this machine."""

    jobs: int = 1
    """Processes of this machine that play at once, each on cores of its own; they take its GPUs in turn. The default
    run takes two where there are two cores and no GPU."""


@dataclass(frozen=True)
class Workers(Ray, Jobs):
    """Other processes that play."""

    @property
    def dealt(self) -> bool:
        """True if this process deals episodes out to others and plays none."""
        return self.ray is not None or self.jobs > 1


@dataclass(frozen=True)
class Output:
    """Part of the plan, folder and what is printed."""

    shard: str | None = None
    """Play part n of N of the plan, such as 3/16, into a folder of its own; `merge` joins them. slurm: the part of this
    task of a Slurm array; slurm/16 where the array has not all 16."""
    out: str | None = None
    """Results folder; results/<date>_<time> when none is named."""
    verbose: Annotated[bool, tyro.conf.arg(aliases=["-v"])] = False
    """Print the whole configuration."""


@dataclass(frozen=True)
class Remote:
    """Requests to a policy server."""

    remote_timeout: float = 60.0
    """For --policy remote and process: deadline of a request with all its attempts [s]."""
    remote_retries: int = 4
    """For --policy remote: repeated attempts after a connection error, with pauses of 0.25, 0.5, 1 ... s."""
    remote_sequential: bool = False
    """For --policy remote: ask for one world after the other, in their order."""
    remote_insecure: bool = False
    """For --policy remote: do not check the certificate of an https server."""

    @staticmethod
    def names_for(policy: str) -> tuple[str, ...]:
        """Names of the flags that belong to a policy, which its spec names."""
        return {"remote": flags_of(Remote), "process": ("remote_timeout",)}.get(policy.partition(":")[0], ())


@dataclass(frozen=True)
class _Plan:
    """Episodes of an evaluation."""

    seeds: Several[int] = ()
    """Group seeds; the protocol's are 0 1 2."""
    repeats: int | None = None
    """Episodes per group seed; the protocol's are 20."""
    until_width: float | None = None
    """Instead of --repeats: play each task, tracker and mode until the 95 % interval of its success rate is as narrow,
    such as 0.14; looked at every 20 episodes, group seeds in turn."""
    max: int | None = None
    """With --until-width: episodes of each task, tracker and mode at most, 200 when not given."""


@dataclass(frozen=True)
class RunOptions(
    Remote, Output, Workers, Viewer, Recording, Pictures, Stepping, Batch, _Plan, Conditions, Chunks, Tested
):
    """Evaluate a policy through a tracker on tasks, and write tables and a report.

    Without --task, --mode, --seeds, --repeats, --until-width and --max-steps the experts solve the paper's seven tasks
    through both trackers, a few episodes each (about two minutes on two CPU cores), the policy that comes with the
    package, if one does, solves those that its card names through the first of them, and the report opens with film
    strips. As soon as one of these flags is given, the rest follows the benchmark's protocol: one tracker, 3 seeds x 20
    repeats.
    """

    recorder: Several[str] = ()
    """Recorders of other packages (entry points `arena_newton.recorders`), whose metrics are in journal and tables."""
    viewer_failures: bool = False
    """Write a .viser recording of each episode that fails, to walk around in."""
    actions: bool = True
    """Write each episode's canonical actions (about 50 kB), for --policy replay:<results>/actions through another
    tracker; in a run of several trackers actions/<tracker>."""
    failures: bool = False
    """Keep the signals that tell why an episode failed (docs/concepts/failures.md); looks at the head camera
    twice a second."""
    accept_versions: bool = False
    """Continue a folder that was begun with other versions of the libraries; the journal then names both."""
    skip_broken: bool = False
    """End the running episodes as errors and go on when simulator or tracker break down as a whole.
    Without it such a break stops the run and leaves them unplayed."""
    retry_errors: bool = False
    """On resume, run episodes again that ended with an error."""
    series: Annotated[int | None, tyro.conf.Suppress] = None
    """Series of demonstrations whose seeds are played instead of the evaluation's (`eval record`)."""
    keep: Annotated[int | None, tyro.conf.Suppress] = None
    """Successes to record of each task, tracker and mode; None: all episodes of the plan."""
    disturb: Annotated[bool, tyro.conf.Suppress] = False
    """Disturb what is executed; the recorded action is the policy's own."""
    disturb_scale: Annotated[float, tyro.conf.Suppress] = 1.0
    """Factor of the disturbance, beside that of each task (`TaskSpec.disturbance`)."""


def is_quick(options: RunOptions) -> bool:
    """True if the flags leave the plan open: the default run over all tasks."""
    named = options.task or options.mode or options.seeds or options.series is not None
    return not named and (options.repeats, options.max_steps, options.until_width) == (None, None, None)


@dataclass(frozen=True)
class _Demonstrations:
    """Number and kind of demonstrations."""

    episodes: int = 100
    """Episodes of each task, tracker and mode."""
    only_success: bool = False
    """Keep so many successes, with at most twice as many attempts; what fails is counted and not kept."""
    disturb: bool = True
    """Add slow noise to what is executed, not to the recorded action, so that recoveries are recorded."""
    disturb_scale: float = 1.0
    """Factor of the noise, beside that of each task (0.5 in pp_box and double_desk, 2 in boxing, 1 in others)."""
    seed_series: int = 0
    """Number of the series of seeds: another one gives other episodes."""
    cameras: tuple[str, ...] = ("front",)
    """Cameras: front left_wrist right_wrist world; without a name after it, none."""
    size: str = "224x224"
    """Size of the pictures: 640x480 is the sensor's own shape, a square has black bars as policies see it [px]."""
    depth: bool = False
    """Write the depth of each picture too, float16 [m]."""
    looks: int = 0
    """Write what every fourth picture shows and its light under so many second lights, 1 or 2, so that a training can
    change its looks (docs/howto/train/recording.md)."""


@dataclass(frozen=True)
class RecordOptions(Output, Workers, Stepping, Batch, _Demonstrations, Conditions, Tested):
    """Record demonstrations: episodes as files, of which `python -m arena_newton.data build` makes a dataset.

    Seeds are of a range of their own, which no evaluation plays. `python -m arena_newton.eval resume <out>` continues.
    With --from FOLDER recorded episodes are played again, action by action, for more cameras.
    """

    source: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Play the recorded episodes of this folder again, and write them with these cameras to --out."""
    accept_differences: bool = False
    """With --from: go on although code, tracker, rules or scene are not those of the recording."""
