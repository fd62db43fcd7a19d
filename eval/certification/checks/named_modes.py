"""Does a mode that `--mode` names, such as one of another package, move what its record says, and nothing else?"""

from __future__ import annotations

import functools

import numpy as np

from arena_newton import rule_sets, tasks
from arena_newton.eval.certification.checks import axes
from arena_newton.eval.certification.checks.traces import first_difference, world_of
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding, skipped
from arena_newton.eval.records.identity import mode_facts
from arena_newton.pages.tables import Table
from arena_newton.pictures.settings import CameraConfig
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.rules import modes
from arena_newton.rules.rule_types import Range, RuleSet

__all__ = ["CHECKS", "drawn"]

NAME = "modes"


def named_modes(context: Context) -> CheckFinding:
    """Compare draws with the record's ranges, and worlds whose placements are base mode's with those of base mode."""
    if not context.options.mode:
        return skipped("--mode names none")
    if context.options.engine != "mujoco":
        return skipped("bits are promised on engine mujoco alone")
    rows, broken, said, tracker = [], [], [], context.trackers[0]
    for name in context.options.mode:
        for task in context.tasks:
            for rules in rule_sets.names():
                moved, faults = drawn(task, name, rules, context.seeds(task, axes.DRAWN_SEEDS))
                rows += [(name, task, rules, *row) for row in moved]
                broken += [f"mode {name}: {task} under {rules}: {fault}" for fault in faults]
            facts = mode_facts(name, rule_sets.get("paper"), (task,))
            for what, measure in (("world", _worlds), ("stand", axes.stand)):
                part = functools.partial(measure, context, task, tracker, name)
                faults = context.measured(f"mode_{name}_{what}", task, tracker, facts, part)
                broken += [f"mode {name}: {task}: {fault}" for fault in faults]
        mode = modes.get(name)
        looks = [f"the scene's {mode.scene}"] * (mode.scene != "base") + ["a drawn light"] * (mode.light is not None)
        numbers = sorted({" ".join(row[3:5]) for row in rows if row[0] == name})
        said.append(f"{name} moves {', '.join([*numbers, *looks]) or 'nothing'}")
    head = ("mode", "task", "rules", "object", "number", "base range", "range")
    sheet = Table(
        (*head, f"drawn in {axes.DRAWN_SEEDS} episodes"),
        rows,
        title="What the modes move; every other number has the bits of base mode",
    )
    summary = f"{len(broken)} deviations from the records" if broken else f"{'; '.join(said)}; nothing else"
    return CheckFinding("fail" if broken else "pass", summary, (sheet,), tuple(broken))


def drawn(task: str, name: str, rules: str, seeds: list[int]) -> tuple[list[tuple[str, ...]], list[str]]:
    """Numbers that a mode draws otherwise than base mode, and what is not as its record says.

    Returns:
        Rows of object or `dynamics`, number, its range in base mode and here, and what was drawn; and the faults.
    """
    mode, rule_set = modes.get(name), rule_sets.get(rules)
    moved = axes.moved_coordinates(task, name, rules, seeds)
    named: dict[tuple[str, str], tuple[Range | None, Range | None]] = {
        (rule.record, axis): (getattr(rule.base, axis, None), getattr(mode.range_of(rule), axis, None))
        for rule in rule_set.task(task).objects
        for axis in axes.named_coordinates(rule, mode)
    }
    for quantity, ends in mode.dynamics.items():
        named[modes.DYNAMICS, quantity] = ((modes.QUANTITIES[quantity].usual,) * 2, ends)
    faults = [f"moves {' '.join(key)}, which the record does not name" for key in moved.keys() - named.keys()]
    faults += [f"does not move {' '.join(key)}" for key in named.keys() - moved.keys()]
    rows: list[tuple[str, ...]] = []
    for key in sorted(named.keys() & moved.keys()):
        low, high = min(moved[key]), max(moved[key])
        usual, bounds = named[key]
        rows.append((*key, axes.shown_range(usual), axes.shown_range(bounds), f"{low:.3f} … {high:.3f}"))
        if bounds is not None and not axes.fills(low, high, bounds):
            faults.append(f"{' '.join(key)} is drawn from {low:.3f} to {high:.3f}, not {axes.shown_range(bounds)}")
    return rows, faults + _light_faults(task, name, rule_set, seeds[:20])


def _light_faults(task: str, name: str, rules: RuleSet, seeds: list[int]) -> list[str]:
    """Faults of the lights: those of base mode, or one for each episode where the record draws them."""
    spec = tasks.get(task)
    lights = [spec.draw(seed, name, rules).light for seed in seeds]
    if modes.get(name).light is None:
        same = lights == [spec.draw(seed, "base", rules).light for seed in seeds]
        return [] if same else ["has another light than base mode"]
    return [f"draws {len({*lights})} lights in {len(seeds)} episodes"] * (len({*lights}) < len(seeds))


def _worlds(context: Context, task: str, tracker: str, name: str) -> list[str]:
    """Faults of worlds of the mode with the placements of base mode: their bits, and whether pictures differ."""
    seeds, rules = context.seeds(task, 2), rule_sets.get("paper").task(task)
    samples = [tasks.get(task).drawn(seed, "base", rules) for seed in seeds]
    mode, traces, pictures = modes.get(name), [], []
    for played in ("base", name):
        env = world_of(context, task, tracker, worlds=len(seeds), mode=played, camera=CameraConfig())
        env.reset(seeds, samples=samples)
        image = env.observe(image=True).image
        assert image is not None
        pictures.append(image.cpu().numpy().tobytes())
        traces.append([])
        for _ in range(env.startup_ticks + axes.STOOD_TICKS):
            env.step(np.tile(np.asarray(STAND_ACTION, dtype=np.float32), (env.worlds, 1)))
            p = env.physics
            traces[-1].append(b"".join(part.numpy().tobytes() for part in (p.qpos, p.qvel, p.xpos)))
        env.close()
    faults, tick = [], first_difference(*traces)
    if tick is not None and mode.scene == "base":  # a scene of its own may be another in all respects
        faults.append(f"with the placements of base mode, physics differs from tick {tick} on")
    if (pictures[0] == pictures[1]) == mode.looks:
        faults.append("the first pictures are those of base mode" if mode.looks else "the first pictures differ")
    return faults


CHECKS = (Check(NAME, "Does each mode that --mode names move what its record says, and nothing else?", named_modes),)
"""This module's check."""
