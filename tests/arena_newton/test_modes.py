"""Modes: records of ranges, also of other packages; what dynamics mode draws acts on both engines, and nothing else."""

import dataclasses
from importlib.metadata import EntryPoint

import numpy as np
import pytest
import torch

from arena_newton import rule_sets, tasks, trackers
from arena_newton.cli import registry
from arena_newton.differentiable.engine_step import EngineStep
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.identity import mode_facts
from arena_newton.physics.dynamics import Delay
from arena_newton.pictures.settings import CameraConfig
from arena_newton.robot.canonical import STAND_ACTION, STATE
from arena_newton.robot.g1 import CANONICAL_TO_MUJOCO
from arena_newton.rules import modes
from arena_newton.rules.modes import DYNAMICS, QUANTITIES, Mode
from arena_newton.usd_scenes.preview import preview
from tests.scenes import scene

PAPER = rule_sets.get("paper")
USUAL = {name: quantity.usual for name, quantity in QUANTITIES.items()}
RANGES = modes.get(DYNAMICS).dynamics
WORLDS = 4
NAN = float("nan")


WET = Mode(name="wet", sentence="slippery", placements=lambda rule: rule.execution, dynamics={"friction": (0.2, 0.4)})
"""A mode of another package."""


@pytest.fixture
def offered(monkeypatch):
    """The mode as an installed package offers it."""
    point = EntryPoint("wet", f"{__name__}:WET", "arena_newton.modes")
    monkeypatch.setattr(registry, "_installed", lambda group, path: [point] if group == point.group else [])
    monkeypatch.setattr(EntryPoint, "load", lambda self: WET)


def test_a_mode_of_another_package_is_played_and_hashed(offered):
    """It is listed behind the built-in ones, draws from its own ranges, and its hash is part of a run's identity."""
    assert modes.names() == (*modes.BUILT_IN, "wet")
    spec = tasks.get("football")
    drawn = [spec.draw(seed, "wet", PAPER) for seed in range(40)]
    assert all(0.2 <= one.dynamics["friction"] <= 0.4 and len(one.dynamics) == 1 for one in drawn)
    assert drawn[3].placed == spec.draw(3, "execution", PAPER).placed

    def identity(*names):
        options = RunOptions(task=("football",), mode=names, policy="stand", tracker=("pd",), engine="mujoco")
        return resolve(options).identity()

    assert "mode_facts" not in identity("base", "execution", "semantic", "visual")
    facts = identity("base", "wet", DYNAMICS)["mode_facts"]
    assert set(facts) == {"wet", DYNAMICS} and "code" in facts["wet"] and "code" not in facts[DYNAMICS]


