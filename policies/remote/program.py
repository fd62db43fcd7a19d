"""Command of `--policy process:<command>`: its words, and the files among them, which count by content."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.files.stored_json import MAX_NAME

__all__ = ["ProgramCommand"]


@dataclass(frozen=True)
class ProgramCommand:
    """A command line, taken apart as a shell does, without one."""

    words: tuple[str, ...]
    """Program and arguments; those that name files are absolute paths."""
    files: tuple[Path, ...]
    """The files among them."""

    @classmethod
    def read(cls, text: str | None) -> ProgramCommand:
        """Take a command apart.

        Raises:
            InputError: It is empty, too long to be stored, has a quote without its end, or its program is not found.
        """
        try:
            words = shlex.split(text or "")
        except ValueError as error:
            raise InputError(f"--policy process:{text}: {error}") from None
        if not words:
            raise InputError("--policy process: needs a command, as in 'process:python agent.py'")
        named = [os.path.isfile(word) for word in words]
        named[0] = named[0] and os.sep in words[0]  # as in a shell, a name alone is one of the search path
        absolute = tuple(str(Path(word).absolute()) if file else word for word, file in zip(words, named, strict=True))
        if shutil.which(absolute[0]) is None:
            raise InputError(f"--policy process:{text}: no program {words[0]} is found")
        made = cls(absolute, tuple(Path(word) for word, file in zip(absolute, named, strict=True) if file))
        if len(made.shown) > MAX_NAME // 2:
            raise InputError(f"--policy process:{made.shown[:40]}...: longer than {MAX_NAME // 2}; name a script")
        return made

    @property
    def decisive(self) -> tuple[Path, ...]:
        """Files that count by content: all of them, but for Python's interpreter before others."""
        program = Path(self.words[0])
        python = program in self.files[:1] and re.fullmatch(r"python[\d.]*", program.resolve().name)
        return self.files[1:] if python and len(self.files) > 1 else self.files

    @property
    def text(self) -> str:
        """The command, which is the same in any folder."""
        return shlex.join(self.words)

    @property
    def shown(self) -> str:
        """The command as tables show it: of a file its name."""
        return shlex.join(Path(word).name if Path(word) in self.files else word for word in self.words)
