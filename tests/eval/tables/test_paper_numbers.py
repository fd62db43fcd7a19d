"""The paper's numbers: read whole, consistent with each other, and statistics against closed forms."""

import collections
import functools
import itertools
import math
import random

import pytest
from rows import episodes, record

from arena_newton.errors import InputError
from arena_newton.eval.statistics.stats import (
    aggregate,
    contrast,
    holm,
    mcnemar,
    paired_rates,
    pooled,
    population_std,
    suites,
)
from arena_newton.eval.tables.paper_numbers import (
    FAMILIES,
    FOLDER,
    PAPER_MODES,
    TRAINING_SETS,
    paper_numbers,
    read_paper,
)

FILES = ("in_gmt.csv", "cross_gmt.csv", "merge_all.csv")


@pytest.fixture
def copied(tmp_path):
    """A folder with copies of the three files."""
    for name in FILES:
        (tmp_path / name).write_bytes((FOLDER / name).read_bytes())
    return tmp_path


@functools.cache
def counts_of(seeds):
    """Successes of so many seeds x 20 repeats, by their sum."""
    found = collections.defaultdict(list)
    for counts in itertools.combinations_with_replacement(range(21), seeds):
        found[sum(counts)].append(counts)
    return found


def seed_counts(rate):
    """Successes of seeds x 20 repeats that print as a rate's mean and std; all that fit."""
    seeds = rate.episodes // 20
    return [
        counts
        for total in range(20 * seeds + 1)
        if abs(total / 20 / seeds - rate.sr) < 5.1e-4
        for counts in counts_of(seeds)[total]
        if abs(population_std([count / 20 for count in counts]) - rate.sr_std) < 5.1e-4
    ]


def test_suite_averages_of_the_paper_follow_from_its_tasks():
    """Every average (mean and population std over all task x seed rates) comes out of the paper's own rows."""
    numbers, checked, odd = paper_numbers(), 0, []
    rows = [((t, m, f), numbers.in_gmt) for t in ("twist2", "sonic") for m in PAPER_MODES for f in FAMILIES.values()]
    rows += [((name, f), numbers.merged) for name in TRAINING_SETS for f in FAMILIES.values()]
    for key, table in rows:
        for suite in ("HOI_AVG", "HSI_AVG"):
            found, tasks = table[(*key, suite)], suites()[suite]
            rates = [table[(*key, task)] for task in tasks]
            weighted = sum(rate.sr * rate.episodes for rate in rates) / sum(rate.episodes for rate in rates)
            assert weighted == pytest.approx(found.sr, abs=6e-4), (key, suite)
            choices = [seed_counts(rate) for rate in rates]
            pooled_rates = ([c / 20 for counts in one for c in counts] for one in itertools.product(*choices))
            if not any(
                abs(math.fsum(one) / len(one) - found.sr) < 6e-5 and abs(population_std(one) - found.sr_std) < 6e-5
                for one in pooled_rates
            ):
                odd.append((*key, suite))
            if all(len(fits) == 1 for fits in choices):
                records = {
                    task: [record(row) for row in episodes(task, fits[0])]
                    for task, fits in zip(tasks, choices, strict=True)
                }
                result = pooled(records, tasks)
                assert result["sr"] == pytest.approx(found.sr, abs=6e-5), (key, suite)
                assert result["sr_std"] == pytest.approx(found.sr_std, abs=6e-5), (key, suite)
                checked += 1
    # The one number of 72 that the paper's rows do not give (they give 22.11).
    assert odd == [("TWIST2+SONICx14", "diffusion", "HOI_AVG")]
    assert checked >= 50


