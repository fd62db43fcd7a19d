"""Tests of rates against SciPy, against enumeration, and against their own promises on synthetic episodes."""

import itertools
import math
import random
import time
from types import SimpleNamespace

import pytest
from rows import episodes, record
from scipy.stats import binomtest, fisher_exact, hypergeom

from arena_newton.eval.certification.checks import error_rates
from arena_newton.eval.statistics.comparison import Contender, compare
from arena_newton.eval.statistics.detectable import (
    MOST_PAIRS,
    POWER,
    STEP,
    detectable_difference,
    detectable_text,
    paired_power,
)
from arena_newton.eval.statistics.rate_tests import (
    LARGEST_BOSCHLOO,
    PairedCounts,
    UnpairedCounts,
    excess,
    letters,
    rate_test,
    stratified_test,
)
from arena_newton.eval.statistics.stats import contrast, mcnemar, suites
from arena_newton.eval.statistics.trainings import RateTerm, trained_contrast
from arena_newton.eval.tables.comparison_page import beta_density
from arena_newton.eval.tables.episode_table import EvaluatedCell
from arena_newton.eval.tables.paper_numbers import paper_numbers
from arena_newton.eval.tables.suite_tables import suite_tables


def test_paired_test_is_the_binomial_test():
    """Within a task the p of paired episodes is SciPy's binomial test of the discordant ones."""
    for only_first, only_second in itertools.product(range(0, 14, 2), range(13)):
        found = rate_test(PairedCounts(7, only_first, only_second, 3))
        expected = binomtest(only_first, only_first + only_second).pvalue if only_first + only_second else 1.0
        assert (found.name, found.p) == ("McNemar", pytest.approx(expected, rel=1e-9))


def test_unpaired_test_is_the_largest_over_the_common_rate():
    """Boschloo's p is the probability of tables that Fisher's test finds no likelier, at the worst common rate."""
    for first, n, second, m in ((7, 12, 2, 12), (1, 6, 5, 8), (0, 9, 4, 7), (10, 10, 6, 9)):
        found = rate_test(UnpairedCounts(first, n, second, m))
        sides = []
        for side in ("less", "greater"):

            def fisher(a, b, n=n, m=m, side=side):
                law = hypergeom(n + m, a + b, n)
                return law.cdf(a) if side == "less" else law.sf(a - 1)

            observed = fisher(first, second)
            extreme = [(a, b) for a in range(n + 1) for b in range(m + 1) if fisher(a, b) <= observed * (1 + 1e-9)]
            sides.append(
                max(
                    sum(
                        math.comb(n, a) * math.comb(m, b) * rate ** (a + b) * (1 - rate) ** (n + m - a - b)
                        for a, b in extreme
                    )
                    for rate in (k / 400 for k in range(401))
                )
            )
        assert found.name == "Boschloo"
        assert found.p == pytest.approx(min(1.0, 2 * min(sides)), rel=2e-3)
    assert rate_test(UnpairedCounts(0, 5, 0, 7)).p == rate_test(UnpairedCounts(5, 5, 7, 7)).p == 1.0


def test_large_numbers_are_fishers():
    """Beyond the size that Boschloo's test takes, the test and its name are Fisher's."""
    n = math.isqrt(LARGEST_BOSCHLOO) + 1
    found = rate_test(UnpairedCounts(120, n, 150, n))
    assert (found.name, found.p) == ("Fisher", pytest.approx(fisher_exact([[120, n - 120], [150, n - 150]]).pvalue))
    assert rate_test(UnpairedCounts(5, n - 1, 9, 60)).name == "Boschloo"