def test_a_mode_of_another_package_brings_layers(monkeypatch, tmp_path):
    """Its layer opens in place of a task's scene, is previewed and counts by content; a task without one refuses it."""
    layer = tmp_path / "football.usda"
    head = (
        '#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    kilogramsPerUnit = 1\n    upAxis = "Z"\n'
    )
    layer.write_text(f"{head}    subLayers = [@arena_newton/usd_scenes/football/scene.usda@]\n)\n")
    night = Mode(name="night", sentence="it is dark", scene="layer", layers=tmp_path)
    monkeypatch.setitem(modes._MODES._registered, "night", night)
    spec = tasks.get("football")
    assert (spec.own_layer("night"), spec.scene_name("night", PAPER)) == (layer, "night")
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=1, engine="mujoco", threads=1, mode="night")
    assert env.scene.path == layer
    env.close()
    assert preview(["football"], tmp_path / "night.png", 16, "night").is_file()
    before = mode_facts("night", PAPER, ("football",))
    layer.write_text(layer.read_text() + 'over "World"\n{\n}\n')
    after = mode_facts("night", PAPER, ("football",))
    assert before["ranges"] == after["ranges"] and before["layers"].keys() == {"football"}
    assert before["layers"] != after["layers"]
    with pytest.raises(InputError, match=r"--mode night: task boxing has no .*boxing\.usda"):
        mode_facts("night", PAPER, ("boxing",))
    with pytest.raises(InputError, match="mode wet: has layers, but its scene is 'base', expected 'layer'"):
        dataclasses.replace(WET, layers=tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dynamics": {"weight": (1, 2)}}, "mode wet: weight is none of friction, robot_mass"),
        ({"dynamics": {"friction": (1.2, 0.3)}}, "mode wet: friction: 1.2 to 0.3 is not a range of it"),
        ({"dynamics": {"gains": (-0.1, 0.3)}}, "mode wet: gains: -0.1 to 0.3 is not a range of it"),
        ({"dynamics": {"friction": (NAN, 1.0)}}, "mode wet: friction: nan to 1 is not a range of it"),
        ({"dynamics": {"action_latency": (0, 1.5)}}, "mode wet: action_latency: 0 to 1.5 is not a range of it"),
        ({"dynamics": {"action_latency": (0.5, 2)}}, "mode wet: action_latency: 0.5 to 2 is not a range of it"),
        ({"dynamics": {"friction": (0.5, float("inf"))}}, "mode wet: friction: 0.5 to inf is not a range of it"),
        ({"dynamics": {"object_mass": (0.0, 1.0)}}, "mode wet: object_mass: 0 to 1 is not a range of it"),
        ({"dynamics": {"friction": (0.0, 1.0)}}, "mode wet: friction: 0 to 1 is not a range of it"),
        ({"dynamics": {"push_time": (0.5, 1.5)}}, "mode wet: push_time: 0.5 to 1.5 is not a range of it"),
        ({"dynamics": {"state_latency": (0, 11)}}, "mode wet: state_latency: 11, expected at most 10 ticks"),
        ({"scene": "layers"}, "mode wet: scene is 'layers', expected base, semantic or layer"),
        ({"scene": "layer", "layers": "/tmp"}, "mode wet: layers is '/tmp', expected a Path or None"),
        ({"placements": None}, "mode wet: placements is None, expected a function of an object's rule"),
        ({"light": 3}, "mode wet: light is 3, expected a function of a rule set or None"),
        ({"dynamics": ["friction"]}, "mode wet: dynamics is .'friction'., expected ranges by name"),
    ],
)
def test_fields_and_ranges_that_are_none_are_refused(change, message):
    """A field of another kind, an unknown quantity, bad bounds, no mass, part of a tick, a late time: one line."""
    with pytest.raises(InputError, match=message):
        dataclasses.replace(WET, **change)


def test_names_are_refused_in_words(offered, monkeypatch):
    """An unknown mode lists the known ones; a mode has the name that it is found by, and no built-in one."""
    with pytest.raises(InputError, match="--mode night: unknown, choose from base, .*, dynamics, wet"):
        modes.get("night")
    with pytest.raises(InputError, match="mode 'visual': is built in"):
        modes.register(dataclasses.replace(WET, name="visual"))
    monkeypatch.setitem(modes._MODES._registered, "dry", WET)
    with pytest.raises(InputError, match="--mode dry: its package calls it wet; entry point and record need one name"):
        modes.get("dry")


def test_a_hash_holds_all_ranges():
    """The hash of a mode changes with each range, its light and its scene, and with the rule set where that counts."""
    mode, changed = (
        WET,
        [
            {"placements": lambda rule: rule.base},
            {"dynamics": {"friction": (0.2, 0.5)}},
            {"dynamics": {"gains": (0.2, 0.4)}},
            {"light": lambda rules: rules.visual_light},
            {"scene": "semantic"},
        ],
    )
    hashes = {
        one.hash_for(PAPER, ["double_desk"]) for one in (mode, *(dataclasses.replace(mode, **c) for c in changed))
    }
    assert len(hashes) == len(changed) + 1
    assert mode.hash_for(PAPER, ["double_desk"]) != mode.hash_for(rule_sets.get("released"), ["double_desk"])
    assert mode.hash_for(PAPER, ["boxing", "football"]) == WET.hash_for(PAPER, ("football", "boxing"))


