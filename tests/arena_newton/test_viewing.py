"""Viewers show what the physics says, on both engines, and change nothing; failed episodes leave a recording."""

import json
import socket
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zstandard
from pxr import Usd, UsdGeom, UsdUtils

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.interfaces import EpisodeResult
from arena_newton.pictures.viewing import EVERY, SCENE, FailureRecorder, WorldViewer
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.robot.g1 import TICK

WORLDS, TICKS = 2, 10


@dataclass
class Episode:
    """Part of a planned episode that a file name needs."""

    repeat: int
    task: str = "football"
    mode: str = "base"
    group_seed: int = 0


def football(engine):
    """Football on an engine, and then its end."""
    env = ArenaEnv("football", tracker=trackers.get("pd"), worlds=WORLDS, engine=engine, device="cpu")
    yield env
    env.close()


@pytest.fixture(scope="module")
def native():
    """Football on native MuJoCo."""
    yield from football("mujoco")


@pytest.fixture(scope="module")
def batched():
    """Football on MuJoCo Warp."""
    yield from football("warp")


@pytest.fixture(params=["native", "batched"])
def env(request):
    """Football on both engines."""
    return request.getfixturevalue(request.param)


def play(env, *recorders, ticks=TICKS):
    """Let the robots stand, from a reset; the positions of every tick."""
    env.reset(range(env.worlds))
    for recorder in recorders:
        for world in range(env.worlds):
            recorder.start(env, world, Episode(world))
    seen = []
    for _ in range(ticks):
        env.step(np.tile(STAND_ACTION, (env.worlds, 1)))
        for recorder in recorders:
            recorder.tick(env)
        seen.append(env.physics.qpos.numpy().copy())
    return np.stack(seen)


def free_port():
    """A port that nobody serves now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def matrices(stage, time):
    """Prim → its transform in the world at a time code."""
    cache = UsdGeom.XformCache(time)
    return {
        str(prim.GetPath()): np.array(cache.GetLocalToWorldTransform(prim))
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.Xformable)
    }


def test_usd_has_a_time_sample_per_frame_and_is_complete(env, tmp_path):
    """The file opens, has a frame for each second tick with the robot where the physics has it, and its textures."""
    viewer = WorldViewer("usd", out=tmp_path)
    viewer.open(env, "football base")
    env.reset(range(WORLDS))
    viewer.start(env, 0, None)
    before = env.physics.qpos.numpy()[0, env.scene.robot.root_qpos + 2]
    play(env, viewer)
    env.physics.add_velocity(np.full((WORLDS, 6), 0.5, dtype=np.float32))
    for _ in range(4 * EVERY):
        env.step(np.tile(STAND_ACTION, (WORLDS, 1)))
        viewer.tick(env)
    moved = env.physics.xpos.numpy()
    viewer.close()
    folder = tmp_path / "football_base"
    stage = Usd.Stage.Open(str(folder / SCENE))
    frames = TICKS // EVERY + 4
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, frames)
    assert stage.GetFramesPerSecond() == round(1 / (EVERY * TICK))
    layers, assets, missing = UsdUtils.ComputeAllDependencies(str(folder / SCENE))
    assert not missing and len(layers) == 1
    assert {Path(asset).parent for asset in assets} == {folder}, assets
    first, last = matrices(stage, 0), matrices(stage, frames)
    steps = [np.linalg.norm(last[path][3, :3] - first[path][3, :3]) for path in first]
    assert before > 0.5 and 0.02 < max(steps) < 1.0, "the push moved the robots"
    # Some shape is exactly at the origin of its body, the pelvis of the first world.
    pelvis = moved[0, env.scene.robot.root_body]
    heights = np.array([last[path][3, 2] for path in last])
    assert np.abs(heights - pelvis[2]).min() < 1e-4
    assert not list(tmp_path.rglob("*.part*"))


def test_a_second_batch_gets_a_folder_of_its_own(native, tmp_path):
    """Another environment, or the same again, overwrites no file."""
    viewer = WorldViewer("usd", out=tmp_path, worlds=1)
    for _ in range(2):
        viewer.open(native, "football")
        play(native, viewer, ticks=EVERY)
    viewer.close()
    assert sorted(path.parent.name for path in tmp_path.rglob(SCENE)) == ["football", "football-2"]


def test_a_viewer_changes_no_bit(native, tmp_path):
    """Episodes run the same with a page, a file and a recorder of failures as without."""
    alone = play(native)
    viewers = WorldViewer("usd", out=tmp_path), WorldViewer("viser", port=free_port(), follow=True)
    try:
        watched = play(native, *viewers, FailureRecorder(tmp_path))
    finally:
        for viewer in viewers:
            viewer.close()
    assert alone.tobytes() == watched.tobytes()


def test_page_is_served_to_this_machine_on_the_port_given(native, capsys):
    """The page answers at its address, shows as many worlds as asked, and says nothing of its own."""
    port = free_port()
    viewer = WorldViewer("viser", port=port, worlds=1)
    try:
        assert viewer.url == f"http://127.0.0.1:{port}"
        play(native, viewer, ticks=EVERY)
        with urllib.request.urlopen(viewer.url, timeout=20) as page:
            assert page.status == 200
        shown = viewer._viewer
        assert shown._visible_worlds == {0} and shown.server.get_host() == "127.0.0.1"
        lens = UsdGeom.Camera(native.scene.stage.GetPrimAtPath("/World/WorldCamera"))
        half = lens.GetVerticalApertureAttr().Get() / lens.GetFocalLengthAttr().Get() / 2
        assert shown.server.initial_camera.fov == pytest.approx(2 * np.arctan(half), abs=1e-4)
        eye = np.asarray(native.scene.frame("/World/WorldCamera").pos)
        assert np.allclose(shown.server.initial_camera.position, eye, atol=1e-5)
    finally:
        viewer.close()
    assert capsys.readouterr().out == ""


def test_a_taken_port_is_an_error():
    """The next free port is not taken instead."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--viewer-port {port}: cannot be served"):
            WorldViewer("viser", port=port)


