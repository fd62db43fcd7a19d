"""Recorded states of episodes checked tick by tick on engine mujoco: a state and its action give the next state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import torch

from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.errors import InputError
from arena_newton.eval.plan.episode_plan import Episode
from arena_newton.interfaces import EpisodeResult, Observation, Recorder, World
from arena_newton.physics.mujoco_engine import MujocoPhysics, lone_joints

__all__ = ["EPISODE", "SECOND", "START", "STILL", "LoneBodies", "StatesAgain", "TickDifferences"]

EPISODE = "episode"
"""Name of the recording of an episode among its media."""
START = 0.01
"""Largest distance of a body in the first recorded state from where the seed puts it, after the start-up [m]."""

SECOND = 50
"""Ticks whose differences are also added up: a small one that always points the same way moves a body in time."""

STILL = 0.05
"""Horizontal speed [m/s] that a lone body may gain, and distance [m] that it may move, while nothing moving is near."""
GAINED = 0.1
"""Part of its speed, on top: engines differ by some percent in how a kicked ball's sliding becomes rolling."""
NEAR = 0.05
"""Distance of the bounding spheres of two bodies within which they may touch during a tick [m]."""
ROLLED = 0.4
"""Speed of a ball's centre that friction trades for a unit of speed of its surface."""


@dataclass
class TickDifferences:
    """Recorded states of an episode, each less the one that a tick from the recorded state before it gives."""

    first: float = 0.0
    """Largest distance along an axis of a body in the first state from where the seed puts it [m]."""
    first_speed: float = 0.0
    """Largest difference of a velocity in it from the one that the seed's start-up gives [m/s, rad/s]."""
    states: int = 0
    """Recorded states that were compared."""
    positions: list[np.ndarray] = field(default_factory=list)
    """Differences of all bodies after each tick [m], each of shape [bodies, 3]."""
    velocities: list[np.ndarray] = field(default_factory=list)
    """Differences of all degrees of freedom [m/s, rad/s], each of shape [nv]; the last state has none."""
    unmoved: tuple[float, int] = (0.0, 0)
    """Most that a lone body got while nothing that moves was near, as a part of what it may, and the tick."""

    def of_ticks(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest difference of a position and of a velocity after each tick."""
        return _largest(self.positions, 1), _largest(self.velocities, 1)

    def of_seconds(self) -> tuple[np.ndarray, np.ndarray]:
        """Largest sum over `SECOND` ticks of the differences of a position and of a velocity."""
        return _largest(self.positions, SECOND), _largest(self.velocities, SECOND)


def _largest(differences: list[np.ndarray], ticks: int) -> np.ndarray:
    """Largest absolute sum of a number over so many ticks, from each tick on; from the first alone if they are few."""
    if not differences:
        return np.zeros(1)
    rows = np.stack(differences).reshape(len(differences), -1)
    sums = np.vstack([np.zeros(rows.shape[1]), np.cumsum(rows, axis=0)])
    many = min(ticks, len(rows))
    largest: np.ndarray = np.abs(sums[many:] - sums[:-many]).max(axis=1)
    return largest


class LoneBodies:
    """Sums of differences of bodies that move freely by themselves, since something that moves was last near each.

    A tick's tolerance is as wide as a kick; without this a ball that lies could be kicked by nobody within it.
    """

    def __init__(self, model: mujoco.MjModel):
        """Know where they are in a scene's state."""
        trees = model.body_treeid
        self._reach = np.zeros(model.nbody)
        np.maximum.at(self._reach, model.geom_bodyid, np.linalg.norm(model.geom_pos, axis=1) + model.geom_rbound)
        joints = lone_joints(model)
        self._bodies = model.jnt_bodyid[joints]
        self._dofs = model.jnt_dofadr[joints]
        self._others = [(trees == trees[body], (trees >= 0) & (trees != trees[body])) for body in self._bodies]
        self.radii = np.ones(model.nv)
        """Factors of degrees of freedom: of a lone body's spin its farthest surface [m], else 1.

        A kick pinches the ball between foot and floor; engines agree on its speed then, and not on its spin."""
        for dof, (own, _) in zip(self._dofs, self._others, strict=True):
            self.radii[dof + 3 : dof + 6] = self._reach[own].max() or 1.0
        self._sums, self._fastest = np.zeros((3, len(joints), 2)), np.zeros(len(joints))

    def worst(
        self,
        before: np.ndarray,
        after: np.ndarray,
        moved: np.ndarray,
        gained: np.ndarray,
        speed: np.ndarray,
        quats: np.ndarray,
    ) -> float:
        """Largest sum now, as a part of what is allowed.

        Args:
            before: Recorded positions of the bodies before the tick, shape [nbody, 3].
            after: The same after it.
            moved: Differences of positions after it, shape [nbody, 3].
            gained: Differences of velocities after it, of spin at the surface, shape [nv].
            speed: Recorded velocities after it, shape [nv].
            quats: Recorded orientations after it, wxyz, shape [nbody, 4].
        """
        for k, (own, others) in enumerate(self._others):
            if any(self._close(at, own, others) for at in (before, after)):
                self._sums[:, k], self._fastest[k] = 0.0, 0.0
                continue
            dof, body, spin = self._dofs[k], self._bodies[k], np.empty(3)
            mujoco.mju_rotVecQuat(spin, gained[dof + 3 : dof + 6], quats[body])
            self._sums[:, k] += moved[body, :2], gained[dof : dof + 2], ROLLED * spin[:2]
            self._fastest[k] = max(self._fastest[k], float(np.linalg.norm(speed[dof : dof + 2])))
        length = np.linalg.norm(self._sums, axis=2)
        length[1:] -= GAINED * self._fastest
        return float(length.max(initial=0.0)) / STILL

    def _close(self, at: np.ndarray, own: np.ndarray, others: np.ndarray) -> bool:
        apart = np.linalg.norm(at[own][:, None] - at[others], axis=2)
        return bool((apart < self._reach[own][:, None] + self._reach[others] + NEAR).any())


@dataclass
class _Recorded:
    """Recorded states of an episode."""

    index: int
    positions: np.ndarray
    """Before each tick and at the end, shape [ticks + 1, nq]."""
    velocities: np.ndarray
    """Before each tick, shape [ticks, nv]."""
    lone: LoneBodies
    """Sums of this episode."""
    bodies: np.ndarray
    """Positions of the bodies in the recorded state before, shape [nbody, 3]."""


class StatesAgain(Recorder):
    """Puts the worlds into the recorded state before each tick, and measures how far off the next one is."""

    def __init__(self, files: Mapping[int, Path]):
        """Take the recordings of `eval run --record` by the episode's number."""
        self.files = files
        self.differences: dict[int, TickDifferences] = {}
        """Differences by the episode's number."""
        self._states: dict[int, _Recorded] = {}

    def start(self, env: World, world: int, episode: Episode) -> None:
        """Read an episode's states.

        Raises:
            InputError: The recording is absent, damaged, or of another scene.
        """
        model, file = env.scene.mj_model, EpisodeFile(self.files[episode.index])
        positions, last = file.array("arena_qpos", -1, model.nq), file.array("arena_final_qpos", model.nq)
        velocities = file.array("arena_qvel", len(positions), model.nv)
        if not len(velocities):
            raise InputError(f"{file.path}: arena_qvel holds no tick")
        states, bodies = np.vstack([positions, last]), np.zeros((model.nbody, 3))
        self._states[world] = _Recorded(episode.index, states, velocities, LoneBodies(model), bodies)
        self.differences[episode.index] = TickDifferences()

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """Measure how far off the recorded state is, and take it up."""
        for world in np.flatnonzero(env.active & (env.tick >= 0)).tolist():
            self._take_up(env, world, int(env.tick[world]))

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Measure how far off the recorded last state is."""
        self._take_up(env, world, result.steps)
        del self._states[world]

    def _take_up(self, env: World, world: int, tick: int) -> None:
        """Put a world into the recorded state at a tick; one that goes on after its recording stays as it is."""
        assert isinstance(env.physics, MujocoPhysics), "the audit plays on engine mujoco"
        mine = self._states[world]
        if tick >= len(mine.positions):
            return
        found, last = self.differences[mine.index], min(tick, len(mine.velocities) - 1)
        bodies = env.physics.xpos.numpy()[world]
        given, moving = bodies.astype(np.float64), env.physics.qvel.numpy()[world].astype(np.float64)
        env.physics.put(world, mine.positions[tick], mine.velocities[last])
        moved, begins = bodies - given, not found.states
        if begins:
            found.first, moved, mine.bodies = float(np.abs(moved).max()), np.zeros_like(moved), bodies
        else:
            found.positions.append(moved)
        if tick == last:
            gained, quats = (mine.velocities[tick] - moving) * mine.lone.radii, env.physics.xquat.numpy()[world]
            if begins:
                found.first_speed = float(np.abs(gained).max())
            else:
                found.velocities.append(gained)
            near = mine.bodies, bodies, moved
            worst = mine.lone.worst(*near, gained, mine.velocities[tick], quats.astype(np.float64))
            found.unmoved = max(found.unmoved, (worst, max(tick - 1, 0)), key=lambda one: one[0])
        found.states, mine.bodies = found.states + 1, bodies.astype(np.float64)
