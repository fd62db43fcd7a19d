"""The evaluation of trackers: its worlds, its measures, its suite and its tables."""

import csv
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from arena_newton.cli.intervals import wilson
from arena_newton.errors import InputError
from arena_newton.robot import g1
from arena_newton.robot.g1 import FEET
from arena_newton.trackers.evaluate import main
from arena_newton.trackers.evaluation import chart, tracker_film
from arena_newton.trackers.evaluation.cells import QUICK, goals, suite
from arena_newton.trackers.evaluation.figures import Result, figures
from arena_newton.trackers.evaluation.lab import Lab, Start, WorldKind, variant
from arena_newton.trackers.evaluation.meter import LINKS, Meter, TickReference
from arena_newton.trackers.evaluation.suite import Cell, Navigation
from arena_newton.trackers.evaluation.suite_rollout import Outcome, find_sill, make_plan, play
from arena_newton.trackers.motions import primitives
from arena_newton.trackers.train.curves import PANELS, draw

RATE = g1.PhysicsRate(dt=0.005, substeps=4)
PRIMITIVES = (
    "stand",
    "shift",
    "step",
    "walk",
    "squat",
    "reach",
    "crouch_reach",
    "kick",
    "punch",
    "sit",
    "carry",
    "push",
)


def test_every_primitive_has_three_settings():
    """The full suite holds three cells or more of every primitive, 20 goals, and no name twice."""
    cells = suite("full")
    names = [cell.name for cell in cells]
    assert len(set(names)) == len(names)
    assert set(QUICK) <= set(names)
    for group in PRIMITIVES:
        assert sum(cell.group == group for cell in cells) >= 3, group
    assert sum(cell.goal is not None for cell in cells) == 20
    assert {cell.payload for cell in cells} >= {1.0, 2.0}
    assert {cell.friction for cell in cells} >= {0.4, 1.2}


def test_goals_depend_on_the_seed_alone():
    """The same seed draws the same goals within 3 m, another seed others."""
    drawn = [(c.goal.x, c.goal.y, c.goal.yaw) for c in goals(20, seed=3)]
    assert drawn == [(c.goal.x, c.goal.y, c.goal.yaw) for c in goals(20, seed=3)]
    assert drawn != [(c.goal.x, c.goal.y, c.goal.yaw) for c in goals(20, seed=4)]
    assert np.abs(np.array(drawn)[:, :2]).max() <= 3.0


def test_draws_of_a_cell_do_not_depend_on_the_others():
    """A cell alone gets the draws that it gets within the suite."""
    cells = suite("quick")
    whole, alone = make_plan(cells, 3, 7), make_plan([cells[2]], 3, 7)
    for name, values in alone.noise.items():
        assert np.array_equal(values, whole.noise[name][whole.cell == 2])
    assert not np.array_equal(alone.noise["joints"], make_plan([cells[2]], 3, 8).noise["joints"])


def test_wilson_is_the_interval_of_the_benchmark():
    """Rates get the interval that the benchmark's own tables use."""
    from arena_newton.eval.statistics import stats

    for successes, trials in ((0, 64), (1, 64), (40, 64), (64, 64)):
        assert wilson(successes, trials) == pytest.approx(stats.wilson(successes, trials))


def test_a_sill_stands_where_the_feet_clear_it():
    """The sill goes under the swing, and a foot that stands on its place counts as no clearance."""
    x = np.linspace(0.0, 2.0, 201)
    feet = np.zeros((201, 2, 3))
    feet[..., 0] = x[:, None]
    feet[..., 2] = 0.035
    feet[(x > 0.6) & (x < 1.1), :, 2] = 0.20
    place, clearance = find_sill(feet)
    assert 0.6 + 0.17 <= place <= 1.1 - 0.10 + 0.01
    assert clearance == pytest.approx(0.165)
    feet[(x > 0.6) & (x < 1.1), 1, 2] = 0.035
    assert find_sill(feet)[1] == pytest.approx(0.0)


