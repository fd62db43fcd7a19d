"""``python -m arena_newton doctor``: what is installed, what it runs on, and what to do about what is missing."""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from arena_newton.cli.command_line import exit_code
from arena_newton.cli.extras import EXTRAS
from arena_newton.errors import InputError
from arena_newton.files.sandboxed_load import faults

__all__ = ["Finding", "examine", "examine_extras", "main", "versions"]

USAGE = """usage: arena-newton doctor
       arena-newton doctor --tracker NAME [--checkpoint PATH] [--stand]
       arena-newton doctor --policy SPEC [--task TASK]

Examines packages, extras, devices, engines, kernel cache, disk and scenes, and says what to do about what is missing.
With --tracker or --policy it tries what the interface promises on one of them, a package's own included; these are
short for `trackers check` and `policies check`. With --stand the tracker also stands, turns and walks for two seconds.
Exit code 0: a run can start, every promise is kept; 1: a problem must be solved first; 2: bad input."""
_REQUIRED = {
    "newton": "physics, scenes and cameras",
    "warp-lang": "kernels",
    "mujoco": "engine mujoco",
    "mujoco-warp": "engine warp",
    "torch": "trackers and policies",
    "usd-core": "scene files",
    "newton-usd-schemas": "scene files",
    "trimesh": "meshes",
    "numpy": "arithmetic",
    "onnx": "official tracker checkpoints",
    "tyro": "command line",
    "tqdm": "progress bar",
    "jinja2": "reports",
    "pillow": "textures and picture strips",
}
_OPTIONAL = {
    "lerobot": "LeRobot policies and datasets",
    "rsl-rl-lib": "tracker training",
    "opencv-python-headless": "image resizing of policies",
    "onnxruntime": "check of converted checkpoints",
    "av": "videos (--video)",
}
_EXTRA_PURPOSES = {
    "data": "datasets in LeRobot's format",
    "docs": "the pages as a site (`docs/build.py`)",
    "gr00t": "`--policy remote:gr00t://`",
    "plots": "charts, and maps of predicted actions",
    "policies": "policies of the families diffusion, flow and pi05",
    "ray": "`eval run --ray`: processes of a cluster",
    "rerun": "`--viewer rerun`",
    "serve": "a policy server; `--policy remote:` of a websocket",
    "teleop": "a person drives the robot; viewers of a run",
    "train": "LeRobot's trainer",
}
"""Extra → what it is for."""
_TORCHCODEC_MEMORY = 8 << 30
"""Memory that loading torchcodec may take beyond the interpreter's own [bytes]; it loads torch."""
_TORCHCODEC_TIME = 60.0
"""Time that it may take [s]; 3 s on an idle machine."""
_LONGEST = 120
"""Characters of its complaint that are shown, up to the end of a sentence."""
_INSTALL = "run `uv sync` in the checkout, or `pip install --upgrade arena-newton`"
_MIN_FREE_GIB = 2.0
"""Below this free space a run with videos or a cold kernel cache may end on a full disk [GiB]."""


@dataclass(frozen=True)
class Finding:
    """One line of the examination."""

    subject: str
    value: str
    status: str = "ok"
    """``ok``, ``note`` (works, but something is absent) or ``bad`` (a run fails)."""
    advice: str = ""
    """Advice to the user."""


def versions() -> dict[str, str | None]:
    """Installed versions by distribution name, without importing anything heavy; None for what is absent."""
    return dict(_versions())


@functools.cache
def _versions() -> dict[str, str | None]:
    """The same; a process keeps the libraries that it has, and looking takes as long as a short episode."""
    from arena_newton import __version__

    found: dict[str, str | None] = {"python": platform.python_version(), "arena-newton": __version__}
    for name in (*_REQUIRED, *_OPTIONAL):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def _packages() -> list[Finding]:
    found = versions()
    minor = sys.version_info[:2]
    advice = "" if minor == (3, 12) else "use Python 3.12, for instance `uv python install 3.12`"
    findings = [
        Finding("python", f"{found['python']} ({sys.executable})", "ok" if minor == (3, 12) else "bad", advice),
        Finding("arena-newton", str(found["arena-newton"])),
    ]
    for name, purpose in (_REQUIRED | _OPTIONAL).items():
        version, status = found[name], "bad" if name in _REQUIRED else "note"
        missing = Finding(name, "missing", status, f"needed for {purpose}: {_INSTALL}")
        findings.append(missing if version is None else Finding(name, version))
    return findings


