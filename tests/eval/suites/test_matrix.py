"""A suite: every cell checked before the first is played, one plan that continues after any end, shards, changes."""

import json
import os
import re
import signal
import subprocess

import pytest
from eval_fakes import FakeEnv, FakePolicy, factories
from made_folders import SUITE, WIDE, journals

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders import joined_folders
from arena_newton.eval.suites import suite_run
from arena_newton.eval.suites.matrix_cells import dealt, expand_cells, parse_only, run_options, selected
from arena_newton.eval.suites.suite_file import SHIPPED, read_suite_file
from arena_newton.eval.suites.suite_records import load_cell, read_events, read_suite
from tests.children import Child
from tests.patience import PLENTY, wait_for


@pytest.fixture
def wide(tmp_path):
    """Path of the wide suite's file."""
    path = tmp_path / "wide.toml"
    path.write_text(WIDE)
    return path


@pytest.fixture
def suite(tmp_path):
    """Path of the suite file."""
    path = tmp_path / "small.toml"
    path.write_text(SUITE)
    return path


def call(suite, out, *flags, **changes):
    """Exit code of `eval matrix`."""
    return main(["matrix", str(suite), "--out", str(out), *flags], factories(**changes))


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Folder of a suite that nothing disturbed."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "small.toml").write_text(SUITE)
    assert call(folder / "small.toml", folder / "out") == 0
    return folder / "out"


def test_every_cell_is_an_ordinary_results_folder(played):
    """Each cell has its folder with what suite.json says of it, and nothing is left to play."""
    plan = read_suite(played)
    assert len(plan.cells) == 6 == len({cell.folder for cell in plan.cells})
    for cell in plan.cells:
        run = load_cell(plan, cell)
        wins = sum(record.outcome == "success" for record in run.records)
        assert (cell.status, cell.finished, cell.successes) == ("done", 4, wins)
        assert len(run.records) == cell.episodes == 4 and cell.wall_s > 0 and cell.device == "cpu"
    expected = {f"still/twist2/{task}/base" for task in ("boxing", "football")}
    assert {cell.id for cell in plan.cells if cell.policy == "still"} == expected


def test_a_cell_is_what_eval_run_plays(played, tmp_path):
    """A cell's episodes are those of the same flags of `eval run`, and `eval resume` takes its folder."""
    flags = "--task boxing --tracker twist2 --mode visual --seeds 0 1 --repeats 2 --engine mujoco --policy expert"
    out = tmp_path / "x" / "expert" / "twist2" / "boxing" / "visual"
    assert main(["run", *flags.split(), "--out", str(out)], factories()) == 0
    ((_, alone),) = journals(tmp_path / "x").items()
    assert alone == journals(played)["expert/twist2/boxing/visual"]
    assert main(["resume", str(played / "expert/twist2/boxing/visual")], factories()) == 0


def test_cells_of_one_environment_follow_each_other(played):
    """Policies of one task, tracker and mode are played one after the other."""
    keys = [(cell.task, cell.tracker, cell.mode) for cell in read_suite(played).cells]
    assert keys == sorted(keys, key=keys.index)


def test_a_finished_suite_plays_nothing(played, suite, capsys):
    """The same command on a finished suite builds no world and ends with 0."""

    def no_env(task, **options):
        raise AssertionError("built a world")

    before = (played / "suite.1-of-1.jsonl").read_bytes()
    assert call(suite, played, env=no_env) == 0
    assert "6 of 6 cells done" in capsys.readouterr().out
    assert (played / "suite.1-of-1.jsonl").read_bytes() == before


def start(suite, out, *flags, hangs="expert stand", shard="1-of-1", begins="begun"):
    """The command line in a process of its own whose policies hang, once the suite's journal holds a text."""
    process = Child("eval_fakes", ["matrix", str(suite), "--out", str(out), *flags], FAKE_HANGS=hangs)
    path = out / f"suite.{shard}.jsonl"
    wait_for(lambda: path.exists() and begins in path.read_text() or process.poll() is not None, "cell that is played")
    assert process.poll() is None, process.communicate()
    return process


