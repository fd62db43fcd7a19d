"""Training end to end on the CPU: 8 worlds, engine `warp`."""

import dataclasses
import importlib
import inspect
import json
import os
import pkgutil
import signal
import socket

import pytest
import torch
import tyro
from PIL import Image

from arena_newton.errors import InputError
from arena_newton.robot import rotations
from arena_newton.robot.g1 import TWIST2_DRIVE, PhysicsRate
from arena_newton.trackers import base, interface, train
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.train import __main__ as command_line
from arena_newton.trackers.train import session
from arena_newton.trackers.train.checkpoint import Card, Checkpoint
from arena_newton.trackers.train.export import export
from arena_newton.trackers.train.runner import TrackerRunner, annealed
from arena_newton.trackers.train.simulation import share_stream
from arena_newton.trackers.train.terms import events
from arena_newton.trackers.train.terms.critic import CRITIC
from arena_newton.trackers.train.terms.measurement import TrainingError
from arena_newton.trackers.train.terms.rewards import Term
from arena_newton.trackers.train.tracker_env import TrackerEnv
from arena_newton.trackers.train.train_options import ExportOptions, TrainOptions, check
from arena_newton.trackers.twist2 import Twist2Tracker
from tests.children import Child

WORLDS, STEPS = 8, 2
TWIST2 = interface.get("twist2")


@pytest.fixture(scope="module")
def env(library):
    """Eight worlds with all of the randomisation."""
    torch.manual_seed(0)
    made = TrackerEnv(TWIST2, TWIST2.action_form("auto"), library.to("cpu"), TrainOptions(worlds=WORLDS))
    made.library = library.to("cpu")
    return made


def make_runner(env, log_dir=None, **changes) -> TrackerRunner:
    options = TrainOptions(**{"worlds": WORLDS, "device": "cpu", "steps": STEPS, "print_interval": 1000} | changes)
    card = Card(
        tracker="twist2",
        command="test",
        commit="none",
        worlds=WORLDS,
        processes=1,
        seed=0,
        data={"clips": 2, "families": {"stand": {"clips": 1, "minutes": 0.1}}, "sources": ["test"]},
        licences={"Apache-2.0": 2},
        action_form=dataclasses.asdict(env.front_end.action_form),
        drive=TWIST2_DRIVE.as_json(),
        physics=dataclasses.asdict(PhysicsRate(0.005, 4)),
        events={"push": {"planar": 2.0}},
    )
    return TrackerRunner(env, options, {"hidden": [64, 64]}, card, log_dir)


@pytest.fixture(scope="module")
def trained(env, tmp_path_factory):
    """A runner that has learned two iterations."""
    runner = make_runner(env, tmp_path_factory.mktemp("trained"), log_interval=1)
    runner.learn(2)
    return runner


@pytest.fixture
def still(env, monkeypatch):
    """Robots that do not move, on which a training's files do not depend."""
    monkeypatch.setattr(env.sim, "step", lambda: None)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_a_rollout_does_not_wait_for_the_device(library):
    """Torch reports each wait as an error: from observation to action to reward there is none."""
    share_stream("cuda:0")
    env = TrackerEnv(TWIST2, TWIST2.action_form("auto"), library.to("cuda:0"), TrainOptions(worlds=WORLDS), "cuda:0")
    algorithm = make_runner(env, steps=4).alg
    obs = env.get_observations()
    try:
        with torch.no_grad():
            for tick in range(4):
                torch.cuda.set_sync_debug_mode("error" if tick else "default")
                obs, rewards, dones, extras = env.step(algorithm.act(obs))
                algorithm.process_env_step(obs, rewards, dones, extras)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_worlds_differ_and_the_critic_knows(env):
    """Start events give every world its own friction, masses and motors, and the critic sees them."""
    sim = env.sim
    friction = sim.geom_friction[:, :, 0]
    assert (friction == friction[:, :1]).all() and friction[:, 0].unique().numel() == WORLDS
    assert torch.allclose(env.privileged["friction"][:, 0] + 0.8, friction[:, 0])
    robot = sim.body_mass[:, list(sim.bodies.values())].sum(1)
    assert robot.unique().numel() == WORLDS and ((robot > 33.0) & (robot < 46.0)).all()
    strength = 1.0 + 0.1 * env.privileged["motor_strength"]
    assert torch.allclose(sim.gain[:, :29, 0], strength * torch.tensor(TWIST2_DRIVE.kp), rtol=1e-5)
    assert torch.allclose(sim.effort_range[:, :, 1], strength * torch.tensor(TWIST2_DRIVE.effort), rtol=1e-5)


