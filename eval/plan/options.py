"""Flags of the commands, as a user gives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from arena_newton.cli.flags import Several

__all__ = [
    "QUICK_REPEATS",
    "QUICK_SEEDS",
    "QUICK_TRACKERS",
    "CertifyOptions",
    "FilmOptions",
    "LoopOptions",
    "RecordOptions",
    "ReportOptions",
    "RunMergeOptions",
    "RunOptions",
    "is_quick",
]

QUICK_SEEDS = (0,)
"""Group seeds of the default run."""
QUICK_REPEATS = 3
"""Episodes per task and tracker of the default run, which takes about two minutes on two CPU cores."""
QUICK_TRACKERS = ("twist2", "sonic")
"""Trackers of the default run: those whose weights come with the package."""


@dataclass(frozen=True)
class RunOptions:
    """Evaluate a policy through a tracker on the seven tasks, and write tables and a report.

    Without --task, --mode, --seeds, --repeats, --until-width and --max-steps the experts solve all seven tasks through
    both trackers, a few episodes each (about two minutes on two CPU cores), a policy that sees does one of them where
    one comes with the package, and the report opens with film strips. As soon as one of them is given, the rest follows
    the benchmark's protocol: one tracker, 3 seeds x 20 repeats.
    """

    task: Several[str] = ()
    """Task names, or `all`: football double_desk pp_box open_door sit_sofa boxing vis_navi."""
    tracker: Several[str] = ()
    """Trackers that execute the 40D action, one or several: twist2 (when none is named) sonic pd ..."""
    checkpoint: str | None = None
    """Weights of the one tracker named: a .safetensors or official .onnx file (SONIC: a folder or two files with a
    comma between); those that come with the package when none is named."""
    policy: str = "expert"
    """Policy that decides it: expert, stand, learned (the one that comes with the package; learned:<folder of eval
    pack>), lerobot:<checkpoint or training>, replay:<clip, or actions of --actions>, replay:<LeRobot
    dataset>#<episode, or all>, remote:<url>."""
    labels: str | None = None
    """Protocol of the policy's actions: v3.1, or v4 for one that was trained on labels of v4; what the policy says of
    itself when none is named, and v3.1 where it says nothing."""
    replan: int | None = None
    """For --policy lerobot: execute only the first so many actions of each chunk, then look again."""
    ensemble: bool = False
    """For --policy lerobot: execute at each tick the mean of all chunks that cover it; looks every 2 ticks, or as
    --replan says."""
    latency_ticks: int = 0
    """Ticks of 0.02 s from a policy's look to the first action of its chunk; the chunk before goes on meanwhile."""
    mode: Several[str] = ()
    """Evaluation modes, one or several: base (when none is named) execution semantic visual."""
    rules: str = "paper"
    """Rule set: paper or released."""
    drive: str = "auto"
    """Gains of the joints' drives: auto (what rule set and tracker ask for), twist2, humanoidarena."""
    seeds: Several[int] = ()
    """Group seeds; the protocol's are 0 1 2."""
    repeats: int | None = None
    """Episodes per group seed; the protocol's are 20."""
    until_width: float | None = None
    """Instead of --repeats: play each task, tracker and mode until the 95 % interval of its success rate is as narrow,
    such as 0.14; looked at every 20 episodes, group seeds in turn."""
    max: int | None = None
    """With --until-width: episodes of each task, tracker and mode at most, 200 when not given."""
    worlds: int = 20
    """Episodes simulated at once."""
    engine: str = "auto"
    """Physics engine: mujoco (CPU), warp (CUDA or CPU), auto (warp where there is CUDA)."""
    device: str | None = None
    """Device of engine warp and of the networks: cpu, cuda, cuda:1; the best there is when none is named."""
    variant: str | None = None
    """USD file that replaces or extends the scene of the one task named."""
    fast_physics: bool = False
    """Run a 1 ms tracker at 5 ms x 4 substeps."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""
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
    record: bool = False
    """Write what a dataset is built of: an NPZ per episode and an MP4 per camera, one frame per tick, in episodes/."""
    record_cameras: tuple[str, ...] = ("front",)
    """Cameras of --record: front left_wrist right_wrist world; without a name after it, none."""
    record_size: str = "224x224"
    """Size of their pictures: 640x480 is the sensor's own shape, a square has black bars as policies see it [px]."""
    record_depth: bool = False
    """Write the depth of each picture too, float16 [m]; 100 MB per 1,000 ticks at 224x224 before compression."""
    viewer: str | None = None
    """Show the first 16 worlds while they run: viser (a page on this machine), rerun (its page), usd (<out>/viewer)."""
    viewer_port: int = 8080
    """TCP port of the viewer's page."""
    viewer_follow: bool = False
    """Let the page's camera go with the first robot."""
    viewer_real_time: bool = False
    """Hold the run back to real time while a viewer shows it."""
    viewer_failures: bool = False
    """Write a .viser recording of each episode that fails, to walk around in."""
    actions: bool = False
    """Write each episode's canonical actions, for --policy replay:<results>/actions through another tracker; of one
    tracker in a run."""
    failures: bool = False
    """Keep the signals that tell why an episode failed (docs/failures.md); looks at the head camera twice a second."""
    shard: str | None = None
    """Play part n of N of the plan, such as 3/16, into a folder of its own; `merge` joins them. slurm: the part of this
    task of a Slurm array; slurm/16 where the array has not all 16."""
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
    """With --ray: a slice of the plan, at most two batches of worlds, that takes longer is stopped and played again."""
    ray_attempts: int = 3
    """With --ray: an episode whose process died so often while it played nothing else ends as an error."""
    out: str | None = None
    """Results folder; results/<date>_<time> when none is named."""
    verbose: Annotated[bool, tyro.conf.arg(aliases=["-v"])] = False
    """Print the whole configuration."""
    accept_versions: bool = False
    """Continue a folder that was begun with other versions of the libraries; the journal then names both."""
    skip_broken: bool = False
    """When simulator or tracker break down as a whole, end the episodes that were running as errors and go on.
    Without it such a break stops the run and leaves them unplayed."""
    retry_errors: bool = False
    """On resume, run episodes again that ended with an error."""
    remote_timeout: float = 60.0
    """For --policy remote: deadline of a request with all its attempts [s]."""
    remote_retries: int = 4
    """For --policy remote: repeated attempts after a connection error, with pauses of 0.25, 0.5, 1 ... s."""
    remote_sequential: bool = False
    """For --policy remote: ask for one world after the other, in their order."""
    remote_insecure: bool = False
    """For --policy remote: do not check the certificate of an https server."""
    seeing: Annotated[bool, tyro.conf.Suppress] = False
    """Also play a few episodes of the policy that comes with the package (the default run)."""
    series: Annotated[int | None, tyro.conf.Suppress] = None
    """Series of demonstrations whose seeds are played instead of the evaluation's (`eval record`)."""
    keep: Annotated[int | None, tyro.conf.Suppress] = None
    """Successes to record of each task, tracker and mode; None: all episodes of the plan."""
    disturb: Annotated[bool, tyro.conf.Suppress] = False
    """Disturb what is executed; the recorded action is the policy's own."""
    disturb_scale: Annotated[float, tyro.conf.Suppress] = 1.0
    """Factor of the disturbance, beside that of each task (`TaskSpec.disturbance`)."""


