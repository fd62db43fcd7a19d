"""What an expert did, kept by episode: for tests that compare two runs bit for bit."""

from arena_newton.interfaces import Recorder


class Actions(Recorder):
    """Keeps the actions of every episode, by its seed."""

    def __init__(self):
        self.worlds, self.rows = {}, {}

    def start(self, env, world, episode):
        self.worlds[world] = self.rows.setdefault(episode.episode_seed, [])

    def before_physics(self, env, observation, action):
        for world, rows in self.worlds.items():
            rows.append(action[world].clone())
