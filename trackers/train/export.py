"""Export of a training checkpoint to the weights file of a tracker and its card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from arena_newton.errors import InputError
from arena_newton.files.limits import TEXT_BYTES
from arena_newton.files.own_files import replace_atomically
from arena_newton.files.stored_json import read_object
from arena_newton.pages.tables import Table
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.interface import get
from arena_newton.trackers.train.checkpoint import Checkpoint
from arena_newton.trackers.train.train_options import ExportOptions

__all__ = ["export", "write"]


def export(checkpoint: Path, options: ExportOptions) -> Path:
    """Write the weights of a training's checkpoint; returns the file.

    Raises:
        InputError: The checkpoint is unfit, or a file cannot be written.
    """
    if options.out.suffix != ".safetensors":
        raise InputError(f"--out {options.out}: expected a .safetensors file")
    if options.metrics is not None and options.metrics.resolve() == options.out.with_suffix(".json").resolve():
        raise InputError(f"--out {options.out}: its card would overwrite --metrics {options.metrics}")
    cards = [options.out.with_suffix(suffix) for suffix in (".json", ".md")]
    if not options.out.exists() and (taken := [c for c in cards if c.exists()]):
        raise InputError(f"--out {options.out}: its card would overwrite {taken[0]}, which is not of these weights")
    state = Checkpoint.read(checkpoint)
    network = get(state.card.tracker).make_network(state.network)
    prefix = "net."
    tensors = {k[len(prefix) :]: v for k, v in state.actor_state_dict.items() if k.startswith(prefix)}
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{checkpoint}: its network does not fit interface {state.card.tracker}") from error
    card = state.card.to_dict() | {
        "iterations": state.iter,
        "samples": state.samples,
        "minutes": round(state.seconds / 60.0, 2),
        "gpu_minutes": round(_process_seconds(state) / 60.0, 2),
        "training": {k: round(v, 5) for k, v in state.last.items() if "/" in k},
    }
    form, drive, physics = card.pop("action_form"), card.pop("drive"), card.pop("physics")
    card |= {name: text for name in ("note", "hardware") if (text := getattr(options, name))}
    if options.metrics is not None:
        card["metrics"] = _figures(options.metrics, card["tracker"])
    try:
        read = weights_file.action_form(form), weights_file.drive(drive), weights_file.physics(physics)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{checkpoint}: the card's action form, drive or physics rate is unfit ({error})") from None
    weights = weights_file.Weights(
        card["tracker"],
        network,
        *read,
        symmetric=options.symmetric,
        card=card | {"symmetric": options.symmetric},
    )
    return write(weights, options.out)


def write(weights: weights_file.Weights, out: Path) -> Path:
    """Write a weights file and its card next to it, as .json and .md; returns the file.

    Raises:
        InputError: A file cannot be written.
    """
    data = json.dumps(weights.card, indent=2, sort_keys=True)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        weights_file.save(out, weights)
        for suffix, text in ((".json", data + "\n"), (".md", _markdown(dict(weights.card)))):
            with replace_atomically(out.with_suffix(suffix)) as file:
                file.write(text.encode())
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from error
    return out


def _process_seconds(checkpoint: Checkpoint) -> float:
    """Seconds of training times the processes that trained, over all parts of a training that was resumed."""
    parts = [(part["seconds"], part["processes"]) for part in checkpoint.card.earlier]
    total, before = 0.0, 0.0
    for seconds, processes in (*parts, (checkpoint.seconds, checkpoint.card.processes)):
        total += (seconds - before) * processes
        before = seconds
    return total


def _figures(path: Path, interface: str) -> dict[str, Any]:
    """Figures of the first tracker of an evaluation that has the interface, and how they were measured.

    Raises:
        InputError: The file is no evaluation of such a tracker.
    """
    document = read_object(path, TEXT_BYTES)
    try:
        measured = next(t for t in document["trackers"] if t["name"] == interface)
        figures = [{key: str(f[key]) for key in ("name", "bar", "value", "verdict")} for f in measured["figures"]]
        settings = dict(document["options"])
    except StopIteration:
        raise InputError(f"--metrics {path}: an evaluation of other trackers than {interface}") from None
    except (KeyError, TypeError, ValueError):
        raise InputError(f"--metrics {path}: not an evaluation.json of trackers.evaluate") from None
    kept = ("suite", "rollouts", "seed", "engine", "device", "clips", "only")
    return {"figures": figures, "settings": {k: settings[k] for k in kept if settings.get(k) not in (None, "")}}


def _markdown(card: dict[str, Any]) -> str:
    """The card for people."""
    lines = [f"# Tracker weights: {card['tracker']}", ""]
    if card.get("note"):
        lines += [card["note"], ""]
    rows = {
        "command": f"`{card['command']}`",
        "commit": card["commit"],
        "samples": f"{card['samples']:,}",
        "minutes": f"{card['minutes']} on {card.get('hardware', 'unnamed hardware')}",
        "iterations": card["iterations"],
        "worlds": f"{card['worlds']} x {card['processes']} processes",
        "seed": card["seed"],
        "answers": "mean of both ways to a mirrored action" if card.get("symmetric") else "the network as it is",
        "licences of the data": ", ".join(f"{name} ({count} clips)" for name, count in card["licences"].items()),
        "sources of the data": "; ".join(card["data"]["sources"]),
    }
    if drawn := card.get("events"):
        rows["randomisation"] = "; ".join(
            f"{n} " + ", ".join(f"{k} {v:g}" for k, v in e.items()) for n, e in drawn.items()
        )
    for k, part in enumerate(card.get("earlier", ()), start=1):
        rows[f"part {k}"] = f"to iteration {part['iter']}, commit {part['commit']}: `{part['command']}`"
    if started := card.get("started_from"):
        rows["started from"] = f"the weights of commit {started}"
    families = [(name, f["clips"], f["minutes"]) for name, f in card["data"]["families"].items()]
    lines += [*Table(("", ""), list(rows.items())).compact(), "", "## References", ""]
    lines += Table(("family", "clips", "minutes"), families).compact()
    if figures := card.get("metrics", {}).get("figures"):
        lines += ["", "## Evaluation", ""]
        if command := card["metrics"].get("command"):
            lines += [f"`{command}`", ""]
        if settings := card["metrics"].get("settings"):
            lines += [", ".join(f"{name} {value}" for name, value in settings.items()), ""]
        cells = [(f["name"], f["bar"], f["value"], f["verdict"]) for f in figures]
        lines += Table(("figure", "bar", "value", ""), cells).compact()
    lines += ["", "## At the end of training", "", *Table(("", ""), list(card["training"].items())).compact()]
    return "\n".join(lines) + "\n"
