"""What all tests share: reference material, scenes that are built once per session, and a small heap to collect."""

import gc
import os
import sys
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("ARENA_REFERENCE", ROOT.parent / "shared"))

if sys.dont_write_bytecode:
    # Many tests start a Python of their own, and each would compile torch's sources again: they share a cache instead.
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(ROOT / ".pytest_cache" / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


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


@pytest.fixture(scope="session")
def football_native():
    """Football on native MuJoCo, three worlds."""
    from arena_newton import rule_sets
    from arena_newton.scene import load_scene

    return load_scene("football", worlds=3, device="cpu", native=True, rules=rule_sets.get("paper"))


@pytest.fixture(scope="session")
def football_warp():
    """Football on the Warp CPU backend, two worlds."""
    from arena_newton import rule_sets
    from arena_newton.scene import load_scene

    return load_scene("football", worlds=2, device="cpu", rules=rule_sets.get("paper"))
