"""GPUs of a machine: the driver's folder, then its program, then torch; the latter two only where a driver loads."""

import sys

import pytest

from arena_newton.physics import devices

LISTED = "GPU 0: NVIDIA H100 (UUID: GPU-1)\n  MIG 1g.10gb Device 0: (UUID: MIG-1)\nGPU 1: NVIDIA H100 (UUID: GPU-2)\n"


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """A machine with a driver whose folder is absent; what its program prints, and torch's count, are given."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(devices, "NVIDIA_DEVICES", tmp_path / "gpus")
    monkeypatch.setattr(devices, "DRIVERS", ("libc.so.6",))  # one that loads

    def made(listed: str | None, torch_finds: int = 0):
        program = (sys.executable, "-c", f"print({listed!r}, end='')") if listed else (str(tmp_path / "absent"),)
        monkeypatch.setattr(devices, "LIST_GPUS", program)
        monkeypatch.setattr("torch.cuda.device_count", lambda: torch_finds)
        return tmp_path / "gpus"

    return made


def test_the_driver_is_asked_where_its_folder_is_absent(machine, monkeypatch):
    """Cards count, not their parts; the variable and the folder come first, and without a driver nothing is asked."""
    folder = machine(LISTED, torch_finds=7)
    assert devices.visible_gpus() == ["0", "1"]
    folder.mkdir()
    assert devices.visible_gpus() == ["0", "1"]  # an empty one
    for name in "abc":
        (folder / name).mkdir()
    assert devices.visible_gpus() == ["0", "1", "2"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    assert devices.visible_gpus() == ["1"]
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setattr(devices, "NVIDIA_DEVICES", folder / "none")
    monkeypatch.setattr(devices, "DRIVERS", ("libabsent.so",))
    assert devices.visible_gpus() == []


def test_torch_is_asked_where_the_program_is_absent(machine, monkeypatch):
    """The same where it fails, or lists nothing."""
    machine(None, torch_finds=2)
    assert devices.visible_gpus() == ["0", "1"]
    monkeypatch.setattr(devices, "LIST_GPUS", (sys.executable, "-c", "raise SystemExit(9)"))
    assert devices.visible_gpus() == ["0", "1"]
    machine("No devices found.\n", torch_finds=0)
    assert devices.visible_gpus() == []
