"""`torch.compile` of a policy's networks: asked for before anything that takes time, refused with one clear error."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
from collections.abc import Iterator, Mapping

import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.policies.train.families.policy_model import TrainableModel

__all__ = ["check_compiler", "compile_networks", "compiler_errors", "uncompiled"]

CPP_COMPILERS = ("g++", "clang++")
"""Those that torch's compiler looks for where the variable CXX names none."""
C_COMPILERS = ("gcc", "clang")
"""Those that Triton, which builds its launchers with one, looks for where CC names none."""

OPTIONS: Mapping[str, bool] = {"triton.mix_order_reduction": False}
"""Options of the compiler. That reduction gives torch 2.10 to 2.13 gradients of biases and norms that are wrong without
an error (pytorch issue 193061): on H100s eleven of fourteen compiled networks of recipe `compact` at batch 128 had a
gradient a thousand times too large, and learned nothing."""


def check_compiler(device: torch.device) -> None:
    """Make sure that networks can be compiled for a device.

    Raises:
        InputError: A program or library is missing.
    """
    on_cuda = device.type == "cuda"
    variable, names, package = ("CC", C_COMPILERS, "gcc") if on_cuda else ("CXX", CPP_COMPILERS, "g++")
    chosen = os.environ.get(variable)
    if not any(shutil.which(name) for name in ((chosen,) if chosen else names)):
        raise InputError(
            f"--compile: needs a compiler, {chosen or ' or '.join(names)} is not there "
            f"(Debian: apt-get install {package}; the variable {variable} may name another)"
        )
    if on_cuda and importlib.util.find_spec("triton") is None:
        raise InputError("--compile: needs Triton, which is not installed: pip install triton")


def compile_networks(model: TrainableModel) -> None:
    """Have a model's networks compiled, in place, when they first compute; names of their tensors stay as they are.

    Raises:
        InputError: The family cannot be compiled.
    """
    if not model.compilable:
        raise InputError(f"--compile: {model.recipe.family} cannot be compiled, its network is not free of the host")
    for part in model.compiled_parts():
        # One size: that of a training's batch. Another one is computed by `uncompiled`.
        part.compile(dynamic=False, options=dict(OPTIONS))


@contextlib.contextmanager
def compiler_errors() -> Iterator[None]:
    """Say in one line what a compiler could not do.

    Raises:
        ArenaError: It failed.
    """
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, torch._dynamo.exc.TorchDynamoException):
            raise
        reason = " ".join(str(error).split())[:300]
        raise ArenaError(f"--compile: the network could not be compiled; train without it ({reason})") from error


def uncompiled() -> contextlib.AbstractContextManager[None]:
    """Context in which compiled networks compute as if they were not, for batches of another size."""
    return torch.compiler.set_stance("force_eager")
