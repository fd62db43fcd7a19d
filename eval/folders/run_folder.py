"""The results folder of a run: whether it may be used, its config.json, and what is left in it when a run ends."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from arena_newton import rule_sets, tasks
from arena_newton.cli.flags import flag_name
from arena_newton.data.recording.episode import VIDEO_FOLDER
from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.plan.config import RunConfig, plain_facts
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records import document as documents
from arena_newton.eval.records.document import CONFIG_FILE, Document, read_document
from arena_newton.eval.records.identity import config_hash, differing_key, moving_versions
from arena_newton.eval.records.journal import JOURNAL_FILE, EpisodeLines, EpisodeRecord, Journal, write_atomic
from arena_newton.eval.records.sharding import Shard
from arena_newton.files.own_files import PARTIAL, file_label
from arena_newton.files.stored_json import JsonObject, check_types
from arena_newton.files.text import counted, plain_text
from arena_newton.pictures.settings import CameraConfig

__all__ = [
    "BREAK_FILE",
    "EPISODES",
    "RECORDING_FLAGS",
    "SUBFOLDERS",
    "ResultsFolder",
    "CAMERAS",
    "PROCESSOR",
    "actions_folder",
    "comparable",
    "iso",
    "results_folder",
    "setting",
    "shown_by",
    "stored_options",
    "timestamp",
]

EPISODES = "episodes"
"""Folder of the files of recorded episodes."""
SUBFOLDERS = ("videos", "strips", "actions", "failures", "original", EPISODES, f"{EPISODES}/{VIDEO_FOLDER}")
"""Folders that a run writes inside its own."""
RECORDING_FLAGS = ("record", "record_cameras", "record_size", "record_depth", "record_looks")
"""Flags that all episodes of a folder share, though they change none of them."""
BREAK_FILE = "break.txt"
"""File with the trace of a break, for a later look."""


def results_folder(out: str | None, shard: Shard | None = None) -> Path:
    """Folder of --out; a new one, named by the time of day and the shard, where none is named.

    Raises:
        InputError: --out names nothing.
    """
    if out is None:
        part = "" if shard is None else f"_shard_{shard.number}_of_{shard.count}"
        return Path("results") / (datetime.datetime.now().strftime("%Y%m%d_%H%M%S") + part)
    if not out.strip():
        raise InputError("--out: is empty, name a folder")
    return Path(out).expanduser()


FORMER_FLAGS = ("seeing",)
"""Flags of earlier versions that change nothing any more."""


def stored_options(folder: Path) -> RunOptions:
    """The flags that a results folder was made with, to be resumed."""
    stored = {name: value for name, value in read_document(folder)["options"].items() if name not in FORMER_FLAGS}
    where = f"{folder / CONFIG_FILE}: options"
    return dataclasses.replace(RunOptions(**check_types(where, stored, RunOptions)), out=str(folder))


def iso(seconds: float) -> str:
    """A time since the epoch [s] as ISO 8601 in UTC."""
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).isoformat(timespec="milliseconds")


def setting(value: object) -> str:
    """The value of a setting in a message."""
    if isinstance(value, list):
        return " ".join(map(str, value))
    if isinstance(value, dict) and all(isinstance(v, str | None) for v in value.values()):
        return " ".join(f"{key} {setting(part)}" for key, part in value.items())
    return "-" if value is None else str(value)


def actions_folder(trackers: Sequence[str], tracker: str) -> str:
    """Folder of the actions of episodes through a tracker, inside a run's: one for each where there are several."""
    return f"actions/{file_label(tracker)}" if len(trackers) > 1 else "actions"


