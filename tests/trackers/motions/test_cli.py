"""The commands of `python -m arena_newton.trackers.motions`, and what they say to wrong input."""

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest

from arena_newton.robot.g1 import DEFAULT_POSE
from arena_newton.trackers.motions import kinematics, programs
from arena_newton.trackers.motions.__main__ import main
from arena_newton.trackers.motions.film import picked_frames
from arena_newton.trackers.motions.library import MotionLibrary
from arena_newton.trackers.motions.load import Clip


def clip_file(folder, name: str, ticks: int = 60, raised: float = 0.0):
    height = kinematics.neutral_stance().height + raised
    pos = np.stack([np.linspace(0, 0.3, ticks), np.zeros(ticks), np.full(ticks, height)], axis=1)
    content = {
        "fps": 30.0,
        "root_pos": pos,
        "root_rot": np.tile([0.0, 0, 0, 1], (ticks, 1)),
        "dof_pos": np.tile(DEFAULT_POSE, (ticks, 1)),
    }
    path = folder / f"{name}.pkl"
    path.write_bytes(pickle.dumps(content))
    return path


def seated() -> MotionLibrary:
    """A clip with a seat behind the robot, hands closed in its second half."""
    pos = np.tile([3.0, -2.0, kinematics.neutral_stance().height], (50, 1))
    quat = np.tile([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], (50, 1))
    hands = np.repeat([[0.0, 0.0], [1.0, 1.0]], 25, axis=0)
    library = MotionLibrary.from_clips([Clip(50.0, pos, quat, np.tile(DEFAULT_POSE, (50, 1)), hands=hands)], ["seat"])
    library.support_kind[:] = 1
    library.support_box[:] = [3.0, -2.4, 0.42, np.pi / 2, 0.5, 0.6, 0.42]
    return library


