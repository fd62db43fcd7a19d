"""LeRobot's environment plug-in: `lerobot-eval --env.type=arena_newton` plays our episodes.

    lerobot-eval --env.discover_packages_path=arena_newton.eval.adapters.lerobot_env --env.type=arena_newton ...

LeRobot imports this package and every module in it, so that the configuration registers itself.
"""

from arena_newton.eval.adapters.lerobot_env.plugin import ArenaNewtonEnv

__all__ = ["ArenaNewtonEnv"]
