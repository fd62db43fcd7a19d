"""Files of episodes: they hold what the table says, equal arrays are equal bytes, damage is one clear error."""

import random
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from arena_newton import policies, trackers
from arena_newton.data.readers.frame_reader import OpenVideo
from arena_newton.data.readers.looks import FIRST_SHAPE
from arena_newton.data.recording.demonstration import DemonstrationRecorder, episode_label
from arena_newton.data.recording.episode import (
    CAMERAS,
    FIELDS,
    EpisodeFile,
    camera_fields,
    episode_files,
    fields_table,
    vision,
    write_episode,
)
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.pictures.settings import CameraConfig
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding
from tests.fuzz.mutants import damaged

ROOT = Path(__file__).resolve().parents[3]

TICKS = 12
OPTIONAL = {"robot_twist2_inference_qpos", "final_body_action_29dof", "<camera>vision_depth"}
"""Not in every file: of one tracker or another, or on request."""
LATER = ("rerecord_", "arena_cleaned", "arena_source_rows")
"""Written by later steps."""


def planned(repeat):
    """An episode of boxing."""
    seed = seeding.recording_seed("boxing", seeding.DEMONSTRATION, 0, repeat)
    names = {"task": "boxing", "tracker": "twist2", "policy": "stand", "mode": "base", "rules": "paper"}
    numbers = {"index": repeat, "group_seed": 0, "repeat": repeat, "object_seed": seeding.object_seed(seed)}
    return SimpleNamespace(episode_seed=seed, **names, **numbers)


