"""Plans of `eval loop --plan`: what their tables say, what is refused, and the commands that are made of them."""

import subprocess
import sys
from dataclasses import replace

import pytest
from made_suites import cell_of, outcomes, write_suite

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.loop import plan_report
from arena_newton.eval.loop.loop_requirements import SHIPPED
from arena_newton.eval.loop.plan_commands import ALL_GPUS, PlanFolders, plan_commands
from arena_newton.eval.loop.plan_file import read_plan, suite_text
from arena_newton.eval.loop.plan_loop import commands_at_once, training_minutes
from arena_newton.eval.suites.matrix_cells import expand_cells
from arena_newton.eval.suites.suite_file import read_suite_file


def made(plan, out, **changes):
    """Commands of a plan by their names."""
    given = {"rows": [plan.rows[0]], "seeds": [1, 2, 3], "device": None, "gpus": 4, "minutes": lambda: 9.0}
    given |= {"middle": lambda suites: (2, suites)} | changes
    return {str(command): command for command in plan_commands(plan, PlanFolders(out), **given)}


def cells_of(plan, name, tmp_path):
    """Cells of a row's suite with three trainings."""
    (tmp_path / "suite.toml").write_text(suite_text(plan, plan.row(name), dict.fromkeys((1, 2, 3), tmp_path / "x")))
    return expand_cells(read_suite_file(tmp_path / "suite.toml"))


def test_the_generalist_plays_every_cell(tmp_path):
    """Three trainings on 14 pairs in seven modes; a network of one tracker is swapped in base mode alone."""
    plan = read_plan("generalist")
    cells = cells_of(plan, "all", tmp_path)
    assert len(cells) == 3 * 14 * 7 and {cell.episodes for cell in cells} == {60}
    assert {cell.policy for cell in cells} == {"all#1", "all#2", "all#3"}
    assert {(cell.tracker, cell.mode) for cell in cells_of(read_plan("ablation"), "sonic", tmp_path)} == {
        ("twist2", "base"),
        ("sonic", "base"),
    }
    cells = cells_of(read_plan("singles"), "boxing-sonic", tmp_path)
    assert {(cell.task, cell.tracker, cell.mode) for cell in cells} == {
        ("boxing", "twist2", "base"),
        *(("boxing", "sonic", mode) for mode in ("base", "execution", "visual", "semantic", "dynamics")),
    }
    swapped = [cell for cell in cells_of(read_plan("tiny"), "own", tmp_path) if cell.tracker not in cell.trained_on]
    assert {cell.mode for cell in swapped} == {"base"}


def test_a_row_of_one_task_and_tracker_has_its_demonstrations_alone(tmp_path):
    """Each of the fourteen is trained on its own dataset, which it waits for, and packed for its task."""
    plan = read_plan("singles")
    singles, merged = plan.rows[:-1], plan.rows[-1]
    assert {(row.tasks, row.trackers) for row in singles} == {
        ((task,), (tracker,)) for task in plan.attempts for tracker in plan.record.tracker
    }
    samples = {(row.tasks[0], row.trackers[0]): row.train.steps * row.train.batch_size for row in singles}
    assert merged.train.steps * merged.train.batch_size == sum(samples.values())
    weights = {task: float(weight) for task, weight in (one.split("=") for one in merged.train.task_weights)}
    assert {pair: 64_000 * weights[pair[0]] for pair in samples} == samples
    assert (set(merged.tasks), set(merged.trackers)) == (set(plan.attempts), set(plan.record.tracker))
    own = {"steps", "batch_size", "balance", "task_weights"}
    for row in singles:
        assert {k: v for k, v in vars(row.train).items() if k not in own} == {
            k: v for k, v in vars(merged.train).items() if k not in own
        }
    commands = made(plan, tmp_path, rows=[plan.row("boxing-sonic")], seeds=[1])
    training = commands["train boxing-sonic_1"]
    words = training.words()
    assert training.after == ("build boxing_sonic",)
    assert [name for name in commands if name.startswith(("record", "build"))] == [
        "record boxing_sonic",
        "build boxing_sonic",
    ]
    assert words[words.index("--dataset") + 1 : words.index("--recipe")] == [str(tmp_path / "datasets/boxing_sonic")]
    assert commands_at_once(plan, 1) == {"record": 18, "build": 8, "train": 4, "evaluate": 7}
    card = commands["card boxing-sonic"].words()
    assert card[card.index("--tasks") + 1 :] == ["boxing"]


