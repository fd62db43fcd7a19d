"""``python -m benchmarks forgeries``: a results folder forged in some seventy ways, and what of an audit finds each.

The forger knows the format: links and tables are made again after each change.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import hashlib
import io
import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.audit.action_replay import replay
from arena_newton.eval.audit.draws import drawn
from arena_newton.eval.audit.folder_audit import audited
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.eval.commands.run import run as evaluate
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.folders.run_folder import comparable, stored_options
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.eval.records.identity import config_hash
from arena_newton.eval.records.journal import JOURNAL_FILE
from arena_newton.eval.reports import report
from arena_newton.files.untrusted_files import array_digest
from arena_newton.trackers.base import Tracker
from benchmarks.bench_options import ForgeryOptions

__all__ = ["FORGERIES", "PLAYED", "TABLES", "forge", "forgery_figures", "journal_lines", "level_of"]
__all__ += ["write_lines"]

type Line = dict[str, Any]
type Forgery = Callable[[Path, list[Line]], None]
"""Changes a folder, whose journal lines are written again afterwards."""


def first(lines: list[Line], outcome: str) -> Line:
    """First line with an outcome.

    Raises:
        InputError: There is none, so that nothing can be forged of it.
    """
    for line in lines:
        if line["outcome"] == outcome:
            return line
    raise InputError(f"the folder has no {outcome}")


def edited(of: str, /, **changes: Any) -> Forgery:
    """Forgery of one line: that of the first episode with an outcome; a callable is given the line."""

    def change(folder: Path, lines: list[Line]) -> None:
        line = first(lines, of)
        line.update({key: value(line) if callable(value) else value for key, value in changes.items()})

    return change


def hashed(name: str) -> Forgery:
    """Forgery of one of the hashes of a line."""
    return edited("timeout", hashes=lambda line: line["hashes"] | {name: "0" * 12})


def won(line: Line) -> None:
    """A failure as a careful forger makes a success of it: margin, progress and predicates too, the fall removed."""
    held = {name: line["steps"] for name in line["predicates"]}
    line |= {"outcome": "success", "reason": "success", "margin": 0.3, "progress": 1.0, "predicates": held}
    line["events"] = [event for event in line["events"] if event["kind"] != "fall"]


def unplayable(line: Line) -> None:
    """An episode as one that ended before its first action, of which there is nothing to play again."""
    line |= {"steps": 0, "media": {}, "phases": []}
    for key in ("actions", "final_state", "shown", "signals"):
        line.pop(key, None)


def won_at_once(folder: Path, lines: list[Line]) -> None:
    """A failure made a success before the policy's first action."""
    line = first(lines, "timeout")
    unplayable(line)
    won(line)


def fell_at_once(folder: Path, lines: list[Line]) -> None:
    """A fall said to be the tracker's in the start-up."""
    line = first(lines, "fall")
    unplayable(line)
    held = dict.fromkeys(line["predicates"])
    line |= {"reason": "startup_fall", "startup_fall": True, "predicates": held, "progress": 0.0}
    line["events"] = [{"kind": "fall", "tick": 0, "detail": "tilt"}]


def kept_nothing(folder: Path, lines: list[Line]) -> None:
    """A failure made a success, of a run that is said to have kept no actions of it."""
    line = first(lines, "timeout")
    won(line)
    for key in ("actions", "final_state", "shown"):
        line.pop(key)
    line["media"].pop("actions")
    document(folder, options__actions=False)


def with_predicate(folder: Path, lines: list[Line]) -> None:
    """The first predicate of a timeout said to have held in its second tick, with the progress of all that did."""
    line = first(lines, "timeout")
    line["predicates"] = held = line["predicates"] | {next(iter(line["predicates"])): 2}
    line["progress"] = sum(tick is not None for tick in held.values()) / len(held)


