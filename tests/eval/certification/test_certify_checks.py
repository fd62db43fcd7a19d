"""Measurements of the checks of a certification, of bodies, bits and pictures on real worlds."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arena_newton import rule_sets, tasks, trackers
from arena_newton.eval.certification import certify
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import agreement, axes, visible
from arena_newton.eval.certification.checks.swap import retention
from arena_newton.eval.certification.checks.traces import first_difference, play
from arena_newton.eval.certification.context import CertifyCell
from arena_newton.eval.certification.finding import Score, discordant
from arena_newton.eval.certification.stand_ins.bodies import BODIES, GLIDE_HEIGHT, HeldLegs, freeze_legs
from arena_newton.eval.play.factories import Factories
from arena_newton.pages.tables import Table
from arena_newton.pictures.settings import CameraConfig
from arena_newton.robot.canonical import ACTION, STAND_ACTION
from arena_newton.robot.g1 import CANONICAL_JOINTS, DEFAULT_POSE, LEGS, TICK
from arena_newton.rules import seeding
from arena_newton.rules.rule_types import ByRules
from arena_newton.tasks import boxing

SEEDS = [seeding.episode_seed(tasks.get("boxing").gym_id, 0, repeat) for repeat in range(300)]


def test_frozen_legs_keep_the_upper_body():
    """Legs and root are those of the standing action; waist, arms and hands stay the policy's; no row is written."""
    action = torch.rand(3, 40)
    given = action.clone()
    frozen = freeze_legs(None, action).numpy()
    legs = [i for i, name in enumerate(CANONICAL_JOINTS) if any(w in name for w in ("hip", "knee", "ankle"))]
    columns = [*range(9), *(9 + i for i in legs)]
    assert len(legs) == 12
    assert (frozen[:, columns] == STAND_ACTION[columns]).all()
    others = np.setdiff1d(np.arange(40), columns)
    assert (frozen[:, others] == given.numpy()[:, others]).all()
    assert (action == given).all()


def test_held_legs_pass_on_all_but_the_legs():
    """The tracker's waist and arms go through, its legs are the default pose, and a mask reaches it."""

    class Counting(trackers.Tracker):
        asked = ()

        def step(self, command, state, mask=None):
            self.asked = (*self.asked, mask)
            return torch.full((2, 29), 7.0)

    inner = Counting()
    held = HeldLegs(inner)
    held.bind(2)
    mask = torch.tensor([True, False])
    held.step(None, None)
    targets = held.step(None, None, mask)
    assert inner.asked == (None, mask)
    assert (targets[:, list(LEGS)] == torch.tensor([DEFAULT_POSE[i] for i in LEGS])).all()
    assert (targets[:, len(LEGS) :] == 7.0).all()
    assert held.describe()["legs"].startswith("held")


@pytest.fixture(scope="module")
def gliding():
    """Two worlds of boxing whose robots have a gliding base."""
    parts = BODIES["gliding"].equip(Factories())
    return parts.env("boxing", tracker=parts.tracker("twist2", None), worlds=2, engine="mujoco")


def test_a_gliding_base_follows_the_command_and_nothing_else(gliding):
    """Commanded to roll and turn it does, upright and at its height; without a command it stays where it is."""
    env, root = gliding, gliding.scene.robot.root_qpos
    env.reset(SEEDS[:2])
    action = np.tile(STAND_ACTION, (2, 1))
    while env.tick.min() < 0:
        env.step(action)
    before = env.physics.qpos.numpy()[:, root : root + 7].copy()
    ticks = 75
    for tick in range(ticks):
        yaw = 0.5 * TICK * (tick + 1)
        action[0, ACTION["root_xy_delta"]] = (0.3 * TICK, 0.0)
        action[0, ACTION["root_z"]] = 0.5  # it cannot crouch
        action[0, ACTION["root_rot6d"]] = (np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw), 0.0, 0.0)
        env.step(action)
    after = env.physics.qpos.numpy()[:, root : root + 7]
    moved = np.linalg.norm(after[:, :2] - before[:, :2], axis=1)
    # An arc of 0.45 m and 0.75 rad has a chord of 0.44 m.
    assert moved[0] == pytest.approx(0.44, abs=0.04) and moved[1] < 0.01
    heights = after[:, 2]
    assert heights == pytest.approx([GLIDE_HEIGHT] * 2, abs=0.01)
    up = 1.0 - 2.0 * (after[:, 4] ** 2 + after[:, 5] ** 2)
    assert up.min() > np.cos(np.radians(3.0))
    w = np.abs((after[:, 3:] * before[:, 3:]).sum(axis=1))
    turned = 2.0 * np.arccos(np.clip(w, 0.0, 1.0))
    assert turned == pytest.approx([0.75, 0.0], abs=0.08)


