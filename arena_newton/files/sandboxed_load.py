"""Try in a separate process first what may take this one down: files of compiled readers, libraries that may not load.

A damaged binary layer can make USD allocate any amount of memory or run forever, and so can a network in
onnxruntime. A library whose shared libraries are absent may leave half of itself behind. Here each is tried once by a
process with limited memory and time, which may crash.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

__all__ = ["faults"]

CRASHED = "it crashes its reader or takes too much memory"
TOO_LONG = "it takes too long to read"
_KINDS = ("crate", "network", "module")


def faults(kind: str, paths: Sequence[str], *, memory: int, seconds: float) -> list[str | None]:
    """Try to open files or import modules: None for each that can be, otherwise its reader's message.

    Args:
        kind: `crate` for USD layers, `network` for ONNX files (path, a tab, the width of the input), `module` for
            Python modules that are imported.
        paths: The files, or the modules' names.
        memory: Memory that each may take in addition to the library itself [bytes].
        seconds: Time that each may take [s].
    """
    child = [sys.executable, "-P", str(Path(__file__)), kind, str(memory), str(seconds)]
    # One thread, since each file is opened by a fork.
    environment = os.environ | {"PXR_WORK_THREAD_LIMIT": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        child,
        input="\n".join(paths),
        capture_output=True,
        text=True,
        env=environment,
        timeout=60 + seconds * len(paths),
    )
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    return answers + [CRASHED] * (len(paths) - len(answers))


def _crate(path: str) -> None:
    from pxr import Sdf

    layer = Sdf.Layer.OpenAsAnonymous(path)

    def visit(at: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(at)
        if isinstance(spec, Sdf.AttributeSpec):
            for _ in (spec.default, *(layer.QueryTimeSample(at, t) for t in layer.ListTimeSamplesForPath(at))):
                pass
        elif spec is not None:
            for key in spec.ListInfoKeys():
                spec.GetInfo(key)

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)


def _network(given: str) -> None:
    import numpy as np
    import onnxruntime

    path, width = given.split("\t")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    first, *others = session.get_inputs()
    rows = first.shape[0] if isinstance(first.shape[0], int) else 2
    fed: dict[str, np.ndarray] = {first.name: np.zeros((rows, int(width)), np.float32)}
    kinds = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(int32)": np.int32}
    for other in others:  # such as a time step
        shape = [n if isinstance(n, int) else rows for n in other.shape]
        if np.prod(shape) > 1_000_000:
            raise ValueError(f"its input {other.name} takes {shape} numbers")
        fed[other.name] = np.zeros(shape, kinds.get(other.type, np.int64))
    session.run(None, fed)


def _module(name: str) -> None:
    import importlib

    importlib.import_module(name)


def _limited(work: Callable[[str], None], path: str, memory: int, seconds: float) -> str | None:
    """The answer for one file, which a fork opens."""
    import resource
    import signal

    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            with open("/proc/self/status", encoding="ascii") as status:
                held = next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmData:"))
            resource.setrlimit(resource.RLIMIT_DATA, (held + memory, held + memory))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            signal.setitimer(signal.ITIMER_REAL, seconds)
            work(path)
        except BaseException as error:
            full = isinstance(error, MemoryError) or "bad_alloc" in str(error) or "length_error" in str(error)
            text = CRASHED if full else str(error) or type(error).__name__
            os.write(writing, text.encode("utf-8", "backslashreplace")[:2000])
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        text = pipe.read().decode("utf-8", "backslashreplace")
    ended = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(ended):
        return TOO_LONG if os.WTERMSIG(ended) == signal.SIGALRM else CRASHED
    return text or None


def _main() -> None:
    kind, memory, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    work = (_crate, _network, _module)[_KINDS.index(kind)]
    if kind == "crate":
        from pxr import Sdf

        Sdf.Layer.CreateAnonymous(".usdc")  # loads the plugins once, before the forks
    elif kind == "network":
        import onnxruntime  # noqa: F401
    errors = os.dup(2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    for path in sys.stdin.read().split("\n"):
        print(json.dumps(_limited(work, path, memory, seconds)), flush=True)
    os.close(errors)


if __name__ == "__main__":
    _main()