def is_quick(options: RunOptions) -> bool:
    """Whether the flags leave the plan open: the default run over all tasks."""
    named = options.task or options.mode or options.seeds or options.series is not None
    return not named and (options.repeats, options.max_steps, options.until_width) == (None, None, None)


@dataclass(frozen=True)
class RecordOptions:
    """Record demonstrations: episodes as files, of which `python -m arena_newton.data build` makes a dataset.

    Seeds are of a range of their own, which no evaluation plays. `python -m arena_newton.eval resume <out>` continues.
    With --from FOLDER recorded episodes are played again, action by action, for more cameras.
    """

    task: Several[str] = ()
    """Task names, or `all`; all when none is named."""
    tracker: Several[str] = ()
    """Trackers that execute the 40D action: twist2 (when none is named) sonic ..."""
    checkpoint: str | None = None
    """Weights of the one tracker named; those that come with the package when none are named."""
    policy: str = "expert"
    """Policy that is recorded."""
    mode: Several[str] = ()
    """Modes: base (when none is named) execution semantic visual."""
    rules: str = "paper"
    """Rule set: paper or released."""
    drive: str = "auto"
    """Gains of the joints' drives: auto, twist2, humanoidarena."""
    episodes: int = 100
    """Episodes of each task, tracker and mode."""
    only_success: bool = False
    """Keep so many successes, with at most twice as many attempts; what fails is counted and not kept."""
    disturb: bool = True
    """Add slow noise to what is executed, not to the recorded action, so that recoveries are recorded."""
    disturb_scale: float = 1.0
    """Factor of the noise, beside that of each task (0.5 in pp_box and double_desk, which grasp; 1 in the others)."""
    seed_series: int = 0
    """Number of the series of seeds: another one gives other episodes."""
    cameras: tuple[str, ...] = ("front",)
    """Cameras: front left_wrist right_wrist world; without a name after it, none."""
    size: str = "224x224"
    """Size of the pictures: 640x480 is the sensor's own shape, a square has black bars as policies see it [px]."""
    depth: bool = False
    """Write the depth of each picture too, float16 [m]."""
    worlds: int = 20
    """Episodes simulated at once."""
    engine: str = "auto"
    """Physics engine: mujoco (CPU), warp (CUDA or CPU), auto (warp where there is CUDA)."""
    device: str | None = None
    """Device of engine warp and of the networks: cpu, cuda, cuda:1."""
    variant: str | None = None
    """USD file that replaces or extends the scene of the one task named."""
    fast_physics: bool = False
    """Run a 1 ms tracker at 5 ms x 4 substeps."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""
    shard: str | None = None
    """Record part n of N of the plan, such as 3/16 or slurm, into a folder of its own; not with --only-success."""
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
    """With --ray: a slice of the plan, at most two batches of worlds, that takes longer is stopped and played again."""
    ray_attempts: int = 3
    """With --ray: an episode whose process died so often while it played nothing else ends as an error."""
    out: str | None = None
    """Folder; results/<date>_<time> when none is named."""
    verbose: Annotated[bool, tyro.conf.arg(aliases=["-v"])] = False
    """Print the whole configuration."""
    source: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Play the recorded episodes of this folder again, and write them with these cameras to --out."""
    accept_differences: bool = False
    """With --from: go on although code, tracker, rules or scene are not those of the recording."""


