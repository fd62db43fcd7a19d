"""Promises of an episode's pictures: what they show, what they cost, and what an interruption leaves."""

import resource
import signal
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from PIL import Image

from arena_newton.env import STAND_ACTION, ArenaEnv
from arena_newton.errors import InputError
from arena_newton.pictures.camera import Camera
from arena_newton.pictures.follow import OFFSETS, follow_pose, room_walls
from arena_newton.pictures.recorder import STRIP_FRAMES, EpisodeRecorder
from arena_newton.pictures.video import VideoWriter, film_strip

TICKS = 23


def episode(repeat, rank=None):
    """An episode of the plan."""
    rank = repeat if rank is None else rank
    return SimpleNamespace(task="vis_navi", mode="base", group_seed=0, repeat=repeat, rank=rank, index=repeat)


def environment(worlds):
    """Worlds of VisNavi on plain drives."""
    from arena_newton import trackers

    return ArenaEnv("vis_navi", tracker=trackers.get("pd"), worlds=worlds, engine="mujoco", device="cpu")


@pytest.fixture(scope="module")
def env():
    """One world."""
    return environment(1)


def record(env, folder, repeats=(0,), ticks=TICKS, outcome="timeout", stop=False, moving=True, **options):
    """Play the first ticks of one episode per world past its start-up, standing, and record them.

    Where nobody looks at the robot, time alone moves on.
    """
    recorder = EpisodeRecorder(folder, **options)
    env.reset([100 + r for r in repeats])
    action = torch.tensor(STAND_ACTION).repeat(env.worlds, 1)
    env.tick[:] = 0
    for world, repeat in enumerate(repeats):
        recorder.start(env, world, episode(repeat))
    for _ in range(ticks):
        if moving:
            env.step(action)
        else:
            env.tick[:] += 1
        recorder.tick(env)
    if stop:
        return recorder
    for world in range(len(repeats)):
        recorder.finish(env, world, SimpleNamespace(outcome=outcome, reason=outcome))
    recorder.close()
    return recorder


def files(folder):
    """Contents of all files below a folder, by relative name."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_strip_draws_only_its_frames(env, tmp_path, monkeypatch):
    """A strip of any length draws ten frames per camera, the first and the last tick among them."""
    drawn = []
    draw = Camera.draw
    monkeypatch.setattr(Camera, "draw", lambda self: (drawn.append(self.width), draw(self)))
    recorder = record(env, tmp_path, ticks=141, video=False, moving=False)
    assert drawn.count(320) == drawn.count(480) == STRIP_FRAMES and len(drawn) == 2 * STRIP_FRAMES
    assert recorder.media(episode(0)) == {
        "ego strip": "strips/vis_navi__base__seed0__repeat0__ego.jpg",
        "world strip": "strips/vis_navi__base__seed0__repeat0__world.jpg",
    }
    with Image.open(tmp_path / recorder.media(episode(0))["ego strip"]) as strip:
        assert strip.format == "JPEG" and strip.width == 10 * 320 + 9 * 4


def test_frames_of_a_strip_are_evenly_spaced(env, tmp_path, monkeypatch):
    """The frames' steps are evenly spaced to one in forty, from the first to the last, for an odd last tick too."""
    said = {}
    monkeypatch.setattr(
        "arena_newton.pictures.recorder.film_strip", lambda frames, path, **o: said.update({path.stem: o["captions"]})
    )
    record(env, tmp_path, ticks=175, video=False, moving=False)
    steps = [int(text.split()[1]) for text in said["vis_navi__base__seed0__repeat0__ego"]]
    assert steps[0] == 0 and steps[-1] == 175 and len(steps) == STRIP_FRAMES
    assert np.abs(np.array(steps) - np.linspace(0, 175, STRIP_FRAMES)).max() <= 175 / 40