def test_rows_of_wrists_differ_by_their_cameras():
    """One row sees through the head camera alone, and the sets of both have all that the other one sees through."""
    plan = read_plan("wrists")
    front, wrists = plan.rows
    assert (front.train.cameras, wrists.train.cameras) == (("front",), plan.record.cameras)
    assert replace(wrists.train, cameras=("front",)) == front.train and len(plan.record.cameras) == 3


def test_rows_differ_by_what_they_are_named_after():
    """Each row differs from its plan's first by what its name says; those of the tracker have no changed looks."""
    looks = {"looks", "look_changes"}
    bold = looks | {"task_weights"}
    rows = {"bold": bold, "tuned": bold | {"start_from", "lr"}}
    ablation = {"none": looks | {"recipe_values"}, "augmentation": looks}
    ablation |= dict.fromkeys(("shapes", "light"), {"look_changes"}) | dict.fromkeys(
        ("plain-02", "plain-06"), {"looks"}
    )
    ablation |= dict.fromkeys(("told", "twist2", "sonic"), looks | {"steps", "batch_size"})
    ablation |= {"untold": looks | {"steps", "batch_size", "tracker_vector"}}
    for name, expected in {"generalist": rows, "ablation": ablation}.items():
        first, *others = read_plan(name).rows
        assert expected == {
            row.name: {key for key, value in vars(row.train).items() if value != getattr(first.train, key)}
            for row in others
        }


def test_the_ablation_has_the_demonstrations_and_the_recipe_of_the_generalist():
    """Its first row is the generalist's on fewer tasks, in smaller steps; singles has the demonstrations of all."""
    ablation, plan = read_plan("ablation"), read_plan("generalist")
    assert ablation.record == plan.record and ablation.attempts.items() <= plan.attempts.items()
    singles = read_plan("singles")
    assert (replace(singles.record, looks=1), singles.attempts, singles.parts) == (
        plan.record,
        plan.attempts,
        plan.parts,
    )
    mine, theirs = (vars(one.rows[0].train) for one in (ablation, plan))
    differ = {key for key in mine if mine[key] != theirs[key]}
    assert differ == {"steps", "lr", "batch_size", "hold_out_every", "looks", "task_weights"}


def test_commands_are_those_of_the_house(tmp_path):
    """Sets, datasets, trainings, suite, tables and card, each after those that it needs, the largest first."""
    plan = read_plan("generalist")
    commands = made(plan, tmp_path)
    stages = [command.stage for command in commands.values()]
    assert {stage: stages.count(stage) for stage in stages} == {
        **{"record": 18, "build": 14, "train": 3},
        **{"evaluate": 1, "tables": 1, "card": 1},
    }
    one = commands["record double_desk_sonic_2"]
    text = " ".join(one.words())
    assert text.startswith("arena_newton.eval record --task double_desk --tracker sonic ")
    assert "--episodes 130" in text and "--worlds 65" in text and "--shard 2/2" in text and "--looks 1" in text
    assert one.size == 130 * 2000 / 2
    assert commands["build double_desk_sonic"].after == ("record double_desk_sonic_1", "record double_desk_sonic_2")
    train = commands["train all_2"]
    text = " ".join(train.words())
    assert text.count(str(tmp_path / "datasets")) == 14 == len(train.after) and train.gpus == 2
    assert "--minutes 9.0" in text and "--seed 2" in text and "--looks 0.6 double_desk=0.3" in text
    assert commands["evaluate all"].after == ("train all_1", "train all_2", "train all_3")
    (tmp_path / "evaluation").mkdir()
    assert commands["evaluate all"].words()[-2:] == ["--jobs", "56"]
    assert commands["card all"].words()[:3] == ["arena_newton.eval", "pack", str(tmp_path / "trainings/all_2")]
    assert not any(command.done() for command in commands.values())