def test_kill_and_again_gives_the_same_episodes(suite, played, tmp_path):
    """`kill -9` within a cell, with a torn last line, then the same command: every cell equals the undisturbed one."""
    out = tmp_path / "killed"
    process = start(suite, out, hangs="stand", begins='"cell":"still/twist2/boxing/base","event":"begun"')
    process.send_signal(signal.SIGKILL)
    process.communicate()
    with (out / "suite.1-of-1.jsonl").open("ab") as file:
        file.write(b'{"schema":1,"cell":"exp')
    states = {cell.id: cell.status for cell in read_suite(out).cells}
    assert states["expert/twist2/boxing/base"] == "done" and states["still/twist2/boxing/base"] == "started"
    assert call(suite, out) == 0
    assert journals(out) == journals(played)
    events = [event.event for event in read_events(out) if event.cell == "still/twist2/boxing/base"]
    assert events == ["begun", "killed", "begun", "done"]
    assert sum(event.cell == "expert/twist2/boxing/base" for event in read_events(out)) == 2, "was played again"


def test_interrupt_says_how_to_go_on(suite, tmp_path, capsys):
    """Ctrl-C ends with code 130 and prints the command that continues; a second process is refused meanwhile."""
    out = tmp_path / "with space"
    process = start(suite, out, "--only", "task=boxing")
    assert call(suite, out) == 2
    assert "another process plays this suite" in capsys.readouterr().err
    process.send_signal(signal.SIGINT)
    output, complaint = process.communicate(timeout=PLENTY)
    assert process.returncode == 130, complaint
    assert f"--out '{out}' --only task=boxing" in output and "0 of 3 cells done" in output
    assert "Traceback" not in complaint
    assert read_suite(out).cells[0].status == "started"


def test_an_interrupt_as_a_cell_begins_says_it_too(suite, tmp_path, capsys, monkeypatch):
    """Ctrl-C after a cell was named and before anything of it is played."""
    monkeypatch.setattr(suite_run.CellPlayer, "begun", lambda *_: signal.raise_signal(signal.SIGINT))
    assert call(suite, tmp_path / "out") == 130
    assert "cells done; continue with: python -m arena_newton.eval matrix" in capsys.readouterr().out


class Killed(BaseException):
    """Stands for `kill -9`: nothing is written after it."""


@pytest.mark.parametrize("moment", [1, 2, 4, 7, 16, 29])
def test_a_kill_at_any_moment_loses_nothing(suite, played, tmp_path, monkeypatch, moment):
    """The process dies at its n-th write to the disk: what was journalled is whole, the same command completes it."""
    out, only = tmp_path / "out", ("--only", "task=boxing policy=still,expert mode=base")
    writes = 0

    def dying(file):
        nonlocal writes
        writes += 1
        if writes >= moment:
            raise Killed

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "fsync", dying)
        call(suite, out, *only)
    if (out / "suite.json").exists():
        done = [cell for cell in read_suite(out).cells if cell.status == "done"]
        assert all(len(load_cell(read_suite(out), cell).records) == 4 for cell in done)
    assert call(suite, out, *only) == 0
    assert journals(out) == {name: journals(played)[name] for name in journals(out)} and len(journals(out)) == 2


def test_files_are_with_their_cells(suite, played, tmp_path, monkeypatch):
    """Files are in the folder of their own mode, and none is left elsewhere by Ctrl-C before its line was written."""

    def actions(out):
        return {path.relative_to(out).as_posix() for path in out.glob("expert/twist2/boxing/**/*.npz")}

    def interrupt(written, to):
        assert written.is_file()
        strips = written.parents[1] / "strips"
        strips.mkdir()
        for mode in ("base", "visual"):
            (strips / f"boxing__{mode}__seed0__repeat0__ego.jpg").touch()  # as a run with --strip writes them first
        raise KeyboardInterrupt

    out, only = tmp_path / "out", ("--only", "task=boxing policy=expert")
    with monkeypatch.context() as patch:
        patch.setattr(joined_folders, "_move", interrupt)
        assert call(suite, out, *only) == 130
    assert {path.split("/")[3] for path in actions(out)} == {"base"} and not list(out.rglob("*_visual_*"))
    assert len(list(out.rglob("*__base__*.jpg"))) == 1
    assert call(suite, out, *only) == 0
    assert actions(out) == actions(played) and len(actions(out)) == 8