def all_won(folder: Path, lines: list[Line]) -> None:
    """Every failure made a success."""
    lost = [line for line in lines if line["outcome"] != "success"]
    if not lost:
        raise InputError("the folder has no failure")
    for line in lost:
        won(line)


def document(folder: Path, **changes: Any) -> Line:
    """Content of config.json, after changes of its keys, such as `status__state`."""
    path = folder / CONFIG_FILE
    content: Line = json.loads(path.read_text())
    for key, value in changes.items():
        *inside, last = key.split("__")
        part = content
        for name in inside:
            part = part[name]
        part[last] = value
    if changes:
        path.write_text(json.dumps(content, indent=2) + "\n")
    return content


def claimed(*, of_lines: Forgery = lambda folder, lines: None, **changes: Any) -> Forgery:
    """Forgery of the configuration, whose hash is made again in it and in all lines, after changes of the lines."""

    def change(folder: Path, lines: list[Line]) -> None:
        hashed = config_hash(document(folder, **changes)["config"])
        document(folder, config_hash=hashed)
        of_lines(folder, lines)
        for line in lines:
            line["hashes"]["config"] = hashed

    return change


def other_weights(folder: Path, lines: list[Line]) -> None:
    """The trackers' weights under another hash, in the configuration and in every line."""
    names = document(folder)["config"]["checkpoint"]
    claimed(config__checkpoint=dict.fromkeys(names, "0" * 12))(folder, lines)
    for line in lines:
        line["hashes"]["checkpoint"] = "0" * 12


def other_policy_file(folder: Path, lines: list[Line]) -> None:
    """The weights of the policy under another hash."""
    for line in lines:
        line["hashes"]["policy"] = "0" * 12


def other_environment(folder: Path, lines: list[Line]) -> None:
    """Physics of another rate, in the configuration and in every line."""
    environments = document(folder)["environments"]
    for facts in environments.values():
        facts["physics_dt"] = 0.002
    document(folder, environments=environments)
    for line in lines:
        facts = environments[f"{line['task']} {line['tracker']} {line['mode']}"]
        line["hashes"]["environment"] = config_hash(comparable(facts))


def other_code_and_environment(folder: Path, lines: list[Line]) -> None:
    """The same, with the hash of another version's code to explain it."""
    claimed(config__code="0" * 12)(folder, lines)
    other_environment(folder, lines)


def other_drive(folder: Path, lines: list[Line]) -> None:
    """Other gains of the joints, in configuration and flags alike."""
    claimed(config__drive="humanoidarena", options__drive="humanoidarena")(folder, lines)


def other_signals(folder: Path, lines: list[Line]) -> None:
    """A failure that a tracker's legs are said to have caused."""
    for line in lines:
        if line["outcome"] != "success" and line.get("signals"):
            line["signals"] |= {"tracking_error": 0.2, "tracking_worst": 0.3}
            return
    raise InputError("the folder has no failure with signals (--failures)")


def seed_dropped(folder: Path, lines: list[Line]) -> None:
    """The worst group seed left out of the plan."""
    seeds = document(folder)["config"]["seeds"]
    if len(seeds) < 2:
        raise InputError("the folder has one group seed")
    won = Counter(line["group_seed"] for line in lines if line["outcome"] == "success")
    kept = [seed for seed in seeds if seed != min(seeds, key=lambda seed: won[seed])]
    lines[:] = [line for line in lines if line["group_seed"] in kept]
    ranked = {index: number for number, index in enumerate(sorted(line["index"] for line in lines))}
    for line in lines:
        line["index"] = ranked[line["index"]]
    claimed(config__seeds=kept, options__seeds=kept, planned=len(lines))(folder, lines)


def downgraded(folder: Path, lines: list[Line]) -> None:
    """Lines said to be of a version without chain and hashes, and a failure made a success."""
    won(first(lines, "timeout"))
    for line in lines:
        line["schema"] = 2
        for key in ("actions", "final_state", "shown", "previous"):
            line.pop(key, None)


