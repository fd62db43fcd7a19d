"""The session: real time, dead-man, episodes that a person saves or discards."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import trackers
from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.files.new_folder import held_folder
from arena_newton.policies.teleop import driving_command
from arena_newton.policies.teleop.driving import EVENTS, RANGES, Driver, Held, read_held
from arena_newton.policies.teleop.driving_command import session_facts
from arena_newton.policies.teleop.pace import STARVED, Pace, TimedPicture
from arena_newton.policies.teleop.source import Telemetry, Wish
from arena_newton.policies.teleop.standing import SECONDS, Stander
from arena_newton.policies.teleop.teleop_options import BrowserOptions
from arena_newton.policies.teleop.teleop_session import TeleopSession
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import DEFAULT_POSE, TICK
from arena_newton.rules import seeding

FASTEST = np.full(40, 0.06, np.float32)
"""Largest change of an action in a tick: 3 rad/s of a joint or of a column of the orientation ..."""
FASTEST[ACTION["root_xy_delta"]] = 0.002
"""... 5 m/s² ..."""
FASTEST[ACTION["root_z"]] = 0.02
FASTEST[ACTION["hands"]] = 1.0
"""... and hands, which are switches."""


class Clock:
    """A time of its own, in which only waiting and what a test says take time."""

    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def timeless() -> Pace:
    """A clock that never waits for real."""
    clock = Clock()
    return Pace(clock, clock.sleep)


def standing_view(tick: int = 0) -> Telemetry:
    """A robot that stands at the origin."""
    zero = np.zeros(3, np.float32)
    quat = np.array([1, 0, 0, 0], np.float32)
    joints = np.array(DEFAULT_POSE, np.float32)
    return Telemetry(tick, np.zeros(64, np.float32), zero, quat, zero, joints, np.zeros(29, np.float32), None, "idle")


def walking_action() -> np.ndarray:
    """A pose far from standing, that walks and looks to the left."""
    action = STAND_ACTION.copy()
    action[ACTION["root_xy_delta"]] = 0.012, 0.0
    action[ACTION["root_z"]] = 0.6
    cos, sin = np.cos(2.5), np.sin(2.5)
    action[ACTION["root_rot6d"]] = cos, -sin, sin, cos, 0.0, 0.0
    action[ACTION["joint_pos"]] += 0.5
    action[ACTION["hands"]] = 1.0, 0.0
    return action


def test_a_source_that_falls_silent_leaves_a_robot_that_stands():
    """No action jumps: from the last one to a stand with its heading and hands, and back to the source's own."""
    stander, given = Stander(), walking_action()
    assert np.array_equal(stander.action(given), given), "a source that speaks is put through as it is"
    ticks = round(SECONDS / TICK)
    silent = np.stack([given, *(stander.action(None) for _ in range(ticks + 1))])
    assert stander.standing
    again = np.stack([silent[-1], *(stander.action(given) for _ in range(ticks + 1))])
    assert not stander.standing
    for row in (silent, again):
        assert (np.abs(np.diff(row, axis=0)) <= FASTEST).all()
    stand = STAND_ACTION.copy()
    stand[ACTION["root_rot6d"]], stand[ACTION["hands"]] = given[ACTION["root_rot6d"]], given[ACTION["hands"]]
    np.testing.assert_allclose(silent[-1], stand, atol=1e-6)
    assert np.array_equal(again[-1], given)


def test_the_pace_says_how_late_it_is():
    """A loop that is slow is late and not in real time; what a reset takes counts for nothing."""
    clock = Clock()
    pace = Pace(clock, clock.sleep)
    for _ in range(100):
        pace.wait()
        clock.now += 0.5 * TICK
    assert (pace.ticks, pace.late) == (100, 0) and pace.factor > 0.99
    clock.now += 5.0
    pace.restart()
    pace.wait()
    assert pace.late == 0 and pace.factor > 0.99
    for _ in range(100):
        pace.wait()
        clock.now += 2.0 * TICK
    assert pace.late > 90 and pace.recent < 0.6 and 0.6 < pace.factor < 0.8


def test_pictures_are_put_off_before_ticks_are_late():
    """A picture that costs more than there is time for waits, but not for ever."""
    clock = Clock()
    pace = Pace(clock, clock.sleep)

    def draw() -> None:
        clock.now += 3.0 * TICK

    picture = TimedPicture(draw, 0.1)
    drawn = []
    for _ in range(500):
        pace.wait()
        if picture.try_draw(pace):
            drawn.append(clock.now)
    assert picture.shed > 3
    assert STARVED <= np.median(np.diff(drawn)) <= STARVED + 0.2
    assert pace.factor > 0.95

    cheap = TimedPicture(lambda: None, 0.1)
    for _ in range(500):
        pace.wait()
        cheap.try_draw(pace)
    assert cheap.shed == 0 and 90 <= cheap.drawn <= 110


