"""The stages of the paper's taxonomy of failures."""

from __future__ import annotations

from enum import StrEnum

__all__ = ["FailureStage"]


class FailureStage(StrEnum):
    """A stage at which an episode fails, in the order of the paper's appendix."""

    PERCEPTION = "perception"
    """The object is not found: the robot never stops near it."""
    APPROACH = "approach"
    """It is found, but the robot stops where it cannot be touched."""
    POSTURE = "posture"
    """The robot stands where it could touch the object and does not, or loses its balance before."""
    CONTACT = "contact"
    """The object is touched without the effect that the task wants."""
    RECOVERY = "recovery"
    """Falls after a touch, or does not follow an object that moved away."""
    TRACKING = "tracking (legs)"
    """The legs do not do what a plausible reference says."""

    @classmethod
    def _missing_(cls, value: object) -> FailureStage | None:
        """The stage's former name, in folders that were written before."""
        return cls.TRACKING if value == "tracker" else None
