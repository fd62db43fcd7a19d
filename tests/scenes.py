"""Scenes of one world for native MuJoCo that many tests read: each is built once per process."""

from functools import cache
from pathlib import Path

from arena_newton import rule_sets
from arena_newton.physics.scene import Scene, load_scene


@cache
def _built(task: str, variant: str, rules: str | None, layer: Path | None) -> Scene:
    given = rules and rule_sets.get(rules)
    return load_scene(task, variant=variant, variant_file=layer, device="cpu", native=True, rules=given)


def scene(task: str, variant: str = "base", rules: str | None = None, layer: Path | None = None) -> Scene:
    """A task's scene; whoever needs a time step sets it, and leaves all else of its model as it is."""
    return _built(task, variant, rules, layer)