def test_a_sill_stops_a_gliding_base():
    """Driven at DoubleDesk's sill the base stays in front of it, upright: it neither steps nor tips over it."""
    parts = BODIES["gliding"].equip(Factories())
    env = parts.env("double_desk", tracker=parts.tracker("twist2", None), worlds=1, engine="mujoco")
    facing_sill = (-2.55, -2.1, GLIDE_HEIGHT), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    env.reset([1], spawn=lambda seed: facing_sill)
    action = STAND_ACTION[None].copy()
    action[0, ACTION["root_xy_delta"]] = (0.4 * TICK, 0.0)
    while env.tick[0] < 150:
        env.step(action)
    x, y, z, qw, qx, qy, qz = env.physics.qpos.numpy()[0, env.scene.robot.root_qpos :][:7]
    assert -1.8 < y < -1.5
    assert 1.0 - 2.0 * (qx**2 + qy**2) > np.cos(np.radians(10.0)) and z == pytest.approx(GLIDE_HEIGHT, abs=0.02)


def test_worlds_that_wait_keep_their_base(gliding):
    """A world outside the mask keeps every bit while the other one glides."""
    env = gliding
    env.reset(SEEDS[:2])
    action = np.tile(STAND_ACTION, (2, 1))
    for _ in range(3):
        env.step(action)
    before = (env.physics.qpos.numpy()[1].copy(), env.physics.qvel.numpy()[1].copy())
    env.step(action, np.array([True, False]))
    assert (env.physics.qpos.numpy()[1] == before[0]).all() and (env.physics.qvel.numpy()[1] == before[1]).all()
    env.step(action)
    root = env.scene.robot.root_qpos
    assert env.physics.qpos.numpy()[1, root : root + 7] == pytest.approx(before[0][root : root + 7], abs=0.01)


def test_traces_tell_another_bit(gliding):
    """The same episode has the same trace in another world and order; another episode differs from its first tick."""
    one = play(gliding, SEEDS[:2], 5)
    other = play(gliding, SEEDS[1::-1], 5)
    assert one == other and len(one) == 2
    first, second = one.values()
    assert first_difference(first, second) == 0 and first_difference(first, first) is None
    assert first_difference(first, [*first[:-1], "0"]) == len(first) - 1
    assert first_difference(first, first[:-1]) == len(first) - 1


def test_targets_are_counted_in_the_picture():
    """A target in the first picture is seen at tick 0 with its pixels; one behind the bag only later, or not at all."""
    env = Factories().env(
        "boxing", tracker=trackers.get("twist2"), worlds=2, engine="mujoco", camera=CameraConfig(), rules="released"
    )
    first, pixels, picture = visible.first_sights(env, [SEEDS[0], SEEDS[1]], "/World/Target")
    assert all((tick == 0) == (count >= visible.SEEN) for tick, count in zip(first, pixels, strict=True))
    assert any(tick == 0 for tick in first)
    tinted = (picture.astype(int)[..., 0] > 120) & (picture.astype(int)[..., 2] > 120) & (picture[..., 1] < 140)
    assert picture.shape == (224, 224, 3) and tinted.sum() >= visible.SEEN
    nothing, pixels, picture = visible.first_sights(env, [SEEDS[0]] * 2, "/World/Nothing")
    assert nothing == [None, None] and pixels == [0, 0] and picture is None


def test_every_task_has_a_target_in_its_scene():
    """Every task names its target, a prim that the task's scene must have."""
    for task in tasks.OWN:
        prim, required = tasks.get(task).target, [r.path for r in tasks.get(task).requires]
        assert any(path == prim or path.startswith(f"{prim}/") for path in required), task


@pytest.mark.parametrize("rules", rule_sets.names())
def test_modes_move_what_the_rules_name(rules):
    """In every task execution mode moves exactly the coordinates with another range; the other modes move none."""
    for task in tasks.OWN:
        own = rule_sets.get(rules).task(task)
        named = {(rule.record, axis) for rule in own.objects for axis in axes.named_coordinates(rule)}
        assert set(axes.moved_coordinates(task, "execution", rules, SEEDS[:50])) == named
        assert not axes.moved_coordinates(task, "visual", rules, SEEDS[:50])


