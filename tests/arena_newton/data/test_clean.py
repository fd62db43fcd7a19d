"""`data clean`: five rules, each counted, and videos that keep step with the rows."""

import random
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from made_episodes import make_episode

from arena_newton.data.__main__ import main
from arena_newton.data.datasets.cleaning import RULES, Rows, broken_rules
from arena_newton.data.recording.episode import EpisodeFile
from arena_newton.rules import seeding

sys.path.insert(0, str(Path(__file__).parents[2] / "fuzz"))
from mutants import damaged


def rows(n=10, **changes):
    """Rows without a fault, with some fields changed."""
    fields = {
        "frame": np.arange(n),
        "time": 0.02 * np.arange(n),
        "action": np.arange(n, dtype=float)[:, None] * np.ones(40),
        "joints": np.zeros((n, 29)),
    }
    return Rows(**fields | changes, step=0.02, fields={})


def broken(name, of, **options):
    """Rows that break one rule; no other one may be broken."""
    found = broken_rules(of, **options)
    assert set(found) == set(RULES)
    assert not any(found[other].any() for other in RULES if other != name)
    return np.flatnonzero(found[name]).tolist()


def test_sound_rows_break_no_rule():
    """Rows of a steady source break none, nor does the first row ever."""
    assert not any(rule.any() for rule in broken_rules(rows()).values())
    assert not any(rule[0] for rule in broken_rules(rows(1)).values())


def test_each_rule_alone():
    """Each rule finds its own fault against the row immediately before, at the original's thresholds."""
    frame = np.array([0, 1, 1, 2, 3, 4, 5, 6, 7, 8])
    assert broken("nonmonotonic", rows(frame=frame)) == [2]
    frame = np.array([0, 1, 3, 4, 5, 6, 7, 8, 9, 10])
    assert broken("gap", rows(frame=frame)) == [2]
    assert broken("gap", rows(frame=frame), max_gap=2) == []
    time = 0.02 * np.array([0, 1, 2, 2, 3, 4, 5, 6, 7, 8.0])
    assert broken("backward", rows(time=time)) == [3]
    time = 0.02 * np.array([0, 1, 2, 4.6, 5.6, 6.6, 7.6, 8.6, 9.6, 10.6])
    assert broken("slow", rows(time=time)) == [3]
    time = 0.02 * np.array([0, 1, 3, 4, 5, 6, 7, 8, 9, 10.0])
    assert broken("slow", rows(time=time), max_step=2.0) == [], "a step of exactly the limit is none too long"
    action = rows().action.copy()
    action[4], action[5] = 0.0, 1e-6
    joints = np.zeros((10, 29))
    assert broken("held", rows(action=action, joints=joints)) == []
    joints[5:, 7] = 0.02
    assert broken("held", rows(action=action, joints=joints)) == [5]
    action[5] = 2e-6
    assert broken("held", rows(action=action, joints=joints)) == []


def test_a_backward_clock_counts_once_per_row_before_it():
    """A row is compared with the one recorded before it, dropped or not: after a jump back the next one is sound."""
    time = 0.02 * np.array([0, 1, 2, 0, 1, 2, 3, 4, 5, 6.0])
    assert broken("backward", rows(time=time)) == [3]


@pytest.fixture
def spoiled(tmp_path):
    """A folder of one sound recording and one with three faults: rows 5 (clock), 9 and 10 (frame index)."""
    folder = tmp_path / "recorded"
    make_episode(folder, repeat=0)
    time = 0.02 * np.arange(40)
    time[5] = time[4]
    frame = np.arange(40)
    frame[9:] += 3
    frame[10] = frame[9]
    bad = make_episode(folder, repeat=1, system_timestamp=time, gmr_frame_index=frame)
    return folder, bad


def frames(video):
    """All frames, decoded."""
    with av.open(str(video)) as container:
        return np.stack([frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)])


