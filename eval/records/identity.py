"""Identity of a run: hashes of files, code and scenes, and the comparison of two identities."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import inspect
import json
import os
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import arena_newton
from arena_newton import tasks as all_tasks
from arena_newton.errors import InputError
from arena_newton.rules import modes as all_modes

if TYPE_CHECKING:
    from arena_newton.files.stored_json import JsonObject
    from arena_newton.rules.rule_types import RuleSet
    from arena_newton.tasks import TaskSpec

__all__ = [
    "PACKAGE",
    "UNHASHED",
    "UNVERSIONED",
    "code_files",
    "code_hash",
    "config_hash",
    "differing_key",
    "foreign_task",
    "hash_path",
    "hash_paths",
    "layers_hash",
    "mode_facts",
    "moving_versions",
    "own_code",
    "package_files",
    "report_hash",
    "scene_files",
    "scenes_hash",
]

PACKAGE = Path(arena_newton.__file__).resolve().parent
REPORTERS = ("eval/folders", "eval/records", "eval/reports", "eval/statistics", "pages")
"""Rooms that write the tables and reports of a run."""
UNHASHED = (
    *REPORTERS,
    "data/checks",
    "data/datasets",
    "eval/adapters",
    "eval/audit",
    "eval/bench",
    "eval/certification",
    "eval/commands",
    "eval/leaderboard",
    "eval/loop",
    "eval/studies",
    "eval/suites",
    "eval/tables",
    "eval/workers",
    "policies/recipes",
    "policies/train",
    "trackers/evaluation",
    "trackers/train",
)
"""Rooms that prepare, report or measure but move and judge no episode of a run, as command lines do
(`__main__.py`). All other code counts, whatever is added to the package."""
UNVERSIONED = ("arena-newton", "av", "jinja2", "matplotlib", "rsl-rl-lib", "tqdm", "tyro")
"""Distributions that move and judge no episode; the versions of all others must not change within a results folder."""
UNRULED = (
    "gym_id instruction spawn_position spawn_quat expert disturbance predicates target interaction recolour events"
).split()
"""Fields of a `TaskSpec` that change an episode or what is kept of it, and are not among the hashed rules."""

LARGE_BYTES = 8 << 20
"""Size from which on a hash is kept [bytes]; nothing that is edited by hand is so large."""


def config_hash(value: object) -> str:
    """First 12 hex digits of the SHA-256 of the canonical JSON of a value."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def hash_path(path: Path) -> str:
    """First 12 hex digits of the SHA-256 of a file, or of names and contents of all files in a folder.

    Large content, such as a checkpoint's, is read once in a process while size and time of its files stay the same.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: is not a regular file")
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    try:
        about = [file.stat() for file in files]
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror})") from None
    if sum(stat.st_size for stat in about) < LARGE_BYTES:
        return _digest(path, tuple(files))
    stamps = tuple((stat.st_size, stat.st_mtime_ns, stat.st_ino) for stat in about)
    return _kept_digest(path.absolute(), tuple(file.absolute() for file in files), stamps)


@functools.lru_cache(maxsize=256)
def _kept_digest(path: Path, files: tuple[Path, ...], stamps: tuple[tuple[int, ...], ...]) -> str:
    """The digest of files as long as their stamps are these."""
    return _digest(path, files)


def _digest(path: Path, files: tuple[Path, ...]) -> str:
    digest = hashlib.sha256()
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
    stored: Mapping[str, object], wanted: Mapping[str, object], ignored: Collection[str] = ()
) -> tuple[str, object, object] | None:
    """First key whose value differs between two identities, with both values; None when they are equal.

    Of values that are tables themselves the key within is named, such as `tracker.drive`.
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


def moving_versions(versions: Mapping[str, str | None]) -> dict[str, str | None]:
    """Versions that an episode may depend on; of Python's the first two numbers."""
    kept = {name: version for name, version in versions.items() if name not in UNVERSIONED}
    if kept.get("python"):
        kept["python"] = ".".join(str(kept["python"]).split(".")[:2])
    return kept


def package_files(root: Path) -> list[Path]:
    """All files below a folder, sorted; linked folders, as in a checkout, are entered, caches are not."""
    found = []
    for folder, names, files in os.walk(root, followlinks=True):
        names[:] = sorted(name for name in names if name != "__pycache__" and not name.startswith("."))
        found += [Path(folder) / name for name in files]
    return sorted(found)


def code_files(root: Path = PACKAGE) -> list[Path]:
    """Modules of a package folder whose change may change a result: all but `UNHASHED` and command lines."""

    @functools.cache
    def counts(folder: Path) -> bool:
        room = folder.relative_to(root)
        return not any(part.as_posix() in UNHASHED for part in (room, *room.parents))

    modules = (file for file in package_files(root) if file.suffix == ".py" and file.name != "__main__.py")
    return [file for file in modules if counts(file.parent)]


def code_hash(root: Path = PACKAGE) -> str:
    """Hash of the code that a run executes, by names and contents; of this package it is taken once in a process."""
    return _running_code() if root == PACKAGE else hash_paths(root, code_files(root))


@functools.cache
def _running_code() -> str:
    """Hash of the code that was loaded: what is edited later does not run in this process."""
    return hash_paths(PACKAGE, code_files(PACKAGE))


