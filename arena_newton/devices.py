"""Which engine and device a run gets; asked while it is planned, so Warp is loaded only where a GPU is looked for."""

from arena_newton.errors import InputError
from arena_newton.quiet import quiet_warp

__all__ = ["resolve_engine"]


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
