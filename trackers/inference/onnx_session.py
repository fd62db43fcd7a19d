"""Networks of ONNX files: ONNX Runtime runs them on the CPU; on a GPU torch modules do where `onnx_mlp` can read them.

The official SONIC encoder rounds its latent and chooses among encoders. Such graphs stay in ONNX Runtime: rows come
from and go to the torch device, so on a GPU a tick waits for the device: correct, not fast.
"""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from arena_newton.errors import InputError
from arena_newton.files import limits, sandboxed_load
from arena_newton.trackers.inference.blocks import session_options

__all__ = ["OnnxSession"]

_PROBE_ROWS = 2


class OnnxSession(torch.nn.Module):
    """One network in ONNX Runtime: [rows, in_width] to [rows, out_width], float32."""

    twin: torch.nn.Module | None
    """The same network as torch modules, after `convert`."""

    def __init__(self, path: str | Path, *, in_width: int, out_width: int, flag: str = "--checkpoint"):
        """Open a file that must have these widths; errors name the command line's `flag`.

        Raises:
            InputError: ONNX Runtime cannot run the file, or it has other widths.
        """
        from arena_newton.trackers.inference import onnx_mlp  # ONNX, which trackers of safetensors do without

        super().__init__()
        where = f"{flag} {path}"
        self.path, self.in_width, self.out_width, self.twin = Path(path), in_width, out_width, None
        _, runnable, data = onnx_mlp.read(path, in_width=in_width, flag=flag)
        self.sha256 = hashlib.sha256(data).hexdigest()
        # Its compiled reader takes a file on trust, and some operators make any number of numbers of none.
        (fault,) = sandboxed_load.faults(
            "network", [f"{path}\t{in_width}"], memory=limits.NETWORK_MEMORY, seconds=limits.NETWORK_SECONDS
        )
        if fault:
            raise InputError(f"{where}: not a usable ONNX file ({' '.join(fault.split())[:160]})")
        try:
            self._session = onnxruntime.InferenceSession(
                runnable, session_options(), providers=["CPUExecutionProvider"]
            )
            inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
            if len(inputs) != 1:
                raise InputError(f"{where}: the network has {len(inputs)} inputs, expected one")
            self._input, self._output = inputs[0].name, outputs[0].name
            self._rows = inputs[0].shape[0] if isinstance(inputs[0].shape[0], int) else 0
            got = self._run(np.zeros((_PROBE_ROWS * (self._rows or 1), in_width), np.float32))
        except InputError:
            raise
        except Exception as error:  # onnxruntime raises classes of its own
            reason = " ".join(str(error).split())[:160]
            raise InputError(f"{where}: not a usable ONNX file ({type(error).__name__}: {reason})") from error
        if got.ndim != 2:
            raise InputError(f"{where}: the network gives shape {list(got.shape)}, not {out_width} numbers per row")
        if got.shape[1] != out_width:
            raise InputError(f"{where}: the network gives {got.shape[1]} numbers, expected {out_width}")

    @property
    def on_host(self) -> bool:
        """True if it computes on the CPU whatever the device of its rows: no CUDA graph can hold it then."""
        return self.twin is None

    def convert(self, device: torch.device) -> None:
        """Let torch modules run the rows of a GPU, where `onnx_mlp` can read the file; undo it for the CPU."""
        self.twin = None
        if device.type != "cpu":
            with contextlib.suppress(InputError):
                self.twin = self.as_torch()

    def as_torch(self) -> torch.nn.Module:
        """The network as torch modules, float32, on the CPU.

        Raises:
            InputError: `onnx_mlp` cannot read the file.
        """
        from arena_newton.trackers.inference import onnx_mlp

        return onnx_mlp.load(self.path, in_width=self.in_width, out_width=self.out_width)

    def _run(self, rows: np.ndarray) -> np.ndarray:
        """All rows, in parts of the size that the file fixes, if it fixes one."""
        if not self._rows:
            return self._session.run([self._output], {self._input: rows})[0]
        padded = np.concatenate([rows, np.zeros((-len(rows) % self._rows, rows.shape[1]), np.float32)])
        parts = np.split(padded, len(padded) // self._rows)
        return np.concatenate([self._session.run([self._output], {self._input: p})[0] for p in parts])[: len(rows)]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Outputs of all rows, shape [rows, out_width], on the device of `x`."""
        if self.twin is not None:
            return self.twin(x)
        return torch.from_numpy(self._run(x.cpu().numpy())).to(x.device)
