"""Statistics against closed forms; against the paper's tables in test_paper_numbers.py."""

import math

import pytest
from rows import episodes, record

from arena_newton.eval.statistics.stats import (
    aggregate,
    cell,
    error_reasons,
    outside_suites,
    pooled,
    population_std,
    suites,
    wilson,
)


def test_cell_counts_and_rates():
    """A cell counts outcomes, and its rates, interval and mean follow from the counts."""
    rows = episodes("football", (4, 5, 7), falls=3)
    rows[0]["outcome"] = "error"
    rows[0]["steps"] = 0
    rows[19]["startup_fall"] = True
    result = cell([record(row) for row in rows])
    assert (result["episodes"], result["successes"], result["falls"], result["errors"]) == (60, 15, 3, 1)
    assert result["startup_falls"] == (rows[19]["outcome"] == "fall")
    assert result["sr"] == 0.25
    assert result["afr"] == 0.05
    assert result["sr_seed_std"] == pytest.approx(math.sqrt(((0.15 - 0.25) ** 2 + 0 + (0.35 - 0.25) ** 2) / 3))
    assert result["mean_steps"] == pytest.approx((60 * 100 + 3 * 190 - 100) / 59)


def test_wilson_interval():
    """Known values of the Wilson interval (Newcombe 1998, table I, 81/263: 0.2553 to 0.3662), closed at the ends."""
    assert wilson(81, 263) == pytest.approx([0.2553, 0.3662], abs=5e-5)
    assert wilson(0, 20)[0] == 0.0
    assert wilson(20, 20)[1] == 1.0
    assert wilson(0, 0) is None


def test_empty_input_gives_no_rate():
    """Without episodes there is no rate, and no division by zero."""
    assert cell([])["sr"] is None
    assert population_std([]) is None
    assert aggregate([]) == {"cells": [], "suites": []}


def test_order_of_journal_is_irrelevant():
    """Cells come in plan order, whatever order the episodes ended in."""
    rows = episodes("football", (1, 2, 3)) + episodes("boxing", (3, 2, 1), index=60)
    records = [record(row) for row in rows]
    assert aggregate(records) == aggregate(records[::-1])
    assert [c["task"] for c in aggregate(records[::-1])["cells"]] == ["football", "boxing"]


def test_suite_needs_all_its_tasks():
    """A suite average is given only when each of its tasks was run."""
    rows = [record(row) for row in episodes("football", (1, 2, 3))]
    assert aggregate(rows)["suites"] == []
    assert pooled({"football": rows}, suites()["HOI_AVG"]) is None


def test_a_task_outside_the_averages_is_named():
    """A task that the paper's averages lack is named; its seven are not."""
    assert outside_suites(suites()["ALL_AVG"]) == []
    assert outside_suites(["football", "golf", "golf"]) == ["golf"]


def test_reasons_of_errors_are_counted():
    """Equal causes are counted together, the most frequent first, in one line without terminal escapes."""
    rows = episodes("football", (20, 20, 20))
    for number, message in enumerate(("a\x1b[31mb\nc", "a b c", "\x1b]0;title\x07late", None, "a\u202eb c" * 200)):
        rows[number] |= {"outcome": "error", "reason": "policy", "error": message}
    first, *others = error_reasons([record(row) for row in rows])
    assert first == {"reason": "policy", "message": "a b c", "count": 2}
    assert [other["message"][:8] for other in others] == ["ab cab c", "late", "no messa"]
    assert max(len(other["message"]) for other in others) == 400
    assert error_reasons([record(row) for row in rows[10:]]) == []
