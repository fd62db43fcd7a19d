"""Leaderboard: entries are held to their schema and their bundles, and the site shows what they say and no more."""

import dataclasses
import hashlib
import json
import re
import shutil
import tomllib
import zipfile
from html.parser import HTMLParser
from pathlib import Path

import pytest
from eval_fakes import FakePolicy, factories
from made_signals import signals
from made_suites import cell_of, write_suite

from arena_newton.eval.__main__ import main
from arena_newton.eval.audit import folder_audit
from arena_newton.eval.audit.draws import drawn
from arena_newton.eval.leaderboard.entry_file import BoardEntry
from arena_newton.eval.records.identity import config_hash

ROOT = Path(__file__).resolve().parents[3]
FLAGS = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "--repeats", "4"]
FLAGS += ["--tracker", "twist2", "sonic"]
KEYS = {"name": "Ours", "authors": "We", "date": "2026-11-26", "source": "here", "hardware": "a laptop"}
KEYS |= {"training_data": "none", "training": "none"}


class Page(HTMLParser):
    """Addresses and tags of a page."""

    def __init__(self, path):
        super().__init__()
        self.addresses, self.tags = [], []
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for key, value in attrs if key in ("href", "src")]


def fill(entry, **keys):
    """Give keys of an entry's file these values."""
    path = entry / "entry.toml"
    content = tomllib.loads(path.read_text()) | keys
    path.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in content.items()))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """An entry of a run of stand-ins."""
    folder = tmp_path_factory.mktemp("made")
    assert main([*FLAGS, "--out", str(folder / "run")], factories()) == 0
    assert main(["bundle", str(folder / "run"), "--out", str(folder / "ours"), "--actions", "3"]) == 0
    return folder / "ours"


@pytest.fixture
def entry(made, tmp_path):
    """A copy of it, filled in, to be changed."""
    copied = shutil.copytree(made, tmp_path / "ours")
    fill(copied, **KEYS)
    return copied


def build(entry, capsys, *flags):
    """Exit code of a build, what it printed, and its site."""
    capsys.readouterr()
    site = entry.parent / "site"
    code = main(["leaderboard", "build", str(entry), "--out", str(site), *flags], factories())
    said = capsys.readouterr()
    return code, said.out + said.err, site


def repacked(entry, change, method=zipfile.ZIP_STORED):
    """Change the members of a bundle, and its hash in the entry, as a forger does who knows both."""
    path = entry / "bundle.zip"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    fill(entry, bundle=hashlib.sha256(path.read_bytes()).hexdigest())


def test_an_entry_of_a_run_is_checked_and_shown(made, entry, capsys):
    """Bundle, build and page: rates, replays and the bundle are shown, all links are there; no entry is replaced."""
    assert main(["leaderboard", "build", str(entry), "--replay", "2"], factories()) == 2
    assert "give one by --draw" in capsys.readouterr().err
    assert main(["leaderboard", "build", str(entry), "--draw", "2"], factories()) == 2
    assert "--draw: draws the episodes of --replay; add it" in capsys.readouterr().err
    code, said, site = build(entry, capsys, "--replay", "2", "--draw", "7")
    assert code == 0 and "consistent, 4 rates" in said, said
    text = (site / "ours.html").read_text()
    assert "16 episodes, 2 played again, no contradiction" in text
    assert (site / "ours" / "bundle.zip").read_bytes() == (entry / "bundle.zip").read_bytes()
    for page in site.glob("*.html"):
        assert all((site / address).is_file() for address in Page(page).addresses), page
    other = shutil.copytree(entry, entry.parent / "other")
    fill(other, head="0" * 64)
    assert main(["bundle", str(made.parent / "run"), "--out", str(other)]) == 2
    assert "holds an entry of other runs already" in capsys.readouterr().err


