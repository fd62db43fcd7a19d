"""`python -m arena_newton.eval film`: one success per task as a film or a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

__all__ = ["FilmOptions", "run"]


@dataclass(frozen=True)
class FilmOptions:
    """Show one success per task of one or several results folders in a single film or picture."""

    out: str = "film.webp"
    """File to write: .webp, .gif or .mp4 is a film of the world videos side by side (run --video), .jpg or .png the
    world strips one below the other (run --strip)."""
    seconds: float = 12.0
    """Length of the film [s]; every episode is played from its start to its end in it."""
    width: int = 960
    """Width of the film or picture [px]."""
    max_mb: float = 3.0
    """Largest size of a .webp film [MB]; its quality is lowered until it fits."""


def run(folders: Sequence[Path], options: FilmOptions) -> int:
    """Write the film, and print which episodes it shows."""
    from arena_newton.eval.folders.results import load_run
    from arena_newton.eval.reports import success_film

    runs, out = [load_run(folder) for folder in folders], Path(options.out).expanduser()
    for line in success_film.write(runs, out, options.seconds, options.width, options.max_mb):
        print(line)
    return 0
