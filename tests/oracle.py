"""Does a tracker drive our G1 as it drives its own MJCF in plain MuJoCo? `python tests/oracle.py`.

One stream of canonical actions per reference goes to both sides: (a) the lab of this package, engine `mujoco`, through
`TrackerLoop`; (b) the official MJCF in plain MuJoCo with the same drive gains, physics step and tracker class. The
oracle side converts 40 numbers into the 35 of the mimic command by NumPy code of its own (`MimicCommand`), not by the
kernel under test.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
import tyro

from arena_newton import rule_sets, trackers
from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import FEET
from arena_newton.trackers.evaluation.lab import Lab, Start, WorldKind
from arena_newton.trackers.evaluation.suite import Cell, clip_cells, tabulate
from arena_newton.trackers.motions import primitives
from arena_newton.tracking import TrackerLoop

__all__ = [
    "ActionStream",
    "MimicCommand",
    "Options",
    "Row",
    "Track",
    "action_streams",
    "compare",
    "load_official",
    "main",
    "measure_track",
    "row_table",
    "run_oracle",
    "run_ours",
]

PROG = "python tests/oracle.py"
FALL_TILT = 60.0
"""A pelvis tilted beyond this has fallen [deg]."""
FALL_HEIGHT = 0.3
"""A pelvis below this has fallen [m]; the squat goes to 0.45 m."""


@dataclass(frozen=True)
class ActionStream:
    """A named reference."""

    name: str
    """Its name in tables."""
    actions: np.ndarray
    """Canonical actions, float32, shape [ticks, 40]."""


@dataclass(frozen=True)
class Row:
    """One reference on both sides; each measure for `ours` and for the `oracle`."""

    reference: str
    """Name of the reference."""
    seconds: float
    """Length [s]."""
    fell_ours: float | None
    """Time of the fall [s], None without one."""
    fell_oracle: float | None
    """Time of the fall [s], None without one."""
    error_ours: float
    """Mean absolute joint error until the end or the fall, 29 joints [rad]."""
    error_oracle: float
    """The same in plain MuJoCo [rad]."""
    legs_ours: float
    """Mean absolute joint error of the legs [rad]."""
    legs_oracle: float
    """The same in plain MuJoCo [rad]."""
    drift_ours: float
    """Distance of the root from the reference's at the end, in the plane [m]."""
    drift_oracle: float
    """The same in plain MuJoCo [m]."""
    yaw_ours: float
    """Heading minus the reference's at the end [deg]."""
    yaw_oracle: float
    """The same in plain MuJoCo [deg]."""

    @property
    def ratio(self) -> float:
        """Our mean joint error divided by the oracle's."""
        return self.error_ours / self.error_oracle

    @property
    def falls_equal(self) -> bool:
        """Both sides fell, or neither."""
        return (self.fell_ours is None) == (self.fell_oracle is None)


@dataclass
class Track:
    """Motion of one side under one reference."""

    joints: np.ndarray
    """Joint positions after each tick [rad], MuJoCo order, shape [ticks, 29]."""
    position: np.ndarray
    """Root position after each tick [m], shape [ticks, 3]."""
    quat: np.ndarray
    """Root orientation after each tick, wxyz, shape [ticks, 4]."""
    target: np.ndarray
    """Root position of the reference after each tick [m], shape [ticks, 3]."""
    target_quat: np.ndarray
    """Root orientation of the reference after each tick, wxyz, shape [ticks, 4]."""


def _matrix(quat: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, dtype=float))
    return out.reshape(3, 3)


def _yaw(rotation: np.ndarray) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _wrap(angle: float) -> float:
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)


