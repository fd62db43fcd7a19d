"""Lets the tests of this folder import each other's stand-ins, and makes what several files read."""

import os
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def made_suite(tmp_path_factory):
    """A suite of known outcomes."""
    from made_suites import plan, write_suite

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)  # thousands of journal lines
        return write_suite(tmp_path_factory.mktemp("made") / "suite", plan())
