"""``python -m arena_newton.eval bench``: this machine against the figures that the product must reach."""

from __future__ import annotations

import contextlib
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import torch
import warp as wp

import arena_newton
from arena_newton import policies, trackers
from arena_newton.cli.quiet import quiet_warp
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.bench.bench_figure import BenchFigure
from arena_newton.eval.bench.bench_learned import learned_figures
from arena_newton.eval.bench.bench_options import BenchOptions
from arena_newton.eval.bench.bench_peers import peer_items
from arena_newton.eval.bench.bench_policy import policy_figures
from arena_newton.eval.bench.bench_recording import recording_figures
from arena_newton.eval.bench.bench_start import start_figures
from arena_newton.eval.bench.bench_tick import RATES, tick_times
from arena_newton.eval.plan import episode_plan
from arena_newton.pictures.recorder import EpisodeRecorder
from arena_newton.pictures.settings import CameraConfig
from arena_newton.rollout import Rollout
from arena_newton.trackers.motions.commands import MotionCommand
from arena_newton.trackers.motions.generator import ReferenceGenerator

__all__ = ["BenchFigure", "run"]

NEEDS_CUDA = "not measured here (needs CUDA)"


def run(options: BenchOptions) -> int:
    """Measure and print.

    Returns:
        Exit code: 0 when no measured figure misses its bar, 1 otherwise.

    Raises:
        InputError: an unknown item, or a checkpoint that cannot be read.
    """
    known = {**_ITEMS, "tests": _tests}
    for name in options.what:
        if name not in known and name != "all":
            raise InputError(f"--what {name}: known are {' '.join(known)} all")
    named = [name for name in options.what if name != "all"]
    wanted = list(dict.fromkeys([*(_ITEMS if "all" in options.what else ()), *named]))
    quiet_warp()
    figures: list[BenchFigure] = []
    measured: Iterator[tuple[str, Iterator[BenchFigure]]] = ((name, known[name](options)) for name in wanted)
    if options.peers:
        measured = iter(peer_items(options))
    for name, found in measured:
        for figure in _guarded(name, found):
            figures.append(figure)
            if not options.json:
                print(_line(figure), flush=True)
    if options.json:
        print(json.dumps([asdict(figure) | {"verdict": figure.verdict} for figure in figures], indent=2))
    return 1 if any(figure.verdict == "MISS" for figure in figures) else 0


def _guarded(name: str, figures: Iterator[BenchFigure]) -> Iterator[BenchFigure]:
    """The figures of one item; one that breaks is a miss with its reason and does not stop the other items."""
    try:
        yield from figures
    except InputError:
        raise
    except Exception as error:
        reason = f"failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        yield BenchFigure(name, 0.0, "", True, math.inf, reason)


def _line(figure: BenchFigure) -> str:
    value = "" if figure.value is None else f"{figure.value:,.3g}" if figure.value < 1000 else f"{figure.value:,.0f}"
    sign = "<=" if figure.at_most else ">="
    note = f"  {figure.note}" if figure.note else ""
    return f"{figure.verdict:<5} {figure.name:<62} {value:>9} {figure.unit:<14} ({sign} {figure.bar:,g}){note}"


@contextlib.contextmanager
def _cores(count: int) -> Iterator[int]:
    """Restrict this process to ``count`` cores; yields how many there are."""
    before, threads = os.sched_getaffinity(0), torch.get_num_threads()
    chosen = set(sorted(before)[:count])
    os.sched_setaffinity(0, chosen)
    torch.set_num_threads(len(chosen))
    try:
        yield len(chosen)
    finally:
        os.sched_setaffinity(0, before)
        torch.set_num_threads(threads)


def _sync(env: ArenaEnv) -> None:
    if env.device.is_cuda:
        wp.synchronize_device(env.device)


def _medians(options: BenchOptions, worlds: int, engine: str, rate: str) -> tuple[float, float]:
    """Median seconds of a full tick and of its bare physics."""
    pairs = tick_times(worlds, engine, RATES[rate], options.rounds, options.checkpoint)
    return statistics.median(pair[0] for pair in pairs), statistics.median(pair[1] for pair in pairs)


def _tick(options: BenchOptions) -> Iterator[BenchFigure]:
    for rate, bar in (("1 ms x 20", 1.3), ("5 ms x 4", 2.0)):
        name = f"tick / bare mj_step, engine mujoco, {options.worlds} worlds, {rate}"
        full, alone = _medians(options, options.worlds, "mujoco", rate)
        times = f"{1e3 * full:.2f} ms / {1e3 * alone:.2f} ms"
        yield BenchFigure(name, bar, "x", True, full / alone, times)


def _throughput(options: BenchOptions) -> Iterator[BenchFigure]:
    ratio = f"tick / bare solver graph, engine warp, {options.cuda_worlds} worlds, "
    rate = f"world-ticks, engine warp, {options.cuda_worlds} worlds, football, dex3, "
    if not wp.is_cuda_available():
        yield BenchFigure(ratio + "5 ms x 4", 1.4, "x", True, None, NEEDS_CUDA)
        yield BenchFigure(rate + "5 ms x 4", 250_000, "world-ticks/s", False, None, NEEDS_CUDA)
        return
    for physics in ("5 ms x 4", "1 ms x 20"):
        full, alone = _medians(options, options.cuda_worlds, "warp", physics)
        times = f"{1e3 * full:.2f} ms / {1e3 * alone:.2f} ms"
        yield BenchFigure(ratio + physics, 1.4, "x", True, full / alone, times)
        if physics == "5 ms x 4":
            yield BenchFigure(rate + physics, 250_000, "world-ticks/s", False, options.cuda_worlds / full)


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
        _sync(env)
        began, used = time.perf_counter(), time.process_time()
        env.render(camera)
        _sync(env)
        times.append(time.perf_counter() - began)
        processor.append(time.process_time() - used)
    return worlds / statistics.median(times), worlds / statistics.median(processor)