def test_a_mode_that_moves_more_is_found(tmp_path, monkeypatch):
    """An object that another mode shifts, or that execution mode shifts beyond its range, fails the check."""
    honest = tasks.get("boxing")

    def shifted(seed, mode, rules):
        sampled = honest.sample(seed, mode, rules)
        if mode == "semantic":
            sampled["boxing_target"]["x"] += 0.01
        if mode == "execution":
            sampled["boxing_target"]["z"] += 0.5
        return sampled

    given = tasks.get
    false = dataclasses.replace(honest, sample=shifted)
    lookup = SimpleNamespace(get=lambda name: false if name == "boxing" else given(name))
    monkeypatch.setattr(axes, "tasks", lookup)
    monkeypatch.setattr(axes, "_reset_faults", lambda context, task: [])
    options = CertifyOptions(out=str(tmp_path), task=("boxing",), checks=("execution",), quick=True)
    assert certify.run(options) == 1
    text = (tmp_path / "certify_1.md").read_text()
    assert "boxing under paper: mode semantic moves boxing\\_target" in text.replace("boxing_target", "boxing\\_target")
    assert "z is drawn from 1." in text


def test_dynamics_that_change_more_are_found(tmp_path, damped):
    """The mode passes its check; one that also damps the joints fails it, by the field and by the bits of base mode."""
    options = CertifyOptions(out=str(tmp_path / "honest"), task=("boxing",), checks=("dynamics",), quick=True)
    assert certify.run(options) == 0
    damped()
    assert certify.run(dataclasses.replace(options, out=str(tmp_path / "damped"))) == 1
    text = "".join(page.read_text() for page in (tmp_path / "damped").glob("certify*.md")).replace("\\_", "_")
    assert "boxing: dof_damping is not as drawn" in text and "usual values differ from base mode from tick" in text


def test_numbers_of_the_protocol():
    """Semantic mode may cost 3 of 60; the swap's Ret is the quotient of the rates."""
    assert [axes.allowed_difference(n) for n in (4, 20, 40, 60)] == [1, 1, 2, 3]
    assert retention(Score(40, 60), Score(10, 60)) == "25 %" and retention(Score(0, 60), Score(0, 60)) == "-"


def test_replays_are_paired_with_their_recordings():
    """A replay meets the episode that was recorded: what counts is the episodes that ended otherwise, in any order."""
    recorded = [SimpleNamespace(episode_seed=seed, outcome=outcome) for seed, outcome in enumerate(("success",) * 5)]
    ends = ("success", "fall", "success", "fall", "success")
    replayed = [SimpleNamespace(episode_seed=seed, outcome=outcome) for seed, outcome in enumerate(ends)]
    assert discordant(recorded, replayed[::-1]) == (2, 0) and discordant(replayed, recorded) == (0, 2)
    assert discordant(recorded, replayed, "fall") == (0, 2)


class Played:
    """A context whose episodes ended before: outcomes by engine, or by whether the weights are the official ones."""

    def __init__(self, **outcomes):
        self.outcomes, self.tasks, self.trackers = outcomes, ("boxing",), ("twist2",)
        given = {"device": None, "checks": ("engines",), "twist2_checkpoint": "official", "quick": False, "jobs": 1}
        self.options = SimpleNamespace(engine="mujoco", **given)

    def evaluate(self, cell):
        which = "other" if cell.engine == "warp" or cell.checkpoint == "official" else "own"
        ends = [{"s": "success", "f": "fall", "t": "timeout"}[letter] for letter in self.outcomes[which]]
        records = [SimpleNamespace(episode_seed=seed, outcome=outcome) for seed, outcome in enumerate(ends)]
        return records[::-1] if which == "other" else records


def test_engines_and_weights_are_compared_episode_by_episode(monkeypatch):
    """Equal rates of other episodes are no difference, and eleven episodes that one alone solves are one."""
    monkeypatch.setattr(agreement, "recorded", lambda context, task, tracker: CertifyCell(task, tracker))
    monkeypatch.setattr(agreement, "_same_start", lambda *given: ("both alike", Table((), ()), []))
    exact = 2 * 0.5**11
    found = agreement.official(Played(own="s" * 12, other="s" + "t" * 11))
    assert (found.verdict, found.sheets[0].rows[0][-1]) == (
        "note",
        f"{exact:.2g}",
    ) and f"p = {exact:.2g}" in found.summary
    assert any("McNemar" in note for note in found.notes) and any(
        "tuned on our weights" in note for note in found.notes
    )
    assert agreement.official(Played(own="s" + "t" * 11, other="s" * 12)).verdict == "fail"
    even = agreement.official(Played(own="s" * 6 + "t" * 6, other="t" * 6 + "s" * 6))
    assert even.verdict == "pass" and "p = 1" in even.summary and len(even.notes) == 1
    engines = agreement.engines(Played(own="s" * 12, other="s" + "f" * 11))
    assert engines.verdict == "fail" and [engines.sheets[1].rows[0][i] for i in (-3, -1)] == ["0.001", "0.001"]
    assert "on cpu" in engines.sheets[1].head[4] and "McNemar" in engines.notes[0]
    few = agreement.engines(Played(own="sstf", other="sttf"))
    assert few.verdict == "note" and "4 pairs are too few" in few.notes[-1]
    assert agreement.engines(Played(own="s" * 80, other="s" * 80)).verdict == "pass"
    assert agreement.engines(Played(own="s" * 80, other="s" * 70 + "t" * 10)).verdict == "fail"


