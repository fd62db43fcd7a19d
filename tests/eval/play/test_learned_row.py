"""The policy that ships: its run after the default one, its flags, and its card with results."""

import contextlib
import dataclasses
import io
import json
import re
import shutil

import pytest
from eval_fakes import FakePolicy, factories

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.run_folder import stored_options
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play import run
from arena_newton.files.untrusted_files import file_digest
from arena_newton.policies.learned import act_network, learned_card
from arena_newton.policies.learned.learned_card import read_card
from tests.made_packed import checkpoint, packed

pytestmark = pytest.mark.usefixtures("narrow")


@pytest.fixture
def wide(monkeypatch, narrow):
    """Vision encoders have all channels, as in the policy that ships."""
    monkeypatch.setattr(act_network, "WIDTHS", narrow)


@pytest.fixture(scope="module")
def folder(narrow, tmp_path_factory):
    """A packed policy for VisNavi and Boxing through both trackers."""
    return packed(tmp_path_factory.mktemp("learned") / "policy", ("vis_navi", "boxing"), trackers=("sonic", "twist2"))


def ship(patch, folder):
    """Let a folder come with the package."""
    patch.setattr(learned_card, "SHIPPED", folder)
    patch.setattr(run, "_recorder", lambda *_: None)  # these worlds have nothing to draw
    return folder


@pytest.fixture
def shipped(folder, monkeypatch):
    """The policy comes with the package."""
    return ship(monkeypatch, folder)


@pytest.fixture
def absent(tmp_path, monkeypatch):
    """No policy comes with the package."""
    ship(monkeypatch, tmp_path / "nowhere")


@pytest.fixture(scope="module")
def default_run(folder, tmp_path_factory):
    """Folder of a default run, and what it printed."""
    out = tmp_path_factory.mktemp("default") / "out"
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        ship(patch, folder)
        assert main(["--device", "cpu", "--out", str(out)], stand_ins()) == 0
    return out, printed.getvalue()


def stand_ins(**changes):
    """Worlds and experts that are none; the learned policy is the real one."""

    def policy(spec, **options):
        return policies.get(spec, **options) if spec.startswith("learned") else FakePolicy(spec, **options)

    return factories(policy=policy, **changes)


def rows(text):
    """Cells of the last table of a text: task, tracker, policy, mode, episodes."""
    found = re.findall(r"^\| (\w+) +\| (\w+) +\| (\S+) +\| (\w+) +\| +(\d+) \|", text, re.M)
    return [row for row in found if row[0].islower()]


def test_the_default_run_has_a_row_that_sees(default_run, shipped, capsys):
    """Experts' table, then that of the learned policy: all its tasks, the default tracker, in a folder inside."""
    out, printed = default_run
    tables = printed.split("| task ")
    assert len(tables) == 3 and {row[2] for row in rows(tables[1])} == {"expert"}
    assert rows(tables[2]) == [(task, "twist2", "learned", "base", "3") for task in read_card(shipped).tasks]
    last = f"report of the experts: {out}/report.html, of the policy that sees: {out}/learned/report.html"
    assert printed.splitlines()[-1] == last
    for folder, shown in ((out, tables[1]), (out / "learned", tables[2])):
        assert rows((folder / "table.md").read_text()) == rows(shown) == rows((folder / "report.md").read_text())
        assert main(["resume", str(folder)], stand_ins()) == 0
        again = capsys.readouterr().out
        assert "all finished" in again and rows(again) == rows(shown)
    results = json.loads((out / "learned" / "results.json").read_text())
    assert results["config"]["policy_facts"]["weights"] == read_card(shipped).weights and results["complete"]


def test_a_run_names_the_trackers_of_its_training(shipped, tmp_path, capsys):
    """Through another tracker a trained policy says which it knows, besides that `pd` cannot balance."""
    flags = ["--task", "vis_navi", "--policy", "learned", "--seeds", "0", "--repeats", "1", "--device", "cpu"]
    assert main([*flags, "--tracker", "twist2", "pd", "--out", str(tmp_path / "both")], stand_ins()) == 0
    said = capsys.readouterr().out
    assert (
        "policy learned was trained through sonic twist2, and is played through pd\n" in said
        and "cannot balance" in said
    )
    assert main([*flags, "--tracker", "twist2", "--out", str(tmp_path / "one")], stand_ins()) == 0
    assert "was trained through" not in capsys.readouterr().out


