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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from arena_newton.errors import InputError
from arena_newton.quiet import quiet_warp

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv
    from arena_newton.interfaces import Physics
    from arena_newton.trackers.base import Tracker

__all__ = ["BenchOptions", "Figure", "run"]

NEEDS_CUDA = "not measured here (needs CUDA)"


@dataclass(frozen=True)
class BenchOptions:
    """Measure this machine against the figures to reach; ratios are taken side by side in one run."""

    what: tuple[str, ...] = ("all",)
    """What to measure: help tick throughput camera pictures episodes tests, or `all` (everything but tests)."""
    checkpoint: str | None = None
    """Official TWIST2 ONNX file; without it a network of its shape with random weights takes its place."""
    worlds: int = 20
    """Worlds of engine mujoco."""
    cuda_worlds: int = 4096
    """Worlds on CUDA."""
    camera_worlds: int = 1024
    """Worlds of the camera on CUDA."""
    rounds: int = 20
    """Rounds of each ratio; their medians are compared."""
    json: bool = False
    """Print one JSON array instead of the table."""


@dataclass(frozen=True)
class Figure:
    """One line of the bench."""

    name: str
    bar: float
    unit: str
    at_most: bool
    """True when smaller is better."""
    value: float | None = None
    """None when it was not measured."""
    note: str = ""

    @property
    def verdict(self) -> str:
        """``pass``, ``MISS`` or ``-``."""
        if self.value is None:
            return "-"
        return "pass" if (self.value <= self.bar if self.at_most else self.value >= self.bar) else "MISS"


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
    figures: list[Figure] = []
    for name in wanted:
        for figure in _guarded(name, known[name](options)):
            figures.append(figure)
            if not options.json:
                print(_line(figure), flush=True)
    if options.json:
        print(json.dumps([asdict(figure) | {"verdict": figure.verdict} for figure in figures], indent=2))
    return 1 if any(figure.verdict == "MISS" for figure in figures) else 0


def _guarded(name: str, figures: Iterator[Figure]) -> Iterator[Figure]:
    """The figures of one item; one that breaks is a miss with its reason and does not stop the other items."""
    try:
        yield from figures
    except InputError:
        raise
    except Exception as error:
        reason = f"failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        yield Figure(name, 0.0, "", True, math.inf, reason)


def _line(figure: Figure) -> str:
    value = "" if figure.value is None else f"{figure.value:,.3g}" if figure.value < 1000 else f"{figure.value:,.0f}"
    sign = "<=" if figure.at_most else ">="
    note = f"  {figure.note}" if figure.note else ""
    return f"{figure.verdict:<5} {figure.name:<62} {value:>9} {figure.unit:<14} ({sign} {figure.bar:,g}){note}"


def _cuda() -> bool:
    import warp as wp

    return wp.is_cuda_available()


@contextlib.contextmanager
def _cores(count: int) -> Iterator[int]:
    """Restrict this process to ``count`` cores; yields how many there are."""
    import torch

    before, threads = os.sched_getaffinity(0), torch.get_num_threads()
    chosen = set(sorted(before)[:count])
    os.sched_setaffinity(0, chosen)
    torch.set_num_threads(len(chosen))
    try:
        yield len(chosen)
    finally:
        os.sched_setaffinity(0, before)
        torch.set_num_threads(threads)


def _twist2(options: BenchOptions) -> tuple[Tracker, str]:
    """TWIST2 tracker and how to call its weights in a note."""
    from arena_newton import trackers

    if options.checkpoint is not None:
        return trackers.get("twist2", checkpoint=options.checkpoint), "official checkpoint"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "random.onnx"
        _write_random_network(path)
        return trackers.get("twist2", checkpoint=path), "random weights of TWIST2's shape (no --checkpoint)"