def examine_extras() -> list[Finding]:
    """Check of the installed extras, and of the data extra's video reader."""
    findings = []
    for extra, modules in EXTRAS.items():
        absent = [module for module in modules if importlib.util.find_spec(module) is None]
        purpose = f"needed for {_EXTRA_PURPOSES[extra]}: " if extra in _EXTRA_PURPOSES else ""
        advice = f"{purpose}uv sync --extra {extra}, or pip install 'arena-newton[{extra}]'"
        if absent:
            findings.append(Finding(f"extra [{extra}]", f"without {', '.join(absent)}", "note", advice))
        else:
            findings.append(Finding(f"extra [{extra}]", "installed"))
    if importlib.util.find_spec("torchcodec") is not None:
        findings.append(_torchcodec())
    return findings


def _torchcodec() -> Finding:
    """Check that torchcodec loads: it is installed without FFmpeg's shared libraries, but needs them."""
    try:
        fault = faults("module", ["torchcodec"], memory=_TORCHCODEC_MEMORY, seconds=_TORCHCODEC_TIME)[0]
    except (OSError, subprocess.SubprocessError) as error:
        fault = _short(error)
    if fault is None:
        return Finding("torchcodec", "loads")
    advice = (
        "LeRobot then reads videos with PyAV, 2 to 4 times slower: install FFmpeg's shared libraries, "
        "`apt install ffmpeg`"
    )
    text = " ".join(fault.split())
    if len(text) > _LONGEST:
        text = text[:_LONGEST].rpartition(". ")[0] or text[:_LONGEST]
    return Finding("torchcodec", f"does not load ({text})", "note", advice)


def _devices() -> list[Finding]:
    findings = [Finding("cpu", f"{len(os.sched_getaffinity(0))} cores, {platform.machine()}")]
    try:
        import warp as wp

        from arena_newton.cli.quiet import quiet_warp

        quiet_warp()
        devices = wp.get_cuda_devices()
    except Exception as error:
        return [*findings, Finding("warp", f"does not start ({_short(error)})", "bad", _INSTALL)]
    for device in devices:
        gib = device.total_memory / 2**30
        findings.append(Finding(device.alias, f"{device.name}, {gib:.0f} GiB, sm_{device.arch}"))
    if not devices:
        advice = "fine for engine mujoco; for thousands of worlds use a machine with an NVIDIA driver (`nvidia-smi`)"
        findings.append(Finding("cuda", "none", "note", advice))
    try:
        import torch

        cuda = torch.cuda.is_available()
    except Exception as error:
        return [*findings, Finding("torch", f"does not start ({_short(error)})", "bad", _INSTALL)]
    if devices and not cuda:
        advice = "torch was built without CUDA; trackers would run on the CPU: install the CUDA build of torch"
        findings.append(Finding("torch cuda", "none", "bad", advice))
    elif cuda:
        findings.append(Finding("torch cuda", f"{torch.version.cuda}, {torch.cuda.device_count()} devices"))
    return findings


def _engines() -> list[Finding]:
    findings = []
    try:
        import mujoco

        model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
        mujoco.mj_step(model, mujoco.MjData(model))
        findings.append(Finding("engine mujoco", "steps"))
    except Exception as error:
        findings.append(Finding("engine mujoco", f"does not step ({_short(error)})", "bad", _INSTALL))
    try:
        import mujoco_warp
        import warp as wp

        where = "CUDA" if wp.is_cuda_available() else "the Warp CPU backend (slow: use --engine mujoco)"
        findings.append(Finding("engine warp", f"{mujoco_warp.__name__} imports, runs on {where}"))
    except Exception as error:
        findings.append(Finding("engine warp", f"does not import ({_short(error)})", "bad", _INSTALL))
    return findings


