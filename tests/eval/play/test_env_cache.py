"""One environment for runs that follow each other, or for modes: episodes are the same to the last bit."""

import dataclasses
import json

import pytest

from arena_newton import trackers
from arena_newton.eval.__main__ import main
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play.env_cache import EnvCache
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.play.run_flow import group_of
from arena_newton.eval.suites.suite_records import read_events, read_suite

SUITE = """
[defaults]
seeds = 0
repeats = 3
worlds = 2
max_steps = 12
engine = "mujoco"
[matrix]
tasks = ["boxing"]
modes = ["base", "visual", "execution"]
[[policies]]
name = "expert"
spec = "expert"
[[policies]]
name = "still"
modes = "base"
spec = "stand"
[[policies]]
name = "again"
spec = "expert"
modes = "base"
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Folder of a suite of five cells that were played in one environment, and that environment's cache."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "five.toml").write_text(SUITE)
    cache = EnvCache()
    assert main(["matrix", str(folder / "five.toml"), "--out", str(folder / "out")], Factories(env=cache)) == 0
    cache.drop()
    return folder / "out", cache


def ends(path):
    """Ends of the episodes of a journal, with every number that physics decides."""
    keys = "index episode_seed outcome reason steps margin progress phases predicates events".split()
    return [{key: json.loads(line)[key] for key in keys} for line in path.read_text().splitlines()]


def test_episodes_do_not_know_what_ran_before(played, tmp_path):
    """A cell in a used environment equals a run in one of its own, bit for bit, and one environment was built."""
    out, cache = played
    assert cache.built == 1
    assert [cell.status for cell in read_suite(out).cells] == ["done"] * 5
    flags = "--task boxing --seeds 0 --repeats 3 --worlds 2 --max-steps 12 --engine mujoco --policy stand".split()
    assert main(["run", *flags, "--out", str(tmp_path / "alone")]) in (0, 1)
    alone = ends(tmp_path / "alone" / "episodes.jsonl")
    assert len(alone) == 3 and len({line["margin"] for line in alone}) == 3
    first, still, again = (ends(out / f"{n}/twist2/boxing/base/episodes.jsonl") for n in ("expert", "still", "again"))
    assert still == alone and first == again != still  # the first cell began in a new one


@pytest.fixture(scope="module")
def modes(kept_worlds, tmp_path_factory):
    """Plays modes with some flags into a folder of a name."""
    flags = "--task boxing --seeds 0 --repeats 3 --worlds 2 --max-steps 12 --engine mujoco --record --actions".split()
    out = tmp_path_factory.mktemp("modes")

    def play(name, *played):
        said = ["run", *flags, "--policy", "expert", "--mode", *played, "--out", str(out / name)]
        assert main(said, Factories(env=kept_worlds)) == 0
        return out / name

    return play


def lines(*folders, but=("index",)):
    """Lines of journals without some keys, times and hash of the plan, by mode and repeat."""
    found = [json.loads(line) for at in folders for line in (at / "episodes.jsonl").read_text().splitlines()]
    for line in found:
        for key in (*but, "durations", "started_at", "finished_at", "previous"):
            del line[key]
        del line["hashes"]["config"]
    return sorted(found, key=lambda line: (line["mode"], line["repeat"]))


def test_modes_of_one_scene_play_in_one_batch(modes):
    """Episodes of three modes in one batch have the journal lines and recordings, bit for bit, of each by itself."""
    together = modes("together", "base", "visual", "execution")
    alone = [modes(name, name) for name in ("base", "visual", "execution")]
    assert lines(together) == lines(*alone) and len(lines(together)) == 9
    assert len({line["margin"] for line in lines(together)}) == 6  # a light moves nothing
    files = {path.relative_to(at): path.read_bytes() for at in alone for path in at.glob("*/**/*.[nm]p[z4]")}
    assert len(files) == 9 * 3 and len(set(files.values())) == 9 * 3
    for name, written in files.items():
        assert (together / name).read_bytes() == written, name
    environments = json.loads((together / "config.json").read_text())["environments"]
    assert list(environments) == [f"boxing twist2 {mode}" for mode in ("base", "visual", "execution")]


def test_cells_of_one_scene_play_in_one_batch(played, modes):
    """Cells of a suite in three modes have the lines and actions, bit for bit, of runs of one mode each."""
    out, _ = played
    names = ("base", "visual", "execution")
    cells = [out / f"expert/twist2/boxing/{name}" for name in names]
    alone = [modes(name, name) for name in names]
    pictures = ("media", "video")
    assert lines(*cells, but=pictures) == lines(*alone, but=pictures) and len(lines(*cells)) == 9
    for cell, run in zip(cells, alone, strict=True):
        files = {path.name: path.read_bytes() for path in (cell / "actions").iterdir()}
        assert files == {path.name: path.read_bytes() for path in (run / "actions").iterdir()} and len(files) == 3
        assert json.loads((cell / "config.json").read_text())["config"]["mode"] == [cell.name]
    began = [event.cell for event in read_events(out) if event.event == "begun"][:3]
    ended = next(number for number, event in enumerate(read_events(out)) if event.event == "done")
    assert began == [f"expert/twist2/boxing/{name}" for name in names] and ended == 3


@pytest.mark.parametrize(
    ("change", "semantic", "base"),
    [
        ({}, "semantic", "base execution visual"),
        ({"worlds_matter": True}, "semantic", "base"),
        ({"policy_facts": {"privileged": True}}, "semantic", "base execution visual"),
        ({"policy_facts": {"privileged": True, "code": "of another package"}}, "semantic", "base"),
        ({"viewer": "usd"}, "semantic", "base"),
    ],
)
def test_modes_that_play_together(change, semantic, base):
    """Modes with one scene, unless the policy could take one for another or a viewer shows them."""
    played = ("base", "semantic", "execution", "visual")
    options = RunOptions(task=("boxing",), mode=played, seeds=(0,), repeats=1, engine="mujoco")
    config = resolve(dataclasses.replace(options, viewer=change.pop("viewer", None)))
    groups = [group_of(dataclasses.replace(config, **change), one) for one in config.episodes]
    assert groups[:2] == [("boxing", "twist2", base), ("boxing", "twist2", semantic)]
    assert (groups[2] == groups[0]) == (groups[3] == groups[0]) == (base != "base")


class Stub:
    """An environment that holds nothing."""

    def __init__(self, task, **options):
        """Take what the cache passes on."""

    def end(self):
        """Nothing to release."""


def test_another_environment_is_built():
    """Another number of worlds, another scene or what was dropped is built again; the same is handed out again."""
    cache, pd = EnvCache(Stub), trackers.get("pd")
    first = cache("boxing", tracker=pd, worlds=1, mode="base")
    assert cache("boxing", tracker=trackers.get("pd"), worlds=1, mode="base") is first and cache.built == 1
    for worlds, mode in ((2, "base"), (1, "semantic"), (1, "base")):
        last = first
        first = cache("boxing", tracker=pd, worlds=worlds, mode=mode)
        assert first is not last
    assert cache("boxing", tracker=pd, worlds=1, mode="visual") is first and first.mode == "visual"
    assert cache.built == 4
    cache.drop()
    assert cache("boxing", tracker=pd, worlds=1, mode="base") is not first
