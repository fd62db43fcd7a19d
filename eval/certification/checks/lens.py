"""Has the head camera the lens of the paper's benchmark? The floor in the first picture, measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import mujoco
import numpy as np
from scipy.optimize import least_squares

from arena_newton.eval.certification.checks.traces import world_of
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding
from arena_newton.pages.tables import Table, percent
from arena_newton.pictures.camera import CAMERA_PRIMS
from arena_newton.pictures.settings import CameraConfig

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv
    from arena_newton.files.stored_json import Json

__all__ = ["CHECKS", "lens_of"]

FOCAL_LENGTH, APERTURE = 7.6, 20.0
"""The original's head camera [mm]: 105.5° wide."""
ASPECT = 4.0 / 3.0
TOLERANCE = 0.005
"""Largest deviation of the picture's half width and half height at unit distance."""
LEAST = 500
"""Least number of pixels that show the floor."""
TASKS = 2
"""Tasks whose pictures are measured under --quick."""


def camera(context: Context) -> CheckFinding:
    """Render the first picture and find the lens with which its distances put the floor's pixels on the floor."""
    rows, wrong, worst = [], [], 0.0
    tracker, true = context.trackers[0], _tangents()
    for task in context.tasks[:TASKS] if context.options.quick else context.tasks:

        def measure(task: str = task) -> Json:
            env = cast("ArenaEnv", world_of(context, task, tracker, worlds=1, camera=CameraConfig()))
            env.reset(context.seeds(task, 1))
            found = lens_of(env)
            env.close()
            return [float(number) for number in found]

        width, height, pixels = cast("list[float]", context.measured("camera", task, tracker, {}, measure))
        off = max(abs(width / true[0] - 1.0), abs(height / true[1] - 1.0))
        worst = max(worst, off)
        angles = [2.0 * np.degrees(np.arctan(tangent)) for tangent in (width, height)]
        rows.append((task, f"{pixels:.0f}", f"{angles[0]:.2f}", f"{angles[1]:.2f}", f"{100 * off:.3f}"))
        if pixels < LEAST:
            wrong.append(f"{task}: {pixels:.0f} pixels show the floor, too few to measure the lens")
        elif off > TOLERANCE:
            wrong.append(f"{task}: the picture is {angles[0]:.2f}° wide and {angles[1]:.2f}° high")
    expected = " x ".join(f"{2.0 * np.degrees(np.arctan(tangent)):.2f}°" for tangent in true)
    head = ("task", "pixels of the floor", "width [°]", "height [°]", "largest deviation [%]")
    summary = f"the head camera's lens is at most {100 * worst:.2f} % from that of {expected}"
    note = f"Half width and half height at unit distance may deviate by {percent(TOLERANCE)} %."
    sheet = Table(head, rows, title="The lens, as the floor in the first picture shows it")
    return CheckFinding("fail" if wrong else "pass", summary, (sheet,), (*wrong, note))


def _tangents() -> tuple[float, float]:
    """Half width and half height of the picture at unit distance."""
    half = 0.5 * APERTURE / FOCAL_LENGTH
    return half, half / ASPECT


def lens_of(env: ArenaEnv) -> tuple[float, float, int]:
    """Half width and half height of the head camera's picture at unit distance, and how many pixels they come from.

    A pixel's place in the picture and its distance give a point; those of the floor are at height 0 with the true lens.
    """
    env.observe(np.ones(env.worlds, dtype=bool), image=True)
    assert env.camera is not None
    shapes = env.camera.shapes()[0].cpu().numpy()
    rows, columns = shapes.shape
    whole = env.camera.distance_picture()[0].cpu().numpy()
    top, left = (whole.shape[0] - rows) // 2, (whole.shape[1] - columns) // 2
    distance = whole[top : top + rows, left : left + columns].astype(float)
    floor = {n for n, label in enumerate(env.scene.model.shape_label) if label.rsplit("/", 1)[-1] == "Floor"}
    picked = np.isin(shapes, list(floor)) & (distance > 0.0)
    row, column = np.nonzero(picked)
    frame = env.scene.frame(CAMERA_PRIMS["ego"])
    turn, local = np.zeros(9), np.zeros(9)
    mujoco.mju_quat2Mat(turn, env.physics.xquat.numpy()[0, frame.body_id].astype(float))
    mujoco.mju_quat2Mat(local, np.array(frame.quat, dtype=float))
    body, own = turn.reshape(3, 3), local.reshape(3, 3)
    height = float(env.physics.xpos.numpy()[0, frame.body_id, 2] + (body @ np.array(frame.pos))[2])
    up = (body @ own)[2]
    x, y = 2.0 * (column + 0.5) / columns - 1.0, 1.0 - 2.0 * (row + 0.5) / rows
    away = distance[picked]

    def above(tangents: np.ndarray) -> np.ndarray:
        ray = np.stack([x * tangents[0], y * tangents[1], -np.ones_like(x)])
        ray /= np.linalg.norm(ray, axis=0)
        heights: np.ndarray = height / away + up @ ray
        return heights

    found = least_squares(above, _tangents()).x
    return float(found[0]), float(found[1]), len(x)


CHECKS = (Check("camera", "Is the head camera's picture as wide as the original's?", camera),)
"""This module's checks."""