@pytest.mark.parametrize(
    ("message", "named"),
    [
        ("", "no JSON"),
        ("[" * 3000, "no JSON"),
        ("[]", "no JSON object"),
        ('{"forward": NaN}', "forward"),
        ('{"forward": 1e999}', "forward"),
        ('{"turn": "1"}', "turn"),
        ('{"left": true}', "left"),
        ('{"sit": 1}', "sit"),
        ('{"camera": "moon"}', "camera"),
        ('{"events": ["explode"]}', "events"),
        ('{"events": [["start"]]}', "events"),
        (json.dumps({"events": ["start"] * 9}), "events"),
        ('{"__class__": 1}', "__class__"),
    ],
)
def test_a_message_that_is_wrong_is_refused(message, named):
    """A message that a page may not send is refused by the name of its field."""
    with pytest.raises(InputError, match=named):
        read_held(message)


def test_a_message_is_what_is_held():
    """Numbers beyond their range count as its end; what is not named is at rest."""
    held = read_held(json.dumps({"forward": 7, "height": 0.0, "reach_left": True, "events": ["kick_left", "start"]}))
    assert held == Held(forward=1.0, height=RANGES["height"][0], reach_left=True, events=("kick_left", "start"))
    assert set(held.events) <= set(EVENTS)


def drive(driver: Driver, held: Held | None, ticks: int) -> np.ndarray:
    """Actions of some ticks."""
    return np.stack([driver.action(held, standing_view()) for _ in range(ticks)])


def test_nobody_there_means_stand():
    """The walk ends in three seconds when messages stop, without a jump; height and hands stay as they were."""
    driver = Driver()
    driver.begin(standing_view())
    held = Held(forward=1.0, turn=0.5, height=0.7, reach_right=True, close_left=True)
    walk = drive(driver, held, 150)
    stop = drive(driver, None, 150)
    actions = np.concatenate([walk, stop])
    speed = np.linalg.norm(actions[:, ACTION["root_xy_delta"]], axis=1) / TICK
    assert speed[100:150].mean() > 0.4
    assert speed[-10:].max() < 0.01 and speed[150:].sum() * TICK < 0.8
    change = np.abs(np.diff(actions, axis=0))[:, :-2]
    assert change[149:].max() <= 1.2 * change[60:149].max(), "no jump where the messages stop"
    assert abs(actions[-1, 2] - 0.7) < 0.02 and actions[-1, -2:].tolist() == [1.0, 0.0]


def test_kick_and_seat():
    """A kick lifts its foot once and ends; sitting lowers the pelvis until it is released."""
    driver = Driver()
    driver.begin(standing_view())
    driver.ask("kick_left")
    heights = []
    for _ in range(260):
        driver.action(Held(forward=1.0 if len(heights) < 20 else 0.0), standing_view())
        heights.append(driver.generator.feet_pos[0, :, 2].numpy() - driver.generator.feet_pos[0, :, 2].min().item())
    left, right = np.array(heights).T
    assert left.max() > 0.06 > right.max()
    assert left[-10:].max() < 0.005, "one kick only"
    sat = drive(driver, Held(sit=True), 200)
    assert sat[-1, 2] < 0.6
    assert abs(drive(driver, None, 50)[-1, 2] - sat[-1, 2]) < 0.01, "who sits stays seated when nobody drives"
    assert drive(driver, Held(), 300)[-1, 2] > 0.75


@pytest.fixture(scope="module")
def env():
    """Football with one world."""
    made = ArenaEnv("football", tracker=trackers.get("twist2"), worlds=1, engine="mujoco", threads=1)
    yield made
    made.close()


class Script:
    """A source that plays a list of controls by tick, and actions of a driver that walks."""

    name = "script"

    def __init__(self, controls=None, *, silent=lambda n: False, spoiled=lambda n: False, quit_at=90):
        self.driver, self.controls = Driver(), {quit_at: "quit", **(controls or {})}
        self.silent, self.spoiled = silent, spoiled
        self.calls, self.begun, self.views, self.actions = 0, 0, [], []

    def begin(self, view):
        self.begun += 1
        assert view.tick == 0
        self.driver.begin(view)

    def wish(self, view):
        n, self.calls = self.calls, self.calls + 1
        action = None if self.silent(n) else self.driver.action(Held(forward=1.0), view)
        if action is not None and self.spoiled(n):
            action[7] = np.nan
        self.actions.append(action)
        return Wish(action, self.controls.get(n, "none"))

    def show(self, view):
        self.views.append(view)

    def close(self):
        pass


def session(env, source, folder, seed=3, **options):
    """A session that takes no real time; its messages are in `said`."""
    said = []
    made = TeleopSession(env, source, folder=folder, seed=seed, pace=timeless(), say=said.append, **options)
    made.said = said
    return made


@pytest.fixture(scope="module")
def saved(env, tmp_path_factory):
    """A session in which one episode was saved and one discarded, its folder and its source."""
    folder = tmp_path_factory.mktemp("person")
    source = Script({0: "start", 60: "save_and_reset", 61: "start", 80: "discard_and_reset"}, quit_at=85)
    one = session(env, source, folder, facts=session_facts(env, BrowserOptions()))
    return one.run(), folder, source


