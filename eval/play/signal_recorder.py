"""Tallies the signals of `episode_signals` while episodes run: a few numbers per world on the device, no trajectory.

Nothing here changes an episode. A look renders the head camera at its own times, for policies that do not see too.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import warp as wp
from torch import Tensor

from arena_newton.eval.play.interaction_view import InteractionView
from arena_newton.eval.records.episode_signals import EpisodeSignals
from arena_newton.interfaces import EpisodeResult, Observation, Planned, Recorder, World
from arena_newton.pictures.camera import Camera
from arena_newton.robot.g1 import LEGS
from arena_newton.robot.rotations import quat_apply
from arena_newton.rules.rule_types import FallRule

__all__ = ["EVERY", "SEEN", "SignalRecorder", "shapes_of"]

EVERY = 25
"""Ticks between two looks: half a second, in which the head turns by half its field of view at most."""
SEEN = 10
"""The object is seen from so many pixels on, as in the check `visible`, of ..."""
SIZE = (224, 168)
"""... width and height of a policy's picture without its black bars [px]."""
SMOOTH = 25
"""Time constant of averages [ticks]: half a second, the period of a step."""
LEAD = 50
"""Ticks before the end that do not count: a fall from the first stumble to the floor takes about a second."""
FACING = 1.2
"""Angle between heading and object up to which an effector that comes near touches it [rad]; one that swings past
behind the shoulder does not. Experts touch within 0.35, a searching robot passes at 1.6 and more."""
APART = 0.10
"""An effector that is farther than this beyond the distance of a touch has let go [m]."""
MOVED = 0.25
"""An object that is farther than this from where it was at the first touch has moved [m]: more than a bag sways."""
SOFT = math.radians(FallRule.soft_tilt_deg)
"""The fall rule's first angle [rad]."""
FAR = 1e3
"""A distance that nothing has [m]."""


