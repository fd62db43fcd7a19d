"""The original's files: names, columns and figures as its scripts expect them."""

import csv
import json

import pytest
from rows import episodes, made

from arena_newton.errors import InputError
from arena_newton.eval.folders.original_format import SUMMARY_COLUMNS, final_csv, original_files, write_original
from arena_newton.files.own_files import file_label

GYM = {"football": "Isaac-Move-Football-Single-G129-Dex3-Wholebody"}


def written(tmp_path, rows):
    """Write and return the run's folder."""
    write_original(tmp_path, original_files([made(row) for row in rows], GYM, (0, 1, 2), 20))
    return tmp_path / "football__t__base"


def test_summary_files(tmp_path):
    """summary.csv, summary.jsonl and summary.json agree with each other and with the episodes."""
    run = written(tmp_path, episodes("football", (12, 15, 17), falls=2))
    with (run / "summary.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert tuple(rows[0]) == SUMMARY_COLUMNS
    lines = [json.loads(line) for line in (run / "summary.jsonl").read_text().splitlines()]
    assert len(rows) == len(lines) == 60
    assert [int(row["episode_index"]) for row in rows] == list(range(60))
    assert [rows[0][key] for key in ("success", "failure_reason", "max_reward_scaled")] == ["True", "success", "0.02"]
    assert [rows[19][key] for key in ("success", "failure_reason", "max_reward")] == ["False", "timeout", "-1.0"]
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["total_episodes"], summary["total_successes"], summary["total_failures"]) == (60, 44, 16)
    assert summary["failure_reason_counts"] == {"fall": 2, "timeout": 14}
    model = summary["per_model"]["p"]
    assert model["per_seed_success_rate"] == {"0": 0.6, "1": 0.75, "2": 0.85}
    assert model["per_seed"]["1"]["successes"] == 15
    assert round(model["seed_success_rate_std"], 4) == 0.1027


def test_episode_files(tmp_path):
    """One JSON per episode, named by label, seed, repeat and index, with the recorded keys."""
    rows = episodes("football", (1, 0, 0))
    rows[21] |= {"outcome": "error", "error": "NaN in the action"}
    run = written(tmp_path, rows)
    names = sorted(p.name for p in (run / "episodes").iterdir())
    assert len(names) == 60 and "p__seed_1__repeat_1__episode_21.json" in names
    episode = json.loads((run / "episodes" / "p__seed_1__repeat_1__episode_21.json").read_text())
    keys = """task model_path model_label seed repeat_idx episode_seed episode_index success failure_reason
    episode_steps max_steps final_reward final_reward_scaled max_reward max_reward_scaled video_path video_recorded
    server_url started_at finished_at duration_sec episode_object_seed episode_object_seed_source error
    terminal_detail"""
    assert set(keys.split()) == set(episode)
    assert (episode["failure_reason"], episode["error"]) == ("sim_error", "NaN in the action")
    assert episode["task"] == GYM["football"]


@pytest.mark.parametrize(
    ("key", "value"), [("task", "../../escape"), ("task", "/tmp/escape"), ("mode", "x/../../../y")]
)
def test_nothing_is_written_outside(tmp_path, key, value):
    """Names that lead out of the folder are refused, and nothing appears there."""
    folder = tmp_path / "a" / "original"
    rows = [made(row | {key: value}) for row in episodes("football", (1, 0, 0))]
    with pytest.raises(InputError, match="lies outside"):
        write_original(folder, original_files(rows, {"football": "G", value: "G"}, (0, 1, 2), 20))
    assert list(tmp_path.iterdir()) == []


def test_long_names_are_cut(tmp_path):
    """A policy with a long address gets file names that every file system takes, and its own."""
    one, other = (file_label(f"remote:http://host/{'x' * 300}{end}") for end in "ab")
    assert len(one) == len(other) == 120 and one != other
    rows = [row | {"policy": f"remote:http://host/{'x' * 300}"} for row in episodes("football", (1, 0, 0))]
    assert len(list((written(tmp_path, rows) / "episodes").iterdir())) == 60


def test_final_csv():
    """final.csv prints fractions as the original does, e.g. "44/60 (73.3%)" and "0/16 (0.0%)"."""
    records = [made(row) for row in episodes("football", (13, 15, 16))]
    rows = list(csv.DictReader(final_csv(records).splitlines()))
    assert rows == [
        {
            "model": "p",
            "success_rate": "44/60 (73.3%)",
            "seed_success_rate_std": "6.2%",
            "avg_success_steps": "106.9",
            "fall_in_failures": "0/16 (0.0%)",
        }
    ]
