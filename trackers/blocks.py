"""Network inference whose result for one world does not depend on the other worlds.

Matrix products and vectorised activations on a CPU give a row other last bits in a batch of 3 than in a batch of 20,
and a walking robot amplifies that to another trajectory. Rows are therefore padded to a multiple of a fixed block size.
Which size leaves a row's bits alone wherever it stands in a block depends on the network, the library and the
processor, so it is tried out on the real weights. Where a larger product of whole blocks gives the same bits, it
replaces the separate ones, and such products are spread over a few threads. Each has one thread to itself: bits then do
not depend on the number of threads. The network is traced, so that a product is one call without Python between its
operations; the threads would wait for each other's interpreter lock otherwise. On other devices the batch runs whole,
without that promise.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache

import torch

__all__ = ["BLOCK_SIZES", "BlockRunner"]

BLOCK_SIZES = (8, 16, 32)
"""Block sizes tried, in this order; rows run one at a time where none keeps the bits."""

_PROBE_SEED = 20240
_THREADS = 4
"""Threads that a batch is spread over at most."""
_WARM_UP = 3
"""Calls within which a traced network settles on how it runs."""

Network = Callable[[torch.Tensor], torch.Tensor]


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@cache
def _pool() -> ThreadPoolExecutor:
    """Threads beside the caller's; torch gives each of them one core."""
    return ThreadPoolExecutor(_THREADS - 1, "tracker", initializer=torch.set_num_threads, initargs=(1,))


def _traced(network: Network, in_width: int, rows: int) -> Network | None:
    """The network without Python between its operations, or None where that is impossible or changes its results."""
    if not isinstance(network, torch.nn.Module):
        return None
    probes = [torch.randn(n, in_width, generator=torch.Generator().manual_seed(n)) for n in (rows, 2 * rows)]
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # torch would rather see networks compiled, which needs a C++ compiler
            traced = torch.jit.freeze(torch.jit.trace(network.eval(), probes[0], check_trace=False))
            for probe in probes:
                for _ in range(_WARM_UP):
                    result = traced(probe)
                torch.testing.assert_close(result, network(probe), rtol=1e-4, atol=1e-5)
    except (RuntimeError, AssertionError, TypeError, ValueError):
        return None
    return traced


class BlockRunner:
    """Runs a network on `worlds` rows with results that are bit-identical for any number and order of rows (CPU).

    Write observations into `input`, call `run`.
    """

    input: torch.Tensor
    """Observations, float32, shape [worlds, in_width]; a view of the padded buffer."""

    def __init__(
        self,
        network: Network,
        in_width: int,
        worlds: int,
        device: torch.device | str = "cpu",
    ):
        """Allocate the padded buffer.

        Args:
            network: Maps [rows, in_width] to [rows, out_width], each row by itself.
            in_width: Width of an observation.
            worlds: Rows that the caller fills.
            device: Where network and buffer live.
        """
        self.network = network
        self.worlds = worlds
        self.device = torch.device(device)
        self.fixed = self.device.type == "cpu"
        padding = max(BLOCK_SIZES) if self.fixed else 1
        self._rows = -(-worlds // padding) * padding
        self._buffer = torch.zeros(self._rows, in_width, device=self.device)
        self.input = self._buffer[:worlds]
        self._product: Network = network
        self._plan: tuple[int, list[slice]] | None = None

    @torch.inference_mode()
    def run(self) -> torch.Tensor:
        """Outputs of the rows in `input`, shape [worlds, out_width]; a new tensor."""
        if not self.fixed:
            return self.network(self.input)
        _, products = self.plan()
        others: list[Future[torch.Tensor]] = []
        if self._product is not self.network and len(products) <= _THREADS:
            others = [_pool().submit(self._run, rows) for rows in products[1:]]
        with _one_thread():
            outputs = [self._run(rows) for rows in products[: len(products) - len(others)]]
        outputs += [other.result() for other in others]
        return (torch.cat(outputs) if len(outputs) > 1 else outputs[0])[: self.worlds]

    @torch.inference_mode()
    def _run(self, rows: slice) -> torch.Tensor:
        view = self._buffer[rows]
        return self._product(view.clone() if rows.start else view)  # a copy starts at an aligned address, as the buffer

    def plan(self) -> tuple[int, list[slice]]:
        """Block size, and the rows of each product."""
        if self._plan is None:
            with _one_thread():
                self._plan = self._find_plan()
        return self._plan

    @torch.inference_mode()
    def _find_plan(self) -> tuple[int, list[slice]]:
        generator = torch.Generator().manual_seed(_PROBE_SEED)
        width = self._buffer.shape[1]
        self._product = _traced(self.network, width, max(BLOCK_SIZES)) or self.network
        for block in BLOCK_SIZES:
            # The choice must be the same for every number of worlds: it looks at one block only.
            rows = torch.randn(block, width, generator=generator)
            expected = self._product(rows)
            moved = (torch.roll(rows, shift, 0) for shift in range(1, block))
            if all(
                torch.equal(torch.roll(self._product(x), -shift, 0), expected) for shift, x in enumerate(moved, start=1)
            ):
                break
        else:
            return 1, _split(self.worlds, 1, self.worlds)
        blocks = -(-self.worlds // block)
        rows = torch.randn(blocks * block, width, generator=generator)
        alone = _split(blocks, block, blocks)
        separate = torch.cat([self._product(rows[one].clone()) for one in alone])
        cores = 1 if self._product is self.network else min(_THREADS, len(os.sched_getaffinity(0)))
        for count in range(min(cores, blocks), 0, -1):
            products = _split(blocks, block, count)
            if torch.equal(torch.cat([self._product(rows[some].clone()) for some in products]), separate):
                return block, products
        return block, alone


def _split(blocks: int, size: int, count: int) -> list[slice]:
    """Rows of `blocks` blocks in `count` runs of nearly equal length."""
    ends = [size * (blocks * i // count) for i in range(count + 1)]
    return [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
