"""Lets the tests of this folder import the networks they are made with, and keeps torch to one thread."""

import importlib
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def one_thread():
    """Two threads that wait for each other on a busy machine make small networks a hundred times slower."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def falcon(monkeypatch):
    """The example package's module, importable as when it is installed."""
    monkeypatch.syspath_prepend(Path(__file__).parent / "falcon_package")
    yield importlib.import_module("falcon_tracker")
    sys.modules.pop("falcon_tracker", None)
