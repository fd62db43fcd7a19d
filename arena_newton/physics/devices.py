"""Engine and device of a run, chosen while it is planned: Warp is loaded only where a GPU may be."""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.cli.quiet import quiet_warp
from arena_newton.errors import InputError

if TYPE_CHECKING:
    import torch

__all__ = ["cluster_engine", "drawing_threads", "resolve_engine", "torch_device", "torch_threads", "visible_gpus"]

ALONE = 60_000
"""Most pixels that one thread draws alone [px]."""
NVIDIA_DEVICES = Path("/proc/driver/nvidia/gpus")
"""Folder with an entry per GPU that the driver of this machine knows."""
DRIVERS = ("libcuda.so", "libcuda.so.1")
"""Names by which Warp loads NVIDIA's driver; without it there is no GPU, and Warp need not be asked."""
LIST_GPUS = ("nvidia-smi", "--list-gpus")
"""Program of the driver that lists them, a line for each."""
LIST_TIMEOUT = 60.0
"""Time after which its answer is no longer waited for [s]."""


def resolve_engine(engine: str, device: str | None) -> tuple[str, str]:
    """Engine and device for `auto`, checked against what this machine has.

    Raises:
        InputError: Unknown engine, or a device that this machine does not have.
    """
    if engine not in {"auto", "mujoco", "warp"}:
        raise InputError(f"--engine {engine}: unknown, choose auto, mujoco or warp")
    if device == "cpu" or (engine == "mujoco" and device is None):
        return ("warp" if engine == "warp" else "mujoco"), "cpu"
    if device is not None and not device.startswith("cuda"):
        raise InputError(f"--device {device}: unknown, choose cpu, cuda or cuda:N")
    cuda = False
    if any(map(_loads, DRIVERS)):
        import warp as wp

        quiet_warp()
        cuda = wp.is_cuda_available()
    if device is not None:
        if not cuda:
            raise InputError(f"--device {device}: no CUDA device on this machine, use --device cpu")
        if device != "cuda" and device not in {d.alias for d in wp.get_cuda_devices()}:
            raise InputError(f"--device {device}: no such device, this machine has {wp.get_cuda_device_count()}")
        if engine == "mujoco":
            raise InputError(f"--device {device}: engine mujoco runs on the CPU, use --engine warp for CUDA")
    if engine == "auto":
        engine = "warp" if cuda else "mujoco"
    return engine, device or ("cuda:0" if cuda else "cpu")


def torch_device(name: str | None) -> torch.device:
    """Torch device for None or `auto`, the best there is, or for a name; each process of torchrun has its own GPU.

    Raises:
        InputError: This machine does not have it.
    """
    import torch

    gpus = torch.cuda.device_count()
    wanted = ("cuda" if gpus else "cpu") if name in (None, "auto") else name
    if wanted == "cpu":
        return torch.device("cpu")
    found = re.fullmatch(r"cuda(?::(\d+))?", str(wanted))
    if found is None:
        raise InputError(f"--device {name}: unknown, choose cpu, cuda or cuda:N")
    own = os.environ.get("LOCAL_RANK", "0") if int(os.environ.get("WORLD_SIZE", "1")) > 1 else found[1]
    if int(own or 0) >= gpus:
        raise InputError(f"--device {name}: no such device, this machine has {gpus} for CUDA")
    return torch.device("cuda", int(own or 0))


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Give torch so many threads, in this thread and in those that begin meanwhile; what it had before returns."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def drawing_threads(pixels: int) -> int:
    """Threads that draw so many pixels on the CPU: those of torch, or one where starting others takes longer."""
    import torch

    return torch.get_num_threads() if pixels > ALONE else 1


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def cluster_engine(engine: str, device: str | None, gpus: float | None) -> tuple[str, str]:
    """Engine and device of processes of a cluster, which each see the GPUs that it gave them; Warp is not loaded.

    Args:
        engine: `auto`: warp where GPUs are asked for, or where this machine has one.
        device: The number of a GPU is of no account.
        gpus: GPUs of each process; None: the user leaves it open.

    Raises:
        InputError: Unknown engine or device.
    """
    resolve_engine(engine, "cpu")
    cuda = device is not None and device.startswith("cuda")
    if not cuda and device not in (None, "cpu"):
        raise InputError(f"--device {device}: unknown, choose cpu, cuda or cuda:N")
    if engine == "mujoco" and (cuda or gpus):
        given = f"--device {device}" if cuda else f"--ray-gpus {gpus:g}"
        raise InputError(f"{given}: engine mujoco runs on the CPU, use --engine warp for CUDA")
    if device == "cpu" and gpus:
        raise InputError(f"--ray-gpus {gpus:g}: contradicts --device cpu")
    if cuda or gpus or (device is None and (engine == "warp" or (engine == "auto" and visible_gpus()))):
        return "warp", "cuda:0"
    return ("warp" if engine == "warp" else "mujoco"), "cpu"


def visible_gpus() -> list[str]:
    """GPUs of this machine that this process may use, as `CUDA_VISIBLE_DEVICES` names them; Warp is not loaded.

    A virtual machine or container may lack the driver's folder: its programs, and then torch, are asked there.
    """
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        return list(itertools.takewhile(lambda name: name not in ("", "-1"), map(str.strip, named.split(","))))
    count = sum(1 for _ in NVIDIA_DEVICES.iterdir()) if NVIDIA_DEVICES.is_dir() else 0
    if not count and any(map(_loads, DRIVERS)):
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            listed = subprocess.run(LIST_GPUS, capture_output=True, text=True, check=True, timeout=LIST_TIMEOUT)
            count = sum(line.startswith("GPU ") for line in listed.stdout.splitlines())
        if not count:
            import torch

            count = torch.cuda.device_count()
    return list(map(str, range(count)))
