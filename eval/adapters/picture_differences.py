"""What a policy decides when it is shown another picture than is rendered for it: `eval doors --pictures`."""

from __future__ import annotations

import dataclasses
import functools
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from arena_newton import policies
from arena_newton.errors import InputError
from arena_newton.eval.adapters.door_options import DoorOptions
from arena_newton.eval.adapters.gym import ArenaVectorEnv
from arena_newton.pictures.camera import Camera
from arena_newton.pictures.settings import CameraConfig
from arena_newton.policies.base import Observation
from arena_newton.policies.protocols.picture_fit import fitted_picture

__all__ = ["PictureRow", "picture_rows", "picture_table"]

QUALITIES = (95, 75)
"""Qualities of JPEG that are compared: that of our codecs, and Pillow's own."""
SENSOR = (640, 480)
"""Width and height of the head camera's own picture [px]."""


@dataclass(frozen=True)
class PictureRow:
    """A picture, and what it changes over the first looks of some episodes."""

    name: str
    brightness: float
    """Mean difference of its values from the rendered picture's, of 255."""
    largest: float
    """Largest difference of an action of the chunk."""
    mean: float
    """Mean difference of the actions."""


def picture_rows(options: DoorOptions, checkpoint: Path) -> list[PictureRow]:
    """Show the first look of each episode in several ways.

    Args:
        options: Task, tracker, episodes, engine and device.
        checkpoint: A policy that looks at pictures.

    Raises:
        InputError: It looks at none.
    """
    policy = policies.get(f"lerobot:{checkpoint}", device=options.device)
    camera = policy.camera
    if not policy.needs_image or camera is None:
        raise InputError(f"--pictures: {checkpoint} looks at no pictures")
    worlds = ArenaVectorEnv(
        options.task,
        options.episodes,
        tracker=options.tracker,
        engine=options.engine,
        device=options.device,
        image_size=None,
        settle="reset",
    )
    try:
        seen, _ = worlds.reset(seed=0)
        state = torch.from_numpy(np.asarray(seen["agent_pos"]))
        rendered = _rendered(worlds, camera)
        sensor = _rendered(worlds, CameraConfig(width=SENSOR[0], height=SENSOR[1], fit="native"))
        other = dataclasses.replace(camera, fit="native" if camera.fit == "pad" else "pad")
        shown = {f"{camera.width}x{camera.height} {camera.fit}, as rendered": rendered}
        shown["the same as PNG"] = _each(rendered, functools.partial(_packed, kind="PNG"))
        for quality in QUALITIES:
            squeezed = _each(rendered, functools.partial(_packed, kind="JPEG", quality=quality))
            shown[f"the same as JPEG, quality {quality}"] = squeezed
        if camera.fit == "pad":
            shown["640x480, scaled and padded by a server"] = _each(sensor, lambda one: fitted_picture(one, camera))
        shown[f"{camera.width}x{camera.height} {other.fit}"] = _rendered(worlds, other)
        shown["black"] = np.zeros_like(rendered)
        answers = {}
        instruction, gym_id = worlds.task_description, worlds.env.spec.gym_id
        mask = np.ones(options.episodes, bool)
        for name, pictures in shown.items():
            policy.reset([int(seed) for seed in range(options.episodes)], [options.task] * options.episodes)
            look = Observation(state, torch.from_numpy(pictures), mask, options.task, gym_id, instruction)
            answers[name] = np.asarray(policy.act(look).actions, np.float64)
    finally:
        worlds.close()
        policy.close()
    wanted = next(iter(answers.values()))
    rows = []
    for name, answer in answers.items():
        apart = np.abs(answer - wanted)
        grey = np.abs(shown[name].astype(np.float64) - rendered).mean()
        rows.append(PictureRow(name, float(grey), float(apart.max()), float(apart.mean())))
    return rows


def picture_table(rows: list[PictureRow]) -> str:
    """The rows as a table in Markdown."""
    lines = ["| picture | mean difference of 255 | largest difference of an action | mean |", "|---|--:|--:|--:|"]
    lines += [f"| {row.name} | {row.brightness:.2f} | {row.largest:.1e} | {row.mean:.1e} |" for row in rows]
    return "\n".join(lines) + "\n"


def _rendered(worlds: ArenaVectorEnv, config: CameraConfig) -> np.ndarray:
    """Pictures of all worlds, uint8, shape [worlds, H, W, 3]."""
    env, size = worlds.env, (config.width, config.height)
    camera = Camera.from_scene(env.scene, config.prim, *size, lights=env.lights, fit=config.fit)
    return np.asarray(env.render(camera, np.ones(env.worlds, bool)).cpu().numpy()).copy()


def _each(pictures: np.ndarray, change: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    return np.stack([change(picture) for picture in pictures])


def _packed(picture: np.ndarray, kind: str, quality: int | None = None) -> np.ndarray:
    """A picture after packing and unpacking."""
    data = io.BytesIO()
    Image.fromarray(picture).save(data, kind, **({} if quality is None else {"quality": quality}))
    return np.asarray(Image.open(data).convert("RGB"))