def test_convert_and_inspect(tmp_path, capsys):
    """Files become a library with licence and source, grounded and mirrored; `inspect` measures it."""
    files = [str(clip_file(tmp_path, "a")), str(clip_file(tmp_path, "b", raised=0.04))]
    out = tmp_path / "lib.npz"
    flags = ["--licence", "MIT", "--source", "https://example.org", "--family", "walk", "--ground", "--mirror"]
    assert main(["convert", *files, "--out", str(out), *flags]) == 0
    assert "clips shifted by -4.0 to" in capsys.readouterr().out
    library = MotionLibrary.load(out)
    assert library.clip_names.tolist() == ["a", "b", "a mirrored", "b mirrored"]
    assert set(library.licence) == {"MIT"} and library.source[1] == "https://example.org: b.pkl"
    assert main(["inspect", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "b mirrored" in printed and "total: 4 clips" in printed and "MIT (4)" in printed
    assert main(["inspect", str(out), "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["families"]["walk"]["clips"] == 4 and abs(numbers["measures"][1]["floor"]) < 1e-3


def test_unlicensed(tmp_path, capsys):
    """Clips without licence and source are not written; a library brings its own."""
    path = clip_file(tmp_path, "a")
    assert main(["convert", str(path), "--out", str(tmp_path / "lib.npz"), "--licence", "MIT"]) == 2
    assert "state --licence and --source" in capsys.readouterr().err and not (tmp_path / "lib.npz").exists()
    assert main(["convert", str(path), "--out", str(tmp_path / "lib.npz"), "--licence", "MIT", "--source", "me"]) == 0
    assert main(["convert", str(tmp_path / "lib.npz"), "--out", str(tmp_path / "again.npz")]) == 0
    assert MotionLibrary.load(tmp_path / "again.npz").licence.tolist() == ["MIT"]


def test_render(tmp_path):
    """A film strip shows the robot, its seat and closed hands, a strip a clip; pictures differ where the clip does."""
    from PIL import Image

    library = MotionLibrary.concatenate([seated(), seated()])
    library.support_kind[1] = 0
    library.save(tmp_path / "lib.npz")
    out = tmp_path / "film.png"
    arguments = ["render", str(tmp_path / "lib.npz"), "--clip", "0", "--clip", "1", "--out", str(out)]
    assert main([*arguments, "--pictures", "2", "--width", "96"]) == 0
    sheet = np.asarray(Image.open(out)).astype(int)
    assert sheet.shape == (2 * (128 + 18 + 4), 2 * 100 + 4, 3)
    pictures = [[sheet[y + 18 : y + 130, x : x + 96] for x in (4, 104)] for y in (0, 150)]
    changed = np.abs(pictures[0][0] - pictures[0][1]).max(axis=2) > 30
    assert 5 < changed.sum() < 500, "closing hands change a few pixels"
    assert (np.abs(pictures[0][0] - pictures[1][0]).max(axis=2) > 10).sum() > 300, "the seat is in the first strip only"


def test_generate(tmp_path, capsys):
    """Random motions of the families asked for, named, licensed, with the command as their source."""
    out = tmp_path / "lib.npz"
    arguments = ["generate", "--out", str(out), "--family", "stand=1", "--family", "squat=1", "--seconds", "2"]
    assert main([*arguments, "--seed", "3", "--mirror"]) == 0
    library = MotionLibrary.load(out)
    assert library.clip_names.tolist() == ["stand-0000", "squat-0000", "stand-0000 mirrored", "squat-0000 mirrored"]
    assert "--seed 3" in library.source[0] and set(library.licence) == {"Apache-2.0"}
    assert "4 clips" in capsys.readouterr().out
    assert set(programs.FAMILIES) >= {"stand", "walk", "squat", "kick", "sit"}


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["frob"], "invalid choice"),
        ([], "required"),
        (["inspect", "{tmp}/none.npz"], "no such file"),
        (["render", "{tmp}/a.pkl", "--clip", "b"], "clip b"),
        (["render", "{tmp}/a.pkl", "--out", "{tmp}/a.gif"], ".png or .mp4"),
        (["render", "{tmp}/a.pkl", "--start", "9"], "nothing between"),
        (["render", "{tmp}/a.pkl", "--pictures", "0"], "--pictures 0"),
        (["render", "{tmp}/a.pkl", "--width", "3"], "at least 16"),
        (["convert", "{tmp}/a.pkl", "--out", "{tmp}/x.pkl"], ".npz"),
        (["convert", "{tmp}/a.pkl", "--out", "/proc/x.npz", "--licence", "MIT", "--source", "x"], "cannot be written"),
        (["generate", "--out", "{tmp}/x.npz", "--family", "walk"], "walk=100"),
        (["generate", "--out", "{tmp}/x.npz", "--family", "swim=3"], "--family swim"),
        (["generate", "--out", "{tmp}/x.npz", "--seconds", "0"], "--seconds 0"),
    ],
)
def test_wrong_input(tmp_path, capsys, arguments, text):
    """Wrong input ends with code 2 and one line that names it."""
    clip_file(tmp_path, "a")
    assert main([a.format(tmp=tmp_path) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert text in error and error.startswith("error: ") and error.count("\n") == 1


def test_picked_frames():
    """Pictures are spread evenly from start to end, both included, and never beyond the clip."""
    library = seated()
    assert picked_frames(library, 0, 4, 0.0, None).tolist() == [0, 16, 33, 49]
    assert picked_frames(library, 0, 3, 0.2, 0.6).tolist() == [10, 20, 30]
    assert picked_frames(library, 0, 400, 0.0, 7.0).tolist() == list(range(50))


def test_help_is_quick():
    """Help needs no simulator: it loads no large library."""
    code = "import sys; from arena_newton.trackers.motions.__main__ import main\ntry: main(['--help'])\n"
    code += "except SystemExit: print(any(m in sys.modules for m in ('torch', 'warp', 'newton', 'mujoco', 'cv2')))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip().endswith("False")


def test_one_bad_file_of_several(tmp_path, capsys):
    """`convert` names the file that it cannot read, and says that nothing is made of the others."""
    good, table, out = clip_file(tmp_path, "good"), tmp_path / "a.csv", tmp_path / "lib.npz"
    table.write_text("\n".join([",".join(["0"] * 36)] * 5))
    flags = ["--out", str(out), "--licence", "MIT", "--source", "https://example.org"]
    assert main(["convert", str(good), str(table), *flags]) == 2
    printed = capsys.readouterr()
    assert f"{table}: the order of the quaternions is not clear" in printed.err
    assert printed.err.rstrip().endswith("nothing is made of the other 1 file") and not out.exists()
    assert main(["convert", str(table), *flags]) == 2
    assert "nothing is made" not in capsys.readouterr().err


def test_a_table_is_counted_before_it_is_split(tmp_path, capsys):
    """A single line of a million columns is refused by its commas; a line among others by its number."""
    table = tmp_path / "a.csv"
    table.write_text("0," * 1_000_000 + "0\n")
    assert main(["inspect", str(table)]) == 2
    assert "has 1000001 columns, expected 36" in capsys.readouterr().err
    table.write_text(",".join(["0"] * 36) + "\n\n" + ",".join(["0"] * 35) + "\n")
    assert main(["inspect", str(table)]) == 2
    assert "line 3 does not hold 36 numbers" in capsys.readouterr().err
