"""The push suite: blows that come as drawn, what is made of them, and cells that are played once."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from arena_newton.errors import InputError
from arena_newton.robot import g1
from arena_newton.robot.g1 import TICK
from arena_newton.trackers.evaluate import main
from arena_newton.trackers.evaluation import parts, push_suite
from arena_newton.trackers.evaluation.cells import suite
from arena_newton.trackers.evaluation.lab import Lab, Start, WorldKind
from arena_newton.trackers.evaluation.suite import Blows
from arena_newton.trackers.evaluation.suite_rollout import Outcome, _Blows, begins, make_plan
from arena_newton.trackers.motions import primitives

RATE = g1.PhysicsRate(dt=0.005, substeps=4)
CALM, HARD = (next(c for c in suite("push") if c.name == name) for name in (push_suite.CALM, "tour, 600 N"))


def test_a_tour_has_a_blow_in_each_segment():
    """A minute in twelve segments; blows begin within the first two seconds of each, the same ones at every force."""
    assert push_suite.tour().seconds == pytest.approx(60.0)
    plan = make_plan(suite("push"), 4, 0)
    at = begins(plan) * TICK - 5.0 * np.arange(12)
    assert at.shape == (4 * len(plan.cells), 12) and at.min() >= 0.1 and at.max() <= 2.0 and at.std() > 0.3
    assert [cell.blows.newtons for cell in plan.cells] == [0.0, 50.0, 150.0, 300.0, 450.0, 600.0, 600.0, 0.0]
    assert not np.array_equal(begins(make_plan(suite("push"), 4, 1)), begins(plan)), "another seed draws others"


def test_draws_of_the_other_suites_are_as_they_were():
    """Numbers that blows need come behind the others of a cell."""
    cell = suite("quick")[0]
    plain, struck = (make_plan([one], 3, 7).noise for one in (cell, replace(cell, blows=Blows(1.0, 12))))
    assert plain.pop("blows").size == 0 and struck.pop("blows").shape == (3, 12, 5)
    assert all(np.array_equal(plain[name], struck[name]) for name in plain)


def test_blows_strike_as_drawn():
    """In free fall a blow of 600 N adds 48 N·s in 0.08 s, on one drawn link; a world of 0 N is not touched."""
    plan = make_plan([replace(cell, blows=replace(cell.blows, segments=1)) for cell in (CALM, HARD)], 2, 0)
    lab = Lab(
        [WorldKind()] * 4, np.zeros(4, bool), drive=g1.TWIST2_DRIVE, rate=RATE, engine="mujoco", device="cpu", threads=1
    )
    root, joints = np.tile([0.0, 0.0, 50.0, 1.0, 0.0, 0.0, 0.0], (4, 1)), np.tile(g1.DEFAULT_POSE, (4, 1))
    lab.start(Start(root, joints, {}, np.full((4, 3), np.nan)))
    blows = _Blows(plan, lab)
    struck, touched, ticks = np.zeros(4), [set() for _ in range(4)], int(begins(plan).max()) + 5
    total = torch.zeros(4, 3)
    for tick in range(ticks):
        lab.forces.zero_()
        blows.add(tick, lab.forces)
        sizes = lab.forces.norm(dim=2)
        struck += (sizes.max(1).values > 0).numpy()
        total += lab.forces.sum(1) * TICK
        for world, body in sizes.nonzero().tolist():
            touched[world].add(body)
        lab.physics.step()
    assert struck.tolist() == [0, 0, 4, 4] and [len(bodies) for bodies in touched] == [0, 0, 1, 1]
    assert total.norm(dim=1).tolist() == pytest.approx([0.0, 0.0, 48.0, 48.0], rel=1e-5)
    robot = [body for path, body in lab.scene.body_ids.items() if "/Robot/" in path]
    mass = torch.as_tensor(lab.scene.mj_model.body_mass[robot], dtype=torch.float32)
    before = lab.xpos[:, robot].clone()
    lab.physics.step()
    momentum = ((lab.xpos[:, robot] - before) * mass[:, None]).sum(1) / TICK  # of the links' frames, near their centres
    change = momentum[2:] - momentum[:1]
    assert torch.nn.functional.cosine_similarity(change, total[2:]).min() > 0.9
    assert change.norm(dim=1).tolist() == pytest.approx([48.0, 48.0], rel=0.2)


def test_recovery_is_the_way_back_to_the_same_tick_without_blows():
    """A robot that is off for 0.6 s after one blow, and falls after the next, recovered once in 0.6 s."""
    cells = [replace(cell, seconds=10.0, blows=replace(cell.blows, segments=2)) for cell in (CALM, HARD)]
    plan = make_plan(cells, 1, 0)
    begin = begins(plan)[1].astype(int)
    errors = np.tile(np.linspace(0.01, 0.02, 500)[:, None, None], (1, 2, 2))
    errors[begin[0] + 4 : begin[0] + 34, 1, 1] += 0.3
    errors[begin[1] + 40 :, 1] = np.nan
    measures = {"fell": np.array([False, True]), "fall_time": np.array([np.nan, (begin[1] + 40) * TICK])}
    errors[begin[1] + 4 :, 1, 0] += 0.2
    outcome = Outcome(measures, 0, 1, "mujoco", "cpu", RATE, 0.0, 0.0, errors)
    push_suite.add_blow_measures(outcome, plan)
    m = outcome.measures
    assert m["blows"].tolist() == [2, 2] and m["blows_survived"].tolist() == [2, 1]
    assert m["survival"] == pytest.approx([10.0, (begin[1] + 40) * TICK])
    assert m["recovery"] == pytest.approx([0.0, 0.6]) and m["recovered"] == pytest.approx([1.0, 0.5])
    alone = Outcome({k: v[1:] for k, v in measures.items()}, 0, 1, "mujoco", "cpu", RATE, 0.0, 0.0, errors[:, 1:])
    push_suite.add_blow_measures(alone, make_plan(cells[1:], 1, 0))
    assert np.isnan(alone.measures["recovery"]).all(), "without the cell to compare with nothing is said"


def test_finished_cells_are_not_played_again(tmp_path, capsys, monkeypatch):
    """A second call reads what the first one finished, prints the same table, and another seed is played."""
    short = [
        replace(cell, seconds=1.0, script=primitives.stand(1.0), blows=Blows(cell.blows.newtons, 1, 1.0, (0.1, 0.3)))
        for cell in (CALM, HARD)
    ]
    monkeypatch.setattr("arena_newton.trackers.evaluation.cells.suite", lambda name: short)
    arguments = "--tracker pd --suite push --rollouts 2 --engine mujoco --device cpu --threads 1 --no-bench".split()
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    first = capsys.readouterr()
    assert "pd, tour, no blow: 2 rollouts of 1 s ..." in first.err
    assert "60 s on both feet: tour, 600 N" in first.out and "survival [s]" in (tmp_path / "evaluation.md").read_text()
    document = json.loads((tmp_path / "evaluation.json").read_text())
    assert [cell["blows"] for cell in document["trackers"][0]["cells"]] == [1.0, 1.0]
    stored = sorted((tmp_path / parts.FOLDER).iterdir())
    stored[0].unlink()
    kept, played = parts.play, []
    monkeypatch.setattr(parts, "play", lambda *a, **k: played.append(a[1].cells[0].name) or kept(*a, **k))
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    again = capsys.readouterr()
    assert len(played) == 1 and again.out == first.out and again.err.count("kept from before") == 1
    assert main([*arguments, "--seed", "1", "--out", str(tmp_path)]) == 0
    assert len(played) == 3
    stored[0].write_bytes(b"torn")
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    assert f"{stored[0]}: not a readable NPZ file" in capsys.readouterr().err
    with pytest.raises(InputError, match="no such file"):
        parts._read(tmp_path / "absent.npz", "mujoco", "cpu", RATE)
    np.savez(tmp_path / "torn.npz", ticks=np.array(3))
    with pytest.raises(InputError, match=r"torn\.npz: a kept cell without 'overflows'"):
        parts._read(tmp_path / "torn.npz", "mujoco", "cpu", RATE)
