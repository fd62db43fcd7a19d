"""Reports are derived from configuration and journal alone, and hold what a reader needs."""

import json
import re

import pytest
from test_stats import episodes

from arena_newton.errors import InputError
from arena_newton.eval import report
from arena_newton.eval.journal import Journal


def folder_with(tmp_path, rows, planned, **config):
    """A results folder with these journal records."""
    identity = {"rules": "paper", "seeds": [0, 1, 2], "repeats": 20, "max_steps": None, "tracker": "t"} | config
    document = {
        "config": identity,
        "config_hash": "0123456789ab",
        "options": {},
        "planned": planned,
        "gym_ids": {"football": "Isaac-Move-Football-Single-G129-Dex3-Wholebody"},
        "rule_set": {"fall": "tilt > 60° <&>"},
    }
    tmp_path.mkdir(exist_ok=True)
    (tmp_path / "config.json").write_text(json.dumps(document))
    with Journal(tmp_path / "episodes.jsonl") as journal:
        for row in rows:
            journal.append(full(row))
    return tmp_path


def full(row):
    """A record with all journal keys."""
    rest = {"rules": "paper", "engine": "mujoco", "episode_seed": 7, "object_seed": 9, "max_steps": 1300, "margin": 0.1}
    rest |= {"reason": row["outcome"], "overflow": False, "error": None, "media": {}, "video": ""}
    rest |= {"durations": {"wall_s": 1.0, "sim_s": 2.0}, "started_at": "a", "finished_at": "b"}
    return rest | row


def test_results_json(tmp_path):
    """results.json holds one cell per task, tracker, policy and mode, with the published keys."""
    run = report.load_run(folder_with(tmp_path / "a", episodes("football", (4, 5, 7), falls=3), 60))
    results = report.write_reports(run)
    assert json.loads((tmp_path / "a" / "results.json").read_text()) == results
    (cell,) = results["cells"]
    keys = "task tracker policy mode episodes successes falls errors sr sr_seed_std ci95 afr mean_steps".split()
    assert set(keys) <= set(cell)
    assert results["complete"] and results["finished"] == 60


def test_wall_clock_is_nowhere_in_the_tables(tmp_path):
    """Two journals that differ in order, times and a repeated episode give the same bytes in every table."""
    rows = episodes("football", (4, 5, 7), falls=3)
    late = [row | {"durations": {"wall_s": 99.0, "sim_s": 2.0}, "started_at": "x", "finished_at": "y"} for row in rows]
    stale = [rows[5] | {"outcome": "error"}]
    report.write_reports(report.load_run(folder_with(tmp_path / "a", rows, 60)))
    report.write_reports(report.load_run(folder_with(tmp_path / "b", stale + late[::-1], 60)))
    for name in ("results.json", "table.md", "table.csv", "report.md", "report.html"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_html_is_self_contained_and_escaped(tmp_path):
    """The HTML report loads nothing from elsewhere, shows configuration and rules, and escapes what it prints."""
    rows = episodes("football", (1, 0, 0), falls=2)
    rows[1]["startup_fall"] = True
    rows[0]["media"] = {"ego": "videos/x__ego.mp4"}
    folder = folder_with(tmp_path / "a", rows, 60, policy="<script>")
    report.write_reports(report.load_run(folder))
    text = (folder / "report.html").read_text()
    assert not re.search(r"<(script|link|img|iframe)|https?://|url\(", text)
    assert "&lt;script&gt;" in text and "tilt &gt; 60° &lt;&amp;&gt;" in text
    assert "<a href='videos/x__ego.mp4'>ego</a>" in text
    assert "1 + 1" in text
    assert "videos/x__ego.mp4" in (folder / "report.md").read_text()


def test_notes_tell_what_the_table_hides(tmp_path):
    """Missing episodes, errors, overflow and a step cap are said in words."""
    rows = episodes("football", (1, 0, 0))[:30]
    rows[3] |= {"outcome": "error"}
    rows[4] |= {"overflow": True}
    run = report.load_run(folder_with(tmp_path / "a", rows, 60, max_steps=50))
    text = " ".join(report.notes(report.results_json(run)))
    for words in ("30 of 60", "1 episode ended with an error", "overflowed", "50 ticks"):
        assert words in text


def test_folder_without_run_is_named(tmp_path):
    """A folder that holds no run, or a broken config.json, is bad input."""
    with pytest.raises(InputError, match=r"no config\.json"):
        report.load_run(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(InputError, match="cannot be read"):
        report.load_run(tmp_path)
