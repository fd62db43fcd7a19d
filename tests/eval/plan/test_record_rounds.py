"""Attempts that are due when successes are wanted."""

import random

import pytest

from arena_newton.errors import InputError
from arena_newton.eval.plan import episode_plan, rounds
from arena_newton.eval.plan.config import recorded_cameras, recording_run, resolve
from arena_newton.eval.plan.options import RecordOptions, RunOptions
from arena_newton.eval.play.recording import outcome_lines
from arena_newton.rules import seeding


def played(group, succeeds, keep, order=lambda batch: batch):
    """Numbers played, in rounds; `order` is the one in which a round's episodes end."""
    ended, batches = {}, []
    while batch := rounds.due(group, ended, keep):
        batches.append(batch)
        for index in order(batch):
            ended[index] = "success" if succeeds(index) else "fall"
    return batches, ended


def test_each_round_has_as_many_attempts_as_successes_are_missing():
    """Three wanted, the first and the fourth attempt fail: rounds of three, one and one, and no success too many."""
    batches, ended = played(range(10, 16), lambda index: index not in (10, 13), 3)
    assert batches == [[10, 11, 12], [13], [14]]
    assert sum(outcome == "success" for outcome in ended.values()) == 3


def test_attempts_end_with_the_plan():
    """Without any success all planned attempts are played, and no more."""
    batches, ended = played(range(4), lambda index: False, 2)
    assert batches == [[0, 1], [2, 3]] and len(ended) == 4


def test_what_is_kept_does_not_depend_on_the_order_of_endings_or_an_interruption():
    """Rounds follow from outcomes alone: with any order of endings, or a stop, the same are played."""
    for seed in range(50):
        draw = random.Random(seed)
        good = {index for index in range(20) if draw.random() < 0.6}
        batches, ended = played(range(20), good.__contains__, 10)
        shuffled, again = played(range(20), good.__contains__, 10, lambda batch: batch[::-1])
        assert shuffled == batches and again == ended
        some = dict(draw.sample(sorted(ended.items()), draw.randrange(len(ended))))
        resumed = dict(some)
        while batch := rounds.due(range(20), resumed, 10):
            resumed |= {batch[0]: "success" if batch[0] in good else "fall"}
        assert set(ended) <= set(resumed) and set(resumed) == set(ended) | set(some)


def test_without_a_number_of_successes_everything_is_due():
    """An evaluation plays its whole plan."""
    assert rounds.due(range(4), {1: "fall"}, None) == [0, 2, 3]
    assert not rounds.complete(4, 2, {0: "success", 1: "success", 2: "success"}, None)
    assert rounds.complete(8, 2, {0: "success", 1: "success", 4: "success", 5: "fall", 6: "success"}, 2)
    assert not rounds.complete(8, 2, {0: "success", 1: "success", 4: "success", 5: "fall"}, 2)


def test_seeds_of_demonstrations_are_no_evaluation_seeds():
    """Every seed of a recording has bit 31, which no seed of an evaluation has, and says its range."""
    config = resolve(recording_run(RecordOptions(episodes=50, only_success=True, engine="mujoco", device="cpu")))
    seeds = [episode.episode_seed for episode in config.episodes]
    assert len(seeds) == 7 * 100 and len(set(seeds)) == len(seeds)
    assert {seeding.seed_range(seed) for seed in seeds} == {seeding.DEMONSTRATION}
    evaluated = episode_plan.expand(["all"], trackers=["twist2"], policy="expert", seeds=range(20), repeats=20)
    assert {seeding.seed_range(episode.episode_seed) for episode in evaluated} == {seeding.EVALUATION}
    assert all(episode.episode_seed < 1 << 31 for episode in evaluated) and min(seeds) >= 1 << 31
    other = resolve(recording_run(RecordOptions(episodes=50, seed_series=1, engine="mujoco", device="cpu")))
    assert not set(seeds) & {episode.episode_seed for episode in other.episodes}
    assert config.identity()["seed_range"] == "demonstration" and config.identity()["disturbance"]["joints"] > 0


def test_an_evaluation_is_known_by_what_it_was():
    """Recording adds nothing to an evaluation's identity: pictures change no episode."""
    plain = resolve(RunOptions(task=("boxing",), engine="mujoco", device="cpu"))
    recorded = resolve(RunOptions(task=("boxing",), engine="mujoco", device="cpu", record=True))
    assert plain.identity() == recorded.identity() and "seed_range" not in plain.identity()
    assert plain.recording is None and list(recorded.recording) == ["front"]
    assert recorded.recording["front"].fit == "pad"


def test_pictures_of_the_sensors_shape_have_no_bars():
    """4:3 pictures fill the sensor, squares have black bars, the world camera fills any."""
    names = ("front", "world")
    sensor = recorded_cameras(RunOptions(record=True, record_size="640x480", record_cameras=names))
    square = recorded_cameras(RunOptions(record=True, record_size="224x224", record_cameras=names))
    assert [c.fit for c in sensor.values()] == ["native", "native"]
    assert [c.fit for c in square.values()] == ["pad", "native"] and square["front"].prim == "ego"


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"size": "224"}, "^--size 224:"),
        ({"size": "225x225"}, "even numbers"),
        ({"size": "9999x9999"}, "even numbers"),
        ({"cameras": ("back",)}, "^--cameras back"),
        ({"cameras": ("front", "front")}, "given twice"),
        ({"cameras": (), "depth": True}, "^--depth:"),
        ({"looks": 3}, "^--looks 3: expected 0 to 2"),
        ({"looks": 1, "cameras": ("world",)}, "^--looks: are those of the camera front"),
        ({"looks": 1, "mode": ("base", "visual")}, "^--looks: belongs to modes without looks of their own, not visual"),
        ({"episodes": 0}, "--episodes 0"),
        ({"episodes": 10**9}, "--episodes: makes"),
        ({"seed_series": 10**20}, "--seed-series 1000"),
        ({"seed_series": -1}, "--seed-series -1"),
        ({"accept_differences": True}, "--accept-differences"),
    ],
)
def test_unfit_flags_are_named(changes, says):
    """A recording that cannot be made is one error that names the flag."""
    with pytest.raises(InputError, match=says):
        resolve(recording_run(RecordOptions(engine="mujoco", device="cpu", **changes)))


def test_nothing_kept_is_nothing_to_build(tmp_path):
    """If no episode was kept, no dataset is advised."""
    config = resolve(recording_run(RecordOptions(task=("boxing",), only_success=True, engine="mujoco", device="cpu")))
    lines = outcome_lines(config, tmp_path, [])
    assert lines[0].startswith("recorded: 0 episodes") and not [line for line in lines if "dataset:" in line]


def test_recording_flags_belong_to_record():
    """Without --record its flags are refused."""
    with pytest.raises(InputError, match="--record-size: belongs to --record"):
        resolve(RunOptions(record_size="640x480", engine="mujoco", device="cpu"))
