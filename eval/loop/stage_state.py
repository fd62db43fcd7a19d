"""State of a stage by its folder alone: a run by its status and report, a training by its last checkpoint."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.records.document import read_document
from arena_newton.eval.suites.suite_records import read_suite
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from arena_newton.policies.train.training_state import TrainingProgress, last_checkpoint

__all__ = ["continued", "played", "succeeded", "trained"]


def succeeded(folder: Path) -> bool:
    """True if a run came to its end and has its report."""
    try:
        state = read_document(folder)["status"]["state"]
    except (InputError, KeyError):  # the run itself says what is wrong with its folder
        return False
    return state == "success" and (folder / "report.html").is_file()


def trained(folder: Path) -> bool:
    """True if a training made all of its steps."""
    try:
        progress = TrainingProgress.read(last_checkpoint(folder))
    except InputError:  # and the training with its own
        return False
    return 0 < progress.steps <= progress.step


def continued(options: PolicyTrainOptions) -> PolicyTrainOptions:
    """Flags that go on with a training from its last checkpoint; one that was killed before its first begins anew."""
    folder = options.out
    assert folder is not None
    if (folder / "checkpoints" / "last").exists():  # the rest is the training's own
        return PolicyTrainOptions(resume=folder, device=options.device, compile=options.compile)
    shutil.rmtree(folder, ignore_errors=True)
    return options


def played(suites: Sequence[Path], policies: set[str]) -> bool:
    """True if all cells of some suites are done, and these policies are among them."""
    try:
        cells = [cell for suite in suites for cell in read_suite(suite).cells]
    except InputError:  # and the suite with its own
        return False
    return all(cell.status == "done" for cell in cells) and policies <= {cell.policy for cell in cells}
