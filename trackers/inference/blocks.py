"""Network inference whose result for one world does not depend on the other worlds.

Matrix products and vectorised activations on a CPU give a row other last bits in a batch of 3 than in a batch of 20,
and a walking robot amplifies that to another trajectory. Rows are therefore padded to a multiple of a fixed block size.
Which size leaves a row's bits alone wherever it stands in a block depends on the network, the library and the
processor, so it is tried out on the real weights. Where a larger product of whole blocks gives the same bits, it
replaces the separate ones. A product runs on one thread: results then do not depend on the number of threads either,
and a second thread loses more than it wins on the few rows of an evaluation, where it has to fetch the weights anew
each tick.

A network is compiled by ONNX Runtime, whose products of a few rows cost little more than reading the weights and give
a row the same bits among any others; hundreds of rows are shared among threads, each with a product of its own. Where
that fails it is traced, which takes Python out from between its operations.
On other devices the batch runs whole, without that promise.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch

__all__ = ["BLOCK_SIZES", "BlockRunner"]

BLOCK_SIZES = (4, 8, 16, 32)
"""Block sizes tried, in this order; rows run one at a time where none keeps the bits."""
_COMPILED_SIZES = (1, 2, 4)
"""Block sizes tried of a compiled network."""
_MERGED = (2, 3, 5, 8, 13, 20, 32)
"""Products of so many blocks must give a block's bits before a compiled network may run as one product of any size."""

_SHARE = 128
"""Fewest rows that are worth a thread."""

_PROBE_SEED = 20240
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


def _compiled(network: Network, in_width: int) -> Network | None:
    """The network on ONNX Runtime, on one thread, or None where that is impossible or changes its results."""
    if not isinstance(network, torch.nn.Module):
        return None
    import onnxruntime

    probe = torch.randn(8, in_width, generator=torch.Generator().manual_seed(8))
    file: Any = io.BytesIO()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # the exporter that needs no further package is deprecated
            torch.onnx.export(
                network.eval(), (probe,), file, dynamo=False, input_names=["obs"], output_names=["action"],
                dynamic_axes={"obs": {0: "rows"}, "action": {0: "rows"}},
            )  # fmt: skip
            session = onnxruntime.InferenceSession(file.getvalue(), options, providers=["CPUExecutionProvider"])

            def run(rows: torch.Tensor) -> torch.Tensor:
                return torch.from_numpy(session.run(None, {"obs": rows.numpy()})[0])

            torch.testing.assert_close(run(probe), network(probe), rtol=1e-4, atol=1e-5)
    except Exception:  # exporter and runtime raise what they like; the traced network stands in
        return None
    return run


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
        self.path = "torch"
        """What runs the network: `onnxruntime`, `torch traced` or `torch`; known once the plan is made."""
        self._plan: tuple[int, bool] | None = None
        self._threads = min(torch.get_num_threads(), worlds // _SHARE)
        self._pool: ThreadPoolExecutor | None = None

    @torch.inference_mode()
    def run(self) -> torch.Tensor:
        """Outputs of the rows in `input`, shape [worlds, out_width]; a new tensor."""
        if not self.fixed:
            return self.network(self.input)
        block, merged = self.plan()
        rows = -(-self.worlds // block) * block
        # A compiled network runs on one thread by itself; torch's number of threads is the whole process's.
        with contextlib.nullcontext() if self.path == "onnxruntime" else _one_thread():
            if self._pool is not None:
                share = -(-rows // (block * self._threads)) * block
                return torch.cat(list(self._pool.map(self._product, self._buffer[:rows].split(share))))[: self.worlds]
            if merged or rows == block:
                return self._product(self._buffer[:rows])[: self.worlds]
            blocks = [self._product(self._buffer[i : i + block].clone()) for i in range(0, rows, block)]
        return torch.cat(blocks)[: self.worlds]

    def plan(self) -> tuple[int, bool]:
        """Block size, and whether all blocks may run as one product."""
        if self._plan is None:
            with _one_thread():
                self._plan = self._find_plan()
        return self._plan

    @torch.inference_mode()
    def _find_plan(self) -> tuple[int, bool]:
        generator = torch.Generator().manual_seed(_PROBE_SEED)
        width = self._buffer.shape[1]
        compiled = _compiled(self.network, width)
        if compiled is not None:
            for block in _COMPILED_SIZES:
                rows = torch.randn(block * max(_MERGED), width, generator=generator)
                blocks = rows.split(block)
                expected = torch.cat([compiled(part.clone()) for part in blocks])
                turned = torch.cat([torch.roll(compiled(torch.roll(part, 1, 0)), -1, 0) for part in blocks])
                whole = (torch.equal(compiled(rows[: n * block].clone()), expected[: n * block]) for n in _MERGED)
                if torch.equal(turned, expected) and all(whole):
                    self._product, self.path = compiled, "onnxruntime"
                    if self._threads > 1:
                        self._pool = ThreadPoolExecutor(self._threads)
                    return block, True
        traced = _traced(self.network, width, max(BLOCK_SIZES))
        self._product, self.path = (self.network, "torch") if traced is None else (traced, "torch traced")
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
            return 1, False
        count = -(-self.worlds // block) * block
        rows = torch.randn(count, width, generator=generator)
        separate = torch.cat([self._product(rows[i : i + block].clone()) for i in range(0, count, block)])
        return block, torch.equal(self._product(rows), separate)
