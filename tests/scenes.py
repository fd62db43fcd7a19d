"""Scenes of one world for native MuJoCo that many tests read: each is built once per process."""

from functools import cache

from arena_newton import rule_sets
from arena_newton.physics.scene import Scene, load_scene


@cache
def _built(task: str, variant: str, rules: str | None) -> Scene:
    return load_scene(task, variant=variant, device="cpu", native=True, rules=rules and rule_sets.get(rules))


def scene(task: str, variant: str = "base", rules: str | None = None) -> Scene:
    """A task's scene; whoever needs a time step sets it, and leaves all else of its model as it is."""
    return _built(task, variant, rules)
