"""Lets the tests of this folder import the networks they are made with."""

import importlib
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def falcon(monkeypatch):
    """The example package's module, importable as when it is installed."""
    monkeypatch.syspath_prepend(Path(__file__).parent / "falcon_package")
    yield importlib.import_module("falcon_tracker")
    sys.modules.pop("falcon_tracker", None)