def enumerated(strata):
    """Probability of the stratified test by listing every outcome of every stratum."""
    laws = []
    for counts in strata:
        if isinstance(counts, PairedCounts):
            trials = counts.only_first + counts.only_second
            coins = [sum(c) for c in itertools.product((0, 1), repeat=trials)]
            law = {k: coins.count(k) / 2**trials for k in set(coins)}
        else:
            both, n = counts.first + counts.second, counts.first_episodes
            chosen = [
                sum(c < both for c in some) for some in itertools.combinations(range(n + counts.second_episodes), n)
            ]
            law = {k: chosen.count(k) / len(chosen) for k in set(chosen)}
        laws.append(law)
    total = {}
    for combination in itertools.product(*laws):
        weight = math.prod(law[k] for law, k in zip(laws, combination, strict=True))
        total[sum(combination)] = total.get(sum(combination), 0.0) + weight
    observed = sum(c.only_first if isinstance(c, PairedCounts) else c.first for c in strata)
    return sum(weight for weight in total.values() if weight <= total[observed] * (1 + 1e-9))


def test_stratified_test_is_the_enumeration():
    """Over tasks p is what listing all outcomes gives: paired, unpaired and mixed strata."""
    rng = random.Random(4)
    for _ in range(40):
        strata = []
        for _ in range(rng.randint(1, 3)):
            if rng.random() < 0.5:
                strata.append(PairedCounts(rng.randint(0, 5), rng.randint(0, 4), rng.randint(0, 4), 1))
            else:
                n, m = rng.randint(1, 5), rng.randint(1, 5)
                strata.append(UnpairedCounts(rng.randint(0, n), n, rng.randint(0, m), m))
        assert stratified_test(strata) == pytest.approx(enumerated(strata), rel=1e-9)
    assert stratified_test([]) == 1.0


def test_stratified_test_of_one_kind():
    """One unpaired stratum is Fisher's test; paired ones are McNemar's test of all their episodes."""
    for table in ([[8, 2], [1, 5]], [[30, 30], [22, 38]], [[0, 9], [3, 4]]):
        (a, b), (c, d) = table
        p = stratified_test([UnpairedCounts(a, a + b, c, c + d)])
        assert p == pytest.approx(fisher_exact(table).pvalue, rel=1e-9)
    strata = [PairedCounts(3, 9, 2, 1), PairedCounts(0, 4, 4, 0), PairedCounts(9, 1, 0, 7)]
    assert stratified_test(strata) == pytest.approx(mcnemar(14, 6))


def test_letters_say_exactly_what_differs():
    """For every set of differing pairs of up to five, two share a letter exactly if they do not differ."""
    for number in (2, 3, 4, 5):
        pairs = list(itertools.combinations(range(number), 2))
        for chosen in itertools.product((False, True), repeat=len(pairs)):
            differing = [pair for pair, taken in zip(pairs, chosen, strict=True) if taken]
            signs = letters(number, differing)
            for pair in pairs:
                assert bool(set(signs[pair[0]]) & set(signs[pair[1]])) == (pair not in differing), (differing, signs)
            assert signs[0].startswith("a")
    # The example of Piepho (2004), section 2, has the form: first two against the last two, the middle with both.
    assert letters(3, [(0, 2)]) == ["a", "ab", "b"]


def difference(strata):
    """The contrast of two rates from counts, averaged over strata."""
    made = []
    for counts in strata:
        if isinstance(counts, PairedCounts):
            ends = [(1, 1)] * counts.both + [(1, 0)] * counts.only_first + [(0, 1)] * counts.only_second
            ends += [(0, 0)] * counts.neither
            pair = [{n: bool(end[k]) for n, end in enumerate(ends)} for k in (0, 1)]
        else:
            pair = [{n: n < counts.first for n in range(counts.first_episodes)}]
            pair += [{-1 - n: n < counts.second for n in range(counts.second_episodes)}]
        made.append([(1 / len(strata), pair[0]), (-1 / len(strata), pair[1])])
    return contrast(made)


