"""Does each axis of generalisation move what it names, and nothing else?"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.eval.certification.checks.replays import recorded
from arena_newton.eval.certification.checks.traces import first_difference, play, world_of
from arena_newton.eval.certification.context import CertifyCell, Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Picture, Score, score, skipped
from arena_newton.files.stored_json import JsonObject
from arena_newton.interfaces import World
from arena_newton.pages.tables import Table
from arena_newton.pictures.settings import CameraConfig
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.rules import modes
from arena_newton.rules.rule_types import CylinderRange, ObjectRule, PoseRange
from arena_newton.tasks.handles import RobotHandles

__all__ = ["CHECKS", "allowed_difference", "fills", "moved_coordinates", "named_coordinates", "shown_range", "stand"]

TRACED = (2, 4)
"""Episodes of each task whose bits are compared, under --quick and otherwise."""
TRACED_TICKS = (100, 500)
"""Their longest length [ticks], start-up not counted."""
DRAWN_SEEDS = 500
"""Episodes whose draws are compared: no physics runs for them."""
FILLED = 0.9
"""Fraction of a range that the draws of `DRAWN_SEEDS` episodes must span: they do with all but 1e-20 probability."""
RESET_WORLDS = 4
"""Episodes whose worlds are compared after the reset."""
STOOD_TICKS = 60
"""Length of the episodes of a standing robot whose dynamics are compared [ticks], start-up not counted."""
PUSHED_AT = 20
"""Tick of their push."""
DERIVED = "body_subtreemass body_invweight0 dof_invweight0 dof_M0 actuator_acc0".split()
"""Fields of a model that follow from masses."""
SCALED = 1e-12
"""Relative error of a scaled field: rounding."""
SEMANTIC_LOSS = (3, 60)
"""Successes, of so many episodes, by which semantic mode may differ."""
_UNSEEN = ("push_heading", "push_time")
"""Quantities that alone change nothing."""
_PICTURED = "picture_noise"
"""Quantity that changes pictures, and no robot that stands."""


def visual(context: Context) -> CheckFinding:
    """Play the same episodes in both modes and compare every bit of the physics, and the first pictures."""
    if context.options.engine != "mujoco":
        return skipped("bits are promised on engine mujoco alone")
    number, ticks = TRACED[not context.options.quick], TRACED_TICKS[not context.options.quick]
    tracker, rows, broken, pictures = context.trackers[0], [], [], []
    for task in context.tasks:
        seeds, picture = context.seeds(task, number), context.folder / "pictures" / f"visual_{task}.png"
        measure = functools.partial(_compare_modes, context, task, tracker, seeds, ticks, picture)
        settings: JsonObject = {"seeds": list(seeds), "ticks": ticks}
        found = context.measured("visual", task, tracker, settings, measure)
        compared, differs, changed = int(found["ticks"]), found["differs"], float(found["changed"])
        rows.append(
            (task, str(len(seeds)), f"{compared:,}", "none" if differs is None else str(differs), f"{changed:.1f}")
        )
        if differs is not None:
            broken.append(f"{task}: physics differs from tick {differs} on")
        if changed == 0.0:
            broken.append(f"{task}: the pictures are the same")
        if picture.is_file():
            pictures.append(Picture(f"{task}: first picture of one episode, base and visual", picture))
    head = ("task", "episodes", "ticks compared", "first tick that differs", "mean change of the first picture [0-255]")
    sheet = Table(head, rows, title="Visual mode against base mode, the same seeds, the expert through " + tracker)
    summary = f"{len(broken)} deviations"
    if not broken:
        all_ticks = sum(int(row[2].replace(",", "")) for row in rows)
        summary = f"every bit of {all_ticks:,} ticks is the same, every first picture differs"
    return CheckFinding("fail" if broken else "pass", summary, (sheet,), tuple(broken), tuple(pictures))


def _compare_modes(
    context: Context, task: str, tracker: str, seeds: list[int], ticks: int, picture: Path
) -> JsonObject:
    """Ticks compared, the first that differs, and the mean change of the first picture."""
    traces, first = [], []
    for mode in ("base", "visual"):
        env = world_of(context, task, tracker, worlds=len(seeds), mode=mode, camera=CameraConfig())
        env.reset(seeds)
        image = env.observe(image=True).image
        assert image is not None
        first.append(image.cpu().numpy().copy())
        env.release(range(len(seeds)))
        traces.append(play(env, seeds, ticks))
        env.close()
    gaps = [first_difference(traces[0][seed], traces[1][seed]) for seed in traces[0]]
    changed = np.abs(first[0].astype(float) - first[1]).mean()
    picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([first[0][0], first[1][0]], axis=1)).save(picture)
    return {
        "ticks": sum(map(len, traces[0].values())),
        "differs": min((gap for gap in gaps if gap is not None), default=None),
        "changed": round(float(changed), 3),
    }


def allowed_difference(episodes: int) -> int:
    """Most successes by which semantic mode may differ from base mode."""
    most, of = SEMANTIC_LOSS
    return math.ceil(most * episodes / of)


def semantic(context: Context) -> CheckFinding:
    """Play the semantic variants with the experts."""
    rows, outside, worst = [], [], 0
    allowed = allowed_difference(context.episodes)
    for tracker in context.sample:
        for task in context.tasks:
            base: Score = score(context.evaluate(recorded(context, task, tracker)))
            other = score(context.evaluate(CertifyCell(task, tracker, mode="semantic")))
            gap = other.successes - base.successes
            worst = max(worst, abs(gap))
            rows.append((task, tracker, base.cells()[0], *other.cells(), f"{gap:+d}"))
            if abs(gap) > allowed:
                outside.append(
                    f"{task} through {tracker}: {gap:+d} of {context.episodes} episodes, allowed are {allowed}"
                )
    head = ("task", "tracker", "base", "semantic", "95 % interval", "difference")
    summary = f"semantic variants change the experts' successes by at most {worst} of {context.episodes} episodes"
    sheet = Table(head, rows, title=f"Semantic against base mode; {allowed} of {context.episodes} are allowed")
    outside += [f"{row[0]} through {row[1]}: solved in neither mode" for row in rows if row[2].startswith("0/")]
    note = (
        "An expert does not look: equal numbers say that variants change looks alone, not that policies cope with them."
    )
    return CheckFinding("fail" if outside else "pass", summary, (sheet,), (*outside, note))


def named_coordinates(rule: ObjectRule, mode: modes.Mode = modes.BUILT_IN["execution"]) -> set[str]:
    """Sampled numbers of an object whose range a mode changes, as its record and the rules name them."""
    base, other = rule.base, mode.range_of(rule)
    if isinstance(base, PoseRange) and isinstance(other, PoseRange):
        return {axis for axis in ("x", "y", "z", "yaw") if getattr(base, axis) != getattr(other, axis)}
    assert isinstance(base, CylinderRange) and isinstance(other, CylinderRange)
    named = {"z"} if base.z != other.z else set()
    around = (base.centers, base.radius, base.azimuth) != (other.centers, other.radius, other.azimuth)
    return named | ({"bag", "azimuth", "x", "y"} if around else set())


def moved_coordinates(task: str, mode: str, rules: str, seeds: Iterable[int]) -> dict[tuple[str, str], list[float]]:
    """Sampled numbers that differ from base mode in one of these episodes.

    Returns:
        (object's record name, coordinate) → its values in the mode, in all the episodes.
    """
    spec, rule_set = tasks.get(task), rule_sets.get(rules)
    values: dict[tuple[str, str], list[float]] = {}
    moved = set()
    for seed in seeds:
        base, other = spec.draw(seed, "base", rule_set).sampled, spec.draw(seed, mode, rule_set).sampled
        if base.keys() != other.keys() - {modes.DYNAMICS}:
            raise InputError(f"task {task}: mode {mode} draws other objects than base")
        for record, sample in other.items():
            for axis, value in sample.items():
                values.setdefault((record, axis), []).append(value)
                if base.get(record, {}).get(axis) != value:
                    moved.add((record, axis))
    return {key: values[key] for key in values if key in moved}


def execution(context: Context) -> CheckFinding:
    """Compare draws of all modes with the rules' ranges, and worlds after their reset."""
    rows, broken, notes = [], [], []
    for rules in rule_sets.names():
        for task in context.tasks:
            rule_set = rule_sets.get(rules)
            seeds = context.seeds(task, DRAWN_SEEDS)
            where = f"{task} under {rules}"
            for mode in ("semantic", "visual"):
                stray = sorted({record for record, _ in moved_coordinates(task, mode, rules, seeds)})
                broken += [f"{where}: mode {mode} moves {' '.join(stray)}"] * bool(stray)
            broken += [f"{where}: {text}" for text in _light_faults(task, rules, seeds[:20])]
            moved = moved_coordinates(task, "execution", rules, seeds)
            named = {
                (rule.record, axis): rule for rule in rule_set.task(task).objects for axis in named_coordinates(rule)
            }
            void = [
                o.record for o in tasks.get(task).objects if o.execution_void and o.rule(rules).placement == "scaled"
            ]
            notes += [f"{where}: the original scales what {record} is drawn to almost nothing" for record in void]
            broken += [f"{where}: moves {' '.join(key)}, which no rule names" for key in moved.keys() - named.keys()]
            broken += [f"{where}: does not move {' '.join(key)}" for key in named.keys() - moved.keys()]
            for key in sorted(named.keys() & moved.keys()):
                low, high = min(moved[key]), max(moved[key])
                bounds = getattr(named[key].execution, key[1], None)
                was = getattr(named[key].base, key[1], None)
                rows.append((task, rules, *key, shown_range(was), shown_range(bounds), f"{low:.3f} … {high:.3f}"))
                if bounds is not None and not fills(low, high, bounds):
                    broken.append(
                        f"{where}: {' '.join(key)} is drawn from {low:.3f} to {high:.3f}, not {shown_range(bounds)}"
                    )
    placed = [_reset_faults(context, task) for task in context.tasks]
    broken += [fault for faults in placed for fault in faults]
    head = (
        "task",
        "rules",
        "object",
        "coordinate",
        "base range",
        "execution range",
        f"drawn in {DRAWN_SEEDS} episodes",
    )
    sheet = Table(head, rows, title="What execution mode moves; every other number of every episode has the same bits")
    summary = f"execution mode moves {len(rows)} coordinates, the rules name these and no other"
    if broken:
        summary = f"{len(broken)} deviations from what the rules name"
    return CheckFinding("fail" if broken else "pass", summary, (sheet,), (*broken, *notes))


def shown_range(bounds: tuple[float, float] | None) -> str:
    """A range in words; a dash for none."""
    return "-" if bounds is None else f"{bounds[0]:.3f} … {bounds[1]:.3f}"


def fills(low: float, high: float, bounds: tuple[float, float]) -> bool:
    """True if draws lie in a range and span it."""
    least, most = min(bounds), max(bounds)
    return least <= low and high <= most and high - low >= FILLED * (most - least)


def _light_faults(task: str, rules: str, seeds: list[int]) -> list[str]:
    """Faults of the lights: visual mode draws one for each episode, the other modes share one."""
    spec, rule_set = tasks.get(task), rule_sets.get(rules)
    lights = {
        mode: [spec.draw(seed, mode, rule_set).light for seed in seeds] for mode in ("base", "execution", "semantic")
    }
    faults = [f"mode {mode} has another light than base" for mode, found in lights.items() if found != lights["base"]]
    drawn = {spec.draw(seed, "visual", rule_set).light for seed in seeds}
    return faults + [f"visual mode draws {len(drawn)} lights in {len(seeds)} episodes"] * (len(drawn) < len(seeds))


def _reset_faults(context: Context, task: str) -> list[str]:
    """Bodies that stand elsewhere after a reset in execution mode although no rule names their object."""
    rule_set, spec = rule_sets.get("paper"), tasks.get(task)
    named = {rule.record for rule in rule_set.task(task).objects if named_coordinates(rule)}
    free = tuple(f"{o.prim}/" for o in spec.objects if o.record in named)

    def measure() -> list[str]:
        poses = []
        for mode in ("base", "execution"):
            env = world_of(context, task, context.trackers[0], worlds=RESET_WORLDS, mode=mode)
            env.reset(context.seeds(task, RESET_WORLDS))
            poses.append(_poses(env))
            env.close()
        return sorted(path for path in poses[0] if poses[0][path] != poses[1][path])

    moved = context.measured("reset", task, context.trackers[0], {}, lambda: list(measure()))
    assert isinstance(moved, list)
    strays = [str(path) for path in moved if not f"{path}/".startswith(free)]
    return [f"{task}: {path} starts elsewhere, which no rule names" for path in strays]


def _poses(env: World) -> dict[str, bytes]:
    """Poses of all bodies in all worlds, by prim path, as bits."""
    position, quat = env.physics.xpos.numpy(), env.physics.xquat.numpy()
    return {path: position[:, body].tobytes() + quat[:, body].tobytes() for path, body in env.scene.body_ids.items()}


def dynamics(context: Context) -> CheckFinding:
    """Compare draws with the ranges, compiled models with the draws, and a robot that stands with one in base mode."""
    if context.options.engine != "mujoco":
        return skipped("bits are promised on engine mujoco alone")
    rows, broken, name = [], [], modes.DYNAMICS
    ranges, first = modes.get(name).dynamics, context.tasks[0]
    for key, bounds in ranges.items():
        drawn = [modes.get(name).draw(seed)[key] for seed in context.seeds(first, DRAWN_SEEDS)]
        rows.append((key, modes.QUANTITIES[key].unit, shown_range(bounds), f"{min(drawn):.3f} … {max(drawn):.3f}"))
        if not fills(min(drawn), max(drawn), bounds):
            broken.append(f"{key}: drawn from {min(drawn):.3f} to {max(drawn):.3f}, not {shown_range(bounds)}")
    for task in context.tasks:
        spec, rule_set = tasks.get(task), rule_sets.get("paper")
        for seed in context.seeds(task, DRAWN_SEEDS):
            base, other = spec.draw(seed, "base", rule_set), spec.draw(seed, name, rule_set)
            if (base.placed, base.light) != (other.placed, other.light):
                broken.append(f"{task}: episode seed {seed} has other placements or lights than in base mode")
                break
        measure = functools.partial(stand, context, task, context.trackers[0])
        found = context.measured(name, task, context.trackers[0], {}, measure)
        assert isinstance(found, list)
        broken += [f"{task}: {fault}" for fault in found]
    sheet = Table(("quantity", "unit", "range", f"drawn in {DRAWN_SEEDS} episodes"), rows, title="What the mode draws")
    summary = f"{len(rows)} quantities are drawn and act; with usual values every bit is that of base mode"
    return CheckFinding(
        "fail" if broken else "pass", f"{len(broken)} deviations" if broken else summary, (sheet,), tuple(broken)
    )


def stand(context: Context, task: str, tracker: str, mode: str = modes.DYNAMICS) -> list[str]:
    """Faults of an episode in which the robot stands: in base mode, with usual values, with each quantity alone.

    Args:
        tracker: Tracker with the weights it comes with.
        mode: Mode whose ranges are tried at their ends, of the two the one further from the usual value.
    """
    usual = {key: quantity.usual for key, quantity in modes.QUANTITIES.items()}
    ends = {key: max(bounds, key=lambda end: abs(end - usual[key])) for key, bounds in modes.get(mode).dynamics.items()}
    alone = [key for key, end in ends.items() if end != usual[key] and key not in _UNSEEN]
    if not alone:
        return []
    camera = CameraConfig() if _PICTURED in alone else None
    env = world_of(context, task, tracker, worlds=2 + len(alone), camera=camera)
    drawn = tasks.get(task).drawn(context.seeds(task, 1)[0], "base", rule_sets.get("paper").task(task))
    usual["push_time"] = PUSHED_AT / env.budget
    given = [{}, usual, *({**usual, key: ends[key]} for key in alone)]
    faults: list[str] = []
    built = env.physics.models[0]
    seeds = context.seeds(task, 1) * env.worlds
    env.reset(seeds, samples=[drawn | ({modes.DYNAMICS: sample} if sample else {}) for sample in given])
    for sample, model in zip(given, env.physics.models, strict=True):
        faults += [f"{field} is not as drawn" for field in _strays(built, model, env.scene.robot, usual | sample)]
    if camera is not None:
        shown = env.observe(image=True).image
        assert shown is not None
        for key, picture in zip(("usual values", *alone), shown[1:], strict=True):
            if picture.equal(shown[0]) == (key == _PICTURED):
                faults.append(f"{key}: the first picture is {'' if key == _PICTURED else 'not '}that of base mode")
    states = []
    for _ in range(env.startup_ticks + STOOD_TICKS):
        env.step(np.tile(np.asarray(STAND_ACTION, dtype=np.float32), (env.worlds, 1)))
        states.append([env.physics.qpos.numpy()[world].tobytes() for world in range(env.worlds)])
    env.close()
    base, plain, *others = zip(*states, strict=True)
    if base != plain:
        faults.append(f"usual values differ from base mode from tick {first_difference(base, plain)} on")
    for key, trace in zip(alone, others, strict=True):
        tick = first_difference(base, trace)
        # Where no object moves, its mass changes nothing.
        strange = tick is not None if key == _PICTURED else tick is None and key != "object_mass"
        if strange or (key == "push" and tick != env.startup_ticks + PUSHED_AT):
            faults.append(f"{key} acts from tick {tick} on")
    return [*dict.fromkeys(faults)]


def _strays(
    built: mujoco.MjModel, model: mujoco.MjModel, robot: RobotHandles, sample: Mapping[str, float]
) -> list[str]:
    """Fields of a model that are not those of the built one, scaled as a sample says."""
    wanted = copy.copy(built)
    mass = np.full(built.nbody, sample["object_mass"])
    mass[list(robot.bodies)] = sample["robot_mass"]
    wanted.body_mass *= mass
    wanted.body_inertia *= mass[:, None]
    wanted.geom_friction[:, 0] *= sample["friction"]
    wanted.actuator_gainprm[robot.joint_ctrl, 0] *= sample["gains"]
    wanted.actuator_biasprm[robot.joint_ctrl, 1:3] *= sample["gains"]
    fields = {name: value for name in dir(wanted) if isinstance(value := getattr(wanted, name), np.ndarray)}
    return [
        name
        for name, value in fields.items()
        if name not in DERIVED and not np.allclose(getattr(model, name), value, rtol=SCALED, atol=0.0)
    ]


CHECKS = (
    Check("visual", "Does visual mode leave every bit of the physics as it is, and change the picture?", visual),
    Check("semantic", "Do semantic variants leave the experts' success within 3 of 60?", semantic),
    Check("execution", "Does execution mode move the placements that the rules name, and nothing else?", execution),
    Check("dynamics", "Does dynamics mode change what it draws, and nothing else?", dynamics),
)
"""This module's checks."""
