"""Compiled scenes as the importer and MuJoCo make them, by prim path, and the differences of two in plain sentences."""

from __future__ import annotations

import contextlib
import functools
import gc
import io
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from pxr import Usd, UsdPhysics

from arena_newton import tasks
from arena_newton.cli.quiet import quiet_warp

if TYPE_CHECKING:
    from arena_newton.physics.scene import Scene

__all__ = ["Compiled", "Reported", "compiled", "compiled_changes", "lost_contacts", "own_compiled", "release"]

_ROBOT = "/World/Robot"
_GROUND = "Ground"
"""Name of the collider under every scene's robot."""
_CLOSE = 1e-4
"""Relative difference of numbers that are the same."""
_MOST_OF_A_THING = 4
"""Sentences about the bodies, joints or colliders of one thing; more are summed up."""
_OPTIONS = (
    "wind magnetic density viscosity timestep integrator cone jacobian solver iterations ls_iterations "
    "noslip_iterations tolerance impratio disableactuator o_margin o_solref o_solimp o_friction"
).split()
_BODY = {
    "mass": ("body_mass", ("physics:mass", "physics:density")),
    "inertia": ("body_inertia", ("physics:mass", "physics:density", "physics:diagonalInertia")),
    "principal axes": ("body_iquat", ("physics:principalAxes",)),
    "centre of mass": ("body_ipos", ("physics:centerOfMass",)),
    "gravity compensation": ("body_gravcomp", ("gravcomp",)),
}
"""Field of the model, and words by which a sentence already mentions it."""
_SIZE = tuple("radius size height width length axis points faceVertexIndices scaled approximation".split())
_GEOM = {
    "type": ("geom_type", _SIZE),
    "size": ("geom_size", _SIZE),
    "position": ("geom_pos", ("moved", "turned", *_SIZE)),
    "orientation": ("geom_quat", ("turned", *_SIZE)),
    "friction": ("geom_friction", ("riction",)),
    "contact directions": ("geom_condim", ("condim",)),
    "contact priority": ("geom_priority", ("priority",)),
    "contact solref": ("geom_solref", ("solref",)),
    "contact solimp": ("geom_solimp", ("solimp",)),
    "contact mixing": ("geom_solmix", ("solmix",)),
    "contact margin": ("geom_margin", ("margin", "contactOffset")),
    "contact gap": ("geom_gap", ("gap",)),
}
_JOINT = {
    "type": ("jnt_type", ("axis",)),
    "axis": ("jnt_axis", ("axis", "localRot", "localPos")),
    "anchor": ("jnt_pos", ("localPos", "localRot")),
    "limits": ("jnt_range", ("imit", "localRot")),
    "limited": ("jnt_limited", ("imit",)),
    "stiffness": ("jnt_stiffness", ("tiffness",)),
    "limit solref": ("jnt_solref", ("solref",)),
    "limit solimp": ("jnt_solimp", ("solimp",)),
    "torque limit": ("jnt_actfrcrange", ("orce",)),
    "limit margin": ("jnt_margin", ("margin",)),
}
_DOF = {
    "damping": ("dof_damping", ("damping",)),
    "armature": ("dof_armature", ("armature",)),
    "friction": ("dof_frictionloss", ("friction",)),
}
_ACTUATOR = {
    "drive's gain": ("actuator_gainprm", ("tiffness",)),
    "drive's bias": ("actuator_biasprm", ("tiffness", "damping")),
    "drive's torque": ("actuator_forcerange", ("orce",)),
    "drive's gear": ("actuator_gear", ("gear",)),
    "drive's range": ("actuator_ctrlrange", ("ctrl",)),
}

Facts = dict[str, dict[str, Any]]
"""Prim path → name of a fact → value."""


@dataclass(frozen=True)
class Reported:
    """Changes reported so far, so that the cause of a change and its effect are not reported twice."""

    sentences: tuple[str, ...] = ()

    def about(self, path: str, words: Iterable[str]) -> bool:
        """True if a sentence names the prim together with one of the words."""
        return any(f" {path}: " in text and any(word in text for word in words) for text in self.sentences)

    def gravity(self) -> bool:
        """True if a sentence reports the value of gravity."""
        one_more = any("one more PhysicsScene" in text for text in self.sentences)
        return not one_more and any(text.startswith("gravity: ") for text in self.sentences)

    def gone(self, path: str) -> bool:
        """True if a sentence reports that the prim is gone."""
        return any(text.endswith(f" {path} is gone") for text in self.sentences)


