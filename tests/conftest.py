"""Fixtures of all tests: reference material, scenes that are built once per session, and a small heap to collect."""

import gc
import importlib.metadata
import os
import shutil
import signal
import sys
import zipfile
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")
# Read by torch and NumPy: threads of small networks that wait for each other on busy cores take ten times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

# Until all is imported: what that makes stays, and to look for garbage among it takes a quarter of the time.
gc.disable()

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


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtestloop(session):
    """Fork the server of tests' processes when all is imported and nothing is patched; then look for garbage rarely."""
    gc.set_threshold(50_000, 10, 10)
    gc.enable()
    gc.freeze()
    if session.items:
        from tests.children import fork_server

        fork_server()
    return (yield)


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

    def read_once(f, **given):
        if given["parent_classes"] or not isinstance(f, type):
            return read(f, **given)
        key = f, repr(given["default_instance"])
        return kept[key] if key in kept else kept.setdefault(key, read(f, **given))

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


def install(package: Path, folder: Path) -> Path:
    """The folder of site packages into which the wheel of a package is unpacked, as an installer does it."""
    from hatchling.builders.wheel import WheelBuilder

    wheel, site = next(WheelBuilder(str(package)).build(directory=str(folder), versions=["standard"])), "site-packages"
    with zipfile.ZipFile(wheel) as file:
        file.extractall(folder / site)
    (folder / "bin").mkdir()
    for one in importlib.metadata.distributions(path=[str(folder / site)]):
        for point in one.entry_points.select(group="console_scripts"):
            called = f"import sys\nsys.path.insert(0, {str(folder / site)!r})\nimport {point.module}\n"
            (folder / "bin" / point.name).write_text(f"#!{sys.executable}\n{called}{point.module}.{point.attr}()\n")
            (folder / "bin" / point.name).chmod(0o755)
    return folder / site


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Leaves a package, named by its folder, as an installer does: importable, with entry points and commands."""

    def leave(package: Path) -> Path:
        site = install(package, tmp_path / "installed" / package.name)
        monkeypatch.syspath_prepend(site)
        monkeypatch.setenv("PATH", str(site.parent / "bin"), prepend=os.pathsep)
        return site

    yield leave
    for name, module in [*sys.modules.items()]:
        if (getattr(module, "__file__", None) or "").startswith(str(tmp_path / "installed")):
            del sys.modules[name]


@pytest.fixture
def installed_falcon(installed):
    """The example package of a tracker."""
    installed(ROOT / "tests" / "trackers" / "falcon_package")


@pytest.fixture
def installed_homing(installed):
    """The example package of a tracker with state estimation and a window."""
    installed(ROOT / "examples" / "new_tracker")


@pytest.fixture(scope="session")
def push_bin_site(tmp_path_factory):
    """Site packages with the example package of a task."""
    return install(ROOT / "examples" / "new_task", tmp_path_factory.mktemp("wheel"))


@pytest.fixture
def push_bin(push_bin_site, tmp_path, monkeypatch):
    """Folder of the example package of a task, a copy that a test may change, as an installer leaves it."""
    site = tmp_path / "site-packages"
    shutil.copytree(push_bin_site, site)
    monkeypatch.syspath_prepend(site)
    for name in [name for name in sys.modules if name.partition(".")[0] == "push_bin"]:
        monkeypatch.delitem(sys.modules, name)  # of this environment's own, where it is installed
    yield site / "push_bin"
    for name in [name for name in sys.modules if name.partition(".")[0] == "push_bin"]:
        del sys.modules[name]
