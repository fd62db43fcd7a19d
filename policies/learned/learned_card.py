"""The card of a packed policy: what it was made of and what it reaches. Nothing heavy is loaded here."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.files.stored_json import Fit, loaded, read_object
from arena_newton.pages.tables import Table, between, percent
from arena_newton.tasks.semantic_mode import semantic_notes

__all__ = ["CARD_FILE", "CARD_PAGE", "NOT_SHIPPED", "SHIPPED", "CellResult", "OtherTraining", "PolicyCard"]
__all__ += ["read_card", "shipped_card"]

SHIPPED = Path(__file__).parents[1] / "weights" / "learned"
"""Folder of the policy that comes with the package."""
CARD_FILE = "card.json"
"""File of a packed policy that programs read."""
CARD_PAGE = "card.md"
"""The same for people."""
NOT_SHIPPED = (
    "--policy learned: no policy comes with this build; learned:<folder> takes one that `python -m arena_newton.eval "
    "pack` made, lerobot:<checkpoint> a checkpoint"
)
"""Error where no policy is shipped."""
FORMAT = 1
"""Version of the card."""
MOST_CARD = 1 << 20
"""Largest card that is read [bytes]."""
MOST_EPISODES = 10_000_000
"""Most episodes of a cell; more is a damaged file."""
COUNTS = ("episodes", "successes", "falls")
"""Numbers of a cell."""
CELL = "task, tracker, mode, episodes, successes and falls"


def _possible(cell: Mapping[str, int]) -> bool:
    """True if the counts of a cell can be."""
    successes, falls, episodes = cell["successes"], cell["falls"], cell["episodes"]
    return 0 < episodes <= MOST_EPISODES and min(successes, falls) >= 0 and successes + falls <= episodes


@dataclass(frozen=True, kw_only=True)
class CellResult:
    """Result of a policy on one task, through one tracker, in one mode."""

    task: str
    tracker: str
    mode: str
    episodes: int
    successes: int
    falls: int

    def __post_init__(self) -> None:
        """Refuse counts that cannot be.

        Raises:
            InputError: More successes or falls than episodes, or no episode.
        """
        if not _possible(vars(self)):
            counts = f"{self.successes} successes and {self.falls} falls of {self.episodes} episodes"
            raise InputError(f"{self.task} {self.tracker} {self.mode}: {counts}, which cannot be")

    @property
    def rate(self) -> float:
        """Fraction of episodes that succeeded."""
        return self.successes / self.episodes


Results = Annotated[tuple[CellResult, ...], Fit(f"cells with {CELL}", lambda cells: all(map(_possible, cells)))]


@dataclass(frozen=True, kw_only=True)
class OtherTraining:
    """Another training of the same recipe on the same datasets, whose network is not packed."""

    seed: int
    weights: str
    """First 12 hex digits of the SHA-256 of its weights."""
    results: Results
    recorded_again: bool = False
    """Its datasets are those of the same names from other recordings of the same demonstrations."""


@dataclass(frozen=True, kw_only=True)
class PolicyCard:
    """Card of a packed policy, which describes it."""

    tasks: Annotated[tuple[str, ...], Fit("at least one name", lambda names: bool(names) and all(names))]
    """Tasks that it is offered for; the default run shows them all."""
    trackers: Annotated[tuple[str, ...], Fit("names", all)] = ()
    """Trackers through which its demonstrations were recorded."""
    family: str = ""
    recipe: str = ""
    steps: int = 0
    """Optimizer steps."""
    seed: int = 0
    started_from: str = ""
    """First 12 hex digits of the SHA-256 of the weights that the training began with; empty: new ones."""
    gpu_minutes: float = 0.0
    """Time of the training [min], of each of its processes."""
    processes: int = 1
    """Processes of the training, each with a GPU of its own."""
    device: str = ""
    """Device of the training."""
    datasets: Annotated[tuple[Mapping[str, object], ...], Fit("a list of objects")] = ()
    """Datasets of its training: name, hash, episodes, frames of each."""
    looks: tuple[str, ...] = ()
    """Fraction of its samples whose looks were changed, then those of single tasks, as `--looks` has them."""
    command: str = ""
    """Command of the training."""
    packed_by: str = ""
    """Command that packed it."""
    weights: str = ""
    """First 12 hex digits of the SHA-256 of the packed weights."""
    trained_weights: str = ""
    """The same of the checkpoint's, by which its results are found when the packed policy is packed again."""
    precision: str = "float16"
    """Precision of its matrices; vectors are float32, and it computes in float32."""
    bytes: int = 0
    """Size of all files but the card [bytes]."""
    note: str = ""
    results: Results = ()
    trainings: tuple[OtherTraining, ...] = ()

    def check_tasks(self, asked: Sequence[str]) -> None:
        """Refuse tasks that it is not offered for.

        Raises:
            InputError: One is not; the message names those that are.
        """
        for task in asked:
            if task not in self.tasks:
                raise InputError(
                    f"--policy learned: does {', '.join(self.tasks)} ({CARD_PAGE} says how well), not {task}"
                )

    def to_json(self) -> str:
        """Text of the card's file."""
        return json.dumps({"format": FORMAT} | asdict(self), indent=2, sort_keys=True) + "\n"

    def to_markdown(self) -> str:
        """The card for people."""
        rows = {
            "tasks": ", ".join(self.tasks),
            "trackers of its demonstrations": ", ".join(self.trackers),
            "family, recipe": f"{self.family}, {self.recipe}",
            "samples with changed looks": ", ".join(self.looks).replace("=", " "),
            "training": f"`{self.command}`" if self.command else "",
            "optimizer steps": f"{self.steps:,}, seed {self.seed}",
            "began with the weights": self.started_from,
            "GPU minutes": f"{self.processes * self.gpu_minutes:.1f} on {self._devices()}",
            "packed by": f"`{self.packed_by}`" if self.packed_by else "",
            "size": f"{self.bytes / 1e6:.1f} MB, matrices in {self.precision}, computed in float32",
            "weights": self.weights + f"; {self.trained_weights} before rounding" * bool(self.trained_weights),
            "other trainings": ", ".join(
                f"seed {one.seed} (weights {one.weights}{', demonstrations recorded again' * one.recorded_again})"
                for one in self.trainings
            ),
        }
        about = Table(("", ""), [(name, _cell(text)) for name, text in rows.items() if text])
        lines = ["# The learned policy", "", *([self.note, ""] if self.note else []), *about.compact()]
        if self.datasets:
            keys = ("name", "episodes", "frames", "hash")
            rows_of = [[_cell(str(one.get(key, ""))) for key in keys] for one in self.datasets]
            lines += ["", "## Data", "", *Table(("dataset", *keys[1:]), rows_of, "lrrl").compact()]
        if self.results:
            head = ("successes", "SR %", "95 % CI", "falls", *["other trainings"][: len(self.trainings)])
            modes = dict.fromkeys(one.mode for one in self.results)
            sums = [(mode, *self._row([one for one in self.results if one.mode == mode])) for mode in modes]
            cells = [(one.task, one.tracker, one.mode, *self._row([one])) for one in self.results]
            lines += ["", "## Results", "", *Table(("mode", *head), sums, "lr").compact()]
            lines += ["", *Table(("task", "tracker", "mode", *head), cells, "lllr").compact()]
        lines += [line for note in semantic_notes(one.mode for one in self.results) for line in ("", note)]
        return "\n".join(lines) + "\n"

    def _devices(self) -> str:
        return f"{self.processes} x " * (self.processes > 1) + (self.device or "an unnamed device")

    def _row(self, cells: Sequence[CellResult]) -> tuple[object, ...]:
        """Counts of some cells together, their rate with its interval, and successes of the other trainings."""
        episodes, successes, falls = (sum(getattr(one, name) for one in cells) for name in COUNTS)
        interval = between(wilson(successes, episodes)).replace(" to ", "–")
        others = []
        for training in self.trainings:
            won = {_conditions(one): one.successes for one in training.results}
            each = [won.get(_conditions(one)) for one in cells]
            others.append("–" if None in each else str(sum(filter(None, each))))
        rates = (f"{successes}/{episodes}", percent(successes / episodes, 0), interval, falls)
        return (*rates, " ".join(others)) if others else rates


def _conditions(one: CellResult) -> tuple[object, ...]:
    return one.task, one.tracker, one.mode, one.episodes


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def read_card(folder: Path) -> PolicyCard:
    """The card of a packed policy.

    Raises:
        InputError: There is none, or it is damaged; the message names the file and the field.
    """
    path = folder / CARD_FILE
    if not path.is_file():
        raise InputError(f"{folder}: holds no packed policy (no {CARD_FILE})")
    return loaded(str(path), read_object(path, MOST_CARD, FORMAT), PolicyCard)


def shipped_card() -> PolicyCard | None:
    """The card of the policy that comes with the package; None where there is none.

    Raises:
        InputError: It is damaged.
    """
    return read_card(SHIPPED) if (SHIPPED / CARD_FILE).is_file() else None