class _FakeLab:
    """Two worlds whose robot is moved by hand."""

    worlds, root_q, root_v, ball_v = 2, 0, 0, 35
    device = torch.device("cpu")

    def __init__(self):
        self.scene = SimpleNamespace(link=LINKS.index, drive=g1.TWIST2_DRIVE)
        self.feet = [LINKS.index(name) for name in FEET]
        self.qpos, self.qvel = torch.zeros(2, 36), torch.zeros(2, 41)
        self.qpos[:, 2], self.qpos[:, 3] = 0.75, 1.0
        self.xpos = torch.zeros(2, len(LINKS), 3)
        self.xpos[..., 2] = 0.75
        self.xpos[:, self.feet, 2] = 0.035
        self.pair_force = torch.zeros(2)
        self.joint_q, self.joint_v = torch.arange(7, 36), torch.arange(6, 35)

    def move(self, x: float) -> None:
        self.qpos[:, 0] = x
        feet = self.xpos[:, self.feet, 0].clone()
        self.xpos[..., 0] = x
        self.xpos[:, self.feet, 0] = feet


def _reference(x: float) -> TickReference:
    quat = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1)
    return TickReference(torch.tensor([[x, 0.0, 0.75]] * 2), quat, torch.zeros(2, 29), torch.zeros(2, len(LINKS), 3))


def test_measures_are_what_they_say():
    """A robot 0.1 rad off in the legs, slower by 0.1 m/s, with a sliding foot, is measured as that."""
    lab = _FakeLab()
    meter = Meter(lab, np.array([100, 100]), np.array([50, 0]))
    targets = torch.zeros(2, 29)
    meter.anchor(targets, _reference(0.0).position)
    lab.qpos[:, 7:19] = 0.1
    for tick in range(100):
        lab.move(0.5 * 0.02 * (tick + 1))
        lab.xpos[:, lab.feet, 0] += 0.001  # both feet slide 5 cm/s
        lab.pair_force[:] = 150.0 if tick >= 40 else 0.0
        meter.update(tick, _reference(0.6 * 0.02 * (tick + 1)), targets)
    m = meter.results()
    assert not m["fell"].any()
    assert m["leg_rmse"] == pytest.approx([0.1, 0.1], rel=1e-5)
    assert m["arm_rmse"] == pytest.approx([0.0, 0.0])
    assert m["velocity_error"] == pytest.approx([0.1, 0.1], rel=1e-3)
    assert m["speed_x"] == pytest.approx([0.5, 0.5], rel=1e-4) and m["ref_x"] == pytest.approx([0.6, 0.6], rel=1e-4)
    assert m["drift"] == pytest.approx([0.2, 0.2], rel=1e-3) and m["drift_10s"] == pytest.approx([1.0, 1.0], rel=1e-3)
    assert m["foot_slip"] == pytest.approx([0.05, 0.05], rel=1e-3)
    assert m["seat_time"] == pytest.approx([1.08, 1.08], abs=0.08)
    torque = (12 * 0.1 * np.array(g1.TWIST2_DRIVE.kp[:12]) / np.array(g1.TWIST2_DRIVE.effort[:12])).mean() / 29
    assert m["torque"] == pytest.approx([torque, torque], rel=1e-4)


def test_falls_end_a_rollout():
    """Tilt, height and NaN are falls; what comes after a fall does not count."""
    lab = _FakeLab()
    meter = Meter(lab, np.array([10, 10]), np.zeros(2))
    targets = torch.zeros(2, 29)
    meter.anchor(targets, _reference(0.0).position)
    meter.update(0, _reference(0.0), targets)
    lab.qpos[0, 2] = 0.39
    lab.qpos[:, 7:36] = 1.0
    live = meter.update(1, _reference(0.0), targets)
    assert live.tolist() == [False, True]
    lab.qpos[1, 2] = float("nan")
    assert meter.update(2, _reference(0.0), targets).tolist() == [False, False]
    m = meter.results()
    assert m["fell"].all() and m["fall_time"] == pytest.approx([0.02, 0.04])
    assert m["joint_rmse"] == pytest.approx([0.0, np.sqrt(0.5)])


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_worlds_of_a_batch_differ_as_asked(engine):
    """Payload, friction and chest force act in their own world only, by the amount that is asked."""
    kinds = [WorldKind(), WorldKind(friction=0.05, payload=2.0)]
    lab = Lab(kinds, np.zeros(2, bool), drive=g1.TWIST2_DRIVE, rate=RATE, engine=engine, device="cpu", threads=1)
    root = np.tile([0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0], (2, 1))
    joints = np.tile(g1.DEFAULT_POSE, (2, 1))
    away = {"Seat": np.array([[np.nan] * 4, [1.0, 0.0, 0.42, 0.0]])}
    lab.start(Start(root, joints, away, np.full((2, 3), np.nan)))
    lab.force[0, 0], lab.force[1, 0] = 100.0, 100.0
    masses = [float(lab.scene.mj_model.body_subtreemass[lab.scene.link("pelvis")]) + extra for extra in (0.0, 4.0)]
    _run_standing(lab, ticks=5)
    momentum = [mass * float(v) for mass, v in zip(masses, _mean_velocity(lab), strict=True)]
    # 100 N for 0.1 s, in free fall.
    assert momentum == pytest.approx([10.0, 10.0], rel=0.03)
    lab.start(Start(root * [1, 1, 0.8 / 3.0, 1, 1, 1, 1], joints, {}, np.full((2, 3), np.nan)))
    assert not lab.force.any(), "a reset clears forces"
    lab.physics.add_velocity(np.tile([1.5, 0.0, 0.0, 0.0, 0.0, 0.0], (2, 1)))
    _run_standing(lab, ticks=8)
    foot = lab.xpos[:, lab.scene.link("left_ankle_roll_link"), 0]
    assert float(foot[1]) > float(foot[0]) + 0.005  # less friction slides farther
    assert lab.overflows() == 0


