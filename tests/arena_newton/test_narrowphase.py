"""mujoco_warp's collision kernel with its pairs written out: the same contacts, named without generating its code."""

from __future__ import annotations

import inspect

import mujoco
import mujoco_warp
import numpy as np
import pytest
import warp as wp
from mujoco_warp._src import collision_primitive, warp_util

from arena_newton.kernel_cache.narrowphase import FACTORY, write_out_pairs
from arena_newton.physics import scene

SHAPES = """<mujoco><worldbody>
<geom type="plane" size="5 5 .1"/>
<body pos="0 0 .1"><freejoint/><geom type="sphere" size=".12"/></body>
<body pos=".15 0 .1"><freejoint/><geom type="capsule" size=".1 .2" euler="80 10 0"/></body>
<body pos=".3 .1 .1"><freejoint/><geom type="box" size=".12 .1 .11" euler="5 3 20"/></body>
<body pos=".4 .2 .15"><freejoint/><geom type="box" size=".1 .1 .1" euler="0 30 0"/></body>
</worldbody></mujoco>"""


def contacts(monkeypatch: pytest.MonkeyPatch, factory: object) -> tuple[bool, list[np.ndarray]]:
    """Contacts of `SHAPES`, after True where the kernel's functions were not known from its source alone."""
    made = []

    def making(types: list, functions: list) -> object:
        made.append(factory(types, functions))
        return made[-1]

    monkeypatch.setattr(warp_util, "_KERNEL_CACHE", {})
    monkeypatch.setattr(collision_primitive, FACTORY, making)
    model = mujoco.MjModel.from_xml_string(SHAPES)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nconmax=64)
    mujoco_warp.kinematics(m, d)
    mujoco_warp.collision(m, d)
    found = d.contact
    rows = [values.numpy()[: d.nacon.numpy()[0]] for values in (found.dist, found.pos, found.frame, found.geom)]
    return made[0].adj.has_unresolved_static_expressions, rows


def test_the_same_contacts_by_a_kernel_that_is_named_from_its_source(monkeypatch: pytest.MonkeyPatch):
    write_out_pairs()
    ours = getattr(collision_primitive, FACTORY)
    library = ours.args[0]
    deferred, theirs = contacts(monkeypatch, library)
    resolved, found = contacts(monkeypatch, ours)
    assert deferred and not resolved
    assert len(theirs[0]) >= 8 and {tuple(pair) for pair in theirs[3]} >= {(0, 1), (0, 2), (0, 3), (1, 2), (3, 4)}
    for a, b in zip(theirs, found, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("count", [1, 6, len(collision_primitive._PRIMITIVE_COLLISIONS)])
def test_every_kind_of_pairs_has_its_turn(count: int, monkeypatch: pytest.MonkeyPatch):
    write_out_pairs()
    monkeypatch.setattr(warp_util, "_KERNEL_CACHE", {})
    pairs = list(collision_primitive._PRIMITIVE_COLLISIONS.items())[-count:]
    types, functions = [list(some) for some in zip(*pairs, strict=True)]
    kernel = getattr(collision_primitive, FACTORY)(types, functions)
    named = [value for value in kernel.adj.resolved_static_expressions.values() if isinstance(value, wp.Function)]
    assert named == functions


@pytest.mark.parametrize("native", [True, False])
def test_a_scene_of_engine_warp_has_them_written_out(native: bool, monkeypatch: pytest.MonkeyPatch):
    called = []
    monkeypatch.setattr(scene, "write_out_pairs", lambda: called.append(True))
    monkeypatch.setattr(scene, "_open_stage", lambda *_: {}["no stage"])
    with pytest.raises(KeyError):
        scene.load_scene("boxing", native=native)
    assert bool(called) is not native


LOOP_ALONE = """def _primitive_narrowphase(types, functions):
    for i in range(wp.static(len(primitive_collisions_func))):
      pass
"""
END_ALONE = """def _primitive_narrowphase(types, functions):
  primitive_narrowphase = None
  return primitive_narrowphase
"""
BARE_INDEX = LOOP_ALONE.replace("pass", "n = i") + "\n  return primitive_narrowphase\n"


@pytest.mark.parametrize("source", [LOOP_ALONE, END_ALONE, BARE_INDEX, None])
def test_another_version_of_the_kernel_is_left_alone(source: str | None, monkeypatch: pytest.MonkeyPatch):
    def factory(types: list, functions: list) -> None:
        """Stand for the library's."""

    def read(_: object) -> str:
        if source is None:
            raise OSError
        return source

    monkeypatch.setattr(collision_primitive, FACTORY, factory)
    monkeypatch.setattr(inspect, "getsource", read)
    write_out_pairs()
    assert getattr(collision_primitive, FACTORY) is factory
    monkeypatch.delattr(collision_primitive, FACTORY)
    write_out_pairs()
    assert not hasattr(collision_primitive, FACTORY)
