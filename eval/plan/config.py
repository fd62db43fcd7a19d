"""A run as it is executed: flags are checked and resolved once, and only go down from there.

No library of physics or pictures is loaded before all that needs none was checked.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton import __version__, policies, recorders, rule_sets, trackers
from arena_newton import tasks as task_specs
from arena_newton.cli.flags import check_least, shared
from arena_newton.data.readers.looks import MOST_LIGHTS
from arena_newton.data.recording.noise_levels import NoiseLevels
from arena_newton.errors import InputError, check_once
from arena_newton.eval.plan import episode_plan, rounds
from arena_newton.eval.plan.flag_checks import DRIVES, check_flags
from arena_newton.eval.plan.options import (
    QUICK_REPEATS,
    QUICK_SEEDS,
    QUICK_TRACKERS,
    Chunks,
    RecordOptions,
    RunOptions,
    Viewer,
    Workers,
    flags_of,
    is_quick,
)
from arena_newton.eval.records.document import Identity
from arena_newton.eval.records.identity import (
    code_hash,
    config_hash,
    foreign_task,
    hash_path,
    layers_hash,
    mode_facts,
    own_code,
    scenes_hash,
)
from arena_newton.eval.records.sharding import Shard, dealt, parse_shard
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import counted, plain_text
from arena_newton.physics.devices import cluster_engine, resolve_engine, visible_gpus
from arena_newton.pictures.settings import (
    CAMERAS,
    SIZE_LIMITS,
    CameraConfig,
    policy_cameras,
    recorded_camera,
    video_sizes,
)
from arena_newton.policies.base import DATASET_FILE, dataset_target, hub_name, is_privileged
from arena_newton.policies.learned.learned_card import NOT_SHIPPED, PolicyCard, read_card, shipped_card
from arena_newton.policies.remote.program import ProgramCommand
from arena_newton.rules import modes, seeding

if TYPE_CHECKING:
    from arena_newton.policies.base import Policy
    from arena_newton.trackers.base import Tracker

__all__ = [
    "DEFAULT_TRACKER",
    "DRIVES",
    "RunConfig",
    "plain_facts",
    "recorded_cameras",
    "recording_run",
    "resolve",
]

DEFAULT_TRACKER = "twist2"
"""Tracker of a run that names tasks or weights, but no tracker."""
POLICY_PATH_SCHEMES = ("learned", "lerobot", "replay")
"""Policies whose text after the colon is a path."""
MOST_EPISODES = 200
"""Episodes of a task, tracker and mode under --until-width; the widest interval is then 14 points wide."""
MOST_DISTURBANCE = 10.0
"""Largest factor of the noise; no robot stands far less."""
ONE_CALL = frozenset("accept_versions retry_errors skip_broken verbose".split())
ONE_CALL |= {*flags_of(Viewer), *flags_of(Workers)}
"""Flags that a resumed run does not take over."""


@dataclass(frozen=True)
class RunConfig:
    """A validated, fully resolved run."""

    flags: RunOptions
    """The flags with every default filled in and every path absolute."""
    episodes: tuple[episode_plan.Episode, ...]
    """Episodes to play: the plan, or its part that the shard has."""
    planned: int
    """Episodes of the whole plan."""
    repeats: int
    """Repeats of the flags, never left open; the device likewise."""
    device: str
    policy: str
    """Spec that the policy is made with, a path in it as the user gave it."""
    policy_label: str
    """Name of the policy in tables: the spec, with a local path shortened to its file name."""
    checkpoint: Path | None
    """Weights of the one tracker, or several with a comma between; None: those that come with the package."""
    variant: Path | None
    video_size: tuple[int, int] | None
    """Size of the world camera's pictures [px]; None: the usual one."""
    policy_options: JsonObject
    """Arguments of the policy besides its spec."""
    checkpoint_hashes: Mapping[str, str | None]
    """Weights by tracker."""
    policy_hash: str | None
    rules_hash: str
    variant_hash: str | None
    scenes_hash: str
    """Built-in scenes of the run's tasks, by content."""
    code_hash: str
    """The package's own code that moves and judges, by content."""
    mode_facts: Mapping[str, JsonObject] = dataclasses.field(default_factory=dict)
    """Hashes of each mode whose ranges are not the rule set's."""
    foreign_tasks: Mapping[str, JsonObject] = dataclasses.field(default_factory=dict)
    """Hashes of scene and code of each task that another package brings; the built-in ones are hashed as a whole."""
    shard: Shard | None = None
    """Part of the plan; None: all of it. It is no part of the identity."""
    recording: Mapping[str, CameraConfig] | None = None
    """Recorded cameras by name; None where nothing is recorded."""
    labels: str = "v3.1"
    """Protocol of the policy's actions; final when the policy was made."""
    cameras: Mapping[str, CameraConfig] = dataclasses.field(default_factory=dict)
    """Cameras that the policy asks for, by name; none for one that does not see."""
    worlds_matter: bool = False
    """True if the policy depends on how many worlds ask at once; known when it was made and checked."""
    tracker_facts: JsonObject | None = None
    """`Tracker.describe()` by tracker, once the trackers are made."""
    policy_facts: JsonObject | None = None
    """`Policy.describe()` and, of one that takes the world itself, `privileged`, once the policy is made."""

    def identity(self) -> Identity:
        """Identity of the results, by flag name; two runs with equal identity may share a results folder.

        Videos, viewers, the folder and shards are absent: they do not change an episode. So is the number of worlds,
        except for a policy that depends on it. Files count by content. What each environment was built with and the
        libraries' versions are stored next to it in config.json.
        """
        flags = self.flags
        return {
            "version": __version__,
            "task": list(flags.task),
            "mode": list(flags.mode),
            "tracker": list(flags.tracker),
            "checkpoint": dict(self.checkpoint_hashes),
            "policy": self.policy_label,
            "policy_file": self.policy_hash,
            "labels": self.labels,
            "worlds": flags.worlds if self.worlds_matter else None,
            "rules": flags.rules,
            "rules_hash": self.rules_hash,
            "seeds": list(flags.seeds),
            "repeats": self.repeats,
            "max_steps": flags.max_steps,
            "engine": flags.engine,
            "device": self.device.split(":")[0],
            "variant": self.variant_hash,
            "fast_physics": flags.fast_physics,
            "drive": flags.drive,
            "scenes": self.scenes_hash,
            "code": self.code_hash,
            "tracker_facts": self.tracker_facts,
            "policy_facts": self.policy_facts,
            **({"mode_facts": dict(self.mode_facts)} if self.mode_facts else {}),  # type: ignore[typeddict-item]
            **({"foreign_tasks": dict(self.foreign_tasks)} if self.foreign_tasks else {}),  # type: ignore[typeddict-item]
            **self._chunks(),
            **self._budget(),
            **self._demonstrations(),
        }

    def _chunks(self) -> Identity:
        """Execution of chunks, where it is not the usual: whole, at once, one after the other."""
        given = {name: getattr(self.flags, name) for name in flags_of(Chunks) if name != "labels"}
        return {name: value for name, value in given.items() if value}  # type: ignore[return-value]  # a part of one

    @property
    def width_rule(self) -> rounds.WidthRule | None:
        """Rule by which a task, tracker and mode has enough episodes; None: all are played."""
        flags = self.flags
        if flags.until_width is None:
            return None
        return rounds.WidthRule(flags.until_width, flags.max or MOST_EPISODES, len(flags.seeds))

    def _budget(self) -> Identity:
        """The rule that is fixed before the first episode; nothing where the plan is played as a whole."""
        rule = self.width_rule
        return {} if rule is None else {"until_width": rule.width, "max": rule.most}  # type: ignore[typeddict-item]

    def _demonstrations(self) -> Identity:
        """Identity of a run of `eval record` as against an evaluation; nothing for one."""
        if self.flags.series is None:
            return {}  # type: ignore[typeddict-item]  # a part of one
        scales = {task: self.noise_scale(task) for task in self.flags.task}
        noise = NoiseLevels().describe() | {"scale": scales} if self.flags.disturb else None
        return {"seed_range": seeding.DEMONSTRATION, "disturbance": noise, "keep": self.flags.keep}  # type: ignore[typeddict-item]

    def noise_scale(self, task: str) -> float:
        """Factor of the noise that disturbs a task's demonstrations; 0 where nothing does."""
        return self.flags.disturb_scale * task_specs.get(task).disturbance if self.flags.disturb else 0.0

    @property
    def privileged(self) -> bool:
        """The policy takes the world itself; known when it was made."""
        return bool((self.policy_facts or {}).get("privileged"))

    @property
    def hash(self) -> str:
        """Hash of `identity`."""
        return config_hash(self.identity())

    def stored_flags(self) -> JsonObject:
        """Flags that `resume` starts from: all flags but those of one call."""
        once = {field.name: field.default for field in dataclasses.fields(self.flags) if field.name in ONE_CALL}
        flags: JsonObject = json.loads(json.dumps(dataclasses.asdict(self.flags) | once))
        return flags

    def with_parts(self, made: Mapping[str, Tracker], policy: Policy) -> RunConfig:
        """The run with what its trackers, by name, and its policy say of themselves."""
        return dataclasses.replace(
            self,
            cameras=policy_cameras(policy),
            labels=self.flags.labels or getattr(policy, "labels", None) or "v3.1",
            worlds_matter=policy.depends_on_worlds,
            tracker_facts={name: _facts(tracker) for name, tracker in made.items()},
            policy_facts=_facts(policy) | ({"privileged": True} if is_privileged(policy) else {}),
        )

    def described_by(self, other: object) -> RunConfig:
        """The run with what trackers and policy say of themselves, of a run or a message that has them."""
        described = ("labels", "worlds_matter", "tracker_facts", "policy_facts")
        return dataclasses.replace(self, **{name: getattr(other, name) for name in described})