def test_what_is_there_is_continued(tmp_path):
    """A recording by `eval resume`, a training by --resume; one without a checkpoint begins again."""
    commands = made(read_plan("generalist"), tmp_path, gpus=1)
    sets = tmp_path / "demonstrations" / "boxing_twist2"
    sets.mkdir(parents=True)
    (sets / "config.json").write_text("{}")
    assert list(commands["record boxing_twist2"].words()) == ["arena_newton.eval", "resume", str(sets)]
    training = tmp_path / "trainings" / "all_1"
    training.mkdir(parents=True)
    (training / "half").touch()
    assert "--resume" not in commands["train all_1"].words() and not training.exists()
    (training / "checkpoints" / "last").mkdir(parents=True)
    words = commands["train all_1"].words()
    assert words[1:3] == ["--resume", str(training)] and "--minutes" not in words


def test_several_gpus_train_one_network(tmp_path):
    """By torchrun where the plan gives a training several, as many as there are; on one GPU or none in one process."""
    plan = read_plan("generalist")
    for gpus, taken in ((4, 2), (2, 2), (1, 1), (0, 1)):
        train = made(plan, tmp_path, gpus=gpus)["train all_1"]
        words = list(train.words())
        begins = ["torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m"] if taken == 2 else []
        assert train.gpus == taken and words[: len(begins) + 1] == [*begins, "arena_newton.policies.train"]
        assert words[words.index("--batch-size") + 1] == "128"
        assert made(plan, tmp_path, gpus=gpus)["evaluate all"].gpus == ALL_GPUS


