"""``python -m benchmarks processors``: replays with other vector instructions and threads than the run's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.bench.timing import BenchFigure
from benchmarks.bench_options import ProcessorOptions

__all__ = ["SETTINGS", "processor_figures"]

ONE = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
SETTINGS: dict[str, dict[str, str]] = {
    "this machine's": {},
    "one thread": ONE,
    "torch with AVX2": {"ATEN_CPU_CAPABILITY": "avx2"},
    "torch without AVX": {"ATEN_CPU_CAPABILITY": "default"},
    "MKL with SSE4.2": {"MKL_ENABLE_INSTRUCTIONS": "SSE4_2"},
    "oneDNN with SSE4.1": {"ONEDNN_MAX_CPU_ISA": "SSE41"},
    "NumPy of Haswell (AVX2)": {"OPENBLAS_CORETYPE": "Haswell"},
    "NumPy of Prescott (SSE3)": {"OPENBLAS_CORETYPE": "Prescott"},
    "all of AVX2": {"ATEN_CPU_CAPABILITY": "avx2", "OPENBLAS_CORETYPE": "Haswell", "ONEDNN_MAX_CPU_ISA": "AVX2"},
}
"""Variables of the environment by what they change; more than the processor has is not given by any."""


def processor_figures(options: ProcessorOptions) -> Iterator[BenchFigure]:
    """Contradictions of a replay, and the largest difference of the policy's answers, under each of the settings.

    Raises:
        InputError: An audit ended otherwise than with its findings.
    """
    command = [sys.executable, "-m", "arena_newton.eval", "audit", options.folder, "--all"]
    command += [] if options.policy is None else ["--policy", options.policy, "--tolerance", "1"]
    for name, variables in SETTINGS.items():
        with tempfile.TemporaryDirectory() as out:
            done = subprocess.run(
                [*command, "--out", out], env=os.environ | variables, capture_output=True, text=True, check=False
            )
            if done.returncode not in (0, 1):
                raise InputError(f"{name}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
            (found,) = json.loads((Path(out) / "audit.json").read_text()).values()
        faults, answer = found["contradictions"], found["largest differences"].get("answer")
        note = "" if answer is None else f"answers differ by up to {answer:.2g}"
        note += f"; {faults[0].rpartition(': ')[2]}" if faults else ""
        yield BenchFigure(f"replayed with {name} instructions", None, "contradictions", True, len(faults), note)
