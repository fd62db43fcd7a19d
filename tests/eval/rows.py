"""Journal lines for tests: some keys are given, the others are filled in as a run would."""

from arena_newton import tasks
from arena_newton.eval.records.journal import SCHEMA, EpisodeRecord
from arena_newton.rules import seeding


def episodes(task, per_seed, repeats=20, falls=0, index=0):
    """Lines of one cell with the given successes per group seed; only what statistics need."""
    rows = []
    for seed, won in enumerate(per_seed):
        for repeat in range(repeats):
            outcome = "success" if repeat < won else "fall" if falls > 0 else "timeout"
            falls -= outcome == "fall"
            row = {"task": task, "tracker": "t", "policy": "p", "mode": "base", "group_seed": seed, "repeat": repeat}
            rows.append(row | {"outcome": outcome, "steps": 100 + repeat, "index": index + len(rows)})
    return rows


def full(row):
    """A line with all keys."""
    known = row["task"] in tasks.names()
    seed = seeding.episode_seed(tasks.get(row["task"]).gym_id, row["group_seed"], row["repeat"]) if known else 7
    rest = {"schema": SCHEMA, "rules": "paper", "engine": "mujoco", "episode_seed": seed}
    rest |= {"object_seed": seeding.object_seed(seed), "max_steps": 1300, "margin": 0.1}
    rest |= {"hashes": {"config": "0123456789ab"}, "startup_fall": False}
    ended = row["outcome"], row["steps"]
    rest |= {
        "reason": {"timeout": "ball_out"}.get(ended[0], ended[0]),
        "overflow": False,
        "error": None,
        "media": {},
        "video": "",
    }
    rest |= {"durations": {"wall_s": 1.0, "sim_s": 2.0}, "started_at": "a", "finished_at": "b"}
    rest |= {"phases": [["walk", 0], ["reach", 40]], "progress": 1.0 if ended[0] == "success" else 0.5}
    rest |= {"predicates": {"approach": 30, "contact": ended[1] if ended[0] == "success" else None}}
    fell = [{"kind": "fall", "tick": ended[1], "detail": "tilt"}] * (ended[0] == "fall")
    rest |= {"events": [{"kind": "contact", "tick": 61, "detail": "hand"}, *fell]}
    return rest | row


def made(row):
    """The record of such a line, whatever its values are."""
    return EpisodeRecord(**full(row) | {"events": (), "phases": ()})


def record(row):
    """The record of such a line."""
    return EpisodeRecord.from_json("a test", full(row))