def test_episodes_start_on_the_reference_beside_its_support(env, library):
    """A restarted world stands in its frame within the noise; the seat stands where its clip says, or out of reach."""
    env.reset()
    now = env.bank.gather(env.frame)
    noise = events.START_NOISE
    assert ((env.sim.joint_pos - now.joint_pos).abs() <= noise["joint_pos"] + 1e-6).all()
    assert ((env.sim.root_pos - now.root_pos)[:, :2].abs() <= noise["xy"] + 1e-6).all()
    assert (rotations.wrap_angle(rotations.heading(env.sim.root_quat)).abs() < 0.2).all()
    seat = env.sim.mocap_pos[:, env.sim.scene.mocap_id("/World/Seat")]
    sits = env.bank.support_kind[env.bank.clip_of[env.frame]] == 1
    assert torch.allclose(seat[sits], torch.tensor([-0.6, 0.0, 0.4])) and (seat[~sits, 2] < -1.0).all()
    assert 0 < sits.sum() < WORLDS


def test_a_broken_world_ends_and_starts_again(env):
    """A world whose state is not finite ends its episode, starts again finite, and does not stop the training."""
    env.step(torch.zeros(WORLDS, 29))
    env.collect()
    env.sim.qpos[3, 9] = float("nan")
    observations, reward, done, extras = env.step(torch.zeros(WORLDS, 29))
    assert done[3] == 1 and not extras["time_outs"][3]
    assert torch.isfinite(reward).all() and reward[3] < -2.0
    assert all(torch.isfinite(v).all() for v in observations.values())
    for _ in range(3):
        observations, reward, done, _ = env.step(torch.zeros(WORLDS, 29))
    assert torch.isfinite(observations["critic"]).all() and torch.isfinite(env.sim.qpos).all()
    assert env.collect()["Ends_per_s/nonfinite"] > 0.0


def test_time_outs_are_no_falls(env):
    """An episode that reaches its clip's end ends without the penalty of a fall."""
    env.reset(env.bank.last[env.frame] - 1)
    _, reward, done, extras = env.step(torch.zeros(WORLDS, 29))
    assert done.all() and extras["time_outs"].all() and (reward > 0.0).all()
    assert (env.episode_length_buf == 0).all()


def pointers(thing: object, depth: int = 2) -> dict[str, int]:
    """Addresses of all tensors that an object holds, directly or within its parts."""
    found: dict[str, int] = {}
    for name, value in vars(thing).items():
        if isinstance(value, torch.Tensor):
            found[name] = value.data_ptr()
        elif isinstance(value, dict):
            found |= {f"{name}.{k}": v.data_ptr() for k, v in value.items() if isinstance(v, torch.Tensor)}
        elif depth and hasattr(value, "__dict__") and not callable(value):
            found |= {f"{name}.{k}": v for k, v in pointers(value, depth - 1).items()}
    return found


def test_the_critics_terms_are_named(env, library, monkeypatch):
    """The observation is the terms in the table's order; a term of a wrong shape is refused by its name."""
    assert list(env.critic_widths) == [name for name in CRITIC if name != "state_delay"]
    assert env.get_observations()["critic"].shape == (WORLDS, sum(env.critic_widths.values()))
    monkeypatch.setitem(env.critic, "height", lambda env, m: m.state.root_pos[:, 2])
    with pytest.raises(TrainingError, match=r"critic term height: shape \[8\], expected \[8, 1\]"):
        env.reset()


