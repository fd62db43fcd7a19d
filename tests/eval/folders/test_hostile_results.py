"""Results folders of strangers: whatever stands in journal and configuration, the answer is a report or one line."""

import functools
import json
import random
import re
import resource
import shutil
from pathlib import Path

import pytest
from eval_fakes import factories

from arena_newton.eval.__main__ import main
from arena_newton.eval.plan import config
from arena_newton.eval.records import identity

FLAGS = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "3", "--repeats", "2"]
VALUES = (
    *("null", "true", "-1", "0", "1", "3", "1e308", "1e999", "-1e999", "NaN", "Infinity", "1" + "0" * 30, "9" * 5000),
    *('""', '"x"', '"football"', '"base"', '"error"', '"../../../escape"', '"/tmp/arena_newton_escape"', '".."', '"."'),
    *('"\\u001b[2J"', '"\\ud800"', '"\\u0000"', '"a\\nb"', '"\\u202e"', '"<script>alert(1)</script>"', '"/dev/zero"'),
    *('"%s"' % ("y" * 100_000), "[]", "{}", "[0, 0]", '["football", "football"]', '{"a": {"b": [1]}}', '{"": 0}'),
    *("[" * 60 + "]" * 60, "[" * 100_000, '{"a":' * 50_000, '"C:\\\\x"', '"remote:http://u:p@h"', "0.5", "-0.0"),
)
"""Hostile values, as they stand in a file."""


