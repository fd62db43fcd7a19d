"""Audits accuse no honest folder, and find forgeries at the level at which they can be found."""

import dataclasses
import hashlib
import json
import re
import shutil
from collections import Counter
from math import comb

import mujoco
import numpy as np
import pytest
import torch
from eval_fakes import FakeEnv, FakePolicy, factories, fake_tracker, last_tick
from made_folders import stored

from arena_newton import policies
from arena_newton.eval.__main__ import main
from arena_newton.eval.audit import folder_audit
from arena_newton.eval.audit.draws import drawn, found_probability
from arena_newton.eval.records.chain import head, joint_head
from arena_newton.eval.records.journal import read_journal
from arena_newton.eval.workers.shard_merge import merge
from arena_newton.files.untrusted_files import array_digest
from arena_newton.interfaces import Chunk
from arena_newton.kernels import tick as codes
from arena_newton.pictures.settings import CameraConfig
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from benchmarks.audits.forgeries import FORGERIES, TABLES, forge, journal_lines, level_of, write_lines

FLAGS = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "3", "--repeats", "5"]
FLAGS += ["--tracker", "twist2", "sonic"]


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """A run of forty episodes through two trackers, `run`, and its two shards."""
    folder = tmp_path_factory.mktemp("audit")
    assert main([*FLAGS, "--out", str(folder / "run")], factories()) == 0
    for part in ("1/2", "2/2"):
        assert main([*FLAGS, "--worlds", "3", "--shard", part, "--out", str(folder / part[0])], factories()) == 0
    return folder


@pytest.fixture
def folder(honest, tmp_path):
    """A copy of the run, to be changed."""
    return shutil.copytree(honest / "run", tmp_path / "run")


def audit(folder, capsys, *flags):
    """Exit code of an audit, and its contradictions."""
    capsys.readouterr()
    code = main(["audit", str(folder), *flags])
    found = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  contradiction: ")]
    return code, found


def test_the_head_is_the_same_whoever_played(honest, tmp_path, capsys):
    """Order, worlds and shards change the links and not the head, which stands in results, tables and reports."""
    merge([honest / "1", honest / "2"], tmp_path / "m")
    names = json.loads((honest / "run" / "results.json").read_text())["head"]
    for name in ("results.json", "table.md", "report.md", "report.html"):
        texts = [(folder / name).read_text() for folder in (honest / "run", tmp_path / "m")]
        assert texts[0] == texts[1] and names in texts[0], name
    links = [[line["previous"] for line in journal_lines(f)] for f in (honest / "run", tmp_path / "m")]
    assert links[0] != links[1] and audit(tmp_path / "m", capsys, "--head", names) == (0, [])
    assert {path.name for path in (tmp_path / "m" / "actions").iterdir()} == {"twist2", "sonic"}
    capsys.readouterr()
    assert main(["report", str(tmp_path / "m"), "--table"]) == 0
    assert f"Head of 1 journal: {names}." in capsys.readouterr().out
    records, _ = read_journal(honest / "run" / "episodes.jsonl")
    assert head(sorted(records, key=lambda one: one.index)) == names


def test_honest_folders_are_not_accused(honest, tmp_path, capsys):
    """Finished, sharded, resumed and interrupted runs, with errors, without actions and moved, contradict nothing."""
    flags = ["--task", "football", "--engine", "mujoco", "--repeats", "3", "--no-actions", "--failures"]
    assert main([*flags[:-1], "--out", str(tmp_path / "bare")], factories()) == 0
    cut = shutil.copytree(honest / "run", tmp_path / "cut")
    (cut / "episodes.jsonl").write_bytes(b"".join((cut / "episodes.jsonl").read_bytes().splitlines(True)[:-7]))
    assert main(["resume", str(cut)], factories()) == 0
    for one in (honest, tmp_path):
        code = main(["audit", str(one), "--out", str(tmp_path / "pages")])
        said = capsys.readouterr().out
        assert code == 0 and "contradictions 0" in said and "level consistent" in said, said
    assert "6 episodes cannot be replayed" not in said and "9 episodes cannot be replayed" in said
    page, content = ((tmp_path / "pages" / f"audit.{end}").read_text() for end in ("md", "json"))
    assert all(level in page and level in content for level in ("self-reported", "consistent", "replayed", "re-run"))


