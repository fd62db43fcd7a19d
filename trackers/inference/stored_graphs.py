"""ONNX graphs of networks in the kernel cache: an export of the packed policy takes 4 s of a core, a read 0.1 s."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import sys
from importlib.metadata import version
from pathlib import Path

import torch
import warp as wp

from arena_newton.files.own_files import PARTIAL, replace_atomically

__all__ = ["graph_file", "read_graph", "write_graph"]

MOST = 8
"""Graphs that are stored at most, those that were used last; one of the packed policy has 62 MB."""


def graph_file(network: torch.nn.Module, shape: tuple[int, ...]) -> Path | None:
    """File of the graph of a network for inputs of a shape; None before Warp has begun, which names its cache.

    Its name is a hash of everything that an export depends on: modules, their settings and sources, weights, shape, the
    libraries, and the processor's instructions, by which torch computes constants.
    """
    if not wp.config.kernel_cache_dir:
        return None
    found = hashlib.sha256()
    libraries = [version(name) for name in ("torch", "onnx", "onnxruntime")]
    found.update(repr((libraries, torch.backends.cpu.get_cpu_capability(), shape)).encode())
    sources = set()
    for name, module in network.named_modules():
        settings = {key: _plain(value) for key, value in vars(module).items() if not key.startswith("_")}
        found.update(repr((name, type(module).__qualname__, settings)).encode())
        sources |= {one.__module__ for one in type(module).__mro__ if not one.__module__.startswith("torch.")}
    for source in sorted(sources):
        file = getattr(sys.modules.get(source), "__file__", None)
        if file is not None and os.path.isfile(file):
            found.update(Path(file).read_bytes())
    for name, tensor in itertools.chain(network.named_parameters(), network.named_buffers()):
        found.update(repr((name, tensor.dtype, tensor.shape)).encode())
        found.update(tensor.detach().reshape(-1).view(torch.uint8).numpy().data)
    return Path(wp.config.kernel_cache_dir) / "onnx" / found.hexdigest()


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, torch.Tensor) else getattr(value, "__qualname__", value)


def read_graph(path: Path | None) -> bytes | None:
    """A stored graph; None where there is none that is whole and has this name."""
    with contextlib.suppress(OSError):
        if path is not None and path.is_file():
            content = path.read_bytes()
            if content[:32] == _digest(path, content[32:]):
                os.utime(path)
                return content[32:]
    return None


def write_graph(path: Path | None, graph: bytes) -> None:
    """Store a graph and remove those that were not used for longest; a cache that cannot be written stores none."""
    with contextlib.suppress(OSError):
        if path is not None:
            with replace_atomically(path) as file:
                file.write(_digest(path, graph) + graph)
            others = [one for one in path.parent.iterdir() if one.suffix != PARTIAL]
            for one in sorted(others, key=lambda one: one.stat().st_mtime, reverse=True)[MOST:]:
                one.unlink()


def _digest(path: Path, graph: bytes) -> bytes:
    return hashlib.sha256(path.name.encode() + graph).digest()
