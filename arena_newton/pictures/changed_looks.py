"""Changed looks of pictures whose shapes are known: other colours, patterns, lights, things in the room, exposure.

A batch is changed on its device, with tensors of fixed shapes and the device's default generator alone, so that the
work can be captured in a CUDA graph (`torch.where` with a number cannot: it would copy that to the device). Texture and
shading of a shape stay, or lose a part: each pixel's luminance over the mean of its shape times the new colour. The
robot and shapes whose colour matters keep theirs, nothing is put before them, and for nothing else a colour like it is
chosen: a policy that is sent to the green target would learn not to trust green. Highlights and casts may still come
near it.

What semantic mode shows is not among the looks: every drawn colour is one of `palette`, which keeps its distance from
`SEMANTIC_COLOURS`; so a brick is never drawn in the colour of that mode's bricks. Lights are those of the recording.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch

from arena_newton.kernels.pictures.lighting import FULL_LIGHT
from arena_newton.pictures.settings import DOME_COLOR, DOME_INTENSITY, FIGURES, FIRST_SHAPE
from arena_newton.tasks.base import KEY_OBJECT

__all__ = ["SEMANTIC_COLOURS", "USUAL", "Changes", "changed_looks", "goal_colour", "hue_lacks", "luminance", "palette"]
__all__ += ["recoloured", "seen_colours", "shape_sums", "unlike"]

SEMANTIC_COLOURS = (
    (0.05, 0.85, 0.1),  # the cube on the bag
    (0.35, 0.55, 0.8),  # window panes
    (0.8, 0.22, 0.02),  # the goal's net
    (0.05, 0.16, 0.38),  # the door leaf
    (0.62, 0.74, 0.78),  # its window
    (0.55, 0.04, 0.03),  # tins
    (0.03, 0.25, 0.1),  # a case
    (0.25, 0.16, 0.1),  # skirting
    (0.1, 0.19, 0.33),  # sofa
    (0.22, 0.12, 0.06),  # table
    (0.93, 0.78, 0.03),  # the ring on the floor
    (0.92, 0.92, 0.92),  # the sign's post
    (0.95, 0.36, 0.03),  # its plate
    (0.413, 0.202, 0.078),  # wood.png
    (0.342, 0.162, 0.06),  # wood.png
    (0.089, 0.037, 0.014),  # wood.png
    (0.314, 0.065, 0.04),  # brick.png
    (0.503, 0.468, 0.413),  # brick.png
    (0.386, 0.089, 0.053),  # brick.png
    (0.01, 0.01, 0.01),  # hazard.png
    (0.839, 0.515, 0.007),  # hazard.png
    (0.61, 0.125, 0.015),  # basketball.png
    (0.012, 0.008, 0.007),  # basketball.png
    (0.521, 0.098, 0.01),  # basketball.png
    (0.584, 0.402, 0.209),  # cardboard.png
    (0.44, 0.227, 0.084),  # cardboard.png
    (0.231, 0.107, 0.037),  # cardboard.png
    (0.68, 0.658, 0.617),  # tiles.png
    (0.246, 0.238, 0.223),  # tiles.png
    (0.617, 0.597, 0.552),  # tiles.png
    (0.275, 0.093, 0.076),  # carpet.png
    (0.235, 0.076, 0.065),  # carpet.png
    (0.202, 0.065, 0.054),  # carpet.png
)
"""Albedo of what semantic mode shows and base mode does not, linear RGB; of a texture its main colours."""
APART = 0.07
"""Least distance of a drawn colour from each of them as a picture shows it, in RGB from 0 to 1."""
COLOURS = 4096
"""Colours of the palette."""
DOME = DOME_INTENSITY * DOME_COLOR[0] / FULL_LIGHT
"""Exposure of the scenes' dome (`kernels.pictures.lighting`)."""
FACINGS = (0.45, 0.6, 0.725, 0.85, 1.0)
"""Light of the dome on surfaces that face down to up (`BOUNCE` to 1)."""
LUMA = (77.0, 150.0, 29.0)
"""Weights of red, green and blue in luminance, of 256 (Rec. 601)."""
SHAPES = 256
"""Values of a byte that names a shape."""
LEAST_CHROMA = 0.08
"""Distance of a goal's colour from grey, in RGB from 0 to 1, from which its hue tells it apart."""
LIKE_HUE, LIKE_CHROMA = 0.8, 1 / 3
"""A colour is like a goal's within 37° of its hue (the cosine) and from a third of its distance from grey on."""


