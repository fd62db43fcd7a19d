"""Can a policy that sees find its target? In which episodes it is in the head camera's first picture, and from when."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from arena_newton import policies, tasks
from arena_newton.eval.certification.checks.traces import world_of
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding, Picture
from arena_newton.eval.play.signal_recorder import shapes_of
from arena_newton.files.stored_json import JsonObject
from arena_newton.interfaces import World
from arena_newton.kernels.tick import RUNNING
from arena_newton.pages.tables import Table
from arena_newton.pictures.settings import CameraConfig
from arena_newton.rules import seeding

__all__ = ["CHECKS", "first_sights"]

SEEN = 10
"""A target is seen from so many pixels on, of the 224 x 168 that the lens fills."""
EVERY = 10
"""Ticks between two looks."""
LONGEST = 1500
"""Ticks after which a target that was not seen counts as never seen."""
TINT = np.array([255.0, 0.0, 255.0])
"""Colour of the target's pixels in the page's pictures, RGB."""


def visible(context: Context) -> CheckFinding:
    """Let the experts act and look for their targets in the pictures that a policy would see."""
    rows, missing, late, pictures = [], [], [], []
    tracker, shown, total = context.trackers[0], 0, 0
    for task in context.tasks:
        target = tasks.get(task).target
        if not target:
            missing.append(f"{task}: no target is named for it")
            continue
        picture = context.folder / "pictures" / f"visible_{task}.png"
        measure = functools.partial(_look, context, task, tracker, picture)
        found = context.measured("visible", task, tracker, {"episodes": context.episodes}, measure)
        sights, pixels = list(found["first"]), list(found["pixels"])
        seen = sorted(int(tick) for tick in sights if tick is not None)
        at_once = seen.count(0)
        shown, total = shown + at_once, total + len(sights)
        median = str(seen[len(seen) // 2]) if seen else "-"
        latest = str(seen[-1]) if seen else "-"
        never = len(sights) - len(seen)
        row = (task, target, f"{at_once}/{len(sights)}", f"{int(np.median(pixels))}", median, latest, str(never))
        rows.append(row)
        if at_once < len(sights):
            late.append(f"{task}: not in the first picture of {len(sights) - at_once} of {len(sights)} episodes")
        missing += [f"{task}: never seen in {never} of {len(sights)} episodes"] * bool(never)
        if picture.is_file():
            pictures.append(Picture(f"{task}: {target} when it is seen first, with its pixels marked", picture))
    head = (
        "task",
        "target",
        "in the first picture",
        "its pixels there, median",
        "seen at tick, median",
        "latest",
        "never",
    )
    sheet = Table(
        head, rows, title=f"The head camera's picture of the expert's episodes, looked at every {EVERY} ticks"
    )
    summary = f"the target is in the first picture of {shown} of {total} episodes"
    summary += "" if missing else ", and is seen in all of them"
    notes = (*missing, *late, f"Seen means {SEEN} pixels or more of the 224 x 168 that the lens fills.")
    return CheckFinding("fail" if missing else "note" if late else "pass", summary, (sheet,), notes, tuple(pictures))


def _look(context: Context, task: str, tracker: str, picture: Path) -> JsonObject:
    """First sights of a task's episodes."""
    seeds = context.seeds(task, min(context.episodes, context.options.worlds))
    env = world_of(context, task, tracker, worlds=len(seeds), camera=CameraConfig())
    first, pixels, image = first_sights(env, seeds, env.spec.target)
    env.close()
    if image is not None:
        picture.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(picture)
    return {"first": list(first), "pixels": list(pixels)}


def first_sights(env: World, seeds: list[int], prim: str) -> tuple[list[int | None], list[int], np.ndarray | None]:
    """Let the expert play one episode per world until each has had its target in the picture.

    Args:
        env: Worlds with a head camera, as many as seeds.
        prim: The target.

    Returns:
        Per world the tick of the first sight (None: never) and the target's pixels in the first picture, and the first
        world's picture of its first sight with the target's pixels tinted.
    """
    policy = policies.get("expert")
    policy.attach(env)
    env.reset(seeds)
    policy.reset([seeding.policy_seed(seed) for seed in seeds], [env.spec.gym_id] * env.worlds)
    shapes = shapes_of(env, prim)
    first: list[int | None] = [None] * env.worlds
    pixels, image = [0] * env.worlds, None
    longest = min(env.budget, LONGEST)
    while env.active.any():
        acting = env.active & (env.tick >= 0)
        looks = acting & (env.tick % EVERY == 0)
        for world, count, picture in _counts(env, looks, shapes):
            tick = int(env.tick[world])
            if tick == 0:
                pixels[world] = count
            if count >= SEEN:
                first[world] = tick
                image = picture if image is None else image
                env.release([world])
        if not env.active.any():
            break
        action = torch.zeros(env.worlds, 40, device=env.torch_device)
        acting = env.active & (env.tick >= 0)
        if acting.any():
            action = torch.as_tensor(policy.act(env.observe(acting)).actions, device=env.torch_device)[:, 0]
        status = env.step(action)
        over = env.active & ((status != RUNNING) | (env.tick >= longest))
        env.release(np.flatnonzero(over))
    return first, pixels, image


def _counts(env: World, looks: np.ndarray, shapes: torch.Tensor) -> list[tuple[int, int, np.ndarray]]:
    """World, number of the target's pixels and picture with these tinted, of the worlds that look."""
    if not looks.any():
        return []
    image = env.observe(looks, image=True).image
    assert image is not None and env.camera is not None
    drawn = env.camera.shapes()
    target = shapes[drawn.clamp_min(0)] & (drawn >= 0)
    found = []
    for world in np.flatnonzero(looks).tolist():
        mask, picture = target[world].cpu().numpy(), image[world].cpu().numpy().copy()
        top, left = (picture.shape[0] - mask.shape[0]) // 2, (picture.shape[1] - mask.shape[1]) // 2
        inner = picture[top : top + mask.shape[0], left : left + mask.shape[1]]
        inner[mask] = (0.5 * inner[mask] + 0.5 * TINT).astype(np.uint8)
        found.append((world, int(mask.sum()), picture))
    return found


CHECKS = (Check("visible", "Is each task's target in the first picture, or seen while the expert acts?", visible),)
"""This module's checks."""
