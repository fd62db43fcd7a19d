"""Identity of a run: all code, scenes and rules that its episodes depend on, and nothing else."""

import dataclasses
import functools
import hashlib
import importlib
import os
import sys
from pathlib import Path

import pytest

from arena_newton.errors import InputError
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records import identity
from arena_newton.rule_sets import get

TASKS = ("football", "double_desk", "pp_box", "open_door", "sit_sofa", "boxing", "vis_navi")


def names(files):
    """Paths below the package as text."""
    return {file.relative_to(identity.PACKAGE).as_posix() for file in files}


def test_every_module_counts():
    """The hash of the code is of the name and content of every module, except those of the list of exceptions."""
    modules = [file for file in identity.package_files(identity.PACKAGE) if file.suffix == ".py"]
    rooms = {file: {part.as_posix() for part in file.relative_to(identity.PACKAGE).parents} for file in modules}
    counted = identity.code_files()
    assert counted == [
        file for file in modules if file.name != "__main__.py" and not rooms[file] & {*identity.UNHASHED}
    ]
    contents = {file: identity.hash_path(file) for file in counted}
    before = identity.hash_paths(identity.PACKAGE, counted, contents.__getitem__)
    assert before == identity.code_hash()
    for file in (counted[0], counted[-1], *counted[::40]):
        touched = contents | {file: "touched"}
        assert identity.hash_paths(identity.PACKAGE, counted, touched.__getitem__) != before, file
    for name in (
        "usd_scenes/g1/links.py",
        "eval/plan/episode_plan.py",
        "eval/play/run.py",
        "env.py",
        "policies/experts/vis_navi.py",
    ):
        assert name in names(counted)