@dataclass(frozen=True)
class Changes:
    """Probability of each kind of change in a sample whose look changes."""

    colours: float = 0.85
    """New colours of shapes or whole objects."""
    patterns: float = 0.5
    """A pattern instead of one colour, of each shape that gets another."""
    light: float = 0.6
    """A fraction of the second light."""
    things: float = 0.2
    """Something cut out of another task's picture."""
    rectangles: float = 0.1
    exposure: float = 0.8
    """Gain, gamma, cast, a smooth field, noise."""
    key_objects: float = 0.15
    """New colours of shapes that a hand must find (`TaskSpec.recolour` is `KEY_OBJECT`)."""
    goals: float = 0.0
    """New colours of what the task is about, where its form tells it apart (`TaskSpec.recolour` is `GOAL_OBJECT`)."""
    flat: float = 0.0
    """A part of its texture and shading less, of each shape that gets another colour."""
    figures: float = 0.0
    """Each of four ellipses or boxes with a look of its own, as furniture that no scene of a training has."""
    tones: float = 0.0
    """A pattern in tones of one colour, as of sand or wood, of each shape that gets another look."""

    def chances(self, own: torch.Tensor) -> torch.Tensor:
        """Probability of another colour of shapes whose films say `own`."""
        goal, key = (own > 0.0) & (own < KEY_OBJECT), (own >= KEY_OBJECT) & (own < 1.0)
        return own + goal * (self.goals - own) + key * (self.key_objects - own)


USUAL = Changes()
"""Changes of a training."""


def seen_colours(albedo: np.ndarray) -> np.ndarray:
    """Colours of surfaces in a picture under the scenes' dome, sRGB from 0 to 1, shape [n · 5, 3].

    Args:
        albedo: Linear RGB, shape [n, 3].
    """
    linear = 1.0 - np.exp(-DOME * np.asarray(albedo)[:, None, :] * np.array(FACINGS)[:, None])
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).reshape(-1, 3)


def hue_lacks(sixths: torch.Tensor, dim: int) -> torch.Tensor:
    """Fractions of red, green and blue that hues lack, along a new dimension; hues are in sixths of the circle.

    A colour is full within a sixth of the circle to both sides of its own, and zero beyond two.
    """
    offsets = torch.stack([torch.remainder(sixths + n, 6.0) for n in (5.0, 3.0, 1.0)], dim=dim)
    return torch.minimum(offsets, 4.0 - offsets).clamp_(0.0, 1.0)


@functools.cache
def palette(device: torch.device) -> torch.Tensor:
    """All colours that shapes may get, sRGB from 0 to 1, float32, shape [4096, 3]."""
    rng = np.random.default_rng(0)
    hue, grey, saturation, value = rng.random((4, 4 * COLOURS))
    saturation = np.where(grey < 0.5, 0.25 * saturation, 0.2 + 0.75 * saturation)
    value = 0.06 + 0.88 * value
    lacking = hue_lacks(torch.from_numpy(hue * 6.0), 1).numpy()
    drawn = value[:, None] * (1.0 - saturation[:, None] * lacking)
    shown = seen_colours(np.array(SEMANTIC_COLOURS).reshape(-1, 3))
    apart = np.linalg.norm(drawn[:, None] - shown[None], axis=2).min(axis=1, initial=1.0) >= APART
    return torch.from_numpy(drawn[apart][:COLOURS].astype(np.float32)).to(device)


def goal_colour(seen: torch.Tensor, shapes: torch.Tensor, chances: torch.Tensor) -> torch.Tensor:
    """Mean colour of the shapes that keep theirs, sRGB from 0 to 1, shape [3]; grey where no picture shows one.

    Args:
        seen: Pictures, uint8, shape [n, H, W, 3].
        shapes: Shape of each pixel, uint8, shape [n, H, W].
        chances: Probability of another colour of each shape, float32, shape [256].
    """
    goal = (shapes >= FIRST_SHAPE) & (chances[shapes.long()] == 0.0)
    return seen[goal].float().mean(dim=0).div(255.0).nan_to_num(0.5)


