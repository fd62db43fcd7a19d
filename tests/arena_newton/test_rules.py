"""Rule sets are frozen, hashed, complete, and documented by a page that cannot drift."""

import dataclasses
import json
import math
from pathlib import Path

import pytest

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.rules import rule_types

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "rules.md"


def test_documentation_page_matches_the_rules(capsys):
    """docs/reference/rules.md is what `python -m arena_newton.rule_sets` prints."""
    assert rule_sets.main([]) == 0
    assert PAGE.read_text(encoding="utf-8") == capsys.readouterr().out


@pytest.mark.parametrize("name", rule_sets.names())
def test_a_rule_set_is_frozen_hashed_and_printable(name):
    """A rule set cannot be changed, and its hash follows its content."""
    rule_set = rule_sets.get(name)
    with pytest.raises(dataclasses.FrozenInstanceError):
        rule_set.name = "mine"
    assert len(rule_set.hash) == 12
    assert rule_set.hash == rule_sets.get(name).hash
    changed = dataclasses.replace(rule_set, fall=dataclasses.replace(rule_set.fall, hard_tilt_deg=74.0))
    assert changed.hash != rule_set.hash
    assert rule_set.hash in rule_sets.text(rule_set)
    assert json.loads(json.dumps(rule_set.to_dict())) == rule_set.to_dict()


def test_a_changed_range_changes_the_hash():
    """Placement ranges belong to the hashed content."""
    paper = rule_sets.get("paper")
    first = paper.tasks[0]
    moved = dataclasses.replace(first.objects[0], base=dataclasses.replace(first.objects[0].base, x=(-1.0, 1.0)))
    changed = dataclasses.replace(paper, tasks=(dataclasses.replace(first, objects=(moved,)), *paper.tasks[1:]))
    assert changed.hash != paper.hash


def test_unknown_names_are_refused():
    """Rule set and task names are checked with a list of what there is."""
    with pytest.raises(InputError, match="paper or released"):
        rule_sets.get("strict")
    with pytest.raises(InputError, match="football"):
        rule_sets.get("paper").task("golf")
    with pytest.raises(InputError, match="football"):
        rule_sets.get("paper").hash_for(["golf"])
    with pytest.raises(InputError, match="typo: unknown, choose paper or released"):
        rule_types.ByRules(1, 2).of("typo")


ORIGINAL = {  # budgets of the paper and of the launch scripts; the robot's position [m] and yaw [deg] at the start
    "football": (1300, 2000, (0.0, -2.0, 0.8), 90.0),
    "double_desk": (2000, 2000, (-3.7, -2.2, 0.8), 0.0),
    "pp_box": (2000, 1450, (-1.6, -5.0, 0.8), 0.0),
    "open_door": (1800, 1800, (-1.6, 0.2, 0.8), 90.0),
    "sit_sofa": (1050, 2000, (-1.6, 2.0, 0.8), -90.0),
    "boxing": (1500, 900, (-1.6, -2.0, 0.8), -90.0),
    "vis_navi": (1800, 1800, (-1.9, -5.2, 0.8), 90.0),
}


@pytest.mark.parametrize("task", ORIGINAL)
def test_budget_and_spawn_are_the_originals(task):
    """Step budgets of both rule sets and the spawn pose of the paper's tasks."""
    paper, released, position, yaw = ORIGINAL[task]
    spec = tasks.get(task)
    assert [spec.max_steps(rule_sets.get(name)) for name in rule_sets.names()] == [paper, released]
    w, x, y, z = spec.spawn_quat
    assert spec.spawn_position == position and x == y == 0.0
    assert math.degrees(2 * math.atan2(z, w)) == pytest.approx(yaw, abs=1e-3)


def test_fall_rules():
    """Angles, force and confirmation of both sets (rule table, row fall)."""
    paper, released = rule_sets.get("paper").fall, rule_sets.get("released").fall
    assert dataclasses.astuple(paper) == (True, 60.0, 75.0, 50.0, 5)
    assert dataclasses.astuple(released) == (False, 60.0, 75.0, 50.0, 5)


