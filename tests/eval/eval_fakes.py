"""Stand-ins for world, tracker and policy: outcomes follow from the episode seed, no physics runs.

As a script it is the command line with these stand-ins, so that a test can kill it: ``eval_fakes.py run --out ...``.
"""

import os
import sys
import time
from types import SimpleNamespace

from arena_newton.errors import InputError
from arena_newton.eval.run import Factories


def outcome_of(episode):
    """Outcome, steps and margin that this world gives an episode."""
    number = episode.episode_seed % 10
    outcome = "success" if number < 5 else "fall" if number < 8 else "timeout"
    steps = episode.max_steps if outcome == "timeout" else 1 + episode.episode_seed % min(30, episode.max_steps)
    return outcome, steps, (episode.episode_seed % 997) / 997 - 0.5


class FakeEnv:
    """Keeps its worlds busy as the real one does; episodes end in another order than they start."""

    def __init__(self, task, *, worlds=1, mode="base", **options):
        """Take what the real one takes."""
        self.task, self.worlds, self.mode, self.options = task, worlds, mode, options

    def describe(self):
        """What the real one says of itself."""
        return {"engine": self.options["engine"], "device": "cpu", "physics_dt": 0.001, "startup_ticks": 0}

    def close(self):
        """Nothing to let go of."""

    def run_episodes(self, policy, episodes, on_finish=None, on_tick=None, recorder=None, max_steps=None):
        """Tick until all episodes have ended."""
        waiting, running = list(episodes), {}
        pause = float(os.environ.get("FAKE_TICK_S", "0"))
        while waiting or running:
            while waiting and len(running) < self.worlds:
                episode = waiting.pop(0)
                running[episode.index] = [episode, 0]
            time.sleep(pause)
            for index, slot in sorted(running.items(), reverse=True):
                slot[1] += 10
                episode = slot[0]
                outcome, steps, margin = outcome_of(episode)
                if slot[1] >= min(steps, 40):
                    del running[index]
                    on_finish(
                        SimpleNamespace(
                            episode=episode,
                            outcome=outcome,
                            reason=outcome,
                            steps=steps,
                            margin=margin,
                            startup_fall=outcome == "fall" and episode.repeat == 0,
                            overflow=False,
                            sim_s=steps * 0.02,
                            wall_s=time.perf_counter() % 1,
                            error=None,
                        )
                    )
            if on_tick is not None:
                on_tick(len(running))


def fake_tracker(spec, checkpoint):
    """Knows the two that the tests name."""
    if spec not in ("pd", "twist2"):
        raise InputError(f"--tracker {spec}: unknown tracker; known are pd, twist2")
    return SimpleNamespace(name=spec, describe=lambda: {"name": spec, "drive": "none"})


def fake_policy(spec, **options):
    """A policy that does not see."""
    return SimpleNamespace(
        name=spec,
        needs_image=False,
        depends_on_worlds=False,
        check=lambda: None,
        check_task=lambda *episodes: None,
        describe=lambda: {"name": spec},
        close=lambda: None,
    )


def factories(**changes):
    """Builders of the stand-ins."""
    parts = {"env": FakeEnv, "tracker": fake_tracker, "policy": fake_policy, "check_variant": lambda path, task: None}
    return Factories(**(parts | changes))


if __name__ == "__main__":
    from arena_newton.eval.__main__ import main

    sys.exit(main(sys.argv[1:], factories()))