class SignalRecorder(Recorder):
    """Keeps the signals of running episodes; those of ended ones are handed out by `taken`."""

    def __init__(self, env: World):
        """Bind the worlds of a task that has an `Interaction`."""
        self.env = env
        device, scene = env.torch_device, env.scene
        self._device = device
        self._view, first = InteractionView(env), scene.robot.root_qvel
        self.spec = self._view.spec
        self._root_velocity = wp.to_torch(env.physics.qvel)[:, first : first + 2]
        self._legs = torch.tensor(list(LEGS), device=device)
        self._reference = wp.to_torch(env.loop.reference.position)
        self._camera: Camera | None = None
        self._shapes = shapes_of(env, self.spec.sight or env.spec.target)
        self._ended: dict[int, EpisodeSignals] = {}
        worlds = env.worlds
        self._now = {name: torch.full((worlds,), value, device=device) for name, value in _BEGIN.items()}
        self._velocity = torch.zeros(worlds, 2, device=device)
        self._touch_at = torch.zeros(worlds, 3, device=device)
        self._ring = torch.zeros(LEAD, worlds, len(_LED) + 4, device=device)
        self._at = 0

    def taken(self, index: int) -> EpisodeSignals | None:
        """Signals of an ended episode by its number in the plan, once."""
        return self._ended.pop(index, None)

    def start(self, env: World, world: int, episode: Planned) -> None:
        """Forget what the world's last episode left."""
        for name, value in _BEGIN.items():
            self._now[name][world] = value
        self._velocity[world] = 0.0

    def before_physics(self, env: World, observation: Observation | None, action: Tensor) -> None:
        """Look where it is time to, until the object is touched."""
        due = env.active & (env.tick >= 0) & (env.tick % EVERY == 0)
        if due.any():
            due &= (self._now["first_touch"] < 0).cpu().numpy()
        if due.any():
            self._look(due)

    def tick(self, env: World) -> None:
        """Take the state after a tick of all worlds that are past their step 0."""
        acting = env.active & (env.tick > 0)
        if acting.any():
            self._take(torch.from_numpy(acting).to(self._device), torch.from_numpy(env.tick).to(self._device))

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """Keep the episode's signals."""
        now = {name: float(values[world]) for name, values in self._now.items()}
        self._ended[int(result.episode.index)] = _signals(now)

    def _look(self, due: np.ndarray) -> None:
        if self._camera is None:
            self._camera = Camera.from_scene(self.env.scene, "ego", *SIZE, lights=self.env.lights)
        self.env.render(self._camera, due)
        drawn = self._camera.shapes()
        pixels = (self._shapes[drawn.clamp_min(0)] & (drawn >= 0)).sum(dim=(1, 2))
        mask, now = torch.from_numpy(due).to(self._device), self._now
        tick = torch.from_numpy(self.env.tick).to(self._device).float()
        seen = mask & (pixels >= SEEN)
        now["first_pixels"] = torch.where(mask & (now["looks"] == 0), pixels.float(), now["first_pixels"])
        now["looks"] = now["looks"] + mask
        now["looks_seen"] = now["looks_seen"] + seen
        now["first_seen"] = torch.where(seen & (now["first_seen"] < 0), tick, now["first_seen"])

    def _take(self, mask: Tensor, tick: Tensor) -> None:
        """One tick of the worlds in `mask`."""
        now, spec, view = self._now, self.spec, self._view
        root, centre, distance, reach = view.root, view.centre, view.distance, view.reach
        bearing = torch.where(distance > 0.0, view.bearing, 0.0)  # over it every heading is right
        change = (self._root_velocity - self._velocity) / SMOOTH
        self._velocity = torch.where(mask[:, None], self._velocity + change, 0.0)
        slow = torch.linalg.vector_norm(self._velocity, dim=1) < spec.slow
        slow &= tick > 2 * SMOOTH  # the average begins at rest

        def keep(name: str, value: Tensor, where: Tensor) -> None:
            now[name] = torch.where(mask & where, value.float(), now[name])

        every = torch.ones_like(mask)
        keep("start_distance", distance, now["start_distance"] < 0)
        keep("nearest_distance", torch.minimum(distance, now["nearest_distance"]), every)
        keep("reach_distance", torch.minimum(reach, now["reach_distance"]), every)

        engaged = slow & (distance <= spec.near)
        aligned = slow & (distance <= spec.stance) & (bearing <= spec.bearing)
        keep("stop_bearing", bearing, engaged & (distance < now["stop_distance"]))
        keep("stop_distance", torch.minimum(distance, now["stop_distance"]), engaged)
        for name, holds in (("engaged", engaged), ("aligned", aligned)):
            keep(f"{name}_now", (now[f"{name}_now"] + 1.0) * holds, every)
            keep(f"{name}_ticks", torch.maximum(now[f"{name}_ticks"], now[f"{name}_now"]), every)

        touching = (reach <= spec.touch) & (bearing <= FACING)
        begins = touching & (now["touching"] == 0)
        first = begins & (now["first_touch"] < 0)
        keep("touch_distance", distance, first)
        keep("touch_bearing", bearing, first)
        self._touch_at = torch.where((mask & first)[:, None], centre, self._touch_at)
        keep("first_touch", tick, first)
        way = (centre - self._touch_at)[:, : 2 if spec.carried else 3]
        moved = torch.linalg.vector_norm(way, dim=1) * (now["first_touch"] >= 0)
        keep("moved", moved * ~touching if spec.carried else moved, every)
        keep("touches", now["touches"] + 1.0, begins)
        keep("touches_moved", now["touches_moved"] + 1.0, begins & (moved > MOVED))
        if spec.carried:
            self._touch_at = torch.where((mask & touching)[:, None], centre, self._touch_at)
        # An object that jumps away while it is touched is let go too.
        keep("touching", touching, begins | (reach > spec.touch + APART))
        self._follow(mask, tick, root)

    def _follow(self, mask: Tensor, tick: Tensor, root: Tensor) -> None:
        """Update the signals of posture and tracker; a signal counts a second later."""
        now, loop = self._now, self.env.loop
        error = loop.command.joints[:, self._legs] - loop.state.joint_pos[:, self._legs]
        error = error.square().mean(dim=1).sqrt()
        up, wanted = _up(root[:, 3:7]), _up(loop.command.quat)
        lean = torch.arccos((up * wanted).sum(dim=1).clamp(-1.0, 1.0))
        fresh = tick <= 1
        for name, value in (("error", error), ("lean", lean)):
            mean = torch.where(fresh, value, now[name] + (value - now[name]) / SMOOTH)
            now[name] = torch.where(mask, mean, now[name])
        tilt, reference_tilt = (torch.arccos(v[:, 2].clamp(-1.0, 1.0)) for v in (up, wanted))
        past = self._ring[self._at].clone()
        places = torch.cat([root[:, :2], self._reference[:, :2]], dim=1)
        led = len(_LED)
        gone = places - past[:, led:]
        old = tick > LEAD
        drift = torch.linalg.vector_norm(gone[:, :2] - gone[:, 2:], dim=1) * old
        values = (error, now["error"], now["lean"], drift, tilt, root[:, 2], reference_tilt, self._reference[:, 2])
        self._ring[self._at] = torch.cat([torch.stack(values, dim=1), places], dim=1)
        self._at = (self._at + 1) % LEAD
        counts = mask & old
        untouched = counts & ((now["first_touch"] < 0) | (tick - now["first_touch"] <= LEAD))
        for column, (name, sign, early) in enumerate(_LED):
            where, value = untouched if early else counts, past[:, column]
            if sign == 0:
                now[name] = now[name] + torch.where(where, value, 0.0)
            else:
                best = torch.maximum(now[name], value) if sign > 0 else torch.minimum(now[name], value)
                now[name] = torch.where(where, best, now[name])
        now["counted"] = now["counted"] + counts