def test_a_rate_at_the_ceiling_is_a_bound():
    """If no pair ends otherwise the bound is the exact one of none in n; if all do, nothing is bounded."""
    low, high = agreement.bound_of_difference(0, 0, 280)
    assert high == pytest.approx(1.0 - 0.025 ** (1 / 280)) and low == -high and high < 0.0132
    assert agreement.bound_of_difference(5, 0, 5)[1] == 1.0
    assert agreement.bound_of_difference(0, 3, 100)[0] == pytest.approx(-0.0852, abs=1e-4)


def test_engines_that_step_other_models_differ_at_once(tmp_path, monkeypatch):
    """An array that differs and a tick beyond the bar are named; without CUDA the check still says so."""
    found = {"unlike": ["body_mass"], "gaps": [1e-7, 2e-5, 1e-4, 1e-3, 1e-2]}
    monkeypatch.setattr(agreement, "first_ticks", lambda *given: found)
    monkeypatch.setattr(agreement, "resolve_engine", lambda *given: ("warp", "cpu"))
    options = SimpleNamespace(engine="mujoco", device=None, checks=(), quick=False, jobs=1)
    measured = lambda name, task, tracker, settings, measure: measure()  # noqa: E731
    context = SimpleNamespace(options=options, tasks=("boxing",), trackers=("twist2",), measured=measured)
    said = agreement.engines(context)
    assert said.verdict == "fail" and said.notes[:2] == (
        "boxing: the compiled models differ in body_mass",
        "boxing: positions differ by 2.0e-05 at tick 2",
    )


def test_a_tiny_real_certification(tmp_path, kept_worlds, monkeypatch):
    """One task and tracker, one episode: the expert solves it, a gliding base does not, and strips are on the page."""
    monkeypatch.setattr(boxing, "TASK", dataclasses.replace(boxing.TASK, steps=ByRules(paper=400, released=400)))
    flags = {"task": ("boxing",), "tracker": ("twist2",), "episodes": 1, "quick": True, "worlds": 1}
    options = CertifyOptions(out=str(tmp_path), checks=("gliding-base",), **flags)
    assert certify.run(options, Factories(env=kept_worlds)) == 0
    page = (tmp_path / "certify.html").read_text()
    assert "success at step" in page and "data:image/jpeg;base64," in page
    assert (tmp_path / "runs" / "boxing" / "twist2_paper_base_gliding" / "episodes.jsonl").is_file()


def test_touches_of_the_sill_are_counted_per_episode():
    """Every tick with a force counts for the episode that its world runs, ticks of worlds at rest for none."""
    from arena_newton.eval.certification.checks.sill import Treads

    force = np.zeros(2)
    model = SimpleNamespace(geom_bodyid=np.array([0, 1, 2]))
    watched = []
    physics = SimpleNamespace(
        pair_force=SimpleNamespace(numpy=lambda: force), watch_pair=lambda a, b: watched.append((a, b))
    )
    scene = SimpleNamespace(mj_model=model, robot=SimpleNamespace(bodies=(1, 2)), geom_ids=lambda prim: [0])
    env = SimpleNamespace(physics=physics, scene=scene, active=np.array([True, True]))
    treads = Treads()
    for world, seed in enumerate((11, 12)):
        treads.start(env, world, SimpleNamespace(episode_seed=seed))
    for pair in ((0.0, 3.0), (0.0, 40.0), (5.0, 0.0)):
        force[:] = pair
        treads.tick(env)
    env.active[0], force[:] = False, 9.0
    treads.tick(env)
    assert treads.ticks == {11: 1, 12: 3} and treads.highest == {11: 5.0, 12: 40.0}
    assert watched[0] == ([1, 2], [0])
