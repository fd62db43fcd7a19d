"""Actions of an expert by episode, for tests that compare two runs bit for bit."""

from arena_newton.interfaces import Recorder


class Actions(Recorder):
    """Keeps the actions of every episode, by its seed."""

    def __init__(self, startup=True):
        """With those of the start-up, or from step 0 on."""
        self.startup, self.worlds, self.rows = startup, {}, {}

    def start(self, env, world, episode):
        self.worlds[world] = self.rows.setdefault(episode.episode_seed, [])

    def before_physics(self, env, observation, action):
        for world, rows in self.worlds.items():
            if self.startup or (env.active[world] and env.tick[world] >= 0):
                rows.append(action[world].clone())

    def finish(self, env, world, result):
        del self.worlds[world]