def test_each_tracker_plays_its_own_episodes_again(honest, tmp_path, capsys):
    """A replay of a run through two trackers meets all of its lines; one without actions has nothing to play."""
    assert main(["audit", str(honest / "run"), "--all"], factories()) == 0
    assert "replayed 40 of 40, contradictions 0" in capsys.readouterr().out
    bare = shutil.copytree(honest / "run", tmp_path / "bare", ignore=shutil.ignore_patterns("actions"))
    numbers = set()
    for _ in range(2):  # the owner cannot know the number that draws
        assert main(["audit", str(bare), "--replay", "2"], factories()) == 0
        said = capsys.readouterr().out
        assert "replayed 0 of 40" in said
        numbers.add(int(said.removeprefix("--draw ").partition(":")[0]))
    assert len(numbers) == 2


def test_a_forged_run_among_many_is_found_as_often_as_said(honest, tmp_path, capsys):
    """Drawn over all runs, episodes find the forged lines of one with the printed probability, and accuse no other."""
    root = shutil.copytree(honest, tmp_path / "runs")
    forge(root / "2", FORGERIES["every failure made a success"])
    assert main(["audit", str(root), "--all"], factories()) == 1
    said = capsys.readouterr().out
    forged = {int(number) for number in re.findall(r"runs/2/episodes.jsonl: episode (\d+): outcome", said)}
    assert said.count("contradictions 0") == 2 and "3 runs: level self-reported" in said and len(forged) > 3, said
    audits = [folder_audit.audited(root / name) for name in ("1", "2", "run")]
    draws = [drawn(audits, 6, number) for number in range(3000)]
    found = [any(record.index in forged for record in records) for _, records, _ in draws]
    said_of_it, exact = found_probability(len(forged) / 80, 6), 1 - comb(80 - len(forged), 6) / comb(80, 6)
    assert abs(np.mean(found) - exact) < 0.05 and 0 < exact - said_of_it < 0.03, (np.mean(found), exact, said_of_it)
    often = Counter((run, record.index) for chosen in draws for run in range(3) for record in chosen[run])
    assert len(often) == 80 and np.abs(np.array(list(often.values())) - 3000 * 6 / 80).max() < 80, often
    other = drawn(audits[::-1], 6, 7)[::-1]  # folders of other names, in another order
    assert [[one.index for one in records] for records in other] == [[r.index for r in records] for records in draws[7]]
    for number in (found.index(True), found.index(False)):
        asked = ["--replay", "6", "--draw", str(number)]
        assert main(["audit", str(root), *asked], factories()) == int(found[number])
        said = capsys.readouterr().out
        level = "self-reported" if found[number] else "replayed"
        assert f"3 runs: level {level}, " in said and "episodes 80 of 80, replayed 6 of 80" in said, said
        assert said.count("6 episodes played again: that finds a forged line with 6% if 1% are forged") == 1, said


def test_the_head_of_many_runs_is_held(honest, tmp_path, capsys):
    """The head that was published with the numbers of several runs is theirs together; another one contradicts."""
    audits = [folder_audit.audited(honest / name) for name in ("1", "2", "run")]
    joint = joint_head([one.head for one in audits])
    assert audit(honest, capsys, "--head", joint, "--out", str(tmp_path)) == (0, [])
    page = (tmp_path / "audit.md").read_text()
    assert (
        page.startswith("# Audit\n\n## 3 runs: consistent\n") and f"| head | {joint} |\n| episodes | 80 of 80" in page
    )
    assert audit(honest, capsys, "--head", audits[0].head) == (
        1,
        [f"  contradiction: {honest}: head is {joint}, published was {audits[0].head}"],
    )


def test_a_window_is_no_contradiction(honest, capsys):
    """A replay shows a tracker with a lookahead another window than the run did: it is refused by name, not accused."""

    def seeing(spec, checkpoint):
        made = fake_tracker(spec, checkpoint)
        made.lookahead = 2 if spec == "sonic" else 0
        return made

    assert main(["audit", str(honest / "run"), "--all"], factories(tracker=seeing)) == 2
    assert "tracker sonic reads the coming reference, which recorded actions do not hold" in capsys.readouterr().err


def test_older_journals_are_marked(tmp_path, capsys):
    """A folder of every older version is read and reported as unchained."""
    for schema in (1, 2):
        code = main(["audit", str(stored(schema, tmp_path / str(schema)))])
        said = capsys.readouterr().out
        assert code == 0 and "head unchained" in said and "Unchained: a line was written by a version" in said, said


