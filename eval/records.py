"""What stands in a results folder: the two files that others may have written are checked when they are read.

Everything that is derived from a journal (tables, pages, the original's files) is written by names that stand in it,
and whoever reads a report may have been sent the folder. A record that fits here has known names and numbers in range.
"""

from __future__ import annotations

import errno
import itertools
import json
import math
import os
import re
import stat
import sys
import types
import typing
import unicodedata
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from arena_newton.errors import InputError

__all__ = [
    "CONFIG_FILE",
    "JOURNAL_FILE",
    "MAX_COUNT",
    "MAX_EPISODES",
    "MAX_SEED",
    "OUTCOMES",
    "SUBFOLDERS",
    "check_document",
    "check_folder",
    "check_plan",
    "check_record",
    "check_types",
    "counted",
    "fit",
    "is_printable",
    "parse",
    "plain_text",
    "read_document",
    "read_regular",
]

CONFIG_FILE = "config.json"
JOURNAL_FILE = "episodes.jsonl"
SUBFOLDERS = ("videos", "strips", "actions", "original", "expert")
"""Folders that a run writes inside its own."""

OUTCOMES = ("success", "fall", "timeout", "error")

MAX_CONFIG_BYTES = 16 << 20
MAX_JOURNAL_BYTES = 512 << 20
"""Room for 400,000 episodes at a little more than 1 kB each."""
MAX_DEPTH = 16
"""Nesting of objects and arrays; ours go to 5."""
MAX_NAME = 512
"""Characters of a name such as a policy with its address."""
MAX_COUNT = 10**7
"""Steps, repeats, episodes."""
MAX_SEED = 2**64
MAX_EPISODES = 200_000
"""Episodes of one plan; the benchmark's largest has 1,680."""

_ESCAPES = re.compile(
    r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|[PX^_][^\x1b]*(?:\x1b\\)?|[@-Z\\-_])?"
)
"""Terminal escapes: control sequences, strings with their ends, single characters (ECMA-48)."""


_DIRECTIONS = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"


def plain_text(text: object, limit: int = 2000) -> str:
    """One line without terminal escapes, control characters and unpaired surrogates, at most ``limit`` characters."""
    kept = (" " if c.isspace() else c for c in _ESCAPES.sub(" ", str(text)))
    line = " ".join("".join(c for c in kept if not _unfit(c)).split())
    return line if len(line) <= limit else line[: limit - 1] + "…"


def is_printable(text: str) -> bool:
    """Whether a text has no control characters, unpaired surrogates or marks that turn its direction."""
    return text.isprintable() or not any(map(_unfit, text))


def _unfit(character: str) -> bool:
    """Control characters, surrogates and marks that turn the direction of text."""
    return unicodedata.category(character) in ("Cc", "Cs") or character in _DIRECTIONS


