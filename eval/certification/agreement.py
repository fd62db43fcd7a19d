"""Do results depend on what they must not depend on: the engine, the number of worlds, whose weights a tracker has?"""

from __future__ import annotations

from arena_newton.devices import resolve_engine
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Sheet, discordant, pooled_score, score, skipped
from arena_newton.eval.certification.replays import recorded
from arena_newton.eval.certification.traces import first_difference, play, world_of
from arena_newton.eval.records import JsonObject
from arena_newton.eval.slice_player import device_name
from arena_newton.eval.stats import mcnemar

__all__ = ["CHECKS"]

DIFFERENT = 0.01
"""Two rates differ from this p-value on, divided by the number of tests of the check (Bonferroni)."""
BATCHED = 3
"""Episodes that are played alone, together, and in the reverse order."""
BATCHED_TICKS = (100, 400)
"""Their longest length under --quick and otherwise [ticks]."""
BATCHED_TASKS = 2
"""Tasks whose episodes are compared under --quick."""


def engines(context: Context) -> CheckFinding:
    """Play the experts on the other engine and compare success and falls, episode by episode, by McNemar's."""
    other = "warp" if context.options.engine == "mujoco" else "mujoco"
    _, device = resolve_engine(other, None if other == "warp" else "cpu")
    if other == "warp" and device == "cpu" and "engines" not in context.options.checks:
        return skipped("no CUDA device here; --checks engines measures Warp's CPU backend, which takes far longer")
    rows, pairs = [], []
    for tracker in context.trackers:
        for task in context.tasks:
            first = context.evaluate(recorded(context, task, tracker))
            second = context.evaluate(CertifyCell(task, tracker, engine=other))
            a, b = score(first), score(second)
            falls = [sum(record.outcome == "fall" for record in found) for found in (first, second)]
            p, q = (mcnemar(*discordant(first, second, outcome)) for outcome in ("success", "fall"))
            pairs.append((task, tracker, p, q))
            rows.append((task, tracker, *a.cells(), *b.cells(), f"{p:.3f}", f"{falls[0]} and {falls[1]}", f"{q:.3f}"))
    level = DIFFERENT / max(2 * len(pairs), 1)
    apart = [f"{task} through {tracker}" for task, tracker, p, q in pairs if min(p, q) < level]
    least = min((min(p, q) for _, _, p, q in pairs), default=1.0)
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
    notes: tuple[str, ...] = (
        f"Engines differ where p, that of McNemar's exact test of the same episodes, is below {level:.2g}: "
        f"{DIFFERENT} over {2 * len(pairs)} tests.",
    )
    notes += tuple(f"{which}: the engines differ" for which in apart)
    summary = f"{this} and {other} on {where}: smallest p of {2 * len(pairs)} tests is {least:.3f}"
    return CheckFinding(
        "fail" if apart else "pass", summary, (Sheet("Rates of both engines", head, tuple(rows)),), notes
    )


def batches(context: Context) -> CheckFinding:
    """Play the same episodes in batches of different size and order and compare every bit."""
    if context.options.engine != "mujoco":
        return skipped("bits are promised on engine mujoco alone")
    quick = context.options.quick
    ticks, rows, broken = BATCHED_TICKS[not quick], [], []
    for tracker in context.trackers:
        for task in context.tasks[:BATCHED_TASKS] if quick else context.tasks:

            def measure(task: str = task, tracker: str = tracker) -> JsonObject:
                return _compare_batches(context, task, tracker, ticks)

            found = context.measured("batches", task, tracker, {"ticks": ticks}, measure)
            assert isinstance(found, dict)
            differs = found["differs"]
            rows.append((task, tracker, f"{int(found['ticks']):,}", "none" if differs is None else str(differs)))
            broken += [f"{task} through {tracker}: differs from tick {differs} on"] * (differs is not None)
    head = ("task", "tracker", "ticks compared", "first tick that differs")
    sheet = Sheet(f"{BATCHED} episodes in one world, in {BATCHED} worlds, and in the reverse order", head, tuple(rows))
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
    sheet = Sheet("Experts through our TWIST2 weights and through the official ones", head, tuple(rows))
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
    Check("engines", "Do both physics engines give the same rates?", engines),
    Check("batches", "Do results depend on how many worlds run at once, or in which order?", batches),
    Check("official", "Do our TWIST2 weights execute the experts as well as the official ones?", official),
)
"""This module's checks."""
