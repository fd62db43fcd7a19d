"""The card of a packed policy: what it was made of and what it reaches. Nothing heavy is loaded here."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.files.untrusted_files import read_bytes
from arena_newton.pages.tables import Table, between, percent
from arena_newton.tasks.semantic_mode import semantic_notes

__all__ = ["CARD_FILE", "CARD_PAGE", "NOT_SHIPPED", "SHIPPED", "CellResult", "PolicyCard", "read_card", "shipped_card"]

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
        fits = 0 < self.episodes <= MOST_EPISODES and min(self.successes, self.falls) >= 0
        if not fits or self.successes + self.falls > self.episodes:
            counts = f"{self.successes} successes and {self.falls} falls of {self.episodes} episodes"
            raise InputError(f"{self.task} {self.tracker} {self.mode}: {counts}, which cannot be")

    @property
    def rate(self) -> float:
        """Fraction of episodes that succeeded."""
        return self.successes / self.episodes


@dataclass(frozen=True, kw_only=True)
class PolicyCard:
    """Card of a packed policy, which describes it."""

    tasks: tuple[str, ...]
    """Tasks that it is offered for; the default run shows the first."""
    trackers: tuple[str, ...] = ()
    """Trackers through which its demonstrations were recorded."""
    family: str = ""
    recipe: str = ""
    steps: int = 0
    """Optimizer steps."""
    seed: int = 0
    gpu_minutes: float = 0.0
    """Time of the training [min]."""
    device: str = ""
    """Device of the training."""
    datasets: tuple[Mapping[str, object], ...] = ()
    """Of each dataset of its training: name, hash, episodes, frames."""
    command: str = ""
    """Command of the training."""
    packed_by: str = ""
    """Command that packed it."""
    weights: str = ""
    """First 12 hex digits of the SHA-256 of the packed weights."""
    precision: str = "float16"
    """Of its matrices; vectors are float32, and it computes in float32."""
    bytes: int = 0
    """Size of all files but the card [bytes]."""
    note: str = ""
    results: tuple[CellResult, ...] = ()

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
            "data": "; ".join(_dataset(one) for one in self.datasets),
            "training": f"`{self.command}`" if self.command else "",
            "optimizer steps": f"{self.steps:,}, seed {self.seed}",
            "GPU minutes": f"{self.gpu_minutes:.1f} on {self.device or 'an unnamed device'}",
            "packed by": f"`{self.packed_by}`" if self.packed_by else "",
            "size": f"{self.bytes / 1e6:.1f} MB, matrices in {self.precision}, computed in float32",
            "weights": self.weights,
        }
        about = Table(("", ""), [(name, _cell(text)) for name, text in rows.items() if text])
        lines = ["# The learned policy", "", *([self.note, ""] if self.note else []), *about.compact()]
        if self.results:
            head = ("task", "tracker", "mode", "successes", "SR %", "95 % CI", "falls")
            lines += ["", "## Results", "", *Table(head, [_result(one) for one in self.results], "lllr").compact()]
        lines += [line for note in semantic_notes(one.mode for one in self.results) for line in ("", note)]
        return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def _dataset(facts: Mapping[str, object]) -> str:
    counts = ", ".join(f"{facts[key]} {key}" for key in ("episodes", "frames") if key in facts)
    return f"{facts.get('name', '?')} ({', '.join(filter(None, (counts, str(facts.get('hash', '')))))})"


def _result(one: CellResult) -> tuple[object, ...]:
    rates = (percent(one.rate, 0), between(wilson(one.successes, one.episodes)).replace(" to ", "–"))
    return (one.task, one.tracker, one.mode, f"{one.successes}/{one.episodes}", *rates, one.falls)


def read_card(folder: Path) -> PolicyCard:
    """The card of a packed policy.

    Raises:
        InputError: There is none, or it is damaged; the message names the file and the field.
    """
    path = folder / CARD_FILE
    if not path.is_file():
        raise InputError(f"{folder}: holds no packed policy (no {CARD_FILE})")
    try:
        content = json.loads(read_bytes(path, MOST_CARD))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({error})") from None
    if not isinstance(content, dict) or content.pop("format", None) != FORMAT:
        raise InputError(f"{path}: expected an object with format {FORMAT}")
    given = {name: content[name] for name in PolicyCard.__dataclass_fields__ if name in content}
    kinds: dict[str, type | tuple[type, ...]] = {"steps": int, "seed": int, "bytes": int, "gpu_minutes": (int, float)}
    for name, value in given.items():
        if name in ("tasks", "trackers"):
            given[name] = _names(path, name, value)
        elif name == "datasets":
            given[name] = tuple(_objects(path, name, value))
        elif name == "results":
            given[name] = tuple(_cell_result(path, i, one) for i, one in enumerate(_objects(path, name, value)))
        elif isinstance(value, bool) or not isinstance(value, kinds.get(name, str)):
            raise InputError(f"{path}: {name} is {str(value)[:80]!r}, which it cannot be")
    if not given.get("tasks"):
        raise InputError(f"{path}: tasks is empty, expected at least one")
    return PolicyCard(**given)


def _names(path: Path, name: str, value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(one, str) and one for one in value):
        raise InputError(f"{path}: {name} is {str(value)[:80]!r}, expected a list of names")
    return tuple(value)


def _objects(path: Path, name: str, value: object) -> Sequence[dict[str, object]]:
    if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
        raise InputError(f"{path}: {name} is {str(value)[:80]!r}, expected a list of objects")
    return value


def _cell_result(path: Path, index: int, given: Mapping[str, object]) -> CellResult:
    names, counts = ("task", "tracker", "mode"), ("episodes", "successes", "falls")
    words, numbers = [given.get(name) for name in names], [given.get(name) for name in counts]
    if not all(isinstance(one, str) for one in words) or not all(type(one) is int for one in numbers):
        raise InputError(f"{path}: results[{index}] is {str(given)[:120]!r}, expected {', '.join(names + counts)}")
    try:
        return CellResult(**{name: given[name] for name in names + counts})  # type: ignore[arg-type]  # checked above
    except InputError as error:
        raise InputError(f"{path}: results[{index}]: {error}") from None


def shipped_card() -> PolicyCard | None:
    """The card of the policy that comes with the package; None where there is none.

    Raises:
        InputError: It is damaged.
    """
    return read_card(SHIPPED) if (SHIPPED / CARD_FILE).is_file() else None