def test_one_interval_of_a_difference(tmp_path):
    """`tables` and `compare` give a difference of the same episodes the same interval, to the last bit."""
    cell = {"policy": "p", "family": "act", "trained_on": ("twist2",), "trained_tasks": ("boxing",), "task": "boxing"}
    cell |= {"mode": "base", "labels": "v4", "latency": 0, "replan": None, "ensemble": False, "folder": tmp_path}
    cells = [
        EvaluatedCell(**cell, tracker=tracker, records=tuple(map(record, episodes("boxing", won))))
        for tracker, won in (("twist2", (15, 14, 20)), ("sonic", (12, 17, 3)))
    ]
    (table,) = [table for table in suite_tables(cells, paper_numbers()) if table.name == "cross_gmt"]
    (entry,) = [entry for entry in table.entries if entry.source == "ours"]
    (pair,) = compare([Contender(cell.tracker, {("boxing",): cell.held()}) for cell in cells]).pairs
    found = pair.difference
    assert (entry.drop, entry.drop_low, entry.drop_high) == (found.value, found.low, found.high)


def test_no_bit_of_an_interval_depends_on_the_order_of_tasks(tmp_path):
    """Strata in any order give the same bits, and so do averages of tasks that a folder holds in another order."""
    rng, names = random.Random(5), suites()["ALL_AVG"]
    for _ in range(40):
        strata = []
        for size in rng.choices(range(7, 61), k=len(names)):
            pair = [{n: rng.random() < 0.6 for n in range(size)} for _ in range(2)]
            strata.append([(1 / len(names), pair[0]), (-1 / len(names), pair[1])])
        assert len({contrast(rng.sample(strata, len(names))) for _ in range(5)}) == 1
    terms = [
        RateTerm(str(task), sign / 7, {n: rng.random() < 0.7 for n in range(20)}, (sign, task), (sign, task, number))
        for task, sign in itertools.product(range(7), (0.2, -1.0))
        for number in range(5 if sign > 0 else 1)
    ]
    assert len({trained_contrast(rng.sample(terms, len(terms))) for _ in range(20)}) == 1
    cell = {"policy": "p", "family": "act", "trained_on": ("twist2",), "tracker": "twist2"}
    cell |= {"labels": "v4", "latency": 0, "replan": None, "ensemble": False, "folder": tmp_path}
    cells = [
        EvaluatedCell(
            **cell, task=task, trained_tasks=(task,), mode=mode, records=tuple(map(record, episodes(task, won)))
        )
        for mode in ("base", "visual")
        for task, won in ((task, [rng.randrange(21) for _ in range(3)]) for task in names)
    ]
    drops = []
    for order in (cells, cells[::-1], rng.sample(cells, len(cells))):
        (table,) = [table for table in suite_tables(order, paper_numbers()) if table.name == "perturbation"]
        whole = [entry for entry in table.entries if (entry.source, entry.mode) == ("ours", "visual")]
        for entry in whole:
            told = [
                Contender(
                    mode, {(c.task,): c.held() for c in order if c.mode == mode and c.task in suites()[entry.task]}
                )
                for mode in ("base", "visual")
            ]
            (pair,) = compare(told).pairs
            found = pair.difference
            assert (entry.drop, entry.drop_low, entry.drop_high) == (found.value, found.low, found.high)
        drops.append({(entry.task, entry.drop, entry.drop_low, entry.drop_high) for entry in whole})
    assert drops[0] == drops[1] == drops[2] and len(drops[0]) == 2


def test_differences_tighten_with_episodes():
    """The interval of unpaired episodes shrinks as they grow, and nothing compared gives none."""
    few, many = (difference([UnpairedCounts(6 * k, 10 * k, 3 * k, 10 * k)]) for k in (1, 50))
    assert few.value == many.value == pytest.approx(0.3)
    assert few.low < 0 < many.low and many.high - many.low < 0.2 * (few.high - few.low)
    assert contrast([]) is None


def test_conditions_that_share_episodes_through_a_third_are_paired():
    """Conditions of a stratum that share episodes are one group, others are independent of it."""
    a, b, c = (
        {n: n % 2 == 0 for n in range(20)},
        {n: n % 2 == 0 for n in range(20)},
        {-1 - n: n < 5 for n in range(9)},
    )
    found = contrast([[(1.0, a), (-1.0, b), (1.0, c)]])
    alone, pair = contrast([[(1.0, c)]]), contrast([[(1.0, a), (-1.0, b)]])
    assert found.value == pytest.approx(5 / 9) and (found.episodes, found.unpaired) == (29, 0)
    assert found.error**2 == pytest.approx(alone.error**2 + pair.error**2)


