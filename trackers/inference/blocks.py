"""Network inference whose result for one world does not depend on the other worlds.

Matrix products on a CPU give a row other last bits in a batch of 3 than in a batch of 20, and a walking robot amplifies
that to another trajectory. ONNX Runtime's products of a few rows cost little more than reading the weights, and usually
give a row the same bits among any others. Whether they do depends on the network, the library and the processor, so it
is tried out on the real weights: for single rows first, then for blocks of 2 and 4, to which the rows are padded; where
none keeps a row's bits, rows run one at a time.

A product runs on one thread: results then do not depend on the number of threads either, and a second thread loses more
than it wins on the few rows of an evaluation, where it has to fetch the weights again each tick. Hundreds of rows are
divided among threads, each with a product of its own. On other devices the batch runs whole, without that promise.
"""

from __future__ import annotations

import functools
import io
import itertools
import threading
import warnings
import weakref
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import onnxruntime
import torch

from arena_newton.errors import InputError
from arena_newton.trackers.inference.stored_graphs import graph_file, read_graph, write_graph

__all__ = ["BlockRunner", "compiled"]

_BLOCK_SIZES = (1, 2, 4)
"""Block sizes tried, in this order."""
_COUNTS = (2, 3, 5, 8, 13, 20, 32)
"""Products of so many blocks must give a block's bits before a network may run as one product of any size: ONNX
Runtime's kernels take up to 12 rows at a time (AVX-512), and these counts leave different remainders."""
_ROWS_PER_THREAD = 128
"""Fewest rows that are worth a thread."""
_PROBE_SEED = 20240

Network = Callable[[torch.Tensor], torch.Tensor]


