"""Programs of this package that run as processes are of this package, not of another version of it."""

import subprocess
import sys

import arena_newton
from arena_newton.files.own_processes import environment


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
