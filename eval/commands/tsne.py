"""`python -m arena_newton.eval tsne`: one policy's actions under observations of two datasets, mapped and measured."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.flags import Several
from arena_newton.errors import InputError
from arena_newton.files.text import counted, plain_text

if TYPE_CHECKING:
    from arena_newton.eval.studies.action_map import ActionMap, Separation
    from arena_newton.eval.studies.predicted_actions import DatasetObservations
    from arena_newton.files.stored_json import JsonObject
    from arena_newton.policies.base import Policy

__all__ = ["TsneOptions", "run"]

FORMAT = 1
"""Version of tsne.json."""


@dataclass(frozen=True)
class TsneOptions:
    """Map the actions that one policy predicts from the observations of two datasets, as the paper's t-SNE figures."""

    policy: str = ""
    """Policy that predicts, such as lerobot:<checkpoint>."""
    datasets: Several[str] = ()
    """Two LeRobot datasets of the same tasks, such as one recorded through each tracker."""
    samples: int = 1000
    """Observations of each dataset and task."""
    frames: int = 10
    """Uniformly spaced observations of each episode."""
    out: str = "tsne"
    """Folder to write: tsne.json, and one picture per task."""
    seed: int = 0
    """Seed of the embedding and of the policy's noise."""
    perplexity: float = 30.0
    """Perplexity of the embedding."""
    batch: int = 50
    """Observations that the policy is given at once."""


def run(options: TsneOptions) -> int:
    """Write tsne.json and the figures, and print one line per task.

    Raises:
        InputError: A flag, a dataset or the policy is unfit.
        StorageError: A file cannot be written.
    """
    from arena_newton import policies, tasks
    from arena_newton.eval.records.journal import StorageError, write_atomic
    from arena_newton.eval.studies.action_map import draw
    from arena_newton.eval.studies.predicted_actions import DatasetObservations

    _check(options)
    first, second = (DatasetObservations(Path(name).expanduser()) for name in options.datasets)
    names = _names(first, second)
    common = [task for task in tasks.names() if task in first.episodes and task in second.episodes]
    if not common:
        raise InputError(f"--datasets: {first.root} and {second.root} have no task in common")
    out = Path(options.out).expanduser()
    policy = policies.get(options.policy)
    try:
        policy.check()
        for task in common:
            policy.check_task(task)
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"--out {out}: cannot be made ({error.strerror})") from None
        maps, results = [], {}
        for task in common:
            one, results[task] = _task(policy, (first, second), names, task, options)
            maps.append(one)
            print(_line(task, one, results[task]), flush=True)
            draw([one], f"{_title(options.policy)}: predicted actions", out / f"tsne_{task}.png")
        if len(maps) > 1:
            draw(maps, f"{_title(options.policy)}: predicted actions", out / "tsne.png")
        write_atomic(out / "tsne.json", _json(policy, options, (first, second), names, results))
    finally:
        policy.close()
        first.close()
        second.close()
    print(f"written: {out / 'tsne.json'} and {counted(len(maps) + (len(maps) > 1), 'figure')}")
    return 0


def _check(options: TsneOptions) -> None:
    if not options.policy:
        raise InputError("--policy: name the policy that predicts, such as lerobot:<checkpoint>")
    if len(options.datasets) != 2:
        raise InputError(f"--datasets: expected two, given {len(options.datasets)}")
    for name, value, least in (
        ("samples", options.samples, 4),
        ("frames", options.frames, 1),
        ("batch", options.batch, 1),
    ):
        if not least <= value <= 1_000_000:
            raise InputError(f"--{name} {value}: expected a number of at least {least}")
    if not 1.0 <= options.perplexity <= 1000.0:
        raise InputError(f"--perplexity {options.perplexity}: expected 1 to 1000")
    if not 0 <= options.seed < 2**32:
        raise InputError(f"--seed {options.seed}: expected 0 to 2^32 - 1")


def _names(first: DatasetObservations, second: DatasetObservations) -> tuple[str, str]:
    """Names of the sources; folders are named too where both are of one tracker."""
    a, b = plain_text(first.name, 40), plain_text(second.name, 40)
    return (a, b) if a != b else (f"{a} 1", f"{b} 2")


def _task(
    policy: Policy,
    datasets: tuple[DatasetObservations, DatasetObservations],
    names: tuple[str, str],
    task: str,
    options: TsneOptions,
) -> tuple[ActionMap, JsonObject]:
    import numpy as np

    from arena_newton.eval.studies.action_map import ActionMap, embed, separation, shifted
    from arena_newton.eval.studies.predicted_actions import as_many_of_each, predict

    samples = as_many_of_each(datasets, task, options.samples, options.frames)  # so that 0.5 is chance
    most = len(samples[0])
    answers = [
        predict(policy, data, one, batch=options.batch, seed=options.seed)
        for data, one in zip(datasets, samples, strict=True)
    ]
    actions = np.concatenate(answers)
    states = np.concatenate([one.states for one in samples])
    sources = np.repeat([0, 1], most)
    apart = samples[0].episodes.max() + 1
    episodes = np.concatenate([samples[0].episodes, samples[1].episodes + apart])
    of_actions, of_states = (separation(values, sources, episodes) for values in (actions, states))
    if of_actions is None or of_states is None:
        raise InputError(f"--datasets: {task}: a source has fewer than two episodes, nothing can be held out")
    points = embed(actions, perplexity=options.perplexity, seed=options.seed)
    one = ActionMap(task, points, sources, names, of_actions, of_states)
    result: JsonObject = {
        "samples_per_source": most,
        "episodes": [len(set(part.episodes.tolist())) for part in samples],
        "actions_told_apart": _separation(of_actions),
        "states_told_apart": _separation(of_states),
        "largest_shifts": [{"number": name, "shift": round(by, 4)} for name, by in shifted(actions, sources)],
    }
    return one, result


def _separation(found: Separation) -> JsonObject:
    return {key: round(value, 6) for key, value in dataclasses.asdict(found).items()}


def _line(task: str, one: ActionMap, result: JsonObject) -> str:
    accuracies = [
        f"from the {what} {100 * r.accuracy:.1f} % ({100 * r.low:.0f} to {100 * r.high:.0f})"
        for what, r in (("action", one.actions), ("state", one.observations))
    ]
    number = result["samples_per_source"]
    sources = f"{number} + {number} observations of {one.names[0]} and {one.names[1]}"
    return f"{task}: {sources}; source predicted {', '.join(accuracies)}; chance 50 %"


def _title(spec: str) -> str:
    return plain_text(spec, 80)


def _json(
    policy: Policy,
    options: TsneOptions,
    datasets: tuple[DatasetObservations, DatasetObservations],
    names: tuple[str, str],
    results: JsonObject,
) -> str:
    content = {
        "format": FORMAT,
        "policy": policy.describe(),
        "labels": policy.labels or "v3.1",
        "sources": [
            {"name": name, "dataset": data.root.name, "hash": data.digest}
            for name, data in zip(names, datasets, strict=True)
        ],
        "frames_per_episode": options.frames,
        "seed": options.seed,
        "perplexity": options.perplexity,
        "tasks": results,
    }
    return json.dumps(content, indent=2, sort_keys=True, allow_nan=False, default=str) + "\n"