def _camera(options: BenchOptions) -> Iterator[BenchFigure]:
    name = f"ego camera 224x224, light per world, CUDA, {options.camera_worlds} worlds"
    if wp.is_cuda_available():
        value, _ = _frames(options.camera_worlds, "cuda:0", "warp", options.rounds)
        yield BenchFigure(name, 40_000, "frames/s", False, value)
    else:
        yield BenchFigure(name, 40_000, "frames/s", False, None, NEEDS_CUDA)
    with _cores(1):
        wall, value = _frames(4, "cpu", "mujoco", max(3, options.rounds // 4))
    note = f"per second of processor time; {wall:.0f} per second of wall clock"
    yield BenchFigure("ego camera 224x224, shadows and textures, one CPU core", 40, "frames/s", False, value, note)


def _pictures(options: BenchOptions) -> Iterator[BenchFigure]:
    """What strips and videos add to two VisNavi episodes of the expert, taken in turn in one environment."""
    env = ArenaEnv("vis_navi", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", device="cpu")
    episodes = episode_plan.expand(["vis_navi"], trackers=["twist2"], policy="expert", seeds=[0], repeats=2)
    policy = policies.get("expert")
    times: dict[str, list[float]] = {"none": [], "strip": [], "video": []}
    with tempfile.TemporaryDirectory() as folder:

        def play(kind: str) -> None:
            with EpisodeRecorder(folder, video=kind == "video", strip=kind == "strip") as recorder:
                began = time.perf_counter()
                Rollout(env, policy, episodes, recorder=() if kind == "none" else recorder).run()
                times[kind].append(time.perf_counter() - began)

        # Kernels of tick and camera first.
        with EpisodeRecorder(folder, video=False) as recorder:
            Rollout(env, policy, episodes, recorder=recorder, max_steps=20).run()
        for _ in range(3):
            play("none")
            play("strip")
        play("video")
    alone = statistics.median(times["none"])
    for kind, bar in (("strip", 1.5), ("video", 8.0)):
        value = statistics.median(times[kind])
        note = f"{value:.1f} s / {alone:.1f} s"
        name = f"--{kind} / no pictures, 2 VisNavi episodes, expert, CPU"
        yield BenchFigure(name, bar, "x", True, value / alone, note)


def _episodes(options: BenchOptions) -> Iterator[BenchFigure]:
    name = "60 episodes x 1300 ticks football, stand, TWIST2, no camera, 2 cores"
    tracker = trackers.get("twist2", options.checkpoint)
    with _cores(2) as cores:
        began = time.perf_counter()
        env = ArenaEnv("football", worlds=options.worlds, tracker=tracker, engine="mujoco")
        built = time.perf_counter()
        episodes = episode_plan.expand(["football"], trackers=["twist2"], policy="stand", max_steps=1300)
        results = Rollout(env, policies.get("stand"), episodes).run()
        wall = time.perf_counter() - built
    ticks = sum(result.steps for result in results)
    detail = f"{ticks:,} ticks on {cores} cores, built in {built - began:.1f} s"
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

    def ticks(count: int) -> float:
        began = time.perf_counter()
        for _ in range(count):
            generator.realign(ahead, 0.05)
            generator.step(table)
            generator.action()
        return (time.perf_counter() - began) / count

    ticks(100)
    return statistics.median(ticks(50) for _ in range(rounds))


def _generator(options: BenchOptions) -> Iterator[BenchFigure]:
    for worlds in GENERATOR_WORLDS:
        with _cores(1):
            seconds = _generator_tick(worlds, options.rounds)
        yield BenchFigure(f"reference generator, tick on the CPU, {worlds} worlds", 1.0, "ms", True, 1e3 * seconds)


def _help(options: BenchOptions) -> Iterator[BenchFigure]:
    times = []
    for _ in range(5):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-m", "arena_newton.eval", "--help"], check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - began)
    yield BenchFigure("python -m arena_newton.eval --help", 1.0, "s", True, statistics.median(times))


def _learned(options: BenchOptions) -> Iterator[BenchFigure]:
    with _cores(2):
        yield from learned_figures(options)


def _tests(options: BenchOptions) -> Iterator[BenchFigure]:
    root = Path(arena_newton.__file__).resolve().parent.parent
    for cold, minutes in ((False, 6.0), (True, 15.0)):
        name = f"whole test suite, 2 cores, kernels {'cold' if cold else 'cached'}"
        if not (root / "tests").is_dir():
            yield BenchFigure(name, minutes, "min", True, None, "not measured here (needs a checkout)")
            continue
        with tempfile.TemporaryDirectory() as cache, _cores(2):
            environment = os.environ | ({"WARP_CACHE_PATH": cache} if cold else {})
            began = time.perf_counter()
            command = [sys.executable, "-m", "pytest", "-q", str(root / "tests")]
            done = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.DEVNULL)
        note = "" if done.returncode == 0 else f"pytest ended with code {done.returncode}"
        yield BenchFigure(name, minutes, "min", True, (time.perf_counter() - began) / 60, note)


_ITEMS: dict[str, Callable[[BenchOptions], Iterator[BenchFigure]]] = {
    "help": _help,
    "tick": _tick,
    "generator": _generator,
    "throughput": _throughput,
    "camera": _camera,
    "pictures": _pictures,
    "recording": recording_figures,
    "episodes": _episodes,
    "policy": policy_figures,
    "learned": _learned,
    "start": start_figures,
}