def _run_standing(lab: Lab, ticks: int) -> None:
    """Let the drives hold the default pose."""
    ctrl = lab.physics.ctrl.numpy()
    ctrl[:, lab.scene.robot.joint_ctrl] = g1.DEFAULT_POSE
    lab.physics.ctrl.assign(ctrl)
    for _ in range(ticks):
        lab.physics.step()


def _exact_follower(name: str):
    """The lab and a cell's reference as positions and velocities of every tick, [ticks, nq] and [ticks, nv]."""
    import mujoco

    from arena_newton import rule_sets
    from arena_newton.physics.scene import load_scene
    from arena_newton.trackers.motions.frames import actions_to_motion

    cell = next(c for c in suite("full") if c.name == name)
    tables = make_plan([cell], 1, 0).tables(torch.device("cpu"))
    motion = actions_to_motion(tables.actions.transpose(0, 1))
    scene = load_scene(
        "lab",
        hands="fixed",
        variant="ball",
        rules=rule_sets.get("paper"),
        drive=g1.TWIST2_DRIVE,
        native=True,
        device="cpu",
    )
    m, robot = scene.mj_model, scene.robot
    q, v = np.tile(m.qpos0, (cell.ticks, 1)), np.zeros((cell.ticks, m.nv))
    q[:, robot.root_qpos : robot.root_qpos + 3] = motion.root_pos[0]
    q[:, robot.root_qpos + 3 : robot.root_qpos + 7] = motion.root_quat[0]
    q[:, robot.joint_qpos] = motion.joint_pos[0]
    for k in range(cell.ticks - 1):
        mujoco.mj_differentiatePos(m, v[k], g1.TICK, q[k], q[k + 1])
    return cell, tables, scene, q, v


def test_who_follows_the_kick_exactly_hits_the_ball():
    """Moved as the reference says, the foot gives the ball 1.5 m/s and more wherever a draw may put it."""
    import mujoco

    from arena_newton.trackers.motions.kinematics import neutral_stance

    cell, _, scene, q, v = _exact_follower("ball, standing kick")
    m = scene.mj_model
    ball_q, ball_v = scene.joint_qpos("/World/Ball"), scene.joint_qvel("/World/Ball")
    rest_q = np.setdiff1d(np.arange(m.nq), np.arange(ball_q, ball_q + 7))
    rest_v = np.setdiff1d(np.arange(m.nv), np.arange(ball_v, ball_v + 6))
    moving = np.flatnonzero(np.abs(v).max(axis=1) > 1.0)
    substeps = round(g1.TICK / m.opt.timestep)
    # Half a start error of the place on top of the draws.
    for distance in (cell.ball.distance[0] - 0.005, cell.ball.distance[1] + 0.005):
        for aside in (-0.015, 0.015):
            d = mujoco.MjData(m)
            d.qpos[:] = m.qpos0
            d.qpos[ball_q : ball_q + 3] = neutral_stance().ankle + distance, cell.ball.lateral + aside, 0.11
            peak, between = 0.0, np.empty(m.nq)
            for k in range(moving[0], moving[-1] + 1):
                for step in range(substeps):
                    between[:] = q[k]
                    mujoco.mj_integratePos(m, between, v[k], step * m.opt.timestep)
                    d.qpos[rest_q], d.qvel[rest_v] = between[rest_q], v[k][rest_v]
                    mujoco.mj_step(m, d)
                peak = max(peak, float(np.linalg.norm(d.qvel[ball_v : ball_v + 2])))
            assert peak >= 1.5, (distance, aside)


