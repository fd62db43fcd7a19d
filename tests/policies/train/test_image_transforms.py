"""LeRobot's image transforms on a batch: torchvision's results, LeRobot's ranges, one draw per step of a training."""

import pytest
import torch
from lerobot.transforms import ImageTransformsConfig
from torchvision.transforms.v2 import functional

from arena_newton.policies.recipes.training_recipe import FAMILIES, RECIPES, recipe
from arena_newton.policies.train.families import families
from arena_newton.policies.train.frames import augmentation
from arena_newton.policies.train.frames.augmentation import gathered_pictures
from arena_newton.policies.train.frames.batching import BatchMaker
from arena_newton.policies.train.frames.frame_store import made_statistics
from arena_newton.policies.train.frames.image_transforms import (
    CHOSEN,
    RANGES,
    TRANSLATION,
    TransformDraw,
    drawn_transforms,
    transformed,
)
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from benchmarks.made_frames import made_frames
from tests.policies.train import narrow_network

CPU = torch.device("cpu")
NAMES = list(RANGES)
REFERENCE = {
    "brightness": functional.adjust_brightness,
    "contrast": functional.adjust_contrast,
    "saturation": functional.adjust_saturation,
    "hue": functional.adjust_hue,
    "sharpness": functional.adjust_sharpness,
}


def pictures(count=4, height=30, width=40):
    """Noise with grey, black, white and one-coloured parts, at which hues are hard."""
    made = torch.rand((count, 3, height, width), generator=torch.Generator().manual_seed(1))
    made[:, :, :4], made[:, :, 4:6], made[:, 1:, 6:8] = made[:, :1, :4], 0.0, 0.0
    made[:, :, 8:9], made[:, 2, 9:11], made[:, :2, 11] = 1.0, made[:, 1, 9:11], made[:, 1:, 11]
    return made


def affine(picture, degrees, moved):
    """Torchvision's affine transform."""
    shift = [int(one) for one in moved]
    return functional.affine(picture, angle=float(degrees), translate=shift, scale=1.0, shear=[0.0, 0.0])


@pytest.mark.parametrize("name", list(REFERENCE))
def test_one_transform_is_torchvisions(name):
    """At given factors, both ends and one between, every sample is what torchvision makes of it alone."""
    given = pictures()
    low, high = RANGES[name]
    values = torch.zeros(4, 6)
    values[:, NAMES.index(name)] = torch.tensor([low, high, 0.3 * low + 0.7 * high, low])
    chosen = torch.zeros(4, 6, dtype=torch.bool)
    chosen[:3, NAMES.index(name)] = True
    got = transformed(given, TransformDraw(chosen, values, torch.zeros(4, 2)))
    for i in range(3):
        wanted = REFERENCE[name](given[i], float(values[i, NAMES.index(name)]))
        assert torch.allclose(got[i], wanted, atol=2e-6), name
        assert not torch.allclose(got[i], given[i], atol=1e-3)
    assert torch.equal(got[3], given[3]), "a transform that was not drawn changes nothing"


@pytest.mark.parametrize("moved", [(0.0, 0.0), (2.0, -1.0)])
def test_the_affine_transform_is_torchvisions(moved):
    """Turned and shifted pictures have torchvision's pixels; at most one of a thousand lies between two."""
    given = pictures(3)
    values, chosen = torch.zeros(3, 6), torch.zeros(3, 6, dtype=torch.bool)
    values[:, 5], chosen[:, 5] = torch.tensor([-5.0, 3.3, 0.0]), True
    got = transformed(given, TransformDraw(chosen, values, torch.tensor([moved] * 3)))
    for i in range(3):
        differs = (got[i] != affine(given[i], values[i, 5], moved)).float().mean()
        assert differs < 1e-3
    assert not torch.equal(got[0], got[2])


