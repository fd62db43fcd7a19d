"""``python -m arena_newton``: the doctor, and where the other commands are."""

import sys
from collections.abc import Sequence

from arena_newton import __version__

__all__ = ["main"]

USAGE = """usage: python -m arena_newton doctor

commands:
  python -m arena_newton doctor              versions, devices, engines, kernel cache, and what to mend
  python -m arena_newton.eval --help         evaluate a policy
  python -m arena_newton.usd_scenes --help   build, validate, list and preview scenes
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ["doctor"]:
        from arena_newton import doctor

        return doctor.main()
    if arguments and arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if arguments == ["--version"]:
        print(__version__)
        return 0
    problem = f"unknown command {' '.join(arguments)!r}" if arguments else "name a command"
    print(f"error: {problem}; known is: doctor (see python -m arena_newton --help)", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
