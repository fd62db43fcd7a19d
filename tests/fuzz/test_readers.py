"""Damaged files for each reader: each is read, or refused in one line that names it, in bounded memory."""

import json

import pytest

from tests.children import Child
from tests.fuzz.mutants import READERS


@pytest.mark.parametrize("reader", READERS)
def test_damaged_files(reader, mutants, tmp_path):
    """None of many damaged files crashes its reader, takes 1 GiB, or is answered by anything but one line."""
    process = Child("tests.fuzz.mutants", [reader, str(mutants), str(tmp_path)])
    said, complained = process.communicate()
    assert process.returncode == 0, f"{reader}: ended with {process.returncode}: {complained[-2000:]}"
    result = json.loads(said.splitlines()[-1])
    assert not result["faults"], "\n".join(result["faults"])
    counts = result["counts"]
    assert sum(counts.values()) >= mutants and set(counts) <= {"accepted", "refused"}, counts
    # Both answers are given: the damage is neither unseen nor total.
    assert counts.get("refused", 0) > mutants // 10 and counts.get("accepted", 0) > 0, counts
    assert result["MiB"] < 1024, result