def test_a_learned_run_that_was_interrupted_is_resumed(shipped, tmp_path, capsys, monkeypatch):
    """Ctrl-C in the second run keeps the experts' report; the second goes on by its own resume."""
    act = FakePolicy.act

    def interrupted(self, observation):
        if self.name == "learned":
            raise KeyboardInterrupt
        return act(self, observation)

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(FakePolicy, "act", interrupted)
        assert main(["--device", "cpu", "--out", str(out)], factories()) == 130
    printed = capsys.readouterr().out
    assert rows(printed)[0][2] == "expert" and f"resume {out / 'learned'}" in printed
    assert main(["resume", str(out / "learned")], factories()) == 0
    assert rows(capsys.readouterr().out)[-1][2] == "learned"


def test_folders_of_earlier_versions_keep_their_flags(default_run, tmp_path):
    """A flag that was stored and is none any more is left out when the run goes on."""
    out = shutil.copytree(default_run[0], tmp_path / "out")
    document = json.loads((out / "config.json").read_text())
    document["options"]["seeing"] = True
    (out / "config.json").write_text(json.dumps(document))
    assert stored_options(out).out == str(out)


@pytest.mark.parametrize(
    "flags", [["--task", "vis_navi"], ["--repeats", "2"], ["--policy", "stand"], ["--tracker", "pd"]]
)
def test_other_runs_have_no_such_row(shipped, flags, tmp_path):
    """A run that says what it wants, or whose trackers the policy does not know, has the experts' rows alone."""
    assert main([*flags, "--device", "cpu", "--out", str(tmp_path / "o")], stand_ins()) == 0
    assert not (tmp_path / "o" / "learned").exists()


def test_without_weights_the_default_run_goes_on(absent, tmp_path, capsys):
    """A build without such a policy plays the experts alone; naming it is one clear error."""
    assert main(["--device", "cpu", "--out", str(tmp_path / "out")], stand_ins()) == 0
    assert {row[2] for row in rows(capsys.readouterr().out)} == {"expert"}
    for flags in (["list", "--policy", "learned"], ["--policy", "learned", "--task", "boxing", "--out", "x"]):
        assert main(flags) == 2
        assert "--policy learned: no policy comes with this build; learned:<folder> takes" in capsys.readouterr().err
    with pytest.raises(InputError, match="no policy comes with this build"):
        policies.get("learned")


def test_it_plays_the_tasks_of_its_card(shipped, folder, tmp_path, capsys):
    """Without --task these are all of its card; another task is one error that names them; a folder may be named."""
    for more in ({}, {"repeats": 1}, {"mode": ("visual",)}, {"seeds": (1,), "shard": "1/3"}):
        played = {episode.task for episode in resolve(RunOptions(policy="learned", **more)).episodes}
        assert played == {"vis_navi", "boxing"}
    assert main(["list", "--policy", "learned", "--task", "boxing", "football"]) == 2
    assert "--policy learned: does vis_navi, boxing (card.md says how well), not football" in capsys.readouterr().err
    short = ["--task", "boxing", "--repeats", "1", "--seeds", "0", "--device", "cpu", "--engine", "mujoco"]
    assert main([*short, "--policy", f"learned:{folder}", "--out", str(tmp_path / "a")], stand_ins()) == 0
    config = json.loads((tmp_path / "a" / "config.json").read_text())["config"]
    assert config["policy"] == f"learned:{folder.name}" and config["labels"] == "v4"
    for flag in (["--replan", "2"], ["--ensemble"]):
        assert main([*short, "--policy", "learned", *flag]) == 2
        assert "belongs to --policy lerobot" in capsys.readouterr().err
    for bad in ("learned:", f"learned:{tmp_path / 'none'}"):
        assert main([*short, "--policy", bad]) == 2
        assert "--policy learned" in capsys.readouterr().err


