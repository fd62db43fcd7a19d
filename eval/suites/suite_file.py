"""The suite file: a TOML table of policies, trackers, tasks, modes and rules, read and checked.

docs/howto/evaluate/suites.md describes its tables. Nothing is expanded here and no checkpoint is looked for: see
`matrix_cells`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError, check_once
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.schema import MAX_COUNT
from arena_newton.files.stored_json import MAX_TEXT, Json, JsonObject, check_types, shown
from arena_newton.files.text import is_printable, plain_text
from arena_newton.policies.chunk_flags import LABELS
from arena_newton.rules import modes
from arena_newton.rules.rule_types import check_name
from arena_newton.trackers import check_spec

__all__ = [
    "CONDITIONS",
    "SELECTORS",
    "SHIPPED",
    "CellRule",
    "MatrixAxes",
    "PolicyEntry",
    "Selector",
    "SuiteFile",
    "read_suite_file",
    "read_toml",
    "suite_path",
]

SHIPPED = Path(__file__).resolve().parent
"""Folder of the suite files that come with the package."""
MAX_BYTES = 1 << 20
"""A suite file with every policy of the paper has 3 kB."""
MAX_ENTRIES = 1000
"""Most policies, rules, or values of a list: a megabyte of them takes hours to multiply out. The paper's suites have 30
policies, three seeds."""
CONDITIONS = (
    *("seeds", "repeats", "max_steps", "worlds", "engine", "device", "drive", "fast_physics", "skip_broken"),
    *("video", "strip", "video_episodes", "video_size", "follow", "actions", "failures"),
    *("remote_timeout", "remote_retries", "remote_sequential", "remote_insecure"),
)
"""Flags of `eval run` that a suite may set for all its cells, in [defaults]."""
TABLES = ("name", "defaults", "matrix", "checkpoints", "policies", "cells")
LISTS = ("tasks", "trackers", "modes", "rules", "latency", "trained_on", "trained_tasks", "seeds")
"""Keys whose single value may be given without brackets."""
SELECTORS = ("policy", "family", "trained_on", "tracker", "task", "mode", "rules", "labels", "latency", "matched")
"""Keys by which cells are chosen, in [[cells]] and in --only."""
PATTERNS = ("task", "tracker")
"""Names in braces that a policy's spec may hold."""
MAX_LATENCY = 1000
"""Most ticks by which a chunk may start late; 20 s, beyond every chunk."""

type Selector = Mapping[str, tuple[str, ...]]
"""Key of `SELECTORS` → values, one of which a cell must have."""


@dataclass(frozen=True)
class MatrixAxes:
    """Table [matrix]: the axes, every combination of which is a cell."""

    tasks: tuple[str, ...] = ("all",)
    """Names of tasks, or `all`."""
    trackers: tuple[str, ...] = ("twist2",)
    """Trackers that execute."""
    modes: tuple[str, ...] = ("base",)
    rules: tuple[str, ...] = ("paper",)
    latency: tuple[int, ...] = (0,)
    """Ticks by which chunks start late."""


@dataclass(frozen=True)
class PolicyEntry:
    """Table [[policies]]: a policy, or by a pattern one for each task and each tracker of its demonstrations."""

    name: str = ""
    """Name in tables; unique, letters, digits, `_`, `-` and `+`."""
    spec: str = ""
    """Value of --policy; `{task}` and `{tracker}` stand for task and tracker of its training."""
    family: str = ""
    """Family of the policy, such as `act`; a checkpoint of ours names it itself."""
    trained_on: tuple[str, ...] = ()
    """Trackers of its demonstrations: with `{tracker}` in the spec one checkpoint for each, else one of all."""
    trained_tasks: tuple[str, ...] = ()
    """Tasks of its demonstrations, where the spec has no `{task}`; those it is played on when not given."""
    tasks: tuple[str, ...] = ()
    """Tasks that it is played on; all of [matrix] when not given, like the four that follow."""
    trackers: tuple[str, ...] = ()
    modes: tuple[str, ...] = ()
    rules: tuple[str, ...] = ()
    latency: tuple[int, ...] = ()
    labels: str = ""
    """Protocol of its actions; what its checkpoint says, or v3.1, when not given."""
    replan: int | None = None
    """Execute only so many actions of each chunk."""
    ensemble: bool = False
    """Average all chunks that cover a tick."""
    worlds: int | None = None
    """Episodes at once, instead of the suite's."""
    hub: bool = False
    """The spec names a model on a hub: no local folder is looked for."""