def counted(number: int, noun: str) -> str:
    """A number with its noun, such as ``1 episode`` and ``2 episodes``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def read_regular(path: Path, limit: int) -> bytes:
    """Content of a regular file of at most ``limit`` bytes; links, pipes and devices are refused.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: It is something else, too large, or cannot be read.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        raise
    except OSError as error:
        link = error.errno == errno.ELOOP
        raise InputError(f"{path}: {'is a link' if link else f'cannot be read ({error.strerror})'}") from None
    with os.fdopen(handle, "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise InputError(f"{path}: is no regular file")
        if about.st_size > limit:
            raise InputError(f"{path}: {about.st_size:,} bytes, expected at most {limit:,}")
        try:
            return file.read()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def parse(data: bytes) -> Any:
    """Strict JSON: no NaN, no infinity, no number beyond float, nothing nested too deep, no unpaired surrogate.

    Raises:
        ValueError: It is not.
    """

    def refuse(name: str) -> Any:
        raise ValueError(f"{name} is no JSON")

    try:
        text = data.decode("utf-8")
        value = json.loads(text, parse_constant=refuse)
        if "\\u" in text:  # an escape is the only way to an unpaired surrogate, which no file can be written with
            json.dumps(value, ensure_ascii=False).encode("utf-8")
    except RecursionError:
        raise ValueError("nested too deep") from None
    waiting = [(value, 0)]
    while waiting:
        part, depth = waiting.pop()
        if depth > MAX_DEPTH:
            raise ValueError("nested too deep")
        if isinstance(part, float) and not math.isfinite(part):
            raise ValueError("a number beyond range")
        if isinstance(part, dict):
            waiting += [(p, depth + 1) for pair in part.items() for p in pair]
        elif isinstance(part, list):
            waiting += [(p, depth + 1) for p in part]
    return value


def _name(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= MAX_NAME and is_printable(value)


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


def _number(value: Any) -> bool:
    """A number that a float can hold: JSON's integers have no end."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _facts(value: Any) -> bool:
    """An object whose numbers, at any depth, a float can hold."""
    waiting = [value]
    while waiting:
        part = waiting.pop()
        if isinstance(part, dict):
            waiting += part.values()
        elif isinstance(part, list):
            waiting += part
        elif isinstance(part, (int, float)) and not isinstance(part, bool) and not _number(part):
            return False
    return isinstance(value, dict)


def _count(least: int, most: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _none_or(test: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or test(value)


def _list_of(test: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(map(test, value))


def _table_of(test: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(_name(k) and test(v) for k, v in value.items())


def _distinct_names(value: Any) -> bool:
    return _list_of(_name)(value) and bool(value) and len(set(value)) == len(value)


_INT = _count(0, MAX_COUNT)
_SEED = _count(0, MAX_SEED)
Fields = Mapping[str, tuple[Callable[[Any], bool], str]]

_REQUIRED: Fields = {
    "index": (_INT, "a number of the plan"),
    "tracker": (_name, "a name"),
    "policy": (_name, "a name"),
    "group_seed": (_SEED, "a number of at least 0"),
    "repeat": (_INT, "a number of at least 0"),
    "outcome": (lambda value: value in OUTCOMES, " ".join(OUTCOMES)),
    "steps": (_INT, "a number of ticks"),
    "max_steps": (_INT, "a number of ticks"),
    "episode_seed": (_SEED, "a number of at least 0"),
    "object_seed": (_SEED, "a number of at least 0"),
}
_OPTIONAL: Fields = {
    "rules": (_name, "a name"),
    "engine": (_name, "a name"),
    "reason": (_none_or(lambda value: value == "" or _name(value)), "a name"),
    "margin": (_none_or(_number), "a number or null"),
    "startup_fall": (_flag, "true or false"),
    "overflow": (_flag, "true or false"),
    "error": (_none_or(_text), "text or null"),
    "durations": (_none_or(_table_of(_number)), "numbers by name"),
    "started_at": (_none_or(_text), "text"),
    "finished_at": (_none_or(_text), "text"),
    "media": (_none_or(_table_of(_text)), "paths by name"),
    "video": (_none_or(_text), "a path"),
    "hashes": (_table_of(_none_or(_name)), "hashes by name"),
}
_CONFIG: Fields = {
    "rules": (_name, "a name"),
    "seeds": (lambda value: _list_of(_SEED)(value) and value and len(set(value)) == len(value), "distinct numbers"),
    "repeats": (_count(1, MAX_COUNT), "a number of at least 1"),
    "max_steps": (_none_or(_count(1, MAX_COUNT)), "a number of ticks or null"),
}
_CONFIG_OPTIONAL: Fields = {
    "task": (_distinct_names, "names of tasks"),
    "mode": (_distinct_names, "names of modes"),
    "version": (_name, "a version"),
    "tracker": (_name, "a name"),
    "policy": (_name, "a name"),
    "engine": (_name, "a name"),
    "device": (_name, "a name"),
    "drive": (_name, "a name"),
    "checkpoint": (_none_or(_name), "a hash or null"),
    "policy_file": (_none_or(_name), "a hash or null"),
    "variant": (_none_or(_name), "a hash or null"),
    "rules_hash": (_name, "a hash"),
    "scenes": (_text, "a hash"),
    "code": (_text, "a hash"),
    "worlds": (_none_or(_number), "a number or null"),
    "fast_physics": (_flag, "true or false"),
    "tracker_facts": (_none_or(_facts), "facts by name or null"),
    "policy_facts": (_none_or(_facts), "facts by name or null"),
}
_DOCUMENT: Fields = {
    "config": (lambda value: isinstance(value, dict), "an object"),
    "config_hash": (lambda v: isinstance(v, str) and bool(re.fullmatch("[0-9a-f]{12}", v)), "12 hex digits"),
    "options": (lambda value: isinstance(value, dict), "an object"),
    "planned": (_INT, "a number of episodes"),
    "gym_ids": (_table_of(_name), "Gym ids by task"),
    "rule_set": (_table_of(_text), "texts by item"),
}
_DOCUMENT_OPTIONAL: Fields = {
    "versions": (_table_of(_none_or(_name)), "versions by library"),
    "later_versions": (_list_of(_table_of(_none_or(_name))), "versions by library"),
    "environments": (_table_of(_facts), "facts by task and mode"),
    "variant_changes": (_list_of(_text), "sentences"),
}


def fit(where: str, values: Mapping[str, Any], fields: Fields, *, required: bool = True) -> None:
    """Hold values to their fields.

    Raises:
        InputError: One is absent or unfit; the message starts with ``where``.
    """
    for key, (test, expected) in fields.items():
        if key not in values:
            if required:
                raise InputError(f"{where}: {key} is missing, expected {expected}")
        elif not test(values[key]):
            raise InputError(f"{where}: {key} is {_shown(values[key])}, expected {expected}")


def _shown(value: Any) -> str:
    return plain_text(json.dumps(value, ensure_ascii=True), 60)


def _known(where: str, key: str, value: Any, names: typing.Collection[str]) -> None:
    if not isinstance(value, str) or value not in names:
        raise InputError(f"{where}: {key} is {_shown(value)}, known are {' '.join(names)}")


def check_record(where: str, record: Any) -> dict[str, Any]:
    """A line of a journal.

    Args:
        where: File and line, for messages.
        record: What the line holds.

    Raises:
        InputError: It is no record of an episode.
    """
    from arena_newton import tasks
    from arena_newton.rules import MODES

    _known(where, "task", record.get("task"), tasks.names())
    _known(where, "mode", record.get("mode"), MODES)
    fit(where, record, _REQUIRED)
    fit(where, record, _OPTIONAL, required=False)
    return record


def check_document(path: Path, document: Any) -> dict[str, Any]:
    """The content of a results folder's config.json.

    Raises:
        InputError: It is no configuration of a run.
    """
    from arena_newton import tasks

    if not isinstance(document, dict):
        raise InputError(f"{path}: cannot be read as the configuration of a run")
    where = f"{path}: cannot be read as the configuration of a run"
    fit(where, document, _DOCUMENT)
    fit(where, document, _DOCUMENT_OPTIONAL, required=False)
    fit(f"{where}: config", document["config"], _CONFIG)
    fit(f"{where}: config", document["config"], _CONFIG_OPTIONAL, required=False)
    for key, value in document["config"].items():
        if not _name(key) or (isinstance(value, str) and not _name(value)):
            raise InputError(f"{where}: config: {_shown(key)} is {_shown(value)}, expected plain text")
    for task in document["gym_ids"]:
        _known(f"{path}: gym_ids", "task", task, tasks.names())
    return document


def read_document(folder: Path) -> dict[str, Any]:
    """Read a results folder's config.json.

    Raises:
        InputError: The folder holds no run, or something that is none.
    """
    path = folder / CONFIG_FILE
    try:
        document = parse(read_regular(path, MAX_CONFIG_BYTES))
    except FileNotFoundError:
        raise InputError(f"{folder}: no results folder (it has no {CONFIG_FILE})") from None
    except ValueError:
        raise InputError(f"{path}: cannot be read as the configuration of a run") from None
    return check_document(path, document)


def check_plan(path: Path, records: typing.Iterable[dict[str, Any]], document: Mapping[str, Any]) -> None:
    """Hold a journal to its configuration.

    No episode that the plan lacks or that another run played, none twice under two numbers, and none again that had
    ended as something else than an error; seeds and step budgets are the plan's.

    Args:
        path: The journal, for messages.
        records: Its lines, in their order.
        document: Content of config.json.

    Raises:
        InputError: A record belongs to another plan or another run.
    """
    from arena_newton import seeding

    config = document["config"]
    numbers: dict[tuple[Any, ...], int] = {}
    ended: dict[int, str] = {}
    budgets, places = _budgets(config), _places(path.with_name(CONFIG_FILE), config)
    if places and document["planned"] != len(places):
        raise InputError(
            f"{path.with_name(CONFIG_FILE)}: planned is {document['planned']}, the plan has {len(places)}; "
            "it was changed by hand"
        )
    run = {key: config[key] for key in ("tracker", "policy", "rules", "engine") if key in config}
    for record in records:
        key = (record["task"], record["mode"], record["group_seed"], record["repeat"])
        name = f"{path}: episode {record['index']} ({key[0]} {key[1]} seed {key[2]} repeat {key[3]})"
        if (
            record["index"] >= document["planned"]
            or record["task"] not in document["gym_ids"]
            or record["group_seed"] not in config["seeds"]
            or record["repeat"] >= config["repeats"]
            or ("mode" in config and record["mode"] not in config["mode"])
        ):
            raise InputError(f"{name}: is not in the plan of {CONFIG_FILE}; the journal was changed by hand")
        if numbers.setdefault(key, record["index"]) != record["index"]:
            raise InputError(f"{name}: stands in the journal as episode {numbers[key]} too")
        seed = seeding.episode_seed(document["gym_ids"][record["task"]], record["group_seed"], record["repeat"])
        planned = run | {"episode_seed": seed, "object_seed": seeding.object_seed(seed)}
        if record["task"] in budgets:
            planned["max_steps"] = budgets[record["task"]]
        if key in places:
            planned["index"] = places[key]
        told = record | {"config hash": (record.get("hashes") or {}).get("config")}
        for field, wanted in (planned | {"config hash": document["config_hash"]}).items():
            if told.get(field) != wanted:
                raise InputError(
                    f"{name}: {field} is {_shown(told.get(field))}, this run's is {_shown(wanted)}; "
                    "the journal was changed by hand"
                )
        if record["steps"] > record["max_steps"]:
            raise InputError(
                f"{name}: {record['steps']} steps of at most {record['max_steps']}; the journal was changed by hand"
            )
        if ended.get(record["index"], "error") != "error":
            raise InputError(
                f"{name}: stands in the journal again after it had ended ({ended[record['index']]}); "
                "the journal was changed by hand"
            )
        ended[record["index"]] = record["outcome"]


def _budgets(config: Mapping[str, Any]) -> dict[str, int]:
    """Step budgets by task; none where the run's rule set is not one that is known here."""
    from arena_newton import rule_sets, tasks

    names = config.get("task", ())
    if config["rules"] not in rule_sets.names() or not set(names) <= set(tasks.names()):
        return {}
    rule_set = rule_sets.get(config["rules"])
    if config.get("rules_hash") != rule_set.hash_for(tuple(names)):
        return {}
    cap = config["max_steps"]
    budgets = {name: tasks.get(name).max_steps(rule_set) for name in names}
    return {name: budget if cap is None else min(budget, cap) for name, budget in budgets.items()}


def _places(path: Path, config: Mapping[str, Any]) -> dict[tuple[Any, ...], int]:
    """Numbers of the plan's episodes by task, mode, group seed and repeat; none where the plan is not told."""
    if "task" not in config or "mode" not in config:
        return {}
    parts = (config["task"], config["mode"], config["seeds"], range(config["repeats"]))
    if math.prod(map(len, parts)) > MAX_EPISODES:
        raise InputError(f"{path}: plans more than {MAX_EPISODES:,} episodes")
    return {key: number for number, key in enumerate(itertools.product(*parts))}


def check_folder(folder: Path) -> None:
    """Refuse a results folder whose own folders are links: a run writes inside its folder only.

    Raises:
        InputError: One is a link.
    """
    for name in SUBFOLDERS:
        if (folder / name).is_symlink():
            raise InputError(f"{folder / name}: is a link; a run writes inside its own folder only")


def check_types(where: str, values: Mapping[str, Any], kind: type) -> dict[str, Any]:
    """Values of a dataclass that were stored as JSON; arrays become tuples.

    Args:
        where: File, for messages.
        values: Stored values by field.
        kind: The dataclass.

    Raises:
        InputError: An unknown field, or a value of another type.
    """
    hints = typing.get_type_hints(kind)
    found = {}
    for key, value in values.items():
        if key not in hints:
            raise InputError(f"{where}: {plain_text(key, 60)} is no option, known are {' '.join(hints)}")
        value = tuple(value) if isinstance(value, list) else value
        if not _of(value, hints[key]):
            raise InputError(f"{where}: {key} is {_shown(values[key])}, expected {_type_name(hints[key])}")
        found[key] = value
    return found


def _of(value: Any, hint: Any) -> bool:
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return _of(value, typing.get_args(hint)[0])
    if origin in (types.UnionType, typing.Union):
        return any(_of(value, part) for part in typing.get_args(hint))
    if origin is tuple:
        return isinstance(value, tuple) and all(_of(part, typing.get_args(hint)[0]) for part in value)
    if hint is type(None):
        return value is None
    if hint is str:
        return isinstance(value, str) and len(value) < 1 << 16 and is_printable(value)
    if hint is float:
        return _number(value)
    return type(value) is hint


def _type_name(hint: Any) -> str:
    return hint.__name__ if type(hint) is type else str(hint).replace("typing.", "")
