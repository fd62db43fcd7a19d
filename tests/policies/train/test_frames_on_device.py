"""Rows of datasets on a device: pictures, actions of both protocols, statistics, batches."""

import dataclasses
import itertools
import json
import random
import shutil

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from transformers.initialization import no_init_weights

from arena_newton.data import Frames
from arena_newton.data.readers.label_protocols import encode_v4
from arena_newton.data.readers.lerobot_reader import DatasetActions
from arena_newton.errors import InputError
from arena_newton.policies.recipes.training_recipe import FAMILIES, recipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames import frame_store
from arena_newton.policies.train.frames.augmentation import gathered_pictures
from arena_newton.policies.train.frames.batching import BalancedOrder, BatchMaker, RowOrder, step_seed
from arena_newton.policies.train.frames.demonstration_rows import read_rows, statistics
from arena_newton.policies.train.frames.frame_store import load_frames
from arena_newton.policies.train.network_memory import SIZES, network_bytes
from arena_newton.policies.train.training import camera_fit
from benchmarks.made_frames import made_frames
from tests.fuzz.mutants import damaged
from tests.policies.train.made_stats import made_stats
from tests.policies.train.small_dataset import BAND, LENGTHS, SIZE, make_dataset

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def rows(dataset):
    """The dataset without its pictures, in v4."""
    return read_rows(dataset, "v4")


@pytest.fixture(scope="module")
def store(rows):
    """It on the CPU, its last episode held out."""
    return load_frames([rows], CPU, hold_out=1, jobs=2)


def unchanged(key, value):
    """No normalization."""
    return value


def test_pictures_are_the_datasets(dataset, store):
    """Every picture is the dataset's in the rows that are kept, and the black rows are given back."""
    frames = Frames(dataset)
    assert (store.top, store.bottom, store.rows) == (BAND, BAND, sum(LENGTHS))
    found = gathered_pictures(store, torch.arange(store.rows))
    for row in range(store.rows):
        wanted = frames[row].copy()
        assert max(wanted[:BAND].max(), wanted[-BAND:].max()) <= frame_store.BLACK
        wanted[:BAND] = wanted[-BAND:] = 0
        assert np.array_equal((found[row] * 255).round().byte().permute(1, 2, 0).numpy(), wanted), row


def test_pictures_of_several_cameras(tmp_path):
    """A batch holds each camera's own pictures of its rows, over several datasets, as if the camera were alone."""
    data = make_dataset(tmp_path, cameras=("front", "left_wrist", "right_wrist"))
    names = ("right_wrist", "front")

    def loaded(cameras):
        whole = read_rows(data, "v4", cameras)
        return load_frames([whole.first(2), whole], CPU, jobs=2)

    store, shown = loaded(names), {}
    batch = BatchMaker(store, unchanged, range(3))(torch.arange(store.rows))
    for name in names:
        alone = loaded((name,))
        shown[name] = gathered_pictures(alone, torch.arange(alone.rows))
        assert torch.equal(batch[f"observation.images.{name}"], shown[name])
    assert not torch.equal(*shown.values()) and "observation.images.left_wrist" not in batch
    with pytest.raises(InputError, match=r"--cameras world: .*info.json has no observation.images.world, but"):
        loaded(("front", "world"))
    wrists = make_dataset(tmp_path / "wrists", cameras=("left_wrist",))
    with pytest.raises(InputError, match=r"--cameras front: .* has no observation.images.front, but .*left_wrist"):
        read_rows(wrists, "v4")


def test_the_first_episodes_alone(rows, store):
    """Two of three episodes before another dataset: its rows follow theirs, and every picture stays with its state."""
    few = load_frames([rows.first(2), rows], CPU, jobs=2)
    two, three = sum(LENGTHS[:2]), sum(LENGTHS)
    assert few.lengths == (*LENGTHS[:2], *LENGTHS) and few.rows == two + three
    order = [*range(two), *range(three)]
    assert torch.equal(few.pictures, store.pictures[order]) and torch.equal(few.states, store.states[order])


