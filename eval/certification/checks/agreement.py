"""Do results depend on what they must not depend on: the engine, the number of worlds, whose weights a tracker has?"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy.stats import beta

from arena_newton.eval.certification.checks.closed_forms import Bench
from arena_newton.eval.certification.checks.replays import recorded
from arena_newton.eval.certification.checks.traces import first_difference, play, world_of
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import (
    Check,
    CheckFinding,
    Verdict,
    discordant,
    pooled_score,
    score,
    skipped,
)
from arena_newton.eval.statistics.stats import mcnemar
from arena_newton.eval.workers.batch_player import device_name
from arena_newton.files.stored_json import JsonObject
from arena_newton.pages.tables import Table, percent
from arena_newton.physics.devices import resolve_engine

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv

__all__ = ["CHECKS", "bound_of_difference", "first_ticks"]

SAME_TICKS = 5
"""Ticks in which both engines must be in the same state: all that is free falls, the drives move every joint, and no
contact makes more of a last bit."""
MOVED = 0.05
"""Distance of the drives' targets from the joints [rad]."""
SAME_STATE = 1e-5
"""Largest difference of a position [m, rad] in them; 4e-7 where both step the same model, and 7e-5 at the first tick
where 3 % of gravity is missing."""
SAME_FIELDS = (
    "body_mass body_inertia body_ipos body_iquat body_pos body_quat body_gravcomp dof_armature dof_damping "
    "dof_frictionloss jnt_range jnt_stiffness geom_friction actuator_gainprm actuator_biasprm actuator_forcerange"
).split()
"""Arrays of the compiled models that must be equal but for float32's last bit."""
MARGIN = 0.05
"""Largest difference of the rates of success or falls of both engines at which they count as equivalent: all 95 % of
its interval must be within."""
DIFFERENT = 0.01
"""Two rates differ from this p-value on, divided by the number of tests of the check (Bonferroni)."""
BATCHED = 3
"""Episodes that are played alone, together, and in the reverse order."""
BATCHED_TICKS = (100, 400)
"""Their longest length under --quick and otherwise [ticks]."""
BATCHED_TASKS = 2
"""Tasks whose episodes are compared under --quick."""


def engines(context: Context) -> CheckFinding:
    """Compare models and first ticks of both engines, and where it is affordable the rates of the experts."""
    other = "warp" if context.options.engine == "mujoco" else "mujoco"
    _, device = resolve_engine(other, None if other == "warp" else "cpu")
    ticks, sheet, wrong = _same_start(context, other, device)
    part = context.options.quick and not context.options.jobs  # whose flags name all checks that it plays
    if other == "warp" and device == "cpu" and (part or "engines" not in context.options.checks):
        summary = f"in {ticks}; rates were not compared: no CUDA device here"
        note = "--checks engines compares rates on Warp's CPU backend, which takes far longer."
        return CheckFinding("fail" if wrong else "note", summary, (sheet,), (*wrong, note))
    verdict, rates, rate_sheet, notes = _rates(context, other, device)
    return CheckFinding("fail" if wrong else verdict, f"in {ticks}; {rates}", (sheet, rate_sheet), (*wrong, *notes))


def _same_start(context: Context, other: str, device: str) -> tuple[str, Table, list[str]]:
    """Findings of the first ticks: in words, as a table and as faults."""
    rows, wrong, most = [], [], 0.0
    tracker = context.trackers[0]
    for task in context.tasks:
        measure = functools.partial(first_ticks, context, task, tracker, other, device)
        found = context.measured("engines", task, tracker, {"other": other, "device": device}, measure)
        unlike, gaps = [str(name) for name in found["unlike"]], [float(gap) for gap in found["gaps"]]
        most = max(most, *gaps)
        rows.append((task, " ".join(unlike) or "none", *(f"{gap:.1e}" for gap in gaps)))
        wrong += [f"{task}: the compiled models differ in {' '.join(unlike)}"] * bool(unlike)
        late = [tick for tick, gap in enumerate(gaps, 1) if not gap <= SAME_STATE]
        wrong += [f"{task}: positions differ by {gaps[tick - 1]:.1e} at tick {tick}" for tick in late[:1]]
    head = ("task", "arrays that differ", *(f"tick {tick + 1}" for tick in range(SAME_TICKS)))
    title = f"Models of both engines, and the largest difference of a position [m, rad]; {SAME_STATE:.0e} is allowed"
    sheet = Table(head, rows, title=title)
    return f"the first {SAME_TICKS} ticks positions differ by at most {most:.1e}", sheet, wrong