def test_pictures_depend_on_the_episode_alone(env, tmp_path, monkeypatch):
    """Pictures are the same in a batch of two worlds, bit for bit, and strips with and without videos."""
    drawn = {}
    write = VideoWriter.write

    def note(video, frame):
        drawn.setdefault(str(video.path.relative_to(tmp_path)), []).append(frame.copy())
        write(video, frame)

    # What goes into the encoder: x264 itself is not the same to the byte twice in one process.
    monkeypatch.setattr(VideoWriter, "write", note)
    record(env, tmp_path / "one", repeats=(1,), ticks=11, size=(96, 64))
    record(environment(2), tmp_path / "two", repeats=(0, 1), ticks=11, size=(96, 64))
    record(env, tmp_path / "strip", repeats=(1,), ticks=11, video=False)
    one, two, strip = files(tmp_path / "one"), files(tmp_path / "two"), files(tmp_path / "strip")
    assert len(one) == 4 and len(strip) == 2
    assert set(one) == {name for name in two if "repeat1" in name}
    for name, content in one.items():
        if name.startswith("strips"):
            assert content == two[name] == strip[name]
        else:
            assert np.array_equal(drawn[f"one/{name}"], drawn[f"two/{name}"])


def test_videos_of_the_first_episodes_only(env, tmp_path):
    """`episodes` limits videos by the place in the plan, not by the order of starting; strips stay."""
    recorder = EpisodeRecorder(tmp_path, episodes=2, size=(64, 48))
    env.reset([5])
    env.tick[:] = 0
    for repeat in (3, 1, 2, 0):
        recorder.start(env, 0, episode(repeat))
        recorder.finish(env, 0, SimpleNamespace(outcome="fall", reason="fall"))
        kinds = {"ego", "world"} if repeat < 2 else set()
        assert set(recorder.media(episode(repeat))) == {"ego strip", "world strip"} | kinds
    assert len(list((tmp_path / "videos").iterdir())) == 4


def test_sizes_and_text_of_videos(env, tmp_path):
    """World videos have the size that was asked for, head videos its height; the outcome is held at the end."""
    record(env, tmp_path, size=(160, 90), strip=False, outcome="success", follow=True)
    for name, size in (("world", (160, 90)), ("ego", (120, 90))):
        with av.open(str(tmp_path / "videos" / f"vis_navi__base__seed0__repeat0__{name}.mp4")) as video:
            frames = [f.to_ndarray(format="rgb24") for f in video.decode(video=0)]
        assert frames[0].shape == (size[1], size[0], 3)
        # Steps 0, 2 … 22, the last step 23, and a second of it with its outcome.
        assert len(frames) == 12 + 1 + 25
        assert np.abs(frames[-1][-14:].astype(int) - frames[12][-14:]).max() > 60
        assert np.abs(frames[-1][:40].astype(int) - frames[-5][:40]).max() < 30
    for bad in ((16, 90), (5000, 90)):
        with pytest.raises(InputError, match="--video-size"):
            EpisodeRecorder(tmp_path, size=bad)
    with pytest.raises(InputError, match="--video-episodes 0"):
        EpisodeRecorder(tmp_path, episodes=0)


def test_follow_camera_keeps_the_robot_large(env, tmp_path):
    """The robot is at least half as high as the following camera's picture, wherever it is in the room."""
    camera = Camera(
        env.scene.model,
        np.array([-1]),
        (0, 0, 0),
        (1, 0, 0, 0),
        width=96,
        height=54,
        focal_length=18.0,
        horizontal_aperture=20.955,
        lights=env.lights,
        views=1,
    )
    walls = room_walls(env.scene.mj_model)
    assert len(walls) == 4
    h = env.scene.robot
    state, hidden = env.scene.model.state(), env.scene.model.state()
    for x, y, heading in ((-1.9, -5.2, 1.6), (-6.6, -1.0, 1.6), (-3.0, 4.5, 0.0), (0.0, 0.0, -1.0)):
        pictures = []
        for z, target in ((0.8, state), (-9.0, hidden)):
            qpos = env.physics.qpos0[[0]].copy()
            qpos[0, h.root_qpos : h.root_qpos + 3] = x, y, z
            mocap = np.tile(env.physics.mocap_pos0, (1, 1, 1)), np.tile(env.physics.mocap_quat0, (1, 1, 1))
            env.physics.reset_worlds(np.array([0]), qpos, *mocap)
            env.physics.write_newton_state(target)
            pose = follow_pose((x, y), heading, OFFSETS[0], walls)
            pictures.append(camera.render_worlds(target, [0], pose[None])[0].numpy().copy().astype(int))
        rows, columns = np.nonzero(np.abs(pictures[0] - pictures[1]).max(axis=2) > 12)
        assert np.ptp(rows) >= 27 and 20 < columns.mean() < 76, (x, y)


