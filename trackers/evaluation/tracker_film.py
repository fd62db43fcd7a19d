"""Film strips of a few cells, seen from the robot's right."""

from __future__ import annotations

from pathlib import Path
from typing import Unpack

import numpy as np

from arena_newton.interfaces import Tracker
from arena_newton.pictures.camera import Camera, WorldLights
from arena_newton.pictures.video import film_strip
from arena_newton.robot.g1 import TICK
from arena_newton.trackers.evaluation import push_suite
from arena_newton.trackers.evaluation.cells import suite
from arena_newton.trackers.evaluation.lab import Lab
from arena_newton.trackers.evaluation.suite_rollout import Settings, make_plan, play

__all__ = ["FILMED", "film"]

FILMED = {"walk 0.6": "walk", "ball, standing kick": "kick", "squat 0.45": "squat", "sit 0.42": "sit"}
"""Cell to file name."""
FILMED_PUSHES = {push_suite.RAMP: "blows"}
"""The same for the push suite."""
PICTURES = 10
"""Pictures per strip."""
WIDTH, HEIGHT = 256, 256
SHOWN = {"walk 0.6": (0.0, 5.0), "ball, standing kick": (0.5, 4.0), "squat 0.45": (0.0, 7.0), "sit 0.42": (0.0, 12.0)}
SHOWN[push_suite.RAMP] = (0.0, 59.9)
"""Part of each rollout that is shown [s]."""
VIEWS = {"walk 0.6": (1.2, 4.6), "ball, standing kick": (0.4, 2.6), "squat 0.45": (0.1, 2.6), "sit 0.42": (-0.1, 2.6)}
VIEWS[push_suite.RAMP] = (0.8, 5.0)
"""Middle of the picture along the robot's path and distance of the camera to its right [m]."""
EYE, GAZE = 1.05, 0.72
"""Heights of the camera and of its target [m]."""
FOCAL, APERTURE = 24.0, 20.0
"""Horizontal field of view 45°."""


class _StripCamera:
    """Takes each strip's pictures at its own times; cell `w` runs in world `w`."""

    def __init__(self, names: list[str]):
        self.names = names
        self.frames: list[list[np.ndarray]] = [[] for _ in names]
        self._wanted = []
        for name in names:
            first, last = SHOWN[name]
            step = (last - first) / (PICTURES - 1)
            self._wanted.append({round((first + k * step) / TICK) for k in range(PICTURES)})
        self._cameras: list[Camera] = []

    def _set_up(self, lab: Lab) -> None:
        lights = WorldLights.allocate(lab.worlds, lab.scene.device, lab.scene.stage)
        for name in self.names:
            x, distance = VIEWS[name]
            # Looks along +y and down: the camera's -z turned about x.
            tilt = 0.5 * (np.pi / 2 - np.arctan2(EYE - GAZE, distance))
            self._cameras.append(
                Camera(
                    lab.scene.model,
                    np.full(lab.worlds, -1),
                    (x, -distance, EYE),
                    (np.cos(tilt), np.sin(tilt), 0.0, 0.0),
                    width=WIDTH,
                    height=HEIGHT,
                    focal_length=FOCAL,
                    horizontal_aperture=APERTURE,
                    lights=lights,
                    samples=2,
                )
            )
        self._state = lab.scene.model.state()

    def __call__(self, lab: Lab, tick: int) -> None:
        due = [w for w, ticks in enumerate(self._wanted) if tick in ticks]
        if not due:
            return
        if not self._cameras:
            self._set_up(lab)
        lab.physics.write_newton_state(self._state)
        for w in due:
            mask = np.arange(lab.worlds) == w
            self.frames[w].append(self._cameras[w].render(self._state, mask)[w].cpu().numpy().copy())


def film(
    tracker: Tracker,
    label: str,
    out: Path,
    *,
    blows: bool = False,
    seed: int = 0,
    fast_physics: bool = False,
    **settings: Unpack[Settings],
) -> list[Path]:
    """Play the filmed cells once and write one strip per cell into a folder; returns the files.

    File names and the line above a strip call the tracker `label`; `blows` films the push suite's ramp instead; the
    rest is as in `suite_rollout.play`.
    """
    files = FILMED_PUSHES if blows else FILMED
    cells = [cell for cell in suite("push" if blows else "full") if cell.name in files]
    names = [cell.name for cell in cells]
    camera = _StripCamera(names)
    plan = make_plan(cells, 1, seed)
    play(tracker, plan, fast_physics=fast_physics, observer=camera, **settings)
    safe = "".join(c if c.isalnum() or c in "-_." else "_" for c in label)
    written = []
    for name, frames in zip(names, camera.frames, strict=True):
        path = out / f"film_{safe}_{files[name]}.png"
        first, last = SHOWN[name]
        written.append(film_strip(frames, path, n=PICTURES, label=f"{label}: {name}, {first:g} to {last:g} s"))
    return written