def copied_success(folder: Path, lines: list[Line]) -> None:
    """A failure replaced by a success of its task: result, actions and hashes, under the failure's own seeds."""
    lost = first(lines, "timeout")
    alike = [line for line in lines if line["outcome"] == "success" and line["task"] == lost["task"]]
    if not alike:
        raise InputError(f"the folder has no success in {lost['task']}")
    kept = "index tracker mode group_seed repeat episode_seed object_seed media started_at finished_at".split()
    with np.load(folder / alike[0]["media"]["actions"]) as stored:
        arrays = dict(stored) | {"episode_seed": np.asarray(np.int64(lost["episode_seed"]))}
    np.savez_compressed(folder / lost["media"]["actions"], **arrays)
    lost |= {key: value for key, value in alike[0].items() if key not in kept}
    lost["actions"] = array_digest(arrays)


def dropped(folder: Path, lines: list[Line]) -> None:
    """A failure left out."""
    lines.remove(first(lines, "timeout"))


def dropped_and_unfinished(folder: Path, lines: list[Line]) -> None:
    """A failure left out of a run that is said to be cancelled."""
    dropped(folder, lines)
    document(folder, status__state="cancelled")


def exchanged(folder: Path, lines: list[Line]) -> None:
    """The outcome of one episode under the name of another."""
    one, other = first(lines, "success"), first(lines, "timeout")
    for key in ("index", "repeat", "group_seed", "episode_seed", "object_seed"):
        one[key], other[key] = other[key], one[key]


def exchanged_actions(folder: Path, lines: list[Line]) -> None:
    """The files of two episodes, with their hashes."""
    one, other = lines[0], lines[1]
    paths = [folder / line["media"]["actions"] for line in (one, other)]
    data = [path.read_bytes() for path in paths]
    paths[0].write_bytes(data[1])
    paths[1].write_bytes(data[0])
    one["actions"], other["actions"] = other["actions"], one["actions"]


def other_actions(seed: bool, of: Callable[[np.ndarray], np.ndarray]) -> Forgery:
    """Forgery of an episode's actions, by `of`; with `seed` their hash is made again."""

    def change(folder: Path, lines: list[Line]) -> None:
        path = folder / lines[0]["media"]["actions"]
        with np.load(path) as stored:
            arrays = dict(stored) | {"action": of(stored["action"])}
        np.savez_compressed(path, **arrays)
        if seed:
            lines[0]["actions"] = array_digest(arrays)

    return change


def in_table(name: str, change: Callable[[str], str]) -> Forgery:
    """Forgery of a derived file."""

    def forged(folder: Path, lines: list[Line]) -> None:
        (folder / name).write_text(change((folder / name).read_text()))

    return forged


def cells(text: str) -> str:
    """results.json with a success more."""
    content = json.loads(text)
    content["cells"][0]["successes"] += 1
    return json.dumps(content, indent=2) + "\n"


def by_other_code(change: Callable[[str], str]) -> Callable[[str], str]:
    """A change of results.json, which names no code then: its figures alone are compared."""
    return lambda text: json.dumps(dict(list(json.loads(change(text)).items())[:-1]))


def other_head(text: str) -> str:
    """results.json with another head."""
    return json.dumps(json.loads(text) | {"head": "0" * 64})


def rates_by_other_code(folder: Path, lines: list[Line]) -> None:
    """table.csv with another rate, in a folder whose results.json names no code."""
    for name, change in (("results.json", by_other_code(str)), ("table.csv", rates)):
        in_table(name, change)(folder, lines)


def rates(text: str) -> str:
    """table.csv with another rate."""
    rows = list(csv.reader(io.StringIO(text)))
    rows[1][rows[0].index("sr")] = "0.123"
    return "\n".join(",".join(row) for row in rows) + "\n"