def _facts(part: Tracker | Policy) -> JsonObject:
    """Own description of a tracker or policy, and the hash of its code if it is of another package, as JSON."""
    code = own_code(part)
    return plain_facts(part.describe() | ({} if code is None else {"code": code}))


def plain_facts(facts: Mapping[str, object]) -> JsonObject:
    """Facts as strict JSON gives them back; anything else as text."""
    plain: JsonObject = json.loads(json.dumps(facts, default=str))
    return plain


def recording_run(options: RecordOptions) -> RunOptions:
    """The flags of a run that records demonstrations.

    Raises:
        InputError: A number is out of range.
    """
    check_least(options, 1, "episodes")
    check_least(options, 0, "seed_series")
    if not 0.0 <= options.disturb_scale <= MOST_DISTURBANCE:
        raise InputError(f"--disturb-scale {options.disturb_scale:g}: expected 0 to {MOST_DISTURBANCE:g}")
    if not options.disturb and options.disturb_scale != 1.0:
        raise InputError("--disturb-scale: belongs to disturbed execution; drop it or --no-disturb")
    if options.accept_differences:
        raise InputError("--accept-differences: belongs to --from, which is not given")
    attempts = options.episodes * (rounds.ATTEMPTS if options.only_success else 1)
    run = shared(
        options,
        RunOptions,
        seeds=(options.seed_series,),
        repeats=attempts,
        record=True,
        record_cameras=options.cameras,
        record_size=options.size,
        record_depth=options.depth,
        record_looks=options.looks,
        actions=False,  # they are in the recordings
        series=options.seed_series,
        keep=options.episodes if options.only_success else None,
    )
    recorded_cameras(run, "--")
    return run