def test_pack_reads_what_the_policy_reached(tmp_path, capsys):
    """`eval pack` offers the tasks that the results show as solved, best first, and writes all cells into the card."""
    made, out = checkpoint(tmp_path / "made"), tmp_path / "packed"
    assert main(["pack", str(made), "--out", str(out)]) == 0
    assert read_card(out).tasks == ("boxing", "vis_navi") and not read_card(out).results
    digest = read_card(out).weights
    played = ["--policy", f"learned:{out}", "--task", "boxing", "vis_navi", "--mode", "base", "visual"]
    played += ["--seeds", "0", "--repeats", "4", "--device", "cpu", "--engine", "mujoco"]
    assert main([*played, "--out", str(tmp_path / "played")], stand_ins()) == 0
    cells = json.loads((tmp_path / "played" / "results.json").read_text())["cells"]
    solved = [cell["task"] for cell in cells if cell["mode"] == "base" and cell["sr"] >= 0.75]
    capsys.readouterr()
    code = main(["pack", str(made), "--out", str(out), "--results", str(tmp_path / "played")])
    error = capsys.readouterr().err
    assert (code, bool(error)) == ((0, False) if solved else (2, True))
    assert solved or "--tasks: none is solved at 75 %" in error
    command = ["pack", str(made), "--out", str(out), "--results", str(tmp_path / "played"), "--tasks", "vis_navi"]
    assert main([*command, "--note", "Made for a test."]) == 0
    card = read_card(out)
    assert card.tasks == ("vis_navi",) and card.weights == digest and len(card.results) == 4
    for one in card.results:
        cell = next(c for c in cells if (c["task"], c["mode"]) == (one.task, one.mode))
        assert (one.successes, one.falls, one.episodes) == (cell["successes"], cell["falls"], 4)
    page = (out / "card.md").read_text()
    assert "Made for a test." in page and page.count("| boxing | twist2 |") == 2
    assert main(["pack", str(out), "--out", str(out), "--tasks", "boxing"]) == 0
    again = read_card(out)
    assert (again.note, set(again.results), again.tasks) == ("Made for a test.", set(card.results), ("boxing",))
    assert [(one.task, one.mode) for one in again.results][:2] == [("boxing", "base"), ("boxing", "visual")]
    assert again.packed_by.startswith(card.packed_by + "; then python -m arena_newton.eval pack packed --tasks")
    assert main(["pack", str(out), "--out", str(out)]) == 0
    assert read_card(out).tasks == ("boxing",), "without new results a policy stays offered for what it was"
    other = checkpoint(tmp_path / "other", tasks=("vis_navi", "boxing"))
    capsys.readouterr()
    weights = (other / "model.safetensors").read_bytes()
    (other / "model.safetensors").write_bytes(weights[:-4] + b"\x00\x00\x00\x00")
    assert main(["pack", str(other), "--out", str(tmp_path / "p"), "--results", str(tmp_path / "played")]) == 2
    assert "no cell of this checkpoint" in capsys.readouterr().err and not (tmp_path / "p").exists()


def test_pack_names_the_flag_or_the_checkpoint_of_an_unknown_task(tmp_path, capsys):
    """An unknown task is `--tasks`, as it was typed, or else the checkpoint's own; nothing is written."""
    made, foreign = checkpoint(tmp_path / "made"), checkpoint(tmp_path / "foreign", tasks=("chess",))
    out = ["--out", str(tmp_path / "packed")]
    assert main(["pack", str(made), *out, "--tasks", "nope"]) == 2
    assert "error: --tasks nope: unknown, choose from football, " in capsys.readouterr().err
    assert main(["pack", str(foreign), *out]) == 2
    assert f"error: {foreign}: was trained on chess, a task that is not known" in capsys.readouterr().err
    assert not (tmp_path / "packed").exists()