TABLES: dict[str, Forgery] = {
    "results.json": in_table("results.json", cells),
    "table.csv": in_table("table.csv", rates),
    "table.md": in_table("table.md", lambda text: text.replace("| ", "| 1", 5)),
    "report.md": in_table("report.md", lambda text: text.replace("success", "failure", 1) + "\n"),
    "results.json, by other code": in_table("results.json", by_other_code(cells)),
    "head in results.json, by other code": in_table("results.json", by_other_code(other_head)),
    "table.csv, by other code": rates_by_other_code,
    "report.html": in_table("report.html", lambda text: text.replace("%</", "9 %</", 1)),
}
"""Forgeries of derived files, by name."""
FORGERIES: dict[str, Forgery] = TABLES | {
    "a failure made a success at step 0": won_at_once,
    "a fall made one in the start-up": fell_at_once,
    "a success whose actions were not kept": kept_nothing,
    "a metric of no recorder": edited("success", extra={"speed": 1.0}),
    "outcome alone": edited("timeout", outcome="success"),
    "outcome and reason": edited("timeout", outcome="success", reason="success"),
    "a timeout to an error": edited("timeout", outcome="error", error="the server was away"),
    "a fall to a timeout": edited("fall", outcome="timeout", reason="timeout"),
    "a success with a negative margin": edited("success", margin=-0.1),
    "a larger margin": edited("success", margin=lambda line: line["margin"] + 0.01),
    "steps of a success": edited("success", steps=lambda line: line["steps"] - 1),
    "steps with predicates": edited(
        "success", steps=3, predicates=lambda line: dict.fromkeys(line["predicates"], 3), phases=[], events=[]
    ),
    "predicates removed": edited("success", predicates={}),
    "a predicate renamed": edited("timeout", predicates={"goal": None}),
    "a predicate after the end": edited("timeout", predicates=lambda line: line["predicates"] | {"approach": 9999}),
    "progress": edited("timeout", progress=0.99),
    "a predicate and progress": with_predicate,
    "event of the fall removed": edited("fall", events=[]),
    "fall moved past the end": edited("fall", events=[{"kind": "fall", "tick": 99999, "detail": "tilt"}]),
    "fall at the start": edited("fall", startup_fall=True),
    "ball out without event": edited("timeout", reason="ball_out"),
    "a phase after the end": edited("success", phases=[["walk", 0], ["reach", 5000]]),
    "step budget": edited("success", max_steps=5000),
    "episode seed": edited("timeout", episode_seed=1),
    "object seed": edited("timeout", object_seed=1),
    "group seed": edited("timeout", group_seed=7),
    "tracker": edited("timeout", tracker="pd"),
    "policy of a line": edited("timeout", policy="another"),
    "rule set of a line": edited("timeout", rules="released"),
    "engine of a line": edited("timeout", engine="warp"),
    "privileged": edited("success", privileged=lambda line: not line.get("privileged")),
    "hash of the checkpoint": hashed("checkpoint"),
    "hash of the libraries": hashed("versions"),
    "hash of the environment": hashed("environment"),
    "hash of the rules": hashed("rules"),
    "duration": edited("success", durations={"wall_s": 1.0, "sim_s": 9999.0}),
    "actions disowned": edited("success", actions=None),
    "evidence disowned": edited("success", final_state=None, shown=None),
    "another file of actions": edited("success", media={"actions": "actions/football_base_s9_r9.npz"}),
    "hash of the actions": edited("success", actions="0" * 64),
    "actions changed": other_actions(False, lambda action: action + 1),
    "actions changed, with hash": other_actions(True, lambda action: action + 1),
    "actions of two episodes exchanged": exchanged_actions,
    "a line dropped": dropped,
    "a line dropped, unfinished": dropped_and_unfinished,
    "a line repeated": lambda folder, lines: lines.append(dict(first(lines, "success"))),
    "two episodes exchanged": exchanged,
    "rule set of the run": lambda folder, lines: document(folder, config__rules="released") and None,
    "checkpoint of the run": lambda folder, lines: document(folder, config__checkpoint={}) and None,
    "a failure made a success": lambda folder, lines: won(first(lines, "timeout")),
    "every failure made a success": all_won,
    "final state": edited("success", final_state="0" * 64),
    "what the policy was shown": edited("success", shown="0" * 64),
    "another drive in the tables": claimed(config__drive="humanoidarena"),
    "another drive in tables and flags": other_drive,
    "a variant that was not played": claimed(config__variant="0" * 12),
    "weights of trackers, with all hashes": other_weights,
    "an environment, with its hash": other_environment,
    "code and an environment, with all hashes": other_code_and_environment,
    "signals of a failure": other_signals,
    "the worst group seed left out of the plan": seed_dropped,
    "weights of the policy, with all hashes": claimed(config__policy_file="0" * 12, of_lines=other_policy_file),
    "trackers of the policy's training": claimed(config__policy_facts__trackers=["sonic"]),
    "labels of the policy": claimed(config__labels="another"),
    "lines of an older version, and a success": downgraded,
    "a run of an older version, and a margin": claimed(
        config__version="0.0.1", of_lines=edited("success", margin=lambda line: line["margin"] + 0.01)
    ),
    "a success under the seed of a failure": copied_success,
}
"""Forgeries by name; links, and tables but for `TABLES`, are made again after each."""


