"""Trainings of a narrow ACT on the CPU: result, resume, signals, several processes, errors."""

import csv
import dataclasses
import json
import os
import random
import re
import resource
import shutil
import signal
import socket
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from safetensors.torch import load_file

from arena_newton.errors import ArenaError, InputError
from arena_newton.physics.devices import torch_threads
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts, checkpoint_folder
from arena_newton.policies.lerobot.checkpoint_policy import LeRobotPolicy
from arena_newton.policies.recipes.training_recipe import recipe
from arena_newton.policies.train import (
    training,
    training_log,
    training_loop,
    training_state,
)
from arena_newton.policies.train.__main__ import main
from arena_newton.policies.train.frames.demonstration_rows import read_rows
from arena_newton.policies.train.frames.frame_store import load_frames
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from arena_newton.policies.train.training import train
from tests.children import Child
from tests.fuzz.mutants import damaged
from tests.patience import wait_for
from tests.policies.train import narrow_network
from tests.policies.train.plain_trainer import plain_trainer
from tests.policies.train.small_dataset import info, make_dataset, padded
from tests.policies.train.stock_lerobot import opened, raw_observation

STEPS = 8
FRONT = "observation.images.front"


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    """A vision encoder that trains in milliseconds."""
    narrow_network.install(monkeypatch.setattr)


def options(data, out, **changes):
    """Flags of a small training without a bar."""
    given = {"recipe": "small", "dataset": (data,), "out": out, "device": "cpu", "steps": STEPS, "quiet": True}
    return PolicyTrainOptions(**(given | changes))


def weights(folder):
    """Tensors of a checkpoint: policy and optimizer."""
    checkpoint = checkpoint_folder(folder).parent
    found = load_file(checkpoint / "pretrained_model" / "model.safetensors")
    return found | load_file(checkpoint / "training_state" / "optimizer_state.safetensors")


def same(one, two):
    """True if two sets of tensors are equal to the last bit."""
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory):
    """A training without an interruption."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        narrow_network.install(patch.setattr)
        train(options(dataset, out, save_every=3, hold_out=1, hold_out_every=4, log_every=2))
    return out


def rows(out):
    """Rows of a training's log."""
    with (out / "progress.csv").open() as file:
        return list(csv.DictReader(file))


def interrupt(monkeypatch, step, act):
    """Let something happen as soon as a step is done."""
    advance = PolicyTrainer.advance

    def interrupted(self):
        advance(self)
        if self.step == step:
            act()

    monkeypatch.setattr(PolicyTrainer, "advance", interrupted)


def test_a_training_leaves_a_checkpoint_that_says_everything(dataset, whole):
    """LeRobot's layout, the last checkpoints only, `last` a relative link, and facts with data, steps, time, device."""
    folder = whole / "checkpoints"
    assert sorted(one.name for one in folder.iterdir()) == ["000006", "000008", "last"]
    assert os.readlink(folder / "last") == "000008" and not list(whole.rglob("*.part"))
    facts = CheckpointFacts.read(checkpoint_folder(whole))
    assert (facts.family, facts.recipe, facts.labels, facts.realign) == ("act", "small", "v4", 0.002)
    assert (facts.width, facts.height, facts.fit, facts.task_vector) == (64, 64, "pad", ())
    assert (facts.tasks, facts.trackers, facts.steps, facts.seed) == (("boxing",), ("twist2",), STEPS, 42)
    assert facts.device == "cpu" and 0.0 < facts.minutes < 5.0
    (data,) = facts.datasets
    assert (data["name"], data["episodes"], data["frames"]) == (dataset.name, 3, info(dataset)["total_frames"])
    assert facts.options["flags"]["hold_out"] == 1 and facts.options["recipe"]["batch_size"] == 2
    step = json.loads((folder / "last" / "training_state" / "training_step.json").read_text())
    assert step == {"step": STEPS, "num_processes": 1, "batch_size": 2}


