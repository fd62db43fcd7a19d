"""Results in the file formats of the original HumanoidArena evaluation, so that its users' scripts read them.

One run folder of the original holds one task, mode and tracker; here each is `original/<task>__<tracker>__<mode>/`
with `episodes/*.json`, `summary.csv`, `summary.jsonl`, `summary.json` and `final.csv`.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.records.journal import EpisodeRecord, write_atomic
from arena_newton.eval.statistics.stats import population_std, seed_rates
from arena_newton.files.own_files import file_label
from arena_newton.files.stored_json import JsonObject
from arena_newton.pages.tables import Table

__all__ = ["ORIGINAL", "SUMMARY_COLUMNS", "episode_json", "final_csv", "original_files", "summary_json"]
__all__ += ["write_original"]

ORIGINAL = "original"
"""Folder of these files."""

SUMMARY_COLUMNS = tuple(
    """task model_path model_label seed repeat_idx episode_seed episode_index
    episode_object_seed episode_object_seed_source success failure_reason episode_steps max_steps
    final_reward final_reward_scaled max_reward max_reward_scaled
    video_path log_path vla_trace_path server_url returncode""".split()
)
"""Columns of `summary.csv` and keys of `summary.jsonl`, in the original's order."""

EPISODE_SEED_FORMULA = "sha256(task_name|group_seed|repeat_idx)_positive_int32"
REWARD_SCALE = 0.02
"""The original's reward manager multiplies a reward by the control step [s]."""


def _reason(record: EpisodeRecord) -> str:
    return "sim_error" if record.outcome == "error" else record.outcome


def _reward(record: EpisodeRecord) -> float:
    """Raw reward of the last step: 1 on success; otherwise 0, and -1 in football."""
    if record.outcome == "success":
        return 1.0
    return -1.0 if record.task == "football" else 0.0


def _common(record: EpisodeRecord, gym_id: str, seeds: Sequence[int], repeats: int) -> JsonObject:
    reward = _reward(record)
    return {
        "task": gym_id,
        "model_path": record.policy,
        "model_label": file_label(record.policy),
        "seed": record.group_seed,
        "repeat_idx": record.repeat,
        "episode_seed": record.episode_seed,
        "episode_index": list(seeds).index(record.group_seed) * repeats + record.repeat,
        "success": record.outcome == "success",
        "failure_reason": _reason(record),
        "episode_steps": record.steps,
        "max_steps": record.max_steps,
        "final_reward": reward,
        "final_reward_scaled": reward * REWARD_SCALE,
        "max_reward": reward,
        "max_reward_scaled": reward * REWARD_SCALE,
        "video_path": record.video or "",
        "server_url": record.policy.removeprefix("remote:") if record.policy.startswith("remote:") else "",
        "episode_object_seed": record.object_seed,
        "episode_object_seed_source": "env_seed",
    }


def episode_json(record: EpisodeRecord, gym_id: str, seeds: Sequence[int], repeats: int) -> JsonObject:
    """Content of one `episodes/*.json`."""
    return _common(record, gym_id, seeds, repeats) | {
        "video_recorded": bool(record.video),
        "started_at": record.started_at,
        "finished_at": record.finished_at,
        "duration_sec": (record.durations or {}).get("wall_s"),
        "error": record.error,
        "terminal_detail": {key: getattr(record, key) for key in ("reason", "margin", "startup_fall")},
    }


def _row(record: EpisodeRecord, gym_id: str, seeds: Sequence[int], repeats: int) -> JsonObject:
    common = _common(record, gym_id, seeds, repeats)
    rest = {"log_path": "", "vla_trace_path": "", "returncode": int(record.outcome == "error")}
    return {column: (common | rest)[column] for column in SUMMARY_COLUMNS}


def _counts(records: Sequence[EpisodeRecord]) -> JsonObject:
    reasons = [_reason(record) for record in records]
    successes = reasons.count("success")
    return {
        "episodes": len(records),
        "successes": successes,
        "failures": len(records) - successes,
        "result_reason_counts": dict(sorted(Counter(reasons).items())),
        "failure_reason_counts": dict(sorted(Counter(r for r in reasons if r != "success").items())),
        "success_rate": successes / len(records) if records else 0.0,
    }


