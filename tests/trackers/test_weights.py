"""Weights files carry a network and all that a tracker must know about it; anything else is refused in one line."""

import dataclasses
import json

import pytest
import torch
from made_inputs import inputs
from safetensors.torch import save_file

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.robot.g1 import SONIC_DRIVE, TWIST2_DRIVE, PhysicsRate
from arena_newton.trackers import base
from arena_newton.trackers.front_end import residual_form
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.inference.networks import InputNorm
from arena_newton.trackers.interface import get
from arena_newton.trackers.sonic import SONIC_FORM, SonicFrontEnd
from arena_newton.trackers.twist2 import Twist2FrontEnd

CARD = {"commit": "abc", "samples": 12, "licences": ["CC0"]}
RATE = PhysicsRate(dt=0.005, substeps=4)


def trained(name: str, seed: int = 0):
    """A network with input statistics that are far from the identity."""
    torch.manual_seed(seed)
    network = get(name).make_network()
    for _ in range(2):
        network.update_norm(3.0 + 2.0 * torch.randn(64, network.obs_width))
    form, drive = (residual_form(TWIST2_DRIVE), TWIST2_DRIVE) if name == "twist2" else (SONIC_FORM, SONIC_DRIVE)
    return weights_file.Weights(name, network, form, drive, RATE, CARD)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    for interface in ("twist2", "sonic"):
        weights_file.save(folder / f"{interface}.safetensors", trained(interface))
    return folder


@pytest.mark.parametrize("interface", ["twist2", "sonic"])
def test_round_trip(files, interface):
    """A saved file is loaded as it was: tensors, action form, drive, physics, card; it is at most 8 MB."""
    path = files / f"{interface}.safetensors"
    saved, loaded = trained(interface), weights_file.load(path, interface)
    x = torch.randn(3, saved.network.obs_width)
    assert torch.equal(saved.network(x), loaded.network(x))
    for name in ("interface", "action_form", "drive", "physics", "card"):
        assert getattr(loaded, name) == getattr(saved, name)
    assert path.stat().st_size <= 8_000_000 and len(loaded.sha256) == 64
    assert not list(files.glob("*.part"))


@pytest.mark.parametrize("interface", ["twist2", "sonic"])
def test_tracker(files, interface):
    """`--checkpoint x.safetensors` drives the robot as front end, network and action form of the file say."""
    tracker = trackers.get(interface, files / f"{interface}.safetensors")
    tracker.bind(3)
    weights = trained(interface)
    front = (Twist2FrontEnd if interface == "twist2" else SonicFrontEnd)(weights.action_form)
    front.bind(3)
    front.reset()
    for tick in range(4):
        command, state = inputs(tick, 3)
        with torch.no_grad():
            expected = front.act(weights.network(front.observe(command, state)))
        torch.testing.assert_close(tracker.step(command, state), expected, atol=2e-4, rtol=1e-4)
    assert tracker.drive == weights.drive and tracker.physics_rate == tracker.fast_physics_rate == RATE
    assert tracker.card == CARD and tracker.name == interface
    assert tracker.describe()["checkpoint_hash"] == weights_file.load(files / f"{interface}.safetensors").sha256[:12]


def test_residual_form():
    """A residual action corrects the reference joints by a quarter of the torque limit a unit, at most six units."""
    front = Twist2FrontEnd(residual_form(TWIST2_DRIVE))
    front.bind(2)
    front.reset()
    command, state = inputs(0, 2)
    front.observe(command, state)
    targets = front.act(torch.tensor([[100.0] * 29, [-1.0] * 29]))
    scale = torch.tensor([0.25 * e / k for e, k in zip(TWIST2_DRIVE.effort, TWIST2_DRIVE.kp, strict=True)])
    torch.testing.assert_close(targets, command.joints + torch.stack([6.0 * scale, -scale]))
    assert (front.last_action[0] == 100.0).all()


