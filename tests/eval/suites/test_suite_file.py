"""Suite files and suite.json that are wrong: one error each that names file, table and key, before anything runs."""

import dataclasses
import json
import random

import pytest

from arena_newton.data.readers.label_protocols import LABELS
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.suites.matrix_cells import check_policies, expand_cells
from arena_newton.eval.suites.suite_file import SHIPPED, read_suite_file, suite_path
from arena_newton.eval.suites.suite_records import (
    CellEvent,
    SuiteCell,
    SuitePlan,
    event_line,
    journal_file,
    read_suite,
    suite_json,
)
from arena_newton.policies.base import POLICIES
from arena_newton.policies.chunk_flags import LABELS as KNOWN_LABELS
from arena_newton.policies.learned.learned_card import SHIPPED as SHIPPED_POLICY
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from tests.fuzz.mutants import damaged

START = '[matrix]\ntasks = "boxing"\ntrackers = ["twist2", "sonic"]\n[[policies]]\nname = "a"\nspec = "stand"\n'


def read(tmp_path, text):
    """The cells of a suite file with this text."""
    path = tmp_path / "s.toml"
    path.write_text(text)
    return expand_cells(read_suite_file(path))


def test_labels_are_those_of_the_product():
    """Labels that a flag or a suite may name are the label protocols."""
    assert set(KNOWN_LABELS) == set(LABELS)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"has no table \[\[policies\]\]"),
        ("policies = 3", r"policies is 3, expected tables \[\[policies\]\]"),
        ("x = [", "not readable as TOML"),
        ("x = " + "[" * 5000, "not readable as TOML"),
        (START + "colour = 1", r"\[\[policies\]\] 1: colour is not an option, known are name spec"),
        ("colour = 1\n" + START, "colour is unknown, known are name defaults matrix checkpoints policies cells"),
        ("name = 1979-05-27\n" + START, "name: 1979-05-27 is neither text nor number"),
        ("[defaults]\nseeds = nan\n" + START, "number out of range"),
        (
            f"[defaults]\nseeds = {[*range(1001)]}\n" + START,
            r"defaults: seeds: has 1,001 entries, expected at most 1,000",
        ),
        (START + START[START.index("[[") :] * 1000, "policies: has 1,001 entries, expected at most 1,000"),
        ('name = "../x"\n' + START, 'name is "../x", expected letters'),
        (
            START.replace('"a"', '"a#0"'),
            'name is "a#0", expected letters, digits, _ - and [+]; #2 at the end for a second',
        ),
        (START.replace("boxing", "bxing"), r"\[matrix\]: tasks: bxing is unknown, known are football"),
        (START.replace('["twist2", "sonic"]', '"twist3"'), r"\[matrix\]: trackers: --tracker twist3: unknown tracker"),
        (START.replace('["twist2", "sonic"]', "[]"), r"\[matrix\]: trackers is empty"),
        (START.replace('["twist2", "sonic"]', '["sonic", "sonic"]'), "trackers: sonic: given twice"),
        (START.replace('["twist2", "sonic"]', "3"), r"\[matrix\]: trackers is \[3\], expected tuple"),
        (START + 'modes = "dark"', r"policies\]\] a: modes: dark is unknown, known are base"),
        (START + 'modes = "visual"', r"policies\]\] a: modes: visual is not in \[matrix\], which has base"),
        (START.replace('"stand"', '"stnd"'), "unknown policy; known are"),
        (START.replace('"stand"', '"lerobot:{tsk}"'), r"\{tsk\} is unknown, known are \{task\} and \{tracker\}"),
        (START.replace('"stand"', '"lerobot:{task"'), "has a brace without its pair"),
        (START.replace('"stand"', '"lerobot:{tracker}"'), "name the trackers of its demonstrations in trained_on"),
        (START.replace('"stand"', '""'), 'spec is "", expected what --policy takes'),
        (START.replace('"a"', '"a.b"'), 'name is "a.b", expected letters'),
        (START + START[START.index("[[") :], "name a: given twice"),
        (START + 'labels = "v5"', 'labels is "v5", known are v3.1 v4'),
        (START + "replan = 0", "replan is 0, expected at least 1"),
        (START + 'replan = "all"', 'replan is "all", expected int'),
        (START + 'trained_tasks = "boxing"', "trained_tasks: belongs to trained_on"),
        (
            START + 'trained_on = "sonic"\ntrained_tasks = "sit_sofa"',
            "is played on boxing, which is not in trained_tasks",
        ),
        (START.replace('tasks = "boxing"', 'tasks = "boxing"\nlatency = -1'), "latency is -1, expected 0 to 1000"),
        (START.replace('tasks = "boxing"', 'tasks = "boxing"\nrules = "mine"'), "rules: --rules mine: unknown"),
        ("[defaults]\nrepeats = 0\n" + START, r"\[defaults\]: --repeats 0: expected at least 1"),
        ('[defaults]\nout = "x"\n' + START, r"\[defaults\]: out is unknown, known are seeds"),
        ('[defaults]\nworlds = "many"\n' + START, r'\[defaults\]: worlds is "many", expected int'),
        ('[checkpoints]\nfalc = "x"\n' + START, r"\[checkpoints\]: falc: --tracker falc: unknown tracker"),
        (START + "[[cells]]\nexclude = {}", r"\[\[cells\]\] 1: exclude is {}, expected a table"),
        (START + "[[cells]]\nexclude = {task = 'boxing'}\ninclude = {}", "expected either include"),
        (START + "[[cells]]\nexclude = {tsk = 'boxing'}", r"\[\[cells\]\] 1: exclude: tsk is unknown"),
        (
            START + "[[cells]]\nexclude = {task = 'sit_sofa'}",
            r"exclude: task sit_sofa: no cell has it, known are boxing",
        ),
        (
            START + "[[cells]]\nexclude = {tracker = 'sonic', policy = 'a', matched = true}",
            "matched true: no cell has it",
        ),
        (START + "[[cells]]\nexclude = {task = 'boxing'}", r"\[\[cells\]\] leave no cell"),
    ],
)
def test_a_wrong_file_is_one_error(tmp_path, text, said):
    """Each wrong table, key or value is named with the file."""
    with pytest.raises(InputError, match=said) as caught:
        cells = read(tmp_path, text)
        check_policies(read_suite_file(tmp_path / "s.toml"), cells)
    assert str(caught.value).startswith(f"{tmp_path / 's.toml'}: ")


