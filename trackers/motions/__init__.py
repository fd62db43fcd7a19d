"""Motion clips that references are made from."""

from arena_newton.trackers.motions.load import Clip, load_actions, load_clip

__all__ = ["Clip", "load_actions", "load_clip"]
