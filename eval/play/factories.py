"""Parts of a run into which a program may put its own: `main(arguments, Factories(...))` of `eval.__main__`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton import policies, recorders, trackers
from arena_newton.env import ArenaEnv
from arena_newton.interfaces import Recorder, World
from arena_newton.policies.base import Policy
from arena_newton.trackers.base import Tracker
from arena_newton.usd_scenes import validate

__all__ = ["Factories"]


def _no_recorders(env: World) -> Sequence[Recorder]:
    return ()


@dataclass(frozen=True)
class Factories:
    """Constructors of a run's parts, for a program that puts its own in (docs/howto/bring/research.md).

    Other processes (`--jobs`) import them by module and name, so there they must not be of the program's main module.
    """

    env: Callable[..., World] = ArenaEnv
    tracker: Callable[[str, Path | None], Tracker] = trackers.get
    policy: Callable[..., Policy] = policies.get
    check_variant: Callable[[Path, str], None] = validate.check
    """Raises InputError for a file that is not a scene of the task."""
    recorders: Callable[[World], Sequence[Recorder]] = _no_recorders
    """Recorders of an environment, made once for it; their metrics are in the journal (`EpisodeResult.extra`)."""

    def measuring(self, env: World, named: Sequence[str]) -> list[Recorder]:
        """Recorders of an environment: those of the program, then those of `--recorder`.

        Raises:
            InputError: A recorder cannot be made, or two metrics have one name.
        """
        found = [*self.recorders(env), *(recorders.get(name, env) for name in named)]
        recorders.check_names(found)
        return found