def test_a_late_picture_keeps_its_rows(tmp_path):
    """Rows that are black at the beginning of all episodes and not later are not cut off."""

    def brightening(rows, size, seed):
        pictures = np.full((rows, size, size, 3), 90, np.uint8)
        pictures[:10, :BAND] = 0
        return pictures

    dataset = make_dataset(tmp_path, lengths=(20, 20), pictures=brightening)
    store = load_frames([read_rows(dataset, "v3.1")], CPU, middle=SIZE - 2 * BAND)
    assert (store.top, store.bottom) == (0, 0) and store.pictures.shape[1] == SIZE
    assert store.pictures[15, 0].min() > 60 and store.pictures[0, 0].max() <= frame_store.BLACK


def test_dark_beginnings_do_not_hide_the_pad(tmp_path):
    """Only rows that are black in every picture are cut off, so that a padded camera is known as one."""

    def dark_first(number, size, seed):
        found = np.full((number, size, size, 3), 90, np.uint8)
        found[:, :BAND] = found[:, -BAND:] = 0
        found[0, : BAND + 12] = 0
        return found

    dark = make_dataset(tmp_path, lengths=(21, 23), pictures=dark_first)
    counted = []
    kept = load_frames([read_rows(dark, "v3.1")], CPU, jobs=1, on_frames=counted.append)
    # A row of slack: the codec may leave traces of the picture in the pad.
    assert BAND - 1 <= kept.top <= BAND and BAND - 1 <= kept.bottom <= BAND
    assert camera_fit(kept) == "pad"
    assert counted == [21, 23]
    frames = Frames(dark)
    assert all(np.array_equal(kept.pictures[row], frames[row][kept.top : SIZE - kept.bottom]) for row in (0, 1, 20, 43))


def test_actions_are_of_the_wanted_protocol(dataset, rows, tmp_path):
    """A v3.1 dataset gives v4 as `encode_v4` makes it, a v4 dataset the same bits, and v3.1 back."""
    about = DatasetActions(dataset)
    own = read_rows(dataset, "v3.1")
    built = make_dataset(tmp_path, labels="v4")
    from_v4, back = read_rows(built, "v4"), read_rows(built, "v3.1")
    for number in range(len(LENGTHS)):
        given = about.actions(number)
        assert np.array_equal(own.episodes[number].actions, given)
        assert np.array_equal(rows.episodes[number].actions, encode_v4(given))
        assert np.array_equal(from_v4.episodes[number].actions, encode_v4(given))
        assert np.allclose(back.episodes[number].actions[1:], given[1:], atol=1e-5)
    assert (rows.episodes[0].task, rows.trackers) == ("boxing", ("twist2",))


def test_statistics_are_the_datasets(dataset):
    """Statistics of all episodes are those of the dataset's own `stats.json`; a floor holds constant numbers up."""
    whole = read_rows(dataset, "v3.1")
    found = statistics([whole], whole.episodes, "v3.1")
    stats = LeRobotDatasetMetadata("local/x", root=dataset).stats
    for key in ("observation.state", "action", "observation.images.front"):
        for name, values in found[key].items():
            assert np.allclose(values, stats[key][name], atol=1e-6), (key, name)
    floored = statistics([whole], whole.episodes, "v3.1", state_floor=1e-3, action_floor=0.5)
    assert floored["action"]["std"].min() == 0.5 and floored["observation.state"]["std"].min() >= 1e-3


