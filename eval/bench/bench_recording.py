"""What recording demonstrations costs: the same episodes with pictures, without them, and without a recorder."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping

import warp as wp

from arena_newton import policies, trackers
from arena_newton.data.recording.demonstration import DemonstrationRecorder
from arena_newton.data.recording.disturbed_execution import ActionNoise
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.bench_figure import BenchFigure
from arena_newton.eval.bench.bench_options import BenchOptions
from arena_newton.eval.plan import episode_plan
from arena_newton.eval.plan.config import recorded_cameras
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play import recording
from arena_newton.interfaces import Recorder
from arena_newton.pictures.settings import CameraConfig
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding

__all__ = ["recording_figures"]

BARS = {True: {224: 60.0, 480: 360.0}, False: {224: 3600.0, 480: 36_000.0}}
"""Seconds for 100 episodes, with CUDA and without, by the height of the pictures; beyond 224 the next one counts."""
RATIO = 2.5
"""Recording with pictures ÷ the same episodes without a recorder, with CUDA."""
WARM_UP = 20
"""Ticks that are played first, with pictures: kernels are compiled and graphs captured."""


class _Recording:
    """Plays the same episodes again and again in one environment."""

    def __init__(self, options: BenchOptions):
        self.cuda = bool(wp.is_cuda_available())
        self.task, count = options.recording_task, options.recording_episodes
        self.env = ArenaEnv(
            self.task,
            tracker=trackers.get("twist2"),
            worlds=min(options.recording_worlds, count),
            engine="warp" if self.cuda else "mujoco",
            device="cuda:0" if self.cuda else "cpu",
        )
        self.episodes = episode_plan.expand(
            [self.task],
            trackers=["twist2"],
            policy="expert",
            seeds=[0],
            repeats=count,
            seed_range=seeding.DEMONSTRATION,
        )
        self.policy = policies.get("expert")

    def play(self, cameras: Mapping[str, CameraConfig] | None, max_steps: int | None = None) -> tuple[float, int, int]:
        """Seconds, ticks and bytes of the episodes; without a recorder where `cameras` is None."""
        steps = max_steps or self.env.budget
        noise = ActionNoise(steps)
        with tempfile.TemporaryDirectory() as folder:
            began = time.perf_counter()
            recorders: list[Recorder] = [noise]
            files = None
            if cameras is not None:
                threads, processes = recording.encoding_threads(), recording.encoding_processes()
                files = DemonstrationRecorder(folder, cameras=cameras, threads=threads, processes=processes)
                recorders.append(files)
            on_tick = None if files is None else (lambda active: saved.extend(files.saved()))
            saved: list[object] = []
            size = 0
            try:
                results = Rollout(
                    self.env,
                    self.policy,
                    self.episodes,
                    recorder=recorders,
                    disturbance=noise,
                    max_steps=steps,
                    on_tick=on_tick,
                ).run()
                if files is not None:
                    saved += files.saved(wait=True)
                    files.check()
            finally:
                if files is not None:
                    files.close()
            if files is not None:
                size = sum(path.stat().st_size for path in files.folder.rglob("*") if path.is_file())
            return time.perf_counter() - began, sum(result.steps for result in results), size


def recording_figures(options: BenchOptions) -> Iterator[BenchFigure]:
    """Time of recording, and its ratio to the same episodes without a recorder, taken side by side."""
    flags = RunOptions(record=True, record_size=options.recording_size)
    cameras = recorded_cameras(flags)
    bench = _Recording(options)
    bench.play(cameras, WARM_UP)
    alone, ticks, _ = bench.play(None)
    numbers, _, _ = bench.play({})
    seconds, recorded, size = bench.play(cameras)
    bench.env.close()
    count, where = len(bench.episodes), "CUDA" if bench.cuda else "CPU"
    what = f"{count} {bench.task} episodes, {options.recording_size}, {where}, {bench.env.worlds} worlds"
    height = 224 if cameras["front"].height <= 224 else 480
    note = f"{recorded:,} frames, {recorded / seconds:,.0f}/s, {size / 1e6:.1f} MB"
    yield BenchFigure(f"recording {what}", BARS[bench.cuda][height] * count / 100, "s", True, seconds, note)
    note = f"{seconds:.1f} s / {alone:.1f} s; states and actions alone {numbers:.1f} s; {ticks:,} ticks"
    ratio = seconds / alone
    if not bench.cuda:  # a picture takes longer than a tick there
        note = f"{ratio:.1f} x, judged on CUDA only: {note}"
    name = f"recording / no recorder, {what}"
    yield BenchFigure(name, RATIO, "x", True, ratio if bench.cuda else None, note)