def test_limit_and_only_play_their_cells(suite, tmp_path, capsys):
    """--limit counts cells that are played in this call; --only narrows them; the rest waits."""
    out = tmp_path / "out"
    assert call(suite, out, "--only", "policy=expert", "--limit", "1") == 0
    assert call(suite, out, "--only", "policy=expert", "--limit", "2") == 0
    done = [cell for cell in read_suite(out).cells if cell.status == "done"]
    assert len(done) == 3 and {cell.policy for cell in done} == {"expert"}
    assert "3 of 4 cells done" in capsys.readouterr().out


@pytest.mark.parametrize("shards", [2, 5])
def test_shards_are_the_suite(wide, shards):
    """Shards have every cell once and cells of every task, and sizes that differ by one at most."""
    cells = expand_cells(read_suite_file(wide))
    parts = [dealt(cells, shard + 1, shards) for shard in range(shards)]
    assert sorted(cell.id for part in parts for cell in part) == sorted(cell.id for cell in cells)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert all({cell.task for cell in part} == {"boxing", "football"} for part in parts)
    assert dealt(list(reversed(cells)), 1, shards) == list(reversed(parts[0])), "the order of the file decides"


def test_shards_of_two_folders_merge_by_copying(suite, played, tmp_path):
    """Two shards, played into folders of their own and copied into one, are the suite that one call played."""
    for shard in ("1/2", "2/2"):
        assert call(suite, tmp_path / shard[0], "--shard", shard) == 0
    assert {cell.status for cell in read_suite(tmp_path / "1").cells} == {"done", "waiting"}
    subprocess.run(["cp", "-r", f"{tmp_path}/2/.", str(tmp_path / "1")], check=True)
    assert {cell.status for cell in read_suite(tmp_path / "1").cells} == {"done"}
    assert journals(tmp_path / "1") == journals(played)


def test_shards_share_a_folder(suite, tmp_path):
    """A shard plays next to another one in the same folder; the same shard, another count or all cells do not."""
    out = tmp_path / "out"
    process = start(suite, out, "--shard", "1/2", shard="1-of-2")
    try:
        for flags in ((), ("--shard", "1/2"), ("--shard", "1/3")):
            assert call(suite, out, *flags) == 2, flags
        assert call(suite, out, "--shard", "2/2", "--limit", "1") == 0
    finally:
        process.kill()
        process.communicate()
    assert [cell.status for cell in read_suite(out).cells].count("done") == 1


def edited(suite, old, new):
    """Change the suite file."""
    text = suite.read_text()
    assert old in text
    suite.write_text(text.replace(old, new))


def test_changed_conditions_are_refused_or_played_again(suite, tmp_path, capsys):
    """Another number of repeats is refused with cell and key; --accept-changes plays again and keeps the old files."""
    out = tmp_path / "out"
    assert call(suite, out, "--limit", "2") == 0
    first = journals(out)
    edited(suite, "repeats = 2", "repeats = 1")
    assert call(suite, out) == 2
    said = capsys.readouterr().err
    assert "2 cells hold results of other conditions" in said and "repeats was 2, now 1" in said
    assert journals(out) == first
    assert call(suite, out, "--accept-changes", "--limit", "2") == 0
    assert {len(lines) for lines in journals(out).values()} == {2}
    aside = {
        path.parent.relative_to(out / ".replaced").as_posix() for path in (out / ".replaced").rglob("episodes.jsonl")
    }
    assert aside == {f"{name}.1" for name in first}


def test_cells_with_the_same_conditions_are_kept(suite, tmp_path):
    """A policy that is added, and an order that is changed, leave what was played."""
    out = tmp_path / "out"
    assert call(suite, out, "--limit", "3") == 0
    events = len(read_events(out))
    edited(suite, 'tasks = ["boxing", "football"]', 'tasks = ["football", "boxing"]')
    suite.write_text(suite.read_text() + '[[policies]]\nname = "more"\nspec = "stand"\n')
    assert call(suite, out, "--only", "task=boxing policy=expert,still") == 0
    assert len(read_events(out)) == events
    assert len(read_suite(out).cells) == 6 + 4


def test_played_cells_do_not_leave_unnoticed(suite, tmp_path, capsys):
    """A suite file that no longer has a played cell is refused; accepted, the cell leaves suite.json."""
    out = tmp_path / "out"
    assert call(suite, out, "--limit", "1") == 0
    edited(suite, 'tasks = ["boxing", "football"]', 'tasks = ["football"]')
    assert call(suite, out) == 2
    assert "1 played cell that" in capsys.readouterr().err
    assert call(suite, out, "--accept-changes", "--limit", "1") == 0
    assert {cell.task for cell in read_suite(out).cells} == {"football"}
    assert (out / "expert/twist2/boxing/base/episodes.jsonl").exists()