def summary_json(records: Sequence[EpisodeRecord], repeats: int) -> JsonObject:
    """Content of `summary.json`."""
    per_model = {}
    for name in dict.fromkeys(file_label(record.policy) for record in records):
        own = [record for record in records if file_label(record.policy) == name]
        rates = seed_rates(own)
        per_model[name] = _counts(own) | {
            "per_seed": {str(seed): _counts([r for r in own if r.group_seed == seed]) for seed in rates},
            "per_seed_success_rate": {str(seed): rate for seed, rate in rates.items()},
            "repeats_per_seed": repeats,
            "seed_success_rate_mean": math.fsum(rates.values()) / len(rates),
            "seed_success_rate_std": population_std(list(rates.values())),
        }
    total = _counts(records)
    return {
        "total_episodes": total["episodes"],
        "total_successes": total["successes"],
        "total_failures": total["failures"],
        "overall_success_rate": total["success_rate"],
        "result_reason_counts": total["result_reason_counts"],
        "failure_reason_counts": total["failure_reason_counts"],
        "episode_seed_formula": EPISODE_SEED_FORMULA,
        "per_model": per_model,
    }


def final_csv(records: Sequence[EpisodeRecord]) -> str:
    """Content of `final.csv`, e.g. `stand,44/60 (73.3%),4.7%,512.0,0/16 (0.0%)`."""
    rows = []
    for name in dict.fromkeys(file_label(record.policy) for record in records):
        own = [record for record in records if file_label(record.policy) == name]
        won = [record.steps for record in own if record.outcome == "success"]
        failures, falls = len(own) - len(won), sum(record.outcome == "fall" for record in own)
        rows.append(
            {
                "model": name,
                "success_rate": _fraction(len(won), len(own)),
                "seed_success_rate_std": f"{100 * (population_std(list(seed_rates(own).values())) or 0):.1f}%",
                "avg_success_steps": f"{math.fsum(won) / len(won):.1f}" if won else "",
                "fall_in_failures": _fraction(falls, failures),
            }
        )
    return _csv(rows, ("model", "success_rate", "seed_success_rate_std", "avg_success_steps", "fall_in_failures"))


def _fraction(part: int, whole: int) -> str:
    return f"{part}/{whole} ({100 * part / whole if whole else 0:.1f}%)"


def _csv(rows: Iterable[JsonObject], columns: Sequence[str]) -> str:
    return Table(columns, [[row[name] for name in columns] for row in rows]).csv()


def original_files(
    records: Sequence[EpisodeRecord], gym_ids: Mapping[str, str], seeds: Sequence[int], repeats: int
) -> dict[str, str]:
    """Texts of the original's files of every task, tracker and mode among records, by path below `original/`.

    Args:
        records: Episodes in the plan's order.
    """
    found: dict[str, str] = {}
    for task, tracker, mode in dict.fromkeys((r.task, r.tracker, r.mode) for r in records):
        own = [r for r in records if (r.task, r.tracker, r.mode) == (task, tracker, mode)]
        run = f"{task}__{file_label(tracker)}__{mode}"
        rows = [_row(record, gym_ids[task], seeds, repeats) for record in own]
        for record in own:
            content = episode_json(record, gym_ids[task], seeds, repeats)
            name = "{model_label}__seed_{seed}__repeat_{repeat_idx}__episode_{episode_index}.json".format(**content)
            found[f"{run}/episodes/{name}"] = json.dumps(content, indent=2) + "\n"
        found[f"{run}/summary.csv"] = _csv(rows, SUMMARY_COLUMNS)
        found[f"{run}/summary.jsonl"] = "".join(json.dumps(row) + "\n" for row in rows)
        found[f"{run}/summary.json"] = json.dumps(summary_json(own, repeats), indent=2) + "\n"
        found[f"{run}/final.csv"] = final_csv(own)
    return found


def write_original(folder: Path, texts: Mapping[str, str]) -> None:
    """Write the original's files, texts by path, below a folder.

    Raises:
        InputError: A path leads out of `folder`, or a folder inside is a link to another one.
        StorageError: A file cannot be written.
    """
    inside = folder.parent.resolve() / folder.name
    for name, text in texts.items():
        path = folder / name
        if not path.resolve().is_relative_to(inside):
            raise InputError(f"{path}: lies outside {folder}; nothing is written there")
        write_atomic(path, text)
