"""Kernels load side by side: the lists name what is launched, nothing else; no module is loaded twice."""

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest
import warp as wp

from arena_newton.kernel_cache import kernel_loading

SCRIPT = """
import json, sys
import torch, warp
from arena_newton import trackers
from arena_newton.kernel_cache import kernel_loading
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.env import ArenaEnv
from arena_newton.pictures.settings import CameraConfig
from arena_newton.cli.quiet import quiet_warp
quiet_warp()
warp.force_load = lambda *given, **more: None
camera = CameraConfig(width=64, height=64)
env = ArenaEnv("boxing", worlds=1, tracker=trackers.get("pd"), engine=sys.argv[1], device="cpu", camera=camera)
env.reset([1])
env.observe(image=True)
env.step(torch.tensor(STAND_ACTION)[None])
print(json.dumps([m.name for m in warp._src.context.user_modules.values() if m.execs]))
"""
BEGINNING = """
import json, threading
import warp as wp
from arena_newton.kernel_cache import kernel_loading
from arena_newton.cli.quiet import quiet_warp
quiet_warp()
begun, plain = [], wp.Device._init_streams
def counted(device):
    begun.append(threading.current_thread() is threading.main_thread())
    plain(device)
wp.Device._init_streams = counted
kernel_loading.load_kernels("warp", "cuda:0", camera=True, suite="HSI")
with wp.ScopedDevice("cuda:0"), wp.ScopedCapture("cuda:0"):
    pass
print(json.dumps(begun))
"""
LIBRARIES = ("newton._src.", "mujoco_warp._src.")


@pytest.mark.release
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_the_lists_are_what_an_environment_launches(engine):
    """A process that loads nothing ahead launches every listed module, and of Newton and MuJoCo Warp no other."""
    done = subprocess.run([sys.executable, "-c", SCRIPT, engine], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    loaded = set(json.loads(done.stdout.splitlines()[-1]))
    listed = set(kernel_loading.kernel_modules(engine, camera=True, suite="HSI"))
    assert listed <= loaded, f"not launched: {sorted(listed - loaded)}"
    own = {name for name in loaded if name.startswith(LIBRARIES)}
    assert own <= listed, f"not listed: {sorted(own - listed)}"


def test_a_second_environment_loads_nothing_again(monkeypatch):
    """Modules load by so many threads as there are cores, once per device; another kind loads what it has more."""
    calls, load = [], wp.force_load

    def watched(device, modules, max_workers):
        calls.append((device, {module.name for module in modules}, max_workers))
        load(device, modules=modules, max_workers=max_workers)

    monkeypatch.setattr(wp, "force_load", watched)
    monkeypatch.setattr(kernel_loading, "_loaded", set())
    monkeypatch.setattr(kernel_loading.os, "sched_getaffinity", lambda _: {0, 1, 2})
    for suite in (None, None, "HSI"):
        kernel_loading.load_kernels("mujoco", "cpu", camera=False, suite=suite)
    judges = set(kernel_loading.SUITE_MODULES["HSI"])
    assert calls == [("cpu", set(kernel_loading.TICK_MODULES), 3), ("cpu", judges, 3)]
    assert all(wp.get_module(name).execs for name in (*kernel_loading.TICK_MODULES, *judges))


def test_adjoints_are_left_out_where_nobody_takes_them():
    """Newton's and mujoco_warp's modules have no adjoints; those of the differentiable kernels keep theirs."""
    kernel_loading.forward_only()
    assert not any(wp.get_module(name).options["enable_backward"] for name in kernel_loading.FORWARD_MODULES)
    for name in ("canonical", "rules.success_hoi", "rules.success_hsi"):
        assert wp.get_module(f"arena_newton.kernels.{name}").options["enable_backward"]


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_cuda_begins_once_however_many_threads_load():
    """A new process makes one stream of a GPU, by its main thread; threads that asked at once would make one each."""
    done = subprocess.run([sys.executable, "-c", BEGINNING], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1]) == [True]


def test_a_device_begins_before_its_first_thread(monkeypatch):
    """The stream of a GPU is asked for by the thread that builds, before those that load are started."""
    calls = []
    monkeypatch.setattr(kernel_loading, "_loaded", set())
    monkeypatch.setattr(wp, "get_device", lambda _: SimpleNamespace(is_cuda=True))
    monkeypatch.setattr(wp, "get_stream", lambda _: calls.append("stream"))
    monkeypatch.setattr(wp, "force_load", lambda *_, **more: calls.append("threads"))
    kernel_loading.load_kernels("mujoco", "cuda:0", camera=False)
    assert calls == ["stream", "threads"]
