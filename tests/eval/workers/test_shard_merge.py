"""Merged shards are what one machine would have written; what does not fit together is refused in one line."""

import json
import os
import shutil

import pytest
from eval_fakes import factories
from made_folders import configuration, contents

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.workers import shard_merge
from arena_newton.eval.workers.shard_merge import merge
from arena_newton.rules import seeding
from benchmarks.audits.forgeries import journal_lines, write_lines

FLAGS = ["--task", "football", "boxing", "--engine", "mujoco", "--mode", "base", "execution", "--repeats", "4"]
TABLES = ("results.json", "table.md", "table.csv", "report.md", "report.html")


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Folders of one machine, `one`, and of three shards with other numbers of worlds, `s1` to `s3`."""
    folder = tmp_path_factory.mktemp("shards")
    assert main(["run", *FLAGS, "--actions", "--worlds", "3", "--out", str(folder / "one")], factories()) == 0
    for n, worlds in ((1, "1"), (2, "7"), (3, "4")):
        flags = [*FLAGS, "--actions", "--worlds", worlds, "--shard", f"{n}/3", "--out", str(folder / f"s{n}")]
        assert main(["run", *flags], factories()) == 0
    return folder


@pytest.fixture
def copied(played, tmp_path):
    """The folders of the shards, to be changed."""
    for name in ("s1", "s2", "s3"):
        shutil.copytree(played / name, tmp_path / name)
    return tmp_path


def unlinked(folder):
    """Lines of a journal without their links."""
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key != "previous"} for line in lines]


def shards(folder):
    """The three folders."""
    return [folder / name for name in ("s1", "s2", "s3")]


def edited(folder, change, number=0, *, link=True):
    """Change a line of a journal; its links are made again."""
    lines = journal_lines(folder)
    change(lines[number])
    write_lines(folder, lines, link=link)
    return lines[number]


def test_merged_shards_are_one_machine(played, tmp_path):
    """Journal, tables, reports and actions are one machine's byte for byte, times apart, in any order of folders."""
    merge(shards(played), tmp_path / "m")
    merge(shards(played)[::-1], tmp_path / "backwards")
    merge([played / "one"], tmp_path / "alone")
    for name in TABLES:
        assert (tmp_path / "m" / name).read_bytes() == (played / "one" / name).read_bytes(), name
    assert contents(tmp_path / "m") == contents(tmp_path / "alone")
    assert configuration(tmp_path / "m") == configuration(played / "one")
    assert (tmp_path / "m/episodes.jsonl").read_bytes() == (tmp_path / "backwards/episodes.jsonl").read_bytes()
    assert contents(tmp_path / "m") == contents(tmp_path / "backwards")
    actions = {path.name: path.read_bytes() for path in (played / "one" / "actions").iterdir()}
    assert actions and {path.name: path.read_bytes() for path in (tmp_path / "m" / "actions").iterdir()} == actions
    lines = [line for folder in shards(played) for line in unlinked(folder)]
    merged = unlinked(tmp_path / "m")
    assert merged == sorted(lines, key=lambda line: line["index"]) and len(merged) == 48
    assert load_run(tmp_path / "m").status["state"] == "success"


def test_a_merged_folder_merges_and_resumes(played, tmp_path, capsys):
    """A partial merge says what is missing, `resume` plays it, and it can be merged with the rest instead."""
    flags = ["merge", str(played / "s1"), str(played / "s3"), "--out", str(tmp_path / "m")]
    assert main(flags) == 2
    error = capsys.readouterr().err
    assert "16 episodes of 48 missing: shard 2/3 is not named" in error and error.count("\n") == 1
    assert not (tmp_path / "m").exists()
    assert main([*flags, "--partial"]) == 1
    assert "Incomplete: 32 of 48 episodes" in capsys.readouterr().out
    results = json.loads((tmp_path / "m" / "results.json").read_text())
    assert (results["status"], results["complete"], results["planned"]) == ("partial", False, 48)
    merge([played / "s2", tmp_path / "m"], tmp_path / "whole")
    assert main(["resume", str(tmp_path / "m")], factories()) == 0
    for name in TABLES:
        one = (played / "one" / name).read_bytes()
        assert (tmp_path / "whole" / name).read_bytes() == one == (tmp_path / "m" / name).read_bytes(), name