def test_a_batch_ends_where_its_episode_ends(store):
    """Actions beyond an episode are its last row and marked; those of other episodes never appear."""
    batches = BatchMaker(store, unchanged, range(-1, 8))
    last = sum(LENGTHS[:2]) - 1  # the second episode's
    batch = batches(torch.tensor([0, 3, last - 2, last]))
    assert batch["action"].shape == (4, 9, 40) and batch["observation.images.front"].shape == (4, 3, SIZE, SIZE)
    assert batch["action_is_pad"].int().tolist() == [
        [1, 0, 0, 0, 0, 0, 0, 0, 0],
        [0] * 9,
        [0, 0, 0, 0, 1, 1, 1, 1, 1],
        [0, 0, 1, 1, 1, 1, 1, 1, 1],
    ]
    assert torch.equal(batch["action"][0, :2], store.actions[[0, 0]])
    assert torch.equal(batch["action"][1], store.actions[2:11])
    assert torch.equal(batch["action"][3, 1:], store.actions[last].expand(8, 40))
    assert torch.equal(batch["observation.state"], store.states[[0, 3, last - 2, last]])


def test_several_datasets_are_one_set(dataset, rows, tmp_path):
    """Two datasets' episodes follow each other, each row with its own task and instruction."""
    other = read_rows(make_dataset(tmp_path, lengths=(22,), task="football", tracker="sonic"), "v4")
    store = load_frames([rows, other], CPU)
    assert store.rows == sum(LENGTHS) + 22 and store.tasks == ("boxing", "football")
    assert store.pairs == (("boxing", "twist2"), ("football", "sonic"))
    batches = BatchMaker(store, unchanged, range(3), task_vector=("football", "boxing"))
    batch = batches(torch.tensor([0, store.rows - 1]), unknown=1.0)
    assert batch["observation.environment_state"].tolist() == [[0.0, 1.0], [1.0, 0.0]]
    words = [store.instructions[n] for n in store.instruction[[0, store.rows - 1]].tolist()]
    assert words == [rows.episodes[0].instruction, other.episodes[0].instruction] and words[0] != words[1]
    assert store.first[-1] == sum(LENGTHS) and torch.equal(store.actions[-22:], torch.tensor(other.episodes[0].actions))


def test_the_vector_names_the_tracker_of_a_row(rows, tmp_path):
    """After the task's numbers come those of the trackers and one of any other, which the wanted fraction has."""
    other = read_rows(make_dataset(tmp_path, lengths=(22,), tracker="sonic"), "v4")
    batches = BatchMaker(
        load_frames([rows, other], CPU), unchanged, range(3), task_vector=("boxing",), tracker_vector=("sonic",)
    )
    last = batches.store.rows - 1
    told = batches(torch.tensor([0, last]))["observation.environment_state"]
    assert told.tolist() == [[1.0, 0.0, 1.0], [1.0, 1.0, 0.0]]
    torch.manual_seed(2)
    told = batches(torch.full((4000,), last), unknown=0.25)["observation.environment_state"]
    assert torch.equal(told[:, 1] + told[:, 2], torch.ones(4000)) and 0.22 < told[:, 2].mean() < 0.28


def test_every_fourth_picture(rows, store):
    """Samples begin at every fourth row of each episode, with its own picture; actions are those of all rows."""
    thin = load_frames([rows], CPU, hold_out=1, every=4, jobs=1)
    starts = np.cumsum([0, *LENGTHS])
    kept = [row for first, last in itertools.pairwise(starts) for row in range(first, last, 4)]
    assert torch.equal(thin.pictures, store.pictures[kept]) and torch.equal(thin.actions, store.actions)
    assert [*thin.samples(), *thin.samples(held=True)] == kept
    chosen = torch.tensor(kept[5:12])
    assert torch.equal(gathered_pictures(thin, chosen), gathered_pictures(store, chosen))
    by_processes = load_frames([rows], CPU, every=4, jobs=2, processes=2)
    assert torch.equal(by_processes.pictures, thin.pictures)


