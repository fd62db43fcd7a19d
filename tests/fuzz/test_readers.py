"""Hundreds of damaged files a reader: each is read, or refused in one line that names it, in bounded memory."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

MUTANTS = 200
READERS = ("usda", "usdc", "usdz", "images", "motions", "recordings", "pickles", "tables", "onnx", "safetensors")
READERS += ("datasets", "shards", "comparisons")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("reader", READERS)
def test_damaged_files(reader, tmp_path):
    """Of 200 damaged files none crashes its reader, takes 1 GiB, or is answered by anything but one line."""
    process = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("mutants.py")), reader, str(MUTANTS), "1", str(tmp_path)],
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, f"{reader}: ended with {process.returncode}: {process.stderr[-2000:]}"
    result = json.loads(process.stdout.splitlines()[-1])
    assert not result["faults"], "\n".join(result["faults"])
    counts = result["counts"]
    assert sum(counts.values()) == MUTANTS and set(counts) <= {"accepted", "refused"}, counts
    # Both answers are given: the damage is neither unseen nor total.
    assert counts.get("refused", 0) > MUTANTS // 10 and counts.get("accepted", 0) > 0, counts
    assert result["MiB"] < 1024, result