def test_a_suite_of_numbered_trainings_is_bundled(made, tmp_path, capsys):
    """Cells of a plan's suite have the number of their training in their folder, as `all#1.twist2+sonic`."""
    cell = tmp_path / "suite" / "all#1.twist2+sonic" / "twist2"
    shutil.copytree(made.parent / "run", cell)
    assert main(["bundle", str(tmp_path / "suite"), "--out", str(tmp_path / "entry")]) == 0
    fill(tmp_path / "entry", **KEYS)
    code, said, _ = build(tmp_path / "entry", capsys)
    assert code == 0 and "consistent, 4 rates" in said, said


def filmed(run):
    """Give the run's lines strips and signals of failures, links and tables."""
    members = {"episodes.jsonl": (run / "episodes.jsonl").read_bytes()}
    lines = [json.loads(line) for line in members["episodes.jsonl"].splitlines()]
    (run / "strips").mkdir()
    for line in lines:
        line["signals"] = dataclasses.asdict(signals(engaged_ticks=0))
        line["media"]["world strip"] = f"strips/{line['index']}.jpg"
        (run / line["media"]["world strip"]).write_bytes(b"picture %d" % line["index"])
    relinked(members, lines)
    (run / "episodes.jsonl").write_bytes(members["episodes.jsonl"])
    assert main(["report", str(run)]) == 0
    return lines


def test_a_page_shows_conditions_failures_and_strips(tmp_path, capsys):
    """Drive, fast physics and weights other than those that ship are on the board; failures and strips on the page."""
    (tmp_path / "own.safetensors").write_bytes(b"own weights")
    flags = ["--task", "football", "--engine", "mujoco", "--seeds", "0", "--repeats", "9"]
    flags += ["--fast-physics", "--drive", "humanoidarena", "--checkpoint", str(tmp_path / "own.safetensors")]
    assert main([*flags, "--out", str(tmp_path / "run")], factories()) == 0
    lines = filmed(tmp_path / "run")
    assert main(["bundle", str(tmp_path / "run"), "--out", str(tmp_path / "ours"), "--strips", "9"]) == 0
    fill(tmp_path / "ours", **KEYS)
    code, said, site = build(tmp_path / "ours", capsys)
    assert code == 0, said
    weights = lines[0]["hashes"]["checkpoint"]
    board, page = ((site / name).read_text() for name in ("index.html", "ours.html"))
    unusual = f"drive humanoidarena, fast physics, seeds 0, 9 repeats of each, other weights {weights}"
    assert f"<small>{unusual}</small>" in board and weights in page
    outcomes = {line["outcome"] for line in lines}
    shown = Page(site / "ours.html").addresses
    pictures = {path for path in shown if path.endswith(".jpg")}
    assert len(pictures) == len(outcomes) > 1 and all((site / path).is_file() for path in pictures)
    stages = re.findall(r'data-label="([^"]+)">(\d+)</td>', page[page.index("<h2>Failures by stage") :])
    counts = {name: int(number) for name, number in stages}
    lost = sum(line["outcome"] != "success" for line in lines)
    assert counts.pop("episodes") == 9 and counts.pop("success") == 9 - lost and sum(counts.values()) == lost > 0


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"name": ""}, 'name is "", expected a name'),
        ({"name": "Ours\u200b"}, "expected a name of Latin letters"),
        ({"name": "\u202eOurs"}, "expected a name of Latin letters"),
        ({"name": "\u041eurs"}, 'name is "\\u041eurs", expected a name of Latin letters'),  # Cyrillic
        ({"name": "\u039furs"}, "expected a name of Latin letters"),  # Greek
        ({"name": "Our\u0455 \u2014 2"}, "expected a name of Latin letters"),
        ({"name": "\u0300"}, "expected a name of Latin letters"),  # a mark on nothing
        ({"trackers": ["tw\u0456st2", "sonic"]}, 'trackers is ["tw\\u0456st2", "sonic"], expected names of Latin'),
        ({"simulator": "\u0430rena_newton"}, "expected a name of Latin letters"),
        ({"authors": "We\u00ad"}, "expected a name that can be read"),
        ({"date": "yesterday"}, "date is"),
        ({"date": "2026-13-01"}, "date is"),
        ({"training_data": "secret"}, "training_data is"),
        ({"level": "proved"}, "level is"),
        ({"trackers": "twist2"}, "trackers is"),
        ({"bundle": ""}, "bundle is empty"),
        ({"level": "replayed"}, "checked is empty"),
        ({"colour": "red"}, "colour is not a key of an entry"),
        ({"numbers": "paper"}, "rows is empty"),
        ({"numbers": "paper", "rows": ["gpt"]}, 'rows: "gpt" is not in paper'),
        ({"numbers": "nothing.csv", "rows": ["act"]}, "nothing.csv: no such file"),
    ],
)
def test_an_unfit_entry_is_refused_by_file_and_key(entry, keys, named, capsys):
    """A key that is missing, unknown or unfit, or that a level needs, is one line with the file and the key; code 2."""
    fill(entry, **keys)
    code, said, _ = build(entry, capsys)
    assert code == 2 and named in said.splitlines()[-1] and str(entry) in said.splitlines()[-1], said


