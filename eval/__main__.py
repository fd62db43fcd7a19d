"""Command line of the benchmark: ``python -m arena_newton.eval [run|resume|merge|report|bench|certify|list] ...``."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.flags import folders_named, parse_flags, user_path
from arena_newton.errors import InputError
from arena_newton.eval.adapters.door_options import DoorOptions
from arena_newton.eval.commands import bench
from arena_newton.eval.commands.pack_options import PackOptions
from arena_newton.eval.plan.options import (
    CertifyOptions,
    FilmOptions,
    LoopOptions,
    RecordOptions,
    ReportOptions,
    RunMergeOptions,
    RunOptions,
)
from arena_newton.eval.plan.suite_options import MatrixOptions
from arena_newton.eval.studies.placement_options import AdversaryOptions, SensitivityOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.run import Factories

__all__ = ["main"]

PROG = program("eval", "arena_newton.eval")
LISTS = frozenset("--task --tracker --mode --seeds --checks --only --differ --axes --grid".split())
"""Flags that take several values and are the whole list where they are not given."""
OVERVIEW = f"""commands:
  {PROG} [run] [flags]           evaluate (flags below)
  {PROG} resume <out> [flags]    continue a run; finished episodes are kept
  {PROG} merge <out> <out>... --out <new>  join the folders of run --shard 1/16 ... 16/16
  {PROG} record [flags]          record demonstrations for datasets, or more cameras with --from <out>
  {PROG} report <out> [<out>...] write tables and report again from the journal; one table of several runs
  {PROG} film <out> [<out>...]   one success per task as a film or a picture
  {PROG} tables <out> [<out>...] the paper's tables from suites and runs, next to the paper's numbers
  {PROG} compare <out> <out>...  compare policies by their episodes: tests, intervals, who won which
  {PROG} tsne [flags]            map what one policy answers to the observations of two datasets
  {PROG} pack <checkpoint> [flags] make a trained policy the one that ships: half precision, a card, 32 MB
  {PROG} list [flags] [--json]   show the plan, run nothing
  {PROG} loop [flags]            record, build, train, evaluate, report: the whole loop
  {PROG} matrix <suite> [flags]  play policies x trackers x tasks x modes as one plan that can be continued
  {PROG} sensitivity [flags]     map success and margin over the placements of a task
  {PROG} adversary [flags]       search the placement at which a policy does worst
  {PROG} bench [--what ...]      measure this machine against the figures to reach
  {PROG} doors [flags]           one checkpoint through lerobot-eval and each served protocol, compared
  {PROG} certify [--quick]       prove the benchmark: checks, a certificate, an exit code
"""


def main(argv: Sequence[str] | None = None, factories: Factories | None = None) -> int:
    """Run the command line, with the arguments of the process and the real parts of a run by default.

    Returns:
        Exit code: 0 done, 1 episodes with errors or missing, 2 bad input, no room or a run that had to stop, 130
        interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = arguments.pop(0) if arguments and arguments[0] in _COMMANDS else "run"
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)

    def work() -> int:
        if command == "run" and arguments and not arguments[0].startswith("-"):
            raise InputError(f"{arguments[0]}: unknown command, known are {' '.join(_COMMANDS)}")
        _check_lists(arguments)
        return _COMMANDS[command](arguments, factories)

    return exit_code(work)


def _folder(arguments: list[str], command: str) -> Path:
    if not arguments or arguments[0].startswith("-"):
        raise InputError(f"{command}: name the results folder: {PROG} {command} <out>")
    return user_path(arguments.pop(0))


def _folders(arguments: list[str], command: str) -> list[Path]:
    """One results folder or several, each once."""
    return folders_named(arguments, command, PROG, noun="the results folder", shown="<out>")


def _check_lists(arguments: Sequence[str]) -> None:
    """Refuse a flag of several values that has none, as an empty variable of a shell leaves it: it would mean all."""
    for flag, after in itertools.pairwise([*arguments, "--"]):
        if flag in LISTS and after.startswith("--"):
            raise InputError(f"{flag}: cannot read it without a value")


def _wants_help(arguments: Sequence[str]) -> bool:
    return any(argument in ("-h", "--help") for argument in arguments)


