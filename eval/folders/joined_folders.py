"""Results folders of runs that differ in their mode alone, held as one run, so that one batch of worlds plays them."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from arena_newton.eval.folders.run_folder import SUBFOLDERS, ResultsFolder
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.records.document import Document
from arena_newton.eval.records.journal import EpisodeLines, EpisodeRecord, StorageError
from arena_newton.files.stored_json import JsonObject

__all__ = ["JoinedFolders"]


class JoinedFolders(ResultsFolder):
    """The folders of several runs, each of which gets its own episodes, with the numbers and hashes of its own plan.

    Files of episodes are written into the first folder, and moved to their own before the journal names them.
    """

    def __init__(self, parts: Sequence[ResultsFolder]):
        """Join runs that were checked, of one mode each and otherwise of the same flags."""
        first = parts[0].config
        planned = itertools.chain.from_iterable(part.config.episodes for part in parts)
        episodes = tuple(dataclasses.replace(episode, index=number) for number, episode in enumerate(planned))
        modes = tuple(part.config.flags.mode[0] for part in parts)
        flags = dataclasses.replace(first.flags, mode=modes)
        facts = {name: one for part in parts for name, one in part.config.mode_facts.items()}
        config = dataclasses.replace(first, flags=flags, episodes=episodes, planned=len(episodes), mode_facts=facts)
        super().__init__(parts[0].path, config, parts[0].installed)
        self._parts, self._by_mode = tuple(parts), dict(zip(modes, parts, strict=True))

    @property
    def parts(self) -> Sequence[ResultsFolder]:
        """The folders, in the order of the plan."""
        return self._parts

    @contextlib.contextmanager
    def opened(self, config: RunConfig) -> Iterator[EpisodeLines]:
        """The journals of all folders as one."""
        self.config = config
        with contextlib.ExitStack() as held:
            journals = [held.enter_context(part.opened(part.config.described_by(config))) for part in self._parts]
            environments = {
                name: facts for part in self._parts for name, facts in part.document["environments"].items()
            }
            self.document: Document = {**self._parts[0].document, "environments": environments}
            try:
                yield _JoinedLines(self._parts, journals)
            finally:
                self._remove_unmoved()

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Keep the status of every run in its config.json while the block plays episodes."""
        with contextlib.ExitStack() as held:
            for part in self._parts:
                held.enter_context(part.running())
            yield

    def finished(self) -> None:
        """Every planned episode is in its journal."""
        for part in self._parts:
            part.finished()

    def register(self, group: str, facts: Mapping[str, object]) -> JsonObject:
        """Keep what the environment of a group says of itself, in the folder of its mode."""
        plain = self._by_mode[group.rpartition(" ")[2]].register(group, facts)
        self.document["environments"][group] = plain
        return plain

    def _remove_unmoved(self) -> None:
        """Remove files of episodes that no journal names: a process ended before it moved them."""
        for mode in list(self._by_mode)[1:]:
            for folder in SUBFOLDERS:
                for path in self.path.glob(f"{folder}/*_{mode}_*"):
                    path.unlink(missing_ok=True)


class _JoinedLines:
    """Passes the lines of episodes on to the journals of their runs."""

    def __init__(self, parts: Sequence[ResultsFolder], journals: Sequence[EpisodeLines]):
        self._targets = list(zip(parts, journals, strict=True))
        self._size = len(parts[0].config.episodes)
        """Episodes of each run."""
        self.records = [
            dataclasses.replace(record, index=record.index + number * self._size)
            for number, journal in enumerate(journals)
            for record in journal.records
        ]

    def append(self, record: EpisodeRecord) -> None:
        """Take the record of an episode that ended, with its number among those of all runs.

        Raises:
            StorageError: A file or a journal cannot be written.
        """
        number, index = divmod(record.index, self._size)
        folder, journal = self._targets[number]
        for path in (record.media or {}).values() if number else ():
            _move(self._targets[0][0].path / path, folder.path / path)
        hashes = {**(record.hashes or {}), "config": folder.document["config_hash"]}
        journal.append(dataclasses.replace(record, index=index, hashes=hashes))
        self.records.append(record)


def _move(written: Path, to: Path) -> None:
    """Move an episode's file into the folder of its run."""
    try:
        to.parent.mkdir(exist_ok=True)
        os.replace(written, to)
    except OSError as error:
        raise StorageError(f"{to}: cannot be written ({error.strerror})") from None
