"""Words and addresses that the reports share: a run's recordings, rules, environments and commands.

Whatever comes from a results folder is text here: nothing in a journal can become an element, and media are linked only
as plain names in `videos/` and `strips/`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from arena_newton import tasks as specs
from arena_newton.cli.flags import shell_command, typed
from arena_newton.eval.plan.options import Remote
from arena_newton.eval.records.document import Identity
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.files.stored_json import Json
from arena_newton.files.text import plain

__all__ = [
    "MEDIA",
    "environment_facts",
    "media_of",
    "replay_command",
    "rules_that_ran",
    "safe_media",
    "tasks_of",
]

MEDIA = {"ego strip": "head camera", "world strip": "world camera", "ego": "head camera", "world": "world camera"}
"""Media of an episode that the page knows → what they show."""
REPLAYED = ("policy", "checkpoint", "labels", "replan", "rules", "drive", "engine", "device", "variant", "max_steps")
"""Flags with a value on which an episode depends, besides its task, tracker, mode, seed and repeat."""

_NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}"
_PATH = re.compile(rf"videos/{_NAME}\.mp4|strips/{_NAME}\.(?:png|jpg)")


def safe_media(path: object) -> str | None:
    """A recording's path if it is a plain name in `videos/` or `strips/`, None otherwise."""
    return path if isinstance(path, str) and _PATH.fullmatch(path) else None


def media_of(record: EpisodeRecord) -> dict[str, str]:
    """An episode's recordings that the page knows, by name."""
    given = record.media or {}
    found = {name: safe_media(given.get(name)) for name in MEDIA}
    return {name: path for name, path in found.items() if path is not None}


def replay_command(options: Mapping[str, Json], record: EpisodeRecord, worlds: object = None) -> str:
    """The command line that plays an episode again, the last one of its seed's that it plays.

    `options` are the run's flags as in config.json; `worlds` asked at once, where the policy depends on their number.
    """
    series, scale = options.get("series"), options.get("disturb_scale")
    given: dict[str, object] = {"task": record.task, "mode": record.mode, "tracker": record.tracker}
    if series is not None:
        given |= {"seed_series": record.group_seed, "episodes": record.repeat + 1}
        given |= {} if options.get("disturb") is True else {"disturb": False}
    else:
        given |= {"seeds": record.group_seed, "repeats": record.repeat + 1}
    given |= {name: options.get(name) for name in REPLAYED if options.get(name) not in ("", "auto")}
    for name in Remote.names_for(plain(options.get("policy"))):
        value = options.get(name, default := getattr(Remote, name))
        given |= {name: value} if value is not False and value != default else {}
    given |= {
        "latency_ticks": options.get("latency_ticks") or None,
        "ensemble": options.get("ensemble") is True or None,
    }
    given |= {"disturb_scale": scale} if series is not None and scale != 1.0 else {}
    given |= {"worlds": worlds, "fast_physics": options.get("fast_physics") is True or None}
    given |= {} if series is not None else {"video": True, "strip": True}
    typed_words = [plain(word) for name, value in given.items() for word in typed(name, value)]
    return shell_command("arena_newton.eval", *(["record"] if series is not None else []), *typed_words)


def environment_facts(facts: Mapping[str, Json]) -> list[tuple[str, str]]:
    """Environment's own description, in words: engine, physics rate, drive, start-up and the rest."""
    left = dict(facts)
    found: list[tuple[str, str]] = [(name, plain(left.pop(name))) for name in ("engine", "device") if name in left]
    dt, substeps = left.pop("physics_dt", None), left.pop("substeps", None)
    if isinstance(dt, int | float) and not isinstance(dt, bool):
        found.append(("physics", f"{1e3 * dt:g} ms" + (f" × {plain(substeps)}" if substeps is not None else "")))
    if "drive" in left:
        found.append(("drive", plain(left.pop("drive"))))
    if "startup_ticks" in left:
        found.append(("start-up", f"{plain(left.pop('startup_ticks'))} ticks"))
    return found + [(plain(name), plain(value)) for name, value in left.items()]


def tasks_of(config: Identity, records: Sequence[EpisodeRecord]) -> list[str]:
    """Names of a run's tasks: those of its configuration, or those of its records where that names none."""
    named = config.get("task")
    return [plain(name) for name in (named if named is not None else dict.fromkeys(r.task for r in records))]


def rules_that_ran(rule_set: Mapping[str, str], tasks: Sequence[str]) -> list[tuple[str, str]]:
    """The rows of a rule set that speak of the tasks of a run, or of all tasks."""
    known = {spec.name: spec for spec in specs.specs()}
    owners = {item: name for name, spec in known.items() for item, _ in spec.rules.paper.success.notes()}
    records = {name: {o.record for o in spec.objects} for name, spec in known.items()}
    ours = set(tasks) & set(known)
    ours |= {record for name in ours for record in records[name]}
    others = {*known, *(record for found in records.values() for record in found)} - ours
    rows = []
    for item, message in rule_set.items():
        named = {*re.findall(r"\w+", plain(item)), owners.get(plain(item), "")} & set(known)
        if named and not named & set(tasks):
            continue
        text = plain(message).replace("see the ranges below", "ranges: docs/reference/rules.md")
        # A remark on other tasks alone is left out; lists of tasks or of their objects keep what belongs to the run.
        for remark in re.findall(r" \([^()]*\)", text):
            named_here = set(re.findall(r"\w+", remark)) & set(known)
            text = text.replace(remark, "") if named_here and not named_here & set(tasks) else text
        parts = text.split(", ")
        if all(part.split(" ")[0] in ours | others for part in parts):
            parts = [part for part in parts if part.split(" ")[0] in ours]
        if parts:
            rows.append((plain(item), ", ".join(parts)))
    return rows