def test_a_mark_of_byte_order_is_no_error(tmp_path):
    """A suite file that an editor of Windows wrote is read as one without its leading mark."""
    assert read(tmp_path, "\ufeff" + START) == read(tmp_path, START)


def test_rules_are_taken_in_order(tmp_path):
    """The last of several rules that fit a cell decides."""
    rules = (
        "[[cells]]\nexclude = { tracker = 'sonic' }\n[[cells]]\ninclude = { mode = 'visual', tracker = ['sonic'] }\n"
    )
    text = START.replace('tasks = "boxing"', 'tasks = "boxing"\nmodes = ["base", "visual"]') + rules
    assert [cell.id for cell in read(tmp_path, text)] == [
        "a/twist2/boxing/base",
        "a/twist2/boxing/visual",
        "a/sonic/boxing/visual",
    ]


def test_conditions_are_in_the_id(tmp_path):
    """Rules and latency that are not the usual ones are in a cell's id, so that adding one renames no cell."""
    text = START.replace('tasks = "boxing"', 'tasks = "boxing"\nrules = ["paper", "released"]\nlatency = [0, 5]')
    assert [cell.id for cell in read(tmp_path, text) if cell.tracker == "sonic"] == [
        "a/sonic/boxing/base",
        "a/sonic/boxing/base.latency5",
        "a/sonic/boxing/base.released",
        "a/sonic/boxing/base.released.latency5",
    ]