class MimicCommand:
    """Converts canonical actions to TWIST2's command for one world, written from the schema, float64.

    The action's displacement is given in the frame of its own root orientation; its height is absolute. The world
    displacement d is the one whose first two components in that frame are the action's and whose world z is the
    difference of heights.
    """

    def __init__(self, position: np.ndarray, quat: np.ndarray):
        """Anchor at the robot's pose."""
        rotation = _matrix(quat)
        yaw = _yaw(rotation)
        c, s = np.cos(yaw), np.sin(yaw)
        self.heading = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self.position, self.rotation = np.array(position, dtype=float), rotation
        self._yaw = yaw
        self._height: float | None = None
        self._joints: np.ndarray | None = None
        self.joint_vel = np.zeros(29)

    def advance(self, action: np.ndarray) -> np.ndarray:
        """Execute one action; returns the mimic command, shape [35]."""
        action = np.asarray(action, dtype=float)
        columns = action[3:9].reshape(3, 2)
        first = columns[:, 0] / np.linalg.norm(columns[:, 0])
        second = columns[:, 1] - (first @ columns[:, 1]) * first
        second /= np.linalg.norm(second)
        r = self.rotation = self.heading @ np.stack([first, second, np.cross(first, second)], axis=1)
        rise = 0.0 if self._height is None else action[2] - self._height
        self._height = action[2]
        frame = np.stack([r[:, 0], r[:, 1], [0.0, 0.0, 1.0]])
        moved = np.linalg.solve(frame, [action[0], action[1], rise])
        self.position = np.array([*(self.position + moved)[:2], action[2]])
        yaw = _yaw(r)
        rate = _wrap(yaw - self._yaw) / g1.TICK
        self._yaw = yaw
        joints = np.zeros(29)
        joints[list(g1.CANONICAL_TO_MUJOCO)] = action[9:38]
        self.joint_vel = np.zeros(29) if self._joints is None else (joints - self._joints) / g1.TICK
        self._joints = joints
        roll, pitch = np.arctan2(r[2, 1], r[2, 2]), np.arcsin(np.clip(-r[2, 0], -1.0, 1.0))
        return np.concatenate([action[:2] / g1.TICK, [action[2], roll, pitch, rate], joints])

    @property
    def quat(self) -> np.ndarray:
        """Target orientation, wxyz, shape [4]."""
        out = np.zeros(4)
        mujoco.mju_mat2Quat(out, self.rotation.ravel())
        return out


def load_official(mjcf: str | Path, drive: g1.DriveGains = g1.TWIST2_DRIVE, dt: float = 0.005) -> mujoco.MjModel:
    """Compile the official MJCF without its meshes and with implicit PD drives.

    Every link has an explicit inertia, so that masses stay; without meshes the four spheres under each foot and the
    cylinders of the shoulders collide. The file's floor, torque ranges, armature and solver stay as they are.

    Args:
        mjcf: `g1_sim2sim_29dof.xml`.
        drive: Gains of the position servos.
        dt: Physics step [s].

    Raises:
        InputError: The file is missing, unreadable or not a G1 with 29 joints.
    """
    path = Path(mjcf)
    if not path.is_file():
        raise InputError(f"--mjcf {path}: no such file")
    try:
        tree = ElementTree.fromstring(path.read_text())
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise InputError(f"--mjcf {path}: not a readable XML file ({error})") from None
    worldbody = tree.find("worldbody")
    if worldbody is None:
        raise InputError(f"--mjcf {path}: holds no worldbody, expected an MJCF")
    for parent in tree.iter():
        for child in list(parent):
            if (child.tag == "mesh" and parent.tag == "asset") or (child.tag == "geom" and child.get("mesh")):
                parent.remove(child)
    if not any(geom.get("type") == "plane" for geom in tree.iter("geom")):
        attributes = {"name": "floor", "type": "plane", "size": "0 0 0.01", "condim": "3"}
        ElementTree.SubElement(worldbody, "geom", attributes)
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(tree, encoding="unicode"))
        motors = {motor.target: motor for motor in spec.actuators}
        for i, name in enumerate(g1.MUJOCO_JOINTS):
            motors[name].set_to_position(kp=drive.kp[i], kv=drive.kd[i])
        spec.option.timestep = dt
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model = spec.compile()
    except KeyError as error:
        raise InputError(f"--mjcf {path}: no motor for joint {error.args[0]}") from None
    except ValueError as error:
        raise InputError(f"--mjcf {path}: MuJoCo cannot compile it ({' '.join(str(error).split())})") from None
    for name in ("pelvis", *FEET):
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) < 0:
            raise InputError(f"--mjcf {path}: no body {name}")
    return model