def test_other_code_is_refused_or_kept(suite, tmp_path, capsys, monkeypatch):
    """Finished cells of another version are kept on --accept-code; a half-played one is played again."""
    out = tmp_path / "out"
    assert call(suite, out, "--limit", "2") == 0
    half = out / "still/twist2/boxing/base/episodes.jsonl"
    half.write_text("".join(half.read_text().splitlines(keepends=True)[:2]))
    for name in ("expert/twist2/boxing/base", "still/twist2/boxing/base"):
        path = out / name / "config.json"
        document = json.loads(path.read_text())
        document["config"]["code"] = "0123456789ab"
        path.write_text(json.dumps(document))
    assert call(suite, out) == 2
    assert "played by another version" in capsys.readouterr().err
    assert call(suite, out, "--accept-code", "--limit", "1") == 0
    assert json.loads((out / "expert/twist2/boxing/base/config.json").read_text())["config"]["code"] == "0123456789ab"
    assert len(half.read_text().splitlines()) == 4 and (out / ".replaced/still/twist2/boxing/base.1").is_dir()


def test_results_that_are_gone_are_played_again(suite, played, tmp_path):
    """A done cell whose folder was deleted is played again."""
    out = tmp_path / "out"
    assert call(suite, out, "--limit", "1") == 0
    subprocess.run(["rm", "-r", str(out / "expert")], check=True)
    assert call(suite, out, "--limit", "1") == 0
    name = "expert/twist2/boxing/base"
    assert journals(out) == {name: journals(played)[name]}
    assert read_suite(out).cell(name).status == "done"


class Failing(FakePolicy):
    """A policy that cannot play."""

    def check_task(self, task, mode=None, seeds=()):
        """It knows no football."""
        if task == "football":
            raise InputError("knows no football")


def failing(spec, **options):
    """Policy `remote` fails, the others work."""
    return (Failing if spec.startswith("remote") else FakePolicy)(spec, **options)


def test_a_failing_cell_stops_or_is_passed(suite, tmp_path, capsys):
    """Without --keep-going the suite stops with the cell's name and code 2, with it the others are played: code 1."""
    edited(suite, 'spec = "stand"', 'spec = "remote:http://127.0.0.1:9"')
    out = tmp_path / "out"
    assert call(suite, out, policy=failing) == 2
    said = capsys.readouterr().err
    assert "cell still/twist2/football/base: knows no football" in said and "--keep-going" in said
    assert call(suite, out, "--keep-going", policy=failing) == 1
    output = capsys.readouterr().out
    assert len(re.findall(r"^failed: still/twist2/football/base: ", output, re.M)) == 1
    states = {cell.id: (cell.status, cell.error) for cell in read_suite(out).cells}
    assert [name for name, (status, _) in states.items() if status != "done"] == ["still/twist2/football/base"]
    assert "knows no football" in states["still/twist2/football/base"][1]
    assert call(suite, out) == 0, "what failed is tried again"


def test_wrong_policies_show_before_the_first_cell(suite, tmp_path, capsys):
    """A policy that cannot do a late cell's task is refused before anything is played."""

    class Picky(FakePolicy):
        def check_task(self, task, mode=None, seeds=()):
            if task == "football":
                raise InputError("knows no football")

    out = tmp_path / "out"
    assert call(suite, out, policy=Picky) == 2
    assert "cell expert/twist2/football/base: knows no football" in capsys.readouterr().err
    assert not list(out.glob("*/*/*/*/episodes.jsonl"))


class Erring(FakeEnv):
    """A world whose environment breaks down as a whole."""

    def step(self, action, worlds=None):
        raise RuntimeError("broke")


def test_episodes_with_errors_are_counted_and_retried(suite, tmp_path, capsys):
    """Episodes that end as errors leave their cell done and the exit code 1; --retry-errors plays them again."""
    edited(suite, "worlds = 2", "worlds = 2\nskip_broken = true")
    out = tmp_path / "out"
    only = ("--only", "task=boxing policy=still")
    assert call(suite, out, *only, env=Erring) == 1
    assert "4 episodes ended with an error" in capsys.readouterr().out
    assert read_suite(out).cell("still/twist2/boxing/base").errors == 4
    assert call(suite, out, *only) == 1, "they are still there"
    assert call(suite, out, *only, "--retry-errors") == 0
    assert read_suite(out).cell("still/twist2/boxing/base").errors == 0


