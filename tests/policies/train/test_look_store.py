"""Changed looks in a training: which samples, of which rows, and that nothing else changes."""

import dataclasses

import numpy as np
import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.policies.train.frames.augmentation import gathered_pictures
from arena_newton.policies.train.frames.batching import BatchMaker
from arena_newton.policies.train.frames.demonstration_rows import read_rows
from arena_newton.policies.train.frames.frame_store import load_frames
from arena_newton.policies.train.frames.look_store import load_looks
from arena_newton.policies.train.policy_options import look_fractions
from tests.arena_newton.data.made_episodes import LOOKS, look_frames
from tests.policies.train.small_dataset import BAND, LENGTHS, SIZE, make_dataset

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """A dataset of each of two tasks, with looks."""
    folder = tmp_path_factory.mktemp("looks")
    return [read_rows(make_dataset(folder, task=task, looks=LOOKS), "v3.1") for task in ("boxing", "vis_navi")]


@pytest.fixture(scope="module")
def store(sets):
    """They on the CPU, half of the samples of Boxing with changed looks, none of VisNavi."""
    plain = load_frames(sets, CPU, jobs=2)
    return dataclasses.replace(plain, looks=load_looks(sets, plain, 0.5, {"vis_navi": 0.0}, jobs=2))


@pytest.mark.parametrize(("every", "step"), [(1, 5), (2, 10)])
def test_frames_are_the_films(sets, every, step):
    """Frames are cut as the pictures; each row knows the last one before it, and pictures are of the same rows."""
    plain = load_frames(sets[:1], CPU, jobs=2, every=every)
    looks = load_looks(sets[:1], plain, 1.0, {}, jobs=2)
    first = 0
    for repeat, length in enumerate(LENGTHS):
        wanted = look_frames(-(-length // 5), SIZE, repeat)[:: step // 5, BAND:-BAND]
        rows = torch.arange(first, first + length)
        assert np.array_equal(looks.frames[looks.number[rows].unique()].numpy(), wanted)
        taken, changed = looks.chosen(rows)
        assert changed.all() and (taken - first).tolist() == [row - row % step for row in range(length)]
        assert len(plain.picture[taken].unique()) == len(wanted)
        first += length
    assert len(looks.frames) == sum(-(-length // step) for length in LENGTHS)


def test_the_wanted_fraction_changes(store):
    """The wanted fraction of one task's samples changes, and of another task's its own fraction."""
    torch.manual_seed(0)
    rows = torch.randint(0, store.rows, (8000,))
    taken, changed = store.looks.chosen(rows)
    boxing = store.task[rows] == store.tasks.index("boxing")
    assert 0.47 < float(changed[boxing].float().mean()) < 0.53 and not changed[~boxing].any()
    assert torch.equal(taken[~changed], rows[~changed])


def test_a_changed_sample_is_whole(store):
    """State and actions are those of the row that is shown; samples whose looks stay have their own picture."""
    batches = BatchMaker(store, lambda key, value: value, range(4))
    rows = torch.arange(store.rows)
    torch.manual_seed(1)
    found = batches(rows, looks=True)
    torch.manual_seed(1)
    taken, changed = store.looks.chosen(rows)
    plain = batches(taken)
    key = "observation.images.front"
    assert torch.equal(found["observation.state"], plain["observation.state"])
    assert torch.equal(found["action"], plain["action"])
    assert torch.equal(found[key][~changed], plain[key][~changed])
    apart = (found[key] - plain[key]).abs().amax(dim=(1, 2, 3))
    assert 20 < int(changed.sum()) and (apart[changed] > 0.05).float().mean() > 0.9
    assert not found[key][:, :, :BAND].any(), "the pad stays black"
    torch.manual_seed(1)
    again = batches(rows, looks=True, shift=0)
    assert torch.equal(found[key], again[key])


def test_without_looks_nothing_is_drawn(store):
    """A store without looks gives the batch, and takes the random numbers, that it did before."""
    batches = BatchMaker(dataclasses.replace(store, looks=None), lambda key, value: value, range(4))
    found = []
    for looks in (True, False):
        torch.manual_seed(2)
        found.append([*batches(torch.arange(20), looks=looks, shift=2, colour=0.1).values(), torch.rand(3)])
    assert all(map(torch.equal, *found))


def test_datasets_without_looks_are_refused(store, sets, dataset):
    """A dataset without looks, and a fraction of a task that no dataset has, are named."""
    plain = read_rows(dataset, "v3.1")
    with pytest.raises(InputError, match=rf"^--looks: {dataset} has none"):
        load_looks([plain], store, 0.5, {})
    with pytest.raises(InputError, match="^--looks football=: the datasets have boxing, vis_navi"):
        load_looks(sets, store, 0.5, {"football": 0.1})


def test_kinds_of_change_are_chosen(store, sets):
    """Without any kind a changed sample is the picture itself; a kind that is not known is named."""
    none = dict.fromkeys(("colours", "light", "things", "rectangles", "exposure"), 0.0)
    looks = load_looks(sets, store, 1.0, {}, none)
    assert looks.changes.patterns == 0.5 and looks.fractions.min() == 1.0
    rows, plain = torch.arange(8), dataclasses.replace(store, looks=None)
    rows, changed = looks.chosen(rows)
    seen = gathered_pictures(dataclasses.replace(store, looks=looks), rows, changed=changed)
    assert changed.any() and torch.allclose(seen, gathered_pictures(plain, rows), atol=1e-3)
    with pytest.raises(InputError, match="^--look-changes lights=: unknown, choose from colours patterns"):
        load_looks(sets, store, 1.0, {}, {"lights": 0.0})


@pytest.mark.parametrize("given", ["1.5", "-0.1", "boxing", "boxing=2", "boxing=nan", ""])
def test_wrong_fractions_are_refused(given):
    """Anything but fractions, of all or of a task, is one line."""
    assert look_fractions(["0.6", "double_desk=0.3"]) == (0.6, {"double_desk": 0.3})
    with pytest.raises(InputError, match=f"^--looks {given}: expected a fraction"):
        look_fractions([given])