def action_streams(clips: Sequence[str | Path] = (), clip_seconds: float | None = None) -> list[ActionStream]:
    """Standing 8 s, walking at 0.3 m/s, a squat to 0.45 m, and clips, of which `clip_seconds` keeps the start."""
    scripts = {
        "stand 8 s": primitives.stand(8.0),
        "walk 0.3 m/s": primitives.walk(0.3, seconds=8.0),
        "squat to 0.45 m": primitives.squat(0.45),
    }
    cells = [Cell(name, "oracle", script.seconds, script) for name, script in scripts.items()]
    for cell in clip_cells([Path(path) for path in clips]):
        kept = cell.ticks if clip_seconds is None else round(clip_seconds / g1.TICK)
        actions = np.asarray(cell.actions)[:kept]
        cells.append(dataclasses.replace(cell, seconds=len(actions) * g1.TICK, actions=actions))
    table = tabulate(cells, torch.device("cpu")).actions.numpy()
    return [ActionStream(cell.name, table[: cell.ticks, i]) for i, cell in enumerate(cells)]


def _tracks(streams: Sequence[ActionStream], history: Sequence[tuple[np.ndarray, ...]]) -> list[Track]:
    """Rows of every tick as one track per reference, cut to its length."""
    columns = [np.stack(column) for column in zip(*history, strict=True)]
    return [Track(*(c[: len(s.actions), w] for c in columns)) for w, s in enumerate(streams)]


def _padded(streams: Sequence[ActionStream]) -> np.ndarray:
    """Actions of all references, short ones held without displacement; shape [ticks, references, 40]."""
    ticks = max(len(s.actions) for s in streams)
    out = np.empty((ticks, len(streams), 40), dtype=np.float32)
    for w, stream in enumerate(streams):
        out[:, w] = stream.actions[-1]
        out[len(stream.actions) :, w, ACTION["root_xy_delta"]] = 0.0
        out[: len(stream.actions), w] = stream.actions
    return out


def _with_startup(streams: Sequence[ActionStream]) -> tuple[np.ndarray, int]:
    """Actions after the start-up of an episode, shape [ticks, references, 40], and the start-up's length [ticks]."""
    startup = rule_sets.get("paper").startup.ticks
    standing = np.tile(STAND_ACTION, (startup, len(streams), 1))
    return np.concatenate([standing, _padded(streams)]), startup


def run_ours(
    checkpoint: str | Path, streams: Sequence[ActionStream], *, tracker: str = "twist2", fast: bool = True
) -> list[Track]:
    """Play references in the lab, each in a world of one batch."""
    worlds = len(streams)
    driver = trackers.get(tracker, checkpoint)
    watched, every = np.zeros(worlds, dtype=bool), np.ones(worlds, dtype=bool)
    lab = Lab([WorldKind()] * worlds, watched, drive=driver.drive, rate=driver.rate(fast=fast), engine="mujoco")
    root = np.tile([0.0, 0.0, g1.SPAWN_HEIGHT, 1.0, 0.0, 0.0, 0.0], (worlds, 1))
    lab.start(Start(root, np.tile(g1.DEFAULT_POSE, (worlds, 1)), {}, np.full((worlds, 3), np.nan)))
    loop = TrackerLoop(lab.physics, lab.scene.robot, driver)
    loop.fresh(every, prefill=True)
    loop.anchor(every)
    actions, startup = _with_startup(streams)
    history, at = [], lab.root_q
    for tick, action in enumerate(actions):
        if tick == startup:
            loop.anchor(every)
        loop.tick(torch.from_numpy(action), every)
        lab.physics.step()
        if tick >= startup:
            qpos = lab.physics.qpos.numpy().astype(float)
            target = (loop.reference.position.numpy().astype(float), loop.reference.quat.numpy().astype(float))
            joints = qpos[:, lab.scene.robot.joint_qpos]
            history.append((joints, qpos[:, at : at + 3], qpos[:, at + 3 : at + 7], *target))
    lab.physics.close()
    return _tracks(streams, history)