def test_a_foreign_folder_is_refused(suite, tmp_path, capsys):
    """A folder that holds something else than a suite is left alone."""
    (tmp_path / "thesis.tex").write_text("x")
    assert call(suite, tmp_path) == 2
    assert "holds no suite" in capsys.readouterr().err
    assert call(suite, suite) == 2


def test_dry_run_plays_nothing(wide, tmp_path, capsys):
    """--dry-run prints matrix and size, and makes no folder."""
    out = tmp_path / "out"
    assert call(wide, out, "--dry-run", "-v") == 0
    said = capsys.readouterr().out
    assert "12 cells with 48 episodes, 12 to play: at most 67,200 world-ticks" in said  # 24 x (1,500 + 1,300)
    assert re.search(r"\| expert \| – +\| sonic +\| +0/2 \| +0/2 \|", said)
    assert "waiting  still/sonic/boxing/base" in said
    assert not out.exists()


def test_flags_of_a_cell(wide, tmp_path):
    """Conditions, weights and labels of the file arrive at the run; those of remote policies at these alone."""
    edited(wide, "repeats = 2", 'repeats = 2\nremote_timeout = 5.0\nmax_steps = 70\ndrive = "twist2"')
    wide.write_text(
        wide.read_text() + '[[policies]]\nname = "far"\nspec = "remote:http://h:1"\nlabels = "v4"\nworlds = 7\n'
        '[checkpoints]\nsonic = "weights.onnx"\n'
    )
    file = read_suite_file(wide)
    cells = {cell.id: cell for cell in expand_cells(file)}
    far = run_options(file, cells["far/sonic/boxing/visual"], tmp_path)
    near = run_options(file, cells["still/twist2/boxing/base"], tmp_path)
    assert (far.remote_timeout, far.labels, far.worlds, far.checkpoint) == (5.0, "v4", 7, "weights.onnx")
    assert (near.remote_timeout, near.labels, near.worlds, near.checkpoint) == (60.0, None, 2, None)
    assert (near.max_steps, near.drive, near.seeds, near.policy) == (70, "twist2", (0, 1), "stand")
    assert far.out == str(tmp_path / "far/sonic/boxing/visual")


def test_only_names_cells(wide):
    """--only takes several keys and values; a value that no cell has is refused with those that there are."""
    cells = expand_cells(read_suite_file(wide))
    found = selected(cells, parse_only("policy=expert,still task=boxing mode=base matched=none"))
    assert {cell.id for cell in found} == {
        f"{p}/{t}/boxing/base" for p in ("expert", "still") for t in ("twist2", "sonic")
    }
    for text, said in (
        ("task=vis_navi", "known are boxing football"),
        ("colour=red", "is unknown, known are policy"),
        ("boxing", "expected key=value"),
        ("task=boxing task=football", "given twice"),
        (" ", "is empty"),
        ("policy=still mode=visual", "no cell has all of these"),
    ):
        with pytest.raises(InputError, match=said):
            selected(cells, parse_only(text))


@pytest.mark.parametrize("name", ["paper", "tiny"])
def test_suites_of_the_package_can_be_read(name):
    """Each suite that comes with the package expands."""
    cells = expand_cells(read_suite_file(SHIPPED / f"{name}.toml"))
    if name == "paper":
        base = [c for c in cells if c.mode == "base" and not c.merged]
        assert len(base) == 4 * 2 * 2 * 7, "four families, trained on two trackers, executed by two, seven tasks"
        assert {c.matched for c in cells if c.mode != "base"} == {True}
        own = [c for c in cells if c.matched and not c.merged]
        assert len(own) == 4 * 2 * 7 * 4 and len(base) - len(own) / 4 == 4 * 2 * 7, "in-GMT, and cross-GMT"
        assert len(cells) == len(own) + 4 * 2 * 7 + 2 * 4 * 2 * 7 and {c.episodes for c in cells} == {60}
        assert {(c.trained_on, c.matched) for c in cells if c.policy == "act_x14"} == {(("twist2", "sonic"), True)}
    assert len({cell.id for cell in cells}) == len(cells)
