"""Flags of a run, what they resolve to, and the hash that a results folder is known by."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

import arena_newton
from arena_newton import __version__
from arena_newton.errors import InputError
from arena_newton.eval.records import is_printable, plain_text

if TYPE_CHECKING:
    from arena_newton.eval.plan import Episode

__all__ = [
    "DRIVES",
    "QUICK_MAX_STEPS",
    "QUICK_REPEATS",
    "RunConfig",
    "RunOptions",
    "code_files",
    "code_hash",
    "config_hash",
    "differing_key",
    "episodes",
    "explicit",
    "hash_path",
    "is_quick",
    "moving_versions",
    "own_code",
    "policy_label",
    "resolve",
    "scene_files",
]

POLICY_PATH_SCHEMES = ("replay",)
DRIVES = ("auto", "twist2", "humanoidarena")
"""Drive gains of --drive; `auto` is what rule set and tracker ask for."""

PACKAGE = Path(arena_newton.__file__).resolve().parent
UNHASHED = (
    "eval/__main__.py",
    "eval/bench.py",
    "eval/config.py",
    "eval/engines.py",
    "eval/html_report.py",
    "eval/journal.py",
    "eval/original_format.py",
    "eval/progress.py",
    "eval/records.py",
    "eval/report.py",
    "eval/stats.py",
    "trackers/evaluate.py",
    "trackers/oracle.py",
    "trackers/evaluation",
    "trackers/train",
)
"""Code that prepares, tells or measures but moves and judges no episode of a run. All other code counts, whatever is
added to the package."""
UNVERSIONED = ("arena-newton", "av", "matplotlib", "rsl-rl-lib", "tqdm", "tyro")
"""Distributions that move and judge no episode; the versions of all others must not change within a results folder."""


QUICK_SEEDS = (0,)
QUICK_REPEATS = 4
"""Repeats of the default look at all seven tasks, sized to end within two minutes on a bare CPU."""
QUICK_MAX_STEPS = 250
"""Step cap of that look [ticks of 0.02 s]."""


@dataclass(frozen=True)
class RunOptions:
    """Evaluate a policy through a tracker on the seven tasks, and write tables and a report.

    Without --task, --mode, --seeds, --repeats and --max-steps a quick look at all seven tasks runs (about two minutes
    on a CPU). As soon as one of them is given, the rest follows the benchmark's protocol: 3 seeds x 20 repeats.
    """

    task: tuple[str, ...] = ()
    """Task names, or `all`: football double_desk pp_box open_door sit_sofa boxing vis_navi."""
    tracker: str = "twist2"
    """Tracker that executes the 40D action: twist2, sonic, pd, ..."""
    checkpoint: str | None = None
    """The tracker's weights: a .safetensors or official .onnx file (SONIC: a folder or two files with a comma between);
    those that come with the package when none is named."""
    policy: str = "stand"
    """Policy that decides it: stand, expert, replay:<clip, or actions of --actions>, remote:<url>."""
    mode: tuple[str, ...] = ()
    """Evaluation modes, one or several: base (when none is named) execution semantic visual."""
    rules: str = "paper"
    """Rule set: paper or released."""
    drive: str = "auto"
    """Gains of the joints' drives: auto (what rule set and tracker ask for), twist2, humanoidarena."""
    seeds: tuple[int, ...] = ()
    """Group seeds; the protocol's are 0 1 2."""
    repeats: int | None = None
    """Episodes per group seed; the protocol's are 20."""
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
    """Write the 10-frame picture strip of each episode."""
    video_episodes: int | None = None
    """Videos of only the first so many episodes of each task and mode; of all when not given."""
    video_size: str | None = None
    """Size of the world camera's pictures, such as 960x540 [px]."""
    follow: bool = False
    """Let the world camera follow the robot."""
    actions: bool = False
    """Write each episode's canonical actions, for --policy replay:<results>/actions through another tracker."""
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