def unlike(goal: torch.Tensor) -> torch.Tensor:
    """Colours that may be drawn beside a goal that is told apart by its colour.

    Args:
        goal: Its mean colour in pictures, sRGB from 0 to 1, shape [3]; grey excludes none.

    Returns:
        Numbers of colours of `palette`, int64, shape [4096]: in place of those that are like the goal's, others again.
    """
    drawn, wanted = (colour - colour.mean(dim=-1, keepdim=True) for colour in (palette(goal.device), goal))
    length, least = torch.linalg.vector_norm(drawn, dim=1), torch.linalg.vector_norm(wanted)
    like = (drawn @ wanted > LIKE_HUE * length * least) & (length > LIKE_CHROMA * least) & (least > LEAST_CHROMA)
    number = torch.arange(COLOURS, device=goal.device)
    others = number[~like]
    return torch.where(like, others[number % len(others)], number)


def changed_looks(
    seen: torch.Tensor,
    frames: torch.Tensor,
    chances: torch.Tensor,
    objects: torch.Tensor,
    colours: torch.Tensor,
    task: torch.Tensor,
    changes: Changes = USUAL,
    changed: torch.Tensor | None = None,
) -> torch.Tensor:
    """Change the look of samples of a batch, each in its own way.

    Args:
        seen: Pictures, uint8, shape [B, H, W, 3].
        frames: Their looks, a shape and one or two light ratios per pixel, uint8, shape [B, H, W, 2 or 3]
            (`data.readers.looks`).
        chances: Probability of another colour of each shape, float32, shape [B, 256].
        objects: First shape of the object that each shape is part of, int64, shape [B, 256].
        colours: Colours that may be drawn, as of `unlike`, int64, shape [B, 4096].
        task: Number of each sample's task, int64, shape [B]; things are cut out of another task's pictures.
        changes: Probabilities.
        changed: Samples that change, bool, shape [B]; None: all.

    Returns:
        0 to 1, float32, shape [B, H, W, 3].
    """
    batch, height, width = seen.shape[:3]
    device = seen.device
    shapes = frames[..., 0].reshape(batch, -1).long()
    chance, free = changes.chances(chances), (chances >= 1.0).gather(1, shapes)
    pixels = seen.reshape(batch, -1, 3).float()
    luma = luminance(pixels)
    if changes.figures:
        shapes, luma = _with_figures(shapes, luma, free, (height, width), changes.figures)
        chance = torch.cat([chance[:, :-FIGURES], torch.ones_like(chance[:, :FIGURES])], dim=1)
    original = pixels = pixels.div_(255.0)
    sums = shape_sums(luma, shapes)
    pixels = recoloured(pixels, luma, shapes, sums, chance, objects, colours, (height, width), changes)
    things = objects, chance > 0.0
    pixels = _with_things(pixels, luma, shapes, sums, things, free, colours, task, (height, width), changes.things)
    inside = free & _rectangles(batch, height, width, device) & _happens(batch, changes.rectangles, device)
    pixels = torch.where(inside[..., None], _colours(1, colours), pixels)
    lit = torch.where(torch.rand((batch, 1, 1), device=device) < 0.5, frames[..., 1], frames[..., -1])
    weight = torch.rand((batch, 1), device=device).mul_(0.7).add_(0.3) * _happens(batch, changes.light, device)
    gains = 1.0 + weight * (torch.exp2((torch.arange(256.0, device=device) - 128.0) / 32.0) - 1.0)
    pixels = pixels * gains.gather(1, lit.reshape(batch, -1).long())[..., None]
    pixels = _exposed(pixels.clamp_(0.0, 1.0).view(batch, height, width, 3), changes.exposure)
    if changed is None:
        return pixels
    return torch.where(changed[:, None, None, None], pixels, original.view_as(pixels))


