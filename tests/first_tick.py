"""Seconds of a process' first tick with an empty kernel cache, with kernels rehearsed or only listed modules loaded.

    WARP_CACHE_PATH=$(mktemp -d) CUDA_CACHE_PATH=$(mktemp -d) python tests/first_tick.py rehearsed
    WARP_CACHE_PATH=$(mktemp -d) CUDA_CACHE_PATH=$(mktemp -d) python tests/first_tick.py listed

The difference is what `kernel_rehearsal` and `kernel_links` save at the first run on a machine with CUDA.
"""

import contextlib
import sys

from arena_newton.eval.bench.bench_start import first_tick
from arena_newton.kernel_cache.kernel_links import Routines
from arena_newton.kernel_cache.kernel_loading import _Loader

if __name__ == "__main__":
    if sys.argv[1:] == ["listed"]:
        _Loader.rehearsing = lambda self: contextlib.nullcontext()
        Routines.make = lambda self, module, device, block_dim: None
    elif sys.argv[1:] != ["rehearsed"]:
        sys.exit(f"{sys.argv[0]}: name rehearsed or listed")
    first_tick("boxing", 60, 0)