def test_an_entry_without_a_key_or_file_is_refused(entry, capsys):
    """Each key without a default is asked for by name; files that are missing or no TOML are named."""
    path = entry / "entry.toml"
    text = path.read_text()
    required = [one for one in BoardEntry.__dataclass_fields__ if one not in ("numbers", "rows", *vars(BoardEntry))]
    for key in required:
        path.write_text(re.sub(rf"^{key} = .*\n", "", text, flags=re.MULTILINE))
        code, said, _ = build(entry, capsys)
        assert code == 2 and f"{path}: {key} is missing" in said, said
    for damaged in ("name = ", f"rows = [1{'0' * 5000}]", f"rows = {'[' * 3000}{']' * 3000}"):
        path.write_text(damaged)
        code, said, _ = build(entry, capsys)
        assert code == 2 and f"{path}: not readable as TOML" in said, said
    path.write_text(text)
    (entry / "bundle.zip").unlink()
    assert "bundle.zip: no such file" in build(entry, capsys)[1]
    assert main(["leaderboard", "destroy"]) == 2


def won(members):
    lines = [json.loads(line) for line in members["episodes.jsonl"].splitlines()]
    line = next(line for line in lines if line["outcome"] != "success")
    line |= {"outcome": "success", "reason": "success", "margin": 0.3, "progress": 1.0}
    line["predicates"] = {name: line["steps"] for name in line["predicates"]}
    line["events"] = [event for event in line["events"] if event["kind"] != "fall"]
    relinked(members, lines)


def relinked(members, lines):
    before, texts = b"", []
    for one in lines:
        before = json.dumps(one | {"previous": hashlib.sha256(before).hexdigest()}).encode() + b"\n"
        texts.append(before)
    members["episodes.jsonl"] = b"".join(texts)


def older(members):
    """Lines said to be of a version that neither linked nor hashed them."""
    lines = [json.loads(line) | {"schema": 2} for line in members["episodes.jsonl"].splitlines()]
    gone = ("previous", "actions", "final_state", "shown")
    texts = (json.dumps({key: value for key, value in line.items() if key not in gone}) for line in lines)
    members["episodes.jsonl"] = "".join(f"{text}\n" for text in texts).encode()