def test_trainings_of_one_recipe_have_numbers(tmp_path):
    """A name may end in the number of the training, which is in the id and so in the folder of its cells."""
    cells = read(tmp_path, START.replace('"a"', '"a#2"'))
    assert [cell.folder for cell in cells] == ["a#2/twist2/boxing/base", "a#2/sonic/boxing/base"]


LEARNED = """[matrix]
tasks = ["boxing", "vis_navi"]
trackers = ["twist2", "sonic"]
latency = [0, 5, 20]
[[policies]]
name = "act"
spec = "lerobot:{at}/act_{{task}}_{{tracker}}"
trained_on = ["twist2", "sonic"]
latency = 0
[[policies]]
name = "both"
spec = "lerobot:{at}/both"
trained_on = ["twist2", "sonic"]
"""


@pytest.fixture
def checkpoints(tmp_path, monkeypatch):
    """Folders of five checkpoints, and the suite file that names them."""
    monkeypatch.setitem(POLICIES.built_in, "lerobot", "arena_newton.policies.stand:from_spec")
    facts = {
        f"act_{task}_{tracker}": CheckpointFacts(labels="v4", family="act", tasks=(task,), trackers=(tracker,))
        for task in ("boxing", "vis_navi")
        for tracker in ("twist2", "sonic")
    }
    facts["both"] = CheckpointFacts(family="flow", tasks=("boxing", "vis_navi"), trackers=("twist2", "sonic"))
    for name, said in facts.items():
        folder = tmp_path / name / "checkpoints/last/pretrained_model"
        folder.mkdir(parents=True)
        (folder / "config.json").write_text('{"n_action_steps": 20, "horizon": 40}')
        (folder / "model.safetensors").write_bytes(b"")
        said.write(folder)
    path = tmp_path / "learned.toml"
    path.write_text(LEARNED.format(at=tmp_path))
    return path


def learned(path):
    """The cells of a suite file, held to their checkpoints; without latency where its last entry says none."""
    if "latency" not in path.read_text().split("[[policies]]")[-1]:
        path.write_text(path.read_text() + "\nlatency = 0\n")
    suite = read_suite_file(path)
    return check_policies(suite, expand_cells(suite))


def test_one_entry_names_a_checkpoint_per_task_and_tracker(checkpoints):
    """A pattern makes a cell of each checkpoint and executing tracker; family and labels are the checkpoints' own."""
    cells = {cell.id: cell for cell in learned(checkpoints)}
    assert len(cells) == 2 * 2 * (2 + 1)
    swapped = cells["act.twist2/sonic/boxing/base"]
    assert swapped.spec.endswith("/act_boxing_twist2") and swapped.matched is False and not swapped.merged
    assert (swapped.family, swapped.labels, swapped.trained_tasks) == ("act", "v4", ("boxing",))
    joint = cells["both.twist2+sonic/sonic/vis_navi/base"]
    assert joint.matched and joint.merged and joint.trained_tasks == ("boxing", "vis_navi")
    assert (joint.family, joint.labels) == ("flow", "v3.1")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: s.replace("/both", "/none"), r"both: spec lerobot:.*none: no such folder"),
        (
            lambda s: s.replace("/act_", "/dp_"),
            r"dp_boxing_twist2: no such folder \(the same or another fault in 3 more\)",
        ),
        (lambda s: s + 'labels = "v4"', r"both: labels is v4, but checkpoint .*both says v3.1"),
        (lambda s: s + 'family = "act"', "family is act, but checkpoint .* says flow"),
        (
            lambda s: s + 'trained_tasks = ["boxing", "vis_navi", "football"]',
            "trained_tasks is boxing vis_navi football",
        ),
        (lambda s: s.replace("{task}_", "boxing_"), r"trained on boxing, cell act.twist2/twist2/vis_navi/base plays"),
        (lambda s: s + "latency = 20", "cell both.*latency20: latency is 20 ticks, 20 actions of each chunk"),
        (lambda s: s + "replan = 41", "replan is 41, the checkpoint predicts 40 actions"),
        (lambda s: s + "ensemble = true\nlatency = 5", "latency is 5 ticks, 1 actions of each chunk are executed"),
        (lambda s: s + "replan = 5\nlatency = 5", "latency is 5 ticks, 5 actions of each chunk are executed"),
        (
            lambda s: s[: s.rindex("trained_on")] + 'trained_on = "sonic"',
            "trained_on is sonic, but checkpoint .* says twist2 sonic",
        ),
    ],
)
def test_checkpoints_are_looked_at_first(checkpoints, change, said):
    """An absent checkpoint, or one that was trained on something else than the file says, is refused by name."""
    checkpoints.write_text(change(checkpoints.read_text()))
    with pytest.raises(InputError, match=said):
        learned(checkpoints)