@dataclass(frozen=True)
class LoopOptions:
    """Record demonstrations, build a dataset, train a policy, evaluate it, and report: the whole loop in one command.

    Each stage resumes: after an interruption the same command continues, and what is finished is not repeated.
    """

    task: tuple[str, ...] = ("vis_navi",)
    """Tasks, which one policy learns together."""
    tracker: str = "twist2"
    """Tracker that records and executes."""
    policy: str = "act"
    """Family: act, diffusion, flow or pi05."""
    recipe: str | None = None
    """Settings of the training: fast (when none is named), paper, released, compact."""
    minutes: float | None = None
    """Time of the training [min]; the schedule is fitted to it. The recipe's number of steps when none is given."""
    steps: int | None = None
    """Optimizer steps instead of the recipe's."""
    episodes: int | None = None
    """Successes to record of each task: 100, or 3 episodes under --small."""
    repeats: int | None = None
    """Episodes of the evaluation for each of the group seeds 0 1 2: 20, or 1 under --small."""
    seed: int = 0
    """Seed of the training, and series of the recorded seeds."""
    worlds: int | None = None
    """Episodes simulated at once: 100 on CUDA and 20 on the CPU when none is given."""
    engine: str = "auto"
    """Physics engine: mujoco (CPU), warp (CUDA or CPU), auto (warp where there is CUDA)."""
    device: str | None = None
    """Device of engine, networks and training: cpu, cuda, cuda:1."""
    size: str | None = None
    """Size of the recorded pictures, which is what the policy sees: 224x224, or 64x64 under --small [px]."""
    max_steps: int | None = None
    """Cap on the step budget of the rule set [ticks of 0.02 s]."""
    weights: str | None = None
    """Pretrained weights for the training: a name on the hub or a local folder."""
    small: bool = False
    """A loop for tests of the machinery: few episodes, small pictures, the recipe `small`; it learns nothing."""
    out: str | None = None
    """Folder; results/loop_<tasks>_<tracker>_<policy>_<recipe> when none is named."""


