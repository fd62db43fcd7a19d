"""Front ends, which training and deployment share."""

import pytest
import torch

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.robot.g1 import MUJOCO_JOINTS, TWIST2_DRIVE
from arena_newton.trackers import RobotState, TrackerCommand, base
from arena_newton.trackers.front_end import ActionForm, residual_form
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.sonic import SonicFrontEnd
from arena_newton.trackers.twist2 import Twist2FrontEnd

FRONTS = {
    "twist2": Twist2FrontEnd,
    "twist2_residual": lambda: Twist2FrontEnd(residual_form(TWIST2_DRIVE)),
    "sonic": SonicFrontEnd,
}
SIDES = torch.tensor(
    [MUJOCO_JOINTS.index(n.replace("left", "?").replace("right", "left").replace("?", "right")) for n in MUJOCO_JOINTS]
)
SIGNS = torch.tensor([-1.0 if "roll" in n or "yaw" in n else 1.0 for n in MUJOCO_JOINTS])


def mirrored(command: TrackerCommand, state: RobotState) -> tuple[TrackerCommand, RobotState]:
    """The same tick seen in a mirror: y points the other way, left is right."""

    def joints(x):
        return x[:, SIDES] * SIGNS

    turn, spin = torch.tensor([1.0, -1.0, 1.0, -1.0]), torch.tensor([-1.0, 1.0, -1.0])
    mimic = torch.cat([command.mimic[:, :6] * torch.tensor([1.0, -1, 1, -1, 1, -1]), joints(command.mimic[:, 6:])], 1)
    return (
        TrackerCommand(mimic, joints(command.joints), joints(command.joint_vel), command.quat * turn),
        RobotState(state.quat * turn, state.ang_vel_body * spin, joints(state.joint_pos), joints(state.joint_vel)),
    )


@pytest.mark.parametrize("name", FRONTS)
def test_mirror(name):
    """In a mirrored world the observation is the mirror image, and so are the targets of a mirrored action."""
    left, right = FRONTS[name](), FRONTS[name]()
    for front in (left, right):
        front.bind(3)
        front.reset()
    rng = torch.Generator().manual_seed(0)
    for _ in range(4):
        c, s = (
            [torch.randn(3, n, generator=rng) for n in (35, 29, 29, 4)],
            [torch.randn(3, n, generator=rng) for n in (4, 3, 29, 29)],
        )
        c[3], s[0] = torch.nn.functional.normalize(c[3]), torch.nn.functional.normalize(s[0])
        command, state = TrackerCommand(*c), RobotState(*s)
        raw = 3.0 * torch.randn(3, 29, generator=rng)
        seen = left.observe(command, state).clone()
        torch.testing.assert_close(right.observe(*mirrored(command, state)), left.mirror_obs()(seen))
        targets = right.act(left.mirror_action()(raw))
        torch.testing.assert_close(targets, left.act(raw)[:, SIDES] * SIGNS)


@pytest.mark.parametrize("name", FRONTS)
def test_ticks_outlive_inference_mode(name):
    """Buffers serve a training loop: ticks inside and outside inference mode mix, and gradients stay out."""
    front = FRONTS[name]()
    front.bind(2)
    front.reset()
    command = TrackerCommand(torch.zeros(2, 35), torch.zeros(2, 29), torch.zeros(2, 29), torch.eye(4)[:2])
    state = RobotState(torch.eye(4)[:2], torch.zeros(2, 3), torch.zeros(2, 29), torch.zeros(2, 29))
    layer = torch.nn.Linear(front.obs_width, 29)
    with torch.inference_mode():
        front.act(layer(front.observe(command, state)))
        front.reset(torch.tensor([True, False]))
    kept = front.observe(command, state).clone()
    assert not front.act(layer(front.obs)).requires_grad
    layer(kept).sum().backward()
    assert layer.weight.grad is not None


def test_action_forms():
    """An action form with another kind, another number of scales or a negative clip is refused."""
    for arguments in (("torque", (1.0,) * 29), ("default", (1.0,)), ("residual", (1.0,) * 29, -1.0)):
        with pytest.raises(InputError, match="action form"):
            ActionForm(*arguments)


@pytest.mark.parametrize("name", ["twist2", "sonic"])
def test_symmetric_weights_answer_the_mean_of_both_ways(name):
    """A deployed action is the mean of the network's and the mirrored one of the mirrored observation."""
    weights = weights_file.load(base.weights_path(name), name)
    tracker = trackers.get(name)
    tracker.bind(4)
    tracker.observation().copy_(torch.randn(4, tracker.front_end.obs_width, generator=torch.Generator().manual_seed(0)))
    if name == "sonic":  # its front end writes ten equal frames, and zeros where nothing is read
        seen = tracker.observation()
        for start, width in ((4, 29), (294, 29), (595, 6)):
            frames = 11 if width == 6 else 10
            seen[:, start : start + frames * width] = seen[:, start : start + width].repeat(1, frames)
    obs, mirror = tracker.observation().clone(), (tracker.front_end.mirror_obs(), tracker.front_end.mirror_action())
    assert weights.symmetric
    with torch.no_grad():
        mean = 0.5 * (weights.network(obs) + mirror[1](weights.network(mirror[0](obs))))
    torch.testing.assert_close(tracker._runner.run(), mean, atol=2e-4, rtol=1e-3)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("name", ["twist2", "sonic"])
def test_graph_of_a_tick_is_the_tick(name):
    """On CUDA a tick held in a graph gives the targets of the tick run as it is, resets in between included."""
    held, plain = (trackers.get(name) for _ in range(2))
    for tracker in (held, plain):
        tracker.bind(5, "cuda")
    plain._graph = None
    assert held._graph is not None
    rng = torch.Generator(device="cuda").manual_seed(0)
    for tick in range(6):
        c = [torch.randn(5, n, generator=rng, device="cuda") for n in (35, 29, 29, 4)]
        s = [torch.randn(5, n, generator=rng, device="cuda") for n in (4, 3, 29, 29)]
        c[3], s[0] = torch.nn.functional.normalize(c[3]), torch.nn.functional.normalize(s[0])
        targets = [t.step(TrackerCommand(*c), RobotState(*s)).clone() for t in (held, plain)]
        torch.testing.assert_close(*targets)
        if tick == 3:
            for tracker in (held, plain):
                tracker.reset(torch.tensor([True, False, False, True, False], device="cuda"))