def test_a_dry_run_shows_what_is_absent(checkpoints, tmp_path, capsys):
    """A dry run prints the matrix, then what is absent, with code 2; --only asks for its own cells' alone."""
    (tmp_path / "both").rename(tmp_path / "moved")
    checkpoints.write_text(checkpoints.read_text() + "latency = 0\n")
    command = ["matrix", str(checkpoints), "--dry-run", "--out", str(tmp_path / "out")]
    assert main(command) == 2
    said = capsys.readouterr()
    assert "12 cells" in said.out and "both: no such folder" in said.err
    assert main([*command, "--only", "policy=act"]) == 0


def test_a_checkpoint_without_weights_is_refused(checkpoints, tmp_path):
    """A folder with a configuration alone is no checkpoint."""
    (tmp_path / "both/checkpoints/last/pretrained_model/model.safetensors").unlink()
    with pytest.raises(InputError, match="holds no weights"):
        learned(checkpoints)


def test_packed_policies_say_what_they_are_too(checkpoints, tmp_path):
    """`learned`, and `learned:<folder>`, count as trained: family, labels, trackers and tasks are from their facts."""
    packed = tmp_path / "both/checkpoints/last/pretrained_model"
    for spec in ("learned", f"learned:{packed}"):
        facts = CheckpointFacts.read(SHIPPED_POLICY if spec == "learned" else packed)
        text = f'[matrix]\ntasks = ["vis_navi"]\n[[policies]]\nname = "one"\nspec = "{spec}"\n'
        checkpoints.write_text(text)
        (cell,) = learned(checkpoints)
        assert (cell.family, cell.labels, cell.trained_on) == (facts.family, facts.labels, facts.trackers)
        assert "vis_navi" in cell.trained_tasks and cell.trained_tasks == facts.tasks
    checkpoints.write_text(text.replace("vis_navi", "sit_sofa"))
    with pytest.raises(
        InputError, match=r"was trained on boxing vis_navi, cell one/twist2/sit_sofa/base plays sit_sofa"
    ):
        learned(checkpoints)


def test_suites_are_found_by_name(tmp_path):
    """A suite of the package has a name; of an absent file the message says which there are."""
    assert suite_path("tiny") == SHIPPED / "tiny.toml"
    for given in ("none", str(tmp_path / "x.toml"), "../tiny"):
        with pytest.raises(InputError, match="the package brings the suites paper tiny"):
            suite_path(given)


def test_damaged_suite_files_are_refused_or_read(tmp_path, mutants):
    """Each damaged suite file is read, or refused with an error that names it."""
    rng, path = random.Random(5), tmp_path / "m.toml"
    sound = START.encode() + b"replan = 4\n[[cells]]\nexclude = { tracker = 'sonic' }\n[defaults]\nseeds = [0, 1]\n"
    refused = 0
    for _ in range(mutants):
        path.write_bytes(damaged(sound, rng, text=True))
        try:
            expand_cells(read_suite_file(path))
        except InputError as error:
            assert str(path) in str(error)
            refused += 1
    assert mutants / 4 < refused <= mutants