def test_each_quantity_has_a_stream_of_its_own():
    """Draws fill their ranges and depend on the seed alone; whether another quantity is drawn changes none of them."""
    drawn = [modes.get(DYNAMICS).draw(seed) for seed in range(400)]
    for name, (low, high) in RANGES.items():
        values = np.array([one[name] for one in drawn])
        assert low <= values.min() and values.max() <= high and np.ptp(values) > 0.9 * (high - low)
        alone = Mode(name="alone", sentence="", dynamics={name: (low, high)})
        assert [alone.draw(seed)[name] for seed in range(20)] == values[:20].tolist()
    values = np.array([[one[name] for name in RANGES] for one in drawn])
    assert np.abs(np.corrcoef(values.T) - np.eye(len(RANGES))).max() < 0.2
    assert tasks.get("boxing").draw(7, "base", PAPER).dynamics == {}


def test_rows_are_as_late_as_each_world_is():
    """A delayed row is the one of so many ticks ago, the first one before that; a masked world's past stands still."""
    delay = Delay(2, 1, torch.device("cpu"))
    delay.ticks[:] = torch.tensor((0, 2))
    seen = []
    for tick in range(5):
        now = torch.tensor([[float(tick)], [10.0 + tick]])
        seen.append(delay.late(now)[:, 0].tolist())
        delay.keep(now, torch.tensor((True, tick != 3)))
    assert seen == [[0, 10], [1, 10], [2, 10], [3, 11], [4, 11]]
    delay.forget(torch.tensor((False, True)))
    assert delay.late(torch.tensor([[5.0], [15.0]]))[:, 0].tolist() == [5, 15]


def stood(env: ArenaEnv, given, ticks: int) -> np.ndarray:
    """Positions of every tick of a robot that stands; `given` is a sample of the dynamics or a mode for each world."""
    own = env.rules.task(env.spec.name)
    drawn = env.spec.drawn(5, "base", own)
    samples = [drawn | {DYNAMICS: one} if isinstance(one, dict) else env.spec.drawn(5, one, own) for one in given]
    env.reset([5] * env.worlds, samples=samples)
    found = []
    for _ in range(ticks):
        env.step(env._stand.expand(env.worlds, -1))
        found.append(env.physics.qpos.numpy().copy())
    return np.array(found)


@pytest.mark.parametrize(("engine", "ticks"), [("mujoco", 60), ("warp", 3)])
def test_worlds_of_one_batch_have_dynamics_of_their_own(engine, ticks):
    """Usual values give every bit of base mode, drawn ones do not; a world that had others is base mode's again."""
    env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=WORLDS, engine=engine, device="cpu", threads=1)
    base = stood(env, ["base"] * WORLDS, ticks)
    mixed = stood(env, ["base", USUAL, DYNAMICS, {"friction": 0.5, "robot_mass": 1.1}], ticks)
    again = stood(env, [DYNAMICS, "base", "base", "base"], ticks)
    env.close()
    for world, same in enumerate((True, True, False, False)):
        assert np.array_equal(mixed[:, world], base[:, world]) == same
        assert np.array_equal(again[:, world], base[:, world]) == (world > 0)
    assert np.array_equal(again[:, 0], mixed[:, 2])


def test_a_differentiable_tick_has_the_dynamics_of_its_episode():
    """The model of a single world is the one that its episode drew, and gradients are of it; then the built one."""
    env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=1, engine="mujoco", threads=1)
    env.reset([5])
    physics, built, before = env.physics, env.physics.mj_model, env.physics.snapshot()

    def moved(sample):
        physics.set_dynamics(np.array([0]), [sample])
        physics.restore(before)
        physics.ctrl.fill_(0.3)
        step = EngineStep(physics)
        after = step(step.state(), torch.full((1, built.nu), 0.3)).qpos
        physics.step()
        return after.numpy(), physics.qpos.numpy().copy()

    predicted, heavy = moved({"robot_mass": 1.2, "gains": 0.8})
    assert physics.mj_model is physics.models[0] is not built and np.allclose(predicted, heavy, rtol=0, atol=1e-6)
    assert np.abs(moved({})[1] - heavy).max() > 1e-4 and physics.mj_model is built
    env.close()


