"""Changed looks: what never changes, and that nothing of semantic mode's scenes is drawn."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom, UsdShade

from arena_newton.physics.scene import SCENES
from arena_newton.pictures import changed_looks as looks
from arena_newton.pictures.changed_looks import Changes, changed_looks, palette, recoloured, seen_colours, unlike
from arena_newton.rules.modes import HELD_OUT
from arena_newton.tasks.base import GOAL_OBJECT, KEY_OBJECT

CPU = torch.device("cpu")
BATCH, HEIGHT, WIDTH = 32, 24, 32
ROBOT, KEPT, SELDOM, WALL, FLOOR, BALL = 1, 2, 3, 4, 5, 6
STILL = Changes(light=0.0, exposure=0.0)
"""Neither light nor exposure, which change every pixel."""


@pytest.fixture(scope="module")
def batch():
    """Noisy pictures of a robot, four things and two surfaces, of two tasks: arguments of `changed_looks`."""
    rng = np.random.default_rng(3)
    seen = rng.integers(60, 200, (BATCH, HEIGHT, WIDTH, 3), np.uint8)
    frames = np.full((BATCH, HEIGHT, WIDTH, 3), 128, np.uint8)
    frames[..., 0] = WALL
    frames[:, HEIGHT // 2 :, :, 0] = FLOOR
    for shape, left in ((ROBOT, 0), (KEPT, 8), (SELDOM, 16), (BALL, 24)):
        frames[:, 8:16, left : left + 6, 0] = shape
    frames[:, :2, :, 0] = 0
    chances = torch.zeros(BATCH, 256)
    chances[:, BALL], chances[:, SELDOM], chances[:, WALL], chances[:, FLOOR] = GOAL_OBJECT, KEY_OBJECT, 1.0, 1.0
    objects, colours = torch.arange(256).expand(BATCH, -1), torch.arange(looks.COLOURS).expand(BATCH, -1)
    task = torch.arange(BATCH) % 2
    return torch.from_numpy(seen), torch.from_numpy(frames), chances, objects, colours, task


def differ(pictures, seen):
    """Pixels that are not as they were, bool, shape [B, H, W]."""
    return ((pictures - seen / 255.0).abs() > 1e-4).any(dim=-1)


def coded(colours):
    """Colours as one number each, by whole grey levels."""
    return ((255.0 * colours).round().long() * torch.tensor([65536, 256, 1])).sum(dim=-1)


def semantic_colours():
    """Albedo of every look that a scene's own variant shows and its base does not: texture or colour → linear.

    Held-out rooms are scenes of their own and not among them: no training is chosen by what they show.
    """
    found = {}
    for file in sorted(SCENES.glob("*/variants/*.usda")):
        if file.stem in HELD_OUT:
            continue
        shown = [bound(SCENES / file.parts[-3] / "scene.usda", name) for name in ("base", file.stem)]
        for look, prims in shown[1].items():
            if prims - shown[0].get(look, set()):
                found[look] = main_colours(SCENES / "textures" / look) if isinstance(look, str) else [look]
    return found


def bound(scene, variant):
    """Prims that are drawn in a variant, by their texture's name or their colour."""
    stage = Usd.Stage.Open(str(scene))
    stage.SetEditTarget(stage.GetSessionLayer())  # others read the layer in this process
    stage.GetDefaultPrim().GetVariantSet("semantics").SetVariantSelection(variant)
    found = {}
    for prim in Usd.PrimRange(stage.GetDefaultPrim()):
        path = str(prim.GetPath())
        if not prim.IsA(UsdGeom.Gprim) or UsdGeom.Imageable(prim).ComputeVisibility() == "invisible":
            continue
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        if not material or path.startswith("/World/Robot"):
            continue
        texture = material.GetPrim().GetChild("Texture")
        if texture:
            look = UsdShade.Shader(texture).GetInput("file").Get().path.rsplit("/", 1)[-1]
        else:
            surface = UsdShade.Shader(material.GetPrim().GetChild("Surface"))
            look = tuple(round(float(value), 4) for value in surface.GetInput("diffuseColor").Get())
        found.setdefault(look, set()).add(path)
    return found


def main_colours(texture):
    """The colours of a texture that cover at least a tenth of it, linear RGB."""
    pixels = cv2.imread(str(texture))[..., ::-1].reshape(-1, 3).astype(np.float32)
    cv2.setRNGSeed(0)
    _, label, centres = cv2.kmeans(pixels, 3, None, (3, 50, 0.1), 3, cv2.KMEANS_PP_CENTERS)
    share = np.bincount(label.ravel(), minlength=3) / len(label)
    value = centres[share >= 0.1] / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).tolist()