@functools.cache
def report_hash() -> str:
    """Hash of the code that writes tables and reports: that of a run, whose names they show, and `REPORTERS`."""
    written = [file for room in REPORTERS for file in package_files(PACKAGE / room)]
    return config_hash([code_hash(), hash_paths(PACKAGE, written)])


def scene_files(root: Path, tasks: Collection[str], known: Collection[str], modes: Collection[str] = ()) -> list[Path]:
    """Layers, textures and what else is stored next to the built-in scenes of a run's tasks.

    Of the `known` tasks, this package's, the folders of those that the run lacks do not count, nor does the trackers'
    `lab`, nor what is named after a held-out mode that is not among `modes`.
    """
    others, unplayed = {"lab", *known} - set(tasks), set(all_modes.HELD_OUT) - set(modes)
    scenes = root / "usd_scenes"

    def counts(file: Path) -> bool:
        parts = file.relative_to(scenes).with_suffix("").parts
        return file.suffix not in (".py", ".pyc") and parts[0] not in others and not unplayed.intersection(parts)

    return [file for file in package_files(scenes) if counts(file)]


@functools.cache
def scenes_hash(tasks: tuple[str, ...], known: tuple[str, ...], modes: tuple[str, ...]) -> str:
    """Hash of the built-in scenes of a run's tasks, taken once in a process, which imports each scene once too."""
    return hash_paths(PACKAGE, scene_files(PACKAGE, tasks, known, modes))


def hash_paths(root: Path, files: Sequence[Path], digest: Callable[[Path], str] = hash_path) -> str:
    """Hash of files below a folder, by names and contents."""
    return config_hash([[file.relative_to(root).as_posix(), digest(file)] for file in files])


def layers_hash(stage: Path) -> str:
    """Hash of a USD file with every layer and asset that it names: the validator walks them before USD composes any."""
    from arena_newton.usd_scenes import validate

    return config_hash(sorted(map(hash_path, validate.layers(stage))))


def foreign_task(spec: TaskSpec, modes: Collection[str] = ()) -> JsonObject:
    """Hashes of a task's scene, with all that it names, and of the packages of judge, sampler and expert, unless ours.

    A kernel is hashed with the package of the judge that launches it. A record that lends all of these from this
    package is in none that is hashed: what its rules do not hold counts by itself. So do layers that replace the scene
    in `modes`, which it does not name.
    """
    codes = {own_code(spec.judge), own_code(spec.sample)}
    if spec.expert is not None:
        codes.add(_package_code(spec.expert.partition(":")[0]))
    codes.discard(None)
    facts: JsonObject = {"code": config_hash(sorted(filter(None, codes)))} if codes else {}
    if not codes and spec.scene is not None:
        facts["record"] = config_hash([repr(getattr(spec, name)) for name in UNRULED])
    if spec.scene is not None and not spec.scene.resolve().is_relative_to((PACKAGE / "usd_scenes").resolve()):
        facts["scene"] = layers_hash(spec.scene)
        layers = {mode: layers_hash(layer) for mode in modes if (layer := spec.own_layer(mode)) is not None}
        facts |= {"layers": layers} if layers else {}
    return facts


def mode_facts(name: str, rules: RuleSet, tasks: Collection[str]) -> JsonObject:
    """Hashes of a mode's ranges for some tasks, and of the package of its functions, unless the rules hold them all.

    So do layers in a folder of its own, with all that they name.
    """
    mode = all_modes.get(name)
    if mode.ruled:
        return {}
    codes = {code for part in (mode.placements, mode.light) if part and (code := own_code(part)) is not None}
    facts: JsonObject = {"ranges": mode.hash_for(rules, tasks)}
    facts |= {"code": config_hash(sorted(codes))} if codes else {}
    if mode.layers is not None:
        layers = {task: all_tasks.get(task).own_layer(name) for task in sorted(tasks)}
        facts["layers"] = {task: layers_hash(layer) for task, layer in layers.items() if layer is not None}
    return facts


def own_code(part: object) -> str | None:
    """Hash of the package, or the single module, that a tracker, policy, class or function of others was written in.

    Returns:
        None for the parts of this package, whose code is hashed as a whole.
    """
    if isinstance(part, functools.partial):
        part = part.func
    return _package_code((part if inspect.isclass(part) or inspect.isroutine(part) else type(part)).__module__)


def _package_code(path: str) -> str | None:
    """Hash of the package that a module is in, or of the single module; None for ours and Python's."""
    name = path.partition(".")[0]
    if name in {"arena_newton", *sys.stdlib_module_names}:
        return None
    if getattr(sys.modules.get(name), "__file__", None) is None:
        with contextlib.suppress(Exception):  # who plays an expert says why it does not load
            importlib.import_module(path)
    module, top = sys.modules.get(path), sys.modules.get(name)
    whole = getattr(top, "__file__", None) is not None  # not so of a namespace, which other packages may be in too
    file = getattr(top if whole else module, "__file__", None)
    if file is None:
        return None
    if whole and not hasattr(top, "__path__"):
        return hash_path(Path(file).resolve())
    folder = Path(file).resolve().parent
    return hash_paths(folder, [f for f in package_files(folder) if f.suffix == ".py"])
