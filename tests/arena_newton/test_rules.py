"""Rule sets are frozen, hashed, complete, and documented by a page that cannot drift."""

import dataclasses
import json
from pathlib import Path

import pytest

from arena_newton import rules, tasks
from arena_newton.errors import InputError

PAGE = Path(__file__).resolve().parents[2] / "docs" / "rules.md"


def test_documentation_page_matches_the_rules():
    """docs/rules.md is what `python -m arena_newton.rules` prints."""
    assert PAGE.read_text(encoding="utf-8") == rules.markdown()


@pytest.mark.parametrize("name", rules.names())
def test_a_rule_set_is_frozen_hashed_and_printable(name):
    """A rule set cannot be changed, and its hash follows its content."""
    rule_set = rules.get(name)
    with pytest.raises(dataclasses.FrozenInstanceError):
        rule_set.name = "mine"
    assert len(rule_set.hash) == 12
    assert rule_set.hash == rules.get(name).hash
    changed = dataclasses.replace(rule_set, fall=dataclasses.replace(rule_set.fall, hard_tilt_deg=74.0))
    assert changed.hash != rule_set.hash
    assert rule_set.hash in str(rule_set)
    assert json.loads(json.dumps(rule_set.to_dict())) == rule_set.to_dict()


def test_a_changed_range_changes_the_hash():
    """Placement ranges belong to the hashed content."""
    paper = rules.get("paper")
    first = paper.tasks[0]
    moved = dataclasses.replace(first.objects[0], base=dataclasses.replace(first.objects[0].base, x=(-1.0, 1.0)))
    changed = dataclasses.replace(paper, tasks=(dataclasses.replace(first, objects=(moved,)), *paper.tasks[1:]))
    assert changed.hash != paper.hash


def test_unknown_names_are_refused():
    """Rule set and task names are checked with a list of what there is."""
    with pytest.raises(InputError, match="paper or released"):
        rules.get("strict")
    with pytest.raises(InputError, match="football"):
        rules.get("paper").task("golf")


@pytest.mark.parametrize(
    ("name", "steps"),
    [("paper", (1300, 2000, 2000, 1800, 1050, 1500, 1800)), ("released", (2000, 2000, 1450, 1800, 2000, 900, 1800))],
)
def test_step_budgets(name, steps):
    """Budgets of the paper and of the launch scripts, in the order of the tasks (rule table, first row)."""
    rule_set = rules.get(name)
    assert tuple(tasks.get(task).max_steps(rule_set) for task in tasks.names()) == steps


def test_fall_rules():
    """Angles, force and confirmation of both sets (rule table, row fall)."""
    paper, released = rules.get("paper").fall, rules.get("released").fall
    assert dataclasses.astuple(paper) == (True, 60.0, 75.0, 50.0, 5)
    assert dataclasses.astuple(released) == (False, 60.0, 75.0, 50.0, 5)


def test_predicate_numbers_that_differ():
    """The numbers in which the two sets differ (rule table)."""
    paper, released = ({t.task: t.success for t in rules.get(n).tasks} for n in rules.names())
    assert (rules.get("paper").ball_restitution, rules.get("released").ball_restitution) == (0.1, 0.75)
    assert (paper["football"].rear_bound, released["football"].rear_bound) == (True, False)
    assert (paper["football"].ball_out, released["football"].ball_out) == (True, False)
    assert (paper["double_desk"].crate_frame, released["double_desk"].min_z) == (True, 0.445)
    assert dataclasses.astuple(paper["pp_box"]) == (0.06, 0.05, 10)
    assert dataclasses.astuple(released["pp_box"])[:2] == (0.6477, 0.06)
    assert dataclasses.astuple(paper["open_door"]) == (0.55, 0.02)
    assert dataclasses.astuple(released["open_door"]) == (60.0,)
    assert dataclasses.astuple(paper["sit_sofa"]) == (50.0, 25, 0.62)
    assert dataclasses.astuple(released["sit_sofa"]) == (5.0, 0.10, 0.35)
    assert dataclasses.astuple(paper["boxing"]) == (0.0, 0.08)
    assert dataclasses.astuple(released["boxing"]) == (0.10, 0.08)
    assert dataclasses.astuple(rules.get("paper").standing) == (0.45, 0.60)


def test_every_task_has_rules_in_both_sets():
    """Both sets know all seven tasks in the same order and the same objects."""
    for name in rules.names():
        assert tuple(t.task for t in rules.get(name).tasks) == tasks.names()
    for ours, theirs in zip(rules.get("paper").tasks, rules.get("released").tasks, strict=True):
        assert [o.record for o in ours.objects] == [o.record for o in theirs.objects]
        assert [o.base for o in ours.objects] == [o.base for o in theirs.objects]