def test_a_tick_keeps_its_buffers(env):
    """No tensor of the environment moves in a tick: a CUDA graph holds addresses."""
    parts = (env, env.front_end, env.sampler, env.tally, env.bank, env.sim)
    before = [pointers(part, 0) for part in parts]
    env.step(torch.zeros(WORLDS, 29))
    env.collect()
    env.step(torch.ones(WORLDS, 29))
    assert [pointers(part, 0) for part in parts] == before


def test_reward_improves(env, monkeypatch):
    """A few iterations of PPO move the policy to the action that a reward term wants, whatever the robot does."""
    torch.manual_seed(0)
    wanted = Term(lambda motion: (motion.action[:, 0] - 1.0).square(), -5.0)
    easy = TrackerEnv(
        TWIST2,
        TWIST2.action_form("auto"),
        env.library,
        TrainOptions(worlds=WORLDS, randomise=False),
        "cpu",
        rewards={"wanted": wanted},
    )
    monkeypatch.setattr(easy.sim, "step", lambda: None)
    runner = make_runner(easy, steps=8, learning_rate=1e-3, desired_kl=10.0, entropy=0.0)
    runner.alg.gamma = 0.0
    runner.learn(10)
    earned = [row["Train/reward_per_s"] for row in runner.history]
    assert sum(earned[-3:]) > 0.85 * sum(earned[:3])
    assert runner.samples == 10 * 8 * WORLDS


def test_resume_goes_on_as_before(env, trained, still):
    """A checkpoint brings back networks, input statistics, sampling, learning rate and random numbers."""
    first, path = trained, trained.folder / "model_last.pt"
    second = make_runner(env, None)
    state = torch.get_rng_state()
    second.load(str(path))
    expected = Checkpoint.read(path)
    assert torch.equal(torch.get_rng_state(), expected.rng) and not torch.equal(torch.get_rng_state(), state)
    observations = env.get_observations()
    assert torch.equal(first.alg.actor(observations), second.alg.actor(observations))
    assert torch.equal(first.alg.critic(observations), second.alg.critic(observations))
    assert second.alg.learning_rate == first.alg.learning_rate and second.samples == first.samples
    assert first.alg.actor.counts().keys() == second.alg.actor.counts().keys()
    for name, count in first.alg.actor.counts().items():
        assert count == second.alg.actor.counts()[name] > 0
    assert torch.equal(env.sampler.cumulative, expected.sampler["cumulative"])
    second.learn(1)
    assert second.current_learning_iteration == 3 and second.history[-1]["iteration"] == 3


def test_old_checkpoints_are_deleted(env, still, tmp_path):
    """The last K and every Nth stay, with the last of all and the one that was resumed from; 0 keeps everything."""

    def files() -> set[str]:
        return {path.name.removeprefix("model_").removesuffix(".pt") for path in tmp_path.glob("model_*.pt")}

    make_runner(env, tmp_path, save_interval=1, keep_last=1, keep_every=2).learn(3)
    assert files() == {"2", "3", "last", "slim"}
    again = make_runner(env, tmp_path, save_interval=1, keep_last=1, keep_every=0)
    again.load(str(tmp_path / "model_2.pt"))
    again.learn(2)
    assert files() == {"2", "4", "last", "slim"}
    kept = make_runner(env, tmp_path, save_interval=1, keep_last=0)
    kept.load(str(tmp_path / "model_2.pt"))
    kept.learn(1)
    assert files() == {"2", "3", "4", "last", "slim"}


