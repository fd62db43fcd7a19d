"""Kernels load side by side: the lists name what is launched and nothing else, and no module is compiled twice."""

import json
import subprocess
import sys
import threading

import numpy as np
import pytest
import warp as wp

from arena_newton import kernel_loading

SCRIPT = """
import json, sys
import torch, warp
from arena_newton import kernel_loading, trackers
from arena_newton.canonical import STAND_ACTION
from arena_newton.env import ArenaEnv
from arena_newton.pictures.settings import CameraConfig
from arena_newton.quiet import quiet_warp
quiet_warp()
kernel_loading.MOST_THREADS = 1
camera = CameraConfig(width=64, height=64)
env = ArenaEnv("boxing", worlds=1, tracker=trackers.get("pd"), engine=sys.argv[1], device="cpu", camera=camera)
env.reset([1])
env.observe(image=True)
for _ in range(2):
    env.step(torch.tensor(STAND_ACTION)[None])
print(json.dumps([m.name for m in warp._src.context.user_modules.values() if m.execs]))
"""
LIBRARIES = ("newton._src.", "mujoco_warp._src.")


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_the_lists_are_what_an_environment_launches(engine):
    """Without threads a new process loads every listed module, and of Newton and MuJoCo Warp no other one."""
    done = subprocess.run([sys.executable, "-c", SCRIPT, engine], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    loaded, listed = (
        set(json.loads(done.stdout.splitlines()[-1])),
        set(kernel_loading.kernel_modules(engine, camera=True, suite="HSI")),
    )
    assert listed <= loaded, f"not launched: {sorted(listed - loaded)}"
    own = {name for name in loaded if name.startswith(LIBRARIES)}
    assert own <= listed, f"not listed: {sorted(own - listed)}"


def test_a_launch_waits_for_the_thread_that_loads_its_module(tmp_path, monkeypatch):
    """A module that is launched while a thread loads it is built once, and nothing stays changed."""
    text = "import warp as wp\n@wp.kernel\ndef double(x: wp.array[float]):\n    x[wp.tid()] = 2.0 * x[wp.tid()]\n"
    (tmp_path / "made_kernels.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(kernel_loading, "kernel_modules", lambda engine, **kind: ("made_kernels",))
    import made_kernels  # noqa: PLC0415

    module = wp.get_module("made_kernels")
    build, inside, most, calls, plain = type(module)._compile, [], [], [], wp.Module.load

    def watched(self, *args, **kwargs):
        calls.append(threading.current_thread().name)
        inside.append(1)
        most.append(len(inside))
        try:
            return build(self, *args, **kwargs)
        finally:
            inside.pop()

    monkeypatch.setattr(type(module), "_compile", watched)
    with kernel_loading.loading("mujoco", "cpu", camera=False):
        x = wp.array([1.0, 2.0], dtype=float, device="cpu")
        wp.launch(made_kernels.double, dim=2, inputs=[x], device="cpu")
        assert np.array_equal(x.numpy(), [2.0, 4.0])
    assert len(calls) == 1 and max(most) == 1
    assert wp.Module.load is plain
    with kernel_loading.loading("mujoco", "cpu", camera=False):  # a second environment has nothing to load
        assert wp.Module.load is plain


def test_a_module_that_cannot_be_built_fails_where_it_is_launched(tmp_path, monkeypatch):
    """A broken kernel that nobody launches stops no environment; its launch raises as without threads."""
    text = "import warp as wp\n@wp.kernel\ndef broken(x: wp.array[float]):\n    x[0] = wp.no_such_thing(x[0])\n"
    (tmp_path / "broken_kernels.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(kernel_loading, "kernel_modules", lambda engine, **kind: ("broken_kernels",))
    with kernel_loading.loading("mujoco", "cpu", camera=False):
        pass
    import broken_kernels  # noqa: PLC0415

    x = wp.zeros(1, dtype=float, device="cpu")
    with pytest.raises(Exception, match="no_such_thing"):
        wp.launch(broken_kernels.broken, dim=1, inputs=[x], device="cpu")
