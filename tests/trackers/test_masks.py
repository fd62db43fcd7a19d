"""A tick of some worlds leaves the histories of the others alone, bit for bit, for every tracker."""

import pytest
import torch
from made_inputs import inputs, rows
from onnx_files import twist2_like
from test_sonic import official_like

from arena_newton import trackers
from arena_newton.trackers import Tracker
from arena_newton.trackers.front_end import FrontEnd, NetworkTracker
from arena_newton.trackers.interface import ActionForm
from arena_newton.trackers.sonic import SonicFrontEnd
from arena_newton.trackers.twist2 import Twist2FrontEnd

WORLDS = 3
ONLY = torch.tensor([False, True, False])
FRONTS = {"twist2": Twist2FrontEnd, "sonic": SonicFrontEnd}


def check(stepped: Tracker, still: Tracker, device: str = "cpu") -> None:
    """World 1 of `stepped` takes three ticks more than in `still`, the first of them at its start."""
    only = ONLY.to(device)
    for tracker in (stepped, still):
        tracker.bind(WORLDS, device)
    for extra in (100, 200, 300):
        stepped.step(*inputs(extra, WORLDS, device), only)
        for tick in range(2):
            answers = [tracker.step(*inputs(extra + tick, WORLDS, device)).clone() for tracker in (stepped, still)]
            assert torch.equal(answers[0][~only], answers[1][~only])
    held = still.step(*inputs(7, WORLDS, device)).clone()
    assert not torch.equal(stepped.step(*inputs(7, WORLDS, device))[only], held[only])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Kind and name of a tracker → its checkpoint: our weights, or files like the official ones."""
    folder = tmp_path_factory.mktemp("official")
    twist2, sonic = twist2_like(folder / "like.onnx"), official_like(folder / "sonic", levels=16)
    return {"own twist2": None, "own sonic": None, "official twist2": twist2, "official sonic": sonic}


KINDS = pytest.mark.parametrize("kind", ["own twist2", "own sonic", "official twist2", "official sonic"])


@KINDS
def test_masks_of_worlds(files, kind):
    """Worlds 0 and 2 answer as if world 1 had not been stepped."""
    check(*(trackers.get(kind.split()[1], files[kind]) for _ in range(2)))


@KINDS
def test_worlds_do_not_mix(files, kind):
    """Twenty worlds, three, and one alone, in any order, give the same bits, also after a reset of some."""
    order = torch.randperm(20, generator=torch.Generator().manual_seed(3))
    groups = [torch.arange(20), order, order[:3], order[7:8]]
    bound = [trackers.get(kind.split()[1], files[kind]) for _ in groups]
    for tracker, group in zip(bound, groups, strict=True):
        tracker.bind(len(group))
    for tick in range(5):
        command, state = inputs(tick, 20)
        targets = []
        for tracker, group in zip(bound, groups, strict=True):
            if tick == 0:
                tracker.prefill(rows(command, group), rows(state, group), group % 2 == 0)
            if tick == 3:
                tracker.reset(group % 3 == 0)
            targets.append(tracker.step(rows(command, group), rows(state, group)).clone())
        for group, got in zip(groups, targets, strict=True):
            assert torch.equal(got, targets[0][group])


def test_package_from_outside(falcon):
    """FALCON's package: worlds 0 and 2 answer as if world 1 had not been stepped."""
    torch.manual_seed(0)
    network = torch.nn.Linear(falcon.FRAMES * falcon.FRAME, 29)
    check(*(NetworkTracker(falcon.FalconFrontEnd(), network) for _ in range(2)))


def test_pd_has_no_history():
    """The PD tracker takes a mask and answers the reference."""
    command, state = inputs(0, WORLDS)
    assert trackers.get("pd").step(command, state, ONLY) is command.joints


@pytest.mark.parametrize("name", FRONTS)
def test_all_true_is_no_mask(name):
    """A mask of all worlds gives the bits of no mask, in answers and observations."""
    plain, masked = trackers.get(name), trackers.get(name)
    for tracker in (plain, masked):
        tracker.bind(WORLDS)
    for tick in range(4):
        expected = plain.step(*inputs(tick, WORLDS))
        assert torch.equal(masked.step(*inputs(tick, WORLDS), torch.ones(WORLDS, dtype=torch.bool)), expected)
        assert torch.equal(plain.observation(), masked.observation())


@pytest.mark.parametrize("name", FRONTS)
def test_front_end_histories(name):
    """The observation of a world that sat out ticks is the one of a world that did not have them."""
    fronts: list[FrontEnd] = [FRONTS[name](ActionForm("default", (0.5,) * 29)) for _ in range(2)]
    for front in fronts:
        front.bind(WORLDS)
        front.reset()
    stepped, still = fronts
    for tick in range(4):
        stepped.observe(*inputs(50 + tick, WORLDS))
        stepped.act(torch.randn(WORLDS, 29), ONLY)
        seen = [front.observe(*inputs(tick, WORLDS)).clone() for front in fronts]
        assert torch.equal(seen[0][~ONLY], seen[1][~ONLY])
        for front in fronts:
            front.act(torch.full((WORLDS, 29), float(tick)))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("name", FRONTS)
def test_graphs_on_cuda(name):
    """On CUDA ticks with and without a mask each have a graph and share their histories."""
    stepped, still = trackers.get(name), trackers.get(name)
    check(stepped, still, "cuda")
    assert set(stepped._graph._graphs) == {False, True}