def test_a_new_module_anywhere_counts(tmp_path):
    """A file or folder that is added to the package changes the hash without being named anywhere."""
    (tmp_path / "env.py").write_text("one")
    before = identity.code_hash(tmp_path)
    for name in ("pictures/camera.py", "trackers/inference/blocks.py", "eval/loop.py", "new.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
        assert identity.code_hash(tmp_path) != before
        before = identity.code_hash(tmp_path)
    for name in ("trackers/train/ppo.py", "eval/reports/report.py", "__pycache__/env.py", "notes.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    assert identity.code_hash(tmp_path) == before


def test_the_exceptions_are_rooms():
    """Each of them is a folder with modules, so that a file follows its room."""
    for room in identity.UNHASHED:
        assert list((identity.PACKAGE / room).glob("*.py")), room


def test_a_module_that_moves_changes_its_standing(tmp_path):
    """The same module is hashed in a room that decides episodes and is not in a room that reports."""
    for room, counts in (("eval/play", True), ("eval/reports", False), ("eval/plan", True), ("policies/train", False)):
        root = tmp_path / room.replace("/", "_")
        (root / room).mkdir(parents=True)
        empty = identity.code_hash(root)
        (root / room / "moved.py").write_text("")
        assert (identity.code_hash(root) != empty) == counts


def test_scenes_of_the_run_count():
    """Layers, variants, textures and robot count; scenes of other tasks and the trackers' lab do not."""
    counted = names(identity.scene_files(identity.PACKAGE, ("boxing",), TASKS))
    for name in ("boxing/scene.usda", "boxing/variants/semantic.usda", "g1/g1.usda", "textures/brick.png"):
        assert f"usd_scenes/{name}" in counted
    assert not any(name.split("/")[1] in (*TASKS[:5], "vis_navi", "lab") for name in counted)
    one, other = (resolve(RunOptions(task=(task,))).identity() for task in ("football", "boxing"))
    assert one["scenes"] != other["scenes"] and one["code"] == other["code"] and len(one["scenes"]) == 12
    assert one["tracker_facts"] is None  # known when the tracker is made


def test_held_out_looks_count_where_they_are_played():
    """Layers and textures of a held-out mode change the identity of runs in that mode, and of no other."""
    without, played = (
        names(identity.scene_files(identity.PACKAGE, ("boxing",), TASKS, modes)) for modes in ((), ("semantic-2",))
    )
    extra = set(played) - set(without)
    assert "usd_scenes/boxing/variants/semantic-2.usda" in extra and not any("-" in name for name in without)
    assert len(extra) > 5 and all("semantic-2" in name for name in extra)


def test_a_new_folder_of_scenes_counts(tmp_path):
    """Files next to the scenes, such as materials in a folder of their own, count without being named."""
    (tmp_path / "usd_scenes" / "materials").mkdir(parents=True)
    (tmp_path / "usd_scenes" / "materials" / "oak.usda").write_text("")
    (tmp_path / "usd_scenes" / "football").mkdir()
    (tmp_path / "usd_scenes" / "football" / "scene.usda").write_text("")
    found = identity.scene_files(tmp_path, ("boxing",), TASKS)
    assert [file.name for file in found] == ["oak.usda"]


def test_code_of_other_packages_counts(tmp_path, monkeypatch):
    """A tracker or policy from another package is known by that package's code; our own and Python's are not asked."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "their_policy").mkdir()
    for name, text in (("__init__.py", ""), ("act.py", "class Theirs:\n    pass\n"), ("weights.bin", "")):
        (tmp_path / "their_policy" / name).write_text(text)
    part = importlib.import_module("their_policy.act").Theirs()
    before = identity.own_code(part)
    (tmp_path / "their_policy" / "network.py").write_text("")
    assert before is not None and identity.own_code(part) != before
    assert (
        identity.own_code(type(part)) == identity.own_code(functools.partial(type(part), 1)) == identity.own_code(part)
    )
    assert identity.own_code(resolve) is None
    assert identity.own_code(object()) is None
    from arena_newton import policies

    assert identity.own_code(policies.get("stand")) is None
    del sys.modules["their_policy"], sys.modules["their_policy.act"]


def test_identity_names_what_changes_results():
    """Drive, what tracker and policy say of themselves and, for a policy that depends on it, the number of worlds."""
    one = resolve(RunOptions(task=("football",)))
    changes = (
        {"flags": dataclasses.replace(one.flags, drive="humanoidarena")},
        {"tracker_facts": {"drive": "stiff"}},
        {"policy_facts": {"url": "http://b"}},
        {"worlds_matter": True},
        {"rules_hash": "0"},
    )
    assert len({one.hash, *(dataclasses.replace(one, **change).hash for change in changes)}) == 6
    same = {"video": True, "strip": True, "video_episodes": 2, "video_size": "64x48", "follow": True, "worlds": 3}
    same |= {"out": "elsewhere", "verbose": True, "skip_broken": True}
    assert dataclasses.replace(one, flags=dataclasses.replace(one.flags, **same)).hash == one.hash


def test_rules_of_other_tasks_do_not_count():
    """The rules' hash is of the tasks that a run uses: another task's rules leave it alone."""
    rules = get("paper")
    fewer = dataclasses.replace(rules, tasks=tuple(t for t in rules.tasks if t.task in ("football", "boxing")))
    resolved = resolve(RunOptions(task=("football",), rules="paper"))
    assert resolved.rules_hash == fewer.hash_for(("football",)) != fewer.hash_for(("football", "boxing"))


def test_difference_is_told_to_the_key():
    """The key that differs in a table within an identity is named."""
    stored = {"a": 1, "facts": {"drive": "soft", "dt": 0.001}}
    assert identity.differing_key(stored, stored) is None
    assert identity.differing_key(stored, {"a": 1, "facts": {"drive": "stiff", "dt": 0.001}}) == (
        "facts.drive", "soft", "stiff"
    )  # fmt: skip
    assert identity.differing_key(stored, {"a": 1, "facts": None}) == ("facts", stored["facts"], None)
    assert identity.differing_key(stored, {"a": 1}) == ("facts", stored["facts"], None)
    assert identity.differing_key(stored, {"a": 1}, ignored=("facts",)) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"drive": "stiff"}, "--drive stiff: unknown, choose from auto, twist2, humanoidarena"),
        ({"video": True, "video_size": "960"}, "--video-size 960"),
        ({"follow": True}, "--follow: belongs to --video or --strip"),
        (
            {"strip": True, "video_size": "960x99999"},
            "--video-size 960x99999: expected 32 to 4096 pixels each",
        ),
        ({"video": True, "video_size": "20x20"}, "--video-size 20x20: expected 32 to 4096 pixels each"),
        ({"video": True, "video_size": "40x4000"}, "--video-size 40x4000: makes head camera videos of 5333x4000"),
        ({"video": True, "video_size": "٣٣٣x٣٣٣"}, "expected width x height"),
        ({"video_episodes": 0}, "--video-episodes 0"),
        ({"seeds": (0, 2**64 + 1)}, "--seeds 18446744073709551617: expected at most 18446744073709551616"),
        ({"seeds": (10**400,)}, "--seeds 10{39}[.]{3}: expected at most"),
        ({"max_steps": 10**7 + 1}, "--max-steps 10000001: expected at most 10,000,000"),
        ({"repeats": 10**4000}, "--repeats 10{39}[.]{3}: makes too many episodes"),
        ({"out": "erg \udcc3\udc9f"}, "--out erg: holds bytes that are no text in this locale's character set"),
        ({"policy": "remote:\x1b[2J"}, "--policy remote:: has control characters"),
        ({"repeats": 10**9}, "--repeats 1000000000: makes 3,000,000,000 episodes, at most 200,000"),
        ({"variant": "/dev/zero"}, "--variant /dev/zero: is not a regular file"),
        ({"checkpoint": "/dev/zero"}, "/dev/zero: is not a regular file"),
    ],
)
def test_unfit_options_are_named(options, message):
    """Unknown names, sizes and files without end are refused before anything is read."""
    with pytest.raises(InputError, match=message):
        resolve(RunOptions(**({"task": ("football",)} | options)))


def test_video_size_is_two_numbers():
    """--video-size becomes width and height."""
    options = RunOptions(task=("football",), strip=True, video_size="960x540", video_episodes=3, follow=True)
    resolved = resolve(options)
    assert resolved.video_size == (960, 540)
    assert (resolved.flags.video_episodes, resolved.flags.follow) == (3, True)


def test_large_files_are_read_once_until_they_change(tmp_path, monkeypatch):
    """A large file's hash is kept; another time or size of it, or another file in its folder, is seen."""
    monkeypatch.setattr(identity, "LARGE_BYTES", 4)
    path = tmp_path / "model.bin"
    path.write_bytes(b"one two")
    first, folder = identity.hash_path(path), identity.hash_path(tmp_path)
    assert first == hashlib.sha256(b"one two").hexdigest()[:12]
    opened = []
    monkeypatch.setattr(Path, "open", lambda self, *args: opened.append(self))
    assert (identity.hash_path(path), identity.hash_path(tmp_path)) == (first, folder) and not opened
    monkeypatch.undo()
    monkeypatch.setattr(identity, "LARGE_BYTES", 4)
    path.write_bytes(b"two one")
    os.utime(path, ns=(0, 1))
    assert identity.hash_path(path) == hashlib.sha256(b"two one").hexdigest()[:12]
    (tmp_path / "config.json").write_bytes(b"{}")
    assert identity.hash_path(tmp_path) != folder
    with pytest.raises(InputError, match="cannot be read"):
        identity.hash_path(tmp_path / "absent")