def recoloured(
    pixels: torch.Tensor,
    luma: torch.Tensor,
    shapes: torch.Tensor,
    sums: torch.Tensor,
    chance: torch.Tensor,
    objects: torch.Tensor,
    colours: torch.Tensor,
    size: tuple[int, int],
    changes: Changes,
) -> torch.Tensor:
    """Give shapes, or whole objects, another colour or a pattern of three.

    Args:
        pixels: 0 to 1, shape [B, P, 3].
        luma: Luminance of each pixel, 0 to 255, int64, shape [B, P].
        shapes: Shape of each pixel, int64, shape [B, P].
        sums: Luminance and number of the pixels of each shape, int64, shape [2, B, 256].
        chance: Probability of another colour of each shape, shape [B, 256].
        objects: First shape of the object that each shape is part of, int64, shape [B, 256].
        colours: As in `changed_looks`.
        size: Height and width, whose product is P.
        changes: Probabilities.

    Returns:
        Pixels of the same shape.
    """
    batch, device = len(pixels), pixels.device
    part = torch.where(torch.rand((batch, 1), device=device) < 0.5, objects, torch.arange(SHAPES, device=device))
    rate = torch.rand((batch, 1), device=device).mul_(0.7).add_(0.3) * _happens(batch, changes.colours, device)
    mine = torch.rand((batch, SHAPES), device=device).gather(1, part) < rate * chance
    which = _pattern(part, shapes, size, changes.patterns)
    three = _colours(3 * SHAPES, colours).view(batch, SHAPES, 9).take_along_dim(part[..., None], 1)
    tone = torch.ones((), device=device)
    if changes.tones:
        draws = torch.rand((2, batch, SHAPES), device=device).gather(2, part.expand(2, -1, -1))
        tonal, spread = draws.gather(2, shapes.expand(2, -1, -1))
        tone = 1.0 + (tonal < changes.tones) * spread * 0.3 * which
        which = which * (tonal >= changes.tones)
    chosen = three.view(batch, -1, 3).take_along_dim((3 * shapes + which)[..., None], 1)
    light, count = torch.zeros_like(sums).scatter_add_(2, part.expand_as(sums), sums).gather(2, part.expand_as(sums))
    shade = _over(luma, (light / count.clamp_min(1)).gather(1, shapes))
    if changes.flat:
        less = (torch.rand((batch, SHAPES), device=device) / changes.flat).clamp_max_(1.0)
        shade = shade.pow_(less.gather(1, part).gather(1, shapes))
    shade = (shade * tone)[..., None]
    return torch.where(mine.gather(1, shapes)[..., None], chosen.mul_(shade).clamp_(0.0, 1.0), pixels)


@functools.cache
def _weights(device: torch.device) -> torch.Tensor:
    return torch.tensor(LUMA, device=device)


def luminance(seen: torch.Tensor) -> torch.Tensor:
    """Luma in whole numbers, 0 to 255, int64, of pictures of the values 0 to 255 [..., 3].

    Exact in single precision, so the same on every device; and sums of it do not depend on their order.
    """
    return (seen.float() @ _weights(seen.device)).div_(256.0).long()


def shape_sums(luma: torch.Tensor, shapes: torch.Tensor) -> torch.Tensor:
    """Sum of the luminance of each shape's pixels, and their number, int64, shape [2, B, 256]; one pass for both."""
    both = torch.zeros((len(luma), SHAPES), dtype=torch.int64, device=luma.device)
    both.scatter_add_(1, shapes, luma + (1 << 32))
    return torch.stack([both & ((1 << 32) - 1), both >> 32])