def test_trainings_side_by_side_divide_the_cores(tmp_path, monkeypatch):
    """Pictures are decoded by a part of the cores for each training that runs at once, on its GPUs or on others."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(16)))
    for plan, gpus, jobs in (("generalist", 2, "8"), ("ablation", 2, "2"), ("ablation", 0, "5")):
        words = list(made(read_plan(plan), tmp_path, gpus=gpus)["train all_1"].words())
        assert words[words.index("--jobs") + 1] == jobs


def test_trainings_have_the_time_that_recording_leaves(tmp_path):
    """Equal parts of it, by waves of those that run at once; too little is refused."""
    plan = read_plan("generalist")
    line = '{{"stage": "{}", "name": "a", "began": {}, "ended": {}, "code": 0}}\n'
    (tmp_path / "commands.jsonl").write_text(line.format("record", 0, 180) + line.format("build", 120, 240))
    assert training_minutes(plan, None, tmp_path, 3, 4) == 12.0
    assert training_minutes(plan, 24.0, tmp_path, 3, 6) == 24.0 - 6.5 - 4.0
    assert training_minutes(plan, 24.0, tmp_path, 3, 2) == 4.5
    assert training_minutes(plan, 24.0, tmp_path, 2, 4) == 13.5
    shared = replace(plan, settings=replace(plan.settings, trainings=2))  # two of them share two GPUs
    assert training_minutes(shared, 24.0, tmp_path, 4, 4) == 13.5
    with pytest.raises(InputError, match="^--minutes 9: recording and building took 4.0, nothing is left to train in"):
        training_minutes(plan, 9.0, tmp_path, 3, 6)
    with (tmp_path / "commands.jsonl").open("a") as file:
        file.write(line.format("train", 250, 310).replace('"code": 0', '"code": -9'))
    assert training_minutes(plan, 24.0, tmp_path, 2, 4) == 12.5  # what a killed one took is gone


BAD = [
    ("seeds = [1, 2]", "seeds = [0]", "[plan]: seeds are 0, expected numbers 1 to 9999"),
    ("recordings = 2", 'recordings = "two"', '[plan]: recordings is "two", expected int'),
    ("looks = 1", "lokks = 1", "[record]: --lokks: unknown argument, did you mean --looks?"),
    ("looks = 1", "", "[[rows]] all: changes looks, and [record] has no looks"),
    ("looks = 1", "looks = 1\nout = 'a'", "[record]: out is given by the plan, leave it out"),
    ("boxing = 2", "boxing = 0", "[attempts]: boxing is 0, expected a number from 1"),
    ("boxing = 2", "chess = 2", "[record]: --task chess"),
    ("[parts]\nvis_navi", "[parts]\nfootball", "[parts]: football is none of [attempts], boxing vis_navi"),
    ('recipe = "small"', 'recipe = "fast"', "[[rows]] all: recipe act/fast takes 224x224, and [record] has size 64x64"),
    ('balance = "task"', 'balance = "all"', "[[rows]] all: --balance all: unknown"),
    ('name = "own"', 'name = "all"', "[[rows]] all: expected a name of its own"),
    ('trackers = ["twist2"]', 'trackers = ["pd"]', "[[rows]] own: trackers are pd, known are twist2 sonic"),
    ('trackers = ["twist2"]', "tasks = []", "[[rows]] own: tasks are none, known are boxing vis_navi"),
    ('trackers = ["twist2"]', 'tasks = ["chess"]', "[[rows]] own: tasks are chess, known are boxing vis_navi"),
    (
        'balance = "task"',
        'balance = "task"\ntask_weights = ["chess=2"]',
        "[[rows]] all: task_weights names chess, and its",
    ),
    ('looks = ["0.5"]', 'looks = ["0.5", "football=0.1"]', "[[rows]] all: looks names football, and its tasks are "),
    ('recipe = "small"', 'recipe = "small"\nstart_from = "/nowhere"', "[[rows]] all: --start-from /nowhere: no such"),
    ("repeats = 2", "repeats = 0", "[evaluate]: [defaults]: --repeats 0"),
    ("repeats = 2", "chunks = 2", "[evaluate]: [defaults]: chunks is unknown"),
    ("seeds = [1, 2]", "seeds = [1, 1]", "[plan]: seeds are 1 1, expected each once"),
    ("recordings = 2", "recordings = 0", "[plan]: recordings is 0, expected at least 1"),
    ("recordings = 2", "recordings = 2\nreserve = -1", "[plan]: reserve is -1"),
    ("[parts]\nvis_navi = 2", "[parts]\nvis_navi = 3", "[parts]: vis_navi has 3 parts of 2 attempts"),
    ("base = [0.9, 0.96]", 'base = "high"', '[bars]: base is "high", expected one or two rates from 0 to 1'),
    ("base = [0.9, 0.96]", "bass = 0.9", "[bars]: bass is no mode that is played"),
    ("[bars]", "[best.sonic]\nchess = 0.5\n[bars]", "[best]: chess is none of the plan's trackers and tasks"),
    ("[bars]", "[best]\ntwist2 = 0.5\n[bars]", "twist2 is 0.5, expected a table [twist2]"),
    ('trackers = ["twist2"]', 'trackers = [["twist2"]]', "[[rows]] own: trackers are "),
    ("[bars]", "[bar]", "bar is unknown, known are name plan record"),
]


@pytest.mark.parametrize(("old", "new", "says"), BAD)
def test_an_unfit_plan_is_one_error(tmp_path, capsys, old, new, says):
    """It names the file and the table, the code is 2, and no folder is made."""
    text = (SHIPPED / "tiny.toml").read_text()
    assert old in text
    (tmp_path / "mine.toml").write_text(text.replace(old, new))
    assert main(["loop", "--plan", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path}/mine.toml: {says}") and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--plan", "mine"], "--plan mine: no such file; the package brings the plans ablation generalist singles"),
        (["--plan", "."], "--plan .: is a folder, expected a file; the package brings the plans ablation generalist"),
        (["--plan", "tiny", "--seeds", "1", "1"], "--seeds 1: given twice"),
        (["--plan", "tiny", "--only", "train", "train"], "--only train: given twice"),
        (["--plan", "tiny", "--task", "boxing"], "--task: belongs to a loop without --plan, whose file says it"),
        (["--plan", "tiny", "--rows", "chess"], "--rows chess: "),
        (["--plan", "tiny", "--only", "play"], "--only play: unknown, choose from record build train"),
        (["--plan", "tiny", "--minutes", "6"], "--minutes 6: 6 are kept for decoding, evaluation and tables"),
        (["--seeds", "1"], "--seeds: belongs to --plan, which is not given"),
    ],
)
def test_unfit_flags_of_a_plan_are_refused(tmp_path, capsys, flags, says):
    """One line that names the flag, code 2, and no folder."""
    assert main(["loop", *flags, "--out", str(tmp_path / "out")]) == 2
    assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_wrong_name_is_refused_at_once():
    """Before torch is loaded, which takes seconds."""
    code = "import sys\nfrom arena_newton.eval.__main__ import main\nprint(main(sys.argv[1:]), 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code, "loop", "--plan", "nope"], capture_output=True, text=True)
    assert done.stdout == "2 False\n" and done.stderr.startswith("error: --plan nope: no such file"), done.stderr


def test_a_folder_is_of_one_plan(tmp_path, capsys):
    """A stage without those before it, another plan, and a folder of something else are refused."""
    flags = ["loop", "--plan", "tiny", "--device", "cpu", "--out", str(tmp_path / "out")]
    assert main([*flags, "--only", "train"]) == 2
    assert "--only train: train all_1 needs build boxing_twist2, which is not done" in capsys.readouterr().err
    flags[2] = "generalist"
    assert main(flags) == 2 and "was begun with another plan" in capsys.readouterr().err
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "file").touch()
    flags[-1] = str(tmp_path / "else")
    assert main(flags) == 2 and "is not empty and holds no plan" in capsys.readouterr().err


def test_the_page_has_the_middle_of_the_trainings_and_their_bars(tmp_path):
    """All successes are printed, bars are held by the training in the middle, missed ones are named by cell."""
    plan = read_plan("generalist")
    folders = PlanFolders(tmp_path)
    cells = []
    for seed, won in ((1, 60), (2, 50), (3, 57)):
        for tracker, less in (("twist2", 0), ("sonic", 7)):
            for mode in ("base", "visual", "dynamics"):
                cell = cell_of(f"all#{seed}", "act", tracker, "boxing", trained_on=("twist2", "sonic"), mode=mode)
                cells.append((cell, outcomes(won - less)))
    write_suite(folders.suite(plan.rows[0]), cells)
    assert plan_report.middle_training(folders.suites(plan.rows[0])) == (3, [folders.suite(plan.rows[0])])
    said = plan_report.write(plan, folders, [], "a command")
    assert "all: base: 107 of 120 (113 93 107) missed" in said and "all: visual: 107 of 120 (113 93 107) missed" in said
    assert "all: under its bar: boxing sonic base: 50 of 60, bar 54" in said
    assert "all: dynamics: 107 of 120 (113 93 107)" in said  # no bar, no verdict
    assert not any("visual: 50" in line or "dynamics: 50" in line or "twist2" in line for line in said)
    assert made(plan, tmp_path)["card all"].words()[3:5] == ["--out", str(tmp_path / "packed" / "all")]
    assert made(plan, tmp_path, rows=[plan.row("bold")])["card bold"].words()[2] == str(tmp_path / "trainings/bold_2")
    page = (tmp_path / "plan.md").read_text()
    assert "| boxing | twist2 | 60 50 57 | 60 50 57 | 60 50 57 |" in page and "Seeds of its trainings: 1 2 3." in page


def test_trainings_of_several_machines_have_one_page(tmp_path):
    """Suites that were put beside a row's own count with it: for its page, its tables, the middle one and its card."""
    plan = read_plan("generalist")
    folders, row = PlanFolders(tmp_path), plan.rows[0]
    assert folders.suites(row) == []
    for name, won in (("all", {1: 40, 2: 50}), ("all@2", {3: 45}), ("none@2", {1: 9})):
        policies = {f"{name.partition('@')[0]}#{seed}": successes for seed, successes in won.items()}
        cells = [
            (cell_of(policy, "act", "twist2", "boxing", trained_on=("twist2",)), outcomes(successes))
            for policy, successes in policies.items()
        ]
        write_suite(tmp_path / "evaluation" / name, cells)
    suites = folders.suites(row)
    assert [suite.name for suite in suites] == ["all", "all@2"]
    assert plan_report.middle_training(suites) == (3, suites[:1])
    commands = made(plan, tmp_path, middle=plan_report.middle_training)
    assert commands["evaluate all"].done() and not made(plan, tmp_path, seeds=[1, 4])["evaluate all"].done()
    assert commands["tables"].words()[2:4] == [str(suite) for suite in suites]
    words = commands["card all"].words()
    assert words[2] == str(tmp_path / "trainings" / "all_3")
    assert words[words.index("--results") :] == ["--results", *map(str, suites), "--trainings", str(suites[0])]
    assert "all: base: 45 of 60 (40 50 45) missed" in plan_report.write(plan, folders, [], "a command")
