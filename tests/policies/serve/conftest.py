"""Lets the tests of policy servers import what they share, and closes the servers that they open."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from served_policies import Served


@pytest.fixture
def served():
    """Opens a policy behind a protocol; closed after the test."""
    opened = []

    def make(policy, protocol="openpi", **options):
        opened.append(Served(policy, protocol, **options))
        return opened[-1]

    yield make
    for one in opened:
        one.close()
