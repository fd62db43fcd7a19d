"""Processes that a test kills or interrupts, forked from one that has imported the world: none imports it again."""

import importlib
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import types
from multiprocessing import forkserver, resource_tracker, util
from pathlib import Path

_WORLD = ["arena_newton.eval.play.run", "arena_newton.eval.suites.suite_run"]
_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(_WORLD)


def fork_server():
    """Fork the server off this process, unless that has not imported the world, which takes 11 s, or holds a GPU."""
    if not {*_WORLD} <= {*sys.modules} or sys.modules["warp"].is_cuda_available():
        return
    start = util.spawnv_passfds

    def fork(_, __, files):
        pid = os.fork()
        if pid == 0:
            try:
                nothing = os.open(os.devnull, os.O_RDWR)
                for file in {int(name) for name in os.listdir("/proc/self/fd")} - {1, 2, nothing, *files}:
                    os.dup2(nothing, file)  # whoever reads at their other ends sees this process's end alone
                forkserver.main(*files, [])
            finally:
                os._exit(0)
        return pid

    resource_tracker.ensure_running()
    util.spawnv_passfds = fork
    try:
        forkserver.ensure_running()
    finally:
        util.spawnv_passfds = start


class Child:
    """A command line in a process of its own; what it prints is kept. Its methods are those of `subprocess.Popen`."""

    def __init__(self, module, arguments, **variables):
        """Call `main` of a module, or the function after its colon, under these variables besides this process's."""
        self._printed = tempfile.TemporaryDirectory()
        streams = [str(Path(self._printed.name, name)) for name in ("out", "err")]
        for stream in streams:
            Path(stream).touch()
        given = {"GIVEN": (module, [*arguments], os.environ | variables, streams)}
        # By its file: the name `tests` is none, or another package's, in a process that pytest did not start.
        self._process = _SERVER.Process(target=runpy.run_path, args=(__file__, given, "child"), daemon=True)
        self._process.start()
        self.pid = self._process.pid

    @property
    def returncode(self):
        """Exit code, the negative signal that ended it, or None."""
        return self._process.exitcode

    def poll(self):
        """Exit code, None while it runs."""
        return self.returncode

    def wait(self, timeout=None):
        """Exit code, once it has ended."""
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return self.returncode

    def communicate(self, timeout=None):
        """All that it printed, and its complaints, once it has ended."""
        self.wait(timeout)
        return self.printed()

    def lines(self, count):
        """First lines, as many as wanted, or all that it printed before it ended."""
        while self.returncode is None and self.printed()[0].count("\n") < count:
            time.sleep(0.02)
        return self.printed()[0].splitlines()

    def printed(self):
        """Text that it has printed so far, and its complaints."""
        return tuple(Path(self._printed.name, name).read_bytes().decode() for name in ("out", "err"))

    def send_signal(self, number):
        """Send a signal, unless it has ended."""
        if self.returncode is None:
            os.kill(self.pid, number)

    def kill(self):
        """`kill -9`."""
        self.send_signal(signal.SIGKILL)


def _play(module, arguments, variables, streams):
    """The process's work."""
    os.environ.clear()
    os.environ.update(variables)
    for number, (name, path) in enumerate(zip(("stdout", "stderr"), streams, strict=True), start=1):
        file = os.open(path, os.O_WRONLY)
        os.dup2(file, number)
        os.close(file)
        setattr(sys, name, open(number, "w", buffering=1, closefd=False))
    sys.argv = [module, *arguments]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.modules["tests"] = tests = types.ModuleType("tests")
    tests.__path__ = [str(Path(__file__).parent)]
    module, _, function = module.partition(":")
    sys.exit(getattr(importlib.import_module(module), function or "main")(arguments))


if __name__ == "child":
    _play(*globals()["GIVEN"])