@dataclass(frozen=True)
class CellRule:
    """Table [[cells]]: cells that are left out, or brought back; of several rules that fit a cell the last decides."""

    include: bool
    where: str
    """Names the table in messages."""
    selector: Selector


@dataclass(frozen=True)
class SuiteFile:
    """A suite file, read and checked."""

    path: Path
    name: str
    hash: str
    """First 12 hex digits of the SHA-256 of its content."""
    defaults: JsonObject
    """Conditions of all cells, by field of `RunOptions`."""
    axes: MatrixAxes
    checkpoints: Mapping[str, str]
    """Weights by tracker; those that come with the package for others."""
    policies: tuple[PolicyEntry, ...]
    rules: tuple[CellRule, ...]


def suite_path(given: str) -> Path:
    """Path of a suite file, or of the one that comes with the package under that name.

    Raises:
        InputError: There is none.
    """
    path = Path(given).expanduser()
    if path.is_file():
        return path
    if path.exists():
        raise InputError(f"matrix {given}: is not a regular file")
    shipped = SHIPPED / f"{given}.toml"
    if re.fullmatch(r"[a-z0-9_]+", given) and shipped.is_file():
        return shipped
    known = " ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
    raise InputError(f"matrix {given}: no such file; the package brings the suites {known}")


def read_suite_file(path: Path) -> SuiteFile:
    """Read and check a suite file.

    Raises:
        InputError: It is no TOML, or a table, key or value is unknown; the message names file, table and key.
    """
    content, digest = read_toml(path)
    _check_names(str(path), content, TABLES)
    name = content.get("name", path.stem)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9+_.-]{1,64}", name) or name.startswith("."):
        raise InputError(f"{path}: name is {shown(name)}, expected letters, digits, _ - + and dots")
    entries = _tables(path, content, "policies")
    if not entries:
        raise InputError(f"{path}: has no table [[policies]], name at least one")
    policies = tuple(_policy(f"{path}: [[policies]] {n + 1}", entry) for n, entry in enumerate(entries))
    check_once(f"{path}: [[policies]]: name", (entry.name for entry in policies))
    where = f"{path}: [matrix]"
    axes = MatrixAxes(**_values(where, _table(path, content, "matrix"), MatrixAxes))
    if axes.tasks == ("all",):
        axes = dataclasses.replace(axes, tasks=tasks.PAPER)
    _check_axes(where, axes, required=True)
    for entry in policies:
        _check_within(f"{path}: [[policies]] {entry.name}", entry, axes)
    return SuiteFile(
        path=path,
        name=name,
        hash=digest,
        defaults=_defaults(path, _table(path, content, "defaults")),
        axes=axes,
        checkpoints=_checkpoints(path, _table(path, content, "checkpoints")),
        policies=policies,
        rules=tuple(
            _rule(f"{path}: [[cells]] {n + 1}", table) for n, table in enumerate(_tables(path, content, "cells"))
        ),
    )


