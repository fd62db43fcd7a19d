"""The actions of a swapped run through the tracker that its policy was trained with: a run of its own, inside."""

from __future__ import annotations

from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import OWN_FOLDER
from arena_newton.eval.folders.run_folder import stored_options
from arena_newton.eval.plan.options import Batch, Conditions, RunOptions, Stepping, flags_of

__all__ = ["own_options"]


def own_options(folder: Path, tracker: str) -> RunOptions:
    """Flags of the replay: the same episodes, rules and physics, the recorded actions, the other tracker.

    Args:
        folder: Results of the swapped run.
        tracker: Name of the policy's own tracker.

    Raises:
        InputError: The run kept no signals or no actions, is a part of a plan, or was played through this tracker.
    """
    stored, where, actions = stored_options(folder), f"--own-tracker {tracker}", folder / "actions"
    if not (stored.failures and stored.actions and actions.is_dir()):
        raise InputError(f"{where}: {folder} holds no signals or no actions; play it with --failures")
    if len(stored.tracker) > 1:
        raise InputError(f"{where}: {folder} was played through {' '.join(stored.tracker)}; name a run through one")
    if stored.shard is not None:
        raise InputError(f"{where}: {folder} is shard {stored.shard} of a run; name the folder of eval merge")
    if tracker in stored.tracker:
        raise InputError(f"{where}: {folder} was played through it; name the tracker that the policy was trained with")
    if (folder / OWN_FOLDER).is_symlink():
        raise InputError(f"{where}: {folder / OWN_FOLDER} is a link; a run writes inside its own folder only")
    groups = (*flags_of(Conditions), *flags_of(Batch), *flags_of(Stepping))
    same = {name: getattr(stored, name) for name in ("task", "seeds", "repeats", *groups)}
    played = {"tracker": (tracker,), "policy": f"replay:{actions}", "actions": False, "out": str(folder / OWN_FOLDER)}
    return RunOptions(**same | played)