@pytest.fixture(scope="module")
def env():
    """Two worlds of boxing."""
    env = ArenaEnv("boxing", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", device="cpu")
    yield env
    env.close()


@pytest.fixture(scope="module")
def folder(env, tmp_path_factory):
    """Two short episodes with pictures of two cameras, depth, and looks."""
    folder = tmp_path_factory.mktemp("episodes")
    cameras = {"front": CameraConfig(64, 64), "world": CameraConfig(64, 48, "world", "native")}
    with DemonstrationRecorder(folder, cameras=cameras, depth=True, looks=1, facts={"a": 1}, threads=2) as recorder:
        episodes = [planned(0), planned(1)]
        Rollout(env, policies.get("stand"), episodes, recorder=recorder, max_steps=TICKS).run()
        saved = recorder.saved(wait=True)
        recorder.check()
    assert {one.files["episode"].name for one in saved} == {f"{episode_label(e)}.npz" for e in episodes}
    return folder


def test_the_file_holds_the_fields_of_the_table(folder):
    """Every array is in the table with its type and shape, and every field of the table is in the file."""
    file = EpisodeFile(episode_files([folder])[0])
    sizes = {"T": file.rows, "nq": file.array("arena_qpos").shape[1], "nv": file.array("arena_qvel").shape[1]}
    kinds = {"text": "U", "bool": "b"}
    seen = set()
    for field in FIELDS:
        if field.name.startswith(LATER) or field.name == "final_body_action_29dof":
            continue
        objects = file.objects if "<object>" in field.name else [""]
        cameras = [CAMERAS[name] for name in file.cameras] if "<camera>" in field.name else [""]
        for thing in objects:
            for camera in cameras:
                name = field.name.replace("<object>", thing).replace("<camera>", camera)
                if camera and name.endswith("looks"):  # which are the head camera's
                    continue
                array = file.array(name)
                seen.add(name)
                expected = field.shape.replace("H", "48" if camera else "64").replace("W", "64")
                shape = tuple(sizes.get(n, n) for n in expected.split(", ")) if expected else ()
                free = tuple(n if n != "n" else array.shape[i] for i, n in enumerate(shape))
                assert array.shape == tuple(int(n) for n in free), name
                fits = array.dtype.kind == kinds[field.kind] if field.kind in kinds else array.dtype == field.kind
                assert fits, (name, array.dtype, field.kind)
    assert set(file.names) == seen


def test_the_table_in_the_docs_is_the_one_of_the_code():
    """docs/howto/train/recording.md lists every field with type, shape and sentence."""
    page = (ROOT / "docs" / "howto" / "train" / "recording.md").read_text()
    assert fields_table() in page


def test_a_cameras_fields_are_its_own():
    """The fields of each camera are those of the table, named as the original names them, and no other camera's."""
    named = [field.name for field in FIELDS if "<camera>" in field.name]
    for camera, part in CAMERAS.items():
        assert camera_fields(camera) == {name.replace("<camera>", part) for name in named}
    assert vision("left_wrist", "rgb_video_fps") == "vision_left_wrist_rgb_video_fps"
    assert sum(len(camera_fields(camera)) for camera in CAMERAS) == len(frozenset().union(*map(camera_fields, CAMERAS)))


def test_equal_arrays_are_equal_bytes(folder, tmp_path):
    """A file that is read and written again has the same bytes; none of a partial file stays."""
    source = episode_files([folder])[0]
    write_episode(tmp_path / source.name, EpisodeFile(source).copy_of({}))
    assert (tmp_path / source.name).read_bytes() == source.read_bytes()
    assert not list(folder.rglob("*.part")) and not list(tmp_path.glob("*.part"))


def test_depth_is_of_the_pictures(folder):
    """Depth has the picture's size; the black bars of a square have none, the floor is metres away."""
    file = EpisodeFile(episode_files([folder])[0])
    square, native = file.array("vision_depth"), file.array(vision("world", "depth"))
    assert square.shape == (file.rows, 64, 64) and native.shape == (file.rows, 48, 64)
    assert not square[:, :8].any() and not square[:, 56:].any() and square[:, 8:56].min() > 0.05


def test_looks_are_of_the_pictures(folder):
    """Every fourth row has a frame: shapes and light where the lens sees, nothing in the bars; equal with one light."""
    for path in episode_files([folder]):
        file = EpisodeFile(path)
        looks, film = file.looks("front")
        video = OpenVideo(film)
        frames = np.stack([video.read(number) for number in range(len(video.times))])
        video.close()
        assert frames.shape == (looks.frames(file.rows), 64, 64, 3) and looks.stride == 4 and len(looks.lights) == 1
        bars, seen = frames[:, [*range(8), *range(56, 64)]], frames[:, 8:56]
        assert (bars == (0, 128, 128)).all() and np.array_equal(frames[..., 1], frames[..., 2])
        prims = dict(looks.shapes)
        assert {*np.unique(seen[..., 0])} <= {*range(1, FIRST_SHAPE + len(prims))} and (seen[..., 0] == 1).any()
        floor = FIRST_SHAPE + [*prims].index("/World/Room/Floor")
        assert (seen[..., 0] == floor).mean() > 0.1 and (seen[..., 1] != 128).mean() > 0.5
        assert {prim: chance for prim, chance in prims.items() if chance < 1.0} == {"/World/Target/Frame/Ball": 0.0}
    lights = [EpisodeFile(path).looks("front")[0].lights for path in episode_files([folder])]
    assert lights[0] != lights[1]


def test_an_episode_without_a_success_can_be_left_out(env, tmp_path):
    """With only_success a timeout leaves no file, and is reported without files."""
    camera = {"front": CameraConfig(32, 32)}
    with DemonstrationRecorder(tmp_path, cameras=camera, only_success=True, threads=1) as recorder:
        Rollout(env, policies.get("stand"), [planned(0)], recorder=recorder, max_steps=5).run()
        (told,) = recorder.saved(wait=True)
    assert told.result.outcome == "timeout" and not told.files
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_closing_in_the_middle_leaves_no_file(env, tmp_path):
    """Episodes that run when the recorder is closed are dropped, videos and depth included."""
    recorder = DemonstrationRecorder(tmp_path, cameras={"front": CameraConfig(32, 32)}, depth=True, threads=2)

    class Stop(Exception):
        pass

    def stop(active):
        if (env.tick[env.active] >= 4).any():
            raise Stop

    with pytest.raises(Stop):
        Rollout(env, policies.get("stand"), [planned(0)], recorder=recorder, max_steps=50, on_tick=stop).run()
    recorder.saved(wait=True)
    assert list(tmp_path.rglob("*.part"))
    recorder.close()
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_damaged_files_are_one_clear_error(folder, tmp_path, mutants):
    """Whatever byte is changed, a file is read as it should be or refused by its name; nothing else happens."""
    source = episode_files([folder])[0]
    arrays = EpisodeFile(source).copy_of({}, drop=["vision_depth", vision("world", "depth")])
    small = tmp_path / "small.npz"
    write_episode(small, arrays)
    path = tmp_path / "mutant.npz"
    refused, draw = 0, random.Random(3)
    for _ in range(mutants):
        path.write_bytes(damaged(small.read_bytes(), draw))
        try:
            file = EpisodeFile(path)
            assert (file.state.shape, file.action.shape) == ((file.rows, 64), (file.rows, 40))
            assert len(file.phases) == file.rows and len(file.order) == 6
        except InputError as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
    assert refused > mutants // 4


@pytest.mark.parametrize(
    "name, value, says",
    [
        ("arena_state", np.zeros((3, 64), np.float32), "arena_state has shape"),
        ("arena_action", np.full((TICKS, 40), np.nan, np.float32), "arena_action holds a number that is not finite"),
        ("vision_rgb_video_path", np.array("../outside.mp4"), "expected a file in videos/"),
        ("arena_phase", np.full(TICKS, 99, np.int16), "arena_phase names phase 99"),
    ],
)
def test_unfit_fields_are_named(folder, tmp_path, name, value, says):
    """A field of another shape, a number that is none, a path elsewhere: the message names file and field."""
    path = tmp_path / "unfit.npz"
    write_episode(path, EpisodeFile(episode_files([folder])[0]).copy_of({name: value}))
    file = EpisodeFile(path)
    with pytest.raises(InputError, match=re.escape(says)):
        _ = file.state, file.action, file.phases, file.video("front")