def _write_random_network(path: Path) -> None:
    """A 1432-512-512-256-29 network (the official one's widths) whose small outputs keep the default pose."""
    import numpy as np
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    widths = (1432, 512, 512, 256, 29)
    generator = np.random.default_rng(0)
    nodes, weights, name = [], [], "x"
    for i, (width_in, width_out) in enumerate(zip(widths, widths[1:], strict=False)):
        last = i == len(widths) - 2
        matrix = generator.normal(0.0, (0.01 if last else 1.0) / width_in**0.5, (width_out, width_in))
        weights.append(numpy_helper.from_array(matrix.astype(np.float32), f"w{i}"))
        weights.append(numpy_helper.from_array(np.zeros(width_out, np.float32), f"b{i}"))
        out = "y" if last else f"h{i}"
        nodes.append(helper.make_node("Gemm", [name, f"w{i}", f"b{i}"], [out], transB=1))
        if not last:
            nodes.append(helper.make_node("Elu", [out], [f"e{i}"]))
            name = f"e{i}"
    graph = helper.make_graph(
        nodes,
        "random",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["rows", widths[0]])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, ["rows", widths[-1]])],
        weights,
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), path)


def _sync(env: ArenaEnv) -> None:
    if env.device.is_cuda:
        import warp as wp

        wp.synchronize_device(env.device)


@contextlib.contextmanager
def _as_before(physics: Physics) -> Iterator[None]:
    """Put the physics back into the state it had, so that the bare steps start where the full ticks do."""
    kept = physics.snapshot()
    yield
    physics.restore(kept)


def _tick_times(options: BenchOptions, worlds: int, engine: str, fast: bool) -> tuple[float, float, str]:
    """Median seconds of a full tick and of its bare physics, taken in turn on the same worlds, and a note."""
    import numpy as np
    import torch

    from arena_newton.env import STAND_ACTION, ArenaEnv

    tracker, note = _twist2(options)
    env = ArenaEnv("football", worlds=worlds, tracker=tracker, engine=engine, fast_physics=fast)
    env.reset(list(range(worlds)))
    action = torch.tensor(STAND_ACTION, device=env.torch_device).repeat(worlds, 1)
    status = np.zeros(worlds, dtype=np.int32)

    def ticks(count: int) -> None:
        for _ in range(count):
            env.observe()
            status[:] = env.step(action)

    def bare(count: int) -> None:
        for _ in range(count):
            env.physics.mj_step_only()

    def timed(work: Callable[[int], None], count: int = 25) -> float:
        _sync(env)
        began = time.perf_counter()
        work(count)
        _sync(env)
        return (time.perf_counter() - began) / count

    ticks(env.startup_ticks + 10)
    with _as_before(env.physics):
        bare(2)
    full, alone = [], []
    for _ in range(options.rounds):
        with _as_before(env.physics):
            alone.append(timed(bare))
        full.append(timed(ticks))
        ended = np.flatnonzero(status)
        if len(ended):  # as in an evaluation, a world that ended starts its next episode
            env.reset([int(w) for w in ended], ended)
    return statistics.median(full), statistics.median(alone), note


def _tick(options: BenchOptions) -> Iterator[Figure]:
    for fast, rate, bar in ((False, "1 ms x 20", 1.3), (True, "5 ms x 4", 2.0)):
        name = f"tick / bare mj_step, engine mujoco, {options.worlds} worlds, {rate}"
        full, alone, note = _tick_times(options, options.worlds, "mujoco", fast)
        times = f"{1e3 * full:.2f} ms / {1e3 * alone:.2f} ms; {note}"
        yield Figure(name, bar, "x", True, full / alone, times)


def _throughput(options: BenchOptions) -> Iterator[Figure]:
    ratio = f"tick / bare solver graph, engine warp, {options.cuda_worlds} worlds, "
    rate = f"world-ticks, engine warp, {options.cuda_worlds} worlds, football, dex3, "
    if not _cuda():
        yield Figure(ratio + "5 ms x 4", 1.4, "x", True, None, NEEDS_CUDA)
        yield Figure(rate + "5 ms x 4", 250_000, "world-ticks/s", False, None, NEEDS_CUDA)
        return
    for fast, physics in ((True, "5 ms x 4"), (False, "1 ms x 20")):
        full, alone, note = _tick_times(options, options.cuda_worlds, "warp", fast)
        times = f"{1e3 * full:.2f} ms / {1e3 * alone:.2f} ms; {note}"
        yield Figure(ratio + physics, 1.4, "x", True, full / alone, times)
        if fast:
            yield Figure(rate + physics, 250_000, "world-ticks/s", False, options.cuda_worlds / full, note)


def _frames(worlds: int, device: str, engine: str, rounds: int) -> tuple[float, float]:
    """Head camera at 224 x 224 with a drawn light per world: frames per second, and per second of processor time."""
    from arena_newton import trackers
    from arena_newton.env import ArenaEnv
    from arena_newton.pictures.camera import CameraConfig

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