def test_export_is_what_was_trained(env, trained, tmp_path):
    """The weights file makes the actions of the trained actor, and its card says how it came to be."""
    options = ExportOptions(tmp_path / "w" / "twist2.safetensors", note="A test.")
    out = export(trained.folder / "model_last.pt", options)
    weights = weights_file.load(out, "twist2")
    observations = env.get_observations()
    assert torch.equal(weights.network(observations["actor"]), trained.alg.actor(observations))
    assert weights.action_form == env.front_end.action_form and weights.drive == TWIST2_DRIVE
    assert weights.card["samples"] == 2 * STEPS * WORLDS and weights.card["licences"] == {"Apache-2.0": 2}
    card = out.with_suffix(".md").read_text()
    assert "A test." in card and "| stand | 1 | 0.1 |" in card
    assert weights.card["events"]["push"] == {"planar": 2.0} and "| randomisation | push planar 2 |" in card


def test_exported_tracker_has_no_preferred_side(env, trained, tmp_path):
    """In a mirrored world the exported tracker gives the mirrored targets, though its network alone does not."""
    for symmetric in (True, False):
        out = export(trained.folder / "model_last.pt", ExportOptions(tmp_path / "w.safetensors", symmetric=symmetric))
        tracker = Twist2Tracker.from_weights(out)
        mirror = env.front_end.mirror_obs(), env.front_end.mirror_action()
        seen = env.get_observations()["actor"]
        with torch.no_grad():
            straight, mirrored = tracker.network(torch.cat([seen, mirror[0](seen)])).chunk(2)
        difference = (mirror[1](straight) - mirrored).abs().max()
        assert (difference < 1e-5) if symmetric else (difference > 1e-3)
        assert ("mean of both ways" in out.with_suffix(".md").read_text()) == symmetric


def test_export_takes_fitting_figures_only(trained, tmp_path):
    """Figures of another tracker or no figures at all are refused, nothing is written then or overwritten."""
    checkpoint, metrics, out = (
        trained.folder / "model_last.pt",
        tmp_path / "evaluation.json",
        tmp_path / "w.safetensors",
    )
    figure = {"name": "falls", "bar": "no", "value": "0/8", "verdict": "pass"}
    document = {"options": {"engine": "mujoco", "rollouts": 8}, "trackers": [{"name": "sonic", "figures": [figure]}]}
    for text, words in (
        ("[1]", "holds list, expected an object"),
        ('{"trackers": [{}]}', "not an evaluation.json"),
        (json.dumps(document), "other trackers than twist2"),
        ("{", "not readable as JSON"),
        ("[" * 100_000, "not readable as JSON"),
    ):
        metrics.write_text(text)
        with pytest.raises(InputError, match=words):
            export(checkpoint, ExportOptions(out, metrics=metrics))
    assert not out.exists()
    document["trackers"][0]["name"] = "twist2"
    metrics.write_text(json.dumps(document))
    with pytest.raises(InputError, match="would overwrite"):
        export(checkpoint, ExportOptions(tmp_path / "evaluation.safetensors", metrics=metrics))
    card = export(checkpoint, ExportOptions(out, metrics=metrics)).with_suffix(".md").read_text()
    assert "| falls | no | 0/8 | pass |" in card and "rollouts 8, engine mujoco" in card
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out .*cannot be written"):
        export(checkpoint, ExportOptions(tmp_path / "file" / "w.safetensors"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda state: state["card"].update(tracker="sonic"), "a training of sonic, not of twist2"),
        (lambda state: state["card"]["action_form"].update(kind="default"), "its action form is default, not residual"),
        (lambda state: state.update(families=["walk"]), "of the families walk; these are stand, squat"),
        (lambda state: state.update(critic_state_dict={"old": torch.zeros(1)}), "a checkpoint of another version"),
        (lambda state: state.update(network={"hidden": [8]}), "a network of other widths"),
        (lambda state: state["critic_widths"].update(height=2), "other critic terms than this training's: height"),
        (lambda state: state["critic_widths"].update(new=3), "other critic terms than this training's: new"),
        (
            lambda state: state["critic_widths"].update(height=state["critic_widths"].pop("height")),
            "other critic terms than this training's: their order",
        ),
        (lambda state: state.pop("rng"), "it lacks rng"),
        (lambda state: state["card"].pop("licences"), "it lacks licences"),
        (lambda state: state.update(card=5), "not a checkpoint of this training"),
    ],
)
def test_resume_refuses_what_is_no_checkpoint_of_this_training(env, trained, tmp_path, change, words):
    """Every difference that would change what is learnt is refused in words."""
    state = torch.load(trained.folder / "model_last.pt", weights_only=True)
    change(state)
    torch.save(state, tmp_path / "other.pt")
    with pytest.raises(InputError, match=f"--resume .*other.pt: .*{words}"):
        make_runner(env).load(str(tmp_path / "other.pt"))