def test_who_steps_over_a_sill_exactly_does_not_touch_it():
    """Moved as the reference says, no part of the robot touches the highest sill of the suite."""
    import mujoco

    cell, tables, scene, q, _ = _exact_follower("sill 0.09")
    m = scene.mj_model
    x, clearance = find_sill(tables.feet[:, 0].numpy())
    assert clearance >= cell.support.height + 0.05
    sill = set(scene.geom_ids("/World/Sill"))

    def touches(height: float) -> bool:
        d = mujoco.MjData(m)
        d.mocap_pos[scene.mocap_id("/World/Sill")] = x, 0.0, height
        for row in q:
            d.qpos[:] = row
            mujoco.mj_kinematics(m, d)
            mujoco.mj_comPos(m, d)
            mujoco.mj_collision(m, d)
            if any(sill & {int(c.geom1), int(c.geom2)} and c.dist < 0.0 for c in d.contact[: d.ncon]):
                return True
        return False

    assert not touches(cell.support.height)
    assert touches(clearance + 0.03)


def _mean_velocity(lab: Lab) -> list[float]:
    """Forward velocity of the robots' centres of mass [m/s]."""
    import mujoco

    robot = lab.scene.link("pelvis")
    out = []
    for w, extra in enumerate((0.0, 2.0)):
        model = variant(lab.scene, WorldKind(payload=extra))
        d = mujoco.MjData(model)
        d.qpos[:], d.qvel[:] = lab.qpos[w].numpy(), lab.qvel[w].numpy()
        mujoco.mj_forward(model, d)
        mujoco.mj_subtreeVel(model, d)
        out.append(float(d.subtree_linvel[robot, 0]))
    return out


def test_a_tracker_that_cannot_balance_falls_when_pushed():
    """Under bare joint drives the robot stands, falls from a 40 N·s push, and no cell disturbs another."""
    from arena_newton.trackers.base import get

    push = next(cell for cell in suite("full") if cell.name == "push 40 N·s, stand")
    cells = [Cell("short stand", "stand", 1.0, primitives.stand(1.0)), push]
    played = make_plan(cells, 2, 0)
    outcome = play(get("pd"), played, engine="mujoco", threads=1)
    fell = outcome.measures["fell"]
    assert fell.tolist() == [False, False, True, True]
    assert np.all(outcome.measures["fall_time"][2:] > 3.0)
    assert np.all(outcome.measures["drift"][:2] < 0.1)


def test_official_twist2_walks_the_reference(shared):
    """The official checkpoint reaches 90 % of 0.3 m/s on the generator's walk and goes to a goal."""
    from arena_newton.trackers.base import get

    goal = Cell("near goal", "goal", 9.0, goal=Navigation(0.6, 0.2, 0.4), rollouts=1)
    cells = [Cell("short walk", "walk", 4.0, primitives.walk(0.3, seconds=4.0)), goal]
    tracker = get("twist2", shared / "reference/twist2/twist2_1017_20k.onnx")
    outcome = play(tracker, make_plan(cells, 2, 0), engine="mujoco", fast_physics=True, threads=1)
    m = outcome.measures
    assert not m["fell"].any()
    assert np.mean(m["speed_x"][:2] / m["ref_x"][:2]) >= 0.9
    assert m["goal_distance"][2] <= 0.08 and m["goal_turn"][2] <= 5.0
    assert np.isnan(m["drift"][2]) and np.isfinite(m["drift"][:2]).all()


def _result(label: str, interface: str, official: bool, falls: int, cells: list[Cell] | None = None) -> Result:
    played = make_plan(suite("full") if cells is None else cells, 2, 0)
    worlds = len(played.cell)
    names = "leg_rmse drift_10s lowest speed_x ref_x goal_distance goal_turn seat_time end_z end_x support_x touch"
    measures = {name: np.full(worlds, 0.05) for name in [*names.split(), "ball_peak", "ball_end"]}
    measures["fell"] = np.arange(worlds) < falls
    return Result(label, interface, official, {}, played, Outcome(measures, 0, 1, "mujoco", "cpu", RATE, 0.0, 0.0))