def won(line):
    """The journal line of an episode as if it had succeeded when it ended."""
    record = json.loads(line)
    record |= {
        "outcome": "success",
        "reason": "success",
        "margin": 0.0,
        "progress": 1.0,
        "startup_fall": False,
        "events": [],
    }
    if record.get("predicates"):
        record["predicates"] |= {list(record["predicates"])[-1]: record["steps"]}
    return json.dumps(record) + "\n"


@pytest.fixture(scope="module")
def evaluated(narrow, tmp_path_factory):
    """A checkpoint of two trackers, `made`, and runs of its packed form through one of them."""
    root = tmp_path_factory.mktemp("evaluated")
    made = checkpoint(root / "made", trackers=("twist2", "sonic"))
    assert main(["pack", str(made), "--out", str(root / "packed")]) == 0
    flags = ["--policy", f"learned:{root / 'packed'}", "--device", "cpu", "--engine", "mujoco"]
    flags += ["--seeds", "0", "--repeats", "4", "--task", "boxing"]
    for name, more in {"whole": [], "shard": ["--shard", "1/2"], "capped": ["--max-steps", "50"]}.items():
        assert main([*flags, *more, "--out", str(root / name)], stand_ins()) == 0
    lines = (root / "whole" / "episodes.jsonl").read_text().splitlines(keepends=True)
    for name, kept in {
        "half": [line for line in lines if '"success"' in line],
        "won": [won(line) for line in lines],
    }.items():
        (root / name).mkdir()
        (root / name / "config.json").write_bytes((root / "whole" / "config.json").read_bytes())
        (root / name / "episodes.jsonl").write_text("".join(kept))
    assert main([*flags, "--rules", "released", "--out", str(root / "released")], stand_ins()) == 0
    return root