def test_engine_warp_scales_the_fields_of_a_world():
    """The arrays that engine warp steps are scaled in the worlds that drew so, and in no other."""
    env = ArenaEnv("pp_box", tracker=trackers.get("pd"), worlds=2, engine="warp", device="cpu")
    names = ("geom_friction", "body_mass", "body_inertia", "actuator_gainprm", "actuator_biasprm")
    before = {name: getattr(env.physics._m, name).numpy().copy() for name in names}
    sample = {"friction": 0.5, "robot_mass": 1.25, "object_mass": 2.0, "gains": 1.5}
    env.physics.set_dynamics(np.arange(2), [{}, sample])
    after = {name: getattr(env.physics._m, name).numpy() for name in names}
    ratio = {name: after[name][1] / np.where(before[name][1] == 0, 1, before[name][1]) for name in names}
    env.close()
    assert all(np.array_equal(after[name][0], before[name][0]) for name in names)
    links, box = env.scene.robot.bodies, env.scene.body_id("/World/Box")
    assert np.allclose(ratio["geom_friction"][:, 0], 0.5) and np.allclose(
        after["geom_friction"][1, :, 1:], before["geom_friction"][1, :, 1:]
    )
    assert np.allclose(ratio["body_mass"][list(links)], 1.25) and np.isclose(ratio["body_mass"][box], 2.0)
    assert np.allclose(ratio["body_inertia"][box], 2.0)
    joints = env.scene.robot.joint_ctrl
    assert np.allclose(ratio["actuator_gainprm"][joints, 0], 1.5) and np.allclose(
        ratio["actuator_biasprm"][joints, 1:3], 1.5
    )
    fingers = env.scene.robot.hand_ctrl
    assert np.array_equal(after["actuator_gainprm"][1][fingers], before["actuator_gainprm"][1][fingers])


def test_pushes_and_latencies_come_when_they_were_drawn():
    """The base's velocity jumps by the push before its tick; state and targets are as many ticks late as drawn."""
    env = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=3, engine="mujoco", threads=1, rules="released")
    push = {"push": 0.5, "push_heading": np.pi / 2, "push_time": 3 / env.budget}
    drawn = env.spec.drawn(5, "base", env.rules.task("boxing"))
    env.reset(
        [5] * 3,
        samples=[drawn, drawn | {DYNAMICS: push}, drawn | {DYNAMICS: {"action_latency": 2, "state_latency": 1}}],
    )
    root, jumps, targets, states = env.scene.robot.root_qvel, [], [], []
    added = env.physics.add_velocity

    def note(change, mask):
        jumps.append((int(env.tick[1]), change[mask].tolist()))
        added(change, mask)

    env.physics.add_velocity = note
    action = env._stand.expand(3, -1).clone()
    for tick in range(6):
        action[:, 9:38] = 0.01 * tick
        states.append(env.observe().state.clone())
        env.step(action)
        targets.append(env.loop.targets.clone())
    env.close()
    assert jumps == [(3, [pytest.approx([0.0, 0.5, 0, 0, 0, 0], abs=1e-6)])] and root >= 0
    assert torch.equal(torch.stack(targets)[2:, 2], torch.stack(targets)[:-2, 0])
    assert torch.equal(targets[0][2], targets[0][0]) and torch.equal(targets[1][2], targets[0][0])
    assert torch.equal(states[1][2], states[0][2]) and not torch.equal(states[1][0], states[0][0])


def played(mode, worlds, seeds, ticks=12, **more):
    """States that a policy is shown, and what the physics holds after them: shapes [ticks, worlds, n]."""
    env = ArenaEnv(
        "boxing", tracker=trackers.get("twist2"), worlds=worlds, engine="mujoco", threads=1, mode="base", **more
    )
    env.reset(seeds, modes=mode)
    shown, held = [], []
    while int(env.tick[0]) < ticks:
        if int(env.tick[0]) >= 0:
            observed = env.observe()
            assert torch.equal(env.observe().state, observed.state)
            shown.append(observed.state.clone())
            held.append(torch.from_numpy(env.physics.qpos.numpy().copy()))
        env.step(torch.tensor(STAND_ACTION).repeat(worlds, 1))
    env.close()
    return torch.stack(shown), torch.stack(held)


