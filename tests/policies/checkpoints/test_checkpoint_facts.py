"""Facts of a checkpoint are read back, and damage is one clear error."""

import json
import random

import pytest

from arena_newton.errors import InputError
from arena_newton.policies.lerobot.checkpoint_facts import FACTS_FILE, CheckpointFacts, checkpoint_folder

FACTS = CheckpointFacts(
    labels="v4", realign=0.002, width=128, height=96, fit="native", task_vector=("boxing", "vis_navi"),
    tracker_vector=("sonic", "twist2"), family="act", recipe="fast", tasks=("boxing",), trackers=("twist2",), steps=10,
    seed=42, minutes=1.5, device="cpu",
    datasets=({"name": "boxing", "hash": "abc", "episodes": 3, "frames": 90},), options={"batch": 8},
)  # fmt: skip


def test_facts_are_read_as_written(tmp_path):
    """Every field comes back; a checkpoint of somebody else has none."""
    assert CheckpointFacts.read(tmp_path) is None
    FACTS.write(tmp_path)
    assert CheckpointFacts.read(tmp_path) == FACTS
    assert FACTS.camera.width == 128 and FACTS.camera.fit == "native"
    assert FACTS.vector("vis_navi", "sonic") == [0, 1, 1, 0, 0] and FACTS.vector("boxing", "new") == [1, 0, 0, 0, 1]
    assert FACTS.vector_width == 5 and CheckpointFacts(task_vector=("boxing",)).vector("boxing", "sonic") == [1]


def test_a_folder_of_a_training_names_its_last_checkpoint(tmp_path):
    """Checkpoint, `pretrained_model`, or the folder of a training; anything else is refused by its name."""
    inner = tmp_path / "checkpoints" / "last" / "pretrained_model"
    inner.mkdir(parents=True)
    with pytest.raises(InputError, match="holds no checkpoint"):
        checkpoint_folder(tmp_path)
    (inner / "config.json").write_text("{}")
    assert checkpoint_folder(tmp_path) == checkpoint_folder(inner) == inner
    with pytest.raises(InputError, match="no such folder"):
        checkpoint_folder(tmp_path / "absent")


def test_damage_is_one_clear_error(tmp_path):
    """Values of the wrong kind are refused by file and field; hundreds of damaged files raise nothing else."""
    FACTS.write(tmp_path)
    path = tmp_path / FACTS_FILE
    whole = json.loads(path.read_text())
    strange = [None, True, -1, 1e99, "x" * 10, [], [1], {}, {"a": 1}, [["a"]]]
    for name in whole:
        refused = 0
        for value in strange:
            path.write_text(json.dumps(whole | {name: value}))
            try:
                CheckpointFacts.read(tmp_path)
            except InputError as error:
                refused += 1
                assert str(path) in str(error)
        assert refused >= 5, name
    text, draw = json.dumps(whole).encode(), random.Random(0)
    for _ in range(300):
        damaged = bytearray(text)
        for _ in range(draw.randint(1, 8)):
            damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        path.write_bytes(bytes(damaged[: draw.randint(1, len(damaged))] if draw.random() < 0.3 else damaged))
        try:
            CheckpointFacts.read(tmp_path)
        except InputError as error:
            assert str(path) in str(error)