@pytest.mark.parametrize(
    ("results", "said"),
    [
        (["half"], "half: is unfinished (2 of 4 episodes), and what ends first is no fair sample"),
        (["shard"], "shard: is shard 1/2 of a run; name the folder into which eval merge joins all"),
        (["capped"], "capped: was played with --max-steps, which makes it no result of the benchmark"),
        (["won"], "--tasks: none is solved at 75 %"),  # its demonstrations are of two trackers
    ],
)
def test_pack_takes_results_alone(evaluated, results, said, tmp_path, capsys):
    """A part of a run or one under conditions of its own is none, and one tracker of two is not every tracker."""
    folders = [str(evaluated / name) for name in results]
    assert main(["pack", str(evaluated / "made"), "--out", str(tmp_path / "p"), "--results", *folders]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1, error
    assert not (tmp_path / "p").exists()


def test_pack_says_what_it_leaves_out(evaluated, tmp_path, capsys, monkeypatch):
    """Episodes under other rules do not count, and are named; the card names a checkpoint given as `.`."""
    monkeypatch.chdir(evaluated / "made")
    folders = [str(evaluated / name) for name in ("whole", "released")]
    command = ["pack", ".", "--out", str(tmp_path / "p"), "--results", *folders, "--tasks", "boxing"]
    assert main(command) == 0
    assert "4 episodes under the rules released left out." in capsys.readouterr().out
    card = read_card(tmp_path / "p")
    assert card.packed_by == "python -m arena_newton.eval pack made --tasks boxing --results whole released"
    assert [(one.task, one.episodes) for one in card.results] == [("boxing", 4)]


def test_a_policy_is_packed_again_with_more_results(evaluated, tmp_path, capsys):
    """Cells of its card stay beside those that come anew, and tasks follow from all of them."""
    won, out = evaluated / "won", tmp_path / "again"
    assert main(["pack", str(evaluated / "made"), "--out", str(out), "--results", str(won), "--tasks", "boxing"]) == 0
    card = json.loads((out / "card.json").read_text())
    other = {"task": "vis_navi", "mode": "base", "episodes": 4, "successes": 1, "falls": 0}
    card["results"] += [other | {"tracker": tracker} for tracker in ("sonic", "twist2")]
    card["results"] += [
        card["results"][0] | {"tracker": "sonic", "successes": 3},
        other | {"tracker": "x", "mode": "?"},
    ]
    (out / "card.json").write_text(json.dumps(card))
    assert main(["pack", str(out), "--out", str(out), "--results", str(evaluated / "whole")]) == 2
    assert "none is solved" in capsys.readouterr().err
    assert main(["pack", str(out), "--out", str(out)]) == 0
    cells = [(one.task, one.tracker, one.mode, one.successes) for one in read_card(out).results]
    boxing = [("boxing", "sonic", "base", 3), ("boxing", "twist2", "base", 4)]
    assert sorted(cells) == boxing + sorted(
        ("vis_navi", name, mode, 1) for name, mode in (("sonic", "base"), ("twist2", "base"), ("x", "?"))
    )
    assert read_card(out).tasks == ("boxing",)


def test_other_trainings_are_in_the_card(evaluated, tmp_path, capsys):
    """Successes of trainings of the same recipe are next to each cell and each sum; another recipe is refused."""
    flags = ["--device", "cpu", "--engine", "mujoco", "--seeds", "0", "--repeats", "4", "--task", "boxing"]
    for name, said in {"again": {"seed": 7}, "small": {"recipe": "small"}}.items():
        made = checkpoint(tmp_path / f"{name}_made", trackers=("twist2", "sonic"), **said)
        weights = (made / "model.safetensors").read_bytes()
        (made / "model.safetensors").write_bytes(weights[:-4] + bytes(4))
        assert main(["pack", str(made), "--out", str(tmp_path / f"{name}_packed")]) == 0
        played = ["--policy", f"learned:{tmp_path / f'{name}_packed'}", "--out", str(tmp_path / name)]
        assert main([*flags, *played], stand_ins()) == 0
    out, command = tmp_path / "p", ["pack", str(evaluated / "made"), "--out", str(tmp_path / "p"), "--tasks", "boxing"]
    command += ["--results", str(evaluated / "whole"), "--trainings"]
    for folder, said in {tmp_path / "small": "is of another recipe", evaluated / "whole": "no cell of another"}.items():
        capsys.readouterr()
        assert main([*command, str(folder)]) == 2
        assert f"--trainings {folder}: {said}" in capsys.readouterr().err and not out.exists()
    assert main([*command, str(tmp_path / "again")]) == 0
    card, page = read_card(out), (out / "card.md").read_text()
    (other,) = card.trainings
    won = json.loads((tmp_path / "again" / "results.json").read_text())["cells"][0]["successes"]
    assert (other.seed, [one.successes for one in other.results]) == (7, [won])
    assert other.weights == read_card(tmp_path / "again_packed").weights and f"seed 7 (weights {other.weights})" in page
    assert len(re.findall(rf"^\| (?:base|boxing \| twist2 \| base) \| \d/4 \|.* \| {won} \|$", page, re.M)) == 2
    assert main(["pack", str(out), "--out", str(out), "--tasks", "boxing"]) == 0
    assert read_card(out).trainings == card.trainings

    ours, config = tmp_path / "ours", json.loads((tmp_path / "again" / "config.json").read_text())
    shutil.copytree(evaluated / "made", ours)
    facts = json.loads((ours / "arena_policy.json").read_text())
    (ours / "arena_policy.json").write_text(json.dumps(facts | {"datasets": [{"name": "boxing", "hash": "1"}]}))
    command[1] = str(ours)
    for name, code in {"boxing": 0, "vis_navi": 2}.items():  # recorded again, and of another task
        config["config"]["policy_facts"] |= {"datasets": [{"name": name, "hash": "2"}]}
        (tmp_path / "again" / "config.json").write_text(json.dumps(config))
        assert main([*command, str(tmp_path / "again")]) == code
    assert "is of another datasets" in capsys.readouterr().err
    assert [one.recorded_again for one in (*read_card(out).trainings, other)] == [True, False]
    assert "demonstrations recorded again)" in (out / "card.md").read_text()


def test_results_of_a_checkpoint_are_those_of_its_packed_form(tmp_path):
    """One that was packed before it was played is packed again with the results of the checkpoint itself."""
    made, out = checkpoint(tmp_path / "made"), tmp_path / "packed"
    assert main(["pack", str(made), "--out", str(out)]) == 0
    assert (trained := read_card(out).trained_weights) == file_digest(made / "model.safetensors", 1 << 30)
    assert main(["pack", str(out), "--out", str(tmp_path / "again")]) == 0
    assert read_card(tmp_path / "again").trained_weights == trained != read_card(out).weights
    flags = ["--device", "cpu", "--engine", "mujoco", "--seeds", "0", "--repeats", "2", "--task", "boxing"]
    assert main([*flags, "--policy", f"learned:{out}", "--out", str(tmp_path / "r")], stand_ins()) == 0
    config = json.loads((tmp_path / "r" / "config.json").read_text())
    config["config"]["policy_facts"]["weights"] = trained  # as if `lerobot:` had played the checkpoint
    (tmp_path / "r" / "config.json").write_text(json.dumps(config))
    assert main(["pack", str(out), "--out", str(out), "--results", str(tmp_path / "r"), "--tasks", "boxing"]) == 0
    assert [(one.task, one.episodes) for one in read_card(out).results] == [("boxing", 2)]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["pack"], "pack: name the checkpoint"),
        (["pack", "nowhere"], "pack nowhere: no such folder"),
        (["pack", "."], "holds no checkpoint"),
        (["pack", ".", "--out", ""], "--out: is empty, name a folder"),
    ],
)
def test_pack_refuses_what_is_no_checkpoint(arguments, said, tmp_path, monkeypatch, capsys):
    """One line, exit code 2."""
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tasks", []),
        ("tasks", "boxing"),
        ("steps", "4"),
        ("gpu_minutes", True),
        ("results", [{"task": "boxing"}]),
        ("results", [dict(task="a", tracker="b", mode="base", episodes=2, successes=3, falls=0)]),
        ("datasets", [1]),
        ("format", 2),
    ],
)
def test_a_damaged_card_is_one_error(folder, tmp_path, field, value):
    """The message names the file and the field."""
    card = json.loads((folder / "card.json").read_text())
    (tmp_path / "card.json").write_text(json.dumps(card | {field: value}))
    with pytest.raises(InputError, match=rf"card\.json: .*{field}") as error:
        read_card(tmp_path)
    assert "\n" not in str(error.value)