def test_the_picture_without_its_pad(store):
    """Cut about its middle it is what the camera sees without bars, and a shift repeats the edges of that."""
    chosen = torch.arange(4)
    cut = gathered_pictures(store, chosen, tall=SIZE - 2 * BAND)
    assert torch.equal(cut, gathered_pictures(store, chosen)[:, :, BAND:-BAND])
    less = dataclasses.replace(store, top=BAND - 3, bottom=BAND - 1)  # rows with traces of a codec are kept
    padded = torch.nn.functional.pad(store.pictures, (0, 0, 0, 0, 3, 1), value=9)
    less = dataclasses.replace(less, pictures=padded)
    assert torch.equal(gathered_pictures(less, chosen, tall=SIZE - 2 * BAND), cut)
    assert gathered_pictures(less, chosen, tall=SIZE - 2 * BAND, shift=4).min() > 0.1
    assert torch.equal(gathered_pictures(store, chosen, tall=SIZE - BAND)[:, :, BAND // 2 : -BAND // 2], cut)


def test_balanced_rows_have_the_wanted_fractions():
    """Groups are drawn by their weights, rows of a group alike; step, seed and process alone decide, as on a resume."""
    samples, groups = np.arange(1000, 1111), np.repeat([1, 0, 2], [1, 10, 100])
    order = BalancedOrder(samples, groups, [1.0, 2.0, 5.0], 7, CPU)
    taken = np.concatenate([order.rows(step, 64).numpy() for step in range(500)])
    counts = [np.isin(taken, samples[groups == group]).sum() / len(taken) for group in range(3)]
    assert counts == pytest.approx([0.125, 0.25, 0.625], abs=0.01)
    within = np.bincount(taken - 1000, minlength=111)[1:11]
    assert within.min() > 300 and within.max() < 500
    assert torch.equal(BalancedOrder(samples, groups, [1.0, 2.0, 5.0], 7, CPU).rows(321, 64), order.rows(321, 64))
    others = [order.rows(321, 64, rank=1, ranks=2), order.rows(322, 64)]
    others += [BalancedOrder(samples, groups, [1.0, 2.0, 5.0], 8, CPU).rows(321, 64)]
    assert not any(torch.equal(other, order.rows(321, 64)) for other in others)


def test_held_out_rows_are_not_sampled(store):
    """Rows to train on and held-out rows are the episodes' rows, without those at their ends that are left out."""
    begin, end = sum(LENGTHS[:2]), sum(LENGTHS)
    assert store.samples().tolist() == list(range(begin))
    assert store.samples(held=True, drop_last=3).tolist() == list(range(begin, end - 3))
    assert store.samples(drop_last=32).tolist() == list(range(LENGTHS[0], LENGTHS[0] + LENGTHS[1] - 32))


def test_an_epoch_has_every_row_once():
    """Rows come once per epoch, in one order, from any step on, for any batch and number of processes."""
    samples = np.arange(100, 137)
    for batch, ranks in ((5, 1), (64, 1), (3, 2)):
        order = RowOrder(samples, 7, CPU)
        steps = 300 // (batch * ranks) + 2
        parts = [order.rows(s, batch, rank=r, ranks=ranks) for s in range(steps) for r in range(ranks)]
        taken = torch.cat(parts)
        for epoch in range(3):
            assert sorted(taken[epoch * 37 : epoch * 37 + 37].tolist()) == samples.tolist()
        again = RowOrder(samples, 7, CPU).rows(steps - 1, batch, rank=ranks - 1, ranks=ranks)
        assert torch.equal(again, parts[-1])
    first = [RowOrder(samples, seed, CPU).rows(0, 20).tolist() for seed in (1, 2)]
    assert first[0] != first[1]


def test_seeds_of_steps_differ():
    """Every seed, step and process draws its own numbers."""
    seeds = {step_seed(a, b, c) for a, b, c in itertools.product(range(20), range(-1, 200), range(4))}
    assert len(seeds) == 20 * 201 * 4 and all(0 <= seed < 2**63 for seed in seeds)


def test_pictures_are_shifted_and_tinted_each_by_itself(store):
    """A shifted picture is the same content moved by at most the limit; colours stay within theirs; black rows stay."""
    row = torch.full((64,), 5)
    plain = gathered_pictures(store, row[:1])[0]
    torch.manual_seed(3)
    shifted = gathered_pictures(store, row, shift=2)
    seen = set()
    inner = plain[:, BAND + 2 : -BAND - 2, 2:-2]
    for picture in shifted:
        moves = [
            (y, x)
            for y, x in itertools.product(range(-2, 3), repeat=2)
            if torch.equal(picture[:, BAND + 2 - y : SIZE - BAND - 2 - y, 2 - x : SIZE - 2 - x], inner)
        ]
        assert moves
        seen.add(moves[0])
        assert picture[:, :BAND].max() == 0 and picture[:, -BAND:].max() == 0
    assert len(seen) > 10
    torch.manual_seed(4)
    tinted = gathered_pictures(store, row, colour=0.1)
    ratio = tinted[:, :, BAND:-BAND] / plain[:, BAND:-BAND]
    low, high = ratio.amin((2, 3)), ratio.amax((2, 3))
    assert low.min() >= 0.81 - 1e-5 and high.max() <= 1.21 + 1e-5 and (high - low).max() < 1e-4
    assert low.std() > 0.02 and (low - low.mean(1, keepdim=True)).abs().max() > 0.02
    torch.manual_seed(4)
    assert torch.equal(gathered_pictures(store, row, colour=0.1), tinted)


def test_what_does_not_fit_is_refused(rows, monkeypatch):
    """A device with too little memory gives one error that says how much is needed and free."""
    monkeypatch.setattr(frame_store, "free_memory", lambda device: 500_000)
    with pytest.raises(InputError, match=r"92 pictures of 64x48 need 0.0 GB of memory on cpu, 0.0 GB are free"):
        load_frames([rows], CPU)
    monkeypatch.setattr(frame_store, "free_memory", lambda device: 10_000_000_000)
    with pytest.raises(InputError, match=r"0\.0 GB are free beside the network, for which 10\.0 GB are kept"):
        load_frames([rows], CPU, network=10_000_000_000)
    load_frames([rows], CPU, network=9_900_000_000, jobs=1)
    with pytest.raises(InputError, match=r"--episodes 4: .* has 3$"):
        rows.first(4)
    with pytest.raises(InputError, match="--hold-out 3: .* has 3 episodes, none would be left"):
        load_frames([rows], CPU, hold_out=3)
    with pytest.raises(InputError, match="pictures of 32x64 pixels, .* has 64x64"):
        load_frames([rows, dataclasses.replace(rows, width=32)], CPU)


@pytest.mark.parametrize("family", ["act", "diffusion"])
def test_memory_of_a_network_is_that_of_its_parameters(family):
    """The table has as many parameters as the paper's network."""
    paper = recipe(family, "paper", network={"pretrained_backbone_weights": None})
    with no_init_weights():
        counted = sum(p.numel() for p in families.build(paper, made_stats(), "cpu").policy.parameters())
    assert SIZES[family].parameters == pytest.approx(counted, rel=0.02)


def test_memory_of_a_network_depends_on_family_and_batch():
    """pi0.5 keeps more than its weights with moments need, ACT less than 6 GB; nothing of the host is kept."""
    cuda = torch.device("cuda")
    found = {family: network_bytes(recipe(family, "paper"), cuda) / 1e9 for family in SIZES}
    assert 2.6 < found["act"] < 6.0 and 35.0 < found["pi05"] < 80.0
    assert all(6.0 < found[family] < 20.0 for family in ("diffusion", "flow"))
    assert network_bytes(recipe("act", "paper", batch_size=128), cuda) > 1e9 * found["act"]
    assert network_bytes(recipe("pi05", "small"), cuda) < 3e9
    assert network_bytes(recipe("pi05", "paper"), CPU) == 0 and set(SIZES) == set(FAMILIES)


def test_made_frames_have_the_form_of_a_dataset():
    """Frames of a measurement give batches like those of a dataset."""
    store = made_frames(120, 64, CPU, length=50)
    batch = BatchMaker(store, unchanged, range(5))(torch.tensor([0, 49, 119]))
    assert batch["action_is_pad"].sum(1).tolist() == [0, 4, 4] and store.lengths == (50, 50, 20)
    assert batch["observation.images.front"].shape == (3, 3, 64, 64)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: (d / "meta" / "stats.json").write_text("{}"), "says nothing of observation.images.front"),
        (lambda d: (d / "meta" / "stats.json").unlink(), "stats.json"),
        (lambda d: edit(d, lambda i: i["features"]["observation.state"].update(shape=[63])), "expected .64."),
        (lambda d: edit(d, lambda i: i["features"].pop("observation.images.front")), "has no pictures"),
        (lambda d: edit(d, lambda i: i["features"]["observation.images.front"].update(shape=[64, 64])), "has shape"),
        (lambda d: edit(d, lambda i: i.update(robot_type="other")), "robot_type is 'other'"),
    ],
)
def test_a_damaged_dataset_is_named(dataset, tmp_path, change, words):
    """Each damage gives one error that names the file."""
    copy = shutil.copytree(dataset, tmp_path / "copy")
    change(copy)
    with pytest.raises(InputError, match=words) as error:
        read_rows(copy, "v4")
    assert str(copy) in str(error.value)


