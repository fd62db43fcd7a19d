"""Shared, expensive things: one built scene a test session."""

import os
import sys
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"

if sys.dont_write_bytecode:
    # Many tests start a Python of their own, and each would compile torch's sources again: they share a cache instead.
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(ROOT / ".pytest_cache" / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference material beside the checkout; tests that need it skip without it."""
    if not (SHARED / "reference").is_dir():
        pytest.skip("needs the reference material in ../shared, which is not here")
    return SHARED


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