def test_bad_requests_are_named(monkeypatch, tmp_path):
    """Kind, number of worlds, folder and a missing library."""
    with pytest.raises(InputError, match="--viewer opengl: unknown"):
        WorldViewer("opengl")
    with pytest.raises(InputError, match="17 worlds, expected 1 to 16"):
        WorldViewer("usd", out=tmp_path, worlds=17)
    with pytest.raises(InputError, match="needs a folder"):
        WorldViewer("usd")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for kind, extra in (("viser", "teleop"), ("rerun", "rerun")):
        with pytest.raises(InputError, match=rf"--viewer {kind}: needs the extra \[{extra}\]"):
            WorldViewer(kind, port=free_port())
    with pytest.raises(InputError, match=r"--viewer-failures: needs the extra \[teleop\]"):
        FailureRecorder(tmp_path)


def test_pause_on_the_page_holds_the_run(native, monkeypatch):
    """A tick returns only when the page lets it go on."""
    viewer = WorldViewer("viser", port=free_port())
    try:
        viewer.show(native)
        answers = iter([False, False, True])
        asked = []
        monkeypatch.setattr(viewer._viewer, "should_step", lambda: asked.append(next(answers)) or asked[-1])
        for _ in range(EVERY):
            viewer.tick(native)
        assert asked == [False, False, True]
    finally:
        viewer.close()


def duration(path):
    """Length of a .viser recording [s]."""
    data = zstandard.ZstdDecompressor().decompressobj().decompress(path.read_bytes()[8:])
    length = int.from_bytes(data[:8], "little")
    return msgspec.msgpack.decode(data[8 : 8 + length])["durationSeconds"]


def test_only_failed_episodes_leave_a_recording(env, tmp_path):
    """A fall is written in its length, a success is not, and no part stays."""
    recorder = FailureRecorder(tmp_path / "failures", "twist2")
    play(env, recorder)
    for world, outcome in ((0, "success"), (1, "fall")):
        recorder.finish(env, world, EpisodeResult(Episode(world), outcome, outcome, TICKS, 0.0))
    (file,) = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert file.name == "twist2__football__base__seed0__repeat1.viser"
    assert duration(file) == pytest.approx(TICKS * TICK, abs=1e-6)


def test_a_recording_that_cannot_be_written_leaves_no_part(native, tmp_path, monkeypatch):
    """A full disk while a recording is written is reported, and the folder stays clean."""
    recorder = FailureRecorder(tmp_path)
    play(native, recorder, ticks=EVERY)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space"):
        recorder.finish(native, 0, EpisodeResult(Episode(0), "fall", "fall", EVERY, 0.0))
    assert not list(tmp_path.iterdir())


def test_replay_with_a_viewer_has_the_same_identity(tmp_path):
    """`eval run --policy replay:` shows its worlds, keeps failures, and its configuration's hash is that without."""
    from arena_newton.eval.__main__ import main

    actions = tmp_path / "stand.npz"
    np.savez(actions, action=np.tile(STAND_ACTION, (8, 1)))
    flags = ["run", "--task", "football", "--policy", f"replay:{actions}", "--seeds", "0", "--repeats", "1"]
    flags += "--max-steps 6 --engine mujoco --device cpu --tracker pd --rules released".split()
    assert main([*flags, "--out", str(tmp_path / "plain")]) == 0
    assert main([*flags, "--out", str(tmp_path / "shown"), "--viewer", "usd", "--viewer-failures"]) == 0
    read = [json.loads((tmp_path / name / "config.json").read_text()) for name in ("plain", "shown")]
    assert read[0]["config_hash"] == read[1]["config_hash"]
    assert len(list((tmp_path / "shown" / "failures").glob("*.viser"))) == 1
    assert len(list((tmp_path / "shown" / "viewer").rglob(SCENE))) == 1
    assert read[1]["options"]["viewer"] is None and read[1]["options"]["viewer_failures"]
