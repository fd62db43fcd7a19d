"""Text of others, made fit to be shown."""

from __future__ import annotations

import json
import re
import sys
import unicodedata
from collections.abc import Collection

__all__ = ["counted", "is_printable", "plain", "plain_text", "unprintable"]

_ESCAPES = re.compile(
    r"\x1b(?:\[[0-?]*[ -/]*[@-~]|\][^\x07\x1b]*(?:\x07|\x1b\\)?|[PX^_][^\x1b]*(?:\x1b\\)?|[@-Z\\-_])?"
)
"""Terminal escapes: control sequences, strings with their ends, single characters (ECMA-48)."""
_TURNING = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Marks that turn the direction of text."""
_INVISIBLE = _TURNING | frozenset("\u061c\ufeff") | {chr(c) for c in (*range(0x200B, 0x2010), *range(0x2028, 0x202A))}
"""These, and other marks and spaces without width."""


def plain_text(value: object, limit: int | None = 2000, *, mark: str | None = None) -> str:
    """A value as text that a page, a terminal and a file can show: no control, surrogate or direction characters.

    Args:
        value: Text, or anything else.
        limit: Most characters; a longer text is cut. None: any number.
        mark: What replaces each unfit character, spaces kept. Without one the text becomes one line with single spaces
            and without terminal escapes.
    """
    if mark is None:
        spaced = " ".join(_ESCAPES.sub(" ", str(value)).split())
        text = " ".join(_clean(spaced, "", _TURNING).split())
    else:
        text = _clean(value if isinstance(value, str) else _dumped(value), mark, _INVISIBLE)
    return text if limit is None or len(text) <= limit else text[: limit - 1] + "…"


def plain(value: object) -> str:
    """A value as text that a page, a terminal and a file can show; unfit characters are marked."""
    return plain_text(value, None, mark="\ufffd")


def _dumped(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, sort_keys=isinstance(value, dict))


def _clean(text: str, mark: str, marks: Collection[str]) -> str:
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        " " if c in "\t\n\r" else mark if unicodedata.category(c) in ("Cc", "Cs") or c in marks else c for c in text
    )


def is_printable(text: str) -> bool:
    """True if a text has no control characters, unpaired surrogates or marks that turn its direction."""
    return text.isprintable() or _clean(text, "", _TURNING) == text


def unprintable(text: str) -> str | None:
    """Reason for which a text of the command line cannot be shown, None when it can."""
    if is_printable(text):
        return None
    if re.search("[\udc80-\udcff]", text):  # bytes that Python could not decode
        return (
            f"holds bytes that are no text in this locale's character set ({sys.getfilesystemencoding()}); "
            "LC_ALL=C.UTF-8 makes that UTF-8"
        )
    return "has control characters in it"


def counted(number: int, noun: str) -> str:
    """A number with its noun, such as ``1 episode`` and ``2 episodes``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
