"""`python -m arena_newton.eval bundle`: an entry of the leaderboard from a results folder or a suite."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError

__all__ = ["BundleOptions", "run"]


@dataclass(frozen=True)
class BundleOptions:
    """Make an entry of the leaderboard from a run: its journal, some actions and strips as bundle.zip, and entry.toml.

    entry.toml has empty keys that its author fills in; `eval leaderboard build` names them (docs/leaderboard.md).
    """

    out: str = "leaderboard/mine"
    """Folder of the entry; its name is that of the entry's page."""
    actions: int = 5
    """Episodes of each run whose actions come along, so that an audit can play them again; 50 kB each. They are drawn
    by the head of the journal."""
    strips: int = 2
    """Film strips of each run that come along, where it has some; 0.1 MB each."""


def run(folders: Sequence[Path], options: BundleOptions) -> int:
    """Write the entry.

    Raises:
        InputError: The folder holds no run or a damaged one, or there is an entry already.
        StorageError: A file cannot be written.
    """
    from arena_newton.cli.flags import check_least, user_path
    from arena_newton.eval.leaderboard.entry_file import BUNDLE_FILE, ENTRY_FILE
    from arena_newton.eval.leaderboard.result_bundle import made_bundle
    from arena_newton.eval.records.journal import StorageError, write_atomic
    from arena_newton.files.own_files import replace_atomically

    check_least(options, 0, "actions", "strips")
    (folder,), out = folders, user_path(options.out)
    if (out / ENTRY_FILE).exists():
        raise InputError(f"--out {out}: holds an entry already")
    data, text = made_bundle(folder, options.actions, options.strips)
    try:
        with replace_atomically(out / BUNDLE_FILE) as file:
            file.write(data)
    except OSError as error:
        raise StorageError(f"{out / BUNDLE_FILE}: cannot be written ({error.strerror})") from None
    write_atomic(out / ENTRY_FILE, text)
    print(f"bundle: {out / BUNDLE_FILE}, {len(data):,} bytes")
    print(f"entry: {out / ENTRY_FILE}; fill in its empty keys, then: python -m arena_newton.eval leaderboard build")
    return 0
