"""``python -m benchmarks processors``: replays with other vector instructions and threads than the run's.

Each setting is a process of its own: this module as a program.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import warp

from arena_newton.errors import InputError
from arena_newton.eval.audit.action_replay import replay
from arena_newton.eval.audit.draws import drawn
from arena_newton.eval.audit.folder_audit import audited
from arena_newton.eval.bench.timing import BenchFigure
from benchmarks.bench_options import ProcessorOptions

__all__ = ["SETTINGS", "processor_figures"]

ONE = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
WARP = "WARP_CPU_COMPILER_FLAGS"
"""Stands for `warp.config.cpu_compiler_flags`, which Warp reads of no variable: flags of `clang -cc1`, which knows no
`-march` but Warp's own `-march=native`."""
PORTABLE = {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE", "ONEDNN_MAX_CPU_ISA": "SSE41"}
PORTABLE |= {"OPENBLAS_CORETYPE": "Prescott", WARP: ""}
SETTINGS: dict[str, dict[str, str]] = {
    "this machine's": {},
    "one thread": ONE,
    "torch with AVX2": {"ATEN_CPU_CAPABILITY": "avx2"},
    "torch without AVX": {"ATEN_CPU_CAPABILITY": "default"},
    "MKL with SSE4.2": {"MKL_ENABLE_INSTRUCTIONS": "SSE4_2"},
    "MKL, compatible": {"MKL_CBWR": "COMPATIBLE"},
    "oneDNN with SSE4.1": {"ONEDNN_MAX_CPU_ISA": "SSE41"},
    "NumPy of Haswell (AVX2)": {"OPENBLAS_CORETYPE": "Haswell"},
    "NumPy of Prescott (SSE3)": {"OPENBLAS_CORETYPE": "Prescott"},
    "Warp for x86-64-v3 (AVX2, FMA)": {WARP: "-target-cpu x86-64-v3"},
    "Warp for any x86-64": {WARP: ""},
    "C library without AVX2 and FMA": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"},
    "all of AVX2": {"ATEN_CPU_CAPABILITY": "avx2", "OPENBLAS_CORETYPE": "Haswell", "ONEDNN_MAX_CPU_ISA": "AVX2"},
    "portable, all of the least": PORTABLE | ONE,
}
"""Variables of the environment by what they change; more than the processor has is not given by any."""


def processor_figures(options: ProcessorOptions) -> Iterator[BenchFigure]:
    """Contradictions of a replay, the policy's largest difference, and processor time, under each of the settings.

    Raises:
        InputError: A replay failed.
    """
    command = [sys.executable, "-m", "benchmarks.audits.processors", options.folder, options.policy or ""]
    usual = 0.0
    for name, variables in SETTINGS.items():
        done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{name}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
        found = json.loads(done.stdout.splitlines()[-1])
        faults, answer, seconds = found["contradictions"], found["answer"], found["seconds"]
        usual = usual or seconds
        note = f"{seconds / usual:.2f} of the processor time ({seconds:.1f} s)"
        note += "" if answer is None else f"; answers differ by up to {answer:.2g}"
        note += f"; {faults[0].rpartition(': ')[2]}" if faults else ""
        yield BenchFigure(f"replayed with {name} instructions", None, "contradictions", True, len(faults), note)


def _replayed_here(folder: str, policy: str) -> str:
    """Findings of a replay in this process, as JSON, and the processor time of a second one, when all is loaded."""
    if (flags := os.environ.get(WARP)) is not None:
        warp.config.cpu_compiler_flags = flags
    for _ in range(2):
        audit = audited(Path(folder).expanduser())
        began = time.process_time()
        replay(audit, drawn([audit], None, 0)[0], policy=policy or None, tolerance=1.0)
        seconds = time.process_time() - began
    return json.dumps({"contradictions": audit.faults, "answer": audit.largest.get("answer"), "seconds": seconds})


if __name__ == "__main__":
    print(_replayed_here(*sys.argv[1:]))
