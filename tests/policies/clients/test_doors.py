"""One policy behind every door: the same actions and outcomes as in this process, to the last bit."""

from types import SimpleNamespace

import numpy as np
import pytest
from foreign_servers import SIZE, NoisePolicy, declared_servers, observation

from arena_newton import policies, trackers
from arena_newton.env import ArenaEnv
from arena_newton.rollout import Rollout

DOORS = declared_servers()
STEPS = 9


def ask(policy, seeds):
    """Chunks of worlds that begin and ask at different times."""
    worlds, found = len(seeds), []
    policy.reset(seeds, ["Isaac-Football"] * worlds)
    for turn in range(3):
        mask = np.arange(worlds) % 3 != turn
        if turn == 2:
            policy.reset([s + 100 for s in seeds], ["Isaac-Football"] * worlds, np.arange(worlds) == 0)
        chunk = policy.act(observation(worlds, mask))
        assert chunk.errors == {}
        found.append(np.asarray(chunk.actions)[mask])
    return found


@pytest.mark.parametrize("door", DOORS)
def test_actions_are_the_same_through_every_door(door):
    """Each protocol carries state, picture, seed and step so that the actions are those of the policy itself."""
    server = DOORS[door]()
    policy = policies.get(f"remote:{server.url}", timeout=10.0, retries=1, backoff=0.01)
    policy.check()
    assert not policy.depends_on_worlds and policy.describe()["server"].startswith("noise")
    assert (policy.camera.width, policy.camera.height) == (SIZE, SIZE)
    for got, wanted in zip(ask(policy, [5, 6, 7, 8]), ask(NoisePolicy(), [5, 6, 7, 8]), strict=True):
        assert got.tobytes() == wanted.tobytes()
    policy.close()
    server.close()


def test_outcomes_are_the_same_through_every_door():
    """Episodes with the simulator and its pictures end with the same bits, whatever carries the policy."""
    made = {name: start() for name, start in DOORS.items()}
    env = ArenaEnv(
        "boxing",
        tracker=trackers.get("pd"),
        worlds=2,
        engine="mujoco",
        device="cpu",
        camera=NoisePolicy().camera,
    )
    ends = {}
    for name in ("direct", *made):
        policy = NoisePolicy() if name == "direct" else policies.get(f"remote:{made[name].url}", timeout=20.0)
        policy.check()
        episodes = [SimpleNamespace(episode_seed=seed) for seed in (3, 5, 8)]
        results = Rollout(env, policy, episodes, max_steps=STEPS).run()
        ends[name] = {r.episode.episode_seed: (r.outcome, r.steps, r.margin, r.error) for r in results}
        policy.close()
    for server in made.values():
        server.close()
    assert all(error is None for *_, error in ends["direct"].values()) and len(ends["direct"]) == 3
    assert all(found == ends["direct"] for found in ends.values()), ends