@dataclass(frozen=True)
class ReportOptions:
    """Write tables and reports of a results folder again from its journal; of several folders print one table."""

    table: bool = False
    """Print a table of successes per task, tracker and mode as Markdown, and write nothing."""
    json: bool = False
    """Print results.json instead of the table."""
    own_tracker: str | None = None
    """Of a swapped run with --failures and --actions: first play its actions through this tracker, the one that the
    policy was trained with, into <out>/own; the report then says how many failures succeed so."""


@dataclass(frozen=True)
class RunMergeOptions:
    """Join the folders of shards into one results folder, as if one machine had played the plan.

    Recordings are copied, tables and report are written from the joined journal. Nothing in the shards changes.
    """

    out: str | None = None
    """Folder to write; it must be new."""
    partial: bool = False
    """Join what there is although shards are missing or unfinished; `resume <out>` plays the rest."""
    accept_versions: bool = False
    """Join shards that were played with other versions of the libraries; the folder then names all."""


@dataclass(frozen=True)
class FilmOptions:
    """Show one success per task of one or several results folders in a single film or picture."""

    out: str = "film.webp"
    """File to write: .webp, .gif or .mp4 is a film of the world videos side by side (run --video), .jpg or .png the
    world strips one below the other (run --strip)."""
    seconds: float = 12.0
    """Length of the film [s]; every episode is played from its start to its end in it."""
    width: int = 960
    """Width of the film or picture [px]."""
    max_mb: float = 3.0
    """Largest size of a .webp film [MB]; its quality is lowered until it fits."""


@dataclass(frozen=True)
class CertifyOptions:
    """Measure what the benchmark claims of itself: solvable tasks that need legs, clean axes, engines that agree.

    The tasks' experts play in all checks but policy-inputs, execution, physics, camera and statistics. Exit code 0: no
    check fails; 1: one fails; 2: bad input.
    """

    out: str = "results/certify"
    """Folder of the certificate and of the evaluations behind it."""
    quick: bool = False
    """A few episodes of everything by two processes: minutes instead of hours, and wide intervals."""
    task: Several[str] = ()
    """Tasks; all that have an expert when none is named."""
    tracker: tuple[str, ...] = ("twist2", "sonic")
    """Trackers, with the weights they come with; the first one alone where one is enough."""
    checks: Several[str] = ()
    """Names of checks to run: journal recording solvable policy-inputs tracker-inputs frozen-legs gliding-base visual
    semantic execution physics camera rules engines batches official shards ray swap visible sill failures statistics
    gradients; all when none is named."""
    episodes: int | None = None
    """Episodes of each cell: 60, the protocol's, or 2 under --quick."""
    worlds: int = 20
    """Episodes simulated at once."""
    engine: str = "mujoco"
    """Physics engine: mujoco (CPU), warp (CUDA or CPU), auto (warp where there is CUDA)."""
    device: str | None = None
    """Device of engine warp and of the networks: cpu, cuda, cuda:1."""
    twist2_checkpoint: str | None = None
    """Official TWIST2 checkpoint (.onnx), to compare our weights with."""
    jobs: int = 1
    """Processes that play at once, each on cores of its own, 2 under --quick (0: only play and write no page, as each
    of them does)."""
    resume: bool = False
    """Continue a certification in its folder; what was played is kept."""