def test_published_intervals_of_one_task():
    """The interval of one task is that of Agresti and Min where paired, of Agresti and Caffo where not."""
    # Agresti and Caffo: p1' = 7/12, p2' = 4/12.
    half = 1.959963984540054 * math.sqrt((7 / 12 * 5 / 12 + 4 / 12 * 8 / 12) / 12)
    found = difference([UnpairedCounts(6, 10, 3, 10)])
    assert (found.low, found.high) == pytest.approx((3 / 12 - half, 3 / 12 + half))
    # Agresti and Min: half an episode more of each kind.
    n, b, c = 22, 8.5, 2.5
    half = 1.959963984540054 * math.sqrt((b + c) - (b - c) ** 2 / n) / n
    found = difference([PairedCounts(4, 8, 2, 6)])
    assert found.value == pytest.approx(6 / 20)
    assert (found.low, found.high) == pytest.approx(((b - c) / n - half, (b - c) / n + half))


def coverage(n, first, second, interval):
    """Probability that the interval of n paired episodes holds the true difference, by enumeration."""
    held = 0.0
    for a, b in itertools.product(range(n + 1), repeat=2):
        if a + b <= n:
            ways = math.comb(n, a) * math.comb(n - a, b) * first**a * second**b
            found = interval([PairedCounts(0, a, b, n - a - b)])
            held += ways * (1 - first - second) ** (n - a - b) * (found.low <= first - second <= found.high)
    return held


def test_few_episodes_of_a_task_are_covered():
    """The interval of ten episodes of a task holds the difference in about 95 of 100 experiments, wherever it is."""
    for first, second in ((0.3, 0.1), (0.5, 0.3), (0.6, 0.1), (0.3, 0.6), (0.15, 0.15)):
        assert coverage(10, first, second, difference) > 0.93


def test_many_small_tasks_are_covered():
    """The middle of the interval is not drawn to 0 where many tasks have few episodes each."""
    rng, held = random.Random(6), 0
    for _ in range(300):
        strata = []
        for _ in range(28):
            both = [(rng.random() < 0.8, rng.random() < 0.2) for _ in range(3)]
            strata.append(
                PairedCounts(
                    *[both.count(ends) for ends in ((True, True), (True, False), (False, True), (False, False))]
                )
            )
        found = difference(strata)
        held += found.low <= 0.6 <= found.high
    assert held > 0.92 * 300


def test_the_difference_lies_in_its_interval_and_is_exact():
    """Whatever the counts are, the interval holds the difference; differences that cancel are 0, not nearly 0."""
    rng = random.Random(9)
    for _ in range(300):
        strata = []
        for _ in range(rng.randint(1, 5)):
            n, m = rng.choice((1, 2, 3, 20)), rng.choice((1, 2, 5, 20))
            if rng.random() < 0.5:
                ends = [rng.randrange(4) for _ in range(n)] if rng.random() < 0.5 else [1] * n
                strata.append(PairedCounts(*(ends.count(k) for k in range(4))))
            else:
                strata.append(UnpairedCounts(rng.choice((0, n)), n, rng.choice((0, m)), m))
        found = difference(strata)
        assert -1 <= found.low <= found.value <= found.high <= 1
    lot = [PairedCounts(0, a, b, 60 - a - b) for a, b in ((2, 0), (3, 0), (0, 5))]
    assert difference(lot).value == 0.0


def test_a_stratum_without_episodes_says_nothing():
    """Nothing out of nothing is no difference and has no direction, and changes nothing beside other strata."""
    nothing, some = UnpairedCounts(0, 0, 0, 0), UnpairedCounts(9, 10, 3, 10)
    assert stratified_test([nothing]) == 1.0 and excess([nothing]) == excess([]) == 0.0
    assert stratified_test([nothing, some]) == stratified_test([some])
    assert excess([nothing, some]) == excess([some]) == 3.0
    assert difference([nothing]) is None and rate_test(nothing).p == 1.0