def test_a_quantity_is_added_to_a_mode_by_its_name():
    """`base+push=0.5` draws it too: it is part of a run's identity, a range is drawn, a push gets time and heading."""
    mode = modes.get("execution+push=0.5+gyro_noise=0.1..0.3")
    drawn = [mode.draw(seed) for seed in range(40)]
    assert {one["push"] for one in drawn} == {0.5} and all(0.1 <= one["gyro_noise"] <= 0.3 for one in drawn)
    assert all(0.02 <= one["push_time"] <= 0.25 and one["push_heading"] for one in drawn)
    assert modes.get("base+push=1+push_time=0.1").draw(3)["push_time"] == 0.1
    spec = tasks.get("football")
    assert spec.draw(3, mode.name, PAPER).placed == spec.draw(3, "execution", PAPER).placed
    assert modes.is_composed(mode.name) and not any(map(modes.is_composed, ("base", "base+x=1", 1)))
    facts = [mode_facts(f"base+push={speed}", PAPER, ("football",)) for speed in ("0.5", "0.6")]
    assert facts[0] != facts[1] and mode_facts("base", PAPER, ("football",)) == {}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("base+push", "--mode base\\+push: 'push': expected a quantity and its value or range, as push=0.5..1"),
        ("base+push=fast", "'push=fast': expected a quantity"),
        ("base+", "'': expected a quantity"),
        ("base+push=1\n", "expected a quantity"),
        ("base+push=nan", "expected a quantity"),
        ("base" + "+gains=1" * 20, "longer than 100 letters"),
        ("base+push=1+push=2", "push: given twice"),
        ("base+weight=1", "weight is none of friction"),
        ("base+gyro_noise=-1", "gyro_noise: -1 to -1 is not a range of it"),
        ("night+push=1", "--mode night: unknown"),
        ("semantic-2+push=1", "semantic-2 has a layer of its own, to which no quantity can be added"),
    ],
)
def test_quantities_that_are_none_are_refused(name, message):
    """Quantities that are added to a mode are known ones with a value or a range, each once."""
    with pytest.raises(InputError, match=message):
        modes.get(name)


def test_noise_is_of_the_sensors_and_of_its_worlds():
    """Noise has its deviation and its episode's seed; policy and tracker get it; a world without it keeps every bit."""
    noisy = "base+joint_pos_noise=0.02+joint_vel_noise=0.3+orientation_noise=0.01+gyro_noise=0.1"
    shown, held = played(["base", noisy, noisy], 3, [5, 5, 6])
    alone, moved = played([noisy], 1, [5])
    exact, still = played(["base"], 1, [5])
    assert torch.equal(shown[:, 1], alone[:, 0]) and torch.equal(held[:, 1], moved[:, 0])
    assert torch.equal(shown[:, 0], exact[:, 0]) and torch.equal(held[:, 0], still[:, 0])
    assert not torch.equal(held[-1, 1], held[-1, 0])  # the tracker reacts
    joints = held[:, 1][:, scene("boxing").robot.joint_qpos[list(CANONICAL_TO_MUJOCO)]]
    error = shown[:, 1, STATE["joint_pos"]] - joints
    assert 0.015 < error.std() < 0.025 and error.mean().abs() < 0.005
    assert not torch.equal(shown[:, 1], shown[:, 2])
    columns = shown[:, 1, STATE["root_rot6d"]].reshape(-1, 3, 2)
    assert torch.allclose(columns.transpose(1, 2) @ columns, torch.eye(2), atol=1e-5)


def test_noise_of_pictures_is_seen_and_needs_a_camera():
    """Colours of a picture have the noise of their episode and tick; without a camera it is refused by name."""
    camera = CameraConfig(32, 24, fit="native")
    pictures = {}
    for name in ("base", "base+picture_noise=8"):
        env = ArenaEnv(
            "boxing", tracker=trackers.get("pd"), worlds=1, engine="mujoco", threads=1, mode=name, camera=camera
        )
        env.reset([5])
        first, again = (env.observe(np.ones(1, bool), image=True).image.float().clone() for _ in "ab")
        assert torch.equal(first, again)
        pictures[name] = first
        env.close()
    assert 4.0 < (pictures["base+picture_noise=8"] - pictures["base"]).std() < 9.0
    blind = ArenaEnv("boxing", tracker=trackers.get("pd"), worlds=1, engine="mujoco", threads=1)
    with pytest.raises(InputError, match="picture_noise, but the policy wants no picture"):
        blind.reset([5], modes=["base+picture_noise=8"])
    blind.close()