def test_predicate_numbers_that_differ():
    """The numbers in which the two sets differ (rule table)."""
    paper, released = ({t.task: t.success for t in rule_sets.get(n).tasks} for n in rule_sets.names())
    assert (rule_sets.get("paper").ball_restitution, rule_sets.get("released").ball_restitution) == (0.1, 0.75)
    assert (paper["football"].rear_bound, released["football"].rear_bound) == (True, False)
    assert (paper["football"].ball_out, released["football"].ball_out) == (True, False)
    assert (paper["double_desk"].crate_frame, released["double_desk"].min_z) == (True, 0.445)
    assert dataclasses.astuple(paper["pp_box"]) == (0.06, 0.05, 10)
    assert dataclasses.astuple(released["pp_box"]) == (0.0223, 0.06, 1)
    assert dataclasses.astuple(paper["open_door"]) == (0.55, 0.02)
    assert dataclasses.astuple(released["open_door"]) == (60.0,)
    assert dataclasses.astuple(paper["sit_sofa"]) == (50.0, 25, 0.62)
    assert dataclasses.astuple(released["sit_sofa"]) == (5.0, 0.10, 0.35)
    assert dataclasses.astuple(paper["boxing"]) == (0.0, 0.08)
    assert dataclasses.astuple(released["boxing"]) == (0.10, 0.08)
    assert (paper["vis_navi"].round_signs, released["vis_navi"].round_signs) == (False, True)
    assert dataclasses.astuple(rule_sets.get("paper").standing) == (0.45, 0.60)


def test_every_task_has_rules_in_both_sets():
    """Both sets know all seven tasks in the same order and the same objects."""
    for name in rule_sets.names():
        assert tuple(t.task for t in rule_sets.get(name).tasks) == tasks.names()
    for ours, theirs in zip(rule_sets.get("paper").tasks, rule_sets.get("released").tasks, strict=True):
        assert [o.record for o in ours.objects] == [o.record for o in theirs.objects]
        assert [o.base for o in ours.objects] == [o.base for o in theirs.objects]


def with_an_eighth_task(rule_set):
    """The rule set with one task more."""
    return dataclasses.replace(rule_set, tasks=(*rule_set.tasks, dataclasses.replace(rule_set.tasks[0], task="bell")))


@pytest.mark.parametrize("name", rule_sets.names())
def test_every_task_prints_its_own_success_condition(name):
    """A rule set says what each task's success is, in the task's own words."""
    rows = dict(rule_sets.table(rule_sets.get(name)))
    for task in rule_sets.get(name).tasks:
        assert rows[task.task] == task.success.sentence()


def test_the_hash_of_a_run_is_that_of_its_tasks():
    """Another task leaves it alone, and so does order; a task of its own, the fall rule or the set's name change it."""
    paper = rule_sets.get("paper")
    used = ("boxing", "football")
    first = paper.hash_for(used)
    assert first == paper.hash_for(reversed(used)) == with_an_eighth_task(paper).hash_for(used)
    others = tuple(t if t.task in used else dataclasses.replace(t, max_steps=1) for t in paper.tasks)
    assert dataclasses.replace(paper, tasks=others).hash_for(used) == first
    own = tuple(dataclasses.replace(t, max_steps=1) if t.task in used else t for t in paper.tasks)
    assert dataclasses.replace(paper, tasks=own).hash_for(used) != first
    assert dataclasses.replace(paper, fall=rule_types.FallRule(at_once=False)).hash_for(used) != first
    assert rule_sets.get("released").hash_for(used) != first
    assert paper.hash_for(tasks.names()) == paper.hash != first


@pytest.mark.parametrize(("crate_frame", "min_z"), [(True, 0.445), (False, None)])
def test_contradictory_rules_are_refused(crate_frame, min_z):
    """DoubleDesk's box in the crate's frame has no lowest height, its world-axis box needs one."""
    from arena_newton.tasks.double_desk import DoubleDeskRule

    with pytest.raises(InputError, match="double_desk: crate_frame"):
        DoubleDeskRule(crate_frame, min_z)


def test_every_number_of_a_predicate_is_printed():
    """Each number of a success rule appears in the table, and a changed one changes the text."""
    for name in rule_sets.names():
        for task in rule_sets.get(name).tasks:
            for field in dataclasses.fields(task.success):
                value = getattr(task.success, field.name)
                if isinstance(value, bool | tuple) or value is None or value == 0.0:
                    continue
                if field.name == "out_z" and not task.success.ball_out:
                    continue  # read only where leaving the field counts, and there it is printed
                changed = dataclasses.replace(task.success, **{field.name: type(value)(2 * value + 1)})
                said = (task.success.sentence(), *task.success.notes())
                assert (changed.sentence(), *changed.notes()) != said, (task.task, field.name)
