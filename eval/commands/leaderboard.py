"""`python -m arena_newton.eval leaderboard build` and `bundle`: entries made, checked and published as static pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["BundleOptions", "LeaderboardOptions", "bundle", "run"]


@dataclass(frozen=True)
class LeaderboardOptions:
    """Check entries of the leaderboard by schema and audit, and write a site that opens from a disk.

    Without names all entries in leaderboard/ are checked. Exit code 1 where something contradicts, a line for each
    contradiction; then no page is written.
    """

    out: str = "site"
    """Folder of the site; its first page is index.html."""
    replay: int = 0
    """Play so many episodes of each entry again, of those whose actions are in its bundle."""
    draw: int | None = None
    """Number of your own by which, with the head, they are drawn; --replay asks for one."""


def run(folders: Sequence[Path], options: LeaderboardOptions, factories: Factories | None = None) -> int:
    """Check, print, and write the site.

    Returns:
        0: nothing contradicts. 1: something does.

    Raises:
        InputError: An entry is unfit, there is none, or the folder of the site holds something else.
        StorageError: A page cannot be written.
    """
    import re
    import tempfile

    from arena_newton.cli.flags import check_least, user_path
    from arena_newton.eval.audit.folder_audit import print_findings
    from arena_newton.eval.leaderboard.checked_entry import check_entry, named_alike, played_elsewhere
    from arena_newton.eval.leaderboard.entry_file import ENTRY_FILE
    from arena_newton.eval.leaderboard.site import write_site
    from arena_newton.eval.records.journal import StorageError
    from arena_newton.files.text import counted

    check_least(options, 0, "replay")
    action, *named = folders
    if action != Path("build"):
        raise InputError(f"leaderboard {action}: unknown, known is build")
    entries = named or sorted(path.parent for path in Path("leaderboard").glob(f"*/{ENTRY_FILE}"))
    if not entries:
        raise InputError(f"leaderboard: no {ENTRY_FILE} in leaderboard/*; name the folders of entries")
    for entry in entries:
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", entry.name):
            raise InputError(f"leaderboard: {entry}: a page is named by its entry's folder: letters, digits and _ . -")
    if len({entry.name.lower() for entry in entries} | {"index"}) <= len(entries):  # of some disks a page of both
        raise InputError(f"leaderboard: two entries of one name, or one named index: {' '.join(map(str, entries))}")
    if options.replay and options.draw is None:
        raise InputError("--replay: draws episodes by a number that nobody could know; give one by --draw")
    if options.draw is not None and not options.replay:
        raise InputError("--draw: draws the episodes of --replay; add it")
    out = user_path(options.out)
    with tempfile.TemporaryDirectory() as scratch:
        found = []
        for folder in entries:
            into = Path(scratch) / folder.name
            one = check_entry(folder, into, replays=options.replay, draw=options.draw or 0, factories=factories)
            one.faults += [*played_elsewhere(one, found), *named_alike(one, found)]
            found.append(one)
            print(f"{folder}: {one.entry.level}, {counted(len(one.rates), 'rate')}")
            print_findings(one.faults, one.notes)
        if any(one.faults for one in found):
            return 1
        try:
            write_site(found, entries, out)
        except OSError as error:
            raise StorageError(f"--out {out}: cannot be written ({error.strerror})") from None
    print(f"site: {out / 'index.html'}")
    return 0


@dataclass(frozen=True)
class BundleOptions:
    """Make an entry of the leaderboard from a run: its journal, some actions and strips as bundle.zip, and entry.toml.

    entry.toml has empty keys that its author fills in; `eval leaderboard build` names them. An entry of the same runs
    keeps those that are filled in. With the audit.json of `eval audit --out` in the entry's folder the actions of the
    episodes that were played again come along, and the level is what that proves (docs/howto/evaluate/leaderboard.md).
    """

    out: str = "leaderboard/mine"
    """Folder of the entry; its name is that of the entry's page."""
    actions: int = 5
    """Episodes whose actions come along, so that an audit can play them again; 50 kB each. They are drawn over all runs
    by their head."""
    strips: int = 2
    """Film strips of each run that come along, where it has some; 0.1 MB each."""


def bundle(folders: Sequence[Path], options: BundleOptions) -> int:
    """Write the entry.

    Raises:
        InputError: The folder holds no run or a damaged one, there is another entry already, or the entry would be
            written into the results.
        StorageError: A file cannot be written.
    """
    from arena_newton.cli.flags import check_least, user_path
    from arena_newton.eval.leaderboard.entry_file import BUNDLE_FILE, ENTRY_FILE, entry_text, read_entry
    from arena_newton.eval.leaderboard.evidence import read_statements
    from arena_newton.eval.leaderboard.result_bundle import made_bundle
    from arena_newton.eval.records.journal import StorageError, write_atomic
    from arena_newton.files.own_files import replace_atomically

    check_least(options, 0, "actions", "strips")
    (folder,), out = folders, user_path(options.out)
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"--out {out}: is in the results; an entry is a folder of its own")
    before = read_entry(out) if (out / ENTRY_FILE).exists() else None
    data, known = made_bundle(folder, options.actions, options.strips, read_statements(out))
    if before is not None and before.head != known["head"]:
        raise InputError(f"--out {out}: holds an entry of other runs already")
    try:
        with replace_atomically(out / BUNDLE_FILE) as file:
            file.write(data)
    except OSError as error:
        raise StorageError(f"{out / BUNDLE_FILE}: cannot be written ({error.strerror})") from None
    write_atomic(out / ENTRY_FILE, entry_text(known, before))
    print(f"bundle: {out / BUNDLE_FILE}, {len(data):,} bytes")
    print(f"entry: {out / ENTRY_FILE}, level {known['level']}; fill in its empty keys")
    print(f"then: python -m arena_newton.eval leaderboard build {out}")
    return 0