def test_mutated_tables_are_refused_by_name(dataset, tmp_path, mutants):
    """Damaged statistics, descriptions and rows: read, or one error that names the dataset."""
    copy, rng, refused = shutil.copytree(dataset, tmp_path / "copy"), random.Random(3), 0
    files = [copy / "meta" / "stats.json", copy / "meta" / "info.json", next((copy / "data").rglob("*.parquet"))]
    for file in files:
        sound = file.read_bytes()
        for _ in range(mutants // 2):
            file.write_bytes(damaged(sound, rng, text=file.suffix == ".json"))
            try:
                found = read_rows(copy, "v4")
                statistics([found], found.episodes, "v4")
            except InputError as error:
                refused += 1
                assert str(copy) in str(error)
        file.write_bytes(sound)
    assert refused > mutants // 2


@pytest.mark.parametrize(
    ("size", "black", "fit"),
    [
        (64, (8, 8), "pad"),
        (64, (7, 9), "pad"),
        (64, (0, 0), "native"),
        (64, (3, 20), "native"),
        (224, (24, 24), "pad"),
        (224, (16, 16), "pad"),
        (224, (0, 40), "native"),
    ],
)
def test_the_camera_of_black_rows(size, black, fit):
    """Rows as around a 4:3 picture mean a padded one, whatever a codec left in them; other dark edges do not."""
    store = dataclasses.replace(made_frames(100, SIZE, CPU), top=black[0], bottom=black[1])
    store = dataclasses.replace(store, pictures=torch.zeros(1, size - sum(black), size, 3, dtype=torch.uint8))
    assert camera_fit(store) == fit


def test_a_codec_at_full_size_hides_no_pad(tmp_path):
    """Pictures of 224x224, whose pad of 28 rows ends within a block of the codec: traces in it are still a pad."""

    def bright(number, size, seed):
        found = np.zeros((number, size, size, 3), np.uint8)
        rng = np.random.default_rng(seed)
        for picture in found:  # hard edges that move, as a floor and furniture have them
            picture[28:-28] = np.kron(rng.integers(0, 2, (21, 28, 1)), np.ones((8, 8, 1))) * [255, 40, 250]
        return found

    made = make_dataset(tmp_path, lengths=(12,), pictures=bright, size=224)
    store = load_frames([read_rows(made, "v3.1")], CPU, jobs=1)
    assert store.top < 26 and camera_fit(store) == "pad"
    counted = []
    middle = load_frames([read_rows(made, "v3.1")], CPU, jobs=1, middle=168, on_frames=counted.append)
    assert (middle.top, middle.bottom, counted) == (28, 28, [12]) and camera_fit(middle) == "pad"
    assert torch.equal(middle.pictures, store.middle(168)[0])


def edit(dataset, change):
    """Change `info.json`."""
    path = dataset / "meta" / "info.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
