"""The check of gradients finds a slope that is off by a percent, and does not mistake a kink for one."""

import json

import pytest
import torch

from arena_newton.differentiable import RollingBall
from arena_newton.eval.certification import certify
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import gradients
from arena_newton.eval.certification.checks.gradients import Agreement, Slopes, agreement_of, flight_slopes
from arena_newton.eval.play.env_cache import EnvCache
from arena_newton.eval.play.factories import Factories

ESTIMATES = torch.tensor([1.0, -2.0, 0.001, 0.5, 1.5])


def slopes(exact=ESTIMATES, spread=0.0):
    """Slopes of five points."""
    return Slopes(exact, ESTIMATES, torch.as_tensor(spread).expand(5))


def test_a_percent_is_found():
    """Equal slopes agree, and one of them that is off by a percent does not; nor do all of them."""
    assert agreement_of(slopes()) == (5, 5, 0.0)
    assert agreement_of(slopes()).holds and agreement_of(slopes(ESTIMATES * 1.002)).holds
    for factor in (1.01, 0.99, -1.0):
        one = ESTIMATES.clone()
        one[1] *= factor
        assert not agreement_of(slopes(one)).holds and not agreement_of(slopes(ESTIMATES * factor)).holds
    assert agreement_of(slopes(ESTIMATES * 1.01)).error == pytest.approx(0.01, rel=1e-3)


def test_a_small_slope_is_measured_by_the_others():
    """Rounding next to zero is no error, a slope that should be next to zero and is not is one."""
    for offset, holds in ((0.001, True), (0.01, False)):
        assert agreement_of(slopes(ESTIMATES + torch.tensor([0.0, 0.0, offset, 0.0, 0.0]))).holds is holds


def test_kinks_are_left_out_but_not_all():
    """Points at which slopes within the step differ are not compared; too many of them, or no slope at all, fail."""
    wrong = ESTIMATES * torch.tensor([1.0, 1.5, 1.0, 1.0, 1.0])
    assert agreement_of(slopes(wrong, torch.tensor([0.0, 0.5, 0.0, 0.0, 0.0]))) == (4, 5, 0.0)
    assert not agreement_of(slopes(ESTIMATES, 0.5)).holds and agreement_of(slopes(ESTIMATES, 0.5)).compared == 0
    assert Agreement(1, 10, 0.0).holds and not Agreement(1, 11, 0.0).holds
    assert not agreement_of(Slopes(*torch.zeros(3, 5))).holds


def test_directions_of_a_known_function():
    """Exact and estimated slopes of a smooth function are the same; one that gives a wrong gradient is found."""

    class Off(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, grad):
            return 1.01 * grad

    draws = torch.Generator().manual_seed(1)
    at = [torch.randn(64, 3, generator=draws).double(), torch.randn(64, 2, 2, generator=draws).double()]

    def function(a, b):
        return a.square().sum(1) + (a[:, :2, None] * b).sum((1, 2)).sin()

    found = gradients._directional(function, at, [1e-3, 1e-3], draws)
    assert agreement_of(found).holds and agreement_of(found).compared > 50
    found = gradients._directional(lambda a, b: function(Off.apply(a), Off.apply(b)), at, [1e-3, 1e-3], draws)
    assert agreement_of(found).error == pytest.approx(0.01, rel=0.1)


def test_a_kink_on_each_side_is_one():
    """A step over a ridge as wide as itself, whose one-sided slopes agree, is not taken for a slope."""
    draws = torch.Generator().manual_seed(1)
    at = [torch.zeros(64, 1).double()]
    found = gradients._directional(lambda x: (2.0 * x - x.clamp(-4e-4, 4e-4)).sum(1), at, [1e-3], draws)
    assert agreement_of(found).error < 1e-9 and 0 < agreement_of(found).compared < 40


@pytest.fixture
def certified():
    """Exit code and finding of a certification of football's gradients through one tracker, with a short start-up."""
    flags = {"task": ("football",), "tracker": ("pd",), "quick": True, "checks": ("gradients",)}
    kept = EnvCache()

    def env(task, **options):
        made = kept(task, **options)
        made.startup_ticks = 4
        return made

    def result(folder):
        code = certify.run(CertifyOptions(out=str(folder), **flags), Factories(env=env))
        return code, json.loads((folder / "certify.json").read_text())["checks"]["gradients"]

    yield result
    kept.drop()


def test_the_gradients_of_a_task(certified, tmp_path, monkeypatch):
    """Conversion, margin, tick and flight of football agree; conversion and tick that are off by a percent do not."""
    monkeypatch.setattr(gradients, "TICKS", (17, 17))
    monkeypatch.setattr(gradients, "TICK_EVERY", 20)
    monkeypatch.setattr(gradients, "FLIGHT", 5)
    code, found = certified(tmp_path / "right")
    assert code == 0 and found["verdict"] == "pass", found
    rows = {row[2]: row[3:] for row in found["tables"][0]["rows"]}
    assert list(rows) == ["conversion", "margin", "tick", "tick, converged solver", "ball's flight"]
    assert all(int(compared) > 0 for compared, *_ in rows.values())
    honest = gradients.reference_step

    def off(action, state, **limit):
        return honest(action + 0.01 * (action - action.detach()), state, **limit)

    class Off(gradients.EngineStep):
        def __call__(self, state, targets, factors=None):
            after = super().__call__(state, targets, factors)
            return after._replace(qvel=after.qvel + 0.01 * (after.qvel - after.qvel.detach()))

    monkeypatch.setattr(gradients, "reference_step", off)
    monkeypatch.setattr(gradients, "EngineStep", Off)
    code, found = certified(tmp_path / "wrong")
    assert code == 1 and found["notes"][0].startswith("football through pd, conversion: an exact slope is 1.")
    assert found["notes"][1].startswith("football through pd, tick: an exact slope is 1.")


def test_a_flight_that_is_off_is_found(monkeypatch):
    """The flight's own slopes agree; those of a flight whose gradient to the velocity is a percent off do not."""
    monkeypatch.setattr(gradients, "FLIGHT", 5)
    ball, cpu = RollingBall(radius=0.11, mass=0.43, friction=0.7, restitution=0.1), torch.device("cpu")
    assert agreement_of(flight_slopes(ball, cpu)).holds
    honest = gradients.ball_flight

    def off(position, velocity, ball, **how):
        return honest(position, velocity + 0.01 * (velocity - velocity.detach()), ball, **how)

    monkeypatch.setattr(gradients, "ball_flight", off)
    assert not agreement_of(flight_slopes(ball, cpu)).holds
