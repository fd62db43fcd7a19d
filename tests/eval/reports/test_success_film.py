"""A film of successes: what it shows, how long it is, and what it needs."""

import shutil

import av
import numpy as np
import pytest
from made_folders import folder_with, recorded
from PIL import Image
from rows import episodes

from arena_newton.eval.__main__ import main
from arena_newton.eval.reports import success_film
from arena_newton.pictures.video import VideoWriter, film_strip

SIZE = (80, 48)
"""Width and height of the test's videos [px]."""


@pytest.fixture(scope="module", autouse=True)
def small_strips():
    """Strips of the usual size, from which pictures are cut."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of three tasks whose first success is repeat 1, with a video and a strip of one colour each."""
    rows = []
    for number, task in enumerate(("football", "boxing", "vis_navi")):
        some = episodes(task, (3,), repeats=3, index=60 * number)
        some[0]["outcome"] = "fall"
        rows += [recorded(row, "world", "world strip") for row in some]
    path = folder_with(tmp_path_factory.mktemp("film") / "run", rows, 180, seeds=[0])
    for row in rows:
        value = 200 if row["outcome"] == "fall" else 40 * row["repeat"]
        with VideoWriter(path / row["media"]["world"], *SIZE) as video:
            for tick in range(30 + 10 * row["repeat"]):
                video.write(np.full((SIZE[1], SIZE[0], 3), value + (20 if tick == 0 else 0), np.uint8))
        strip = [np.full((270, 480, 3), value, np.uint8)] * 10
        film_strip(strip, path / row["media"]["world strip"], label="x", captions=["y"] * 10)
    return path


def tile(frame, number, columns=3, width=None):
    """Colour in the middle of a tile."""
    width = width or (frame.shape[1] + 6) // columns
    return int(frame[frame.shape[0] // 2, number * width + width // 2].mean())


def test_a_film_shows_the_first_success_of_each_task(folder, tmp_path, capsys):
    """Every tile plays its whole episode within the film's seconds, and none of a failure is shown."""
    out = tmp_path / "film.webp"
    assert main(["film", str(folder), "--out", str(out), "--seconds", "2", "--width", "240"]) == 0
    output = capsys.readouterr().out
    assert "football, t: 101 steps" in output and "no recorded success of double_desk pp_box" in output
    with Image.open(out) as film:
        frames, shown = [], 0
        for number in range(film.n_frames):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")))
            shown += film.info["duration"]
    assert shown == 2000
    assert frames[0].shape[1] <= 240
    for number in range(3):
        assert abs(tile(frames[0], number) - 60) < 12 and abs(tile(frames[-1], number) - 40) < 12


def test_a_film_for_players(folder, tmp_path):
    """An .mp4 has the length that was asked for."""
    out = tmp_path / "film.mp4"
    assert main(["film", str(folder), "--out", str(out), "--seconds", "3", "--width", "240"]) == 0
    with av.open(str(out)) as video:
        assert len(list(video.decode(video=0))) == 30


def test_strips_as_one_picture(folder, tmp_path):
    """A .jpg has the strips of the same episodes, one below the other, without their own small text."""
    out = tmp_path / "strips.jpg"
    assert main(["film", str(folder), "--out", str(out), "--width", "1000"]) == 0
    with Image.open(out) as picture:
        pixels = np.asarray(picture)
    height = round(1000 * 270 / 4836)
    assert pixels.shape == (3 * (26 + height), 1000, 3)
    for number in range(3):
        rows = pixels[26 + number * (26 + height) :][:height, 20:80]
        assert np.abs(rows.astype(int) - 40).max() < 12


def test_tiles_are_in_rows():
    """Seven tiles make rows of four and three, the second in the middle under the first, and sides are even."""
    tiles = [np.full((9, 20, 3), 10 * number, np.uint8) for number in range(7)]
    picture = success_film.tiled(tiles, 4)
    gap = success_film.GAP
    assert picture.shape == (2 * 9 + gap, 4 * 20 + 3 * gap, 3)
    for number in range(4):
        assert (picture[:9, number * (20 + gap) :][:, :20] == 10 * number).all()
    left = (20 + gap) // 2
    for number in range(3):
        assert (picture[9 + gap :, left + number * (20 + gap) :][:, :20] == 40 + 10 * number).all()
    assert (picture[9 + gap :, :left] == success_film.GROUND).all()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--out", "film.avi"], "--out film.avi: expected"),
        (["--width", "20"], "--width 20"),
        (["--seconds", "0"], "--seconds 0"),
        (["--max-mb", "0.0001"], "--max-mb 0.0001: the film has"),
    ],
)
def test_bad_input_is_one_line(folder, tmp_path, monkeypatch, capsys, flags, message):
    """A film that cannot be written is one line with code 2, and leaves no file."""
    monkeypatch.chdir(tmp_path)
    before = sorted(folder.parent.rglob("*"))
    assert main(["film", str(folder), *flags]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and message in error
    assert sorted(folder.parent.rglob("*")) == before and not list(tmp_path.iterdir())


def test_a_recording_that_is_none(folder, tmp_path, capsys):
    """A broken video is named; a run without recordings says which flag makes them."""
    copy = shutil.copytree(folder, tmp_path / "copy")
    broken = copy / "videos" / "boxing__base__seed0__repeat1__world.mp4"
    broken.write_bytes(b"no video")
    assert main(["film", str(copy), "--out", str(tmp_path / "x.webp")]) == 2
    assert broken.name in capsys.readouterr().err
    bare = folder_with(tmp_path / "bare", episodes("boxing", (20, 20, 20)), 60)
    assert main(["film", str(bare), "--out", str(tmp_path / "x.webp")]) == 2
    assert "(run --video)" in capsys.readouterr().err
