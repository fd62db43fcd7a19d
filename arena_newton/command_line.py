"""What a command line answers when its work fails."""

import sys
from collections.abc import Callable

from arena_newton.errors import ArenaError, InputError

__all__ = ["exit_code"]


def exit_code(work: Callable[[], object]) -> int:
    """Do the work: 0 done, 1 failed, 2 bad input, 130 interrupted; an error is one line on the error stream."""
    try:
        work()
    except InputError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except ArenaError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        return 130
    return 0