def test_a_stock_lerobot_loads_it(whole):
    """LeRobot's own calls give a policy with processors that acts on a raw observation."""
    folder = checkpoint_folder(whole)
    config = PreTrainedConfig.from_pretrained(folder)
    policy = get_policy_class(config.type).from_pretrained(folder, config=config)
    pre, post = make_pre_post_processors(config, pretrained_path=str(folder))
    batch = pre({"observation.state": torch.zeros(1, 64), "observation.images.front": torch.rand(1, 3, 64, 64)})
    chunk = post(policy.predict_action_chunk(batch))
    assert chunk.shape == (1, 20, 40) and torch.isfinite(chunk).all()


def test_the_log_has_its_rows(whole):
    """Steps, losses, learning rates along warm-up and cosine, held-out losses where they are due; curves next to it."""
    table = rows(whole)
    assert [int(row["step"]) for row in table] == [2, 4, 6, 8]
    assert [bool(row["held_out_loss"]) for row in table] == [False, True, False, True]
    settings = dataclasses.replace(recipe("act", "small"), steps=STEPS, warmup_steps=0)
    for row in table:
        wanted = settings.lr * settings.lr_factor(int(row["step"]) - 1)
        assert float(row["learning_rate"]) == pytest.approx(wanted) and float(row["gradient_norm"]) > 0
    assert list((whole / "tensorboard").glob("events.*"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_training_goes_on_to_the_same_bits(dataset, whole, tmp_path, monkeypatch, capsys, number):
    """Ctrl-C or SIGTERM saves, says how to go on and gives 130; resumed, weights and moments are those of the whole."""
    out = tmp_path / "run"
    flags = ["--recipe", "small", "--dataset", str(dataset), "--out", str(out), "--device", "cpu", "--quiet"]
    flags += ["--steps", str(STEPS), "--hold-out", "1", "--hold-out-every", "4", "--log-every", "2"]
    handler = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        interrupt(patch, 5, lambda: os.kill(os.getpid(), number))
        assert main(flags) == 130
    assert f"stopped after 5 steps; go on with: python -m arena_newton.policies.train --resume {out}" in (
        capsys.readouterr().out
    )
    assert signal.getsignal(signal.SIGTERM) == handler
    torch.manual_seed(999)
    assert main(["--resume", str(out)]) == 0
    assert same(weights(out), weights(whole))
    assert [row["step"] for row in rows(out)] == ["2", "4", "6", "8"]
    assert [row["loss"] for row in rows(out)] == [row["loss"] for row in rows(whole)]


def test_a_finished_training_says_so(whole, capsys):
    """The command line's --resume of a finished training names its checkpoint."""
    assert main(["--resume", str(whole)]) == 0
    assert f"finished already, after {STEPS} steps: {whole}/checkpoints/00000{STEPS}/" in capsys.readouterr().out


def test_a_finished_training_is_not_repeated(whole, monkeypatch):
    """Resumed, it gives its checkpoint at once, without reading the data."""
    monkeypatch.setattr(training, "read_rows", lambda *_: pytest.fail("reads the data"))
    assert train(PolicyTrainOptions(resume=whole)) == whole / "checkpoints" / "000008" / "pretrained_model"


def test_a_failing_disk_leaves_the_last_whole_checkpoint(dataset, whole, tmp_path, monkeypatch):
    """A checkpoint of which any part cannot be written leaves the one before whole, from which the training goes on."""
    real = {name: getattr(training_state, name) for name in ("_write_optimizer", "_synced", "save_rng_state")}
    for number, name in enumerate(real):
        out = tmp_path / str(number)

        def failing(*arguments, name=name):
            if any("000006" in str(one) for one in arguments):
                raise OSError(28, "No space left on device")
            return real[name](*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(training_state, name, failing)
            with pytest.raises(InputError, match="000006: the checkpoint cannot be written .No space left on device"):
                train(options(dataset, out, save_every=3, hold_out=1))
        assert os.readlink(out / "checkpoints" / "last") == "000003"
        assert CheckpointFacts.read(checkpoint_folder(out)).steps == 3
    train(PolicyTrainOptions(resume=out, quiet=True))
    assert same(weights(out), weights(whole)) and not list(out.rglob("*.part"))


def test_a_full_disk_is_one_error(dataset, tmp_path, capsys):
    """A full disk under safetensors or the log is a message with the path and code 2; no part of it takes space."""
    out = tmp_path / "run"
    given = ["--dataset", str(dataset), "--recipe", "small", "--device", "cpu", "--steps", "1", "--out", str(out)]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))  # bytes of a file; a write beyond fails
    try:
        assert main(given) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    error = capsys.readouterr().err
    assert f"error: {out}/checkpoints/000001: the checkpoint cannot be written (" in error and "File too large" in error
    assert not list((out / "checkpoints").iterdir())


def test_a_log_on_a_full_disk_is_one_error(dataset, tmp_path, monkeypatch):
    """A row of the log that cannot be written ends the training with the folder's name."""

    def full(self, row):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(training_log.TrainingLog, "record", full)
    with pytest.raises(InputError, match=r"--out .*run: cannot be written .No space left on device"):
        train(options(dataset, tmp_path / "run"))


def narrow_main(arguments):
    """The command, of the narrow network, in a process of its own."""
    narrow_network.install()
    return main(arguments)


NARROW = f"{__name__}:narrow_main"


@pytest.mark.release
def test_a_killed_training_goes_on(dataset, tmp_path):
    """After kill -9 at any moment `last` is a whole checkpoint, with which the training goes on."""
    out = tmp_path / "run"
    flags = ["--recipe", "small", "--dataset", str(dataset), "--out", str(out), "--device", "cpu", "--save-every", "1"]
    process = Child(NARROW, [*flags, "--steps", "100000", "--quiet"])
    try:
        last = out / "checkpoints" / "last"
        wait_for(lambda: last.exists() or process.poll() is not None, "checkpoint", 400.0)
        assert process.poll() is None
        time.sleep(random.Random().uniform(0.0, 0.3))
    finally:
        process.kill()
        process.wait()
    done = CheckpointFacts.read(checkpoint_folder(out)).steps
    assert done >= 1
    train(PolicyTrainOptions(resume=out, steps=done + 2, quiet=True))
    assert CheckpointFacts.read(checkpoint_folder(out)).steps == done + 2
    assert not list(out.rglob("*.part"))


@pytest.mark.release
def test_processes_train_one_network(dataset, tmp_path, monkeypatch):
    """Both processes of a torchrun on the CPU hold the same weights at each checkpoint, which the first writes."""
    out, agreed = tmp_path / "run", []
    check = PolicyTrainer.check_agreement
    monkeypatch.setattr(PolicyTrainer, "check_agreement", lambda self: (check(self), agreed.append(self.step)))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        group = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    flags = ["--recipe", "small", "--dataset", str(dataset), "--out", str(out), "--device", "cpu", "--quiet"]
    arguments = [*flags, "--steps", "3", "--keep", "0", "--save-every", "1"]
    second = Child(NARROW, arguments, **group, RANK="1", LOCAL_RANK="1")
    for name, value in (group | {"RANK": "0", "LOCAL_RANK": "0"}).items():
        monkeypatch.setenv(name, value)
    try:
        train(options(dataset, out, steps=3, save_every=1, keep=0))
        assert second.wait(400) == 0, second.printed()
    finally:
        second.kill()
    progress = training_state.TrainingProgress.read(out / "checkpoints" / "last")
    assert (progress.step, progress.processes, progress.batch_size) == (3, 2, 2)
    assert CheckpointFacts.read(checkpoint_folder(out)).processes == 2
    assert agreed == [1, 2, 3]
    assert not torch.distributed.is_initialized()


def a_second_a_step(monkeypatch, later=1.0, since=0):
    """A clock by which each step takes a second, from some step on another time."""
    clock = [1000.0]
    monkeypatch.setattr(training_loop, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    advance = PolicyTrainer.advance

    def slow(self):
        advance(self)
        clock[0] += later if self.step > since > 0 else 1.0

    monkeypatch.setattr(PolicyTrainer, "advance", slow)


def test_the_schedule_ends_when_the_time_is_up(dataset, tmp_path, monkeypatch):
    """--minutes fixes the number of steps by the measured speed; with the last one the cosine reaches its end."""
    a_second_a_step(monkeypatch)
    folder = train(options(dataset, tmp_path / "run", steps=0, minutes=0.5, log_every=1, save_every=0))
    facts = CheckpointFacts.read(folder)
    assert 27 <= facts.steps <= 30 and 0.45 <= facts.minutes <= 0.5
    rates = [float(row["learning_rate"]) for row in rows(tmp_path / "run")]
    low = recipe("act", "small").final_lr_fraction * max(rates)
    assert rates[-1] == pytest.approx(low, rel=0.5) and rates[15] == pytest.approx(max(rates) / 2, rel=0.2)


def test_the_schedule_is_shortened_where_steps_become_slower(dataset, tmp_path, monkeypatch):
    """Of 60 s a step takes one second, from the ninth on two: 34 steps, whose cosine reaches its end; in time."""
    monkeypatch.setattr(training_loop, "MEASURED_STEPS", 4)
    monkeypatch.setattr(training_loop, "SKIPPED_STEPS", 2)
    a_second_a_step(monkeypatch, later=2.0, since=8)
    folder = train(options(dataset, tmp_path / "run", steps=0, minutes=1.0, log_every=1, save_every=0))
    facts = CheckpointFacts.read(folder)
    assert 30 <= facts.steps <= 36 and 0.9 <= facts.minutes <= 1.05
    rates = [float(row["learning_rate"]) for row in rows(tmp_path / "run")]
    assert rates[-1] == pytest.approx(recipe("act", "small").final_lr_fraction * max(rates), rel=0.5)


def test_another_time_on_resume_is_kept(dataset, tmp_path, monkeypatch):
    """--resume with more --minutes trains on, with a schedule that ends then; --steps in its place does as well."""
    a_second_a_step(monkeypatch)
    out = tmp_path / "run"
    assert 13 <= CheckpointFacts.read(train(options(dataset, out, steps=0, minutes=0.25))).steps <= 15
    again = PolicyTrainOptions(resume=out, minutes=0.5, quiet=True)
    facts = CheckpointFacts.read(train(again))
    assert 27 <= facts.steps <= 30 and 0.45 <= facts.minutes <= 0.5
    assert CheckpointFacts.read(train(again)).steps == facts.steps
    assert CheckpointFacts.read(train(PolicyTrainOptions(resume=out, steps=32, quiet=True))).steps == 32


def test_a_folder_belongs_to_one_process(dataset, whole, tmp_path, monkeypatch):
    """A second training in the folder of a running one is refused, and one that was finished meanwhile is kept."""
    out = tmp_path / "run"
    refused = []

    def second():
        with pytest.raises(InputError, match=r"another process trains in it") as caught:
            train(options(dataset, out, steps=1))
        refused.append(caught.value)

    interrupt(monkeypatch, 2, second)
    train(options(dataset, out, steps=3))
    assert len(refused) == 1 and [one.name for one in sorted((out / "checkpoints").iterdir())] == ["000003", "last"]
    monkeypatch.setattr(training, "check_new", lambda out: None)  # it was not there yet when this one began
    with pytest.raises(InputError, match=r"holds a training already"):
        train(options(dataset, out, steps=1))


@pytest.fixture(scope="module")
def pairs(dataset, tmp_path_factory):
    """Datasets of Boxing through both trackers and of Football through one."""
    folder = tmp_path_factory.mktemp("pairs")
    sonic = make_dataset(folder, lengths=(24, 22), tracker="sonic")
    return dataset, sonic, make_dataset(folder, lengths=(22, 23), task="football", labels="v4")


def test_many_tasks_through_several_trackers(pairs, tmp_path, monkeypatch, capsys):
    """The vector names task and tracker, fractions and losses are of each pair, a resumed training has the same bits.

    What the training began with counts on a resume, whatever the recipe of that name has become.
    """
    given = {"dataset": pairs, "balance": "task", "task_weights": ("football=3",), "task_vector": True, "steps": 6}
    given |= {"hold_out": 1, "hold_out_every": 3, "log_every": 3, "batch_size": 8, "quiet": False}
    whole = train(options(None, tmp_path / "whole", **given))
    printed = capsys.readouterr().out
    facts = CheckpointFacts.read(whole)
    assert (facts.task_vector, facts.tracker_vector) == (("boxing", "football"), ("sonic", "twist2"))
    assert PreTrainedConfig.from_pretrained(whole).input_features["observation.environment_state"].shape == (5,)
    names = ("boxing_sonic", "boxing_twist2", "football_twist2")
    for row in rows(tmp_path / "whole"):
        assert all(float(row[f"held_out_loss_{name}"]) > 0.0 for name in names) and float(row["loss_football_twist2"])
    found = {name: float(re.search(rf"^{name}: (\S+) % of the samples", printed, re.M)[1]) for name in names}
    assert found["football_twist2"] > 40.0 > max(found["boxing_sonic"], found["boxing_twist2"])
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt(patch, 4, lambda: os.kill(os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            train(options(None, out, **given))
    monkeypatch.setattr(training, "chosen_recipe", lambda options: pytest.fail("takes another recipe"))
    train(PolicyTrainOptions(resume=out, quiet=True))
    assert same(weights(out), weights(tmp_path / "whole"))


def test_a_policy_that_is_not_given_its_tracker(pairs, tmp_path):
    """--no-tracker-vector leaves it out, as trainings did before there was the flag, which go on without."""
    out = tmp_path / "run"
    facts = CheckpointFacts.read(
        train(options(None, out, dataset=pairs[:2], task_vector=True, tracker_vector=False, steps=1))
    )
    assert (facts.task_vector, facts.tracker_vector, facts.vector_width) == (("boxing",), (), 1)
    progress = out / "checkpoints" / "last" / "training_state" / "arena_training.json"
    content = json.loads(progress.read_text())
    del content["options"]["tracker_vector"]
    progress.write_text(json.dumps(content))
    assert CheckpointFacts.read(train(PolicyTrainOptions(resume=out, steps=2, quiet=True))).tracker_vector == ()


def test_losses_of_pairs_sum_to_the_whole(pairs, monkeypatch):
    """Weighed by their samples, losses of pairs are the loss of the step, and held-out ones that of all rows."""
    store = load_frames([read_rows(one, "v4") for one in pairs], torch.device("cpu"), hold_out=1, jobs=1)
    trainer = plain_trainer(16, store=store)
    for _ in range(2):
        before = dict(trainer.drawn)
        trainer.advance()
        losses = trainer.pair_losses()
        counts = {name: trainer.drawn[name] - before[name] for name in losses}
        assert sum(counts.values()) == 16 and len(losses) > 1
        assert sum(counts[name] * losses[name] for name in losses) / 16 == pytest.approx(float(trainer.loss))
    held, of_pairs = trainer.held_out_losses()
    taken = np.linspace(0, len(trainer.held) - 1, len(trainer.held) // 16 * 16).round().astype(int)
    counts = np.bincount(store.pair[trainer.held[taken]], minlength=3)
    assert sum(counts * list(of_pairs.values())) / sum(counts) == pytest.approx(held)


def test_a_network_without_the_pad(dataset, tmp_path, monkeypatch):
    """Black bars of a dataset are cut off, and the policy wants the camera's own 4:3; pictures without bars stay."""
    monkeypatch.setattr(training, "chosen_recipe", lambda options: recipe("act", "small", cut_pad=True))
    folder = train(options(dataset, tmp_path / "cut", steps=1))
    assert LeRobotPolicy(folder).camera == CameraConfig(width=64, height=48, fit="native")
    policy, before, _ = opened(folder)
    assert (
        policy.predict_action_chunk(before(raw_observation(rows=1) | {FRONT: torch.rand(1, 3, 48, 64)}))
        .isfinite()
        .all()
    )
    bright = make_dataset(
        tmp_path, lengths=(22,), pictures=lambda n, size, seed: np.full((n, size, size, 3), 90, np.uint8)
    )
    facts = CheckpointFacts.read(train(options(bright, tmp_path / "whole", steps=1)))
    assert (facts.width, facts.height, facts.fit) == (64, 64, "native")


def test_a_training_has_no_more_threads_than_cores_are_given(dataset, tmp_path, monkeypatch, capsys):
    """`--jobs` of a training that shares its machine; what was set before returns. Its log says what was decoded."""
    found, build = [], training.families.build
    monkeypatch.setattr(training.families, "build", lambda *a: found.append(torch.get_num_threads()) or build(*a))
    with torch_threads(2):
        for jobs in (0, 1, 3):
            train(options(dataset, tmp_path / str(jobs), steps=1, jobs=jobs))
        assert torch.get_num_threads() == 2
    assert found == [2, 1, 2]
    assert capsys.readouterr().out.count("pictures, 0.0") == 3


def test_a_loss_that_is_not_finite_ends_the_training(dataset, tmp_path, monkeypatch):
    """It is an error that names the step and keeps the last checkpoint."""

    def broken(self):
        self.step += 1
        self._loss.fill_(1.0 if self.step < 4 else float("nan"))

    monkeypatch.setattr(PolicyTrainer, "advance", broken)
    with pytest.raises(ArenaError, match=r"the loss is nan at step 4; the last checkpoint is .*000002"):
        train(options(dataset, tmp_path / "run", save_every=2, log_every=1))


BAD = [
    (["--policy", "cat"], "--policy cat: unknown, choose from act, diffusion, flow, pi05"),
    (["--recipe", "slow"], "--recipe slow: unknown"),
    (["--policy", "diffusion", "--recipe", "compact"], "--recipe compact: unknown for --policy diffusion"),
    (["--dataset", "nowhere"], "--dataset nowhere: no such folder"),
    (["--steps", "-1"], "--steps -1: expected a number from 0"),
    (["--minutes", "nan"], "--minutes nan: expected a number"),
    (["--labels", "v5"], "--labels v5: unknown"),
    (["--cameras", "front", "world"], "--cameras front world: expected different ones of front left_wrist right_wrist"),
    (["--cameras", "left_wrist"], "--cameras left_wrist: "),
    (["--cameras", "front", "left_wrist", "--looks", "0.5"], "--looks: changes the pictures of camera front alone"),
    (["--steps", "3", "--minutes", "1"], "--steps: is given by --minutes too; drop one of them"),
    (["--dataset", "."], "--dataset .: no LeRobot dataset, meta/info.json is missing; `python -m arena_newton.data"),
    (["--device", "tpu"], "--device tpu: unknown"),
    (["--hold-out", "9"], "--hold-out 9: "),
    (["--recipe", "fast"], "pictures of 64x64 pixels, recipe act/fast takes 224x224: record with --size 224x224"),
    (["--resume", "nowhere"], "--resume nowhere: no such folder"),
    (["--balance", "even"], "--balance even: unknown, choose from picture, task"),
    (["--task-weights", "boxing=2"], "--task-weights: weigh the draw of --balance task, which is not given"),
    (["--balance", "task", "--task-weights", "boxing=0"], "--task-weights boxing=0: expected a task and a positive"),
    (["--balance", "task", "--task-weights", "football=2"], "--task-weights football: the datasets have boxing"),
    (["--look-changes", "light=0"], "--look-changes: belongs to --looks, which is not given"),
    (["--looks", "1", "--look-changes", "light"], "--look-changes light: expected a kind of change and a probability"),
    (["--looks", "1", "--look-changes", "light=0", "light=1"], "--look-changes for light: given twice"),
    (["--looks", "1", "--look-changes", "light=nan"], "--look-changes light=nan: expected a kind of change"),
    (["--recipe-values", "colour=NaN"], "--recipe-values: colour is NaN, expected float"),
    (["--recipe-values", "shift_px=-3"], "recipe act/small: shift_px is -3, expected 0 or more"),
    (["--recipe-values", "lr=1"], "--recipe-values lr=1: --lr says it"),
    (["--recipe-values", "shift_px"], "--recipe-values shift_px: expected a field once and its value"),
    (["--recipe-values", "shift_px=0.5"], "--recipe-values: shift_px is 0.5, expected int"),
    (["--recipe-values", "shift=1"], "--recipe-values: shift is not an option, known are"),
    (["--recipe-values", "network.shift=1"], "recipe act/small: ACTConfig.__init__() got an unexpected"),
    (["--picture-every", "0"], "--picture-every 0: expected a number from 1"),
    (["--steps", "many"], "--steps: cannot read many"),
    (["--speed", "1"], "--speed: unknown argument"),
]


@pytest.mark.parametrize(("flags", "words"), BAD)
def test_a_bad_flag_is_one_error(dataset, tmp_path, monkeypatch, capsys, flags, words):
    """It names flag or file, the code is 2, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    given = ["--dataset", str(dataset), "--recipe", "small", "--device", "cpu", "--steps", "1", *flags]
    assert main(given) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_is_not_overwritten_nor_mixed(dataset, whole, tmp_path, capsys):
    """A folder with a training is refused without --resume; a resumed one refuses other settings and other data."""
    before = weights(whole)
    given = ["--dataset", str(dataset), "--recipe", "small", "--device", "cpu", "--steps", "1", "--out", str(whole)]
    for flags, words in (
        (given, f"--out {whole}: holds a training already; --resume {whole} goes on with it"),
        (["--resume", str(whole), "--seed", "3"], f"--seed 3: the training in {whole} has None"),
        (["--resume", str(whole), "--recipe", "fast"], f"--recipe fast: the training in {whole} has small"),
        (["--resume", str(whole), "--policy", "flow"], f"--policy flow: the training in {whole} has act"),
        (["--resume", str(tmp_path)], f"--resume {tmp_path}: holds no checkpoint of a training"),
    ):
        assert main(flags) == 2
        assert words in capsys.readouterr().err
    other = make_dataset(tmp_path, lengths=(22, 23))
    assert main(["--resume", str(whole), "--dataset", str(other), "--steps", "20"]) == 2
    assert "the content is not that of the datasets which the training began with" in capsys.readouterr().err
    dark = make_dataset(tmp_path / "dark", pictures=lambda *given: padded(*given) // 2)
    shutil.copy(dataset / "meta" / "info.json", dark / "meta")  # other pictures, which the original's file does not say
    assert main(["--resume", str(whole), "--dataset", str(dark), "--steps", "20"]) == 2
    assert "the content is not that of the datasets which the training began with" in capsys.readouterr().err
    assert same(weights(whole), before)


def test_damaged_states_are_refused_by_name(whole, tmp_path, monkeypatch, mutants):
    """Damaged progress files, optimizer states and weights: accepted, or one error with the file's name."""
    checkpoint = shutil.copytree(whole / "checkpoints" / "000008", tmp_path / "c")
    trainer = plain_trainer(2)
    trainer.model.save(checkpoint / "pretrained_model", CheckpointFacts())
    trainer.advance()
    training_state._write_optimizer(trainer.optimizer, checkpoint / "training_state")
    rng, refused = random.Random(1), 0
    for file in (
        checkpoint / "training_state" / "arena_training.json",
        checkpoint / "training_state" / "optimizer_state.safetensors",
        checkpoint / "pretrained_model" / "model.safetensors",
    ):
        sound = file.read_bytes()
        # Of large files the header is what is read; the numbers are numbers.
        head = len(sound) if file.suffix == ".json" else 8 + int.from_bytes(sound[:8], "little")
        for _ in range(mutants):
            file.write_bytes(damaged(sound[:head], rng, text=file.suffix == ".json") + sound[head:])
            try:
                training_state.restore(trainer, checkpoint)
                training.resumed(
                    PolicyTrainOptions(), training_state.TrainingProgress.read(checkpoint).options, checkpoint
                )
            except InputError as error:
                refused += 1
                assert str(checkpoint) in str(error)
        file.write_bytes(sound)
        training_state.restore(trainer, checkpoint)
    assert refused > mutants