def places(value, path=()):
    """Paths to all values within a JSON value."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in items:
        yield from places(part, (*path, key))


def with_raw(value, path, raw):
    """JSON text of a value with the part at a path replaced by text."""
    mark = "@@here@@"
    copy = json.loads(json.dumps(value))
    at = copy
    for key in path[:-1]:
        at = at[key]
    if not path:
        return raw
    at[path[-1]] = mark
    return json.dumps(copy).replace(f'"{mark}"', raw)


def mutated(value, rng):
    """JSON text of an object with one change: another value, a lost or a renamed key, or changed bytes."""
    kind = rng.randrange(8)
    if kind < 5:
        return with_raw(value, rng.choice(list(places(value))[1:]), rng.choice(VALUES)).encode()
    if kind == 5:
        return json.dumps({key: part for key, part in value.items() if key != rng.choice(list(value))}).encode()
    if kind == 6:
        key = rng.choice(list(value))
        return json.dumps(
            {rng.choice(("", "x", "../x", key + "\x1b")) if k == key else k: p for k, p in value.items()}
        ).encode()
    return spoiled(json.dumps(value).encode(), rng)


def spoiled(data, rng):
    """Bytes with some of them flipped, cut out, cut off or put in."""
    data = bytearray(data)
    for _ in range(rng.randrange(1, 4)):
        at, size = rng.randrange(len(data)), rng.choice((1, 1, 2, 40))
        change = rng.randrange(4)
        if change == 0:
            data[at] = rng.randrange(256)
        elif change == 1:
            del data[at : at + size]
        elif change == 2:
            del data[at:]
        else:
            data[at:at] = rng.choice((b"\x00" * size, b"\xff\xfe", b"\n", b"}{", b'"', b"\\", rng.randbytes(size)))
        if not data:
            break
    return bytes(data)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A small results folder; what each command looks up again is looked up once."""
    cached = functools.cache(identity.hash_path)
    folder = tmp_path_factory.mktemp("sound") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(config, "code_hash", lambda: "0" * 12)
        for module in (config, identity):
            patch.setattr(module, "hash_path", cached)
        assert main([*FLAGS, "--out", str(folder)], factories()) == 0
        for path in folder.iterdir():
            if path.name not in ("config.json", "episodes.jsonl"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        yield folder


@pytest.fixture
def base(sound, tmp_path, monkeypatch):
    """A copy of it two floors down, and files beside it that must not change."""
    monkeypatch.chdir(tmp_path)
    folder = shutil.copytree(sound, tmp_path / "outer" / "inner" / "run")
    (tmp_path / "outer" / "victim").write_text("mine")
    return folder


def check(folder, mutants, write, capsys, commands):
    """Give each mutant to one of the commands."""
    root = folder.parents[2]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    kept = folder.parent / "kept"
    shutil.copytree(folder, kept)
    counts = {"accepted": 0, "refused": 0}
    capsys.readouterr()
    for number, mutant in enumerate(mutants):
        command = commands[number % len(commands)]
        shutil.rmtree(folder)
        shutil.copytree(kept, folder)
        write(mutant)
        code = main([*command, str(folder)], factories())
        captured = capsys.readouterr()
        complaints = [
            line for line in captured.err.splitlines() if not re.match(r"  |[a-z_]+ [a-z0-9]+ [a-z]+: \d", line)
        ]
        if code == 2:
            counts["refused"] += 1
            assert len(complaints) == 1 and complaints[0].startswith("error: "), (number, captured.err)
            assert len(complaints[0]) < 2500 and str(folder) in complaints[0] or "--" in complaints[0]
        else:
            counts["accepted"] += 1
            assert code in (0, 1) and not complaints, (number, code, captured.err)
        assert "\x1b" not in captured.err + captured.out, (number, mutant[:200])
        inside = {str(path.relative_to(root)) for path in root.rglob("*") if folder not in (path, *path.parents)}
        inside = {path for path in inside if not path.startswith("outer/inner/kept/")}
        assert inside == {"outer", "outer/inner", "outer/inner/kept", "outer/victim"}, (number, inside)
        assert not Path("/tmp/arena_newton_escape").exists()
        assert (root / "outer" / "victim").read_text() == "mine"
    assert counts["refused"] > len(mutants) // 3 and counts["accepted"] > 0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 1 << 20  # KiB; torch and Warp are most of it
    print(f"{len(mutants)} mutants: {counts}")


def test_mutated_journals(base, mutants, capsys):
    """A journal changed anywhere gives a report or one line with code 2, and nothing is written elsewhere."""
    rng = random.Random(1)
    path = base / "episodes.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    made = []
    for number in range(mutants):
        at = rng.randrange(len(lines))
        if number % 5 == 4:
            made.append(spoiled(b"".join(lines), rng))
        else:
            line = mutated(json.loads(lines[at]), rng)
            made.append(b"".join([*lines[:at], line + b"\n", *lines[at + 1 :]]))
    check(base, made, path.write_bytes, capsys, (["report"], ["audit"], ["resume"]))


def test_mutated_configurations(base, mutants, capsys):
    """A config.json changed anywhere gives a report, a continued run or one line with code 2."""
    rng = random.Random(2)
    path = base / "config.json"
    document = json.loads(path.read_bytes())
    made = []
    for number in range(mutants):
        part = ("options", "config", None)[number % 3]  # most of a document's values are versions and rules
        if part is None:
            made.append(mutated(document, rng))
        else:
            made.append(with_raw(document, (part,), mutated(document[part], rng).decode("latin-1")).encode("latin-1"))
    check(base, made, path.write_bytes, capsys, (["resume"], ["report"], ["audit"]))


def refused(folder, capsys, *words):
    """Both commands that read a folder refuse it in one line with these words, and leave the journal alone."""
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    for command in (["report"], ["resume"], ["resume", "--accept-versions", "--retry-errors", "--skip-broken"]):
        capsys.readouterr()
        assert main([command[0], str(folder), *command[1:]], factories()) == 2, command
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and error.startswith(f"error: {folder}"), error
        assert all(word in error for word in words), error
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tracker", "sonic"),
        ("policy", "stand"),
        ("rules", "released"),
        ("engine", "warp"),
        ("episode_seed", 5),
        ("object_seed", 5),
        ("max_steps", 3),
        ("steps", 1_000_000),
        ("privileged", True),
        ("hashes", {"config": "deadbeef0000"}),
        ("hashes", {}),
    ],
)
def test_a_line_of_another_run_is_refused(base, capsys, field, value):
    """A line that another tracker, policy, rule set, engine or configuration played is no line of this run."""
    path = base / "episodes.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    lines[2][field] = value
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    refused(base, capsys, "changed by hand", f"episode {lines[2]['index']} ")


