"""`python -m arena_newton.eval run`: episodes of a policy, their table and their report."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.eval.plan.options import RunOptions, is_quick

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["run"]


def run(options: RunOptions, factories: Factories | None = None) -> int:
    """Run, by default twice: experts, then in a folder inside a few episodes of the policy that comes with the package.

    Two processes play the default run on a CPU that has as many cores. What is wrong with flags or folders is found
    before the libraries of physics load, which takes seconds.
    """
    from arena_newton.cli.command_line import INTERRUPTED
    from arena_newton.doctor import versions
    from arena_newton.eval.folders.run_folder import ResultsFolder, results_folder
    from arena_newton.eval.plan.config import resolve

    config = resolve(options)
    if is_quick(options) and config.device == "cpu" and not (options.dealt or options.viewer or factories):
        flags = dataclasses.replace(config.flags, jobs=min(2, len(os.sched_getaffinity(0))))
        config = dataclasses.replace(config, flags=flags)
    folders = [ResultsFolder(results_folder(options.out, config.shard), config, versions())]
    if is_quick(options) and options.policy == "expert" and not options.record:
        more = _learned(config.flags, folders[0].path / "learned")
        folders += [ResultsFolder(results_folder(one.out), resolve(one), versions()) for one in more]
    for folder in folders:
        folder.check()
    if config.flags.dealt:
        from arena_newton.eval.workers import dealing

        code = dealing.execute(folders, factories)
    else:
        from arena_newton.eval.play.run import execute

        code = 0
        for folder in folders:
            code = max(code, execute(folder, factories) if code != INTERRUPTED else code)
    if code == INTERRUPTED:
        return code
    if len(folders) > 1:
        experts, sees = (folder.path / "report.html" for folder in folders)
        print(f"\nreport of the experts: {experts}, of the policy that sees: {sees}")
    return code


def _learned(flags: RunOptions, folder: Path) -> list[RunOptions]:
    """Run of the policy that sees: the tasks of its card, through the first tracker of both that it knows.

    Returns:
        Its flags alone; none where no policy comes with this build, or it knows none of the trackers.
    """
    from arena_newton.policies.learned.learned_card import shipped_card

    card = shipped_card()
    known = [name for name in flags.tracker if name in card.trackers] if card is not None else []
    if card is None or not known:
        return []
    return [dataclasses.replace(flags, policy="learned", task=card.tasks, tracker=(known[0],), out=str(folder))]
