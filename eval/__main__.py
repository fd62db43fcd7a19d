"""Command line of the benchmark: ``python -m arena_newton.eval [run|resume|report|bench|engines|list] ...``."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from arena_newton.errors import ArenaError, InputError

if TYPE_CHECKING:
    from arena_newton.eval.config import RunOptions
    from arena_newton.eval.run import Factories

__all__ = ["main"]

INTERRUPTED = 130
PROG = "python -m arena_newton.eval"
COMMANDS = ("run", "resume", "report", "bench", "engines", "list")
OVERVIEW = f"""commands:
  {PROG} [run] [flags]           evaluate (flags below)
  {PROG} resume <out> [flags]    continue a run; finished episodes are kept
  {PROG} report <out>            write tables and report again from the journal
  {PROG} list [flags] [--json]   show the plan, run nothing
  {PROG} bench [--what ...]      measure this machine against the figures to reach
  {PROG} engines [flags]         compare the rates of the two physics engines
"""


@dataclass(frozen=True)
class ReportOptions:
    """Write tables and reports of a results folder again from its journal."""

    json: bool = False
    """Print results.json instead of the table."""


def main(argv: Sequence[str] | None = None, factories: Factories | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments; those of the process by default.
        factories: builders of the parts of a run; the real ones by default.

    Returns:
        Exit code: 0 done, 1 episodes with errors or missing, 2 bad input, no room or a run that had to stop, 130
        interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = arguments.pop(0) if arguments and arguments[0] in COMMANDS else "run"
    if command == "run" and arguments and not arguments[0].startswith("-"):
        print(f"error: {arguments[0]}: unknown command, known are {' '.join(COMMANDS)}", file=sys.stderr)
        return 2
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return _COMMANDS[command](arguments, factories)
    except InputError as error:
        print(f"error: {_one_line(error)}", file=sys.stderr)
        return 2
    except ArenaError as error:
        from arena_newton.eval.journal import StorageError
        from arena_newton.eval.run import RunStopped
        from arena_newton.policies.base import PolicyUnavailable

        print(f"error: {_one_line(error)}", file=sys.stderr)
        return 2 if isinstance(error, (StorageError, RunStopped, PolicyUnavailable)) else 1
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return 0


def _one_line(error: BaseException) -> str:
    from arena_newton.eval.records import plain_text

    return plain_text(error)


def _parse[T](kind: type[T], arguments: list[str], command: str, default: T | None = None) -> T:
    """Parse flags with tyro; its multi-line complaint becomes one line."""
    import tyro

    complaint = io.StringIO()
    given: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, args=arguments, prog=f"{PROG} {command}".rstrip(), **given)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        text = re.sub(r"\x1b\[[0-9;]*m", "", complaint.getvalue())
        lines = [line.strip(" │╭╮╰╯─┃") for line in text.splitlines()]
        lines = [line for line in lines if line]
        message = " ".join(lines[1:] or lines)  # the first is the title of tyro's box
        message = re.sub(r"\s*(Argument helptext:|For full helptext,?) .*$", "", message)
        unread = re.match(r"Error parsing (--[\w-]+): .*arguments: (\[.*\])", message)
        raise InputError(f"{unread[1]}: cannot read {unread[2]}" if unread else message) from None


def _folder(arguments: list[str], command: str) -> Path:
    if not arguments or arguments[0].startswith("-"):
        raise InputError(f"{command}: name the results folder: {PROG} {command} <out>")
    return Path(arguments.pop(0)).expanduser()


def _wants_help(arguments: Sequence[str]) -> bool:
    return any(argument in ("-h", "--help") for argument in arguments)


def _run(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval.config import RunOptions

    if _wants_help(arguments):
        print(OVERVIEW)
    options = _parse(RunOptions, arguments, "run")
    from arena_newton.eval.config import is_quick
    from arena_newton.eval.run import execute, results_folder

    if not is_quick(options) or options.policy != "stand" or options.tracker == "pd":
        return execute(options, factories)
    folder = results_folder(options)
    code = execute(dataclasses.replace(options, out=str(folder)), factories)
    return code if code == INTERRUPTED else max(code, _show_expert(options, folder / "expert", factories))


def _show_expert(options: RunOptions, folder: Path, factories: Factories | None) -> int:
    """End the quick look with a policy that solves its task, and name a picture of it."""
    from arena_newton.eval.run import execute

    print("\nAll of these stood still. One that solves its task:")
    one = dataclasses.replace(
        options, task=("vis_navi",), policy="expert", seeds=(0,), repeats=1, worlds=1, strip=True, out=str(folder)
    )
    code = execute(one, factories)
    for strip in sorted((folder / "strips").glob("*__world.*")):
        print(f"see it: {strip}")
    return code


def _resume(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval.config import RunOptions

    if _wants_help(arguments):
        print(f"usage: {PROG} resume <out> [flags]; flags that change the results are refused\n")
        _parse(RunOptions, ["--help"], "resume <out>")
    folder = _folder(arguments, "resume")
    from arena_newton.eval.run import execute, stored_options

    options = _parse(RunOptions, arguments, "resume", default=stored_options(folder))
    if options.out != str(folder):
        raise InputError(f"resume {folder}: continues in that folder; drop --out {options.out}")
    return execute(options, factories)


def _report(arguments: list[str], factories: Factories | None) -> int:
    if _wants_help(arguments):
        _parse(ReportOptions, ["--help"], "report <out>")
    folder = _folder(arguments, "report")
    options = _parse(ReportOptions, arguments, "report")
    import json

    from arena_newton.eval import report

    results = report.write_reports(report.load_run(folder))
    if options.json:
        print(json.dumps(results, indent=2))
        return 0
    print(report.table(results))
    for note in report.notes(results):
        print(note)
    print(f"report: {folder / 'report.html'}")
    return 0


def _list(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval.config import RunOptions

    as_json = "--json" in arguments
    if _wants_help(arguments):
        print(f"usage: {PROG} list [flags of run] [--json]; --json prints an array with one object per episode\n")
    options = _parse(RunOptions, [a for a in arguments if a != "--json"], "list")
    from arena_newton.eval import config as configs

    config = configs.resolve(options)
    from arena_newton.eval.progress import simulated
    from arena_newton.eval.records import counted

    episodes = configs.episodes(config)
    if as_json:
        import json

        from arena_newton.eval import plan

        rows = [json.dumps(row, allow_nan=False) for row in plan.to_list_json(episodes)]
        print("[\n" + ",\n".join(rows) + "\n]")
        return 0
    print(f"{counted(len(episodes), 'episode')}, {simulated(sum(episode.max_steps for episode in episodes))}")
    for episode in episodes:
        print(
            f"{episode.index:>5} {episode.task:<12} {episode.mode:<10} seed {episode.group_seed} "
            f"repeat {episode.repeat:>2} episode_seed {episode.episode_seed:>10} max_steps {episode.max_steps}"
        )
    return 0


def _bench(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval import bench

    return bench.run(_parse(bench.BenchOptions, arguments, "bench"))


def _engines(arguments: list[str], factories: Factories | None) -> int:
    from arena_newton.eval import engines

    return engines.run(_parse(engines.EngineOptions, arguments, "engines"))


_COMMANDS = {
    "run": _run,
    "resume": _resume,
    "report": _report,
    "list": _list,
    "bench": _bench,
    "engines": _engines,
}


if __name__ == "__main__":
    sys.exit(main())