def _run(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        print(OVERVIEW)
    options = parse_flags(RunOptions, arguments, f"{PROG} run")
    return _execute(options, factories)


def _execute(options: RunOptions, factories: Factories | None) -> int:
    """Run; what is wrong with flags or folder is found before the libraries of physics load, which takes seconds."""
    from arena_newton.doctor import versions
    from arena_newton.eval.folders.run_folder import ResultsFolder, results_folder
    from arena_newton.eval.plan.config import resolve
    from arena_newton.eval.reports.learned_row import row_options

    config = resolve(options)
    folder = ResultsFolder(results_folder(options.out, config.shard), config, versions())
    folder.check()
    row = row_options(config.flags, folder.path)
    beside = None
    if row is not None:
        beside = ResultsFolder(results_folder(row.out), resolve(row), versions())
        beside.check()
    if config.flags.ray is not None:
        _before_ray()
        from arena_newton.eval.workers import ray_run

        return ray_run.execute(folder, factories, beside)
    from arena_newton.eval.play.run import execute

    return execute(folder, factories, beside)


def _before_ray() -> None:
    """Set what is read when ray is imported: under `uv run` it would start every process by another `uv run`."""
    os.environ["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"


def _record(arguments: list[str], factories: Factories | None) -> int:
    options = parse_flags(RecordOptions, arguments, f"{PROG} record")
    if options.source is not None:
        from arena_newton.eval.play import rerecord

        return rerecord.run(options, factories)
    from arena_newton.eval.plan.config import recording_run

    return _execute(recording_run(options), factories)


def _resume(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        print(f"usage: {PROG} resume <out> [flags]; flags that change the results are refused\n")
        parse_flags(RunOptions, ["--help"], f"{PROG} resume <out>")
    folder = _folder(arguments, "resume")
    from arena_newton.eval.folders.run_folder import stored_options

    stored = stored_options(folder)
    options = parse_flags(RunOptions, arguments, f"{PROG} resume", default=stored)
    if stored.until_width is not None and options.max != stored.max:
        raise InputError(f"--max was {stored.max}, now {options.max}: it was said before the first episode, and stays")
    if options.out != str(folder):
        raise InputError(f"resume {folder}: continues in that folder; drop --out {options.out}")
    return _execute(options, factories)


def _report(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        parse_flags(ReportOptions, ["--help"], f"{PROG} report <out> [<out> ...]")
    folders = _folders(arguments, "report")
    options = parse_flags(ReportOptions, arguments, f"{PROG} report")
    from arena_newton.eval.folders.results import load_run
    from arena_newton.eval.reports import report
    from arena_newton.eval.reports.learned_row import row_results
    from arena_newton.eval.tables import run_table

    if options.table or len(folders) > 1:
        if options.json:
            raise InputError("--json: is of one folder, without --table")
        if options.own_tracker is not None:
            raise InputError("--own-tracker: is of one folder, without --table")
        print(run_table.joint_table([load_run(folder) for folder in folders]), end="")
        return 0
    (folder,) = folders
    if options.own_tracker is not None:
        from arena_newton.eval.play.own_tracker import own_options

        failed = _execute(own_options(folder, options.own_tracker), factories)
        if failed:
            return failed
    run = load_run(folder)
    results = report.write_reports(run)
    if options.json:
        print(json.dumps(results, indent=2))
        return 0
    print(report.table(results, row_results(run)))
    for note in report.notes(run, results):
        print(note)
    print(f"report: {folder / 'report.html'}")
    return 0


def _merge(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        parse_flags(RunMergeOptions, ["--help"], f"{PROG} merge <out> [<out> ...]")
    folders = folders_named(
        arguments, "merge", PROG, noun="the folders of the shards", shown="<out> <out>... --out <new>"
    )
    options = parse_flags(RunMergeOptions, arguments, f"{PROG} merge")
    from arena_newton.eval.workers import shard_merge

    return shard_merge.run(folders, options)


def _film(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        parse_flags(FilmOptions, ["--help"], f"{PROG} film <out> [<out> ...]")
    folders = _folders(arguments, "film")
    options = parse_flags(FilmOptions, arguments, f"{PROG} film")
    from arena_newton.eval.folders.results import load_run
    from arena_newton.eval.reports import success_film

    for line in success_film.write([load_run(folder) for folder in folders], options):
        print(line)
    return 0


def _list(arguments: list[str], factories: Factories | None) -> int:
    as_json = "--json" in arguments
    if _wants_help(arguments):
        print(f"usage: {PROG} list [flags of run] [--json]; --json prints an array with one object per episode\n")
    options = parse_flags(RunOptions, [a for a in arguments if a != "--json"], f"{PROG} list")
    from arena_newton.eval.plan.config import resolve
    from arena_newton.eval.reports.progress import simulated
    from arena_newton.eval.statistics.detectable import detectable_text
    from arena_newton.files.text import counted

    episodes = resolve(options).episodes
    if as_json:
        from arena_newton.eval.plan import episode_plan

        rows = [json.dumps(episode_plan.listed(episode), allow_nan=False) for episode in episodes]
        print("[\n" + ",\n".join(rows) + "\n]")
        return 0
    print(f"{counted(len(episodes), 'episode')}, {simulated(sum(episode.max_steps for episode in episodes))}")
    cells = Counter((episode.task, episode.tracker, episode.mode) for episode in episodes)
    if told := detectable_text(list(cells.values())):
        print(told)
    for episode in episodes:
        print(
            f"{episode.index:>5} {episode.task:<12} {episode.tracker:<8} {episode.mode:<10} seed {episode.group_seed} "
            f"repeat {episode.repeat:>2} episode_seed {episode.episode_seed:>10} max_steps {episode.max_steps}"
        )
    return 0


def _loop(arguments: list[str], factories: Factories | None) -> int:
    options = parse_flags(LoopOptions, arguments, f"{PROG} loop")
    from arena_newton.eval.loop.loop_requirements import check_libraries

    check_libraries(options.policy)  # before the libraries are loaded
    from arena_newton.eval.loop import learning_loop

    return learning_loop.run(options, factories)


def _matrix(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        parse_flags(MatrixOptions, ["--help"], f"{PROG} matrix <suite>")
    if not arguments or arguments[0].startswith("-"):
        raise InputError(f"matrix: name the suite file: {PROG} matrix <suite.toml>")
    given = arguments.pop(0)
    options = parse_flags(MatrixOptions, arguments, f"{PROG} matrix")
    from arena_newton.eval.suites.suite_call import plan_call

    call = plan_call(given, options)
    if options.dry_run:
        print(call.table(), flush=True)
        if call.problem is not None:
            raise call.problem
        return 0
    if options.ray is not None:
        _before_ray()
        from arena_newton.eval.suites import ray_suite

        return ray_suite.run(call, factories)
    from arena_newton.eval.suites import suite_run

    return suite_run.run(call, factories)


def _sensitivity(arguments: list[str], factories: Factories | None) -> int:
    options = parse_flags(SensitivityOptions, arguments, f"{PROG} sensitivity")
    from arena_newton.cli.extras import require

    require("plots", "eval sensitivity", ("matplotlib",))
    from arena_newton.eval.studies import sensitivity

    return sensitivity.run(options, factories)


def _adversary(arguments: list[str], factories: Factories | None) -> int:
    options = parse_flags(AdversaryOptions, arguments, f"{PROG} adversary")
    from arena_newton.eval.studies import adversary

    return adversary.run(options, factories)


def _bench(arguments: list[str], factories: Factories | None) -> int:
    return bench.run(parse_flags(bench.BenchOptions, arguments, f"{PROG} bench"))


def _doors(arguments: list[str], factories: Factories | None) -> int:
    options = parse_flags(DoorOptions, arguments, f"{PROG} doors")
    from arena_newton.eval.adapters import door_comparison

    return door_comparison.run(options)


def _certify(arguments: list[str], factories: Factories | None) -> int:
    options = parse_flags(CertifyOptions, arguments, f"{PROG} certify")
    from arena_newton.eval.commands import certify

    if options.quick and options.jobs == 1 and factories is None:
        options = dataclasses.replace(options, jobs=min(certify.QUICK_JOBS, len(os.sched_getaffinity(0))))
    return certify.run(options, factories)


def _tables(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval.commands.table_options import TablesOptions

    if _wants_help(arguments):
        parse_flags(TablesOptions, ["--help"], f"{PROG} tables <out> [<out> ...]")
    folders = _folders(arguments, "tables")
    options = parse_flags(TablesOptions, arguments, f"{PROG} tables")
    from arena_newton.eval.commands import tables_command

    return tables_command.run(folders, options)


def _compare(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval.commands.table_options import CompareOptions

    if _wants_help(arguments):
        parse_flags(CompareOptions, ["--help"], f"{PROG} compare <out> [<out> ...]")
    folders = _folders(arguments, "compare")
    options = parse_flags(CompareOptions, arguments, f"{PROG} compare")
    from arena_newton.eval.commands import compare_command

    return compare_command.run(folders, options)


def _tsne(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval.commands.table_options import TsneOptions

    options = parse_flags(TsneOptions, arguments, f"{PROG} tsne")
    from arena_newton.cli.extras import require

    require("plots", "eval tsne")
    require("data", "eval tsne", ("pyarrow",))
    from arena_newton.eval.commands import tsne_command

    return tsne_command.run(options)


def _pack(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        parse_flags(PackOptions, ["--help"], f"{PROG} pack <checkpoint>")
    if not arguments or arguments[0].startswith("-"):
        raise InputError(f"pack: name the checkpoint, or the folder of a training: {PROG} pack <checkpoint>")
    given = user_path(arguments.pop(0))
    options = parse_flags(PackOptions, arguments, f"{PROG} pack")
    from arena_newton.eval.commands import pack_command

    return pack_command.run(given, options)


_COMMANDS = {
    "run": _run,
    "record": _record,
    "resume": _resume,
    "merge": _merge,
    "report": _report,
    "film": _film,
    "loop": _loop,
    "tables": _tables,
    "compare": _compare,
    "tsne": _tsne,
    "pack": _pack,
    "matrix": _matrix,
    "sensitivity": _sensitivity,
    "adversary": _adversary,
    "bench": _bench,
    "doors": _doors,
    "certify": _certify,
    "list": _list,
}


if __name__ == "__main__":
    sys.exit(main())