def test_rows_and_frames_are_dropped_together(spoiled, tmp_path, capsys):
    """Spoiled rows leave every field and the video; what stays agrees, and the sound recording is the same bytes."""
    folder, bad = spoiled
    out = tmp_path / "cleaned"
    assert main(["clean", str(folder), "--out", str(out)]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith(f"| {folder}"))
    # episodes, rows, nonmonotonic, gap, backward, slow, held, dropped, episodes with dropped rows
    assert line.split("|")[2:-1] == [f" {n} " for n in (2, 80, 1, 2, 1, 0, 0, 4, 1)]
    before, after = EpisodeFile(bad), EpisodeFile(out / bad.name)
    stays = np.delete(np.arange(40), [5, 9, 10, 11])
    assert after.rows == 36
    np.testing.assert_array_equal(after.array("arena_source_rows"), stays)
    np.testing.assert_array_equal(after.action, before.action[stays])
    np.testing.assert_array_equal(after.array("arena_phase"), before.array("arena_phase")[stays])
    np.testing.assert_array_equal(after.array("vision_frame_indices"), np.arange(36))
    np.testing.assert_array_equal(after.array("arena_final_qpos"), before.array("arena_final_qpos"))
    assert after.json("arena_cleaned")["rules"] == {"nonmonotonic": 1, "gap": 2, "backward": 1, "slow": 0}
    was, now = frames(before.video("front")), frames(after.video("front"))
    assert len(now) == 36 and np.abs(was[stays] - now).mean(axis=(1, 2, 3)).max() < 3
    assert np.abs(was[stays][1:] - now[:-1]).mean(axis=(1, 2, 3)).min() > 5, "pictures tell which frame they are"
    histogram = after.array("arena_vision_histogram", 3, 256)
    assert set(histogram.sum(axis=1)) == {36 * 32 * 32}
    sound = next(file for file in folder.glob("*.npz") if file != bad)
    assert (out / sound.name).read_bytes() == sound.read_bytes()
    video = EpisodeFile(sound).video("front").name
    assert (out / "videos" / video).read_bytes() == (folder / "videos" / video).read_bytes()


def test_rules_are_turned_off_and_a_second_cleaning_drops_no_more(spoiled, tmp_path, capsys):
    """A flag turns each rule off; cleaning what is clean gives the same bytes, and so does doing it again."""
    folder, bad = spoiled
    flags = ["--no-nonmonotonic", "--no-gap"]
    assert main(["clean", str(folder), "--out", str(tmp_path / "one"), *flags]) == 0
    assert EpisodeFile(tmp_path / "one" / bad.name).rows == 39
    assert main(["clean", str(folder), "--out", str(tmp_path / "same"), *flags]) == 0
    assert main(["clean", str(tmp_path / "one"), "--out", str(tmp_path / "two"), *flags, "--no-slow"]) == 0
    for other in ("same", "two"):
        assert (tmp_path / other / bad.name).read_bytes() == (tmp_path / "one" / bad.name).read_bytes()
    capsys.readouterr()
    assert main(["clean", str(folder), "--count", "--out", str(tmp_path / "none")]) == 0
    assert "| 4 | 1 |" in capsys.readouterr().out
    assert not (tmp_path / "none").exists()


def test_the_originals_own_recordings(tmp_path):
    """An NPZ of the original's SONIC schema is cleaned by the same rules; of its frame indices the raw one counts."""
    folder = tmp_path / "raw"
    folder.mkdir()
    n = 30
    time = 1.7e9 + 0.02 * np.arange(n)
    time[20:] += 0.5
    arrays = {
        "schema_version": np.str_("sonic_episode_v3"),
        "num_frames": np.int64(n),
        "meta_control_dt": np.full(n, 0.02),
        "consumed_frame_index": np.arange(n) // 2,
        "gmr_frame_index": np.arange(n) * 3,
        "raw_frame_index": np.arange(n) + 100,
        "realtime_timestamp": time,
        "vla_action": np.cumsum(np.ones((n, 40)), axis=0),
        "robot_qpos_before_decimation": np.zeros((n, 29)),
        "encoder_input": np.arange(n)[:, None] * np.ones(1762),
    }
    np.savez(folder / "task_sonic_1.npz", **arrays)
    assert main(["clean", str(folder), "--out", str(tmp_path / "out")]) == 0
    with np.load(tmp_path / "out" / "task_sonic_1.npz") as kept:
        np.testing.assert_array_equal(kept["encoder_input"][:, 0], np.delete(np.arange(n), 20))
        assert len(kept["meta_control_dt"]) == n and int(kept["num_frames"]) == n - 1


