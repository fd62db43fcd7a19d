"""The log of a training: a CSV, TensorBoard's curves, and a bar with loss and time left."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from arena_newton.files.own_files import replace_atomically
from arena_newton.pages.tables import csv_lines

__all__ = ["COLUMNS", "LOG_FILE", "TrainingLog"]

LOG_FILE = "progress.csv"
"""Rows of a training's log."""
COLUMNS = ("step", "minutes", "loss", "held_out_loss", "learning_rate", "gradient_norm", "steps_per_s")
"""Its columns; minutes are those of the optimization, of all parts of a resumed training. Where there are several pairs
of task and tracker, `loss_<pair>`, the mean since the row before, and `held_out_loss_<pair>` of each follow."""


class TrainingLog:
    """Writes rows where they are asked for; a resumed training's log goes on at its step."""

    def __init__(self, folder: Path, *, step: int = 0, quiet: bool = False, pairs: Sequence[str] = ()):
        """Open the log.

        Args:
            step: Step at which the training goes on; later rows of an interrupted part are dropped.
            pairs: Names of the pairs that have columns of their own.
        """
        self._path = folder / LOG_FILE
        self._columns = (*COLUMNS, *(f"{name}_{pair}" for name in ("loss", "held_out_loss") for pair in pairs))
        kept = [row for row in _rows(self._path) if int(row["step"]) <= step] if step else []
        with replace_atomically(self._path) as file:
            file.write(self._text([dict(zip(self._columns, self._columns, strict=True)), *kept]).encode())
        self._curves = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1 if step else None)
        self._bar = tqdm(
            total=None, initial=step, unit="step", disable=quiet or None, dynamic_ncols=True, mininterval=1.0
        )

    def advance(self, count: int, total: int) -> None:
        """Move the bar to a step of so many; 0: their number is not known yet."""
        if self._bar.total != (total or None):
            self._bar.total = total or None
        self._bar.update(count - self._bar.n)

    def record(self, row: dict[str, float]) -> None:
        """Add a row; a value that is missing or not a number is left empty."""
        facts = {name: value for name, value in row.items() if not math.isnan(value)}
        with self._path.open("a", newline="") as file:
            file.write(self._text([{name: f"{value:.8g}" for name, value in facts.items()}]))
        for name, value in facts.items():
            if name != "step":
                self._curves.add_scalar(f"train/{name}", value, int(row["step"]))
        shown = {"loss": f"{row['loss']:.4f}"} if "loss" in facts else {}
        if "held_out_loss" in facts:
            shown["held_out"] = f"{row['held_out_loss']:.4f}"
        self._bar.set_postfix(shown, refresh=False)

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._bar.write(line)

    def _text(self, rows: list[dict[str, str]]) -> str:
        return csv_lines([row.get(name, "") for name in self._columns] for row in rows)

    def close(self) -> None:
        """Write what is left; the bar stays as it is."""
        self._curves.close()
        self._bar.close()


def _rows(path: Path) -> list[dict[str, str]]:
    """Rows of a log that are whole: a killed training may leave a part of one."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        found = list(csv.DictReader(file))
    return [
        {str(name): str(value or "") for name, value in row.items()}
        for row in found
        if str(row.get("step") or "").isdigit()
    ]
