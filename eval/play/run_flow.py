"""Flow of a run, whoever plays its episodes: the pending episodes, when one counts, the reports and the exit code.

No library of physics is loaded: a process that leaves the episodes to others needs none.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton import rule_sets, tasks
from arena_newton.cli.flags import shell_command
from arena_newton.errors import ArenaError
from arena_newton.eval.folders.results import Results, RunRecord, load_run
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan import rounds
from arena_newton.eval.plan.config import RunConfig
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.eval.records.journal import EpisodeRecord, StorageError
from arena_newton.eval.reports import console, report
from arena_newton.eval.reports.progress import Progress
from arena_newton.files.text import counted

if TYPE_CHECKING:
    from arena_newton.interfaces import EpisodeResult

__all__ = [
    "Group",
    "RunStopped",
    "begun",
    "check_again",
    "command",
    "due",
    "group_of",
    "groups",
    "kept",
    "progress_of",
    "reported",
    "naming_the_command",
]

Group = tuple[str, str, str]
"""Task, tracker, and mode or modes with a space between, whose episodes run in one environment."""


class RunStopped(ArenaError):
    """Something other than an episode failed; what was played is kept, what was running stays unplayed."""

    exit_code = 2


def reported(folder: ResultsFolder, seconds: float) -> int:
    """Write the reports of a run that took so long [s], and print its end.

    Returns:
        Exit code: 0 when every planned episode has an outcome other than error, 1 otherwise.
    """
    try:
        loaded = load_run(folder.path)
        results = report.write_reports(loaded)
    except StorageError as error:
        raise StorageError(f"{error}; free space, then: {command(folder, 'report')}") from None
    console.result(loaded, results, command(folder, "resume"), seconds)
    for line in _recorded(folder, loaded.records):
        print(line)
    return _exit_code(folder, loaded, results)


def command(folder: ResultsFolder, name: str) -> str:
    """The command line that does something to a folder; a program that decides must be named again."""
    policy = folder.config.flags.policy
    again = ("--policy", policy) if name == "resume" and policy.startswith("process:") else ()
    return shell_command("arena_newton.eval", name, folder.path, *again)


def groups(episodes: Iterable[Episode]) -> dict[Group, list[Episode]]:
    """Episodes by task, tracker and mode."""
    found: dict[Group, list[Episode]] = {}
    for episode in episodes:
        found.setdefault((episode.task, episode.tracker, episode.mode), []).append(episode)
    return found


def group_of(config: RunConfig, episode: Episode) -> Group:
    """Group in which an episode is played: with the modes of the run that share its scene.

    Each mode is played by itself where a policy depends on the number of worlds, or is of another package and sees the
    world, so that it may not know that worlds differ in their modes; and for a viewer, which shows one mode at a time.
    """
    spec, rules = tasks.get(episode.task), rule_sets.get(episode.rules)
    shared = [m for m in config.flags.mode if spec.scene_name(m, rules) == spec.scene_name(episode.mode, rules)]
    foreign = config.privileged and "code" in (config.policy_facts or {})
    alone = config.worlds_matter or foreign or config.flags.viewer is not None
    return episode.task, episode.tracker, episode.mode if alone else " ".join(shared)


def begun(
    config: RunConfig, folder: ResultsFolder, records: Sequence[EpisodeRecord]
) -> tuple[dict[int, EpisodeRecord], dict[Group, list[Episode]]]:
    """Say what is to be played in a folder that was opened, and whose journal has these records.

    Returns:
        Finished episodes by number, and those to play next, by group; where none are left the folder is that of a
        finished run.
    """
    ended = _finished_episodes(config, folder.path, records)
    waiting = due(config, ended)
    console.announce(config, folder.path, waiting)
    if not waiting:
        folder.finished()
    return ended, waiting


def progress_of(
    config: RunConfig, ended: Mapping[int, EpisodeRecord], waiting: Mapping[Group, Sequence[Episode]]
) -> Progress:
    """Progress of the run."""
    finished = sum(episode.max_steps for episode in config.episodes if episode.index in ended)
    coming = [episode.max_steps for group in waiting.values() for episode in group]
    return Progress(finished + sum(coming), planned=len(ended) + len(coming), finished=len(ended), done=finished)


def _finished_episodes(config: RunConfig, folder: Path, records: Sequence[EpisodeRecord]) -> dict[int, EpisodeRecord]:
    """The episodes of a journal that need not be played again, by number; one whose recording is missing does."""
    ended = {record.index: record for record in records}
    again, planned = config.flags.retry_errors, {e.index: e for e in config.episodes}
    done = {index: record for index, record in ended.items() if not (again and record.outcome == "error")}
    if config.recording is None:
        return done
    from arena_newton.eval.play import recording

    lost = [i for i, r in done.items() if not recording.is_recorded(config, folder, r, planned[i])]
    if lost:
        print(f"  of {counted(len(lost), 'episode')} the recording is missing: played again", file=sys.stderr)
    return {index: record for index, record in done.items() if index not in lost}


def due(config: RunConfig, ended: Mapping[int, EpisodeRecord]) -> dict[Group, list[Episode]]:
    """Episodes to play next, by group."""
    outcomes = {index: record.outcome for index, record in ended.items()}
    found: dict[Group, list[Episode]] = {}
    for cell in groups(config.episodes).values():
        wanted = set(rounds.due([e.index for e in cell], outcomes, config.flags.keep, config.width_rule))
        if wanted:
            found.setdefault(group_of(config, cell[0]), []).extend(e for e in cell if e.index in wanted)
    return found


def kept(config: RunConfig, records: Sequence[EpisodeRecord]) -> str:
    """Number of planned episodes in the journal, in words."""
    number = len({record.index for record in records})
    return f"{number} of {counted(len(config.episodes), 'episode')} kept"


def check_again(
    config: RunConfig,
    folder: Path,
    records: Sequence[EpisodeRecord],
    result: EpisodeRecord | EpisodeResult,
    episode: Episode,
    media: Iterable[str],
) -> None:
    """Hold an episode that is in the journal already, and was played again, to what it was; else remove its files.

    Raises:
        RunStopped: It was played again for its recording, and ended in another way.
    """
    before = next((record for record in reversed(records) if record.index == episode.index), None)
    if before is None or before.outcome == "error" or _ending(before) == _ending(result):
        return
    for path in media:
        (folder / path).unlink(missing_ok=True)
    raise RunStopped(
        f"{episode.key}: was played again for its recording and ended as {result.outcome} after "
        f"{result.steps} steps, the journal has {before.outcome} after {before.steps}: engine "
        f"{config.flags.engine} does not repeat an episode bit for bit; record into another --out"
    )


@contextlib.contextmanager
def naming_the_command(resume: str, kept: Callable[[], str]) -> Iterator[None]:
    """Errors of a block that plays episodes say what is kept, and by which command the run goes on."""
    try:
        yield
    except StorageError as error:
        raise StorageError(f"{error}; free space, then: {resume}") from None
    except RunStopped as error:
        raise RunStopped(f"{error}; {kept()}; continue with: {resume}") from None


def _ending(result: EpisodeRecord | EpisodeResult) -> tuple[str, str | None, int]:
    return result.outcome, result.reason, result.steps


def _recorded(folder: ResultsFolder, records: Sequence[EpisodeRecord]) -> list[str]:
    """Lines on the recorded episodes."""
    if folder.config.recording is None:
        return []
    from arena_newton.eval.play import recording

    return recording.outcome_lines(folder.config, folder.path, records)


def _exit_code(folder: ResultsFolder, loaded: RunRecord, results: Results) -> int:
    """0 when the run has all that was asked for, 1 otherwise."""
    config = folder.config
    if config.flags.keep is not None:
        successes = sum(record.outcome == "success" for record in loaded.records)
        return 0 if successes >= config.flags.keep * len(groups(config.episodes)) else 1
    return 0 if results["complete"] and not any(record.outcome == "error" for record in loaded.records) else 1