def resolve(options: RunOptions) -> RunConfig:
    """Check every flag and file, and fill in what was left open.

    Raises:
        InputError: A flag names something unknown or absent; the message says what is known.
    """
    check_flags(options)
    quick = is_quick(options)
    tasks = task_specs.PAPER if options.task in ((), ("all",)) else tuple(options.task)
    scheme, _, target = options.policy.partition(":")
    if scheme == "learned":
        card = _card(target)
        tasks = tasks if options.task else card.tasks
        card.check_tasks(tasks)
    if options.failures:
        without = [task for task in tasks if task_specs.get(task).interaction is None]
        if without:
            raise InputError(f"--failures: no signals are defined for {' '.join(without)} (`TaskSpec.interaction`)")
    # Weights that are named are one tracker's; the default run has two.
    several = QUICK_TRACKERS if quick and options.checkpoint is None else (DEFAULT_TRACKER,)
    used = tuple(options.tracker) or several
    checkpoint, checkpoint_hashes = _checkpoint(options, used)
    for tracker in used:
        trackers.check_spec(tracker)
    policies.check_spec(options.policy)
    check_once("--recorder", options.recorder)
    for recorder in options.recorder:
        recorders.load(recorder)
    if scheme in POLICY_PATH_SCHEMES and target and not (scheme == "lerobot" and hub_name(target)):
        at, episode = dataset_target(str(Path(target).expanduser()))
        policy_path, ending = _existing("--policy", str(at), f"{scheme}:"), "" if episode is None else f"#{episode}"
    else:
        policy_path, ending = None, ""
    label = f"{scheme}:{_shown(policy_path)}{ending}" if policy_path else options.policy
    program = ProgramCommand.read(target) if scheme == "process" else None
    if program is not None:
        options, label = dataclasses.replace(options, policy=f"process:{program.text}"), f"process:{program.shown}"
    variant = _existing("--variant", options.variant)
    if variant is not None and len(tasks) != 1:
        raise InputError(f"--variant {options.variant}: name the one task it belongs to with --task")
    default_repeats = QUICK_REPEATS if quick else episode_plan.PROTOCOL_REPEATS
    repeats = default_repeats if options.repeats is None else options.repeats
    used_seeds = tuple(options.seeds) or (QUICK_SEEDS if quick else episode_plan.PROTOCOL_SEEDS)
    if options.until_width is not None:
        needed = -(-(options.max or MOST_EPISODES) // len(used_seeds))
        if options.repeats not in (None, needed):
            raise InputError(f"--repeats {options.repeats}: --until-width decides it, up to --max; drop one of both")
        repeats = needed
    flags = dataclasses.replace(
        options,
        task=tasks,
        tracker=used,
        mode=tuple(options.mode) or ("base",),
        seeds=used_seeds,
        repeats=repeats,
        max=(options.max or MOST_EPISODES) if options.until_width is not None else None,
        strip=options.strip or quick,
        follow=options.follow or quick,
        checkpoint=str(checkpoint) if checkpoint else None,
        variant=str(variant) if variant else None,
        policy=f"{scheme}:{policy_path}{ending}" if policy_path else options.policy,
    )
    episodes = episode_plan.expand(
        flags.task,
        trackers=flags.tracker,
        policy=label,
        modes=flags.mode,
        rules=flags.rules,
        seeds=flags.seeds,
        repeats=repeats,
        max_steps=flags.max_steps,
        seed_range=seeding.EVALUATION if flags.series is None else seeding.DEMONSTRATION,
        most=flags.max,
    )
    rule_set = rule_sets.get(options.rules)
    shard = None if options.shard is None else parse_shard(options.shard)
    if shard is not None and shard.count > len(episodes):
        raise InputError(f"--shard {shard}: the plan has {counted(len(episodes), 'episode')}, expected no more shards")
    keys = [(e.task, e.tracker, e.mode, e.group_seed, e.repeat) for e in episodes]
    played = episodes if shard is None else [episodes[index] for index in dealt(keys, shard)]
    video_size, policy_options = _size(options.video_size), _policy_options(options)
    recording = recorded_cameras(options) if options.record else None
    policy_hash = hash_path(_decisive(scheme, policy_path)) if policy_path else None
    if program is not None and program.decisive:
        policy_hash = config_hash([hash_path(file) for file in program.decisive])
    variant_hash = layers_hash(variant) if variant else None
    if options.dealt:
        alone = options.ray is None and options.device is None and not visible_gpus()  # what --jobs starts sees no more
        engine, device = cluster_engine(options.engine, "cpu" if alone else options.device, options.ray_gpus)
    else:
        engine, device = resolve_engine(options.engine, options.device)  # last: it may have to load Warp
    return RunConfig(
        flags=dataclasses.replace(flags, engine=engine, device=device, shard=None if shard is None else str(shard)),
        episodes=tuple(dataclasses.replace(episode, engine=engine) for episode in played),
        planned=len(episodes),
        shard=shard,
        repeats=repeats,
        device=device,
        policy=options.policy,
        policy_label=label,
        checkpoint=checkpoint,
        variant=variant,
        video_size=video_size,
        recording=recording,
        policy_options=policy_options,
        checkpoint_hashes=checkpoint_hashes,
        policy_hash=policy_hash,
        rules_hash=rule_set.hash_for(tasks),
        variant_hash=variant_hash,
        scenes_hash=scenes_hash(tasks, task_specs.OWN, flags.mode),
        code_hash=code_hash(),
        mode_facts={name: facts for name in flags.mode if (facts := mode_facts(name, rule_set, tasks))},
        foreign_tasks={
            name: facts for name in tasks if (facts := foreign_task(task_specs.get(name), sorted(flags.mode)))
        },
    )


def _card(target: str) -> PolicyCard:
    """The card of `--policy learned`, or of `learned:<folder>`.

    Raises:
        InputError: There is none.
    """
    if target:
        folder = Path(target).expanduser()
        if not folder.is_dir():
            raise InputError(f"--policy learned:{target}: no such folder")
        return read_card(folder)
    card = shipped_card()
    if card is None:
        raise InputError(NOT_SHIPPED)
    return card


def _size(given: str | None) -> tuple[int, int] | None:
    """Width and height of --video-size."""
    if given is None:
        return None
    numbers = re.fullmatch(r"([0-9]{1,5})[x×]([0-9]{1,5})", given)
    if not numbers:
        raise InputError(f"--video-size {given}: expected width x height, such as 960x540")
    return video_sizes((int(numbers[1]), int(numbers[2])))["world"]


def recorded_cameras(options: RunOptions, flag: str = "--record-") -> dict[str, CameraConfig]:
    """Recorded cameras by name.

    Args:
        options: Cameras, their size, and whether depth is recorded.
        flag: How the flags begin that messages name: those of `eval run`, or `--`, those of `eval record`.

    Pictures of the sensor's own shape (4:3) show what it shows; in others, such as squares, it has black bars as in the
    pictures of policies. The world camera has no sensor to keep to.

    Raises:
        InputError: An unknown camera, one named twice, or an unfit size.
    """
    numbers = re.fullmatch(r"([0-9]{1,5})[x×]([0-9]{1,5})", options.record_size)
    width, height = (int(numbers[1]), int(numbers[2])) if numbers else (0, 0)
    low, high = SIZE_LIMITS
    if not all(low <= n <= high and n % 2 == 0 for n in (width, height)):
        raise InputError(
            f"{flag}size {options.record_size}: expected width x height, even numbers from {low} to {high}, such as "
            "224x224 or 640x480"
        )
    if options.record_depth and not options.record_cameras:
        raise InputError(f"{flag}depth: belongs to cameras, none is recorded")
    if not 0 <= options.record_looks <= MOST_LIGHTS:
        raise InputError(f"{flag}looks {options.record_looks}: expected 0 to {MOST_LIGHTS}")
    if options.record_looks and "front" not in options.record_cameras:
        raise InputError(f"{flag}looks: are those of the camera front, which is not recorded")
    if options.record_looks and (shown := [mode for mode in options.mode if modes.get(mode).looks]):
        raise InputError(
            f"{flag}looks: belongs to modes without looks of their own, not {min(shown)}: none must learn its looks"
        )
    for name in options.record_cameras:
        if name not in CAMERAS:
            raise InputError(f"{flag}cameras {plain_text(name)}: unknown, choose from {' '.join(CAMERAS)}")
    check_once(f"{flag}cameras", options.record_cameras)
    return {name: recorded_camera(name, width, height) for name in options.record_cameras}


def _checkpoint(options: RunOptions, used: Sequence[str]) -> tuple[Path | None, dict[str, str | None]]:
    """The weights' path, and what those of each tracker hash to: without a path, those that come with the package."""
    if options.checkpoint is None:
        shipped = {tracker: trackers.shipped_weights(tracker) for tracker in used}
        return None, {tracker: hash_path(path) if path else None for tracker, path in shipped.items()}
    if len(used) > 1:
        raise InputError(f"--checkpoint {options.checkpoint}: name the one --tracker whose weights they are")
    given = Path(options.checkpoint).expanduser()
    files = [given] if given.exists() else [Path(part).expanduser() for part in options.checkpoint.split(",")]
    for file in files:
        if not str(file) or not file.exists():
            raise InputError(f"--checkpoint {options.checkpoint}: no such file")
    path = Path(",".join(str(file.resolve()) for file in files))
    hashes = [hash_path(file) for file in files]
    return path, {used[0]: hashes[0] if len(hashes) == 1 else config_hash(hashes)}


def _policy_options(options: RunOptions) -> JsonObject:
    """Arguments of a policy besides its spec."""
    scheme = options.policy.partition(":")[0]
    if scheme == "process":
        return {"timeout": options.remote_timeout, "labels": options.labels or "v3.1"}
    if scheme == "remote":
        return {
            "timeout": options.remote_timeout,
            "retries": options.remote_retries,
            "sequential": options.remote_sequential,
            "verify_ssl": not options.remote_insecure,
            "labels": options.labels or "v3.1",
        }
    return {"replan": options.replan, "ensemble": options.ensemble} if scheme == "lerobot" else {}


def _shown(path: Path) -> str:
    """Name of what is played: of a run for its folder `actions`, of a training and its step for a checkpoint."""
    inner = path.parent if path.name == "pretrained_model" else path
    if inner.parent.name == "checkpoints":
        return f"{inner.parents[1].name}-{inner.name}"
    if path.parent.name == "actions":  # of one of several trackers
        return f"{path.parents[1].name}-{path.name}"
    return path.parent.name if path.name == "actions" and path.parent.name else path.name


def _decisive(scheme: str, path: Path) -> Path:
    """Part of a policy's path that counts by content: of a training the checkpoint, of a dataset its description.

    The policy itself says the hash of the actions that it plays.
    """
    if scheme == "lerobot":
        from arena_newton.policies.lerobot.checkpoint_facts import checkpoint_folder  # imports torch

        return checkpoint_folder(path)
    return path / DATASET_FILE if (path / DATASET_FILE).is_file() else path


def _existing(flag: str, given: str | None, before: str = "") -> Path | None:
    """Absolute path of a file, for --policy also of a folder."""
    if given is None:
        return None
    path = Path(given).expanduser()
    if not given or not path.exists():
        raise InputError(f"{flag} {before}{given}: no such file{' or folder' if flag == '--policy' else ''}")
    if path.is_dir() and flag != "--policy":
        raise InputError(f"{flag} {given}: is a folder, expected a file")
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{flag} {given}: is not a regular file")
    return path.resolve()