class ResultsFolder:
    """The folder that a run writes."""

    def __init__(self, path: Path, config: RunConfig, installed: Mapping[str, str | None]):
        """Name the folder, the run and the versions of the libraries; nothing is read or written."""
        self.path, self.config, self.installed = path, config, dict(installed)
        self.document: Document
        """Content of config.json, once the folder is prepared."""

    @property
    def journal(self) -> Path:
        """Path of the journal."""
        return self.path / JOURNAL_FILE

    def check(self) -> Document | None:
        """Refuse a folder of another configuration or of other libraries, or one that holds something else.

        Returns:
            The stored config.json; None in a new folder.

        Raises:
            InputError: The folder cannot be the run's.
        """
        folder = self.path
        if folder.exists() and not folder.is_dir():
            raise InputError(f"--out {folder}: is a file")
        if not (folder / CONFIG_FILE).exists():
            # What a run leaves that was killed at its very start: an empty journal, a configuration half written.
            found = {path.name: path for path in folder.iterdir()} if folder.exists() else {}
            half = found.pop(CONFIG_FILE + PARTIAL, None)
            others = any(
                name != JOURNAL_FILE or path.is_symlink() or path.stat().st_size for name, path in found.items()
            )
            if others or (half is not None and (half.is_symlink() or not half.is_file())):
                raise InputError(f"--out {folder}: is not empty and holds no results; choose another folder")
            return None
        trackers = self.config.flags.tracker
        for name in (*SUBFOLDERS, *(actions_folder(trackers, one) for one in trackers)):
            if (folder / name).is_symlink():
                raise InputError(f"{folder / name}: is a link; a run writes inside its own folder only")
        stored = read_document(folder)
        unknown = () if self.config.tracker_facts is not None else ("tracker_facts", "policy_facts", "worlds", "labels")
        difference = differing_key(stored["config"], self.config.identity(), unknown)
        if difference is not None:
            key, was, now = difference
            raise InputError(
                f"{folder}: holds results of another configuration: {key} was {setting(was)}, now {setting(now)}; "
                "choose another --out"
            )
        was_shard, shard = stored.get("shard"), self.config.flags.shard
        if was_shard != shard:
            was = "the whole plan" if was_shard is None else f"shard {was_shard}"
            now_shard = "without a shard" if shard is None else f"--shard {shard}"
            raise InputError(f"{folder}: was begun with {was}, now {now_shard}; choose another --out")
        for name in RECORDING_FLAGS:
            default = getattr(RunOptions, name)
            kept, given = stored["options"].get(name, default), getattr(self.config.flags, name)
            if given != (tuple(kept) if isinstance(kept, list) else kept):
                raise InputError(f"{folder}: was begun with {flag_name(name)} {setting(kept)}; choose another --out")
        known = [moving_versions(versions) for versions in _versions(stored)]
        present = moving_versions(self.installed)
        if present not in known and not self.config.flags.accept_versions:
            library, was, now = differing_key(known[-1], present) or ("versions", None, None)
            raise InputError(
                f"{folder}: was run with {library} {setting(was)}, installed is {setting(now)}, and results may "
                "differ; install that version, choose another --out, or mix both with --accept-versions"
            )
        return stored

    @property
    def parts(self) -> Sequence[ResultsFolder]:
        """Folders that hold the run's results: this one."""
        return (self,)

    @contextlib.contextmanager
    def opened(self, config: RunConfig) -> Iterator[EpisodeLines]:
        """The journal of the folder, prepared for the run; what is unfinished is removed at the end of the block.

        `config` has what tracker and policy say of themselves. A torn last line is cut.

        Raises:
            InputError: The folder cannot be the run's, or another process writes it.
            StorageError: It cannot be written.
        """
        self.make()
        with Journal(self.journal) as journal:
            self.prepare(config, journal.records)
            self.remove_unfinished()
            if journal.torn_bytes:
                print(
                    f"  cut a torn last line of {counted(journal.torn_bytes, 'byte')} off the journal", file=sys.stderr
                )
            try:
                yield journal
            finally:
                self.remove_unfinished()

    def make(self) -> None:
        """Create the folder.

        Raises:
            InputError: It cannot be created.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {self.path}: cannot be created ({error.strerror})") from None

    def prepare(self, config: RunConfig, played: Sequence[EpisodeRecord]) -> None:
        """Write config.json into a new folder, or hold the run to the one that is there; the journal's lock is held.

        `config` now has what tracker and policy say of themselves; `played` are the lines of the journal.

        Raises:
            InputError: The folder cannot be the run's.
        """
        self.config = config
        stored = self.check()
        self.document = self._new_document() if stored is None else stored
        documents.check_plan(self.path, played, self.document)
        sets, lacking = _versions(self.document), self.document["options"].get("actions") and not config.flags.actions
        if moving_versions(self.installed) not in map(moving_versions, sets):
            self.document["later_versions"] = [*sets[1:], self.installed]
        elif stored is not None and not lacking:
            return
        if lacking:
            self.document["options"]["actions"] = False
        self._save()

    def _new_document(self) -> Document:
        config = self.config
        document: Document = {
            "config_hash": config.hash,
            "config": config.identity(),
            "rule_set": dict(rule_sets.table(rule_sets.get(config.flags.rules, config.flags.task))),
            "gym_ids": {name: tasks.get(name).gym_id for name in config.flags.task},
            "options": config.stored_flags(),
            "versions": self.installed,
            "planned": config.planned,
            "environments": {},
        }
        if config.shard is not None:
            document["shard"] = str(config.shard)
        if config.variant is not None:
            from arena_newton.usd_scenes import validate

            document["variant_changes"] = validate.differences(config.variant, config.flags.task[0])
        return document

    def _save(self) -> None:
        write_atomic(self.path / CONFIG_FILE, json.dumps(self.document, indent=2) + "\n")

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Keep the status of the run in config.json while the block plays episodes.

        Bad input that shows in the block refuses the run: the status stays what it was.
        """
        before = self.document.get("status")
        status: documents.Status = {"state": "started", "started_at": timestamp(), "finished_at": None, "error": None}
        self.document["status"] = status
        self._save()
        try:
            yield
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                self.document["status"] = status | {"state": "cancelled", "finished_at": timestamp()}
            elif not isinstance(error, InputError):
                text = plain_text(error, 400) or type(error).__name__
                self.document["status"] = status | {"state": "error", "finished_at": timestamp(), "error": text}
            elif before is not None:
                self.document["status"] = before
            else:
                del self.document["status"]
            with contextlib.suppress(ArenaError):  # on a full disk the first error is the one to report
                self._save()
            raise
        self.document["status"] = status | {"state": "success", "finished_at": timestamp()}
        self._save()

    def finished(self) -> None:
        """Every planned episode is in the journal, and none was played: a killed run may have left another status."""
        status = self.document.get("status")
        if status is not None and status["state"] != "success":
            self.document["status"] = status | {"state": "success", "finished_at": timestamp(), "error": None}
            self._save()

    def register(self, group: str, facts: Mapping[str, object]) -> JsonObject:
        """Keep what an environment says of itself, once per task, tracker and mode; refuse another one than before.

        Returns:
            The facts as JSON.

        Raises:
            InputError: Earlier episodes of this group were run in an environment that differs.
        """
        plain = plain_facts(facts)
        known = self.document.setdefault("environments", {})
        if group not in known:
            known[group] = plain
            # In the plan's order, whoever builds them first, so that reports are the same bytes.
            planned = dict.fromkeys(f"{e.task} {e.tracker} {e.mode}" for e in self.config.episodes)
            order = {name: number for number, name in enumerate(planned)}
            known = dict(sorted(known.items(), key=lambda named: order.get(named[0], len(order))))
            self.document["environments"] = known
            self._save()
        difference = differing_key(comparable(known[group]), comparable(plain))
        if difference is not None:
            key, was, now = difference
            change = f"was run with {key} {setting(was)}, now it is {setting(now)}"
            raise InputError(f"{self.path}: {group} {change}; choose another --out")
        return plain

    def hashes(self, tracker: str, environment: JsonObject) -> dict[str, str | None]:
        """Names of a journal line's run, from the tracker and the environment's own description."""
        config = self.config
        return {
            "config": self.document["config_hash"],
            "rules": config.rules_hash,
            "checkpoint": config.checkpoint_hashes[tracker],
            "policy": config.policy_hash,
            "variant": config.variant_hash,
            "versions": config_hash(moving_versions(self.installed)),
            "environment": config_hash(comparable(environment)),
        }

    def keep_trace(self) -> None:
        """Write the trace of the exception that is being handled."""
        with contextlib.suppress(ArenaError, ValueError):
            write_atomic(self.path / BREAK_FILE, traceback.format_exc())

    def keep_file(self, name: str, content: bytes) -> None:
        """Write a file of an episode, by its path below the folder.

        Raises:
            StorageError: It cannot be written.
        """
        write_atomic(self.path / name, content)

    def remove_unfinished(self) -> None:
        """Remove what unfinished recordings left."""
        for pattern in (*(f"{name}/*{PARTIAL}" for name in SUBFOLDERS), "actions/*.partial", f"actions/*/*{PARTIAL}"):
            for part in self.path.glob(pattern):
                with contextlib.suppress(OSError):
                    part.unlink()


