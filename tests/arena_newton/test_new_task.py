"""Adding a task: one record, one scene, one judge; nothing that lists tasks forgets it."""

import dataclasses
import importlib
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from arena_newton import rule_sets, tasks
from arena_newton.doctor import _scenes
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main as eval_main
from arena_newton.eval.adapters import gym
from arena_newton.eval.certification.context import with_expert
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.identity import foreign_task
from arena_newton.eval.statistics import stats
from arena_newton.tasks.judge import Condition, ConditionsJudge
from arena_newton.usd_scenes.__main__ import main as scenes_main
from arena_newton.usd_scenes.skeleton import write
from arena_newton.usd_scenes.validate import task_of, validate
from scene_builders.__main__ import parts

ROOT = Path(__file__).resolve().parents[2]


def test_a_registered_task_is_listed_and_judged_by_its_rules(bell, capsys):
    """Names, rule sets, the rules page, the scenes' list and an evaluation's plan know it; hashes of others stay."""
    assert bell in tasks.names() and tasks.get(bell).name == bell
    for name in rule_sets.names():
        assert dict(rule_sets.table(rule_sets.get(name)))[bell] == "the bell rings 3 times"
    assert "| bell | the bell rings 3 times | the same |" in rule_sets.markdown([bell])
    assert scenes_main(["list"]) == 0 and "\nbell " in capsys.readouterr().out
    assert eval_main(["list", "--task", bell, "--json"]) == 0
    assert '"bell"' in capsys.readouterr().out
    assert bell not in parts()


def test_hashes_of_other_tasks_do_not_change(bell):
    """A run of other tasks keeps its identity, and the rules that it stores, when a task is registered."""
    assert tuple(one.task for one in rule_sets.get("paper", ["football"]).tasks) == tasks.OWN
    assert rule_sets.get("paper", [bell]).tasks[-1].task == bell
    with_bell = {name: rule_sets.get(name).hash_for(tasks.OWN) for name in rule_sets.names()}
    page = rule_sets.markdown()
    tasks.unregister(bell)
    assert with_bell == {name: rule_sets.get(name, ()).hash for name in rule_sets.names()}
    assert bell not in page and page == rule_sets.markdown()


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
    variants = tasks.get(bell).layer.parent / "variants"
    variants.mkdir()
    replaced = []
    for text in ("#usda 1.0\n", "#usda 1.0\n# other\n"):
        (variants / "semantic-2.usda").write_text(text, encoding="utf-8")
        replaced.append(foreign_task(tasks.get(bell), ("base", "semantic-2")))
    assert all(facts.items() > second[bell].items() for facts in replaced) and replaced[0] != replaced[1]
    monkeypatch.setattr("arena_newton.eval.records.identity.own_code", lambda part: "0123456789ab")
    assert identity(bell)["foreign_tasks"][bell]["code"] != first[bell]["code"]


def test_layers_of_held_out_looks_are_part_of_a_runs_identity(bell):
    """A layer that replaces the scene in a mode is hashed in runs of that mode alone."""

    def facts(*modes):
        options = RunOptions(task=(bell,), mode=modes, policy="stand", tracker=("pd",), engine="mujoco")
        return resolve(options).identity()["foreign_tasks"][bell]

    with pytest.raises(InputError, match="--mode semantic-2: task bell has no "):
        facts("semantic-2")
    layer = tasks.get(bell).layer.parent / "variants" / "semantic-2.usda"
    layer.parent.mkdir(exist_ok=True)
    shutil.copy(tasks.get(bell).layer, layer)
    base, first = facts("base"), facts("base", "semantic-2")
    assert first == base | {"layers": first["layers"]} and list(first["layers"]) == ["semantic-2"]
    layer.write_text(layer.read_text(encoding="utf-8") + "# heavier\n", encoding="utf-8")
    assert facts("semantic-2")["layers"] != first["layers"] and facts("base") == base


def test_an_object_is_not_called_as_the_dynamics(bell):
    """Samples of a task's objects and of an episode's dynamics share one record, so their names are kept apart."""
    spec = tasks.get(bell)
    taken = dataclasses.replace(tasks.get("football").objects[0], record="dynamics")
    with pytest.raises(InputError, match="task 'bell': object 'dynamics': the name is taken"):
        dataclasses.replace(spec, objects=(taken,))


def test_a_name_hides_no_layer_of_other_runs(bell):
    """A task of others that is called as a folder of the built-in scenes changes no identity of other runs."""
    before = resolve(RunOptions(task=("football",))).identity()
    tasks.register(dataclasses.replace(tasks.get(bell), name="textures"))
    try:
        assert resolve(RunOptions(task=("football",))).identity() == before
    finally:
        tasks.unregister("textures")