def test_checkpoints_of_earlier_versions_are_taken(env, trained, tmp_path):
    """The keys of a file's first version are enough to resume and to export."""
    state = torch.load(trained.folder / "model_last.pt", weights_only=True)
    first = (
        "actor_state_dict critic_state_dict optimizer_state_dict iter infos network norm_counts learning_rate samples"
    )
    kept = [*first.split(), "seconds", "families", "sampler", "rng", "cuda_rng", "card", "last"]
    card = "tracker command commit processes worlds seed data licences action_form drive physics rewards".split()
    assert set(card) == set(state["card"]) - {"events"}, "a card without earlier parts"
    del state["card"]["events"]
    torch.save(state, tmp_path / "last.pt")
    torch.save({name: state[name] for name in kept}, tmp_path / "first.pt")
    resumed = make_runner(env)
    resumed.load(str(tmp_path / "first.pt"))
    assert resumed.current_learning_iteration == 2 and resumed.samples == 2 * STEPS * WORLDS
    out = [
        export(file, ExportOptions(tmp_path / f"{file.stem}.safetensors"))
        for file in (tmp_path / "first.pt", tmp_path / "last.pt")
    ]
    assert out[0].read_bytes() == out[1].read_bytes()


def test_a_resumed_training_tells_of_all_its_parts(env, tmp_path, capsys):
    """Card and weights keep the licences, commands and processes of the parts before, and what they started from."""
    first = make_runner(env, tmp_path / "a")
    first.card.licences, first.card.processes, first.card.started_from = {"CC-BY-NC": 5}, 2, "abc"
    first.seconds = 60.0
    first.save(str(tmp_path / "a.pt"))
    second = make_runner(env, tmp_path / "b")
    second.load(str(tmp_path / "a.pt"))
    second.seconds = 180.0
    second.save(str(tmp_path / "b.pt"))
    out = export(tmp_path / "b.pt", ExportOptions(tmp_path / "w.safetensors"))
    card = json.loads(out.with_suffix(".json").read_text())
    assert card["licences"] == {"CC-BY-NC": 5, "Apache-2.0": 2} and card["started_from"] == "abc"
    assert [part["processes"] for part in card["earlier"]] == [2] and card["processes"] == 1
    assert card["minutes"] == 3.0 and card["gpu_minutes"] == 2 * 1.0 + 1 * 2.0
    assert "CC-BY-NC (5 clips)" in out.with_suffix(".md").read_text()
    assert "other references" not in capsys.readouterr().out


def test_other_references_start_without_evidence(env, trained, tmp_path, capsys):
    """Evidence about one library's clips says nothing about another's of the same shape."""
    state = torch.load(trained.folder / "model_last.pt", weights_only=True)
    state["sampler"] |= {"library": "another", "seconds": state["sampler"]["seconds"] + 1e6}
    torch.save(state, tmp_path / "other.pt")
    make_runner(env).load(str(tmp_path / "other.pt"))
    assert "other references" in capsys.readouterr().out and (env.sampler.seconds < 1e5).all()