def unfinished(members):
    """Failures left out of a run that is said to be cancelled."""
    lines = [json.loads(line) for line in members["episodes.jsonl"].splitlines()]
    relinked(members, [line for line in lines if line["outcome"] == "success"])
    content = json.loads(members["config.json"])
    members["config.json"] = json.dumps(content | {"status": content["status"] | {"state": "cancelled"}}).encode()


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (lambda entry: repacked(entry, won), "head is"),
        (lambda entry: repacked(entry, older), "a version without chain wrote its lines"),
        (lambda entry: repacked(entry, unfinished), "of 16 episodes; rates are of whole plans"),
        (lambda entry: repacked(entry, lambda m: m.update({sorted(m)[0]: b"x" * 99})), "contradiction"),
        (lambda entry: (entry / "bundle.zip").write_bytes(b"other"), "SHA-256 is"),
        (lambda entry: fill(entry, trackers=["twist2"]), "trackers are twist2, its numbers have sonic twist2"),
        (lambda entry: fill(entry, checkpoint="0123456789ab"), "checkpoint is"),
        (lambda entry: fill(entry, numbers="paper", rows=["act"]), "numbers of paper are not those of its bundle"),
        (lambda entry: fill(entry, simulator="Isaac Sim"), 'simulator is "Isaac Sim", its runs are of arena_newton'),
        (lambda entry: fill(entry, training_data="scripted"), "policy expert of its runs is not trained"),
    ],
    ids="outcome older unfinished actions bytes trackers weights numbers simulator data".split(),
)
def test_an_edited_result_is_found(entry, edit, named, capsys):
    """A changed outcome with its links, changed actions, bytes and statements contradict; no page is written."""
    edit(entry)
    code, said, site = build(entry, capsys)
    assert code == 1 and named in said and not site.exists(), said


def test_an_entry_is_of_one_policy_and_of_one_owner(made, entry, capsys):
    """Two policies in one place, of which a board would show the better, and another entry's episodes contradict."""
    both = shutil.copytree(made.parent / "run", made.parent / "both")
    assert main([*FLAGS, "--policy", "stand", "--out", str(both / "stand")], factories()) == 0  # below the other run
    assert main(["bundle", str(both), "--out", str(entry.parent / "both")]) == 0
    fill(entry.parent / "both", **KEYS)
    code, said, site = build(entry.parent / "both", capsys)
    assert code == 1 and said.count("base has two rates, of the policies") == 4 and not site.exists(), said
    assert (
        said.count("derived files not there") == 1 and "derived files not there, such as results.json. (2 runs)" in said
    )
    theirs = shutil.copytree(entry, entry.parent / "theirs")
    repacked(theirs, renamed)
    with zipfile.ZipFile(theirs / "bundle.zip") as archive:
        archive.extractall(entry.parent / "unpacked")
    fill(theirs, head=folder_audit.audited(entry.parent / "unpacked").head, name="Theirs")
    assert build(theirs, capsys)[0] == 0  # alone it is sound: what its owner renamed, nothing in it shows
    assert main(["leaderboard", "build", str(entry), str(theirs), "--out", str(site)]) == 1
    said = capsys.readouterr().out
    assert "theirs/bundle.zip: 8 of its runs and episodes are those of entry ours" in said, said
    for name in ("\uff2furs", "OURS", "\u00d6urs", " ou\u0301rs\u00a0"):  # of full width, of other case, with accents
        fill(theirs, name=name)
        assert main(["leaderboard", "build", str(entry), str(theirs), "--out", str(site)]) == 1
        named = f'theirs/entry.toml: name is {json.dumps(name)}, which reads as "Ours" of ours/entry.toml'
        assert named in capsys.readouterr().out
    shutil.copytree(theirs, entry.parent / "OURS")
    assert main(["leaderboard", "build", str(entry), str(entry.parent / "OURS")]) == 2
    assert "two entries of one name" in capsys.readouterr().err


def test_a_name_may_have_accents_and_pi(entry, capsys):
    """Accents, π and text of any alphabet where nothing is told apart by it are taken as they are."""
    fill(entry, name="π0.5, façade (ours)", authors="王涛文, Łukasz Ж.", training="Дома", training_data="none")
    code, said, _ = build(entry, capsys)
    assert code == 0, said


