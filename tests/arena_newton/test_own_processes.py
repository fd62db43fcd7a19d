"""Programs of this package that run as processes are of this package, not of another version of it."""

import subprocess
import sys
import threading

import arena_newton
from arena_newton.files.own_processes import environment, how_it_ended


def test_a_process_finds_this_package(tmp_path, monkeypatch):
    """A process imports the version that started it, from any folder, though another one is installed too."""
    other = tmp_path / "arena_newton"
    other.mkdir()
    (other / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    code = "import arena_newton; print(arena_newton.__file__)"
    command = [sys.executable, "-P", "-c", code]
    found = subprocess.run(command, env=environment(), cwd=tmp_path, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == arena_newton.__file__


def test_how_a_process_ended():
    """The signal of a process that ends slowly is waited for; one that only closed its output has no exit code."""
    code = "import os, time; os.close(1); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert not process.stdout.read()
        assert how_it_ended(process, 0.05) == "it closed its output"
        threading.Timer(0.3, process.kill).start()
        assert how_it_ended(process, 60.0) == "SIGKILL; out of memory?"
