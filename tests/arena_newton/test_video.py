"""Promises of videos and film strips."""

import os
import subprocess
import sys

import av
import numpy as np
import pytest
from PIL import Image

from arena_newton.errors import ArenaError
from arena_newton.pictures.video import VideoWriter, film_strip


def _frames(n, height=48, width=64):
    frames = np.zeros((n, height, width, 3), np.uint8)
    for i in range(n):
        frames[i] = (i * 20) % 256
    return frames


def test_video_is_h264_with_every_frame(tmp_path):
    """The file is H.264 yuv420p of the given size and rate, holds every frame, and appears only when closed."""
    path = tmp_path / "a" / "run.mp4"
    writer = VideoWriter(path, 64, 48, fps=25.0)
    for frame in _frames(12):
        writer.write(frame)
    assert not path.exists()
    writer.close()
    writer.close()
    assert sorted(p.name for p in path.parent.iterdir()) == ["run.mp4"]
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert (stream.width, stream.height, stream.codec_context.pix_fmt) == (64, 48, "yuv420p")
        assert float(stream.average_rate) == 25.0
        decoded = [f.to_ndarray(format="rgb24") for f in container.decode(stream)]
    assert len(decoded) == 12
    assert abs(int(decoded[5].mean()) - 100) < 6


def test_odd_sizes_are_padded(tmp_path):
    """A frame of odd size gets one black row or column."""
    with VideoWriter(tmp_path / "odd.mp4", 33, 21) as writer:
        writer.write(np.full((21, 33, 3), 255, np.uint8))
    with av.open(str(tmp_path / "odd.mp4")) as container:
        frame = next(container.decode(video=0)).to_ndarray(format="rgb24")
    assert frame.shape == (22, 34, 3)
    assert frame[:20, :32].mean() > 240


LOSSLESS = {"b_frames": False, "lossless": True}


@pytest.mark.parametrize(
    ("height", "width", "how"),
    [(48, 64, {}), (70, 62, {"b_frames": False, "gop": 2}), (70, 62, LOSSLESS), (21, 33, LOSSLESS)],
)
def test_colours_come_back(tmp_path, height, width, how):
    """A frame of four colours is read with them, each at its own place, also between others."""
    colours = np.array([[200, 30, 40], [40, 180, 60], [50, 60, 210], [230, 220, 30]], np.uint8)
    frame = np.zeros((height, width, 3), np.uint8)
    half, middle = height // 2, width // 2
    for number, colour in enumerate(colours):
        rows = slice(0, half) if number < 2 else slice(half, None)
        frame[rows, slice(0, middle) if number % 2 == 0 else slice(middle, None)] = colour
    with VideoWriter(tmp_path / "c.mp4", width, height, crf=10, **how) as writer:
        for pictures in (frame, frame[::-1], frame):
            writer.write(pictures)
    with av.open(str(tmp_path / "c.mp4")) as container:
        read = [one.to_ndarray(format="rgb24")[:height, :width].astype(int) for one in container.decode(video=0)]
    for one, wanted in zip(read, (frame, frame[::-1], frame), strict=True):
        off = np.abs(one - wanted)
        assert off.mean() < 8 and np.median(off) <= 3  # colours of neighbours mix
        assert "lossless" not in how or not off.any()


def test_failed_video_leaves_nothing(tmp_path):
    """Neither an interrupted video nor one without frames leaves a file."""
    with pytest.raises(RuntimeError), VideoWriter(tmp_path / "x.mp4", 64, 48) as writer:
        writer.write(_frames(1)[0])
        raise RuntimeError
    VideoWriter(tmp_path / "y.mp4", 64, 48).close()
    assert list(tmp_path.iterdir()) == []


def test_wrong_frame_is_refused(tmp_path):
    """A frame of another size or type is answered with one clear line."""
    writer = VideoWriter(tmp_path / "x.mp4", 64, 48)
    with pytest.raises(ArenaError, match="expected frames of 64×48"):
        writer.write(np.zeros((40, 64, 3), np.uint8))
    with pytest.raises(ArenaError, match="uint8"):
        writer.write(np.zeros((48, 64, 3), np.float32))
    writer.discard()
    assert list(tmp_path.iterdir()) == []


def test_film_strip_spaces_frames_evenly(tmp_path):
    """Ten frames side by side, first and last included, with a label line above on request."""
    frames = _frames(12)
    plain = np.asarray(Image.open(film_strip(frames, tmp_path / "s.png")))
    assert plain.shape == (48, 10 * 64 + 9 * 4, 3)
    assert plain[10, 10, 0] == frames[0, 0, 0, 0]
    assert plain[10, -10, 0] == frames[11, 0, 0, 0]
    labelled = np.asarray(Image.open(film_strip(list(frames[:3]), tmp_path / "t.png", label="football success")))
    assert labelled.shape[0] > 48
    assert labelled.shape[1] == 3 * 64 + 2 * 4
    with pytest.raises(ArenaError, match="at least one frame"):
        film_strip([], tmp_path / "u.png")


@pytest.mark.parametrize("kind", ["link", "hard link", "dangling link"])
def test_pictures_follow_no_link(tmp_path, kind):
    """A link that lies where a picture is written, under its name or its partial name, leads nowhere."""
    victim = tmp_path / "victim"
    victim.write_text("mine")
    for name in ("a.mp4", "a.mp4.part", "a.jpg", "a.jpg.part"):
        link = tmp_path / name
        link.hardlink_to(victim) if kind == "hard link" else link.symlink_to(victim if kind == "link" else "absent")
    with VideoWriter(tmp_path / "a.mp4", 64, 48) as writer:
        for frame in _frames(3):
            writer.write(frame)
    film_strip(_frames(3), tmp_path / "a.jpg")
    assert victim.read_text() == "mine" and not (tmp_path / "absent").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.jpg", "a.mp4", "victim"]
    assert all(path.is_file() and not path.is_symlink() for path in tmp_path.iterdir())
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert len(list(container.decode(video=0))) == 3


def test_bytes_do_not_depend_on_what_was_in_memory(tmp_path):
    """Equal frames give equal bytes, whatever the memory held that the encoder was given (glibc's MALLOC_PERTURB_)."""
    program = """
import sys
import numpy
from arena_newton.pictures.video import VideoWriter
picture = numpy.add.outer(numpy.arange(224), numpy.arange(224))[:, :, None] * numpy.ones((1, 1, 3))
with VideoWriter(sys.argv[1], 224, 224, 50, gop=10, b_frames=False) as video:
    for tick in range(20):
        video.write((picture + tick).astype(numpy.uint8))
"""
    made = []
    for number in ("1", "255"):
        path = tmp_path / f"{number}.mp4"
        subprocess.run(
            [sys.executable, "-c", program, str(path)], env=os.environ | {"MALLOC_PERTURB_": number}, check=True
        )
        made.append(path.read_bytes())
    assert made[0] == made[1]