def _over(luma: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
    """Luminance over a mean, bounded in both directions so that neither noise nor a highlight becomes a colour."""
    return (luma + 6.0).div_(mean + 6.0).clamp_(0.0, 2.5)


def _happens(batch: int, probability: float, device: torch.device) -> torch.Tensor:
    """True with this probability, per sample, shape [B, 1]."""
    return torch.rand((batch, 1), device=device) < probability


def _colours(count: int, colours: torch.Tensor) -> torch.Tensor:
    """Colours of the palette for each sample, of those that it may get, shape [B, count, 3]."""
    device = colours.device
    return palette(device)[colours.gather(1, torch.randint(0, COLOURS, (len(colours), count), device=device))]


def _pattern(part: torch.Tensor, shapes: torch.Tensor, size: tuple[int, int], probability: float) -> torch.Tensor:
    """Index of the three colours of its part at each pixel: one, blotches, stripes, tiles or bricks, in perspective.

    Args:
        part: Part of each shape, int64, shape [B, 256].
        shapes: Shape of each pixel, int64, shape [B, P].
        size: Height and width, whose product is P.
        probability: Of a pattern instead of one colour.

    Returns:
        0, 1 or 2, uint8, shape [B, P].
    """
    (height, width), batch, device = size, len(part), part.device
    uniform = torch.rand((8, batch, 1, 1), device=device)
    y = torch.linspace(-1.0, 1.0, height, device=device).view(1, -1, 1)
    x = torch.linspace(-1.0, 1.0, width, device=device).view(1, 1, -1)
    # A floor below a horizon, turned about the vertical; and a wall that recedes to one side.
    away = 1.0 / (y + 0.2 + 0.8 * uniform[0] + 0.2 * (uniform[1] - 0.5) * x).clamp_min(0.06)
    turn = math.pi * uniform[2]
    across = x * away
    floor = torch.cos(turn) * across - torch.sin(turn) * away, torch.sin(turn) * across + torch.cos(turn) * away
    near = 1.0 / (1.0 + 1.4 * (uniform[3] - 0.5) * x)
    wall = 2.0 * x * near, 2.0 * (y + 0.2 * (uniform[4] - 0.5)) * near
    draws = torch.rand((5, batch, SHAPES), device=device).gather(2, part.expand(5, -1, -1))
    lies, scale, kind, line, mixed = draws
    scale = 0.6 * torch.exp2(3.0 * scale)
    kind = (kind / max(probability, 1e-6) * 4.0).long()  # 4 and more: one colour
    bricks = kind == 3
    line = 0.03 + 0.12 * line
    # Bounds of each shape, beyond which no pixel is where its pattern has no such part.
    blotches, stripes, tiles = kind == 0, kind == 1, (kind == 2) | bricks
    bounds = [scale, scale * (1 + bricks.int()), 0.5 * bricks, 3.0 * line * stripes + line * tiles, line * tiles]
    bounds += [1.0 - 0.4 * mixed + 2.0 * ~stripes, 0.6 * mixed * tiles]
    scale_u, scale_v, offset, wide, high, last, speckled = (
        torch.stack(bounds).gather(2, shapes.expand(len(bounds), -1, -1)).unbind()
    )
    lying, blotched = torch.stack([lies < 0.5, blotches]).gather(2, shapes.expand(2, -1, -1)).unbind()
    u, v = (
        torch.where(lying, one.reshape(batch, -1), other.expand(-1, height, width).reshape(batch, -1)) * scale
        for one, other, scale in zip(floor, wall, (scale_u, scale_v), strict=True)
    )
    row = torch.floor(v)
    u = u + offset * torch.remainder(row, 2.0)
    along = torch.remainder(u, 1.0)
    cell = torch.floor(u) * 12.9898 + row * 78.233 + 100.0 * uniform[5].view(-1, 1)
    # Blotches: a random field of the sample, seen in the same perspective.
    field = torch.rand((batch, 2, 24, 24), device=device)
    where = torch.stack([torch.remainder(u / 4.0, 2.0), torch.remainder(v / 4.0, 2.0)], dim=-1).sub_(1.0)
    cloud = torch.nn.functional.grid_sample(field, where[:, None], padding_mode="border", align_corners=True)[:, :, 0]
    first = (cloud[:, 0] > 0.55) & blotched | (along < wide) | (torch.remainder(v, 1.0) < high)
    second = (along > last) | (torch.remainder(torch.sin(cell) * 4375.85, 1.0) < speckled)
    inner, outer = (cloud[:, 1] > 0.6) & blotched & first, second & ~first
    return first.byte().add_(inner).add_(outer, alpha=2)


def _with_things(
    pixels: torch.Tensor,
    luma: torch.Tensor,
    shapes: torch.Tensor,
    sums: torch.Tensor,
    things: tuple[torch.Tensor, torch.Tensor],
    free: torch.Tensor,
    colours: torch.Tensor,
    task: torch.Tensor,
    size: tuple[int, int],
    probability: float,
) -> torch.Tensor:
    """Put something out of another sample's picture somewhere, in another colour, behind what must stay visible.

    Args:
        things: Of each shape: its object, and whether that may get another colour; both of shape [B, 256].
    """
    (height, width), (batch, count), device = size, luma.shape, luma.device
    other = torch.randint(0, batch, (batch,), device=device)
    at = torch.randint(0, count, (batch, 1), device=device)
    first = other[:, None] * count  # pixel of all samples
    theirs, movable = (one[other] for one in things)
    thing = (theirs == theirs.gather(1, shapes.view(-1)[first + at])) & movable
    light, area = (sums[:, other] * thing).sum(dim=2, keepdim=True)
    fits = (area > 0.001 * count) & (area < 0.15 * count) & (task[other] != task)[:, None]
    fits &= _happens(batch, probability, device)
    moved = torch.rand((2, batch, 1), device=device) - 0.5
    down = torch.arange(height, device=device) + (0.6 * height * moved[0]).long()
    right = torch.arange(width, device=device) + (0.9 * width * moved[1]).long()
    within = ((down >= 0) & (down < height))[:, :, None] & ((right >= 0) & (right < width))[:, None, :]
    source = (first + down.clamp(0, height - 1) * width)[:, :, None] + right.clamp(0, width - 1)[:, None, :]
    source = source.reshape(batch, -1)
    put = thing.gather(1, shapes.view(-1)[source]) & within.reshape(batch, -1) & free & fits
    shade = _over(luma.view(-1)[source], light / area.clamp_min(1))
    colour = _colours(1, colours) * shade[..., None]
    return torch.where(put[..., None], colour.clamp_(0.0, 1.0), pixels)


def _with_figures(
    shapes: torch.Tensor, luma: torch.Tensor, free: torch.Tensor, size: tuple[int, int], probability: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Shapes and luminance of pictures with ellipses and boxes, the last shapes, upright before what may be hidden.

    They are shaded from one side to the other, and get colours as all shapes do; without one they show what was there.
    """
    (height, width), (batch, _), device = size, shapes.shape, shapes.device
    middle, half, kind = torch.rand((5, batch, FIGURES, 1, 1), device=device).split((2, 2, 1))
    half = 0.015 * torch.exp2(4.2 * half)  # to 0.28 of the picture's side
    down = (torch.arange(height, device=device).view(-1, 1) / height - middle[0]) / half[0]
    right = (torch.arange(width, device=device) / width - middle[1]) / half[1]
    inside = torch.where(kind[0] < 0.5, down**2 + right**2, torch.maximum(down.abs(), right.abs()) ** 2) < 1.0
    inside &= torch.rand((batch, FIGURES, 1, 1), device=device) < probability
    number = torch.arange(SHAPES - FIGURES, SHAPES, device=device).view(1, -1, 1, 1)
    top = (inside * number).amax(dim=1).reshape(batch, -1) * free
    shaded = (inside * (160.0 + 60.0 * right.clamp(-1.0, 1.0))).amax(dim=1).reshape(batch, -1).long()
    return torch.where(top > 0, top, shapes), torch.where(top > 0, shaded, luma)


def _rectangles(batch: int, height: int, width: int, device: torch.device) -> torch.Tensor:
    """Inside of a rectangle of each sample, bool, shape [B, P]."""
    middle = torch.rand((2, batch, 1), device=device)
    half = torch.rand((2, batch, 1), device=device) * 0.15 + 0.02
    rows, columns = (
        (torch.arange(length, device=device) / length - middle[axis]).abs() < half[axis]
        for axis, length in enumerate((height, width))
    )
    return (rows[:, :, None] & columns[:, None, :]).reshape(batch, -1)


def _exposed(pictures: torch.Tensor, probability: float) -> torch.Tensor:
    """Gain, gamma, cast, a smooth field and noise, each in its own fraction of the samples."""
    batch, height, width = pictures.shape[:3]
    device = pictures.device

    def drawn(low: float, high: float, *shape: int) -> torch.Tensor:
        value = torch.rand((batch, *shape), device=device) * (high - low) + low
        return 1.0 + (value - 1.0) * _happens(batch, probability, device).view(-1, *(1,) * len(shape))

    field = torch.nn.functional.interpolate(
        drawn(0.75, 1.25, 1, 3, 4), size=(height, width), mode="bilinear", align_corners=True
    )
    gain = drawn(0.65, 1.35, 1, 1, 1) * drawn(0.88, 1.12, 1, 1, 3)
    pictures = (pictures * gain).mul_(field.permute(0, 2, 3, 1)).clamp_(1e-4, 1.0)
    pictures = pictures.pow_(drawn(0.7, 1.4, 1, 1, 1))
    noise = torch.randn(pictures.shape, device=device).mul_(drawn(1.0, 1.03, 1, 1, 1) - 1.0)
    return noise.add_(pictures).clamp_(0.0, 1.0)