def test_a_subset_is_applied_in_lerobots_order():
    """Three transforms one after the other, in the order of LeRobot's table."""
    given = pictures(200, 12, 16)
    torch.manual_seed(5)
    draw = drawn_transforms(200, 12, 16, CPU)
    got = transformed(given, draw)
    for i in range(0, 200, 7):
        wanted = given[i]
        for number in draw.chosen[i].nonzero().flatten().tolist():
            value = float(draw.values[i, number])
            wanted = affine(wanted, value, draw.moved[i]) if number == 5 else REFERENCE[NAMES[number]](wanted, value)
        assert (torch.isclose(got[i], wanted, atol=1e-5).float().mean()) > 0.995
    assert got.min() >= 0.0 and got.max() <= 1.0


def test_the_ranges_are_lerobots():
    """Names, order, ranges and number are those of LeRobot's defaults, and the draws lie within them."""
    config = ImageTransformsConfig()
    assert list(config.tfs) == NAMES and config.max_num_transforms == CHOSEN and not config.random_order
    for name, one in config.tfs.items():
        wanted = one.kwargs["degrees" if name == "affine" else name]
        assert tuple(wanted) == RANGES[name] and one.weight == 1.0
    assert config.tfs["affine"].kwargs == {"degrees": RANGES["affine"], "translate": TRANSLATION}
    draw = drawn_transforms(4000, 100, 200, CPU)
    assert (draw.chosen.sum(dim=1) == CHOSEN).all() and (draw.chosen.float().mean(dim=0) - 0.5).abs().max() < 0.04
    for number, (low, high) in enumerate(RANGES.values()):
        of = draw.values[:, number]
        assert low <= of.min() < low + 0.02 * (high - low) and high - 0.02 * (high - low) < of.max() <= high
    assert draw.moved.abs().amax(dim=0).tolist() == [10.0, 5.0] and torch.equal(draw.moved, draw.moved.round())


def test_a_batch_follows_from_the_seed_of_its_step():
    """The same seed gives the same pictures, black rows are seen by the transforms, and samples differ."""
    store = made_frames(100, 64, CPU)
    rows = torch.tensor([3, 3, 50])

    def made(seed):
        torch.manual_seed(seed)
        return gathered_pictures(store, rows, transforms=True)

    plain = gathered_pictures(store, rows)
    first = made(1)
    assert torch.equal(first, made(1)) and not torch.equal(first, made(2))
    assert first.shape == plain.shape and not torch.equal(first[0], first[1])
    many = gathered_pictures(store, torch.arange(60), transforms=True)
    assert many[:, :, :8].amax() > 0.0, "an affine transform moves what was seen into the black rows"


@pytest.mark.parametrize("family", FAMILIES)
def test_only_the_papers_pi05_has_them(family):
    """The paper's table enables image transforms of pi0.5 alone; other recipes shift and tint by themselves."""
    for name, having in RECIPES.items():
        if family in having:
            assert recipe(family, name).image_transforms == ((family, name) == ("pi05", "paper"))


def test_a_training_applies_what_its_recipe_says(monkeypatch):
    """Steps of a recipe with transforms see other pictures than those of one without; the held-out loss sees none."""
    drawn = []

    def watch(*shape):
        drawn.append(shape)
        return drawn_transforms(*shape)

    narrow_network.install(monkeypatch.setattr)
    monkeypatch.setattr(augmentation, "drawn_transforms", watch)
    losses = []
    for transforms in (False, True):
        settings = recipe("act", "small", image_transforms=transforms, shift_px=0, colour=0.0)
        torch.manual_seed(0)
        model = families.build(settings, made_statistics(), "cpu")
        store = made_frames(60, 64, CPU)
        trainer = PolicyTrainer(model, BatchMaker(store, model.normalise, model.samples), settings)
        trainer.fix_steps(2)
        trainer.advance()
        losses.append(float(trainer.loss))
        trainer.held = trainer.samples[:4]
        trainer.held_out_losses()
    assert drawn == [(settings.batch_size, 64, 64, CPU)] and losses[0] != losses[1]