@pytest.mark.parametrize(
    ("ended", "changes", "said"),
    [
        ("success", {"margin": -0.5}, "a success with a margin of -0.5"),
        ("success", {"progress": 0.1}, "a success with a progress of 0.1"),
        ("success", {"predicates": {"goal": None}}, "whose last predicate held first at None"),
        ("success", {"outcome": "timeout", "reason": "timeout"}, "a timeout after"),
        ("success", {"outcome": "fall", "reason": "fall"}, "a fall without the event fall"),
        ("fall", {"outcome": "success", "reason": "success"}, "a success with a margin of -"),
        ("fall", {"outcome": "timeout", "reason": "ball_out", "steps": 900}, "a timeout at step 900 after a fall"),
    ],
)
def test_a_line_that_contradicts_itself_is_refused(base, capsys, ended, changes, said):
    """An outcome that was edited without all that belongs to it stops whoever reads the folder."""
    path = base / "episodes.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    next(line for line in lines if line["outcome"] == ended).update(changes)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    refused(base, capsys, "changed by hand", said)


def test_a_finished_episode_stands_once(base, capsys):
    """A second line of an episode is taken after an error, and refused after any other end."""
    path = base / "episodes.jsonl"
    whole = path.read_text()
    first = json.loads(whole.splitlines()[0])
    path.write_text(whole + json.dumps(first | {"outcome": "success"}) + "\n")
    refused(base, capsys, "again after it had ended", "changed by hand")
    path.write_text(json.dumps(first | {"outcome": "error"}) + "\n" + whole)
    assert main(["report", str(base)], factories()) == 0
    assert main(["resume", str(base)], factories()) == 0


def test_numbers_of_two_episodes_are_not_exchanged(base, capsys):
    """Numbers follow from task, mode, seed and repeat; so does how many there are."""
    path = base / "episodes.jsonl"
    lines = sorted((json.loads(line) for line in path.read_text().splitlines()), key=lambda line: line["index"])
    lines[0]["index"], lines[1]["index"] = 1, 0
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    refused(base, capsys, "index is 1, this run's is 0")
    config_file = base / "config.json"
    document = json.loads(config_file.read_text())
    config_file.write_text(json.dumps(document | {"planned": 1000}))
    assert main(["report", str(base)], factories()) == 2
    assert "planned is 1000, the plan has 8" in capsys.readouterr().err


@pytest.mark.parametrize("raw", ["1" + "0" * 400, "-1" + "0" * 400])
@pytest.mark.parametrize("place", [("margin",), ("durations", "wall_s"), ("steps",), ("group_seed",)])
def test_integers_that_no_float_holds_are_refused(base, capsys, place, raw):
    """JSON's integers have no end; a record's do."""
    path = base / "episodes.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text(with_raw(json.loads(lines[0]), place, raw) + "\n" + "".join(lines[1:]))
    refused(base, capsys, "line 1", place[0])


@pytest.mark.parametrize(
    ("place", "raw"),
    [
        (("config", "mode"), "3"),
        (("config", "mode"), '"base"'),
        (("config", "mode"), "[3]"),
        (("config", "task"), "5"),
        (("config", "task"), "[[]]"),
        (("config", "seeds"), '"01"'),
        (("config", "seeds"), "[[0]]"),
        (("config", "repeats"), "true"),
        (("config", "repeats"), "2.0"),
        (("config", "max_steps"), "[1]"),
        (("config", "tracker"), "{}"),
        (("config", "tracker_facts"), '{"physics_dt": 1' + "0" * 400 + "}"),
        (("environments",), '{"football base": {"physics_dt": 1' + "0" * 400 + "}}"),
        (("environments",), '{"football base": {"a": [{"b": 1' + "0" * 400 + "}]}}"),
        (("planned",), "1" + "0" * 400),
    ],
)
def test_a_configuration_of_other_types_is_refused(base, capsys, place, raw):
    """Values of a configuration have the types that a run writes."""
    path = base / "config.json"
    path.write_text(with_raw(json.loads(path.read_text()), place, raw))
    refused(base, capsys, place[-1])


def test_options_of_other_types_still_give_a_report(base):
    """A report shows whatever the stored flags are; resume names the one that is wrong."""
    path = base / "config.json"
    document = json.loads(path.read_text())
    for values in ({"policy": ["a"], "max_steps": {"a": 1}, "worlds": 10**400}, {"remote_timeout": 10**400, "task": 3}):
        path.write_text(json.dumps(document | {"options": document["options"] | values}))
        assert main(["report", str(base)], factories()) == 0
        assert main(["resume", str(base)], factories()) == 2
