"""View of the worlds that a policy plays in: everything to read, nothing to write.

Arrays that it hands out are copies, positions and velocities renewed before each look, so that what is written into
them moves nothing; attributes cannot be set. It keeps from accidents, not from intent: what lies deeper in an object
that it hands out (handles, the compiled model's accessors, the stage) is the world's own. A policy that moves the world
by it is found by the replay of its actions.
"""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp

from arena_newton.errors import InputError
from arena_newton.interfaces import World

__all__ = ["PolicyView"]

OF_WORLD = """spec mode modes rules worlds device torch_device engine startup_ticks tick active budget camera_config
    camera_configs""".split()
"""Attributes of a `World` that a policy may read, besides `scene`, `physics`, the tracker's name and those that a class
of worlds names in `shown`."""
OF_SCENE = """path hands worlds device stage mj_model body_ids joint_ids geom_labels drive latch robot body_id has_body
    link joint_qpos joint_qvel mocap_id geom_ids lowest frame marker""".split()
"""Attributes of a `Scene` that it may read."""
OF_PHYSICS = "qpos qvel ctrl xpos xquat xipos contact_force".split()
"""Arrays of a `Physics` that it may read."""


class _Frozen:
    """An object whose named attributes can be read and none written."""

    def __init__(self, what: str, names: list[str] | None, read: Callable[[str], Any]):
        """Say what it is, which attributes it has (None: all), and how one is read."""
        self.__dict__.update(_what=what, _names=names, _read=read)

    def __getattr__(self, name: str) -> Any:
        """A public attribute; an array is a copy."""
        if name.startswith("_"):
            raise AttributeError(name)
        if self._names is not None and name not in self._names:
            raise InputError(f"{self._what} has no {name} for a policy, which moves the world by its actions alone")
        return _readable(f"{self._what}.{name}", self._read(name))

    def __setattr__(self, name: str, value: object) -> None:
        """Refuse."""
        raise InputError(f"{self._what}.{name}: is read-only, a policy moves the world by its actions alone")


def _readable(what: str, value: Any) -> Any:
    """A value, or what can be changed instead of it without harm."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, dict):
        return MappingProxyType(value)
    if isinstance(value, list):
        return tuple(value)
    if type(value).__module__.startswith("mujoco"):
        return _Frozen(what, None, lambda name: getattr(value, name))
    return value


class PolicyView(_Frozen):
    """A `World` as policies are given it in `attach`."""

    def __init__(self, env: World):
        """Show an environment; nothing of it is copied before it is read."""
        shown: dict[str, tuple[torch.Tensor, torch.Tensor, wp.array]] = {}

        def array(name: str) -> wp.array:
            if name not in shown:
                there = getattr(env.physics, name)
                here = wp.clone(there)
                shown[name] = wp.to_torch(here), wp.to_torch(there), here
            return shown[name][2]

        def refresh() -> None:
            for here, there, _ in shown.values():
                here.copy_(there)

        parts = {
            "physics": _Frozen("physics", OF_PHYSICS, array),
            "scene": _Frozen("scene", OF_SCENE, lambda name: getattr(env.scene, name)),
            "tracker": SimpleNamespace(name=getattr(env.tracker, "name", "")),
        }

        def read(name: str) -> Any:
            return parts[name] if name in parts else getattr(env, name)

        super().__init__("the world", [*OF_WORLD, *parts, *getattr(env, "shown", ())], read)
        self.__dict__.update(refresh=refresh)
