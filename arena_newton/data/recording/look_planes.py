"""Looks while an episode is recorded: the shape that each pixel shows, and its luminance under random second lights.

Second lights are a dome of another intensity, or a distant light that comes from further down than any of visual mode:
what that mode shows is not among them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
import warp as wp

from arena_newton.data.readers.looks import FIRST_SHAPE, MOST_SHAPES, Looks
from arena_newton.errors import InputError
from arena_newton.interfaces import World
from arena_newton.pictures.camera import Camera, WorldLights
from arena_newton.pictures.changed_looks import luminance
from arena_newton.pictures.settings import DOME_INTENSITY
from arena_newton.rules.rule_types import LightRange
from arena_newton.tasks.base import LightDraw

__all__ = ["STRIDE", "LookPlanes", "second_light", "visual_angle"]

STRIDE = 4
"""Rows from one frame of looks to the next: 0.08 s, in which little moves."""
KEY = 0x6C6F6F6B
"""Separates the second lights' generator from all others."""
ROBOT = "/World/Robot/"
DOME = (0.3, 1.5)
"""Intensity of a dome over that of the scenes' dome."""
DISTANT = (2000.0, 9000.0)
"""Intensity of a distant light; drawn evenly in its logarithm."""
DISTANT_PROBABILITY = 0.65
APART = 5.0
"""Least angle between a distant light and any of visual mode [deg]."""
FLATTEST = 65.0
"""Largest angle between a distant light and the vertical [deg]."""


def visual_angle() -> float:
    """Largest angle between a light of visual mode and the vertical [deg]."""
    ranges = LightRange()
    pitch, roll = (math.radians(max(map(abs, bounds))) for bounds in (ranges.pitch_deg, ranges.roll_deg))
    return math.degrees(math.acos(math.cos(pitch) * math.cos(roll)))


def second_light(episode_seed: int, number: int) -> LightDraw | float:
    """The second light of an episode with this number: a distant light, or the intensity of a dome."""
    rng = np.random.default_rng([episode_seed, number, KEY])
    distant, strength, tilt, turn = map(float, rng.random(4))
    if distant >= DISTANT_PROBABILITY:
        return DOME_INTENSITY * (DOME[0] + (DOME[1] - DOME[0]) * strength)
    steepest = visual_angle() + APART
    tilt, turn = math.radians(steepest + (FLATTEST - steepest) * tilt), math.tau * turn
    down = -math.sin(tilt) * math.cos(turn), -math.sin(tilt) * math.sin(turn), -math.cos(tilt)
    return LightDraw(down, DISTANT[0] * (DISTANT[1] / DISTANT[0]) ** strength, (0.75, 0.75, 0.75))


@functools.cache
def _codes(device: torch.device) -> torch.Tensor:
    """Byte of two luminances, own · 256 + second, uint8, shape [65536]."""
    value = np.arange(256) + 1.0
    codes = np.clip(np.rint(128.0 + 32.0 * np.log2(value[None, :] / value[:, None])), 0, 255)
    return torch.from_numpy(codes.astype(np.uint8).reshape(-1)).to(device)


class LookPlanes:
    """Makes the frames of looks of an environment's camera."""

    def __init__(self, env: World, camera: Camera, lights: int):
        """Name the shapes.

        Args:
            env: The worlds.
            camera: Camera of the pictures, which no one else renders with.
            lights: Second lights of an episode.

        Raises:
            InputError: The scene has more shapes than bytes can name.
        """
        scene, model = env.scene, env.scene.model
        drawn = model.bvh_shape_enabled.numpy()[: model.bvh_shape_count_enabled]
        labels = {int(shape): model.shape_label[int(shape)] for shape in drawn}
        names = sorted({label for label in labels.values() if not label.startswith(ROBOT)})
        if len(names) > MOST_SHAPES:
            raise InputError(f"--looks: {env.spec.name} shows {len(names)} shapes, expected at most {MOST_SHAPES}")
        code = {name: FIRST_SHAPE + number for number, name in enumerate(names)}
        # The first entry is that of a pixel without a shape.
        table = np.zeros(model.shape_count + 1, np.uint8)
        for shape, label in labels.items():
            table[shape + 1] = code.get(label, 1)
        self._table = torch.from_numpy(table).to(env.torch_device)
        self._shapes = tuple((name, _chance(name, env.spec.recolour)) for name in names)
        self._camera = camera
        self._lights = [WorldLights.allocate(env.worlds, scene.device, scene.stage) for _ in range(lights)]

    def begin(self, world: int, episode_seed: int) -> Looks:
        """Draw the second lights of a world's episode."""
        rows: list[tuple[float, ...]] = []
        for number, lights in enumerate(self._lights):
            light = second_light(episode_seed, number)
            if isinstance(light, LightDraw):
                lights.set(world, light)
                rows.append((light.intensity, *light.direction))
            else:
                lights.set(world, None, dome_intensity=light)
                rows.append((light,))
        return Looks(STRIDE, tuple(rows), self._shapes)

    def frames(self, worlds: Sequence[int]) -> torch.Tensor:
        """Frames of worlds whose pictures the camera has just rendered, uint8, shape [len(worlds), H, W, 3]."""
        camera, device = self._camera, self._table.device
        chosen = torch.tensor(worlds, device=device)
        mask = np.zeros(camera.worlds, bool)
        mask[list(worlds)] = True
        shapes = camera.whole(self._table[camera.shapes() + 1])[chosen]
        own = luminance(wp.to_torch(camera.image)[chosen])
        seconds = [_codes(device)[256 * own + luminance(camera.relit(one, mask)[chosen])] for one in self._lights]
        return torch.stack([shapes, seconds[0], seconds[-1]], dim=-1)


def _chance(prim: str, recolour: Mapping[str, float]) -> float:
    """Probability with which a prim may get another colour."""
    return next((chance for name, chance in recolour.items() if f"{prim}/".startswith(f"{name}/")), 1.0)