def _camera(options: BenchOptions) -> Iterator[Figure]:
    name = f"ego camera 224x224, light per world, CUDA, {options.camera_worlds} worlds"
    if _cuda():
        value, _ = _frames(options.camera_worlds, "cuda:0", "warp", options.rounds)
        yield Figure(name, 40_000, "frames/s", False, value)
    else:
        yield Figure(name, 40_000, "frames/s", False, None, NEEDS_CUDA)
    with _cores(1):
        wall, value = _frames(4, "cpu", "mujoco", max(3, options.rounds // 4))
    note = f"per second of processor time; {wall:.0f} per second of wall clock"
    yield Figure("ego camera 224x224, shadows and textures, one CPU core", 40, "frames/s", False, value, note)


def _pictures(options: BenchOptions) -> Iterator[Figure]:
    """What strips and videos add to two VisNavi episodes of the expert, taken in turn in one environment."""
    from arena_newton import policies, trackers
    from arena_newton.env import ArenaEnv
    from arena_newton.eval import plan
    from arena_newton.pictures.recorder import EpisodeRecorder
    from arena_newton.rollout import Rollout

    env = ArenaEnv("vis_navi", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", device="cpu")
    episodes = plan.expand(["vis_navi"], tracker="twist2", policy="expert", seeds=[0], repeats=2)
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
        yield Figure(f"--{kind} / no pictures, 2 VisNavi episodes, expert, CPU", bar, "x", True, value / alone, note)


def _episodes(options: BenchOptions) -> Iterator[Figure]:
    from arena_newton import policies
    from arena_newton.env import ArenaEnv
    from arena_newton.eval import plan
    from arena_newton.rollout import Rollout

    name = "60 episodes x 1300 ticks football, stand, TWIST2, no camera, 2 cores"
    if options.checkpoint is None:
        yield Figure(name, 120, "s", True, None, "not measured (needs --checkpoint: random weights fall at once)")
        return
    tracker, note = _twist2(options)
    with _cores(2) as cores:
        began = time.perf_counter()
        env = ArenaEnv("football", worlds=options.worlds, tracker=tracker, engine="mujoco")
        built = time.perf_counter()
        episodes = plan.expand(["football"], tracker="twist2", policy="stand", max_steps=1300)
        results = Rollout(env, policies.get("stand"), episodes).run()
        wall = time.perf_counter() - built
    ticks = sum(result.steps for result in results)
    detail = f"{ticks:,} ticks on {cores} cores, built in {built - began:.1f} s; {note}"
    yield Figure(name, 120, "s", True, wall, detail)


def _help(options: BenchOptions) -> Iterator[Figure]:
    times = []
    for _ in range(5):
        began = time.perf_counter()
        subprocess.run([sys.executable, "-m", "arena_newton.eval", "--help"], check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - began)
    yield Figure("python -m arena_newton.eval --help", 1.0, "s", True, statistics.median(times))


def _tests(options: BenchOptions) -> Iterator[Figure]:
    import arena_newton

    root = Path(arena_newton.__file__).resolve().parent.parent
    for cold, minutes in ((False, 6.0), (True, 15.0)):
        name = f"whole test suite, 2 cores, kernels {'cold' if cold else 'cached'}"
        if not (root / "tests").is_dir():
            yield Figure(name, minutes, "min", True, None, "not measured here (needs a checkout)")
            continue
        with tempfile.TemporaryDirectory() as cache, _cores(2):
            environment = os.environ | ({"WARP_CACHE_PATH": cache} if cold else {})
            began = time.perf_counter()
            command = [sys.executable, "-m", "pytest", "-q", str(root / "tests")]
            done = subprocess.run(command, cwd=root, env=environment, stdout=subprocess.DEVNULL)
        note = "" if done.returncode == 0 else f"pytest ended with code {done.returncode}"
        yield Figure(name, minutes, "min", True, (time.perf_counter() - began) / 60, note)


_ITEMS: dict[str, Callable[[BenchOptions], Iterator[Figure]]] = {
    "help": _help,
    "tick": _tick,
    "throughput": _throughput,
    "camera": _camera,
    "pictures": _pictures,
    "episodes": _episodes,
}