def test_figures_have_the_verdict_of_their_bar():
    """A figure above its bar is a MISS, one within it a pass, one without bar neither."""
    ours, theirs = _result("ours", "twist2", False, 0), _result("official", "twist2", True, 8)
    verdicts = {f.name: f.verdict for f in figures(ours, [ours, theirs])}
    assert verdicts["fall rate, whole suite"] == "pass"
    assert verdicts["fall rate, against official TWIST2"] == "pass"
    assert verdicts["leg joint RMSE, walk 0.3 m/s"] == "MISS"
    assert verdicts["drift per 10 s, walk 0.3 m/s, open loop"] == "pass"
    assert verdicts["squat to 0.45 m and back"] == "pass"
    assert verdicts["goals reached in closed loop"] == "pass"
    assert verdicts["sit on 0.42 m (100 N for 2 s) and rise"] == "MISS"
    assert verdicts["step over a 9 cm sill"] == "MISS"
    assert verdicts["ball speed: standing kick"] == "MISS"
    assert verdicts["10 N against the chest, walk 0.35 m/s"] == "MISS"
    assert verdicts["push of 40 N·s in 0.1 s while walking, falls"] == "pass"
    assert {f.name: f.verdict for f in figures(theirs)}["fall rate, whole suite"] == "MISS"
    sonic = {f.name: f.verdict for f in figures(_result("s", "sonic", False, 0))}
    assert sonic["drift per 10 s, walk 0.3 m/s, open loop"] == ""


def test_a_part_of_the_suite_has_no_verdict_on_falls():
    """The bar of the fall rate holds for the whole suite; of some cells it is given without a verdict."""
    some = _result("ours", "twist2", False, 0, suite("quick"))
    official = _result("official", "twist2", True, 2, suite("quick"))
    verdicts = {f.name: f.verdict for f in figures(some, [some, official])}
    assert verdicts["fall rate, these cells only"] == ""
    assert not any("whole suite" in name or "official" in name for name in verdicts)


def test_command_line_writes_tables_side_by_side(tmp_path, capsys, monkeypatch):
    """Two trackers stand in one table; Markdown, JSON and CSV hold every cell."""
    short = [
        replace(cell, seconds=1.0, script=primitives.stand(1.0)) for cell in suite("quick") if cell.name == "stand"
    ]
    monkeypatch.setattr("arena_newton.trackers.evaluation.cells.suite", lambda name: short)
    arguments = "--tracker pd --label a --tracker pd --label b --suite quick --only stand --rollouts 2".split()
    arguments += ["--engine", "mujoco", "--threads", "1", "--no-bench", "--out", str(tmp_path)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "| figure | bar | a | b |" in printed and "fall rate, these cells only" in printed
    document = json.loads((tmp_path / "evaluation.json").read_text())
    assert [t["label"] for t in document["trackers"]] == ["a", "b"]
    assert document["trackers"][0]["cells"] == [
        {**cell, "tracker": "a"} for cell in document["trackers"][1]["cells"]
    ], "the same tracker on the same plan gives the same numbers"
    with (tmp_path / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["tracker"], r["cell"], r["rollouts"]) for r in rows] == [("a", "stand", "2"), ("b", "stand", "2")]
    text = (tmp_path / "evaluation.md").read_text()
    assert "## Figures" in text and "MPJPE" in text
    with Image.open(tmp_path / "evaluation.png") as picture:
        assert picture.width > 800


def test_the_chart_shows_each_verdict(tmp_path):
    """A figure past its limit is a MISS; the picture holds bars of both colours, beyond the line and short of it."""
    ours, theirs = _result("ours", "twist2", False, 0), _result("official", "twist2", True, 8)
    for result in (ours, theirs):
        for figure in figures(result, [ours, theirs]):
            assert figure.ratio is not None or figure.met is None, figure.name
            assert figure.ratio is None or figure.ratio <= 1.0 or figure.verdict == "MISS", figure.name
    with Image.open(chart.chart([ours, theirs], tmp_path / "chart.png")) as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    for colour in ("8fcfa5", "f0a090"):
        assert (pixels == np.frombuffer(bytes.fromhex(colour), np.uint8)).all(1).mean() > 0.02