def journal_lines(folder: Path) -> list[Line]:
    """Lines of a journal."""
    return [json.loads(line) for line in (folder / JOURNAL_FILE).read_text().splitlines()]


def write_lines(folder: Path, lines: list[Line], *, link: bool = True) -> None:
    """Write a journal, by default with its links made again."""
    before, written = b"", []
    for line in lines:
        linked = line | ({"previous": hashlib.sha256(before).hexdigest()} if link else {})
        before = json.dumps(linked, separators=(",", ":")).encode() + b"\n"
        written.append(before)
    (folder / JOURNAL_FILE).write_bytes(b"".join(written))


def forge(folder: Path, change: Forgery, *, tables: bool = True) -> None:
    """Change a folder, link its lines again, and make its tables again, unless they refuse what contradicts itself."""
    lines = journal_lines(folder)
    change(folder, lines)
    write_lines(folder, lines)
    if tables:
        shutil.rmtree(folder / "original")
        with contextlib.suppress(ArenaError):
            report.write_reports(load_run(folder))


def level_of(
    folder: Path, published: str, *, policy: str | None = None, factories: Factories | None = None
) -> tuple[str, list[str]]:
    """Part of an audit that finds a forgery first, and contradictions: lines, replay, policy; else head, or nothing.

    A replay finds also that there is nothing to play: the level stays *consistent*, as a note says. A published head
    finds all that changes an episode; it is asked last, for folders of which none was published.

    Args:
        folder: The forged folder.
        published: Head that was published before.
        policy: Policy that its owner names.
        factories: What episodes are played with; the real parts by default.
    """
    try:
        found = audited(folder)
    except InputError as error:
        return "lines", [str(error)]
    if found.faults:
        return "lines", found.faults
    for level, asked in (("replay", None), ("policy", policy))[: 1 if policy is None else 2]:
        replay(found, drawn([found], None, 0)[0], factories, policy=asked)
        if found.faults or found.absent:
            return level, found.faults or found.notes
    known = [f"head is {found.head}, published was {published}"] * (found.head != published)
    return "head" if known else "", known