def test_a_record_that_lends_a_judge_is_part_of_a_runs_identity(bell):
    """A task of others whose judge and sampler are of this package is known by what its record says."""
    spec = dataclasses.replace(tasks.get("football"), scene=tasks.get(bell).layer)
    first, x = foreign_task(spec), spec.spawn_position[0] + 0.1
    assert set(first) == {"record", "scene"} and foreign_task(spec) == first
    moved = dataclasses.replace(spec, spawn_position=(x, *spec.spawn_position[1:]))
    assert foreign_task(moved)["record"] != first["record"] and foreign_task(tasks.get("football")) == {}


def test_success_that_nothing_decides_is_refused():
    """A judge without a condition of success, or whose success asks for success, would judge by nothing."""
    scene = SimpleNamespace(path="bell.usda")
    for success in ([], [Condition("margin")]):
        with pytest.raises(InputError, match=r"^bell\.usda: success needs conditions, and none of the kind margin"):
            ConditionsJudge(scene, (), {}, success)
    with pytest.raises(InputError, match=r"^bell\.usda: success for 0 ticks, expected at least 1"):
        ConditionsJudge(scene, (), {}, [Condition("upright", 0.5)], 0)


def test_names_that_are_taken_are_refused(bell):
    """A second task of the same name, and one without a scene, are refused in words."""
    with pytest.raises(InputError, match="'bell': the name is taken"):
        tasks.register(tasks.get(bell))
    with pytest.raises(InputError, match="'football': the name is taken"):
        tasks.register(tasks.get("football"))
    with pytest.raises(InputError, match="--task gong: unknown task; known are bell, boxing"):
        tasks.get("gong")


def test_all_are_the_papers(bell):
    """`all`, the default run and an average of the paper do not take in a task that was added."""
    for named in ((), ("all",)):
        assert (
            resolve(RunOptions(task=named, policy="stand", tracker=("pd",), engine="mujoco")).flags.task == tasks.PAPER
        )
    assert with_expert(()) == with_expert(("all",)) == (tasks.PAPER, ())
    assert bell in tasks.names() and bell not in stats.suites()["ALL_AVG"]


def test_a_record_without_what_others_have_is_refused(bell):
    """A task of another package names its scene, and with an interaction the prim to find."""
    spec = dataclasses.replace(tasks.get(bell), name="gong", interaction=tasks.get("boxing").interaction)
    with pytest.raises(InputError, match="task 'gong': `target` must name the prim to find"):
        tasks.register(spec)
    with pytest.raises(InputError, match="task 'gong': `scene` must name the layer"):
        tasks.register(dataclasses.replace(spec, scene=None))


BROKEN = {
    "gone": ("nowhere.at_all:TASK", "--task gone: its package does not load .ModuleNotFoundError: No module named"),
    "number": ("math:pi", "--task number: its package offers a float, not a task"),
    "renamed": ("arena_newton.tasks.boxing:TASK", "--task renamed: its package calls it boxing"),
}
"""Entry point → what it names, and what is said of it."""
RECORDER = "[arena_newton.recorders]\ngone = nowhere.at_all:Recorder\n"