def test_many_episodes_take_no_time():
    """Thousands of episodes a task are tested in a blink, precisely to the last digit that is shown."""
    began = time.perf_counter()
    assert mcnemar(50_100, 49_900) == pytest.approx(binomtest(49_900, 100_000).pvalue, rel=1e-8)
    n = 1500
    p = stratified_test([UnpairedCounts(n // 2, n, n // 2 - 10, n)] * 7 + [PairedCounts(0, 900, 880, 9)])
    assert time.perf_counter() - began < 120.0  # with whole numbers of thousands of digits it took hours
    exact = normal_tail(excess([UnpairedCounts(n // 2, n, n // 2 - 10, n)] * 7 + [PairedCounts(0, 900, 880, 9)]), n)
    assert p == pytest.approx(exact, rel=0.01)


def normal_tail(more, n):
    """The normal limit, with continuity, of that test of 7 tasks of n and 1,780 coins."""
    won = n - 10
    variance = 7 * won * (2 * n - won) * n * n / ((2 * n) ** 2 * (2 * n - 1)) + 1780 / 4
    return math.erfc((more - 0.5) / math.sqrt(2 * variance))


def test_small_probabilities_are_precise():
    """A probability far out is as precise as one near 1."""
    strata = [UnpairedCounts(60, 60, 2, 60)] * 4
    one = {k: math.comb(60, k) * math.comb(60, 62 - k) for k in range(2, 61)}
    total = {0: 1}
    for _ in strata:
        new = {}
        for a, b in itertools.product(total, one):
            new[a + b] = new.get(a + b, 0) + total[a] * one[b]
        total = new
    assert stratified_test(strata) == pytest.approx(
        sum(w for w in total.values() if w <= total[240]) / sum(total.values()), rel=1e-9
    )
    assert stratified_test(strata) < 1e-100


def test_posterior_is_a_density():
    """The violin's density integrates to 1 and has its mean at (s + 1)/(n + 2)."""
    for successes, played in ((0, 5), (3, 20), (20, 20), (41, 60)):
        grid = [(k + 0.5) / 20_000 for k in range(20_000)]
        values = [beta_density(successes, played, rate) for rate in grid]
        assert sum(values) / 20_000 == pytest.approx(1.0, abs=1e-4)
        mean = sum(v * r for v, r in zip(values, grid, strict=True)) / 20_000
        assert mean == pytest.approx((successes + 1) / (played + 2), abs=1e-4)
    assert beta_density(0, 5, 0.0) == 6.0 and beta_density(5, 5, 1.0) == 6.0 and beta_density(2, 5, 1.0) == 0.0


def test_the_power_is_the_enumeration():
    """McNemar's power is the sum over all outcomes of the pairs; the difference found is the smallest that has it."""
    n, first, second = 14, 0.4, 0.1
    total = 0.0
    for a in range(n + 1):
        for b in range(n + 1 - a):
            ways = math.comb(n, a) * math.comb(n - a, b)
            total += ways * first**a * second**b * (1 - first - second) ** (n - a - b) * (mcnemar(a, b) <= 0.05)
    assert paired_power(n, first, second) == pytest.approx(total, rel=1e-9)
    gain = detectable_difference(60)
    assert paired_power(60, (0.5 + gain) / 2, (0.5 - gain) / 2) >= POWER
    assert paired_power(60, (0.5 + gain - STEP) / 2, (0.5 - gain + STEP) / 2) < POWER
    assert detectable_difference(5, nested=True) is None  # five coins alone never reach 5 %
    assert detectable_difference(60, nested=True) < gain
    text = detectable_text([60] * 7)
    assert f"60 episodes per cell: 13 to {100 * gain:g} points" in text and "all 420" in text
    assert "3 episodes per cell: none" in detectable_text([3]) and detectable_text([]) == ""


def test_every_plan_that_is_said_to_be_computed_is():
    """Up to the largest plan whose difference is computed there is one, and the largest tells smaller ones apart."""
    few, many = (detectable_difference(n) for n in (420, MOST_PAIRS))
    assert many < few == 0.1
    # In the normal limit: 0.84 + 1.96 standard deviations of half the discordant pairs.
    assert many == pytest.approx(2.8 * math.sqrt(0.5 / MOST_PAIRS), abs=STEP)
    assert f"all {MOST_PAIRS:,}" in detectable_text([MOST_PAIRS // 2] * 2)
    assert detectable_text([MOST_PAIRS + 1]) == ""


def test_comparisons_keep_their_level_and_find_what_is_there(monkeypatch):
    """On synthetic comparisons of each case no test errs more than its level allows, and power is as computed."""
    monkeypatch.setattr(error_rates, "DIFFERENCES", (0.0, 0.2))
    found = error_rates.tallies(40, episodes=16)
    assert [tally for tally in found if not tally.holds] == []
    by_name = {(tally.case, tally.what): tally for tally in found}
    none, much = (
        by_name[f"3 policies, same episodes, the last +{points} points", "Cochran-Mantel-Haenszel, all tasks"]
        for points in (0, 20)
    )
    assert none.kind == "error" and much.kind == "power" and much.rate > 0.4 > none.rate


def test_the_summary_names_the_spreads_that_its_intervals_are_held_to(monkeypatch):
    """The line of `statistics` says up to which spread an interval must cover, where that is declared and measured."""
    monkeypatch.setattr(error_rates, "COMPARISONS", 1)
    found = error_rates._statistics(SimpleNamespace(options=SimpleNamespace(quick=False)))
    held = [row for row in found.sheets[0].rows if row[2] == "coverage" and "trainings differ" in row[0]]
    spreads = {
        word: max(int(row[0].split()[-2]) for row in held if word in row[1]) for word in ("3 trainings", "declared")
    }
    assert f"differ by up to {spreads['3 trainings']} points where that is measured" in found.summary
    assert f"{spreads['declared']} where it is declared" in found.summary
    assert spreads["declared"] < spreads["3 trainings"]


def test_a_test_that_errs_is_found_out(monkeypatch):
    """A test that quarters its p breaks its level in the same simulation."""
    monkeypatch.setattr(
        "arena_newton.eval.statistics.comparison.stratified_test", lambda strata: stratified_test(strata) / 4
    )
    monkeypatch.setattr(error_rates, "SPREADS", ())
    monkeypatch.setattr(error_rates, "DIFFERENCES", (0.0,))
    assert any(not tally.holds for tally in error_rates.tallies(60, episodes=20))


def test_an_interval_of_episodes_alone_is_found_out(monkeypatch):
    """An interval that leaves out how much trainings differ does not cover them in the same simulation."""
    monkeypatch.setattr("arena_newton.eval.statistics.trainings.MATCHED_SPREAD", 0.0)
    monkeypatch.setattr("arena_newton.eval.statistics.trainings.ENOUGH", 99)
    monkeypatch.setattr(error_rates, "DIFFERENCES", ())
    monkeypatch.setattr(error_rates, "SPREADS", (0.2,))
    held = {tally.what: tally.holds for tally in error_rates.tallies(60)}
    assert len(held) == 4 and not held["interval over 3 trainings, one task, covers"]


def test_family_is_adjusted_over_all_pairs():
    """Adjusted p follow Holm: over pairs for all tasks together, over pairs and tasks within tasks."""
    rng = random.Random(2)
    contenders = [
        Contender(f"p{k}", {(t,): {n: rng.random() < 0.3 + 0.2 * k for n in range(40)} for t in ("a", "b")})
        for k in range(3)
    ]
    result = compare(contenders)
    ranked = sorted(pair.p for pair in result.pairs)
    highest = 0.0
    for rank, p in enumerate(ranked):
        highest = max(highest, min(1.0, (3 - rank) * p))
        assert any(pair.p == p and pair.p_holm == pytest.approx(highest) for pair in result.pairs)
    parts = [part for pair in result.pairs for part in pair.strata]
    smallest = min(parts, key=lambda part: part.p)
    assert len(parts) == 6 and smallest.p_holm == pytest.approx(min(1.0, 6 * smallest.p))
