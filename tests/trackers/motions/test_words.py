"""Motions in words: what a sentence makes of the reference, and what is no sentence."""

import math

import numpy as np
import pytest

from arena_newton.errors import InputError
from arena_newton.robot.canonical import ACTION, STAND_ACTION, validate_action
from arena_newton.trackers.motions.words import VOCABULARY, WordedMotion


@pytest.fixture(scope="module")
def motion():
    """One robot."""
    return WordedMotion()


def test_walking_and_turning_end_where_they_were_sent(motion):
    """A walk ends at its point and a turn at its angle; hands and height change on the way, and stay until `stand`."""
    motion.reset()
    for sentence in ("walk to 0.4 0.1 facing 20", "close left", "crouch 0.6", "reach right 0.3 -0.2 0.1"):
        motion.say(sentence)
    rows = motion.actions(25)
    while not motion.arrived and len(rows) < 400:
        rows += motion.actions(25)
    x, y, yaw = motion.pose
    assert math.dist((x, y), (0.4, 0.1)) < 0.08 and abs(yaw - math.radians(20)) < 0.1
    last = validate_action(np.array(rows), "words")[-1]
    assert last[ACTION["hands"]].tolist() == [1.0, 0.0] and last[2] == pytest.approx(0.6, abs=0.02)
    assert motion.generator.hand_points[0, 1].tolist() == pytest.approx([0.3, -0.2, 0.1], abs=0.02)
    motion.say("open left")
    motion.say("stand")
    last = np.array(motion.actions(100))[-1]
    assert last[2] == pytest.approx(motion.generator.channel("height")[0].item(), abs=0.02) and last[2] > 0.7
    np.testing.assert_allclose(last[9:38], motion.actions(1)[0][9:38], atol=0.02)
    assert len(STAND_ACTION) == len(last) and not last[ACTION["hands"]].any()


def test_the_reference_turns_to_a_measured_heading(motion):
    """The robot's measured heading is where the next walk begins."""
    motion.reset()
    motion.actions(1, measured=0.5)
    assert motion.pose[2] == pytest.approx(0.5, abs=0.01)


def test_a_seat_is_low_and_behind(motion):
    """Sitting lowers the pelvis and leads it behind the feet."""
    motion.reset()
    motion.say("sit")
    assert motion.actions(120)[-1][2] < 0.5 and motion.pose[0] < -0.1
    motion.say("crouch 0.6")
    motion.actions(120)
    assert motion.generator.channel("pelvis_back").item() == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(
    "sentence", ["fly", "walk to the door", "walk to 1", "turn to nan", "reach both 0 0 0", "close door", "crouch", ""]
)
def test_other_sentences_are_refused_with_the_vocabulary(motion, sentence):
    """What is no sentence changes nothing, and the message is what a language model needs to try again."""
    motion.reset()
    with pytest.raises(InputError) as caught:
        motion.say(sentence)
    assert all(known in str(caught.value) for known in VOCABULARY) and motion.arrived