def test_unfinished_shards_are_named(copied):
    """Folder and numbers of an unfinished shard, torn line included, are named, and the number of a missing one."""
    journal = copied / "s2" / "episodes.jsonl"
    journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-3]) + b'{"index": 4')
    with pytest.raises(InputError) as caught:
        merge([copied / "s1", copied / "s2"], copied / "m")
    assert f"{copied / 's2'} (shard 2/3) has 13 of 16 episodes, shard 3/3 is not named" in str(caught.value)
    assert "19 episodes of 48 missing" in str(caught.value)
    assert main(["resume", str(copied / "s2")], factories()) == 0
    assert merge(shards(copied), copied / "m").results["complete"]


def test_who_misses_what(copied):
    """A folder whose missing episodes others have is not named as unfinished."""
    shutil.copytree(copied / "s1", copied / "again")
    path = copied / "s1" / "episodes.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:5]))
    with pytest.raises(InputError) as caught:
        merge([copied / "s1", copied / "again", copied / "s2"], copied / "m")
    assert str(caught.value).startswith("merge: 16 episodes of 48 missing: shard 3/3 is not named;")


def test_other_counts_of_shards_join(played, tmp_path):
    """Whole plans and shards of other counts join where they have every episode, alike in several."""
    half = tmp_path / "half"
    assert main(["run", *FLAGS, "--actions", "--shard", "1/2", "--out", str(half)], factories()) == 0
    merged = merge([*shards(played), half], tmp_path / "m")
    assert "24 episodes in several folders, each alike." in merged.notes
    assert (tmp_path / "m" / "report.html").read_bytes() == (played / "one" / "report.html").read_bytes()
    with pytest.raises(InputError, match="shard 2/2 is not named"):
        merge([half], tmp_path / "n")


@pytest.mark.parametrize(
    ("key", "value"), [("outcome", None), ("steps", 1), ("margin", 0.123), ("overflow", True), ("phases", [["a", 0]])]
)
def test_overlaps_that_differ_are_refused(copied, played, key, value):
    """Two folders with one episode and another value of it are refused: episode, value and both folders are named."""
    shutil.copytree(copied / "s1", copied / "again")

    def change(line):
        line[key] = {"fall": "timeout"}.get(line["outcome"], "fall") if value is None else value

    line = edited(copied / "again", change, 2)
    with pytest.raises(InputError) as caught:
        merge([*shards(copied), copied / "again"], copied / "m")
    words = f"episode {line['index']} ({line['task']} twist2 {line['mode']} seed {line['group_seed']} "
    words += f"repeat {line['repeat']}): {key} is"
    text = str(caught.value)
    assert text.startswith(words) and f"in {copied / 's1'}" in text and f"in {copied / 'again'}" in text
    assert not (copied / "m").exists() and not list(copied.glob("*.part"))


def test_a_changed_line_is_not_linked_again(copied):
    """A shard whose line was changed without its links is refused by its line: merged, it would look untouched."""
    edited(copied / "s2", lambda line: line.update(margin=0.123), 2, link=False)
    with pytest.raises(InputError, match=r"s2/episodes.jsonl: line 4 is not linked to line 3: a line was changed"):
        merge(shards(copied), copied / "m")
    assert not (copied / "m").exists()


def test_overlaps_of_other_times_join(copied):
    """Times and recordings of an episode that two folders have may differ: the first folder's line is kept."""
    shutil.copytree(copied / "s1", copied / "twin")
    edited(copied / "twin", lambda line: line.update(started_at="later", durations=line["durations"] | {"wall_s": 9.0}))
    merged = merge([*shards(copied), copied / "twin"], copied / "m")
    assert "16 episodes in several folders, each alike." in merged.notes
    assert b"later" not in (copied / "m" / "episodes.jsonl").read_bytes()


def test_an_error_gives_way(copied, played):
    """The other folder's episode counts where it ended as an error in one, as after --retry-errors."""
    shutil.copytree(copied / "s1", copied / "again")
    broken = {"outcome": "error", "reason": "environment", "error": "out of memory", "steps": 0}
    edited(copied / "s1", lambda line: line.update(broken))
    merged = merge([*shards(copied), copied / "again"], copied / "m")
    assert any(note.startswith("1 episode ended as an error in one folder") for note in merged.notes)
    assert (copied / "m" / "table.md").read_bytes() == (played / "one" / "table.md").read_bytes()
    assert main(["merge", *map(str, shards(copied)), "--out", str(copied / "n")]) == 1, "an error is not 0"


