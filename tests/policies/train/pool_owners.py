"""Processes that have other ones decode, for tests that end them."""

import os
import time

from arena_newton.policies.train.frames.decoder_pool import DecoderPool


def idle(_):
    """Start two processes, say which, and ask them for nothing."""
    pool = DecoderPool(64, 64, threads=1, processes=2)
    print(*(one.process.pid for one in pool._workers), flush=True)
    time.sleep(600)


def without_input(_):
    """Start one from a process whose standard input is closed; 0 if its memory is in no stream's position."""
    os.close(0)
    with DecoderPool(64, 64, threads=1, processes=1) as pool:
        return int(pool._fd <= 2)