@dataclass(frozen=True)
class Compiled:
    """Facts of one compiled scene."""

    gravity: tuple[float, ...]
    """[m/s²]"""
    options: dict[str, Any]
    bodies: Facts
    joints: Facts
    geoms: Facts
    meets: frozenset[tuple[str, str]]
    """Pairs of geoms, by prim path in order, that MuJoCo tests for contacts."""
    colliders: frozenset[str]
    """Prims of the stage that are made to collide, whether or not they do."""


def compiled(path: str | Path, variant: str | None = None) -> Compiled:
    """Build a scene on the CPU and collect its facts.

    Args:
        path: A layer that passes `validate`, or a task.
        variant: Variant of `semantics`; None: the layer's own selection.

    Raises:
        InputError: The scene cannot be built.
    """
    from arena_newton.physics.scene import load_scene

    quiet_warp()
    # The importer repeats its remarks when the scene is built to be run.
    dropped = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(dropped), contextlib.redirect_stderr(dropped):
        warnings.simplefilter("ignore")
        scene = load_scene(path, worlds=1, device="cpu", native=True, variant=variant, drawn=False)
    m = scene.mj_model
    options: dict[str, Any] = {name: np.array(getattr(m.opt, name)) for name in _OPTIONS}
    options |= {
        f"MuJoCo's {name.removeprefix(prefix).lower()} flag": np.array(bool(flags & bit.value) == on)
        for flags, bits, prefix, on in (
            (m.opt.disableflags, mujoco.mjtDisableBit, "mjDSBL_", False),
            (m.opt.enableflags, mujoco.mjtEnableBit, "mjENBL_", True),
        )
        for name, bit in bits.__members__.items()
        if name.startswith(prefix)
    }
    options |= {"equality constraints": np.array(m.neq), "tendons": np.array(m.ntendon)}
    prims = Usd.PrimRange(scene.stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    colliders = frozenset(str(prim.GetPath()) for prim in prims if prim.HasAPI(UsdPhysics.CollisionAPI))
    return Compiled(
        gravity=tuple(float(value) for value in m.opt.gravity),
        options=options,
        bodies=_bodies(scene),
        joints=_joints(scene),
        geoms={
            label: {name: getattr(m, field)[geom].copy() for name, (field, _) in _GEOM.items()}
            for geom, label in enumerate(scene.geom_labels)
            if label
        },
        meets=_meets(scene),
        colliders=colliders,
    )


def release() -> None:
    """Release the stages that were built: the importer leaves reference cycles that hold them.

    USD would otherwise keep using the old layers after the files change.
    """
    gc.collect()


def own_compiled(task: str, variant: str | None) -> Compiled:
    """The facts of a task's own scene, read once per process."""
    return _kept(tasks.get(task).layer, variant)


_kept = functools.lru_cache(maxsize=4)(compiled)


def _bodies(scene: Scene) -> Facts:
    m = scene.mj_model
    paths = {body: path for path, body in scene.body_ids.items()}
    facts: Facts = {}
    for path, body in scene.body_ids.items():
        facts[path] = {name: getattr(m, field)[body].copy() for name, (field, _) in _BODY.items()}
        facts[path]["free directions"] = np.array(m.body_dofnum[body])
        facts[path]["carrier"] = paths.get(int(m.body_parentid[body]), "the world")
    return facts


def _joints(scene: Scene) -> Facts:
    m = scene.mj_model
    drives = {int(m.actuator_trnid[actuator, 0]): actuator for actuator in range(m.nu)}
    facts: Facts = {}
    for path, joint in scene.joint_ids.items():
        if not path.startswith("/"):
            continue  # the importer's own free joints
        first = int(m.jnt_dofadr[joint])
        facts[path] = {name: getattr(m, field)[joint].copy() for name, (field, _) in _JOINT.items()}
        facts[path] |= {name: getattr(m, field)[first].copy() for name, (field, _) in _DOF.items()}
        if joint in drives:
            actuator = drives[joint]
            facts[path] |= {name: getattr(m, field)[actuator].copy() for name, (field, _) in _ACTUATOR.items()}
    return facts


def _meets(scene: Scene) -> frozenset[tuple[str, str]]:
    """MuJoCo's own filter: contact bits, excluded bodies, welded bodies, parent and child."""
    m = scene.mj_model
    body, weld = m.geom_bodyid, m.body_weldid[m.geom_bodyid]
    above = m.body_weldid[m.body_parentid[weld]]
    bits = (m.geom_contype[:, None] & m.geom_conaffinity[None, :]) != 0
    pairs = (bits | bits.T) & (weld[:, None] != weld[None, :])
    if not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        child = (weld[:, None] == above[None, :]) & (weld[:, None] != 0) & (weld[None, :] != 0)
        pairs &= ~(child | child.T)
    if m.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
        pairs[:] = False
    excluded = {(int(row) >> 16, int(row) & 0xFFFF) for row in m.exclude_signature}
    filtered = [
        (i, j)
        for i, j in zip(*np.nonzero(np.triu(pairs, 1)), strict=True)
        if (body[i], body[j]) not in excluded and (body[j], body[i]) not in excluded
    ]
    return frozenset(
        (min(a, b), max(a, b))
        for i, j in (*filtered, *zip(m.pair_geom1, m.pair_geom2, strict=True))
        if (a := scene.geom_labels[i]) and (b := scene.geom_labels[j])
    )


def compiled_changes(theirs: Compiled, ours: Compiled, reported: Reported, needed: Iterable[str] = ()) -> Iterator[str]:
    """Changes of the compiled model that are not reported already.

    Args:
        theirs: A variant.
        ours: Its task's own scene, in the same variant of `semantics`.
        reported: Sentences about the variant's layer.
        needed: Prims that the task needs, which are called rule objects.

    Yields:
        Sentences such as `rule object: /World/Ball/Collider: friction is (0, 0, 0), not (1, 0.005, 0.0001)`.
    """
    if not _same(theirs.gravity, ours.gravity) and not reported.gravity():
        yield f"gravity: is {_shown(theirs.gravity)} m/s², not {_shown(ours.gravity)} m/s²"
    yield from _contact_changes(theirs, ours)
    for name, old in ours.options.items():
        if not _same(theirs.options[name], old):
            yield f"physics: {name} is {_shown(theirs.options[name])}, not {_shown(old)}"
    roots = tuple(needed)
    words = {name: word for table in (_BODY, _GEOM, _JOINT, _DOF, _ACTUATOR) for name, (_, word) in table.items()}
    for their, our, noun in (
        (theirs.bodies, ours.bodies, "bodies"),
        (theirs.joints, ours.joints, "joints"),
        (theirs.geoms, ours.geoms, "colliders"),
    ):
        grouped: dict[tuple[str, str, str], list[tuple[str, str]]] = {}
        for path, old in our.items():
            if path not in their:
                if not reported.gone(path) and not reported.about(path, ("collisionEnabled", "Enabled is")):
                    text = f"no longer one of the {noun} of the model"
                    grouped.setdefault((_kind(path, roots), _top(path), text), []).append((path, "part in the model"))
                continue
            new = their[path]
            for name in dict.fromkeys((*old, *new)):
                if _same(new.get(name), old.get(name)) or reported.about(path, words.get(name, (name,))):
                    continue
                text = f"{name} is {_shown(new.get(name))}, not {_shown(old.get(name))}"
                grouped.setdefault((_kind(path, roots), _top(path), text), []).append((path, name))
        yield from _grouped(grouped, noun)


def _grouped(changes: dict[tuple[str, str, str], list[tuple[str, str]]], noun: str) -> Iterator[str]:
    """One sentence for the prims of a thing that change alike; a thing that changes all over is summed up."""
    things: dict[tuple[str, str], dict[tuple[str, ...], list[str]]] = {}
    names: dict[tuple[str, str], dict[str, set[str]]] = {}
    for (kind, top, text), found in changes.items():
        paths = tuple(path for path, _ in found)
        things.setdefault((kind, top), {}).setdefault(paths, []).append(text)
        for path, name in found:
            names.setdefault((kind, top), {}).setdefault(name, set()).add(path)
    for (kind, top), reported in things.items():
        if len(reported) > _MOST_OF_A_THING:
            shown = (f"{name} of {len(paths)}" for name, paths in names[kind, top].items())
            yield f"{kind}: {top}: {noun} differ: {', '.join(shown)}"
            continue
        for paths, texts in reported.items():
            what = paths[0] if len(paths) == 1 else f"{top} ({len(paths)} {noun})"
            yield f"{kind}: {what}: {', '.join(texts)}"


def _contact_changes(theirs: Compiled, ours: Compiled) -> Iterator[str]:
    """Pairs that collide now and did not, and pairs that no longer do, where both scenes have them."""
    known = set(ours.geoms) & set(theirs.geoms) | set(ours.geoms) & theirs.colliders
    lost = _by_thing(pair for pair in ours.meets - theirs.meets if set(pair) <= known)
    won = _by_thing(pair for pair in theirs.meets - ours.meets if set(pair) <= known)
    before, after = _by_thing(ours.meets), _by_thing(theirs.meets)
    alone: list[str] = []
    for thing in sorted({thing for pair in lost for thing in pair}):
        if not any(thing in pair for pair in after):
            yield f"collisions: {thing} no longer meets anything"
            alone.append(thing)
    for (a, b), pairs in lost.items():
        if a in alone or b in alone:
            continue
        if (a, b) not in after:
            yield f"collisions: {_two(a, b)} no longer meet"
        else:
            count = len(before[a, b])
            yield f"collisions: {_two(a, b)} no longer meet in {len(pairs)} of {count} pairs of colliders"
    for (a, b), pairs in won.items():
        yield f"collisions: {_two(a, b)} meet in {len(pairs)} pairs of colliders that did not"


def lost_contacts(theirs: Compiled, ours: Compiled, needed: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Needed things that no longer meet each other or the ground, as (prim path, message).

    Args:
        theirs: A variant.
        ours: Its task's own scene, in the same variant of `semantics`.
        needed: Prims that the task needs; the robot and the ground are needed always.
    """
    grounds = {path for path in ours.geoms if path.endswith(f"/{_GROUND}")}
    roots = (_ROBOT, *grounds, *needed)

    def thing(path: str) -> str | None:
        return max((root for root in roots if path == root or path.startswith(f"{root}/")), key=len, default=None)

    there = set(theirs.geoms) | theirs.colliders
    before: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for pair in ours.meets:
        a, b = thing(pair[0]), thing(pair[1])
        if a and b and set(pair) <= there:
            # A robot before what it meets, and the ground last.
            first, second = sorted((a, b), key=lambda name: (name in grounds, name != _ROBOT, name))
            before.setdefault((first, second), set()).add(pair)
    for (a, b), pairs in sorted(before.items(), key=lambda kv: (kv[0][0] != _ROBOT, kv[0][1] not in grounds, kv)):
        gone = pairs - theirs.meets
        if gone == pairs:
            yield a, f"no longer meets {b}: expected collisions as in the task's scene"
        elif gone and a == _ROBOT and b in grounds:
            lost = sorted(label for pair in gone for label in pair if label not in grounds)
            more = f" (nor do {len(lost) - 1} more)" if len(lost) > 1 else ""
            yield lost[0], f"no longer meets {b}{more}: expected collisions of the whole robot"


def _by_thing(pairs: Iterable[tuple[str, str]]) -> dict[tuple[str, str], list[tuple[str, str]]]:
    found: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for pair in sorted(pairs):
        a, b = sorted((_top(pair[0]), _top(pair[1])))
        found.setdefault((a, b), []).append(pair)
    return found


def _two(a: str, b: str) -> str:
    return f"parts of {a}" if a == b else f"{a} and {b}"


def _top(path: str) -> str:
    """The thing that a prim is part of: the child of the world, or of the room."""
    parts = path.split("/")
    return "/".join(parts[: 4 if len(parts) > 3 and parts[2] == "Room" else 3])


def _kind(path: str, needed: Iterable[str]) -> str:
    if path == _ROBOT or path.startswith(f"{_ROBOT}/"):
        return "robot"
    if any(path == root or path.startswith(f"{root}/") for root in needed):
        return "rule object"
    return "object"


def _same(new: Any, old: Any) -> bool:
    if new is None or old is None or isinstance(old, str):
        return bool(new is old or new == old)
    if not np.issubdtype(np.asarray(old).dtype, np.floating):
        return bool(np.array_equal(new, old))
    one, other = np.asarray(new, dtype=np.float64), np.asarray(old, dtype=np.float64)
    return one.shape == other.shape and bool((np.abs(one - other) <= 1e-9 + _CLOSE * np.abs(other).max()).all())


def _shown(value: Any) -> str:
    if value is None or isinstance(value, str):
        return value or "none"
    numbers = np.trim_zeros(np.ravel(np.asarray(value, dtype=np.float64)), "b")
    if getattr(value, "dtype", None) == np.bool_ and np.ndim(value) == 0:
        return "on" if value else "off"
    if np.ndim(value) == 0:
        return f"{float(value):.6g}"
    shown = (numbers if numbers.size else (0.0,)) if np.size(value) > 4 else np.ravel(value)
    return f"({', '.join(f'{float(number):.5g}' for number in shown)})"
