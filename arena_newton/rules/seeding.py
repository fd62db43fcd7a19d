"""Seeds of an episode: who, where and under which light depends on three names and numbers only.

The formulas are those of the original benchmark; its recorded seeds and samples are reproduced exactly (see the tests).
"""

import hashlib
import random
import zlib

import numpy as np

__all__ = ["DEMONSTRATION", "EVALUATION", "TELEOPERATION", "episode_seed", "light_rng", "object_rng", "object_seed"]
__all__ += ["dynamics_rng", "planned_seed", "policy_seed", "recording_seed", "seed_range", "sensor_rng"]

EVALUATION = "evaluation"
"""Range of the seeds that judge a policy, which are positive int32 as the original's: 0 to 2^31 - 1."""
DEMONSTRATION = "demonstration"
"""Range of the seeds of recorded experts: 2^31 to 2^32 - 1, so that no episode of it is ever evaluated."""
TELEOPERATION = "teleoperation"
"""Range of the seeds of recorded people: the same numbers as of demonstrations, drawn apart from them."""

_U64 = (1 << 64) - 1
_EPISODE_STEP = 0x9E3779B185EBCA87
"""Step of the object seed between the episodes of one process; every evaluation episode is the first of its process."""
_FIRST_WORLD = 0x85EBCA77
"""Addend of the original's first world to the key of an object's generator."""
_RECORDED = 1 << 31
"""Bit of the seeds of recordings."""
_LIGHT_KEY = 0x1A2B3C4D
"""Separates the light's generator from all others."""


def episode_seed(gym_id: str, group_seed: int, repeat: int) -> int:
    """Seed of one episode: the last four bytes of sha256("gym_id|group_seed|repeat"), as a positive int32.

    Args:
        gym_id: The task's id as the original spells it.
        group_seed: 0, 1 or 2 in the published protocol.
        repeat: 0 to 19 in the published protocol.
    """
    digest = hashlib.sha256(f"{gym_id}|{group_seed}|{repeat}".encode()).digest()
    return int.from_bytes(digest[-4:], "big") & 0x7FFFFFFF


def recording_seed(gym_id: str, kind: str, group_seed: int, repeat: int) -> int:
    """Seed of one episode to learn from: as `episode_seed`, but with bit 31 set, which no evaluation seed has.

    Args:
        gym_id: The task's id as the original spells it.
        kind: `DEMONSTRATION` or `TELEOPERATION`.
        group_seed: Number of a series of recordings.
        repeat: Number of the episode in its series.
    """
    digest = hashlib.sha256(f"{gym_id}|{kind}|{group_seed}|{repeat}".encode()).digest()
    return int.from_bytes(digest[-4:], "big") | _RECORDED


def planned_seed(gym_id: str, kind: str, group_seed: int, repeat: int) -> int:
    """Seed of one planned episode: `episode_seed` for `EVALUATION`, `recording_seed` for the ranges of recordings."""
    if kind == EVALUATION:
        return episode_seed(gym_id, group_seed, repeat)
    return recording_seed(gym_id, kind, group_seed, repeat)


def seed_range(episode_seed: int) -> str:
    """`EVALUATION` for a seed that may judge a policy, otherwise `DEMONSTRATION`: whoever learns may use it."""
    return DEMONSTRATION if int(episode_seed) & _RECORDED else EVALUATION


def policy_seed(episode_seed: int) -> int:
    """Seed of an episode that a policy is given, for its noise alone: 0 to 2^31 - 1, by SHA-256 of the episode seed.

    It leads back to no placement. It is no secret: who tries all numbers of a plan finds the episode.
    """
    digest = hashlib.sha256(f"policy|{int(episode_seed)}".encode()).digest()
    return int.from_bytes(digest[-4:], "big") & 0x7FFFFFFF


def object_seed(episode_seed: int) -> int:
    """Master seed of an episode's objects, 64 bits."""
    return (int(episode_seed) ^ _EPISODE_STEP) & _U64


def object_rng(object_seed: int, record_name: str) -> np.random.Generator:
    """Generator of one object.

    The original evaluates one world per process, so an episode here is drawn as in the original's first world,
    whichever world of the batch runs it.

    Args:
        object_seed: Master seed of the episode's objects.
        record_name: The object's name in the original's records, e.g. `football`.
    """
    return np.random.default_rng((int(object_seed) ^ zlib.crc32(record_name.encode()) ^ _FIRST_WORLD) & _U64)


def light_rng(episode_seed: int) -> random.Random:
    """Generator of the light in visual mode."""
    return random.Random(int(episode_seed) ^ _LIGHT_KEY)


def dynamics_rng(episode_seed: int, quantity: str) -> random.Random:
    """Generator of one quantity of an episode's dynamics, by SHA-256 of its name and the episode seed."""
    digest = hashlib.sha256(f"dynamics|{quantity}|{int(episode_seed)}".encode()).digest()
    return random.Random(int.from_bytes(digest[:8], "big"))


def sensor_rng(episode_seed: int, tick: int, sensor: str = "state") -> np.random.Generator:
    """Generator of one sensor's noise at one tick of an episode, by SHA-256 of their names and the episode seed."""
    digest = hashlib.sha256(f"sensor|{sensor}|{int(episode_seed)}|{tick}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))
