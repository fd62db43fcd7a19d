"""The rule sets `paper` and `released`: assembled from the tasks, printed, hashed.

`paper` is what the benchmark's paper says, made precise where it is silent; `released` is what its released code does.
The numbers that belong to one task are in that task's file, the common ones in `arena_newton.rules.rule_types`.
"""

import dataclasses
import functools
import sys
from collections.abc import Sequence

from arena_newton import tasks
from arena_newton.cli.command_line import exit_code, program
from arena_newton.cli.flags import Several, parse_flags
from arena_newton.pages.tables import Table
from arena_newton.robot.g1 import TWIST2_DRIVE, TWIST2_HUMANOIDARENA_DRIVE
from arena_newton.rules.modes import BUILT_IN, DYNAMICS, QUANTITIES
from arena_newton.rules.rule_types import (
    ByRules,
    CylinderRange,
    FallRule,
    PoseRange,
    Range,
    RuleSet,
    StartupRule,
    check_name,
    num,
)

__all__ = ["get", "main", "markdown", "names", "table", "text"]


def names() -> tuple[str, ...]:
    """Names of the rule sets, the default first."""
    return tuple(field.name for field in dataclasses.fields(ByRules))


def get(name: str, played: Sequence[str] | None = None) -> RuleSet:
    """A rule set by name, of all tasks, or of this package's and those that a run plays, whatever else is installed.

    Raises:
        InputError: Unknown name, or an unknown task that is played.
    """
    check_name(name)
    known = tasks.specs() if played is None else map(tasks.get, dict.fromkeys((*tasks.OWN, *played)))
    return _assembled(name, tuple(known))


@functools.lru_cache(maxsize=4)
def _assembled(name: str, specs: tuple[tasks.TaskSpec, ...]) -> RuleSet:
    paper = name == "paper"
    return RuleSet(
        name=name,
        fall=FallRule(at_once=paper),
        tasks=tuple(spec.rules.of(name) for spec in specs),
        navi_visual_room_swap=not paper,
        startup=StartupRule(ticks=50, prefill=True) if paper else StartupRule(ticks=0, prefill=False),
        original_drive=not paper,
    )


def _span(bounds: Range | None) -> str:
    if bounds is None:
        return "–"
    return num(bounds[0]) if bounds[0] == bounds[1] else f"{num(bounds[0])} … {num(bounds[1])}"


def _fall_text(rule: FallRule) -> str:
    soft, hard, force = num(rule.soft_tilt_deg), num(rule.hard_tilt_deg), num(rule.force_threshold)
    if rule.at_once:
        return (
            f"tilt > {soft}° for {rule.confirm_ticks} consecutive ticks, or tilt > {hard}° at once, "
            f"or ≥ {force} N on a critical body with tilt > {soft}° at once"
        )
    return (
        f"(tilt > {hard}°, or tilt > {soft}° with ≥ {force} N on a critical body) "
        f"for {rule.confirm_ticks} consecutive ticks"
    )


def _startup_text(rule: StartupRule) -> str:
    if rule.ticks:
        text = f"{rule.ticks} ticks under a standing command (the original has none), then the policy is asked"
    else:
        text = "none: the policy is asked at the spawn pose"
    history = (
        "the tracker's history holds the first frame"
        if rule.prefill
        else "the tracker's history starts as the original's (TWIST2: zeros; SONIC: the first joints, else zeros)"
    )
    return f"{text}; {history}"


def _placement_text(rules: RuleSet, placement: str) -> str:
    found = [o.record for t in rules.tasks for o in t.objects if o.placement == placement]
    return ", ".join(found) or "none"


def _mode_notes(rules: RuleSet, mode: str) -> list[tuple[str, str]]:
    """Tasks in which a mode changes something in particular, and what this rule set says of it."""
    notes = ((t.task, tasks.get(t.task).mode_notes.get(mode)) for t in rules.tasks)
    return [(task, note.of(rules.name)) for task, note in notes if note is not None]


def _light_text(rules: RuleSet) -> str:
    fixed = [t.task for t in rules.tasks if t.light is not None]
    text = "dome in base, execution and semantic"
    if fixed:
        text += f" (distant always in {', '.join(fixed)})"
    v = rules.visual_light
    return (
        f"{text}; visual: distant, pitch {_span(v.pitch_deg)}°, roll {_span(v.roll_deg)}°, yaw {_span(v.yaw_deg)}°, "
        f"intensity {_span(v.intensity)}, each colour {_span(v.color[0])}"
    )


def text(rules: RuleSet) -> str:
    """A rule set as it is printed, one line per row."""
    return "\n".join(
        [f"rules {rules.name} ({rules.hash})", *(f"  {item}: {message}" for item, message in table(rules))]
    )


