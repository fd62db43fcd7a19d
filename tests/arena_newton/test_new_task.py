"""Adding a task: one record, one scene, one judge; nothing that lists tasks forgets it."""

import json
import shutil

import numpy as np
import pytest

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main as eval_main
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.statistics import stats
from arena_newton.usd_scenes.__main__ import main as scenes_main
from arena_newton.usd_scenes.skeleton import write
from arena_newton.usd_scenes.validate import task_of, validate
from scene_builders.__main__ import parts


def test_a_registered_task_is_listed_and_judged_by_its_rules(bell, capsys):
    """Names, rule sets, the rules page, the scenes' list and an evaluation's plan know it; hashes of others stay."""
    assert tasks.names()[-1] == bell and tasks.get(bell).name == bell
    for name in rule_sets.names():
        assert dict(rule_sets.table(rule_sets.get(name)))[bell] == "the bell rings 3 times"
    page = rule_sets.markdown()
    assert "| bell | the bell rings 3 times | the same |" in page
    assert scenes_main(["list"]) == 0 and "\nbell " in capsys.readouterr().out
    assert eval_main(["list", "--task", bell, "--json"]) == 0
    assert '"bell"' in capsys.readouterr().out
    assert bell not in parts()


def test_hashes_of_other_tasks_do_not_change(bell):
    """A run of other tasks keeps its identity when a task is registered."""
    with_bell = {name: rule_sets.get(name).hash_for(tasks.names()[:-1]) for name in rule_sets.names()}
    tasks.unregister(bell)
    assert with_bell == {name: rule_sets.get(name).hash for name in rule_sets.names()}
    assert bell not in rule_sets.markdown()


def test_its_scene_is_validated_by_its_own_requirements(bell, tmp_path, capsys):
    """The validator finds the task by the folder, accepts its scene, names what it lacks; `new` starts a variant."""
    layer = tasks.get(bell).layer
    assert scenes_main(["validate", bell]) == 0 and task_of(layer) == bell
    assert validate(write(bell, tmp_path / "mine.usda"), bell) == []
    broken = tmp_path / "other" / "bell"
    shutil.copytree(layer.parent, broken)
    text = (broken / "scene.usda").read_text(encoding="utf-8").replace('"Bell"', '"Gong"')
    (broken / "scene.usda").write_text(text, encoding="utf-8")
    assert any("/World/Bell: missing" in str(problem) for problem in validate(broken / "scene.usda"))


def test_an_evaluation_reports_it_outside_the_papers_averages(bell, tmp_path):
    """A run of the task ends in a journal, table and report that name it, and no average of the paper counts it."""
    out = tmp_path / "run"
    flags = "--policy stand --tracker pd --engine mujoco --seeds 0 --repeats 1 --max-steps 3".split()
    assert eval_main(["run", "--task", bell, *flags, "--out", str(out)]) == 0
    (line,) = (out / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    assert (json.loads(line)["task"], json.loads(line)["outcome"]) == (bell, "timeout")
    assert bell in (out / "table.md").read_text(encoding="utf-8")
    assert bell in (out / "report.html").read_text(encoding="utf-8")
    assert stats.outside_suites([bell, "football"]) == [bell]


def test_its_scene_and_its_code_are_part_of_a_runs_identity(bell, monkeypatch):
    """A run of a task of others is known by the task's scene and package; identities of built-in tasks have no key."""

    def identity(*names):
        return resolve(RunOptions(task=names, policy="stand", tracker=("pd",), engine="mujoco")).identity()

    assert "foreign_tasks" not in identity("football")
    first = identity("football", bell)["foreign_tasks"]
    assert list(first) == [bell] and set(first[bell]) == {"code", "scene"}
    with tasks.get(bell).layer.open("a", encoding="utf-8") as layer:
        layer.write("# heavier\n")
    second = identity(bell)["foreign_tasks"]
    assert second[bell]["code"] == first[bell]["code"] and second[bell]["scene"] != first[bell]["scene"]
    monkeypatch.setattr("arena_newton.eval.records.identity.own_code", lambda part: "0123456789ab")
    assert identity(bell)["foreign_tasks"][bell]["code"] != first[bell]["code"]


def test_names_that_are_taken_are_refused(bell):
    """A second task of the same name, and one without a scene, are refused in words."""
    with pytest.raises(InputError, match="'bell': the name is taken"):
        tasks.register(tasks.get(bell))
    with pytest.raises(InputError, match="'football': the name is taken"):
        tasks.register(tasks.get("football"))
    with pytest.raises(InputError, match="--task gong: unknown task; known are bell, boxing"):
        tasks.get("gong")


@pytest.mark.parametrize("name", tasks.PAPER)
def test_every_task_of_the_paper_is_complete(name):
    """A suite, requirements, predicates and, where there is one, an expert that can be imported."""
    import importlib

    spec = tasks.get(name)
    assert spec.suite in ("HOI", "HSI") and spec.requires and spec.layer.is_file()
    assert len(spec.predicates) > 1 and len({p.name for p in spec.predicates}) == len(spec.predicates)
    assert all(np.isfinite(spec.spawn_position)) and abs(np.linalg.norm(spec.spawn_quat) - 1.0) < 1e-6
    if spec.expert is not None:
        module, _, attribute = spec.expert.partition(":")
        assert callable(getattr(importlib.import_module(module), attribute))