def test_episodes_are_counted_once(copied):
    """However many folders have an episode, it is one that several have, or one that was repaired."""
    for name in ("b", "c"):
        shutil.copytree(copied / "s1", copied / name)
        edited(copied / name, lambda line: line.update(outcome="error", reason="environment", error="broken", steps=0))
    merged = merge([*shards(copied), copied / "b", copied / "c"], copied / "m")
    assert merged.notes == (
        "15 episodes in several folders, each alike.",
        "1 episode ended as an error in one folder and not in another, which counts.",
    )


def test_environments_of_any_two_folders_are_held_together(copied):
    """Two shards whose environments differ are refused also where the first folder has none of that group."""
    lines = [json.loads(line) for line in (copied / "s1" / "episodes.jsonl").read_text().splitlines()]
    kept = [line for line in lines if line["task"] == "football"]
    text = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in kept)
    (copied / "s1" / "episodes.jsonl").write_text(text)
    rewritten(copied / "s1", lambda document: document["environments"].pop("boxing twist2 base"))
    rewritten(copied / "s3", lambda document: document["environments"]["boxing twist2 base"].update(physics_dt=1))
    with pytest.raises(InputError, match="s3: boxing twist2 base: physics_dt is 1, in .*s2 0.001"):
        merge(shards(copied), copied / "m", partial=True)


def strips(folder, *without):
    """Give the episodes of a folder strips, some of which get lost."""
    (folder / "strips").mkdir()
    lines = journal_lines(folder)
    for line in lines:
        line["media"]["world strip"] = f"strips/{line['index']}.jpg"
        if line["index"] not in without:
            (folder / "strips" / f"{line['index']}.jpg").write_text(str(line["index"]))
    write_lines(folder, lines)
    return [line["index"] for line in lines]


@pytest.mark.parametrize("first", [True, False], ids=["one has no strips", "one lost a strip"])
def test_recordings_come_from_any_folder(copied, first):
    """A recording that one of two folders with an episode lacks is taken from the other."""
    shutil.copytree(copied / "s1", copied / "twin")
    numbers = strips(copied / "twin")
    if not first:
        strips(copied / "s1", numbers[3])
    merged = merge([*shards(copied), copied / "twin"], copied / "m")
    assert not any("no folder has" in note for note in merged.notes)
    assert {path.name: path.read_text() for path in (copied / "m" / "strips").iterdir()} == {
        f"{number}.jpg": str(number) for number in numbers
    }


def test_successes_that_were_to_be_kept(copied):
    """A recording that has its successes before its attempts end is whole, and an unfinished one is not."""
    folder = copied / "s1"
    config = json.loads((folder / "config.json").read_text())
    config["config"] |= {"seed_range": "demonstration", "keep": 4, "seeds": [0], "repeats": 12}
    del config["shard"]
    (folder / "config.json").write_text(json.dumps(config))
    line = json.loads((folder / "episodes.jsonl").read_text().splitlines()[0])
    line |= {"group_seed": 0, "outcome": "success", "steps": 9, "predicates": {}}
    lines = []
    for number in (number for number in range(48) if number % 12 < 4):
        task, mode = ("football", "boxing")[number // 24], ("base", "execution")[number // 12 % 2]
        seed = seeding.planned_seed(tasks.get(task).gym_id, "demonstration", 0, number % 12)
        part = {"index": number, "task": task, "mode": mode, "repeat": number % 12, "episode_seed": seed}
        budget = tasks.get(task).max_steps(rule_sets.get("paper"))
        lines.append(line | part | {"object_seed": seeding.object_seed(seed), "max_steps": budget})
    write_lines(folder, lines)
    merged = merge([folder], copied / "m")
    assert merged.results["complete"] and merged.run.status["state"] == "success"
    write_lines(folder, lines[:-1])
    with pytest.raises(InputError, match="successes of at most 48 episodes missing: .*s1 has 15 of 48"):
        merge([folder], copied / "n")
    merged = merge([folder], copied / "n", partial=True)
    assert not merged.results["complete"] and merged.run.status["state"] == "partial"


def rewritten(folder, change):
    """Change a config.json, and its hash as a run of that configuration has it."""
    path = folder / "config.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda d: d["config"].update(code="0" * 12), "code is 000000000000, in"),
        (lambda d: d["config"]["policy_facts"].update(name="other"), "policy_facts.name is other, in"),
        (lambda d: d["rule_set"].update({next(iter(d["rule_set"])): "x"}), "rule_set."),
        (lambda d: d["environments"]["boxing twist2 base"].update(physics_dt=1), "boxing twist2 base: physics_dt is 1"),
        (lambda d: d["versions"].update(mujoco="0.1"), "mujoco is 0.1, in"),
        (lambda d: d["options"].update(record=True), "--record is True, in"),
        (lambda d: d.update(shard="3/49"), "shard 3/49 of a plan of 48"),
        (lambda d: d.update(shard="1/3"), "is not in shard 1/3"),
        (lambda d: d.update(shard="4/3"), "shard is"),
    ],
)
def test_folders_that_differ_are_refused(copied, change, expected):
    """Another configuration, rule set, environment, library or split is refused with the key and both folders."""
    rewritten(copied / "s2", change)
    with pytest.raises(InputError) as caught:
        merge(shards(copied), copied / "m")
    assert expected in str(caught.value) and str(copied / "s2") in str(caught.value)
    assert not (copied / "m").exists()