@pytest.fixture
def written(tmp_path):
    """A suite's folder with two cells, one of them done."""
    cell = SuiteCell(
        id="a.sonic/twist2/boxing/base",
        policy="a",
        family="act",
        spec="lerobot:x",
        trained_on=("sonic",),
        trained_tasks=("boxing",),
        tracker="twist2",
        task="boxing",
        mode="base",
        rules="paper",
        labels="v3.1",
        folder="a.sonic/twist2/boxing/base",
        episodes=60,
        ticks=90_000,
    )
    other = dataclasses.replace(cell, id="b/twist2/boxing/base", folder="b/twist2/boxing/base")
    plan = SuitePlan(tmp_path, "s", "s.toml", "0" * 12, (cell, other))
    (tmp_path / "suite.json").write_text(json.dumps(suite_json(plan)))
    at = "2026-01-01T00:00:0{}.000+00:00".format
    lines = [
        CellEvent(cell=cell.id, event="begun", at=at(0), device="NVIDIA H200"),
        CellEvent(cell=cell.id, event="interrupted", at=at(1), wall_s=2.0, finished=20, successes=3),
        CellEvent(cell=cell.id, event="done", at=at(2), wall_s=3.5, finished=60, successes=44, device="NVIDIA H200"),
    ]
    (tmp_path / journal_file(2, 4)).write_bytes(b"".join(map(event_line, lines)))
    return tmp_path


def test_a_suite_says_how_far_its_cells_are(written):
    """Status and counts are the last event's, times add up, and what was reopened counts no more."""
    done, waiting = read_suite(written).cells
    assert (done.status, done.finished, done.successes, done.wall_s) == ("done", 60, 44, 5.5)
    assert (done.device, done.matched) == ("NVIDIA H200", False)
    assert (waiting.status, waiting.finished) == ("waiting", 0)
    line = event_line(CellEvent(cell=done.id, event="reopened", at="2026-01-02T00:00:00.000+00:00"))
    (written / journal_file(1, 4)).write_bytes(line)
    assert read_suite(written).cells[0] == dataclasses.replace(done, **_blank())


def _blank():
    """Fields of a cell of which nothing was played."""
    return {"status": "waiting", "finished": 0, "successes": 0, "wall_s": 0.0, "device": ""}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"schema": 2}, "schema 2 was written by a newer version"),
        ({"schema": "1"}, 'schema is "1"'),
        ({"cells": 3}, "cells is 3, expected a list"),
        ({"folder": "../x"}, r"cells\[0\]: folder is \"../x\", expected a path below"),
        ({"folder": "/x"}, "expected a path below"),
        ({"folder": "a/./b"}, "expected a path below"),
        ({"task": "none"}, 'task is "none", known are'),
        ({"episodes": 0}, "episodes is 0"),
        ({"trained_on": "sonic"}, "trained_on is"),
        ({"id": "b/twist2/boxing/base"}, "is listed twice"),
    ],
)
def test_a_damaged_suite_is_refused(written, change, said):
    """A value of suite.json that does not fit is named with file and cell."""
    path = written / "suite.json"
    content = json.loads(path.read_text())
    for key, value in change.items():
        (content if key in content else content["cells"][0])[key] = value
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=said):
        read_suite(written)


def test_damaged_records_are_refused_or_read(written, mutants):
    """Each damaged plan and each damaged journal is read, or refused with an error that names it."""
    rng, refused = random.Random(6), 0
    for path in (written / "suite.json", written / journal_file(2, 4)):
        sound = path.read_bytes()
        for _ in range(mutants):
            path.write_bytes(damaged(sound, rng, text=True))
            try:
                read_suite(written)
            except InputError as error:
                assert str(path) in str(error)
                refused += 1
        path.write_bytes(sound)
    assert 2 * mutants / 3 < refused < 2 * mutants
