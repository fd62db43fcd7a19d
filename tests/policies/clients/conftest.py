"""Lets the tests of clients import their servers, and closes what they open."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from foreign_servers import OPENED


@pytest.fixture(autouse=True)
def closed():
    """Servers and policies are closed after their test."""
    yield
    while OPENED:
        OPENED.pop().close()