def test_input_statistics():
    """Statistics taken batch by batch equal those of all samples at once."""
    norm = InputNorm(5)
    x = 100.0 + 3.0 * torch.randn(600, 5)
    for part in x.split([100, 300, 200]):
        norm.update(part)
    torch.testing.assert_close(norm.mean, x.mean(0), rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(norm.std, x.std(0, unbiased=False) + 0.01, rtol=1e-3, atol=1e-3)


def test_sonic_structure():
    """SONIC's latent is bounded, and the encoder reads the 646 numbers of mode 0 and nothing else."""
    network = trained("sonic").network
    x = 10.0 * torch.randn(4, network.obs_width)
    latent = network.encode(x[:, :1762])
    assert latent.shape == (4, 64) and latent.abs().max() <= 1.0
    other = torch.ones(1762, dtype=torch.bool)
    other[network.used] = False
    x[:, :1762][:, other] += 1.0
    assert len(network.used) == 646 and torch.equal(network.encode(x[:, :1762]), latent)


def rewritten(files, path, change, interface="twist2"):
    """A copy of a file with changed tensors or metadata."""
    from safetensors import safe_open

    with safe_open(files / f"{interface}.safetensors", "pt") as f:
        tensors, meta = {k: f.get_tensor(k) for k in f.keys()}, json.loads(f.metadata()[weights_file.METADATA_KEY])  # noqa: SIM118
    change(tensors, meta)
    save_file(tensors, path, {weights_file.METADATA_KEY: json.dumps(meta)})
    return path


CHANGES = {
    "format": (lambda t, m: m.update(format="other-9"), "other-9"),
    "absent": (lambda t, m: m.pop("drive"), "drive"),
    "widths": (lambda t, m: m["hidden"].update(hidden=[64, 64]), "shape|misses|unknown"),
    "silly_widths": (lambda t, m: m["hidden"].update(hidden=["a"]), "widths"),
    "huge": (lambda t, m: m["hidden"].update(hidden=[10**9]), "8192"),
    "unknown_argument": (lambda t, m: m["hidden"].update(depth=3), "depth"),
    "kind": (lambda t, m: m["action_form"].update(kind="torque"), "torque"),
    "scale": (lambda t, m: m["action_form"].update(scale=[1.0]), "29"),
    "gains": (lambda t, m: m["drive"].update(kp=[1.0]), "kp"),
    "physics": (lambda t, m: m["physics"].update(substeps=3), "tick"),
    "interface": (lambda t, m: m.update(interface="falcon"), "falcon"),
    "tensor": (lambda t, m: t.pop("norm.mean"), "norm.mean"),
    "extra": (lambda t, m: t.update(more=torch.zeros(1)), "more"),
    "many_layers": (lambda t, m: m["hidden"].update(hidden=[8] * 1000), "1000 layers, expected at most 64"),
    "wide_layers": (lambda t, m: m["hidden"].update(hidden=[8192] * 60), "misses|shape|unknown"),
    "gain_nan": (lambda t, m: m["drive"].update(kp=[float("nan")] * 29), "finite"),
    "finger": (lambda t, m: m["drive"].update(finger_kp=-1.0), "finger_kp"),
    "scale_inf": (lambda t, m: m["action_form"].update(scale=[float("inf")] * 29), "finite"),
    "substeps_inf": (lambda t, m: m["physics"].update(substeps=float("inf")), "metadata"),
    "nested": (lambda t, m: m.update(card=json.loads("[" * 900 + "]" * 900)), "metadata"),
    "nan": (lambda t, m: t["norm.mean"].fill_(float("nan")), "finite"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_unfit_files(files, tmp_path, name):
    """A file that is not what it says is refused with one line that names file and fault."""
    change, words = CHANGES[name]
    path = rewritten(files, tmp_path / "changed.safetensors", change)
    with pytest.raises(InputError, match=words) as caught:
        trackers.get("twist2", path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_foreign_files(files, tmp_path):
    """Noise, a stranger's safetensors, and the other interface's weights are distinguished."""
    noise = tmp_path / "noise.safetensors"
    for data in (b"", b"\x00" * 7, b"\xff" * 64, b"x" * 5000):
        noise.write_bytes(data)
        with pytest.raises(InputError, match="not a readable safetensors"):
            trackers.get("twist2", noise)
    save_file({"a": torch.zeros(1)}, noise)
    with pytest.raises(InputError, match="not a tracker of this project"):
        trackers.get("sonic", noise)
    with pytest.raises(InputError, match="--tracker sonic"):
        trackers.get("twist2", files / "sonic.safetensors")


def test_save_refuses(files, tmp_path):
    """A network that went non-finite is not written, and a path that cannot be written is named."""
    weights = trained("twist2")
    with pytest.raises(InputError, match="cannot be written"):
        weights_file.save(files / "twist2.safetensors" / "x.safetensors", weights)
    weights.network.actor[0].bias.data[3] = float("inf")
    with pytest.raises(InputError, match="actor.0.bias"):
        weights_file.save(tmp_path / "x.safetensors", weights)
    assert not list(tmp_path.iterdir())


def test_defaults(files, monkeypatch):
    """Without `--checkpoint` the trackers take the weights beside the package."""
    monkeypatch.setattr(base, "weights_path", lambda interface: files / f"{interface}.safetensors")
    for interface in ("twist2", "sonic"):
        assert trackers.get(interface).checkpoint == str(files / f"{interface}.safetensors")


@pytest.mark.parametrize("interface", ["twist2", "sonic"])
def test_shipped(interface):
    """Weights that come with the package load, are at most 8 MB, and carry a card."""
    path = base.weights_path(interface)
    if not path.is_file():
        pytest.skip(f"no {path.name} here yet")
    weights = weights_file.load(path, interface)
    assert path.stat().st_size <= 8_000_000
    assert {"commit", "command", "samples", "minutes", "data", "licences", "metrics"} <= weights.card.keys()
    assert dataclasses.is_dataclass(weights.drive)