def test_runs_that_the_board_does_not_show_are_no_copies(tmp_path, capsys):
    """Copies of a run and runs beside a suite's cells, which make the draw of a forged one unlikely, are refused."""
    flags = ["--task", "football", "--engine", "mujoco", "--seeds", "0", "--repeats", "2"]
    assert main([*flags, "--out", str(tmp_path / "runs" / "shown")], factories()) == 0
    late = tmp_path / "runs" / "late"
    assert main([*flags, "--latency-ticks", "10", "--out", str(late)], factories()) == 0
    cell = dataclasses.replace(
        cell_of("expert", "expert", "twist2", "football", trained_on=(), tasks_of=()), spec="expert"
    )
    suite = write_suite(tmp_path / "suite", [(dataclasses.replace(cell, labels="v4", episodes=2), None)])
    shutil.copytree(tmp_path / "runs" / "shown", suite / cell.folder)
    for folder, copy, code, named in (
        (tmp_path / "runs", tmp_path / "runs" / "again", 1, "ours/bundle.zip: 2 of its runs are one, head "),
        (suite, suite / "more", 2, "of no run in it"),
    ):
        for number, expected in enumerate((0, code)):
            out = tmp_path / f"{folder.name}{number}" / "ours"
            assert main(["bundle", str(folder), "--out", str(out)]) == 0
            fill(out, **KEYS)
            found, said, _ = build(out, capsys)
            assert found == expected and (not number or named in said), said
            shutil.copytree(late, copy, dirs_exist_ok=True)


def renamed(members):
    """The runs of another under a policy of another name."""
    content = json.loads(members["config.json"])
    content["config"]["policy"] = content["options"]["policy"] = "mine"
    content["config_hash"] = hashed = config_hash(content["config"])
    lines = [json.loads(line) | {"policy": "mine"} for line in members["episodes.jsonl"].splitlines()]
    for line in lines:
        line["hashes"]["config"] = hashed
    members["config.json"] = json.dumps(content).encode()
    relinked(members, lines)


@pytest.fixture(scope="module")
def audited(made):
    """An entry of the run after an audit that played all its episodes again and asked the policy."""
    entry = made.parent / "audited" / "ours"
    asked = ["--all", "--policy", "expert", "--out", str(entry)]
    assert main(["audit", str(made.parent / "run"), *asked], factories()) == 0
    for _ in range(2):  # made again, an entry keeps what was filled in
        assert main(["bundle", str(made.parent / "run"), "--out", str(entry)]) == 0
        fill(entry, checked="eval audit --all", **KEYS)
    return entry


def stated(entry, **keys):
    """Change what audit.json says of the run."""
    path = entry / "audit.json"
    ((name, content),) = json.loads(path.read_text()).items()
    path.write_text(json.dumps({name: content | keys}))


def test_a_level_is_what_the_evidence_gives(audited, tmp_path, capsys):
    """An audit next to an entry gives the bundle its actions and the entry its level; the page says what it covers."""
    entry = shutil.copytree(audited, tmp_path / "ours")
    assert tomllib.loads((entry / "entry.toml").read_text())["level"] == "re-run"
    code, said, site = build(entry, capsys, "--replay", "16", "--draw", "1")
    assert code == 0 and "ours: re-run, 4 rates" in said, said
    covered = "audit.json: 16 of 16 episodes played again. That finds any forged line. Policy expert was asked again"
    assert covered in (site / "ours.html").read_text()
    stated(entry, policy=None, asked=None)
    fill(entry, level="replayed")
    assert build(entry, capsys)[0] == 0


