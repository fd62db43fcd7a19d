"""The row of the default run that sees: some episodes of the policy that comes with the package, in a folder inside."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import Results, RunRecord, load_run, results_json
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.document import CONFIG_FILE
from arena_newton.policies.learned.learned_card import shipped_card

__all__ = ["ROW_FOLDER", "row_options", "row_results"]

ROW_FOLDER = "learned"
"""Folder of the row inside that of the run: a run of its own, with its own configuration and journal."""


def row_options(flags: RunOptions, folder: Path) -> RunOptions | None:
    """The flags of the row's run: the first task of the card, through the first tracker of both that it knows.

    Args:
        flags: Of the run, resolved.
        folder: Its results folder.

    Returns:
        None where the run has no such row, or no policy comes with this build.

    Raises:
        InputError: The card is damaged, or the row's folder is a link.
    """
    card = shipped_card() if flags.seeing else None
    tracker = next((name for name in card.trackers if name in flags.tracker), None) if card is not None else None
    if card is None or tracker is None:
        return None
    if (folder / ROW_FOLDER).is_symlink():
        raise InputError(f"{folder / ROW_FOLDER}: is a link; a run writes inside its own folder only")
    return dataclasses.replace(
        flags, seeing=False, policy="learned", task=card.tasks[:1], tracker=(tracker,), out=str(folder / ROW_FOLDER)
    )


def row_results(run: RunRecord) -> Results | None:
    """Results of the row of a run; None where it has none, or none that was played yet.

    Raises:
        InputError: Its folder is damaged.
    """
    folder = run.folder / ROW_FOLDER
    if run.document["options"].get("seeing") is not True or folder.is_symlink():
        return None
    if not (folder / CONFIG_FILE).is_file():
        return None
    return results_json(load_run(folder))
