"""Bodies that start inside something else: the contacts at the reset of one episode per mode."""

from __future__ import annotations

from pathlib import Path

import mujoco

from arena_newton import rule_sets, tasks
from arena_newton.files import limits
from arena_newton.physics.scene import Scene, load_scene, scene_path
from arena_newton.robot import g1
from arena_newton.rules import modes as all_modes
from arena_newton.tasks import Draws, TaskSpec
from arena_newton.usd_scenes.dependencies import Problem

__all__ = ["penetrations"]

_SEED = 0
"""Episode seed of every mode."""


def penetrations(path: str | Path, task: str) -> tuple[list[Problem], list[Problem]]:
    """Pairs of things that start more than `limits.PENETRATION` inside each other, in one episode of each mode.

    Args:
        path: A layer that passes `validate`.

    Returns:
        Pairs that the layer brings, and pairs that start so in the task's own scene too: some of the original's ranges
        overlap.

    Raises:
        InputError: The scene cannot be built.
    """
    found = _pairs(path, task)
    if not found:
        return [], []
    own = set(_pairs(task, task)) if Path(path).resolve() != scene_path(task).resolve() else set(found)
    new, known = [], []
    for pair, (depth, modes) in found.items():
        text = f"starts {100 * depth:.0f} cm inside {pair[1]} (episode seed {_SEED}, mode {', '.join(modes)})"
        (known if pair in own else new).append(Problem(str(path), pair[0], text))
    return new, known


def _pairs(path: str | Path, task: str) -> dict[tuple[str, str], tuple[float, list[str]]]:
    """(prim, prim) → depth [m] and the modes in which they start so."""
    spec, rules = tasks.get(task), rule_sets.get("paper")
    scenes: dict[str | None, Scene] = {}
    found: dict[tuple[str, str], tuple[float, list[str]]] = {}
    for mode, ranges in all_modes.BUILT_IN.items():
        if ranges.scene == "layer" or ranges.dynamics:  # a scene of its own, or the placements of base mode
            continue
        # As in a run: a user's file keeps its own selection but in semantic mode.
        variant = spec.variant(mode, rules) if mode == "semantic" or str(path) == task else None
        if variant not in scenes:
            scenes[variant] = load_scene(
                path, worlds=1, device="cpu", native=True, variant=variant, rules=rules, drawn=False
            )
        for pair, depth in _inside(scenes[variant], spec.draw(_SEED, mode, rules), spec).items():
            deepest, modes = found.get(pair, (0.0, []))
            found[pair] = (max(depth, deepest), [*modes, mode])
    return found


def _inside(scene: Scene, draws: Draws, spec: TaskSpec) -> dict[tuple[str, str], float]:
    """Pairs of prims of one episode's first instant, with their depth [m]."""
    m = scene.mj_model
    data = mujoco.MjData(m)
    handles = scene.robot
    data.qpos[handles.root_qpos : handles.root_qpos + 3] = spec.spawn_position
    data.qpos[handles.root_qpos + 3 : handles.root_qpos + 7] = spec.spawn_quat
    data.qpos[handles.joint_qpos] = g1.DEFAULT_POSE
    for thing in spec.objects:
        pose = draws.placed[thing.prim]
        if scene.has_body(f"{thing.prim}/Frame"):
            mocap = scene.mocap_id(thing.prim)
            data.mocap_pos[mocap], data.mocap_quat[mocap] = pose.pos, pose.quat
            data.mocap_pos[mocap, 2] += thing.raised(scene)
        else:
            address = scene.joint_qpos(thing.prim)
            data.qpos[address : address + 7] = (*pose.pos, *pose.quat)
            data.qpos[address + 2] += thing.raised(scene)
    mujoco.mj_forward(m, data)
    bodies = {body: prim for prim, body in scene.body_ids.items()}
    found: dict[tuple[str, str], float] = {}
    for contact in data.contact:
        if contact.dist >= -limits.PENETRATION:
            continue
        names = [_name(scene, bodies, int(geom)) for geom in contact.geom]
        # A robot's link is named first, then an object, then what is fixed.
        first, second = sorted(names, key=lambda name: (name[1], name[0]))
        pair = (first[0], second[0])
        found[pair] = max(found.get(pair, 0.0), -float(contact.dist))
    return found


def _name(scene: Scene, bodies: dict[int, str], geom: int) -> tuple[str, bool]:
    """Prim of the body, or of the geom where it is static; and whether it is static."""
    body = int(scene.mj_model.geom_bodyid[geom])
    if body in bodies:
        return bodies[body], int(scene.mj_model.body_mocapid[body]) >= 0
    return scene.geom_labels[geom], True