def run_oracle(
    checkpoint: str | Path,
    mjcf: str | Path,
    streams: Sequence[ActionStream],
    *,
    tracker: str = "twist2",
    fast: bool = True,
    model: mujoco.MjModel | None = None,
) -> list[Track]:
    """Play references on the official MJCF in plain MuJoCo, after the start-up of an episode.

    Args:
        checkpoint: Weights of the tracker.
        mjcf: The official MJCF.
        streams: References.
        tracker: Name of the tracker.
        fast: The tracker's fast physics rate.
        model: A changed model instead of the file's, to find what makes a difference.
    """
    driver = trackers.get(tracker, checkpoint)
    rate = driver.rate(fast=fast)
    m = model if model is not None else load_official(mjcf, driver.drive, rate.dt)
    joints = [m.joint(n) for n in g1.MUJOCO_JOINTS]
    q_of, v_of = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    actuator = {int(m.actuator_trnid[a, 0]): a for a in range(m.nu)}
    ctrl_of = [actuator[int(j.id)] for j in joints]
    sims = [mujoco.MjData(m) for _ in streams]
    for d in sims:
        d.qpos[:3], d.qpos[3:7] = (0.0, 0.0, g1.SPAWN_HEIGHT), (1.0, 0.0, 0.0, 0.0)
        d.qpos[q_of] = g1.DEFAULT_POSE
    driver.bind(len(streams), torch.device("cpu"))

    def anchor() -> list[MimicCommand]:
        return [MimicCommand(d.qpos[:3], d.qpos[3:7]) for d in sims]

    def rows(values: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.stack(values).astype(np.float32))

    commands, history = anchor(), []
    stream, startup = _with_startup(streams)
    for tick, actions in enumerate(stream):
        if tick == startup:
            commands = anchor()
        mimic = rows([c.advance(a) for c, a in zip(commands, actions, strict=True)])
        velocity, quat = rows([c.joint_vel for c in commands]), rows([c.quat for c in commands])
        command = TrackerCommand(mimic=mimic, joints=mimic[:, 6:], joint_vel=velocity, quat=quat)
        state = RobotState(
            quat=rows([d.qpos[3:7] for d in sims]),
            ang_vel_body=rows([d.qvel[3:6] for d in sims]),
            joint_pos=rows([d.qpos[q_of] for d in sims]),
            joint_vel=rows([d.qvel[v_of] for d in sims]),
        )
        if tick == 0:
            driver.prefill(command, state)
        targets = driver.step(command, state).numpy()
        for d, target in zip(sims, targets, strict=True):
            d.ctrl[ctrl_of] = target
            mujoco.mj_step(m, d, rate.substeps)
        if tick >= startup:
            history.append(
                (
                    np.stack([d.qpos[q_of] for d in sims]),
                    np.stack([d.qpos[:3] for d in sims]),
                    np.stack([d.qpos[3:7] for d in sims]),
                    np.stack([c.position for c in commands]),
                    np.stack([c.quat for c in commands]),
                )
            )
    return _tracks(streams, history)


class TrackErrors(NamedTuple):
    """Errors of one side, as in `Row`."""

    fell: float | None
    error: float
    legs: float
    drift: float
    yaw: float


def measure_track(stream: ActionStream, track: Track) -> TrackErrors:
    """Errors of a track until its end or its fall."""
    x, y = track.quat[:, 1], track.quat[:, 2]
    tilt = np.degrees(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))
    down = np.flatnonzero((tilt > FALL_TILT) | (track.position[:, 2] < FALL_HEIGHT) | ~np.isfinite(tilt))
    end = int(down[0]) + 1 if down.size else len(tilt)
    wanted = stream.actions[:end, 9:38][:, list(g1.MUJOCO_TO_CANONICAL)]
    error = np.abs(track.joints[:end] - wanted)
    drift = float(np.linalg.norm(track.position[end - 1, :2] - track.target[end - 1, :2]))
    yaw = _yaw(_matrix(track.quat[end - 1])) - _yaw(_matrix(track.target_quat[end - 1]))
    fell = end * g1.TICK if down.size else None
    legs = float(error[:, list(g1.LEGS)].mean())
    return TrackErrors(fell, float(error.mean()), legs, drift, float(np.degrees(_wrap(yaw))))


