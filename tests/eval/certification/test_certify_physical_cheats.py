"""Cheats in physics, camera and rules that `eval certify --quick` must find, by the name of the check that fails.

`CHEATS` has a row a cheat: the check that finds it, its task, and its patch. Without a patch the same checks pass.
"""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from arena_newton.eval.certification import certify
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import closed_forms
from arena_newton.kernels.rules import success
from arena_newton.physics import batch, scene
from arena_newton.pictures.camera import Camera
from arena_newton.tasks import sit_sofa

FORMS = ("fall", "weight", "masses", "soles", "bounces", "drives")
"""Closed forms of the check `physics`."""


def certified(folder, check, task):
    """Exit code of a check of one task through TWIST2; engines that are not named compare their first ticks alone."""
    options = CertifyOptions(out=str(folder), task=(task,), tracker=("twist2",), episodes=1, quick=True)
    return certify.run(options, checks=[one for one in certify.CHECKS if one.name == check])


PLAN = closed_forms._plan


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_both_engines_are_measured(engine, quick):
    """Closed forms are measured in every task on the episodes' engine, and at least in the first on the other one."""
    given = SimpleNamespace(options=SimpleNamespace(quick=quick), tasks=("football", "boxing"), trackers=("twist2",))
    found = [(row[0], row[2]) for row in PLAN(given, (engine, "cpu")) if row[4]]
    assert {(engine, "football"), (engine, "boxing")} < set(found)
    assert ({"mujoco": "warp", "warp": "mujoco"}[engine], "football") in found


@pytest.fixture(autouse=True)
def one_engine(monkeypatch):
    """Closed forms on few worlds of engine mujoco alone: Warp's CPU backend takes half a minute."""
    monkeypatch.setattr(closed_forms, "_plan", lambda *given: [one for one in PLAN(*given) if one[0] == "mujoco"])
    monkeypatch.setattr(closed_forms, "WORLDS", 4)


@pytest.fixture(autouse=True)
def near_the_sofa(monkeypatch):
    """Robots of SitSofa begin near it, which takes a third less ticks."""
    monkeypatch.setattr(sit_sofa, "TASK", dataclasses.replace(sit_sofa.TASK, spawn_position=(-1.2, -0.3, 0.8)))


def compiled(monkeypatch, change):
    """Change the models that episodes step, each as it is made."""
    made = batch._at_rate

    def cheat(*given):
        model = made(*given)
        change(model)
        return model

    monkeypatch.setattr(batch, "_at_rate", cheat)


def gravity_less_3_percent(monkeypatch):
    """9.516 m/s²."""
    compiled(monkeypatch, lambda model: model.opt.gravity.__imul__(0.97))


def friction_less_10_percent(monkeypatch):
    """Friction of every contact."""
    compiled(monkeypatch, lambda model: model.geom_friction.__imul__(0.9))


def heavier_link(monkeypatch):
    """The left knee has 5 % more mass than Unitree says."""

    def cheat(model):
        model.body_mass[next(b for b in range(model.nbody) if "left_knee" in model.body(b).name)] *= 1.05

    compiled(monkeypatch, cheat)


def weaker_drives(monkeypatch):
    """Stiffness and damping are 5 % lower."""
    drives = scene._set_drives

    def cheat(builder, drive):
        lower = {name: tuple(0.95 * value for value in getattr(drive, name)) for name in ("kp", "kd")}
        drives(builder, dataclasses.replace(drive, **lower))

    monkeypatch.setattr(scene, "_set_drives", cheat)


def livelier_ball(monkeypatch):
    """Its coefficient of restitution is higher by 0.05."""
    given = batch.set_restitution
    monkeypatch.setattr(batch, "set_restitution", lambda scene, e, dt, *models: given(scene, e + 0.05, dt, *models))


def wider_camera(monkeypatch):
    """The picture is 3 % wider at the same distance."""
    began = Camera.__init__

    def cheat(self, *given, horizontal_aperture, **named):
        began(self, *given, horizontal_aperture=1.03 * horizontal_aperture, **named)

    monkeypatch.setattr(Camera, "__init__", cheat)


def rule_that_confirms_a_tick_early(monkeypatch):
    """SitSofa succeeds after 24 ticks instead of 25."""
    launch = success.launch_sit_sofa_paper
    monkeypatch.setattr(
        success,
        "launch_sit_sofa_paper",
        lambda *given, confirm_ticks, **named: launch(*given, confirm_ticks=confirm_ticks - 1, **named),
    )


CHEATS = [
    ("physics", "football", gravity_less_3_percent, "fall"),
    ("engines", "football", gravity_less_3_percent, ""),
    ("physics", "football", friction_less_10_percent, "soles"),
    ("physics", "football", heavier_link, "masses"),
    ("physics", "football", weaker_drives, "drives"),
    ("physics", "football", livelier_ball, "bounces"),
    ("camera", "football", wider_camera, ""),
    ("rules", "sit_sofa", rule_that_confirms_a_tick_early, ""),
]
"""The check that finds a cheat, a task, its patch, and the closed form that is measured."""


def test_the_page_lists_every_cheat():
    """docs/reference/certify.md has a row for each cheat, with the checks that find it."""
    page = (Path(__file__).parents[3] / "docs" / "reference" / "certify.md").read_text()
    table = page.split("`tests/eval/certification/test_certify_physical_cheats.py`")[1].split("\n\n")[1]
    rows = [re.findall(r"`([a-z]+)`", line) for line in table.splitlines()[2:]]
    found = {}
    for check, _, cheat, _ in CHEATS:
        found.setdefault(cheat, []).append(check)
    assert sorted(rows) == sorted(found.values())


@pytest.mark.parametrize(("check", "task"), sorted({row[:2] for row in CHEATS}))
def test_the_honest_pass(tmp_path, check, task):
    """Without a patch every check that finds a cheat passes."""
    assert certified(tmp_path, check, task) == 0


@pytest.mark.parametrize(("check", "task", "cheat", "form"), CHEATS, ids=lambda given: getattr(given, "__name__", None))
def test_a_cheat_is_found_by_name(tmp_path, monkeypatch, capsys, check, task, cheat, form):
    """`certify --quick` fails, and its line names the check."""
    cheat(monkeypatch)
    for name in FORMS:
        if name != form:
            monkeypatch.setattr(closed_forms, name, lambda bench, **_: ())
    assert certified(tmp_path, check, task) == 1
    assert re.search(rf"^fail  {check} ", capsys.readouterr().out, re.MULTILINE)
