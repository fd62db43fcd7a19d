"""ONNX networks that `onnx_mlp` cannot turn into torch: they run in onnxruntime, on the CPU.

The official SONIC encoder rounds its latent and chooses among encoders; such graphs keep their own runtime. Rows come
from and go to the torch device, so on a GPU this path waits for the device every tick: correct, not fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from arena_newton import limits, probe
from arena_newton.errors import InputError
from arena_newton.foreign import check_size
from arena_newton.trackers.inference import onnx_mlp

__all__ = ["OnnxSession", "load_any"]

_PROBE_ROWS = 2


class OnnxSession(torch.nn.Module):
    """One network in onnxruntime: [rows, in_width] to [rows, out_width], float32."""

    on_host = True
    """It computes on the CPU whatever the device of its rows: no CUDA graph can hold it."""

    def __init__(self, path: str | Path, *, in_width: int, out_width: int, flag: str = "--checkpoint"):
        """Open the file.

        Args:
            path: The file.
            in_width: Observation width that the caller needs.
            out_width: Output width that the caller needs.
            flag: Command-line flag that errors name.

        Raises:
            InputError: onnxruntime cannot run the file, or it has other widths.
        """
        super().__init__()
        import onnxruntime

        where = f"{flag} {path}"
        check_size(path, limits.NETWORK_BYTES, where=where)
        # Its compiled reader takes a file on trust, and some operators make any number of numbers of none.
        (fault,) = probe.faults(
            "network", [f"{path}\t{in_width}"], memory=limits.NETWORK_MEMORY, seconds=limits.NETWORK_SECONDS
        )
        if fault:
            raise InputError(f"{where}: not a usable ONNX file ({' '.join(fault.split())[:160]})")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            self._session: Any = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
            if len(inputs) != 1:
                raise InputError(f"{where}: the network has {len(inputs)} inputs, expected one")
            width = inputs[0].shape[-1]
            if isinstance(width, int) and width != in_width:
                raise InputError(f"{where}: the network takes {width} numbers, expected {in_width}")
            self._input, self._output = inputs[0].name, outputs[0].name
            self._rows = inputs[0].shape[0] if isinstance(inputs[0].shape[0], int) else 0
            got = self._run(np.zeros((_PROBE_ROWS * (self._rows or 1), in_width), np.float32))
        except InputError:
            raise
        except Exception as error:  # onnxruntime raises classes of its own
            reason = " ".join(str(error).split())[:160]
            raise InputError(f"{where}: not a usable ONNX file ({type(error).__name__}: {reason})") from error
        if got.ndim != 2 or got.shape[1] != out_width:
            raise InputError(f"{where}: the network gives shape {list(got.shape)}, expected {out_width} numbers a row")

    def _run(self, rows: np.ndarray) -> np.ndarray:
        """All rows, in pieces of the size that the file fixes, if it fixes one."""
        if not self._rows:
            return self._session.run([self._output], {self._input: rows})[0]
        padded = np.concatenate([rows, np.zeros((-len(rows) % self._rows, rows.shape[1]), np.float32)])
        pieces = np.split(padded, len(padded) // self._rows)
        return np.concatenate([self._session.run([self._output], {self._input: p})[0] for p in pieces])[: len(rows)]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Outputs of all rows, shape [rows, out_width], on the device of `x`."""
        if torch.jit.is_tracing():
            raise RuntimeError("a session of onnxruntime cannot be traced")
        return torch.from_numpy(self._run(np.ascontiguousarray(x.cpu().numpy()))).to(x.device)


def load_any(path: str | Path, *, in_width: int, out_width: int, flag: str = "--checkpoint") -> torch.nn.Module:
    """A network as torch modules where they suffice, in onnxruntime otherwise.

    Args:
        path: The file.
        in_width: Observation width that the caller needs.
        out_width: Output width that the caller needs.
        flag: Command-line flag that errors name.

    Raises:
        InputError: Neither can run the file, or it has other widths.
    """
    try:
        return onnx_mlp.load(path, in_width=in_width, out_width=out_width, flag=flag)
    except InputError as error:
        try:
            return OnnxSession(path, in_width=in_width, out_width=out_width, flag=flag)
        except InputError:
            raise error from None
