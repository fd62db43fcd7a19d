"""Trackers: whole-body controllers that execute a reference on the robot."""

from arena_newton.trackers.base import (
    RobotState,
    Tracker,
    TrackerCommand,
    check_spec,
    get,
    names,
    register,
    shipped_weights,
)

__all__ = ["RobotState", "Tracker", "TrackerCommand", "check_spec", "get", "names", "register", "shipped_weights"]
