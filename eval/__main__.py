"""Command line of the benchmark: ``python -m arena_newton.eval [run|resume|merge|report|bench|certify|list] ...``.

A command is its row here and its file in `eval/commands`, or the one that its row names; it loads when it is called.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

from arena_newton.cli.command_line import exit_code
from arena_newton.cli.command_table import HELP, CommandRow, call, overview
from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["COMMANDS", "main"]

RUNS = ("<out> [<out> ...]", "the results folder")
COMMANDS = {
    "run": CommandRow("evaluate (flags below); `run` may be left out"),
    "resume": CommandRow(
        "continue a run: finished episodes are kept, flags that change the results refused", "<out>", RUNS[1]
    ),
    "merge": CommandRow(
        "join the folders of run --shard 1/16 ... 16/16", "<out> [<out> ...]", "the folders of the shards"
    ),
    "record": CommandRow("record demonstrations for datasets, or more cameras with --from <out>"),
    "report": CommandRow("write tables and report again from the journal; one table of several runs", *RUNS),
    "audit": CommandRow("check results: lines, links, actions and tables of a folder against each other", *RUNS),
    "bundle": CommandRow(
        "make an entry of the leaderboard from a run", "<out>", RUNS[1], work="commands.leaderboard:bundle"
    ),
    "leaderboard": CommandRow(
        "check the entries of the leaderboard and write its pages", "build [<entry> ...]", "what to do, build"
    ),
    "film": CommandRow("one success per task as a film or a picture", *RUNS),
    "tables": CommandRow("the paper's tables from suites and runs, next to the paper's numbers", *RUNS),
    "reproductions": CommandRow(
        "the paper's numbers, each next to ours with a mark", *RUNS, work="commands.tables:reproductions"
    ),
    "compare": CommandRow("compare policies by their episodes: tests, intervals, who won which", *RUNS),
    "tsne": CommandRow(
        "map what one policy answers to the observations of two datasets", extras={"plots": (), "data": ("pyarrow",)}
    ),
    "pack": CommandRow(
        "make a trained policy the one that ships: half precision, a card, 32 MB",
        "<checkpoint>",
        "the checkpoint, or the folder of a training",
    ),
    "list": CommandRow("show the plan of a run, run nothing"),
    "loop": CommandRow("record, build, train, evaluate, report: the whole loop"),
    "matrix": CommandRow(
        "play policies x trackers x tasks x modes as one plan that can be continued", "<suite>", "the suite file"
    ),
    "sensitivity": CommandRow(
        "map success and margin over the placements of a task", extras={"plots": ("matplotlib",)}
    ),
    "adversary": CommandRow("search the placement at which a policy does worst"),
    "bench": CommandRow("measure this machine against the figures to reach"),
    "protocols": CommandRow("one checkpoint through lerobot-eval and each served protocol, compared"),
    "certify": CommandRow("prove the benchmark: checks, a certificate, an exit code"),
}
"""Commands by name, as the overview lists them."""


def main(argv: Sequence[str] | None = None, factories: Factories | None = None) -> int:
    """Run the command line, with the arguments of the process and the real parts of a run by default.

    Returns:
        Exit code: 0 done, 1 episodes with errors or missing, 2 bad input, no room or a run that had to stop, 130
        interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = arguments.pop(0) if arguments and arguments[0] in COMMANDS else "run"
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)

    def work() -> int:
        if name == "run" and arguments and not arguments[0].startswith("-"):
            raise InputError(f"{arguments[0]}: unknown command, known are {' '.join(COMMANDS)}")
        if name == "run" and set(HELP) & set(arguments):
            print(overview("eval", COMMANDS) + "\n")
        return call("eval", name, COMMANDS[name], arguments, factories=factories)

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