def table(rules: RuleSet) -> list[tuple[str, str]]:
    """Rows (item, what this set says) in the order of the documentation."""
    paper = rules.name == "paper"
    return [
        ("step budget (50 Hz ticks)", ", ".join(f"{t.task} {t.max_steps}" for t in rules.tasks)),
        ("fall", _fall_text(rules.fall)),
        *(row for t in rules.tasks for row in ((t.task, t.success.sentence()), *t.success.notes())),
        ("standing", f"root z ≥ {num(rules.standing.min_root_z)} m and up-axis ≥ {num(rules.standing.min_up)}"),
        ("placed absolutely", _placement_text(rules, "absolute")),
        ("placed as offset from the initial pose", _placement_text(rules, "offset")),
        (
            "placed by the original's offset and scale: initial pose + spawn scale × sample",
            _placement_text(rules, "scaled"),
        ),
        (
            "execution mode",
            "ranges widened about the base range, never shifted, never void, and not into a fixture where the original "
            "keeps clear of it by a shift (see the ranges below)"
            if paper
            else "ranges as the released configuration has them",
        ),
        *((f"semantic {task}", message) for task, message in _mode_notes(rules, "semantic")),
        ("lights", _light_text(rules)),
        *((f"{task} in visual mode", message) for task, message in _mode_notes(rules, "visual")),
        ("start-up before step 0", _startup_text(rules.startup)),
        (
            "drive of official TWIST2 checkpoints",
            "the original's robot asset" if rules.original_drive else "TWIST2's own gains",
        ),
        ("success is judged", rules.success_judged),
    ]


def _range_text(ranges: PoseRange | CylinderRange) -> str:
    if isinstance(ranges, CylinderRange):
        axes = ", ".join(f"({num(x)}, {num(y)})" for x, y in ranges.centers)
        return f"{num(ranges.radius)} m around {axes}; z {_span(ranges.z)}"
    parts = [f"{k} {_span(getattr(ranges, k))}" for k in ("x", "y", "z", "yaw") if getattr(ranges, k) is not None]
    return ", ".join(parts)


def _departures() -> list[tuple[str, str, str]]:
    """Rows (item, here, in the original) in which both rule sets differ from the original, and on purpose."""
    own, original = TWIST2_DRIVE, TWIST2_HUMANOIDARENA_DRIVE
    leg = "hip pitch, roll, yaw, knee, ankle pitch, roll"

    def six(values: tuple[float, ...]) -> str:
        return "/".join(num(v) for v in values[:6])

    return [
        (
            "TWIST2's drive",
            f"TWIST2's own gains, {leg} {six(own.kp)} N·m/rad, efforts {six(own.effort)} N·m; official checkpoints "
            "take the original's under `--rules released` or `--drive humanoidarena`",
            f"{six(original.kp)} N·m/rad, efforts {six(original.effort)} N·m",
        ),
        (
            "physics rate",
            "the checkpoint's: official TWIST2 1 ms × 20, our weights and SONIC 5 ms × 4 (a run prints its own)",
            "1 ms × 20 under TWIST2, 5 ms × 4 under SONIC",
        ),
        (
            "finger drive",
            f"stiffness {num(own.finger_kp)} N·m/rad, damping {num(own.finger_kd)} N·m·s/rad, effort "
            f"{num(own.finger_effort)} N·m: the soft drive that grasped and released in trials. Unitree's model allows "
            "thumb_0 as much and a hand's other six joints 1.4 N·m. In an expert's DoubleDesk (`twist2`, seed 0 repeat "
            "0, 5,604 physics steps) the left thumb_1, which holds the hammer, is above that in 8.4 % of them (8.7 % "
            "over four repeats) and at its limit in 0.3 %, the hand's others above it in 0.3 to 0.4 %",
            "100, 10, 300",
        ),
        ("rotor inertia of the joints", "0.0036 to 0.025 kg·m², Unitree's public model", "0"),
        ("soft joint limits", "none beside the joints' own", "0.9 of the range"),
        (
            "football's friction",
            "0.7 in every contact of the ball",
            "0.5 static, 0.4 dynamic; a contact takes the larger of two: 0.7 on the pitch, 1.0 at a foot",
        ),
        (
            "door",
            "handle spring 2.5 N·m/rad, leaf damping 1.5 N·m·s/rad and friction 0.5 N·m; the latch releases at 20° of "
            "the handle",
            "drive 5, damping 20, at most 5 once released; the same angle",
        ),
        ("visual mode's light", "a point of the sky: hard shadows", "15° wide"),
        ("heights of sofa cartons", "0.21 m above the sample, which is their base", "the asset's origin is not known"),
        ("heights of VisNavi's blocks", "the sample is their base", "the asset's origin is not known"),
    ]


