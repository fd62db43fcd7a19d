"""Warp without its banner."""

import os
import sys

__all__ = ["quiet_warp"]


def quiet_warp() -> None:
    """Start Warp without its banner, and without its driver's complaint on a machine that has no GPU.

    The complaint is written by native code to the error stream, where the answer to bad input must be one line.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    kept = os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(sink)