def test_bad_input_is_one_line_and_code_2(tmp_path, capsys):
    """A folder without a run, and a journal that is none, are refused in a line."""
    assert main(["audit", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"error: {tmp_path}: no results folder (it has no config.json)\n"


@pytest.mark.parametrize("flags", [["--draw", "7"], ["--draw", "7", "--all"], ["--replay", "1", "--all"]])
def test_a_flag_that_would_be_ignored_is_refused(honest, flags, capsys):
    """A number that draws nothing, and a number of episodes where all are played, are one line with the flag."""
    assert main(["audit", str(honest / "run"), *flags]) == 2
    assert capsys.readouterr().err.startswith(f"error: {flags[0]}")


def with_file(name, content):
    """Damage: a file of the folder with other bytes; none: it is gone."""

    def damage(folder):
        path = folder / name
        path.unlink()
        if content is not None:
            path.write_bytes(content)

    return damage


def with_options(folder):
    """Damage: the flags name another kind of policy than the configuration."""
    content = json.loads((folder / "config.json").read_text())
    content["options"]["policy"] = "process:touch /tmp/started"
    (folder / "config.json").write_text(json.dumps(content))


def by_other_code(folder):
    """Damage: a table that no CSV reader takes, of other code."""
    with_file("results.json", None)(folder)
    with_file("table.csv", b"task\n" + b"a" * 200_000)(folder)


@pytest.mark.parametrize(
    ("damage", "code", "named"),
    [
        (with_file("episodes.jsonl", None), 2, "run/episodes.jsonl: no such file"),
        (with_file("config.json", b""), 2, "run/config.json: cannot be read as the configuration of a run"),
        (with_file("episodes.jsonl", b"\xff\xfe\n{}\n"), 2, "run/episodes.jsonl: line 1 is not a JSON object"),
        (with_file("results.json", b'{"cells": NaN}'), 1, "run/results.json: is not what journal and"),
        (with_file("actions/sonic/boxing_base_s0_r0.npz", b"hello"), 1, "boxing_base_s0_r0.npz: not a readable NPZ"),
        (by_other_code, 1, "run/table.csv: its figures are not those of the journal"),
        (with_options, 1, 'run/config.json: config: policy is "expert", its options have "process:touch /tmp/started"'),
    ],
    ids="journal config bytes nan actions csv policy".split(),
)
def test_a_damaged_folder_is_named(folder, capsys, damage, code, named):
    """A file that is gone, empty, no text or no archive is one line with its name, and code 2, or 1 where it lies."""
    damage(folder)
    assert main(["audit", str(folder)]) == code
    said = capsys.readouterr()
    lines = said.err.splitlines() if code == 2 else [one for one in said.out.splitlines() if "contradiction: " in one]
    assert len(lines) == 1 and named in lines[0], lines


def test_bytes_that_are_no_line_are_said(folder, capsys):
    """Bytes that a kill left behind the last whole line of a journal are not read, and an audit says so."""
    with (folder / "episodes.jsonl").open("ab") as journal:
        journal.write(b"[1, 2]\n")
    assert main(["audit", str(folder)]) == 0
    assert "The last 7 bytes of episodes.jsonl are no whole line: they were not read." in capsys.readouterr().out


REPLAYED = {"a larger margin", "a predicate and progress", "final state", "what the policy was shown"}
REPLAYED |= {"a failure made a success", "every failure made a success", "a success under the seed of a failure"}
REPLAYED |= {"weights of trackers, with all hashes", "an environment, with its hash"}
REPLAYED |= {"code and an environment, with all hashes", "a success whose actions were not kept"}
REPLAYED |= {"a fall made one in the start-up", "lines of an older version, and a success"}
REPLAYED |= {"trackers of the policy's training", "labels of the policy", "weights of the policy, with all hashes"}
REPLAYED |= {"a run of an older version, and a margin"}
LEVEL = dict.fromkeys(REPLAYED, "replay")
LEVEL |= dict.fromkeys(("a timeout to an error", "a line dropped, unfinished", "actions changed, with hash"), "head")
LEVEL |= {"the worst group seed left out of the plan": "head"}
LEVEL |= {"another drive in tables and flags": "head"}
"""Means that find a forgery, where lines alone do not; the world of these tests heeds no action."""


def test_a_link_in_a_folder_is_not_followed(folder, tmp_path, capsys):
    """Derived files behind a link are not looked through, however many there are."""
    shutil.rmtree(folder / "original")
    (folder / "original").symlink_to(tmp_path)
    code, found = audit(folder, capsys)
    assert code == 1 and len(found) == 1 and "/original: is a link; a run writes inside its own folder only" in found[0]


@pytest.mark.parametrize("name", [name for name in FORGERIES if name != "signals of a failure"])
def test_forgeries_are_found(folder, name):
    """A forger who makes links and tables again is found by the lines, by a replay or by the published head."""
    published = json.loads((folder / "results.json").read_text())["head"]
    forge(folder, FORGERIES[name], tables=name not in TABLES)
    level, found = level_of(folder, published, factories=factories())
    assert bool(found) and level == LEVEL.get(name, "lines"), found


def test_a_page_of_another_template_is_no_edited_page(folder, capsys):
    """Another style, markup or sentence of a report's page is a note; a changed figure or outcome contradicts."""
    page = folder / "report.html"
    text = page.read_text()
    other = text.replace("<style>", "<style>p { color: red }").replace('class="', 'class="new ')
    page.write_text(other.replace("</main>", "<p>A sentence of another template.</p></main>"))
    assert main(["audit", str(folder)]) == 0
    assert "report.html was written with another template: the figures and names in" in capsys.readouterr().out
    for old, new in ((r">\d+\.\d ", ">99.9 "), (">timeout<", ">success<")):
        page.write_text(re.sub(old, new, other, count=1))
        assert page.read_text() != other, old
        code, found = audit(folder, capsys)
        assert code == 1 and len(found) == 1 and "report.html: is not what journal and configuration give" in found[0]


def test_pages_of_other_code_are_no_edited_pages(folder, capsys):
    """Reports that other code of this version worded are named, not accused, as long as the tables have the figures."""
    content = json.loads((folder / "results.json").read_text())
    content.pop("written_by")
    content["more"] = 1
    (folder / "results.json").write_text(json.dumps(content))
    with (folder / "report.md").open("a") as page:
        page.write("A sentence of other code.\n")
    code, found = audit(folder, capsys)
    assert code == 0, found
    assert main(["audit", str(folder)]) == 0
    assert "Written by other code, not compared: report.md." in capsys.readouterr().out
    (folder / "results.json").write_text(json.dumps(content | {"cells": []}))
    assert audit(folder, capsys)[1][0].endswith("results.json: its cells or suites are not those of the journal")
    (folder / "results.json").write_text("{")  # no code can be read: no excuse
    assert len(audit(folder, capsys)[1]) == 2


class Other(FakePolicy):
    """A policy that decides otherwise; recordings are played as they are."""

    def act(self, observation):
        chunk = super().act(observation)
        return chunk if self.name.startswith("replay:") else Chunk(chunk.actions + 0.5)


class Losing(FakeEnv):
    """A world in which nobody succeeds."""

    def step(self, action, worlds=None):
        status = super().step(action, worlds)
        return np.where(status == codes.SUCCESS, codes.FALL, status)


def test_actions_of_another_policy_are_found(honest, capsys):
    """The policy is asked again at its own queries: the run's own decides as recorded, another one is found."""
    asked = ["audit", str(honest / "run"), "--replay", "6", "--draw", "7", "--policy", "stand"]
    assert main(asked, factories()) == 0
    said = capsys.readouterr().out
    assert "level re-run" in said and "actions are equal to the bit" in said and "47% if 10% are forged" in said
    assert main([*asked, "--tolerance", "0.4"], factories(policy=Other)) == 1
    said = capsys.readouterr().out
    assert said.count("at tick 0 the policy decides otherwise; actions differ by up to 0.5") == 6
    assert main([*asked, "--tolerance", "0.5"], factories(policy=Other)) == 0


def test_a_metric_that_no_recorder_gave_is_found(tmp_path, capsys):
    """A replay with the run's recorders holds lines with and without a metric to what they measure."""
    run, made = tmp_path / "run", factories(recorders=last_tick)
    assert main([*FLAGS[:5], "--seeds", "0", "--repeats", "4", "--out", str(run)], made) == 0
    lines = journal_lines(run)
    (index,) = [i for i, line in enumerate(lines) if line["outcome"] == "fall"][:1]
    assert main(["audit", str(run), "--all"], made) == 0
    lines[index]["extra"] = {"last_tick": 3.0}
    write_lines(run, lines)
    assert main(["report", str(run)]) == 0
    capsys.readouterr()
    assert main(["audit", str(run), "--all"], made) == 1
    assert 'extra is {"last_tick": 3.0}, its actions give {}' in capsys.readouterr().out


def rewritten(folder, lines, **arrays):
    """Other arrays in the file of an episode's actions, with their hash."""
    path = folder / lines[0]["media"]["actions"]
    with np.load(path) as stored:
        content = dict(stored) | arrays
    np.savez_compressed(path, **content)
    lines[0]["actions"] = array_digest(content)


def test_hostile_actions_are_one_line(folder, capsys):
    """A hash of actions without their file's path contradicts, and queries that are no numbers are code 2."""
    forge(folder, lambda folder, lines: lines[0].update(media={}))
    assert main(["audit", str(folder), "--all"], factories()) == 1
    assert ": its actions are null, expected actions/" in capsys.readouterr().out
    forge(folder, lambda folder, lines: rewritten(folder, lines[1:], queries=np.array(["x"])))
    assert main(["audit", str(folder), "--all"], factories()) == 2
    assert "queries holds <U1, expected numbers" in capsys.readouterr().err


def test_a_rate_that_new_seeds_do_not_have_is_found(honest, capsys):
    """New episodes on seeds of the auditor: the claimed rate is confirmed, one that is far off contradicts."""
    fresh = ["audit", str(honest / "run"), "--policy", "stand", "--fresh", "100"]
    assert main(fresh, factories()) == 0
    said = capsys.readouterr().out
    assert said.count("Fresh episodes: ") == 4 and "level consistent" in said and "fresh 400" in said
    assert main(fresh, factories(env=Losing)) == 1
    assert "0 of 100 succeed on group seed" in capsys.readouterr().out


@pytest.mark.parametrize(
    "flags",
    [
        *[("--policy", "stand"), ("--fresh", "3"), ("--tolerance", "-1"), ("--replay", "-1"), ("--fresh", "-1")],
        *[("--tolerance", "inf"), ("--tick-tolerance", "nan"), ("--velocity-tolerance", "-1")],
    ],
)
def test_flags_that_do_nothing_are_refused(honest, capsys, flags):
    """A flag that lacks its other one, or is out of range, is a line and code 2."""
    assert main(["audit", str(honest / "run"), *flags], factories()) == 2
    assert capsys.readouterr().err.startswith(f"error: {flags[0]}")


@pytest.mark.parametrize(
    ("change", "number"),
    [
        (lambda lines: lines[4].update(finished_at="2026-01-01"), 6),
        (lambda lines: lines.pop(4), 5),
        (lambda lines: lines[9].pop("previous"), 10),
    ],
    ids=["changed", "dropped", "unlinked"],
)
def test_a_broken_link_is_named(folder, capsys, change, number):
    """A line that was changed or dropped without its links breaks the next one, whatever it says."""
    lines = journal_lines(folder)
    change(lines)
    write_lines(folder, lines, link=False)
    code, found = audit(folder, capsys)
    assert code == 1 and any(f"line {number} is not linked to line {number - 1}: " in line for line in found), found


def test_lines_of_an_older_form_are_marked(folder, capsys):
    """A line said to be of the form before, which hashes neither pictures nor states, is noted."""

    def older(folder, lines):
        lines[0] |= {"schema": 3, "final_state": None, "shown": None}
        lines[0]["actions"] = hashlib.sha256((folder / lines[0]["media"]["actions"]).read_bytes()).hexdigest()

    forge(folder, older)
    main(["audit", str(folder)])
    assert "1 episode without a hash of what the policy was shown: not compared." in capsys.readouterr().out


class Seeing(FakePolicy):
    """A policy that stands, sees a small picture, and moves its first joint by how bright that is."""

    needs_image = True
    camera = CameraConfig(width=32, height=24, fit="native")
    chunk_size = 4

    def act(self, observation):
        actions = torch.tensor(STAND_ACTION).repeat(len(observation.mask), self.chunk_size, 1)
        actions[:, :, ACTION["joint_pos"].start] += observation.image.float().mean(dim=(1, 2, 3))[:, None] / 2550
        return Chunk(actions)


def test_pictures_are_drawn_again(parts, tmp_path, capsys):
    """A replay draws with its stored camera what the policy was shown; one shown more, or asked less, is found."""
    made = dataclasses.replace(
        parts, policy=lambda spec, **options: (policies.get if spec.startswith("replay") else Seeing)(spec, **options)
    )
    flags = ["run", "--task", "football", "--policy", "stand", "--engine", "mujoco", "--repeats", "2", "--seeds", "0"]
    assert main([*flags, "--out", str(tmp_path / "run")], made) == 0
    assert main(["audit", str(tmp_path / "run"), "--all"], made) == 0
    assert main(["audit", str(tmp_path / "run"), "--all", "--policy", "stand"], made) == 0
    assert "level re-run" in capsys.readouterr().out
    other = shutil.copytree(tmp_path / "run", tmp_path / "other")
    forge(other, lambda folder, lines: rewritten(folder, lines, queries=np.zeros(1, np.int32)))
    assert main(["audit", str(other), "--all", "--policy", "stand"], made) == 1
    assert "no query of the policy gave the action at tick 4\n" in capsys.readouterr().out
    forge(tmp_path / "run", lambda folder, lines: shown_otherwise(folder))
    assert main(["audit", str(tmp_path / "run"), "--all"], made) == 1
    assert capsys.readouterr().out.count("shown is") == 2


def shown_otherwise(folder):
    """The policy is said to have had another camera."""
    content = json.loads((folder / "config.json").read_text())
    content["environments"]["football twist2 base"]["cameras"]["front"]["width"] = 28
    (folder / "config.json").write_text(json.dumps(content, indent=2) + "\n")


def test_ticks_of_engine_warp_are_checked_one_by_one(parts, tmp_path, capsys):
    """States that engine warp recorded follow from each other on engine mujoco; a step aside between two is found."""
    run, bare = tmp_path / "run", tmp_path / "bare"
    flags = ["run", "--task", "football", "--policy", "stand", "--engine", "warp", "--device", "cpu", "--seeds", "0"]
    flags += ["--repeats", "2", "--worlds", "2"]
    assert main([*flags, "--out", str(bare)], parts) == 0
    assert main([*flags, "--record", "--record-cameras", "--out", str(run)], parts) == 0
    assert main(["audit", str(bare), "--all"], parts) == 2
    assert "ticks are checked one by one where states were recorded (--record)" in capsys.readouterr().err
    assert main(["audit", str(run), "--all"], parts) == 0
    said = capsys.readouterr().out
    assert "level replayed" in said and "each tick was checked on mujoco" in said
    path = next((run / "episodes").glob("*repeat0000.npz"))
    with np.load(path) as stored:
        arrays = dict(stored)
    ticks = len(arrays["arena_qvel"])
    for name, at, by, said in (
        ("arena_qvel", 0, 2.0 * (np.arange(ticks) == 7), "m/s or rad/s from what mujoco gives"),
        ("arena_qvel", 0, 2.0 * (np.arange(ticks) == 0), "velocities of its first state are 2 m/s"),
        ("arena_qvel", -5, 0.9 * (np.arange(ticks) == 7), "until tick 6 a body that nothing moved got 0.8"),
        ("arena_qpos", 0, 0.003 * np.arange(ticks), "positions added up over a second from tick 0 on are 0.0"),
        ("arena_qpos", 0, 0.05 * (np.arange(ticks) >= 7), "positions after tick 6 are 0.05 m from what mujoco gives"),
    ):
        forged = {name: arrays[name].copy(), "arena_final_qpos": arrays["arena_final_qpos"].copy()}
        forged[name][:, at] += by
        forged["arena_final_qpos"][0] += by[-1] * (name == "arena_qpos")
        np.savez_compressed(path, **arrays | forged)
        assert main(["audit", str(run), "--all"], parts) == 1
        assert said in capsys.readouterr().out
    forged = {name: arrays[name].copy() for name in ("arena_qpos", "arena_qvel")}
    turned = np.zeros(3)  # a ball that rolls from the first state on: each tick follows from the one before
    mujoco.mju_rotVecQuat(turned, np.array([0.0, 0.12 / 0.11, 0.0]), arrays["arena_qpos"][0, -4:] * [1, -1, -1, -1])
    forged["arena_qvel"][:, -6:] += [0.12, 0.0, 0.0, *turned]
    forged["arena_qpos"][:, -7] += 0.12 * 0.02 * np.arange(ticks)
    np.savez_compressed(path, **arrays | forged)
    forge(run, FORGERIES["weights of trackers, with all hashes"])
    assert main(["audit", str(run), "--all"], parts) == 1
    said = capsys.readouterr().out
    assert "until tick 0 a body that nothing moved got 0.11 m/s" in said and "config: checkpoint is" in said, said
    for ticks, code in ((6, 1), (0, 2)):
        few = {name: arrays[name][:ticks] for name in ("arena_qpos", "arena_qvel")}
        np.savez_compressed(path, **arrays | few | {"arena_final_qpos": arrays["arena_qpos"][ticks]})
        assert main(["audit", str(run), "--all"], parts) == code
        said = "".join(capsys.readouterr())
        assert f"states of its first {ticks} ticks alone" in said or "arena_qvel holds no tick" in said