@dataclass(frozen=True)
class RunConfig:
    """A validated, fully resolved run."""

    tasks: tuple[str, ...]
    modes: tuple[str, ...]
    tracker: str
    checkpoint: Path | None
    checkpoint_hash: str | None
    policy: str
    policy_hash: str | None
    rules: str
    rules_hash: str
    seeds: tuple[int, ...]
    repeats: int
    max_steps: int | None
    engine: str
    device: str
    variant: Path | None
    variant_hash: str | None
    fast_physics: bool
    worlds: int
    video: bool
    strip: bool
    actions: bool
    drive: str = "auto"
    video_episodes: int | None = None
    video_size: tuple[int, int] | None = None
    follow: bool = False
    scenes_hash: str = ""
    """Built-in scenes of the run's tasks, by content."""
    code_hash: str = ""
    """The package's own code that moves and judges, by content."""
    policy_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What the policy is made with beside its spec."""
    worlds_matter: bool = False
    """Whether the policy depends on how many worlds ask at once; known when it was made and checked."""
    tracker_facts: dict[str, Any] | None = None
    """`Tracker.describe()`, once the tracker is made."""
    policy_facts: dict[str, Any] | None = None
    """`Policy.describe()`, once the policy is made."""

    def identity(self) -> dict[str, Any]:
        """What the results depend on, by flag name; two runs with equal identity may share a results folder.

        Videos and the folder are absent: they do not change an episode. So is the number of worlds, but for a policy
        that depends on it. Files count by content. What each environment was built with and the libraries' versions
        stand beside it in config.json.
        """
        return {
            "version": __version__,
            "task": list(self.tasks),
            "mode": list(self.modes),
            "tracker": self.tracker,
            "checkpoint": self.checkpoint_hash,
            "policy": policy_label(self.policy),
            "policy_file": self.policy_hash,
            "worlds": self.worlds if self.worlds_matter else None,
            "rules": self.rules,
            "rules_hash": self.rules_hash,
            "seeds": list(self.seeds),
            "repeats": self.repeats,
            "max_steps": self.max_steps,
            "engine": self.engine,
            "device": self.device.split(":")[0],
            "variant": self.variant_hash,
            "fast_physics": self.fast_physics,
            "drive": self.drive,
            "scenes": self.scenes_hash,
            "code": self.code_hash,
            "tracker_facts": self.tracker_facts,
            "policy_facts": self.policy_facts,
        }

    @property
    def hash(self) -> str:
        """Hash of :meth:`identity`."""
        return config_hash(self.identity())


def config_hash(value: Any) -> str:
    """First 12 hex digits of the SHA-256 of the canonical JSON of ``value``."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def hash_path(path: Path) -> str:
    """First 12 hex digits of the SHA-256 of a file, or of names and contents of all files in a folder."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: is no regular file")
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        if path.is_dir():
            digest.update(file.relative_to(path).as_posix().encode() + b"\0")
        try:
            with file.open("rb") as handle:
                while block := handle.read(1 << 20):
                    digest.update(block)
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    return digest.hexdigest()[:12]


def differing_key(
    stored: dict[str, Any], wanted: dict[str, Any], ignored: Collection[str] = ()
) -> tuple[str, Any, Any] | None:
    """First key whose value differs between two identities, with both values; None when they are equal.

    Of values that are tables themselves the key within is told, such as `tracker.drive`.
    """
    for key in [*wanted, *(k for k in stored if k not in wanted)]:
        was, now = stored.get(key), wanted.get(key)
        if key in ignored or was == now:
            continue
        if isinstance(was, dict) and isinstance(now, dict):
            inner = differing_key(was, now)
            if inner is not None:
                return f"{key}.{inner[0]}", inner[1], inner[2]
        return key, was, now
    return None


def moving_versions(versions: dict[str, str | None]) -> dict[str, str | None]:
    """Of all versions those that an episode may depend on; of Python's the first two numbers."""
    kept = {name: version for name, version in versions.items() if name not in UNVERSIONED}
    if kept.get("python"):
        kept["python"] = ".".join(str(kept["python"]).split(".")[:2])
    return kept


def is_quick(options: RunOptions) -> bool:
    """Whether the flags leave the plan open: a quick look at all tasks."""
    named = options.task or options.mode or options.seeds
    return not named and (options.repeats, options.max_steps) == (None, None)