def signalled(env, monkeypatch, *numbers: int) -> None:
    """At the end of the second rollout these signals arrive."""
    collect, calls = env.collect, []

    def collect_and_signal() -> dict[str, float]:
        calls.append(1)
        for number in numbers if len(calls) == 2 else ():
            os.kill(os.getpid(), number)
        return collect()

    monkeypatch.setattr(env, "collect", collect_and_signal)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_training_with_its_files(env, still, tmp_path, number, monkeypatch):
    """The iteration in flight is finished, logged and written, and the command's code is that of an interruption."""
    runner = make_runner(env, tmp_path, log_interval=100)
    signalled(env, monkeypatch, number)
    runner.learn(50)
    assert runner.current_learning_iteration == 2 and (tmp_path / "model_last.pt").is_file()
    assert [json.loads(line)["iteration"] for line in (tmp_path / "progress.jsonl").read_text().splitlines()] == [1, 2]
    assert not (tmp_path / "git").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.setattr("arena_newton.trackers.train.session.train", lambda options: runner)
    assert command_line.main(["--device", "cpu", "--log-dir", str(tmp_path / "log")]) == 130


def test_a_second_interrupt_stops_at_once(env, still, monkeypatch):
    """A second Ctrl-C does not wait for the end of the iteration."""
    runner = make_runner(env)
    signalled(env, monkeypatch, signal.SIGINT, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        runner.learn(50)


def test_export_overwrites_nothing_foreign_and_needs_every_tensor(trained, tmp_path):
    """A card's neighbour of the same name stays; a checkpoint without a network is no tracker."""
    last = trained.folder / "model_last.pt"
    (tmp_path / "x.json").write_text("mine")
    with pytest.raises(InputError, match=r"--out .*x.safetensors: its card would overwrite .*x.json"):
        export(last, ExportOptions(tmp_path / "x.safetensors"))
    assert (tmp_path / "x.json").read_text() == "mine"
    state = torch.load(last, weights_only=True)
    state["actor_state_dict"] = {}
    torch.save(state, tmp_path / "empty.pt")
    with pytest.raises(InputError, match="empty.pt: its network does not fit interface twist2"):
        export(tmp_path / "empty.pt", ExportOptions(tmp_path / "y.safetensors"))


@pytest.mark.parametrize("held", ["twist2.safetensors", "model_5.pt", "progress.jsonl"])
def test_a_folder_with_a_training_or_weights_is_left_alone(held, tmp_path):
    """A new run needs an empty folder; one that is resumed from a checkpoint of the folder writes there."""
    (tmp_path / held).write_text("mine")
    with pytest.raises(InputError, match=rf"--log-dir .*: already contains a training run \({held}\)"):
        session.check_folder(TrainOptions(log_dir=tmp_path))
    (tmp_path / "model_7.pt").write_text("checkpoint")
    session.check_folder(TrainOptions(log_dir=tmp_path, resume=tmp_path / "model_7.pt"))


def test_the_end_of_a_time_limit_is_annealed(env):
    """Towards the end of `--minutes` target KL and entropy coefficient fall to a tenth, without `--anneal` not."""
    assert [annealed(elapsed, 0.5) for elapsed in (0.2, 0.75, 0.99)] == pytest.approx([1.0, 0.5, 0.1])
    assert annealed(0.99, 0.0) == 1.0
    runner = make_runner(env, anneal=0.5, desired_kl=0.02, entropy=0.01)
    runner.anneal(0.75)
    assert (runner.alg.desired_kl, runner.alg.entropy_coef) == pytest.approx((0.01, 0.005))


def second_process(arguments):
    """Train, and save the network."""
    options = tyro.cli(TrainOptions, args=arguments[1:])
    runner = session.build(options)
    runner.learn(options.iterations)
    torch.save(runner.alg.get_policy().state_dict(), arguments[0])
    torch.distributed.destroy_process_group()  # its threads must not outlive the interpreter


@pytest.mark.release
def test_two_processes_train_one_network(library, tmp_path, monkeypatch):
    """Both processes of a torchrun on the CPU end with the same network and input statistics."""
    library.save(tmp_path / "library.npz")
    flags = ["--device", "cpu", "--worlds", "2", "--steps", "4", "--iterations", "1", "--no-mirror"]
    flags += ["--library", str(tmp_path / "library.npz"), "--log-dir", str(tmp_path / "run")]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        group = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    arguments = [str(tmp_path / "second.pt"), *flags]
    second = Child(f"{__name__}:second_process", arguments, **group, RANK="1", LOCAL_RANK="1")
    for name, value in (group | {"RANK": "0", "LOCAL_RANK": "0"}).items():
        monkeypatch.setenv(name, value)
    precision = torch.get_float32_matmul_precision()
    try:
        runner = session.build(tyro.cli(TrainOptions, args=flags))
        runner.learn(1)
        assert second.wait(300) == 0, second.printed()[1][-2000:]
    finally:
        second.kill()
        torch.set_float32_matmul_precision(precision)
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
    one, two = runner.alg.get_policy().state_dict(), torch.load(tmp_path / "second.pt", weights_only=True)
    assert one.keys() == two.keys()
    for name, value in one.items():
        assert torch.equal(value, two[name]), name
    row = json.loads((tmp_path / "run" / "progress.jsonl").read_text().splitlines()[0])
    assert row["samples"] == 2 * 2 * 4


def test_curves(trained, tmp_path, capsys):
    """A picture of one training or several; a folder without a log is named."""
    out, log = tmp_path / "curves.png", str(trained.folder)
    assert command_line.main(["curves", log, f"{log}/progress.jsonl", "--out", str(out)]) == 0
    with Image.open(out) as picture:
        assert picture.width > 1000 and len(set(picture.convert("L").resize((60, 30)).getdata())) > 10
    (tmp_path / "bad.jsonl").write_text("3\n{}\n")
    (tmp_path / "deep.jsonl").write_text("[" * 100_000 + "\n{}\n")
    for arguments, words in (
        (["curves", str(tmp_path / "b")], "b/progress.jsonl: cannot be read"),
        (["curves"], "name folders of trainings"),
        (["curves", log, log], "is named twice"),
        (["export", log, log], "unknown argument"),
        (["curves", str(tmp_path / "bad.jsonl")], "a logged iteration lacks seconds"),
        (["curves", str(tmp_path / "deep.jsonl")], "deep.jsonl: line 1 is not JSON"),
        (["curves", log, "--out", str(tmp_path / "a.txt")], "expected .png"),
    ):
        assert command_line.main(arguments) == 2
        assert words in capsys.readouterr().err


def test_start_from_weights(env, trained, still, tmp_path):
    """A new training begins with the network of a weights file, and keeps it while the critic learns."""
    file = export(trained.folder / "model_last.pt", ExportOptions(tmp_path / "weights.safetensors"))
    weights = {k: v.clone() for k, v in trained.alg.get_policy().net.state_dict().items() if not k.endswith("count")}

    second = make_runner(env)
    second.start_from(file)
    critic = [p.detach().clone() for p in second.alg.critic.parameters()]
    second.critic_iterations = 2
    second.learn(2)
    for name, value in second.alg.get_policy().net.state_dict().items():
        if name.startswith("norm.") and name in weights:  # rounding next to the floor of a deviation
            torch.testing.assert_close(value, weights[name], atol=1e-3, rtol=1e-3)
        elif name in weights:
            assert torch.equal(value, weights[name]), name
    assert any(not torch.equal(a, b) for a, b in zip(critic, second.alg.critic.parameters(), strict=True))
    second.learn(1)
    moved = [k for k, v in second.alg.get_policy().net.state_dict().items() if k in weights and (v != weights[k]).any()]
    assert any(k.endswith("weight") for k in moved), "afterwards the network learns"


def test_start_from_unfit_weights(env, tmp_path):
    """Weights of another width are refused by the flag's name."""
    with pytest.raises(InputError, match="--start-from .*: no such|--start-from .*absent"):
        make_runner(env).start_from(tmp_path / "absent.safetensors")
    if base.weights_path("twist2").is_file():
        with pytest.raises(InputError, match="other widths"):
            make_runner(env).start_from(base.weights_path("twist2"))


def test_mistakes_answer_in_one_line(tmp_path, capsys, monkeypatch):
    """Wrong flags and files exit with 2 and name what is wrong."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.pt").write_bytes(b"no checkpoint")
    for arguments, words in (
        (["--library", str(tmp_path / "none.npz"), "--device", "cpu"], "no such file"),
        (["--rewards", "nonsense", "1.0"], "nonsense"),
        (["export", str(tmp_path / "bad.pt"), "--out", str(tmp_path / "x.safetensors")], "not a training checkpoint"),
        (["export", "--out", "x.safetensors", "bad.pt"], "export: name the checkpoint: "),
        (["--resume", str(tmp_path / "bad.pt"), "--device", "cpu"], "--resume"),
        (["--families", "stnd", "3", "--device", "cpu"], "--families"),
        (["--events", "push", "planar", "3", "--no-randomise", "--device", "cpu"], "--events: sets"),
        (["export", str(tmp_path / "none.pt"), "--out", str(tmp_path / "x.safetensors")], "no such checkpoint"),
        (["--device", "cpu", "--start-from", str(tmp_path)], "--start-from"),
        (["--device", "cpu", "--settle", "0.3"], "--anneal"),
        (["--device", "cpu", "--log-dir", str(tmp_path / "bad.pt" / "x")], "--log-dir"),
    ):
        assert command_line.main(arguments) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1
    with pytest.raises(InputError, match="pass one of the two"):
        check(TrainOptions(library=tmp_path / "a.npz", families={"walk": 1}))


def test_what_is_no_interface_is_refused():
    """A tracker or an action form that training does not know is named, not taken for another."""
    with pytest.raises(InputError, match=r"--tracker .*nosuch.*sonic, twist2"):
        session.build(TrainOptions(tracker="nosuch"))
    with pytest.raises(InputError, match="--action-form nosuch: expected auto, residual or default"):
        session.build(TrainOptions(action_form="nosuch"))


def test_training_options_have_one_default():
    """No other part of a training has a default for a number or a switch of its options: only `TrainOptions` does."""
    plain = {f.name for f in dataclasses.fields(TrainOptions) if isinstance(f.default, int | float)} - {"minutes"}
    found = []
    for module in pkgutil.iter_modules(train.__path__, f"{train.__name__}."):
        parts = vars(importlib.import_module(module.name)).values()
        own = [p for p in parts if getattr(p, "__module__", "") == module.name and p is not TrainOptions]
        methods = [m for p in own if inspect.isclass(p) for m in vars(p).values()]
        for function in filter(inspect.isfunction, [*own, *methods]):
            given = inspect.signature(function).parameters.values()
            found += [f"{module.name}: {p.name}" for p in given if p.name in plain and p.default is not p.empty]
    assert not found


UNFIT = (
    "--worlds -1; --keep-last -1; --iterations 0; --minutes -1; --minibatches 1000; --learning-rate nan; --seed -1; "
    "--families walk -3; --episode-s 1e30; --rewards heading nan; --events; --events push"
)


@pytest.mark.parametrize("flags", map(str.split, UNFIT.split("; ")), ids=" ".join)
def test_numbers_out_of_range_are_refused_first(flags, tmp_path, capsys):
    """A number that no training can use, or none, is one line with its flag, before references are made."""
    log_dir = tmp_path / "log"
    assert command_line.main(["--device", "cpu", "--worlds", "8", "--log-dir", str(log_dir), *flags]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and flags[0] in message
    assert not log_dir.exists()