def test_versions_can_be_accepted(copied):
    """With --accept-versions the merged folder names the libraries of all shards."""
    rewritten(copied / "s2", lambda document: document["versions"].update(mujoco="0.1"))
    assert main(["merge", *map(str, shards(copied)), "--out", str(copied / "m"), "--accept-versions"]) == 0
    later = json.loads((copied / "m" / "config.json").read_text())["later_versions"]
    assert [versions["mujoco"] for versions in later] == ["0.1"]


def test_bad_calls(copied, capsys, monkeypatch):
    """A missing or unfit --out, a folder twice or without results: one line, exit code 2, nothing is written."""
    monkeypatch.chdir(copied)
    (copied / "link").symlink_to("s1")
    (copied / "file").write_text("x")
    (copied / "busy.part").mkdir()
    (copied / "suite").mkdir()
    (copied / "suite" / "suite.json").write_text("{}")
    before = sorted(str(path) for path in copied.rglob("*"))
    cases = {
        (): "name the folders of the shards",
        ("s1", "s2", "s3"): "--out",
        ("s1", "s1", "--out", "m"): "named twice",
        ("s1", "nowhere", "--out", "m"): "nowhere: no results folder",
        ("s1", "suite", "--out", "m"): "suite: is a suite, whose parts are joined by copying",
        ("s1", "s2", "s3", "--out", "s1"): "--out s1: is not empty",
        ("s1", "s2", "s3", "--out", "link"): "is a link",
        ("s1", "s2", "s3", "--out", "file"): "is a file",
        ("s1", "s2", "s3", "--out", "file/m"): "cannot be created",
        ("s1", "s2", "s3", "--out", ""): "--out",
        ("s1", "s2", "s3", "--out", "."): "is not empty",
        ("s1", "s2", "s3", "--out", "s1/all"): "--out s1/all: is in s1, which stays as it is",
        ("s1", "s2", "s3", "--out", "a\nb"): "control characters",
        ("s1", "s2", "s3", "--out", "busy"): "busy.part: was left",
        ("s1", "--out", "m", "--shard", "1/2"): "--shard: unknown argument",
    }
    for arguments, expected in cases.items():
        capsys.readouterr()
        assert main(["merge", *arguments]) == 2, arguments
        error = capsys.readouterr().err
        assert expected in error and error.count("\n") == 1, error
    assert sorted(str(path) for path in copied.rglob("*")) == before


@pytest.mark.parametrize("path", ["../s2/config.json", "/etc/hostname", "strips/../../x", "config.json", "strips/.x"])
def test_recordings_outside_are_refused(copied, path):
    """A journal that names a file which no run writes cannot have it copied."""
    edited(copied / "s1", lambda line: line.update(media={"world strip": path}))
    with pytest.raises(InputError, match="expected a recording of the folder"):
        merge(shards(copied), copied / "m")
    assert not (copied / "m").exists()


