"""Kernels load side by side: lists and rehearsal name what is launched, nothing else; no module is compiled twice."""

import dataclasses
import functools
import json
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import mujoco_warp
import numpy as np
import pytest
import warp as wp

from arena_newton.kernel_cache import kernel_links, kernel_loading, kernel_rehearsal
from arena_newton.physics.scene import load_scene

SCRIPT = """
import hashlib, json, sys
import torch, warp
from arena_newton import trackers
from arena_newton.kernel_cache import kernel_loading
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.env import ArenaEnv
from arena_newton.pictures.settings import CameraConfig
from arena_newton.cli.quiet import quiet_warp
quiet_warp()
kernel_loading.MOST_THREADS = int(sys.argv[2])
camera = CameraConfig(width=64, height=64)
env = ArenaEnv("boxing", worlds=1, tracker=trackers.get("pd"), engine=sys.argv[1], device="cpu", camera=camera)
def loaded():
    return [m.name for m in warp._src.context.user_modules.values() if m.execs]
built = loaded()
env.reset([1])
picture = env.observe(image=True).image
for _ in range(2):
    env.step(torch.tensor(STAND_ACTION)[None])
bits = b"".join(a.numpy().tobytes() for a in (env.physics.qpos, env.physics.qvel, env.physics.contact_force))
print(json.dumps([built, loaded(), hashlib.sha256(bits + picture.numpy().tobytes()).hexdigest()]))
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
with kernel_loading.loading("warp", "cuda:0", camera=True, suite="HSI"):
    pass
with wp.ScopedDevice("cuda:0"), wp.ScopedCapture("cuda:0"):
    pass
print(json.dumps(begun))
"""
LIBRARIES = ("newton._src.", "mujoco_warp._src.")
PICTURE = "_shade_kernel"
"""Beginning of the one module that is made for a picture and loaded with the first one."""


