"""Commands of one command line as a table: an overview, help, folders, flags, extras and work, once for all of them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from arena_newton.cli.command_line import exit_code, program
from arena_newton.errors import InputError

__all__ = ["HELP", "CommandRow", "call", "overview", "run_table"]

HELP = ("-h", "--help")


@dataclass(frozen=True)
class CommandRow:
    """One command: a line of the overview, what it is given, and the module that does it."""

    purpose: str
    takes: str = ""
    """Folders or files before its flags, as usage shows them: `<out> [<out> ...]`."""
    noun: str = "a folder"
    """These, as the complaint asks for them where none is named."""
    work: str = ""
    """`module:function` in the folder of its command line; `commands.<name>:run` where it is left open. The function
    gets the folders where there are any, and the options."""
    options: type | None = None
    """Dataclass of its flags; None: the one that the function names, whose module then loads quickly."""
    extras: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Extras that it needs, with the modules that it needs of them; none named: all."""


def overview(area: str, commands: Mapping[str, CommandRow]) -> str:
    """A line per command."""
    rows = {f"{name} {one.takes or '[flags]'}": one.purpose for name, one in commands.items()}
    width = max(map(len, rows))
    prog = program(area.replace(".", " "), f"arena_newton.{area}")
    return "\n".join(["commands:", *(f"  {prog} {words:<{width}}  {purpose}" for words, purpose in rows.items())])


def run_table(area: str, commands: Mapping[str, CommandRow], argv: Sequence[str] | None) -> int:
    """Run a command line, with the arguments of the process by default.

    Returns:
        Exit code: 0 done, 1 failed, 2 bad input, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)

    def work() -> int:
        if not arguments or arguments[0] in HELP:
            print(overview(area, commands), file=sys.stdout if arguments else sys.stderr)
            return 0 if arguments else 2
        name = arguments.pop(0)
        if name not in commands:
            raise InputError(f"{name}: unknown command, known are {' '.join(commands)}")
        return call(area, name, commands[name], arguments)

    return exit_code(work)


def call(area: str, name: str, command: CommandRow, arguments: list[str], **more: object) -> int:
    """Parse what was typed after a command's name, and do its work.

    A module with a function `defaults` says by the folders which values flags have that are not given. What a method
    `check` of the flags refuses is refused before the work's libraries load.

    Args:
        area: Folder of the command line, which is its name too: `eval`.
        **more: What the function gets besides, if it has an argument of that name.

    Returns:
        Exit code.

    Raises:
        InputError: A folder or flag is missing or unfit, or an extra is not installed.
        SystemExit: Help was asked for and printed.
    """
    from arena_newton.cli.extras import require  # an overview needs neither
    from arena_newton.cli.flags import folders_named, parse_flags

    words = area.replace(".", " ")
    prog = program(words, f"arena_newton.{area}")
    place, _, function = (command.work or f"commands.{name}:run").partition(":")
    place = f"arena_newton.{area}.{place}"
    module = None if command.options else importlib.import_module(place)
    kind = command.options or getattr(module, getattr(module, function).__annotations__["options"])
    if any(argument in HELP for argument in arguments):
        parse_flags(kind, ["--help"], f"{prog} {name} {command.takes}".rstrip())
    named = []
    if command.takes:
        most = None if "..." in command.takes else 1
        named = [folders_named(arguments, name, prog, noun=command.noun, shown=command.takes, most=most)]
    defaults = getattr(module, "defaults", None)
    options = parse_flags(kind, arguments, f"{prog} {name}", None if defaults is None else defaults(*named))
    for extra, modules in command.extras.items():
        require(extra, f"{words} {name}", modules)
    if callable(check := getattr(options, "check", None)):
        check()
    work = getattr(module or importlib.import_module(place), function)
    code: int = work(*named, options, **{key: value for key, value in more.items() if key in work.__annotations__})
    return code