def test_linked_recordings_are_refused(copied):
    """Neither a link nor a linked folder is followed, and a pipe does not block."""
    edited(copied / "s1", lambda line: line.update(media={"world strip": "strips/a.jpg"}))
    (copied / "secret").mkdir()
    (copied / "secret" / "a.jpg").write_text("mine")
    (copied / "s1" / "strips").symlink_to("../secret")
    with pytest.raises(InputError, match="strips: is a link"):
        merge(shards(copied), copied / "m")
    (copied / "s1" / "strips").unlink()
    (copied / "s1" / "strips").mkdir()
    (copied / "s1" / "strips" / "a.jpg").symlink_to("../../secret/a.jpg")
    with pytest.raises(InputError, match=r"a\.jpg: is a link"):
        merge(shards(copied), copied / "m")
    (copied / "s1" / "strips" / "a.jpg").unlink()
    os.mkfifo(copied / "s1" / "strips" / "a.jpg")
    with pytest.raises(InputError, match=r"a\.jpg: is not a regular file"):
        merge(shards(copied), copied / "m")
    (copied / "s1" / "strips" / "a.jpg").unlink()
    merged = merge(shards(copied), copied / "m")
    assert any("no folder has: strips/a.jpg" in note for note in merged.notes)


def test_a_full_disk_leaves_nothing(copied, monkeypatch, capsys):
    """A disk that is full while recordings are copied: one line, exit code 2, no half folder."""

    def full(source, target, length):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shard_merge.shutil, "copyfileobj", full)
    assert main(["merge", *map(str, shards(copied)), "--out", str(copied / "m")]) == 2
    error = capsys.readouterr().err
    assert "disk full; the shards are as they were" in error and error.count("\n") == 1
    assert not list(copied.glob("m*"))


def test_a_real_run(tmp_path, parts):
    """On engine mujoco two shards with other numbers of worlds give one machine's bytes, with strips and films."""
    flags = ["--task", "boxing", "--engine", "mujoco", "--seeds", "0", "--repeats", "3", "--max-steps", "6"]
    flags += ["--policy", "expert", "--tracker", "twist2", "--strip", "--video", "--video-episodes", "1"]
    flags += ["--video-size", "64x48"]
    assert main(["run", *flags, "--worlds", "2", "--out", str(tmp_path / "one")], parts) == 0
    for n in (1, 2):
        out = ["--worlds", "1", "--shard", f"{n}/2", "--out", str(tmp_path / f"s{n}")]
        assert main(["run", *flags, *out], parts) == 0
    merge(shards(tmp_path)[:2], tmp_path / "m")
    merge([tmp_path / "one"], tmp_path / "alone")
    merged, alone = contents(tmp_path / "m"), contents(tmp_path / "alone")
    assert merged == alone
    assert sum(name.endswith(".jpg") for name in merged) == 6 and sum(name.endswith(".mp4") for name in merged) == 2
    one = contents(tmp_path / "one")
    assert {name: data for name, data in one.items() if name != "episodes.jsonl"} == {
        name: data for name, data in merged.items() if name != "episodes.jsonl"
    }
    assert sorted(one["episodes.jsonl"].splitlines()) == sorted(merged["episodes.jsonl"].splitlines())
    assert configuration(tmp_path / "m") == configuration(tmp_path / "one")


def test_recorded_shards(tmp_path, parts):
    """Two shards of a recording give the files of one machine's, which the merged folder counts as recorded."""
    flags = "--task boxing --episodes 3 --engine mujoco --size 64x64 --max-steps 4".split()
    for name, more in (("one", "--worlds 2"), ("s1", "--worlds 1 --shard 1/2"), ("s2", "--worlds 1 --shard 2/2")):
        assert main(["record", *flags, *more.split(), "--out", str(tmp_path / name)], parts) == 0
    merge([tmp_path / "s1", tmp_path / "s2"], tmp_path / "m")
    names = sorted(str(path.relative_to(tmp_path / "one")) for path in (tmp_path / "one" / "episodes").rglob("*.*"))
    assert len(names) == 6
    for name in names:
        assert (tmp_path / "m" / name).read_bytes() == (tmp_path / "one" / name).read_bytes(), name
    journal = (tmp_path / "m" / "episodes.jsonl").read_bytes()
    assert main(["resume", str(tmp_path / "m")]) == 0
    assert (tmp_path / "m" / "episodes.jsonl").read_bytes() == journal, "played again"
