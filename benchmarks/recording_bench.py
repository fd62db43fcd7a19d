"""Cost of recording demonstrations: the same episodes with pictures, without them, and without a recorder."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping

import warp as wp

from arena_newton import policies
from arena_newton.data.recording.demonstration import DemonstrationRecorder
from arena_newton.data.recording.disturbed_execution import ActionNoise
from arena_newton.eval.bench.timing import BenchFigure, RepeatedEpisodes
from arena_newton.eval.plan.config import recorded_cameras
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play import recording
from arena_newton.interfaces import Recorder
from arena_newton.pictures.settings import CameraConfig
from arena_newton.rules import seeding
from benchmarks.bench_options import RecordingBenchOptions

__all__ = ["recording_figures"]

BARS = {True: {224: 60.0, 480: 360.0}, False: {224: 3600.0, 480: 36_000.0}}
"""Seconds for 100 episodes, with CUDA and without, by the height of the pictures; beyond 224 the next one counts."""
RATIO = 2.5
"""Recording with pictures ÷ the same episodes without a recorder, with CUDA."""
WARM_UP = 20
"""Ticks that are played first, with pictures: kernels are compiled and graphs captured."""


def _play(bench: RepeatedEpisodes, cameras: Mapping[str, CameraConfig] | None, ticks: int) -> tuple[float, int, int]:
    """Seconds, ticks and bytes of the episodes; without a recorder where `cameras` is None."""
    noise = ActionNoise(ticks)
    if cameras is None:
        seconds, results = bench.play(ticks, recorder=[noise], disturbance=noise)
        return seconds, sum(result.steps for result in results), 0
    with tempfile.TemporaryDirectory() as folder:
        threads, processes = recording.encoding_threads(), recording.encoding_processes()
        began = time.perf_counter()
        files = DemonstrationRecorder(folder, cameras=cameras, threads=threads, processes=processes)
        saved: list[object] = []
        try:
            recorders: list[Recorder] = [noise, files]
            _, results = bench.play(
                ticks, recorder=recorders, disturbance=noise, on_tick=lambda active: saved.extend(files.saved())
            )
            saved += files.saved(wait=True)
            files.check()
        finally:
            files.close()
        size = sum(path.stat().st_size for path in files.folder.rglob("*") if path.is_file())
        return time.perf_counter() - began, sum(result.steps for result in results), size


def recording_figures(options: RecordingBenchOptions) -> Iterator[BenchFigure]:
    """Time of recording, and its ratio to the same episodes without a recorder, taken side by side."""
    cameras = recorded_cameras(RunOptions(record=True, record_size=options.size))
    cuda, count = bool(wp.is_cuda_available()), options.episodes
    worlds = min(options.worlds, count)
    expert = policies.get("expert")
    bench = RepeatedEpisodes(options.task, expert, count, worlds=worlds, cuda=cuda, seed_range=seeding.DEMONSTRATION)
    budget = bench.env.budget
    _play(bench, cameras, WARM_UP)
    alone, ticks, _ = _play(bench, None, budget)
    numbers, _, _ = _play(bench, {}, budget)
    seconds, recorded, size = _play(bench, cameras, budget)
    bench.close()
    what = f"{count} {options.task} episodes, {options.size}, {'CUDA' if cuda else 'CPU'}, {worlds} worlds"
    height = 224 if cameras["front"].height <= 224 else 480
    note = f"{recorded:,} frames, {recorded / seconds:,.0f}/s, {size / 1e6:.1f} MB"
    yield BenchFigure(f"recording {what}", BARS[cuda][height] * count / 100, "s", True, seconds, note)
    note = f"{seconds:.1f} s / {alone:.1f} s; states and actions alone {numbers:.1f} s; {ticks:,} ticks"
    ratio = seconds / alone
    if not cuda:  # a picture takes longer than a tick there
        note = f"{ratio:.1f} x, judged on CUDA only: {note}"
    yield BenchFigure(f"recording / no recorder, {what}", RATIO, "x", True, ratio if cuda else None, note)