def timestamp() -> str:
    """This moment as ISO 8601 in UTC."""
    return iso(datetime.datetime.now(datetime.UTC).timestamp())


def _versions(document: Document) -> list[dict[str, str | None]]:
    """Libraries of the first run in a folder, then of those that were accepted later."""
    return [document.get("versions", {}), *document.get("later_versions", ())]


PROCESSOR = "processor"
"""Fact of an environment: the vector instructions that torch computes with on this machine, such as AVX512. Networks'
last bits depend on it. It is no part of any hash: nodes of a cluster differ, and may play one plan."""
CAMERAS = "cameras"
"""Fact of an environment: the policy's cameras by name. It is no part of any hash, as the policy is."""


def shown_by(cameras: Mapping[str, CameraConfig]) -> JsonObject:
    """Fact of an environment with these cameras; nothing for a policy that does not see."""
    return {CAMERAS: {name: dataclasses.asdict(one) for name, one in cameras.items()}} if cameras else {}


def comparable(facts: JsonObject) -> JsonObject:
    """Facts of an environment without processor, cameras and number of its device: `cuda:0` and `cuda:1` are alike."""
    kept = {key: value for key, value in facts.items() if key not in (PROCESSOR, CAMERAS)}
    return kept | ({"device": str(kept["device"]).split(":")[0]} if "device" in kept else {})