def resolve(options: RunOptions) -> RunConfig:
    """Check every flag and file, and fill in what was left open.

    Raises:
        InputError: a flag names something unknown or absent; the message says what is known.
    """
    from arena_newton import policies, rule_sets
    from arena_newton import tasks as task_specs
    from arena_newton.eval import plan
    from arena_newton.physics import resolve_engine
    from arena_newton.quiet import quiet_warp

    quick = is_quick(options)
    for field in dataclasses.fields(options):
        given = getattr(options, field.name)
        for text in given if isinstance(given, tuple) else (given,):
            if isinstance(text, str) and not is_printable(text):
                raise InputError(f"--{field.name.replace('_', '-')} {plain_text(text)}: has control characters in it")
    if options.drive not in DRIVES:
        raise InputError(f"--drive {options.drive}: unknown, choose from {', '.join(DRIVES)}")
    if options.video_episodes is not None and options.video_episodes < 1:
        raise InputError(f"--video-episodes {options.video_episodes}: expected at least 1")
    pictures = {"video_episodes": options.video_episodes, "video_size": options.video_size, "follow": options.follow}
    for name, given in pictures.items():
        if given and not (options.video or options.strip):
            raise InputError(f"--{name.replace('_', '-')}: belongs to --video or --strip, neither is given")
    if "all" in options.task and len(options.task) > 1:
        raise InputError("--task all: stands alone, name either all or single tasks")
    tasks = task_specs.names() if tuple(options.task) in ((), ("all",)) else tuple(options.task)
    seeds = tuple(options.seeds) or (QUICK_SEEDS if quick else plan.PROTOCOL_SEEDS)
    if min(seeds) < 0:
        raise InputError(f"--seeds {min(seeds)}: expected numbers of at least 0")
    if options.worlds < 1:
        raise InputError(f"--worlds {options.worlds}: expected at least 1")
    repeats = options.repeats if options.repeats is not None else (QUICK_REPEATS if quick else plan.PROTOCOL_REPEATS)
    checkpoint, checkpoint_hash = _checkpoint(options)
    policies.check_spec(options.policy)
    scheme, _, target = options.policy.partition(":")
    policy_path = _existing("--policy", target) if scheme in POLICY_PATH_SCHEMES and target else None
    variant = _existing("--variant", options.variant)
    if variant is not None and len(tasks) != 1:
        raise InputError(f"--variant {options.variant}: name the one task it belongs to with --task")
    for name in tasks:
        task_specs.get(name)
    config = RunConfig(
        tasks=tasks,
        scenes_hash=_digest(PACKAGE, scene_files(PACKAGE, tasks, task_specs.names()), hash_path),
        code_hash=code_hash(),
        modes=tuple(options.mode) or ("base",),
        tracker=options.tracker,
        checkpoint=checkpoint,
        checkpoint_hash=checkpoint_hash,
        policy=options.policy,
        policy_hash=hash_path(policy_path) if policy_path else None,
        rules=options.rules,
        rules_hash=rule_sets.get(options.rules).hash_for(tasks),
        seeds=seeds,
        repeats=repeats,
        max_steps=QUICK_MAX_STEPS if quick else options.max_steps,
        engine=options.engine,
        device=options.device or "",
        variant=variant,
        variant_hash=_hash_scene(variant) if variant else None,
        fast_physics=options.fast_physics,
        worlds=options.worlds,
        video=options.video,
        strip=options.strip,
        actions=options.actions,
        policy_options=_policy_options(options),
        drive=options.drive,
        video_episodes=options.video_episodes,
        video_size=_size(options.video_size),
        follow=options.follow,
    )
    episodes(config)  # names and numbers are wrong at once, before Warp starts
    quiet_warp()
    engine, device = resolve_engine(options.engine, options.device)
    return dataclasses.replace(config, engine=engine, device=device)


def episodes(config: RunConfig) -> list[Episode]:
    """The run's episodes in plan order.

    Raises:
        InputError: an unknown task or mode, something named twice, or a number out of range.
    """
    from arena_newton.eval import plan

    return plan.expand(
        config.tasks,
        tracker=config.tracker,
        policy=policy_label(config.policy),
        modes=config.modes,
        rules=config.rules,
        engine=config.engine,
        seeds=config.seeds,
        repeats=config.repeats,
        max_steps=config.max_steps,
    )


def explicit(options: RunOptions, config: RunConfig) -> RunOptions:
    """The flags with every default filled in and every path absolute: what ``resume`` starts from."""
    scheme, _, target = options.policy.partition(":")
    local = scheme in POLICY_PATH_SCHEMES and target
    return dataclasses.replace(
        options,
        task=config.tasks,
        mode=config.modes,
        seeds=config.seeds,
        repeats=config.repeats,
        max_steps=config.max_steps,
        engine=config.engine,
        device=config.device,
        checkpoint=str(config.checkpoint) if config.checkpoint else None,
        variant=str(config.variant) if config.variant else None,
        policy=f"{scheme}:{Path(target).expanduser().resolve()}" if local else options.policy,
        retry_errors=False,
        accept_versions=False,
        skip_broken=False,
        verbose=False,
    )


def policy_label(policy: str) -> str:
    """Name of a policy in tables: the spec, with a local path shortened to its file name."""
    scheme, _, target = policy.partition(":")
    if scheme not in POLICY_PATH_SCHEMES or not target:
        return policy
    path = Path(target)
    return f"{scheme}:{path.parent.name if path.name == 'actions' and path.parent.name else path.name}"


def _hash_scene(path: Path) -> str:
    """Hash of a USD file with every layer and asset that it names; the validator walks them before USD composes any."""
    from arena_newton.usd_scenes import validate

    return config_hash(sorted(hash_path(file) for file in validate.layers(path)))


