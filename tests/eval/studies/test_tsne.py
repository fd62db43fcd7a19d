"""Maps of predicted actions: which frames are asked, what a policy answers to each, and what tells sources apart."""

import json

import av
import numpy as np
import pyarrow.parquet
import pytest

pytest.importorskip("sklearn")
pytest.importorskip("matplotlib")

from arena_newton import policies, tasks  # noqa: E402
from arena_newton.errors import InputError  # noqa: E402
from arena_newton.eval.__main__ import main  # noqa: E402
from arena_newton.eval.studies import action_map  # noqa: E402
from arena_newton.eval.studies.action_map import embed, separation, shifted  # noqa: E402
from arena_newton.eval.studies.predicted_actions import DatasetObservations, as_many_of_each, predict  # noqa: E402
from arena_newton.pictures.settings import CameraConfig  # noqa: E402
from arena_newton.policies.base import POLICIES  # noqa: E402
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION  # noqa: E402
from tests.policies.original_dataset import features, write_dataset  # noqa: E402

FRONT = "observation.images.front"
LENGTHS = (31, 24, 40, 28)
SIZE = 64


def brightness(episode, frame):
    """Grey value of a frame's picture."""
    return 40 + 30 * episode + frame


def make_dataset(root, tracker, offset, lengths=LENGTHS, task="boxing"):
    """A dataset of boxing: states count rows and hold an offset of their tracker, pictures are grey by frame."""
    episodes = [np.tile(STAND_ACTION, (length, 1)) for length in lengths]
    seeds = [{"task": task, "mode": "base", "tracker": tracker, "episode_seed": 2**31 + k} for k in range(len(lengths))]
    described = features()
    described[FRONT] = {"dtype": "video", "shape": [SIZE, SIZE, 3], "names": ["height", "width", "channels"]}
    info = {"features": described, "arena": {"episodes": seeds}}
    write_dataset(root, episodes, instruction=tasks.get(task).instruction, info=info)
    path = root / "data" / "chunk-000" / "file-000.parquet"
    table = pyarrow.parquet.read_table(path)
    rng = np.random.default_rng(7)
    states = 0.1 * rng.standard_normal((len(table), 64)).astype(np.float32)
    states[:, 6] += offset
    states[:, 40] = np.arange(len(table))
    column = pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(states.ravel(), pyarrow.float32()), 64)
    table = table.set_column(table.column_names.index("observation.state"), "observation.state", column)
    pyarrow.parquet.write_table(table, path)
    video = root / "videos" / FRONT / "chunk-000" / "file-000.mp4"
    video.parent.mkdir(parents=True)
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=50, options={"crf": "1", "g": "10"})
        stream.width = stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for episode, length in enumerate(lengths):
            for frame in range(length):
                grey = np.full((SIZE, SIZE, 3), brightness(episode, frame), np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
        container.mux(stream.encode())
    return root, states


class Linear(policies.Policy):
    """Sees: its first action holds what it was shown, the second what must not be taken."""

    name = "linear"
    labels = "v3.1"
    needs_image = True
    camera = CameraConfig(width=SIZE, height=SIZE)
    chunk_size = 2

    def reset(self, seeds, tasks, mask=None):
        """Take the seeds."""
        self.seeds = list(seeds)

    def act(self, observation):
        """Copy state, brightness and seed."""
        worlds = len(observation.state)
        actions = np.zeros((worlds, 2, ACTION_WIDTH), np.float32)
        actions[:, 0, :2] = observation.state.cpu().numpy()[:, [6, 40]]
        actions[:, 0, 2] = observation.image.float().mean(dim=(1, 2, 3)).cpu().numpy()
        actions[:, 0, 3] = np.asarray(self.seeds) % 1000
        actions[:, 1] = 99.0
        return policies.Chunk(actions)


class Privileged(policies.Policy):
    """Reads a world that it was never given."""

    name = "privileged"

    def act(self, observation):
        """Fail as an expert does without an environment."""
        return policies.Chunk(self.env.qpos)


@pytest.fixture(scope="module", autouse=True)
def registered():
    """Both policies by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(POLICIES, "_registered", {})
        policies.register("linear-of-a-test", lambda argument: Linear())
        policies.register("privileged-of-a-test", lambda argument: Privileged())
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two datasets whose states differ in one number by ten times its spread."""
    root = tmp_path_factory.mktemp("made")
    return [make_dataset(root / name, name, offset) for name, offset in (("twist2", 0.0), ("sonic", 1.0))]


def test_uniformly_spaced_frames_of_each_episode(made):
    """Ten frames from first to last of each episode, in rows of the dataset, as many as are asked for."""
    data = DatasetObservations(made[0][0])
    assert data.name == "twist2" and list(data.episodes) == ["boxing"]
    samples = data.sample("boxing", 40, 10)
    assert len(samples) == 40
    assert samples.rows[:10].tolist() == np.linspace(0, 30, 10).round().astype(int).tolist()
    assert samples.rows[-1] == sum(LENGTHS) - 1 and samples.rows[10] == LENGTHS[0]
    assert np.array_equal(samples.states[:, 40], samples.rows)
    few = data.sample("boxing", 20, 10)
    assert sorted(set(few.episodes.tolist())) == [0, 3] and len(few) == 20
    assert len(data.sample("boxing", 1000, 10)) == 40


def test_a_smaller_source_leaves_the_other_spread(made, tmp_path):
    """Sources have equally many observations, the larger one from its first episode to its last."""
    root, _ = make_dataset(tmp_path / "few", "sonic", 0.0, lengths=(25, 30))
    sources = [DatasetObservations(made[0][0]), DatasetObservations(root)]
    larger, smaller = as_many_of_each(sources, "boxing", 40, 10)
    assert len(larger) == len(smaller) == 20
    assert sorted(set(larger.episodes.tolist())) == [0, len(LENGTHS) - 1]


def test_each_observation_is_answered_alone(made):
    """The first action of the chunk belongs to its state, picture and seed, whatever the batch."""
    root, states = made[1]
    data = DatasetObservations(root)
    samples = data.sample("boxing", 38, 10)
    found = predict(Linear(), data, samples, batch=38)
    assert np.array_equal(found[:, 0], states[samples.rows, 6]) and np.array_equal(found[:, 1], samples.rows)
    first = np.cumsum([0, *LENGTHS])[samples.episodes]
    wanted = [brightness(e, r) for e, r in zip(samples.episodes, samples.rows - first, strict=True)]
    assert np.abs(found[:, 2] - wanted).max() < 3.0
    assert len(set(found[:, 3].tolist())) > 30
    for batch in (1, 7):
        assert np.array_equal(predict(Linear(), data, samples, batch=batch), found)
    assert not np.array_equal(predict(Linear(), data, samples, batch=38, seed=1)[:, 3], found[:, 3])


def test_a_linear_classifier_tells_what_differs():
    """Sources that differ are separated over held-out episodes; equal ones are not, constant ones neither."""
    rng = np.random.default_rng(0)
    sources, episodes = np.repeat([0, 1], 200), np.repeat(np.arange(40), 10)
    same = rng.standard_normal((400, 5))
    found = separation(same, sources, episodes)
    assert 0.3 < found.accuracy < 0.7 and found.low < 0.5 < found.high and found.episodes == 40
    moved = same + 6.0 * sources[:, None] * np.eye(5)[2]
    assert separation(moved, sources, episodes).accuracy > 0.98
    assert separation(np.ones((400, 5)), sources, episodes).accuracy == 0.5
    assert separation(same[:20], sources[[0] * 10 + [-1] * 10], episodes[:20]) is None


def test_what_an_episode_has_of_its_own_tells_nothing():
    """Numbers that name the episode are no evidence of the source: whole episodes are held out."""
    rng = np.random.default_rng(1)
    sources, episodes = np.repeat([0, 1], 200), np.repeat(np.arange(40), 10)
    own = rng.standard_normal((40, 30))[episodes]
    assert separation(own, sources, episodes).accuracy < 0.75


def test_largest_shifts_are_named():
    """The numbers of the action that move most are named, in units of their spread within a source."""
    rng = np.random.default_rng(0)
    actions = rng.standard_normal((2000, ACTION_WIDTH)).astype(np.float32)
    sources = np.repeat([0, 1], 1000)
    actions[1000:, 2] -= 3.0
    (name, by), _ = shifted(actions, sources, 2)
    assert name == "root_z" and by == pytest.approx(-3.0, abs=0.2)


def test_the_embedding_is_seeded():
    """The same actions give the same map, and clusters that are far apart stay apart in it."""
    rng = np.random.default_rng(0)
    actions = np.concatenate([rng.standard_normal((40, 40)), rng.standard_normal((40, 40)) + 20.0])
    one = embed(actions, perplexity=30.0, seed=0)
    assert np.array_equal(one, embed(actions, perplexity=30.0, seed=0)) and one.shape == (80, 2)
    centres = one[:40].mean(axis=0), one[40:].mean(axis=0)
    spread = max(one[:40].std(), one[40:].std())
    assert np.linalg.norm(centres[0] - centres[1]) > spread
    assert np.isfinite(embed(np.ones((8, 40)), perplexity=30.0, seed=0)).all()


def test_command_writes_numbers_and_figures(made, tmp_path, capsys):
    """One command: figures per task, and the accuracy on actions and on states, equal when it is called again."""
    flags = ["tsne", "--policy", "linear-of-a-test", "--datasets", *(str(root) for root, _ in made), "--samples", "40"]
    for name in ("a", "b"):
        assert main([*flags, "--batch", "16", "--out", str(tmp_path / name)]) == 0
    assert "boxing: 40 + 40 observations of twist2 and sonic" in capsys.readouterr().out
    result = json.loads((tmp_path / "a" / "tsne.json").read_text())
    assert result["policy"] == {"name": "linear"} and [s["name"] for s in result["sources"]] == ["twist2", "sonic"]
    boxing = result["tasks"]["boxing"]
    assert boxing["samples_per_source"] == 40 and boxing["episodes"] == [4, 4]
    assert boxing["actions_told_apart"]["accuracy"] > 0.95 and boxing["states_told_apart"]["accuracy"] > 0.8
    assert boxing["largest_shifts"][0]["number"] == "root_xy_delta[0]"
    for name in ("tsne.json", "tsne_boxing.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--datasets", "{a}", "{b}"], "--policy: name the policy"),
        (["--policy", "stand", "--datasets", "{a}"], "--datasets: expected two, given 1"),
        (["--policy", "stand", "--datasets", "{a}", "{b}", "--samples", "0"], "--samples 0"),
        (["--policy", "stand", "--datasets", "{a}", "/nowhere"], "/nowhere: no such folder"),
        (["--policy", "nobody", "--datasets", "{a}", "{b}"], "nobody"),
        (["--policy", "privileged-of-a-test", "--datasets", "{a}", "{b}"], "reads the world's state cannot be mapped"),
    ],
)
def test_wrong_calls_are_one_error(made, tmp_path, capsys, flags, message):
    """A missing policy, one dataset, a policy that needs a world: exit code 2 and one line."""
    names = {"a": made[0][0], "b": made[1][0]}
    assert main(["tsne", *(flag.format(**names) for flag in flags), "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err


def test_pictures_of_another_size_are_refused(made):
    """A policy that wants another size, or depth, is refused with what the dataset has."""
    data = DatasetObservations(made[0][0])
    policy = Linear()
    policy.camera = CameraConfig(width=224, height=224)
    with pytest.raises(InputError, match="its pictures have 64x64 pixels, the policy wants 224x224"):
        predict(policy, data, data.sample("boxing", 4, 1), batch=4)
    policy.camera = CameraConfig(width=SIZE, height=SIZE, depth=True)
    with pytest.raises(InputError, match="policy linear: observes the depth of front, which datasets do not hold"):
        predict(policy, data, data.sample("boxing", 4, 1), batch=4)


def test_datasets_without_a_common_task(made, tmp_path):
    """Datasets of different tasks are refused, and so are states that are not finite."""
    other, _ = make_dataset(tmp_path / "football", "sonic", 0.0, lengths=(5, 5), task="football")
    assert (
        main(["tsne", "--policy", "stand", "--datasets", str(made[0][0]), str(other), "--out", str(tmp_path / "o")])
        == 2
    )
    path = other / "data" / "chunk-000" / "file-000.parquet"
    table = pyarrow.parquet.read_table(path)
    bad = pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(np.full(640, np.nan, np.float32)), 64)
    pyarrow.parquet.write_table(table.set_column(0, "observation.state", bad), path)
    with pytest.raises(InputError, match="a state is not finite"):
        DatasetObservations(other).sample("football", 4, 2)


def test_a_checkpoint_goes_through_its_own_pipeline(made, tmp_path, capsys, narrow_resnet):
    """A Diffusion Policy with random weights answers each observation with the noise of that observation alone."""
    checkpoints = pytest.importorskip("tests.policies.checkpoints.made_checkpoints")
    known = checkpoints.facts(family="diffusion")
    folder = checkpoints.save(tmp_path / "dp", "diffusion", facts=known, num_inference_steps=2)
    data = DatasetObservations(made[0][0])
    samples = data.sample("boxing", 4, 1)
    policy = policies.get(f"lerobot:{folder}")
    policy.check()
    found = predict(policy, data, samples, batch=3)
    assert found.shape == (4, ACTION_WIDTH) and np.isfinite(found).all()
    assert np.array_equal(found, predict(policy, data, samples, batch=2))
    assert not np.array_equal(found, predict(policy, data, samples, batch=3, seed=1))
    flags = ["--policy", f"lerobot:{folder}", "--datasets", *(str(root) for root, _ in made)]
    assert (
        main(["tsne", *flags, "--samples", "8", "--frames", "2", "--batch", "8", "--out", str(tmp_path / "out")]) == 0
    )
    assert json.loads((tmp_path / "out" / "tsne.json").read_text())["policy"]["family"] == "diffusion"
    assert "boxing: 8 + 8 observations" in capsys.readouterr().out


@pytest.mark.parametrize("tasks", [1, 2])
def test_a_figure_has_room_for_its_texts(tasks, tmp_path, monkeypatch):
    """Title, legend and headings lie within the figure, whatever the policy is called."""
    found = []
    monkeypatch.setattr(action_map, "save", lambda figure, path: found.append(figure))
    half = action_map.Separation(0.5, 0.45, 0.55, 10)
    points = np.random.default_rng(0).normal(size=(20, 2))
    maps = [
        action_map.ActionMap("double_desk", points, np.arange(20) % 2, ("twist2", "sonic"), half, half)
        for _ in range(tasks)
    ]
    title = f"lerobot:runs/{'act_double_desk_twist2_' * 3}: predicted actions"
    action_map.draw(maps, title, tmp_path / "map.png")
    (figure,) = found
    figure.canvas.draw()
    texts = [figure._suptitle, *figure.legends, *(axes.title for axes in figure.axes)]
    for text in texts:
        box = text.get_window_extent()
        assert 0 <= box.x0 and box.x1 <= figure.bbox.width and 0 <= box.y0 and box.y1 <= figure.bbox.height, text