def test_a_run_of_all_tasks_has_the_averages_of_act():
    """ACT's seed rows give its suite average of 28.33 ± 13.94 % and its 27 falls of 420."""
    rates = {task: paper_numbers().in_gmt["twist2", "base", "act", task] for task in suites()["ALL_AVG"]}
    records = [
        record(row)
        for number, (task, rate) in enumerate(rates.items())
        for row in episodes(task, seed_counts(rate)[0], falls=27 * (number == 0), index=60 * number)
    ]
    found = {suite["suite"]: suite for suite in aggregate(records)["suites"]}
    hoi, every = found["HOI_AVG"], found["ALL_AVG"]
    assert [100 * hoi["sr"], 100 * hoi["sr_std"]] == pytest.approx([28.33, 13.94], abs=0.005)
    assert (every["falls"], every["episodes"]) == (27, 420) and 100 * every["afr"] == pytest.approx(6.43, abs=0.005)


def test_the_prose_of_the_paper_follows_from_its_tables():
    """Mean drops of 39.9 and 36.0 points and fall rates of 1.36 and 7.56 % come out of the table of cross-GMT."""
    cells = paper_numbers().cross_gmt.values()
    for trained_on, drop, falls in (("twist2", 39.9, 1.36), ("sonic", 36.0, 7.56)):
        mine = [cell for cell in cells if cell.trained_on == trained_on]
        assert len(mine) == 28
        assert 100 * sum(cell.drop for cell in mine) / 28 == pytest.approx(drop, abs=0.051)
        assert 100 * sum(cell.task_afr for cell in mine) / 28 == pytest.approx(falls, abs=0.0051)
    best = paper_numbers().best("twist2", "boxing")
    assert (best.family, best.sr, best.successes) == ("flow", 0.633, 38)


def test_cells_of_other_sizes_are_found():
    """The two cells of ACT that lack a seed, and those that both trackers played, get their number of episodes."""
    merged = paper_numbers().merged
    assert merged["TWIST2x7", "act", "pp_box"].episodes == 40
    assert merged["TWIST2+SONICx14", "act", "pp_box"].episodes == 100
    assert merged["TWIST2+SONICx14", "act", "football"].episodes == 120
    assert merged["TWIST2+SONICx14", "act", "HOI_AVG"].episodes == 340
    assert {rate.episodes for rate in paper_numbers().in_gmt.values()} == {60, 180, 240}


@pytest.mark.parametrize(
    ("name", "was", "now", "message"),
    [
        ("in_gmt.csv", "twist2,base,act,football,26.7", "twist2,base,act,football,26.8", "line 2: sr_mean_pct is 26.8"),
        ("in_gmt.csv", "twist2,base,act,football,", "twist2,base,act,golf,", "line 2: task is 'golf'"),
        (
            "in_gmt.csv",
            "sonic,base,act,football,16.7",
            "sonic,base,act,football,nan",
            "is 'nan', expected a percentage",
        ),
        ("in_gmt.csv", "twist2,base,act,double_desk,", "twist2,base,act,football,", "is there twice"),
        ("in_gmt.csv", "sr_std_pct", "std", "expected the columns"),
        ("cross_gmt.csv", "act,football,26.70,0.00", "act,football,26.70,5.00", "is no retention of 5 %"),
        ("cross_gmt.csv", "twist2->sonic,act,football", "twist2->pd,act,football", "direction is 'twist2->pd'"),
        ("merge_all.csv", "TWIST2x7,act,football", "TWIST2x8,act,football", "training_set is 'TWIST2x8'"),
        ("merge_all.csv", "TWIST2x7,act,pp_box,17.5", "TWIST2x7,act,pp_box,17.5,1", "line 4: has 7 columns"),
    ],
)
def test_a_changed_file_is_refused(copied, name, was, now, message):
    """A number, name or column that cannot be the paper's is one error that names file and line."""
    text = (copied / name).read_text()
    assert was in text
    (copied / name).write_text(text.replace(was, now, 1))
    with pytest.raises(InputError, match=name) as caught:
        read_paper(copied)
    assert message in str(caught.value)


def test_a_missing_cell_and_a_missing_file_are_refused(copied):
    """A table that lacks a cell is not read as the paper's, nor is an absent file."""
    lines = (copied / "cross_gmt.csv").read_text().splitlines(keepends=True)
    (copied / "cross_gmt.csv").write_text("".join(lines[:-1]))
    with pytest.raises(InputError, match="has 55 cells, the paper's table has 56"):
        read_paper(copied)
    (copied / "cross_gmt.csv").unlink()
    with pytest.raises(InputError, match=r"cross_gmt\.csv: cannot be read"):
        read_paper(copied)