def test_no_drawn_colour_is_one_of_semantic_modes():
    """Each of the 4,096 colours that shapes may get differs from every look that only semantic mode shows."""
    found = semantic_colours()
    assert {"brick.png", "tiles.png", "wood.png", "hazard.png", (0.05, 0.16, 0.38), (0.8, 0.22, 0.02)} <= set(found)
    drawn = palette(CPU).numpy()
    assert drawn.shape == (looks.COLOURS, 3) and len(np.unique(drawn.round(3), axis=0)) > 4000
    for look, colours in found.items():
        listed = np.linalg.norm(np.array(colours)[:, None] - np.array(looks.SEMANTIC_COLOURS), axis=2).min(axis=1)
        assert listed.max() < 0.01, (look, listed)  # colours of textures are listed to three digits
        apart = np.linalg.norm(drawn[:, None] - seen_colours(np.array(colours)), axis=2).min()
        assert apart > 0.06, (look, apart)
    # The colours are spread as widely as that allows: some are near the distance that is kept.
    assert np.linalg.norm(drawn[:, None] - seen_colours(np.array(looks.SEMANTIC_COLOURS)), axis=2).min() < 0.08


def test_shapes_get_colours_of_the_palette_alone(batch):
    """Every colour in 2,000 looks of evenly lit shapes is one of the palette."""
    seen, frames, chances, objects, colours, _ = batch
    torch.manual_seed(0)
    known = set(coded(palette(CPU)).tolist())
    even, shapes = torch.full_like(seen, 120), frames[..., 0].reshape(BATCH, -1).long()
    pixels, luma = even.reshape(BATCH, -1, 3) / 255.0, looks.luminance(even).reshape(BATCH, -1)
    patterned, drawn = 0, set()
    for _ in range(2000 // BATCH):
        sums = looks.shape_sums(luma, shapes)
        found = recoloured(pixels, luma, shapes, sums, chances, objects, colours, (HEIGHT, WIDTH), STILL)
        changed = (found != pixels).any(dim=2)
        drawn |= set(coded(found[changed]).unique().tolist())
        codes = torch.where(shapes == WALL, coded(found), -1)
        patterned += sum(len(one.unique()) > 2 for one in codes)
    assert drawn <= known and len(drawn) > 1000
    assert 200 < patterned < 1000


def test_robot_and_things_whose_colour_matters_stay(batch):
    """Neither colour nor anything else is put on the robot, on what keeps its colour, or on the background."""
    seen, frames, *_ = batch
    torch.manual_seed(1)
    seldom = walls = 0
    for _ in range(10):
        changed = differ(changed_looks(*batch, STILL), seen)
        shapes = frames[..., 0]
        assert not changed[(shapes <= KEPT) | (shapes == BALL)].any()
        seldom += int(changed[shapes == SELDOM].float().mean() * 1000)
        walls += int(changed[shapes == WALL].float().mean() * 1000)
    assert 0 < seldom < 1500 and 4000 < walls < 9000


@pytest.mark.parametrize(("kind", "shape", "other"), [("key_objects", SELDOM, BALL), ("goals", BALL, SELDOM)])
def test_key_objects_and_goals_change_as_often_as_is_asked(batch, kind, shape, other):
    """Each kind gets another colour never, or as walls do, and the other kind and what keeps its colour do not."""
    seen, frames, *_ = batch
    shapes = frames[..., 0]
    for asked in (0.0, 1.0):
        torch.manual_seed(1)
        alone = replace(STILL, things=0.0, rectangles=0.0, key_objects=0.0, goals=0.0)
        changed = [differ(changed_looks(*batch, replace(alone, **{kind: asked})), seen) for _ in range(10)]
        found, walls = (
            np.mean([float(one[shapes == kind].float().mean()) for one in changed]) for kind in (shape, WALL)
        )
        assert not any(one[(shapes <= KEPT) | (shapes == other)].any() for one in changed)
        assert found == 0.0 if asked == 0.0 else abs(found - walls) < 0.2, (found, walls)


def test_flat_shapes_lose_texture(batch):
    """Of shapes that get one other colour about half keep less of their texture, and some of those nearly none."""
    seen, frames, chances, *others = batch
    walls = frames[..., 0] == WALL
    spread = {}
    for flat in (0.0, 0.5):
        torch.manual_seed(2)
        plain = Changes(colours=1.0, patterns=0.0, flat=flat, light=0.0, things=0.0, rectangles=0.0, exposure=0.0)
        values = changed_looks(*batch, plain).amax(dim=-1).double()
        shown = [one[wall] for one, wall in zip(values, walls, strict=True)]
        spread[flat] = torch.stack([one.std() / one.mean() for one in shown])
    less = spread[0.5] < 0.9 * spread[0.0]
    assert 0.2 < less.double().mean() < 0.6 and (spread[0.5] < 0.3 * spread[0.0]).any()
    assert (spread[0.5] <= spread[0.0] + 1e-9).all()


def test_tones_are_of_one_colour(batch):
    """The pixels of an evenly lit shape in a pattern of tones differ in their luminance alone."""
    seen, frames, *rest = batch
    torch.manual_seed(6)
    wall = frames[..., 0] == WALL
    tonal = Changes(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, tones=1.0)
    found = changed_looks(torch.full_like(seen, 120), frames, *rest, tonal)
    pixels = [one[shown] for one, shown in zip(found, wall, strict=True)]
    hues = [one / one.amax(dim=1, keepdim=True) for one in pixels if float(one.max()) < 0.99]
    assert len(hues) > 5 and max(float((one - one[0]).abs().max()) for one in hues) < 1e-4
    assert any(len(one.amax(dim=1).unique()) > 1 for one in pixels)


def test_figures_stand_before_what_may_be_hidden_alone(batch):
    """Walls and floor are partly hidden by figures in colours of the palette, and nothing else changes."""
    seen, frames, *_ = batch
    torch.manual_seed(4)
    bare = torch.zeros_like(batch[2])
    bare[:, WALL], bare[:, FLOOR] = 1.0, 1.0
    figures = Changes(1.0, 0.3, 0.0, 0.0, 0.0, 0.0, key_objects=0.0, figures=0.9)
    off = replace(figures, figures=0.0)
    hidden = 0.0
    for _ in range(5):
        changed = changed_looks(seen, frames, bare, *batch[3:], figures)
        assert not differ(changed, seen)[frames[..., 0] > FLOOR].any() and not differ(changed, seen)[:, :2].any()
        even = torch.full_like(seen, 120)
        spans = [
            len(coded(changed_looks(even, frames, bare, *batch[3:], kind)).unique()) / BATCH for kind in (figures, off)
        ]
        hidden += spans[0] > spans[1]
    assert hidden >= 4, "pictures with figures have more colours"


def test_nothing_gets_the_colour_of_a_goal_that_is_told_by_it(batch):
    """Beside a green goal no shape, thing or rectangle is drawn in a green; beside a grey one all colours may be."""
    seen, frames, chances, *rest = batch
    goal = looks.goal_colour(seen, frames[..., 0], chances[0])
    assert torch.equal(goal, seen[frames[..., 0] == KEPT].float().mean(0) / 255.0)
    assert torch.equal(unlike(goal), torch.arange(looks.COLOURS))  # noise about a grey
    green = unlike(torch.tensor([0.25, 0.75, 0.3]))
    drawn = palette(CPU)[green]
    greens = int(greenness(palette(CPU)).sum())
    assert not greenness(drawn).any() and 200 < greens < 600 and len(green.unique()) > 3400
    even = Changes(colours=1.0, light=0.0, exposure=0.0, things=1.0, rectangles=1.0)
    allowed, plain = [green.expand(BATCH, -1), *rest[2:]], [*rest[1:]]
    torch.manual_seed(7)
    found = [
        changed_looks(torch.full_like(seen, 120), frames, chances, rest[0], *one, even) for one in (allowed, plain)
    ]
    assert not greenness(found[0]).any() and greenness(found[1]).any()


def greenness(colours):
    """Colours whose hue is within 30° of green and that are far from grey, sRGB from 0 to 1, shape [..., 3]."""
    red, green, blue = colours.unbind(-1)
    least = colours.min(dim=-1).values
    return (green - least > 0.25) & (torch.maximum(red, blue) - least < 0.5 * (green - least))


def test_texture_and_shading_stay(batch):
    """The luminance of a shape in one colour keeps the order of its pixels."""
    seen, frames, *_ = batch
    torch.manual_seed(2)
    plain = Changes(colours=1.0, patterns=0.0, light=0.0, things=0.0, rectangles=0.0, exposure=0.0)
    found = (255.0 * changed_looks(*batch, plain)).round().byte()
    wall = frames[0, ..., 0] == WALL
    pairs = [(looks.luminance(seen[n])[wall], looks.luminance(found[n])[wall]) for n in range(BATCH)]
    related = [np.corrcoef(before.numpy(), after.numpy())[0, 1] for before, after in pairs if len(after.unique()) > 20]
    assert len(related) > BATCH // 2 and min(related) > 0.9


def test_the_second_light_is_that_of_the_film(batch):
    """A ratio of a half darkens to a half at most; without any change pictures stay."""
    seen, frames, *rest = batch
    dark = frames.clone()
    dark[..., 1:] = 96  # a half
    torch.manual_seed(3)
    off = Changes(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    ratio = changed_looks(seen, dark, *rest, off) / (seen / 255.0)
    assert 0.499 < float(ratio.min()) < 0.6 and float(ratio.max()) <= 0.86
    none = changed_looks(seen, dark, *rest, Changes(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert torch.allclose(none, seen / 255.0, atol=1e-6)


def test_things_are_of_other_tasks(batch):
    """Something is cut out of a picture of another task where there is one, and of none of its own task."""
    seen, *rest, task = batch
    torch.manual_seed(4)
    things = Changes(0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    mixed, alone = (differ(changed_looks(seen, *rest, tasks, things), seen) for tasks in (task, torch.zeros_like(task)))
    assert mixed.any() and not alone.any()


def test_looks_follow_the_seed(batch):
    """The device's seed decides everything: equal seeds give equal pictures, others give others."""
    found = []
    for seed in (5, 5, 6):
        torch.manual_seed(seed)
        found.append(changed_looks(*batch))
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])
    assert found[0].min() >= 0.0 and found[0].max() <= 1.0
