"""Contact sheets: a scene seen from the robot's head camera and from the world camera, as a PNG."""

from __future__ import annotations

from pathlib import Path

import mujoco
import newton
import numpy as np
from PIL import Image, ImageDraw

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.physics.scene import Scene, load_scene, scene_path
from arena_newton.pictures.camera import Camera, WorldLights
from arena_newton.robot import g1
from arena_newton.rules import modes as all_modes
from arena_newton.tasks.base import draw_light
from arena_newton.usd_scenes.shapes import open_stage

__all__ = ["MODES", "preview"]

MODES = tuple(mode.name for mode in all_modes.BUILT_IN.values() if mode.looks or mode.name == "base")
"""Modes that a scene looks different in; visual is the base variant under a drawn distant light."""
_LIGHT_SEED = 0
"""Episode seed of the light drawn for visual mode."""
_SETTLE = 1.5
"""Time for dropped objects to come to rest [s]."""
_STEP = 0.005
_VIEWS = (("ego", 4 / 3), ("world", 16 / 9))
_LABEL = 18
_GAP = 4


def preview(targets: list[str], out: Path, size: int = 320, *modes: str) -> Path:
    """Render a contact sheet: one row per target and mode, ego view left, world view right.

    Objects are where the file puts them, dropped until they rest; the robot is held in its spawn pose.

    Args:
        targets: Task names or scene files.
        out: PNG to write.
        size: Width of the head camera's picture [px]; the other view has the same height.
        *modes: Some of `MODES` or of other packages, or all for all of `MODES`; base when none is given.

    Returns:
        The path of the PNG.

    Raises:
        InputError: Unknown mode, size, or a target that is not a scene.
    """
    known = (*MODES, *(mode for mode in all_modes.names() if mode not in all_modes.BUILT_IN))
    for mode in modes:
        if mode not in ("all", *known):
            raise InputError(f"--mode {mode}: unknown, choose from {', '.join(known)} or all")
    if size < 16:
        raise InputError(f"--size {size}: expected at least 16 pixels")
    height = round(size / _VIEWS[0][1])
    shown = MODES if "all" in modes else modes or ("base",)
    rows = [
        (f"{target} | {name}", _views(target, height, name))
        for target in targets
        for name in shown
        if "all" not in modes or target in tasks.names() or name not in all_modes.HELD_OUT
    ]
    widths = [round(height * aspect) for _, aspect in _VIEWS]
    area = (sum(widths) + _GAP * (len(widths) + 1), (height + _LABEL + _GAP) * len(rows))
    sheet = Image.new("RGB", area, (24, 24, 24))
    text = ImageDraw.Draw(sheet)
    for row, (label, pictures) in enumerate(rows):
        y, x = row * (height + _LABEL + _GAP), _GAP
        for (view, _), width, picture in zip(_VIEWS, widths, pictures, strict=True):
            text.text((x, y + 3), f"{label} | {view}", fill=(235, 235, 235))
            sheet.paste(Image.fromarray(picture), (x, y + _LABEL))
            x += width + _GAP
    out = Path(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        sheet.save(out, format="PNG")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from None
    return out


def _views(target: str, height: int, mode: str) -> list[np.ndarray]:
    """Pictures of one scene in one mode, uint8 [height, width, 3] each."""
    layer = tasks.get(target).own_layer(mode) if target in tasks.names() else None
    variant = "base" if layer else _variant(target, mode)
    scene = load_scene(target, worlds=1, device="cpu", native=True, variant=variant, variant_file=layer)
    lights = WorldLights.allocate(1, scene.device, scene.stage)
    if drawn := all_modes.get(mode).light:
        lights.set(0, draw_light(_LIGHT_SEED, drawn(rule_sets.get("paper"))))
    state = _settled(scene)
    pictures = []
    for view, aspect in _VIEWS:
        camera = Camera.from_scene(scene, view, round(height * aspect), height, lights, samples=2)
        pictures.append(camera.render(state)[0].cpu().numpy().copy())
    return pictures


def _variant(target: str, mode: str) -> str:
    """The variant of `semantics` to load: the one that the scene selects by itself, unless asked for semantic."""
    if (own := all_modes.get(mode).scene) != "base":
        return mode if own == "layer" else own
    stage = open_stage(scene_path(target))
    world = stage.GetPrimAtPath("/World")
    return (world.GetVariantSet("semantics").GetVariantSelection() if world else "") or "base"


def _settled(scene: Scene) -> newton.State:
    """Newton state with the robot in its spawn pose and every object at rest where it fell."""
    m = scene.mj_model
    data = mujoco.MjData(m)
    handles = scene.robot
    data.qpos[handles.joint_qpos] = g1.DEFAULT_POSE
    data.ctrl[handles.joint_ctrl] = g1.DEFAULT_POSE
    own_q, own_v = _robot_coordinates(m, set(handles.bodies))
    spawn = data.qpos[own_q].copy()
    saved_step, m.opt.timestep = m.opt.timestep, _STEP
    for _ in range(round(_SETTLE / _STEP)):
        mujoco.mj_step(m, data)
        data.qpos[own_q] = spawn
        data.qvel[own_v] = 0.0
    m.opt.timestep = saved_step
    mujoco.mj_forward(m, data)
    state = scene.model.state()
    poses = state.body_q.numpy()
    for body, newton_body in enumerate(scene.body_to_newton[0]):
        if newton_body >= 0:
            poses[newton_body, :3] = data.xpos[body]
            poses[newton_body, 3:] = data.xquat[body][[1, 2, 3, 0]]
    state.body_q.assign(poses)
    return state


def _robot_coordinates(m: mujoco.MjModel, links: set[int]) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the robot's own coordinates in qpos and qvel."""
    q, v = [], []
    for joint in range(m.njnt):
        if int(m.jnt_bodyid[joint]) in links:
            free = m.jnt_type[joint] == 0
            q += range(m.jnt_qposadr[joint], m.jnt_qposadr[joint] + (7 if free else 1))
            v += range(m.jnt_dofadr[joint], m.jnt_dofadr[joint] + (6 if free else 1))
    return np.array(q), np.array(v)