def test_without_matplotlib_nothing_is_drawn(tmp_path, monkeypatch):
    """An absent plots extra is one line that says what to install."""
    monkeypatch.setattr(chart.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"chart.png: needs matplotlib: install `arena-newton\[plots\]`"):
        chart.chart([_result("ours", "twist2", False, 0)], tmp_path / "chart.png")
    (tmp_path / "progress.jsonl").write_text(json.dumps({name: 1 for name in ("seconds", *(p[0] for p in PANELS))}))
    with pytest.raises(InputError, match="curves: needs matplotlib"):
        draw([tmp_path], tmp_path / "curves.png")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "at least one --tracker"),
        (["--checkpoint", "x.onnx"], "name its --tracker first"),
        (["--tracker", "nobody"], "unknown tracker"),
        (["--tracker", "nowhere:factory"], "nowhere"),
        (["--tracker", "os:getcwd"], "--tracker os:getcwd: its factory does not take what it is given"),
        (["--tracker", "builtins:str"], "--tracker builtins:str: its factory makes a str, not a Tracker"),
        (["--tracker", "pd", "--tracker", "pd"], "--label"),
        (["--tracker", "pd", "--only", "nothing"], "no cell or group matches"),
        (["--tracker", "pd", "--only", "stand", "nothing"], "--only nothing: no cell or group matches"),
        (["--tracker", "pd", "--rollouts", "0"], "--rollouts 0"),
        (["--tracker", "pd", "--rollouts", "999999999"], "--rollouts 999999999: expected a number from 1 to 4096"),
        (["--tracker", "pd", "--clips", "absent.pkl"], "absent.pkl"),
        (["--tracker", "pd", "--film"], "--out"),
        (["--tracker", "pd", "--device", "cuda:99"], "cuda"),
    ],
)
def test_bad_arguments_end_in_one_line(arguments, message, capsys):
    """A mistyped command is answered by one line that names what is wrong."""
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error and error.startswith("error: ") and error.count("\n") == 1


def test_list_prints_the_cells(capsys):
    """--list names every cell without a tracker."""
    assert main(["--list"]) == 0
    printed = capsys.readouterr().out
    assert all(cell.name in printed for cell in suite("full"))


def test_film_shows_the_robot(tmp_path, monkeypatch):
    """A strip is written for every filmed cell, and its pictures differ where the robot moves."""
    from PIL import Image

    from arena_newton.trackers.base import get

    for name, value in (("FILMED", {"squat 0.45": "squat"}), ("PICTURES", 2), ("WIDTH", 48), ("HEIGHT", 48)):
        monkeypatch.setattr(tracker_film, name, value)
    monkeypatch.setitem(tracker_film.SHOWN, "squat 0.45", (0.0, 2.0))
    (path,) = tracker_film.film(get("pd"), "pd", tmp_path, engine="mujoco", threads=1)
    assert path.name == "film_pd_squat.png"
    strip = np.asarray(Image.open(path).convert("RGB")).astype(int)
    first, second = strip[-48:, :48], strip[-48:, -48:]
    assert np.abs(first - second).max() > 60


def test_film_of_the_push_suite_shows_the_fall(tmp_path, monkeypatch):
    """`--film` with the push suite is the ramp and nothing else; a tracker that balances nothing lies at its end."""
    from arena_newton.trackers.base import get

    for name, value in (("PICTURES", 2), ("WIDTH", 48), ("HEIGHT", 48)):
        monkeypatch.setattr(tracker_film, name, value)
    name = next(iter(tracker_film.FILMED_PUSHES))
    (cell,) = (cell for cell in suite("push") if cell.name == name)
    short = replace(cell, seconds=5.0, blows=replace(cell.blows, segments=1))
    monkeypatch.setattr(tracker_film, "suite", lambda name: {"push": [suite("push")[0], short]}[name])
    monkeypatch.setitem(tracker_film.SHOWN, name, (0.0, 4.9))
    (path,) = tracker_film.film(get("pd"), "pd", tmp_path, blows=True, engine="mujoco", threads=1)
    assert path.name == "film_pd_blows.png"
    strip = np.asarray(Image.open(path).convert("RGB")).astype(int)
    first, last = strip[-48:, :48], strip[-48:, -48:]
    changed = np.abs(first - last).max(axis=2) > 60
    assert changed[:24].any(), "the head is gone from the upper half"
