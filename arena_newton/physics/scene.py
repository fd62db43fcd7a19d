"""A USD stage becomes one Newton model with N worlds and the one MuJoCo model that both engines step.

Handles (bodies, joints, geoms, markers, frames) are found by prim path; of a task only the path of its layer is known.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import newton
import numpy as np
import warp as wp
from newton.solvers import mujoco as newton_mujoco
from pxr import Gf, Usd, UsdGeom

import arena_newton.kernels  # noqa: F401  (quiets Warp's module log)
from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.kernel_cache.kernel_loading import forward_only
from arena_newton.kernel_cache.narrowphase import write_out_pairs
from arena_newton.kernel_cache.solver_options import collide_boxes_as_mujoco
from arena_newton.physics.ball import BALL, BALL_SKIN, add_skin, set_restitution
from arena_newton.robot import g1
from arena_newton.tasks.base import SCENES, Quat, Vec3
from arena_newton.tasks.handles import ROBOT, BodyFrame, Latch, Marker, RobotHandles
from arena_newton.usd_scenes.dependencies import layers, stamp
from arena_newton.usd_scenes.shapes import check_buildable, open_stage

if TYPE_CHECKING:
    from arena_newton.rules.rule_types import RuleSet

__all__ = ["SCENES", "Scene", "load_scene", "scene_path"]

LATCH = "arena:latch"
"""Label of the equality constraint that is the latch."""
LATCH_RELEASE_DEG = 20.0
"""Angle from its rest at which a pressed handle releases the latch [deg] (the original's), where a stage's
`arena:releaseAngle` does not say otherwise."""
LATCH_SOLIMP = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Constraint impedance of the latch: at the default, the light handle softens it, 10 N·m turn the locked leaf 12°."""


def scene_path(task_or_path: str | Path) -> Path:
    """Path of the stage for a task name or a file.

    Raises:
        InputError: Neither a task's scene nor a readable file.
    """
    name = str(task_or_path)
    built_in = tasks.get(name).layer if name in tasks.names() else SCENES / name / "scene.usda"
    if built_in.is_file():
        return built_in
    path = Path(task_or_path)
    if path.suffix in {".usda", ".usd", ".usdc", ".usdz"} and path.is_file():
        return path
    raise InputError(f"{task_or_path}: no such scene file (expected a task name or an existing .usda file)")


@dataclass
class Scene:
    """A built scene: Newton model, MuJoCo model, and handles by prim path."""

    path: Path
    hands: str
    """`dex3` or `fixed`."""
    worlds: int
    device: wp.Device
    stage: Usd.Stage
    model: newton.Model
    """All worlds."""
    solver: newton.solvers.SolverMuJoCo
    mj_model: mujoco.MjModel
    """One world, as both engines step it."""
    body_ids: dict[str, int]
    """Prim path → MuJoCo body."""
    joint_ids: dict[str, int]
    """Prim path → MuJoCo joint."""
    body_to_newton: np.ndarray
    """int32 [worlds, nbody]: Newton body of each MuJoCo body (−1 for the world)."""
    geom_labels: list[str]
    """Prim path of each MuJoCo geom."""
    drive: g1.DriveGains
    latch: Latch | None = None
    """The door's latch, where the stage has one."""
    batch_taken: bool = False
    """A physics of engine `warp` steps the solver's own batch; the next one copies it."""
    ball_restitution: float | None = None
    """Coefficient of restitution of `/World/Ball`; None: no ball, or no rule set that says so."""

    def body_id(self, prim_path: str) -> int:
        """MuJoCo body of a rigid prim.

        Raises:
            InputError: The stage has no such rigid body.
        """
        if prim_path not in self.body_ids:
            raise InputError(f"{self.path}: prim {prim_path} is missing or is not a rigid body")
        return self.body_ids[prim_path]

    def has_body(self, prim_path: str) -> bool:
        """True if the stage has that rigid body."""
        return prim_path in self.body_ids

    def link(self, name: str) -> int:
        """MuJoCo body of a robot link by its name."""
        for path, body in self.body_ids.items():
            if path.startswith(f"{ROBOT}/") and path.rsplit("/", 1)[1] == name:
                return body
        raise InputError(f"{self.path}: robot link {name} is missing under {ROBOT}")

    def joint_qpos(self, prim_path: str) -> int:
        """Address in qpos of a joint prim, or of the free joint of a rigid prim."""
        return int(self.mj_model.jnt_qposadr[self._joint_of(prim_path)])

    def joint_qvel(self, prim_path: str) -> int:
        """Address in qvel of a joint prim, or of the free joint of a rigid prim."""
        return int(self.mj_model.jnt_dofadr[self._joint_of(prim_path)])

    def _joint_of(self, prim_path: str) -> int:
        if prim_path in self.joint_ids:
            return self.joint_ids[prim_path]
        body = self.body_id(prim_path)
        if self.mj_model.body_jntnum[body] != 1:
            raise InputError(f"{self.path}: prim {prim_path} has no free joint")
        return int(self.mj_model.body_jntadr[body])

    def mocap_id(self, prim_path: str) -> int:
        """MuJoCo mocap index of a fixture (its root or its `Frame`)."""
        frame = prim_path if prim_path in self.body_ids else f"{prim_path}/Frame"
        mocap = int(self.mj_model.body_mocapid[self.body_id(frame)])
        if mocap < 0:
            raise InputError(f"{self.path}: prim {prim_path} is not a fixture (Frame anchored by a fixed joint)")
        return mocap

    def geom_ids(self, prim_path: str) -> list[int]:
        """MuJoCo geoms at or under a prim."""
        found = [i for i, p in enumerate(self.geom_labels) if p == prim_path or p.startswith(prim_path + "/")]
        if not found:
            raise InputError(f"{self.path}: prim {prim_path} holds no collision geometry")
        return found

    def lowest(self, prim_path: str) -> float:
        """Height of the lowest point of an upright body's geoms in the body's frame [m], by their bounding boxes."""
        m = self.mj_model
        lowest = np.inf
        for geom in self.geom_ids(prim_path):
            if self.geom_labels[geom] == BALL_SKIN:
                continue
            w, x, y, z = m.geom_quat[geom]
            upward = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
            centre, half = m.geom_aabb[geom, :3], m.geom_aabb[geom, 3:]
            lowest = min(lowest, m.geom_pos[geom, 2] + upward @ centre - np.abs(upward) @ half)
        return float(lowest)

    def frame(self, name_or_path: str) -> BodyFrame:
        """A frame prim by path, or by its name under the robot, as a pose in the body that carries it."""
        return BodyFrame(*self._local_pose(self._find(name_or_path)))

    def marker(self, prim_path: str) -> Marker:
        """A marker prim as an oriented box in the body that carries it.

        Raises:
            InputError: The prim or its `arena:size` is missing.
        """
        prim = self._find(prim_path)
        size = prim.GetAttribute("arena:size").Get()
        if size is None:
            raise InputError(f"{self.path}: marker {prim_path} has no attribute arena:size")
        body, pos, quat = self._local_pose(prim)
        x, y, z = (0.5 * float(v) for v in size)
        return Marker(body, pos, quat, (x, y, z), bool(prim.GetAttribute("arena:round").Get()))

    def _find(self, name_or_path: str) -> Usd.Prim:
        if name_or_path.startswith("/"):
            prim = self.stage.GetPrimAtPath(name_or_path)
        else:
            base = self.stage.GetPrimAtPath(ROBOT)
            under = Usd.PrimRange(base) if base else ()
            prim = next((p for p in under if p.GetName() == name_or_path), None)
        if not prim:
            raise InputError(f"{self.path}: prim {name_or_path} is missing")
        return prim

    def _local_pose(self, prim: Usd.Prim) -> tuple[int, Vec3, Quat]:
        cache = UsdGeom.XformCache()
        carrier = prim
        while carrier and str(carrier.GetPath()) not in self.body_ids:
            carrier = carrier.GetParent()
        body = self.body_ids[str(carrier.GetPath())] if carrier else 0
        world = cache.GetLocalToWorldTransform(prim)
        local = world * cache.GetLocalToWorldTransform(carrier).GetInverse() if body else world
        transform = Gf.Transform(local)
        p, q = transform.GetTranslation(), transform.GetRotation().GetQuat()
        im = q.GetImaginary()
        return body, (p[0], p[1], p[2]), (q.GetReal(), im[0], im[1], im[2])

    @functools.cached_property
    def robot(self) -> RobotHandles:
        """Addresses of the robot."""
        m = self.mj_model
        by_name = {p.rsplit("/", 1)[1]: j for p, j in self.joint_ids.items() if p.startswith(ROBOT + "/")}
        actuator_of_joint = {int(m.actuator_trnid[a, 0]): a for a in range(m.nu)}
        missing = [n for n in g1.MUJOCO_JOINTS if n not in by_name]
        if missing:
            raise InputError(f"{self.path}: robot joint {missing[0]} is missing under {ROBOT}")
        body = [by_name[n] for n in g1.MUJOCO_JOINTS]
        hand = [by_name[n] for n in g1.HAND_JOINTS if n in by_name]
        root = self.link("pelvis")
        root_joint = int(m.body_jntadr[root])
        links = {p.rsplit("/", 1)[1]: b for p, b in self.body_ids.items() if p.startswith(ROBOT + "/")}
        named = {b for n, b in links.items() if any(word in n for word in g1.CRITICAL_BODY_WORDS)}
        critical = sorted(named - {b for n, b in links.items() if "ankle" in n or "foot" in n})
        return RobotHandles(
            root_body=root,
            root_qpos=int(m.jnt_qposadr[root_joint]),
            root_qvel=int(m.jnt_dofadr[root_joint]),
            joint_qpos=np.array([m.jnt_qposadr[j] for j in body], dtype=np.int32),
            joint_qvel=np.array([m.jnt_dofadr[j] for j in body], dtype=np.int32),
            joint_ctrl=np.array([actuator_of_joint[j] for j in body], dtype=np.int32),
            hand_qpos=np.array([m.jnt_qposadr[j] for j in hand], dtype=np.int32),
            hand_ctrl=np.array([actuator_of_joint[j] for j in hand], dtype=np.int32),
            bodies=tuple(sorted(links.values())),
            critical_bodies=tuple(critical),
            feet=tuple(links[f"{side}_ankle_roll_link"] for side in ("left", "right")),
        )


def _is_own(path: Path) -> bool:
    """True if a scene is the project's own: other scenes are checked before they are built."""
    return path.resolve().is_relative_to(SCENES.resolve())


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Turn an error of the importer about a foreign scene into one line that names the file."""
    try:
        yield
    except Exception as error:  # Newton and MuJoCo raise nearly anything
        if _is_own(path) or isinstance(error, InputError):
            raise
        reason = " ".join(str(error).split())[:200] or "no reason given"
        raise InputError(f"{path}: cannot be built ({type(error).__name__}: {reason})") from error


def _open_stage(path: Path, variant: str | None, hands: str) -> Usd.Stage:
    stage = open_stage(path, checked=not _is_own(path))
    stage.SetEditTarget(stage.GetSessionLayer())
    robot_prim = stage.GetPrimAtPath(ROBOT)
    if not robot_prim:
        raise InputError(f"{path}: prim {ROBOT} is missing")
    known_hands = robot_prim.GetVariantSet("hands").GetVariantNames()
    if hands not in known_hands:
        raise InputError(f"{path}: prim {ROBOT} has no hands {hands!r}, known are {' '.join(known_hands)}")
    robot_prim.GetVariantSet("hands").SetVariantSelection(hands)
    world = stage.GetPrimAtPath("/World")
    sets = world.GetVariantSets()
    if variant is None:
        return stage
    known = sets.GetVariantSet("semantics").GetVariantNames() if sets.HasVariantSet("semantics") else ()
    if variant in known:
        sets.GetVariantSet("semantics").SetVariantSelection(variant)
    elif variant != "base":
        raise InputError(f"{path}: prim /World has no variant {variant!r} in variant set 'semantics'")
    return stage


def _set_drives(builder: newton.ModelBuilder, drive: g1.DriveGains) -> None:
    gains: dict[str, tuple[float, float, float, float | None]] = {
        n: (drive.kp[i], drive.kd[i], drive.effort[i], drive.armature[i] if drive.armature else None)
        for i, n in enumerate(g1.MUJOCO_JOINTS)
    }
    finger = (drive.finger_kp, drive.finger_kd, drive.finger_effort, drive.finger_armature)
    gains |= dict.fromkeys(g1.HAND_JOINTS, finger)
    for joint, label in enumerate(builder.joint_label):
        name = label.rsplit("/", 1)[-1]
        if not label.startswith(ROBOT + "/") or name not in gains:
            continue
        dof = builder.joint_qd_start[joint]
        kp, kd, effort, armature = gains[name]
        builder.joint_target_mode[dof] = int(newton.JointTargetMode.POSITION)
        builder.joint_target_ke[dof] = kp
        builder.joint_target_kd[dof] = kd
        builder.joint_effort_limit[dof] = effort
        if armature is not None:
            builder.joint_armature[dof] = armature


def _free_fixtures(builder: newton.ModelBuilder) -> None:
    """Flag bodies that hang on the world by a fixed joint as kinematic, so that each world can pose its own."""
    for joint, kind in enumerate(builder.joint_type):
        if kind == newton.JointType.FIXED and builder.joint_parent[joint] == -1:
            builder.body_flags[builder.joint_child[joint]] = int(newton.BodyFlags.KINEMATIC)


def _add_latch(builder: newton.ModelBuilder, stage: Usd.Stage) -> tuple[int, float] | None:
    """Add the equality that locks a latched leaf; the handle's joint in the builder and its release angle [deg]."""
    for prim in stage.Traverse():
        if prim.HasAttribute("arena:latch") and prim.GetAttribute("arena:latch").Get():
            leaf = builder.joint_label.index(str(prim.GetPath()))
            hinge = f"{prim.GetPath().GetParentPath()}/HandleHinge"
            if hinge not in builder.joint_label:
                raise InputError(f"{stage.GetRootLayer().identifier}: {prim.GetPath()} has a latch but no HandleHinge")
            handle = builder.joint_label.index(hinge)
            # leaf = 0 + 0·handle: the leaf is held at its closed angle while the equality is active.
            newton_mujoco.add_equality_joint(
                builder, leaf, handle, polycoef=(0.0, 0.0), label=LATCH, enabled=True, solimp=LATCH_SOLIMP
            )
            own = prim.GetAttribute("arena:releaseAngle").Get()
            return handle, LATCH_RELEASE_DEG if own is None else float(own)
    return None


def _find_latch(scene: Scene, handle: int, release_deg: float) -> Latch:
    """The latch in the compiled model, whose other equalities a layer may have brought."""
    labels = scene.solver.model.mujoco.equality_constraint_label
    rows = scene.solver.mjc_eq_to_newton_eq.numpy()[0]
    equality = next(e for e, row in enumerate(rows) if row >= 0 and labels[row].endswith(LATCH))
    address = scene.joint_qpos(scene.solver.model.joint_label[handle])
    rest = float(scene.mj_model.qpos0[address])
    return Latch(equality, address, rest - math.radians(release_deg))


def _empty() -> newton.ModelBuilder:
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.rigid_gap = 0.0
    return builder


_OWN: dict[tuple[object, ...], newton.ModelBuilder] = {}
"""Models as the importer made them of the project's own scenes: that takes nearly all of a scene's building."""
_OTHERS: dict[tuple[object, ...], newton.ModelBuilder] = {}
"""The last few of other scenes, by their files: a variant is checked, compared and played one after the other."""
_MOST_OTHERS = 2


def _imported(stage: Usd.Stage, path: Path, variant: str | None, hands: str, drawn: bool) -> newton.ModelBuilder:
    """Model that Newton's importer makes of a stage; the same files are imported once per process."""
    own = _is_own(path)
    kept, files = (_OWN, ()) if own else (_OTHERS, tuple(stamp(file) for file in layers(path)))
    key = (path.resolve(), variant, hands, drawn, files)
    if key in kept:
        return copy.deepcopy(kept[key])
    if not own:
        check_buildable(stage, path)
    template = _empty()
    with _naming(path):
        template.add_usd(stage, enable_self_collisions=False, collapse_fixed_joints=False, load_visual_shapes=drawn)
    if len(_OTHERS) == _MOST_OTHERS and not own:
        del _OTHERS[next(iter(_OTHERS))]
    kept[key] = copy.deepcopy(template)
    return template


def load_scene(
    task: str | Path,
    *,
    worlds: int = 1,
    device: str | None = None,
    variant: str | None = "base",
    hands: str = "dex3",
    rules: RuleSet | None = None,
    drive: g1.DriveGains = g1.TWIST2_DRIVE,
    variant_file: str | Path | None = None,
    contacts_per_world: int = 96,
    constraints_per_world: int = 320,
    native: bool = False,
    drawn: bool = True,
) -> Scene:
    """Build a scene.

    Args:
        task: Task name, or path of a stage.
        device: Warp device of the Newton model.
        variant: Variant of the set `semantics` on `/World`; None keeps the layer's own selection.
        hands: `dex3` or `fixed`.
        rules: Rule set; decides the ball's restitution.
        drive: Gains of the robot's position drives.
        variant_file: A user's layer to open instead of the task's own scene.
        contacts_per_world: Contact buffer of engine `warp`.
        constraints_per_world: Constraint buffer of engine `warp`.
        native: The model is stepped by native MuJoCo; the batch's Warp solver is not allocated.
        drawn: The model also holds what is drawn but does not collide; without it MuJoCo's model is the same but for
            the numbers in its names, and an import takes half the time.

    Raises:
        InputError: The stage cannot be read or misses a prim that the robot needs.
    """
    forward_only()
    if not native:
        write_out_pairs()
    path = scene_path(variant_file or task)
    stage = _open_stage(path, variant, hands)

    template = _imported(stage, path, variant, hands, drawn)
    _set_drives(template, drive)
    _free_fixtures(template)
    latch = _add_latch(template, stage)
    if rules is not None:
        add_skin(template)

    def finalize(count: int) -> newton.Model:
        builder = _empty()
        builder.replicate(template, count)
        return builder.finalize(device=device)

    with _naming(path), wp.ScopedDevice(device), warnings.catch_warnings():
        # Fixtures hang on the world by one fixed joint each, on purpose.
        warnings.filterwarnings("ignore", message=".*outside articulations as standalone world roots.*")
        model = finalize(worlds)
        solver = newton.solvers.SolverMuJoCo(
            finalize(1) if native and worlds > 1 else model,
            njmax=constraints_per_world,
            nconmax=contacts_per_world,
            iterations=10,
            ls_iterations=20,
            solver="newton",
            integrator="implicitfast",
            cone="pyramidal",
            impratio=1.0,
            kinematic_switchable_roots=False,
            use_mujoco_cpu=native,
        )
    if not native:
        collide_boxes_as_mujoco(solver.mjw_model)
    m = solver.mj_model
    map_body = solver.mjc_body_to_newton.numpy()
    if native and worlds > 1:
        stride = model.body_count // worlds
        map_body = np.where(map_body[0] < 0, -1, map_body[0] + stride * np.arange(worlds)[:, None]).astype(np.int32)
    body_ids = {model.body_label[n]: b for b, n in enumerate(map_body[0]) if n >= 0}
    map_joint = solver.mjc_jnt_to_newton_jnt.numpy()[0]
    joint_ids = {model.joint_label[n]: j for j, n in enumerate(map_joint) if n >= 0}
    map_geom = solver.mjc_geom_to_newton_shape.numpy()[0]
    labels = solver.model.shape_label
    geom_labels = [labels[s] if s >= 0 else "" for s in map_geom[: m.ngeom]]

    scene = Scene(
        path=path,
        hands=hands,
        worlds=worlds,
        device=model.device,
        stage=stage,
        model=model,
        solver=solver,
        mj_model=m,
        body_ids=body_ids,
        joint_ids=joint_ids,
        body_to_newton=map_body,
        geom_labels=geom_labels,
        drive=drive,
    )
    if latch is not None:
        scene.latch = _find_latch(scene, *latch)
    if rules is not None and scene.has_body(BALL):
        scene.ball_restitution = rules.bounce(str(task))
        set_restitution(scene, scene.ball_restitution, float(m.opt.timestep))
    return scene