def compare(
    checkpoint: str | Path,
    mjcf: str | Path,
    clips: Sequence[str | Path] = (),
    *,
    tracker: str = "twist2",
    fast: bool = True,
    clip_seconds: float | None = None,
) -> list[Row]:
    """Play the same references on both sides.

    Args:
        checkpoint: Weights of the tracker.
        mjcf: The official MJCF.
        clips: Motion clips in addition to standing, walking and the squat.
        tracker: Name of the tracker.
        fast: The tracker's fast physics rate instead of its own.
        clip_seconds: Length of the part of each clip that is played, from its start [s]; the whole clip by default.

    Returns:
        One row per reference.

    Raises:
        InputError: A file is missing or cannot be used.
    """
    load_official(mjcf)  # an unfit file is reported before anything is played
    streams = action_streams(clips, clip_seconds)
    oracle = run_oracle(checkpoint, mjcf, streams, tracker=tracker, fast=fast)
    ours = run_ours(checkpoint, streams, tracker=tracker, fast=fast)
    rows = []
    for stream, a, b in zip(streams, ours, oracle, strict=True):
        x, y = measure_track(stream, a), measure_track(stream, b)
        rows.append(
            Row(
                reference=stream.name,
                seconds=len(stream.actions) * g1.TICK,
                fell_ours=x.fell,
                fell_oracle=y.fell,
                error_ours=x.error,
                error_oracle=y.error,
                legs_ours=x.legs,
                legs_oracle=y.legs,
                drift_ours=x.drift,
                drift_oracle=y.drift,
                yaw_ours=x.yaw,
                yaw_oracle=y.yaw,
            )
        )
    return rows


def row_table(rows: Sequence[Row]) -> str:
    """Markdown table; each cell holds ours / oracle."""

    def fell(at: float | None) -> str:
        return "no" if at is None else f"{at:.1f} s"

    lines = [
        "| reference | s | fell | joint error [rad] | legs [rad] | ratio | root xy error [m] | yaw error [deg] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r.reference} | {r.seconds:.1f} | {fell(r.fell_ours)} / {fell(r.fell_oracle)} "
            f"| {r.error_ours:.4f} / {r.error_oracle:.4f} | {r.legs_ours:.4f} / {r.legs_oracle:.4f} | {r.ratio:.3f} "
            f"| {r.drift_ours:.2f} / {r.drift_oracle:.2f} | {r.yaw_ours:+.1f} / {r.yaw_oracle:+.1f} |"
        )
    return "\n".join(lines)


@dataclass(frozen=True)
class Options:
    """Compare a tracker on our G1 with the same tracker on its official MJCF in plain MuJoCo."""

    checkpoint: Path
    """Weights of the tracker."""
    mjcf: Path
    """The official MJCF, g1_sim2sim_29dof.xml."""
    clip: tuple[Path, ...] = ()
    """A motion clip in any format that `trackers motions` reads; repeat for more."""
    clip_seconds: float | None = None
    """Play only the start of each clip [s]."""
    tracker: str = "twist2"
    """Name of the tracker."""
    fast_physics: bool = False
    """Use the tracker's fast physics rate."""
    json: bool = False
    """Print JSON instead of the table."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; exit code 0 done, 2 bad input."""
    options = tyro.cli(Options, args=argv, prog=PROG, config=(tyro.conf.UseAppendAction,))
    try:
        rows = compare(
            options.checkpoint,
            options.mjcf,
            options.clip,
            tracker=options.tracker,
            fast=options.fast_physics,
            clip_seconds=options.clip_seconds,
        )
    except InputError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    if options.json:
        print(json.dumps([dataclasses.asdict(r) | {"ratio": r.ratio} for r in rows], indent=2))
    else:
        print(row_table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
