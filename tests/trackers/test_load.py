"""Motion clips are read without running what a pickle may hold."""

import pickle
import resource
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from arena_newton.errors import InputError
from arena_newton.trackers.motions import load, load_actions, load_clip
from arena_newton.trackers.motions.load import JOINTS_23, load_plain_pickle

CLIPS = Path(__file__).parents[2] / ".." / "shared" / "reference" / "twist2" / "example_motions"


def clip(frames: int = 60, **changes) -> dict:
    content = {
        "fps": np.array(30.0),
        "root_pos": np.tile([0.0, 0.0, 0.8], (frames, 1)) + np.linspace(0, 1, frames)[:, None] * [1.0, 0, 0],
        "root_rot": np.tile([0.0, 0.0, 0.0, 1.0], (frames, 1)),
        "dof_pos": np.zeros((frames, 29)),
        "local_body_pos": np.zeros((frames, 38, 3), dtype=np.float32),
        "link_body_list": ["pelvis"],
    }
    return content | changes


def write(path: Path, content, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


class Evil:
    """Creates a file when it is unpickled."""

    def __init__(self, target: Path):
        self.target = target

    def __reduce__(self):
        return (exec, (f"open({str(self.target)!r}, 'w').close()",))


@pytest.mark.parametrize("protocol", [0, 2, 3, 4, 5])
def test_reads_clip(tmp_path, protocol):
    """Clips of every pickle protocol are read; quaternions become wxyz."""
    got = load_clip(write(tmp_path / "a.pkl", clip(), protocol))
    assert got.fps == 30.0 and got.joint_pos.shape == (60, 29) and got.trimmed == 0
    assert got.root_quat[0].tolist() == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("protocol", [0, 2, 5])
def test_evil_pickle(tmp_path, protocol):
    """A pickle that wants to run code is refused, nothing of it runs, and the message names what it held."""
    mark = tmp_path / "ran"
    for content in (Evil(mark), clip(fps=Evil(mark)), clip(root_pos=np.array([Evil(mark)], dtype=object))):
        with pytest.raises(InputError, match=r"exec.*refused"):
            load_clip(write(tmp_path / "evil.pkl", content, protocol))
    assert not mark.exists()


@pytest.mark.parametrize(
    "name", [b"cos\nsystem\n", b"cnumpy\nload\n", b"cbuiltins\ngetattr\n", b"cnumpy\nndarray.tofile\n"]
)
def test_other_callables(tmp_path, name):
    """Functions of NumPy and of the language itself are refused as well."""
    path = tmp_path / "evil.pkl"
    path.write_bytes(name + b"(S'echo'\ntR.")
    with pytest.raises(InputError, match="refused"):
        load_clip(path)


def test_state_of_functions(tmp_path):
    """A pickle cannot set attributes on the functions and classes that it may name."""
    for name in (b"c_codecs\nencode\n", b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n"):
        path = tmp_path / "state.pkl"
        path.write_bytes(b"\x80\x02" + name + b"N}(S'marked'\nS'x'\nu\x86b.")
        with pytest.raises(InputError, match=r"a state for .*refused"):
            load_plain_pickle(path)
        assert not any(hasattr(admitted, "marked") for admitted in load._admitted().values())


class JoblibPickler(pickle._Pickler):
    """Writes arrays as joblib does: a wrapper in the pickle, then padding and the array's bytes in the file."""

    def save(self, obj, save_persistent_id=True):
        if not isinstance(obj, np.ndarray) or obj.ndim == 0:
            return super().save(obj, save_persistent_id)
        wrapper = sys.modules["joblib.numpy_pickle"].NumpyArrayWrapper()
        wrapper.__dict__ |= {
            "subclass": np.ndarray,
            "shape": obj.shape,
            "order": "C" if obj.flags.c_contiguous else "F",
            "dtype": obj.dtype,
            "allow_mmap": True,
            "numpy_array_alignment_bytes": 16,
        }
        super().save(wrapper)
        self.framer.commit_frame(force=True)
        self.file.write(b"\x05" + b"\xff" * 5 + (obj if wrapper.order == "C" else obj.T).tobytes())


@pytest.fixture
def joblib_file(tmp_path, monkeypatch):
    """Writes content in joblib's way; the wrapper's class exists for the writer only."""
    name = "joblib.numpy_pickle"
    wrapper = type("NumpyArrayWrapper", (), {"__module__": name})

    def write(content, protocol: int = 4) -> Path:
        with monkeypatch.context() as patch:
            module = types.ModuleType(name)
            module.NumpyArrayWrapper = wrapper
            patch.setitem(sys.modules, "joblib", types.ModuleType("joblib"))
            patch.setitem(sys.modules, name, module)
            path = tmp_path / "joblib.pkl"
            with path.open("wb") as file:
                pickler = JoblibPickler(file, protocol=protocol)
                pickler.file = file
                pickler.dump(content)
        return path

    return write


def asap(frames: int = 60) -> dict:
    content = clip(frames)
    return {
        "root_trans_offset": content["root_pos"],
        "root_rot": content["root_rot"],
        "dof": np.asfortranarray(np.arange(frames * 23.0).reshape(frames, 23) / 1e3),
        "fps": 30,
    }


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_joblib(joblib_file, protocol):
    """ASAP's clips as joblib writes them are read, arrays in either memory order; wrists they lack stand at zero."""
    content = asap()
    got = load_clip(joblib_file({"a walk": content}, protocol))
    np.testing.assert_array_equal(got.joint_pos[:, JOINTS_23], content["dof"])
    assert not got.joint_pos[:, [19, 20, 21, 26, 27, 28]].any()
    np.testing.assert_array_equal(got.root_pos, content["root_trans_offset"])


def test_bad_joblib(joblib_file, tmp_path):
    """A joblib file with objects, with code, cut short, or with several clips is refused in one line."""
    with pytest.raises(InputError, match="an array of objects, which is refused"):
        load_clip(joblib_file(clip(dof_pos=np.array([Evil(tmp_path / "ran")], dtype=object))))
    with pytest.raises(InputError, match=r"exec.*refused"):
        load_clip(joblib_file({"a": asap() | {"fps": Evil(tmp_path / "ran")}}))
    with pytest.raises(InputError, match="holds 2 clips"):
        load_clip(joblib_file({"a": asap(), "b": asap()}))
    path = joblib_file(asap())
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(InputError, match="not a readable pickle"):
        load_clip(path)
    assert not (tmp_path / "ran").exists()


def test_bad_content(tmp_path):
    """Every defect is one line that names the file and the field."""
    nan = np.zeros((60, 29))
    nan[3, 4] = np.nan
    cases = {
        r"dof_pos has 24 joints, expected 29 or 23": clip(dof_pos=np.zeros((60, 24))),
        r"field dof_pos holds NaN": clip(dof_pos=nan),
        r"field fps must be": clip(fps=np.array(0.0)),
        r"root_rot has shape \[50, 4\]": clip(root_rot=np.tile([0.0, 0, 0, 1], (50, 1))),
        r"root_pos holds 1e\+30, expected m up to 1000": clip(root_pos=np.full((60, 3), 1e30)),
        r"dof_pos holds 57, expected rad": clip(dof_pos=np.full((60, 29), 57.0)),
        r"not of length 1": clip(root_rot=np.zeros((60, 4))),
        r"field root_pos holds no numbers": clip(root_pos="here"),
        r"field root_pos is missing": {"fps": 30.0},
        r"holds list": [1, 2],
    }
    for i, (text, content) in enumerate(cases.items()):
        path = write(tmp_path / f"{i}.pkl", content)
        with pytest.raises(InputError, match=text) as caught:
            load_clip(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    path = tmp_path / "cut.pkl"
    path.write_bytes(pickle.dumps(clip())[:500])
    with pytest.raises(InputError, match="not a readable pickle"):
        load_clip(path)
    with pytest.raises(InputError, match="cannot be read"):
        load_clip(tmp_path / "none.pkl")


def test_trims_start_jump(tmp_path):
    """The first frames of a capture that begins with a jump are cut off and counted."""
    content = clip()
    content["root_pos"][:2, 2] = (1.83, 1.2)
    got = load_clip(write(tmp_path / "jump.pkl", content))
    assert got.trimmed == 2 and got.root_pos[0, 2] == 0.8
    assert load_clip(tmp_path / "jump.pkl", trim=False).trimmed == 0


@pytest.mark.skipif(not CLIPS.is_dir(), reason="TWIST2's example motions are not next to this checkout")
def test_official_clips():
    """The example clips that are known to begin with a jump are trimmed, the others stay whole."""
    trimmed = {path.stem[-3:]: load_clip(path).trimmed for path in CLIPS.glob("*.pkl")}
    assert {name for name, frames in trimmed.items() if frames} == {"001", "004", "005", "007", "009", "010"}
    assert max(trimmed.values()) <= 5


def test_actions(tmp_path):
    """Action files are checked for width, NaN and a missing array."""
    good = np.zeros((7, 40), dtype=np.float32)
    good[:, [3, 6]] = 1.0
    np.savez(tmp_path / "good.npz", action=good)
    assert load_actions(tmp_path / "good.npz").shape == (7, 40)
    bad = good.copy()
    bad[4, 30] = np.nan
    for name, content, text in (
        ("narrow", {"action": good[:, :39]}, "39 numbers, expected 40"),
        ("nan", {"action": bad}, "nan, expected a finite number"),
        ("other", {"state": good}, "array action is missing"),
        ("objects", {"action": np.array([{}], dtype=object)}, "not a readable NPZ"),
        ("empty", {"action": good[:0]}, "expected \\[ticks, 40\\]"),
    ):
        np.savez(tmp_path / f"{name}.npz", **content)
        with pytest.raises(InputError, match=text) as caught:
            load_actions(tmp_path / f"{name}.npz")
        assert str(tmp_path / f"{name}.npz") in str(caught.value)
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(InputError, match="not a readable NPZ"):
        load_actions(tmp_path / "text.npz")


def doubled(levels: int) -> list:
    """Lists that each hold the next one a hundred times: a few bytes in a pickle, 100^levels numbers as an array."""
    value: list = [0.0] * 100
    for _ in range(levels - 1):
        value = [value] * 100
    return value


def repeated(count: int) -> bytes:
    """A pickle that encodes one text of 1 MiB again and again."""
    text = pickle.dumps("x" * 2**20, 2)[2:-3]
    one = b"c_codecs\nencode\n" + b"h\x00X\x06\x00\x00\x00latin1\x86R"
    return b"\x80\x02" + text + b"q\x000](" + one * count + b"e."


BOMBS = {
    "array without numbers": b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n"
    b"cnumpy\nndarray\nJ\x00\x00\x00\x40\x85U\x01b\x87R.",
    "call of ndarray": b"\x80\x02cnumpy\nndarray\nJ\x00\x00\x00\x40\x85\x85R.",
    "scalar without bytes": b"\x80\x02cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\nU\x0bV2147483640\x85R\x85R.",
    "bytearray": b"\x80\x05\x96" + (2**33).to_bytes(8, "little") + b"abc.",
    "frame": b"\x80\x04\x95" + (2**60).to_bytes(8, "little") + b"N.",
    "bytes": b"\x80\x04\x8e" + (2**60).to_bytes(8, "little") + b"abc.",
    "memo": pickle.dumps({"fps": 30, "root_pos": doubled(6)}, 4),
    "repeated": repeated(300),
    "nested": b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",
}


@pytest.mark.parametrize("name", BOMBS)
def test_pickles_that_would_take_memory(tmp_path, name):
    """Instructions that invent, repeat or unfold arrays are refused in one line before the memory is taken."""
    path = tmp_path / "bomb.pkl"
    path.write_bytes(BOMBS[name])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"bomb\.pkl: ") as caught:
        load_clip(path)
    assert "\n" not in str(caught.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 600_000
