"""Command `python -m arena_newton.policies.teleop redis`."""

from __future__ import annotations

from arena_newton.policies.teleop.driving_command import drive, make_world
from arena_newton.policies.teleop.redis_reference import references
from arena_newton.policies.teleop.redis_source import RedisSource, connect
from arena_newton.policies.teleop.teleop_options import RedisOptions

__all__ = ["drive_by_redis"]


def drive_by_redis(options: RedisOptions) -> int:
    """Take a sender's actions from a Redis server and run the session.

    Returns:
        Exit code.

    Raises:
        InputError: A flag is wrong, or the server does not answer.
    """
    client = connect(options.host, options.port, options.db)
    source = RedisSource(client, references(options.tracker), say=lambda line: print(line, flush=True))
    env = make_world(options)
    print(
        f"input is taken from {options.host}:{options.port} as {source.backend.name}\nCtrl-C ends the session.",
        flush=True,
    )
    return drive(env, source, options)