@pytest.mark.parametrize(
    ("forge", "named"),
    [
        (lambda entry: (entry / "audit.json").unlink(), "gives consistent: there is no audit.json"),
        (lambda entry: stated(entry, head="0" * 64), "gives consistent: audit.json: head of no run is "),
        (lambda entry: stated(entry, contradictions=["steps"]), "gives consistent: audit.json: contradictions: steps"),
        (lambda entry: stated(entry, played=[]), "gives consistent: audit.json: played is not all episodes"),
        (lambda entry: stated(entry, played=[0, 0]), "gives consistent: audit.json: played is not all episodes"),
        (lambda entry: picked(entry), "played is not what draw 7 draws by the head"),
        (lambda entry: few(entry), "gives consistent: audit.json: played is 2 episodes, expected at least 16"),
        (lambda entry: repacked(entry, actions_left_out), "gives consistent: bundle.zip: actions of episode "),
        (lambda entry: stated(entry, policy=None), "gives replayed: audit.json: asked is 16 of 16 episodes"),
        (lambda entry: stated(entry, asked=15), "gives replayed: audit.json: asked is 15 of 16 episodes"),
        (
            lambda entry: stated(entry, policy="stand"),
            'replayed: audit.json: policy is "stand", its run has "expert"',
        ),
        (lambda entry: stated(entry, tolerance=1.0), "gives replayed: audit.json: tolerance is 1, expected at most"),
        (lambda entry: stated(entry, asked_policy=None), "audit.json: asked_policy: policy is null, expected"),
        (lambda entry: asked_of(entry, policy="stand"), 'asked_policy: policy is "stand", expected "expert"'),
        (lambda entry: asked_of(entry, policy_file="0" * 12), "config.json: policy_file is null, of the policy itself"),
        (lambda entry: asked_of(entry, labels="v4"), 'config.json: labels is "v3.1", of the policy itself "v4"'),
        (
            lambda entry: asked_of(entry, policy_facts={"privileged": True, "weights": "0" * 12}, code="0" * 12),
            "config.json: policy_facts: privileged is null, of the policy itself true",
        ),
        (lambda entry: stated(entry, asked="16"), 'audit.json: asked is "16", expected'),
        (lambda entry: stated(entry, played=[-1]), "audit.json: played is [-1], expected"),
        (lambda entry: (entry / "audit.json").write_text('{"run": 1}'), "expected an object of runs"),
        (lambda entry: (entry / "audit.json").write_text('{"run": {"tolerance": NaN}}'), "NaN is not JSON"),
        (lambda entry: (entry / "audit.json").write_bytes(b"\xff"), "not readable as JSON"),
    ],
    ids="none head faults empty repeated picked few unpacked unasked part other lax unnamed kind file labels facts "
    "text low shape nan raw".split(),
)
def test_a_level_without_its_evidence_is_refused(audited, tmp_path, forge, named, capsys):
    """An entry that claims more than bundle and audit.json give is one line with file and field, code 2, no page."""
    entry = shutil.copytree(audited, tmp_path / "ours")
    forge(entry)
    code, said, site = build(entry, capsys)
    assert code == 2 and named in said and str(entry) in said.splitlines()[-1] and not site.exists(), said


def asked_of(entry, **names):
    """The policy that was asked is said to have other names."""
    ((_, content),) = json.loads((entry / "audit.json").read_text()).items()
    stated(entry, asked_policy=content["asked_policy"] | names)


def few(entry):
    """Two episodes played again alone, truly drawn."""
    with zipfile.ZipFile(entry / "bundle.zip") as archive:
        archive.extractall(entry.parent / "run")
    (found,) = [folder_audit.audited(entry.parent / "run")]
    stated(entry, draw=7, played=[one.index for one in drawn([found], 2, 7)[0]], asked=2)


def picked(entry):
    """Two episodes played again that the draw, which comes of the head and so of the code, did not choose."""
    few(entry)
    ((_, content),) = json.loads((entry / "audit.json").read_text()).items()
    stated(entry, played=[number for number in range(16) if number not in content["played"]][:2])


class Kin(FakePolicy):
    """A policy of other code."""


