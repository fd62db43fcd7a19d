"""A tick of some worlds leaves the histories of the others alone, bit for bit, for every tracker."""

import pytest
import torch
from onnx_files import twist2_like
from test_sonic import official_like

from arena_newton import trackers
from arena_newton.trackers import RobotState, Tracker, TrackerCommand
from arena_newton.trackers.front_end import FrontEnd, NetworkTracker
from arena_newton.trackers.interface import ActionForm
from arena_newton.trackers.sonic import SonicFrontEnd
from arena_newton.trackers.twist2 import Twist2FrontEnd

WORLDS = 3
ONLY = torch.tensor([False, True, False])
FRONTS = {"twist2": Twist2FrontEnd, "sonic": SonicFrontEnd}


def inputs(seed: int, device: str = "cpu") -> tuple[TrackerCommand, RobotState]:
    rng = torch.Generator().manual_seed(seed)

    def draw(width):
        return torch.randn(WORLDS, width, generator=rng).to(device)

    quat, target = (torch.nn.functional.normalize(draw(4)) for _ in range(2))
    return TrackerCommand(draw(35), draw(29), draw(29), target), RobotState(quat, draw(3), draw(29), draw(29))


def check(stepped: Tracker, still: Tracker, device: str = "cpu") -> None:
    """World 1 of `stepped` takes three ticks more than in `still`, the first of them at its start."""
    only = ONLY.to(device)
    for tracker in (stepped, still):
        tracker.bind(WORLDS, device)
    for extra in (100, 200, 300):
        stepped.step(*inputs(extra, device), only)
        for tick in range(2):
            answers = [tracker.step(*inputs(extra + tick, device)).clone() for tracker in (stepped, still)]
            assert torch.equal(answers[0][~only], answers[1][~only])
    held = still.step(*inputs(7, device)).clone()
    assert not torch.equal(stepped.step(*inputs(7, device))[only], held[only])


@pytest.mark.parametrize("name", ["twist2", "sonic"])
def test_own_weights(name):
    """Our weights: worlds 0 and 2 answer as if world 1 had not been stepped."""
    check(trackers.get(name), trackers.get(name))


@pytest.mark.parametrize("name", ["twist2", "sonic"])
def test_official_files(name, tmp_path):
    """Official ONNX files: worlds 0 and 2 answer as if world 1 had not been stepped."""
    file = twist2_like(tmp_path / "like.onnx") if name == "twist2" else official_like(tmp_path / "sonic", levels=16)
    check(trackers.get(name, file), trackers.get(name, file))


def test_package_from_outside(falcon):
    """FALCON's package: worlds 0 and 2 answer as if world 1 had not been stepped."""
    torch.manual_seed(0)
    network = torch.nn.Linear(falcon.FRAMES * falcon.FRAME, 29)
    check(*(NetworkTracker(falcon.FalconFrontEnd(), network) for _ in range(2)))


def test_pd_has_no_history():
    """The PD tracker takes a mask and answers the reference."""
    command, state = inputs(0)
    assert trackers.get("pd").step(command, state, ONLY) is command.joints


@pytest.mark.parametrize("name", FRONTS)
def test_all_true_is_no_mask(name):
    """A mask of all worlds gives the bits of no mask, in answers and observations."""
    plain, masked = trackers.get(name), trackers.get(name)
    for tracker in (plain, masked):
        tracker.bind(WORLDS)
    for tick in range(4):
        expected = plain.step(*inputs(tick))
        assert torch.equal(masked.step(*inputs(tick), torch.ones(WORLDS, dtype=torch.bool)), expected)
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
        stepped.observe(*inputs(50 + tick))
        stepped.act(torch.randn(WORLDS, 29), ONLY)
        seen = [front.observe(*inputs(tick)).clone() for front in fronts]
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
