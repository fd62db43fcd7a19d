"""One environment for runs that follow each other: episodes are the same to the last bit."""

import json

import pytest

from arena_newton import trackers
from arena_newton.eval.__main__ import main
from arena_newton.eval.play.env_cache import EnvCache
from arena_newton.eval.play.run import Factories
from arena_newton.eval.suites.suite_records import read_suite

SUITE = """
[defaults]
seeds = 0
repeats = 3
worlds = 2
max_steps = 12
engine = "mujoco"
[matrix]
tasks = ["boxing"]
[[policies]]
name = "expert"
spec = "expert"
[[policies]]
name = "still"
spec = "stand"
[[policies]]
name = "again"
spec = "expert"
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Folder of a suite of three cells that were played in one environment, and that environment's cache."""
    folder = tmp_path_factory.mktemp("suite")
    (folder / "three.toml").write_text(SUITE)
    cache = EnvCache()
    assert main(["matrix", str(folder / "three.toml"), "--out", str(folder / "out")], Factories(env=cache)) == 0
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
    assert [cell.status for cell in read_suite(out).cells] == ["done"] * 3
    flags = "--task boxing --seeds 0 --repeats 3 --worlds 2 --max-steps 12 --engine mujoco --policy stand".split()
    assert main(["run", *flags, "--out", str(tmp_path / "alone")]) in (0, 1)
    alone = ends(tmp_path / "alone" / "episodes.jsonl")
    assert len(alone) == 3 and len({line["margin"] for line in alone}) == 3
    first, still, again = (ends(out / f"{n}/twist2/boxing/base/episodes.jsonl") for n in ("expert", "still", "again"))
    assert still == alone and first == again != still  # the first cell began in a new one


class Stub:
    """An environment that holds nothing."""

    def __init__(self, task, **options):
        """Take what the cache passes on."""

    def end(self):
        """Nothing to release."""


def test_another_environment_is_built():
    """Another number of worlds, another mode or what was dropped is built again; the same is handed out again."""
    cache, pd = EnvCache(Stub), trackers.get("pd")
    first = cache("boxing", tracker=pd, worlds=1, mode="base")
    assert cache("boxing", tracker=trackers.get("pd"), worlds=1, mode="base") is first and cache.built == 1
    for worlds, mode in ((2, "base"), (1, "visual"), (1, "base")):
        last = first
        first = cache("boxing", tracker=pd, worlds=worlds, mode=mode)
        assert first is not last
    assert cache.built == 4
    cache.drop()
    assert cache("boxing", tracker=pd, worlds=1, mode="base") is not first