def session_options(threads: int = 1) -> onnxruntime.SessionOptions:
    """Options of a session on some threads that does not write to the screen.

    Several threads that share a product wait for each other's parts without sleeping, and no longer than it takes.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.add_session_config_entry("session.intra_op.allow_spinning", str(int(threads > 1)))
    options.add_session_config_entry("session.force_spinning_stop", "1")
    options.log_severity_level = 4
    return options


class OnnxProduct:
    """A network in ONNX Runtime: rows in, rows out."""

    def __init__(self, graph: bytes, threads: int = 1):
        """Take a file with one input, `obs`, and one output, `action`; its session begins when it is first needed."""
        self._graph, self._threads = graph, threads
        self._others: dict[int, OnnxProduct] = {}
        self._begun: onnxruntime.InferenceSession | None = None
        self._beginning = threading.Lock()

    @property
    def _session(self) -> onnxruntime.InferenceSession:
        with self._beginning:
            if self._begun is None:
                self._begun = onnxruntime.InferenceSession(
                    self._graph, session_options(self._threads), providers=["CPUExecutionProvider"]
                )
            return self._begun

    def on(self, threads: int) -> OnnxProduct:
        """The network on a number of threads, which changes no bit; each number holds the weights once more."""
        if threads == self._threads:
            return self
        if threads not in self._others:
            self._others[threads] = OnnxProduct(self._graph, threads)
        return self._others[threads]

    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        """Outputs of any number of rows; a new tensor."""
        return torch.from_numpy(self._session.run(None, {"obs": rows.numpy()})[0])

    def bound(self, rows: torch.Tensor) -> Callable[[], torch.Tensor]:
        """A call without arguments for rows that stay in one place; each writes the same tensor again."""
        result = self(rows)
        given, made = rows.numpy(), result.numpy()
        binding = self._session.io_binding()
        binding.bind_input("obs", "cpu", 0, given.dtype.type, given.shape, given.ctypes.data)
        binding.bind_output("action", "cpu", 0, made.dtype.type, made.shape, made.ctypes.data)

        def call(_held: object = given) -> torch.Tensor:  # the binding knows only where the rows are
            self._session.run_with_iobinding(binding)
            return result

        return call


def compiled(network: torch.nn.Module, shape: tuple[int, ...], rtol: float = 1e-4, atol: float = 1e-5) -> OnnxProduct:
    """The network in ONNX Runtime, on one thread of the CPU; its graph is stored in the kernel cache.

    A graph is compared with torch before it is stored, by the libraries and processor's instructions in its name.

    Args:
        network: Maps a tensor to a tensor, rows first.
        shape: Of an input; any number of rows may be given later.
        rtol: Relative difference from what torch computes that is allowed.
        atol: Absolute one.

    Raises:
        InputError: It cannot be exported, or ONNX Runtime computes something else.
    """
    path = graph_file(network.eval(), shape)
    if (known := read_graph(path)) is not None:
        return OnnxProduct(known)
    probe = torch.randn(shape, generator=torch.Generator().manual_seed(8))
    try:
        graph = _exported_graph(network, probe)
        run = OnnxProduct(graph)
        with torch.no_grad():
            torch.testing.assert_close(run(probe), network(probe), rtol=rtol, atol=atol)
    except Exception as error:  # exporter and runtime raise classes of their own
        reason = " ".join(str(error).split())[:160]
        raise InputError(f"the network cannot run in ONNX Runtime ({type(error).__name__}: {reason})") from error
    write_graph(path, graph)
    return run


def _exported_graph(network: torch.nn.Module, probe: torch.Tensor) -> bytes:
    file: Any = io.BytesIO()  # the exporter takes buffers, its types do not say so
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        # The exporter is deprecated. Its successor (dynamo=True) gives the same bits, but takes 8 s instead of
        # 0.3 s the first time in a process, 1.3 s instead of 0.05 s later, and fails to optimise `Symmetric`.
        torch.onnx.export(
            network, (probe,), file, dynamo=False, input_names=["obs"], output_names=["action"],
            dynamic_axes={"obs": {0: "rows"}, "action": {0: "rows"}},
        )  # fmt: skip
    graph: bytes = file.getvalue()
    return graph


@dataclass
class _Exported:
    """A network in ONNX Runtime, and its plan once that was asked for."""

    numbers: int
    """Checksum of the weights that were exported."""
    product: Network
    plan: tuple[int, bool] | None = None


_EXPORTED: weakref.WeakKeyDictionary[torch.nn.Module, _Exported] = weakref.WeakKeyDictionary()
"""Networks as they were exported last: one that is bound again runs as before, unless its weights have changed."""


def _exported(network: torch.nn.Module, width: int) -> _Exported:
    numbers = 0
    for tensor in itertools.chain(network.parameters(), network.buffers()):
        numbers = zlib.crc32(tensor.detach().reshape(-1).view(torch.uint8).numpy(), numbers)
    known = _EXPORTED.get(network)
    if known is None or known.numbers != numbers:
        known = _EXPORTED[network] = _Exported(numbers, compiled(network, (8, width)))
    return known


class BlockRunner:
    """Runs a network on `worlds` rows with results that are bit-identical for any number and order of rows (CPU).

    Write observations into `input`, call `run`.
    """

    input: torch.Tensor
    """Observations, float32, shape [worlds, in_width]; a view of the padded buffer."""

    def __init__(self, network: torch.nn.Module, in_width: int, worlds: int, device: torch.device | str = "cpu"):
        """Allocate the padded buffer.

        Args:
            network: Maps [rows, in_width] to [rows, out_width], each row by itself. On the CPU it is exported to ONNX
                Runtime, unless one of its modules is `on_host`, a session already.
            worlds: Rows that the caller fills.
        """
        self.network = network
        self.worlds = worlds
        self.device = torch.device(device)
        on_host = any(getattr(module, "on_host", False) for module in network.modules())
        self.fixed = self.device.type == "cpu"
        """True if rows have the same bits in any batch."""
        self.path = "onnxruntime" if self.fixed or on_host else "torch"
        """Library that runs the network: `onnxruntime` or `torch`."""
        padding = max(_BLOCK_SIZES) if self.fixed else 1
        self._buffer = torch.zeros(-(-worlds // padding) * padding, in_width, device=self.device)
        self.input = self._buffer[:worlds]
        self._exported = _Exported(0, torch.inference_mode()(network)) if on_host or not self.fixed else None
        self._planned: Callable[[], torch.Tensor] | None = None
        threads = min(torch.get_num_threads(), worlds // _ROWS_PER_THREAD)
        self._pool = ThreadPoolExecutor(threads) if self.fixed and threads > 1 else None
        self._threads = threads

    def run(self) -> torch.Tensor:
        """Outputs of the rows in `input`, shape [worlds, out_width]; the next run may write them again.

        Raises:
            InputError: On the first call, if ONNX Runtime cannot run the network.
        """
        if self._planned is None:
            self._planned = self._as_planned() if self.fixed else torch.inference_mode()(self._whole)
        return self._planned()

    def _whole(self) -> torch.Tensor:
        return self.network(self.input)

    def _as_planned(self) -> Callable[[], torch.Tensor]:
        """A run with everything that is the same each time done beforehand."""
        product, worlds = self._compile().product, self.worlds
        block, merged = self.plan()
        rows = self._buffer[: -(-worlds // block) * block]
        if not merged:
            parts = rows.split(block)
            return lambda: torch.cat([product(part.clone()) for part in parts])[:worlds]
        if (pool := self._pool) is not None:
            parts = rows.split(-(-len(rows) // (block * self._threads)) * block)
            return lambda: torch.cat(list(pool.map(product, parts)))[:worlds]
        run = product.bound(rows) if isinstance(product, OnnxProduct) else functools.partial(product, rows)
        return run if len(rows) == worlds else lambda: run()[:worlds]

    def _compile(self) -> _Exported:
        if self._exported is None:
            self._exported = _exported(self.network, self._buffer.shape[1])
        return self._exported

    @torch.inference_mode()
    def plan(self) -> tuple[int, bool]:
        """Block size, and whether all blocks may run as one product; the same for every number of worlds."""
        exported = self._compile()
        if exported.plan is None:
            generator = torch.Generator().manual_seed(_PROBE_SEED)
            width = self._buffer.shape[1]
            kept = (block for block in _BLOCK_SIZES if _keeps_bits(exported.product, block, width, generator))
            block = next(kept, None)
            exported.plan = (1, False) if block is None else (block, True)
        return exported.plan


def _keeps_bits(product: Network, block: int, width: int, generator: torch.Generator) -> bool:
    """True if a row has the same bits in either position of a block, and a block the same bits among any others."""
    rows = torch.randn(block * max(_COUNTS), width, generator=generator)
    blocks = rows.split(block)
    expected = torch.cat([product(part.clone()) for part in blocks])
    turned = torch.cat([torch.roll(product(torch.roll(part, 1, 0)), -1, 0) for part in blocks])
    whole = (torch.equal(product(rows[: n * block].clone()), expected[: n * block]) for n in _COUNTS)
    return torch.equal(turned, expected) and all(whole)
