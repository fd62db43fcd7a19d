"""`data.Frames`: pictures of a dataset in any order."""

import gc
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest

pytest.importorskip("pyarrow")

from arena_newton.data import Frames  # noqa: E402
from arena_newton.data.datasets.lerobot_dataset import choose, write_dataset  # noqa: E402
from arena_newton.data.recording.episode import EpisodeFile, episode_files  # noqa: E402
from arena_newton.data.recording.layouts import LAYOUTS  # noqa: E402
from arena_newton.errors import InputError  # noqa: E402
from tests.arena_newton.data import made_episodes  # noqa: E402
from tests.arena_newton.data.consistent import ROWS, consistent_episode  # noqa: E402

SIDE = 48
"""Width and height of pictures [px]."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Dataset of two cameras in three files each, and all pictures of the recorded MP4s, decoded in order."""
    folder, out = tmp_path_factory.mktemp("recordings"), tmp_path_factory.mktemp("built") / "d"
    with pytest.MonkeyPatch.context() as patch:

        def noise(rows, size, seed):
            return np.random.default_rng(seed + 10 * rows).integers(0, 255, (rows, size, size, 3), np.uint8)

        patch.setattr(made_episodes, "pictures", noise)
        for repeat in range(3):
            consistent_episode(folder, ROWS - repeat, repeat=repeat, size=SIDE, cameras=("front", "world"))
    episodes = [EpisodeFile(file) for file in episode_files([folder])]
    write_dataset(choose([e.path for e in episodes]), out, kind=LAYOUTS["arena"], file_mb=1e-6)
    decoded = {}
    for camera in ("front", "world"):
        decoded[camera] = []
        for episode in episodes:
            with av.open(str(episode.video(camera))) as container:
                decoded[camera] += [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return out, decoded


@pytest.mark.parametrize("camera", ["front", "observation.images.world"])
def test_every_order_gives_the_recorded_pictures(made, camera):
    """Forwards, backwards and at random, each row's picture is the recorded MP4's, bit for bit."""
    root, decoded = made
    frames = Frames(root, camera)
    assert len(frames) == 3 * ROWS - 3 and len(list((root / "videos" / frames.camera).rglob("*.mp4"))) == 3
    pictures = decoded[camera.rsplit(".")[-1]]
    order = [*range(len(frames)), *reversed(range(len(frames)))]
    order += np.random.default_rng(0).integers(0, len(frames), 60).tolist()
    for row in order:
        assert np.array_equal(frames[row], pictures[row]), row
    assert np.array_equal(frames[-1], pictures[-1])
    for number, first in enumerate((0, ROWS, 2 * ROWS - 1)):
        assert all(np.array_equal(a, b) for a, b in zip(frames.episode(number), pictures[first:], strict=False))


def test_few_files_stay_open(made):
    """With one file open at a time the pictures are the same, and no more files are open."""
    root, decoded = made

    def opened():
        names = [str(path.resolve()) for path in Path("/proc/self/fd").iterdir() if path.exists()]
        return sum(name.startswith(str(root)) and name.endswith(".mp4") for name in names)

    gc.collect()  # readers of other tests
    before = opened()
    frames = Frames(root, open_files=1)
    for row in (0, ROWS + 3, 2 * ROWS + 5, 7):
        assert np.array_equal(frames[row], decoded["front"][row])
        assert opened() == before + 1
    frames.close()
    assert opened() == before
    assert np.array_equal(frames[3], decoded["front"][3])


def test_worker_processes_read_it(made):
    """A copy in another process, by pickle or by fork, gives the same pictures."""
    import torch

    root, decoded = made
    frames = Frames(root)
    assert np.array_equal(frames[5], decoded["front"][5])  # it is open before the fork
    copy = pickle.loads(pickle.dumps(frames))
    assert np.array_equal(copy[6], decoded["front"][6])
    batches = torch.utils.data.DataLoader(frames, batch_size=8, num_workers=2)
    assert all(np.array_equal(a, b) for a, b in zip(torch.cat(list(batches)).numpy(), decoded["front"], strict=True))


def test_lerobot_gives_the_same(made):
    """LeRobot's own reader, by PyAV, gives the same pictures."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root, _ = made
    read = LeRobotDataset("local/d", root=root, return_uint8=True, video_backend="pyav")
    frames = Frames(root)
    for row in (0, 1, ROWS - 1, ROWS, 2 * ROWS + 9):
        assert np.array_equal(read[row]["observation.images.front"].permute(1, 2, 0).numpy(), frames[row])


def test_a_title_in_another_encoding_is_no_damage(made, tmp_path):
    """Text in a film that is not UTF-8 is nobody's business: its pictures are read."""
    root, decoded = made
    copy = Path(shutil.copytree(root, tmp_path / "d"))
    for video in (copy / "videos" / "observation.images.front").rglob("*.mp4"):
        encoder = b"Lavf"
        assert encoder in video.read_bytes()
        video.write_bytes(video.read_bytes().replace(encoder, "Läuf".encode("latin-1")))
    assert np.array_equal(Frames(copy)[ROWS], decoded["front"][ROWS])


def test_mistakes_are_named(made, tmp_path):
    """A camera or row that is not there, a torn video and a folder that is no dataset are named."""
    root, _ = made
    with pytest.raises(InputError, match=r"has no camera left, known are observation\.images\.front"):
        Frames(root, "left")
    with pytest.raises(IndexError, match="row 117 of 117"):
        Frames(root)[117]
    with pytest.raises(InputError, match="info.json: cannot be read"):
        Frames(tmp_path)
    copy = Path(shutil.copytree(root, tmp_path / "d"))
    video = sorted((copy / "videos" / "observation.images.front").rglob("*.mp4"))[1]
    video.write_bytes(video.read_bytes()[:3000])
    frames = Frames(copy)
    assert frames[0].shape == (SIDE, SIDE, 3)
    with pytest.raises(InputError, match=r"file-001\.mp4: "):
        frames[2 * ROWS - 3]


def test_it_needs_no_lerobot():
    """Reading pictures imports neither LeRobot nor torch nor torchcodec, and `arena_newton.data` imports nothing."""
    code = (
        "import sys, arena_newton.data as d; heavy = {'lerobot', 'torch', 'torchcodec', 'av', 'pyarrow'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "d.Frames; assert not {'lerobot', 'torch', 'torchcodec'} & set(sys.modules)\n"
        "print('light')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500)
    assert done.stdout == "light\n", done.stderr
