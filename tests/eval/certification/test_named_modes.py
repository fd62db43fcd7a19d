"""Modes that a certification is asked for by name: what their records say is compared with what they move."""

import dataclasses

import pytest

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.certification import certify
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks.named_modes import drawn
from arena_newton.physics.dynamics import SensorNoise
from arena_newton.rules import modes, seeding
from arena_newton.rules.modes import Mode
from arena_newton.rules.rule_types import PoseRange

SEEDS = [seeding.episode_seed(tasks.get("football").gym_id, 0, repeat) for repeat in range(300)]
DIM = Mode(
    name="dim",
    sentence="a drawn light, a ball further to the left, grainy pictures, and late actions",
    placements=lambda rule: dataclasses.replace(rule.base, y=(1.0, 2.0)),
    light=lambda rules: rules.visual_light,
    dynamics={
        **{"action_latency": (1, 3), "picture_noise": (2.0, 8.0)},
        **{"push": (0.5, 1.0), "push_heading": (0.0, 1.0), "push_time": (0.1, 0.2)},
    },
)


@pytest.fixture
def offered():
    """Offers modes in this process, for one test."""
    names = []

    def offer(mode):
        names.append(mode.name)
        modes.register(mode)
        return mode.name

    yield offer
    for name in names:
        modes.unregister(name)


def options(folder, **given):
    return CertifyOptions(out=str(folder), task=("football",), tracker=("twist2",), quick=True, **given)


def test_a_mode_moves_what_its_record_says(tmp_path, offered, capsys):
    """A mode of placements, a light and dynamics passes, and its line names each number that it moves."""
    assert certify.run(options(tmp_path, checks=("modes",), mode=(offered(DIM),))) == 0
    said = capsys.readouterr().out
    drawn_here = "action_latency", "picture_noise", "push", "push_heading", "push_time"
    numbers = ", ".join([*(f"dynamics {name}" for name in drawn_here), "football y"])
    assert f"dim moves {numbers}, a drawn light; nothing else" in said


def test_what_changes_more_or_less_than_its_record_says_is_found(tmp_path, offered, damped, monkeypatch):
    """Damping beside the friction that is drawn, noise of pictures that no picture has."""
    damped()
    monkeypatch.setattr(SensorNoise, "on_picture", lambda self, name, image, asked, tick: image)
    ranges = {"friction": (0.2, 0.5), "picture_noise": (2.0, 8.0)}
    slick = offered(Mode(name="slick", sentence="slippery and grainy", dynamics=ranges))
    assert certify.run(options(tmp_path, checks=("modes",), mode=(slick,))) == 1
    text = "".join(page.read_text() for page in tmp_path.glob("certify*.md")).replace("\\_", "_")
    assert "mode slick: football: dof_damping is not as drawn" in text
    assert "mode slick: football: picture_noise: the first picture is that of base mode" in text


def test_draws_that_are_not_the_record_s_are_found(offered, monkeypatch):
    """Draws outside the ranges, of other numbers, or of none are faults, each with its name."""
    offered(DIM)
    rows, faults = drawn("football", "dim", "paper", SEEDS)
    assert not faults and ("football", "y", "-1.200 … 1.200", "1.000 … 2.000") in [row[:4] for row in rows]
    spec = tasks.get("football")

    def other(seed, mode, rules):
        sampled = spec.sample(seed, "base", rules)
        sampled["football"]["x"] += 0.01 * (mode == "dim")
        return sampled

    monkeypatch.setattr(tasks, "get", lambda name: dataclasses.replace(spec, sample=other))
    assert drawn("football", "dim", "paper", SEEDS)[1] == [
        "moves football x, which the record does not name",
        "does not move football y",
    ]


def test_modes_are_refused_by_name(tmp_path, offered):
    """An unknown mode, the check without a mode, and a range of another kind are errors by name."""
    with pytest.raises(InputError, match="--mode moon: unknown"):
        certify.run(options(tmp_path, mode=("moon",)))
    with pytest.raises(InputError, match="--checks modes: name the modes by --mode"):
        certify.run(options(tmp_path, checks=("modes",)))
    offered(Mode(name="flat", sentence="a pose", placements=lambda rule: PoseRange((0.0, 1.0), (0.0, 1.0), (1.0, 1.0))))
    with pytest.raises(InputError, match="mode flat: placements of boxing_target: PoseRange, expected a CylinderRange"):
        drawn("boxing", "flat", "paper", SEEDS[:2])