def first_ticks(context: Context, task: str, tracker: str, other: str, device: str) -> JsonObject:
    """Arrays in which the compiled models of two engines differ, and differences of positions in the first ticks."""
    states, models = [], []
    for options in ({}, {"engine": other, "device": device}):
        env = cast("ArenaEnv", world_of(context, task, tracker, worlds=1, **options))
        bench = Bench(env)
        bench.start(bench.pose())
        env.physics.ctrl.assign(env.physics.ctrl.numpy() + MOVED)
        models.append({name: _field(env, name) for name in SAME_FIELDS})
        states.append([])
        for _ in range(SAME_TICKS):
            env.physics.step()
            states[-1].append(bench.rows("qpos")[0])
        env.close()
    unlike = [name for name in SAME_FIELDS if not _same(models[0][name], models[1][name])]
    gaps = [float(np.abs(a - b).max()) for a, b in zip(*states, strict=True)]
    return {"unlike": list(unlike), "gaps": [gap if np.isfinite(gap) else 1e9 for gap in gaps]}


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Equality of two arrays but for the last bit that float32 keeps."""
    return one.shape == other.shape and np.allclose(one, other, rtol=1e-6, atol=1e-7)


def _field(env: ArenaEnv, name: str) -> np.ndarray:
    """One array of the model that an engine steps, as float32."""
    model = env.physics.mj_model if env.engine == "mujoco" else env.scene.solver.mjw_model
    value = getattr(model, name)
    rows = value if isinstance(value, np.ndarray) else value.numpy()
    return np.asarray(rows, dtype=np.float32).reshape(-1)


def bound_of_difference(only_first: int, only_second: int, pairs: int) -> tuple[float, float]:
    """95 % interval of a difference of two paired rates that covers at least that often: exact bounds of its parts.

    A difference is the rate of pairs in which the first alone has the outcome less that of the second alone; each is
    bounded from above by 97.5 % (Clopper and Pearson 1934), and from below by 0.
    """

    def upper(count: int) -> float:
        return 1.0 if count >= pairs else float(beta.ppf(0.975, count + 1, pairs - count))

    return -upper(only_second), upper(only_first)


def _rates(context: Context, other: str, device: str) -> tuple[Verdict, str, Table, tuple[str, ...]]:
    """Success and falls of the experts on both engines, episode by episode."""
    rows, tests, total = [], [], {"success": [0, 0], "fall": [0, 0]}
    pairs = 0
    for tracker in context.trackers:
        for task in context.tasks:
            first = context.evaluate(recorded(context, task, tracker))
            second = context.evaluate(CertifyCell(task, tracker, engine=other))
            a, b = score(first), score(second)
            falls = [sum(record.outcome == "fall" for record in found) for found in (first, second)]
            only = {outcome: discordant(first, second, outcome) for outcome in total}
            p, q = (mcnemar(*only[outcome]) for outcome in ("success", "fall"))
            for outcome, counts in only.items():
                total[outcome] = [sum(two) for two in zip(total[outcome], counts, strict=True)]
            pairs += a.episodes
            tests.append((task, tracker, p, q))
            rows.append((task, tracker, *a.cells(), *b.cells(), f"{p:.3f}", f"{falls[0]} and {falls[1]}", f"{q:.3f}"))
    level = DIFFERENT / max(2 * len(tests), 1)
    apart = [f"{task} through {tracker}" for task, tracker, p, q in tests if min(p, q) < level]
    bounds = {outcome: bound_of_difference(counts[0], counts[1], pairs) for outcome, counts in total.items()}
    within = all(-MARGIN <= low and high <= MARGIN for low, high in bounds.values())
    far = any(mcnemar(*counts) < DIFFERENT and abs(counts[0] - counts[1]) > MARGIN * pairs for counts in total.values())
    this, where = context.options.engine, device_name(device)
    head = (
        "task",
        "tracker",
        this,
        "95 % interval",
        f"{other} on {where}",
        "95 % interval",
        "p",
        "falls",
        "p of falls",
    )
    gaps = [
        f"{what} by {percent(low)} % to {percent(high)} %"
        for what, (low, high) in zip(("success", "falls"), bounds.values(), strict=True)
    ]
    notes = [
        f"Engines are equivalent where the 95 % interval of the difference of their rates, all {pairs} pairs of the "
        f"same episodes together, is within {percent(MARGIN, 0)} % on either side: {'; '.join(gaps)}. It has the upper "
        "97.5 % bounds (Clopper and Pearson) of the pairs that only one engine wins, less 0 of the other's: wider than "
        "the interval of `eval compare`, and sure to cover in 95 %. "
        f"They differ in a cell where p, that of McNemar's exact test, is below {level:.2g}: {DIFFERENT} over "
        f"{2 * len(tests)} tests; all cells together where it is below {DIFFERENT} and the rates are more than "
        f"{percent(MARGIN, 0)} % apart."
    ]
    notes += [f"{which}: the engines differ" for which in apart]
    verdict: Verdict = "fail" if apart or far else "pass" if within else "note"
    if verdict == "note":
        notes.append(f"{pairs} pairs are too few to show that the rates are within {percent(MARGIN, 0)} %.")
    summary = f"{this} and {other} on {where}: rates differ in {', '.join(gaps)} (95 %)"
    return verdict, summary, Table(head, rows, title="Rates of both engines"), tuple(notes)


def batches(context: Context) -> CheckFinding:
    """Play the same episodes in batches of different size and order and compare every bit."""
    if context.options.engine != "mujoco":
        return skipped("bits are promised on engine mujoco alone")
    quick = context.options.quick
    ticks, rows, broken = BATCHED_TICKS[not quick], [], []
    for tracker in context.trackers:
        for task in context.tasks[:BATCHED_TASKS] if quick else context.tasks:
            measure = functools.partial(_compare_batches, context, task, tracker, ticks)
            found = context.measured("batches", task, tracker, {"ticks": ticks}, measure)
            differs = found["differs"]
            rows.append((task, tracker, f"{int(found['ticks']):,}", "none" if differs is None else str(differs)))
            broken += [f"{task} through {tracker}: differs from tick {differs} on"] * (differs is not None)
    head = ("task", "tracker", "ticks compared", "first tick that differs")
    sheet = Table(head, rows, title=f"{BATCHED} episodes in one world, in {BATCHED} worlds, and in the reverse order")
    summary = f"{len(rows) - len(broken)} of {len(rows)} groups of episodes have the same bits in every batch and order"
    return CheckFinding("fail" if broken else "pass", summary, (sheet,), tuple(broken))


def _compare_batches(context: Context, task: str, tracker: str, ticks: int) -> JsonObject:
    """Ticks compared, and the first at which an episode depends on its batch."""
    seeds = context.seeds(task, BATCHED)
    traces = []
    for worlds, order in ((1, seeds), (BATCHED, seeds), (BATCHED, seeds[::-1])):
        env = world_of(context, task, tracker, worlds=worlds)
        traces.append(play(env, order, ticks))
        env.close()
    gaps = [first_difference(traces[0][seed], other[seed]) for other in traces[1:] for seed in traces[0]]
    return {
        "ticks": sum(map(len, traces[0].values())),
        "differs": min((gap for gap in gaps if gap is not None), default=None),
    }


def official(context: Context) -> CheckFinding:
    """Play the experts through the official TWIST2 weights and compare with those that come with the package."""
    given = context.options.twist2_checkpoint
    if given is None:
        return skipped("name the official checkpoint: --twist2-checkpoint twist2_1017_20k.onnx")
    rows, ours, theirs, gained, lost = [], [], [], 0, 0
    for task in context.tasks:
        own = context.evaluate(recorded(context, task, "twist2"))
        official = context.evaluate(CertifyCell(task, "twist2", checkpoint=given))
        ours.append(score(own))
        theirs.append(score(official))
        only_ours, only_official = discordant(own, official)
        gained, lost = gained + only_ours, lost + only_official
        rows.append((task, *ours[-1].cells(), *theirs[-1].cells(), f"{mcnemar(only_ours, only_official):.2g}"))
    a, b, p = pooled_score(ours), pooled_score(theirs), mcnemar(gained, lost)
    rows.append(("all", *a.cells(), *b.cells(), f"{p:.2g}"))
    head = ("task", "our weights", "95 % interval", "official weights", "95 % interval", "p")
    sheet = Table(head, rows, title="Experts through our TWIST2 weights and through the official ones")
    summary = f"experts succeed in {a.successes} of {a.episodes} episodes with our weights, "
    summary += f"in {b.successes} with the official ones (p = {p:.2g})"
    worse = p < DIFFERENT and a.rate < b.rate
    better = p < DIFFERENT and a.rate > b.rate
    notes = ["Both play the same episodes; p is that of McNemar's exact test."]
    if better:
        notes.append(
            "The experts' references are tuned on our weights, so that this says nothing of which weights are better "
            "for others."
        )
    return CheckFinding("fail" if worse else "note" if better else "pass", summary, (sheet,), tuple(notes))


CHECKS = (
    Check("engines", "Do both physics engines move alike, and give the same rates within the margin?", engines),
    Check("batches", "Do results depend on how many worlds run at once, or in which order?", batches),
    Check("official", "Do our TWIST2 weights execute the experts as well as the official ones?", official),
)
"""This module's checks."""