def _size(given: str | None) -> tuple[int, int] | None:
    """Width and height of --video-size."""
    if given is None:
        return None
    from arena_newton.pictures.recorder import video_sizes

    numbers = re.fullmatch(r"([0-9]{1,5})[x×]([0-9]{1,5})", given)
    if not numbers:
        raise InputError(f"--video-size {given}: expected width x height, such as 960x540")
    return video_sizes((int(numbers[1]), int(numbers[2])))["world"]


def _files(root: Path) -> list[Path]:
    """All files below a folder, sorted; linked folders, as in a checkout, are entered, caches are not."""
    found = []
    for folder, names, files in os.walk(root, followlinks=True):
        names[:] = sorted(name for name in names if name != "__pycache__" and not name.startswith("."))
        found += [Path(folder) / name for name in files]
    return sorted(found)


def code_files(root: Path = PACKAGE) -> list[Path]:
    """Modules of a package folder whose change may change a result: all but `UNHASHED`."""

    def counts(file: Path) -> bool:
        name = file.relative_to(root)
        return file.suffix == ".py" and not any(part.as_posix() in UNHASHED for part in (name, *name.parents))

    return [file for file in _files(root) if counts(file)]


def code_hash(root: Path = PACKAGE, digest: Callable[[Path], str] = hash_path) -> str:
    """Hash of the code that a run executes, by names and contents.

    Args:
        root: Package folder.
        digest: Hash of one file.
    """
    return _digest(root, code_files(root), digest)


def scene_files(root: Path, tasks: Collection[str], known: Collection[str]) -> list[Path]:
    """Layers, textures and what else lies beside the built-in scenes of a run's tasks.

    Args:
        root: Package folder.
        tasks: Tasks of the run.
        known: All tasks; the folders of those that the run lacks do not count, nor does the trackers' `lab`.
    """
    others = {"lab", *known} - set(tasks)
    scenes = root / "usd_scenes"
    found = [file for file in _files(scenes) if file.suffix not in (".py", ".pyc")]
    return [file for file in found if file.relative_to(scenes).parts[0] not in others]


def _digest(root: Path, files: Sequence[Path], digest: Callable[[Path], str]) -> str:
    return config_hash([[file.relative_to(root).as_posix(), digest(file)] for file in files])


def own_code(part: Any) -> str | None:
    """Hash of the package, or the single module, that a tracker or policy of others was written in.

    Returns:
        None for the parts of this package, whose code is hashed as a whole.
    """
    module = sys.modules.get(type(part).__module__)
    name = module.__name__.partition(".")[0] if module is not None else ""
    top = sys.modules.get(name)
    if top is None or getattr(top, "__file__", None) is None or name in {"arena_newton", *sys.stdlib_module_names}:
        return None
    file = Path(str(top.__file__)).resolve()
    if not hasattr(top, "__path__"):
        return hash_path(file)
    return _digest(file.parent, [f for f in _files(file.parent) if f.suffix == ".py"], hash_path)


def _checkpoint(options: RunOptions) -> tuple[Path | None, str | None]:
    """The weights' path, and what they hash to: without a path, those that come with the package."""
    from arena_newton import trackers

    if options.checkpoint is None:
        shipped = trackers.shipped_weights(options.tracker)
        return None, hash_path(shipped) if shipped else None
    given = Path(options.checkpoint).expanduser()
    files = [given] if given.exists() else [Path(part).expanduser() for part in options.checkpoint.split(",")]
    for file in files:
        if not str(file) or not file.exists():
            raise InputError(f"--checkpoint {options.checkpoint}: no such file")
    path = Path(",".join(str(file.resolve()) for file in files))
    hashes = [hash_path(file) for file in files]
    return path, hashes[0] if len(hashes) == 1 else config_hash(hashes)


def _policy_options(options: RunOptions) -> dict[str, Any]:
    """What --policy remote is made with; the flags are refused with another policy."""
    if options.policy.partition(":")[0] == "remote":
        return {
            "timeout": options.remote_timeout,
            "retries": options.remote_retries,
            "sequential": options.remote_sequential,
            "verify_ssl": not options.remote_insecure,
        }
    for field in dataclasses.fields(options):
        if field.name.startswith("remote_") and getattr(options, field.name) != field.default:
            flag = f"--{field.name.replace('_', '-')}"
            raise InputError(f"{flag}: belongs to --policy remote:<url>, not {options.policy}")
    return {}


def _existing(flag: str, given: str | None) -> Path | None:
    if given is None:
        return None
    path = Path(given).expanduser()
    if not given or not path.exists():
        raise InputError(f"{flag} {given}: no such file")
    if path.is_dir() and flag != "--policy":
        raise InputError(f"{flag} {given}: is a folder, expected a file")
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{flag} {given}: is no regular file")
    return path.resolve()
