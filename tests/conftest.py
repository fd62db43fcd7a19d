"""Fixtures of all tests: reference material, scenes that are built once per session, and a small heap to collect."""

import gc
import os
import signal
import sys
import tomllib
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")
# Read by torch and NumPy: threads of small networks that wait for each other on busy cores take ten times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
# Before the package takes the root of a checkout off the path.
import benchmarks  # noqa: E402, F401
import scene_builders  # noqa: E402, F401

sys.path.remove(str(ROOT))
SHARED = Path(os.environ.get("ARENA_REFERENCE", ROOT.parent / "shared"))

if sys.dont_write_bytecode:
    # Many tests start a Python of their own, and each would compile torch's sources again: they share a cache instead.
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(ROOT / ".pytest_cache" / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's background job ignores Ctrl-C, and so would every process that a test starts in order to interrupt it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser):
    """Flag for the number of damaged files that each reader gets."""
    help = "damaged files per reader: 30, or 200 in the tests that damage files alone"
    parser.addoption("--fuzz", choices=("brief", "full"), default="brief", help=help)


def pytest_collection_modifyitems(config, items):
    """Play the tests that damage files alone, where they are asked for all of them."""
    if config.getoption("--fuzz") == "full":
        others = [item for item in items if "mutants" not in item.fixturenames]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if "mutants" in item.fixturenames]


@pytest.fixture(scope="session")
def mutants(request) -> int:
    """Damaged files per reader."""
    return 200 if request.config.getoption("--fuzz") == "full" else 30


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference material; tests that need it skip without it."""
    if not (SHARED / "reference").is_dir():
        pytest.skip(f"needs reference material, and {SHARED} has none; ARENA_REFERENCE names another folder")
    return SHARED


@pytest.fixture(scope="module", autouse=True)
def small_heap():
    """Every evaluation collects garbage; with the objects of all earlier tests that took seconds per call."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_loss_of_power():
    """Nothing waits for the disk: all files of a test are gone after it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def read_options():
    """Flags are read from the dataclass of their command once: tyro does it for every call, in 22 ms."""
    from tyro._parsers import ParserSpecification

    read, kept = ParserSpecification.from_callable_or_type, {}

    def read_once(kind, **given):
        if given["parent_classes"] or not isinstance(kind, type):
            return read(kind, **given)
        key = kind, repr(given["default_instance"])
        return kept[key] if key in kept else kept.setdefault(key, read(kind, **given))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ParserSpecification, "from_callable_or_type", staticmethod(read_once))
        yield


@pytest.fixture(scope="session")
def football_native():
    """Football on native MuJoCo, three worlds."""
    from arena_newton import rule_sets
    from arena_newton.physics.scene import load_scene

    return load_scene("football", worlds=3, device="cpu", native=True, rules=rule_sets.get("paper"))


@pytest.fixture(scope="session")
def football_warp():
    """Football on the Warp CPU backend, two worlds."""
    from arena_newton import rule_sets
    from arena_newton.physics.scene import load_scene

    return load_scene("football", worlds=2, device="cpu", rules=rule_sets.get("paper"))


@pytest.fixture
def installed_falcon(tmp_path, monkeypatch):
    """The example package of a tracker as an installer leaves it: importable, with its entry points."""
    package = ROOT / "tests" / "trackers" / "falcon_package"
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    info = tmp_path / "falcon_tracker-1.0.dist-info"
    info.mkdir()
    info.joinpath("METADATA").write_text("Metadata-Version: 2.1\nName: falcon-tracker\nVersion: 1.0\n")
    lines = [f"[{g}]\n" + "".join(f"{k} = {v}\n" for k, v in e.items()) for g, e in project["entry-points"].items()]
    info.joinpath("entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(package)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("falcon_tracker", None)
