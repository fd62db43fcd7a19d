"""Figures of one part each: camera, pictures of episodes, reference generator, whole plans, overview, tests."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
import warp as wp

from arena_newton import policies, trackers
from arena_newton.env import ArenaEnv
from arena_newton.eval.bench.timing import NEEDS_CUDA, BenchFigure, RepeatedEpisodes, cores, seconds_of
from arena_newton.eval.plan.episode_plan import PROTOCOL_REPEATS, PROTOCOL_SEEDS
from arena_newton.pictures.recorder import EpisodeRecorder
from arena_newton.pictures.settings import CameraConfig
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator
from benchmarks.bench_options import CameraBenchOptions, PlainBenchOptions, RoundsBenchOptions

__all__ = [
    "camera_speeds",
    "episode_times",
    "generator_times",
    "overview_times",
    "picture_costs",
    "suite_times",
]


def _frames(worlds: int, device: str, engine: str, rounds: int) -> tuple[float, float]:
    """Head camera at 224 x 224 with a drawn light per world: frames per second, and per second of processor time."""
    env = ArenaEnv(
        "football",
        worlds=worlds,
        tracker=trackers.get("pd"),
        engine=engine,
        device=device,
        mode="visual",
        camera=CameraConfig(width=224, height=224),
    )
    camera = env.camera
    assert camera is not None
    env.reset(list(range(worlds)))
    env.render(camera)
    times, processor = [], []
    for _ in range(rounds):
        used = time.process_time()
        times.append(seconds_of(lambda: env.render(camera)))
        processor.append(time.process_time() - used)
    return worlds / statistics.median(times), worlds / statistics.median(processor)


def camera_speeds(options: CameraBenchOptions) -> Iterator[BenchFigure]:
    """Pictures per second on CUDA, and per second of processor time on one core."""
    name = f"ego camera 224x224, light per world, CUDA, {options.worlds} worlds"
    if wp.is_cuda_available():
        value, _ = _frames(options.worlds, "cuda:0", "warp", options.rounds)
        yield BenchFigure(name, 40_000, "frames/s", False, value)
    else:
        yield BenchFigure(name, 40_000, "frames/s", False, None, NEEDS_CUDA)
    with cores(1):
        wall, value = _frames(4, "cpu", "mujoco", max(3, options.rounds // 4))
    note = f"per second of processor time; {wall:.0f} per second of wall clock"
    yield BenchFigure("ego camera 224x224, shadows and textures, one CPU core", 40, "frames/s", False, value, note)


def picture_costs(options: PlainBenchOptions) -> Iterator[BenchFigure]:
    """Time that strips and videos add to two VisNavi episodes of the expert, taken in turn in one environment."""
    bench = RepeatedEpisodes("vis_navi", policies.get("expert"), 2)
    times: dict[str, list[float]] = {"none": [], "strip": [], "video": []}
    with tempfile.TemporaryDirectory() as folder:

        def play(kind: str, ticks: int | None = None) -> float:
            with EpisodeRecorder(folder, video=kind == "video", strip=kind == "strip") as recorder:
                return seconds_of(lambda: bench.play(ticks, recorder=() if kind == "none" else recorder))

        play("strip", 20)  # kernels of tick and camera
        for kind in ("none", "strip") * 3 + ("video",):
            times[kind].append(play(kind))
    bench.close()
    alone = statistics.median(times["none"])
    for kind, bar in (("strip", 1.5), ("video", 8.0)):
        value = statistics.median(times[kind])
        note = f"{value:.1f} s / {alone:.1f} s"
        name = f"--{kind} / no pictures, 2 VisNavi episodes, expert, CPU"
        yield BenchFigure(name, bar, "x", True, value / alone, note)


def episode_times(options: PlainBenchOptions) -> Iterator[BenchFigure]:
    """Seconds of the protocol's 60 Football episodes of a robot that stands."""
    name = "60 episodes x 1300 ticks football, stand, TWIST2, no camera, 2 cores"
    stand = policies.get("stand")
    with cores(2) as count:
        began = time.perf_counter()
        bench = RepeatedEpisodes("football", stand, PROTOCOL_REPEATS, seeds=PROTOCOL_SEEDS, worlds=20)
        built = time.perf_counter() - began
        wall, results = bench.play(1300)
    bench.close()
    ticks = sum(result.steps for result in results)
    detail = f"{ticks:,} ticks on {count} cores, built in {built:.1f} s"
    yield BenchFigure(name, 120, "s", True, wall, detail)


GENERATOR_WORLDS = (1, 20, 64)
"""Worlds of the reference generator that are measured: one, those of an evaluation, and many."""


def _generator_tick(worlds: int, rounds: int) -> float:
    """Median seconds of a tick on the CPU: `realign`, `step` with packed commands, `action`; a walk, hands reach."""
    generator, ahead = ReferenceGenerator(worlds), torch.zeros(worlds)
    command = MotionCommand.neutral(worlds)
    command.velocity[:, 0], command.reach[:] = 0.4, 1.0
    command.hand_point[:, :, 0] += 0.1
    table = command.pack()

    def ticks(count: int) -> None:
        for _ in range(count):
            generator.realign(ahead, 0.05)
            generator.step(table)
            generator.action()

    ticks(100)
    return statistics.median(seconds_of(lambda: ticks(50)) / 50 for _ in range(rounds))


def generator_times(options: RoundsBenchOptions) -> Iterator[BenchFigure]:
    """Time of a tick of the reference generator."""
    for worlds in GENERATOR_WORLDS:
        with cores(1):
            seconds = _generator_tick(worlds, options.rounds)
        yield BenchFigure(f"reference generator, tick on the CPU, {worlds} worlds", 1.0, "ms", True, 1e3 * seconds)


def overview_times(options: PlainBenchOptions) -> Iterator[BenchFigure]:
    """Time in which the evaluation explains itself."""
    command = [sys.executable, "-m", "arena_newton.eval", "--help"]
    times = [seconds_of(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)) for _ in range(5)]
    yield BenchFigure("python -m arena_newton.eval --help", 0.4, "s", True, statistics.median(times))


def suite_times(options: PlainBenchOptions) -> Iterator[BenchFigure]:
    """Minutes of the whole test suite on two cores."""
    root = Path(__file__).resolve().parent.parent
    for cold, minutes in ((False, 5.0), (True, 9.0)):
        with tempfile.TemporaryDirectory() as cache, cores(2):
            environment = os.environ | ({"WARP_CACHE_PATH": cache} if cold else {})
            began = time.perf_counter()
            command = [sys.executable, "-m", "pytest", "-q", str(root / "tests")]
            done = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.DEVNULL)
        note = "" if done.returncode == 0 else f"pytest ended with code {done.returncode}"
        name = f"whole test suite, 2 cores, kernels {'cold' if cold else 'cached'}"
        yield BenchFigure(name, minutes, "min", True, (time.perf_counter() - began) / 60, note)
