"""``python -m benchmarks devices``: ticks and pictures of engine warp on a device, against engine mujoco on the CPU."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch

from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.eval.audit.action_replay import DRIFT, MEASURED, replay
from arena_newton.eval.audit.draws import drawn
from arena_newton.eval.audit.folder_audit import audited
from arena_newton.eval.bench.timing import BenchFigure
from arena_newton.eval.commands.audit import AuditOptions
from arena_newton.eval.commands.run import run as evaluate
from arena_newton.eval.plan.options import RunOptions
from arena_newton.physics.devices import torch_device
from arena_newton.pictures.settings import CameraConfig
from benchmarks.bench_options import DeviceOptions

__all__ = ["device_figures"]


def device_figures(options: DeviceOptions) -> Iterator[BenchFigure]:
    """Largest differences of the ticks of experts' episodes, and of their first pictures."""
    options = dataclasses.replace(options, device=options.device or str(torch_device(None)))
    for task in options.tasks:
        with tempfile.TemporaryDirectory() as work:
            yield from _ticks(task, Path(work) / "run", options)
        yield from _pictures(task, options)


def _ticks(task: str, out: Path, options: DeviceOptions) -> Iterator[BenchFigure]:
    """Largest differences of a tick and of a second, with the tolerances of an audit."""
    flags = RunOptions(
        task=(task,),
        tracker=("twist2",),
        seeds=(0,),
        repeats=options.episodes,
        worlds=options.episodes,
        engine="warp",
        device=options.device,
        max_steps=options.max_steps,
        record=True,
        record_cameras=(),
        out=str(out),
    )
    with contextlib.redirect_stdout(io.StringIO()):
        evaluate(flags)
        audit = audited(out)
        replay(audit, drawn([audit], None, 0)[0])
    allowed = AuditOptions.tick_tolerance, AuditOptions.velocity_tolerance
    bars = *allowed, DRIFT * allowed[0], DRIFT * allowed[1]
    ticks = sum(record.steps for record in audit.run.records)
    for name, bar in zip(MEASURED, bars, strict=True):
        unit = "m" if name.startswith("position") else "m/s, rad/s"
        note = f"{ticks} ticks on {options.device}"
        yield BenchFigure(f"{task}: largest difference of a {name}", bar, unit, True, audit.largest[name], note)
    yield BenchFigure(f"{task}: contradictions", 0, "", True, len(audit.faults), "; ".join(audit.faults[:1]))


def _pictures(task: str, options: DeviceOptions) -> Iterator[BenchFigure]:
    """First pictures of a device drawn twice, and against those of the CPU."""
    here, again = (_drawn(task, "warp", options.device, options.episodes) for _ in range(2))
    yield BenchFigure(f"{task}: pictures drawn twice differ", 0, "bytes", True, int((here != again).sum()))
    other = _drawn(task, "mujoco", "cpu", options.episodes)
    far = (here.int() - other.int()).abs()
    note = f"largest {int(far.max())} of 255; engine mujoco draws them on the CPU"
    part = 100 * float((far > 0).float().mean())
    yield BenchFigure(f"{task}: bytes of pictures that differ", None, "%", True, part, note)


def _drawn(task: str, engine: str, device: str | None, worlds: int) -> torch.Tensor:
    """First pictures of a policy's head camera."""
    camera = CameraConfig(width=224, height=224)
    env = ArenaEnv(task, worlds=worlds, tracker=trackers.get("twist2"), engine=engine, device=device, camera=camera)
    env.reset(list(range(worlds)))
    image = env.observe(image=True).image
    assert image is not None
    pictures = image.cpu().clone()
    env.close()
    return pictures
