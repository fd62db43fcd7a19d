"""Nothing starts inside something else, but for the cases that the documentation lists."""

import mujoco
import numpy as np
import pytest

from arena_newton import rule_sets, tasks
from arena_newton.physics.scene import Scene
from arena_newton.robot import g1
from arena_newton.rules import seeding
from arena_newton.rules.modes import BUILT_IN, HELD_OUT
from arena_newton.tasks.handles import ROBOT
from tests.scenes import scene

ALLOWED = 0.01
"""Penetration that physics undoes unseen [m]."""
SEEDS = [(group, repeat) for group in range(3) for repeat in range(20)]


def thing(label: str) -> str:
    """The prim directly under /World that a geom belongs to."""
    return "/".join(label.split("/")[:3])


def spawn(built: Scene, spec, data) -> None:
    """The robot as an episode begins."""
    h = built.robot
    data.qpos[h.root_qpos : h.root_qpos + 7] = (*spec.spawn_position, *spec.spawn_quat)
    data.qpos[h.joint_qpos], data.qpos[h.hand_qpos] = g1.DEFAULT_POSE, 0.0


def place(built: Scene, placed, data) -> None:
    """Objects where an episode's draw puts them."""
    for prim, pose in placed.items():
        if built.has_body(f"{prim}/Frame"):
            data.mocap_pos[built.mocap_id(prim)], data.mocap_quat[built.mocap_id(prim)] = pose.pos, pose.quat
        else:
            address = built.joint_qpos(prim)
            data.qpos[address : address + 7] = (*pose.pos, *pose.quat)


def depths(built: Scene, data, placed) -> dict[tuple[str, str], float]:
    """Pairs of things more than 1 cm inside each other, at least one of them placed and one movable, and how deep [m].

    Two immovable things may cross: OpenDoor's wall runs through the planes that end the room.
    """
    m = built.mj_model
    mujoco.mj_kinematics(m, data)
    solid = np.flatnonzero((m.geom_contype | m.geom_conaffinity) & np.array([bool(p) for p in built.geom_labels]))
    owner = np.array([thing(built.geom_labels[g]) for g in solid])
    ours, movable = np.isin(owner, list(placed)), m.body_treeid[m.geom_bodyid[solid]] >= 0
    radius = m.geom_rbound[solid]
    far = np.linalg.norm(data.geom_xpos[solid, None] - data.geom_xpos[solid], axis=2) > radius[:, None] + radius
    bounded = (radius[:, None] > 0.0) & (radius > 0.0)  # planes have no radius
    pairs = (owner[:, None] != owner) & (ours[:, None] | ours) & (movable[:, None] | movable) & ~(far & bounded)
    found: dict[tuple[str, str], float] = {}
    for i, j in zip(*np.nonzero(np.triu(pairs, 1)), strict=True):
        depth = -mujoco.mj_geomDistance(m, data, int(solid[i]), int(solid[j]), 0.0, None)
        if depth > ALLOWED:
            first, second = sorted((str(owner[i]), str(owner[j])))
            found[first, second] = max(found.get((first, second), 0.0), depth)
    return found


def measure(task: str) -> dict[tuple, tuple[int, float]]:
    """(rule set, mode, first, second) to the number of episodes and the deepest case [m]."""
    spec = tasks.get(task)
    known: dict[str, dict[tuple[str, str], float]] = {}
    found: dict[tuple, tuple[int, float]] = {}
    for name in rule_sets.names():
        for mode in (name for name, ranges in BUILT_IN.items() if not ranges.dynamics):  # those of base mode
            rule_set = rule_sets.get(name)
            # Without clutter semantic modes are the same model (test_semantic_modes_change_looks_and_clutter_alone).
            cluttered = spec.semantic_change == "clutter"
            variant = spec.variant(mode, rule_set) if cluttered else "base"
            layer = spec.own_layer(mode) if cluttered else None
            built = scene(task, variant, layer=layer)
            data = mujoco.MjData(built.mj_model)
            spawn(built, spec, data)
            for group, repeat in SEEDS:
                placed = spec.draw(seeding.episode_seed(spec.gym_id, group, repeat), mode, rule_set).placed
                key = f"{variant} {layer} {placed}"
                if key not in known:  # most draws are the same in both rule sets and in the modes that share a scene
                    place(built, placed, data)
                    known[key] = depths(built, data, placed)
                for pair, depth in known[key].items():
                    count, deepest = found.get((name, mode, *pair), (0, 0.0))
                    found[name, mode, *pair] = count + 1, max(deepest, depth)
    return found


@pytest.mark.parametrize("task", tasks.OWN)
def test_things_start_apart_but_for_the_listed_cases(task):
    """In 60 episodes of every mode and rule set the things more than 1 cm inside each other are those listed."""
    listed = {
        (name, mode, *sorted((case.first, case.second))): (case.episodes, case.depth)
        for case in tasks.get(task).overlaps
        for name in case.rules
        for mode in (*case.modes, *(HELD_OUT if "semantic" in case.modes else ()))
    }
    found = measure(task)
    assert {k: v[0] for k, v in found.items()} == {k: v[0] for k, v in listed.items()}
    for key, (_, depth) in found.items():
        assert depth == pytest.approx(listed[key][1], abs=0.002), key


def test_a_thing_put_into_another_is_found():
    """The measure sees a ball in the robot, a carton in the table and a carton in the floor."""
    for task, prim, pos, other in (
        ("football", "/World/Ball", (0.0, -2.0, 0.75), ROBOT),
        ("sit_sofa", "/World/Carton_1", (-2.6, 0.1, 0.22), "/World/CoffeeTable"),
        ("sit_sofa", "/World/Carton_1", (-1.0, 2.0, 0.15), None),
    ):
        built, spec = scene(task, "base"), tasks.get(task)
        data = mujoco.MjData(built.mj_model)
        spawn(built, spec, data)
        address = built.joint_qpos(prim)
        data.qpos[address : address + 3] = pos
        pairs = depths(built, data, {prim})
        assert pairs and all(prim in pair for pair in pairs)
        assert other is None or any(other in pair for pair in pairs)
