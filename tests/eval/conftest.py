"""Lets the tests of this folder import each other's stand-ins, and makes what several files read."""

import gc
import sys
from collections import defaultdict
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def made_suite(tmp_path_factory):
    """A suite of known outcomes."""
    from made_suites import plan, write_suite

    return write_suite(tmp_path_factory.mktemp("made") / "suite", plan())


@pytest.fixture(scope="session")
def cells(made_suite):
    """Its cells."""
    from arena_newton.eval.tables.evaluated_cells import read_cells

    return read_cells([made_suite])


@pytest.fixture(scope="module", autouse=True)
def small_strips():
    """Pictures of film strips have a sixteenth of their pixels."""
    from arena_newton.pictures.settings import STRIP_SIZES

    with pytest.MonkeyPatch.context() as patch:
        for name, size in STRIP_SIZES.items():
            patch.setitem(STRIP_SIZES, name, tuple(side // 8 * 2 for side in size))
        yield


@pytest.fixture(scope="module")
def narrow():
    """Vision encoders of packed policies have a quarter of their channels, whose numbers it gives."""
    from arena_newton.policies.learned import act_network

    widths = act_network.WIDTHS
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(act_network, "WIDTHS", tuple(width // 4 for width in widths))
        yield widths


@pytest.fixture(scope="module")
def narrow_resnet():
    """Vision encoders of LeRobot's checkpoints are narrow, too."""
    from tests.policies.checkpoints.made_checkpoints import install

    with pytest.MonkeyPatch.context() as patch:
        install(patch)
        yield


class Keepers(defaultdict):
    """Builder of environments (`Factories.env`) that hands out again what was closed: one keeper for each kind."""

    def __call__(self, task, **options):
        """The environment of a run; what is not given is the default."""
        said = {name: value for name, value in options.items() if value is not None and value is not False}
        said = {"rules": "paper", "mode": "base"} | said
        kind = {name: str(value) for name, value in sorted(said.items()) if name != "tracker"}
        return self[task, said["tracker"].name, str(kind)](task, **said)

    def drop(self):
        """Release all; their memory goes with the process, which has too much of it to search for garbage."""
        gc.freeze()
        for keeper in self.values():
            keeper.drop()


def keepers(kind):
    """Builder of environments of a kind, which all files share, and then its end."""
    from arena_newton.eval.play.env_cache import EnvCache

    made = Keepers(lambda: EnvCache(kind))
    yield made
    made.drop()


@pytest.fixture(scope="session")
def kept_worlds():
    """Environments that all files share."""
    from arena_newton.eval.play.env_cache import CachedEnv

    yield from keepers(CachedEnv)


@pytest.fixture(scope="session")
def watched_worlds():
    """Environments that all files share and that keep a hash of every tick."""
    from watched import LastingWatchedEnv

    yield from keepers(LastingWatchedEnv)


@pytest.fixture(scope="session")
def parts():
    """Parts of runs in environments that all files share and whose episodes soon succeed."""
    from quick_worlds import QuickEnv

    from arena_newton.eval.play.factories import Factories

    for made in keepers(QuickEnv):
        yield Factories(env=made)


@pytest.fixture(scope="session")
def boxed(watched_worlds):
    """An expert's first two episodes of boxing: a `Table` of its actions, hashes of the ticks, results."""
    from watched import Table, watched_rollout

    from arena_newton import policies

    table = Table()
    return table, *watched_rollout(watched_worlds, "boxing", 2, 2, policies.get("expert"), recorder=table)


@pytest.fixture
def push_crate():
    """Name of a registered task with an interaction, for which no saboteur and no seed was set."""
    import dataclasses

    from arena_newton import tasks

    like = tasks.get("vis_navi")
    carried = dataclasses.replace(like.interaction, carried=True)
    tasks.register(dataclasses.replace(like, name="push_crate", scene=like.layer, interaction=carried))
    yield "push_crate"
    tasks.unregister("push_crate")


@pytest.fixture
def damped(monkeypatch):
    """Plants a fault: drawn dynamics damp all joints as well."""
    from arena_newton.physics import batch

    honest = batch.varied

    def varied(model, robot, sample):
        own = honest(model, robot, sample)
        own.dof_damping[:] += 0.1
        return own

    return lambda: monkeypatch.setattr(batch, "varied", varied)
