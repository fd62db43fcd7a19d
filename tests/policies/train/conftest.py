"""Fixtures of training: one small dataset per session."""

import os

os.environ.setdefault("HF_HUB_OFFLINE", "1")

import pytest

pytest.importorskip("pyarrow")

from tests.policies.train.small_dataset import make_dataset  # noqa: E402


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """Three demonstrations of Boxing, labels v3.1."""
    return make_dataset(tmp_path_factory.mktemp("data"))