@functools.cache
def run(engine: str, threads: int) -> tuple[set[str], set[str], str]:
    """Modules that a new process has loaded when an environment is built and after two ticks, and the result's hash."""
    done = subprocess.run([sys.executable, "-c", SCRIPT, engine, str(threads)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    built, loaded, bits = json.loads(done.stdout.splitlines()[-1])
    return set(built), set(loaded), bits


@pytest.mark.release
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_the_lists_are_what_an_environment_launches(engine):
    """Without threads a new process loads every listed module, and of Newton and MuJoCo Warp no other one."""
    _, loaded, _ = run(engine, 1)
    listed = set(kernel_loading.kernel_modules(engine, camera=True, suite="HSI"))
    assert listed <= loaded, f"not launched: {sorted(listed - loaded)}"
    own = {name for name in loaded if name.startswith(LIBRARIES)}
    assert own <= listed, f"not listed: {sorted(own - listed)}"


@pytest.mark.release
def test_a_rehearsal_finds_all_modules_and_no_other_one():
    """With threads the building of an environment loads what a run without them launches, and no bit differs."""
    before, launched, bits = run("warp", 1)
    built, loaded, same = run("warp", 2)
    assert loaded == launched
    assert len(launched - before) > 30, "a run without threads loads most modules after the building"
    assert all(name.startswith(PICTURE) for name in launched - built), sorted(launched - built)
    assert same == bits


@pytest.fixture(scope="module")
def solver():
    """Newton's solver of a scene for engine `warp`, after one step."""
    made = load_scene("boxing", device="cpu").solver
    with wp.ScopedDevice("cpu"):  # on a machine with a GPU that is the default
        mujoco_warp.step(made.mjw_model, made.mjw_data)
    return made


def contents(*structs) -> dict[str, bytes]:
    """Bytes of every array in structs."""
    found = {}
    for struct in structs:
        for field in dataclasses.fields(struct):
            value = getattr(struct, field.name, None)
            if isinstance(value, wp.array):
                found[f"{type(struct).__name__}.{field.name}"] = value.numpy().tobytes() if value.size else b""
            elif dataclasses.is_dataclass(value):
                found |= contents(value)
    return found


def test_a_rehearsal_changes_nothing(solver):
    """Walking the solver under rehearsal tells its modules and leaves every array of model and data as it is."""
    m, d, told = solver.mjw_model, solver.mjw_data, []
    before, load, flags = contents(m, d), wp.Module.load, m.opt.disableflags
    with kernel_rehearsal.rehearsed(lambda module, device, block: told.append((module.name, device, block)), m, d):
        kernel_rehearsal.walk_solver(m, d, mujoco_warp.set_const_fixed)
    after = contents(m, d)
    assert [name for name in before if before[name] != after[name]] == []
    assert wp.Module.load is load and m.opt.disableflags == flags
    assert len({name for name, _, _ in told}) > 40
    with wp.ScopedDevice("cpu"):
        mujoco_warp.step(m, d)
    assert contents(d)["Data.qpos"] != before["Data.qpos"], "a real step does change them"


def test_a_rehearsal_sorts_nothing(solver, monkeypatch):
    """A model of so many geoms that pairs are found by sorting is walked too; what no launch wrote is not sorted."""
    m, d, told, sorts = solver.mjw_model, solver.mjw_data, [], []
    monkeypatch.setattr(m.opt, "broadphase", mujoco_warp.BroadphaseType.SAP_SEGMENTED)
    monkeypatch.setattr(wp.utils, "segmented_sort_pairs", lambda *given: sorts.append(given))
    monkeypatch.setattr(wp.utils, "array_scan", lambda *given: sorts.append(given))
    with kernel_rehearsal.rehearsed(lambda module, device, block: told.append(module.name), m, d):
        kernel_rehearsal.walk_solver(m, d, mujoco_warp.set_const_fixed)
    assert not sorts and len(set(told)) > 40
    wp.utils.array_scan()
    assert sorts == [()], "what was held back is put back"


@wp.kernel
def count(x: wp.array[float]):
    """Add one."""
    x[wp.tid()] += 1.0


def test_a_rehearsal_holds_back_its_own_thread_only():
    """Another thread launches, copies and clears as always while this one rehearses."""
    mine, other = wp.zeros(1, dtype=float, device="cpu"), wp.zeros(1, dtype=float, device="cpu")

    def work(x):
        wp.launch(count, dim=1, inputs=[x], device="cpu")
        wp.copy(x, wp.full(1, float(x.numpy()[0]) + 10.0, dtype=float, device="cpu"))

    with kernel_rehearsal.rehearsed(lambda *_: None, mine, other), ThreadPoolExecutor(1) as pool:
        work(mine)
        mine.fill_(7.0)
        pool.submit(work, other).result()
    assert (mine.numpy()[0], other.numpy()[0]) == (0.0, 11.0)


def test_a_failing_rehearsal_stops_nothing(monkeypatch):
    """An error half way leaves the scene to load its modules as it launches them, and everything is put back."""
    monkeypatch.setattr(kernel_loading, "MOST_THREADS", 2)
    before, calls = (wp.Module.load, wp.copy, wp.array.zero_, mujoco_warp.set_const_fixed), []

    def broken(m, d, set_const_fixed):
        set_const_fixed(m, d)
        calls.append(1)
        raise RuntimeError("no such solver")

    monkeypatch.setattr(kernel_loading, "walk_solver", broken)
    with kernel_loading.loading("warp", "cpu", camera=False):
        made = load_scene("boxing", device="cpu").solver
    with wp.ScopedDevice("cpu"):
        mujoco_warp.step(made.mjw_model, made.mjw_data)
    assert calls == [1]
    assert np.isfinite(made.mjw_data.qpos.numpy()).all() and made.mjw_model.body_subtreemass.numpy().any()
    assert (wp.Module.load, wp.copy, wp.array.zero_, mujoco_warp.set_const_fixed) == before


@wp.kernel(module="unique", enable_backward=False)
def factor(a: wp.array2d[float], b: wp.array2d[float]):
    """Cholesky factor of a tile."""
    tile = wp.tile_load(a, shape=(8, 8))
    wp.tile_store(b, wp.tile_cholesky(tile))


def test_linked_routines_are_compiled_once_ahead(monkeypatch, tmp_path):
    """What a kernel will link is known before its code is written for good, is compiled once, and only for CUDA."""
    made = []
    monkeypatch.setattr(kernel_links, "_compile", lambda arguments: made.append(arguments))
    cuda = SimpleNamespace(is_cuda=True, is_cpu=False, get_cuda_compile_arch=lambda: 90)
    with ThreadPoolExecutor(1) as pool, monkeypatch.context() as patch:
        patch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
        routines = kernel_links.Routines(pool)
        routines.make(factor.module, wp.get_device("cpu"), 1)
        assert made == []
        for _ in range(2):
            routines.make(factor.module, cuda, 32)
        routines.make(count.module, cuda, 256)
        (tmp_path / factor.module.get_module_identifier(64)).mkdir()
        routines.make(factor.module, cuda, 64)  # is in the cache
    asked = [(one["solver"], one["M"], one["N"], one["arch"], one["num_threads"]) for one in made]
    assert ("potrf", 8, 8, 90, 32) in asked and len(set(asked)) == len(asked)
    assert {threads for *_, threads in asked} == {32}
    a = wp.array(np.diag(np.arange(1.0, 9.0) ** 2), dtype=float, device="cpu")
    b = wp.zeros_like(a)
    wp.launch_tiled(factor, dim=[1], inputs=[a, b], block_dim=32, device="cpu")
    np.testing.assert_allclose(b.numpy(), np.diag(np.arange(1.0, 9.0)), rtol=1e-6)


def test_routines_are_compiled_while_another_module_is_listened_to(monkeypatch):
    """Threads that compile routines call Warp's own function while another thread has a listener in its position."""
    built, inside, done = [], threading.Event(), threading.Event()
    monkeypatch.setattr(kernel_links, "BUILDER", lambda *, M, builder: built.append(M))

    def slow(*given, **more):
        inside.set()
        assert done.wait(30)

    monkeypatch.setattr(kernel_links.context, "ModuleBuilder", slow)
    with ThreadPoolExecutor(1) as pool:
        asking = pool.submit(kernel_links.asked, factor.module, 32, 90)
        assert inside.wait(30)
        kernel_links._compile({"M": 8})
        done.set()
        assert built == [8] and asking.result() == []


def test_adjoints_are_left_out_where_nobody_takes_them():
    """Newton's and mujoco_warp's modules have no adjoints; those of the differentiable kernels keep theirs."""
    kernel_loading.forward_only()
    assert not any(wp.get_module(name).options["enable_backward"] for name in kernel_loading.FORWARD_MODULES)
    for name in ("canonical", "rules.success_hoi", "rules.success_hsi"):
        assert wp.get_module(f"arena_newton.kernels.{name}").options["enable_backward"]


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


def test_ctrl_c_while_threads_are_waited_for_changes_nothing(monkeypatch):
    """Whoever interrupts the end of a building finds Warp as it was."""
    plain = wp.Module.load

    def interrupted(*given, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(kernel_loading, "MOST_THREADS", 2)
    monkeypatch.setattr(kernel_loading, "kernel_modules", lambda engine, **kind: ("arena_newton.kernels.rules.fall",))
    monkeypatch.setattr(kernel_loading, "_loaded", set())
    monkeypatch.setattr(kernel_loading.ThreadPoolExecutor, "shutdown", interrupted)
    with pytest.raises(KeyboardInterrupt), kernel_loading.loading("mujoco", "cpu", camera=False):
        assert wp.Module.load is not plain
    assert wp.Module.load is plain
    with kernel_loading._loading:
        pass


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


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_cuda_begins_once_however_many_threads_load():
    """A new process makes one stream of a GPU, by its main thread; threads that asked at once would make one each."""
    done = subprocess.run([sys.executable, "-c", BEGINNING], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1]) == [True]


def test_a_device_begins_before_its_first_thread(monkeypatch):
    """The stream of a GPU is asked for by the thread that builds, before a thread that loads is started."""
    gpu, asked = SimpleNamespace(is_cuda=True, is_cpu=False), []
    monkeypatch.setattr(kernel_loading, "MOST_THREADS", 2)
    monkeypatch.setattr(kernel_loading, "_loaded", set())
    monkeypatch.setattr(kernel_loading.os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(wp, "get_device", lambda _: gpu)
    monkeypatch.setattr(wp, "get_stream", lambda device: asked.append((device, threading.current_thread())))
    monkeypatch.setattr(kernel_loading._Loader, "start", lambda *_: asked.append("thread"))
    with kernel_loading.loading("mujoco", "cuda:0", camera=False):
        pass
    assert asked[0] == (gpu, threading.main_thread()) and asked[1] == "thread"