def test_views_show_the_worlds_that_are_asked_for():
    """A camera of two views shows any two of three worlds, in any order, as the full camera does."""
    env = environment(3)
    env.reset([1, 2, 3])
    options = {"prim": "world", "width": 64, "height": 48, "lights": env.lights}
    state = env.scene.model.state()
    env.physics.write_newton_state(state)
    every = Camera.from_scene(env.scene, **options).render(state).clone()
    assert not torch.equal(every[0], every[2])
    few = Camera.from_scene(env.scene, **options, views=2)
    assert torch.equal(few.render_worlds(state, [2, 0]), every[[2, 0]])
    assert torch.equal(few.render_worlds(state, [1]), every[[1]])
    with pytest.raises(InputError, match="3 worlds for 2 views"):
        few.render_worlds(state, [0, 1, 2])
    with pytest.raises(InputError, match="render_worlds"):
        few.render(state)


def test_an_interruption_leaves_no_partial_file(env, tmp_path):
    """Closing the recorder, as a context does on Ctrl-C and SIGTERM, removes what is unfinished and nothing else."""
    record(env, tmp_path, strip=False, size=(64, 48))
    before = files(tmp_path)
    recorder = record(env, tmp_path, repeats=(1,), strip=False, size=(64, 48), stop=True)
    assert len(list(tmp_path.rglob("*.part"))) == 2
    with pytest.raises(KeyboardInterrupt), recorder:
        raise KeyboardInterrupt
    assert files(tmp_path) == before


@pytest.fixture
def full():
    """No file above 20 kB; writing beyond fails as on a full disk."""
    ignored, before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, ignored)


def test_a_full_disk_names_the_file(tmp_path, full):
    """Writing that fails is an OSError with the file's name, and leaves no partial file."""
    noise = np.random.default_rng(0).integers(0, 255, (60, 120, 160, 3), np.uint8)
    for path in (tmp_path / "x.mp4", tmp_path / "x.jpg"):
        with pytest.raises(OSError) as caught:
            if path.suffix == ".jpg":
                film_strip(noise, path)
            with VideoWriter(path, 160, 120) as writer:
                for frame in noise:
                    writer.write(frame)
        assert (caught.value.errno, caught.value.filename) == (27, str(path))
    assert list(tmp_path.iterdir()) == []


def test_unwritable_folders_are_os_errors(tmp_path):
    """A file where a folder should be is an OSError with a name, for videos and strips."""
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError) as caught:
        VideoWriter(tmp_path / "file" / "x.mp4", 64, 48)
    assert caught.value.filename
    with pytest.raises(OSError) as caught:
        film_strip([np.zeros((8, 8, 3), np.uint8)], tmp_path / "file" / "x.png")
    assert caught.value.filename


def test_a_state_that_is_not_finite_is_not_drawn(env, tmp_path):
    """An episode whose state breaks keeps the pictures of the time before."""
    recorder = record(env, tmp_path, strip=True, size=(64, 48), stop=True)
    steps = list(recorder._streams[0].ticks)
    env.physics.xpos.fill_(float("nan"))
    env.tick[:] += 1
    recorder.tick(env)
    recorder.finish(env, 0, SimpleNamespace(outcome="error", reason="nonfinite_state"))
    assert len(recorder.media(episode(0))) == 4 and steps[-1] == 22
    recorder.close()
