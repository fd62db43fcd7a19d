"""Rates of the two engines are compared over rollouts that differ by next to nothing."""

import json

import pytest

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.studies import engines


def test_fisher_known_values():
    """Fisher's exact test gives the textbook's values: the lady tasting tea, and equal rates."""
    assert engines.fisher(3, 4, 1, 4) == pytest.approx(0.48571428, abs=1e-8)
    assert engines.fisher(8, 10, 1, 10) == pytest.approx(0.00547749, abs=1e-7)
    assert engines.fisher(5, 50, 5, 50) == pytest.approx(1.0)


def test_rates_on_disk_and_against(tmp_path, capsys):
    """A run writes its rates, and a later one compares itself with them."""
    out = tmp_path / "rates.json"
    flags = ["engines", "--task", "football", "--tracker", "pd", "--rollouts", "2", "--worlds", "2", "--max-steps", "5"]
    assert main([*flags, "--fast-physics", "--out", str(out)]) == 0
    (rates,) = json.loads(out.read_text())
    assert rates["engine"] == "mujoco" and rates["rollouts"] == 2
    assert main([*flags, "--fast-physics", "--against", str(out)]) == 0
    assert "p = 1.000 falls" in capsys.readouterr().out


def test_spawn_noise_follows_the_seed():
    """Another seed moves the robot elsewhere; no noise leaves it where the task puts it."""
    from arena_newton import trackers
    from arena_newton.env import ArenaEnv

    env = ArenaEnv("football", worlds=2, tracker=trackers.get("pd"), engine="mujoco")
    spawn = engines.moved_spawn(env.spec, noise=1e-3)
    root = env.scene.robot.root_qpos
    env.reset([1, 2], spawn=spawn)
    first = env.physics.qpos.numpy()[:, root : root + 2].copy()
    env.reset([2], [0], spawn=spawn)
    again = env.physics.qpos.numpy()[:, root : root + 2]
    assert abs(first[0] - first[1]).max() > 1e-5
    assert (again[0] == first[1]).all() and (again[1] == first[1]).all()


def test_bad_flags(tmp_path):
    """Unfit numbers and files are named."""
    with pytest.raises(InputError, match="--noise"):
        engines.run(engines.EngineOptions(noise=float("nan")))
    with pytest.raises(InputError, match="--against"):
        engines.run(engines.EngineOptions(against=str(tmp_path / "absent.json")))
