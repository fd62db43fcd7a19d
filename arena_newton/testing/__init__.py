"""Conformance checks for trackers and policies from outside: what the interfaces promise, tried on an object.

    from arena_newton.testing import check_policy, check_tracker

    def test_my_tracker():
        check_tracker(MyTracker())

Every broken promise is named in one `ConformanceError`. The same on a command line, for anything that is known by name:
`python -m arena_newton doctor --tracker falcon`.
"""

from arena_newton.testing.findings import CheckResult, ConformanceError
from arena_newton.testing.policy_conformance import check_policy
from arena_newton.testing.tracker_conformance import check_tracker

__all__ = ["CheckResult", "ConformanceError", "check_policy", "check_tracker"]