def test_a_package_that_does_not_load_disturbs_no_other_task(tmp_path, monkeypatch):
    """A task or recorder that its package fails to give is refused by name; lists, rule sets, runs have all others."""
    rules, known = rule_sets.get("paper").hash, tasks.names()
    info = tmp_path / "broken-1.0.dist-info"
    info.mkdir()
    info.joinpath("METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    lines = [f"{name} = {target}\n" for name, (target, _) in BROKEN.items()]
    info.joinpath("entry_points.txt").write_text("[arena_newton.tasks]\n" + "".join(lines) + RECORDER)
    monkeypatch.syspath_prepend(tmp_path)
    assert {*tasks.names()} == {*known, *BROKEN} and tuple(spec.name for spec in tasks.specs()) == known
    assert rule_sets.get("paper").hash == rules
    for name, (_, said) in BROKEN.items():
        with pytest.raises(InputError, match=said):
            tasks.get(name)
    flags = "--policy stand --tracker pd --engine mujoco --seeds 0 --repeats 1 --max-steps 2 --out".split()
    assert eval_main(["run", "--task", "boxing", *flags, str(tmp_path / "run")]) == 0
    assert eval_main(["run", "--task", "boxing", "--recorder", "gone", *flags, str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists()
    found = [finding.value for finding in _scenes() if finding.status == "bad"]
    assert len(found) == len(BROKEN) and all(text.startswith("--task ") for text in found)


def test_a_task_of_a_package_is_known_everywhere(push_bin, capsys):
    """Installed, a task is listed, validated with its variants, has a Gym id and judges without a kernel of its own."""
    assert "push_bin" in tasks.names() and tasks.get("push_bin").layer == push_bin / "scene.usda"
    assert scenes_main(["list"]) == 0 and "push_bin     base, semantic " in capsys.readouterr().out
    for layer in ("scene.usda", "variants/semantic.usda"):
        assert task_of(push_bin / layer) == "push_bin" and validate(push_bin / layer) == []
    assert eval_main(["list", "--task", "push_bin", "--mode", "base", "semantic", "--json"]) == 0
    assert capsys.readouterr().out.count('"task": "push_bin"') == 120
    gym.register()
    assert "arena_newton/PushBin-v0" in gymnasium.registry
    del gymnasium.registry["arena_newton/PushBin-v0"]
    assert "push_bin" in rule_sets.markdown(["push_bin"]) and missing_rows(tasks.get("push_bin"), own=False) == []


def test_the_scene_of_a_package_is_what_its_builder_writes(push_bin, tmp_path):
    """Its layers are built again byte for byte in a folder far from this package, and name no path of a machine."""
    importlib.import_module("push_bin.build").build(tmp_path)
    for name in ("scene.usda", "variants/semantic.usda"):
        assert (tmp_path / name).read_bytes() == (ROOT / "examples" / "new_task" / "push_bin" / name).read_bytes()
        assert "@/" not in (tmp_path / name).read_text()


def test_the_expert_of_a_package_solves_its_task_and_resume_knows_the_package(push_bin, tmp_path, capsys):
    """Base and semantic mode are solved through twist2; a change of the scene or of the code is refused by name."""
    out = tmp_path / "run"
    flags = "--task push_bin --tracker twist2 --mode base semantic --seeds 900 --repeats 1 --engine mujoco".split()
    assert eval_main(["run", *flags, "--failures", "--out", str(out)]) == 0
    lines = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert [(line["mode"], line["outcome"]) for line in lines] == [("base", "success"), ("semantic", "success")]
    assert all(line["signals"]["first_pixels"] > 10 and line["signals"]["first_touch"] for line in lines)
    assert all(list(line["predicates"]) == ["approach", "contact", "transport", "rest"] for line in lines)
    for file, old, new in (("scene.usda", "mass = 10", "mass = 12"), ("expert.py", "PALMS = ((0.36", "PALMS = ((0.35")):
        text = (push_bin / file).read_text()
        assert old in text
        (push_bin / file).write_text(text.replace(old, new))
        capsys.readouterr()
        assert eval_main(["resume", str(out)]) == 2
        key = "scene" if file == "scene.usda" else "code"
        assert f"another configuration: foreign_tasks.push_bin.{key} was" in capsys.readouterr().err
        (push_bin / file).write_text(text)
    assert eval_main(["resume", str(out)]) == 0


def missing_rows(spec, own=True):
    """Rows that a task lacks, each with the file to edit."""
    name, rows = spec.name, {}
    record = f"arena_newton/tasks/{name}.py"
    rows[f"{record}: requires"] = spec.requires
    rows[f"{record}: predicates, more than success, of different names"] = len(spec.predicates) > 1 and len(
        {predicate.name for predicate in spec.predicates}
    ) == len(spec.predicates)
    rows[f"{record}: spawn_quat of length 1"] = abs(np.linalg.norm(spec.spawn_quat) - 1.0) < 1e-6
    rows[f"{record}: target, one of `requires` or above one"] = spec.target and any(
        f"{item.path}/".startswith(f"{spec.target}/") for item in spec.requires
    )
    rows[f"{record}: interaction"] = spec.interaction
    rows[f"{record}: interaction.predicate, one of `predicates`"] = spec.interaction and (
        spec.interaction.predicate in ("", *(predicate.name for predicate in spec.predicates[:-1]))
    )
    rows[f"{record}: semantic_change"] = spec.semantic_change
    module, _, attribute = (spec.expert or "").partition(":")
    rows[f"{record}: expert, a class whose `task` is its name"] = (
        spec.expert and getattr(importlib.import_module(module), attribute).task == name
    )
    rows[f"scene_builders/{name}.py: the scene is built"] = spec.layer.is_file()
    if own:
        rows |= {
            "arena_newton/tasks/__init__.py: OWN": name in tasks.OWN,
            f"scene_builders/{name}.py: build": (ROOT / "scene_builders" / f"{name}.py").is_file(),
            "docs/howto/bring/policies.md: table of instructions": f"| {spec.instruction} |"
            in page_of("howto/bring/policies"),
            "docs/reference/rules.md: python -m arena_newton.rule_sets": f"| {name} | {spec.predicates[0].name} |"
            in page_of("reference/rules"),
            "docs/howto/train/experts.md": name in page_of("howto/train/experts"),
        }
    return [row for row, there in rows.items() if not there]


def page_of(name):
    """Text of a page of the documentation."""
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def test_every_task_of_the_tree_has_each_row(bell):
    """No task lacks what failures, visibility, pages and experts read of it; one that lacks all is told all files."""
    lacking = {name: missing_rows(tasks.get(name)) for name in tasks.OWN}
    assert {name: rows for name, rows in lacking.items() if rows} == {}
    assert {spec.suite for spec in map(tasks.get, tasks.PAPER)} == {"HOI", "HSI"}
    files = {row.partition(":")[0] for row in missing_rows(tasks.get(bell))}
    assert files == {
        "arena_newton/tasks/__init__.py",
        "arena_newton/tasks/bell.py",
        "docs/howto/train/experts.md",
        "docs/howto/bring/policies.md",
        "docs/reference/rules.md",
        "scene_builders/bell.py",
    }
