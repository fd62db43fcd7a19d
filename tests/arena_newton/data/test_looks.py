"""Looks of recorded pictures: what their films hold, and their way into datasets."""

import hashlib
import json
import shutil

import numpy as np
import pytest

pytest.importorskip("pyarrow")

from arena_newton.data.__main__ import main  # noqa: E402
from arena_newton.data.readers.frame_reader import OpenVideo  # noqa: E402
from arena_newton.data.readers.looks import FIRST_SHAPE, Looks, dataset_looks  # noqa: E402
from arena_newton.data.recording.episode import EpisodeFile, episode_files  # noqa: E402
from arena_newton.data.recording.look_planes import second_light, visual_angle  # noqa: E402
from arena_newton.errors import InputError  # noqa: E402
from arena_newton.rules.rule_types import LightRange  # noqa: E402
from arena_newton.tasks.base import LightDraw, draw_light  # noqa: E402
from tests.arena_newton.data.consistent import ROWS, consistent_episode  # noqa: E402
from tests.arena_newton.data.made_episodes import LOOKS, look_frames  # noqa: E402


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two episodes with looks and one without."""
    folder = tmp_path_factory.mktemp("looks")
    for repeat in range(3):
        consistent_episode(folder, ROWS + repeat, repeat=repeat, looks=None if repeat == 2 else LOOKS)
    return folder


@pytest.fixture(scope="module")
def dataset(recordings, tmp_path_factory):
    """They as a dataset."""
    out = tmp_path_factory.mktemp("built") / "boxing"
    assert main(["build", str(recordings), "--out", str(out)]) == 0
    return out


def test_films_keep_every_byte(recordings):
    """A film's frames are those that were written, one for every fifth row."""
    file = EpisodeFile(episode_files([recordings])[1])
    looks, film = file.looks("front")
    video = OpenVideo(film)
    frames = np.stack([video.read(number) for number in range(len(video.times))])
    video.close()
    assert looks == LOOKS and np.array_equal(frames, look_frames(-(-file.rows // 5), 32, 1))


def test_bytes_name_shapes_and_their_objects():
    """A byte's probability is its shape's, none of robot and background; an object's parts of a kind share a number."""
    room = ("/World/Room/Floor", 1.0), ("/World/Room/Walls", 1.0)
    shapes = *room, ("/World/Door/Leaf", 1.0), ("/World/Door/Lever", 0.5), ("/World/Door/Rim", 1.0)
    looks = Looks(5, ((1000.0,),), shapes)
    assert looks.chances()[: FIRST_SHAPE + 6].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0, 0.5, 1.0, 0.0]
    assert looks.objects()[:8].tolist() == [0, 1, 2, 3, 4, 5, 4, 7]
    assert Looks.read(json.loads(json.dumps(looks.plain())), "here") == looks


def test_second_lights_are_never_those_of_visual_mode():
    """None of 4,000 lights comes from within 5° of any direction of visual mode, which has no domes."""
    steep = [draw_light(seed, LightRange()) for seed in range(4000)]
    widest = max(np.degrees(np.arccos(-light.direction[2])) for light in steep)
    assert visual_angle() - 2.0 < widest <= visual_angle() and all(isinstance(light, LightDraw) for light in steep)
    drawn = [second_light(seed, number) for seed in range(2000) for number in range(2)]
    tilts = [np.degrees(np.arccos(-light.direction[2])) for light in drawn if isinstance(light, LightDraw)]
    assert min(tilts) >= visual_angle() + 5.0 - 1e-6 and 0.5 < len(tilts) / len(drawn) < 0.8
    turned = [light.direction for light in drawn if isinstance(light, LightDraw)]
    assert np.abs(np.mean(turned, axis=0)[:2]).max() < 0.05, "they come from all sides"
    assert second_light(7, 0) == second_light(7, 0) != second_light(7, 1)


def test_a_dataset_carries_the_films(recordings, dataset, tmp_path, capsys):
    """`build` copies each film byte for byte and says what it is of; `verify` and `merge` take them."""
    listed = dataset_looks(dataset, 3)
    assert [film is not None for film in listed] == [True, True, False]
    for film, file in zip(listed[:2], episode_files([recordings]), strict=False):
        looks, source = EpisodeFile(file).looks("front")
        assert film.looks == looks and film.path.read_bytes() == source.read_bytes()
        assert film.sha256 == hashlib.sha256(source.read_bytes()).hexdigest()
    assert main(["verify", str(dataset), "--recordings", str(recordings)]) == 0
    assert "looks" not in (dataset / "meta" / "info.json").read_text()
    other = tmp_path / "recordings"
    consistent_episode(other, ROWS, repeat=7)
    assert main(["build", str(other), "--out", str(tmp_path / "other")]) == 0
    assert not (tmp_path / "other" / "looks").exists()
    assert main(["merge", str(tmp_path / "other"), str(dataset), "--out", str(tmp_path / "both")]) == 0
    merged = dataset_looks(tmp_path / "both", 4)
    assert merged[0] is None is merged[3] and [film.sha256 for film in merged[1:3]] == [f.sha256 for f in listed[:2]]
    assert main(["verify", str(tmp_path / "both"), "--recordings", str(recordings), str(other)]) == 0


def exchanged(dataset):
    shutil.copyfile(dataset / "looks" / "episode_000000.mp4", dataset / "looks" / "episode_000001.mp4")


def cut(dataset):
    film = dataset / "looks" / "episode_000000.mp4"
    film.write_bytes(film.read_bytes()[:-100])


def edited(*path):
    """Sets a value deep in the list of looks."""
    *way, last, new = path

    def edit(dataset):
        file = dataset / "looks" / "looks.json"
        content = value = json.loads(file.read_text())
        for step in way:
            value = value[step]
        value[last] = new
        file.write_text(json.dumps(content))

    return edit


FAULTS = {
    "exchanged": (exchanged, "episode_000001.mp4, episode 1: is not the film of looks.json"),
    "cut": (cut, "episode_000000.mp4, episode 0: is not the film of looks.json"),
    "missing": (lambda dataset: (dataset / "looks" / "episode_000001.mp4").unlink(), "episode_000001.mp4: is missing"),
    "another version": (edited("schema", "arena_looks_v9"), 'schema is "arena_looks_v9", expected arena_looks_v1'),
    "too few": (edited("episodes", []), "is no list of 3"),
    "no stride": (edited("episodes", 0, "stride", 0), "looks.json: episode 0: stride is 0"),
    "a light that is none": (edited("episodes", 0, "lights", [["bright"]]), "episode 0: lights is [["),
    "a shape that is none": (edited("episodes", 1, "shapes", [["/World/Floor", 2.0]]), "episode 1: shapes is [["),
    "another stride": (edited("episodes", 0, "stride", 4), "looks, episode 0: are not the looks of"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_verify_names_what_is_wrong_with_looks(fault, recordings, dataset, tmp_path, capsys):
    """A film that is exchanged, cut or missing and a list that is damaged are one line, and exit code 1."""
    spoil, words = FAULTS[fault]
    copy = shutil.copytree(dataset, tmp_path / "copy")
    spoil(copy)
    assert main(["verify", str(copy), "--recordings", str(recordings)]) == 1
    assert words in capsys.readouterr().err


def test_a_recording_whose_film_is_torn_is_refused(recordings, tmp_path, capsys):
    """`build` names a film that is missing or of another length."""
    copy = shutil.copytree(recordings, tmp_path / "copy")
    films = sorted((copy / "videos").glob("*_looks.mp4"))
    shutil.copyfile(films[0], films[1])
    assert main(["build", str(copy), "--out", str(tmp_path / "out")]) == 2
    assert f"{films[1]}: has 8 frames, its episode's looks are 9" in capsys.readouterr().err
    films[1].unlink()
    assert main(["build", str(copy), "--out", str(tmp_path / "out")]) == 2
    assert "arena_vision_looks" in (said := capsys.readouterr().err) and "is missing" in said


def test_looks_of_rows_that_are_gone_are_dropped(recordings, tmp_path):
    """`clean` and `split` keep the films of whole episodes, and drop those of episodes that lost rows."""
    assert main(["clean", str(recordings), "--out", str(tmp_path / "clean")]) == 0
    kept = [EpisodeFile(file) for file in episode_files([tmp_path / "clean"])]
    whole = [file.looks("front") is not None for file in kept]
    assert whole == ["arena_cleaned" not in file and number < 2 for number, file in enumerate(kept)]
    sides = [str(tmp_path / side) for side in ("train", "held")]
    command = ["split", str(recordings), "--out-train", sides[0], "--out-held-out", sides[1], "--fraction", "0.5"]
    assert main([*command, "--seed", "1"]) == 0
    films = [EpisodeFile(file).looks("front") for side in sides for file in episode_files([side])]
    assert sum(film is not None for film in films) == 2


def test_strips_show_changed_looks(dataset, tmp_path):
    """`inspect --looks N` adds N rows of pictures to each strip of an episode that has looks, and none to others."""
    assert main(["inspect", str(dataset), "--looks", "3", "--pictures", "4", "--out", str(tmp_path / "page.html")]) == 0
    assert main(["inspect", str(dataset), "--pictures", "4", "--out", str(tmp_path / "plain.html")]) == 0
    sizes = [len((tmp_path / name).read_text()) for name in ("page.html", "plain.html")]
    assert sizes[0] > sizes[1] + 3000


def test_damaged_descriptions_are_one_error():
    """Anything that is no description of looks is refused by name."""
    for value in (None, [], {}, {"schema": 1}, LOOKS.plain() | {"lights": []}, LOOKS.plain() | {"stride": True}):
        with pytest.raises(InputError, match="^here: "):
            Looks.read(value, "here")
