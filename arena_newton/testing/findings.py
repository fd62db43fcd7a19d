"""Findings of conformance checks, and lists of checks."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from arena_newton.errors import ArenaError
from arena_newton.files.text import plain_text

__all__ = ["Promise", "CheckResult", "ConformanceError", "Violation", "json_object", "perform", "table"]

_LONGEST = 300
"""Longest message of a finding [characters]: plug-ins may raise whole pages."""


class Violation(ArenaError):
    """A promise is broken; the message says how."""


@dataclass(frozen=True)
class Promise:
    """One promise of an interface, and how it is tried."""

    name: str
    """Name in findings."""
    promise: str
    """Condition that must hold, in one sentence."""
    attempt: Callable[[], str | None]
    """Tries it; returns a remark, or None.

    Raises:
        Violation: It does not hold. Any other error counts as a violation too.
    """


@dataclass(frozen=True)
class CheckResult:
    """Finding of one check."""

    name: str
    """The check's name."""
    ok: bool
    """True if the promise holds."""
    message: str
    """Fault if it is broken; the promise if it holds."""


class ConformanceError(ArenaError, AssertionError):
    """A tracker or a policy breaks promises of its interface: all of them are listed."""

    def __init__(self, subject: str, results: Sequence[CheckResult]):
        """Keep what was found.

        Args:
            subject: What was checked, such as `tracker falcon`.
            results: All findings; those that are not ok make the message.
        """
        self.results = tuple(results)
        failed = [result for result in results if not result.ok]
        lines = "\n".join(f"  {result.name}: {result.message}" for result in failed)
        super().__init__(f"{subject} breaks {len(failed)} of {len(results)} promises:\n{lines}")


def perform(checks: Sequence[Promise]) -> list[CheckResult]:
    """Try every promise; an error of the plug-in is a finding, and the next check goes on.

    An error that several checks meet, such as that of a wrong signature, is told once.
    """
    found: list[CheckResult] = []
    told: dict[str, str] = {}
    for check in checks:
        try:
            remark = check.attempt()
            found.append(CheckResult(check.name, True, remark or check.promise))
        except Violation as violation:
            found.append(CheckResult(check.name, False, plain_text(violation, _LONGEST)))
        except Exception as error:
            message = plain_text(f"raised {type(error).__name__}: {error}", _LONGEST)
            first = told.setdefault(message, check.name)
            message = message if first == check.name else f"the same error as {first}"
            found.append(CheckResult(check.name, False, message))
    return found


def table(subject: str, results: Sequence[CheckResult]) -> str:
    """Findings as lines for a terminal: `!` marks what is broken."""
    width = max(len(result.name) for result in results)
    lines = [f"{'  ' if result.ok else '! '}{result.name:<{width}}  {result.message}" for result in results]
    bad = sum(not result.ok for result in results)
    end = f"{bad} of {len(results)} promises broken" if bad else f"keeps all {len(results)} promises"
    return "\n".join([*lines, f"{subject}: {end}"])


def json_object(described: object) -> str:
    """A description as JSON text.

    Raises:
        Violation: It is not a JSON object.
    """
    if not isinstance(described, dict):
        raise Violation(f"describe() answers a {type(described).__name__}, expected a dict")
    try:
        return json.dumps(described, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise Violation(f"describe() is not JSON: {error}") from None
