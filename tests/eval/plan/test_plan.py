"""The plan is pure, ordered, complete, and prints everything that an episode draws."""

import json

import pytest

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.eval.plan import episode_plan

KEYS = ["task", "mode", "rules", "group_seed", "repeat", "episode_seed", "object_seed", "sampled", "placed", "light"]
KEYS += ["max_steps"]


def expand(*names: str, **changes):
    """A plan with the default tracker and policy."""
    return episode_plan.expand(names or ("all",), **({"trackers": ("pd",), "policy": "stand"} | changes))


def test_full_protocol():
    """Seven tasks × four modes × three seeds × twenty repeats, numbered in order, with unique keys."""
    episodes = expand(*tasks.PAPER, modes=("base", "execution", "semantic", "visual"))
    assert len(episodes) == 7 * 4 * 60
    assert [e.index for e in episodes] == list(range(len(episodes)))
    assert len({e.key for e in episodes}) == len(episodes)
    assert tuple(dict.fromkeys(e.task for e in episodes)) == tasks.PAPER
    assert all(len({e.episode_seed for e in episodes if e.task == t}) == 60 for t in tasks.PAPER)


def test_trackers_of_a_task_follow_each_other():
    """Within a task the trackers, within a tracker the modes; each counts its episodes from 0."""
    episodes = expand("football", "boxing", trackers=("a", "b"), modes=("base", "visual"), seeds=(0, 1), repeats=2)
    cells = list(dict.fromkeys((e.task, e.tracker, e.mode) for e in episodes))
    assert cells[:5] == [*(("football", t, m) for t in "ab" for m in ("base", "visual")), ("boxing", "a", "base")]
    assert [e.index for e in episodes] == list(range(32)) and [e.rank for e in episodes] == [0, 1, 2, 3] * 8


def test_one_seed_for_every_mode_and_rule_set():
    """Seeds depend on task, group seed and repeat only."""
    base = expand("boxing", seeds=(0,), repeats=2)
    assert [e.episode_seed for e in base] == [1049058202, 12283769]
    assert base[0].object_seed == 11400714785972326685
    other = expand("boxing", seeds=(0,), repeats=2, modes=("visual",), rules="released", engine="warp")
    assert [e.episode_seed for e in other] == [e.episode_seed for e in base]
    assert (base[0].max_steps, other[0].max_steps) == (1500, 900)


def test_listing_holds_the_recorded_draws():
    """`list --json` shows the original's samples and their world poses, as plain JSON."""
    (row,) = map(episode_plan.listed, expand("double_desk", seeds=(0,), repeats=1))
    assert list(row) == KEYS
    assert json.loads(json.dumps(row)) == row
    assert row["sampled"]["hammer"]["yaw"] == pytest.approx(-0.317236, abs=5e-7)
    assert row["sampled"]["basket"]["x"] == pytest.approx(-3.573021, abs=5e-7)
    assert row["placed"]["basket"]["position"] == pytest.approx([-3.573021, -0.122363, 0.745], abs=5e-7)
    assert row["placed"]["hammer"]["prim"] == "/World/Hammer"
    assert row["light"] is None
    (row,) = map(episode_plan.listed, expand("double_desk", seeds=(0,), repeats=1, rules="released"))
    assert row["placed"]["basket"]["position"] == pytest.approx([-2.83573, -0.10122, 0.75245], abs=5e-6)
    assert row["light"]["direction"] == [0.0, 0.0, -1.0]


@pytest.mark.parametrize("rules", ["paper", "released"])
def test_every_episode_lists_as_json(rules):
    """Every task in every mode lists all its objects; visual mode lists its light."""
    modes = ("base", "execution", "semantic", "visual")
    rows = [episode_plan.listed(e) for e in expand(modes=modes, rules=rules, seeds=(2,), repeats=2)]
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    for row in rows:
        records = {o.record for o in tasks.get(row["task"]).objects}
        assert set(row["sampled"]) == set(row["placed"]) == records
        if row["mode"] == "visual":
            assert 3000.0 <= row["light"]["intensity"] <= 7000.0


def test_max_steps_caps_the_budget():
    """A cap shortens budgets and never lengthens them."""
    assert {e.max_steps for e in expand("football", "boxing", max_steps=1400)} == {1300, 1400}


@pytest.mark.parametrize(
    ("names", "changes", "message"),
    [
        (("golf",), {}, "--task golf"),
        (("all", "boxing"), {}, "--task all"),
        (("boxing", "boxing"), {}, "--task boxing: given twice"),
        (("boxing",), {"modes": ("night",)}, "--mode night"),
        (("boxing",), {"modes": ()}, "--mode: nothing given"),
        (("boxing",), {"trackers": ("pd", "pd")}, "--tracker pd: given twice"),
        (("boxing",), {"trackers": ("own:a+b", "own:a=b")}, "two have one name as a folder"),
        (("boxing",), {"seeds": (1, 1)}, "--seeds 1: given twice"),
        (("boxing",), {"repeats": 0}, "--repeats 0"),
        (("boxing",), {"rules": "mine"}, "--rules mine"),
        (("boxing",), {"max_steps": 0}, "--max-steps 0"),
    ],
)
def test_bad_requests_are_named(names, changes, message):
    """Each wrong flag is answered with one line that names it."""
    with pytest.raises(InputError, match=message):
        expand(*names, **changes)


def test_weights_of_the_package_count():
    """Without --checkpoint a run's identity holds the hash of the weights that come with the package."""
    from arena_newton import trackers
    from arena_newton.eval.plan import config

    path = trackers.shipped_weights("twist2")
    assert path is not None
    resolved = config.resolve(config.RunOptions(task=("football",), tracker=("twist2",)))
    assert resolved.checkpoint is None and resolved.checkpoint_hashes == {"twist2": config.hash_path(path)}
    named = config.resolve(config.RunOptions(task=("football",), tracker=("twist2",), checkpoint=str(path)))
    assert named.checkpoint_hashes == resolved.checkpoint_hashes
    assert config.resolve(config.RunOptions(task=("football",), tracker=("pd",))).checkpoint_hashes == {"pd": None}


def test_two_files_and_folders_as_checkpoint(tmp_path):
    """SONIC's two files, or the folder that holds them, are one checkpoint; a missing one of them is named."""
    from arena_newton.errors import InputError
    from arena_newton.eval.plan import config

    for name in ("model_encoder.onnx", "model_decoder.onnx"):
        (tmp_path / name).write_bytes(name.encode())
    pair = ",".join(str(tmp_path / n) for n in ("model_encoder.onnx", "model_decoder.onnx"))
    hashes = {
        config.resolve(config.RunOptions(task=("football",), tracker=("sonic",), checkpoint=given)).checkpoint_hashes[
            "sonic"
        ]
        for given in (pair, str(tmp_path), str(tmp_path / "model_encoder.onnx"))
    }
    assert len(hashes) == 3
    with pytest.raises(InputError, match="--checkpoint .*absent.onnx"):
        config.resolve(config.RunOptions(task=("football",), checkpoint=f"{tmp_path}/absent.onnx,{pair}"))