def test_what_ships_can_be_packed_again(tmp_path, wide):
    """Packing the policy in the package gives the same files, and a card that says no less."""
    card = learned_card.shipped_card()
    if card is None:
        pytest.skip("no policy comes with this build")
    assert main(["pack", str(learned_card.SHIPPED), "--out", str(tmp_path / "p")]) == 0
    again = read_card(tmp_path / "p")
    assert dataclasses.replace(again, packed_by="", bytes=0) == dataclasses.replace(card, packed_by="", bytes=0)
    for name in ("model.safetensors", "config.json", "arena_policy.json"):
        assert (tmp_path / "p" / name).read_bytes() == (learned_card.SHIPPED / name).read_bytes(), name
    assert card.bytes == sum(p.stat().st_size for p in learned_card.SHIPPED.iterdir() if p.stem != "card")


def test_what_ships_fits(wide):
    """The policy in the package is whole, at most 32 MB, solves what it is offered for; its page is its card."""
    card = learned_card.shipped_card()
    if card is None:
        pytest.skip("no policy comes with this build")
    assert sum(path.stat().st_size for path in learned_card.SHIPPED.iterdir()) <= 32_000_000
    assert policies.get("learned").describe()["weights"] == card.weights
    assert (learned_card.SHIPPED / "card.md").read_text() == card.to_markdown()
    base = {(one.task, one.tracker): one.rate for one in card.results if one.mode == "base"}
    assert card.trackers and all(base[task, tracker] >= 0.75 for task in card.tasks for tracker in card.trackers)
    assert card.command and card.gpu_minutes > 0 and card.datasets and all(one["hash"] for one in card.datasets)