def entry_of_three(runs, entry, policy):
    """An entry of three runs of which twenty episodes were played again, none of the second; audits, and the number."""
    few = ["--task", "football", "--engine", "mujoco", "--seeds", "0", "--repeats", "1", "--mode", "semantic"]
    assert main([*few, "--out", str(runs / "semantic")], factories(policy=policy)) == 0
    audits = [folder_audit.audited(runs / name) for name in ("base", "semantic", "visual")]
    draw = next(number for number in range(99) if not drawn(audits, 20, number)[1])
    asked = ["--replay", "20", "--draw", str(draw), "--policy", "expert", "--out", str(entry)]
    assert main(["audit", str(runs), *asked], factories()) == 0
    assert main(["bundle", str(runs), "--out", str(entry)]) == 0
    fill(entry, checked="eval audit", **KEYS)
    return audits, draw


def test_a_level_is_of_all_runs_together(made, tmp_path, capsys):
    """Episodes are drawn over all runs of an entry; their actions alone come along, and those of one run earn less."""
    runs, entry = tmp_path / "runs", tmp_path / "ours"
    shutil.copytree(made.parent / "run", runs / "base")
    assert main([*FLAGS, "--repeats", "6", "--mode", "visual", "--out", str(runs / "visual")], factories()) == 0
    audits, draw = entry_of_three(runs, entry, FakePolicy)
    assert "3 runs: level re-run" in capsys.readouterr().out
    with zipfile.ZipFile(entry / "bundle.zip") as archive:
        assert sum(name.endswith(".npz") for name in archive.namelist()) == 20
    code, said, site = build(entry, capsys, "--replay", "2", "--draw", "1")
    assert code == 0 and "ours: re-run, 9 rates" in said, said
    text = (site / "ours.html").read_text()
    assert "41 episodes, 2 played again" in text and "20 of 41 episodes played again, by draw" in text
    content = json.loads((entry / "audit.json").read_text())
    alone = {str(runs / "visual"): [one.index for one in drawn(audits[2:], 20, draw)[0]]}
    for name, run in content.items():  # twenty that the number draws by the head of one run, and none of the others
        run |= {"played": (played := alone.get(name, [])), "asked": len(played)}
    (entry / "audit.json").write_text(json.dumps(content))
    code, said, _ = build(entry, capsys)
    assert code == 2 and f"played is not what draw {draw} draws by the head of all runs" in said
    shutil.rmtree(runs / "semantic")
    entry_of_three(runs, tmp_path / "kin", Kin)  # a run of another policy, of which no episode was drawn
    fill(tmp_path / "kin", level="re-run")
    assert "evidence gives replayed: config.json: policy_facts: " in build(tmp_path / "kin", capsys)[1]


def actions_left_out(members):
    """Actions of one episode not in the bundle."""
    members.pop(next(name for name in members if name.startswith("actions/")))


def test_a_bundle_stays_in_its_folder(entry, capsys):
    """A member of a bundle with another path or kind is refused, and nothing is written outside."""
    for name in ("../escaped.json", "/escaped.json", "actions/../../escaped.npz", "run.sh"):
        repacked(entry, lambda members, name=name: members.update({name: b"{}"}))
        code, said, _ = build(entry, capsys)
        assert code == 2 and "is no file of a bundle" in said, said
        assert not list(entry.parent.parent.rglob("escaped.*"))


@pytest.mark.parametrize("name", ["other/strips/1.jpg", "actions/99999.npz", "other/episodes.jsonl", "suite.x.jsonl"])
def test_a_member_of_no_run_is_refused(entry, name, capsys):
    """A file of a bundle that none of its runs names is refused by its name: nothing would check it."""
    repacked(entry, lambda members: members.update({name: b"{}"}))
    code, said, site = build(entry, capsys)
    assert code == 2 and f'{entry / "bundle.zip"}: "{name}" is of no run in it' in said and not site.exists(), said