class TeleportingWorld(ArenaEnv):
    """A world whose robot is half a metre further on at the end of a tick, by default that of its first second."""

    at = 50
    """The tick; those of the start-up are negative."""

    def step(self, action: torch.Tensor | np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Advance, and teleport."""
        status = super().step(action, worlds)
        for world in np.flatnonzero(self.tick == self.at):
            self.physics.data[world].qpos[self.scene.robot.root_qpos] += 0.5  # type: ignore[union-attr]
        return status


class EarlyTeleportingWorld(TeleportingWorld):
    """One that does so in the start-up, before the policy acts."""

    at = -5


class LightWorld(ArenaEnv):
    """A world whose gravity lacks three of a hundred parts."""

    def __init__(self, *arguments: Any, **options: Any):
        """Build it."""
        super().__init__(*arguments, **options)
        for data in self.physics.data:  # type: ignore[union-attr]
            data.model.opt.gravity[2] = -9.516


def played_again(folder: Path, out: Path, factories: Factories | None = None, **changes: Any) -> None:
    """Play the plan of a folder again, with other parts or flags."""
    evaluate(dataclasses.replace(stored_options(folder), out=str(out), **changes), factories)


def under_the_name_of(honest: Path, folder: Path) -> None:
    """Give the episodes of another policy the name of an honest run's policy, everywhere."""
    ours, lines = document(honest), journal_lines(folder)
    of_honest = journal_lines(honest)[0]
    document(folder, config=ours["config"], config_hash=ours["config_hash"], options__policy=ours["options"]["policy"])
    for line in lines:
        line.pop("privileged", None)
        line |= {key: of_honest[key] for key in ("policy", "privileged") if key in of_honest}
        line["hashes"] |= {key: of_honest["hashes"][key] for key in ("config", "policy")}
    write_lines(folder, lines)
    shutil.rmtree(folder / "original")
    report.write_reports(load_run(folder))


def in_world(kind: type[ArenaEnv]) -> Callable[[Path, Path], None]:
    """Forgery that plays the plan of a folder in another world."""
    return lambda honest, out: played_again(honest, out, Factories(env=kind))


def with_other_weights(honest: Path, out: Path) -> None:
    """The plan of a folder played through trackers whose targets are 1 % larger, under the hashes of the run's."""

    def stronger(spec: str, checkpoint: Path | None) -> Tracker:
        one = trackers.get(spec, checkpoint)
        step = one.step
        one.step = lambda *given: step(*given) * 1.01  # type: ignore[method-assign]
        return one

    played_again(honest, out, Factories(tracker=stronger))


def disguised(honest: Path, out: Path) -> None:
    """The plan of a folder played by an expert, under the name of the folder's policy."""
    played_again(honest, out, policy="expert")
    under_the_name_of(honest, out)


PLAYED = {
    "a world that teleports": in_world(TeleportingWorld),
    "a world that teleports in the start-up": in_world(EarlyTeleportingWorld),
    "a world with 3 % less gravity": in_world(LightWorld),
    "trackers of other weights": with_other_weights,
    "an expert under the policy's name": disguised,
}
"""Forgeries whose episodes are played, by name: of the honest folder, into another; their head is the published one."""


def forgery_figures(options: ForgeryOptions) -> Iterator[BenchFigure]:
    """Contradictions that an audit finds in each forged copy of a folder, and the level that finds it.

    Raises:
        InputError: The folder holds no run, or an audit of it contradicts.
    """
    honest = Path(options.folder).expanduser()
    known = audited(honest)
    if known.faults:
        raise InputError(f"--folder {honest}: expected an honest folder: {known.faults[0]}")
    with tempfile.TemporaryDirectory() as work:
        for name, change in FORGERIES.items():
            folder = shutil.copytree(honest, Path(work) / "forged")
            try:
                forge(folder, change, tables=name not in TABLES)
                level, found = level_of(folder, known.head, policy=options.policy)
                yield BenchFigure(name, 1, "contradictions", False, len(found), level or "not found")
            except InputError as error:
                yield BenchFigure(name, None, "contradictions", False, None, str(error))
            shutil.rmtree(folder)
        for number, (name, play) in enumerate(PLAYED.items()):
            folder = Path(work) / f"played{number}"
            play(honest, folder)
            level, found = level_of(folder, audited(folder).head, policy=options.policy)
            yield BenchFigure(name, 1, "contradictions", False, len(found), level or "not found")