def test_mutated_files_are_read_or_refused(copied, mutants):
    """Each of many damaged copies is read as it is or refused in one line; nothing else happens."""
    rng, refused = random.Random(0), 0
    whole = {name: (copied / name).read_bytes() for name in FILES}
    for number in range(mutants):
        name = FILES[number % 3]
        data = bytearray(whole[name])
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(data))
            data[at : at + rng.randint(0, 2)] = bytes(rng.randrange(256) for _ in range(rng.randint(0, 2)))
        (copied / name).write_bytes(data)
        try:
            read_paper(copied)
        except InputError as error:
            refused += 1
            assert name in str(error) and "\n" not in str(error)
        (copied / name).write_bytes(whole[name])
    assert refused > mutants // 3


def test_mcnemar_is_exact():
    """Known values of the exact test (discordant pairs 1 and 7: 18/256), symmetric, 1 where nothing speaks."""
    assert mcnemar(1, 7) == pytest.approx(18 / 256)
    assert mcnemar(7, 1) == mcnemar(1, 7)
    assert mcnemar(0, 5) == pytest.approx(2 / 32)
    assert mcnemar(0, 0) == mcnemar(4, 4) == 1.0
    assert mcnemar(0, 60) == pytest.approx(2 / 2**60)


def test_holm_adjusts_in_steps():
    """Holm's own example order: each p times the number of those left, never decreasing, at most 1."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


def test_only_common_episodes_are_paired():
    """Episodes of one condition alone are counted and left out of rates and test."""
    first = {(0, i): i < 15 for i in range(20)}
    second = {(0, i): i < 5 for i in range(10, 30)}
    result = paired_rates(first, second)
    assert (result.pairs, result.unpaired) == (10, 20)
    assert (result.first, result.second) == (0.5, 0.0)
    assert (result.only_first, result.only_second) == (5, 0)
    assert result.p == pytest.approx(2 / 32)
    assert paired_rates(first, {}).p is None


def test_contrast_is_the_interval_of_agresti_and_min():
    """The difference of two paired rates has the published interval, and stays open where nothing varies."""
    outcomes = [(True, True)] * 20 + [(True, False)] * 25 + [(False, True)] * 5 + [(False, False)] * 10
    first, second = ({i: pair[k] for i, pair in enumerate(outcomes)} for k in (0, 1))
    found = contrast([[(1.0, first), (-1.0, second)]])
    n, b, c = 62, 25.5, 5.5
    half = 1.959963984540054 * math.sqrt((b + c) - (b - c) ** 2 / n) / n
    assert found.value == pytest.approx(20 / 60)
    assert (found.low, found.high) == pytest.approx((20 / n - half, 20 / n + half))
    assert (found.strata, found.episodes, found.unpaired) == (1, 60, 0)
    same = contrast([[(1.0, dict.fromkeys(range(60), True)), (-1.0, dict.fromkeys(range(60), True))]])
    assert same.value == 0.0 and same.low == -same.high < -0.01
    assert contrast([]) is None
    assert contrast([[(1.0, {0: True}), (-1.0, {})]]) is None


def test_contrast_covers_the_truth():
    """About 95 % of the intervals of made experiments with known rates hold the true mean difference."""
    rng, held = random.Random(1), 0
    for _ in range(400):
        strata = []
        for base, other in ((0.9, 0.5), (0.4, 0.3), (0.6, 0.6)):
            luck = {i: rng.random() for i in range(60)}
            first = {i: u < base for i, u in luck.items()}
            second = {i: (luck[i] if rng.random() < 0.5 else rng.random()) < other for i in luck}
            strata.append([(1 / 3, first), (-1 / 3, second)])
        found = contrast(strata)
        held += found.low <= 0.5 / 3 <= found.high
    assert 0.92 < held / 400 < 0.99