def markdown(others: Sequence[str] = ()) -> str:
    """The documentation page `docs/reference/rules.md`, with tasks of other packages where they are named.

    Raises:
        InputError: An unknown task.
    """
    sets = [get(name, others) for name in names()]
    specs = [tasks.get(t.task) for t in sets[0].tasks]
    items = [
        [cell.replace("|", "\\|") for cell in (item, first, "the same" if first == second else second)]
        for (item, first), (_, second) in zip(*map(table, sets), strict=True)
    ]
    steps = [(spec.name, predicate.name, predicate.sentence) for spec in specs for predicate in spec.predicates]
    ranges = [
        (ours.task, a.record, _range_text(a.base), wide, "the same" if wide == original else original)
        for ours, theirs in zip(*(s.tasks for s in sets), strict=True)
        for a, b in zip(ours.objects, theirs.objects, strict=True)
        for wide, original in [(_range_text(a.execution), _range_text(b.execution))]
    ]
    overlaps = [
        (spec.name, things, ", ".join(case.rules), ", ".join(case.modes), case.episodes, num(case.depth), case.why)
        for spec in specs
        for case in spec.overlaps
        for things in [" and ".join(path.removeprefix("/World/") for path in (case.first, case.second))]
    ]
    drawn = [
        (f"`{name}`", _span(BUILT_IN[DYNAMICS].dynamics.get(name)), quantity.unit, quantity.sentence)
        for name, quantity in QUANTITIES.items()
    ]
    head = ("task", "things", "`--rules`", "`--mode`", "episodes of 60", "deepest [m]", "because")
    lines = [
        "# Rule sets",
        "",
        "`--rules paper` (default) follows the benchmark's paper, made precise where it is silent; `--rules released`",
        "follows its released code. A run prints the set it uses and stores the set's hash with every result.",
        "This page is generated: `python -m arena_newton.rule_sets > docs/reference/rules.md`.",
        "",
        *Table(("item", *(f"`{s.name}`" for s in sets)), items).compact(),
        "",
        "## Modes",
        "",
        "A mode changes base mode's episodes in what its line says, and in nothing else.",
        "",
        *Table(("`--mode`", "change"), [(f"`{mode.name}`", mode.sentence) for mode in BUILT_IN.values()]).compact(),
        "",
        "`dynamics` draws those with a range once per episode, each by a generator of its own, under both rule sets.",
        "`+name=value` and `+name=low..high` behind a mode's name draw any of them, as `--mode base+push=0.5`; a push",
        "that is named alone has the time and heading of `dynamics`:",
        "",
        *Table(("quantity", "range", "unit", "meaning"), drawn).compact(),
        "",
        "## Where both sets depart from the original",
        "",
        *Table(("item", "here", "in the original"), _departures()).compact(),
        "",
        "## Steps on the way to success",
        "",
        "Predicates say how far an episode came; they decide nothing. Every tick tests all of them, each by itself.",
        "The last one of a task is its success.",
        "",
        *Table(("task", "predicate", "holds when"), steps).compact(),
        "",
        "## Where objects are put",
        "",
        "Ranges of the sampled pose, in m and rad. A sample is drawn once from the episode's seed; the placement above",
        "turns it into a world pose. Base ranges, and with them the draws of base, semantic and visual mode, are the",
        "same in both sets.",
        "",
        *Table(("task", "object", "base", "execution, `paper`", "execution, `released`"), ranges).compact(),
        "",
        "## Episodes that start with things inside each other",
        "",
        "All the cases deeper than 1 cm in the protocol's 60 episodes (3 seeds × 20) of any mode and rule set; physics",
        "pushes the things apart in the first ticks. The original's own ranges make them, and its draws are kept.",
        "",
        *Table(head, overlaps, "llllrrl").compact(),
    ]
    return "\n".join(lines) + "\n"


@dataclasses.dataclass(frozen=True)
class _Flags:
    """Print both rule sets as Markdown."""

    task: Several[str] = ()
    """Tasks of other packages, besides those of this one."""


def main(argv: Sequence[str] | None = None) -> int:
    """Print the page `docs/reference/rules.md`.

    Returns:
        Exit code: 0, or 2 for an unknown task or argument.
    """

    def work() -> None:
        arguments = list(sys.argv[1:] if argv is None else argv)
        flags = parse_flags(_Flags, arguments, program("rules", "arena_newton.rule_sets"))
        print(markdown(flags.task), end="")

    return exit_code(work)


if __name__ == "__main__":
    sys.exit(main())