def test_two_sessions_save_in_no_one_folder(tmp_path):
    """A folder in which another session saves is refused, and world and source are closed."""
    closed = []
    given = SimpleNamespace(close=lambda: closed.append(True))
    said = "--out .*: another process saves a person's episodes in it"
    with held_folder(tmp_path, "holds it"), pytest.raises(InputError, match=said):
        driving_command.drive(given, given, BrowserOptions(out=str(tmp_path)))
    assert closed == [True, True]


def test_any_episode_of_the_seed_is_in_the_way(env, tmp_path):
    """A folder that holds a later episode of the seed is refused by that file's name; another seed is not."""
    one = session(env, Script({}, quit_at=1), tmp_path)
    file = one._recorder.file(one._plan(4))
    file.touch()
    with pytest.raises(InputError, match=rf"--seed 3: .*{file.name} is there already"):
        session(env, Script({}, quit_at=1), tmp_path)
    session(env, Script({}, quit_at=1), tmp_path, seed=33)


def test_a_saved_episode_holds_what_was_driven(saved, env):
    """The file has each action as the source gave it, and a seed that no evaluation has; a discarded one no file."""
    report, folder, source = saved
    assert [path.parent for path in report.saved] == [folder] and sorted(folder.iterdir()) == list(report.saved)
    episode = EpisodeFile(report.saved[0])
    assert episode.rows == 60
    np.testing.assert_array_equal(episode.array("arena_action"), np.stack(source.actions[:60]))
    assert episode.text("arena_seed_range") == seeding.TELEOPERATION
    seed = int(episode.array("arena_episode_seed"))
    assert seeding.seed_range(seed) != seeding.EVALUATION
    assert episode.text("arena_policy") == "teleop-script" and episode.text("arena_outcome") == "timeout"
    assert report.factor == 1.0 and report.late == 0
    assert source.begun == 3


def test_a_saved_episode_plays_again_bit_for_bit(saved, env):
    """Pictures are taken afterwards: its seed and its actions give the same states on engine `mujoco`."""
    episode = EpisodeFile(saved[0].saved[0])
    env.reset([int(episode.array("arena_episode_seed"))])
    while env.tick[0] < 0:
        env.step(torch.from_numpy(STAND_ACTION)[None])
    states = []
    for action in episode.array("arena_action"):
        states.append(env.observe().state[0].numpy().copy())
        env.step(torch.from_numpy(action)[None])
    np.testing.assert_array_equal(np.stack(states), episode.array("arena_state"))


def test_pictures_come_afterwards(saved, tmp_path):
    """`eval record --from` plays the person's episodes again, finds every position equal, and adds the pictures."""
    out = tmp_path / "pictures"
    assert main(["record", "--from", str(saved[1]), "--out", str(out), "--size", "64x64"]) == 0
    (file,) = (out / "episodes").glob("*.npz")
    episode = EpisodeFile(file)
    assert episode.cameras == ("front",) and episode.video("front").is_file()
    assert episode.text("arena_seed_range") == seeding.TELEOPERATION


def test_a_seed_is_not_recorded_twice(saved, env):
    """A second session of the same seed in the same folder is refused before it begins."""
    with pytest.raises(InputError, match="--seed 3"):
        session(env, Script(), saved[1])
    session(env, Script(), saved[1], seed=4)


def test_a_silent_source_stands_and_the_session_goes_on(env, tmp_path):
    """Silence and actions that are no numbers make the robot stand, warn once, and later actions count again."""
    source = Script(silent=lambda n: 60 <= n < 180, spoiled=lambda n: 180 <= n < 240, quit_at=300)
    one = session(env, source, tmp_path)
    one.run()
    at = np.array([view.root_position[:2] for view in source.views if view.tick > 0])
    moved = [np.linalg.norm(at[b] - at[a]) for a, b in ((20, 60), (150, 230), (260, 298))]
    assert moved[0] > 0.25 and moved[1] < 0.05 and moved[2] > 0.1
    assert len(one.said) == 1 and "root_rot6d" in one.said[0]
    assert source.views[-1].outcome is None


def test_a_recorded_fall_waits_for_the_person(env, tmp_path):
    """A robot that fell stays as it lies, and the episode can still be saved; `start` in the middle begins again."""

    class Falls(Script):
        def wish(self, view):
            wish = super().wish(view)
            action = STAND_ACTION.copy()
            action[ACTION["joint_pos"]] += 0.9 * (self.calls > 30)
            return Wish(action, wish.control)

    source = Falls({20: "start", 400: "save"}, quit_at=405)
    one = session(env, source, tmp_path)
    report = one.run()
    ended = [view for view in source.views if view.outcome == "fall"]
    assert len(ended) > 50 and len({view.tick for view in ended}) == 1
    episode = EpisodeFile(report.saved[0])
    assert episode.text("arena_outcome") == "fall" and episode.rows == ended[0].tick
    assert int(episode.array("arena_repeat")) == 1, "the episode that had begun without a recording is another one"


def test_several_worlds_are_refused(env, tmp_path):
    """A person drives one world."""
    env.worlds = 2
    try:
        with pytest.raises(InputError, match="one world"):
            session(env, Script(), tmp_path)
    finally:
        env.worlds = 1