def _storage() -> list[Finding]:
    findings = []
    try:
        import warp as wp

        cache = Path(wp.config.kernel_cache_dir or "")
        files = [p for p in cache.rglob("*") if p.is_file()] if cache.is_dir() else []
        size = sum(p.stat().st_size for p in files) / 2**20
        if files:
            findings.append(Finding("kernel cache", f"{cache}, {size:.0f} MiB in {len(files)} files"))
        else:
            advice = "nothing to do: the first run compiles for about a minute; WARP_CACHE_PATH moves it"
            findings.append(Finding("kernel cache", f"{cache}, empty", "note", advice))
        existing = next(p for p in (cache, *cache.parents) if p.exists())
        if not os.access(existing, os.W_OK):
            findings.append(Finding("kernel cache", "not writable", "bad", "set WARP_CACHE_PATH to a writable folder"))
    except Exception as error:
        findings.append(Finding("kernel cache", f"unknown ({_short(error)})", "bad", _INSTALL))
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    advice = "" if free >= _MIN_FREE_GIB else "free some space or write results elsewhere with --out"
    findings.append(Finding("free disk here", f"{free:.1f} GiB", "ok" if free >= _MIN_FREE_GIB else "note", advice))
    return findings


def _scenes() -> list[Finding]:
    from arena_newton import tasks

    root = tasks.base.SCENES
    findings = []
    for path in (root / "g1" / "g1.usda", *(spec.layer for spec in tasks.specs())):
        if not path.is_file():
            shown = path.relative_to(root) if path.is_relative_to(root) else path
            advice = "install again, or run `python -m scene_builders` in a checkout"
            findings.append(Finding("scenes", f"{shown} is missing", "bad", advice))
    for name in {*tasks.names()} - {spec.name for spec in tasks.specs()}:
        try:
            tasks.get(name)
        except InputError as error:
            findings.append(Finding("tasks", str(error), "bad", "repair or uninstall its package"))
    return findings or [Finding("scenes", f"robot and all tasks in {root}")]


def _short(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"


def examine() -> list[Finding]:
    """Everything worth knowing before a run."""
    findings = _packages()
    if any(finding.status == "bad" for finding in findings):
        return findings
    return [*findings, *examine_extras(), *_devices(), *_engines(), *_storage(), *_scenes()]


def main(argv: Sequence[str] = ()) -> int:
    """Print the findings.

    Args:
        argv: Arguments; there are none but ``--help``: the front door hands `--tracker` and `--policy` to others.

    Returns:
        Exit code: 0 when a run can start, 1 when a problem must be solved first.
    """
    if argv:
        helps = argv[0] in ("-h", "--help")
        print(
            USAGE if helps else f"error: doctor {argv[0]}: unknown, expected --tracker NAME or --policy SPEC",
            file=None if helps else sys.stderr,
        )
        return 0 if helps else 2
    return exit_code(_print_findings)


def _print_findings() -> int:
    print("examining packages, devices, engines and scenes ...", file=sys.stderr, flush=True)
    findings = examine()
    width = max(len(finding.subject) for finding in findings)
    for finding in findings:
        mark = {"ok": "  ", "note": "- ", "bad": "! "}[finding.status]
        print(f"{mark}{finding.subject:<{width}}  {finding.value}")
        if finding.advice:
            print(f"  {'':<{width}}  -> {finding.advice}")
    bad = sum(finding.status == "bad" for finding in findings)
    print(f"{bad} problems to mend" if bad else "ready: python -m arena_newton.eval")
    return 1 if bad else 0


if __name__ == "__main__":  # by the front door, which hands --tracker and --policy to others
    sys.exit(importlib.import_module("arena_newton.__main__").main(["doctor", *sys.argv[1:]]))
