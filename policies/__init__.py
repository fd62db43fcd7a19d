"""Policies: they look and decide a 40-number whole-body action."""

from arena_newton.policies.base import (
    Chunk,
    Observation,
    Policy,
    PolicyUnavailable,
    check_spec,
    get,
    names,
    register,
    world_mask,
)

__all__ = [
    "Chunk",
    "Observation",
    "Policy",
    "PolicyUnavailable",
    "check_spec",
    "get",
    "names",
    "register",
    "world_mask",
]