def read_toml(path: Path) -> tuple[JsonObject, str]:
    """Content of a TOML file as JSON has it, and its hash.

    Raises:
        InputError: It cannot be read, or holds what JSON has not.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: {path.stat().st_size:,} bytes, expected at most {MAX_BYTES:,}")
        data = path.read_bytes()
        content = tomllib.loads(data.decode("utf-8-sig"))  # editors of Windows begin with a mark
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except RecursionError:
        raise InputError(f"{path}: not readable as TOML (nested too deep)") from None
    except ValueError as error:
        raise InputError(f"{path}: not readable as TOML ({plain_text(error, 200)})") from None
    _check_plain(str(path), content)
    return content, hashlib.sha256(data).hexdigest()[:12]


def _check_plain(where: str, value: object, depth: int = 0) -> None:
    """Refuse what JSON has not: dates, not-a-number, texts that no terminal can show."""
    if depth > 8:
        raise InputError(f"{where}: nested too deep")
    match value:
        case dict():
            for key, part in value.items():
                if not is_printable(key):
                    raise InputError(f"{where}: {plain_text(key, 60)} has control characters in it")
                _check_plain(f"{where}: {plain_text(key, 60)}", part, depth + 1)
        case list():
            if len(value) > MAX_ENTRIES:
                raise InputError(f"{where}: has {len(value):,} entries, expected at most {MAX_ENTRIES:,}")
            for part in value:
                _check_plain(where, part, depth + 1)
        case str():
            if not is_printable(value) or len(value) >= MAX_TEXT:
                raise InputError(f"{where}: {plain_text(value, 60)} is too long or has control characters in it")
        case bool():
            pass
        case int() | float():
            if not abs(value) <= 2**64:
                raise InputError(f"{where}: {str(value)[:40]} is a number out of range")
        case _:
            raise InputError(f"{where}: {plain_text(value, 60)} is neither text nor number, true, false, list or table")


def _table(path: Path, content: Mapping[str, Json], key: str) -> JsonObject:
    value = content.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{path}: {key} is {shown(value)}, expected a table [{key}]")
    return value


def _tables(path: Path, content: Mapping[str, Json], key: str) -> list[JsonObject]:
    value = content.get(key, [])
    if not isinstance(value, list) or not all(isinstance(part, dict) for part in value):
        raise InputError(f"{path}: {key} is {shown(value)}, expected tables [[{key}]]")
    return value


def _values(where: str, table: Mapping[str, Json], kind: type) -> JsonObject:
    """Values of a table that a dataclass describes; a single value of a list may be given without brackets."""
    listed = {k: [v] if k in LISTS and not isinstance(v, list) else v for k, v in table.items()}
    return check_types(where, listed, kind)


def _defaults(path: Path, table: Mapping[str, Json]) -> JsonObject:
    where = f"{path}: [defaults]"
    _check_names(where, table, CONDITIONS)
    return _values(where, table, RunOptions)


def _checkpoints(path: Path, table: Mapping[str, Json]) -> dict[str, str]:
    for tracker, weights in table.items():
        where = f"{path}: [checkpoints]: {plain_text(tracker, 60)}"
        if not isinstance(weights, str) or not weights:
            raise InputError(f"{where} is {shown(weights)}, expected a path")
        _of(where, check_spec, tracker)
    return dict(table)


def _of(where: str, check: Callable[[str], object], value: str) -> None:
    """Put table and key in front of what a check of the product says."""
    try:
        check(value)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _check_axes(where: str, axes: MatrixAxes | PolicyEntry, *, required: bool = False) -> None:
    """Hold the values of axes to what the product knows."""
    for key in ("tasks", "trackers", "modes", "rules", "latency"):
        values = getattr(axes, key)
        if required and not values:
            raise InputError(f"{where}: {key} is empty, name at least one")
        check_once(f"{where}: {key}:", values)
    _check_names(f"{where}: tasks", axes.tasks, tasks.names())
    _check_names(f"{where}: modes", axes.modes, modes.names())
    for tracker in axes.trackers:
        _of(f"{where}: trackers", check_spec, tracker)
    for rules in axes.rules:
        _of(f"{where}: rules", check_name, rules)
        rule_sets.get(rules)
    for latency in axes.latency:
        if not 0 <= latency <= MAX_LATENCY:
            raise InputError(f"{where}: latency is {latency}, expected 0 to {MAX_LATENCY} ticks")


def _check_names(where: str, values: Iterable[str], known: Sequence[str]) -> None:
    for value in values:
        if value not in known:
            raise InputError(f"{where}: {plain_text(value, 60)} is unknown, known are {' '.join(known)}")


def _policy(where: str, table: Mapping[str, Json]) -> PolicyEntry:
    entry = PolicyEntry(**_values(where, table, PolicyEntry))
    if not re.fullmatch(r"[A-Za-z0-9+_-]{1,64}(#[1-9][0-9]{0,3})?", entry.name):
        expected = "letters, digits, _ - and +; #2 at the end for a second training of one recipe"
        raise InputError(f"{where}: name is {shown(entry.name)}, expected {expected}")
    where = f"{where} ({entry.name})"
    if not entry.spec or len(entry.spec) > 400:
        raise InputError(
            f"{where}: spec is {shown(entry.spec)}, expected what --policy takes, such as lerobot:<folder>"
        )
    patterns = re.findall(r"\{([^{}]*)\}", entry.spec)
    if entry.spec.count("{") != len(patterns) or entry.spec.count("}") != len(patterns):
        raise InputError(f"{where}: spec {entry.spec}: has a brace without its pair")
    for pattern in patterns:
        if pattern not in PATTERNS:
            raise InputError(
                f"{where}: spec {entry.spec}: {{{pattern}}} is unknown, known are {{task}} and {{tracker}}"
            )
    if "tracker" in patterns and not entry.trained_on:
        raise InputError(f"{where}: spec has {{tracker}}, name the trackers of its demonstrations in trained_on")
    if "task" in patterns and entry.trained_tasks:
        raise InputError(f"{where}: trained_tasks: belongs to a spec without {{task}}")
    if entry.trained_tasks and not entry.trained_on:
        raise InputError(f"{where}: trained_tasks: belongs to trained_on, which is not given")
    _check_names(f"{where}: trained_tasks", entry.trained_tasks, tasks.names())
    for tracker in entry.trained_on:
        if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", tracker):
            raise InputError(f"{where}: trained_on is {shown(tracker)}, expected names of trackers")
    for key in ("trained_on", "trained_tasks"):
        check_once(f"{where}: {key}:", getattr(entry, key))
    if entry.labels and entry.labels not in LABELS:
        raise InputError(f"{where}: labels is {shown(entry.labels)}, known are {' '.join(LABELS)}")
    for key in ("replan", "worlds"):
        value = getattr(entry, key)
        if value is not None and not 1 <= value <= MAX_COUNT:
            raise InputError(f"{where}: {key} is {value}, expected at least 1")
    return entry


def _check_within(where: str, entry: PolicyEntry, axes: MatrixAxes) -> None:
    """An entry narrows the axes of [matrix]; it has nothing beyond them."""
    _check_axes(where, entry)
    for key in ("tasks", "trackers", "modes", "rules", "latency"):
        known = getattr(axes, key)
        for value in getattr(entry, key):
            if value not in known:
                raise InputError(f"{where}: {key}: {value} is not in [matrix], which has {' '.join(map(str, known))}")


def _rule(where: str, table: Mapping[str, Json]) -> CellRule:
    if len(table) != 1 or next(iter(table)) not in ("include", "exclude"):
        given = " ".join(plain_text(key, 60) for key in table) or "nothing"
        raise InputError(f"{where}: has {given}, expected either include = {{...}} or exclude = {{...}}")
    ((kind, chosen),) = table.items()
    if not isinstance(chosen, dict) or not chosen:
        raise InputError(f'{where}: {kind} is {shown(chosen)}, expected a table such as {{ task = "boxing" }}')
    _check_names(f"{where}: {kind}", chosen, SELECTORS)
    found = {}
    for key, value in chosen.items():
        parts = value if isinstance(value, list) else [value]
        if not parts or not all(isinstance(part, str | int | bool) for part in parts):
            raise InputError(f"{where}: {kind}: {key} is {shown(value)}, expected names")
        found[key] = tuple(str(part).lower() if isinstance(part, bool) else str(part) for part in parts)
    return CellRule(kind == "include", f"{where}: {kind}", found)