_LED = (
    ("tracking_sum", 0, False),
    ("tracking_worst", 1, False),
    ("tilt_error", 1, False),
    ("drift", 1, False),
    ("tilt", 1, True),
    ("height_min", -1, False),
    ("reference_tilt", 1, True),
    ("reference_height", -1, True),
)
"""Numbers that count a second late, in the order of the ring's columns: name, kind (0 sum, 1 largest, -1 smallest),
whether only those before the first touch count."""

_BEGIN = dict.fromkeys(
    """looks looks_seen first_pixels engaged_ticks aligned_ticks engaged_now aligned_now touches touches_moved touching
    moved error lean tracking_sum tracking_worst tilt_error drift tilt reference_tilt counted""".split(),
    0.0,
)
_BEGIN |= dict.fromkeys("first_seen first_touch start_distance touch_distance touch_bearing stop_bearing".split(), -1.0)
_BEGIN |= dict.fromkeys("nearest_distance reach_distance stop_distance height_min reference_height".split(), FAR)
"""Running number → its value before an episode's step 0; -1 and `FAR` mean that there is none yet."""


def shapes_of(env: World, prim: str) -> Tensor:
    """Shapes of the model that belong to a prim, bool, shape [shapes]."""
    labels = env.scene.model.shape_label
    return torch.tensor([f"{label}/".startswith(f"{prim}/") for label in labels], device=env.torch_device)


def _up(quat: Tensor) -> Tensor:
    """The body's z-axis in the world, [W, 3]."""
    return quat_apply(quat, torch.tensor([0.0, 0.0, 1.0], device=quat.device).expand(len(quat), 3))


def _signals(now: dict[str, float]) -> EpisodeSignals:
    """The record of the running numbers of one episode."""

    def count(name: str) -> int:
        return int(now[name])

    def maybe(name: str) -> float | None:
        return None if now[name] < 0 or now[name] >= FAR else round(now[name], 4)

    def ticks(name: str) -> int | None:
        return None if now[name] < 0 else int(now[name])

    def number(name: str) -> float:
        return round(max(now[name], 0.0), 4) if now[name] < FAR else 0.0

    return EpisodeSignals(
        looks=count("looks"),
        looks_seen=count("looks_seen"),
        first_pixels=count("first_pixels"),
        first_seen=ticks("first_seen"),
        start_distance=number("start_distance"),
        nearest_distance=number("nearest_distance"),
        engaged_ticks=count("engaged_ticks"),
        stop_distance=maybe("stop_distance"),
        stop_bearing=maybe("stop_bearing"),
        aligned_ticks=count("aligned_ticks"),
        reach_distance=number("reach_distance"),
        touches=count("touches"),
        first_touch=ticks("first_touch"),
        touch_distance=maybe("touch_distance"),
        touch_bearing=maybe("touch_bearing"),
        moved=number("moved"),
        touches_moved=count("touches_moved"),
        posture_margin=round(SOFT - now["tilt"], 4),
        height_min=number("height_min"),
        reference_tilt=number("reference_tilt"),
        reference_height=number("reference_height"),
        tracking_error=round(now["tracking_sum"] / max(now["counted"], 1.0), 4),
        tracking_worst=number("tracking_worst"),
        tilt_error=number("tilt_error"),
        drift=number("drift"),
    )