def test_weights_are_of_a_training(tmp_path, capsys):
    """A policy whose runs name weights was trained: an entry that says otherwise contradicts them."""

    class Weighty(FakePolicy):
        def describe(self):
            return {"name": self.name, "weights": "0123456789ab"}

    flags = ["--task", "football", "--engine", "mujoco", "--repeats", "1", "--policy", "learned"]
    flags += ["--out", str(tmp_path / "run")]
    assert main(flags, factories(policy=Weighty)) == 0
    assert main(["bundle", str(tmp_path / "run"), "--out", str(tmp_path / "ours")]) == 0
    fill(tmp_path / "ours", **KEYS)
    code, said, site = build(tmp_path / "ours", capsys)
    assert code == 1 and 'training_data is "none", the policy of its runs has weights' in said and not site.exists()


def test_nothing_else_is_overwritten(made, entry, capsys):
    """A page that no build wrote stays, and so do results: both folders are refused by their flag."""
    site = entry.parent / "site"
    for name in ("index.html", "ours.html"):
        site.mkdir()
        (site / name).write_text("<title>Diary</title>")
        code, said, _ = build(entry, capsys)
        assert code == 2 and f"--out {site}: {name} is of something else" in said, said
        assert [path.read_text() for path in site.iterdir()] == ["<title>Diary</title>"]
        shutil.rmtree(site)
    assert [build(entry, capsys)[0] for _ in range(2)] == [0, 0]
    run = made.parent / "run"
    for out in (run, run / "entry"):
        assert main(["bundle", str(run), "--out", str(out)]) == 2
        assert f"--out {out}: is in the results" in capsys.readouterr().err
    assert not (run / "bundle.zip").exists() and not (run / "entry").exists()


def test_what_is_damaged_in_a_bundle_is_named_by_it(entry, capsys):
    """A message about a file of a bundle names the bundle, not the folder into which it was unpacked."""
    for name, said in (("config.json", "no results folder"), ("episodes.jsonl", "/episodes.jsonl: no such file")):
        copied = shutil.copytree(entry, entry.parent / name)
        repacked(copied, lambda members, name=name: members.pop(name))
        assert f"error: {copied / 'bundle.zip'}" in (found := build(copied, capsys)[1]) and said in found


def test_a_bundle_is_deflated_and_has_a_plain_name(entry, capsys):
    """A bundle packed by another method than deflate, and an entry whose page would leave the site, are refused."""
    repacked(entry, lambda members: members.update({"config.json": b" " * 50_000_000}), zipfile.ZIP_BZIP2)
    code, said, _ = build(entry, capsys)
    assert code == 2 and "is packed by method 12, expected deflate or none" in said, said
    assert "letters, digits and _ . -" in build(entry / "..", capsys)[1]


def test_a_bundle_may_be_elsewhere(entry, capsys):
    """An entry with numbers of a table and the hash of a bundle that is not there is listed, and says so."""
    fill(entry, numbers="paper", rows=["act"])
    (entry / "bundle.zip").unlink()
    code, said, site = build(entry, capsys)
    assert code == 2 and "level is consistent, its evidence gives self-reported: no bundle.zip is there" in said
    fill(entry, level="self-reported")
    code, said, site = build(entry, capsys)
    assert code == 0 and "is not part of this board" in said
    assert "is not part of this board" in (site / "ours.html").read_text()


def test_text_of_an_entry_stays_text(entry, capsys):
    """Hostile words of an entry add no element and no address to the pages."""
    _, _, site = build(entry, capsys)
    harmless = [Page(path).tags for path in sorted(site.glob("*.html"))]
    fill(entry, name="<script>alert(1)</script>", source="<img src=//a.example>", training="{{ 7 * 7 }}\"'><a href=x>")
    _, _, site = build(entry, capsys)
    assert [Page(path).tags for path in sorted(site.glob("*.html"))] == harmless
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in (site / "index.html").read_text()