def still(folder, *, executed, repeat=0, seeds=seeding.TELEOPERATION):
    """A recording whose labels repeat while joints move; what was executed repeats too, or does not."""
    label = np.zeros((40, 40), np.float32)
    joints = 0.03 * np.arange(40, dtype=np.float32)[:, None] * np.ones((1, 29), np.float32)
    fields = {"arena_action": label, "arena_executed_action": executed, "robot_qpos_before_decimation": joints}
    return make_episode(folder, repeat=repeat, cameras=(), arena_seed_range=np.str_(seeds), **fields)


def test_a_repeated_label_is_no_held_action(tmp_path, capsys):
    """Executed actions are judged, not the label; a policy that stands is not, and a stalled source is."""
    folder, held = tmp_path / "recorded", np.zeros((40, 40), np.float32)
    moving = np.arange(40, dtype=np.float32)[:, None] * np.ones((1, 40), np.float32)
    sound = [
        still(folder, executed=moving, repeat=0, seeds=seeding.DEMONSTRATION),
        still(folder, executed=moving, repeat=1),
        still(folder, executed=held, repeat=2, seeds=seeding.DEMONSTRATION),
        still(folder, executed=held, repeat=3, seeds=seeding.EVALUATION),
    ]
    stalled = still(folder, executed=held, repeat=4)
    assert main(["clean", str(folder), "--out", str(tmp_path / "out")]) == 0
    assert "| 39 | 39 | 1 |" in capsys.readouterr().out
    assert [EpisodeFile(tmp_path / "out" / file.name).rows for file in sound] == [40] * 4
    assert EpisodeFile(tmp_path / "out" / stalled.name).rows == 1


def test_bad_input_is_one_clear_error(tmp_path, capsys):
    """Flags, folders and fields that do not fit are named, with exit code 2, and nothing is written."""
    file = make_episode(tmp_path / "a", rows=4)
    out = tmp_path / "out"
    for arguments, message in {
        ("clean", str(tmp_path / "none")): "no such folder",
        ("clean", str(file.parent), "--max-gap", "0"): "--max-gap 0: expected at least 1",
        ("clean", str(file.parent), "--max-step", "nan"): "--max-step nan",
        ("clean", str(file.parent), "--out", str(tmp_path / "a")): "exists",
    }.items():
        assert main([*arguments, *([] if "--out" in arguments else ["--out", str(out)])]) == 2
        assert message in capsys.readouterr().err
    for number, (name, value) in enumerate(
        {
            "num_frames": None,
            "system_timestamp": np.zeros(3),
            "arena_executed_action": np.full((4, 40), np.nan, np.float32),
            "system_control_frequency": np.float64(0),
            "robot_qpos_before_decimation": np.array(["a"] * 4),
        }.items()
    ):
        folder = tmp_path / f"bad{number}"
        make_episode(folder, rows=4, **{name: value})
        assert main(["clean", str(folder), "--out", str(out)]) == 2
        assert name in capsys.readouterr().err
    (file.parent / "videos" / f"{file.stem}_front_rgb.mp4").unlink()
    assert main(["clean", str(file.parent), "--out", str(out)]) == 2
    assert "is missing" in capsys.readouterr().err
    assert not out.exists() and not list(tmp_path.glob("out*"))


def test_damaged_recordings(tmp_path, capsys, mutants):
    """Damaged recordings are cleaned, or refused in one line that names them; nothing half is left."""
    folder, rng = tmp_path / "a", random.Random(3)
    file = make_episode(folder, rows=6, size=16, system_timestamp=np.array([0, 1, 1, 2, 3, 4]) * 0.02)
    sound, counts = file.read_bytes(), {0: 0, 2: 0}
    for number in range(mutants):
        file.write_bytes(damaged(sound, rng))
        counts[main(["clean", str(folder), "--out", str(tmp_path / f"out{number}")])] += 1
        error = capsys.readouterr().err
        assert not error or str(folder) in error
    assert counts[2] > mutants // 10 and not list(tmp_path.glob("*.part*"))
